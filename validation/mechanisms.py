"""Mechanisms with loops in three engines: errors, softness, and the time of accelerations and steps.

Run ``python -m validation.mechanisms``; it writes ``validation/mechanisms.json``. The reference of errors is the oracle
with 34 digits. MuJoCo's accelerations are measured by its own written law, since its loops are soft.
"""

from __future__ import annotations

import json
import time

import numpy as np

import mbkit as mb
from validation.stamp import results, stamp

SAMPLES, BATCH, STEPS = 16, 4096, 200
#: All of the catalog.
NAMES = None
#: What is timed: the mechanism and what else it takes.
TIMED = (
    ("four_bar", {}),
    ("four_bars", {"n": 1}),
    ("four_bars", {"n": 4}),
    ("four_bars", {"n": 40}),
    # A light crank, driven by forces of a stiff spring.
    ("andrews_squeezer", {"dt": 1e-5}),
    ("delta_robot", {}),
    ("stewart_platform", {}),
)


def best(call, repeats=5):
    """Return the shortest time of some calls, s."""
    times = []
    for _ in range(repeats):
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return min(times)


def agreement(name):
    result = mb.compare(mb.catalog.get(name)(), samples=SAMPLES, terms_only=True)
    worst = {}
    for engine in result.engines:
        rows = [r for r in result.rows if r.engine == engine and not r.defect]
        row = max(rows, key=lambda r: r.relative)
        worst[engine] = {"error": row.relative, "term": row.term, "passed": all(r.passed for r in rows)}
    defects = sorted({r.term for r in result.rows if r.defect})
    return {"mechanism": name, "worst": worst, "softness": result.softness, "terms_of_known_defects": defects}


def speed(name, dt=1e-3, **options):
    """Return nanoseconds of v̇, beside Pinocchio's in a loop, and of RK4 steps of dt seconds, on one thread."""
    model = mb.catalog.get(name)(**options)
    own, other = mb.dynamics(model, "lagrangian", threads=1), mb.dynamics(model, "pinocchio")
    q, v = model.random_state(0, 32)
    q, v = (np.tile(x, (BATCH // 32, 1)) for x in (q, v))
    tau = np.zeros_like(v)
    batch = best(lambda: own.forward_dynamics(q, v, tau)) / BATCH
    # Through the adapter, checks left out: Pinocchio's own call and the passive forces.
    single = other._constrained_motion
    single(q[0], v[0], tau[0])
    beside = best(lambda: [single(*state) for state in zip(q[:256], v[:256], tau[:256], strict=True)]) / 256
    bare = bare_constraint_dynamics(other, q, v)
    # From the neutral pose at rest, where every mechanism is closed.
    q0, v0 = model.neutral(), np.zeros(model.nv)
    state, force = [q0, v0], np.zeros(model.nv)

    def steps():
        x, w = state
        for _ in range(STEPS):
            x, w = own.step(x, w, force, dt)

    steps()
    starts = np.tile(q0, (BATCH, 1)), np.tile(v0, (BATCH, 1))
    end = STEPS * dt
    run = [mb.simulate(own, *starts, end, "rk4", dt=dt, save=[end], doubt=False).stats.seconds for _ in range(4)]
    return {
        "mechanism": model.name,
        "nv": model.nv,
        "dt": dt,
        "solver_of_pinocchio": other.constraint_solver,
        "forward_dynamics_ns": batch * 1e9,
        "pinocchio_ns": beside * 1e9,
        "pinocchio_bare_ns": bare and bare * 1e9,
        "step_single_ns": best(steps) / STEPS * 1e9,
        "step_batch_ns": min(run) / (BATCH * STEPS) * 1e9,
    }


def bare_constraint_dynamics(dyn, q, v):
    """Return seconds of Pinocchio's own function in a loop, with nothing around it; None where it does not apply."""
    if dyn.constraint_solver != "constraintDynamics":
        return None
    import pinocchio as pin

    held = dyn._held
    models, data = held._rigid
    settings = pin.ProximalSettings(1e-14, 1e-14, held._mu, 20)
    states = [(dyn._full_q(x), dyn._full_v(w)) for x, w in zip(q[:256], v[:256], strict=True)]
    force, m, d = np.zeros(dyn.pin_model.nv), held._m, held._d
    return best(lambda: [pin.constraintDynamics(m, d, x, w, force, models, data, settings) for x, w in states]) / 256


#: See `validation.smoke`.
SMOKE = {"SAMPLES": 1, "BATCH": 32, "STEPS": 2, "NAMES": ("four_bar", "scissor"), "TIMED": TIMED[:1]}


def main():
    names = NAMES or [n for n in mb.catalog.systems() if mb.catalog.get(n)().loops]
    rows = []
    for name in names:
        rows.append(agreement(name))
        print(name, {e: f"{x['error']:.1e}" for e, x in rows[-1]["worst"].items()}, rows[-1]["softness"])
    timed = [speed(name, **options) for name, options in TIMED]
    for row in timed:
        print(row)
    data = {**stamp(__file__), "samples": SAMPLES, "batch": BATCH, "agreement": rows, "speed": timed}
    results("mechanisms.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
