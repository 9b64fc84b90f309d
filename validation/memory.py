"""Memory that models leave behind when they are released, by what was done with them.

Run ``python -m validation.memory`` (25 minutes of processor time; ``--models 200`` for a first look).
Each case has a process of its own. It makes one model after another, a double pendulum with other
numbers each time, uses it and releases it; the resident memory is read every so often. Reported is
the slope of a straight line through the second half of the readings: caches of bounded size, such
as heyoka's of 64 MiB, fill in the first half.
"""

from __future__ import annotations

import argparse
import gc
import json
import multiprocessing
import os
import resource
import time
import warnings
from pathlib import Path

import numpy as np

READINGS = 40
Q, V = np.array([0.1, 0.2]), np.zeros(2)


def fresh(rng):
    import mbkit as mb

    return mb.catalog.double_pendulum(length1=float(rng.uniform(0.5, 2)), mass1=float(rng.uniform(0.5, 2)))


def engine(name, **options):
    """Return a case: one evaluation of forward dynamics."""

    def use(model):
        import mbkit as mb

        mb.dynamics(model, name, **options).forward_dynamics(Q, V, V)

    return use


def run(method, **options):
    """Return a case: a run of 0.1 s on the own derivation."""

    def use(model):
        import mbkit as mb

        mb.simulate(mb.dynamics(model, "lagrangian"), Q, V, 0.1, method=method, **options)

    return use


CASES = {
    "model": lambda model: model.digest,
    "pinocchio": engine("pinocchio"),
    "mujoco": engine("mujoco"),
    "interpreted": engine("lagrangian", compile=False),
    "compiled": engine("lagrangian", compile=True),
    "rk4": run("rk4", dt=0.01),
    "rk853": run("rk853"),
    "taylor": run("taylor"),
}


def resident():
    """Return the resident memory of this process, kB."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1000


def slope(models, kilobytes):
    """Return kB per model, by least squares over the second half of the readings."""
    half = len(models) // 2
    return float(np.polyfit(models[half:], kilobytes[half:], 1)[0])


def measure(name, count):
    """Use and release `count` models; return the readings and their slope."""
    warnings.simplefilter("ignore")
    rng = np.random.default_rng(0)
    done, readings = [], []
    start = time.process_time()
    for k in range(1, count + 1):
        CASES[name](fresh(rng))
        if k % max(1, count // READINGS) == 0:
            done.append(k)
            readings.append(resident())
    return {
        "case": name,
        "models": count,
        "kB_per_model": slope(done, readings),
        "first_MB": readings[0] / 1000,
        "last_MB": readings[-1] / 1000,
        "processor_s": time.process_time() - start,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--models", type=int, default=2000)
    parser.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    asked = parser.parse_args()
    # Nothing comes from disk: each model is compiled.
    os.environ["MBKIT_CACHE_DIR"] = os.environ["HEYOKA_CACHE_DIR"] = ""
    path = Path(__file__).with_suffix(".json")
    rows = {row["case"]: row for row in json.loads(path.read_text())["rows"]} if path.exists() else {}
    context = multiprocessing.get_context("spawn")
    for name in asked.cases:
        with context.Pool(1) as pool:
            row = rows[name] = pool.apply(measure, (name, asked.models))
        print(f"{name:12} {row['kB_per_model']:8.2f} kB a model  {row['first_MB']:6.0f} to {row['last_MB']:.0f} MB")
        from validation.stamp import stamp

        whole = {"rows": list(rows.values()), **stamp()}
        path.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
