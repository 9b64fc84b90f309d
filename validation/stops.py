"""Joint stops in runs: times of events and energies of impacts beside the truths of `stop_motions`, and what they cost.

Run ``python -m validation.stops``; it writes ``validation/stops.json``. Batches of arms are timed in turn in one
process, in processor time; ratios are what to read.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np

import mbkit as mb
from tests import test_stop_motions as scenes
from tests.scenes import slider
from validation import stop_motions as truths
from validation.stamp import results, stamp
from validation.stop_arcs import Stop

SCENES = (*scenes.CLOSED, *truths.SCENES)
#: Restitutions and heights of what bounces until it rests.
BOUNCES = ((0.5, 1.3), (0.8, 0.02), (0.01, 1.0))
#: Methods with a fixed step, a scene, and numbers of steps in which orders are observed.
_SCENE = "second joint, e = 0.5"
ORDERS = {
    "rk4": (_SCENE, (400, 800, 1600)),
    "gauss6": (_SCENE, (25, 50, 100)),
    "semi_implicit_euler": (_SCENE, (400, 800, 1600)),
    # It has no events, so that the end is compared.
    "moreau": ("second joint, e = 0", (500, 1000, 2000, 4000)),
}
#: Arms of a batch, steps of 1 ms, and rounds.
BATCH = (1000, 1000, 3)
#: Of times, s, and of energies, relative.
BARS = {"times": 1e-10, "energies": 1e-12, "carnot": 1e-12}
SMOKE = {
    "SCENES": ("bounces",),
    "BOUNCES": BOUNCES[:1],
    "ORDERS": {"rk4": ("bounces", (20, 40))},
    "BATCH": (2, 5, 1),
}


def accuracy(name):
    """Return the largest errors of the times of events, and of the energies that impacts take.

    `energies` are beside the truth's, over the kinetic energy before the impact; `carnot` are beside the energy of the
    velocities that the same impact takes, times (1 - e)/(1 + e), over this energy.
    """
    told = scenes.case(name)
    dyn, pairs = mb.dynamics(told.model, "pinocchio"), scenes.paired(scenes.went(told), told)
    energies, carnot = [], []
    for hit, truth in pairs:
        if truth.kind != "hits":
            continue
        M, jump, e = dyn.mass_matrix(hit.q), hit.v - hit.before, float(told.model.joints[truth.joint].restitution[0])
        energies.append(float(abs(hit.energy_change + float(truth.lost)) / (hit.before @ M @ hit.before / 2)))
        law = -(1 - e) / (1 + e) * (jump @ M @ jump) / 2
        # Perfect restitution takes nothing.
        carnot.append(float(abs(hit.energy_change - law) / abs(law) if law else abs(hit.energy_change)))
    row = {"scene": name, "events": len(pairs), "impacts": len(carnot)}
    row["times"] = max((abs(float(e.t - truth.t)) for e, truth in pairs), default=0.0)
    row |= {"energies": max(energies, default=0.0), "carnot": max(carnot, default=0.0)}
    worst = " ".join(f"{x} {row[x]:8.1e}" for x in ("times", "energies", "carnot"))
    print(f"{name:30} {row['events']:2} events, {row['impacts']} impacts: {worst}")
    return row


def rests(e, height):
    """Return when infinitely many bounces have ended, beside Zeno's series."""
    model = slider(mass=2.0, inertia=(1, 1, 1), axis=scenes.Z, **scenes.acting(Stop(0, None, e))).build()
    limit = float(truths.bounces(height, e, 1)[1])
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [height], [0], limit + 0.3, "rk853", **scenes.TIGHT)
    last, still = run.events[-1], run.t > run.events[-1].t
    assert last.name == "x comes to rest on its lower stop"
    row = {"restitution": e, "height": height, "hits": len(run.events) - 1, "times": abs(last.t - limit)}
    row["moves_at_rest"] = float(max(np.abs(run.q[still]).max(), np.abs(run.v[still]).max()))
    print(row)
    return row


def order(method, name, steps):
    """Return the observed order of a method with a fixed step."""
    told, errors = scenes.case(name), []
    for n in steps:
        run = scenes.went(told, method, dt=told.duration / n)
        mine, truth = (run.q[-1], told.end[0]) if told.end else (run.events[-1].t, told.events[-1].t)
        errors.append(scenes.off(mine, truth))
    row = {"method": method, "scene": name, "events": len(told.events), "errors": errors}
    row["order"] = float(-np.polyfit(np.log(steps), np.log(errors), 1)[0])
    print(row)
    return row


def arms():
    """Yield names and models of arms with stops."""
    yield "panda, all its limits", mb.load("panda", stops=True)
    b = mb.ModelBuilder.of(mb.load("ur5"))
    for joint in ("shoulder_lift_joint", "elbow_joint"):
        b.set_joint(joint, lower=-2.0, upper=2.0, stops=True)
    yield "ur5, shoulder and elbow at ±2 rad", b.build()
    yield "ur5, all its limits", mb.load("ur5", stops=True)


def batch(name, model, many, steps, rounds):
    """Return the time of a batch by rk4 with stops over that without, released at rest from random states."""
    bare = model.without("stops")
    with_, without = (mb.dynamics(m, "lagrangian", threads=1) for m in (model, bare))
    q = bare.random_state(np.random.default_rng(1), many)[0]
    v, seconds, runs = np.zeros((many, bare.nv)), {"with": [], "without": []}, {}
    for _ in range(rounds + 1):
        for which, dyn in (("with", with_), ("without", without)):
            begun = time.process_time()
            runs[which] = mb.simulate(dyn, q, v, steps * 1e-3, "rk4", dt=1e-3, doubt=False)
            seconds[which].append(time.process_time() - begun)
    run = runs["with"]
    assert run.stats.ended == "finished"
    # A few alone.
    off = 0.0
    for i in range(0, many, max(many // 10, 1)):
        one = mb.simulate(with_, q[i], v[i], steps * 1e-3, "rk4", dt=1e-3, doubt=False)
        assert [e.name for e in one.events] == [e.name for e in run.events if e.member == i]
        off = max(off, float(np.abs(one.q - run.q[i]).max()))
    # The first run compiles.
    each = {which: float(np.median(x[1:])) for which, x in seconds.items()}
    hits = [e.member for e in run.events if " hits its " in e.name]
    row = {"arms": name, "count": many, "steps": steps, "hits_per_arm": len(hits) / many}
    row |= {"arms_that_hit": len({*hits}), "events_per_arm": len(run.events) / many, "off_single_runs": off}
    row |= {"seconds": each, "ratio": each["with"] / each["without"]}
    print(row)
    return row


def main():
    rows = [accuracy(name) for name in SCENES]
    data = {"accuracy": [r for r in rows if r["events"]], "rests": [rests(*x) for x in BOUNCES]}
    data["orders"] = [order(method, *x) for method, x in ORDERS.items()]
    data["batches"] = [batch(*x, *BATCH) for x in arms()]
    worst = {x: max(r[x] for r in rows) for x in BARS}
    worst["times"] = max(worst["times"], *(r["times"] for r in data["rests"]))
    data |= {"rtol": scenes.TIGHT["rtol"], "worst": worst}
    print(worst)
    results("stops.json").write_text(json.dumps({**stamp(__file__), **data}, indent=1) + "\n", encoding="utf-8")
    return int(any(worst[x] > bar for x, bar in BARS.items()))


if __name__ == "__main__":
    sys.exit(main())
