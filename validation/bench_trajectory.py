"""One trajectory at an error of 1e-9: which engine and method is fastest, and by how much.

Run ``python -m validation.bench_trajectory``, alone on the machine. For each way the loosest
tolerance or longest step is sought whose error in q, the largest at ten times of the
run against a reference, is at most 1e-9; then all of them are timed in turn, as a user
calls them, and medians and half the interquartile ranges are given, with the median of
the processor's time beside them, which other programs on the machine disturb less, and
the machine's load, which says whether there were any. The reference is
rk853 on mbkit's own derivation at 1e-14; a second one, SciPy's DOP853 on Pinocchio at
2.3e-14, says how far it holds. `bare` ways are called without mbkit: SciPy's DOP853 on
Pinocchio's aba.

Compile time is no part of the runs: `first_run_s` is a first run of rk853 with an empty
cache, deriving and compiling included. The budget: UR5, 10 s, at least 5 times faster
than the fastest way that MuJoCo, or SciPy on Pinocchio, has.

`fixed` has the processor's time of one step of RK4 in a run of one state, µs: of short and long
runs, with the last state kept or all, of the machine code alone, and of a loop that reads the state
and sets a torque before each step.
"""

from __future__ import annotations

import json
import os
import time
import warnings

import numpy as np
import pinocchio as pin
from scipy.integrate import solve_ivp

import mbkit as mb
from mbkit.model.integration_space import Space
from mbkit.simulate.solvers.compiled_fixed_step import Chunk
from mbkit.simulate.time_grid import Grid
from mbkit.studies.study_runs import start_state
from validation.stamp import results, stamp

ROUNDS, GOAL, TIMES = 9, 1e-9, 10
#: A way that needs more s than this for one run has lost, and is not timed again.
PATIENCE = 3.0
SCENES = (
    ("ur5, 10 s", lambda: mb.load("ur5").without("damping"), 10.0),
    ("double_pendulum, 5 s", mb.catalog.double_pendulum, 5.0),
    ("panda, mimic free, 0.5 s", lambda: mb.load("panda", mimic="free").without("damping"), 0.5),
    ("anymal_b, floating, 2 s", lambda: mb.load("anymal_b", floating_base=True).without("damping"), 2.0),
)
#: Steps of DT s of RK4 in one run.
STEPS, DT = (1_000, 100_000), 1e-4
FIXED = (
    ("double_pendulum", mb.catalog.double_pendulum),
    ("four_bar", mb.catalog.four_bar),
    ("ur5", lambda: mb.load("ur5").without("damping")),
    ("panda, mimic free", lambda: mb.load("panda", mimic="free").without("damping")),
)
#: (engine, method) -> order of the fixed-step ones, None of those with a tolerance.
WAYS = {
    ("lagrangian", "rk853"): None,
    ("pinocchio", "rk853"): None,
    ("lagrangian", "taylor"): None,
    ("lagrangian", "dop853"): None,
    ("pinocchio", "dop853"): None,
    ("lagrangian", "rk4"): 4,
    ("pinocchio", "rk4"): 4,
    ("mujoco", "mujoco_rk4"): 4,
    ("mujoco", "mujoco_euler"): 1,
    ("mujoco", "mujoco_implicit"): 1,
    ("mujoco", "mujoco_implicitfast"): 1,
    ("mujoco", "mujoco_discrete"): 1,
}
#: Ways that the budget is measured against.
OTHERS = ("dop853 on pinocchio", "bare dop853 on pinocchio", "mujoco_")


def start(model):
    if model.name == "double_pendulum":
        return np.array([1.0, 0.5]), np.zeros(2)
    return start_state(model, 0)


def seconds(call):
    """Return the time on the wall and the processor's, s."""
    begin, busy = time.perf_counter(), time.process_time()
    call()
    return time.perf_counter() - begin, time.process_time() - busy


class Scene:
    """A run to be made in many ways."""

    def __init__(self, label, model, duration):
        self.label, self.model, self.duration = label, model, duration
        self.q, self.v = start(model)
        self.grid = np.linspace(0.0, duration, TIMES + 1)
        self.first = self._first()
        self.engines = {name: mb.dynamics(model, name) for name in ("lagrangian", "pinocchio", "mujoco")}
        self.exact = self.run("lagrangian", "rk853", rtol=1e-14).q
        self.holds = self.error(self.run("pinocchio", "dop853", rtol=2.3e-14).q)

    def _first(self):
        kept = os.environ.get("MBKIT_CACHE_DIR")
        os.environ["MBKIT_CACHE_DIR"] = ""
        try:
            dyn = mb.dynamics(self.model, "lagrangian")
            return seconds(lambda: mb.simulate(dyn, self.q, self.v, self.duration, "rk853", rtol=GOAL))[0]
        finally:
            del os.environ["MBKIT_CACHE_DIR"]
            if kept is not None:
                os.environ["MBKIT_CACHE_DIR"] = kept

    def run(self, engine, method, **options):
        return mb.simulate(self.engines[engine], self.q, self.v, self.duration, method, save=self.grid, **options)

    def error(self, q):
        return float(np.abs(q - self.exact).max()) if q.shape == self.exact.shape else np.inf

    def bare(self):
        """Return run(rtol) by SciPy on Pinocchio's aba and nothing else; None where it would be another motion."""
        model, nq = self.model, self.model.nq
        m = self.engines["pinocchio"].pin_model
        d, tau = m.createData(), np.zeros(m.nv)
        # Quaternions want more than this, and joints may be in another order.
        if model.quaternions or m.nq != nq or any(j.idx_q != j.idx_v for j in m.joints[1:]):
            return None

        def rate(_, y):
            return np.concatenate([y[nq:], pin.aba(m, d, y[:nq], y[nq:], tau)])

        y0 = np.concatenate([self.q, self.v])

        def run(rtol):
            made = solve_ivp(rate, (0.0, self.duration), y0, "DOP853", rtol=rtol, atol=rtol, t_eval=self.grid[-1:])
            return made.y[:nq, -1]

        if np.abs(run(1e-12) - self.exact[-1]).max() > 1e-8:
            return None
        return run


def by_tolerance(run, error):
    """Return the loosest tolerance that reaches the goal, as (option, error), and the last error if none does."""
    worst = np.inf
    run(1e-4)  # what is to be compiled is
    for exponent in np.arange(-4.0, -13.76, -0.25):
        rtol = float(10.0**exponent)
        began = time.perf_counter()
        worst = error(run(rtol))
        if worst <= GOAL:
            return rtol, worst
        if time.perf_counter() - began > PATIENCE:
            break
    return None, worst


def by_step(scene, engine, method, order):
    """Return the longest step that reaches the goal, some hundredths short, as (dt, error)."""
    part = scene.duration / TIMES
    scene.run(engine, method, dt=part)  # what is to be compiled is
    count, worst = max(4, round(part / 4e-3)), np.inf
    while True:
        began = time.perf_counter()
        worst = scene.error(scene.run(engine, method, dt=part / count).q)
        took = time.perf_counter() - began
        if worst <= GOAL:
            return part / count, worst
        # A little more than the order says, at most ten times, at least 5 %.
        factor = 10.0 if not np.isfinite(worst) else (worst / GOAL) ** (1 / order)
        if took * factor > PATIENCE:
            return None, worst
        count = int(np.ceil(count * np.clip(1.02 * factor, 1.05, 10.0)))


def ways(scene):
    """Return name -> (setting, error, call or None)."""
    out = {}
    for (engine, method), order in WAYS.items():
        name = method if method.startswith("mujoco") else f"{method} on {engine}"
        kind = "rtol" if order is None else "dt"
        try:
            if order is None:
                setting, error = by_tolerance(
                    lambda rtol, e=engine, m=method: scene.run(e, m, rtol=rtol).q,
                    scene.error,
                )
            else:
                setting, error = by_step(scene, engine, method, order)
        except (mb.errors.MbkitError, ImportError) as failure:
            print(f"  {name}: {failure}")
            continue
        call = None
        if setting is not None:
            call = lambda e=engine, m=method, k=kind, s=setting: scene.run(e, m, **{k: s})  # noqa: E731
        out[name] = {kind: setting}, error, call
    run = scene.bare()
    if run is not None:
        setting, error = by_tolerance(run, lambda q: float(np.abs(q - scene.exact[-1]).max()))
        out["bare dop853 on pinocchio"] = {"rtol": setting}, error, lambda: run(setting)
    return out


def measure(scene):
    """Return the row of a scene."""
    found = ways(scene)
    calls = {name: call for name, (_, _, call) in found.items() if call is not None}
    times = {name: [] for name in calls}
    for k in range(ROUNDS):
        for name, call in calls.items():
            # What is a hundred times slower needs no nine rounds.
            if k < 3 or times[name][0][0] < 0.3:
                times[name].append(seconds(call))
    rows = {}
    for name, (setting, error, call) in found.items():
        rows[name] = {**setting, "max_error": error, "reached": call is not None}
        if call is not None:
            wall, busy = np.transpose(times[name]) * 1e3
            low, median, high = np.percentile(wall, [25, 50, 75])
            rows[name] |= {"ms": median, "spread_ms": (high - low) / 2, "processor_ms": np.median(busy)}
            stats = getattr(call(), "stats", None)
            if stats is not None:
                rows[name] |= {"steps": stats.steps, "evaluations": stats.evaluations}
    own = rows["rk853 on lagrangian"]
    other = min(
        (name for name, row in rows.items() if row["reached"] and name.startswith(OTHERS)),
        key=lambda name: rows[name]["ms"],
        default=None,
    )
    return {
        "scene": scene.label,
        "goal": GOAL,
        "reference_holds_to": scene.holds,
        "first_run_s": scene.first,
        "ways": rows,
        "fastest_other": other,
        "times_faster": None if other is None else rows[other]["ms"] / own["ms"],
        "times_faster_by_processor": None if other is None else rows[other]["processor_ms"] / own["processor_ms"],
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
    }


def fixed(label, model):
    """Return the processor's time of a step of RK4 in runs of one state, µs."""
    dyn, (q, v), space = mb.dynamics(model, "lagrangian", threads=1, compile=True), start(model), Space(model)
    chunk = Chunk(dyn._step_plan("rk4"), space, 1, STEPS[0], torques=False, all_kept=False)
    chunk.begin(q[None], space.to_integrator_velocity(q, v)[None], dyn._parameter_values)
    chunk.set_times(Grid.of(0.0, 1.0, DT), 0, chunk.block)
    zero = np.zeros((1, model.nv, 1))

    def alone():
        chunk.run_to(chunk.block)
        chunk.again()

    def stopped():
        for k in range(chunk.block):
            chunk.now("q"), chunk.now("w")
            chunk.hold(zero)
            chunk.run_to(k + 1)
        chunk.again()

    calls = {"machine code": (chunk.block, alone), "stopped at each": (chunk.block, stopped)}
    for count in STEPS:
        for kept, save in (("last", [count * DT]), ("all", None)):
            calls[f"{count} steps, {kept} kept"] = (
                count,
                lambda n=count, s=save: mb.simulate(dyn, q, v, n * DT, "rk4", dt=DT, save=s),
            )
    best = dict.fromkeys(calls, np.inf)
    for _ in range(ROUNDS):
        for name, (count, call) in calls.items():
            # The first of some finds cold caches.
            best[name] = min(best[name], *(seconds(call)[1] / count * 1e6 for _ in range(5)))
    print(f"{label}: " + ", ".join(f"{name} {us:.3f} µs" for name, us in best.items()))
    return {"model": label, "step_us": best}


def show(row):
    print(f"{row['scene']}: reference holds to {row['reference_holds_to']:.1e}, first run {row['first_run_s']:.2f} s")
    for name, r in sorted(row["ways"].items(), key=lambda item: item[1].get("ms", np.inf)):
        setting = next((f"{k} {r[k]:.3g}" for k in ("rtol", "dt") if r.get(k)), "")
        took = (
            f"{r['ms']:10.3f} ± {r['spread_ms']:.3f} ms ({r['processor_ms']:.3f})"
            if r["reached"]
            else "    not within patience"
        )
        print(f"  {name:28} {setting:14} error {r['max_error']:.1e} {took}  {r.get('steps', '')}")
    if row["fastest_other"]:
        ratios = f"{row['times_faster']:.0f} times ({row['times_faster_by_processor']:.0f} by the processor's time)"
        print(f"  rk853 on lagrangian is {ratios} faster than {row['fastest_other']}; load {row['load']:.1f}")


#: See `validation.smoke`.
SMOKE = {"SCENES": (("double_pendulum, 50 ms", mb.catalog.double_pendulum, 0.05),), "ROUNDS": 1, "PATIENCE": 0.02}
SMOKE |= {"STEPS": (20, 40), "FIXED": FIXED[:1]}


def main():
    warnings.simplefilter("ignore")
    rows = []
    for label, make, duration in SCENES:
        rows.append(measure(Scene(label, make(), duration)))
        show(rows[-1])
    about = {"fixed": [fixed(label, make()) for label, make in FIXED], "rounds": ROUNDS, **stamp(__file__)}
    with results("trajectory.json").open("w", encoding="utf-8") as f:
        json.dump({"rows": rows, **about}, f, indent=1)


if __name__ == "__main__":
    main()
