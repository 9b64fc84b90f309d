"""Springs and dampers from soft to all but rigid."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mbkit import catalog
from mbkit._check import Array
from mbkit.model import Model, ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import EPS, SWING, powers, register, stable_steps
from mbkit.studies.stress.cases.exact_motions import (
    cart_pole,
    modal,
    released,
    ringing_spring,
    slow_motion,
    slowest_mode,
)

CASES: Final[list[Case]] = []
_case = partial(register, CASES, "stiffness")

_RANGE: Final = (powers(0, 12, 2), (1.0, 1e4, 1e8, 1e12))
#: Of slow motions, measured against Taylor series with 34 digits.
_SLOW_FLOOR: Final = 1e-11


def hinge(stiffness: float, damping: float) -> Model:
    """Return a body of 1 kg m² on a hinge with a spring and a damper, without gravity."""
    b = ModelBuilder("hinge", gravity=(0.0, 0.0, 0.0))
    b.add_body("bob", mass=1.0, com=(0.0, 0.0, -1.0))
    b.add_joint("theta", "continuous", parent="world", child="bob", axis=SWING, stiffness=stiffness, damping=damping)
    return b.build()


def _spring(stiffness: float, damping: float) -> Problem:
    frequency, duration = math.sqrt(stiffness), 1.0
    return Problem(
        hinge(stiffness, damping),
        np.ones(1),
        np.zeros(1),
        duration=duration,
        exact=released(1.0, stiffness, damping / 2),
        floor=4 * EPS * (1 + frequency * duration),
        source="damped oscillator, Landau, Lifshitz 1976, §25",
        facts=_facts(frequency, duration),
    )


def _facts(frequency: float, duration: float, *, damped: bool = False) -> dict[str, float]:
    name = "fastest rate, 1/s" if damped else "fastest frequency, rad/s"
    return {name: frequency, "steps of dop853 at the least": stable_steps(duration, frequency, damped=damped)}


@_case("stiffness", "N m/rad", *_RANGE)
def joint_spring(stiffness: float) -> Problem:
    """A body on a hinge with a spring rings for 1 s: every period of it has to be right."""
    return _spring(stiffness, 0.0)


@_case("stiffness", "N m/rad", *_RANGE)
def lightly_damped_joint_spring(stiffness: float) -> Problem:
    """A body on a hinge rings for 1 s, in which a light damper takes a tenth of it."""
    return _spring(stiffness, 0.2)


@_case("stiffness", "N m/rad", *_RANGE)
def critically_damped_joint_spring(stiffness: float) -> Problem:
    """A body on a hinge with a spring and critical damping comes to rest, the sooner the stiffer."""
    return _spring(stiffness, 2 * math.sqrt(stiffness))


@_case("stiffness", "N m/rad", *_RANGE)
def stiff_joint(stiffness: float) -> Problem:
    """A double pendulum falls from 1 rad with its second joint held straight by a spring and a damper."""
    # M22 - M12²/M11 at the straight pose, which is what the spring moves.
    inertia, g, theta = 0.2, 9.81, 1.0
    frequency = math.sqrt(stiffness / inertia)
    damping = 2 * math.sqrt(stiffness * inertia)
    model = catalog.double_pendulum(gravity=g)
    first, second = model.joints
    held = replace(second, stiffness=np.array([stiffness]), damping=np.array([damping]))
    # The torque that a rigid joint would carry there, at rest.
    torque = inertia * g * math.sin(theta)

    def residual(y: Array, rate: Array) -> Array:
        q1, sigma, v1, rho = y.T
        q2, v2, a1, a2 = sigma / stiffness, rho / stiffness, rate[:, 2], rate[:, 3] / stiffness
        s2, c2 = np.sin(q2), np.cos(q2)
        tip = g * np.sin(q1 + q2)
        return np.stack(
            [
                rate[:, 0] - v1,
                rate[:, 1] - rho,
                (3 + 2 * c2) * a1 + (1 + c2) * a2 - s2 * v2 * (2 * v1 + v2) + 2 * g * np.sin(q1) + tip,
                (1 + c2) * a1 + a2 + s2 * v1 * v1 + tip + sigma + damping / stiffness * rho,
            ],
            axis=-1,
        )

    duration = 1.0
    solved = slow_motion(residual, np.array([theta, torque, 0.0, 0.0]), duration, 100)
    return Problem(
        replace(model, joints=(first, held)),
        np.array([theta, torque / stiffness]),
        np.zeros(2),
        duration=duration,
        exact=lambda t: solved(t)[:, :2] / [1.0, stiffness],
        floor=_SLOW_FLOOR,
        source="collocation in the angle and the spring's torque, Radau IIA of order 15",
        facts=_facts(frequency, duration, damped=True),
    )


def conical(stiffness: float, damping: float) -> tuple[Problem, float]:
    """Return a mass that circles on a point spring of 1 m, without ringing, for 2 s; and its angular velocity.

    The spring's length stays, so its damper is idle. The stiff direction turns in the mass' coordinates.
    """
    g, cosine, sine = 1.0, 0.8, 0.6
    length = 1 + g / (stiffness * cosine)
    turn = math.sqrt(g / (length * cosine))
    b = ModelBuilder("conical_pendulum", gravity=(0.0, 0.0, -g))
    for name, parent, axis in (("x", "world", (1, 0, 0)), ("y", "x", (0, 1, 0)), ("z", "y", (0, 0, 1))):
        b.add_body(name, mass=1.0 if name == "z" else 0.0)
        b.add_joint(name, "prismatic", parent=parent, child=name, axis=axis)
    b.add_spring("cord", body_a="world", body_b="z", stiffness=stiffness, rest_length=1.0, damping=damping)
    radius, height = length * sine, -length * cosine

    def motion(t: Array) -> Array:
        place = [radius * np.cos(turn * t), radius * np.sin(turn * t), np.full(np.shape(t), height)]
        return np.stack(place, axis=-1)

    duration, frequency = 2.0, math.sqrt(stiffness)
    problem = Problem(
        b.build(),
        np.array([radius, 0.0, height]),
        np.array([0.0, turn * radius, 0.0]),
        duration=duration,
        exact=motion,
        # Rounding of the start alone makes the spring ring by as much.
        floor=64 * EPS * length,
        source="conical pendulum: the spring carries weight and centrifugal force",
        scale=radius,
        facts=_facts(frequency, duration, damped=damping > 0),
    )
    return problem, turn


@_case("stiffness", "N/m", *_RANGE)
def point_spring(stiffness: float) -> Problem:
    """A mass circles on a point spring for 2 s and does not ring; the stiff direction turns with it."""
    return conical(stiffness, 0.0)[0]


@_case("stiffness", "N/m", *_RANGE)
def damped_point_spring(stiffness: float) -> Problem:
    """A mass circles on a critically damped point spring for 2 s."""
    return conical(stiffness, 2 * math.sqrt(stiffness))[0]


@_case("stiffness", "N/m", *_RANGE)
def elastic_pendulum(stiffness: float) -> Problem:
    """An elastic pendulum swings from 1 rad for 2 s and hardly rings."""
    return _swinging_spring(stiffness, 0.0)


@_case("stiffness", "N/m", *_RANGE)
def damped_elastic_pendulum(stiffness: float) -> Problem:
    """An elastic pendulum with critical damping along its spring swings from 1 rad for 2 s."""
    return _swinging_spring(stiffness, 2 * math.sqrt(stiffness))


def _swinging_spring(stiffness: float, damping: float) -> Problem:
    """Return an elastic pendulum let go 1 rad from below, stretched as the weight alone would stretch it."""
    g, theta, duration = 1.0, 1.0, 2.0
    force = g * math.cos(theta)

    def residual(y: Array, rate: Array) -> Array:
        angle, sigma, turn, rho = y.T
        length = 1 + sigma / stiffness
        return np.stack(
            [
                rate[:, 0] - turn,
                rate[:, 1] - rho,
                length * rate[:, 2] + 2 * rho / stiffness * turn + g * np.sin(angle),
                rate[:, 3] / stiffness - length * turn**2 - g * np.cos(angle) + sigma + damping / stiffness * rho,
            ],
            axis=-1,
        )

    model = catalog.elastic_pendulum(stiffness=stiffness, gravity=g)
    swing, stretch = model.joints
    solved = slow_motion(residual, np.array([theta, force, 0.0, 0.0]), duration, 200)
    return Problem(
        replace(model, joints=(swing, replace(stretch, damping=np.array([damping])))) if damping else model,
        np.array([theta, force / stiffness]),
        np.zeros(2),
        duration=duration,
        exact=lambda t: solved(t)[:, :2] / [1.0, stiffness],
        floor=_SLOW_FLOOR,
        source="collocation in the angle and the spring's force, Radau IIA of order 15",
        facts=_facts(math.sqrt(stiffness), duration, damped=damping > 0),
    )


@_case("stiffness", "N/m", *_RANGE)
def ringing_elastic_pendulum(stiffness: float) -> Problem:
    """An elastic pendulum turns without gravity for 2 s; its spring rings with the same energy at any stiffness."""
    push, turn, duration = 0.3, 0.5, 2.0
    radius = stiffness / (stiffness - turn**2)
    motion, period = ringing_spring(stiffness, radius, push, turn)
    frequency = 2 * math.pi / period
    return Problem(
        catalog.elastic_pendulum(stiffness=stiffness, gravity=0.0),
        np.array([0.0, radius - 1]),
        np.array([turn, push]),
        duration=duration,
        exact=motion,
        floor=16 * EPS * (1 + frequency * duration) * push / math.sqrt(stiffness) + 1e-13,
        source="central motion by quadrature, Landau, Lifshitz 1976, §14",
        facts=_facts(frequency, duration) | {"amplitude of the ringing, m": push / math.sqrt(stiffness)},
    )


@_case("damping", "N s/m", *_RANGE)
def stiff_damping(damping: float) -> Problem:
    """A cart on a soft spring pulls another one by a damper, for 2 s."""
    b = ModelBuilder("two_carts", gravity=(0.0, 0.0, 0.0))
    b.add_body("first", mass=1.0)
    b.add_body("second", mass=1.0)
    along = (1.0, 0.0, 0.0)
    b.add_joint("x1", "prismatic", parent="world", child="first", axis=along, stiffness=4.0)
    b.add_joint("x2", "prismatic", parent="first", child="second", axis=along, damping=damping)
    M, C, K = np.array([[2.0, 1.0], [1.0, 1.0]]), np.diag([0.0, damping]), np.diag([4.0, 0.0])
    start, duration = np.array([1.0, 0.0]), 2.0
    return Problem(
        b.build(),
        start,
        np.zeros(2),
        duration=duration,
        exact=modal(M, C, K, start, np.zeros(2)),
        floor=16 * EPS,
        source="linear modes with 50 digits",
        facts=_facts(2 * damping, duration, damped=True),
    )


@_case("cart mass", "kg", powers(0, -12, 2), (1.0, 1e-4, 1e-8, 1e-12))
def light_cart_pole(cart: float) -> Problem:
    """A pole falls from the horizontal for 10 s; the lighter the cart, the shorter the jerk below."""
    theta, duration = math.pi / 2, 10.0
    # θ̇ where the pole hangs down.
    peak = math.sqrt(2 * 9.81 * (cart + 1) / cart)
    return Problem(
        catalog.cart_pole(cart_mass=cart),
        np.array([0.0, theta]),
        np.zeros(2),
        duration=duration,
        exact=cart_pole(theta, cart),
        # Found against 40 digits at the lightest cart.
        floor=2e-11,
        source="energy and momentum with a quadrature, IFToMM proposal 'light cart-pole'",
        facts={"fastest rate, 1/s": peak, "cond(M) below": 2 * (1 + cart) / cart},
    )


@_case("bending stiffness", "N m²", powers(5, 15, 2), (1e5, 1e9, 1e13))
def flexible_appendage(stiffness: float) -> Problem:
    """A hub swings slowly on a torsion spring and bends two beams that get stiffer and stiffer."""
    soft, angle, duration = 1000.0, 0.01, 2.0
    model = catalog.flexible_spacecraft(segments=4, bending_stiffness=stiffness)
    hub = replace(model.joints[0], stiffness=np.array([0.0, 0.0, soft]))
    springs = np.array([soft, *(2 * j.stiffness[0] for j in model.joints[1:5])])
    frequency, shape, fastest = slowest_mode(_antisymmetric_inertia(model), springs)

    def motion(t: Array) -> Array:
        bent = np.multiply.outer(np.cos(frequency * t), angle * shape)
        return np.concatenate([np.zeros((len(t), 2)), bent, bent[:, 1:]], axis=1)

    return Problem(
        replace(model, joints=(hub, *model.joints[1:])),
        motion(np.zeros(1))[0],
        np.zeros(model.nv),
        duration=duration,
        exact=motion,
        # What is not linear bends the beams by the angle's square of what the motion bends them.
        floor=angle**3 * float(np.abs(shape[1:]).sum()) ** 2 + 16 * EPS,
        source="slowest linear mode",
        scale=angle,
        facts=_facts(fastest, duration) | {"slowest frequency, rad/s": frequency},
    )


def _antisymmetric_inertia(model: Model) -> Array:
    """Return M of the hub's turn and the bends of one beam, which the other one repeats, about the straight shape."""
    hub, *segments = model.bodies[:5]
    n = len(segments)
    M = np.zeros((n + 1, n + 1))
    M[0, 0] = hub.inertia[2, 2]
    # Distance of each joint, the hub's centre first, and of each segment's centre from the hub's.
    pivots = np.concatenate([[0.0], np.cumsum([j.translation[0] for j in model.joints[1 : n + 1]])])
    for i, body in enumerate(segments, start=1):
        moves = np.where(np.arange(n + 1) <= i, pivots[i] + body.com[0] - pivots, 0.0)
        turns = (np.arange(n + 1) <= i).astype(float)
        M += 2 * (body.mass * np.outer(moves, moves) + body.inertia[2, 2] * np.outer(turns, turns))
    return M
