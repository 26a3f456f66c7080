"""Backward Euler of the benchmark's stiff cloth in JAX: Newton, with conjugate gradients that see products alone.

A step solves  v1 - v0 - h f(q0 + h v1, v1) / m = 0.  Its matrix is never formed: jax.linearize gives the products,
and only the 3 x 3 blocks of its diagonal are written out, to precondition (block Jacobi).  Linear systems are solved
to two digits: more would cost more time than the Newton iterations they save.
An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)


def conjugate_gradients(product, b, precondition, tol):
    """x with product(x) = b, up to a residual of tol |b|."""

    def unfinished(state):
        _, r, _, _, count = state
        return (jnp.vdot(r, r) > tol**2 * jnp.vdot(b, b)) & (count < b.size)

    def improve(state):
        x, r, p, rz, count = state
        Ap = product(p)
        alpha = rz / jnp.vdot(p, Ap)
        x, r = x + alpha * p, r - alpha * Ap
        z = precondition(r)
        rz, before = jnp.vdot(r, z), rz
        return x, r, z + rz / before * p, rz, count + 1

    z = precondition(b)
    return jax.lax.while_loop(unfinished, improve, (jnp.zeros_like(b), b, z, jnp.vdot(b, z), 0))[0]


def make(problem, tol=1e-10, linear_tol=1e-2, blocks=True, max_iterations=50):
    """forward: (stiffness, v0) -> final (q, v).  tol bounds the last correction of v, relative to the largest.

    blocks: precondition with the 3 x 3 blocks of the diagonal, or with the diagonal alone.
    """
    i, j = jnp.asarray(problem["pairs"]).T
    rest, free = jnp.asarray(problem["rest"]), jnp.asarray(problem["free"])[:, None]
    mass, gravity, drag = problem["mass"], jnp.asarray(problem["gravity"]), problem["drag"]
    q0, h, steps = jnp.asarray(problem["q0"]), problem["h"], problem["steps"]

    def force(q, v, stiffness):
        edge = q[j] - q[i]
        length = jnp.sqrt((edge * edge).sum(axis=1))
        pull = (stiffness * (1 - rest / length))[:, None] * edge
        spring = jnp.zeros_like(q).at[i].add(pull).at[j].add(-pull)
        return spring + mass * gravity - drag * v

    def jacobi(q, stiffness):
        edge = q[j] - q[i]
        squared = (edge * edge).sum(axis=1)[:, None, None]
        slack = rest[:, None, None] / jnp.sqrt(squared)
        along = edge[:, :, None] * edge[:, None, :] / squared
        block = stiffness[:, None, None] * ((1 - slack) * jnp.eye(3) + slack * along)
        stiff = jnp.zeros((len(q), 3, 3)).at[i].add(block).at[j].add(block)
        stiff = stiff if blocks else stiff * jnp.eye(3)
        inverse = jnp.linalg.inv((1 + h * drag / mass) * jnp.eye(3) + h**2 / mass * stiff)
        return lambda r: jnp.einsum("nij,nj->ni", inverse, r)

    def step(state, stiffness):
        q, v = state

        def residual(v1):
            return v1 - v - h / mass * free * force(q + h * v1, v1, stiffness)

        def unfinished(state):
            _, size, count = state
            return (size > tol) & (count < max_iterations)

        def improve(state):
            v1, _, count = state
            r, product = jax.linearize(residual, v1)
            dv = conjugate_gradients(product, -r, jacobi(q + h * v1, stiffness), linear_tol)
            size = jnp.abs(dv).max() / jnp.abs(v1 + dv).max()
            return v1 + dv, size, count + 1

        v1, size, _ = jax.lax.while_loop(unfinished, improve, (v, jnp.inf, 0))
        v1 = jnp.where(size <= tol, v1, jnp.nan)  # a failure must not pass for an answer
        return q + h * v1, v1

    def forward(stiffness, v0):
        return jax.lax.scan(lambda state, _: (step(state, stiffness), None), (q0, free * v0), None, length=steps)[0]

    return jax.jit(forward)
