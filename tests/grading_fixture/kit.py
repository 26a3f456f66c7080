"""What is given: forces."""


def spring(stiffness):
    """f(x) = -k x."""
    return lambda x: -stiffness * x
