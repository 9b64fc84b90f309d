"""The symbols in which textbooks write the catalog's systems, and the numbers that stand for them."""

from __future__ import annotations

import inspect
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from itertools import count
from typing import Any, Final

import numpy as np

from mbkit import catalog
from mbkit._check import ROUNDING
from mbkit.errors import MbkitError
from mbkit.lagrangian.energies.charts import chart_names
from mbkit.load.urdf_reader import Snapper
from mbkit.model import Expression, Model, Parameter
from mbkit.model.parts import rules_of

#: Textbook symbols of arguments whose symbol is not the usual one: argument=symbol, or three symbols of a vector.
_SYMBOLS: Final = {
    "acrobot": "com1=l_c1 com2=l_c2 inertia1=I1 inertia2=I2",
    "cart_pole": "cart_mass=m_c pole_mass=m_p",
    "clamped_beam": "length=L bending_stiffness=EI",
    "flexible_spacecraft": "length=L bending_stiffness=EI hub_mass=m_h hub_inertia=J_x,J_y,J hub_radius=r",
    "free_body": "sides=a,b,c",
    "furuta_pendulum": "arm_length=L arm_mass=m_a arm_com=l_a arm_inertia=J_a "
    "pendulum_mass=m pendulum_com=l pendulum_inertia=J_x,J_y,J_z",
    "gyroscope": "rotor_mass=m rotor_axial=C rotor_across=A offset=l gimbal_mass=m_g "
    "inner_inertia=A_i,B_i,C_i outer_inertia=J_o",
    "slider_crank": "crank=L1 rod=L2 crank_mass=m1 rod_mass=m2 piston_mass=m3",
}
#: Symbols of coordinates that the catalog calls by a word.
_LETTERS: Final = {
    "elastic_pendulum": ("theta", "s"),
    "furuta_pendulum": ("alpha", "theta"),
    "gyroscope": ("alpha", "beta", "gamma"),
}
_LETTER: Final = re.compile(r"([A-Za-z]|alpha|beta|gamma|delta|theta|phi|psi)(_?\d+)?")
_USUAL: Final = {"gravity": "g", "mass": "m", "length": "l", "stiffness": "k", "damping": "d", "inertia": "J"}


def in_symbols(model: Model) -> Model | None:
    """Return a catalog system with a parameter for each argument, at the values of a model; None for other models.

    The values are solved from the model's numbers. An argument of zero stays the number zero.
    """
    system = next((n for n in catalog.systems() if model.name == n or _numbered(model.name, n)), None)
    if system is None or model.bindings:
        return None
    names, numbers = _content(model)
    for size in range(1, model.nv + 1):
        # A system may have another size, or take no parameters; values solved for may be no system's.
        with suppress(MbkitError, TypeError):
            symbolic = _with_parameters(system, size)
            if _content(symbolic)[0] != names:
                continue
            values = _solved(symbolic, model)
            moved = symbolic.with_nominal(values)
            pairs = zip(_content(moved)[1], numbers, strict=True)
            if all(
                np.allclose(x, y, rtol=ROUNDING, atol=ROUNDING * float(np.abs(y).max(initial=0.0))) for x, y in pairs
            ):
                zeros = {name: 0.0 for name, x in values.items() if x == 0.0}
                named = moved.with_parameters(**zeros) if zeros else moved
                # Parts that the catalog's system lacks, such as forces, are the model's own.
                return replace(model, bindings=tuple(b for b in named.bindings if b.where != "frames"))
            return None
    return None


def letters(model: Model) -> list[str] | None:
    """Return names of coordinates that are short enough for equations; None where the model's own are."""
    own = chart_names(model)
    if all(_LETTER.fullmatch(n) for n in own):
        return None
    if model.name in _LETTERS and len(_LETTERS[model.name]) == len(own):
        return list(_LETTERS[model.name])
    # The last part of a name such as hub.x, of a joint with several coordinates, may be a symbol.
    tails = [n.rpartition(".")[2] for n in own]
    known = {t for t in tails if _LETTER.fullmatch(t) and tails.count(t) == 1 and not t.startswith("q")}
    numbers = count(1)
    return [t if t in known else f"q{next(numbers)}" for t in tails]


def with_plain_turns(model: Model, reach: float) -> tuple[Model, str | None]:
    """Return a model whose rotations within `reach` of 0, 1 or -1 are exact, and a note if that changed it.

    A file's 1.57079632679 for π/2 leaves 5e-12 instead of zero, and with it a term in every equation.
    """
    snap = Snapper(reach)
    joints = tuple(
        replace(j, rotation=snap(j.rotation), axes=np.array([snap(axis) for axis in j.axes]).reshape(-1, 3))
        for j in model.joints
    )
    if not snap.count:
        return model, None
    return replace(model, joints=joints), snap.note


def _numbered(name: str, system: str) -> bool:
    return name.startswith(f"{system}_") and name.removeprefix(f"{system}_").isdigit()


def _with_parameters(system: str, size: int) -> Model:
    """Return a catalog system with a parameter for each number; arguments that count parts are the size."""
    function, own = catalog.systems()[system], dict(x.split("=") for x in _SYMBOLS.get(system, "").split())
    arguments: dict[str, Any] = {}
    for name, argument in inspect.signature(function).parameters.items():
        default, symbol = argument.default, own.get(name) or _usual(name)
        if type(default) is int:
            arguments[name] = size
        elif isinstance(default, float):
            arguments[name] = Parameter(symbol, default)
        elif isinstance(default, tuple) and all(isinstance(x, float) for x in default):
            names = symbol.split(",") if name in own else [f"{symbol}_{axis}" for axis in "xyz"]
            arguments[name] = [Parameter(n, x) for n, x in zip(names, default, strict=True)]
    return function(**arguments)


def _usual(name: str) -> str:
    stem = name.rstrip("0123456789")
    return _USUAL.get(stem, stem) + name[len(stem) :]


def _content(model: Model) -> tuple[list[Any], list[Any]]:
    """Return the names, and apart from them the numbers, of what a description's equations hold."""
    names: list[Any] = []
    numbers: list[Any] = [model.gravity]
    for where in ("bodies", "joints", "springs", "couplings", "loops"):
        for part in getattr(model, where):
            values, rules = {f.name: getattr(part, f.name) for f in fields(part)}, rules_of(type(part))
            # Data and what jumps are those of the model.
            own = (f for f, rule in rules.items() if rule.direction or (not rule.fixed and rule.absent is None))
            numbers += [values[f] for f in own if "jump" not in rules[f].does]
            names += [(where, f, x) for f, x in values.items() if f not in rules]
    return names, numbers


def _solved(symbolic: Model, model: Model) -> dict[str, float]:
    """Return the values of parameters that give a model's numbers, as far as they follow from them."""
    values: dict[str, float] = {}
    # Frames move nothing, and a model may be without them.
    left = [(b.expression, _number(model, b)) for b in symbolic.bindings if b.where != "frames"]
    progress = True
    while progress:
        progress = False
        for expression, target in left:
            unknown = {p.name for p in expression.parameters()} - set(values)
            if len(unknown) == 1:
                (name,) = unknown
                at = [_evaluated(expression, {**values, name: x}) for x in (0.0, 1.0, 2.0)]
                slope = at[1] - at[0]
                # Linear expressions only are solved.
                if slope and np.isfinite(at).all() and abs(at[2] - at[1] - slope) <= 1e-9 * abs(slope):
                    values[name], progress = _rounded((target - at[0]) / slope), True
    return values


def _rounded(x: float) -> float:
    """Return the shorter decimal where a number is one to rounding."""
    short = float(f"{x:.12g}")
    return short if abs(short - x) <= ROUNDING * abs(x) else x


def _evaluated(expression: Expression, values: Mapping[str, float]) -> float:
    try:
        return float(expression.evaluate(lambda p: values[p.name], float))
    except ZeroDivisionError:
        return float("nan")


def _number(model: Model, binding: Any) -> float:
    part: Any = model
    if binding.where != "gravity":
        part = next(p for p in getattr(model, binding.where) if p.name == binding.part)
    value = getattr(part, binding.field)
    return float(value[binding.index] if binding.index else value)
