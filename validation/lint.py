"""What `mbkit lint` finds on the robots of example-robot-data, with a verdict on each finding, and on planted mistakes.

Run ``python -m validation.lint`` (about three minutes). Every finding on a robot has its verdict, true or false with a
reason, in ``lint_verdicts.toml``: a finding is true where the number in the file is not that of the robot, or where the
file leaves out what would make it right. A finding without a verdict is an error. The mistakes are written into copies
of the robots' files, one at a time; one is found where its own check names its link or joint, and did not before.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import tomllib
import warnings
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import numpy as np

import mbkit as mb
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.load.loader import find
from validation.robots import FEW, chosen
from validation.stamp import results, stamp

VERDICTS = Path(__file__).with_name("lint_verdicts.toml")

#: All of them.
ROBOTS = None
Edit = Callable[[ET.Element, str], None]


# Mistakes, as edits of a URDF at one link or joint.


def _part(robot: ET.Element, tag: str, name: str) -> ET.Element:
    return next(e for e in robot.findall(tag) if e.get("name") == name)


def _numbers(element: ET.Element, name: str) -> list[float]:
    return [float(x) for x in element.get(name, "0 0 0").split()]


def mass(factor: float) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        element = _part(robot, "link", link).find("inertial/mass")
        element.set("value", repr(factor * float(element.get("value"))))

    return edit


def com(factor: float) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        origin = _part(robot, "link", link).find("inertial/origin")
        origin.set("xyz", " ".join(repr(factor * x) for x in _numbers(origin, "xyz")))

    return edit


def moments(change: Callable[[dict[str, float]], dict[str, float]]) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        element = _part(robot, "link", link).find("inertial/inertia")
        values = {name: float(x) for name, x in element.attrib.items()}
        element.attrib.update({name: repr(float(x)) for name, x in change(values).items()})

    return edit


def inertia(factor: float) -> Edit:
    return moments(lambda old: {name: factor * x for name, x in old.items()})


#: The products with the sign of the other convention, and axes exchanged.
PRODUCTS = moments(lambda old: {name: -old[name] for name in ("ixy", "ixz", "iyz")})
XZ = moments(lambda o: {"ixx": o["izz"], "izz": o["ixx"], "ixy": o["iyz"], "iyz": o["ixy"]})


def turned(rpy: str) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        _part(robot, "link", link).find("inertial/origin").set("rpy", rpy)

    return edit


def about_origin(robot: ET.Element, link: str) -> None:
    """Write the inertia about the link's origin; the frame of the inertia keeps its axes."""
    inertial = _part(robot, "link", link).find("inertial")
    origin, m = inertial.find("origin"), float(inertial.find("mass").get("value"))
    R = mb.spatial.matrix_from_rpy(*_numbers(origin, "rpy"))
    p = R.T @ np.array(_numbers(origin, "xyz"))
    more = m * (p @ p * np.eye(3) - np.outer(p, p))
    moments(lambda old: {n: x + more["xyz".index(n[1]), "xyz".index(n[2])] for n, x in old.items()})(robot, link)


def copied(*others: str) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        source = _part(robot, "link", link).find("inertial/inertia").attrib
        for other in others:
            _part(robot, "link", other).find("inertial/inertia").attrib.update(source)

    return edit


def placeholder(kg: float, moment: float) -> Edit:
    def edit(robot: ET.Element, link: str) -> None:
        _part(robot, "link", link).find("inertial/mass").set("value", repr(kg))
        moments(lambda old: {name: moment * (name[1] == name[2]) for name in old})(robot, link)

    return edit


def joint(tag: str, **numbers: float) -> Edit:
    """Multiply numbers of a joint; a number that is a text replaces it."""

    def edit(robot: ET.Element, name: str) -> None:
        owner = _part(robot, "joint", name)
        element = owner.find(tag)
        if element is None:
            element = ET.SubElement(owner, tag)
        for key, factor in numbers.items():
            new = factor if isinstance(factor, str) else " ".join(repr(factor * x) for x in _numbers(element, key))
            element.set(key, new)

    return edit


DEGREES = joint("limit", lower=57.29577951308232, upper=57.29577951308232)


class Planted(NamedTuple):
    """A mistake: where it is made, what it is, and the check that should find it."""

    robot: str
    part: str
    mistake: str
    check: str
    edit: Edit


PLANTED = (
    Planted("z1", "link03", "mass in grams", "density", mass(1e3)),
    Planted("go2", "FL_thigh", "mass in grams", "density", mass(1e3)),
    Planted("xarm7", "link4", "mass in grams", "density", mass(1e3)),
    Planted("solo12", "HR_SHOULDER", "mass in tonnes", "density", mass(1e-3)),
    Planted("talos_full_v2", "arm_left_3_link", "mass in tonnes", "density", mass(1e-3)),
    Planted("romeo_laas_small", "LShoulderYaw_link", "mass in grams, without shapes", "neighbours", mass(1e3)),
    Planted("simple_humanoid", "LARM_LINK3", "mass in tonnes, without shapes", "neighbours", mass(1e-3)),
    Planted("panda", "panda_link4", "centre of mass in millimetres", "centre of mass", com(1e3)),
    Planted("kinova", "j2s6s200_link_2", "centre of mass in millimetres", "centre of mass", com(1e3)),
    Planted("laikago", "FR_thigh", "centre of mass in centimetres", "centre of mass", com(1e2)),
    Planted("simple_humanoid", "LARM_LINK2", "com in millimetres, without shapes", "centre of mass", com(1e3)),
    Planted("hyq", "lf_upperleg", "centre of mass on the other side of the joint", "centre of mass", com(-1)),
    Planted("b1", "FL_calf", "centre of mass on the other side of the joint", "centre of mass", com(-1)),
    Planted("z1", "link02", "inertia in g mm²", "radius of gyration", inertia(1e9)),
    Planted("xarm7", "link5", "inertia in kg mm²", "radius of gyration", inertia(1e6)),
    Planted("go2", "RR_calf", "inertia in g cm²", "radius of gyration", inertia(1e7)),
    Planted("tiago_pro", "arm_left_3_link", "inertia in kg cm²", "radius of gyration", inertia(1e4)),
    Planted("romeo_laas_small", "LHipYaw_link", "in kg mm², without shapes", "radius of gyration", inertia(1e6)),
    Planted("solo12", "HL_LOWER_LEG", "inertia for a thousandth of the mass", "radius of gyration", inertia(1e-3)),
    Planted("go2", "RL_calf", "inertia about the link's origin", "inertia about origin", about_origin),
    Planted("z1", "link02", "inertia about the link's origin", "inertia about origin", about_origin),
    Planted("solo12", "HR_UPPER_LEG", "inertia about the link's origin", "inertia about origin", about_origin),
    Planted("xarm7", "link4", "inertia three times too large", "solid body", inertia(3.0)),
    Planted("ur5_robot", "elbow_joint", "axis of length 2", "unit axes", joint("axis", xyz=2.0)),
    Planted("talos_full_v2", "arm_left_2_link", "products of the other sign", "sign of products", PRODUCTS),
    Planted("solo12", "FL_UPPER_LEG", "products of the other sign", "sign of products", PRODUCTS),
    Planted("b1", "trunk", "products of the other sign", "sign of products", PRODUCTS),
    Planted("go2", "FL_calf", "ixx and izz exchanged", "axes", XZ),
    Planted("z1", "link02", "ixx and izz exchanged", "axes", XZ),
    Planted("hyq", "lf_lowerleg", "ixx and izz exchanged", "axes", XZ),
    Planted("kinova", "j2s6s200_link_2", "inertia in a frame turned by 90°", "axes", turned("1.5708 0 0")),
    Planted("laikago", "FL_calf", "inertia in a frame turned by 90°", "axes", turned("0 1.5708 0")),
    Planted("xarm7", "joint2", "limits in degrees", "limits in degrees", DEGREES),
    Planted("panda", "panda_joint4", "limits in degrees", "limits in degrees", DEGREES),
    Planted("ur3_robot", "elbow_joint", "limits in degrees", "limits in degrees", DEGREES),
    Planted("go2", "FL_calf_joint", "limits of no width", "empty limits", joint("limit", lower="0", upper="0")),
    Planted("z1", "joint3", "effort in kN m", "effort", joint("limit", effort=1e-3)),
    Planted("panda", "panda_joint2", "effort of a wrist", "effort", joint("limit", effort="12")),
    Planted("kinova", "j2s6s200_link_2", "one inertia on four links", "copied inertia",
            copied("j2s6s200_link_3", "j2s6s200_link_4", "j2s6s200_link_5")),
    Planted("b1", "FR_thigh", "one inertia on three links", "copied inertia", copied("FR_hip", "FR_calf")),
    Planted("xarm7", "link6", "mass 1 and the identity", "placeholder", placeholder(1.0, 1.0)),
    Planted("g1", "left_rubber_hand", "inertia 0.001 about all axes", "placeholder", placeholder(0.17, 1e-3)),
    Planted("solo12", "HR_UPPER_LEG", "one leg with an old mass", "mirror", mass(1.2)),
    Planted("z1", "joint1", "damping in N m s/° of a large motor", "damping", joint("dynamics", damping="300")),
    Planted("go2", "FL_thigh_joint", "origin in millimetres", "neighbours", joint("origin", xyz=1e3)),
)  # fmt: skip


def planted(row: Planted, folder: Path, known: dict[str, mb.studies.lint.LintResult]) -> dict[str, object]:
    """Make a mistake, and return whether its check names its part and did not before."""
    robot = find(row.robot)
    tree = ET.parse(robot.path)
    row.edit(tree.getroot(), row.part)
    copy = folder / f"{robot.path.stem}.urdf"
    tree.write(copy)
    if robot.name not in known:
        known[robot.name] = mb.lint(row.robot)
    before = {(r.check, name) for r in known[robot.name].rows for name in (r.part, *r.others)}
    now = [r for r in mb.lint(copy).rows if row.part in (r.part, *r.others) and (r.check, row.part) not in before]
    own = next((r for r in now if r.check == row.check), None)
    return {
        **{name: getattr(row, name) for name in ("robot", "part", "mistake", "check")},
        "found": own is not None,
        "confidence": own.confidence if own else "",
        "message": own.message if own else "",
        "also": sorted({r.check for r in now} - {row.check}),
    }


# The robots.


def verdict_of(robot: str, row: mb.studies.lint.LintFinding, verdicts: list[dict]) -> dict | None:
    """Return the first verdict whose patterns the finding fits."""

    def fits(verdict: dict, key: str, text: str) -> bool:
        return any(fnmatchcase(text, pattern) for pattern in verdict.get(key, ["*"]))

    place = {"robots": robot, "parts": row.part, "checks": row.check, "sure": row.confidence}
    return next((v for v in verdicts if all(fits(v, key, text) for key, text in place.items())), None)


#: See `validation.smoke`.
SMOKE = {"ROBOTS": FEW, "PLANTED": PLANTED[:1]}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m validation.lint", description=__doc__.splitlines()[0])
    parser.add_argument("--planted", action="store_true", help="the planted mistakes alone; nothing is written")
    asked = parser.parse_args()
    warnings.simplefilter("ignore", MbkitWarning)
    known: dict[str, mb.studies.lint.LintResult] = {}
    out, missing = dict(stamp(__file__)), 0
    if not asked.planted:
        verdicts = tomllib.loads(VERDICTS.read_text(encoding="utf-8"))["verdict"]
        findings, refused = [], {}
        for robot in chosen(ROBOTS):
            try:
                known[robot.name] = mb.lint(robot.name)
            except MbkitError as error:
                refused[robot.name] = str(error).partition(": ")[2].splitlines()[0]
                continue
            for row in known[robot.name].rows:
                verdict = verdict_of(robot.name, row, verdicts)
                if verdict is None:
                    missing += 1
                    print(f"no verdict: {robot.name} | {row.check} | {row.confidence} | {row}")
                    continue
                one = {name: getattr(row, name) for name in ("part", "check", "confidence", "message", "expected")}
                findings.append({"robot": robot.name, **one, "true": verdict["true"], "reason": verdict["reason"]})
        counts = Counter((f["check"], f["true"]) for f in findings)
        for check in mb.studies.lint.CHECKS:
            print(f"{check:20} {counts[check, True]:5} true {counts[check, False]:5} false")
        out |= {"robots": len(known), "refused": refused, "findings": findings}
        out["clean"] = sorted(name for name, result in known.items() if not result.rows)
    share = next(p for p in find("panda").path.parents if p.name == "example-robot-data").parent
    os.environ["ROS_PACKAGE_PATH"] = str(share)
    with tempfile.TemporaryDirectory() as folder:
        out["planted"] = [planted(row, Path(folder), known) for row in PLANTED]
    for row in out["planted"]:
        print(("found " if row["found"] else "MISSED"), *list(row.values())[:4], row["message"], row["also"], sep=" | ")
    print(f"{sum(r['found'] for r in out['planted'])} of {len(PLANTED)} planted mistakes found")
    if not asked.planted and not missing:
        results("lint.json").write_text(json.dumps(out, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
