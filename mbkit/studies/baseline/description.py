"""A description as named numbers, one for each parameter that a person may have edited.

A section a kind of part; what has its default value (no damping, no limit, no rotation) is left out.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["FLAT", "SECTIONS", "Description", "Part", "default", "described", "moving_mass"]

Part = dict[str, Any]
#: Section -> part -> field -> number, text or list of numbers; a flat section has one part without name.
Description = dict[str, dict[str, Part]]

#: Section -> what its part is called; causes before their effects: a link's place before the body that it is part of.
SECTIONS: Final = {
    "system": "",
    "parameters": "parameter",
    "expressions": "",
    "energies": "",
    "links": "link",
    "places": "joint",
    "frames": "frame",
    "joints": "joint",
    "bodies": "body",
    "springs": "spring",
    "couplings": "coupling",
    "loops": "loop",
    "motions": "prescribed motion of joint",
}
FLAT: Final = ("system", "parameters", "expressions", "energies")
_UPPER: Final = ("upper", "velocity_limit", "effort_limit")
_TRIANGLE: Final = np.triu_indices(3)


def described(model: Model) -> Description:
    """Return every number and name of a model, in its own order."""
    if model.written is not None:
        return _written(model, model.system)  # type: ignore[attr-defined]  # energies have their system
    out: Description = {
        "system": {"": {"name": model.name, "gravity": _plain(model.gravity)}},
        "parameters": {"": _parameters(model)},
        "expressions": {
            "": {f"{b.field}{_at(b.index)} of {b.part}".strip(): str(b.expression) for b in model.bindings}
        },
        "joints": _parts(model.joints),
        "frames": _frames(model),
        "bodies": _parts(model.bodies),
        "springs": _parts(model.springs),
        "couplings": _parts(model.couplings),
        "loops": _parts(model.loops),
        "motions": {m.joint: _part(m, "joint") for m in model.prescribed},
    }
    return {section: parts for section, parts in out.items() if any(parts.values())}


def _written(model: Model, s: Any) -> Description:
    named = {"T": s.T, "V": s.V, "dissipation": s.dissipation, "forces": list(s.forces)}
    named |= {f"constraint {k + 1}": x for k, x in enumerate(s.constraints)}
    if hasattr(s, "D"):
        # Of a system in quasi-velocities: what makes them the coordinates' rates.
        named["D"] = s.D.tolist()
    names = {
        "name": model.name,
        "coordinates": ", ".join(model.coordinate_names),
        "velocities": ", ".join(model.velocity_names),
    }
    return {
        "system": {"": names},
        "parameters": {"": _parameters(model)},
        "energies": {"": {name: str(x) for name, x in named.items()}},
    }


def _parameters(model: Model) -> Part:
    return {name: float(x) for name, x in model.parameters.items() if x is not None}


def _at(index: tuple[int, ...]) -> str:
    return f"[{', '.join(map(str, index))}]" if index else ""


def _parts(parts: Iterable[Any]) -> dict[str, Part]:
    return {part.name: _part(part, "name") for part in parts}


def _frames(model: Model) -> dict[str, Part]:
    """Return the frames; one where another stands, as a fixed joint where its link, only says so."""
    out: dict[str, Part] = {}
    first: dict[str, str] = {}
    for frame in model.frames:
        part = _part(frame, "name")
        place = repr(part)
        out[frame.name] = {"same_as": first[place]} if place in first else part
        first.setdefault(place, frame.name)
    return out


def _part(part: Any, name: str) -> Part:
    out: Part = {}
    for f in fields(part):
        value = getattr(part, f.name)
        if f.name == "mimic":
            if value is not None:
                out |= {"mimic": value.joint, "ratio": value.ratio, "offset": value.offset}
        elif f.name != name and (isinstance(value, (str, tuple)) or not _is_default(f.name, value) or f.name == "mass"):
            out[f.name] = _plain(value[_TRIANGLE] if f.name == "inertia" else value)
    return out


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return ", ".join(value)
    return [float(x) for x in value.ravel()] if isinstance(value, np.ndarray) else value


def _is_default(field: str, value: Any) -> bool:
    plain = _plain(value)
    return bool(np.array_equal(plain, default(field, plain)))


def default(field: str, like: Any) -> Any:
    """Return the value of a field that is left out, of the shape of another."""
    if isinstance(like, str):
        return ""
    if not isinstance(like, list):
        return 1.0 if field == "ratio" else 0.0
    if field.startswith("rotation"):
        return [float(x) for x in np.eye(3).ravel()]
    nothing = float("-inf") if field == "lower" else float("inf") if field in _UPPER else 0.0
    return [nothing] * len(like)


def moving_mass(description: Mapping[str, Mapping[str, Part]]) -> tuple[float, Array]:
    """Return the total mass, kg, and the gravity, m/s²; zeros where energies do not tell them."""
    mass = sum(float(part["mass"]) for part in description.get("bodies", {}).values())
    gravity = description.get("system", {}).get("", {}).get("gravity", [0.0, 0.0, 0.0])
    return mass, np.array(gravity)
