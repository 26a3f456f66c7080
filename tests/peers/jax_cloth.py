"""The benchmark's cloth in JAX, as one would write it: jit + scan, forces by scatter-add over an edge list.

An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import jax
import jax.numpy as jnp

jax.config.update("jax_enable_x64", True)


def make(problem):
    """(forward, gradient): (stiffness, v0) -> final (q, v); and d(loss)/d(stiffness, v0), loss = sum of w . (q, v)."""
    i, j = jnp.asarray(problem["pairs"]).T
    rest, free = jnp.asarray(problem["rest"]), jnp.asarray(problem["free"])[:, None]
    mass, gravity, drag = problem["mass"], jnp.asarray(problem["gravity"]), problem["drag"]
    q0, h, steps = jnp.asarray(problem["q0"]), problem["h"], problem["steps"]
    weight_q, weight_v = jnp.asarray(problem["weights"])

    def force(q, v, stiffness):
        edge = q[j] - q[i]
        length = jnp.sqrt((edge * edge).sum(axis=1))
        pull = (stiffness * (1 - rest / length))[:, None] * edge
        spring = jnp.zeros_like(q).at[i].add(pull).at[j].add(-pull)
        return spring + mass * gravity - drag * v

    def forward(stiffness, v0):
        def step(state, _):
            q, v = state
            v = v + h * free * force(q, v, stiffness) / mass
            return (q + h * v, v), None

        return jax.lax.scan(step, (q0, free * v0), None, length=steps)[0]

    def loss(stiffness, v0):
        q, v = forward(stiffness, v0)
        return (weight_q * q).sum() + (weight_v * v).sum()

    return jax.jit(forward), jax.jit(jax.grad(loss, argnums=(0, 1)))
