"""The lecture's "force objects".  A description; `System` binds it once to points, `RigidBodies` to bodies."""

from dsim.effects.actuation import Actuation
from dsim.effects.at_points import Attached
from dsim.effects.body_torques import AngularDrag, TorqueActuation
from dsim.effects.drag import Drag
from dsim.effects.effect import Effect
from dsim.effects.field import Field
from dsim.effects.gravity import Gravity
from dsim.effects.spring_damping import SpringDamping
from dsim.effects.springs import Springs

__all__ = ["Actuation", "AngularDrag", "Attached", "Drag", "Effect", "Field", "Gravity", "SpringDamping", "Springs",
           "TorqueActuation"]  # fmt: skip
