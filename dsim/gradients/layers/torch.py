"""dsim inside PyTorch: a `torch.nn.Module` whose backward is `adjoint`."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from dsim.gradients.layers.state_map import TWICE, Output, StateMap, missing
from dsim.gradients.objectives import Run, Variables


def torch_layer(run: Run, variables: Variables, output: Output = "path") -> Any:
    """A `torch.nn.Module`: p (..., k) -> the states along the path (..., N+1, ny), or with output="last" (..., ny).

    run: (system, y0) -> trajectory, as for ReducedObjective; every row of a batch is one run.  p is float64 or float32;
    dsim computes in float64, and states and gradient come back in p's dtype, on p's device.  The backward is `adjoint`,
    once a row: any number of passes with retain_graph=True, but no derivative of the derivative, and no torch.func.

    Raises ImportError without PyTorch; ValueError for p of another shape or dtype, or not finite; SimulationError, with
    its status, where a run ends early; RuntimeError for a second derivative.
    """
    return _module()(StateMap(run, variables, output))


@cache
def _module() -> Any:
    """The module's class.  It inherits from PyTorch's, which is imported only where someone makes a layer."""
    try:
        import torch
    except ImportError as error:
        raise missing("torch_layer", "PyTorch", "torch") from error

    class Pullback(torch.autograd.Function):
        """bar -> (dy/dp)^T bar; a function of its own, so that a second derivative is refused and not silently 0."""

        @staticmethod
        def forward(ctx: Any, p: Any, bar: Any, scene: StateMap, trajectories: Any) -> Any:
            bars = _doubles(bar).reshape(len(trajectories), *bar.shape[p.ndim - 1 :])
            rows = [scene.pullback(trajectory, row) for trajectory, row in zip(trajectories, bars, strict=True)]
            return _like(p, rows, p.shape)

        @staticmethod
        def backward(ctx: Any, *bars: Any) -> Any:
            raise RuntimeError(TWICE)

    class States(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, p: Any, scene: StateMap) -> Any:
            trajectories = [scene.trajectory(row) for row in _doubles(p).reshape(-1, p.shape[-1])]
            if ctx.needs_input_grad[0]:
                ctx.save_for_backward(p)
                ctx.scene, ctx.trajectories = scene, trajectories
            return _like(p, [scene.states(taken) for taken in trajectories], p.shape[:-1] + scene.shape)

        @staticmethod
        def backward(ctx: Any, *bars: Any) -> Any:
            (p,) = ctx.saved_tensors
            return Pullback.apply(p, bars[0], ctx.scene, ctx.trajectories), None

    class SceneLayer(torch.nn.Module):
        def __init__(self, scene: StateMap) -> None:
            super().__init__()
            self.scene = scene

        def forward(self, p: Any) -> Any:
            _check(p, len(self.scene.variables))
            return States.apply(p, self.scene)

        def extra_repr(self) -> str:
            return f"{', '.join(self.scene.variables.wrt)} ({len(self.scene.variables)}) -> {self.scene.output}"

    return SceneLayer


def _check(p: Any, count: int) -> None:
    kind = str(getattr(p, "dtype", type(p).__name__))
    if kind not in ("torch.float64", "torch.float32"):
        raise ValueError(f"p must be a tensor of float64 or float32; got {kind}")
    if p.ndim == 0 or p.shape[-1] != count:
        raise ValueError(f"p must have shape (..., {count}); got {tuple(p.shape)}")


def _doubles(tensor: Any) -> Any:
    return tensor.detach().cpu().double().numpy()


def _like(p: Any, rows: Any, shape: Any) -> Any:
    return p.new_tensor(np.array(rows, dtype=float)).reshape(shape)
