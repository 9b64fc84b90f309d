"""Elements and attributes that MuJoCo's schema does not have: misspelt names, whose values would be lost.

The schema is MuJoCo's own, printed by `mujoco.mj_printSchema`. It leaves out <frame>, in which MuJoCo
4.0.0 checks no names at all: there mbkit is stricter.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

from mbkit.errors import nearest
from mbkit.load.mjcf_attributes import ORIENTATIONS
from mbkit.load.xml_reader import Element, Reader

__all__ = ["check_names", "rules"]

# Where nothing acts on the smooth motion, an unknown name is a note.
_ASIDE: Final = frozenset(
    {
        *("visual", "statistic", "size", "sensor", "custom", "keyframe", "extension", "contact"),
        *("texture", "material", "skin", "hfield", "camera", "light"),
    }
)
# These are refused or not read as a whole.
_UNREAD: Final = frozenset({"replicate", "attach", "composite", "flexcomp", "plugin"})
_MOST_NOTED: Final = 6


@dataclass(frozen=True)
class Rule:
    """What an element may hold; `once` says that its parent has one at most."""

    attributes: frozenset[str] = frozenset()
    children: dict[str, Rule] = field(default_factory=dict)
    once: bool = False


def check_names(mujoco: Element, read: Reader) -> str:
    """Keep a fault for each unknown name that could act on the motion, and return a note about the others."""
    aside: list[str] = []
    _check(mujoco, rules(), read, aside)
    if not aside:
        return ""
    more = f" and {len(aside) - _MOST_NOTED} more" if len(aside) > _MOST_NOTED else ""
    return f"unknown to MuJoCo's schema, and ignored: {', '.join(aside[:_MOST_NOTED])}{more}"


def _check(element: Element, rule: Rule, read: Reader, aside: list[str], acts: bool = True) -> None:
    """Check an element and all inside; without effect on the motion (not `acts`), names go into `aside`."""

    def unknown(what: str, name: str, known: frozenset[str], where: Element) -> None:
        if acts and where.tag not in _ASIDE:
            read.fault(f"{_called(element)}: unknown {what} {name[:60]!r}{_hint(name, known)}", where)
        else:
            aside.append(f"{what} {name[:60]!r} of <{element.tag}> ({where.place})")

    for name in element.attributes:
        if name not in rule.attributes:
            unknown("attribute", name, rule.attributes, element)
    seen: set[str] = set()
    for child in element.children:
        inner = rule.children.get(child.tag)
        if child.tag in _UNREAD:
            continue
        if inner is None:
            unknown("element", child.tag, frozenset(rule.children), child)
        elif inner.once and child.tag in seen:
            read.fault(f"{_called(element)}: more than one <{child.tag}>; keep one", child)
        else:
            _check(child, inner, read, aside, acts and child.tag not in _ASIDE)
        seen.add(child.tag)


def _called(element: Element) -> str:
    name = element.attributes.get("name", "")
    return f"{element.tag} {name[:60]!r}" if name else f"<{element.tag}>"


@lru_cache(maxsize=1000)
def _hint(name: str, known: frozenset[str]) -> str:
    near = nearest(name[:60], sorted(known), 1)
    return f"; did you mean {near[0]!r}?" if near else f"; there are: {', '.join(sorted(known)) or 'none'}"


@lru_cache(maxsize=1)
def rules() -> Rule:
    """Return the rule for <mujoco>, from MuJoCo's schema."""
    # The first MJCF that is loaded pays for the import.
    import mujoco

    # Lines are "name (how often)   attribute attribute", indented by level; longer ones go on below.
    root = Rule()
    open_rules: list[tuple[int, Rule]] = [(-1, root)]
    found: list[tuple[int, str, str, list[str]]] = []
    for line in mujoco.mj_printSchema(False, False).splitlines():
        begun = re.fullmatch(r"( *)(\S+) \((.)\)(.*)", line)
        if begun:
            indent, tag, often, attributes = begun.groups()
            found.append((len(indent), tag.removeprefix("(world)"), often, attributes.split()))
        elif found:
            found[-1][3].extend(line.split())
    for level, tag, often, names in found:
        rule = Rule(frozenset(names), once=often in "!?")
        while open_rules[-1][0] >= level:
            open_rules.pop()
        open_rules[-1][1].children[tag] = rule
        open_rules.append((level, rule))
        if often == "R":
            rule.children[tag] = rule
    whole = root.children["mujoco"]
    body = whole.children.pop("body")
    frame_attributes = frozenset({"name", "class", "childclass", "pos", *ORIENTATIONS})
    world = {tag: rule for tag, rule in body.children.items() if tag not in ("inertial", "joint", "freejoint")}
    for children in (body.children, world):
        children["frame"] = Rule(frame_attributes, children)
    whole.children["worldbody"] = Rule(frozenset(), world)
    return whole
