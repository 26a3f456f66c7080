"""The benchmark's cloth in Taichi, as its documentation writes differentiable simulation: fields over all steps, a
kernel a substep, the kernels' gradients in reverse.  `taichi_fused` is the same in one kernel.

An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import numpy as np
import taichi as ti

ti.init(ti.cpu, default_fp=ti.f64, cpu_max_num_threads=1, fast_math=False, log_level=ti.WARN)
vectors = ti.types.ndarray(dtype=ti.math.vec3)  # rows of a NumPy array


@ti.data_oriented
class Cloth:
    def __init__(self, problem):
        self.steps, self.points, self.springs = problem["steps"], len(problem["q0"]), len(problem["rest"])
        self.mass, self.drag, self.h = problem["mass"], problem["drag"], problem["h"]
        self.gravity = ti.Vector(problem["gravity"].tolist())
        states = (self.steps + 1, self.points)
        self.q, self.v, self.f = (ti.Vector.field(3, ti.f64, shape=states, needs_grad=True) for _ in "qvf")
        self.stiffness = ti.field(ti.f64, shape=self.springs, needs_grad=True)
        self.pairs = ti.Vector.field(2, ti.i32, shape=self.springs)
        self.rest, self.free = ti.field(ti.f64, shape=self.springs), ti.field(ti.f64, shape=self.points)
        self.pairs.from_numpy(problem["pairs"].astype(np.int32))
        self.rest.from_numpy(problem["rest"])
        self.free.from_numpy(problem["free"])

    @ti.kernel
    def force(self, t: ti.i32):
        for s in range(self.springs):
            i, j = self.pairs[s][0], self.pairs[s][1]
            edge = self.q[t, j] - self.q[t, i]
            pull = self.stiffness[s] * (1 - self.rest[s] / edge.norm()) * edge
            self.f[t, i] += pull
            self.f[t, j] += -pull

    @ti.kernel
    def advance(self, t: ti.i32):
        for p in range(self.points):
            total = self.f[t, p] + self.mass * self.gravity - self.drag * self.v[t, p]
            self.v[t + 1, p] = self.v[t, p] + self.h * self.free[p] * total / self.mass
            self.q[t + 1, p] = self.q[t, p] + self.h * self.v[t + 1, p]

    @ti.kernel
    def put(self, t: ti.i32, q: vectors, v: vectors):
        for p in range(self.points):
            self.q[t, p], self.v[t, p] = q[p], self.free[p] * v[p]

    @ti.kernel
    def take(self, t: ti.i32, q: vectors, v: vectors):
        for p in range(self.points):
            q[p], v[p] = self.q[t, p], self.v[t, p]

    @ti.kernel
    def seed(self, t: ti.i32, q: vectors, v: vectors):
        for p in range(self.points):
            self.q.grad[t, p], self.v.grad[t, p] = q[p], v[p]

    @ti.kernel
    def take_gradient(self, v: vectors):
        for p in range(self.points):
            v[p] = self.free[p] * self.v.grad[0, p]


def make(problem):
    """(forward, gradient): (stiffness, v0) -> final (q, v); and d(loss)/d(stiffness, v0), loss = sum of w . (q, v)."""
    cloth = Cloth(problem)

    def forward(stiffness, v0):
        cloth.stiffness.from_numpy(stiffness)
        cloth.f.fill(0)
        cloth.put(0, problem["q0"], v0)
        for t in range(cloth.steps):
            cloth.force(t)
            cloth.advance(t)
        q, v = np.empty_like(problem["weights"])
        cloth.take(cloth.steps, q, v)
        return q, v

    def gradient(stiffness, v0):
        forward(stiffness, v0)
        for field in (cloth.q, cloth.v, cloth.f, cloth.stiffness):
            field.grad.fill(0)
        cloth.seed(cloth.steps, *problem["weights"])
        for t in reversed(range(cloth.steps)):
            cloth.advance.grad(t)
            cloth.force.grad(t)
        v_bar = np.empty_like(v0)
        cloth.take_gradient(v_bar)
        return cloth.stiffness.grad.to_numpy(), v_bar

    return forward, gradient
