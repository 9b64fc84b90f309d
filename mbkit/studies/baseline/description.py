"""A description as named numbers, one for each parameter that a person may have edited.

A section a kind of part; what has its default value (no damping, no limit, no rotation) is left out.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.load import load
from mbkit.load.loader import find
from mbkit.load.urdf_reader import read_links
from mbkit.model import Body, Joint, Loop, Model, NoSlip
from mbkit.model.changes.freeing import SYMMETRIC
from mbkit.model.elements.formula import Formula
from mbkit.model.elements.references import KINDS_OF_PARTS, called
from mbkit.model.parts import ENTRIES, OF_Q, PointSpring, rules_of
from mbkit.studies._targets import resolved, resolved_options
from mbkit.studies.explain.hypotheses import turn_of

Part = dict[str, Any]
#: Section -> part -> field -> number, text or list of numbers; a flat section has one part without name.
Description = dict[str, dict[str, Part]]

#: Kinds of parts whose section, or word for a part, is another one than theirs: files that users keep have these.
_SECTION: Final = {"prescribed": "motions"}
_NOUN: Final = {"prescribed": "prescribed motion of joint"}
#: Section -> what its part is called; causes before their effects: a link's place before the body that it is part of.
SECTIONS: Final = {
    "system": "",
    "parameters": "parameter",
    "expressions": "",
    "energies": "",
    "links": "link",
    "places": "joint",
    **{
        _SECTION.get(kind, kind): _NOUN.get(kind, called(kind))
        for kind in (*reversed(KINDS_OF_PARTS[:3]), *KINDS_OF_PARTS[3:])
    },
}
#: Rules of numbers by field.
_RULES: Final = {n: x for cls in (Model, Body, Joint, PointSpring, Loop, NoSlip) for n, x in rules_of(cls).items()}
FLAT: Final = ("system", "parameters", "expressions", "energies")
_TRIANGLE: Final = np.triu_indices(3)


def described(model: Model) -> Description:
    """Return every number and name of a model, in its own order."""
    parameters: Part = {name: float(x) for name, x in model.parameters.items() if x is not None}
    if not model.has_bodies:
        return _written(model, parameters)
    out: Description = {
        "system": {"": {"name": model.name, "gravity": _plain(model.gravity)}},
        "parameters": {"": parameters},
        "expressions": {
            "": {f"{b.field}{list(b.index) or ''} of {b.part}".strip(): str(b.expression) for b in model.bindings}
        },
        **{_SECTION.get(kind, kind): {p.name: _part(p) for p in getattr(model, kind)} for kind in KINDS_OF_PARTS},
        "frames": _frames(model),
    }
    return {section: parts for section, parts in out.items() if any(parts.values())}


def _written(model: Model, parameters: Part) -> Description:
    s: Any = model.form  # type: ignore[attr-defined]  # energies have their system
    named = {"T": s.T, "V": s.V, "dissipation": s.dissipation, "forces": list(s.forces)}
    named |= {f"constraint {k + 1}": x for k, x in enumerate(s.constraints)}
    if hasattr(s, "D"):
        # The matrix that makes quasi-velocities the coordinates' rates.
        named["D"] = s.D.tolist()
    names = {"coordinates": ", ".join(model.coordinate_names), "velocities": ", ".join(model.velocity_names)}
    return {
        "system": {"": {"name": model.name} | names},
        "parameters": {"": parameters},
        "energies": {"": {name: str(x) for name, x in named.items()}},
    }


def _frames(model: Model) -> dict[str, Part]:
    """Return the frames; one where another stands, as a fixed joint where its link, only says so."""
    out: dict[str, Part] = {}
    first: dict[str, str] = {}
    for frame in model.frames:
        part = _part(frame)
        place = repr(part)
        out[frame.name] = {"same_as": first[place]} if place in first else part
        first.setdefault(place, frame.name)
    return out


def _part(part: Any) -> Part:
    out: Part = {}
    # The first field is the name, but of what has the name of its body.
    for f in fields(part)[part.name == getattr(part, fields(part)[0].name) :]:
        value = getattr(part, f.name)
        if f.name == "mimic":
            if value is not None:
                out |= {"mimic": value.joint, "ratio": value.ratio, "offset": value.offset}
        else:
            plain = _plain(value[_TRIANGLE] if f.name == "inertia" else value)
            kept = f.name == "mass" or isinstance(value, (str, tuple))
            if kept or not np.array_equal(plain, default(f.name, plain)):
                out[f.name] = plain
    return out


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, Formula):
        # A text: files of baselines have no nested parts.
        return "" if value is None else repr((value.arguments, value.operations, value.outputs))
    if isinstance(value, tuple):
        return ", ".join(value)
    return [float(x) for x in value.ravel()] if isinstance(value, np.ndarray) else value


def default(field: str, like: Any) -> Any:
    """Return the value of a field that is left out, of the shape of another."""
    if isinstance(like, str):
        return ""
    if not isinstance(like, list) or field == "ratio":
        return 1.0 if field == "ratio" else 0.0
    if field.startswith("rotation"):
        return [float(x) for x in np.eye(3).ravel()]
    return [_RULES[field].nothing if field in _RULES else 0.0] * len(like)


def moving_mass(description: Mapping[str, Mapping[str, Part]]) -> tuple[float, Array]:
    """Return the total mass, kg, and the gravity, m/s²; zeros where energies do not tell them."""
    mass = sum(float(part["mass"]) for part in description.get("bodies", {}).values())
    gravity = description.get("system", {}).get("", {}).get("gravity", [0.0, 0.0, 0.0])
    return mass, np.array(gravity, dtype=np.float64)


# Differences of two descriptions, parameter by parameter, in words.

#: Roundings in a number: another release of a parser may add the same numbers in another order.
_MAX_ROUNDINGS: Final = 64
_XYZ: Final = ENTRIES[:3]
_ENTRIES: Final = {
    **{name: _XYZ for name, rule in _RULES.items() if rule.shape == (3,)},
    "inertia": tuple(name for name, _ in SYMMETRIC),
    "axes": (*_XYZ, *(f"{x} of the second" for x in _XYZ)),
}
#: Least turn that is told, rad; a smaller one is within the rounding of its sine.
_LEAST_TURN_RAD: Final = 1e-7


@dataclass(frozen=True)
class Change:
    """One parameter that differs.

    `section` is such as ``"bodies"``; `part` is the name of the body, joint or other part, empty where the section has
    but one; `field` is such as ``"mass"``, empty where the whole part is new or gone; `old` and `new` are a number, a
    text, a list of numbers or None; `text` says it in words: ``"mass of body link5: 2.3 → 2.31"``. `rounding` says
    whether it is no more than rounding.
    """

    section: str
    part: str
    field: str
    old: Any
    new: Any
    text: str
    rounding: bool = False


def changes(old: Description, new: Description) -> tuple[Change, ...]:
    """Return what differs, causes before effects: a link's place before the body whose inertia it moves."""
    return tuple(c for section in SECTIONS for c in _section(section, old, new))


def _section(section: str, old: Description, new: Description) -> Iterator[Change]:
    before, after = old.get(section, {}), new.get(section, {})
    if section == "frames":
        # One that stood where another does, and now stands elsewhere, is told by its own place.
        apart = [n for n in before if n in after and before[n].get("same_as") != after[n].get("same_as")]
        before, after = ({**x, **{n: x[x[n].get("same_as", n)] for n in apart}} for x in (before, after))
    noun = SECTIONS[section]
    added = [n for n in after if n not in before and n]
    for name in [n for n in before if n not in after and n]:
        same = next((n for n in added if after[n] == before[name]), None)
        if same is None:
            yield Change(section, name, "", before[name], None, f"{noun} {name} is gone")
        else:
            added.remove(same)
            yield Change(section, name, "", name, same, f"{noun} {name} is called {same} now")
    for name in added:
        yield Change(section, name, "", None, after[name], f"{noun} {name} is new")
    kept = [n for n in before if n in after] if section not in FLAT else [""]
    if section == "joints" and kept != (now := [n for n in after if n in before]):
        order = f"order of the joints: {', '.join(kept)} → {', '.join(now)}"
        yield Change(section, "", "order", kept, now, order)
    for name in kept:
        owner = f"{noun} {name}{_more(section, name, new)}"
        yield from _fields(section, name, owner, before.get(name, {}), after.get(name, {}))


def _more(section: str, name: str, description: Description) -> str:
    """Return the names of a file that stand for a part too: what a parser has merged into it."""
    frames = description.get("frames", {})
    if section == "frames":
        names = [n for n, frame in frames.items() if frame.get("same_as") == name]
        return f" ({', '.join(names)})" if names else ""
    names = [n for n, frame in frames.items() if frame.get("body") == name]
    return f" (with {', '.join(names)} fixed to it)" if names and section == "bodies" else ""


def _fields(section: str, name: str, owner: str, before: Part, after: Part) -> Iterator[Change]:
    for field in dict.fromkeys([*before, *after]):
        # A number that a flat section leaves out does not exist, rather than being zero.
        absent = section in FLAT and section != "system"
        old = before.get(field, None if absent else default(field, after.get(field)))
        new = after.get(field, None if absent else default(field, before.get(field)))
        if old == new:
            continue
        what = field.replace("_", " ")
        if section == "parameters":
            what = f"parameter {field}"
        elif section not in FLAT:
            what = f"{what} of {owner}"
        x, y = _numbers(old), _numbers(new)
        text, rounding = " → ".join("none" if z in (None, "") else str(z) for z in (old, new)), False
        if x is not None and y is not None and x.shape == y.shape:
            text, rounding = _difference(field, x, y), _only_rounding(field, x, y)
        yield Change(section, name, field, old, new, f"{what}: {text}", rounding)


def _numbers(x: Any) -> Array | None:
    return np.array(x, dtype=np.float64, ndmin=1) if isinstance(x, (int, float, list)) else None


def _difference(field: str, old: Array, new: Array) -> str:
    if field.startswith("rotation") and len(old) == 9 and (turned := _turn(old, new)):
        return turned
    names = _ENTRIES.get(field, [str(k) for k in range(len(old))] if len(old) > 1 else [""])
    # Equal infinities are no difference, though they have none.
    moved = [k for k in range(len(old)) if old[k] != new[k]]
    return ", ".join(f"{names[k]} {_pair(old[k], new[k])}".strip() for k in moved)


def _pair(old: float, new: float) -> str:
    for digits in (6, 9, 12):
        a, b = f"{old:.{digits}g}", f"{new:.{digits}g}"
        if a != b:
            return f"{a} → {b}"
    return f"{old:.17g} → {new:.17g}"


def _turn(old: Array, new: Array) -> str:
    """Return by how much and about which of the old axes a frame has turned; empty for a turn within rounding."""
    turned = turn_of(old.reshape(3, 3).T @ new.reshape(3, 3))
    angle = float(np.linalg.norm(turned))
    if angle < _LEAST_TURN_RAD:
        return ""
    axis = ", ".join(f"{x:g}" for x in np.round(turned / angle, 4) + 0.0)
    return f"turned by {angle:.6g} rad about ({axis})"


def _only_rounding(field: str, old: Array, new: Array) -> bool:
    if not (np.isfinite(old).all() and np.isfinite(new).all()):
        return False
    rule = _RULES.get(field)
    # Zero is no size of a place, a direction or a limit: an origin moved by 1e-17 m has not moved.
    absolute = rule and (rule.direction or rule.place or rule.shape == OF_Q)
    size = max(float(np.linalg.norm(old)), 1.0 if absolute else 0.0)
    return float(np.linalg.norm(new - old)) <= _MAX_ROUNDINGS * EPS * size


# A `Model` has one body for links that are fixed to each other. Their own numbers are recorded beside it, so that a
# change names the link or joint that was edited.

LINK_SECTIONS: Final = ("links", "places")
_PLACE: Final = ("translation", "rotation")


def links_of(model: Model, target: str, options: Mapping[str, Any], baseline: Path) -> Description:
    """Return the sections "links" and "places"; nothing where the target is no URDF that makes this very model."""
    path = _urdf(target, baseline)
    if path is None:
        return {}
    try:
        with warnings.catch_warnings(action="ignore", category=MbkitWarning):
            # By its own name: a robot's inconsistent bodies stay as written.
            if load(resolved(target, baseline), **resolved_options(options, baseline)).digest != model.digest:
                return {}
            return _merged(read_links(path))
    except (MbkitError, TypeError):
        # Links only make a message more exact; loading the target reports its faults.
        return {}


def _urdf(target: str, baseline: Path) -> Path | None:
    if not target:
        return None
    if target.lower().endswith(".urdf"):
        return Path(resolved(target, baseline))
    try:
        robot = find(target)
    except MbkitError:
        return None
    return robot.path if robot else None


def _merged(whole: Model) -> Description:
    """Return the links that share a body with others, and the places of the joints upon these."""
    host: dict[str, str] = {}
    for joint in whole.tree:
        fixed = not joint.type.nv and joint.parent != "world"
        host[joint.child] = host[joint.parent] if fixed else joint.child
    size = Counter(host.values())
    shared = [link for link, body in host.items() if size[body] > 1]
    parts = described(whole)
    bodies, joints = parts["bodies"], parts["joints"]
    return {
        "links": {link: bodies[link] for link in shared},
        "places": {n: {f: p[f] for f in _PLACE if f in p} for n, p in joints.items() if p["parent"] in shared},
    }


def without_consequences(changed: tuple[Change, ...], old: Description) -> tuple[Change, ...]:
    """Return the changes without those of merged bodies and frames that follow from a link's."""
    if not any(c.section in LINK_SECTIONS for c in changed):
        return changed
    hosts = {frame["body"] for frame in old.get("frames", {}).values() if "body" in frame}

    def follows(c: Change) -> bool:
        if c.section == "bodies":
            return c.part in hosts and c.field != ""
        moves = c.section == "frames" or (c.section == "joints" and c.part in old.get("places", {}))
        return moves and c.field in _PLACE

    return tuple(c for c in changed if not follows(c))
