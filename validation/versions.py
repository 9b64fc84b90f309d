"""Versions of engines against the oracle: which changed which number, and when.

Run ``python -m validation.versions``; it writes ``validation/versions.json``. Environments are made below the user's
cache folder, or below ``MBKIT_ENVIRONMENTS``: 18 GB, and twenty minutes where none is there yet. Those of Newton and
MuJoCo Warp take 7 GB more, and are measured on a few robots: each version compiles its own kernels.

All robots of example-robot-data are measured, random trees, and one arm that is written in eight ways. Seven say the
same, the eighth in other units; a parser that reads one of them otherwise is wrong. That they do is checked with
mbkit's own reader and the oracle before anything is measured.
"""

from __future__ import annotations

import json
import math
import re
import sys
import tempfile
import warnings
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import mbkit as mb
from mbkit.engines.versions import process
from mbkit.engines.versions.engine_version import versions_of
from mbkit.engines.versions.importer import VersionImport
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.studies.results import to_plain
from mbkit.studies.versions.measure import FILE, RUN
from mbkit.studies.versions.result import Change, VersionRow
from tests.random_trees import random_tree
from validation.arms import joint, link, urdf, written
from validation.robots import FEW as TWO
from validation.robots import chosen
from validation.stamp import results, stamp

#: Engine -> its versions.
VERSIONS: dict[str, tuple[str, ...]] = {
    "mujoco": (
        *(f"3.1.{k}" for k in range(7)),
        *(f"3.2.{k}" for k in range(8)),
        *(f"3.3.{k}" for k in range(8)),
        *("3.4.0", "3.5.0", "3.6.0", "3.7.0", "3.8.0", "3.8.1"),
        *(f"3.{k}.0" for k in range(9, 18)),
        "4.0.0",
    ),
    "pinocchio": (
        *("2.6.18", "2.6.19", "2.6.20", "2.6.21", "2.7.0"),
        *("3.3.1", "3.4.0", "3.7.0", "3.8.0", "3.9.0", "4.0.0", "4.1.0"),
    ),
    "drake": (*(f"1.{k}.0" for k in range(35, 52)), "1.51.1"),
    "newton": ("1.5.1", "1.5.2", "1.6.0", "1.6.1", "1.7.0", "1.8.0"),
    "mujoco-warp": (*(f"3.{k}.0" for k in range(13, 18)), "4.0.0"),
}
#: Of engines in which robots are trained, the last six versions, on these.
TRAINED = {"newton", "mujoco-warp"}
FEW = ("ur5", "panda", "hyq", "anymal")
#: All of them.
ROBOTS = None
BARE = {"springs": False, "damping": False}
TREES = {
    "turning": lambda: random_tree(5, 6, ("revolute", "free", "ball", "planar"), armature=False, **BARE),
    "universal": lambda: random_tree(2, 5, ("revolute", "universal"), armature=False, **BARE),
    "spherical_zyx": lambda: random_tree(3, 5, ("revolute", "spherical_zyx"), armature=False, **BARE),
    "rotors": lambda: random_tree(6, 5, ("revolute", "prismatic"), armature=True, **BARE),
}

#: Fewer digits are wrong, of engines in double precision and in single.
RIGHT = {False: 8.0, True: 4.0}
#: What a reason says of one robot alone: its name, its parts.
OF_ONE = re.compile(
    r"^\S+:\d+: | of \S+(?= is not finite)| at index .*| (?:Object|Element) name.*|: (?:body|joint) .*|; suspect: .*|"
    r"\. mass = .*"
)


def robots() -> list[str]:
    """Return the robots of example-robot-data that mbkit reads."""
    out = []
    for robot in chosen(ROBOTS):
        try:
            mb.load(robot.name)
        except MbkitError:
            continue
        out.append(robot.name)
    return out


def study(engine: str, targets: list[Any]) -> dict[str, Any]:
    """Return what moved, one row a robot, what is wrong in the last version, and what has no number."""
    result = mb.versions(targets, engine, VERSIONS[engine], most=100, samples=2)
    data, last = result.to_dict(), result.measured[-1]
    by_robot: dict[str, list[VersionRow]] = {}
    for r in result.rows:
        by_robot.setdefault(r.robot, []).append(r)
    kept = {k: data[k] for k in ("engine", "measured", "missing", "settings", "seconds", "verdict")}
    return kept | {
        "changes": together(result.changes, versions_of(engine)),
        "robots": {name: summary(rows, last) for name, rows in by_robot.items()},
        "wrong": wrong(result.rows, last, RIGHT[engine in TRAINED]),
        "times": times_of(result.rows),
        "reasons": reasons(result.rows),
    }


def together(changes: Iterable[Change], known: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return changes of the same terms of the same robots between two versions as one."""
    groups: dict[tuple[str, str, str, str], list[Change]] = {}
    for c in changes:
        groups.setdefault((c.before, c.version, c.direction, c.term), []).append(c)
    out: dict[tuple[Any, ...], dict[str, Any]] = {}
    for (before, version, direction, term), some in groups.items():
        robots = tuple(c.robot for c in some)
        new = {
            "before": before,
            "version": version,
            # Whether none of those that pip has lies between.
            "next_to_it": known.index(version) == known.index(before) + 1,
            "direction": direction,
            "robots": robots,
            "terms": [],
            "digits_before": [],
            "digits": [],
        }
        one = out.setdefault((before, version, direction, robots), new)
        one["terms"].append(term)
        for c in some:
            one["digits_before"].append(c.digits_before)
            one["digits"].append(c.digits)
    order = list(known).index
    for one in out.values():
        for name in ("digits_before", "digits"):
            one[name] = ends(one[name])
    return sorted(out.values(), key=lambda x: (order(x["version"]), x["direction"], x["terms"]))


def ends(values: Iterable[float]) -> list[float] | None:
    """Return the least and the largest, None without a number."""
    some = [round(x, 1) for x in values if not math.isnan(x)]
    return [min(some), max(some)] if some else None


def summary(rows: list[VersionRow], last: str) -> dict[str, Any]:
    """Return a robot's row: its fewest digits in the last version, and the largest move of a number."""
    now = [r for r in rows if r.version == last and r.term != RUN]
    lists = ([r.digits for r in now if r.term.startswith(FILE) is of_file] for of_file in (False, True))
    own, file = (ends(x) for x in lists)
    moves = [r.moved for r in rows if not math.isnan(r.moved)]
    return {
        "digits": own and own[0],
        "file_digits": file and file[0],
        "moved": float(f"{max(moves, default=0.0):.1e}"),
        "changes": sum(r.changed for r in rows),
    }


def wrong(rows: Iterable[VersionRow], last: str, least: float) -> list[dict[str, Any]]:
    """Return terms that are wrong in the last version, and since which measured one they are."""
    of: dict[tuple[str, str], list[VersionRow]] = {}
    for r in rows:
        of.setdefault((r.robot, r.term), []).append(r)
    out = []
    for (robot, term), some in of.items():
        if term == RUN or some[-1].version != last or not some[-1].digits < least:
            continue
        since = last
        for r in reversed(some):
            if not r.digits < least:
                break
            since = r.version
        out.append({"robot": robot, "term": term, "digits": round(some[-1].digits, 1), "since": since})
    return out


def times_of(rows: Iterable[VersionRow]) -> dict[str, list[float]]:
    """Return each version's time over the last one's, the median of robots, and of how many."""
    of: dict[str, dict[str, float]] = {}
    for r in rows:
        if not math.isnan(r.time_ratio):
            of.setdefault(r.version, {})[r.robot] = r.time_ratio
    return {version: [round(median(x.values()), 2), len(x)] for version, x in of.items()}


def reasons(rows: Iterable[VersionRow]) -> list[dict[str, Any]]:
    """Return why terms have no number: each reason once, with its robots, terms and versions."""
    of: dict[str, dict[str, list[str]]] = {}
    for r in rows:
        if r.reason:
            one = of.setdefault(OF_ONE.sub("", r.reason), {"robots": [], "terms": [], "versions": []})
            for name, value in zip(one, (r.robot, r.term, r.version), strict=True):
                if value not in one[name]:
                    one[name].append(value)
    return [{"reason": text, **one} for text, one in of.items()]


#: The smallest files that a version reads wrongly: one hinge about x, whose M is a number.
SMALLEST = {
    "inertial_turned": (
        link("arm", 1.0, (0, 0, 0), np.diag([1.0, 1.5, 2.0]), (0.0, np.pi / 2, 0.0)),
        joint("hinge", "continuous", "base", "arm", (0, 0, 0), (0, 0, 0), (1, 0, 0)),
    ),
    "weld_turned": (
        link("arm", 1.0, (0, 0, 0), np.eye(3)),
        link("weight", 1.0, (0, 1, 0), np.eye(3)),
        joint("hinge", "continuous", "base", "arm", (0, 0, 0), (0, 0, 0), (1, 0, 0)),
        joint("weld", "fixed", "arm", "weight", (0, 0, 0), (0.0, 0.0, np.pi / 2)),
    ),
    "weld_without_mass": (
        link("arm", 1.0, (0, 0, 0), np.eye(3)),
        link("flywheel", 0.0, (0, 0, 0), np.eye(3)),
        joint("hinge", "continuous", "base", "arm", (0, 0, 0), (0, 0, 0), (1, 0, 0)),
        joint("weld", "fixed", "arm", "flywheel", (0, 0, 0), (0, 0, 0)),
    ),
}


def smallest(engine: str) -> dict[str, Any]:
    """Return M of each smallest file as each version reads it, and as the oracle says."""
    out: dict[str, Any] = {}
    for name, elements in SMALLEST.items():
        text = urdf(name, ['<link name="base"/>', *elements])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "robot.urdf"
            path.write_text(text, encoding="utf-8")
            model = mb.load(path)
        right = float(mb.dynamics(model, "oracle").mass_matrix([0.0])[0, 0])
        values = {}
        for version in VERSIONS[engine]:
            read = VersionImport(mb.engine(f"{engine}=={version}"), text, "urdf", model)
            values[version] = float(read.term("mass_matrix", np.zeros((1, 1)), np.zeros((1, 1)))[0, 0, 0])
        out[name] = {"urdf": text, "right": right, "M": values}
    for version in VERSIONS[engine]:
        process.end(mb.engine(f"{engine}=={version}"))
    return out


#: See `validation.smoke`.
SMOKE = {
    "VERSIONS": {"mujoco": ("4.0.0",)},
    "ROBOTS": TWO[:1],
    "TREES": {"rotors": TREES["rotors"]},
    "SMALLEST": {"weld_turned": SMALLEST["weld_turned"]},
}


def main() -> None:
    path = results("versions.json")
    names = sys.argv[1:] or list(VERSIONS)
    out: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if sys.argv[1:] and path.exists() else {}
    out |= stamp(__file__)
    warnings.simplefilter("ignore", MbkitWarning)
    with tempfile.TemporaryDirectory() as folder:
        trees = [replace(make(), name=name) for name, make in TREES.items()]
        models = [*written(Path(folder)), *trees]
        for engine in names:
            trained = engine in TRAINED
            few = [*FEW, *trees] if trained else [*robots(), *models]
            out.setdefault("engines", {})[engine] = study(engine, few)
            if not trained:
                out.setdefault("smallest", {})[engine] = smallest(engine)
            print(out["engines"][engine]["verdict"])
    path.write_text(json.dumps(to_plain(out), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
