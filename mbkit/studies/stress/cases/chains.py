"""Heavy beside light: masses that differ along a chain, and in a robot's hand; and chains from short to long."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from mbkit import catalog
from mbkit._check import Array
from mbkit.load import load
from mbkit.model import Body, Model, ModelBuilder
from mbkit.studies.stress.case import Case, Problem
from mbkit.studies.stress.cases._common import SWING, Facts, motion, powers, register, terms_at
from mbkit.studies.stress.cases.exact_motions import HangingChain

CASES: Final[list[Case]] = []
_case = partial(register, CASES, "mass ratio")

_UP: Final = (powers(0, 9), (1.0, 1e3, 1e6, 1e9))
_DOWN: Final = (powers(0, -9), (1.0, 1e-3, 1e-6, 1e-9))
_RATIO: Final = "last over first mass"
_ARM: Final = (1.0, 1.0, 1.0)


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


def _graded(ratio: float) -> tuple[float, ...]:
    """Return the masses of five rods, each by the same factor heavier than the one before."""
    return tuple(ratio ** (i / 4 - 0.5) for i in range(5))


def _facts(model: Model) -> Facts:
    masses = [body.mass for body in model.bodies if body.mass > 0]
    return {"heaviest over lightest body": max(masses) / min(masses)}


def _terms(model: Model) -> Problem:
    return terms_at(model, facts=_facts(model))


def _swinging(name: str, masses: Sequence[float], load_mass: float = 0.0, *, taut: bool = True) -> Problem:
    """Let a chain go at rest, its first rod half a radian from below, for 1 s."""
    model, chain, angle = rods(name, masses, load_mass), HangingChain(masses, load_mass), 0.5
    q = chain.taut(angle) if taut else np.array([angle, *[0.0] * (len(masses) - 1)])
    source = "collocation in angles from the vertical, Radau IIA of order 15"
    # The error was measured against Taylor series with 34 digits.
    return motion(model, q, 0.0, 1.0, chain.motion(q, 1.0), 1e-11, source, _facts(model))


@_case(_RATIO, "", *_UP)
def heavy_tip(ratio: float) -> Problem:
    """A taut chain of five rods, each heavier than the one above, swings from 0.5 rad for 1 s."""
    return _swinging("graded_chain", _graded(ratio))


@_case(_RATIO, "", *_UP, measure="terms")
def heavy_tip_terms(ratio: float) -> Problem:
    """Terms of a chain of five rods, each heavier than the one above."""
    return _terms(rods("graded_chain", _graded(ratio)))


@_case(_RATIO, "", *_DOWN)
def light_tip(ratio: float) -> Problem:
    """A chain of five rods, each lighter than the one above, swings from 0.5 rad for 1 s."""
    return _swinging("graded_chain", _graded(ratio), taut=False)


@_case(_RATIO, "", *_DOWN, measure="terms")
def light_tip_terms(ratio: float) -> Problem:
    """Terms of a chain of five rods, each lighter than the one above."""
    return _terms(rods("graded_chain", _graded(ratio)))


@_case("load", "kg", *_UP)
def loaded_arm(mass: float) -> Problem:
    """A taut arm of three rods of 1 kg swings from 0.5 rad for 1 s with a load at its end."""
    return _swinging("loaded_arm", _ARM, mass)


@_case("load", "kg", *_UP, measure="terms")
def loaded_arm_terms(mass: float) -> Problem:
    """Terms of an arm of three rods of 1 kg with a load at its end."""
    return _terms(rods("loaded_arm", _ARM, mass))


@_case("load", "kg", *_UP, measure="terms")
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


@_case("part of the fingers' mass", "", *_DOWN, measure="terms")
def light_finger(factor: float) -> Problem:
    """Terms of Panda whose fingers get lighter and lighter."""
    model = load("panda")
    fingers = [body for body in model.bodies if body.name.endswith("finger")]
    return _terms(_with(model, *(replace(b, mass=factor * b.mass, inertia=factor * b.inertia) for b in fingers)))


def _with(model: Model, *changed: Body) -> Model:
    """Return the model with some bodies changed."""
    by_name = {body.name: body for body in changed}
    return replace(model, bodies=tuple(by_name.get(body.name, body) for body in model.bodies))


#: Heaviest over lightest body -> the robot of example-robot-data.
_ROBOTS: Final = {45.0: "ur5", 330.0: "panda", 650.0: "talos_full", 3000.0: "pr2", 6500.0: "alex_psyonic_hands"}


@_case("heaviest over lightest body", "", tuple(_ROBOTS), (45.0, 330.0, 6500.0), measure="terms")
def robots_as_found(ratio: float) -> Problem:
    """Terms of robots as their files have them: ur5, panda, talos_full, pr2, alex_psyonic_hands."""
    return _terms(load(_ROBOTS[min(_ROBOTS, key=lambda known: abs(known - ratio))]))


LENGTH_CASES: Final[list[Case]] = []
_LENGTHS: Final = tuple(2.0**k for k in range(1, 9))


def straight_inertia(n: int) -> Array:
    """Return M of a straight chain of n thin rods of 1 kg and 1 m, in angles from rod to rod.

    A turn of joint j moves rod i ≥ j as a whole: M_jk = Σ over the rods i ≥ j, k of (i - j + ½)(i - k + ½) + 1/12.
    """
    bodies, joints = np.arange(n)[:, None], np.arange(n)
    arms = np.where(bodies >= joints, bodies - joints + 0.5, 0.0)
    return np.asarray(arms.T @ arms + (n - np.maximum.outer(joints, joints)) / 12)


# The longest take a minute to derive, with 34 digits.
@register(LENGTH_CASES, "length", "rods", "", _LENGTHS, (2.0, 8.0, 32.0), measure="terms", patience=6.0)
def chain(n: float) -> Problem:
    """Terms of a planar chain of thin rods, straight and bent: its condition number grows as the fourth power."""
    count = round(n)
    cond = float(np.linalg.cond(straight_inertia(count)))
    facts = {"cond(M) straight": cond, "cond(M) / N⁴": cond / count**4}
    return terms_at(catalog.chain(n=count), samples=4, facts=facts)
