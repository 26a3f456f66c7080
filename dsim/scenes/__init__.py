"""Ready-made scenes.  Every builder takes keyword parameters with sensible defaults and returns a `Scene`."""

from dsim.scenes.bodies import robot, soft_body
from dsim.scenes.nets import chain, cloth
from dsim.scenes.particles import kepler, projectile, river
from dsim.scenes.pendulum import pendulum_spring, pendulum_stiff, rigid_pendulum_angle
from dsim.scenes.rigid import racket, sign
from dsim.scenes.scene import Scene

__all__ = [
    "Scene",
    "chain",
    "cloth",
    "kepler",
    "pendulum_spring",
    "pendulum_stiff",
    "projectile",
    "racket",
    "rigid_pendulum_angle",
    "river",
    "robot",
    "sign",
    "soft_body",
]
