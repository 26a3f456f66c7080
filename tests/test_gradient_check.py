"""check_gradient and its kin: right gradients are smooth, wrong ones are caught, rough functions are named."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from dsim.studies import check_adjoint, check_gradient, check_jacobian, taylor_test
from dsim.studies.gradient_check import ADVICE

X = np.random.default_rng(0).normal(size=12)


def sines(x):
    return np.sin(x).sum()


def bent(gradient, entry, by=1e-5):
    gradient = gradient.copy()
    gradient[entry] *= 1 + by
    return gradient


SMOOTH = {
    "quadratic": (lambda x: x @ x, X, 2 * X),
    "linear": (lambda x: 3 * x.sum(), X, 0 * X + 3),
    "constant": (lambda x: 5.0, X, 0 * X),
    "optimum": (lambda x: x @ x, 0 * X, 0 * X),
    "steep": (lambda x: np.exp(50 * x).sum(), X[:2] / 2, 50 * np.exp(25 * X[:2])),
    "fast": (lambda x: np.sin(1e3 * x).sum(), X, 1e3 * np.cos(1e3 * X)),
    "tiny x": (lambda x: np.sin(x / 1e-9).sum(), X * 1e-9, np.cos(X) / 1e-9),
    "huge x": (lambda x: np.sin(x / 1e6).sum(), X * 1e6, np.cos(X) / 1e6),
    "tiny f": (lambda x: 1e-9 * sines(x), X, 1e-9 * np.cos(X)),
    "huge f": (lambda x: 1e6 * sines(x), X, 1e6 * np.cos(X)),
    "offset": (lambda x: 1e8 + sines(x), X, np.cos(X)),
    "kink nearby": (lambda x: np.abs(x).sum(), np.array([1e-6, 1.0]), np.array([1.0, 1.0])),
    "jump nearby": (lambda x: np.floor(x).sum() + x.sum(), np.array([2.00001, 0.5]), np.ones(2)),
    "scalar x": (lambda x: x**3, np.array(2.0), np.array(12.0)),
    "matrix x": (lambda x: (x**3).sum(), X.reshape(3, 4), 3 * X.reshape(3, 4) ** 2),
    "unequal": (lambda x: 1e6 * x[0] + 1e-6 * np.sin(x[1]), np.array([1.0, 2]), np.array([1e6, 1e-6 * np.cos(2)])),
}


@pytest.mark.parametrize("name", SMOOTH)
def test_a_right_gradient_is_smooth(name):
    f, x, gradient = SMOOTH[name]
    report = check_gradient(f, x, gradient)
    assert report.verdict == "smooth" and report.ok and not report.evaluations > 40 * (x.size + 1) * 2
    assert report.digits > (2.5 if name == "offset" else 6 if name != "steep" else 3.5)


@pytest.mark.parametrize("name", [n for n in SMOOTH if n not in ("constant", "optimum", "offset", "steep", "unequal")])
def test_an_error_of_1e_5_in_one_entry_is_wrong(name):
    f, x, gradient = SMOOTH[name]
    flat = bent(gradient.ravel(), gradient.size - 1).reshape(gradient.shape)
    report = check_gradient(f, x, flat)
    assert report.verdict == "wrong" and report.worst == f"entry {gradient.size - 1}"


def test_what_is_known_badly_is_not_called_wrong_but_its_digits_say_so():
    f, x, gradient = SMOOTH["offset"]
    assert check_gradient(f, x, bent(gradient, 3)).digits < 5
    assert check_gradient(f, x, bent(gradient, 3, 0.01)).verdict == "wrong"


@pytest.mark.parametrize("n", [100, 1000])
def test_one_wrong_entry_among_many(n):
    x = np.random.default_rng(1).normal(size=n) * 10.0 ** np.linspace(-3, 3, n)
    assert check_gradient(sines, x, np.cos(x)).ok
    assert check_gradient(sines, x, bent(np.cos(x), n // 3)).worst == f"entry {n // 3}"


def test_a_wrong_entry_whose_true_value_is_zero():
    gradient = np.append(2 * X[:-1], 1e-5)
    assert check_gradient(lambda x: x[:-1] @ x[:-1], X, gradient).worst == f"entry {X.size - 1}"


def test_beyond_the_budget_the_rest_is_seen_through_sign_vectors():
    x = np.random.default_rng(2).normal(size=600)
    report = check_gradient(sines, x, np.cos(x), entries=64)
    assert report.ok and report.coverage == "64 of 600 entries and 8 sign vectors"
    looked_at = {label for label in report.labels}
    unseen = next(i for i in range(600) if f"entry {i}" not in looked_at)
    wrong = check_gradient(sines, x, bent(np.cos(x), unseen, 0.01), entries=64)
    assert wrong.verdict == "wrong" and wrong.worst.startswith("sign vector")


MIXED = {  # an entry of this size beside 1, on which f depends by that scale
    "sine": (lambda x, size: np.sin(x[0] / size) + np.sin(x[1]), lambda size: np.cos(1) / size, np.cos(1)),
    "logarithm": (lambda x, size: np.log(x[0]) + x[1], lambda size: 1 / size, 1.0),
    "bump": (lambda x, size: np.exp(-((x[0] / size) ** 2)) + x[1], lambda size: -2 / size / np.e, 1.0),
}


@pytest.mark.parametrize("size", [1e-4, 1e-8, 1e-12])
@pytest.mark.parametrize("name", MIXED)
def test_an_entry_is_judged_by_its_own_scale(name, size):
    f, slope, other = MIXED[name]
    x = np.array([size, 1.0])
    right, wrong = np.array([slope(size), other]), np.array([slope(size) * (1 + 1e-5), other])
    assert check_gradient(lambda z: f(z, size), x, right).digits > 6
    report = check_gradient(lambda z: f(z, size), x, wrong)
    assert report.verdict == "wrong" and report.worst == "entry 0" and report.window[1] < size


@pytest.mark.parametrize("size", [1e-9, 1e-17, 1e-315])
def test_a_tiny_entry_that_f_knows_as_zero_is_judged_by_larger_steps(size):
    """Steps of 1e-10 of 1e-17 change nothing in 1e3 (x + 1): they must not be taken for a staircase."""
    x = np.array([size, 1.0])
    assert check_gradient(lambda z: 1e3 * (z[0] + 1) + z[1], x, [1e3, 1.0]).ok
    assert check_gradient(lambda z: 1e3 * (z[0] + 1) + z[1], x, [1.001e3, 1.0]).verdict == "wrong"
    assert check_gradient(lambda z: abs(z[0] + 1e-16) + z[1] - 1e-16, x, [1.0, 1.0]).verdict in ("kink", "smooth")


def test_a_second_sweep_is_for_tiny_entries_that_do_not_settle():
    x = np.array([1e-8, 1.0])
    once = check_gradient(np.sum, x, np.ones(2)).evaluations
    assert check_gradient(lambda z: z[1], x, np.array([0.0, 1.0])).evaluations == once
    assert check_gradient(lambda z: np.log(z[0]) + z[1], x, np.array([1e8, 1.0])).evaluations == 1.5 * (once - 1) + 1


@pytest.mark.parametrize("jump, slope", [(1e-4, 1e6), (1e-6, 1e3), (1e-6, 1.0), (1e-8, 1.0), (1e-10, 1.0)])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_weak_jump_is_seen_beside_a_steep_slope(jump, slope, side):
    def f(x):
        return slope * np.sin(x[0]) + jump * (side * (x[0] - 0.5) > 0)

    gradient = np.array([slope * np.cos(0.5)])
    assert check_gradient(f, np.array([0.5]), gradient).verdict == "jump"
    assert check_gradient(lambda x: slope * np.sin(x[0]), np.array([0.5]), gradient).ok


def test_noise_is_not_taken_for_a_jump():
    """These draws agree on four steps of one entry by chance: a gap at h = 0 that four steps show is no jump yet."""
    x = np.ones(60)
    for seed in (3, 16, 54):
        rng = np.random.default_rng(seed)
        assert "jump" not in check_gradient(lambda z, rng=rng: z.sum() + 1e-6 * rng.normal(), x, x).verdicts


@pytest.mark.parametrize("change", [3e-6, 1e-5, 1e-4, 1e-3])
def test_a_one_sided_derivative_at_a_weak_kink_is_no_wrong_one(change):
    def f(x):
        return x[0] + change * max(x[0], 0.0)

    verdicts = [check_gradient(f, np.zeros(1), np.array([1 + part * change])).verdict for part in (-1, 0, 1, 2)]
    assert verdicts == ["wrong", "kink", "kink", "wrong"]


@pytest.mark.parametrize("offset, error", [(0.0, 4e-6), (1e4, 4e-6), (1e7, 1e-3), (1e7, 1e-2)])
def test_a_wrong_gradient_of_a_smooth_function_is_not_excused_as_a_kink(offset, error):
    """One-sided differences are known worse than central ones: what lies between them need not be a kink."""
    x, curve = np.array([0.3]), 5.0
    right = curve * np.cos(curve * x)
    assert check_gradient(lambda z: offset + np.sin(curve * z[0]), x, right).ok
    assert check_gradient(lambda z: offset + np.sin(curve * z[0]), x, right * (1 + error)).verdict == "wrong"


@pytest.mark.parametrize("gradient", [0.0, -0.0, None])
def test_digits_are_sensible_where_the_derivative_vanishes(gradient):
    report = check_gradient(lambda x: x[0] * abs(x[0]), np.zeros(1), None if gradient is None else np.array([gradient]))
    assert report.ok and report.digits > 6 and "-0" not in str(report).replace("e-0", "")


def test_no_digits_are_never_minus_zero():
    report = check_gradient(sines, X, -np.cos(X))
    assert report.verdict == "wrong" and np.copysign(1.0, report.digits) == 1.0
    assert "-0.0" not in json.dumps(report.to_dict())


ROUGH = {
    "abs": ("kink", lambda x: np.abs(x).sum(), np.array([0.0, 1.0]), np.array([0.0, 1.0])),
    "relu": ("kink", lambda x: np.maximum(x, 0).sum(), np.array([0.0, 1.0]), np.array([1.0, 1.0])),
    "vertical tangent": ("kink", lambda x: np.sqrt(np.abs(x)).sum(), np.array([0.0, 0.25]), np.array([0.0, 1.0])),
    "floor": ("jump", lambda x: np.floor(x).sum(), np.array([2.0, 0.5]), np.zeros(2)),
    "one side undefined": ("jump", lambda x: np.sqrt(x - 1).sum(), np.array([1.0, 2.0]), np.array([0.0, 0.5])),
    "single precision": ("noise", lambda x: float(np.sin(x.astype("f4")).sum()), X[:3], np.cos(X[:3])),
}


@pytest.mark.parametrize("name", ROUGH)
def test_rough_functions_are_named(name):
    verdict, f, x, gradient = ROUGH[name]
    report = check_gradient(f, x, gradient)
    assert report.verdict == verdict and not report.ok and verdict in str(report)


@pytest.mark.parametrize("size", [1e-6, 1e-2])
def test_noise_is_named(size):
    rng = np.random.default_rng(3)
    assert check_gradient(lambda x: x.sum() + size * rng.normal(), X[:3], np.ones(3)).verdict == "noise"


def test_a_gradient_outside_the_subdifferential_of_a_kink_is_wrong():
    assert check_gradient(lambda x: np.abs(x).sum(), np.zeros(1), np.array([1.5])).verdict == "wrong"


def test_a_branch_that_flips_in_between_is_seen_below_it():
    """A contact that switches 3e-5 away: central differences at 1e-4 and 1e-5 are off, the analytic slope is right."""

    def f(x):
        return float(-0.5183 * x[0] + (0.02 if x[0] > 3e-5 else 0.0))

    report = check_gradient(f, np.zeros(1), np.array([-0.5183]))
    assert report.ok and "is that near" in report.note and report.window[1] < 3e-5


def test_the_gradient_may_come_from_f_or_be_left_out():
    assert check_gradient(lambda x: (x @ x, 2 * x), X).ok
    assert check_gradient(lambda x: (x @ x, 2.001 * x), X).verdict == "wrong"
    alone = check_gradient(lambda x: x @ x, X)
    assert alone.ok and alone.given is None and np.allclose(alone.numerical, 2 * X) and "none was judged" in str(alone)


def test_single_precision_has_looser_windows():
    x = X.astype(np.float32)
    assert check_gradient(lambda z: np.sin(z).sum(), x, np.cos(x)).ok
    assert check_gradient(lambda z: np.sin(z).sum(), x, 1.01 * np.cos(x)).verdict == "wrong"


def test_f_gets_copies():
    def rude(x):
        value = x @ x
        x[:] = 7
        return value

    kept = X.copy()
    assert check_gradient(rude, kept, 2 * X).ok and (kept == X).all()


class Torchlike:
    """Has what PyTorch's tensors have: no implicit conversion while a gradient is required."""

    def __init__(self, data, graph=True):
        self.data, self.graph = np.asarray(data), graph

    def new_tensor(self, data):
        return Torchlike(data, graph=False)

    def detach(self):
        return Torchlike(self.data, graph=False)

    def cpu(self):
        return self

    def __array__(self, dtype=None, copy=None):
        if self.graph:
            raise RuntimeError("call detach first")
        return np.array(self.data, dtype=dtype)


class Namespace:
    @staticmethod
    def asarray(data, dtype=None):
        return Jaxlike(np.asarray(data, dtype=dtype))


class Jaxlike:
    """Has what arrays of the array API have."""

    def __init__(self, data):
        self.data, self.dtype = np.asarray(data), np.asarray(data).dtype

    def __array_namespace__(self):
        return Namespace

    def __array__(self, dtype=None, copy=None):
        return np.array(self.data, dtype=dtype)


@pytest.mark.parametrize("kind", [Torchlike, Jaxlike])
def test_arrays_of_other_libraries(kind):
    seen = set()

    def f(x):
        seen.add(type(x))
        return kind(np.sin(x.data).sum()), kind(np.cos(x.data))

    assert check_gradient(f, kind(X)).ok and seen == {kind}
    assert check_gradient(f, kind(X), kind(1.01 * np.cos(X))).verdict == "wrong"


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), decade=st.integers(-9, 6), entry=st.integers(0, 5))
def test_random_smooth_functions_at_every_scale(seed, decade, entry):
    rng = np.random.default_rng(seed)
    scale = 10.0**decade
    a, b = rng.uniform(0.5, 2.0, 6), rng.uniform(-0.7, 0.7, 6)

    def f(x):
        return float((a * np.sin(x / scale)).sum() + 0.5 * ((x / scale) ** 2).sum())

    gradient = (a * np.cos(b) + b) / scale
    assert check_gradient(f, b * scale, gradient).ok
    wrong = gradient.copy()
    wrong[entry] += 1e-5 * max(abs(wrong[entry]), 0.1 / scale)
    assert check_gradient(f, b * scale, wrong).verdict == "wrong"


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: check_gradient(sines, [1.0, np.nan], np.ones(2)), "x must be finite; got nan"),
        (lambda: check_gradient(sines, X, X[:3]), r"gradient must have the shape of x, \(12,\); got \(3,\)"),
        (lambda: check_gradient(lambda x: x, X, X), r"f must return one number; got shape \(12,\)"),
        (lambda: check_gradient(lambda x: (1, 2, 3), X), "f must return a number or .* tuple of 3"),
        (lambda: check_gradient(lambda x: np.nan, X, X), r"f\(x\) must be finite; got nan"),
        (lambda: check_gradient(lambda x: "high", X, X), r"f\(x\) must be an array of numbers"),
        (lambda: check_gradient(lambda x: [x @ x, 2 * x], X), r"the tuple \(number, gradient\); got a list"),
        (lambda: check_gradient(3.0, X, X), "f must be callable, x -> number or .*; got 3.0"),
        (lambda: taylor_test("sines", X, X), "f must be callable, x -> number or .*; got 'sines'"),
        (lambda: check_gradient(sines, X, X, entries=0), "entries must be a whole number >= 1; got 0"),
        (lambda: check_gradient(sines, X, X, entries=2.5), "entries must be a whole number >= 1; got 2.5"),
        (lambda: check_gradient(sines, X, X, entries="all"), "entries must be a whole number >= 1; got 'all'"),
        (lambda: check_jacobian(None, X, np.eye(12)), r"f must be callable, x -> \(m,\); got None"),
        (lambda: check_gradient(sines, [], []), "x must have at least one entry"),
        (lambda: check_gradient(sines, X, X, rtol=-1), "rtol must be > 0"),
        (lambda: check_jacobian(lambda x: x, X, np.eye(3)), r"jacobian must have shape \(12, 12\).*got \(3, 3\)"),
        (lambda: check_adjoint(lambda u: u[:2], lambda w: w, 3, 3), r"tangent\(u\) must have shape \(3,\)"),
    ],
)
def test_bad_input_is_one_clear_error(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_a_gradient_that_is_not_finite_is_wrong():
    assert check_gradient(sines, X, np.where(X > 0, np.cos(X), np.nan)).verdict == "wrong"


@pytest.mark.parametrize("name", ADVICE)
def test_every_line_of_every_report_fits_80_columns(name):
    report = replace(check_gradient(sines, X, np.cos(X)), verdict=name, note="differences do not settle " * 5)
    lines = str(report).splitlines()
    assert max(map(len, lines)) <= 80 and " ".join(ADVICE[name].split()) in " ".join(" ".join(lines).split())


def test_the_report_reads_well_and_goes_to_json():
    report = check_gradient(sines, X, bent(np.cos(X), 4))
    assert max(map(len, str(report).splitlines())) <= 80
    data = json.loads(json.dumps(report.to_dict()))
    assert data["verdict"] == "wrong" and data["worst"]["entry"] == "entry 4" and data["counts"]["smooth"] == 11


# Jacobians, adjoints, Taylor remainders


def outputs(x):
    return np.sin(x) * x[0]


def slopes(x):
    return np.diag(np.cos(x) * x[0]) + np.outer(np.sin(x), np.eye(len(x))[0])


@pytest.mark.parametrize("wrap", [np.asarray, csr_array, aslinearoperator], ids=["dense", "sparse", "operator"])
@pytest.mark.parametrize("n", [5, 40])
def test_jacobians(wrap, n):
    x = np.random.default_rng(4).uniform(0.5, 2.0, n)
    right = slopes(x)
    assert check_jacobian(outputs, x, wrap(right)).ok
    for wrong in (right.T, 1.01 * right, -right, right - np.diag(np.diag(right)) * 1e-3):
        assert check_jacobian(outputs, x, wrap(wrong)).verdict == "wrong"


def test_adjoints():
    J = np.random.default_rng(5).normal(size=(4, 3))
    assert check_adjoint(lambda u: J @ u, lambda w: J.T @ w, 3, 4).ok
    for wrong in (1.01 * J, -J, J * (1 + 1e-5), np.roll(J, 1, axis=0)):
        report = check_adjoint(lambda u: J @ u, lambda w, wrong=wrong: wrong.T @ w, 3, 4)
        assert not report.ok and "DISAGREE" in str(report)
    assert not check_adjoint(lambda u: J @ u, lambda w: np.full(3, np.nan), 3, 4).ok


def test_taylor_remainders():
    assert taylor_test(sines, X, np.cos(X)).slope == pytest.approx(2, abs=0.05)
    assert taylor_test(lambda x: 3 * x.sum(), X, 0 * X + 3).slope == np.inf
    for wrong in (1.01 * np.cos(X), -np.cos(X), bent(np.cos(X), 2, 0.01), 0 * X):
        report = taylor_test(sines, X, wrong)
        assert not report.ok and report.slope == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("n", [5, 30, 100])
@pytest.mark.parametrize("seed", range(3))
def test_values_rounded_inside_never_make_a_right_gradient_wrong(n, seed):
    x = np.random.default_rng(seed).normal(size=n)
    assert check_gradient(lambda z: float((z.astype(np.float32) ** 2).sum()), x, 2 * x).verdict == "noise"
    assert check_gradient(lambda z: float(f"{z @ z:.6g}"), x, 2 * x).verdict == "noise"


def test_what_round_off_hides_is_not_called_right():
    x = np.array([0.3, 0.4])
    assert check_gradient(lambda z: 1e12 + np.sin(z).sum(), x, 2 * np.cos(x)).verdict == "noise"
    assert check_gradient(lambda z: 1e8 + 1e-4 * np.sin(z).sum(), x, np.zeros(2)).verdict == "noise"
    report = check_gradient(lambda z: 1e12 * z[0] ** 2 + z[1], x, [0.6e12, 1.0])
    assert report.ok and "1 entries are too small" in report.note


@pytest.mark.parametrize("ulps", [1, 2])
def test_a_last_digit_that_is_always_off_is_no_vertical_tangent(ulps):
    """(f(x+h) - f(x))/h of a value whose last digit differs at every step grows like 1/h as well."""
    base, slope = -0.144053045, 2.1e-11

    def f(x):
        moved = x[0] - 60.0
        value = base + slope * moved
        return value if abs(moved) > 1e-6 or moved == 0 else base + ulps * np.spacing(base) * np.sign(-moved)

    report = check_gradient(f, np.array([60.0]), np.array([slope]))
    assert report.verdict == "smooth", report
    steep = check_gradient(lambda x: base + 1e-9 * np.sqrt(np.abs(x[0])), np.array([0.0]), np.array([0.0]))
    assert steep.verdict == "kink", steep
