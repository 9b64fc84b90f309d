"""Numbers of a model that become parameters, by path: ``"link.mass"``, ``"*.damping"``, ``"gravity"``."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import shown
from mbkit.errors import InputError, nearest
from mbkit.model.model import Model
from mbkit.model.parameters import Binding, Parameter
from mbkit.model.validation import static_bodies

_AXES: Final = ("x", "y", "z")
SYMMETRIC: Final = (
    *(("xx", (0, 0)), ("xy", (0, 1)), ("xz", (0, 2))),
    *(("yy", (1, 1)), ("yz", (1, 2)), ("zz", (2, 2))),
)
#: Kind of parts -> numbers that act in the dynamics and may be free. Earlier kinds have a name for themselves.
_FIELDS: Final = {
    "bodies": ("mass", "com", "inertia"),
    "joints": ("translation", "pitch", "armature", "damping", "stiffness", "rest", "ratio", "offset"),
    "springs": ("stiffness", "rest_length", "damping", "point_a", "point_b"),
    "couplings": ("stiffness", "rest_length", "damping", "armature"),
    "loops": ("translation_a", "translation_b", "length"),
    "couplers": ("ratio", "offset"),
    "prescribed": ("offset", "rate", "amplitude", "frequency", "phase"),
    "no_slip": ("translation_a", "translation_b", "radius", "speed"),
}
#: What no engine applies.
_DATA: Final = ("friction", "lower", "upper", "velocity_limit", "effort_limit")
_Entry = tuple[str, str, str, tuple[int, ...]]
#: Of loops, the length that a rod alone has.
_ROD: Final = "distance"


class Number(NamedTuple):
    """A number of a model: its path, that of its vector, where it stands, and its value."""

    path: str
    whole: str
    where: str
    part: str
    field: str
    indices: tuple[tuple[int, ...], ...]
    value: float

    @property
    def entries(self) -> tuple[_Entry, ...]:
        """Where it stands in the model, as a `Binding` says; a product of inertia stands twice."""
        return tuple((self.where, self.part, self.field, index) for index in self.indices)


@dataclass(frozen=True)
class Scale:
    """One factor of many numbers of a model; `mbkit.scale` makes it.

    Attributes
    ----------
    patterns : tuple of str
        Paths, as `Model.with_free` takes them.
    name : str
        Of the parameter, whose nominal value is 1.
    """

    patterns: tuple[str, ...]
    name: str

    def __str__(self) -> str:
        return self.name


def scale(*patterns: str, name: str | None = None) -> Scale:
    """Return one factor of many numbers, for `Model.with_free` and `mbkit.variants`.

    Parameters
    ----------
    *patterns : str
        Paths, such as ``"*.mass"``.
    name : str, optional
        Of the parameter; by default ``"scale(*.mass)"`` and the like.

    Examples
    --------
    >>> import mbkit as mb
    >>> heavier = mb.load("ur5").with_free(mb.scale("*.mass", "*.inertia", name="size"))
    >>> heavier.with_parameters(size=2.0).body("forearm_link").mass / heavier.body("forearm_link").mass
    2.0
    """
    if not patterns:
        raise InputError("scale: expected paths such as '*.mass', got none")
    for pattern in patterns:
        if not isinstance(pattern, str):
            raise InputError(f"scale: expected paths such as '*.mass', got {shown(pattern)}")
    if name is not None and not isinstance(name, str):
        raise InputError(f"name: expected text, got {shown(name)}")
    return Scale(patterns, f"scale({', '.join(patterns)})" if name is None else name)


def numbers_of(model: Model) -> Iterator[Number]:
    """Yield all numbers of a model that may be free."""
    yield from _entries("gravity", "gravity", "", "gravity", model.gravity, _AXES)
    for where, fields in _FIELDS.items():
        for part in getattr(model, where):
            for field in fields:
                yield from _of_part(where, part, field)


def _of_part(where: str, part: Any, field: str) -> Iterator[Number]:
    path = f"{part.name}.{field}"
    if where == "joints" and field in ("ratio", "offset"):
        value = getattr(part.mimic, field) if part.mimic else None
    elif (field == "pitch" and not part.type.pitched) or (field == "length" and part.kind != _ROD):
        value = None
    else:
        value = getattr(part, field, None)
    if value is None:
        return
    if np.ndim(value) == 0:
        yield Number(path, path, where, part.name, field, ((),), float(value))
    elif field == "inertia":
        for end, (i, k) in SYMMETRIC:
            both = ((i, k),) if i == k else ((i, k), (k, i))
            yield Number(f"{path}.{end}", path, where, part.name, field, both, float(value[i, k]))
    else:
        of_joint = where == "joints" and field != "translation"
        if of_joint and part.type.quaternion is not None:
            if field == "armature" and part.type.nv:
                # A rotor has the same inertia about every axis there.
                every = tuple((i,) for i in range(part.type.nv))
                yield Number(path, path, where, part.name, field, every, float(value[0]))
            if field in ("armature", "stiffness", "rest"):
                return
        yield from _entries(path, where, part.name, field, value, part.type.velocity_suffixes if of_joint else _AXES)


def _entries(path: str, where: str, part: str, field: str, values: Any, ends: Iterable[str]) -> Iterator[Number]:
    for i, (end, x) in enumerate(zip(ends, values, strict=True)):
        yield Number(f"{path}.{end}" if end else path, path, where, part, field, ((i,),), float(x))


def chosen(model: Model, pattern: str) -> list[Number]:
    """Return the numbers that a path fits; a wildcard leaves out what is zero, and bodies that never move."""
    if not isinstance(pattern, str):
        raise InputError(f"paths: expected text such as 'link.mass' or a scale, got {shown(pattern)}")
    every = list(numbers_of(model))
    found = [x for x in every if x.path == pattern or x.whole == pattern]
    if not found:
        moves = {x.whole for x in every if x.value} - _still(model, every)
        found = [x for x in every if fnmatchcase(x.path, pattern) or fnmatchcase(x.whole, pattern)]
        found = [x for x in found if x.whole in moves]
    if not found:
        raise InputError(_nothing(model, every, pattern))
    places = {x.path: x.where for x in found}
    if twice := [x for x in found if places[x.path] != x.where]:
        raise InputError(f"paths: {twice[0].path!r} is a number of two parts of one name; rename one of them")
    return found


def _still(model: Model, every: list[Number]) -> set[str]:
    static = static_bodies(model.joints)
    return {x.whole for x in every if x.where == "bodies" and x.part in static}


def _nothing(model: Model, every: list[Number], pattern: str) -> str:
    name, _, field = pattern.rpartition(".")
    item = f"paths: {pattern!r} fits no number of {model.name}"
    if field in _DATA:
        return f"{item}: {field} is data, and acts in no engine"
    frame = next((f for f in model.frames if pattern.startswith(f"{f.name}.")), None)
    if frame is not None and field.split(".")[0] in _FIELDS["bodies"]:
        end = pattern.removeprefix(f"{frame.name}.")
        return f"{item}: {frame.name!r} is a frame on body {frame.body!r}, which holds its inertia: {frame.body}.{end}"
    near = nearest(pattern, [x.path for x in every] + [x.whole for x in every])
    if near:
        return f"{item}; did you mean {near[0]!r}?"
    zero = [x.whole for x in every if fnmatchcase(x.path, pattern) or fnmatchcase(x.whole, pattern)]
    if zero:
        return f"{item} that acts; without a wildcard, as in {zero[0]!r}, a zero becomes a parameter too"
    fields = ", ".join(dict.fromkeys(x.field for x in every if name and fnmatchcase(x.part, name)))
    return f"{item}; " + (f"{name} has {fields}" if fields else "no part has this name")


def with_free(model: Model, paths: Iterable[Any]) -> Model:
    """Return a model with free numbers, as `Model.with_free` says."""
    model.require_bodies("with_free")
    bound = {(b.where, b.part, b.field, b.index): b.expression for b in model.bindings}
    new: dict[_Entry, Any] = {}
    paths = tuple(paths)
    for path in (x for x in paths if not isinstance(x, Scale)):
        for number in chosen(model, path):
            if (there := bound.get(number.entries[0])) is not None:
                if path in (number.path, number.whole):
                    raise InputError(f"paths: {number.path!r} is a parameter already, {there}; give that one a value")
                continue
            _require_other_name(model, number.path)
            new |= dict.fromkeys(number.entries, Parameter(number.path, number.value))
    for one in (x for x in paths if isinstance(x, Scale)):
        if one.name in {x.path for x in numbers_of(model)}:
            raise InputError(f"scale: {one.name!r} is the path of a number; give another name=")
        _require_other_name(model, one.name)
        for number in _scaled(model, one):
            factor = Parameter(one.name, 1.0)
            new |= {key: new.get(key, bound.get(key, number.value)) * factor for key in number.entries}
    kept = [b for b in model.bindings if (b.where, b.part, b.field, b.index) not in new]
    out = replace(model, bindings=(*kept, *(Binding(*key, x) for key, x in new.items())))
    if not (free := [name for name in out.parameters if name not in model.parameters]):
        return model
    return replace(out, notes=(*out.notes, f"free numbers: {', '.join(free)}"))


def _scaled(model: Model, one: Scale) -> list[Number]:
    return [*{x.path: x for pattern in one.patterns for x in chosen(model, pattern)}.values()]


def _require_other_name(model: Model, name: str) -> None:
    if name in model.parameters:
        raise InputError(f"paths: {model.name} has a parameter {name!r}, which stands elsewhere; a name is one number")
