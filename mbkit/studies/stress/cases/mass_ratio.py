"""Heavy beside light: masses that differ along a chain, and in a robot's hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit.load import load
from mbkit.model import Body, Model, ModelBuilder
from mbkit.studies.stress.case import Case, Measure, Problem
from mbkit.studies.stress.cases._common import powers, terms_at
from mbkit.studies.stress.cases.exact_motions import HangingChain

__all__ = ["CASES"]

_SWING: Final = (0.0, -1.0, 0.0)
_UP, _DOWN = powers(0, 9), powers(0, -9)
_QUICK_UP, _QUICK_DOWN = (1.0, 1e3, 1e6, 1e9), (1.0, 1e-3, 1e-6, 1e-9)


def _chain(name: str, masses: tuple[float, ...], load_mass: float = 0.0) -> Model:
    """Return thin rods of 1 m, hinged end to end, with a point mass at the last end."""
    b = ModelBuilder(name)
    for i, mass in enumerate(masses):
        across = mass / 12
        parent = f"rod{i}" if i else "world"
        b.add_body(f"rod{i + 1}", mass=mass, com=(0.0, 0.0, -0.5), inertia=(across, across, 0.0))
        place = (0.0, 0.0, -1.0 if i else 0.0)
        b.add_joint(f"theta{i + 1}", "continuous", parent=parent, child=f"rod{i + 1}", axis=_SWING, translation=place)
    if load_mass:
        b.add_body("load", mass=load_mass)
        end = (0.0, 0.0, -1.0)
        b.add_joint("hold", "fixed", parent=f"rod{len(masses)}", child="load", translation=end)
    return b.build()


def _graded(ratio: float) -> tuple[float, ...]:
    """Return the masses of five rods, each by the same factor heavier than the one before."""
    return tuple(ratio ** (i / 4 - 0.5) for i in range(5))


_ARM: Final = (1.0, 1.0, 1.0)
#: Found against Taylor series with 34 digits.
_FLOOR: Final = 1e-11


def _swinging(model: Model, masses: tuple[float, ...], load_mass: float = 0.0, *, taut: bool = True) -> Problem:
    """Let a chain go at rest, its first rod half a radian from below."""
    chain, angle, duration = HangingChain(masses, load_mass), 0.5, 1.0
    q = chain.taut(angle) if taut else np.array([angle, *[0.0] * (len(masses) - 1)])
    return Problem(
        model,
        q,
        np.zeros(len(q)),
        duration=duration,
        exact=chain.motion(q, duration),
        floor=_FLOOR,
        source="collocation in angles from the vertical, Radau IIA of order 15",
        facts=_facts(model),
    )


def _facts(model: Model) -> dict[str, float]:
    masses = [body.mass for body in model.bodies if body.mass > 0]
    return {"heaviest over lightest body": max(masses) / min(masses)}


def _terms(model: Model) -> Problem:
    return terms_at(model, facts=_facts(model))


def _heavy_tip(ratio: float) -> Problem:
    return _swinging(_chain("graded_chain", _graded(ratio)), _graded(ratio))


def _light_tip(ratio: float) -> Problem:
    return _swinging(_chain("graded_chain", _graded(ratio)), _graded(ratio), taut=False)


def _graded_terms(ratio: float) -> Problem:
    return _terms(_chain("graded_chain", _graded(ratio)))


def _load_swing(mass: float) -> Problem:
    return _swinging(_chain("loaded_arm", _ARM, mass), _ARM, mass)


def _load_terms(mass: float) -> Problem:
    return _terms(_chain("loaded_arm", _ARM, mass))


def _hand_load(mass: float) -> Problem:
    """Return Panda with a point mass between its fingers."""
    model = load("panda")
    grip = model.frame("panda_hand_tcp")
    hand = next(body for body in model.bodies if body.name == grip.body)
    apart, total = grip.translation - hand.com, hand.mass + mass
    # Steiner's theorem for the two about their common centre.
    spread = hand.mass * mass / total * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    com = hand.com + mass / total * apart
    return _terms(_with(model, replace(hand, mass=total, com=com, inertia=hand.inertia + spread)))


def _light_finger(factor: float) -> Problem:
    model = load("panda")
    fingers = [body for body in model.bodies if body.name.endswith("finger")]
    return _terms(_with(model, *(replace(b, mass=factor * b.mass, inertia=factor * b.inertia) for b in fingers)))


def _with(model: Model, *changed: Body) -> Model:
    """Return the model with some bodies changed."""
    by_name = {body.name: body for body in changed}
    return replace(model, bodies=tuple(by_name.get(body.name, body) for body in model.bodies))


#: Heaviest over lightest body -> the robot of example-robot-data.
_FOUND: Final = {
    45.0: "ur5",
    330.0: "panda",
    650.0: "talos_full",
    3000.0: "pr2",
    6500.0: "alex_psyonic_hands",
}


def _as_found(ratio: float) -> Problem:
    return _terms(load(_FOUND[min(_FOUND, key=lambda known: abs(known - ratio))]))


def _case(
    name: str,
    about: str,
    make: Callable[[float], Problem],
    parameter: str = "last over first mass",
    unit: str = "",
    *,
    up: bool,
    measure: Measure = "terms",
) -> Case:
    values, quick = (_UP, _QUICK_UP) if up else (_DOWN, _QUICK_DOWN)
    return Case(name, about, "mass ratio", parameter, unit, values, quick, make, measure)


CASES: Final = (
    _case(
        "heavy_tip",
        "A taut chain of five rods, each heavier than the one above, swings from 0.5 rad for 1 s.",
        _heavy_tip,
        up=True,
        measure="motion",
    ),
    _case(
        "heavy_tip_terms",
        "Terms of a chain of five rods, each heavier than the one above.",
        _graded_terms,
        up=True,
    ),
    _case(
        "light_tip",
        "A chain of five rods, each lighter than the one above, swings from 0.5 rad for 1 s.",
        _light_tip,
        up=False,
        measure="motion",
    ),
    _case(
        "light_tip_terms",
        "Terms of a chain of five rods, each lighter than the one above.",
        _graded_terms,
        up=False,
    ),
    _case(
        "loaded_arm",
        "A taut arm of three rods of 1 kg swings from 0.5 rad for 1 s with a load at its end.",
        _load_swing,
        "load",
        "kg",
        up=True,
        measure="motion",
    ),
    _case(
        "loaded_arm_terms",
        "Terms of an arm of three rods of 1 kg with a load at its end.",
        _load_terms,
        "load",
        "kg",
        up=True,
    ),
    _case("hand_load", "Terms of Panda, of 17 kg, with a load in its hand.", _hand_load, "load", "kg", up=True),
    _case(
        "light_finger",
        "Terms of Panda whose fingers get lighter and lighter.",
        _light_finger,
        "part of the fingers' mass",
        up=False,
    ),
    Case(
        "robots_as_found",
        f"Terms of robots as their files have them: {', '.join(_FOUND.values())}.",
        "mass ratio",
        "heaviest over lightest body",
        "",
        tuple(_FOUND),
        (45.0, 330.0, 6500.0),
        _as_found,
        "terms",
    ),
)
