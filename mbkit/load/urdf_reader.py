"""URDF read and checked before any parser in C++ sees it, and its model link by link without one.

`examine` finds all faults of a file at once. It writes the bodies and joints as plain XML, with the same names and
numbers, and without meshes, textures, plugins and all else that could point outside the file. By the URDF specification
a joint's frame is its child link's, an inertia is about the centre of mass in the axes of its origin, and rpy are turns
about fixed x, y and z.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import EPS, TWO_TURNS, Array, by_key
from mbkit._reproducible import turned
from mbkit.errors import MAX_LISTED, ModelError, Suggestions
from mbkit.load import xml_reader
from mbkit.load.mjcf_attributes import z_to
from mbkit.load.xml_reader import Element, Reader, element_text, misspelt, reserved, unused
from mbkit.model import Body, Joint, Mimic, Model, ModelBuilder, kind_of
from mbkit.model.parts import rules_of
from mbkit.model.validation import body_fault, listing, repeated_names

# The parser in C++ recurses over the tree, and its tables grow as the square.
_MAX_JOINTS: Final = 2000
#: The joint on which a floating base moves.
BASE_JOINT: Final = "root_joint"
# Pinocchio's parser takes this for no limit.
_OPEN: Final = "1.7976931348623157e308"
_KINDS: Final = {k: k for k in ("fixed", "revolute", "continuous", "prismatic", "planar")} | {"floating": "free"}
#: Numbers of <dynamics>, which the builder has by the same names.
DYNAMICS: Final = ("damping", "friction")
# Others that published files have.
_SPRING: Final = {"spring_stiffness": "stiffness", "spring_reference": "rest"}
_MOMENTS: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
# The elements of URDF's dynamics, with the elements in each and its attributes.
_SCHEMA: Final[Mapping[str, tuple[frozenset[str], frozenset[str]]]] = {
    tag: (frozenset(children.split()), frozenset(attributes.split()))
    for tag, children, attributes in (
        ("robot", "link joint", "name version"),
        ("link", "inertial", "name"),
        ("inertial", "origin mass inertia", ""),
        ("origin", "", "xyz rpy"),
        ("mass", "", "value"),
        ("inertia", "", " ".join(_MOMENTS)),
        ("joint", "origin parent child axis limit dynamics mimic", "name type"),
        ("parent", "", "link"),
        ("child", "", "link"),
        ("axis", "", "xyz"),
        ("limit", "", "lower upper effort velocity"),
        ("dynamics", "", " ".join((*DYNAMICS, *_SPRING))),
        ("mimic", "", "joint multiplier offset"),
    )
}
# Elements of the specification or of common extensions that say nothing about the dynamics.
_EXTENSIONS: Final = frozenset({"visual", "collision", "material", "transmission", "contact", "calibration"})
# In these an unknown name would be a lost part of the dynamics, except for these attributes of simulators.
_WHOLE: Final = frozenset({"inertial", "origin", "mass", "inertia", "parent", "child", "dynamics", "mimic"})
_HARMLESS: Final = frozenset({"D", "K", "mu_coulomb", "mu_viscous"})

_Numbers = tuple[float, ...]


@dataclass(frozen=True)
class UrdfLink:
    """A link; its inertia is about the centre of mass, in axes turned by roll, pitch and yaw. None without one."""

    name: str
    mass: float = 0.0
    com: _Numbers = ()
    rpy: _Numbers = ()
    inertia: Array | None = None


@dataclass(frozen=True)
class UrdfJoint:
    """A joint; `numbers` are arguments of `ModelBuilder.add_joint`."""

    name: str
    kind: str
    parent: str
    child: str
    translation: _Numbers
    rpy: _Numbers
    mimic: Mimic | None
    numbers: Mapping[str, Any]


@dataclass(frozen=True)
class UrdfFile:
    """A URDF without faults."""

    name: str
    text: str  # the bodies and joints alone
    root: str  # the link that no joint carries
    links: tuple[UrdfLink, ...]
    joints: tuple[UrdfJoint, ...]  # in the file's order
    odd_links: Mapping[str, str]  # links of inconsistent inertia, which links fixed to them may correct, and why
    notes: tuple[str, ...]
    point_masses: bool  # whether mass without inertia is meant


def examine(robot: Element, source: str, *, floating_base: bool, mimic_matters: bool, lenient: bool) -> UrdfFile:
    """Read and check a <robot> element, or raise `ModelError` with every fault.

    A mimic tag that cannot be followed is a fault where `mimic_matters`, and a note where `lenient`.
    """
    read = Reader()
    name = robot.attributes.get("name", "")
    if not name.strip():
        read.fault('<robot> has no name; write <robot name="...">', robot)
    unread = _unread(robot, read)
    macros = [e for e in robot.walk() if e.tag.startswith("xacro:")]
    if macros:
        read.fault(f"{len(macros)} xacro elements, such as <{macros[0].tag}>; run xacro on the file first", macros[0])
    robot = _with_planes_turned(robot, read)
    odd: dict[str, str] = {}
    links = [_link(e, read, odd, lenient) for e in robot.all("link")]
    joints = [_joint(e, read) for e in robot.all("joint")]
    texts = "".join(text for _, text in (*links, *joints))
    root = _check_tree([link.name for link, _ in links], [j for j, _ in joints], floating_base, read)
    followed, notes = _check_mimics([j for j, _ in joints], mimic_matters, lenient, read)
    if floating_base and any(j.name == BASE_JOINT for j in followed):
        read.fault(f"joint {BASE_JOINT!r}: floating_base=True adds a joint of that name; rename yours")
    if read.faults:
        raise ModelError(source, read.faults)
    if lenient and (points := [x.name for x, _ in links if x.mass and x.inertia is not None and not x.inertia.any()]):
        read.notes.append(f"links of mass without inertia, read as point masses: {listing(points, MAX_LISTED)}")
    return UrdfFile(
        name,
        element_text("robot", {"name": name}, texts),
        root,
        tuple(link for link, _ in links),
        tuple(followed),
        odd,
        notes=(*notes, *read.notes, *unread),
        point_masses=lenient,
    )


# The tree


def _check_tree(links: Sequence[str], joints: Sequence[UrdfJoint], floating_base: bool, read: Reader) -> str:
    """Find wrong names, loops, loose ends, and trees that are too large or do not move; return the root link."""
    for what, names in (("link", links), ("joint", [j.name for j in joints])):
        read.faults += repeated_names(what, [n for n in names if n])
    known = dict.fromkeys(n for n in links if n)
    suggestions = Suggestions()
    carriers = by_key((joint.child, joint) for joint in joints if joint.child in known)
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end and end not in known:
                near = suggestions.near(end, known)
                hint = f"did you mean {near!r}?" if near else "add the link"
                read.fault(f"joint {joint.name!r}: unknown link {end!r}; {hint}")
    if not known:
        read.fault("no links; expected <link> elements")
    for link, several in carriers.items():
        if len(several) > 1:
            names = ", ".join(repr(j.name) for j in several)
            read.fault(f"link {link!r}: child of {len(several)} joints ({names}); a URDF is a tree: keep one of them")
    roots = [n for n in known if n not in carriers]
    if len(roots) > 1:
        names = ", ".join(repr(n) for n in roots[:6]) + (", ..." if len(roots) > 6 else "")
        read.fault(
            f"{len(roots)} links that no joint carries ({names}); a robot has one root: connect or remove the rest"
        )
    for cycle in _cycles(known, carriers):
        names = ", ".join(map(repr, cycle))
        read.fault(f"joints {names} form a cycle; a URDF is a tree: cut the loop at one joint")
    if len(joints) > _MAX_JOINTS:
        read.fault(f"{len(joints)} joints; up to {_MAX_JOINTS} are read")
    if links and not floating_base and all(j.kind == "fixed" for j in joints):
        what = "all joints are fixed" if joints else "no joints"
        read.fault(f"{what}, so nothing moves (nq = 0); add a joint that moves, or load with floating_base=True")
    return roots[0] if roots else ""


def _cycles(links: Iterable[str], carriers: Mapping[str, Sequence[UrdfJoint]]) -> list[list[str]]:
    """Return the joints of every closed loop, from parent to child; each link's first parent counts."""
    done: set[str] = set()
    out = []
    for at in links:
        path: dict[str, str] = {}
        while at not in done and at not in path and at in carriers:
            path[at] = carriers[at][0].name
            at = carriers[at][0].parent
        if at in path:
            out.append([*path.values()][list(path).index(at) :][::-1])
        done |= path.keys()
    return out


def _check_mimics(
    joints: list[UrdfJoint], matters: bool, lenient: bool, read: Reader
) -> tuple[list[UrdfJoint], list[str]]:
    """Return the joints without the tags that cannot be followed, and notes on these."""
    by_name = {j.name: j for j in joints}
    on_fixed, unfollowed, suggestions = list[str](), list[str](), Suggestions()
    out = []
    for joint in joints:
        why = _why_lost(joint.mimic.joint, by_name, suggestions) if joint.mimic and joint.kind != "fixed" else ""
        if joint.mimic and joint.kind == "fixed":
            on_fixed.append(joint.name)
        elif why:
            unfollowed.append(f"{joint.name} (mimics {why})")
            if matters and not lenient:
                read.fault(f"joint {joint.name!r}: mimics {why}; correct the name, or load with mimic='free'")
        out.append(replace(joint, mimic=None) if why or joint.kind == "fixed" else joint)
    notes = (
        ("mimic tags on fixed joints say nothing and were left out", on_fixed),
        ("mimic joints left independent, because their tags lead nowhere", unfollowed),
    )
    return out, [f"{what}: {', '.join(names)}" for what, names in notes if names]


def _why_lost(leader: str, by_name: Mapping[str, UrdfJoint], suggestions: Suggestions) -> str:
    if leader not in by_name:
        near = suggestions.near(leader, by_name)
        return f"unknown joint {leader!r}" + (f", near {near!r}" if near else "")
    return f"fixed joint {leader!r}" if by_name[leader].kind == "fixed" else ""


# Single elements, with their texts for the parser: numbers as they were written, one space apart (urdfdom does
# not read ' 1.5 ', and drops the link's inertia).


def _copy(element: Element, *names: str) -> str:
    return element_text(
        element.tag, {n: " ".join(element.attributes[n].split()) for n in names if n in element.attributes}
    )


def _origin(owner: Element, item: str, read: Reader) -> tuple[_Numbers, _Numbers, str]:
    zeros = (0.0, 0.0, 0.0)
    origin = read.only(owner, "origin", item)
    if origin is None:
        return zeros, zeros, ""
    xyz, rpy = (read.numbers(origin, name, item, count=3, default=zeros) for name in ("xyz", "rpy"))
    if any(abs(x) > TWO_TURNS for x in rpy):
        read.notes.append(f"{item}: origin rpy {rpy} is beyond two turns; URDF's are radians ({origin.place})")
    return xyz, rpy, _copy(origin, "xyz", "rpy")


def _link(link: Element, read: Reader, odd: dict[str, str], lenient: bool) -> tuple[UrdfLink, str]:
    name = read.name(link, "name", "a link")
    item = f"link {name!r}"
    inertial = read.only(link, "inertial", item)
    if inertial is None:
        return UrdfLink(name), element_text("link", {"name": name})
    before = len(read.faults)
    com, rpy, text = _origin(inertial, item, read)
    mass, moments = (read.only(inertial, tag, item) for tag in ("mass", "inertia"))
    if mass is None:
        read.fault(f"{item}: <inertial> has no <mass>; add it, or remove <inertial>", inertial)
    if moments is None and lenient:
        moments = Element("inertia", dict.fromkeys(_MOMENTS, "0"), inertial.line)
    elif moments is None:
        remedy = 'add it, or take a point mass with nonphysical="warn"'
        read.fault(f"{item}: <inertial> has no <inertia>; {remedy}", inertial)
    if mass is None or moments is None:
        return UrdfLink(name), ""
    kg = read.number(mass, "value", item)
    ixx, ixy, ixz, iyy, iyz, izz = (read.number(moments, m, item) for m in _MOMENTS)
    inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
    if kg < 0:
        read.fault(f"{item}: mass {kg:g} kg is negative; expected 0 or more", mass)
    if len(read.faults) == before:
        why = body_fault(Body(name, kg, np.zeros(3), inertia), point_masses=lenient)
        odd |= {name: why} if why else {}
    text = element_text("inertial", {}, text + _copy(mass, "value") + _copy(moments, *_MOMENTS))
    return UrdfLink(name, kg, com, rpy, inertia), element_text("link", {"name": name}, text)


def _joint(joint: Element, read: Reader) -> tuple[UrdfJoint, str]:
    name = read.name(joint, "name", "a joint")
    item = f"joint {name!r}"
    type_ = joint.attributes.get("type", "")
    kind = _KINDS.get(type_, "")
    if not kind:
        read.fault(f"{item}: type {type_!r}; expected one of {', '.join(_KINDS)}", joint)
    xyz, rpy, text = _origin(joint, item, read)
    ends = {tag: _end(joint, tag, item, read) for tag in ("parent", "child")}
    text += "".join(element_text(tag, {"link": link}) for tag, link in ends.items())
    numbers: dict[str, Any] = {}
    for part in (_axis, _limit, _dynamics):
        values, inside = part(joint, kind, item, read)
        numbers |= values
        text += inside
    mimic = None
    follows = read.only(joint, "mimic", item)
    if follows is not None:
        ratio, offset = (read.number(follows, n, item, x) for n, x in (("multiplier", 1.0), ("offset", 0.0)))
        mimic = Mimic(read.name(follows, "joint", item), ratio, offset)
    text = element_text("joint", {"name": name, "type": type_}, text)
    return UrdfJoint(name, kind, ends["parent"], ends["child"], xyz, rpy, mimic, numbers), text


def _end(joint: Element, tag: str, item: str, read: Reader) -> str:
    end = read.only(joint, tag, item)
    if end is None:
        read.fault(f'{item}: no <{tag}>; add <{tag} link="..."/>', joint)
    return "" if end is None else read.name(end, "link", item)


def _axis(joint: Element, kind: str, item: str, read: Reader) -> tuple[dict[str, Any], str]:
    axis = read.only(joint, "axis", item)
    before = len(read.faults)
    vector = (1.0, 0.0, 0.0) if axis is None else read.numbers(axis, "xyz", item, count=3)
    if kind in ("", "fixed", "free") or len(read.faults) > before:
        return {}, ""
    if not any(vector):
        read.fault(f"{item}: axis is zero; expected a direction, such as 0 0 1", axis)
    return ({}, "") if kind == "planar" else ({"axis": vector}, _copy(axis, "xyz") if axis else "")


def _limit(joint: Element, kind: str, item: str, read: Reader) -> tuple[dict[str, Any], str]:
    limit = read.only(joint, "limit", item)
    bounded = kind in ("revolute", "prismatic")
    if limit is None:
        if bounded:
            remedy = "; or make it continuous" if kind == "revolute" else ""
            needed = '<limit lower="..." upper="..." effort="..." velocity="..."/>'
            read.fault(f"{item}: a {kind} joint needs {needed}{remedy}", joint)
        return {}, ""
    lower, upper = (read.number(limit, a, item, 0.0, bounded=False) for a in ("lower", "upper"))
    numbers: dict[str, Any] = {}
    for name in ("effort", "velocity"):
        value = read.number(limit, name, item, None if bounded else 0.0, bounded=False)
        if value < 0:
            read.fault(f"{item}: limit {name} is negative; expected 0 or more", limit)
        numbers[f"{name}_limit"] = unbounded(value)
    if not bounded and not (kind == "continuous" and {"effort", "velocity"} <= limit.attributes.keys()):
        return {}, ""
    if bounded and lower > upper:
        # PyBullet and others write no limit in this way.
        crossed = f"lower limit {lower:g} above upper limit {upper:g}"
        read.notes.append(f"{item}: {crossed}, read as no limit ({limit.place})")
        limit = replace(limit, attributes=limit.attributes | {"lower": f"-{_OPEN}", "upper": _OPEN})
        lower, upper = -math.inf, math.inf
    if bounded:
        numbers |= {"lower": unbounded(lower), "upper": unbounded(upper)}
    return numbers, _copy(limit, "lower", "upper", "effort", "velocity")


def _dynamics(joint: Element, kind: str, item: str, read: Reader) -> tuple[dict[str, Any], str]:
    dynamics = read.only(joint, "dynamics", item)
    if dynamics is None:
        return {}, ""
    numbers = {
        own: read.number(dynamics, name, item, 0.0)
        for name, own in (*zip(DYNAMICS, DYNAMICS, strict=True), *_SPRING.items())
    }
    for name, x in numbers.items():
        if x < rules_of(Joint)[name].least:
            read.fault(f"{item}: {name} {x:g} is negative; expected 0 or more", dynamics)
    stiffness, rest = numbers["stiffness"], numbers["rest"]
    if not stiffness:
        # A rest alone says nothing.
        numbers = {name: numbers[name] for name in DYNAMICS}
    if kind in ("free", "planar") and any(numbers.values()):
        what, type_ = "a spring" if stiffness else " or ".join(DYNAMICS), joint.attributes["type"]
        read.fault(f"{item}: {what} on a {type_} joint, which URDF parsers drop; remove it", dynamics)
    if stiffness:
        unit = "which a fixed joint leaves idle" if kind == "fixed" else "read as N m/rad or N/m"
        says = f"spring_stiffness {stiffness:g} about {rest:g}, which URDF does not define, {unit}"
        read.notes.append(f"{item}: {says} ({dynamics.place})")
    if kind in ("", "fixed", "free", "planar"):
        return {}, ""
    # Parsers refuse the element without one of these.
    return numbers, "" if dynamics.attributes.keys().isdisjoint(DYNAMICS) else _copy(dynamics, *DYNAMICS)


def unbounded(limit: ArrayLike) -> Array:
    """Return limits, infinite where the largest double of a parser stands for none."""
    return np.where(np.abs(limit) < 1e300, limit, np.copysign(np.inf, limit))


def _with_planes_turned(robot: Element, read: Reader) -> Element:
    """Return the robot with the normal of each planar joint along z: its frame is turned, and a fixed joint turns back.

    The turn is the shortest one from z to the normal; from -z it is about x.
    """
    links = {e.attributes.get("name", "") for e in robot.all("link")}
    joints = {e.attributes.get("name", "") for e in robot.all("joint")}
    children: list[Element] = []
    for e in robot.children:
        name, child = e.attributes.get("name", ""), e.first("child")
        if e.tag != "joint" or e.attributes.get("type") != "planar" or child is None:
            children.append(e)
            continue
        item, axis, before = f"joint {name!r}", read.only(e, "axis", f"joint {name!r}"), len(read.faults)
        normal = np.array((1.0, 0.0, 0.0) if axis is None else read.numbers(axis, "xyz", item, count=3))
        _, rpy, _ = _origin(e, item, read)
        if len(read.faults) > before or not normal.any() or not (normal[:2].any() or normal[2] < 0):
            children.append(e)
            continue
        R = z_to(normal)
        plane, back = reserved(f"{child.attributes.get('link', '')}_plane", links), reserved(f"{name}_back", joints)
        origin = e.first("origin")
        placed = origin.attributes if origin is not None else {}
        turned = placed | {"rpy": _rpy(spatial.matrix_from_rpy(*rpy) @ R)}
        new = {"origin": turned, "child": {"link": plane}, "axis": {"xyz": "0 0 1"}}
        others = [c for c in e.children if c.tag not in new]
        children += [
            replace(e, children=[*others, *(Element(tag, x, e.line) for tag, x in new.items())]),
            Element("link", {"name": plane}, e.line),
            Element(
                "joint",
                {"name": back, "type": "fixed"},
                e.line,
                [
                    Element("origin", {"rpy": _rpy(R.T)}, e.line),
                    Element("parent", {"link": plane}, e.line),
                    Element("child", dict(child.attributes), e.line),
                ],
            ),
        ]
        shown = " ".join(f"{x:g}" for x in normal)
        link = child.attributes.get("link", "")
        read.notes.append(
            f"{item}: its normal {shown} is z of the body {plane!r}, whose x and y it moves along; {link!r} is a frame "
            "of that body"
        )
    return replace(robot, children=children)


def _rpy(R: Array) -> str:
    return " ".join(repr(float(x)) for x in spatial.rpy_from_matrix(R))


# Unknown names


def _unread(robot: Element, read: Reader) -> list[str]:
    """Find misspelt and misplaced names in the dynamics, and return notes on everything else that is not read."""
    elements: Counter[str] = Counter()
    attributes: Counter[str] = Counter()
    stack = [robot]
    while stack:
        element = stack.pop()
        children, known = _SCHEMA[element.tag]
        for name in element.attributes.keys() - known:
            # A damper or spring of any name is none where its number is zero.
            idle = element.tag == "dynamics" and not element.attributes[name].strip(" +-.0")
            if (hint := _attribute_hint(element.tag, name, known)) and not idle:
                read.fault(f"<{element.tag}>: unknown attribute {name[:60]!r}; {hint}", element)
            elif not name.startswith("xmlns"):
                attributes[f"{element.tag} {name}"[:40]] += 1
        for child in element.children:
            if child.tag in children:
                continue
            if hint := _element_hint(element.tag, child.tag, children):
                read.fault(f"<{element.tag}>: unknown element <{child.tag[:60]}>; {hint}", child)
            else:
                elements[child.tag[:40]] += 1
        stack.extend(c for c in reversed(element.children) if c.tag in children)
    return [
        f"{what}: {listing([f'{n} {tag}' for tag, n in sorted(counts.items())], MAX_LISTED)}"
        for what, counts in (
            ("left out of the file, with every path in it", elements),
            ("attributes that URDF does not define, left out", attributes),
        )
        if counts
    ]


def _attribute_hint(tag: str, name: str, known: frozenset[str]) -> str:
    """Return what to write for a misspelt attribute, or an unknown one among numbers of the dynamics."""
    if ":" in name or name in _HARMLESS:
        return ""
    if correct := misspelt(name, known):
        return f"did you mean {correct!r}?"
    return f"expected {', '.join(sorted(known)) or 'none'}" if tag in _WHOLE else ""


def _element_hint(owner: str, tag: str, known: frozenset[str]) -> str:
    """Return what to write for a misspelt or misplaced element."""
    if ":" in tag or tag in _EXTENSIONS or (owner, tag) == ("link", "origin"):
        return ""
    if places := [f"<{other}>" for other, (inside, _) in _SCHEMA.items() if tag in inside]:
        return f"it belongs into {' or '.join(places)}"
    if correct := misspelt(tag, known):
        return f"did you mean <{correct}>?"
    return f"expected {', '.join(f'<{k}>' for k in sorted(known)) or 'none'}" if owner in _WHOLE else ""


# The model, link by link: the measure of importers


class Snapper:
    """Rounds entries of rotations and axes that are within `reach` of 0, 1 or -1, and counts them.

    Half a turn, written 3.141592653589793, gives 6e-17 in place of 0, and terms would not vanish when expressions are
    derived. Entries farther off, such as -3.67e-6 of the angle 1.5708, stay as written.
    """

    def __init__(self, reach: float = 8 * EPS) -> None:
        # A rotation matrix from a quaternion is off by up to about 5 eps.
        self._reach = reach
        self.count = 0
        self.largest = 0.0

    def __call__(self, entries: Array) -> Array:
        """Return the entries of a rotation matrix or a unit vector, rounded."""
        out = np.where(np.abs(entries) <= self._reach, 0.0, entries)
        # A one is set only where it is alone: beside an angle of 4e-8, whose cosine is
        # 1 - 8e-16, it would spoil the unit length.
        alone = np.ones(out.shape, dtype=bool)
        for axis in range(out.ndim):
            alone &= np.count_nonzero(out, axis=axis, keepdims=True) == 1
        near_one = alone & (np.abs(np.abs(out) - 1) <= self._reach)
        out = np.where(near_one, np.sign(out), out)
        change = np.abs(out - entries)
        self.count += int(np.count_nonzero(change))
        self.largest = max(self.largest, float(change.max()))
        return out

    @property
    def note(self) -> str | None:
        """A sentence on the changes, or None."""
        if not self.count:
            return None
        return (
            f"{self.count} entries of rotations and axes within {self._reach:.1e} of 0, 1 or -1 were set to it; "
            f"the largest change was {self.largest:.1e}"
        )


def urdf_links(root: Element, source: str, *, floating_base: bool = False) -> Model:
    """Return the model of a <robot> element with one body for each link, or raise `ModelError`.

    The root link is fixed to the world or floats; a root link called ``world`` is the world.
    """
    urdf = examine(root, source, floating_base=floating_base, mimic_matters=False, lenient=True)
    snap, b = Snapper(), ModelBuilder(urdf.name)
    for link in (x for x in urdf.links if x.name != "world"):
        if link.inertia is None:
            b.add_body(link.name)
            continue
        R, I = snap(spatial.matrix_from_rpy(*link.rpy)), link.inertia
        own = I if np.array_equal(R, np.eye(3)) else turned(R, I)
        b.add_body(link.name, mass=link.mass, com=link.com, inertia=0.5 * (own + own.T))
    if floating_base:
        b.add_joint(BASE_JOINT, "free", parent="world", child=urdf.root)
    elif urdf.root != "world":
        name = unused(f"world_to_{urdf.root}", {j.name for j in urdf.joints})
        b.add_joint(name, "fixed", parent="world", child=urdf.root)
    for j in urdf.joints:
        numbers = {**j.numbers, "mimic": j.mimic} if kind_of(j.kind).nv == 1 else {}
        R = snap(spatial.matrix_from_rpy(*j.rpy))
        b.add_joint(j.name, j.kind, parent=j.parent, child=j.child, translation=j.translation, rotation=R, **numbers)
    for note in urdf.notes:
        b.note(note)
    return b.build(nonphysical="warn")


def read_links(path: Path) -> Model:
    """Return `urdf_links` of a file."""
    return urdf_links(xml_reader.read(path), str(path))
