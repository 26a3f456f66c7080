import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dsim.grading import compare
from dsim.grading.student import ItemLost, kit_function


@given(seed=st.integers(0, 2**32 - 1))
def test_solve(student, seed):
    rng = np.random.default_rng(seed)
    A, b = rng.normal(size=(4, 4)) + 4 * np.eye(4), rng.normal(size=4)
    x = compare.array("solve(A, b)", student.call("solve", A, b), (4,))
    student.award(1 / 3)  # a vector of the right shape
    compare.at_most("the residual |A x - b|", float(np.abs(A @ x - b).max()), 1e-10)


def test_integrate(student):
    found = student.call("step", kit_function("spring", stiffness=4.0), np.array([1.0]), np.array([0.5]), 0.1)
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise ItemLost("step must return (x, v)")
    compare.close("v", found[1], [0.1], 1e-12)
    student.award(0.5)
    compare.close("x", found[0], [1.01], 1e-12)
