"""Measure everything again: every file and figure that the pages of numbers are made of.

``python -m validation`` runs all parts, one after the other, in about three hours on two cores; with names of
parts it runs these; ``--list`` names them all. A part that fails does not stop the others. With ``--smoke`` each
runs with little of everything, and nothing is kept: `validation.smoke`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

TOP = Path(__file__).resolve().parent.parent


class Part(NamedTuple):
    """A script of this folder: about how many minutes it takes on two cores, what it writes, and what it measures."""

    minutes: float
    writes: tuple[str, ...]
    about: str


#: Those whose result is a time come last; let nothing else run beside them.
PARTS = {
    "accuracy": Part(20, ("accuracy.json",), "terms against 34 digits: robots, floating robots, random trees"),
    "bodies": Part(20, ("bodies.json",), "motion, momentum, loads and M⁻¹ against 34 digits"),
    "bench_bodies": Part(2, ("bench_bodies.json",), "batches of motion, momentum and loads beside engines in a loop"),
    "readme_figure": Part(2, ("check_all.json",), "every robot of example-robot-data in three engines"),
    "matrix": Part(
        8, ("matrix.json",), "every kind of part on every path, and pairs: right, refused by name, or left out"
    ),
    "published": Part(2, ("published_checks.json",), "published problems, to their printed digits"),
    "identification": Part(
        3, ("identification.json",), "identified parameters of two arms, and regressors beside Pinocchio"
    ),
    "energy_drift": Part(1, ("energy_drift.json",), "a million steps of a symplectic method"),
    "long_loops": Part(1, ("long_loops.json",), "a million steps of mechanisms with loops: gap and energy"),
    "near_redundant": Part(2, ("near_redundant.json",), "digits of accelerations beside the condition of the rows"),
    "lint": Part(5, ("lint.json",), "what lint finds on the robots, with verdicts, and of planted mistakes"),
    "importers": Part(1, ("importers.json", "importers_floating.json"), "one file through three importers"),
    "importers_trained": Part(20, ("importers_trained.json",), "the robots through importers of trained engines"),
    "importer_defects": Part(
        20,
        ("importer_defects.json",),
        "smallest files through importers of trained engines; environments of 600 MB each",
    ),
    "versions": Part(
        45, ("versions.json",), "versions of MuJoCo, Pinocchio and Drake; makes some 18 GB of environments"
    ),
    "trained_engines": Part(
        60, ("trained_engines.json",), "Newton, MuJoCo Warp and MJX on every robot; makes 2 GB of environments"
    ),
    "transfer": Part(
        40, ("transfer.json",), "robots in five engines beside the exact motion, and what each usual change does"
    ),
    "motion_causes": Part(
        2, ("motion_causes.json",), "twenty pairs of files with drawn faults: causes named, and their effect in radians"
    ),
    "environments": Part(10, (), "tests of engines in environments of their own; makes 3 GB of these"),
    "planted": Part(7, ("planted.json",), "a hundred planted defects, and the tests that catch them"),
    "fuzz": Part(10, ("fuzz.json",), "random and damaged files, random trees"),
    "memory": Part(14, ("memory.json",), "memory that released models leave behind"),
    "stress": Part(25, ("stress.json",), "what holds to where: stiff and extreme cases"),
    "auto": Part(15, ("auto.json",), "method auto beside the best method of each hard problem"),
    "bench_terms": Part(15, ("terms.json",), "one sample of inverse and forward dynamics"),
    "operations": Part(10, ("operations.json",), "operations of each form, and the vector units' limit"),
    "sampled": Part(1, ("sampled.json",), "controllers that sample: runs beside loops of steps, and batches"),
    "bench_single_calls": Part(1, ("single_calls.json",), "a single call, beside the bare call of the engine"),
    "friction": Part(6, ("friction.json",), "dry friction: references, orders across phases, a smoothed law"),
    "stop_motions": Part(2, ("stop_motions.json",), "joints that meet stops: closed forms, and arcs of 40 digits"),
    "stops": Part(1, ("stops.json",), "joint stops: times, energies, orders, and batches with and without them"),
    "four_bar": Part(1, ("four_bar.json",), "a loop in four engines: error, gap and time of a step"),
    "mechanisms": Part(5, ("mechanisms.json",), "mechanisms with loops: errors, softness, time of a step"),
    "bicycle": Part(1, ("bicycle.json",), "the benchmark bicycle's eigenvalues beside its paper's formulas and print"),
    "flexible": Part(1, ("flexible.json",), "strings and beams beside closed forms, and chains of rigid segments"),
    "iftomm": Part(15, ("iftomm.json",), "published problems with loops: Andrews' squeezer, IFToMM's A01 to A05"),
    "variants": Part(
        6, ("variants.json",), "changed robots beside Pinocchio's and MuJoCo's own changes, and a thousand variants"
    ),
    "bench_rollouts": Part(5, ("rollouts.json",), "batches of rollouts, beside mujoco.rollout"),
    "bench_trajectory": Part(5, ("trajectory.json",), "one trajectory to an error of 1e-9"),
    "bench_derivation": Part(1, ("derivation.json",), "equations to read, beside sympy.physics.mechanics"),
    "gpu": Part(4, ("gpu.json",), "the own derivation on an NVIDIA GPU, which it needs"),
    "checks_cost": Part(3, ("checks_cost.json",), "the checks after a run"),
    "work_precision": Part(14, ("work_precision.json",), "error against run time of ten scenes"),
}


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m validation", description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help="run these parts (default: all of them)")
    parser.add_argument("--smoke", action="store_true", help="with little of everything, in seconds; nothing is kept")
    parser.add_argument("--list", action="store_true", help="name the parts and end")
    asked = parser.parse_args()
    if unknown := [x for x in asked.parts if x not in PARTS]:
        parser.error(f"no part is called {unknown[0]!r}; the parts are {', '.join(PARTS)}")
    if asked.list:
        for name, part in PARTS.items():
            print(f"{name:20} {part.minutes:3.0f} min  {part.about}")
        return 0
    failed = []
    for name in asked.parts or PARTS:
        print(name if asked.smoke else f"{name}: about {PARTS[name].minutes:g} min", flush=True)
        begun = time.perf_counter()
        run = ["validation.smoke", name] if asked.smoke else [f"validation.{name}"]
        status = subprocess.run([sys.executable, "-m", *run], cwd=TOP, check=False).returncode
        print(f"{name}: {'done' if status == 0 else f'exit status {status}'} in {time.perf_counter() - begun:.0f} s")
        failed += [name] if status else []
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
