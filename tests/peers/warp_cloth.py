"""The benchmark's cloth in NVIDIA Warp: two kernels a step, a tape for the gradient, both captured as graphs.

A graph replays the recorded launches without Python between them, as one does for many small kernels.
An independent program: it shares no code with dsim, only the arrays of the problem.
"""

import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.set_device("cpu")
Numbers, Vectors = wp.array(dtype=wp.float64), wp.array(dtype=wp.vec3d)


@wp.struct
class Cloth:
    pairs: wp.array(dtype=wp.vec2i)
    rest: Numbers
    free: Numbers
    gravity: wp.vec3d
    mass: wp.float64
    drag: wp.float64
    h: wp.float64


@wp.kernel
def pull(cloth: Cloth, q: Vectors, stiffness: Numbers, force: Vectors):
    s = wp.tid()
    i = cloth.pairs[s][0]
    j = cloth.pairs[s][1]
    edge = q[j] - q[i]
    f = stiffness[s] * (wp.float64(1.0) - cloth.rest[s] / wp.length(edge)) * edge
    wp.atomic_add(force, i, f)
    wp.atomic_sub(force, j, f)


@wp.kernel
def move(cloth: Cloth, force: Vectors, q: Vectors, v: Vectors, q1: Vectors, v1: Vectors):
    p = wp.tid()
    f = force[p] + cloth.mass * cloth.gravity - cloth.drag * v[p]
    new = v[p] + cloth.free[p] * cloth.h / cloth.mass * f
    v1[p] = new
    q1[p] = q[p] + cloth.h * new


def cloth_of(problem):
    cloth = Cloth()
    cloth.pairs = wp.array(problem["pairs"], dtype=wp.vec2i)
    cloth.rest = wp.array(problem["rest"], dtype=wp.float64)
    cloth.free = wp.array(problem["free"], dtype=wp.float64)
    cloth.gravity = wp.vec3d(*problem["gravity"])
    cloth.mass, cloth.drag, cloth.h = problem["mass"], problem["drag"], problem["h"]
    return cloth


def make(problem):
    """(forward, gradient): (stiffness, v0) -> final (q, v); and d(loss)/d(stiffness, v0), loss = sum of w . (q, v)."""
    steps, points, springs = problem["steps"], len(problem["q0"]), len(problem["rest"])
    cloth = cloth_of(problem)
    q, v, force = (wp.zeros((steps + 1, points), dtype=wp.vec3d, requires_grad=True) for _ in range(3))
    stiffness = wp.zeros(springs, dtype=wp.float64, requires_grad=True)
    weights = wp.array(problem["weights"], dtype=wp.vec3d)
    q[0].assign(problem["q0"])
    wp.load_module(device="cpu")

    def run():
        force.zero_()
        for t in range(steps):
            wp.launch(pull, springs, [cloth, q[t], stiffness], [force[t]])
            wp.launch(move, points, [cloth, force[t], q[t], v[t]], [q[t + 1], v[t + 1]])

    with wp.ScopedCapture() as only_forward:
        run()
    with wp.ScopedCapture() as both_ways:
        with wp.Tape() as tape:
            run()
        for array in (q, v, force, stiffness):
            array.grad.zero_()
        wp.copy(q.grad[steps], weights[0])
        wp.copy(v.grad[steps], weights[1])
        tape.backward()

    def launch(recorded, k, v0):
        stiffness.assign(k)
        v[0].assign(problem["free"][:, None] * v0)
        wp.capture_launch(recorded.graph)

    def forward(k, v0):
        launch(only_forward, k, v0)
        return q[steps].numpy().copy(), v[steps].numpy().copy()

    def gradient(k, v0):
        launch(both_ways, k, v0)
        return stiffness.grad.numpy().copy(), problem["free"][:, None] * v.grad[0].numpy()

    return forward, gradient
