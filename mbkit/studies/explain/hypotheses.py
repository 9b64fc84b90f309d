"""Differences between two descriptions: a name, a sentence, and fields of parts with the values of either side.

Each field belongs to one difference alone, so that any of them can be added to the first description or removed from
the second without the others. Usual mistakes are rows: kind, sentence, changed fields. A row may be known beforehand
(`body_mistakes`, `joint_mistakes`), or follow from the numbers of the other side (`fitted_body`, `fitted_joint`). What
no row explains is told with its numbers, so that each difference has a name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import chain, permutations, product
from typing import Any, Final, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from mbkit import spatial
from mbkit._check import Array, by_key
from mbkit.load.shapes import NOTHING, MassProperties
from mbkit.model import Joint, Mimic
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.formula import NUMPY, Formula
from mbkit.model.elements.motion_laws import MOTION_LAWS, Motion, interval, position
from mbkit.model.elements.references import called
from mbkit.model.loops import CROSSED, HINGED, SLIDING, WELDED
from mbkit.model.parts import Coupler, Loop, NumberRule, acting, rules_of
from mbkit.studies.explain.merged_model import (
    OTHERS,
    LinkInBody,
    MergedModel,
    Tolerances,
    Where,
    composite,
    number_text,
    rules_for,
)

Part = TypeVar("Part")


class Holder(Protocol):
    """A description, or what holds one: it can change fields of its parts."""

    def put(self, where: Where, values: Mapping[str, Any]) -> Self:
        """Return it with other fields in one part."""
        ...


Held = TypeVar("Held", bound=Holder)

#: Kind of a difference, and noun, where they are not the description's word for a part.
_WORDS: Final = {
    "springs": ("point spring", "spring"),
    "couplings": ("joint coupling", "coupling"),
    "prescribed": ("prescribed motion", "motion of"),
    "no_slip": ("contact without slip", "no slip"),
}
#: What an end of a loop has.
_OF_END: Final = ("body", "rotation", "translation")
#: Relative difference of numbers written with five digits.
_ROUNDED_DIFFERENCE: Final = 2e-5
#: Most differences that are never summarized as rounding.
_MAX_LISTED_ALONE: Final = 4
_DEGREE: Final = np.pi / 180
#: URDF's order of an inertia's six numbers, and MuJoCo's.
_URDF: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MJCF: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Numbers of a joint that are data.
_BOUNDS: Final = tuple(name for name, rule in rules_of(Joint).items() if not rule.acts)
#: Words for a field, where they are not its name.
_FIELD_WORDS: Final = {
    "com": "centre of mass",
    "lower": "lower limit",
    "upper": "upper limit",
    "stribeck_velocity": "Stribeck velocity",
}
#: Kinds of differences in fields, where they are not the field's name.
_FIELD_KINDS: Final = {
    **_FIELD_WORDS,
    **dict.fromkeys(_BOUNDS, "limits"),
    "translation": "joint origin",
    "rotation": "joint rotation",
    "axes": "axis",
    "stiffness": "spring",
    "rest": "spring",
    "restitution": "stops",
}
_PLACE: Final = ("rotation", "translation")
_SPRING: Final = ("stiffness", "rest")
MATTER: Final = ("mass", "com", "inertia")
#: Most numbers of a field that a sentence says.
_MAX_NUMBERS_SHOWN: Final = 9


class Mistake(NamedTuple):
    """A named difference of one part: its kind, a sentence that begins with a verb, and the changed fields."""

    kind: str
    says: str
    fields: Mapping[str, Any]


class Change(NamedTuple):
    """Fields of one part on both sides."""

    where: Where
    ours: Mapping[str, Any]
    theirs: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A difference between two descriptions, with a name; `a` and `b` are its numbers."""

    kind: str
    subject: str
    says: str
    changes: tuple[Change, ...] = ()
    a: Any = None
    b: Any = None

    def sentence(self, other: str) -> str:
        """Return what it says of the other side, by its name."""
        return f"{self.subject}{': ' * bool(self.subject)}{other} {self.says}"

    def apply(self, x: Held) -> Held:
        """Put the difference into a description."""
        for change in self.changes:
            x = x.put(change.where, change.theirs)
        return x

    def revert(self, x: Held) -> Held:
        """Take the difference out of a description that has it."""
        for change in self.changes:
            x = x.put(change.where, change.ours)
        return x


def named(
    where: Where, a: Any, b: Any, groups: Iterable[Sequence[str]], rows: Iterable[Mistake], near: Tolerances
) -> Iterator[Hypothesis]:
    """Yield the differences that turn part `a` into part `b`, each field once.

    Of each group of fields, the first row that explains all that differ in it, else the first for each field. Fields
    that no row explains are told with their numbers, those of one kind together.
    """
    apart = [names for group in groups if (names := near.differing(a, b, *group))]
    known = list(rows) if apart else []

    def explained(*names: str) -> Iterator[tuple[Mistake, Hypothesis]]:
        for x in known:
            changed = dict.fromkeys([*names, *x.fields])
            if x.fields.keys() & {*names} and not near.differing(replace(a, **x.fields), b, *changed):
                yield x, told(x.kind, x.says, changed)

    def told(kind: str, says: str, names: Iterable[str]) -> Hypothesis:
        ours, theirs = ({n: getattr(side, n) for n in names} for side in (a, b))
        numbers = [*ours.values(), *theirs.values()]
        if len(numbers) != 2 or not all(isinstance(v, (float, np.ndarray)) for v in numbers):
            numbers = [None, None]
        section, *holder, name = where if len(where) > 1 else (*where, "")
        fixed = f", fixed to {holder[0]!r}" if holder and holder[0] not in (name, "world") else ""
        subject = f"{called(section)} {name!r}{fixed}" if section else ""
        return Hypothesis(kind, subject, says, (Change(where, ours, theirs),), *numbers)

    for names in apart:
        if whole := next(explained(*names), None):
            yield whole[1]
            continue
        left = dict.fromkeys(names)
        for name in names:
            if name in left and (found := next(explained(name), None)):
                left = {n: None for n in left if n not in found[0].fields}
                yield found[1]
        for kind, some in by_key((kind_of(n), n) for n in left).items():
            yield told(kind, f"has {changed_text(a, b, some)}", some)


def kind_of(field: str) -> str:
    """Return the kind of a difference in a field."""
    return _FIELD_KINDS.get(field, field.replace("_", " "))


def absences(joint: Joint) -> list[Mistake]:
    """Return the loss of each number that adds to energies or forces along a coordinate or its rate."""
    lost = ((n, kind_of(n)) for n, rule in rules_of(Joint).items() if rule.does)
    return _changing(joint, ((kind, f"has no {kind}", {n: 0.0 * getattr(joint, n)}) for n, kind in lost))


def changed_text(a: Any, b: Any, names: Iterable[str]) -> str:
    """Return fields of two parts as text: their numbers, or that they are other ones."""
    return ", ".join(_changed(n, acting(a, n), acting(b, n), rules_for(a).get(n)) for n in names)


def _changed(name: str, a: Any, b: Any, rule: NumberRule | None) -> str:
    what = _FIELD_WORDS.get(name, name.replace("_", " "))
    if isinstance(b, np.ndarray) and b.size and np.isinf(b).all():
        return f"no {what} ({number_text(a)})"
    if any((isinstance(x, np.ndarray) and x.size > _MAX_NUMBERS_SHOWN) or isinstance(x, Formula) for x in (a, b)):
        return f"another {what}"
    unit = rule.unit if rule and rule.unit and "," not in rule.unit else ""
    return f"{what} {_text(b)} for {_text(a)} {unit}".rstrip()


def _text(x: Any) -> str:
    if isinstance(x, Mimic):
        return f"{number_text(x.ratio)} {x.joint} + {number_text(x.offset)}"
    return number_text(x) if isinstance(x, (float, np.ndarray)) else "none" if x is None else repr(x)


def _changing(part: Any, rows: Iterable[tuple[str, str, Mapping[str, Any]]]) -> list[Mistake]:
    """Return the mistakes that change a part."""
    some = (Mistake(*row) for row in rows)
    return [x for x in some if not all(np.array_equal(getattr(part, name), y) for name, y in x.fields.items())]


def _reordered(R: Array) -> list[Array]:
    """Return the rotation with its quaternion written w first and read w last, and the reverse."""
    x, y, z, w = spatial.quaternion_from_matrix(R)
    return [spatial.matrix_from_quaternion(np.array(q)) for q in ([w, x, y, z], [y, z, w, x])]


def turn_of(R: Array) -> Array:
    """Return a rotation's axis times its angle in rad, (3,)."""
    with np.errstate(divide="ignore"):
        return spatial.log_quaternion(spatial.quaternion_from_matrix(R))


# Bodies.


def body_mistakes(links: Sequence[LinkInBody], R_PJ: Array, *, base: bool = False) -> list[Mistake]:
    """Return the usual mistakes with a body of these links, its own first, whatever the other side has.

    The joint that carries the body has the rotation R_PJ; `base` says whether it is a base that moves freely.
    """
    at = composite(links)
    m, c, I = at.mass, at.com, at.inertia
    steiner = -m * spatial.skew(c) @ spatial.skew(c)
    from_origin = "has the inertia about the body's origin for that about the centre of mass"
    to_com = "takes the inertia to be about the body's origin, and moves it to the centre of mass"
    rows: list[tuple[str, str, dict[str, Any]]] = [
        ("base mass" if base else "lost body", "has no matter in it", vars(NOTHING)),
        *_merge_mistakes(links),
        ("inertia about the wrong point", from_origin, {"inertia": I + steiner}),
        ("inertia about the wrong point", to_com, {"inertia": I - steiner}),
        ("inertia axes", "has the inertia in the parent's axes", {"inertia": R_PJ @ I @ R_PJ.T}),
        ("inertia axes", "has the inertia in axes turned against its own", {"inertia": R_PJ.T @ I @ R_PJ}),
        *_product_mistakes(I),
        *_vector_mistakes("centre of mass", "com", c, R_PJ),
    ]
    for mass, says in (
        (m, "has the inertia of a ball of water of its mass"),
        (1.0, "has a ball of water of 1 kg in its place"),
    ):
        # Drake's substitute for inconsistent matter: a ball of water.
        if mass > 0:
            radius = (mass / (4 / 3 * np.pi * 1000.0)) ** (1 / 3)
            rows.append(("replaced inertia", says, {"mass": mass, "inertia": 0.4 * mass * radius**2 * np.eye(3)}))
    rows += [
        x for unit, name in (("mass", "mass"), ("inertia", "inertia")) for x in _units(unit, name, getattr(at, name))
    ]
    return _changing(at, rows)


def _vector_mistakes(kind: str, name: str, x: Array, R: Array) -> Iterator[tuple[str, str, dict[str, Any]]]:
    yield kind, f"has the {kind} at the origin", {name: 0.0 * x}
    yield kind, f"has the {kind} on the other side of the origin", {name: -x}
    yield from ((kind, f"has the {kind} in other axes", {name: Q @ x}) for Q in (R, R.T))
    yield from _units("length", name, x)


def _units(unit: str, name: str, x: Any) -> Iterator[tuple[str, str, dict[str, Any]]]:
    for factor in (1e3, 1e-3, 1e6, 1e-6):
        says = f"has {factor:g} times the {_FIELD_KINDS.get(name, name)}, as in another unit"
        yield f"unit of {unit}", says, {name: factor * x}


def _merge_mistakes(links: Sequence[LinkInBody]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield mistakes with links that are fixed to each other."""

    def unturned(x: LinkInBody) -> LinkInBody:
        return replace(x, matter=replace(x.matter, inertia=x.R.T @ x.matter.inertia @ x.R))

    own, *fixed = links
    heavy = [x for x in fixed if x.massive]
    for one in heavy:
        rest = composite([x for x in links if x is not one])
        yield "lost body", f"leaves out link {one.name!r}, which is fixed to it", vars(rest)
    groups = [(f"link {x.name!r}", [x]) for x in heavy]
    if len(heavy) > 1:
        yield "lost body", "leaves out every link that is fixed to it", vars(composite([own]))
        groups.append(("its links", heavy))
    for which, some in groups:
        for kind, how, change in (
            ("fused with a rotated frame", "without turning it", lambda x: replace(x, R=np.eye(3))),
            ("fused with a rotated frame", "turned the wrong way", lambda x: replace(x, R=x.R.T)),
            ("fused with a rotated frame", "without turning its inertia", unturned),
            ("fused at the wrong place", "at the origin", lambda x: replace(x, p=np.zeros(3))),
        ):
            whole = composite([change(x) if x in some else x for x in links])
            yield kind, f"fuses {which} {how}", vars(whole)
    if heavy:
        total = sum((x.mass_properties.inertia for x in links), np.zeros((3, 3)))
        says = "adds the inertias of its links, each about its own centre of mass"
        yield "inertia about the wrong point", says, {"inertia": total}


def _product_mistakes(I: Array) -> Iterator[tuple[str, str, dict[str, Any]]]:
    diagonal = np.diag(np.diag(I))
    yield "products of inertia", "has the products of inertia with the other sign", {"inertia": 2 * diagonal - I}
    yield "products of inertia", "has no products of inertia", {"inertia": diagonal}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        flipped = I.copy()
        flipped[i, j] = flipped[j, i] = -I[i, j]
        yield "products of inertia", f"has I{'xyz'[i]}{'xyz'[j]} with the other sign", {"inertia": flipped}
    for order, other, says in ((_URDF, _MJCF, "URDF's order read in MJCF's"), (_MJCF, _URDF, "MJCF's order in URDF's")):
        misread = np.zeros((3, 3))
        for (i, j), (k, l) in zip(order, other, strict=True):
            misread[k, l] = misread[l, k] = I[i, j]
        yield "order of the inertia's numbers", f"has the inertia's six numbers in {says}", {"inertia": misread}


def fitted_body(a: MassProperties, b: MassProperties, usual: Iterable[Mistake], near: Tolerances) -> Iterator[Mistake]:
    """Yield the rows for what turns matter `a` into `b` beyond the usual mistakes."""
    if a.mass and b.mass:
        factor = b.mass / a.mass
        says = f"has {number_text(factor)} times the mass, and the inertia with it"
        yield Mistake("mass", says, {"mass": b.mass, "inertia": factor * a.inertia})
    if not a.mass and not a.inertia.any():
        yield Mistake("added body", "has matter in it", vars(b))
    # An inertia has the name of a usual mistake whatever else of the body differs.
    yield from (x._replace(fields={"inertia": x.fields["inertia"]}) for x in usual if "inertia" in x.fields)
    moments, others = (np.diag(np.linalg.eigvalsh(x.inertia)) for x in (a, b))
    if near.inertia(moments, others, a.mass):
        if _has_reordered_axes(a.inertia, b.inertia, a.mass, near):
            says = "has the inertia in axes whose quaternion was read in the wrong order"
            yield Mistake("quaternion order", says, {"inertia": b.inertia})
        says = f"has the same principal moments in other axes: {changed_text(a, b, ['inertia'])}"
        yield Mistake("inertia axes", says, {"inertia": b.inertia})
    # Newton's correction of an inertia that no body can have, or of less than 1e-6 kg m².
    if (more := np.trace(b.inertia - a.inertia) / 3) > 0:
        says = f"has {number_text(float(more))} kg m² more about every axis"
        yield Mistake("corrected inertia", says, {"inertia": a.inertia + more * np.eye(3)})
    if np.trace(a.inertia):
        factor = float(np.trace(b.inertia) / np.trace(a.inertia))
        yield Mistake("inertia", f"has {number_text(factor)} times the inertia", {"inertia": factor * a.inertia})


def _has_reordered_axes(a: Array, b: Array, mass: float, near: Tolerances) -> bool:
    """Return whether b is a in principal axes whose quaternion was read in another order.

    That shows where the axes are known, and not merely exchanged, as those of a cylinder that lies along another one.
    """
    moments, axes = np.linalg.eigh(a)
    across = np.abs(axes.T @ np.linalg.eigh(b)[1])
    if any(map(near.number, moments[:2], moments[1:])) or near.vector(across, np.round(across)):
        return False
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        Q = axes[:, order] * signs
        for R in _reordered(Q) if np.linalg.det(Q) > 0 else ():
            turned = R @ np.diag(moments[list(order)]) @ R.T
            if np.linalg.norm(turn_of(R.T @ Q)) > near.relative and near.inertia(turned, b, mass):
                return True
    return False


# Joints.


def joint_mistakes(joint: Joint) -> list[Mistake]:
    """Return the usual mistakes with a joint, whatever the other side has."""
    R, p, axes, pitch = joint.rotation, joint.translation, joint.axes, joint.pitch
    angles = np.array(spatial.rpy_from_matrix(R))
    roll, pitching, yaw = (spatial.matrix_from_rpy(*x) for x in np.diag(angles))
    too_large, too_small = (
        spatial.matrix_from_rpy(*np.remainder(factor * angles, 2 * np.pi)) for factor in (1 / _DEGREE, _DEGREE)
    )
    rows: list[tuple[str, str, dict[str, Any]]] = []
    if joint.mimic is not None:
        rows.append(("mimic", f"leaves it free, which follows {joint.mimic.joint!r}", {"mimic": None}))
        rows.append(("mimic", "leaves out the offset at which it follows", {"mimic": replace(joint.mimic, offset=0.0)}))
    for factor, says in ((_DEGREE, "per degree for per radian"), (1 / _DEGREE, "per radian for per degree")):
        given = ((n, getattr(joint, n)) for n, rule in rules_of(Joint).items() if rule.does and "/rad" in rule.unit)
        rows += [("unit of angle", f"has {n} {says}", {n: factor * x}) for n, x in given]
    misread = "reads the joint's quaternion in the wrong order"
    inverse = {"rotation": R.T, "translation": -R.T @ p}
    rows += [
        ("unit of pitch", "takes a pitch per radian for one per turn", {"pitch": 2 * np.pi * pitch}),
        ("unit of pitch", "takes a pitch per turn for one per radian", {"pitch": 1 / (2 * np.pi) * pitch}),
        ("pitch", "has the pitch with the other sign", {"pitch": -pitch}),
        ("pitch", "has no pitch", {"pitch": 0.0}),
        ("axis sign", "has the axis the other way round", {"axes": -axes}),
        ("axis", "has the axis in the parent's axes", {"axes": axes @ R}),
        ("axis", "has the axis in other axes", {"axes": axes @ R.T}),
        *(("quaternion order", misread, {"rotation": x}) for x in _reordered(R)),
        ("inverse rotation", "has the joint's rotation the wrong way round", {"rotation": R.T}),
        ("rotation left out", "has no rotation at the joint", {"rotation": np.eye(3)}),
        ("order of angles", "turns by roll, pitch, yaw in the other order", {"rotation": roll @ pitching @ yaw}),
        ("unit of angle", "takes degrees for radians in the joint's rotation", {"rotation": too_large}),
        ("unit of angle", "takes radians for degrees in the joint's rotation", {"rotation": too_small}),
        *_vector_mistakes("joint origin", "translation", p, R),
        ("inverse placement", "has the joint's placement the wrong way round", inverse),
    ]
    return _changing(joint, rows)


def groups_of(a: Joint, b: Joint) -> list[Sequence[str]]:
    """Return the fields of two joints that are named together."""
    own = [f.name for f in fields(Joint) if f.name not in ("name", "parent", "child")]
    if a.type.motion != b.type.motion:
        # The numbers of one joint type mean nothing to the other.
        return [["parent"], own]
    springs = [_SPRING] if a.stiffness.any() or b.stiffness.any() else []
    alone = ([n] for n in own if n not in ("kind", *_PLACE, *_SPRING, *_BOUNDS))
    return [["parent"], _PLACE, *alone, *springs, _BOUNDS]


def fitted_joint(a: Joint, b: Joint, near: Tolerances) -> Iterator[Mistake]:
    """Yield the rows for what turns joint `a` into `b` beyond the usual mistakes."""
    if a.type.motion != b.type.motion:
        whole = {n: getattr(b, n) for n in groups_of(a, b)[1]}
        yield Mistake("joint kind", f"has it as a {b.kind} joint, not a {a.kind} one", whole)
        return
    if (a.restitution is None) != (b.restitution is None):
        yield Mistake("stops", f"has {'no ' * a.stops}stops", {"restitution": b.restitution})
    turn, shift = turn_of(a.rotation.T @ b.rotation), a.rotation.T @ (b.translation - a.translation)
    rotation, translation = {"rotation": b.rotation}, {"translation": b.translation}
    if a.type.axial and a.type.rotates and np.allclose(np.cross(turn, a.axes[0]), 0.0, atol=1e-9):
        yield Mistake("zero position", f"counts from {_angle(float(turn @ a.axes[0]))} further on", rotation)
    if a.type.axial and not a.type.rotates and near.point(np.cross(shift, a.axes[0]), np.zeros(3)):
        yield Mistake("zero position", f"counts from {number_text(float(shift @ a.axes[0]))} m further on", translation)
    yield Mistake("joint rotation", f"has it turned by {_angle(float(np.linalg.norm(turn)))}", rotation)


def _angle(x: float) -> str:
    return f"{number_text(x)} rad ({number_text(x / _DEGREE)}°)"


# All differences of two descriptions.


def words(section: str) -> tuple[str, str]:
    """Return the kind of a difference in parts of this section, and the noun before a part's name."""
    return _WORDS.get(section, (called(section), called(section)))


#: Kinds of differences that act on the motion through no term, but through constraints.
CONSTRAINTS: Final = frozenset(words(section)[0] for section in CONSTRAINT_FEATURES)


def summarized_differences(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    """Return the differences between two descriptions; many small ones are one, called rounding."""
    fine = differences(one, other, near)
    if len(fine) <= _MAX_LISTED_ALONE:
        return fine
    coarse = differences(one, other, replace(near, relative=max(_ROUNDED_DIFFERENCE, near.relative)))
    if len(coarse) > len(fine) // 2:
        return fine
    large = {(change.where, name) for h in coarse for change in h.changes for name in change.ours}
    small = []
    for where, *sides in (change for h in fine for change in h.changes):
        ours, theirs = ({n: x for n, x in side.items() if (where, n) not in large} for side in sides)
        small += [Change(where, ours, theirs)] if ours else []
    says = f"has rounded numbers: {len(small)} of them differ, by less than {_ROUNDED_DIFFERENCE:.0e} of their size"
    return [*coarse, Hypothesis("rounding", "", says, tuple(small))]


def differences(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    """Return the differences that turn `one` into `other`, part by part."""
    a, b = one.model, other.model
    gravity = f"has the gravity {number_text(b.gravity)} m/s² for {number_text(a.gravity)}"
    rows = (("has no gravity", 0 * a.gravity), ("has gravity with the other sign", -a.gravity), (gravity, b.gravity))
    signs = [Mistake("gravity", says, {"gravity": x}) for says, x in rows]
    out = [*named(("",), a, b, [["gravity"]], signs, near)]
    out += chain(*(_other_parts(section, one, other, near) for section in OTHERS))
    theirs = {j.name: j for j in b.joints}
    for joint, there in ((j, theirs[j.name]) for j in a.joints if j.name in theirs):
        usual = chain(joint_mistakes(joint), fitted_joint(joint, there, near))
        out += named(("joints", joint.name), joint, there, groups_of(joint, there), usual, near)
        out += _matter_differences(one, joint, other, near)
    return out


# Matter.


def _matter_differences(one: MergedModel, joint: Joint, other: MergedModel, near: Tolerances) -> Iterator[Hypothesis]:
    body, b = joint.child, other.mass_properties(joint.child)
    if not near.same(one.mass_properties(body), b):
        base = joint.type.floating and joint.parent == "world"
        apart = _links_apart(one, other, body, near)
        yield from apart or _of_matter(("bodies", body), one.links[body], joint.rotation, b, near, base)


def _links_apart(one: MergedModel, other: MergedModel, body: str, near: Tolerances) -> list[Hypothesis]:
    """Return the differences of a body link by link, where both sides know the same links of it."""
    ours, theirs, out = one.links[body], {x.name: x.matter for x in other.links[body]}, list[Hypothesis]()
    if len(ours) > 1 and theirs.keys() == {x.name for x in ours}:
        for x in (x for x in ours if not near.same(x.matter, theirs[x.name])):
            # In common axes.
            alone, R = replace(x, R=np.eye(3), p=np.zeros(3)), np.eye(3)
            out += _of_matter(("links", body, x.name), [alone], R, theirs[x.name], near)
    return out


def _of_matter(
    where: Where, links: Sequence[LinkInBody], R: Array, b: MassProperties, near: Tolerances, base: bool = False
) -> Iterator[Hypothesis]:
    a, usual = composite(links), body_mistakes(links, R, base=base)
    return named(where, a, b, [MATTER], chain(usual, fitted_body(a, b, usual, near)), near)


def ground_differences(one: MergedModel, other: MergedModel, near: Tolerances, first: str) -> Iterator[Hypothesis]:
    """Yield the difference in the matter that stands still, which no term has."""
    a, b = one.ground, other.ground
    if near.same(a, b):
        return
    says = f"has {number_text(a.mass)} -> {number_text(b.mass)} kg standing still"
    if not b.mass and a.mass:
        says = f"has no mass in what stands still, where {first} has {number_text(a.mass)} kg"
    elif near.number(a.mass, b.mass):
        some = [f"{x.subject} {x.says}" for x in _links_apart(one, other, "world", near)]
        says = f"has other matter of the same mass standing still{': ' if some else ''}{', '.join(some)}"
    yield Hypothesis("base mass", "the base", says, a=a.mass, b=b.mass)


def links_in_common_axes(one: MergedModel, other: MergedModel, near: Tolerances) -> tuple[MergedModel, MergedModel]:
    """Return both descriptions with their common links in the same axes.

    A link whose frame differs between the two has its body's axes in both.
    """
    sides = dict(one.links), dict(other.links)
    for name in sides[0].keys() & sides[1].keys():
        there = {x.name: x for x in sides[1][name]}
        pairs = [(x, there[x.name]) for x in sides[0][name] if x.name in there]
        apart = {x.name for x, y in pairs if not (near.vector(x.R, y.R) and near.point(x.p, y.p))}
        for side in sides:
            side[name] = tuple(
                LinkInBody(x.name, np.eye(3), np.zeros(3), x.mass_properties) if x.name in apart else x
                for x in side[name]
            )
    return MergedModel(one.model, sides[0]), MergedModel(other.model, sides[1])


# Parts of all other kinds.


def _other_parts(section: str, one: MergedModel, other: MergedModel, near: Tolerances) -> Iterator[Hypothesis]:
    ours, theirs = ({x.name: x for x in getattr(side.model, section)} for side in (one, other))
    kind, what = words(section)
    pairs: list[tuple[Any, Any]] = [(x, theirs[n]) for n, x in ours.items() if n in theirs]
    alone, left = ([x for n, x in side.items() if n not in there] for side, there in ((ours, theirs), (theirs, ours)))
    if section == "loops":
        # Loops of other names are known by their ends.
        same, alone = paired(alone, left, lambda a, b: _apart(a, b, near))
        pairs += same
        if same:
            others = ", ".join(f"{a.name!r} is {b.name!r}" for a, b in same)
            yield Hypothesis("renamed", "", f"calls loops otherwise: {others}")
    for a, b in (*pairs, *((x, None) for x in alone), *((None, x) for x in left)):
        says = "lacks it" if b is None else "has it besides" if a is None else _other_numbers(a, b, near)
        if says:
            both = {x.name: None for x in (a, b) if x is not None}
            one_side, other_side = (both if x is None else both | {x.name: x} for x in (a, b))
            name = (b if a is None else a).name
            yield Hypothesis(kind, f"{what} {name!r}", says, (Change((section,), one_side, other_side),))


def _apart(a: Loop, b: Loop, near: Tolerances) -> float:
    """Return how far two loops are from one another; infinite where they hold other things together."""
    same = [x for x in (b, exchanged(b)) if (x.kind, x.body_a, x.body_b) == (a.kind, a.body_a, a.body_b)]
    return min((sum(moved(a, x)) for x in same), default=np.inf if loop_differences(a, b, near) else 0.0)


def _other_numbers(a: Any, b: Any, near: Tolerances) -> str:
    """Return what differs between two parts; empty where nothing does."""
    if isinstance(a, Loop):
        return ", and ".join(loop_differences(a, b, near))
    if type(a) in MOTION_LAWS:
        return "" if _same_motion(a, b, near) else "moves it otherwise"
    if type(a) is not type(b):
        return f"has another kind of it: {b} for {a}"
    others = near.differing(a, b)
    if isinstance(a, Coupler) and others:
        return f"has {follows(b)} for {follows(a)}"
    return f"has {changed_text(a, b, others)}" if others else ""


def _same_motion(a: Motion, b: Motion, near: Tolerances) -> bool:
    """Return whether two laws have the same coordinate at every time, whatever their formulas."""
    first, last = interval(a)
    if interval(b) != (first, last):
        return False
    # Times without a common period.
    t = np.maximum(first, -50.0) + (np.minimum(last, 50.0) - np.maximum(first, -50.0)) * np.linspace(0, 1, 257) ** 1.37
    x, y = (np.broadcast_to(position(part, t, NUMPY), t.shape) for part in (a, b))
    return near.vector(x, y, max(1.0, float(np.abs(x).max())))


# Loops and couplers. Ends may be exchanged. Of a hinge's frames the axis counts alone, of welded ones their turn
# against each other, and a slider's point may be anywhere along its axis.


def paired(
    some: Iterable[Part], left: list[Part], apart: Callable[[Part, Part], float]
) -> tuple[list[tuple[Part, Part]], list[Part]]:
    """Pair parts with the nearest of `left`, which are taken out of it, and return those without a partner.

    `apart` is the distance of two, infinite where they are no pair.
    """
    waiting, pairs = list(some), []
    while near := [
        (far, i, k) for i, a in enumerate(waiting) for k, b in enumerate(left) if (far := apart(a, b)) < np.inf
    ]:
        _, i, k = min(near)
        pairs.append((waiting.pop(i), left.pop(k)))
    return pairs, waiting


def exchanged(loop: Loop) -> Loop:
    """Return a loop with its ends exchanged, which holds the same."""
    ends = {f"{name}_{side}": getattr(loop, f"{name}_{other}") for side, other in ("ab", "ba") for name in _OF_END}
    return replace(loop, **ends)


def follows(x: Coupler) -> str:
    """Return a coupler's equation."""
    terms = [f"{number_text(r)} {name}" for r, name in zip(x.ratios, x.leaders, strict=True)]
    terms += [number_text(x.offset)] if x.offset else []
    curve = f", with curve {number_text(x.curve)}" if x.curve.any() else ""
    return f"{x.joint} = {' + '.join(terms).replace('+ -', '- ')}{curve}"


def loop_differences(a: Loop, b: Loop, near: Tolerances) -> list[str]:
    """Return what `b` has otherwise than `a`, in sentences that begin with a verb; empty where they hold the same."""
    return min((list(_differences(a, x, near)) for x in (b, exchanged(b))), key=len)


def moved(a: Loop, b: Loop) -> tuple[float, float]:
    """Return by how much the ends of `b` are moved and turned against those of `a`, of one kind, in m and rad."""
    far = max(float(np.linalg.norm(x)) for x in _shifts(a, b).values())
    return far, _turn(a, b) if a.kind in WELDED else 0.0


def _differences(a: Loop, b: Loop, near: Tolerances) -> Iterator[str]:
    if a.kind != b.kind:
        yield f"closes it as {b.kind} for {a.kind}"
    shifts = _shifts(a, b)
    for side in "ab":
        body, own = getattr(b, f"body_{side}"), getattr(a, f"body_{side}")
        if body != own:
            yield f"ends it on {body!r} for {own!r}"
        elif not near.point(shifts[side], np.zeros(3)):
            there, own_place = (number_text(getattr(x, f"translation_{side}")) for x in (b, a))
            away = f"{np.linalg.norm(shifts[side]):.6g} m away, at {there} for {own_place}"
            yield f"has its point on {body!r} {away}"
    if not near.number(a.length, b.length):
        yield f"has a length of {b.length:.6g} m for {a.length:.6g} m"
    if a.kind == b.kind and (a.body_a, a.body_b) == (b.body_a, b.body_b):
        yield from _turned(a, b, near)


def _shifts(a: Loop, b: Loop) -> dict[str, Array]:
    """Return how far each end's point is moved, less what both ends may move together without a change."""
    out = {side: getattr(b, f"translation_{side}") - getattr(a, f"translation_{side}") for side in "ab"}
    axes = {side: getattr(a, f"rotation_{side}")[:, 2] for side in "ab"}
    if a.kind == b.kind == WELDED[0]:
        # Any point of two bodies that are welded may be called theirs.
        return {"a": out["a"] - b.rotation_a @ b.rotation_b.T @ out["b"], "b": np.zeros(3)}
    if a.kind == b.kind and a.kind in (*SLIDING, HINGED[0]):
        # A slider's ends move along the axis each by itself, a hinge's together.
        along = {side: axes[side] @ out[side] for side in "ab"}
        along["b"] = along["b"] if a.kind in SLIDING else along["a"]
        return {side: x - axes[side] * along[side] for side, x in out.items()}
    return out


def _turn(a: Loop, b: Loop) -> float:
    return float(np.linalg.norm(turn_of((a.rotation_a @ a.rotation_b.T).T @ b.rotation_a @ b.rotation_b.T)))


def _turned(a: Loop, b: Loop, near: Tolerances) -> Iterator[str]:
    if a.kind in WELDED and _turn(a, b) > near.relative:
        yield f"turns its ends by {_degrees(_turn(a, b))} against each other"
    if a.kind not in (*HINGED, *SLIDING, CROSSED):
        return
    own, other = ([getattr(x, f"rotation_{side}")[:, 2] for side in "ab"] for x in (a, b))
    # An axis has no direction; of a hinge's two both turn round together, of a cross each by itself.
    signs = [np.sign(x @ y) or 1.0 for x, y in zip(own, other, strict=True)]
    if a.kind in HINGED:
        signs = [signs[0], signs[0]]
    for side, x, y, sign in zip("ab", own, other, signs, strict=True):
        if not near.vector(x, sign * y):
            angle = np.arccos(np.clip(abs(x @ y), 0.0, 1.0))
            yield f"has its axis on {getattr(a, f'body_{side}')!r} turned by {_degrees(angle)}"


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.4g}°"
