"""Versions of engines against the oracle: which changed which number, and when.

Run ``python -m validation.versions``; it writes ``validation/versions.json``. Environments are made below the user's
cache folder, or below ``MBKIT_ENVIRONMENTS``: 18 GB, and twenty minutes where none is there yet. Those of Newton and
MuJoCo Warp take 7 GB more, and are measured on a few robots: each version compiles its own kernels.

It is a loop over `mb.compare`: each robot in all versions of an engine at once, terms alone. Beside these terms stand
those of the version's own parser (rows ``file M``, ``file g`` and ``file nle``) and 0.1 s of MuJoCo's own Runge-Kutta
method. A number has changed where its error moved by more than the tolerance between two versions that follow each
other.

All robots of example-robot-data are measured, random trees, and one arm that is written in eight ways. Seven say the
same, the eighth in other units; a parser that reads one of them otherwise is wrong. That they do is checked with
mbkit's own reader and the oracle before anything is measured.
"""

from __future__ import annotations

import json
import math
import os
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import mbkit as mb
from mbkit._check import by_key
from mbkit.engines.remote import process
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.load.sanitized_text import strip
from mbkit.studies.compare.terms import states
from mbkit.studies.results import to_plain
from mbkit.studies.study_runs import free_of_mimic, start_state
from tests.random_trees import random_tree
from validation.arms import joint, link, urdf, written
from validation.own_parser import OwnParser
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
#: All of them, and ways of the arm.
ROBOTS = None
WAYS = None
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


class Row(NamedTuple):
    """One term of one robot in one version: its error by the oracle, NaN without a value, and why there is none."""

    robot: str
    version: str
    term: str
    error: float
    reason: str = ""


class Change(NamedTuple):
    """A number whose error moved between two measured versions."""

    before: Row
    after: Row
    direction: str


#: Random states of each robot, beside neutral, at-limit and near-singular ones.
SAMPLES = 2
#: An error moved where it did by more: of engines in double precision and in single.
TOLERANCE = {False: 1e-9, True: 1e-4}
#: The state after a short run by the engine's own Runge-Kutta method; that run's step, s, and steps.
RUN, DT, STEPS = "own RK4", 2e-2, 5
#: Before the name of a term of the version's own parser; such terms and their quantities.
FILE, OF_FILE = "file ", {"M": "mass_matrix", "g": "gravity", "nle": "nle"}


def study(engine: str, targets: list[Any]) -> dict[str, Any]:
    """Return what moved, one row a robot, what is wrong in the last version, and what has no number."""
    begun, measured, missing = time.perf_counter(), [], []
    for version in VERSIONS[engine]:
        try:
            mb.engine(f"{engine}=={version}").interpreter()
        except MbkitError as error:
            missing.append((version, str(error)))
        else:
            measured.append(version)
    found = [row for target in targets for row in rows_of(target, engine, measured)]
    rows = sorted(found, key=lambda row: measured.index(row.version))
    for version in measured:
        process.end(mb.engine(f"{engine}=={version}"))
    tolerance, last = TOLERANCE[engine in TRAINED], measured[-1]
    changes = list(changes_of(rows, tolerance))
    by_robot = by_key((row.robot, row) for row in rows)
    counts = {name: sum(c.after.robot == name for c in changes) for name in by_robot}
    return {
        "engine": engine,
        "measured": measured,
        "missing": missing,
        "settings": {"samples": SAMPLES, "tolerance": tolerance},
        "seconds": time.perf_counter() - begun,
        "verdict": f"{engine} {measured[0]} to {last}: {len(changes)} changes, {len(missing)} versions not measured",
        "changes": together(changes, VERSIONS[engine]),
        "robots": {name: summary(some, last) | {"changes": counts[name]} for name, some in by_robot.items()},
        "wrong": wrong(rows, last, RIGHT[engine in TRAINED]),
        "reasons": reasons(rows),
    }


def rows_of(target: Any, engine: str, versions: list[str]) -> Iterator[Row]:
    """Yield the rows of one robot."""
    model = mb.load(target) if isinstance(target, str) else target
    name = target if isinstance(target, str) else model.name
    engines = {f"{engine}=={version}": version for version in versions}
    # A comparison takes two engines at least, also where one version alone holds the robot.
    found = mb.compare(model, [*engines, "lagrangian"], SAMPLES, terms_only=True)
    for r in found.rows:
        if r.engine in engines:
            lost = not math.isfinite(r.relative)
            yield Row(name, engines[r.engine], r.term, math.nan if lost else r.relative, r.reason if lost else "")
    terms = tuple(dict.fromkeys(r.term for r in found.rows))
    for refusal in found.refusals:
        if refusal.engine in engines:
            for term in (refusal.term,) if refusal.term else terms:
                yield Row(name, engines[refusal.engine], term, math.nan, refusal.reason)
    for full, version in engines.items():
        yield from run_rows(name, model, full, version)
    if os.path.isfile(model.source or "") and all(j.type.nv <= 1 for j in model.joints):
        stripped = strip(Path(model.source))
        if not stripped.meshes:
            yield from file_rows(name, free_of_mimic(model), stripped, engines)


def run_rows(name: str, model: mb.Model, engine: str, version: str) -> Iterator[Row]:
    """Yield the error of a short run by the engine's own method, where it has one."""
    try:
        dyn: Any = mb.dynamics(model, engine)
        if not dyn.runs:
            return
        q0, v0 = start_state(model, 0)
        q, v = dyn.rollout(q0, v0, DT, STEPS)
    except MbkitError as error:
        yield Row(name, version, RUN, math.nan, str(error))
        return
    exact = mb.simulate(mb.dynamics(model, "lagrangian"), q0, v0, DT * STEPS, method="rk853", rtol=1e-13)
    apart = np.concatenate([model.difference(exact.q[-1], q[-1]), v[-1] - exact.v[-1]])
    size = max(1.0, float(np.linalg.norm(np.concatenate([exact.q[-1], exact.v[-1]]))))
    yield Row(name, version, RUN, float(np.linalg.norm(apart)) / size)


def file_rows(name: str, model: mb.Model, file: Any, engines: dict[str, str]) -> Iterator[Row]:
    """Yield the errors of terms of what each version's own parser reads, relative to the largest entry."""
    at, oracle = states(model, SAMPLES, 0), mb.dynamics(model, "oracle")
    exact = {x: getattr(oracle, of)(at.q, *([at.v] if of == "nle" else [])) for x, of in OF_FILE.items()}
    for engine, version in engines.items():
        try:
            read = OwnParser(mb.engine(engine), file.text, file.format, model)
            for term, quantity in OF_FILE.items():
                off = np.abs(read.term(quantity, at.q, at.v) - exact[term]).max()
                yield Row(name, version, FILE + term, float(off / np.abs(exact[term]).max()))
        except MbkitError as error:
            yield from (Row(name, version, FILE + term, math.nan, str(error)) for term in OF_FILE)


def digits_of(error: float) -> float:
    """Return the digits that a relative error leaves right, NaN for NaN."""
    return math.nan if math.isnan(error) else min(15.65, max(0.0, -math.log10(max(error, 1e-300))))


def changes_of(rows: Iterable[Row], tolerance: float) -> Iterator[Change]:
    """Yield where a number's error moved, or where it began or ceased to be there."""
    for some in by_key(((row.robot, row.term), row) for row in rows).values():
        for one, other in pairwise(some):
            old, new = one.error, other.error
            if math.isnan(old) != math.isnan(new):
                yield Change(one, other, "refused since" if math.isnan(new) else "given since")
            elif abs(new - old) > tolerance:
                # From one build to the next a worst error changes by less than a factor of two.
                towards, away = 2 * new < old, 2 * old < new
                where = "towards the truth" if towards else "away from the truth" if away else ""
                yield Change(one, other, where or "as far from the truth as before")


def together(changes: Iterable[Change], known: tuple[str, ...]) -> list[dict[str, Any]]:
    """Return changes of the same terms of the same robots between two versions as one."""
    groups = by_key(((c.before.version, c.after.version, c.direction, c.after.term), c) for c in changes)
    out: dict[tuple[Any, ...], dict[str, Any]] = {}
    for (before, version, direction, term), some in groups.items():
        robots = tuple(c.after.robot for c in some)
        new = {
            "before": before,
            "version": version,
            # Whether every version between them could be measured: there is none.
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
            one["digits_before"].append(digits_of(c.before.error))
            one["digits"].append(digits_of(c.after.error))
    order = list(known).index
    for one in out.values():
        for name in ("digits_before", "digits"):
            one[name] = ends(one[name])
    return sorted(out.values(), key=lambda x: (order(x["version"]), x["direction"], x["terms"]))


def ends(values: Iterable[float]) -> list[float] | None:
    """Return the least and the largest, None without a number."""
    some = [round(x, 1) for x in values if not math.isnan(x)]
    return [min(some), max(some)] if some else None


def summary(rows: list[Row], last: str) -> dict[str, Any]:
    """Return a robot's row: its fewest digits in the last version, and the largest move of an error."""
    now = [r for r in rows if r.version == last and r.term != RUN]
    lists = ([digits_of(r.error) for r in now if r.term.startswith(FILE) is of_file] for of_file in (False, True))
    own, file = (ends(x) for x in lists)
    by_term = by_key((r.term, r.error) for r in rows if not math.isnan(r.error))
    moves = [abs(x - y) for errors in by_term.values() for x, y in pairwise(errors)] or [0.0]
    return {"digits": own and own[0], "file_digits": file and file[0], "moved": float(f"{max(moves):.1e}")}


def wrong(rows: Iterable[Row], last: str, least: float) -> list[dict[str, Any]]:
    """Return terms that are wrong in the last version, and since which measured one they are."""
    out = []
    for (robot, term), some in by_key(((row.robot, row.term), row) for row in rows).items():
        if term == RUN or some[-1].version != last or not digits_of(some[-1].error) < least:
            continue
        since = last
        for r in reversed(some):
            if not digits_of(r.error) < least:
                break
            since = r.version
        out.append({"robot": robot, "term": term, "digits": round(digits_of(some[-1].error), 1), "since": since})
    return out


def reasons(rows: Iterable[Row]) -> list[dict[str, Any]]:
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
            read = OwnParser(mb.engine(f"{engine}=={version}"), text, "urdf", model)
            values[version] = float(read.term("mass_matrix", np.zeros((1, 1)), np.zeros((1, 1)))[0, 0, 0])
        out[name] = {"urdf": text, "right": right, "M": values}
    for version in VERSIONS[engine]:
        process.end(mb.engine(f"{engine}=={version}"))
    return out


#: See `validation.smoke`.
SMOKE = {
    "VERSIONS": {"mujoco": ("4.0.0",)},
    "ROBOTS": (),
    "WAYS": 1,
    "TREES": {},
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
        models = [*written(Path(folder))[:WAYS], *trees]
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
