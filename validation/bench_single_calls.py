"""What a single call through mbkit costs beside the bare call of an engine, and a single step.

Run ``python -m validation.bench_single_calls``; with ``bodies`` behind it only the motion
of frames, momenta and loads are timed, in fewer rounds. Both sides are timed in turn in one
process, so that the machine's mood meets them alike; ratios are what to read. The
budget of mbkit's Pinocchio engine: at most the bare call + 1 µs, and 1.5 times it for
Panda's inverse dynamics, nle and forward dynamics. The budget of the own derivation:
at most Pinocchio's bare call. A step is RK4 at 1 ms; beside it stand ``mj_step`` with
the same formula, and a run of one step.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import timeit

import mujoco
import numpy as np
import pinocchio as pin

import mbkit as mb
from validation.stamp import results, stamp

ROUNDS, CALLS, FRESH = 101, 500, 9
#: Rounds and calls of motion, momenta and loads, and repeats of a run.
FEWER, REPEATS = (7, 30), (20, 9)
MODELS = {
    "ur5": lambda: mb.load("ur5"),
    "panda, mimic free": lambda: mb.load("panda", mimic="free"),
    "panda, mimic free, undamped": lambda: mb.load("panda", mimic="free").without("damping"),
    "panda, mimic reduced": lambda: mb.load("panda"),
    "anymal_b, floating": lambda: mb.load("anymal_b", floating_base=True),
}
#: Of these, motion, momenta and loads.
BODIES = ("ur5", "anymal_b, floating")


def pair(ours, bare, rounds, number):
    """Return the least µs of each in several rounds, and their ratio: what else runs only adds."""
    least = [float("inf")] * 2
    for _ in range(rounds):
        for k, f in enumerate((ours, bare)):
            least[k] = min(least[k], timeit.timeit(f, number=number) / number * 1e6)
    return *least, least[0] / least[1]


def import_seconds():
    """Return the median time of a fresh ``import mbkit`` and of a fresh ``import numpy``, s."""
    out = {}
    for module in ("mbkit", "numpy"):
        code = f"import time; t = time.perf_counter(); import {module}; print(time.perf_counter() - t)"
        runs = [
            float(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout)
            for _ in range(FRESH)
        ]
        out[module] = statistics.median(runs)
    return out


def calls(dyn, m, d, model, q, v, a):
    """Return (name, through mbkit, bare) of every call."""
    Q, V, A = model.layout.expand_q(q), model.layout.expand_v(v), model.layout.expand_v(a)
    D = np.concatenate([j.damping for j in model.joints])
    if D.any():
        # The same number in another way: Pinocchio's rnea and aba know no damping.
        inverse, forward = lambda: pin.rnea(m, d, Q, V, A) + D * V, lambda: pin.aba(m, d, Q, V, A - D * V)
    else:
        inverse, forward = lambda: pin.rnea(m, d, Q, V, A), lambda: pin.aba(m, d, Q, V, A)
    return (
        ("inverse_dynamics", lambda: dyn.inverse_dynamics(q, v, a), inverse),
        ("nle", lambda: dyn.nle(q, v), lambda: pin.nonLinearEffects(m, d, Q, V)),
        ("forward_dynamics", lambda: dyn.forward_dynamics(q, v, a), forward),
        ("mass_matrix", lambda: dyn.mass_matrix(q), lambda: pin.crba(m, d, Q)),
        ("gravity", lambda: dyn.gravity(q), lambda: pin.computeGeneralizedGravity(m, d, Q)),
    )


def body_calls(model, m, d, q, v, a):
    """Return (name, arguments, bare call of Pinocchio) of motion, momenta and loads; one frame, at its origin."""
    name = model.bodies[-1].name
    joint, frame = m.njoints - 1, pin.SE3.Identity()
    world = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    w = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    on, outside = {name: w}, pin.StdVec_Force(m.njoints, pin.Force.Zero())
    outside[joint] = pin.Force(w)

    def after(first, second):
        def both():
            first()
            return second()

        return both

    jacobian = after(
        lambda: pin.computeJointJacobians(m, d, q), lambda: pin.getFrameJacobian(m, d, joint, frame, world)
    )
    return (
        ("pose", (q, name), after(lambda: pin.forwardKinematics(m, d, q), lambda: (d.oMi[joint] * frame).homogeneous)),
        ("jacobian", (q, name), jacobian),
        (
            "velocity",
            (q, v, name),
            after(
                lambda: pin.forwardKinematics(m, d, q, v),
                lambda: pin.getFrameVelocity(m, d, joint, frame, world).vector,
            ),
        ),
        (
            "acceleration",
            (q, v, a, name),
            after(
                lambda: pin.forwardKinematics(m, d, q, v, a),
                lambda: pin.getFrameClassicalAcceleration(m, d, joint, frame, world).vector,
            ),
        ),
        (
            "jacobian_dot_v",
            (q, v, name),
            after(
                lambda: pin.computeJointJacobiansTimeVariation(m, d, q, v),
                lambda: pin.getJointJacobianTimeVariation(m, d, joint, world) @ v,
            ),
        ),
        ("center_of_mass", (q,), lambda: pin.centerOfMass(m, d, q, False)),
        ("center_of_mass_velocity", (q, v), lambda: pin.centerOfMass(m, d, q, v, False)),
        ("center_of_mass_acceleration", (q, v, a), lambda: pin.centerOfMass(m, d, q, v, a, False)),
        ("center_of_mass_jacobian", (q,), lambda: pin.jacobianCenterOfMass(m, d, q, False)),
        ("centroidal_momentum", (q, v), lambda: pin.computeCentroidalMomentum(m, d, q, v)),
        ("centroidal_momentum_matrix", (q,), lambda: pin.computeCentroidalMap(m, d, q)),
        ("centroidal_momentum_bias", (q, v), lambda: pin.dccrba(m, d, q, v) @ v),
        ("locked_inertia", (q,), after(lambda: pin.ccrba(m, d, q, v), lambda: d.Ig.matrix())),
        ("mass_matrix_inverse", (q,), lambda: pin.computeMinverse(m, d, q)),
        ("generalized_force", (q, on), lambda: jacobian().T @ w),
        ("inverse_dynamics", (q, v, a, on), lambda: pin.rnea(m, d, q, v, a, outside)),
        ("forward_dynamics", (q, v, a, on), lambda: pin.aba(m, d, q, v, a, outside)),
        (
            "joint_wrenches",
            (q, v, a),
            after(lambda: pin.rnea(m, d, q, v, a), lambda: [d.f[i].vector for i in range(1, m.njoints)]),
        ),
    )


def body_rows():
    """Return the rows of motion, momenta and loads of every engine, beside Pinocchio's bare call."""
    rows = []
    for label in BODIES:
        model = MODELS[label]().without("damping")
        rng = np.random.default_rng(0)
        q, v = model.random_state(rng)
        a = rng.standard_normal(model.nv)
        engines = [mb.dynamics(model, name) for name in ("lagrangian", "pinocchio", "mujoco", "drake")]
        m = engines[1].pin_model
        for name, given, bare in body_calls(model, m, m.createData(), q, v, a):
            row = {"model": label, "call": f"{name}, a wrench" if name.endswith("dynamics") else name}
            for dyn in engines:
                method = getattr(dyn, name)
                method(*given)
                row[f"{dyn.engine}_us"], row["bare_us"], _ = pair(lambda f=method, x=given: f(*x), bare, *FEWER)
            rows.append(row)
            print(f"{label:20} {row['call']:28}", *(f"{k} {x:8.2f}" for k, x in row.items() if k.endswith("_us")))
    return rows


def step_row(label, model, q, v, tau):
    """Return the row of a step of 1 ms: of the own derivation, of mj_step, and of a run of one step, µs."""
    dyn, mj = mb.dynamics(model, "lagrangian"), mb.dynamics(model, "mujoco")
    m = mj.mj_model
    m.opt.integrator, m.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 1e-3
    d = mujoco.MjData(m)
    mine, theirs, ratio = pair(lambda: dyn.step(q, v, tau, 1e-3), lambda: mujoco.mj_step(m, d), ROUNDS, CALLS)
    calls, rounds = REPEATS
    times = timeit.repeat(lambda: mb.simulate(dyn, q, v, 1e-3, dt=1e-3, torque=tau), number=calls, repeat=rounds)
    run = min(times) / calls * 1e6
    print(f"{label:30} step {mine:7.2f} µs  mj_step {theirs:7.2f} µs  × {ratio:.2f}  simulate {run:.0f} µs")
    return {"model": label, "step_us": mine, "mj_step_us": theirs, "ratio": ratio, "simulate_us": run}


#: See `validation.smoke`.
SMOKE = {
    "MODELS": {"two links": mb.catalog.double_pendulum},
    "BODIES": ("two links",),
    "ROUNDS": 1,
    "CALLS": 1,
    "FRESH": 1,
    "FEWER": (1, 1),
    "REPEATS": (1, 1),
}


def main():
    path = results("single_calls.json")
    if sys.argv[1:] == ["bodies"]:
        whole = json.loads(path.read_text(encoding="utf-8"))
        path.write_text(
            json.dumps(whole | {"bodies": {"rows": body_rows(), **stamp(__file__)}}, indent=1), encoding="utf-8"
        )
        return
    rows, own_rows, steps = [], [], []
    for label, make in MODELS.items():
        model = make()
        dyn = mb.dynamics(model, "pinocchio")
        m = dyn.pin_model
        rng = np.random.default_rng(0)
        q, v = model.random_state(rng)
        a = rng.standard_normal(model.nv)
        for engine, kept in ((dyn, rows), (mb.dynamics(model, "lagrangian"), own_rows)):
            for name, ours, bare in calls(engine, m, m.createData(), model, q, v, a):
                mine, theirs, ratio = pair(ours, bare, ROUNDS, CALLS)
                kept.append({"model": label, "call": name, "mbkit_us": mine, "bare_us": theirs, "ratio": ratio})
                print(
                    f"{label:30} {engine.engine:10} {name:18} {mine:7.2f} µs  bare {theirs:7.2f} µs  "
                    f"+ {mine - theirs:5.2f} µs  × {ratio:.2f}"
                )
        steps.append(step_row(label, model, q, v, a))
    imports = import_seconds()
    print(f"import mbkit {imports['mbkit']:.3f} s (numpy alone {imports['numpy']:.3f} s)")
    bodies = {"rows": body_rows(), **stamp(__file__)}
    whole = {"rows": rows, "own": own_rows, "steps": steps, "import_s": imports, "bodies": bodies, **stamp(__file__)}
    path.write_text(json.dumps(whole, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
