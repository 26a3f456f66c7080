"""Element mathematics: energies of E elements at once, with exact derivatives.  No loop, no assembly."""

from dsim.kernels.kernel import Kernel
from dsim.kernels.spring import SPRING

__all__ = ["SPRING", "Kernel"]
