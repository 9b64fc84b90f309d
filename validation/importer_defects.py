"""Smallest files that Newton's, MuJoCo Warp's and MJX's own importers read otherwise than written, by version.

``python -m validation.importer_defects [NAME==VERSION ...]`` writes ``validation/importer_defects.json`` and keeps the
columns of the others. Environments are made where they are missing, 600 MB each. Each file is small enough that what it
says is plain: its reading by mbkit is the reference, and Pinocchio's or MuJoCo's own reading agrees with it.
"""

from __future__ import annotations

import json
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

from mbkit.engines.imported import IMPORTERS
from mbkit.engines.remote import process
from mbkit.engines.remote.packages import engine
from mbkit.errors import MbkitWarning
from mbkit.studies.explain.terms import TERMS
from mbkit.studies.importers import Parsed, compare_parsers
from validation.stamp import results, stamp

VERSIONS = (
    *(f"newton=={x}" for x in ("1.8.0", "1.7.0", "1.6.1", "1.5.2")),
    *(f"mujoco-warp=={x}" for x in ("4.0.0", "3.17.0", "3.16.0", "3.15.0", "3.14.0", "3.13.0")),
    "mjx==3.17.0",
)


def urdf(*parts: str) -> str:
    return f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>'


def link(name: str, mass: float, moments: tuple[float, float, float] | None, beside: str = "") -> str:
    """Return a link whose centre of mass is 0.1 m from its origin; without moments it has no <inertial>."""
    if moments is None:
        return f'<link name="{name}">{beside}</link>'
    xx, yy, zz = moments
    inertia = f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{inertial}{beside}</link>'


def joint(name: str, kind: str, parent: str, child: str, beside: str = "") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><axis xyz="1 0 0"/>'
        f'<limit lower="-1" upper="1" effort="9" velocity="9"/>{beside}</joint>'
    )


HINGE = joint("hinge", "revolute", "base", "arm"), link("arm", 1.0, (0.02, 0.02, 0.01))
BOX = '<collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision>'
INERTIAL = '<inertial pos="0.1 0.2 0.3" mass="2" diaginertia="0.2 0.3 0.35"/>'


def mjcf(body: str, before: str = "") -> str:
    return f'<mujoco>{before}<worldbody><body name="arm">{body}</body></worldbody></mujoco>'


#: What the file has -> its text.
FILES = {
    "link_without_inertia": urdf(*HINGE, joint("weld", "fixed", "arm", "tool"), link("tool", 1e-3, (0.0,) * 3)),
    "impossible_inertia": urdf(HINGE[0], link("arm", 1.0, (0.01, 0.01, 0.03))),
    "shape_without_inertial": urdf(*HINGE, joint("weld", "fixed", "arm", "tool"), link("tool", 0.0, None, BOX)),
    "mimic_of_a_fixed_joint": urdf(
        *(*HINGE, link("tool", 1.0, (0.02, 0.02, 0.01))),
        joint("weld", "fixed", "arm", "tool", '<mimic joint="hinge" multiplier="2"/>'),
    ),
    "joints_at_two_places": mjcf(
        f'<joint name="a" axis="1 0 0"/><joint name="b" axis="0 1 0" pos="0.3 0 0"/>{INERTIAL}'
    ),
    "hinge_before_slide": mjcf(f'<joint name="a" axis="0 1 0"/><joint name="b" type="slide" axis="1 0 0"/>{INERTIAL}'),
    "oblique_axes": mjcf(f'<joint name="a" axis="1 0 0"/><joint name="b" axis="1 1 0"/>{INERTIAL}'),
    "gravity": mjcf(f'<joint name="a" axis="1 0 0"/>{INERTIAL}', '<option gravity="0 3 -5"/>'),
    "settotalmass": mjcf(f'<joint name="a" axis="1 0 0"/>{INERTIAL}', '<compiler settotalmass="10"/>'),
    "shellinertia": mjcf('<joint name="a" axis="1 0 0"/><geom type="box" size="0.1 0.2 0.3" shellinertia="true"/>'),
    "zero_of_a_joint": mjcf(f'<joint name="a" axis="1 0 0" ref="30"/>{INERTIAL}'),
    "tendon": mjcf(f'<joint name="a" axis="1 0 0"/>{INERTIAL}').replace(
        "</mujoco>", '<tendon><fixed stiffness="3"><joint joint="a" coef="1"/></fixed></tendon></mujoco>'
    ),
    "gear": mjcf(f'<joint name="a" axis="1 0 0"/>{INERTIAL}').replace(
        "</mujoco>", '<actuator><position joint="a" kp="5" gear="3"/></actuator></mujoco>'
    ),
    "gravcomp": mjcf(f'<joint name="a" axis="1 0 0"/>{INERTIAL}').replace('name="arm"', 'name="arm" gravcomp="1"'),
    "nonlinear_damper": mjcf(f'<joint name="a" axis="1 0 0" damping="1 2 3"/>{INERTIAL}'),
    "light_body": mjcf(
        f'<joint name="a" axis="1 0 0"/>{INERTIAL}<body name="tip" pos="0.3 0.1 0.2"><joint name="b" axis="0 1 0"/>'
        '<inertial pos="0 0 0" mass="1e-4" diaginertia="1e-8 1e-8 1e-8"/></body>'
    ),
}


def told(p: Parsed) -> dict[str, Any]:
    """Return one importer's reading of a file."""
    if p.refused:
        return {"status": "refuses", "why": p.refused}
    assert p.explanation is not None
    return {
        "status": "agrees" if p.agrees else "differs",
        "worst": {s.name: float(f"{s.worst:.2g}") for s in p.stages if s.name in TERMS and s.same is False},
        "causes": [c.says.split(": ", 1)[-1].replace(p.engine, "it") for c in p.explanation.acting],
        "explained": p.explanation.explained,
    }


#: See `validation.smoke`.
SMOKE = {"VERSIONS": ("mujoco",), "FILES": {k: FILES[k] for k in ("impossible_inertia", "gravity")}}


def main() -> None:
    """Measure the versions that are named, or all, and write after each."""
    warnings.simplefilter("ignore", MbkitWarning)
    out = results("importer_defects.json")
    data = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
    read: dict[str, Any] = data.get("read", {})
    with tempfile.TemporaryDirectory() as folder:
        for version in sys.argv[1:] or VERSIONS:
            for name, text in FILES.items():
                path = Path(folder) / f"{name}.{'xml' if '<mujoco' in text else 'urdf'}"
                path.write_text(text, encoding="utf-8")
                first = compare_parsers(path, [version]).importers[0]
                read.setdefault(name, {})[version] = told(first)
                print(f"{version} {name}: {read[name][version]}", flush=True)
            if version not in IMPORTERS:
                process.end(engine(version))
            out.write_text(
                json.dumps(stamp(__file__) | {"files": FILES, "read": read}, indent=1) + "\n", encoding="utf-8"
            )


if __name__ == "__main__":
    main()
