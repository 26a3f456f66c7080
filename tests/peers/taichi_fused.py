"""The benchmark's cloth in Taichi: fields over all steps, one serial kernel for the run, and that kernel's gradient.

All steps lie in one kernel, as two hundred launches would cost more than the work.  There is no loss to evaluate:
its weights are put where the gradient of the last state starts.
It is no idiom - kernels are meant to be launched - but the quickest we found on one core.
"""

import numpy as np
import taichi as ti
from taichi_cloth import vectors  # which starts Taichi, once


@ti.data_oriented
class Cloth:
    def __init__(self, problem):
        self.steps, self.points, self.springs = problem["steps"], len(problem["q0"]), len(problem["rest"])
        self.mass, self.drag, self.h = problem["mass"], problem["drag"], problem["h"]
        self.gravity = ti.Vector(problem["gravity"].tolist())
        states = (self.steps + 1, self.points)
        self.q, self.v = (ti.Vector.field(3, ti.f64, shape=states, needs_grad=True) for _ in "qv")
        self.start = ti.Vector.field(3, ti.f64, shape=self.points, needs_grad=True)
        self.stiffness = ti.field(ti.f64, shape=self.springs, needs_grad=True)
        self.pairs = ti.Vector.field(2, ti.i32, shape=self.springs)
        self.rest = ti.field(ti.f64, shape=self.springs)
        self.free = ti.field(ti.f64, shape=self.points)
        self.pairs.from_numpy(problem["pairs"].astype(np.int32))
        self.rest.from_numpy(problem["rest"])
        self.free.from_numpy(problem["free"])

    @ti.kernel
    def begin(self, q0: vectors):
        for p in range(self.points):
            self.q[0, p] = q0[p]
            self.v[0, p] = self.free[p] * self.start[p]

    @ti.kernel
    def run(self):
        q, v, h, mass = ti.static(self.q, self.v, self.h, self.mass)
        ti.loop_config(serialize=True)  # no atomic additions then
        for _ in range(1):  # the outermost loop is not reversed, those inside are
            for t in range(self.steps):
                for n in range(self.springs + self.points):  # springs first; with two loops the gradient is wrong
                    if n < self.springs:
                        i, j = self.pairs[n][0], self.pairs[n][1]
                        edge = q[t, j] - q[t, i]
                        push = h / mass * self.stiffness[n] * (1 - self.rest[n] / edge.norm()) * edge
                        v[t + 1, i] += self.free[i] * push
                        v[t + 1, j] -= self.free[j] * push
                    else:
                        p = n - self.springs
                        v[t + 1, p] += v[t, p] + self.free[p] * h * (self.gravity - self.drag / mass * v[t, p])
                        q[t + 1, p] = q[t, p] + h * v[t + 1, p]

    @ti.kernel
    def last(self, q: vectors, v: vectors):
        for p in range(self.points):
            q[p], v[p] = self.q[self.steps, p], self.v[self.steps, p]

    @ti.kernel
    def seed(self, q: vectors, v: vectors):
        for p in range(self.points):
            self.q.grad[self.steps, p], self.v.grad[self.steps, p] = q[p], v[p]


def make(problem):
    """(forward, gradient): (stiffness, v0) -> final (q, v); and d(loss)/d(stiffness, v0), loss = sum of w . (q, v)."""
    cloth = Cloth(problem)

    def forward(stiffness, v0):
        cloth.stiffness.from_numpy(stiffness)
        cloth.start.from_numpy(v0)
        cloth.v.fill(0)
        cloth.begin(problem["q0"])
        cloth.run()
        q, v = np.empty_like(problem["weights"])
        cloth.last(q, v)
        return q, v

    def gradient(stiffness, v0):
        forward(stiffness, v0)
        for field in (cloth.q, cloth.v, cloth.start, cloth.stiffness):
            field.grad.fill(0)
        cloth.seed(*problem["weights"])
        cloth.run.grad()
        cloth.begin.grad(problem["q0"])
        return cloth.stiffness.grad.to_numpy(), cloth.start.grad.to_numpy()

    return forward, gradient
