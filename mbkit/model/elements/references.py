"""References of parts to bodies and joints: other names for these, and another place for what hangs on them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import UnknownNameError
from mbkit.model.elements.forces import Force, arguments_of
from mbkit.model.elements.formula import Formula
from mbkit.model.parameters import Binding, Expression, split
from mbkit.model.parts import rules_of

#: A `mbkit.model.description.Description`, a floor above.
_Model = Any
_New = Callable[[str], str]
#: Kinds of parts, as a description names them.
KINDS_OF_PARTS: Final = (
    *("bodies", "joints", "frames"),
    *("springs", "couplings", "loops", "couplers", "prescribed", "forces", "no_slip"),
)
#: The word for one of them, where it is not the plural's singular.
_CALLED: Final = {"bodies": "body", "no_slip": "no slip"}
#: Fields that name other parts.
_OF_BODIES: Final = ("parent", "child", "body", "body_a", "body_b", "frame")
_OF_JOINTS: Final = ("joint", "leader", "joints", "without")
#: Bodies that a part hangs on, with the end of its fields' names.
_SIDES: Final = {"parent": "", "body": "", "body_a": "_a", "body_b": "_b"}


def called(section: str) -> str:
    """Return the word for one part of a kind."""
    return _CALLED.get(section, section.removesuffix("s"))


def names_in(part: Any, of: Iterable[str] = (*_OF_BODIES, *_OF_JOINTS)) -> set[str]:
    """Return the names of the bodies, frames and joints that a part refers to, or those in some of its fields."""
    given = [getattr(part, n, ()) for n in of]
    own = {x for value in given for x in ((value,) if isinstance(value, str) else value)}
    mimic = getattr(part, "mimic", None)
    return own | ({mimic.joint} if mimic else set())


def renamed(model: _Model, bodies: _New, joints: _New, others: _New) -> tuple[dict[str, list[Any]], list[Binding]]:
    """Return the parts and bindings of a model with other names of its parts; parameters keep theirs."""
    moving = [j.name for j in model.independent_joints]
    arguments = {x: joints(j) + x.removeprefix(j) for j in moving for x in arguments_of(model, j)}
    own = {"bodies": bodies, "joints": joints}
    made = [
        (kind, p, with_names(model, p, bodies, joints, arguments, own.get(kind, others)))
        for kind in KINDS_OF_PARTS
        for p in getattr(model, kind)
    ]
    # Some names follow from others, as that of a gravity compensation from its body's.
    names = {(kind, old.name): part.name for kind, old, part in made}
    parts = {kind: [part for own, _, part in made if own == kind] for kind in KINDS_OF_PARTS}
    return parts, [replace(b, part=names.get((b.where, b.part), b.part)) for b in model.bindings]


def with_names(
    model: _Model, part: Any, bodies: _New, joints: _New, arguments: Mapping[str, str], own: _New = str
) -> Any:
    """Return a part of a model with other names for what it refers to, also in formulas of forces, and for itself."""
    given = {field.name: getattr(part, field.name) for field in fields(part)}
    changes: dict[str, Any] = {"name": own(given["name"])} if "name" in given else {}
    for new, of in ((bodies, _OF_BODIES), (joints, _OF_JOINTS)):
        some = {n: given[n] for n in of if n in given}
        changes |= {n: new(x) if isinstance(x, str) else tuple(map(new, x)) for n, x in some.items()}
    if mimic := given.get("mimic"):
        changes["mimic"] = replace(mimic, joint=joints(mimic.joint))
    if isinstance(part, Force) and arguments:
        try:
            # Its own arguments stay.
            names = {x: y for x, y in arguments.items() if x not in (*part.own(model), *part.symbols)}
        except UnknownNameError:
            # A force on a joint that is not there, which is told where the model is built.
            names = {}
        formulas = {n: x for n, x in given.items() if isinstance(x, Formula)}
        changes |= {n: replace(x, arguments=tuple(names.get(a, a) for a in x.arguments)) for n, x in formulas.items()}
    return replace(part, **changes)


def entries(part: Any, field: str, bindings: Iterable[Binding]) -> Any:
    """Return a field with its expressions in the place of their nominal numbers."""
    own = [b for b in bindings if (b.where, b.part, b.field) == (part.section, part.name, field)]
    if not own:
        return getattr(part, field)
    value = np.array(getattr(part, field), dtype=object)
    for b in own:
        value[b.index] = b.expression
    return value.item() if value.ndim == 0 else value


def with_fields(part: Any, values: Mapping[str, Any], bindings: list[Binding]) -> Any:
    """Return a part with other fields, numbers or expressions, and put the bindings of these into the list."""
    place = part.section, part.name
    numbers, new = split(*place, dict(values))
    bindings[:] = [b for b in bindings if (b.where, b.part) != place or b.field not in values]
    bindings += new
    return replace(part, **numbers)


def moved_by(R: Array, p: Any, x: Any) -> Any:
    """Return p + R x of three numbers or expressions; what a zero or a one multiplies stays as it is."""
    if np.array_equal(R, np.eye(3)) and not p.any():
        return x
    if p.dtype != object and np.asarray(x).dtype != object:
        return p + R @ x
    out = np.empty(3, dtype=object)
    for i in range(3):
        terms = [x[k] if R[i, k] == 1.0 else R[i, k] * x[k] for k in range(3) if R[i, k]]
        terms += [p[i]] if isinstance(p[i], Expression) or p[i] else []
        out[i] = sum(terms[1:], terms[0])
    return out


def hung_on(part: Any, places: Mapping[str, tuple[str, Array, Any]], bindings: list[Binding]) -> Any:
    """Return a part with what hangs on some bodies hung on others; these see the old one's frame at R, p."""
    names, new = rules_of(type(part)).keys(), dict[str, Any]()
    for side, end in _SIDES.items():
        if place := places.get(getattr(part, side, "")):
            new[side], R, p = place
            new |= {n: R @ getattr(part, n) for n in {f"rotation{end}", f"axis{end}"} & names}
            points = {f"translation{end}", f"point{end}"} & names
            new |= {n: moved_by(R, p, entries(part, n, bindings)) for n in points}
    return with_fields(part, new, bindings) if new else part
