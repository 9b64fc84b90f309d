"""Runs under a controller that samples, beside a loop of single steps and runs without samples.

Run ``python -m validation.sampled``, alone on the machine. All ways are timed in turn in one process, in processor
time; ratios are what to read. One arm is stepped by RK4 at 1 ms for 1 s and for 10 s, sampled at each step by a PD law
in NumPy: by ``simulate(..., hold=...)``, by a loop of ``dyn.step``, and by the law as data (`StateFeedback`, which acts
at each stage); a table of torques and no torque at all show what the samples cost. Batches of a double pendulum are
sampled by a `Policy` that costs nothing.
"""

from __future__ import annotations

import json
import statistics
import time
import warnings

import numpy as np

import mbkit as mb
from mbkit.simulate import Policy, StateFeedback, simulate
from validation.stamp import results, stamp

ROUNDS, STEPS, STEP = 15, (1000, 10_000), 1e-3
ARMS = {"ur5": lambda: mb.load("ur5"), "panda, mimic free": lambda: mb.load("panda", mimic="free")}
BATCHES = (200, 2000, 10_000)
SMOKE = {"ROUNDS": 1, "STEPS": (4, 5), "ARMS": {"ur5": ARMS["ur5"]}, "BATCHES": (3,)}
KP, KD = 50.0, 5.0


def law(_t, q, v):
    return -KP * q - KD * v


def medians(ways):
    """Return the median processor time of each way, s, all called in turn, in another order in each round.

    What comes behind a long way finds its caches empty.
    """
    spent, rng = {name: [] for name in ways}, np.random.default_rng(0)
    for way in ways.values():
        way()
    for _ in range(ROUNDS):
        for name in rng.permutation([*ways]).tolist():
            way = ways[name]
            begin = time.process_time()
            way()
            spent[name].append(time.process_time() - begin)
    return {name: statistics.median(x) for name, x in spent.items()}


def arm(label, model, steps):
    """Return µs per step of each way, and by how much the runs by a loop and by samples differ."""
    dyn = mb.dynamics(model, "lagrangian")
    q0, v0, nv = model.neutral(), np.zeros(model.nv), model.nv
    feedback = StateFeedback(np.hstack([KP * np.eye(nv), KD * np.eye(nv)]))

    def loop():
        q, v = q0, v0
        for k in range(steps):
            q, v = dyn.step(q, v, law(k * STEP, q, v), STEP)
        return q

    def run(torque, hold=None):
        return lambda: simulate(dyn, q0, v0, steps * STEP, dt=STEP, torque=torque, hold=hold, doubt=False)

    ways = {"loop": loop, "sampled": run(law, STEP), "feedback": run(feedback), "at stages": run(law)}
    ways |= {"table": run(np.ones((steps, nv))), "none": run(None)}
    off = float(np.abs(loop() - ways["sampled"]().q[-1]).max())
    row = {
        "label": label,
        "steps": steps,
        "difference": off,
        "us": {k: x / steps * 1e6 for k, x in medians(ways).items()},
    }
    us = row["us"]
    row["ratios"] = {
        "sampled beside the loop": us["sampled"] / us["loop"],
        "feedback beside none": us["feedback"] / us["none"],
        "table beside none": us["table"] / us["none"],
    }
    print(label, steps, {k: round(x, 2) for k, x in (us | row["ratios"]).items()}, flush=True)
    return row


def batch(count):
    """Return steps a second of a batch, sampled at each step by one call for all, and without samples."""
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, "lagrangian")
    q, v, none = (
        np.random.default_rng(0).normal(size=(count, model.nq)),
        np.zeros(model.nv),
        np.zeros((count, model.nv)),
    )
    policy = Policy(lambda *_: none)
    ways = {
        "policy": lambda: simulate(
            dyn, q, v, STEPS[0] * STEP, dt=STEP, torque=policy, hold=STEP, save=STEPS[0], doubt=False
        ),
        "none": lambda: simulate(dyn, q, v, STEPS[0] * STEP, dt=STEP, save=STEPS[0], doubt=False),
    }
    row = {"count": count, "steps a second": {k: count * STEPS[0] / x for k, x in medians(ways).items()}}
    print(count, {k: f"{x:.3g}" for k, x in row["steps a second"].items()}, flush=True)
    return row


def main():
    warnings.simplefilter("ignore")
    about = {
        "arms": [arm(label, make(), n) for label, make in ARMS.items() for n in STEPS],
        "batches": [batch(n) for n in BATCHES],
    }
    about |= {"rounds": ROUNDS, **stamp(__file__)}
    results("sampled.json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
