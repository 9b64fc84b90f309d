"""Checks of a URDF before any parser in C++ reads it.

`examine` finds all faults of a file at once and writes its bodies and joints as plain XML, with the same names and
numbers, and without meshes, textures, plugins and all else that could point outside the file.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np

from mbkit.errors import ModelError, Suggestions
from mbkit.load.xml_reader import Element, Reader, misspelt
from mbkit.model import Body, Mimic
from mbkit.model.validation import body_fault

# The tree of a URDF

# The parser in C++ recurses over the tree, and its tables grow as the square.
_MAX_JOINTS: Final = 2000


@dataclass(frozen=True)
class UrdfJoint:
    """A joint without its numbers, which stay in the text."""

    name: str
    kind: str
    parent: str
    child: str
    mimic: Mimic | None


def check_names(links: Sequence[str], joints: Sequence[UrdfJoint], read: Reader) -> None:
    """Find repeated names, and links that do not exist."""
    for what, names in (("link", links), ("joint", [j.name for j in joints])):
        for name, count in Counter(names).items():
            if count > 1 and name:
                read.fault(f"{what} {name!r}: declared {count} times; names must differ")
    known = dict.fromkeys(n for n in links if n)
    suggestions = Suggestions()
    for joint in joints:
        for end in (joint.parent, joint.child):
            if end and end not in known:
                near = suggestions.near(end, known)
                hint = f"did you mean {near!r}?" if near else "add the link"
                read.fault(f"joint {joint.name!r}: unknown link {end!r}; {hint}")


def check_tree(links: Sequence[str], joints: Sequence[UrdfJoint], read: Reader) -> str:
    """Find loops and loose ends, and return the root link."""
    known = dict.fromkeys(n for n in links if n)
    if not known:
        read.fault("no links; expected <link> elements")
        return ""
    carriers: dict[str, list[UrdfJoint]] = {}
    for joint in joints:
        if joint.child in known:
            carriers.setdefault(joint.child, []).append(joint)
    for link, several in carriers.items():
        if len(several) > 1:
            listing = ", ".join(repr(j.name) for j in several)
            read.fault(f"link {link!r}: child of {len(several)} joints ({listing}); a URDF is a tree: keep one of them")
    roots = [n for n in known if n not in carriers]
    if len(roots) > 1:
        listing = ", ".join(repr(n) for n in roots[:6]) + (", ..." if len(roots) > 6 else "")
        read.fault(
            f"{len(roots)} links that no joint carries ({listing}); a robot has one root: connect or remove the rest"
        )
    for cycle in _cycles(known, carriers):
        read.fault(
            f"joints {', '.join(repr(n) for n in cycle)} form a cycle; a URDF is a tree: cut the loop at one joint"
        )
    return roots[0] if roots else ""


def _cycles(links: Iterable[str], carriers: Mapping[str, Sequence[UrdfJoint]]) -> list[list[str]]:
    """Return the joints of every closed loop, from parent to child; each link's first parent counts."""
    done: set[str] = set()
    out = []
    for start in links:
        path: dict[str, str] = {}
        at = start
        while at not in done and at not in path and at in carriers:
            path[at] = carriers[at][0].name
            at = carriers[at][0].parent
        if at in path:
            inside = list(path)[list(path).index(at) :]
            out.append([path[n] for n in reversed(inside)])
        done |= path.keys()
    return out


def check_size(links: Sequence[str], joints: Sequence[UrdfJoint], floating_base: bool, read: Reader) -> None:
    """Find trees that are too large, or in which nothing moves."""
    if len(joints) > _MAX_JOINTS:
        read.fault(f"{len(joints)} joints; up to {_MAX_JOINTS} are read")
    if links and not floating_base and all(j.kind == "fixed" for j in joints):
        what = "all joints are fixed" if joints else "no joints"
        read.fault(f"{what}, so nothing moves (nq = 0); add a joint that moves, or load with floating_base=True")


def check_mimics(
    joints: list[UrdfJoint], matters: bool, lenient: bool, read: Reader
) -> tuple[list[UrdfJoint], list[str]]:
    """Return the joints without the tags that cannot be followed, and notes on these."""
    by_name = {j.name: j for j in joints}
    out, fixed, lost = [], [], []
    suggestions = Suggestions()
    for joint in joints:
        keep = joint.mimic
        if keep is not None and joint.kind == "fixed":
            keep = None
            fixed.append(joint.name)
        elif keep is not None and (why := _why_lost(keep.joint, by_name, suggestions)):
            keep = None
            lost.append(f"{joint.name} (mimics {why})")
            if matters and not lenient:
                read.fault(f"joint {joint.name!r}: mimics {why}; correct the name, or load with mimic='free'")
        out.append(replace(joint, mimic=keep))
    notes = []
    if fixed:
        notes.append(f"mimic tags on fixed joints say nothing and were left out: {', '.join(fixed)}")
    if lost:
        notes.append(f"mimic joints left independent, because their tags lead nowhere: {', '.join(lost)}")
    return out, notes


def _why_lost(leader: str, by_name: Mapping[str, UrdfJoint], suggestions: Suggestions) -> str:
    if leader not in by_name:
        near = suggestions.near(leader, by_name)
        return f"unknown joint {leader!r}" + (f", near {near!r}" if near else "")
    return f"fixed joint {leader!r}" if by_name[leader].kind == "fixed" else ""


_KINDS: Final = {
    "fixed": "fixed",
    "revolute": "revolute",
    "continuous": "continuous",
    "prismatic": "prismatic",
    "floating": "free",
    "planar": "planar",
}
# Pinocchio's parser takes this for no limit.
_OPEN: Final = "1.7976931348623157e308"
# Names in a note.
_MAX_LISTED: Final = 40
_MOMENTS: Final = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass(frozen=True)
class UrdfFile:
    """A URDF without faults."""

    name: str
    text: str  # the bodies and joints alone
    root: str  # the link that no joint carries
    joints: tuple[UrdfJoint, ...]  # in the file's order
    links: frozenset[str]
    odd_links: Mapping[str, str]  # links of inconsistent inertia, which links fixed to them may correct, and why
    notes: tuple[str, ...]


def examine(robot: Element, source: str, *, floating_base: bool, mimic_matters: bool, lenient: bool) -> UrdfFile:
    """Check a <robot> element, or raise `ModelError` with every fault.

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

    odd: dict[str, str] = {}
    link_texts = [_link(e, read, odd) for e in robot.all("link")]
    links = [e.attributes.get("name", "") for e in robot.all("link")]
    joints_and_texts = [_joint(e, read) for e in robot.all("joint")]
    joints = [j for j, _ in joints_and_texts]
    check_names(links, joints, read)
    root = check_tree(links, joints, read)
    check_size(links, joints, floating_base, read)
    joints, notes = check_mimics(joints, mimic_matters, lenient, read)
    if floating_base and any(j.name == "root_joint" for j in joints):
        read.fault("joint 'root_joint': floating_base=True adds a joint of that name; rename yours")
    if read.faults:
        raise ModelError(source, read.faults)
    text = _written("robot", {"name": name}, [*link_texts, *(t for _, t in joints_and_texts)])
    return UrdfFile(name, text, root, tuple(joints), frozenset(links), odd, notes=(*notes, *read.notes, *unread))


def unbounded(limit: float) -> float:
    """Return a limit, infinite where it is a parser's largest double."""
    return limit if abs(limit) < 1e300 else math.copysign(math.inf, limit)


# Texts of single elements: numbers as they were written, one space apart (urdfdom does
# not read ' 1.5 ', and drops the link's inertia).


def _written(tag: str, attributes: Mapping[str, str], inside: Iterable[str] = ()) -> str:
    listing = "".join(f" {k}={quoteattr(v)}" for k, v in attributes.items())
    body = "".join(inside)
    return f"<{tag}{listing}>{body}</{tag}>" if body else f"<{tag}{listing}/>"


def _copied(element: Element, *names: str) -> str:
    return _written(element.tag, {n: " ".join(element.attributes[n].split()) for n in names if n in element.attributes})


def _origin(owner: Element, item: str, read: Reader) -> list[str]:
    origin = read.only(owner, "origin", item)
    if origin is None:
        return []
    read.numbers(origin, "xyz", item, count=3, default=(0, 0, 0))
    read.numbers(origin, "rpy", item, count=3, default=(0, 0, 0))
    return [_copied(origin, "xyz", "rpy")]


def _link(link: Element, read: Reader, odd: dict[str, str]) -> str:
    name = read.name(link, "name", "a link")
    item = f"link {name!r}"
    inertial = read.only(link, "inertial", item)
    if inertial is None:
        return _written("link", {"name": name})
    before = len(read.faults)
    texts = _origin(inertial, item, read)
    mass, moments = (read.only(inertial, tag, item) for tag in ("mass", "inertia"))
    for tag, element in (("mass", mass), ("inertia", moments)):
        if element is None:
            read.fault(f"{item}: <inertial> has no <{tag}>; add it, or remove <inertial>", inertial)
    if mass is None or moments is None:
        return ""
    kg = read.number(mass, "value", item)
    ixx, ixy, ixz, iyy, iyz, izz = (read.number(moments, m, item) for m in _MOMENTS)
    if kg < 0:
        read.fault(f"{item}: mass {kg:g} kg is negative; expected 0 or more", mass)
    if len(read.faults) == before:
        inertia = np.array([[ixx, ixy, ixz], [ixy, iyy, iyz], [ixz, iyz, izz]])
        why = body_fault(Body(name, kg, np.zeros(3), inertia), point_masses=False)
        if why:
            odd[name] = why
    texts += [_copied(mass, "value"), _copied(moments, *_MOMENTS)]
    return _written("link", {"name": name}, [_written("inertial", {}, texts)])


def _joint(joint: Element, read: Reader) -> tuple[UrdfJoint, str]:
    name = read.name(joint, "name", "a joint")
    item = f"joint {name!r}"
    type_ = joint.attributes.get("type", "")
    kind = _KINDS.get(type_, "")
    if not kind:
        read.fault(f"{item}: type {type_!r}; expected one of {', '.join(_KINDS)}", joint)
    texts = _origin(joint, item, read)
    ends = {tag: _end(joint, tag, item, read) for tag in ("parent", "child")}
    texts += [_written(tag, {"link": link}) for tag, link in ends.items()]
    texts += _axis(joint, kind, item, read)
    texts += _limit(joint, kind, item, read)
    dynamics = read.only(joint, "dynamics", item)
    if dynamics is not None:
        damping, friction = (read.number(dynamics, a, item, 0.0) for a in ("damping", "friction"))
        if friction < 0:
            read.fault(f"{item}: friction {friction:g} is negative; expected 0 or more", dynamics)
        if kind in ("free", "planar") and (damping or friction):
            read.fault(f"{item}: damping or friction on a {type_} joint, which URDF parsers drop; remove it", dynamics)
        if kind not in ("", "fixed", "free", "planar") and {"damping", "friction"} & dynamics.attributes.keys():
            texts.append(_copied(dynamics, "damping", "friction"))
    mimic = None
    follows = read.only(joint, "mimic", item)
    if follows is not None:
        ratio, offset = (read.number(follows, n, item, x) for n, x in (("multiplier", 1.0), ("offset", 0.0)))
        mimic = Mimic(read.name(follows, "joint", item), ratio, offset)
    text = _written("joint", {"name": name, "type": type_}, texts)
    return UrdfJoint(name, kind, ends["parent"], ends["child"], mimic), text


def _end(joint: Element, tag: str, item: str, read: Reader) -> str:
    end = read.only(joint, tag, item)
    if end is None:
        read.fault(f'{item}: no <{tag}>; add <{tag} link="..."/>', joint)
    return "" if end is None else read.name(end, "link", item)


def _axis(joint: Element, kind: str, item: str, read: Reader) -> list[str]:
    axis = read.only(joint, "axis", item)
    before = len(read.faults)
    vector = (1.0, 0.0, 0.0) if axis is None else read.numbers(axis, "xyz", item, count=3)
    if kind in ("", "fixed", "free") or len(read.faults) > before:
        return []
    if axis is not None and not any(vector):
        read.fault(f"{item}: axis is zero; expected a direction, such as 0 0 1", axis)
    elif kind == "planar" and (vector[:2] != (0, 0) or vector[2] <= 0):
        listing = " ".join(f"{x:g}" for x in vector)
        read.fault(
            f"{item}: planar with the normal {listing} (URDF's default is 1 0 0); only 0 0 1 is read: "
            'turn the joint by <origin rpy="..."/> and write <axis xyz="0 0 1"/>',
            axis or joint,
        )
    return [] if axis is None or kind == "planar" else [_copied(axis, "xyz")]


def _limit(joint: Element, kind: str, item: str, read: Reader) -> list[str]:
    limit = read.only(joint, "limit", item)
    bounded = kind in ("revolute", "prismatic")
    if limit is None:
        if bounded:
            remedy = "; or make it continuous" if kind == "revolute" else ""
            read.fault(
                f'{item}: a {kind} joint needs <limit lower="..." upper="..." effort="..." velocity="..."/>{remedy}',
                joint,
            )
        return []
    needed = None if bounded else 0.0
    lower, upper = (read.number(limit, a, item, 0.0, bounded=False) for a in ("lower", "upper"))
    for attribute in ("effort", "velocity"):
        if read.number(limit, attribute, item, needed, bounded=False) < 0:
            read.fault(f"{item}: limit {attribute} is negative; expected 0 or more", limit)
    if bounded and lower > upper:
        # PyBullet and others write no limit in this way.
        crossed = f"lower limit {lower:g} above upper limit {upper:g}"
        read.notes.append(f"{item}: {crossed}, read as no limit ({limit.place})")
        limit = replace(limit, attributes=limit.attributes | {"lower": f"-{_OPEN}", "upper": _OPEN})
    if not bounded and not (kind == "continuous" and {"effort", "velocity"} <= limit.attributes.keys()):
        return []
    return [_copied(limit, "lower", "upper", "effort", "velocity")]


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
        ("dynamics", "", "damping friction"),
        ("mimic", "", "joint multiplier offset"),
    )
}
# Elements of the specification or of common extensions that say nothing about the dynamics.
_EXTENSIONS: Final = frozenset({"visual", "collision", "material", "transmission", "contact", "calibration"})
# In these an unknown name would be a lost part of the dynamics, except for these attributes of simulators.
_WHOLE: Final = frozenset({"inertial", "origin", "mass", "inertia", "parent", "child", "dynamics", "mimic"})
_HARMLESS: Final = frozenset({"D", "K", "mu_coulomb", "mu_viscous"})


def _unread(robot: Element, read: Reader) -> list[str]:
    """Find misspelt and misplaced names in the dynamics, and return notes on everything else that is not read."""
    elements: Counter[str] = Counter()
    attributes: Counter[str] = Counter()
    stack = [robot]
    while stack:
        element = stack.pop()
        children, known = _SCHEMA[element.tag]
        for name in element.attributes.keys() - known:
            if not _misspelt_attribute(element, name, known, read) and not name.startswith("xmlns"):
                attributes[f"{element.tag} {name}"] += 1
        stack.extend(c for c in reversed(element.children) if c.tag in children)
        for child in element.children:
            if child.tag not in children and not _misspelt_element(element, child, children, read):
                elements[child.tag] += 1
    notes = []
    for what, counts in (
        ("left out of the file, with every path in it", elements),
        ("attributes that URDF does not define, left out", attributes),
    ):
        listing = ", ".join(f"{n} {tag[:40]}" for tag, n in sorted(counts.items())[:_MAX_LISTED])
        listing += f" and {len(counts) - _MAX_LISTED} more" if len(counts) > _MAX_LISTED else ""
        notes += [f"{what}: {listing}"] if listing else []
    return notes


def _misspelt_attribute(element: Element, name: str, known: frozenset[str], read: Reader) -> bool:
    """Keep a fault where an attribute is a misspelt one, or an unknown one among numbers of the dynamics."""
    if ":" in name or name in _HARMLESS:
        return False
    meant = misspelt(name, known)
    if not meant and element.tag not in _WHOLE:
        return False
    hint = f"did you mean {meant!r}?" if meant else f"expected {', '.join(sorted(known)) or 'none'}"
    read.fault(f"<{element.tag}>: unknown attribute {name[:60]!r}; {hint}", element)
    return True


def _misspelt_element(owner: Element, child: Element, known: frozenset[str], read: Reader) -> bool:
    """Keep a fault where an element is a misspelt or misplaced one."""
    if ":" in child.tag or child.tag in _EXTENSIONS or (owner.tag, child.tag) == ("link", "origin"):
        return False
    places = [f"<{tag}>" for tag, (inside, _) in _SCHEMA.items() if child.tag in inside]
    meant = "" if places else misspelt(child.tag, known)
    if places:
        hint = f"it belongs into {' or '.join(places)}"
    elif meant:
        hint = f"did you mean <{meant}>?"
    elif owner.tag in _WHOLE:
        hint = f"expected {', '.join(f'<{tag}>' for tag in sorted(known)) or 'none'}"
    else:
        return False
    read.fault(f"<{owner.tag}>: unknown element <{child.tag[:60]}>; {hint}", child)
    return True
