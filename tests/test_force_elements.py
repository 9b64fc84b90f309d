"""Forces by functions, at joints, on frames and in bushings: against closed forms, the oracle and every engine."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import mpmath
import numpy as np
import pytest
import sympy as sp
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.errors import ModelError
from mbkit.simulate import METHODS
from tests.scenes import mounted

RNG = np.random.default_rng
#: A symmetric positive matrix without any zero.
_ROOT = RNG(0).standard_normal((6, 6))
STIFFNESS = _ROOT @ _ROOT.T
R_TIP = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix()


def tree() -> mb.ModelBuilder:
    """Return a floating base with an arm of two links, a frame at its tip, and a damped spring in its elbow."""
    b = mb.ModelBuilder("arm")
    b.add_body("base", mass=3.0, inertia=(0.2, 0.3, 0.25), com=(0.01, 0.02, 0.03))
    b.add_body("upper", mass=1.0, com=(0.2, 0, 0), inertia=(0.01, 0.02, 0.02))
    b.add_body("lower", mass=0.7, com=(0.1, 0, 0.05), inertia=(0.01, 0.02, 0.02))
    b.add_joint("float", "free", parent="world", child="base")
    b.add_joint("shoulder", "revolute", parent="base", child="upper", axis=(0, 1, 0), translation=(0.1, 0, 0))
    elbow = {"axis": (0, 0, 1), "translation": (0.4, 0, 0), "damping": 0.1, "stiffness": 2.0}
    b.add_joint("elbow", "revolute", parent="upper", child="lower", **elbow)
    b.add_frame("tip", body="lower", translation=(0.3, 0.1, 0), rotation=R_TIP)
    return b


def push(t: Any, p: Any, twist: Any) -> Any:
    return -0.3 * twist[:3] * (twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2 + 0.1) ** 0.5 + p[:3] * t


def all_elements() -> mb.Model:
    """Return the arm with a force of each sort, time, parameters and potentials among them."""
    b = tree()
    t, q, v, k, elbow, rate = sp.symbols("t q v k elbow elbow_dot")
    law = -k * sp.sin(q) + 0.3 * sp.cos(2 * t) * rate - sp.Rational(1, 3) * v * elbow**2
    b.add_joint_force("motor", "shoulder", law, potential=k * q**4, parameters={"k": mb.Parameter("k", 2.0)})
    moment = (0.1, mb.Parameter("M", 0.2), math.pi)
    for axes in ("local", "world", "local_world_aligned"):
        b.add_force(f"push {axes}", "tip", force=push, moment=moment, axes=axes, potential=lambda p: p[0] ** 2 + p[2])
    b.add_bushing(
        "rubber",
        body_a="base",
        body_b="lower",
        translation_a=(0.1, 0.2, 0.3),
        translation_b=(0.0, 0.1, 0.3),
        rotation_b=R_TIP,
        stiffness=STIFFNESS,
        damping=0.3 * STIFFNESS,
        force=lambda t, x, x_dot: -(x**3) + ca.sin(t) - 0.1 * x_dot**3,
        potential=lambda x: x[0] * x[3] ** 2,
    )
    return b.build()


MODEL = all_elements()
TIME = 0.7
Q, V = MODEL.random_state(0, 4)
A, TAU = RNG(1).standard_normal((2, 4, MODEL.nv))


def off(x: Any, exact: Any) -> float:
    return float(np.abs(np.asarray(x) - exact).max() / np.abs(exact).max())


# Engines


@pytest.fixture(scope="module")
def oracle() -> Any:
    return mb.dynamics(MODEL, "oracle").at(t=TIME)


@pytest.mark.thorough("lagrangian")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco", "drake"])
def test_every_engine_has_the_same_forces(engine: str, oracle: Any) -> None:
    if engine == "drake":
        pytest.importorskip("pydrake")
    dyn = mb.dynamics(MODEL, engine).at(t=TIME)
    wrenches = {"tip": np.arange(6.0)}
    for quantity, states in {
        "passive": (Q, V),
        "potential_energy": (Q,),
        "inverse_dynamics": (Q, V, A),
        "forward_dynamics": (Q, V, TAU),
    }.items():
        assert off(getattr(dyn, quantity)(*states), getattr(oracle, quantity)(*states)) < 1e-13, quantity
    for quantity, last in (("inverse_dynamics", A), ("forward_dynamics", TAU)):
        given = (Q, V, last, wrenches, "world")
        assert off(getattr(dyn, quantity)(*given), getattr(oracle, quantity)(*given)) < 1e-13, quantity
        if not dyn._why_no_derivatives:
            name = f"{quantity}_derivatives"
            for x, exact in zip(getattr(dyn, name)(Q, V, last), getattr(oracle, name)(Q, V, last), strict=True):
                assert off(x, exact) < 1e-12, name
    one = dyn.forward_dynamics(Q[0], V[0], TAU[0])
    assert off(one, oracle.forward_dynamics(Q, V, TAU)[0]) < 1e-13
    assert off(dyn.at(t=0.0).passive(Q, V), oracle.passive(Q, V)) > 1e-3


# What they are: against formulas written apart


def displacement(dyn: mb.Dynamics, q: np.ndarray) -> np.ndarray:
    """Return x of the bushing of `all_elements`, from the poses of the bodies and SciPy's rotation vector."""
    A, B = dyn.pose(q, "base"), dyn.pose(q, "lower")
    own, other = np.eye(4), np.eye(4)
    own[:3, 3], other[:3, 3], other[:3, :3] = (0.1, 0.2, 0.3), (0.0, 0.1, 0.3), R_TIP
    seen = np.linalg.inv(A @ own) @ B @ other
    return np.concatenate([seen[:3, 3], Rotation.from_matrix(seen[:3, :3]).as_rotvec()])


def test_a_bushing_acts_on_the_rates_of_its_displacement() -> None:
    b = tree()
    ends = {"body_a": "base", "body_b": "lower", "translation_a": (0.1, 0.2, 0.3), "translation_b": (0.0, 0.1, 0.3)}
    b.add_bushing(
        "rubber",
        **ends,
        rotation_b=R_TIP,
        stiffness=STIFFNESS,
        damping=STIFFNESS[::-1] @ STIFFNESS[::-1].T,
        force=lambda _t, x, rate: -(x**3) - rate**3,
    )
    model = b.build()
    dyn, bare, h = mb.dynamics(model, "lagrangian"), mb.dynamics(model.without("forces"), "lagrangian"), 1e-6
    for q, v in zip(Q, V, strict=True):
        x = displacement(bare, q)
        assert dyn.potential_energy(q) - bare.potential_energy(q) == pytest.approx(0.5 * x @ STIFFNESS @ x, rel=1e-12)

        def moved(u: np.ndarray, q: np.ndarray = q) -> np.ndarray:
            ends = (displacement(bare, model.integrate(q, s * u)) for s in (h, -h))
            return np.subtract(*ends) / (2 * h)

        J, rate = np.array([moved(e) for e in np.eye(model.nv)]).T, moved(v)
        f = -STIFFNESS @ x - STIFFNESS[::-1] @ STIFFNESS[::-1].T @ rate - x**3 - rate**3
        # Differences over h leave 1e-16 / h, and h².
        assert off(dyn.passive(q, v) - bare.passive(q, v), J.T @ f) < 1e-8


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.031, 0.0316, 0.032, 0.5, 2.0, 3.1])
def test_a_rotation_vector_is_exact_at_every_angle(angle: float) -> None:
    """0.0316 rad is where the series ends; the oracle holds its digits on both sides."""
    b = mounted(
        "twist", "disc", "turn", "revolute", gravity=(0, 0, 0), mass=1.0, inertia=(1.0, 1.0, 1.0), axis=(0, 0, 1)
    )
    b.add_bushing("shaft", body_a="world", body_b="disc", stiffness=[0, 0, 0, 5.0, 6.0, 7.0])
    model = b.build()
    with mpmath.workdps(40):
        exact = mpmath.mpf(7) / 2 * mpmath.mpf(angle) ** 2
        high, low = mb.dynamics(model, "oracle").extended("potential_energy", [angle])
        assert abs(mpmath.mpf(float(high)) + mpmath.mpf(float(low)) - exact) <= mpmath.mpf(1e-29) * exact
    dyn = mb.dynamics(model, "lagrangian")
    assert dyn.passive([angle], [0.0])[0] == pytest.approx(-7 * angle, rel=2e-14, abs=0)
    # Half a turn is a pole of the second derivatives.
    slope = dyn.inverse_dynamics_derivatives([angle], [0.0], [0.0]).q[0, 0]
    assert slope == pytest.approx(7.0, rel=2e-14 / (math.pi - angle) ** 2)


def frequencies(model: mb.Model) -> np.ndarray:
    """Return the frequencies of small motions about the neutral configuration, rad/s."""
    dyn, n = mb.dynamics(model, "lagrangian"), model.nv
    at = model.neutral(), np.zeros(n), np.zeros(n)
    by_q, by_v, _ = dyn.forward_dynamics_derivatives(*at)
    roots = np.linalg.eigvals(np.block([[np.zeros((n, n)), np.eye(n)], [by_q, by_v]]))
    return np.sort(np.abs(roots.imag))[::2]


def test_a_body_on_a_bushing_has_the_frequencies_of_the_closed_form() -> None:
    """A bushing h below the centre of mass couples sliding and rocking, with K = [[k, k h], [k h, k h² + c]]."""
    m, inertia, h = 2.0, (0.3, 0.4, 0.5), 0.2
    k, c = np.array([1000.0, 1500.0, 800.0]), np.array([30.0, 40.0, 50.0])
    b = mounted("block", "block", "free", "free", gravity=(0, 0, 0), mass=m, inertia=inertia)
    ends = {"body_a": "world", "body_b": "block", "translation_a": (0, 0, -h), "translation_b": (0, 0, -h)}
    b.add_bushing("rubber", **ends, stiffness=[*k, *c])

    def pair(k: float, c: float, moment: float) -> np.ndarray:
        K, M = np.array([[k, k * h], [k * h, k * h**2 + c]]), np.diag([m, moment])
        return np.sqrt(np.linalg.eigvals(np.linalg.solve(M, K)).real)

    expected = [*pair(k[0], c[1], inertia[1]), *pair(k[1], c[0], inertia[0])]
    expected += [math.sqrt(k[2] / m), math.sqrt(c[2] / inertia[2])]
    assert np.allclose(frequencies(b.build()), np.sort(expected), rtol=1e-12, atol=0)


def test_expressions_of_either_library_and_functions_say_the_same() -> None:
    q, v, w = ca.SX.sym("q"), ca.SX.sym("v"), ca.SX.sym("w")
    x, y, z = sp.symbols("q v w")
    laws: list[Any] = [
        -w * ca.sin(q) * v - ca.if_else(q > 0, 2.0, 3.0),
        -z * sp.sin(x) * y - sp.Piecewise((2, x > 0), (3, True)),
        lambda _t, q, v: -1.5 * np.sin(q) * v - ca.if_else(q > 0, 2.0, 3.0),
    ]
    forces = []
    for k, law in enumerate(laws):
        b = tree()
        b.add_joint_force("f", "shoulder", law, parameters=None if k == 2 else {"w": 1.5})
        forces.append(mb.dynamics(b.build(), "lagrangian").passive(Q, V))
    assert np.array_equal(forces[0], forces[1])
    assert off(forces[2], forces[0]) < 1e-15


# Time


def slider() -> mb.Model:
    """Return 2 kg on a rail under the force 3 cos 5 t."""
    b = mounted("slider", "car", "rail", "prismatic", gravity=(0, 0, 0), mass=2.0, axis=(1, 0, 0))
    b.add_joint_force("drive", "rail", lambda t, _q, _v: 3 * ca.cos(5 * t))
    return b.build()


def closed_form(t0: float, t: float) -> tuple[float, float]:
    """Return x and v at t of the slider at rest at t0."""
    c = 3 / (2 * 5)
    v = c * (math.sin(5 * t) - math.sin(5 * t0))
    return -c / 5 * (math.cos(5 * t) - math.cos(5 * t0)) - c * math.sin(5 * t0) * (t - t0), v


@pytest.mark.parametrize("name", ["semi_implicit_euler", "gauss6", "rk853", "taylor"])
def test_every_method_starts_at_t0_and_follows_the_time(name: str) -> None:
    method, t0, duration = METHODS[name], 0.4, 1.0
    dyn = mb.dynamics(slider(), "lagrangian")
    given: dict[str, Any] = {"dt": 1e-3} if method.kind == "fixed" else {"rtol": 1e-9}
    save = None if method.kind == "fixed" else [t0, t0 + 0.3, t0 + duration]
    run = mb.simulate(dyn, [0.0], [0.0], duration, name, save=save, t0=t0, **given)
    assert run.t[0] == t0
    assert run.t[-1] == pytest.approx(t0 + duration, rel=1e-15)
    x, v = closed_form(t0, t0 + duration)
    # An Euler's error at this step, and that of a method of second order; the others' are theirs by tolerance.
    worst = {1: 5e-3, 2: 5e-6}.get(method.order, 1e-8) if method.kind == "fixed" else 1e-7
    assert abs(run.q[-1, 0] - x) < worst
    assert abs(run.v[-1, 0] - v) < worst


# The description


# Bad input


def fault(add: Any) -> str:
    b = tree()
    add(b)
    with pytest.raises(ModelError) as caught:
        b.build()
    return str(caught.value)


q_, v_, x_ = (ca.SX.sym(n) for n in ("q", "v", "stray"))


@pytest.mark.parametrize(
    ("add", "words"),
    [
        (lambda b: b.add_joint_force("f", "elbow", -q_ * x_), ["force 'f'", "unknown symbol 'stray'", "parameters="]),
        (lambda b: b.add_joint_force("f", "elbow", -ca.SX.sym("shouldr")), ["did you mean 'shoulder'"]),
        (lambda b: b.add_joint_force("f", "float", -ca.SX.sym("q_0")), ["expected 6 components, got 1"]),
        (lambda b: b.add_joint_force("f", "elbow"), ["never act"]),
        (lambda b: b.add_joint_force("f", "elbow", potential=v_**2), ["potential", "'v'"]),
        (lambda b: b.add_joint_force("f", "elbow", -q_, parameters={"k": 1.0}), ["'k'", "in no expression"]),
        (lambda b: b.add_joint_force("f", "elbow", ca.MX.sym("q")), ["expected a casadi.SX, got an MX"]),
        (lambda b: b.add_joint_force("f", "elbow", lambda _t, q, _v: math.sin(q)), ["the function raised", "torque="]),
        (
            lambda b: b.add_joint_force("f", "elbow", lambda _t, q, _v: np.interp(q, [0.0, 1.0], [0.0, 2.0])),
            ["calls numpy.interp, which takes numbers alone", "casadi.pw_lin", "torque="],
        ),
        (lambda b: b.add_joint_force("f", "elbow", math.nan), ["finite"]),
        (lambda b: b.add_force("f", "tp", force=(1, 0, 0)), ["unknown frame 'tp'", "'tip'"]),
        (lambda b: b.add_force("f", "tip", force=(1, 0, 0), axes="global"), ["axes", "'global'"]),
        (lambda b: b.add_bushing("b", body_a="base", body_b="base", stiffness=1.0), ["both frames on 'base'"]),
        (lambda b: b.add_bushing("b", body_a="base", body_b="lower", stiffness=np.tri(6)), ["symmetric"]),
        (lambda b: b.add_bushing("b", body_a="base", body_b="lower", damping=-1.0), ["damping", "drives the motion"]),
    ],
)
def test_what_is_no_force_is_refused_with_the_reason(add: Any, words: list[str]) -> None:
    text = fault(add)
    for word in words:
        assert word in text


def test_a_symbol_with_two_meanings_is_refused() -> None:
    b = mounted("cart", "cart", "x", "prismatic", mass=1.0, axis=(1, 0, 0))
    b.add_force("f", "cart", force=(-ca.SX.sym("x"), 0, 0))
    with pytest.raises(ModelError, match="'x' stands for one of its own arguments and a coordinate"):
        b.build()
    b = mounted("cart", "cart", "q", "prismatic", mass=1.0, axis=(1, 0, 0))
    b.add_joint_force("f", "q", -2 * q_)
    assert mb.dynamics(b.build()).passive([1.0], [0.0]) == -2.0


def test_a_state_at_which_a_force_is_not_a_number_is_refused() -> None:
    b = tree()
    b.add_joint_force("f", "elbow", lambda _t, q, _v: -ca.sqrt(q))
    model = b.build()
    q = model.neutral()
    q[-1] = -1.0
    for engine in ("lagrangian", "pinocchio", "mujoco"):
        with pytest.raises(mb.errors.NumericalError, match=engine):
            mb.dynamics(model, engine).forward_dynamics(q, np.zeros(model.nv), np.zeros(model.nv))
