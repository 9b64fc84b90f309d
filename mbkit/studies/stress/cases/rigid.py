"""Cases without springs: mass ratios, long chains, fast turns, singular poses, friction, large and small numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Final

import mpmath as mp
import numpy as np

from mbkit import catalog, lagrangian
from mbkit._check import EPS, Array
from mbkit.load import load
from mbkit.model import Body, Model, ModelBuilder
from mbkit.studies import exact_motions as exact_motions
from mbkit.studies.exact_motions import Exact
from mbkit.studies.measurement import Problem
from mbkit.studies.stress.case import SWING, Facts, case, motion, powers, terms_at

# Heavy beside light: masses that differ along a chain, and in a robot's hand

_masses = partial(case, "mass ratio")

_UP: Final = (powers(0, 9), (1.0, 1e3, 1e6, 1e9))
_DOWN: Final = (powers(0, -9), (1.0, 1e-3, 1e-6, 1e-9))
_UPWARD: Final = ("last over first mass", "", *_UP)
_DOWNWARD: Final = ("last over first mass", "", *_DOWN)
_LOADED: Final = ("load", "kg", *_UP)
_TERMS: Final[dict[str, Any]] = {"measure": "terms", "terms": True}


def rods(name: str, masses: Sequence[float], load_mass: float = 0.0) -> Model:
    """Return thin rods of 1 m, hinged end to end, with a point mass at the last end."""
    b = ModelBuilder(name)
    for i, mass in enumerate(masses, start=1):
        across = mass / 12
        parent = f"rod{i - 1}" if i > 1 else "world"
        b.add_body(f"rod{i}", mass=mass, com=(0.0, 0.0, -0.5), inertia=(across, across, 0.0))
        place = (0.0, 0.0, -1.0 if i > 1 else 0.0)
        b.add_joint(f"theta{i}", "continuous", parent=parent, child=f"rod{i}", axis=SWING, translation=place)
    if load_mass:
        b.add_body("load", mass=load_mass)
        b.add_joint("hold", "fixed", parent=f"rod{len(masses)}", child="load", translation=(0.0, 0.0, -1.0))
    return b.build()


def _facts(model: Model) -> Facts:
    masses = [body.mass for body in model.bodies if body.mass > 0]
    return {"heaviest over lightest body": max(masses) / min(masses)}


def _terms(model: Model) -> Problem:
    return terms_at(model, facts=_facts(model))


@_masses(
    *(*_LOADED, "loaded_arm_terms", "Terms of an arm of three rods of 1 kg with a load at its end."), arm=True, **_TERMS
)
@_masses(
    *(*_LOADED, "loaded_arm", "A taut arm of three rods of 1 kg swings from 0.5 rad for 1 s with a load at its end."),
    arm=True,
)
@_masses(*_DOWNWARD, "light_tip_terms", "Terms of a chain of five rods, each lighter than the one above.", **_TERMS)
@_masses(
    *(*_DOWNWARD, "light_tip", "A chain of five rods, each lighter than the one above, swings from 0.5 rad for 1 s."),
    taut=False,
)
@_masses(*_UPWARD, "heavy_tip_terms", "Terms of a chain of five rods, each heavier than the one above.", **_TERMS)
@_masses(
    *_UPWARD, "heavy_tip", "A taut chain of five rods, each heavier than the one above, swings from 0.5 rad for 1 s."
)
def _chain(value: float, *, arm: bool = False, terms: bool = False, taut: bool = True) -> Problem:
    """Return an arm with a load, or five rods, each by the same factor heavier than the one before.

    Unless its terms are asked for, it is let go at rest, its first rod half a radian from below, for 1 s.
    """
    masses, load_mass = ([1.0, 1.0, 1.0], value) if arm else ([value ** (i / 4 - 0.5) for i in range(5)], 0.0)
    model = rods("loaded_arm" if arm else "graded_chain", masses, load_mass)
    if terms:
        return _terms(model)
    chain, angle = exact_motions.HangingChain(masses, load_mass), 0.5
    q = chain.taut(angle) if taut else np.array([angle, *[0.0] * (len(masses) - 1)])
    source = "collocation in angles from the vertical, Radau IIA of order 15"
    # The error was measured against Taylor series with 34 digits.
    return motion(model, q, 0.0, 1.0, chain.motion(q, 1.0), 1e-11, source, facts=_facts(model))


@_masses(*_LOADED, measure="terms")
def hand_load(mass: float) -> Problem:
    """Terms of Panda, of 17 kg, with a load in its hand."""
    model = load("panda")
    grip = model.frame("panda_hand_tcp")
    hand = next(body for body in model.bodies if body.name == grip.body)
    apart, total = grip.translation - hand.com, hand.mass + mass
    # Steiner's theorem for the hand and a point mass about their common centre.
    spread = hand.mass * mass / total * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    com = hand.com + mass / total * apart
    return _terms(_with(model, replace(hand, mass=total, com=com, inertia=hand.inertia + spread)))


@_masses("part of the fingers' mass", "", *_DOWN, measure="terms")
def light_finger(factor: float) -> Problem:
    """Terms of Panda whose fingers get lighter and lighter."""
    model = load("panda")
    fingers = [body for body in model.bodies if body.name.endswith("finger")]
    return _terms(_with(model, *(replace(b, mass=factor * b.mass, inertia=factor * b.inertia) for b in fingers)))


def _with(model: Model, *changed: Body) -> Model:
    by_name = {body.name: body for body in changed}
    return replace(model, bodies=tuple(by_name.get(body.name, body) for body in model.bodies))


#: Heaviest over lightest body -> the robot of example-robot-data.
_ROBOTS: Final = {45.0: "ur5", 330.0: "panda", 650.0: "talos_full", 3000.0: "pr2", 6500.0: "alex_psyonic_hands"}


@_masses("heaviest over lightest body", "", tuple(_ROBOTS), (45.0, 330.0, 6500.0), measure="terms")
def robots_as_found(ratio: float) -> Problem:
    """Terms of robots as their files have them: ur5, panda, talos_full, pr2, alex_psyonic_hands."""
    return _terms(load(_ROBOTS[min(_ROBOTS, key=lambda known: abs(known - ratio))]))


# Chains from short to long

_LENGTHS: Final = tuple(2.0**k for k in range(1, 9))


def straight_inertia(n: int) -> Array:
    """Return M of a straight chain of n thin rods of 1 kg and 1 m, in angles from rod to rod.

    A turn of joint j moves rod i ≥ j as a whole: M_jk = Σ over the rods i ≥ j, k of (i - j + ½)(i - k + ½) + 1/12.
    """
    bodies, joints = np.arange(n)[:, None], np.arange(n)
    arms = np.where(bodies >= joints, bodies - joints + 0.5, 0.0)
    return np.asarray(arms.T @ arms + (n - np.maximum.outer(joints, joints)) / 12)


# The longest take a minute to derive, with 34 digits.
@case("length", "rods", "", _LENGTHS, (2.0, 8.0, 32.0), measure="terms", patience=6.0)
def chain(n: float) -> Problem:
    """Terms of a planar chain of thin rods, straight and bent: its condition number grows as the fourth power."""
    count = round(n)
    cond = float(np.linalg.cond(straight_inertia(count)))
    facts = {"cond(M) straight": cond, "cond(M) / N⁴": cond / count**4}
    return terms_at(catalog.chain(n=count), samples=4, facts=facts)


# Fast turns, and many of them

_spin = partial(case, "spin")
_SPINS: Final = (powers(0, 6), (1.0, 1e2, 1e4, 1e6))
#: The spin of Gazebo's "boxes" benchmark, complex case without gravity: nearly about the middle axis, rad/s.
_BOX_SPIN: Final = (0.1, 5.0, 0.1)


@_spin("spin", "rad/s", *_SPINS)
def heavy_top(spin: float) -> Problem:
    """A heavy top precesses steadily for 1 s, 30° below the horizontal, and spins."""
    # The top of Terze, Müller and Zlatar.
    mass, radius, g = 15.0, 1.0, 9.81
    across, along = 0.234375 + mass * radius**2, 0.46875
    exact, q, v, rate = exact_motions.precession(spin, 2 * np.pi / 3, mass * g * radius, across, along)
    source, facts = "steady precession, Landau, Lifshitz 1976, §35", {"fastest rate, 1/s": spin}
    facts["precession, rad/s"] = rate
    return motion(catalog.heavy_top(), q, v, 1.0, exact, 8 * EPS * (1 + spin), source, facts=facts)


def box_spin() -> tuple[Exact, float]:
    """Return the quaternions (K, 4) of the tumbling box, and the period of its angular velocity, s."""
    return exact_motions.free_rotor(np.diag(catalog.free_body().bodies[0].inertia), np.array(_BOX_SPIN))


def tumbling(place: Array, velocity: Array, duration: float) -> Problem:
    """Return the box tumbling about its centre, which starts at a place and moves steadily."""
    spin, period = box_spin()

    def exact(t: Array) -> Array:
        return np.concatenate([place + np.multiply.outer(t, velocity), spin(t)], axis=1)

    q, v = np.array([*place, 0.0, 0.0, 0.0, 1.0]), np.array([*velocity, *_BOX_SPIN])
    # Each turn is known to some eps; the place to its own rounding.
    floor = 16 * EPS * (1 + float(np.linalg.norm(_BOX_SPIN)) * duration) + EPS * float(np.abs(place).max())
    source, facts = "free rotation by elliptic functions, Landau, Lifshitz 1976, §37", {"flips": 2 * duration / period}
    # No attitude is farther than π from another.
    return motion(catalog.free_body(), q, v, duration, exact, floor, source, facts=facts, scale=np.pi)


def _ball(spin: float, duration: float, **more: Any) -> Problem:
    """Return a ball that turns steadily about an oblique axis: no torque, no gyroscopic term."""
    b = ModelBuilder("ball", gravity=(0.0, 0.0, 0.0))
    b.add_body("ball", mass=1.0, inertia=(0.4, 0.4, 0.4))
    b.add_joint("turn", "ball", parent="world", child="ball")
    q, axis, source = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 2.0, 2.0]) / 3, "steady turn about one axis"
    exact, floor = exact_motions.turning(axis, spin), 8 * EPS * (1 + spin * duration)
    more["facts"] = {"fastest rate, 1/s": spin, "turns": spin * duration / (2 * np.pi)}
    return motion(b.build(), q, spin * axis, duration, exact, floor, source, **more)


@_spin("spin", "rad/s", *_SPINS)
def spinning_ball(spin: float) -> Problem:
    """A ball without torque turns steadily about an oblique axis for 1 s."""
    return _ball(spin, 1.0)


@_spin("flips", "", (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0), (1.0, 10.0, 100.0), patience=3.0)
def dzhanibekov_box(count: float) -> Problem:
    """A box without torque turns over again and again, past its unstable axis each time."""
    return tumbling(np.zeros(3), np.zeros(3), count * box_spin()[1] / 2)


_RUNGE_KUTTA: Final = ("rk4", "semi_implicit_euler", "implicit_midpoint", "gauss4", "gauss6")


@_spin(
    *("steps", "", powers(2, 6), (1e2, 1e4, 1e5)), methods=(*_RUNGE_KUTTA, "mujoco_rk4", "mujoco_euler"), patience=3.0
)
def quaternion_drift(steps: float) -> Problem:
    """A ball turns by 0.01 rad in each of many steps: does its quaternion stay one?"""
    # So small a step makes no error of its own: only rounding is left.
    return _ball(10.0, 1e-3 * steps, dt=1e-3)


# Poses at which something divides by nearly nothing

_near = partial(case, "near-singular")


def _suspended(inertia: tuple[float, float, float]) -> Model:
    b = ModelBuilder("suspended", gravity=(0.0, 0.0, 0.0))
    b.add_body("body", mass=1.0, inertia=inertia)
    b.add_joint("turn", "spherical_zyx", parent="world", child="body")
    return b.build()


@_near("distance from π/2", "rad", powers(0, -12), (1.0, 1e-3, 1e-6, 1e-12), measure="terms")
def gimbal_lock(distance: float) -> Problem:
    """Terms of a body on a spherical-ZYX joint whose pitch is nearly a right angle."""
    problem = terms_at(_suspended((0.1, 0.2, 0.25)))
    q = problem.q.copy()
    q[:, 1] = np.where(np.arange(len(q)) % 2, -1, 1) * (math.pi / 2 - distance)
    return replace(problem, q=q)


@_near("nearest distance from π/2", "rad", powers(0, -12, 2), (1.0, 1e-4, 1e-8, 1e-12))
def gimbal_pass(distance: float) -> Problem:
    """A ball on a spherical-ZYX joint turns steadily past gimbal lock, where two angles jump by π."""
    model, speed = _suspended((0.1, 0.1, 0.1)), 2.5
    exact, v = exact_motions.past_gimbal_lock(distance, speed)
    facts = {"fastest rate, 1/s": speed / math.sin(distance)}
    return motion(model, np.zeros(3), v, 1.0, exact, 64 * EPS, "steady turn about one axis, in angles", facts=facts)


@_near("distance", "rad", powers(0, -12, 2), (1.0, 1e-6, 1e-12), measure="terms")
def wrist(distance: float) -> Problem:
    """Terms of UR5 with its wrist nearly straight, where axes align: joint space does not care."""
    problem = terms_at(load("ur5"))
    q = problem.q.copy()
    q[:, 4] = distance
    return replace(problem, q=q)


@_near("distance at the end", "rad", (0.5, *powers(-1, -7)), (0.5, 1e-2, 1e-4, 1e-6))
def massless_crank(distance: float) -> Problem:
    """A piston pushes a massless crank to its dead centre: how near can a run come?"""
    # It moves without force. x = r cos θ + l cos φ and sin φ = (r/l) sin θ give 4 r x sin²(θ/2) = δ (2 l - δ), where
    # δ = r + l - x is left of the way.
    r, l, first, duration = 0.1, 0.3, 1.2, 1.0

    def lever(theta: float) -> float:
        """Return -dx/dθ over r."""
        return math.sin(theta) * (1 + r * math.cos(theta) / math.sqrt(l * l - (r * math.sin(theta)) ** 2))

    def left(theta: float) -> float:
        """Return δ, of terms that do not cancel."""
        sine = r / l * math.sin(theta)
        return 2 * r * math.sin(theta / 2) ** 2 + l * sine * sine / (1 + math.sqrt(1 - sine * sine))

    start, end = left(first), left(distance)
    speed = (start - end) / duration

    def exact(t: Array) -> Array:
        rest = start + (end - start) * (t / duration)
        square = rest * (2 * l - rest) / (4 * r * (r + l - rest))
        return 2 * np.arcsin(np.sqrt(square))[:, None]

    model = lagrangian.systems.slider_crank(mass=1.0, crank=r, rod=l).model
    # The way left is known to eps of the way, and the angle goes with its root.
    floor, facts = 8 * EPS * (1 + 1 / distance), {"inertia at the end, kg m²": (r * lever(distance)) ** 2}
    source, v = "a piston without force moves steadily", -speed / (r * lever(first))
    return motion(model, np.array([first]), v, duration, exact, floor, source, facts=facts)


@_near("mass of the middle rod", "kg", powers(0, -18, 2), (1.0, 1e-6, 1e-12, 1e-18), measure="terms")
def massless_link(mass: float) -> Problem:
    """Terms of a chain of three rods whose middle one weighs less and less."""
    return terms_at(rods("light_middle", (1.0, mass, 1.0)))


# Dry friction

_rubbed = partial(case, "friction")
_ALONG: Final = (1.0, 0.0, 0.0)
#: The pull of gravity on a block of 1 kg along its slope, N.
_PULL: Final = 4.0


def _thrown(friction: float, speed: float) -> Problem:
    """Return a block that is thrown up a slope and rests where it stops, for twice that time."""
    b = ModelBuilder("block", gravity=(-_PULL, 0.0, -9.0))
    b.add_body("block", mass=1.0)
    b.add_joint("x", "prismatic", parent="world", child="block", axis=_ALONG, friction=friction)
    slowed = _PULL + friction
    stops = speed / slowed
    way = speed * stops / 2

    def exact(t: Array) -> Array:
        s = np.minimum(t, stops)
        return (s * (speed - slowed * s / 2))[:, None]

    source = "Coulomb's law: uniformly slowed, and at rest"
    facts = {"friction over the other forces": friction / _PULL, "fastest change, 1/s": 1 / stops}
    return motion(b.build(), [0.0], speed, 2 * stops, exact, 4 * EPS * way, source, facts=facts, scale=way)


@_rubbed("friction over pull", "", (1.1, 11.0, 110.0, 1100.0), (1.1, 110.0, 1100.0))
def strong_friction(ratio: float) -> Problem:
    """A block is thrown up a slope, where friction above gravity's pull lets it rest."""
    return _thrown(ratio * _PULL, 1.0)


@_rubbed("speed", "m/s", powers(0, -9), (1.0, 1e-3, 1e-6, 1e-9))
def slow_slip(speed: float) -> Problem:
    """A block comes up a slope at hardly any speed and rests."""
    return _thrown(2 * _PULL, speed)


@_rubbed("joints at rest", "", (1.0, 2.0, 4.0, 8.0, 16.0, 32.0), (1.0, 4.0, 16.0))
def many_at_rest(count: float) -> Problem:
    """A stack of blocks swings on a spring; friction just holds each block on the one below."""
    n, frequency, reach = int(count), 3.0, 0.5
    b = ModelBuilder("stack", gravity=np.zeros(3))
    for i in range(n + 1):
        b.add_body(f"block{i}", mass=1.0)
        # Friction is a hundredth above the force that accelerates the blocks above a joint.
        holds: dict[str, Any] = {"friction": 1.01 * (n + 1 - i) * reach * frequency**2}
        holds = holds if i else {"stiffness": (n + 1) * frequency**2}
        b.add_joint(
            f"x{i}", "prismatic", parent=f"block{i - 1}" if i else "world", child=f"block{i}", axis=_ALONG, **holds
        )
    q = np.zeros(n + 1)
    q[0] = reach

    def exact(t: Array) -> Array:
        return np.cos(frequency * t)[:, None] * q

    source, facts = "a spring and the mass of all blocks", {"joints with friction": count}
    return motion(b.build(), q, 0.0, 4.0, exact, 4 * EPS, source, facts=facts)


# Numbers that are large, or very small, though the motion is an ordinary one

_large = partial(case, "large")

_FAR: Final = ((1.0, 1e2, 1e4, 1e6, 1e7, 1e8, 1e9), (1.0, 1e4, 1e7, 1e9))
_PLACE: Final = np.array([1.0, -1.0, 0.5])
_PENDULUM: Final = "pendulum by elliptic functions, Landau, Lifshitz 1976, §11"


@_large("angle", "rad", *_FAR)
def many_turns(angle: float) -> Problem:
    """A pendulum swings from 1 rad for 2 s after many whole turns."""
    with mp.workdps(40):
        turn = 2 * mp.pi
        turns = mp.nint(angle / turn)
        start = float(turns * turn + 1)
        # The rounded angle less its whole turns.
        apart = float(mp.mpf(start) - turns * turn)
    swing = exact_motions.pendulum(apart, 0.0, 9.81)
    return motion(
        *(catalog.pendulum(), [start], 0.0, 2.0, lambda t: start + (swing(t) - apart), EPS * start + 1e-14, _PENDULUM),
        facts={"spacing of doubles there, rad": math.ulp(start)},
    )


@_large("place", "m", *_FAR)
def far_on_rail(place: float) -> Problem:
    """A cart-pole falls from 2 rad for 2 s, far out on its rail."""
    theta, start = 2.0, np.array([place, 0.0])
    falling, source = exact_motions.cart_pole(theta, 1.0), "energy and momentum with a quadrature"
    more: dict[str, Any] = {"facts": {"spacing of doubles there, m": math.ulp(place)}, "scale": 2 * theta}
    floor, q = EPS * place + 1e-12, np.array([place, theta])
    return motion(catalog.cart_pole(), q, 0.0, 2.0, lambda t: falling(t) + start, floor, source, **more)


@_large("place", "m", *_FAR)
def far_base(place: float) -> Problem:
    """A box tumbles and drifts for 1 s, far from the origin."""
    problem = tumbling(place * _PLACE, np.array([1.0, 2.0, -1.0]), 1.0)
    return replace(problem, facts={"spacing of doubles there, m": math.ulp(place)})


@_large("place", "m", *_FAR, measure="terms")
def far_base_terms(place: float) -> Problem:
    """Terms of a quadruped on a floating base far from the origin."""
    problem = terms_at(load("anymal_b", floating_base=True))
    q = problem.q.copy()
    q[:, :3] += place * _PLACE
    return replace(problem, q=q, facts={"spacing of doubles there, m": math.ulp(place)})


def _swing(model: Model, gravity: float, speed: float, duration: float, floor: float, **more: Any) -> Problem:
    """Return a pendulum of 1 m that starts at 1 rad."""
    exact = exact_motions.pendulum(1.0, speed, gravity)
    return motion(model, np.ones(1), speed, duration, exact, floor, _PENDULUM, **more)


def _under_gravity(gravity: float, speed: float, duration: float) -> Problem:
    floor, facts = 16 * EPS * (1 + math.sqrt(gravity) * duration), {"fastest frequency, rad/s": math.sqrt(gravity)}
    return _swing(catalog.pendulum(gravity=gravity), gravity, speed, duration, floor, facts=facts)


@_large("gravity", "m/s²", powers(0, 6), (1.0, 1e3, 1e6))
def strong_gravity(gravity: float) -> Problem:
    """A pendulum swings from 1 rad for 1 s under ever stronger gravity."""
    return _under_gravity(gravity, 0.0, 1.0)


@_large("gravity", "m/s²", (*powers(0, -6), 0.0), (1.0, 1e-3, 0.0))
def weak_gravity(gravity: float) -> Problem:
    """A pendulum starts at 1 rad with 1 rad/s under ever weaker gravity, and none."""
    return _under_gravity(gravity, 1.0, 2.0)


_HUGE: Final = (
    *("inertia", "kg m²", (1.0, 1e3, 1e6, 1e9, 1e12, 1e15, 1e20, 1e50, 1e100, 1e150, 1e200, 1e250, 1e300)),
    (1.0, 1e15, 1e150, 1e300),
)
_TINY: Final = (
    *("inertia", "kg m²", (1.0, 1e-3, 1e-6, 1e-9, 1e-12, 1e-15, 1e-16, 1e-20, 1e-50, 1e-100, 1e-200, 1e-300, 1e-310)),
    (1.0, 1e-12, 1e-16, 1e-310),
)


@_large(*_TINY, "tiny_inertia", "A pendulum of 1 m swings from 1 rad for 1 s, ever lighter, down to subnormal numbers.")
@_large(*_HUGE, "huge_inertia", "A pendulum of 1 m swings from 1 rad for 1 s, ever heavier.")
def _of_inertia(inertia: float) -> Problem:
    # The motion does not depend on the mass, but all forces do.
    return _swing(catalog.pendulum(mass=inertia), 9.81, 0.0, 1.0, 16 * EPS)


@_large(
    *(*_TINY, "tiny_inertia_terms", "Terms of a double pendulum of 1 m each, ever lighter, down to subnormal numbers."),
    measure="terms",
)
@_large(*_HUGE, "huge_inertia_terms", "Terms of a double pendulum of 1 m each, ever heavier.", measure="terms")
def _terms_of_inertia(inertia: float) -> Problem:
    return terms_at(catalog.double_pendulum(mass1=inertia, mass2=inertia), force=inertia)
