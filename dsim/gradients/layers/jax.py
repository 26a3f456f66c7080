"""dsim inside JAX: a function with a `jax.custom_vjp` that is `adjoint`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from dsim.gradients.layers.state_map import TWICE, Output, StateMap, Tape, missing
from dsim.gradients.objectives import Run, Variables


def jax_layer(run: Run, variables: Variables, output: Output = "path") -> Callable[[Any], Any]:
    """A function p (k,) -> the states along the path (N+1,ny), or with output="last" (ny,): under grad, jit and vmap.

    run: (system, y0) -> trajectory, as for ReducedObjective.  p is float64 (jax_enable_x64) or float32; dsim computes
    in float64, and states and gradient come back in p's dtype.  The backward is `adjoint`, on the run of the forward
    pass while its memory allows (256 MB for the layer), else on the same run again.  Values inside jit and vmap go
    through `jax.pure_callback`, one run after the other.

    Raises ImportError without JAX; ValueError for p of another shape or dtype, or not finite, and for a second
    derivative; SimulationError, with its status, where a run ends early.  What is raised while compiled code runs,
    JAX wraps in a JaxRuntimeError, whose last line is the message.
    """
    try:
        import jax
    except ImportError as error:
        raise missing("jax_layer", "JAX", "jax") from error

    scene, count = StateMap(run, variables, output), len(variables)
    tape = Tape(scene)
    recorded = _once(lambda p: _on_host(tape.states, scene.shape, p))
    pullback = _once(lambda p, bar: _on_host(tape.pullback, (count,), p, bar))

    @jax.custom_vjp
    def states(p: Any) -> Any:
        return _on_host(lambda p: scene.states(scene.trajectory(p)), scene.shape, p)

    states.defvjp(lambda p: (recorded(p), p), lambda p, bar: (pullback(p, bar),))

    def layer(p: Any) -> Any:
        p = jax.numpy.asarray(p)
        if p.dtype not in (np.float64, np.float32):
            raise ValueError(f"p must be float64 or float32; got {p.dtype}")
        if p.shape != (count,):
            raise ValueError(f"p must have shape ({count},); got {p.shape}; for a batch use jax.vmap")
        return states(p)

    return layer


def _on_host(function: Callable[..., Any], shape: tuple[int, ...], p: Any, *others: Any) -> Any:
    """Called directly where the numbers are there, as a callback where JAX traces."""
    import jax

    def called(*numbers: Any) -> Any:
        return np.asarray(function(*(np.asarray(array, dtype=np.float64) for array in numbers)), dtype=p.dtype)

    if any(isinstance(argument, jax.core.Tracer) for argument in (p, *others)):
        return jax.pure_callback(called, jax.ShapeDtypeStruct(shape, p.dtype), p, *others, vmap_method="sequential")
    return jax.numpy.asarray(called(p, *others))


def _once(function: Callable[..., Any]) -> Any:
    """What runs inside a derivative: asked for its own, it says so."""
    import jax

    def refuse(*_: Any) -> Any:
        raise ValueError(TWICE)

    wrapped = jax.custom_vjp(function)
    wrapped.defvjp(lambda *arguments: (function(*arguments), None), refuse)
    return wrapped
