"""Errors of motion, momentum, loads and M⁻¹ of every engine against 34 digits, in eps.

Run ``python -m validation.bodies [jobs]``. As `validation.accuracy`, with the terms of bodies
(`mbkit.studies.compare.body_terms`) at 8 random and some hard states of each system, Drake among the
engines, and the own derivation as CasADi's machine runs it. It writes ``validation/bodies.json``.
The bars: 50 eps for the own derivation, 1e-12 for the engines. Exit status 1 if one is missed.
"""

from __future__ import annotations

import os
import sys
from functools import partial

from rich.console import Console
from rich.progress import track

from mbkit.studies.compare.body_terms import BODY_TERMS
from mbkit.studies.worker import run
from validation import accuracy
from validation.stamp import results, stamp

ENGINES = (*accuracy.ENGINES, "drake")
SAMPLES = 8
#: Processes, one for each core.
JOBS = None
#: In eps.
BAR, BAR_OF_ENGINES = 50.0, 1e-12 / accuracy.EPS


def measured(make, samples):
    """Return the errors of one system; in a worker, which finds the terms by itself."""
    return accuracy.measured(make, BODY_TERMS, ENGINES, samples)


def missed(found):
    """Return engine, term, system and eps of every error above its bar."""
    out = []
    for name, system in found.items():
        for engine, terms in system.get("errors", {}).items():
            bar = BAR if engine == accuracy.JUDGED else BAR_OF_ENGINES
            out += [
                {"engine": engine, "term": term, "system": name, "eps": x["eps"], "state": x["state"]}
                for term, x in terms.items()
                if not x["eps"] <= bar
            ]
    return out


#: See `validation.smoke`.
SMOKE = {"accuracy.FLOATING": (), "accuracy.TREES": 1, "accuracy.ROBOTS": accuracy.FEW, "SAMPLES": 1, "JOBS": 1}


def main():
    # Nothing is timed here, and thousands of functions would be compiled for a few states each.
    os.environ["MBKIT_COMPILE"] = "0"
    console = Console(width=160 if not sys.stdout.isatty() else None)
    wanted = accuracy.systems()
    jobs = int(sys.argv[1]) if len(sys.argv) > 1 else JOBS
    calls = {name: partial(measured, make, SAMPLES) for name, (_, make) in wanted.items()}
    found = {}
    for name, result in track(run(calls, jobs=jobs), "comparing", len(wanted), console=Console(stderr=True)):
        if isinstance(result, Exception):
            raise RuntimeError(f"{name}: {result}") from result
        found[name] = {"group": wanted[name][0], **result}
    found = dict(sorted(found.items()))
    lines = accuracy.summary(found, BODY_TERMS, ENGINES)
    over = missed(found)
    stamped = {**stamp(__file__), "bars": {"own": BAR, "engines": BAR_OF_ENGINES}, "summary": lines, "missed": over}
    results("bodies.json").write_text(accuracy.as_json(stamped, found), encoding="utf-8")
    console.print(accuracy.table(lines))
    for x in over:
        console.print(f"missed: {x['engine']}, {x['term']}: {x['eps']:.3g} eps at {x['system']}, {x['state']}")
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
