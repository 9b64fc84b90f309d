"""What MuJoCo holds of an MJCF beside the terms: options of simulation, servos, force ranges, contacts, limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import mujoco
import numpy as np

#: Options that are numbers of a list.
_NAMED: Final = {
    "integrator": mujoco.mjtIntegrator,
    "cone": mujoco.mjtCone,
    "jacobian": mujoco.mjtJacobian,
    "solver": mujoco.mjtSolver,
}
#: Kind of object: prefix of its arrays, how many there are, and what acts in runs alone.
_ARRAYS: Final[tuple[tuple[str, str, str, str], ...]] = (
    (
        *("actuator", "actuator", "nu"),
        "trntype dyntype gaintype biastype dynprm gainprm biasprm gear ctrllimited ctrlrange forcelimited forcerange "
        "actlimited actrange actearly delay cranklength armature damping",
    ),
    ("joint", "jnt", "njnt", "limited range margin solref solimp actfrclimited actfrcrange"),
    ("velocity", "dof", "nv", "solref solimp"),
    (
        *("tendon", "tendon", "ntendon"),
        "limited range margin solref_lim solimp_lim frictionloss solref_fri solimp_fri actfrclimited actfrcrange",
    ),
    (
        *("geom", "geom", "ngeom"),
        "type size pos quat contype conaffinity condim priority friction solmix solref solimp margin gap",
    ),
    ("equality", "eq", "neq", "active0 solref solimp"),
)
_DIGITS: Final = 6

Settings = dict[tuple[str, str], Any]


def settings_of(text: str, files: dict[str, bytes]) -> Settings:
    """Return (option or object, what) -> its numbers; raises whatever MuJoCo does over a text that it cannot read."""
    m = mujoco.MjModel.from_xml_string(text, files)
    names = (x for x in dir(m.opt) if not x.startswith("_") and x != "gravity")
    out: Settings = {("", name): _value(getattr(m.opt, name), name) for name in names}
    for kind, prefix, count, fields in _ARRAYS:
        for k in range(getattr(m, count)):
            if kind == "geom" and not (m.geom_contype[k] or m.geom_conaffinity[k]):
                continue
            name = "" if kind == "velocity" else getattr(m, prefix)(k).name
            label = f"{kind} {name!r}" if name else f"{kind} {k}"
            out |= {(label, field): _value(getattr(m, f"{prefix}_{field}")[k]) for field in fields.split()}
    return out


def _value(x: Any, name: str = "") -> Any:
    if name in _NAMED:
        return _NAMED[name](x).name.rpartition("_")[2].lower()
    return tuple(float(y) for y in np.atleast_1d(x))


def differences(a: Settings, b: Settings) -> Iterator[str]:
    """Yield what differs, in words."""
    owners = {side: {label for label, _ in some} for side, some in (("a", a), ("b", b))}
    for key, old in a.items():
        if (new := b.get(key, old)) != old:
            yield f"{key[1]}{f' of {key[0]}' if key[0] else ''} {_pair(old, new)}"
    for label in sorted(owners["a"] ^ owners["b"]):
        yield f"{label} {'lost' if label in owners['a'] else 'new'}"


def _pair(old: Any, new: Any) -> str:
    if isinstance(old, str):
        return f"{old} → {new}"
    moved = [(x, y) for x, y in zip(old, new, strict=True) if x != y]
    return ", ".join(f"{x:.{_DIGITS}g} → {y:.{_DIGITS}g}" for x, y in moved[:2]) + (", ..." if len(moved) > 2 else "")
