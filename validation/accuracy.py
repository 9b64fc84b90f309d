"""Errors of every engine against 34 digits, in eps: robots, floating robots, random trees.

Run ``python -m validation.accuracy [jobs]``. It compares M, nle, inverse and forward
dynamics of each system at 64 random and some hard states with the oracle, through
the public interface, and writes ``validation/accuracy.json``. By default the own
derivation is measured compiled, as users have it, which takes long the first time;
with ``MBKIT_COMPILE=0`` as CasADi's machine runs it. An error is the worst
of all states, normwise, as `mbkit.studies.compare.errors` says; beside it stands the worst
of a single joint by its own scale. The bars are those of the own derivation: 10 eps
on robots, 50 eps on random trees of all joint kinds with up to 30 joints. Exit
status 1 if one is missed.
"""

from __future__ import annotations

import json
import re
import statistics
import sys
import warnings
from functools import partial

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import mbkit as mb
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import MbkitError, MbkitWarning, ModelError
from mbkit.studies.compare.study import Judge
from mbkit.studies.compare.terms import TERMS as ALL_TERMS
from mbkit.studies.compare.terms import states
from mbkit.studies.worker import run
from tests.random_trees import random_tree
from validation.robots import FEW, chosen
from validation.stamp import results, stamp

EPS = float(np.finfo(float).eps)
TERMS = tuple(t for t in ALL_TERMS if t.name in ("M", "nle", "inverse dynamics", "forward dynamics"))
ENGINES = ("lagrangian", "pinocchio", "mujoco")
FLOATING = ("talos", "anymal_b", "solo12")
TREES, LARGEST, SAMPLES = 200, 30, 64
#: Processes, one for each core.
JOBS = None
#: All of them.
ROBOTS = None
BARS = {"robots": 10.0, "floating robots": 10.0, "random trees": 50.0}
JUDGED = "lagrangian"


def systems():
    """Return name -> (group, how to make the model); what takes longest first."""
    made = {f"{name} floating": ("floating robots", partial(mb.load, name, floating_base=True)) for name in FLOATING}
    made |= {r.name: ("robots", partial(mb.load, r.name)) for r in chosen(ROBOTS)}
    for seed in reversed(range(TREES)):
        joints = 1 + seed % LARGEST
        made[f"tree {seed}"] = ("random trees", partial(random_tree, seed, joints, mimic=bool(seed // LARGEST % 2)))
    return made


def told(error):
    """Return why a system was refused, without the place of its file on this machine."""
    if isinstance(error, ModelError):
        return "; ".join(error.faults)
    return re.sub(r"(?<![^\s'\"(])/(?:[^\s'\":]+/)*", "", str(error))


def measured(make, terms=TERMS, engines=ENGINES, samples=64):
    """Return the errors of one system: engine -> term -> figures, and what was refused."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        try:
            model = make()
        except MbkitError as error:
            return {"refused": told(error)}
        if not model.nv:
            return {"refused": "nothing moves"}
        oracle, at = OracleDynamics(model), states(model, samples, 0)
        errors, notes = {}, []
        for engine in engines:
            try:
                dyn = mb.dynamics(model, engine)
            except MbkitError as error:
                notes.append(f"{engine}: {told(error)}")
                continue
            judge = Judge(model, {engine: dyn}, oracle, at, tolerance=np.inf)
            errors[engine] = {}
            for term in terms:
                try:
                    errors[engine][term.name] = figures(judge, term, dyn)
                except MbkitError as error:
                    notes.append(f"{term.name}: {told(error)}")
    return {"nv": model.nv, "samples": len(at.q), "errors": errors, "notes": notes}


def figures(judge, term, dyn):
    """Return the errors of one term in eps: the worst state's, the median, the worst joint's."""
    high, low = term.reference(judge.oracle, judge.at)
    e = term.errors((term.call(dyn, judge.at) - high) - low, high, judge.scales)
    worst, joint = e.worst, int(np.argmax(e.per_velocity)) if e.per_velocity.size else None
    return {
        "eps": round(float(e.relative[worst]) / EPS, 3),
        "median": round(float(np.median(e.relative)) / EPS, 3),
        "per_joint": 0.0 if joint is None else round(float(e.per_velocity[joint]) / EPS, 3),
        "joint": "" if joint is None else judge.joint_of[joint],
        "state": judge.at.kinds[worst],
    }


def summary(found, terms=TERMS, engines=ENGINES):
    """Return a line per group, engine and term: how many, median, worst and where."""
    lines = []
    for group in BARS:
        for engine in engines:
            for term in (t.name for t in terms):
                at = [
                    (s["errors"][engine][term], name)
                    for name, s in found.items()
                    if s["group"] == group and term in s.get("errors", {}).get(engine, {})
                ]
                if not at:
                    continue
                worst, name = max(at, key=lambda x: x[0]["eps"])
                alone, alone_at = max(at, key=lambda x: x[0]["per_joint"])
                lines.append(
                    {
                        "group": group,
                        "engine": engine,
                        "term": term,
                        "systems": len(at),
                        "median": statistics.median(x["eps"] for x, _ in at),
                        "worst": worst["eps"],
                        "where": name,
                        "per_joint": alone["per_joint"],
                        "per_joint_where": f"{alone_at}, {alone['joint']}",
                    }
                )
    return lines


def table(lines):
    out = Table("systems", "engine", "term", title="Errors against 34 digits, in eps = 2.2e-16")
    for head in ("n", "median", "worst", "at", "per joint", "at"):
        out.add_column(head, justify="left" if head == "at" else "right")
    for x in lines:
        numbers = f"{x['median']:.2f}", f"{x['worst']:.2f}", x["where"], f"{x['per_joint']:.3g}", x["per_joint_where"]
        out.add_row(x["group"], x["engine"], x["term"], str(x["systems"]), *numbers)
    return out


def missed(lines):
    """Return the lines of the own derivation that are above their bar."""
    return [x for x in lines if x["engine"] == JUDGED and x["worst"] > BARS[x["group"]]]


def as_json(stamped, found):
    """Return everything as JSON, a line per system."""
    head = json.dumps(stamped, indent=1).removesuffix("\n}")
    systems = ",\n".join(f"  {json.dumps(name)}: {json.dumps(system)}" for name, system in found.items())
    return f'{head},\n "systems": {{\n{systems}\n }}\n}}\n'


#: See `validation.smoke`.
SMOKE = {"FLOATING": (), "TREES": 1, "SAMPLES": 2, "ROBOTS": FEW, "JOBS": 1}


def main():
    console = Console(width=160 if not sys.stdout.isatty() else None)
    wanted = systems()
    jobs = int(sys.argv[1]) if len(sys.argv) > 1 else JOBS
    answers = run({name: partial(measured, make, samples=SAMPLES) for name, (_, make) in wanted.items()}, jobs=jobs)
    found = {}
    for name, result in track(answers, "comparing", len(wanted), console=Console(stderr=True)):
        if isinstance(result, Exception):
            raise RuntimeError(f"{name}: {result}") from result
        found[name] = {"group": wanted[name][0], **result}
    found = dict(sorted(found.items()))
    lines = summary(found)
    over = missed(lines)
    compiled = mb.dynamics(mb.catalog.pendulum(), JUDGED).compile
    stamped = {
        **stamp(__file__),
        "compiled": compiled,
        "bars": BARS,
        "summary": lines,
    }
    results("accuracy.json").write_text(as_json(stamped, found), encoding="utf-8")
    console.print(table(lines))
    for x in over:
        console.print(
            f"missed: {x['group']}, {x['term']}: {x['worst']:.1f} > {BARS[x['group']]:.0f} eps at {x['where']}"
        )
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
