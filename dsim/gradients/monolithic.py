"""The whole trajectory as one equation  G(x(p), p) = 0,  x = (x_1, ..., x_N), and its derivative in one solve.

Lecture: "What about dynamics?":  dx/dp = -(dG/dx)^-1 dG/dp,  dG/dx block lower triangular, a block row a step.
For understanding and for checks: it stores every block, and nothing is eliminated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from dsim.arrays.checks import Array, as_array
from dsim.simulation import Trajectory
from dsim.solve.linear import Factor, factorize

if TYPE_CHECKING:
    from scipy.sparse import csr_array


@dataclass(frozen=True, eq=False)
class BlockSystem:
    """dG/dx (N m, N m) and dG/dp (N m, ny + P), p = (y0, theta).

    m is the size of a step's state: ny, or 2 ny for two-step methods, whose first block row is the step that makes
    the past; `reduced` has ny for them too.  `ticks` (N+1,) are the first rows of the blocks.
    """

    trajectory: Trajectory
    dGdx: csr_array
    dGdp: csr_array
    ticks: Array

    def derivative(self, dp: Any = None) -> Array:
        """dx/dp dp = -(dG/dx)^-1 dG/dp dp for dp (ny+P,) or (ny+P,k), by default all columns: (N+1, ny[, k])."""
        size = self.dGdp.shape[1]
        dp = np.eye(size) if dp is None else as_array("dp", dp)
        if dp.shape[:1] != (size,):
            raise ValueError(f"dp must have {size} rows, ny + P; got shape {dp.shape}")
        ny, first = self._sizes
        dx = -self._factor().solve(self.dGdp @ dp)
        states = dx.reshape(len(self.ticks) - 1, -1, *dp.shape[1:])[first:, :ny]
        return np.concatenate([dp[None, :ny], states])

    def gradient(self, dJdy: Array) -> Array:
        """dJ/dp (ny+P,) = dJ/dy_0 - dG/dp^T (dG/dx)^-T dJ/dx from dJdy (N+1,ny): one solve with the transpose."""
        ny, first = self._sizes
        steps = len(self.trajectory.t) - 1
        dJdy = as_array("dJdy", dJdy, (steps + 1, ny))
        loads = np.zeros((len(self.ticks) - 1, self.dGdx.shape[0] // (len(self.ticks) - 1)))
        loads[first:, :ny] = dJdy[1:]
        gradient: Array = -(self.dGdp.T @ self._factor().solve_transposed(loads.ravel()))
        gradient[:ny] += dJdy[0]
        return gradient

    def reduced(self) -> BlockSystem:
        """Without the copies of x_n that a two-step method carries along: block rows of size ny, as the lecture draws
        them, G_n(x_n, x_{n-1}, x_{n-2}, p), and before them one for the past that the method makes up."""
        from scipy.sparse import csc_array, csr_array
        from scipy.sparse.linalg import splu

        ny, first = self._sizes
        if not first:
            return self
        halves = np.arange(self.dGdx.shape[0]).reshape(len(self.ticks) - 1, 2, ny)
        kept = np.concatenate([halves[:1, 1], halves[1:, 0]]).ravel()  # the past, then x_1, ..., x_N
        copies = np.concatenate([halves[:1, 0], halves[1:, 1]]).ravel()
        above, below = self.dGdx[kept], self.dGdx[copies]
        inverse = splu(csc_array(below[:, copies]))
        through = csr_array(above[:, copies])
        dGdx, dGdp = (
            csr_array(direct - through @ inverse.solve(copied.toarray()))
            for direct, copied in ((above[:, kept], below[:, kept]), (self.dGdp[kept], self.dGdp[copies]))
        )
        return BlockSystem(self.trajectory, dGdx, dGdp, self.ticks // 2)

    @property
    def _sizes(self) -> tuple[int, int]:
        """ny, and how many block rows come before the first step."""
        return self.trajectory.y.shape[1], len(self.ticks) - len(self.trajectory.t)

    def _factor(self) -> Factor:
        return factorize(self.dGdx)


def block_system(trajectory: Trajectory) -> BlockSystem:
    """Assemble dG/dx and dG/dp of a trajectory from A, B and C of its steps.  Lecture: the two matrices drawn there.

    Raises ValueError for a trajectory without steps, without its system, or one that failed.
    """
    from scipy.sparse import block_array, csr_array

    stepper, system = trajectory.differentiable()
    steps = [trajectory.step(n) for n in range(len(trajectory.t) - 1)]
    if not steps:
        raise ValueError("trajectory must have at least one step; got 0")
    starts = [trajectory.start()] if stepper.history > 1 else []
    blocks = [stepper.linearize(system, step) for step in (*starts, *steps)]
    grid: list[list[Any]] = [[None] * len(blocks) for _ in blocks]
    for i, block in enumerate(blocks):
        grid[i][i] = block.A
        if i:
            grid[i][i - 1] = block.B
    size = blocks[0].A.shape[0]
    empty = csr_array((size * (len(blocks) - 1), system.size))
    by_start = [blocks[0].B, empty] if len(blocks) > 1 else [blocks[0].B]
    dGdp = block_array([[_stacked(by_start), _stacked([block.C for block in blocks])]])
    return BlockSystem(trajectory, csr_array(block_array(grid)), csr_array(dGdp), size * np.arange(len(blocks) + 1))


def _stacked(rows: list[Any]) -> Any:
    from scipy.sparse import vstack

    return vstack(rows, format="csr")
