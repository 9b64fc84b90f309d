"""The tree of a URDF: names, parents, loops, and joints that follow others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

from mbkit.errors import Suggestions
from mbkit.load.attributes import Reader
from mbkit.model import Mimic

__all__ = ["UrdfJoint", "check_mimics", "check_names", "check_size", "check_tree"]

# The parser in C++ recurses over the tree, and its tables grow as the square.
_MOST_JOINTS: Final = 2000


@dataclass(frozen=True)
class UrdfJoint:
    """A joint's place in the tree; its numbers stay in the text."""

    name: str
    kind: str
    parent: str
    child: str
    mimic: Mimic | None


def check_names(links: Sequence[str], joints: Sequence[UrdfJoint], read: Reader) -> None:
    """Find names that are used twice, and links that do not exist."""
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
            told = ", ".join(repr(j.name) for j in several)
            read.fault(f"link {link!r}: child of {len(several)} joints ({told}); a URDF is a tree: keep one of them")
    roots = [n for n in known if n not in carriers]
    if len(roots) > 1:
        told = ", ".join(repr(n) for n in roots[:6]) + (", ..." if len(roots) > 6 else "")
        read.fault(
            f"{len(roots)} links that no joint carries ({told}); a robot has one root: connect or remove the rest"
        )
    for cycle in _cycles(known, carriers):
        read.fault(
            f"joints {', '.join(repr(n) for n in cycle)} form a cycle; a URDF is a tree: cut the loop at one joint"
        )
    return roots[0] if roots else ""


def _cycles(links: Iterable[str], carriers: Mapping[str, Sequence[UrdfJoint]]) -> list[list[str]]:
    """Return the joints of every closed loop, from parent to child; each link's first parent counts."""
    done: set[str] = set()
    found = []
    for start in links:
        path: dict[str, str] = {}
        at = start
        while at not in done and at not in path and at in carriers:
            path[at] = carriers[at][0].name
            at = carriers[at][0].parent
        if at in path:
            inside = list(path)[list(path).index(at) :]
            found.append([path[n] for n in reversed(inside)])
        done |= path.keys()
    return found


def check_size(links: Sequence[str], joints: Sequence[UrdfJoint], floating_base: bool, read: Reader) -> None:
    """Find trees that are too large, or in which nothing moves."""
    if len(joints) > _MOST_JOINTS:
        read.fault(f"{len(joints)} joints; up to {_MOST_JOINTS} are read")
    if links and not floating_base and all(j.kind == "fixed" for j in joints):
        what = "all joints are fixed" if joints else "no joints"
        read.fault(f"{what}, so nothing moves (nq = 0); add a joint that moves, or load with floating_base=True")


def check_mimics(
    joints: list[UrdfJoint], matters: bool, lenient: bool, read: Reader
) -> tuple[list[UrdfJoint], list[str]]:
    """Return the joints without the tags that cannot be followed, and what was said about those."""
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
