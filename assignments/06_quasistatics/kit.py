"""What is given: small bodies at rest, and objectives.

A body has n coordinates of free points, x (n,), in m, and parameters p (P,).  `force` (n,) in N is the total force;
`dfdx` (n, n) and `dfdp` (n, P) are its derivatives; `dfdx_definite` is another matrix (n, n), -df/dx made positive
semi-definite spring by spring and negated: good to search with, and not the derivative.
An objective has `value`, a number, and its partial derivatives `dOdx` (n,) and `dOdp` (P,), each at (x, p).
"""

import numpy as np


class Springs:
    """Springs between points, some of them pinned; p holds their rest lengths, in m.

    points (N, d), edges (E, 2), pinned: numbers of points.  stiffness k (E,) N/m.  load (n,) N.
    """

    def __init__(self, points, edges, pinned, stiffness, load):
        self.points, self.edges = np.array(points, dtype=float), np.array(edges)
        self.stiffness, self.load = stiffness * np.ones(len(edges)), np.array(load, dtype=float)
        self.free = np.setdiff1d(np.arange(len(points)), pinned)
        self.places = (self.free[:, None] * self.points.shape[1] + np.arange(self.points.shape[1])).ravel()

    def start(self):
        """The free coordinates before anything moves."""
        return self.points[self.free].ravel()

    def _edges(self, x):
        """Length (E,) and direction (E, d) of every spring."""
        points = self.points.copy()
        points[self.free] = x.reshape(len(self.free), -1)
        edge = points[self.edges[:, 1]] - points[self.edges[:, 0]]
        length = np.linalg.norm(edge, axis=1)
        return length, edge / length[:, None]

    def force(self, x, p):
        length, n = self._edges(x)
        pull = (self.stiffness * (length - p))[:, None] * n
        total = np.zeros(self.points.shape)
        np.add.at(total, self.edges[:, 0], pull)
        np.add.at(total, self.edges[:, 1], -pull)
        return total.ravel()[self.places] + self.load

    def dfdx(self, x, p):
        length, n = self._edges(x)
        return self._matrix(n, 1 - p / length)

    def dfdx_definite(self, x, p):
        length, n = self._edges(x)
        return self._matrix(n, np.maximum(1 - p / length, 0))

    def _matrix(self, n, across):
        """Each spring resists with k along itself and with k times `across` sideways."""
        count, d = self.points.shape
        total = np.zeros((count, d, count, d))
        along = n[:, :, None] * n[:, None, :]
        blocks = self.stiffness[:, None, None] * (along + across[:, None, None] * (np.eye(d) - along))
        for (i, j), block in zip(self.edges, blocks, strict=True):
            total[i, :, i] -= block
            total[j, :, j] -= block
            total[i, :, j] += block
            total[j, :, i] += block
        return total.reshape(count * d, count * d)[np.ix_(self.places, self.places)]

    def dfdp(self, x, p):
        _, n = self._edges(x)
        push = self.stiffness[:, None] * n
        total = np.zeros((*self.points.shape, len(self.edges)))
        every = np.arange(len(self.edges))
        total[self.edges[:, 0], :, every] -= push
        total[self.edges[:, 1], :, every] += push
        return total.reshape(-1, len(self.edges))[self.places]


def net(side=3, stiffness=200.0, weight=1.0, spacing=0.5):
    """A square net of side x side points in space, its four corners pinned, a weight (N) at every free point."""
    grid = [(spacing * i, spacing * j, 0.0) for i in range(side) for j in range(side)]
    edges = [(i * side + j, i * side + j + 1) for i in range(side) for j in range(side - 1)]
    edges += [(i * side + j, i * side + j + side) for i in range(side - 1) for j in range(side)]
    corners = [0, side - 1, side * (side - 1), side * side - 1]
    points = np.array(grid)
    inside = np.setdiff1d(np.arange(side * side), corners)
    points[inside, 2] -= 0.4 * spacing
    return Springs(points, edges, corners, stiffness, np.tile([0.0, 0.0, -weight], len(inside)))


def truss(stiffness=1000.0, load=20.0, height=0.6, lean=0.1):
    """Two bars that lean against each other in the plane, loaded at the apex: both are in compression."""
    return Springs([(-1.0, 0.0), (lean, height), (1.0, 0.0)], [(0, 1), (1, 2)], [0, 2], stiffness, [0.0, -load])


class Follower(Springs):
    """A chain that hangs from a pin; a jet at its end blows at a right angle to the last link, wherever that points.

    p = (rest lengths of the links in m, the push of the jet in N).  Such a force has no energy: df/dx is not symmetric.
    """

    def __init__(self, links, stiffness, weight, length):
        hung = length + weight * np.arange(links, 0, -1) / stiffness  # without the jet
        points = [(0.0, -down) for down in (0.0, *np.cumsum(hung))]
        edges = [(i, i + 1) for i in range(links)]
        super().__init__(points, edges, [0], stiffness, np.tile([0.0, -weight], links))
        self.links = links

    def force(self, x, p):
        total = super().force(x, p[:-1])
        _, n = self._edges(x)
        total[-2:] += p[-1] * np.array([-n[-1, 1], n[-1, 0]])
        return total

    def dfdx(self, x, p):
        total = super().dfdx(x, p[:-1])
        length, n = self._edges(x)
        turned = np.array([-n[-1, 1], n[-1, 0]])
        turning = -p[-1] / length[-1] * np.outer(n[-1], turned)
        total[-2:, -2:] += turning
        if self.links > 1:
            total[-2:, -4:-2] -= turning
        return total

    def dfdx_definite(self, x, p):
        return super().dfdx_definite(x, p[:-1])

    def dfdp(self, x, p):
        _, n = self._edges(x)
        jet = np.zeros((len(x), 1))
        jet[-2:, 0] = -n[-1, 1], n[-1, 0]
        return np.hstack([super().dfdp(x, p[:-1]), jet])


def follower(links=3, stiffness=40.0, weight=2.0, length=0.4):
    """A hanging chain with a jet at its end."""
    return Follower(links, stiffness, weight, length)


class Bond:
    """Point 1 hangs at a spring, point 2 is glued to it; somebody pulls at point 2.  x = (x1, x2), p = (pull, k).

    The glue holds with 2 D a (e^(-a s) - e^(-2 a s)), s = x2 - x1: at most D a / 2, at s = ln(2) / a.  Beyond it
    there is no equilibrium.  k in N/m, the pull in N, D in J, a in 1/m.
    """

    def __init__(self, depth, width):
        self.depth, self.width = depth, width

    def start(self):
        return np.zeros(2)

    def _glue(self, x):
        """Its force, and the derivative of that by s."""
        once = np.exp(np.minimum(-self.width * (x[1] - x[0]), 300.0))
        scale = 2 * self.depth * self.width
        return scale * (once - once**2), scale * self.width * (2 * once**2 - once)

    def force(self, x, p):
        glue, _ = self._glue(x)
        return np.array([glue - p[1] * x[0], p[0] - glue])

    def dfdx(self, x, p):
        return self._matrix(self._glue(x)[1], p)

    def dfdx_definite(self, x, p):
        return self._matrix(max(self._glue(x)[1], 0.0), p)

    def _matrix(self, slope, p):
        return np.array([[-slope - p[1], slope], [slope, -slope]])

    def dfdp(self, x, p):
        return np.array([[0.0, -x[0]], [1.0, 0.0]])


def bond(depth=1.0, width=2.0):
    """Two points that are glued together, one held by a spring, the other pulled."""
    return Bond(depth, width)


class Target:
    """O = |x - target|^2 / 2 + (price / 2) |p - usual|^2: come close to a shape, at a price on p."""

    def __init__(self, target, price, usual):
        self.target, self.price, self.usual = target, price, usual

    def value(self, x, p):
        return 0.5 * np.sum((x - self.target) ** 2) + 0.5 * self.price * np.sum((p - self.usual) ** 2)

    def dOdx(self, x, p):
        return x - self.target

    def dOdp(self, x, p):
        return self.price * (p - self.usual)


def target(target, price=0.0, usual=0.0):
    """Come close to the coordinates `target` (n,); a price of 0 lets the parameters be anything."""
    return Target(target, price, usual)
