"""A simulation as a layer of a network: p -> states, differentiable by PyTorch and by JAX.

    y(p) = the states of run(*variables.place(p)),      p_bar = (dy/dp)^T y_bar by `adjoint`.

Neither library is imported before its layer is made.
"""

from dsim.gradients.layers.jax import jax_layer
from dsim.gradients.layers.torch import torch_layer

__all__ = ["jax_layer", "torch_layer"]
