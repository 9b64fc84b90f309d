"""Usual mistakes with bodies and joints as rows: kind, sentence, changed fields; and the name of a difference by them.

A row may be known beforehand (`body_mistakes`, `joint_mistakes`), or follow from the numbers of the other side
(`fitted_body`, `fitted_joint`). What no row explains is told with its numbers, so that each difference has a name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import permutations, product
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._check import Array, by_key
from mbkit.load.shapes import NOTHING, MassProperties
from mbkit.model import Joint, Mimic
from mbkit.model.elements.formula import Formula
from mbkit.model.parts import NumberRule, acting, rules_of
from mbkit.studies.explain.merged_model import LinkInBody, Tolerances, composite, number_text, rules_for

#: kg/m³.
_WATER_DENSITY: Final = 1000.0
_DEGREE: Final = np.pi / 180
#: URDF's order of an inertia's six numbers, and MuJoCo's.
_URDF: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MJCF: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Numbers of a joint that are data.
_BOUNDS: Final = tuple(name for name, rule in rules_of(Joint).items() if not rule.acts)
#: Words for a field, where they are not its name.
_WORDS: Final = {
    "com": "centre of mass",
    "lower": "lower limit",
    "upper": "upper limit",
    "stribeck_velocity": "Stribeck velocity",
}
#: Kinds of differences in fields, where they are not the field's name.
_KINDS: Final = {
    **_WORDS,
    **dict.fromkeys(_BOUNDS, "limits"),
    "translation": "joint origin",
    "rotation": "joint rotation",
    "axes": "axis",
    "stiffness": "spring",
    "rest": "spring",
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


def named(
    a: Any, b: Any, groups: Iterable[Sequence[str]], rows: Iterable[Mistake], near: Tolerances
) -> Iterator[Mistake]:
    """Yield the differences that turn part `a` into part `b`, with the fields of `b`, each field once.

    Of each group of fields, the first row that explains all that differ in it, else the first for each field. Fields
    that no row explains are told with their numbers, those of one kind together.
    """
    apart = [names for group in groups if (names := near.differing(a, b, *group))]
    known = list(rows) if apart else []

    def fitting(names: Sequence[str]) -> Iterator[Mistake]:
        for x in known:
            changed = dict.fromkeys([*names, *x.fields])
            if x.fields.keys() & {*names} and not near.differing(replace(a, **x.fields), b, *changed):
                yield x._replace(fields={n: getattr(b, n) for n in changed})

    for names in apart:
        if whole := next(fitting(names), None):
            yield whole
            continue
        left = dict.fromkeys(names)
        for name in names:
            if name in left and (x := next(fitting([name]), None)):
                left = {n: None for n in left if n not in x.fields}
                yield x
        for kind, some in by_key((_KINDS.get(n, n.replace("_", " ")), n) for n in left).items():
            yield Mistake(kind, f"has {changed_text(a, b, some)}", {n: getattr(b, n) for n in some})


def changed_text(a: Any, b: Any, names: Iterable[str]) -> str:
    """Return fields of two parts as text: their numbers, or that they are other ones."""
    return ", ".join(_changed(n, acting(a, n), acting(b, n), rules_for(a).get(n)) for n in names)


def _changed(name: str, a: Any, b: Any, rule: NumberRule | None) -> str:
    what = _WORDS.get(name, name.replace("_", " "))
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
        # Drake's substitute for inconsistent matter.
        if mass > 0:
            radius = (mass / (4 / 3 * np.pi * _WATER_DENSITY)) ** (1 / 3)
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
        says = f"has {factor:g} times the {_KINDS.get(name, name)}, as in another unit"
        yield f"unit of {unit}", says, {name: factor * x}


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
    for which, some in groups:
        for kind, how, change in (
            ("fused with a rotated frame", "without turning it", lambda x: replace(x, R=np.eye(3))),
            ("fused with a rotated frame", "turned the wrong way", lambda x: replace(x, R=x.R.T)),
            ("fused with a rotated frame", "without turning its inertia", _with_unturned_inertia),
            ("fused at the wrong place", "at the origin", lambda x: replace(x, p=np.zeros(3))),
        ):
            whole = composite([change(x) if x in some else x for x in links])
            yield kind, f"fuses {which} {how}", vars(whole)
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
        given = ((n, getattr(joint, n)) for n in ("damping", "stiffness"))
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
    turn, shift = turn_of(a.rotation.T @ b.rotation), a.rotation.T @ (b.translation - a.translation)
    rotation, translation = {"rotation": b.rotation}, {"translation": b.translation}
    if a.type.axial and a.type.rotates and np.allclose(np.cross(turn, a.axes[0]), 0.0, atol=1e-9):
        yield Mistake("zero position", f"counts from {_angle(float(turn @ a.axes[0]))} further on", rotation)
    if a.type.axial and not a.type.rotates and near.point(np.cross(shift, a.axes[0]), np.zeros(3)):
        yield Mistake("zero position", f"counts from {number_text(float(shift @ a.axes[0]))} m further on", translation)
    yield Mistake("joint rotation", f"has it turned by {_angle(float(np.linalg.norm(turn)))}", rotation)


def _angle(x: float) -> str:
    return f"{number_text(x)} rad ({number_text(x / _DEGREE)}°)"
