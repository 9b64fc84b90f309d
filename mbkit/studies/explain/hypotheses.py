"""Differences between two descriptions as tables of usual mistakes: kind, sentence, changed fields.

A mistake is compared with the other side, field by field. Each field belongs to one difference alone, so that any of
them can be added to the first description or removed from the second without the others.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from itertools import islice, permutations, product
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load.shapes import NOTHING, MassProperties
from mbkit.model import Body, Joint, Mimic, Model
from mbkit.model.description import CONSTRAINT_FEATURES
from mbkit.model.elements.formula import NUMPY
from mbkit.model.elements.motion_laws import MOTION_LAWS, Motion, interval, position
from mbkit.model.elements.references import called
from mbkit.model.parts import Coupler, Loop, acting, rules_of
from mbkit.studies.explain.loop_differences import loop_differences, turn_of
from mbkit.studies.explain.merged_model import (
    OTHERS,
    LinkInBody,
    MergedModel,
    Tolerances,
    composite,
    number_text,
)

_WATER: Final = 1000.0  # kg/m³
_DEGREE: Final = np.pi / 180
#: URDF's order of an inertia's six numbers, and MuJoCo's.
_URDF: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MJCF: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Kind of a difference, and noun, where they are not the description's word for a part; numbers of joints alike.
_WORDS: Final = {
    "springs": ("point spring", "spring"),
    "couplings": ("joint coupling", "coupling"),
    "prescribed": ("prescribed motion", "motion of"),
    "no_slip": ("contact without slip", "no slip"),
}
_OF_BODY: Final = {"mass": "mass", "com": "centre of mass"}
_NUMBER: Final = {"stiffness": "spring", "stribeck_velocity": "Stribeck velocity"}
#: Numbers of a joint that are told together, and those that are compared one by one.
BOUNDS: Final = tuple(name for name, rule in rules_of(Joint).items() if not rule.acts)
_PLACE: Final = ("rotation", "translation", "axes", "pitch", "rest")
NUMBERS: Final = tuple(name for name in rules_of(Joint) if name not in (*_PLACE, *BOUNDS))
#: Those of them that every joint has.
OF_ALL: Final = tuple(name for name in NUMBERS if rules_of(Joint)[name].absent is None)
#: Numbers that a sentence says all of.
_FEW: Final = 9


class Mistake(NamedTuple):
    """A named difference of one part: its kind, a sentence that begins with a verb, and the changed fields."""

    kind: str
    says: str
    fields: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A difference between two descriptions: fields of one part in either, with a name, and their numbers."""

    kind: str
    subject: str
    says: str
    #: (description, fields) -> the description with these fields in the part.
    put: Callable[[MergedModel, Mapping[str, Any]], MergedModel] = lambda x, _: x
    ours: Mapping[str, Any] | None = None
    theirs: Mapping[str, Any] | None = None
    a: Any = None
    b: Any = None

    def apply(self, x: MergedModel) -> MergedModel:
        """Put the difference into a description."""
        return self.put(x, self.theirs or {})

    def revert(self, x: MergedModel) -> MergedModel:
        """Take the difference out of a description that has it."""
        return self.put(x, self.ours or {})

    def without(self, names: Container[str]) -> Hypothesis:
        """Return the hypothesis with fewer fields."""
        ours, theirs = ({k: x for k, x in (s or {}).items() if k not in names} for s in (self.ours, self.theirs))
        return replace(self, ours=ours, theirs=theirs)


def _reordered(R: Array) -> list[Array]:
    """Return the rotation with its quaternion written w first and read w last, and the reverse."""
    x, y, z, w = spatial.quaternion_from_matrix(R)
    return [spatial.matrix_from_quaternion(np.array(q)) for q in ([w, x, y, z], [y, z, w, x])]


def _effective(part: Any, rows: Sequence[tuple[str, str, Mapping[str, Any]]]) -> list[Mistake]:
    """Return the mistakes that change a part."""
    return [
        Mistake(*row) for row in rows if not all(np.array_equal(getattr(part, name), x) for name, x in row[2].items())
    ]


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
        ("centre of mass", "has the centre of mass at the origin", {"com": np.zeros(3)}),
        ("centre of mass", "has the centre of mass on the other side of the origin", {"com": -c}),
        *(("centre of mass", "has the centre of mass in other axes", {"com": R @ c}) for R in (R_PJ, R_PJ.T)),
    ]
    for mass, says in (
        (m, "has the inertia of a ball of water of its mass"),
        (1.0, "has a ball of water of 1 kg in its place"),
    ):
        # Drake's substitute for inconsistent matter.
        if mass > 0:
            radius = (mass / (4 / 3 * np.pi * _WATER)) ** (1 / 3)
            rows.append(("replaced inertia", says, {"mass": mass, "inertia": 0.4 * mass * radius**2 * np.eye(3)}))
    for factor, says in ((1e3, "1000 times too large, as grams or millimetres"), (1e-3, "1000 times too small")):
        rows += [
            ("unit of mass", f"has a mass {says}", {"mass": factor * m}),
            ("unit of length", f"has the centre of mass {says}", {"com": factor * c}),
            ("unit of inertia", f"has an inertia {says}", {"inertia": factor * I}),
        ]
    for factor in (1e6, 1e-6):
        says = f"has an inertia {factor:g} times as large, as of millimetres"
        rows.append(("unit of inertia", says, {"inertia": factor * I}))
    return _effective(at, rows)


def _merge_mistakes(links: Sequence[LinkInBody]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield mistakes with links that are fixed to each other."""
    own, *fixed = links
    heavy = [x for x in fixed if x.massive]
    for one in heavy:
        rest = composite([x for x in links if x is not one])
        yield "lost body", f"leaves out link {one.name!r}, which is fixed to it", vars(rest)
    groups = [(f"link {x.name!r}", [x]) for x in heavy]
    if len(heavy) > 1:
        yield "lost body", "leaves out every link that is fixed to it", vars(composite([own]))
        groups.append(("its links", heavy))
    ways: tuple[tuple[str, str, Callable[[LinkInBody], LinkInBody]], ...] = (
        ("fused with a rotated frame", "without turning it", lambda x: replace(x, R=np.eye(3))),
        ("fused with a rotated frame", "turned the wrong way", lambda x: replace(x, R=x.R.T)),
        ("fused with a rotated frame", "without turning its inertia", _with_unturned_inertia),
        ("fused at the wrong place", "at the origin", lambda x: replace(x, p=np.zeros(3))),
    )
    for which, some in groups:
        for kind, how, change in ways:
            yield kind, f"fuses {which} {how}", vars(composite([change(x) if x in some else x for x in links]))
    if heavy:
        total = sum((x.mass_properties.inertia for x in links), np.zeros((3, 3)))
        says = "adds the inertias of its links, each about its own centre of mass"
        yield "inertia about the wrong point", says, {"inertia": total}


def _with_unturned_inertia(x: LinkInBody) -> LinkInBody:
    return replace(x, matter=replace(x.matter, inertia=x.R.T @ x.matter.inertia @ x.R))


def _product_mistakes(I: Array) -> Iterator[tuple[str, str, dict[str, Any]]]:
    diagonal = np.diag(np.diag(I))
    yield "products of inertia", "has the products of inertia with the other sign", {"inertia": 2 * diagonal - I}
    yield "products of inertia", "has no products of inertia", {"inertia": diagonal}
    for i, j in ((0, 1), (0, 2), (1, 2)):
        flipped = I.copy()
        flipped[i, j] = flipped[j, i] = -I[i, j]
        yield "products of inertia", f"has I{'xyz'[i]}{'xyz'[j]} with the other sign", {"inertia": flipped}
    for order, other, says in (
        (_URDF, _MJCF, "URDF's order read in MJCF's"),
        (_MJCF, _URDF, "MJCF's order read in URDF's"),
    ):
        misread = np.zeros((3, 3))
        for (i, j), (k, l) in zip(order, other, strict=True):
            misread[k, l] = misread[l, k] = I[i, j]
        yield "order of the inertia's numbers", f"has the inertia's six numbers in {says}", {"inertia": misread}


def _body_differences(
    links: Sequence[LinkInBody], R_PJ: Array, b: MassProperties, near: Tolerances, *, base: bool = False
) -> list[Mistake]:
    """Return the mistakes that turn a body's matter into that of the other side, named as exactly as possible.

    First one mistake for all of it, then one each for mass, centre of mass and inertia, with the other side's values.
    """
    a = composite(links)
    mistakes = body_mistakes(links, R_PJ, base=base)
    for mistake in mistakes:
        if near.same(replace(a, **mistake.fields), b):
            return [mistake._replace(fields=vars(b))]
    if a.mass and b.mass and b.mass != a.mass and near.same(a.scaled(b.mass / a.mass), b):
        says = f"has {number_text(b.mass / a.mass)} times the mass, and the inertia with it"
        return [Mistake("mass", says, vars(b))]
    if not a.mass and not a.inertia.any():
        return [Mistake("added body", "has matter in it", vars(b))]
    out = []
    for name in near.differing(a, b):
        wanted = replace(a, **{name: getattr(b, name)})
        kind, says = _inertia_difference(a, b, mistakes, near) if name == "inertia" else (_OF_BODY[name], "")
        if not says:
            change = f"{number_text(getattr(a, name))} -> {number_text(getattr(b, name))} {rules_of(Body)[name].unit}"
            usual = (x[:2] for x in mistakes if near.same(replace(a, **x.fields), wanted))
            kind, says = next(usual, (kind, f"has the {kind} {change}"))
        out.append(Mistake(kind, says, {name: getattr(b, name)}))
    return out


def _inertia_difference(
    a: MassProperties, b: MassProperties, mistakes: Sequence[Mistake], near: Tolerances
) -> tuple[str, str]:
    """Return kind and sentence of another inertia, whatever else of the body differs."""
    for mistake in mistakes:
        I = mistake.fields.get("inertia", a.inertia)
        if near.inertia(I, b.inertia, a.mass) and not near.inertia(I, a.inertia, a.mass):
            return mistake.kind, mistake.says
    moments = np.linalg.eigvalsh(a.inertia), np.linalg.eigvalsh(b.inertia)
    if near.inertia(np.diag(moments[0]), np.diag(moments[1]), a.mass):
        if _has_reordered_axes(a.inertia, b.inertia, a.mass, near):
            return "quaternion order", "has the inertia in axes whose quaternion was read in the wrong order"
        axes = f"{number_text(a.inertia)} -> {number_text(b.inertia)} kg m²"
        return "inertia axes", f"has the same principal moments in other axes: {axes}"
    # Newton's correction of an inertia that no body can have, or of less than 1e-6 kg m².
    more = np.trace(b.inertia - a.inertia) / 3
    if more > 0 and near.inertia(a.inertia + more * np.eye(3), b.inertia, a.mass):
        return "corrected inertia", f"has {number_text(float(more))} kg m² more about every axis"
    factor = np.trace(b.inertia) / np.trace(a.inertia) if np.trace(a.inertia) else 0.0
    if near.inertia(factor * a.inertia, b.inertia, a.mass):
        return "inertia", f"has {number_text(float(factor))} times the inertia"
    return "inertia", f"has the inertia {number_text(a.inertia)} -> {number_text(b.inertia)} kg m²"


def _has_reordered_axes(a: Array, b: Array, mass: float, near: Tolerances) -> bool:
    """Return whether b is a in principal axes whose quaternion was read in another order.

    That shows where the axes are known, and not merely exchanged, as those of a cylinder that lies along another one.
    """
    moments, axes = np.linalg.eigh(a)
    if near.number(moments[0], moments[1]) or near.number(moments[1], moments[2]):
        return False
    across = np.abs(axes.T @ np.linalg.eigh(b)[1])
    if near.vector(across, np.round(across)):
        return False
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        Q = axes[:, order] * signs
        for R in _reordered(Q) if np.linalg.det(Q) > 0 else ():
            turned = R @ np.diag(moments[list(order)]) @ R.T
            if np.linalg.norm(turn_of(R.T @ Q)) > near.relative and near.inertia(turned, b, mass):
                return True
    return False


def link_differences(
    ours: Sequence[LinkInBody], theirs: Sequence[LinkInBody], near: Tolerances
) -> list[tuple[str, Mistake]] | None:
    """Return (link, mistake) where both sides know the same links of a body, in common axes; else None."""
    there = {x.name: x.matter for x in theirs}
    if len(ours) < 2 or there.keys() != {x.name for x in ours}:
        return None
    out = []
    for x in ours:
        if not near.same(x.matter, there[x.name]):
            alone = replace(x, R=np.eye(3), p=np.zeros(3))
            out += [(x.name, mistake) for mistake in _body_differences([alone], np.eye(3), there[x.name], near)]
    return out


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


# Joints.


def joint_mistakes(joint: Joint) -> list[Mistake]:
    """Return the usual mistakes with a joint, whatever the other side has."""
    R, p, axes, pitch = joint.rotation, joint.translation, joint.axes, joint.pitch
    angles = np.array(spatial.rpy_from_matrix(R))
    roll, pitching, yaw = (spatial.matrix_from_rpy(*x) for x in np.diag(angles))
    too_large, too_small = (
        spatial.matrix_from_rpy(*np.remainder(factor * angles, 2 * np.pi)) for factor in (1 / _DEGREE, _DEGREE)
    )
    rows: list[tuple[str, str, dict[str, Any]]] = [
        (kind := _NUMBER.get(name, name), f"has no {kind}", {name: np.zeros(joint.type.nv)}) for name in OF_ALL
    ]
    if joint.mimic is not None:
        rows.append(("mimic", f"leaves it free, which follows {joint.mimic.joint!r}", {"mimic": None}))
        if joint.mimic.offset:
            mimic = Mimic(joint.mimic.joint, joint.mimic.ratio)
            rows.append(("mimic", "leaves out the offset at which it follows", {"mimic": mimic}))
    misread = "reads the joint's quaternion in the wrong order"
    far = "has the joint's origin 1000 times too far, as of millimetres"
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
        ("joint origin", "has the joint's origin on the other side", {"translation": -p}),
        ("joint origin", "has the joint at the parent's origin", {"translation": 0.0 * p}),
        ("unit of length", far, {"translation": 1e3 * p}),
        ("unit of length", "has the joint's origin 1000 times too near", {"translation": 1e-3 * p}),
        ("joint origin", "has the joint's origin in the joint's axes", {"translation": R @ p}),
        ("joint origin", "has the joint's origin in other axes", {"translation": R.T @ p}),
        ("inverse placement", "has the joint's placement the wrong way round", inverse),
    ]
    return _effective(joint, rows)


def _joint_differences(a: Joint, b: Joint, near: Tolerances) -> Iterator[Mistake]:
    """Yield the mistakes that turn joint `a` into joint `b`, named as exactly as possible."""
    if a.parent != b.parent:
        yield Mistake("parent", f"hangs it on {b.parent!r} and not on {a.parent!r}", {"parent": b.parent})
    if a.type.motion != b.type.motion:
        # The numbers of one joint type mean nothing to the other.
        whole = {f.name: getattr(b, f.name) for f in fields(b) if f.name not in ("name", "child", "parent")}
        yield Mistake("joint kind", f"has it as a {b.kind} joint, not a {a.kind} one", whole)
        return
    apart = near.differing(a, b)
    mistakes = joint_mistakes(a) if apart else []

    def named(*names: str) -> Iterator[Mistake]:
        """Yield the first usual mistake in just these fields."""
        usual = (x for x in mistakes if x.fields.keys() == {*names})
        hits = (x for x in usual if not near.differing(replace(a, **x.fields), b, *names))
        yield from (x._replace(fields=_fields(b, names)) for x in islice(hits, 1))

    placement = [n for n in ("rotation", "translation") if n in apart]
    if placement:
        yield from [*named(*placement)] or [next(named(n), _moved(n, a, b, near)) for n in placement]
    for name, kind, says in (("axes", "axis", "{}, not {}"), ("pitch", "pitch", "{} m/rad for {}")):
        if name in apart:
            numbers = says.format(number_text(getattr(b, name)), number_text(getattr(a, name)))
            yield next(named(name), Mistake(kind, f"has the {kind} {numbers}", _fields(b, [name])))
    if "mimic" in apart:
        yield Mistake("mimic", _follows_otherwise(a.mimic, b.mimic), {"mimic": b.mimic})
    for name in (n for n in NUMBERS if n in apart):
        kind = _NUMBER.get(name, name.replace("_", " "))
        more = ["rest"] if name == "stiffness" else []
        yield Mistake(kind, _other_number(kind, acting(a, name), acting(b, name)), _fields(b, [name, *more]))
    if a.stiffness.any() and "rest" in apart and "stiffness" not in apart:
        says = f"has the spring at rest at {number_text(b.rest)}, not {number_text(a.rest)}"
        yield Mistake("spring", says, {"rest": b.rest})
    if limits := _fields(b, [n for n in BOUNDS if n in apart]):
        yield Mistake("limits", _other_limits(a, limits), limits)


def _fields(part: Any, names: Iterable[str]) -> dict[str, Any]:
    return {n: getattr(part, n) for n in names}


def _moved(name: str, a: Joint, b: Joint, near: Tolerances) -> Mistake:
    """Return the difference in rotation or translation, as another zero position where it is along the axis."""
    value = _fields(b, [name])
    if name == "rotation":
        turn = turn_of(a.rotation.T @ b.rotation)
        angle = float(np.linalg.norm(turn))
        zero = a.type.axial and a.type.rotates and np.allclose(np.cross(turn, a.axes[0]), 0.0, atol=1e-9)
        angle = float(turn @ a.axes[0]) if zero else angle
        amount = f"{number_text(angle)} rad ({number_text(angle / _DEGREE)}°)"
        if zero:
            return Mistake("zero position", f"counts from {amount} further on", value)
        return Mistake("joint rotation", f"has it turned by {amount}", value)
    d = a.rotation.T @ (b.translation - a.translation)
    if a.type.axial and not a.type.rotates and near.point(np.cross(d, a.axes[0]), np.zeros(3)):
        return Mistake("zero position", f"counts from {number_text(float(d @ a.axes[0]))} m further on", value)
    says = f"has the joint at {number_text(b.translation)} m, not at {number_text(a.translation)}"
    return Mistake("joint origin", says, value)


def _follows_otherwise(a: Mimic | None, b: Mimic | None) -> str:
    if not (a and b):
        return f"lets it follow {b.joint!r}, which is free" if b else f"leaves it free, which follows {a.joint!r}"  # type: ignore[union-attr]
    one, other = (f"{number_text(m.ratio)} {m.joint} + {number_text(m.offset)}" for m in (b, a))
    return f"lets it follow {one}, not {other}"


def _other_number(name: str, a: Array, b: Array) -> str:
    what = "spring of stiffness" if name == "spring" else name
    unit = ""
    for factor, says in ((_DEGREE, "per degree for per radian"), (1 / _DEGREE, "per radian for per degree")):
        if a.any() and np.allclose(b, factor * a, rtol=1e-9):
            unit = f" ({says})"
    return f"has {what} {number_text(b)} for {number_text(a)}{unit}"


def _other_limits(a: Joint, limits: dict[str, Array]) -> str:
    names = {n: f"{n} limit" if n in ("lower", "upper") else n.replace("_", " ") for n in limits}
    lost = [n for n, x in limits.items() if not np.isfinite(x).any()]
    parts = [
        f"{names[n]} {number_text(x)} for {number_text(getattr(a, n))}" for n, x in limits.items() if n not in lost
    ]
    parts += [f"no {names[n]} ({number_text(getattr(a, n))})" for n in lost]
    return f"has {', '.join(parts)}"


# The whole description.


def differences(one: MergedModel, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    """Return the differences that turn `one` into `other`, part by part."""
    out = _global_differences(one.model, other.model, near)
    theirs = {j.name: j for j in other.model.joints}
    for a in one.model.joints:
        if b := theirs.get(a.name):
            put = partial(MergedModel.with_joint, name=a.name)
            out += [_hypothesis(x, f"joint {a.name!r}", put, a, b) for x in _joint_differences(a, b, near)]
            out += _matter_differences(one, a, other, near)
    return out


def _hypothesis(x: Mistake, subject: str, put: Callable[..., MergedModel], a: object, b: object) -> Hypothesis:
    ours, theirs = ({name: getattr(side, name) for name in x.fields} for side in (a, b))
    numbers = [*ours.values(), *theirs.values()]
    if len(numbers) != 2 or not all(isinstance(v, (float, np.ndarray)) for v in numbers):
        numbers = [None, None]
    return Hypothesis(x.kind, subject, x.says, put, ours, theirs, *numbers)


def _matter_differences(one: MergedModel, joint: Joint, other: MergedModel, near: Tolerances) -> list[Hypothesis]:
    body = joint.child
    a, b = one.mass_properties(body), other.mass_properties(body)
    if near.same(a, b):
        return []
    links = link_differences(one.links[body], other.links[body], near)
    if not links:
        base = joint.type.floating and joint.parent == "world"
        mistakes = _body_differences(one.links[body], joint.rotation, b, near, base=base)
        return [_hypothesis(x, f"body {body!r}", partial(MergedModel.with_body, name=body), a, b) for x in mistakes]
    out = []
    ours, theirs = ({x.name: x.matter for x in side.links[body]} for side in (one, other))
    for name, x in links:
        subject = f"link {name!r}" + (f", fixed to {body!r}" if name != body else "")
        out.append(
            _hypothesis(x, subject, partial(MergedModel.with_link, body=body, link=name), ours[name], theirs[name])
        )
    return out


def _global_differences(a: Model, b: Model, near: Tolerances) -> list[Hypothesis]:
    """Return the differences in gravity, and in all parts beside bodies and joints."""
    out = []
    if not near.vector(a.gravity, b.gravity, max(1.0, float(np.abs(a.gravity).max()))):
        says = f"has the gravity {number_text(b.gravity)} m/s² for {number_text(a.gravity)}"
        if a.gravity.any() and near.vector(np.zeros(3), b.gravity):
            says = "has no gravity"
        elif a.gravity.any() and near.vector(-a.gravity, b.gravity):
            says = "has gravity with the other sign"
        mistake = Mistake("gravity", says, {"gravity": b.gravity})
        out.append(_hypothesis(mistake, "", lambda x, values: x.with_fields(**values), a, b))
    for section in OTHERS:
        ours, theirs = ({x.name: x for x in getattr(m, section)} for m in (a, b))
        if section == "loops":
            same = {
                x: y for x in ours if x not in theirs for y in theirs if not loop_differences(ours[x], theirs[y], near)
            }
            others = ", ".join(f"{x!r} is {y!r}" for x, y in same.items())
            out += [Hypothesis("renamed", "", f"calls loops otherwise: {others}")] if same else []
            ours, theirs = _without(ours, same), _without(theirs, same.values())
        for name in dict.fromkeys([*ours, *theirs]):
            one, other = ours.get(name), theirs.get(name)
            if one is None or other is None or (says := _other_numbers(one, other, near)):
                says = "lacks it" if other is None else "has it besides" if one is None else says
                kind, what = words(section)
                put = partial(_with_parts, section=section)
                out.append(Hypothesis(kind, f"{what} {name!r}", says, put, {name: one}, {name: other}))
    return out


def words(section: str) -> tuple[str, str]:
    """Return the kind of a difference in parts of this section, and the noun before a part's name."""
    return _WORDS.get(section, (called(section), called(section)))


#: Kinds of differences that act on the motion through no term, but through constraints.
CONSTRAINTS: Final = frozenset(words(section)[0] for section in CONSTRAINT_FEATURES)


def _with_parts(x: MergedModel, parts: Mapping[str, Any], section: str) -> MergedModel:
    """Exchange parts of a kind by name; None takes one away."""
    kept = [p for p in getattr(x.model, section) if p.name not in parts]
    return x.with_fields(**{section: (*kept, *(p for p in parts.values() if p is not None))})


def _without(parts: Mapping[str, Any], names: Container[str]) -> dict[str, Any]:
    return {name: part for name, part in parts.items() if name not in names}


def _other_numbers(a: Any, b: Any, near: Tolerances) -> str:
    """Return what differs between two parts of one name; empty where nothing does."""
    if isinstance(a, Loop):
        return ", and ".join(loop_differences(a, b, near))
    if type(a) in MOTION_LAWS:
        return "" if _same_motion(a, b, near) else "moves it otherwise"
    if type(a) is not type(b):
        return f"has another kind of it: {b} for {a}"
    others = near.differing(a, b)
    if isinstance(a, Coupler) and others:
        return f"has {_follows(b)} for {_follows(a)}"
    return f"has {', '.join(_change(n, getattr(a, n), getattr(b, n)) for n in others)}" if others else ""


def _change(name: str, a: Any, b: Any) -> str:
    what = name.replace("_", " ")
    if isinstance(a, (str, tuple)):
        return f"{what} {b!r} for {a!r}"
    few = isinstance(a, float) or (isinstance(a, np.ndarray) and a.size <= _FEW)
    return f"{what} {number_text(b)} for {number_text(a)}" if few else f"another {what}"


def _follows(x: Coupler) -> str:
    terms = [f"{number_text(r)} {name}" for r, name in zip(x.ratios, x.leaders, strict=True)]
    terms += [number_text(x.offset)] if x.offset else []
    curve = f", with curve {number_text(x.curve)}" if x.curve.any() else ""
    return f"{x.joint} = {' + '.join(terms).replace('+ -', '- ')}{curve}"


def _same_motion(a: Motion, b: Motion, near: Tolerances) -> bool:
    """Return whether two laws have the same coordinate at every time, whatever their formulas."""
    first, last = interval(a)
    if interval(b) != (first, last):
        return False
    # Times without a common period.
    t = np.maximum(first, -50.0) + (np.minimum(last, 50.0) - np.maximum(first, -50.0)) * np.linspace(0, 1, 257) ** 1.37
    x, y = (np.broadcast_to(position(part, t, NUMPY), t.shape) for part in (a, b))
    return near.vector(x, y, max(1.0, float(np.abs(x).max())))
