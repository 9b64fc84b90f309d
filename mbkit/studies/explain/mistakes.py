"""Usual mistakes with bodies and joints as rows: kind, sentence, changed fields; and the name of a difference by them.

A row may be known beforehand (`body_mistakes`, `joint_mistakes`), or follow from the numbers of the other side
(`fitted_body`, `fitted_joint`). The last of these have any number, so that each difference has a name.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from itertools import permutations, product
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.load.shapes import NOTHING, MassProperties
from mbkit.model import Body, Joint, Mimic
from mbkit.model.parts import acting, rules_of
from mbkit.studies.explain.merged_model import LinkInBody, Tolerances, composite, number_text

_WATER: Final = 1000.0  # kg/m³
_DEGREE: Final = np.pi / 180
#: URDF's order of an inertia's six numbers, and MuJoCo's.
_URDF: Final = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_MJCF: Final = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
#: Kinds of differences in numbers, where they are not the field's name.
_KINDS: Final = {
    "com": "centre of mass",
    "translation": "joint origin",
    "axes": "axis",
    "stiffness": "spring",
    "stribeck_velocity": "Stribeck velocity",
}
#: Numbers of a joint that are told together, and those that are compared one by one.
BOUNDS: Final = tuple(name for name, rule in rules_of(Joint).items() if not rule.acts)
_PLACE: Final = ("rotation", "translation")
_NUMBERS: Final = tuple(n for n in rules_of(Joint) if n not in (*_PLACE, *BOUNDS, "axes", "pitch", "stiffness", "rest"))
MATTER: Final = ("mass", "com", "inertia")


class Mistake(NamedTuple):
    """A named difference of one part: its kind, a sentence that begins with a verb, and the changed fields."""

    kind: str
    says: str
    fields: Mapping[str, Any]


def named(
    a: Any, b: Any, groups: Iterable[Sequence[str]], rows: Iterable[Mistake], near: Tolerances
) -> Iterator[Mistake]:
    """Yield the differences that turn part `a` into part `b`, with the fields of `b`, each field once.

    Of each group of fields, the first row that explains all that differ in it, else the first for each field.
    """
    apart = [names for group in groups if (names := near.differing(a, b, *group))]
    known = list(rows) if apart else []

    def first(names: list[str]) -> Iterator[Mistake]:
        for x in known:
            changed = dict.fromkeys([*names, *x.fields])
            if x.fields.keys() & {*names} and not near.differing(replace(a, **x.fields), b, *changed):
                yield x._replace(fields={n: getattr(b, n) for n in changed})
                return

    for names in apart:
        if whole := [*first(names)]:
            yield from whole
            continue
        done: set[str] = set()
        for name in names:
            for x in first([name]) if name not in done else ():
                done |= x.fields.keys()
                yield x


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
            radius = (mass / (4 / 3 * np.pi * _WATER)) ** (1 / 3)
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
        for what, how, change in (
            ("with a rotated frame", "without turning it", lambda x: replace(x, R=np.eye(3))),
            ("with a rotated frame", "turned the wrong way", lambda x: replace(x, R=x.R.T)),
            ("with a rotated frame", "without turning its inertia", _with_unturned_inertia),
            ("at the wrong place", "at the origin", lambda x: replace(x, p=np.zeros(3))),
        ):
            whole = composite([change(x) if x in some else x for x in links])
            yield f"fused {what}", f"fuses {which} {how}", vars(whole)
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
    change = f"{number_text(a.inertia)} -> {number_text(b.inertia)} kg m²"
    moments = [np.diag(np.linalg.eigvalsh(x.inertia)) for x in (a, b)]
    if near.inertia(*moments, a.mass):
        if _has_reordered_axes(a.inertia, b.inertia, a.mass, near):
            says = "has the inertia in axes whose quaternion was read in the wrong order"
            yield Mistake("quaternion order", says, {"inertia": b.inertia})
        says = f"has the same principal moments in other axes: {change}"
        yield Mistake("inertia axes", says, {"inertia": b.inertia})
    # Newton's correction of an inertia that no body can have, or of less than 1e-6 kg m².
    if (more := np.trace(b.inertia - a.inertia) / 3) > 0:
        says = f"has {number_text(float(more))} kg m² more about every axis"
        yield Mistake("corrected inertia", says, {"inertia": a.inertia + more * np.eye(3)})
    if np.trace(a.inertia):
        factor = float(np.trace(b.inertia) / np.trace(a.inertia))
        yield Mistake("inertia", f"has {number_text(factor)} times the inertia", {"inertia": factor * a.inertia})
    for name in MATTER:
        kind, x, y = _KINDS.get(name, name), *(number_text(getattr(side, name)) for side in (a, b))
        yield Mistake(kind, f"has the {kind} {x} -> {y} {rules_of(Body)[name].unit}", {name: getattr(b, name)})


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
        rows.append(("mimic", _follows_otherwise(joint.mimic, None), {"mimic": None}))
        mimic = Mimic(joint.mimic.joint, joint.mimic.ratio)
        rows.append(("mimic", "leaves out the offset at which it follows", {"mimic": mimic}))
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
    if a.type.motion != b.type.motion:
        # The numbers of one joint type mean nothing to the other.
        return [["parent"], [f.name for f in fields(Joint) if f.name not in ("name", "child", "parent")]]
    springs = [["stiffness", "rest"]] if a.stiffness.any() or b.stiffness.any() else []
    return [["parent"], _PLACE, ["axes"], ["pitch"], ["mimic"], *([n] for n in _NUMBERS), *springs, BOUNDS]


def fitted_joint(a: Joint, b: Joint, near: Tolerances) -> Iterator[Mistake]:
    """Yield the rows for what turns joint `a` into `b` beyond the usual mistakes."""
    own = {f.name: getattr(b, f.name) for f in fields(b)}

    def row(kind: str, says: str, *names: str) -> Mistake:
        return Mistake(kind, says, {n: own[n] for n in names})

    yield row("parent", f"hangs it on {b.parent!r} and not on {a.parent!r}", "parent")
    if a.type.motion != b.type.motion:
        yield row("joint kind", f"has it as a {b.kind} joint, not a {a.kind} one", *groups_of(a, b)[1])
        return
    turn, shift = turn_of(a.rotation.T @ b.rotation), a.rotation.T @ (b.translation - a.translation)
    angle, axis = float(np.linalg.norm(turn)), a.axes[0] if a.type.axial else np.zeros(3)
    if a.type.axial and a.type.rotates and np.allclose(np.cross(turn, axis), 0.0, atol=1e-9):
        yield row("zero position", f"counts from {_angle(float(turn @ axis))} further on", "rotation")
    if a.type.axial and not a.type.rotates and near.point(np.cross(shift, axis), np.zeros(3)):
        yield row("zero position", f"counts from {number_text(float(shift @ axis))} m further on", "translation")
    yield row("joint rotation", f"has it turned by {_angle(angle)}", "rotation")
    at, not_at, rest, no_rest, axes, no_axes = (
        number_text(getattr(x, n)) for n in ("translation", "rest", "axes") for x in (b, a)
    )
    yield row("joint origin", f"has the joint at {at} m, not at {not_at}", "translation")
    yield row("axis", f"has the axis {axes}, not {no_axes}", "axes")
    yield row("pitch", f"has the pitch {number_text(b.pitch)} m/rad for {number_text(a.pitch)}", "pitch")
    yield row("mimic", _follows_otherwise(a.mimic, b.mimic), "mimic")
    yield row("spring", f"has the spring at rest at {rest}, not {no_rest}", "rest")
    for name in (*_NUMBERS, "stiffness"):
        kind, more = _KINDS.get(name, name.replace("_", " ")), ["rest"] if name == "stiffness" else []
        yield row(kind, _other_number(kind, acting(a, name), acting(b, name)), name, *more)
    yield row("limits", _other_limits(a, b, near), *BOUNDS)


def _angle(x: float) -> str:
    return f"{number_text(x)} rad ({number_text(x / _DEGREE)}°)"


def _follows_otherwise(a: Mimic | None, b: Mimic | None) -> str:
    if a and b:
        one, other = (f"{number_text(m.ratio)} {m.joint} + {number_text(m.offset)}" for m in (b, a))
        return f"lets it follow {one}, not {other}"
    return f"lets it follow {b.joint!r}, which is free" if b else f"leaves it free, which follows {a and a.joint!r}"


def _other_number(name: str, a: Array, b: Array) -> str:
    units = ((_DEGREE, "per degree for per radian"), (1 / _DEGREE, "per radian for per degree"))
    unit = [f" ({says})" for factor, says in units if a.any() and np.allclose(b, factor * a, rtol=1e-9)]
    what = "spring of stiffness" if name == "spring" else name
    return f"has {what} {number_text(b)} for {number_text(a)}{''.join(unit)}"


def _other_limits(a: Joint, b: Joint, near: Tolerances) -> str:
    parts = []
    for name in near.differing(a, b, *BOUNDS):
        x, y = (getattr(side, name) for side in (b, a))
        what = f"{name} limit" if name in ("lower", "upper") else name.replace("_", " ")
        lost = not np.isfinite(x).any()
        parts.append(f"no {what} ({number_text(y)})" if lost else f"{what} {number_text(x)} for {number_text(y)}")
    return f"has {', '.join(parts)}"
