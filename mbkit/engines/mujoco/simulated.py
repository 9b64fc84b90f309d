"""What MuJoCo simulates of an MJCF beside the terms: options, servos, force ranges, contacts, limits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, Final

import mujoco
import numpy as np

#: Options that are numbers of a list.
_NAMED: Final = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver}
#: Kind of object -> how many there are, and what of it acts in runs alone.
_FIELDS: Final = {
    "actuator": (
        "nu",
        "trntype dyntype gaintype biastype dynprm gainprm biasprm gear ctrllimited ctrlrange forcelimited forcerange "
        "actlimited actrange delay",
    ),
    "jnt": ("njnt", "limited range margin solref solimp actfrclimited actfrcrange"),
    "tendon": ("ntendon", "limited range margin solref_lim solimp_lim frictionloss actfrclimited actfrcrange"),
    "geom": ("ngeom", "type size pos quat contype conaffinity condim priority friction solref solimp margin gap"),
    "eq": ("neq", "active0 solref solimp"),
}


def _settings(text: str, files: dict[str, bytes]) -> dict[str, Any]:
    """Return the numbers by what they are of."""
    m = mujoco.MjModel.from_xml_string(text, files)
    names = {x: getattr(m.opt, x) for x in dir(m.opt) if not x.startswith("_") and x != "gravity"}
    out = {x: _NAMED[x](y).name.split("_")[1].lower() if x in _NAMED else _numbers(y) for x, y in names.items()}
    for kind, (count, fields) in _FIELDS.items():
        for k in range(getattr(m, count)):
            if kind != "geom" or m.geom_contype[k] or m.geom_conaffinity[k]:
                label = f"{kind} {getattr(m, kind)(k).name or k}"
                out |= {f"{x} of {label}": _numbers(getattr(m, f"{kind}_{x}")[k]) for x in fields.split()}
    return out


def _numbers(x: Any) -> str:
    return " ".join(f"{y:.6g}" for y in np.trim_zeros(np.atleast_1d(x).astype(float), "b")) or "0"


def differences(files: Iterable[tuple[str, dict[str, bytes]]]) -> Iterator[str]:
    """Yield what differs between two texts with their files; raises what MuJoCo does over one that it cannot read."""
    a, b = (_settings(*file) for file in files)
    for what in dict.fromkeys([*a, *b]):
        if a.get(what) != b.get(what):
            yield f"{what} {a.get(what, 'none')} → {b.get(what, 'none')}"
