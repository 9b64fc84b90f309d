"""Springs and dampers from soft to all but rigid, steps around the largest stable one, and many steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit import catalog
from mbkit._check import EPS, Array
from mbkit.model import Model, ModelBuilder
from mbkit.model.validation import sample_mass_matrix
from mbkit.studies import exact_motions as exact_motions
from mbkit.studies.measurement import Problem
from mbkit.studies.stress.case import SWING, Facts, Make, case, motion, powers

_RANGE: Final = (powers(0, 12, 2), (1.0, 1e4, 1e8, 1e12))
_joint = partial(case, "stiffness", "stiffness", "N m/rad", *_RANGE)
_point = partial(case, "stiffness", "stiffness", "N/m", *_RANGE)

#: How far along the imaginary and the negative real axis the 8th order of Dormand and Prince 8(5,3) is stable: its
#: stability polynomial is that of exp to z⁸, with four coefficients of its own behind. From the
#: coefficients in Hairer, Nørsett, Wanner 1993, II.10.
_DOP853: Final = (5.96, 6.39)


def stable_steps(duration: float, frequency: float, *, damped: bool = False) -> float:
    """Return the least number of steps of the explicit Runge-Kutta method with the longest stable one.

    `frequency` is that of the fastest mode, rad/s; of one that decays without turning, its rate, 1/s.
    """
    return max(1.0, float(math.ceil(duration * frequency / _DOP853[damped])))


def _facts(frequency: float, duration: float, *, damped: bool = False) -> Facts:
    name = "fastest rate, 1/s" if damped else "fastest frequency, rad/s"
    return {name: frequency, "steps of dop853 at the least": stable_steps(duration, frequency, damped=damped)}


def _released_hinge(
    stiffness: float, damping: float, duration: float, floor: float, facts: Facts, **more: Any
) -> Problem:
    """Let a body of 1 kg m² on a hinge with a spring and a damper go from 1 rad at rest, without gravity."""
    b = ModelBuilder("hinge", gravity=(0.0, 0.0, 0.0))
    b.add_body("bob", mass=1.0, com=(0.0, 0.0, -1.0))
    b.add_joint("theta", "continuous", parent="world", child="bob", axis=SWING, stiffness=stiffness, damping=damping)
    exact, source = exact_motions.linear([[0.0, 1.0], [-stiffness, -damping]], [1, 0]), "linear motion with 50 digits"
    return motion(b.build(), np.ones(1), 0.0, duration, exact, floor, source, facts=facts, **more)


# Of several decorators the last adds its case first.
@_joint(
    "critically_damped_joint_spring",
    "A body on a hinge with a spring and critical damping comes to rest, the sooner the stiffer.",
    damping=None,
)
@_joint(
    "lightly_damped_joint_spring",
    "A body on a hinge rings for 1 s, in which a light damper takes a tenth of it.",
    damping=0.2,
)
@_joint("joint_spring", "A body on a hinge with a spring rings for 1 s: every period of it has to be right.", damping=0)
def _joint_spring(stiffness: float, damping: float | None) -> Problem:
    """Return 1 s of the hinge; without a damping it is the critical one."""
    frequency = math.sqrt(stiffness)
    damping = 2 * frequency if damping is None else damping
    return _released_hinge(stiffness, damping, 1.0, 4 * EPS * (1 + frequency), _facts(frequency, 1.0))


def _slow(
    model: Model, F: exact_motions.Residual, force: tuple[str, float], stiffness: float, duration: float, facts: Facts
) -> Problem:
    """Return a motion in an angle, from 1 rad, and a coordinate that a spring all but holds, by what that carries."""
    name, carried = force
    solved = exact_motions.slow_motion(F, np.array([1.0, carried, 0.0, 0.0]), duration, round(100 * duration))
    source = f"collocation in the angle and the spring's {name}, Radau IIA of order 15"
    scale = np.array([1.0, stiffness])
    q = np.array([1.0, carried]) / scale
    # The floor is the error by collocation, measured against Taylor series with 34 digits.
    return motion(model, q, 0.0, duration, lambda t: solved(t)[:, :2] / scale, 1e-11, source, facts=facts)


@_joint()
def stiff_joint(stiffness: float) -> Problem:
    """A double pendulum falls from 1 rad with its second joint held straight by a spring and a damper."""
    # M22 - M12²/M11 at the straight pose, which is what the spring moves.
    inertia, g, theta = 0.2, 9.81, 1.0
    damping = 2 * math.sqrt(stiffness * inertia)
    model = catalog.double_pendulum(gravity=g)
    first, second = model.joints
    held = replace(second, stiffness=np.array([stiffness]), damping=np.array([damping]))

    def residual(y: Array, rate: Array) -> Array:
        q1, sigma, v1, rho = y.T
        q2, v2, a1, a2 = sigma / stiffness, rho / stiffness, rate[:, 2], rate[:, 3] / stiffness
        s2, c2, tip = np.sin(q2), np.cos(q2), g * np.sin(q1 + q2)
        upper = (3 + 2 * c2) * a1 + (1 + c2) * a2 - s2 * v2 * (2 * v1 + v2) + 2 * g * np.sin(q1) + tip
        lower = (1 + c2) * a1 + a2 + s2 * v1 * v1 + tip + sigma + damping / stiffness * rho
        return np.stack([rate[:, 0] - v1, rate[:, 1] - rho, upper, lower], axis=-1)

    # The torque that a rigid joint would carry there, at rest.
    torque = "torque", inertia * g * math.sin(theta)
    facts = _facts(math.sqrt(stiffness / inertia), 1.0, damped=True)
    return _slow(replace(model, joints=(first, held)), residual, torque, stiffness, 1.0, facts)


@_point("damped_point_spring", "A mass circles on a critically damped point spring for 2 s.", damped=True)
@_point(
    "point_spring",
    "A mass circles on a point spring for 2 s and does not ring; the stiff direction turns with it.",
    damped=False,
)
def _conical(stiffness: float, damped: bool) -> Problem:
    """Return a mass that circles on a point spring of 1 m, without ringing, for 2 s.

    The spring's length stays, so its critical damper is idle. The stiff direction turns in the mass' coordinates.
    """
    g, cosine, sine, duration, frequency = 1.0, 0.8, 0.6, 2.0, math.sqrt(stiffness)
    length = 1 + g / (stiffness * cosine)
    turn = math.sqrt(g / (length * cosine))
    b = ModelBuilder("conical_pendulum", gravity=(0.0, 0.0, -g))
    for name, parent, axis in (("x", "world", (1, 0, 0)), ("y", "x", (0, 1, 0)), ("z", "y", (0, 0, 1))):
        b.add_body(name, mass=1.0 if name == "z" else 0.0)
        b.add_joint(name, "prismatic", parent=parent, child=name, axis=axis)
    damping = 2 * frequency if damped else 0.0
    b.add_spring("cord", body_a="world", body_b="z", stiffness=stiffness, rest_length=1.0, damping=damping)
    radius, height = length * sine, -length * cosine

    def circle(t: Array) -> Array:
        place = [radius * np.cos(turn * t), radius * np.sin(turn * t), np.full(np.shape(t), height)]
        return np.stack(place, axis=-1)

    q, v = np.array([radius, 0.0, height]), np.array([0.0, turn * radius, 0.0])
    # Rounding of the start alone makes the spring ring by as much.
    floor, facts = 64 * EPS * length, _facts(frequency, duration, damped=damped)
    source = "conical pendulum: the spring carries weight and centrifugal force"
    return motion(b.build(), q, v, duration, circle, floor, source, facts=facts, scale=radius)


@_point(
    "damped_elastic_pendulum",
    "An elastic pendulum with critical damping along its spring swings from 1 rad for 2 s.",
    damped=True,
)
@_point("elastic_pendulum", "An elastic pendulum swings from 1 rad for 2 s and hardly rings.", damped=False)
def _elastic_pendulum(stiffness: float, damped: bool) -> Problem:
    """Return an elastic pendulum let go 1 rad from below, stretched as the weight alone would stretch it."""
    g, theta, duration = 1.0, 1.0, 2.0
    damping = 2 * math.sqrt(stiffness) if damped else 0.0

    def residual(y: Array, rate: Array) -> Array:
        angle, sigma, turn, rho = y.T
        length = 1 + sigma / stiffness
        swing = length * rate[:, 2] + 2 * rho / stiffness * turn + g * np.sin(angle)
        along = rate[:, 3] / stiffness - length * turn**2 - g * np.cos(angle) + sigma + damping / stiffness * rho
        return np.stack([rate[:, 0] - turn, rate[:, 1] - rho, swing, along], axis=-1)

    model = catalog.elastic_pendulum(stiffness=stiffness, gravity=g)
    if damped:
        swing, stretch = model.joints
        model = replace(model, joints=(swing, replace(stretch, damping=np.array([damping]))))
    facts = _facts(math.sqrt(stiffness), duration, damped=damped)
    return _slow(model, residual, ("force", g * math.cos(theta)), stiffness, duration, facts)


@_point()
def ringing_elastic_pendulum(stiffness: float) -> Problem:
    """An elastic pendulum turns without gravity for 2 s; its spring rings with the same energy at any stiffness."""
    push, turn, duration = 0.3, 0.5, 2.0
    radius = stiffness / (stiffness - turn**2)
    exact, period = exact_motions.ringing_spring(stiffness, radius, push, turn)
    frequency, amplitude = 2 * math.pi / period, push / math.sqrt(stiffness)
    floor = 16 * EPS * (1 + frequency * duration) * push / math.sqrt(stiffness) + 1e-13
    facts = _facts(frequency, duration) | {"amplitude of the ringing, m": amplitude}
    model, q, v = catalog.elastic_pendulum(stiffness=stiffness, gravity=0.0), [0.0, radius - 1], [turn, push]
    source = "central motion by quadrature, Landau, Lifshitz 1976, §14"
    return motion(model, q, v, duration, exact, floor, source, facts=facts)


@case("stiffness", "damping", "N s/m", *_RANGE)
def stiff_damping(damping: float) -> Problem:
    """A cart on a soft spring pulls another one by a damper, for 2 s."""
    b, along = ModelBuilder("two_carts", gravity=(0.0, 0.0, 0.0)), (1.0, 0.0, 0.0)
    b.add_body("first", mass=1.0)
    b.add_body("second", mass=1.0)
    b.add_joint("x1", "prismatic", parent="world", child="first", axis=along, stiffness=4.0)
    b.add_joint("x2", "prismatic", parent="first", child="second", axis=along, damping=damping)
    # q̈ = -M⁻¹ (K q + C q̇), M = [[2, 1], [1, 1]].
    rates = np.array([[0, 0, 1, 0], [0, 0, 0, 1], [-4, 0, 0, damping], [4, 0, 0, -2 * damping]])
    exact, facts = exact_motions.linear(rates, [1, 0, 0, 0]), _facts(2 * damping, 2.0, damped=True)
    return motion(b.build(), [1.0, 0.0], 0.0, 2.0, exact, 16 * EPS, "linear motion with 50 digits", facts=facts)


@case("stiffness", "cart mass", "kg", powers(0, -12, 2), (1.0, 1e-4, 1e-8, 1e-12))
def light_cart_pole(cart: float) -> Problem:
    """A pole falls from the horizontal for 10 s; the lighter the cart, the shorter the jerk below."""
    theta = math.pi / 2
    # θ̇ where the pole hangs down.
    peak = math.sqrt(2 * 9.81 * (cart + 1) / cart)
    facts = {"fastest rate, 1/s": peak, "cond(M) below": 2 * (1 + cart) / cart}
    source = "energy and momentum with a quadrature, IFToMM proposal 'light cart-pole'"
    # The error was measured against 40 digits at the lightest cart.
    exact, floor = exact_motions.cart_pole(theta, cart), 2e-11
    return motion(catalog.cart_pole(cart_mass=cart), [0.0, theta], 0.0, 10.0, exact, floor, source, facts=facts)


@case("stiffness", "bending stiffness", "N m²", powers(5, 15, 2), (1e5, 1e9, 1e13))
def flexible_appendage(stiffness: float) -> Problem:
    """A hub swings slowly on a torsion spring and bends two beams that get stiffer and stiffer."""
    soft, angle, duration = 1000.0, 0.01, 2.0
    model = catalog.flexible_spacecraft(segments=4, bending_stiffness=stiffness)
    hub = replace(model.joints[0], stiffness=np.array([0.0, 0.0, soft]))
    springs = np.array([soft, *(2 * j.stiffness[0] for j in model.joints[1:5])])
    # The hub's turn, and the bends of one beam, which the other one repeats, about the straight shape.
    free = np.vstack([np.zeros((2, 5)), np.eye(5), np.eye(5)[1:]])
    M = free.T @ sample_mass_matrix(model, model.neutral()) @ free
    frequency, shape, fastest = exact_motions.slowest_mode(M, springs)

    def exact(t: Array) -> Array:
        return np.multiply.outer(np.cos(frequency * t), angle * (free @ shape))

    # Terms beyond the linear ones bend the beams by the square of the angle, relative to the motion.
    floor = angle**3 * float(np.abs(shape[1:]).sum()) ** 2 + 16 * EPS
    facts = _facts(fastest, duration) | {"slowest frequency, rad/s": frequency}
    model, start = replace(model, joints=(hub, *model.joints[1:])), exact(np.zeros(1))[0]
    return motion(model, start, 0.0, duration, exact, floor, "slowest linear mode", facts=facts, scale=angle)


# The step at which linear theory lets a method break on q̈ + 2 ζ ω q̇ + ω² q = 0.
#
# With x = ω h the amplification of a step has the characteristic polynomials, stable where both roots are within the
# unit circle (Jury 1964; for Runge-Kutta methods Hairer, Wanner 1996, IV.2)
#
# - semi-implicit Euler, v⁺ = v + h a(q, v): λ² - (2 - 2ζx - x²) λ + 1 - 2ζx; at λ = -1, x² + 4ζx = 4
# - the same with the damper implicit: (1 + 2ζx) λ² - (2 + 2ζx - x²) λ + 1; at λ = -1, x² - 4ζx = 4
# - Runge-Kutta of order 4 in 4 stages: λ = 1 + z + z²/2 + z³/6 + z⁴/24 at both roots z of z² + 2ζx z + x²
# - Gauss's, the midpoint rule, and Euler with damper and spring implicit: every x.


_EXPLICIT: Final = ("semi_implicit_euler", "mujoco_euler")
_DAMPER_IMPLICIT: Final = ("mujoco_implicit", "mujoco_implicitfast")
_UNLIMITED: Final = ("implicit_midpoint", "gauss4", "gauss6", "mujoco_discrete")
_FIXED: Final = ("rk4", "mujoco_rk4", *_EXPLICIT, *_DAMPER_IMPLICIT, *_UNLIMITED)


def largest_step(_engine: str, method: str, *, frequency: float, damping: float) -> float | None:
    """Return the largest stable step, s, at ω and ζ (0, or at least 1); infinite where none, None without a step."""
    if method in _EXPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) - damping) / frequency
    if method in _DAMPER_IMPLICIT:
        return 2 * (math.sqrt(damping**2 + 1) + damping) / frequency
    if method in ("rk4", "mujoco_rk4"):
        # Its limits on the imaginary and on the negative real axis; the second is the root of 24 + 12 z + 4 z² + z³.
        if damping == 0:
            return 2 * math.sqrt(2) / frequency
        return 2.785293563405282 / (frequency * (damping + math.sqrt(damping**2 - 1)))
    return math.inf if method in _UNLIMITED else None


#: Enough for a growth of a fifth a step to pass any bar; few enough for slow evaluations.
_STEPS: Final = 200
# Steps close to either side of what theory says of one of the methods, and coarse ones elsewhere.
_AROUND: Final = (0.1, 1.0, 1.4, 1.7, 1.9, 2.1, 2.4, 2.7, 3.0, 4.0, 10.0, 100.0, 1000.0)
_AROUND_CRITICAL: Final = (0.1, 0.4, 0.78, 0.88, 1.4, 2.0, 2.6, 3.0, 4.0, 4.6, 5.1, 10.0, 100.0, 1000.0)
_AROUND_OVER: Final = (0.1, 1.0, 1.4, 1.85, 2.1, 2.4, 2.65, 3.0, 10.0, 50.0, 190.0, 215.0, 1000.0)
#: ω and ζ of an overdamped spring: its damper alone has the rate 1/s.
_OVER: Final = (0.1, 5.0)


def _step(
    values: tuple[float, ...], quick: tuple[float, ...], oscillator: tuple[float, float], *named: str, **numbers: Any
) -> Callable[[Make], Make]:
    """Return the decorator of a case whose linear theory is that of an oscillator with this ω and ζ."""
    why = "the test is for growth, not accuracy: a stable run stays near its start, an unstable one grows in each step"
    theory = partial(largest_step, frequency=oscillator[0], damping=oscillator[1])
    numbers |= {"bar": 100.0, "why": why, "methods": _FIXED, "theory": theory}
    return case("step", "step", "s", values, quick, *named, **numbers)


@_step(
    *(_AROUND_OVER, (1.85, 2.1, 2.65, 3.0, 190.0, 215.0), _OVER, "step_overdamped"),
    "A body on a spring with a strong damper, whose rates are 0.99 and 0.01 /s, 200 steps.",
    numbers=_OVER,
)
@_step(
    *(_AROUND_CRITICAL, (0.78, 0.88, 2.6, 3.0, 4.6, 5.1, 100.0), (1.0, 1.0), "step_critically_damped"),
    "A body on a critically damped spring of 1 rad/s, 200 steps.",
    numbers=(1.0, 1.0),
)
@_step(
    *(_AROUND, (1.0, 1.9, 2.1, 2.7, 3.0, 100.0), (1.0, 0.0), "step_oscillator"),
    "A body on a spring of 1 rad/s, 200 steps.",
    numbers=(1.0, 0.0),
)
def _hinge_steps(step: float, numbers: tuple[float, float]) -> Problem:
    frequency, damping = numbers
    duration, facts = _STEPS * step, {"fastest frequency, rad/s": frequency}
    if damping:
        facts = {"fastest rate, 1/s": frequency * (damping + math.sqrt(damping**2 - 1))}
    floor = 16 * EPS * (1 + duration)
    return _released_hinge(frequency**2, 2 * damping * frequency, duration, floor, facts, dt=step)


@_step(tuple(1e-3 * x for x in _AROUND[:-1]), tuple(1e-3 * x for x in (1.0, 1.9, 2.1, 2.7, 3.0, 10.0)), (1e3, 0.0))
def step_point_spring(step: float) -> Problem:
    """A mass that circles on a point spring of 1000 rad/s, 200 steps."""
    facts = {"fastest frequency, rad/s": 1e3}
    return replace(_conical(1e6, damped=False), duration=_STEPS * step, dt=step, facts=facts)


# Many steps, and whether the energy stays

#: RK4 drifts over the bar between a million steps and ten, the midpoint rule never does.
_STEP: Final = 4e-3


@case(
    *("long", "steps", "", powers(3, 7), (1e3, 1e4, 1e5)),
    measure="energy",
    bar=1e-3,
    why="along a chaotic motion only conserved quantities can be compared; a thousandth of the energy is half a "
    "thousandth of the speed, which no plot shows",
    methods=(*_FIXED, "rk853", "taylor", "auto"),
    patience=6.0,
)
def long_run(count: float) -> Problem:
    """A double pendulum, chaotic from (2, 1) rad at rest, for ever more steps of 4 ms."""
    model, start, duration = catalog.double_pendulum(), np.array([2.0, 1.0]), count * _STEP
    return Problem(model, start, np.zeros(2), duration=duration, dt=_STEP, facts={"duration, s": duration})
