"""Elementary functions and decisions: the same numbers in every backend, against mpmath at 50 digits."""

from __future__ import annotations

import ctypes
import itertools
import math
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import casadi as ca
import mpmath
import numpy as np
import pytest

from mbkit.catalog import double_pendulum
from mbkit.codegen import extended_precision, simd_kernel, taylor
from mbkit.codegen import program as program_module
from mbkit.codegen.backend import Machine
from mbkit.codegen.c_source import c_code
from mbkit.codegen.extended_precision import Extended, arithmetic
from mbkit.codegen.llvm_ir import CALLS
from mbkit.codegen.program import program
from mbkit.codegen.taylor import TaylorSystem, precision
from mbkit.errors import UnsupportedError
from tests.test_compiled import built
from tests.test_export import C99, needs_cc

EPS = float(np.finfo(float).eps)
EPS_113 = mpmath.mpf(2) ** -112
BACKENDS = ["mpmath", *(["real128"] if arithmetic().name == "real128" else [])]
mp = mpmath.MPContext()
mp.dps = 50


N = 60


def uniform(a: float, b: float) -> Any:
    return lambda rng: rng.uniform(a, b, N)


def tiny(rng: np.random.Generator) -> Any:
    return rng.choice([-1, 1], N) * 10.0 ** rng.uniform(-290, -8, N)


def large(rng: np.random.Generator) -> Any:
    return 10.0 ** rng.uniform(0, 290, N)


def near(c: float, side: float = 0.0) -> Any:
    """Numbers about c, down to its neighbours; with a side only those above (1) or below (-1)."""
    return lambda rng: c + (side or rng.choice([-1, 1], N)) * 10.0 ** rng.uniform(-15, -1, N)


@dataclass(frozen=True)
class Function:
    """A function, where to ask it, and by how many ulps the C library may be off.

    The largest errors that are known of glibc's double functions stay below 1 ulp, and
    below 2.5 for the hyperbolic ones and their inverses (Zimmermann 2021, Accuracy of
    mathematical functions in single, double, extended double and quadruple precision).
    """

    name: str
    ulps: float
    points: tuple[Any, ...]
    middle: tuple[float, float] = (0.2, 0.7)

    def casadi(self, *x: Any) -> Any:
        return (ca.power if self.name == "pow" else getattr(ca, self.name))(*x)

    def exact(self, *x: Any) -> Any:
        return getattr(mp, "power" if self.name == "pow" else self.name)(*x)

    @property
    def arguments(self) -> int:
        return CALLS[self.name]

    def groups(self, seed: int = 0) -> np.ndarray:
        """Return arguments, shape (n, 2); the second one is for those that take two."""
        rng = np.random.default_rng(seed)
        made = [g(rng) for g in self.points]
        return np.concatenate([np.stack(x if isinstance(x, tuple) else (x, np.ones_like(x)), axis=1) for x in made])


def pair(a: Any, b: Any) -> Any:
    return lambda rng: (a(rng), b(rng))


TABLE = [
    Function("tan", 1, (uniform(-3, 3), uniform(-1e8, 1e8), tiny, lambda _: np.arange(1, N) * np.pi / 2)),
    Function("asin", 1, (uniform(-1, 1), tiny, near(1, -1), near(-1, 1))),
    Function("acos", 1, (uniform(-1, 1), tiny, near(1, -1), near(-1, 1))),
    Function("atan", 1, (uniform(-3, 3), tiny, large)),
    Function("exp", 1, (uniform(-600, 700), uniform(-1, 1), tiny)),
    Function("expm1", 1, (uniform(-600, 700), uniform(-1, 1), tiny)),
    Function("log", 1, (large, lambda rng: 1 / large(rng), near(1))),
    Function("log1p", 1, (uniform(-0.9, 9), large, tiny, near(-1, 1))),
    Function("sinh", 2.5, (uniform(-700, 700), uniform(-1, 1), tiny)),
    Function("cosh", 2.5, (uniform(-700, 700), uniform(-1, 1), tiny)),
    Function("tanh", 2.5, (uniform(-25, 25), uniform(-1, 1), tiny)),
    Function("asinh", 2.5, (uniform(-9, 9), large, tiny)),
    Function("acosh", 2.5, (uniform(1, 9), large, near(1, 1)), middle=(1.2, 3.0)),
    Function("atanh", 2.5, (uniform(-1, 1), tiny, near(1, -1), near(-1, 1))),
    Function("pow", 1, (pair(uniform(0, 9), uniform(-20, 20)), pair(near(1), uniform(-2e3, 2e3)))),
    Function("atan2", 1, (pair(uniform(-1, 1), uniform(-1, 1)), pair(tiny, uniform(-1, 1)))),
    Function("hypot", 1, (pair(uniform(-1, 1), uniform(-1, 1)), pair(large, large))),
]
IDS = [f.name for f in TABLE]
each = pytest.mark.parametrize("f", TABLE, ids=IDS)
X, Y = ca.SX.sym("x"), ca.SX.sym("y")


def function(*outputs: Any) -> ca.Function:
    return ca.Function("f", [X, Y], [ca.vertcat(*(ca.SX(e) for e in outputs))])


def arguments(f: Function) -> list[Any]:
    return [X, Y][: f.arguments]


def columns(points: np.ndarray) -> list[np.ndarray]:
    return [np.ascontiguousarray(points[:, i : i + 1]) for i in range(2)]


def everything() -> ca.Function:
    """Every function and decision of two numbers between 0 and 1, one output each."""
    shifted = [f.casadi(*((X + 1 if f.name == "acosh" else X), Y)[: f.arguments]) for f in TABLE]
    return function(*shifted, *decisions())


def _unless_nan(choose: Callable[[float, float], float]) -> Callable[[float, float], float]:
    return lambda x, y: math.nan if math.isnan(x + y) else choose(x, y)


#: Decisions: in CasADi, and in Python's own numbers.
DECISIONS: dict[str, tuple[Any, Callable[[float, float], float]]] = {
    "fmin": (ca.fmin(X, Y), _unless_nan(min)),
    "fmax": (ca.fmax(X, Y), _unless_nan(max)),
    "lt": (X < Y, lambda x, y: x < y),
    "le": (X <= Y, lambda x, y: x <= y),
    "eq": (ca.eq(X, Y), lambda x, y: x == y),
    "ne": (ca.ne(X, Y), lambda x, y: x != y),
    "and": (ca.logic_and(X, Y), lambda x, y: x != 0 and y != 0),
    "or": (ca.logic_or(X, Y), lambda x, y: x != 0 or y != 0),
    "not": (ca.logic_not(X), lambda x, _: x == 0),
    "sign": (ca.sign(X), lambda x, _: x if math.isnan(x) else float(x > 0) - float(x < 0)),
    "if_else": (
        ca.if_else(ca.logic_and(X > 0, ca.logic_not(Y > X)), X, 2 * Y),
        lambda x, y: x if x > 0 and not y > x else 2 * y,
    ),
}


def decisions() -> list[Any]:
    return [written for written, _ in DECISIONS.values()]


def read_exactly(x: Any) -> Any:
    """Return a 113-bit number as mpmath's: 36 digits are more than it holds."""
    return mp.mpf(str(x)) if not isinstance(x, mpmath.ctx_mp_python._mpf) else mp.mpf(x)


# Values


@each
def test_machine_code_is_as_right_as_the_c_library(f: Function) -> None:
    points = f.groups()
    out = built(function(f.casadi(*arguments(f))))(*columns(points))[0].ravel()
    for got, point in zip(out, points, strict=True):
        exact = f.exact(*(mp.mpf(float(x)) for x in point[: f.arguments]))
        assert abs(mp.mpf(float(got)) - exact) <= f.ulps * np.spacing(abs(float(exact))), point


@pytest.mark.parametrize("backend", BACKENDS)
@each
def test_113_bits_are_right_to_33_digits(f: Function, backend: Any) -> None:
    own, points = arithmetic(backend), f.groups(1)
    # With digits beyond a double's, which what is asked near the ends of a domain would not bear.
    low = points * EPS / 8 if f.name not in ("asin", "acos", "atanh", "pow") else 0 * points
    given = [own.from_pair(points[:, i : i + 1], low[:, i : i + 1]) for i in range(2)]
    out = Extended(program(function(f.casadi(*arguments(f)))), own)(*given)[0].ravel()
    for k, got in enumerate(out):
        x = [mp.mpf(float(points[k, i])) + mp.mpf(float(low[k, i])) for i in range(f.arguments)]
        exact = f.exact(*x)
        # libquadmath's functions are measured to be off by up to 1.5 ulp, of which one is at most 2⁻¹¹².
        assert abs(read_exactly(got) - exact) <= 2 * EPS_113 * abs(exact), points[k]


@needs_cc
def test_c_gives_the_bits_of_machine_code(tmp_path: Any) -> None:
    made = everything()
    (tmp_path / "f.c").write_text(c_code("test", {"f": made}))
    subprocess.run([*C99, "-shared", "-fPIC", str(tmp_path / "f.c"), "-o", str(tmp_path / "f.so"), "-lm"], check=True)
    call = ctypes.CDLL(str(tmp_path / "f.so")).f
    code, rng = built(made), np.random.default_rng(2)
    odd = [(a, b) for a in (0.0, 1.0, np.nan, -2.0) for b in (0.0, 1.0, np.nan)]
    for x, y in [*rng.uniform(0.1, 0.9, (50, 2)), *odd]:
        out = np.empty(made.size1_out(0))
        call(
            *(np.array([v], dtype=float).ctypes.data_as(ctypes.c_void_p) for v in (x, y)),
            out.ctypes.data_as(ctypes.c_void_p),
        )
        # Both call the same library, one number at a time.
        np.testing.assert_array_equal(out, code(np.array([x]), np.array([y]))[0].ravel(), err_msg=f"{x} {y}")


# Derivatives


@pytest.mark.parametrize("how", ["machine code", "interpreter", *BACKENDS])
@each
def test_jacobians_are_the_derivatives(f: Function, how: Any) -> None:
    made = function(ca.densify(ca.jacobian(f.casadi(*arguments(f)), ca.vertcat(*arguments(f))).T))
    points = np.random.default_rng(3).uniform(*f.middle, (8, 2))
    given, eps = columns(points), mpmath.mpf(EPS)
    if how in BACKENDS:
        out = Extended(program(made), arithmetic(how))(*given)[0]
        eps = EPS_113
    else:
        out = (built(made) if how == "machine code" else Machine(made))(*given)[0]
    for got, point in zip(out[:, :, 0], points, strict=True):
        x = [mp.mpf(float(v)) for v in point[: f.arguments]]
        for i in range(f.arguments):
            order = tuple(int(i == j) for j in range(f.arguments))
            exact = mp.diff(f.exact, tuple(x), order) if f.arguments > 1 else mp.diff(f.exact, x[0])
            # Up to six operations of an ulp or two each, and no difference here loses more than one digit.
            assert abs(read_exactly(got[i]) - exact) <= 16 * eps * abs(exact)


# Decisions, and what is no number


@pytest.mark.parametrize("how", ["machine code", "interpreter", *BACKENDS])
def test_decisions_are_the_same_everywhere(how: Any) -> None:
    made = function(*decisions())
    points = np.array(list(itertools.product([0.0, 1.0, -2.0, 0.5, np.nan], repeat=2)))
    if how in BACKENDS:
        own = arithmetic(how)
        out = own.pair(Extended(program(made), own)(*columns(points))[0])[0]
    else:
        out = (built(made) if how == "machine code" else Machine(made))(*columns(points))[0]
    for got, (x, y) in zip(out[:, :, 0], points, strict=True):
        for value, (name, (_, decide)) in zip(got, DECISIONS.items(), strict=True):
            if how == "interpreter" and name in ("fmin", "fmax") and math.isnan(x + y):
                continue  # CasADi's machine has C's, which pass over what is no number
            np.testing.assert_equal(value, float(decide(x, y)), err_msg=f"{name} of {x}, {y}")


OUTSIDE = [
    *[("sqrt", -1.0, 0.0), ("log", -1.0, 0.0), ("log1p", -2.0, 0.0), ("asin", 2.0, 0.0), ("acos", -2.0, 0.0)],
    *[("acosh", 0.5, 0.0), ("atanh", 2.0, 0.0), ("pow", -8.0, 0.3)],
]
POLES = [("log", 0.0, 0.0), ("log1p", -1.0, 0.0), ("atanh", 1.0, 0.0), ("pow", 0.0, -1.5), ("exp", 1e4, 0.0)]


def _named(name: str) -> Any:
    return ca.power(X, Y) if name == "pow" else getattr(ca, name)(X)


@pytest.mark.parametrize(("name", "x", "y"), OUTSIDE + POLES)
def test_a_value_that_is_none_is_found_and_leaves_its_neighbours_alone(name: str, x: float, y: float) -> None:
    made = function(_named(name))
    points = np.full((11, 2), 0.75 if name != "acosh" else 1.75)
    good = built(made)(*columns(points))[0]
    points[6] = x, y
    for code in (built(made), Machine(made)):
        out, finite = code.call_checked(*columns(points))
        assert not finite
        assert np.isnan(out[0][6]) if (name, x, y) in OUTSIDE else np.isinf(out[0][6])
        np.testing.assert_array_equal(np.delete(out[0], 6), np.delete(good, 6))
    for backend in BACKENDS:
        own = arithmetic(backend)
        extended = own.pair(Extended(program(made), own)(*columns(points))[0])[0]
        assert not np.isfinite(extended[6]), backend
        assert np.isfinite(np.delete(extended, 6)).all()


@pytest.mark.parametrize("hide", [lambda e: ca.fmax(e, 0), lambda e: ca.fmin(1, e), lambda e: ca.fmax(0, e)])
def test_no_choice_hides_what_is_no_number(hide: Any) -> None:
    made = function(hide(ca.log(X)))
    points = columns(np.array([[-1.0, 0.0], [2.0, 0.0]]))
    out, finite = built(made).call_checked(*points)
    assert not finite
    assert np.isnan(out[0].ravel()).tolist() == [True, False]
    for backend in BACKENDS:
        own = arithmetic(backend)
        extended = own.pair(Extended(program(made), own)(*points)[0])[0]
        assert np.isnan(extended.ravel()).tolist() == [True, False]


@pytest.mark.thorough("inf", "-inf")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_read_and_not_finite_is_found_whatever_a_function_makes_of_it(bad: float) -> None:
    """exp(-inf) is 0, atan(inf) a number, NaN to the power of 0 is 1."""
    for made in [f.casadi(*arguments(f)) for f in TABLE] + decisions():
        code = built(function(made))
        for i in range(2):
            points = np.zeros((9, 2))
            points[3, i] = bad
            assert not code.call_checked(*columns(points))[1], (made, i)


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_exponent_is_too_large_for_113_bits(backend: Any) -> None:
    own = arithmetic(backend)
    x, huge = ca.exp(ca.exp(X)), ca.exp(X)
    made = Extended(program(function(x, ca.sinh(huge), ca.cosh(huge), huge**huge, 1 / x)), own)
    out = own.pair(made(np.array([[1e3], [1e300]]), np.zeros((2, 1)))[0][:, :, 0])[0]
    assert np.isposinf(out[:, :4]).all()
    assert (out[:, 4] == 0).all()


# A state's bits depend on nothing but the state


def test_bits_depend_neither_on_place_nor_batch_nor_threads() -> None:
    code, n = built(everything()), 1003
    points = np.random.default_rng(4).uniform(0.05, 0.95, (n, 2))
    out = code(*columns(points), threads=1)[0]
    for i in range(0, n, 97):
        np.testing.assert_array_equal(code(points[i, :1], points[i, 1:])[0], out[i])
    for k in (1, 3, 500):
        np.testing.assert_array_equal(code(*columns(points[k:]))[0], out[k:])
    many = np.tile(points, (200, 1))
    assert len(many) * code.operations > 4e6  # enough for two threads
    np.testing.assert_array_equal(code(*columns(many), threads=2)[0], np.tile(out, (200, 1, 1)))


def test_pieces_give_the_same_bits_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    points = columns(np.random.default_rng(6).uniform(0.05, 0.95, (21, 2)))
    expected = built(everything())(*points)[0]
    monkeypatch.setattr(simd_kernel, "_MAX_WHOLE_OPERATIONS", 10)
    monkeypatch.setattr(simd_kernel, "_PIECE_OPERATIONS", 12)
    assert len(simd_kernel.pieces_of(program(everything()))) > 5
    np.testing.assert_array_equal(built(everything())(*points)[0], expected)


# Taylor series


def equations(rates: Callable[[Any, Any], Any], n: int) -> Any:
    """Return what a Taylor system asks of equations, for accelerations that are given straight."""
    q, v, tau = (ca.SX.sym(name, n) for name in ("q", "v", "tau"))
    forward = ca.Function("forward_dynamics", [q, v, tau], [ca.densify(ca.SX(rates(q, v)))])
    return SimpleNamespace(
        q=q,
        v=v,
        tau=tau,
        force=tau,
        extra_arguments={},
        model=double_pendulum(),
        kin=SimpleNamespace(qdot=v),
        elimination="mass matrix",
        function=lambda _: forward,
    )


@pytest.mark.thorough("53", "64")
@pytest.mark.parametrize("bits", [53, 64, 113])
def test_series_of_every_function_hold_its_integral(bits: int) -> None:
    """With q' = v = 1 and v' = 0 of the first, every other velocity is the integral of a function."""
    pytest.importorskip("heyoka")
    try:
        kind = precision(bits)
    except UnsupportedError as error:
        pytest.skip(str(error))

    def given(f: Function, q: Any) -> list[Any]:
        # Both arguments move, within the domain.
        return [q * 0.5 + (1.25 if f.name == "acosh" else 0.25), 1.5 - q][: f.arguments]

    system = TaylorSystem(
        equations(lambda q, _: ca.vertcat(0, *(f.casadi(*given(f, q[0])) for f in TABLE)), len(TABLE) + 1)
    )
    with system.integrator(kind, kind.eps) as integrator:
        integrator.time = kind.dtype(0)
        state = np.zeros(2 * len(TABLE) + 2)
        state[len(TABLE) + 1] = 1.0
        integrator.state[:] = state.astype(kind.dtype)
        integrator.propagate_until(kind.dtype(0.75))
        out = integrator.state[len(TABLE) + 2 :]
    for f, got in zip(TABLE, out, strict=True):
        exact = mp.quad(lambda t, f=f: f.exact(*given(f, t)), [0, 0.25, 0.5, 0.75])
        # Some ten steps; each adds a rounding or two to a sum of the size of its result.
        assert abs(mp.mpf(str(got)) - exact) <= 32 * mp.mpf(kind.eps) * (abs(exact) + 0.1), f.name


def test_a_series_knows_where_it_may_take_the_wrong_branch() -> None:
    pytest.importorskip("heyoka")
    smooth = TaylorSystem(equations(lambda q, v: ca.vertcat(ca.tanh(q[0]), ca.exp(v[1])), 2))
    assert not smooth.kinked
    for jump in (lambda x: ca.fmin(x, 0), lambda x: ca.asin(ca.sin(x)), lambda x: ca.atan2(x, -1)):
        assert TaylorSystem(equations(lambda q, v, j=jump: ca.vertcat(j(q[0]), v[1]), 2)).kinked


# What no backend has


@pytest.mark.parametrize(("e", "told"), [(ca.floor(X), "floor"), (ca.erfinv(X), "erfinv"), (ca.fmod(X, Y), "fmod")])
def test_an_operation_that_no_backend_has_is_named(e: Any, told: str) -> None:
    with pytest.raises(
        UnsupportedError, match=rf"^f: CasADi's operation {told} has no counterpart.*acos, .*\(of an MX"
    ):
        program(function(e))


def test_every_operation_has_a_place_in_every_backend() -> None:
    heyoka = pytest.importorskip("heyoka")
    names = {*program_module._UNARY.values(), *program_module._BINARY.values()}
    assert {o.name for o in program(everything()).operations} >= {*CALLS, *DECISIONS} - {"if_else"}
    for known in (extended_precision._functions(arithmetic()), taylor._functions(heyoka)):
        assert known.keys() == names
