"""dsim: differentiable simulation you can read, teach from and check your own code against."""
