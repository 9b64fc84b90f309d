"""Giving parameters their values: another description, checked like the first."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from mbkit._check import real
from mbkit.errors import ModelError, UnknownNameError
from mbkit.model.parameters import Expression, Parameter, with_numbers
from mbkit.model.validation import structure_faults, suspects

if TYPE_CHECKING:
    from mbkit.model.model import Model

__all__ = ["fixed", "moved", "opened"]


def _checked(model: Model, values: Mapping[str, Any]) -> dict[str, float]:
    """Return finite numbers by the names of a model's parameters."""
    for name in values:
        if name not in model.parameters:
            raise UnknownNameError("parameter", name, model.parameters)
    return {name: real(f"parameter {name!r}", value) for name, value in values.items()}


def fixed(model: Model, values: Mapping[str, Any]) -> Model:
    """Return the model with plain numbers where these parameters stood."""
    given = _checked(model, values)
    return _substituted(model, lambda p: given.get(p.name, p))


def moved(model: Model, values: Mapping[str, Any]) -> Model:
    """Return the same parametrised model at other nominal values."""
    given = _checked(model, values)
    return _substituted(model, lambda p: Parameter(p.name, given.get(p.name, p.value)))


def opened(model: Model) -> Model:
    """Return the same parametrised model with no value for any parameter."""
    return _substituted(model, lambda p: Parameter(p.name))


def _substituted(model: Model, parameter: Callable[[Parameter], Any]) -> Model:
    bindings = [(b, b.expression.evaluate(parameter, float)) for b in model.bindings]

    def filled(where: str, part: Any, name: str) -> Any:
        return with_numbers(part, [(b.field, b.index, x) for b, x in bindings if (b.where, b.part) == (where, name)])

    made: Model = replace(
        filled("gravity", model, ""),
        bodies=tuple(filled("bodies", b, b.name) for b in model.bodies),
        joints=tuple(filled("joints", j, j.name) for j in model.joints),
        frames=tuple(filled("frames", f, f.name) for f in model.frames),
        springs=tuple(filled("springs", s, s.name) for s in model.springs),
        couplings=tuple(filled("couplings", c, c.name) for c in model.couplings),
        loops=tuple(filled("loops", x, x.name) for x in model.loops),
        prescribed=tuple(filled("prescribed", p, p.name) for p in model.prescribed),
        bindings=tuple(replace(b, expression=x) for b, x in bindings if isinstance(x, Expression)),
    )
    faults = structure_faults(
        made.bodies, made.joints, made.frames, made.springs, made.couplings, made.loops, made.prescribed
    )
    # What was taken as written at first is known to be wrong, but no mass was negative.
    taken = {name for name, _ in model.nonphysical}
    found = suspects(made, point_masses=True)
    faults += [f"body {n!r}: {why}" for n, why in found if n not in taken or made.body(n).mass < 0]
    if faults:
        raise ModelError(model.name, faults)
    return made
