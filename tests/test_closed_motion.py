"""Motions of the textbook's systems: on paper, of bodies in every engine, and in closed form, one and the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath as mp
import numpy as np
import pytest
import sympy as sp
from scipy.spatial.transform import Rotation
from scipy.special import mathieu_a

import mbkit as mb
from mbkit.lagrangian import Lagrangian, systems
from mbkit.lagrangian.system import QuasiLagrangian
from tests import twins
from tests.twins import TWINS, paper
from validation import closed_forms, elliptic, motions, quadrature, textbook

INTERPRETED = {"compile": False}
#: What an eighth-order method leaves of 13 digits a step, over some hundred steps.
CLOSE = 1e-12
ENGINES = ("lagrangian", "pinocchio", "mujoco")

Pair = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Known:
    """A motion of a twin whose course is known.

    `exact` takes times and gives positions and velocities on paper, or if `bodily` the model's. `torque` is
    held, on paper's coordinates, which are the model's then. `more` names other forms of the paper's equations.
    """

    twin: str
    q: tuple[float, ...]
    v: tuple[float, ...]
    duration: float
    exact: Callable[[np.ndarray], Pair]
    bodily: bool = False
    torque: tuple[float, ...] | None = None
    more: tuple[str, ...] = ()


def spin(told: elliptic.Spin) -> Pair:
    return told.q, told.w


def top(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    form = twins.TOP
    thin = form["across"] - form["mass"] * form["length"] ** 2
    start = Rotation.from_matrix(twins.attitude(q)).as_quat()
    w0 = twins.body_rates(q) @ v
    return spin(elliptic.heavy_top(t, form["mass"], thin, form["axial"], (0.0, 0.0, form["length"]), w0, start))


def turning(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    start = Rotation.from_matrix(twins.attitude(q)).as_quat()
    return spin(elliptic.free_body(t, twins.BODY, twins.body_rates(q) @ v, start))


def dual_spin(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    """Where the wheel is, too: its rate stays."""
    R, w = motions.dual_spin(t, twins.DUAL_SPIN, twins.attitude(q), twins.body_rates(q) @ v[:3], v[3])
    c = twins.DUAL_SPIN.com
    turned = np.column_stack([-R @ c, Rotation.from_matrix(R).as_quat(), q[3] + v[3] * t])
    return turned, np.column_stack([-np.cross(w, c), w, np.full(len(t), v[3])])


def kepler(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    return textbook.Kepler.of(1.7 / 3.0, *q, *v).at(t)


def spherical(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    return tuple(x[:, ::-1] for x in elliptic.SphericalPendulum(q[0], *v, length=0.8).angles(t))


def two_links(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    """Return the double pendulum without weight, in angles from the vertical."""
    m1, m2, l1, l2 = 0.7, 1.0, 1.0, 0.6
    told = motions.elbow(
        t, (q[0], q[1] - q[0]), (v[0], v[1] - v[0]), (m1 + m2) * l1**2 + m2 * l2**2, m2 * l2**2, m2 * l1 * l2
    )
    return tuple(np.cumsum(x, axis=1) for x in told)


def acrobot(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    # About the hinges.
    I1, I2 = 0.083 + 0.5**2, 0.33 + 1.0
    return motions.elbow(t, q, v, I1 + I2 + 1.0, I2, 1.0)


def piston(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    return motions.pushed_piston(t, q[0], v[0], 3.0, twins.PISTON)


def crank(t: np.ndarray) -> Pair:
    told = np.array([(0.0, 0.0), *(twins.CRANK.from_rest(x, 0.1) for x in t[1:])])
    return told[:, :1], told[:, 1:]


def arsinh(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    x, u = motions.damped(t, np.sinh(q[0]), np.cosh(q[0]) * v[0], 4.0, 0.3)
    return np.arcsinh(x), u / np.sqrt(1 + x**2)


def absolute(system: closed_forms.System, S: np.ndarray, **given: Any) -> Callable[..., Pair]:
    """Return the motion of a system in q' = S q, integrated."""

    def told(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
        out = motions.of_system(system, t, S @ q, S @ v, **given)
        return tuple(x @ np.linalg.inv(S).T for x in out)

    return told


def driven(t: np.ndarray, q: tuple[float, ...], v: tuple[float, ...]) -> Pair:
    form = textbook.Kapitza(**twins.KAPITZA)
    y = motions.integrated(lambda now, y: np.array([y[1], form.acceleration(now, y[0])]), t, [*q, *v])
    return y[:, :1], y[:, 1:]


def known(twin: str, q: tuple[float, ...], v: tuple[float, ...], duration: float, exact: Any, **more: Any) -> Known:
    return Known(twin, q, v, duration, lambda t: exact(t, q, v), **more)


RELATIVE = np.array([[1.0, 0.0], [-1.0, 1.0]])
ONE = np.eye(2)
KNOWN = {
    "pendulum": known(
        "pendulum", (1.0,), (0.5,), 2.0, lambda t, q, v: elliptic.pendulum(t, *q, *v, 1.3), more=("hamilton",)
    ),
    "double pendulum without weight": known("weightless double_pendulum", (0.3, 1.0), (0.9, -0.4), 2.0, two_links),
    "double pendulum": known(
        "double_pendulum", (1.0, 0.4), (0.0, 0.5), 0.6,
        absolute(closed_forms.double_pendulum(1.0, 0.7, 0.6, 1.0), RELATIVE),
    ),
    "rods": known(
        "rods", (0.7, 0.4, -0.3), (0.1, 0.5, 0.0), 0.7, absolute(closed_forms.chain(3), np.eye(3) - np.eye(3, k=-1))
    ),
    "elastic pendulum along the vertical": known(
        "elastic_pendulum", (0.0, 0.1), (0.0, -0.6), 1.5,
        lambda t, q, v: motions.stretched(t, q[1], v[1], 1.0, 30.0),
    ),
    "elastic pendulum without weight": known(
        "weightless elastic_pendulum", (0.2, 0.1), (1.9, 0.3), 1.0,
        lambda t, q, v: motions.elastic(t, q, v, 0.8, 1.0, 30.0),
    ),
    "elastic pendulum": known(
        "elastic_pendulum", (0.8, 0.1), (0.5, -0.6), 1.0, absolute(textbook.elastic_pendulum(0.8, 1.0, 30.0), ONE)
    ),
    "spherical pendulum": known("spherical_pendulum", (0.9, 0.0), (0.3, 1.5), 1.5, spherical, more=("routh",)),
    "cart-pole under a force": known(
        "cart_pole", (0.2, 2.0), (0.3, -1.0), 1.0,
        lambda t, q, v: motions.cart_pole(t, q, v, 1.0, 0.3, 1.0, 0.7, 9.81), torque=(0.7, 0.0), more=("hamilton",),
    ),
    "acrobot without weight": known("weightless acrobot", (0.3, 1.0), (0.9, -0.4), 2.0, acrobot),
    "acrobot under a torque": known(
        "acrobot", (0.4, 0.8), (0.0, 0.5), 1.0, absolute(textbook.acrobot(), ONE, tau=[0.0, 2.0]), torque=(0.0, 2.0)
    ),
    "Furuta pendulum": known(
        "furuta_pendulum", (0.1, 0.5), (2.0, 3.0), 0.6,
        lambda t, q, v: motions.furuta_pendulum(t, q, v, 0.25, 4e-3, 0.1, 0.15, 7e-4),
    ),
    "Kepler": known("kepler", (0.7, 0.4), (0.3, 1.5), 5.0, kepler, more=("routh",)),
    "bead on a hoop": known(
        "bead_on_hoop", (0.7,), (1.5,), 1.0,
        lambda t, q, v: motions.bead_on_hoop(t, *q, *v, textbook.BeadOnHoop(0.5, 6.0, 0.7)),
    ),
    "Kapitza's pendulum upright": known("driven_pendulum", (3.0,), (0.4,), 0.06, driven),
    "piston under a force": known("slider_crank", (1.2,), (8.0,), 0.25, piston),
    "crank under a torque": Known("rigid_slider_crank", (0.0,), (0.0,), 0.25, crank),
    "damped vibration": known("one_degree", (0.9,), (-0.5,), 3.0, arsinh),
    "masses on springs": known(
        "masses on springs", (0.1, -0.2, 0.5, 0.3), (1.0, 0.0, -0.4, 0.2), 2.0,
        lambda t, q, v: motions.spring_chain(t, q, v, **twins.SPRINGS),
    ),
    "block with friction": known(
        "sliding_block", (0.0,), (0.1,), 2.0, lambda t, _, v: motions.sliding_block(t, v[0], 0.5, 0.3, 0.4)
    ),
    "fall through air": known(
        "falling_body", (0.3,), (6.0,), 1.5, lambda t, q, v: motions.thrown_upwards(t, *q, *v, 2.0, 0.5)
    ),
    "thruster": known(
        "thruster", (0.1, -0.2, 0.4), (0.5, 0.0, 0.3), 2.0,
        lambda t, q, v: motions.thruster(t, q, v, **twins.THRUSTER),
    ),
    "heavy top": known(
        "heavy_top", (0.1, 0.6, 0.2), (0.5, -0.2, 12.0), 1.0, top, bodily=True, more=("quasi", "routh", "hamilton")
    ),
    "rigid body": known("rigid_body", (0.1, 0.9, 0.2), (0.5, 1.0, 2.0), 1.5, turning, bodily=True),
    "gyroscope": known(
        "gyroscope", (0.1, 0.3, 0.2), (2.0, -1.0, 60.0), 0.15,
        lambda t, q, v: motions.gyroscope(t, q, v, textbook.Gyroscope()), more=("quasi", "routh"),
    ),
    "spacecraft with a wheel": known(
        "spacecraft", (0.1, 0.9, 0.2, 0.0), (0.5, 1.0, 2.0, 30.0), 1.0, dual_spin, bodily=True
    ),
    "flexible spacecraft": known(
        "flexible_spacecraft", (0.1, 0.2, 0.3, 0.2, -0.3), (0.1, 0.2, 0.5, 1.0, -1.0), 0.6,
        absolute(textbook.flexible_spacecraft(**twins.FLEXIBLE, hub_inertia=0.3), np.eye(5)),
    ),
}  # fmt: skip

# On paper, in the own derivation, and in the others in turn.
WAYS = [
    (name, way)
    for k, (name, motion) in enumerate(KNOWN.items())
    for way in ("paper", *motion.more, ENGINES[0], ENGINES[1 + k % 2])
]


@cache
def course(name: str) -> tuple[np.ndarray, Pair]:
    """Return times, and the model's coordinates and velocities at them in closed form."""
    motion = KNOWN[name]
    times = np.linspace(0.0, motion.duration, 4)
    exact = motion.exact(times)
    return times, exact if motion.bodily else on_bodies(motion, times, exact)


def on_bodies(motion: Known, times: np.ndarray, told: Pair) -> Pair:
    """Return the model's states where the paper has these."""
    twin = TWINS[motion.twin]
    states = list(zip(*told, times, strict=True))
    return np.array([twin.place(q, t) for q, _, t in states]), np.array([twin.velocity(*state) for state in states])


def quasi(name: str) -> QuasiLagrangian:
    """Return a system in body rates: Euler's angles', or those of the gyroscope's rotor in the inner gimbal's axes."""
    if name == "heavy_top":
        # Weight and reach stand in one product, m g l, which one letter may mean.
        given = {**twins.TOP, "mass": 9.81 * twins.TOP["mass"] * twins.TOP["length"]}
        few = systems.heavy_top(**given).substituted(dict.fromkeys(sp.symbols("l g"), 1))
        return few.quasi_velocities(twins.by_body_rates(few))
    lag = paper(name)
    # The inner gimbal is flat, as a ring is: C_i = A_i + B_i. So four numbers are all that T and V hold.
    be, (u, w, r) = lag.coordinates[1], lag.velocities
    P, J, C, k = sp.symbols("P J C k")
    form, s, c = textbook.Gyroscope(), sp.sin(be), sp.cos(be)
    T = (P * (w**2 + u**2 * c**2) + J * u**2 + C * (r + u * s) ** 2) / 2
    hinge, axial, _ = form.inner_inertia
    values = {P: form.across + hinge, J: form.outer_inertia + axial, C: form.rotor_axial, k: form.moment}
    few = Lagrangian(T, k * s, lag.coordinates, lag.velocities, parameters=values)
    return few.quasi_velocities(sp.Matrix([[0, 0, 1 / c], [1, 0, 0], [0, 1, -s / c]]))


def run(motion: Known, way: str, times: np.ndarray) -> Pair:
    """Return the model's coordinates and velocities along the motion, found in one of the ways."""
    twin, lag = TWINS[motion.twin], paper(motion.twin)
    q, v = np.array(motion.q), np.array(motion.v)
    torque = np.zeros(len(q)) if motion.torque is None else np.array(motion.torque)

    def simulated(dyn: Any, q: Any, v: Any, torque: Any = None) -> Any:
        return mb.simulate(dyn, q, v, motion.duration, "rk853", rtol=1e-13, save=times, torque=torque)

    if way in ENGINES:
        dyn = mb.dynamics(twin.model(), way, **(INTERPRETED if way == "lagrangian" else {}))
        acting = [f for f in (twin.force, twin.drive) if f]
        held = (lambda t, q, v: sum(f(dyn, t, q, v) for f in acting)) if acting else motion.torque
        out = simulated(dyn, twin.place(q, 0.0), twin.velocity(q, v), held)
        return out.q, out.v
    if way == "paper":
        out = simulated(lag.dynamics(options=INTERPRETED), q, v, torque)
        told = out.q, out.v
    elif way == "quasi":
        other = quasi(motion.twin)
        out = simulated(other.dynamics(options=INTERPRETED), q, other.to_quasi_velocity(q, v))
        told = out.q, other.to_velocity(out.q, out.v)
    elif way == "routh":
        routhian = lag.routhian()
        start = routhian.reduce(q, v)
        reduced = simulated(routhian.lagrangian.dynamics(options=INTERPRETED, **start.values), start.q, start.v)
        out = routhian.reconstruct(reduced, q)
        told = out.q, out.v
    else:
        h, n = lag.hamiltonian(), len(q)
        y = motions.integrated(h.field(torque), times, np.concatenate([q, h.to_momentum(q, v)]))
        told = y[:, :n], np.array([h.to_velocity(x[:n], x[n:]) for x in y])
    return on_bodies(motion, times, told)


@pytest.mark.thorough(every=9)
@pytest.mark.parametrize(("name", "way"), WAYS)
def test_motion_is_the_known_one(name: str, way: str) -> None:
    """In every engine and every form of the equations, to what thirteen digits a step add up to."""
    times, (q0, v0) = course(name)
    q, v = run(KNOWN[name], way, times)
    if q.shape[1] > v.shape[1]:
        # A quaternion and its negative are one attitude.
        first = 3 if q.shape[1] > 4 else 0
        four = slice(first, first + 4)
        q0 = q0.copy()
        q0[:, four] *= np.sign(np.sum(q[:, four] * q0[:, four], axis=1))[:, None]
    assert np.abs(q - q0).max() <= CLOSE * max(1.0, float(np.abs(q0).max()))
    assert np.abs(v - v0).max() <= CLOSE * max(1.0, float(np.abs(v0).max()))


def test_quadrature_is_the_elliptic_functions() -> None:
    """The two oracles, on a pendulum and on a spherical one; what neither can do is refused."""
    t, one = np.array([0.0, 3.0, 10.0]), mp.mpf(1)
    swing = quadrature.Swing(lambda _: one, lambda x: -mp.mpf(9.81) * mp.cos(x), 0.3, -4.0)
    # The phase of a hundred radians is rounded in both.
    for told, exact in zip(swing.at(t), elliptic.pendulum(t, 0.3, -4.0), strict=True):
        assert told == pytest.approx(exact[:, 0], abs=5e-14)
    told = quadrature.one_cyclic(
        t, (0.0, 0.9), (1.5, 0.3), lambda x: mp.sin(x) ** 2, lambda _: 0 * one, lambda _: one,
        lambda x: -mp.mpf(9.81) * mp.cos(x),
    )  # fmt: skip
    for mine, exact in zip(told, elliptic.SphericalPendulum(0.9, 0.3, 1.5).angles(t), strict=True):
        assert mine == pytest.approx(exact, abs=5e-14)
    for start, speed, why in ((0.3, 0.0, "moves"), (0.0, 7.0, "turns round")):
        with pytest.raises(ValueError, match=why):
            quadrature.Swing(swing.inertia, swing.potential, start, speed).at(t)


def test_upright_is_stable_above_mathieus_threshold() -> None:
    """x'' + (A - 2 Q cos 2τ) x = 0 about the upright, A = -4 g/(l Ω²), Q = 2 a/l: stable where A > a₀(Q).

    Abramowitz, Stegun 1964, ch. 20. The average of fast shaking has a₀ = -Q²/2, whence a² Ω² > 2 g l.
    """
    a, ell, size = 0.1, 0.8, 1e-5
    edge = np.sqrt(-4 * 9.81 / (ell * mathieu_a(0, 2 * a / ell)))
    assert edge == pytest.approx(np.sqrt(2 * 9.81 * ell) / a, rel=0.02), "the averaged one"
    for rate, stable in ((0.99 * edge, False), (edge, None), (1.01 * edge, True)):
        lag = systems.driven_pendulum(length=ell, amplitude=a, frequency=rate)
        period = 2 * np.pi / rate
        start = np.array([[np.pi + size], [np.pi]]), np.array([[0.0], [size * rate]])
        dyn = lag.dynamics(options=INTERPRETED)
        out = mb.simulate(dyn, *start, period, "rk853", rtol=1e-13, save=[0.0, period])
        half = (out.q[0, -1, 0] - np.pi + out.v[1, -1, 0] / rate) / (2 * size)
        exact = textbook.Kapitza(ell, a, rate)
        assert half == pytest.approx(motions.half_trace(exact, np.pi), abs=1e-9)
        # Rounding of π and the cube of the size are left.
        assert abs(half) == pytest.approx(1.0, abs=1e-8) if stable is None else (abs(half) < 1) == stable


@pytest.mark.parametrize(("rate", "stays"), [(150.0, True), (60.0, False)])
def test_shaken_pendulum_stands_or_falls(rate: float, stays: bool) -> None:
    """Let go beside the upright, for some of the slow periods: as the average says."""
    form = textbook.Kapitza(0.8, 0.05, rate)
    assert form.upright_is_stable == stays
    lag = systems.driven_pendulum(length=0.8, amplitude=0.05, frequency=rate)
    out = mb.simulate(lag.dynamics(options=INTERPRETED), [3.0], [0.0], 1.2, "rk4", dt=2 * np.pi / rate / 16)
    aside = np.abs(out.q - np.pi).max()
    # The shaking adds a share a/l to the slow swing.
    assert aside < (np.pi - 3.0) * 1.1 if stays else aside > 1.0
