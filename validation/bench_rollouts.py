"""Batches of rollouts: mbkit's compiled steps beside `mujoco.rollout`, the same RK4 with the same step.

Run ``python -m validation.bench_rollouts``. Both sides use all cores, are timed in turn
in one process, and integrate the same states of the same description (MuJoCo's model
is built from it, with contacts, limits and all else off that the smooth dynamics does
not need); ratios of the minima are what to read. MuJoCo always writes every state and
is called bare, with threads that are kept; mbkit is timed as a user calls it. The
budget: 25 times `mujoco.rollout` for the UR5, 15 times for the Panda, and the same
states within 1e-11 after 200 steps of 1 ms.
"""

from __future__ import annotations

import json
import time

import mujoco
import mujoco.rollout
import numpy as np

import mbkit as mb
from mbkit._child_process import cores
from validation.stamp import results, stamp

ROUNDS, STEPS, DT = 7, 200, 1e-3
SIZES = (1024, 4096, 16384)
#: MuJoCo's time per state does not depend on how many there are.
BARE = 1024


MODELS = {
    "double_pendulum": mb.catalog.double_pendulum,
    "ur5": lambda: mb.load("ur5"),
    "panda, mimic free": lambda: mb.load("panda", mimic="free"),
    "anymal_b, floating": lambda: mb.load("anymal_b", floating_base=True),
    "talos_reduced": lambda: mb.load("talos_reduced"),
}
#: Of these, how many rollouts of how many steps are one call.
ONE_CALL = ("panda, mimic free", 4096, 1000)


def made(label):
    # mujoco.rollout knows friction as a soft constraint alone, and its RK4 takes dampers as another formula does.
    return MODELS[label]().without("damping", "friction")


def states(model, n):
    """Return random poses with moderate velocities: faster starts multiply rounding by more than 1e3."""
    q, v = model.random_state(np.random.default_rng(5), n)
    return q, 0.1 * v


def bare(dyn, q, v, pool, steps=STEPS):
    """Return a call of mujoco.rollout and nothing else."""
    m = dyn.mj_model
    m.opt.integrator, m.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, DT
    n = len(q)
    start = np.zeros((n, mujoco.mj_stateSize(m, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    # The states' values matter here, not which of MuJoCo's coordinates has which.
    start[:, 1 : 1 + m.nq], start[:, 1 + m.nq : 1 + m.nq + m.nv] = q[:, dyn._maps.q_index], v[:, dyn._maps.v_index]
    out = np.empty((n, steps, start.shape[1]))
    sensors = np.empty((n, steps, m.nsensordata))
    data = [mujoco.MjData(m) for _ in range(cores())]
    return lambda: pool.rollout(m, data, start, nstep=steps, state=out, sensordata=sensors)


def seconds(f):
    start = time.perf_counter()
    f()
    return time.perf_counter() - start


def row(label, model, pool):
    own, theirs = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "mujoco")
    q, v = states(model, max(SIZES))
    duration = STEPS * DT
    first = seconds(lambda: mb.simulate(own, q[:1], v[:1], duration))
    ours = mb.simulate(own, q[:64], v[:64], duration)
    same = mb.simulate(theirs, q[:64], v[:64], duration, "mujoco_rk4")
    apart = max(float(np.abs(x - y).max()) for x, y in ((ours.q, same.q), (ours.v, same.v)))
    calls = {"mujoco": bare(theirs, q[:BARE], v[:BARE], pool)}
    work = {"mujoco": BARE}
    for n in SIZES:
        for kept, save in (("end", [duration]), ("all", None)):
            if kept == "all" and n * STEPS * (model.nq + model.nv) > 1e8:
                continue
            name = f"{n} {kept}"
            work[name] = n
            calls[name] = lambda n=n, save=save: mb.simulate(own, q[:n], v[:n], duration, save=save)
    single = "1 all"
    work[single], calls[single] = 1, lambda: mb.simulate(own, q[0], v[0], duration)
    for call in calls.values():
        call()
    best = {name: min(seconds(call) for _ in range(1)) for name, call in calls.items()}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            best[name] = min(best[name], seconds(call))
    ns = {name: s / (work[name] * STEPS) * 1e9 for name, s in best.items()}
    ratios = {name: ns["mujoco"] / x for name, x in ns.items() if name not in ("mujoco", single)}
    return {
        "model": label,
        "nv": model.nv,
        "max_difference": apart,
        "first_run_s": first,
        "ns_per_state_and_step": ns,
        "times_mujoco": ratios,
    }


def one_call(pool):
    """Return the rate of 4096 rollouts of 1 s in one call, beside `mujoco.rollout` on a sixteenth of them."""
    label, n, steps = ONE_CALL
    model = made(label)
    own, theirs = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "mujoco")
    q, v = states(model, n)
    few = n // 16
    calls = {
        "mujoco": (few, bare(theirs, q[:few], v[:few], pool, steps)),
        "end saved": (n, lambda: mb.simulate(own, q, v, steps * DT, dt=DT, save=[steps * DT])),
        "every 10 ms saved": (n, lambda: mb.simulate(own, q, v, steps * DT, dt=DT, save=10)),
    }
    times = {name: [] for name in calls}
    for _, call in calls.values():
        call()
    for _ in range(5):
        for name, (_, call) in calls.items():
            times[name].append(seconds(call))
    out = {name: {"rollouts": count, "seconds": float(np.median(times[name]))} for name, (count, _) in calls.items()}
    for told in out.values():
        told["rollouts_per_second"] = told["rollouts"] / told["seconds"]
    run = mb.simulate(own, q, v, steps * DT, dt=DT, save=[steps * DT])
    return {"model": label, "horizon_s": steps * DT, "finished": run.stats.finished, "calls": out}


#: See `validation.smoke`.
SMOKE = {
    "MODELS": {"z1": lambda: mb.load("z1")},
    "ONE_CALL": ("z1", 16, 10),
    "ROUNDS": 1,
    "STEPS": 5,
    "SIZES": (4,),
    "BARE": 4,
}


def main():
    rows = []
    with mujoco.rollout.Rollout(nthread=cores()) as pool:
        for label in MODELS:
            rows.append(row(label, made(label), pool))
            r = rows[-1]
            ns = ", ".join(f"{k}: {x:.0f}" for k, x in r["ns_per_state_and_step"].items())
            ratios = ", ".join(f"{k}: × {x:.1f}" for k, x in r["times_mujoco"].items())
            print(
                f"{label}: {r['max_difference']:.1e} apart, first run {r['first_run_s']:.2f} s\n  ns {ns}\n  {ratios}"
            )
        whole = one_call(pool)
        for name, told in whole["calls"].items():
            print(f"{whole['model']}, 1 s: {name}: {told['rollouts_per_second']:.0f} rollouts per second")
    about = {"rk4_dt": DT, "steps": STEPS, "cores": cores(), **stamp(__file__)}
    with results("rollouts.json").open("w", encoding="utf-8") as f:
        json.dump({"rows": rows, "one_call": whole, **about}, f, indent=1)


if __name__ == "__main__":
    main()
