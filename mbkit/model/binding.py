"""Which numbers of a description's parts stand for expressions of parameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mbkit.model.parameter import Expression, Number, nominal
from mbkit.model.parts import Joint

__all__ = ["Binding", "split", "with_numbers"]


@dataclass(frozen=True)
class Binding:
    """One number of a part and the expression that it stands for.

    Attributes
    ----------
    where : str
        ``"bodies"``, ``"joints"``, ``"frames"``, ``"springs"``, ``"couplings"``, ``"loops"``, ``"prescribed"``, or
        ``"gravity"``.
    part : str
        The part's name, of a prescribed motion its joint's; empty for gravity.
    field : str
        Name of its attribute; of a mimic joint also ``"ratio"`` and ``"offset"``.
    index : tuple of int
        Which entry of an array.
    expression : Expression
    """

    where: str
    part: str
    field: str
    index: tuple[int, ...]
    expression: Expression


def split(where: str, part: str, fields: dict[str, Any]) -> tuple[dict[str, Any], tuple[Binding, ...]]:
    """Return a part's fields with nominal numbers, and the bindings of those that were expressions."""
    numbers, bindings = dict(fields), []
    for field, value in fields.items():
        if isinstance(value, Expression):
            numbers[field] = nominal(value)
            bindings.append(Binding(where, part, field, (), value))
        elif isinstance(value, np.ndarray) and value.dtype == object:
            numbers[field] = np.array([nominal(x) for x in value.flat], dtype=np.float64).reshape(value.shape)
            bindings += [
                Binding(where, part, field, index, x) for index, x in np.ndenumerate(value) if isinstance(x, Expression)
            ]
    return numbers, tuple(bindings)


def with_numbers(part: Any, numbers: Iterable[tuple[str, tuple[int, ...], Number]]) -> Any:
    """Return a part with numbers of some fields replaced by nominal ones."""
    changes: dict[str, Any] = {}
    for field, index, value in numbers:
        if isinstance(part, Joint) and field in ("ratio", "offset"):
            if part.mimic:
                changes["mimic"] = replace(changes.get("mimic", part.mimic), **{field: nominal(value)})
        elif index:
            array = changes.setdefault(field, np.array(getattr(part, field)))
            array[index] = nominal(value)
        else:
            changes[field] = nominal(value)
    return replace(part, **changes)
