"""Numbers of a model that become parameters, by path: ``"link.mass"``, ``"*.damping"``, ``"gravity"``.

``"link.log_cholesky"`` stands for ten numbers of which all values are bodies that can be (Rucker and Wensing 2022,
Smooth parameterization of rigid-body inertia, IEEE Robotics and Automation Letters 7(2)).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array, shown
from mbkit.errors import InputError, did_you_mean
from mbkit.model.elements.paths import OF_BODIES, Path
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.loops import ROLLING_KINDS
from mbkit.model.model import Model
from mbkit.model.parameters import Binding, Parameter
from mbkit.model.parts import ENTRIES, Body, Joint, NumberRule, numbers, rules_of
from mbkit.model.validation import static_bodies

SYMMETRIC: Final = (
    *(("xx", (0, 0)), ("xy", (0, 1)), ("xz", (0, 2))),
    *(("yy", (1, 1)), ("yz", (1, 2)), ("zz", (2, 2))),
)
FREE: Final = Path("free numbers", "", OF_BODIES)
#: Numbers of which not every part that has the field has one.
_WHERE: Final[dict[str, Callable[[Model, Any], bool]]] = {
    "pitch": lambda _, joint: joint.type.pitched,
    "length": lambda _, loop: loop.kind == "distance",
    "radius": lambda _, part: part.kind in ROLLING_KINDS,
    "speed": lambda _, part: part.kind not in ROLLING_KINDS,
    "curve": lambda _, coupler: len(coupler.leaders) == 1,
    "fraction": lambda model, force: force.body not in model.rotors,
    "stiffness": lambda _, part: not isinstance(part, Joint) or part.type.quaternion is None,
    "rest": lambda _, joint: joint.type.quaternion is None,
}
_Entry = tuple[str, str, str, tuple[int, ...]]
#: The ten numbers of a log-Cholesky factor, and the end of their path.
TEN: Final = ("alpha", "d1", "d2", "d3", "s12", "s23", "s13", "t1", "t2", "t3")
LOG_CHOLESKY: Final = ".log_cholesky"


class Number(NamedTuple):
    """A number of a model: its path, that of its vector, where it stands, its value, and the rule of its field."""

    path: str
    whole: str
    where: str
    part: str
    field: str
    indices: tuple[tuple[int, ...], ...]
    value: float
    rule: NumberRule

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
    for where in ("gravity", *KINDS_OF_PARTS):
        for part in (model,) if where == "gravity" else getattr(model, where):
            name = "" if where == "gravity" else part.name
            for field, rule, value in numbers(part):
                if rule.fixed or (field in _WHERE and not _WHERE[field](model, part)):
                    continue
                whole = f"{name}.{field}" if name else field
                for end, indices in _entries(part, field, rule, np.asarray(value)):
                    x = float(np.asarray(value)[indices[0]])
                    path = f"{name}.{end}" if field == "numbers" else f"{whole}.{end}" if end else whole
                    # The whole of a bushing's matrix is its diagonal, and what is not zero.
                    alone = field == "numbers" or (len(indices[0]) == 2 and "." in end and not x)
                    yield Number(path, path if alone else whole, where, name, field, indices, x, rule)


def _entries(
    part: Any, field: str, rule: NumberRule, value: Array
) -> Iterator[tuple[str, tuple[tuple[int, ...], ...]]]:
    """Yield the numbers of a field: the end of the path, and the indices at which it stands."""
    if value.ndim == 2:
        names, symmetric = ENTRIES[: len(value)], field == "inertia" or np.array_equal(value, value.T, equal_nan=True)
        for i, k in np.ndindex(value.shape):
            if i <= k or not symmetric:
                end = names[i] + names[k] if field == "inertia" else names[i] if i == k else f"{names[i]}.{names[k]}"
                yield end, ((i, k), (k, i)) if symmetric and i != k else ((i, k),)
    elif rule.does == "T" and value.ndim and part.type.quaternion is not None:
        # A rotor has the same inertia about every axis there.
        yield "", tuple((i,) for i in range(len(value)))
    elif value.ndim:
        yield from ((end, ((i,),)) for ends in rule.entries(part) or () for i, end in enumerate(ends))
    else:
        yield "", ((),)


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
    static = static_bodies(model.joints) | model.rotors
    return {x.whole for x in every if x.where == "bodies" and x.part in static}


def _nothing(model: Model, every: list[Number], pattern: str) -> str:
    name, _, field = pattern.rpartition(".")
    item = f"paths: {pattern!r} fits no number of {model.name}"
    every_part = (part for where in KINDS_OF_PARTS for part in getattr(model, where) if fnmatchcase(part.name, name))
    if why := next((r[field].fixed for r in map(rules_of, map(type, every_part)) if field in r and r[field].fixed), ""):
        return f"{item}: {field} cannot be free: {why}"
    frame = next((f for f in model.frames if pattern.startswith(f"{f.name}.")), None)
    if frame is not None and field.split(".")[0] in rules_of(Body):
        end = pattern.removeprefix(f"{frame.name}.")
        return f"{item}: {frame.name!r} is a frame on body {frame.body!r}, which holds its inertia: {frame.body}.{end}"
    if near := did_you_mean(pattern, [x.path for x in every] + [x.whole for x in every]):
        return item + near
    zero = [x.whole for x in every if fnmatchcase(x.path, pattern) or fnmatchcase(x.whole, pattern)]
    if zero:
        return f"{item} that acts; without a wildcard, as in {zero[0]!r}, a zero becomes a parameter too"
    fields = ", ".join(dict.fromkeys(x.field for x in every if name and fnmatchcase(x.part, name)))
    return f"{item}; " + (f"{name} has {fields}" if fields else "no part has this name")


def body_of_log_cholesky(ten: Sequence[Any]) -> dict[str, Any]:
    """Return mass, centre of mass and inertia about it, of the numbers `TEN` of any kind that `numpy.exp` takes.

    The pseudo-inertia is U Uᵀ with U = exp(alpha) [[V, t], [0, 1]] and V upper triangular with the diagonal exp(d): the
    mass is exp(2 alpha), the centre of mass t, and the second moments about it are exp(2 alpha) V Vᵀ.
    """
    alpha, d1, d2, d3, s12, s23, s13, *t = ten
    mass = np.exp(2.0 * alpha)
    V = [[np.exp(d1), s12, s13], [np.exp(d2), s23], [np.exp(d3)]]
    # Rows begin at the diagonal.
    second = {(i, k): sum(x * y for x, y in zip(V[i][k - i :], V[k], strict=True)) for _, (i, k) in SYMMETRIC}
    trace = sum(second[i, i] for i in range(3))
    inertia = {index: mass * (trace - x if index[0] == index[1] else -x) for index, x in second.items()}
    return {"mass": mass, "com": t, "inertia": inertia}


def log_cholesky(body: Body) -> dict[str, float]:
    """Return the log-Cholesky numbers of a body by their paths; `InputError` for one without extent."""
    second = 0.5 * np.trace(body.inertia) * np.eye(3) - body.inertia
    try:
        # Upper triangular: the lower factor of the axes in the other order.
        V = np.linalg.cholesky(second[::-1, ::-1] / body.mass)[::-1, ::-1] if body.mass > 0 else np.zeros((3, 3))
        d = [math.log(x) for x in np.diag(V)]
    except (np.linalg.LinAlgError, ValueError):
        raise InputError(
            f"paths: body {body.name!r} has no log-Cholesky factor, which needs mass and extent along three axes"
        ) from None
    ten = (0.5 * math.log(body.mass), *d, V[0, 1], V[1, 2], V[0, 2], *body.com)
    return {f"{body.name}{LOG_CHOLESKY}.{name}": float(x) for name, x in zip(TEN, ten, strict=True)}


def _factored(model: Model, path: str, bound: Container[_Entry]) -> dict[_Entry, Any]:
    """Return the expressions of the bodies that a path of log-Cholesky factors fits."""
    new: dict[_Entry, Any] = {}
    for name in dict.fromkeys(x.part for x in chosen(model, f"{path.removesuffix(LOG_CHOLESKY)}.mass")):
        own = body_of_log_cholesky([Parameter(*pair) for pair in log_cholesky(model.body(name)).items()])
        new["bodies", name, "mass", ()] = own["mass"]
        new |= {("bodies", name, "com", (i,)): x for i, x in enumerate(own["com"])}
        new |= {("bodies", name, "inertia", at): x for (i, k), x in own["inertia"].items() for at in ((i, k), (k, i))}
        if any(key in bound for key in new):
            raise InputError(f"paths: {path!r}: numbers of {name!r} are parameters already")
    return new


def with_free(model: Model, paths: Iterable[Any]) -> Model:
    """Return a model with free numbers, as `Model.with_free` says."""
    FREE.admit(model, "with_free: not known of")
    bound = {(b.where, b.part, b.field, b.index): b.expression for b in model.bindings}
    new: dict[_Entry, Any] = {}
    paths = tuple(paths)
    factors = [x for x in paths if isinstance(x, str) and x.endswith(LOG_CHOLESKY)]
    for path in (x for x in paths if not isinstance(x, Scale) and x not in factors):
        for number in chosen(model, path):
            if (there := bound.get(number.entries[0])) is not None:
                if path in (number.path, number.whole):
                    raise InputError(f"paths: {number.path!r} is a parameter already, {there}; give that one a value")
                continue
            _require_other_name(model, number.path)
            new |= dict.fromkeys(number.entries, Parameter(number.path, number.value))
    for path in factors:
        new |= _factored(model, path, {*bound, *new})
    for one in (x for x in paths if isinstance(x, Scale)):
        if one.name in {x.path for x in numbers_of(model)}:
            raise InputError(f"scale: {one.name!r} is the path of a number; give another name=")
        _require_other_name(model, one.name)
        for number in _scaled(model, one):
            factor = Parameter(one.name, 1.0)
            new |= {key: new.get(key, bound.get(key, number.value)) * factor for key in number.entries}
    kept = [b for b in model.bindings if (b.where, b.part, b.field, b.index) not in new]
    out = replace(model, bindings=(*kept, *(Binding(*key, x) for key, x in new.items())))
    if factors:
        # The numbers of the factors, to rounding.
        out = out._substituted(lambda p: p)
    if not (free := [name for name in out.parameters if name not in model.parameters]):
        return model
    return replace(out, notes=(*out.notes, f"free numbers: {', '.join(free)}"))


def _scaled(model: Model, one: Scale) -> list[Number]:
    return [*{x.path: x for pattern in one.patterns for x in chosen(model, pattern)}.values()]


def _require_other_name(model: Model, name: str) -> None:
    if name in model.parameters:
        raise InputError(f"paths: {model.name} has a parameter {name!r}, which stands elsewhere; a name is one number")
