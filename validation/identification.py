"""Identified parameters of two arms: exact torques, 200 trials with noise, and the speed of the regressor.

Run ``python -m validation.identification`` (3 minutes; ``--trials 20`` for a first look).

The geometry of a UR5 and of a Panda is known, but with other masses, centres of mass and inertias than they have. They
move along an optimized Fourier series of 10 s. Torques come from each engine's inverse dynamics, exact first, then with
white noise of 0.5 % to 5 % of each joint's root mean square. Reported are the largest error of a base parameter from
exact torques, relative to the largest parameter; and of the noisy trials the part of all estimates whose error is
within three of the standard deviations told, with the part of the worst parameter. Normal errors would be so in
99.73 %.

The speed is that of 100,000 samples at once on the own derivation, arrays in their ordinary order. Beside it stand a
loop that calls Pinocchio's ``computeJointTorqueRegressor`` and keeps nothing, and one that keeps as many columns as
there are base parameters in one array, as the own derivation does. All are best of 20 or 30.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit.model.base_parameters import regressor_columns
from validation.stamp import results, stamp

ROBOTS = ("ur5", "panda")
ENGINES = ("pinocchio", "mujoco", "lagrangian")
SAMPLES, TRIALS = 100_000, 200
#: Of the motion that identifies, s.
LASTS = 10.0
#: Calls of a loop, whose time for a sample does not depend on their number.
CALLS = 5_000


def other_masses(model, rng):
    """Return the geometry with masses and inertias off by up to 30 %, and centres of mass by some 2 cm."""
    bodies = []
    for b in model.bodies:
        f, g = rng.uniform(0.7, 1.3, 2)
        shift = 0.02 * rng.standard_normal(3) if b.mass else np.zeros(3)
        bodies.append(replace(b, mass=f * b.mass, com=b.com + shift, inertia=g * b.inertia))
    return replace(model, bodies=tuple(bodies))


def arrays(found):
    return (np.array([getattr(p, name) for p in found.parameters]) for name in ("value", "deviation"))


def identified(name, trials):
    model, rng = mb.load(name), np.random.default_rng(0)
    motion = mb.excitation(model, duration=LASTS, rate=100.0, seed=0)
    before, true = other_masses(model, rng), model.base_parameters().values
    state = motion.q, motion.v, motion.a
    exact = {}
    for engine in ENGINES:
        tau = mb.dynamics(model, engine).inverse_dynamics(*state)
        values, _ = arrays(mb.identify(before, *state, tau))
        exact[engine] = float(np.abs(values - true).max() / np.abs(true).max())
    tau = mb.dynamics(model, "mujoco").inverse_dynamics(*state)
    noise = np.sqrt((tau**2).mean(axis=0)) * np.geomspace(0.005, 0.05, model.nv)
    off = []
    for _ in range(trials):
        values, deviations = arrays(mb.identify(before, *state, tau + noise * rng.standard_normal(tau.shape)))
        off.append(np.abs(values - true) / deviations)
    within = np.array(off) < 3
    noisy = tau + noise * rng.standard_normal(tau.shape)
    start = time.perf_counter()
    held = mb.identify(before, *state, noisy, physical=True)
    after = mb.dynamics(held.model, "mujoco").inverse_dynamics(*state)
    return {
        "model": name,
        "base_parameters": int(true.size),
        "standard_parameters": 10 * len(model.tree),
        "condition": motion.condition,
        "samples": len(motion.t),
        "exact": exact,
        "trials": trials,
        "within_three": float(within.mean()),
        "within_three_worst_parameter": float(within.mean(axis=0).min()),
        "consistent_seconds": time.perf_counter() - start,
        "consistent_torque_error": float(np.sqrt(((after - tau) ** 2).mean() / (tau**2).mean())),
        "free_is_matter": is_matter(mb.identify(before, *state, noisy)),
    }


def is_matter(found):
    try:
        return bool(found.model)
    except mb.errors.ModelError:
        return False


def best(run, times):
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def speed(name):
    model, rng = mb.load(name), np.random.default_rng(0)
    q, v = model.random_state(rng, SAMPLES)
    a = rng.standard_normal(v.shape)
    dyn = mb.dynamics(model, "lagrangian")
    own = {x: best(lambda x=x: dyn.regressor(q, v, a, x), 30) / SAMPLES for x in ("standard", "base")}
    m = mb.dynamics(model, "pinocchio").pin_model
    d = m.createData()
    layout, few = model.layout, slice(0, CALLS)
    Q, V, A = layout.expand_q(q[few]), layout.expand_v(v[few]), layout.expand_v(a[few])

    def loop():
        for row in zip(Q, V, A, strict=True):
            pin.computeJointTorqueRegressor(m, d, *row)

    kept = regressor_columns(model, "base", False, False).bodies
    # As many columns as there are base parameters, from the front: which ones does not change the time.
    which = list(range(len(kept)))
    out = np.empty((CALLS, m.nv, len(which)))

    def stacked():
        for k, row in enumerate(zip(Q, V, A, strict=True)):
            out[k] = pin.computeJointTorqueRegressor(m, d, *row)[:, which]

    theirs, filled = best(loop, 20) / CALLS, best(stacked, 20) / CALLS
    # What nobody who keeps all rows can go below: writing as many numbers into new memory, and into memory in use.
    shape = (SAMPLES, model.nv, len(model.regressor_columns()))
    fresh = best(lambda: np.full(shape, 1.0), 10) / SAMPLES
    room = np.full(shape, 1.0)
    again = best(lambda: room.fill(2.0), 10) / SAMPLES
    near = slice(0, 1000)
    cached = best(lambda: dyn.regressor(q[near], v[near], a[near]), 200) / 1000
    return {
        "model": name,
        "samples": SAMPLES,
        "standard_ns": 1e9 * own["standard"],
        "base_ns": 1e9 * own["base"],
        "pinocchio_loop_ns": 1e9 * theirs,
        "pinocchio_stacked_ns": 1e9 * filled,
        "standard_in_cache_ns": 1e9 * cached,
        "memory_fresh_ns": 1e9 * fresh,
        "memory_again_ns": 1e9 * again,
    }


#: See `validation.smoke`.
SMOKE = {"ROBOTS": ("z1",), "SAMPLES": 20, "CALLS": 5, "TRIALS": 2, "LASTS": 2.0}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=TRIALS)
    parser.add_argument("--speed", action="store_true", help="measure times alone, and keep the rest")
    asked = parser.parse_args()
    path = results("identification.json")
    rows = json.loads(path.read_text())["identified"] if asked.speed else []
    for name in ROBOTS[: 0 if asked.speed else None]:
        rows.append(identified(name, asked.trials))
        print(rows[-1])
    speeds = [speed(name) for name in ROBOTS]
    for row in speeds:
        print(row)
    text = json.dumps({"identified": rows, "speed": speeds, **stamp(__file__)}, indent=1)
    path.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
