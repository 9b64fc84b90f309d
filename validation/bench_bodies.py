"""Batches of the quantities of bodies beside a loop over the bare functions of Pinocchio and MuJoCo.

Run ``python -m validation.bench_bodies``; it writes ``validation/bench_bodies.json``. One thread each
side. The engines have no batches of these quantities in Python, so a script loops: over `LOOP` states
here, in turn with the own derivation's batch of `BATCH` states. Least of all rounds, since what else
runs on the machine only adds. The frame is the body at the end of the longest branch.
"""

from __future__ import annotations

import json
import time

import mujoco
import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit.studies.compare.body_terms import farthest
from validation.stamp import results, stamp

ROBOTS = (("ur5", False), ("panda", False), ("anymal_b", True), ("talos", True))
BATCH, LOOP, ROUNDS = 10_000, 400, 9
#: States of a batch whose results are large.
FEW = 1_000
ALIGNED = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED


def own_calls(model):
    """Return name -> call of the own derivation on a batch."""
    dyn, frame = mb.dynamics(model, "lagrangian", threads=1), farthest(model)
    rng = np.random.default_rng(0)
    q, v = model.random_state(rng, BATCH)
    a = rng.standard_normal(v.shape)
    return {
        "pose": lambda: dyn.pose(q, frame),
        "jacobian": lambda: dyn.jacobian(q, frame),
        "velocity": lambda: dyn.velocity(q, v, frame),
        "acceleration": lambda: dyn.acceleration(q, v, a, frame),
        "center_of_mass": lambda: dyn.center_of_mass(q),
        "centroidal_momentum": lambda: dyn.centroidal_momentum(q, v),
        "centroidal_momentum_matrix": lambda: dyn.centroidal_momentum_matrix(q),
        "mass_matrix_inverse": lambda: dyn.mass_matrix_inverse(q),
        "joint_wrenches": lambda: dyn.joint_wrenches(q, v, a),
        "forward_dynamics_derivatives": lambda: dyn.forward_dynamics_derivatives(q[:FEW], v[:FEW], a[:FEW]),
        "regressor": lambda: dyn.regressor(q[:FEW], v[:FEW], a[:FEW]),
    }


def pinocchio_calls(model):
    """Return name -> a call of Pinocchio's function at one state; mimic joints stay free, as it has them."""
    dyn, frame = mb.dynamics(model, "pinocchio"), model.frame(farthest(model))
    m, d = dyn.pin_model, dyn.pin_model.createData()
    joint, X = dyn._in_joint(frame)

    def pose(q, *_):
        pin.forwardKinematics(m, d, q)
        return d.oMi[joint] * X

    def velocity(q, v, _):
        pin.forwardKinematics(m, d, q, v)
        return pin.getFrameVelocity(m, d, joint, X, ALIGNED)

    def acceleration(q, v, a):
        pin.forwardKinematics(m, d, q, v, a)
        return pin.getFrameClassicalAcceleration(m, d, joint, X, ALIGNED)

    return {
        "pose": pose,
        "jacobian": lambda q, *_: pin.computeJointJacobian(m, d, q, joint),
        "velocity": velocity,
        "acceleration": acceleration,
        "center_of_mass": lambda q, *_: pin.centerOfMass(m, d, q),
        "centroidal_momentum": lambda q, v, _: pin.computeCentroidalMomentum(m, d, q, v),
        "centroidal_momentum_matrix": lambda q, v, _: pin.ccrba(m, d, q, v),
        "mass_matrix_inverse": lambda q, *_: pin.computeMinverse(m, d, q),
        "joint_wrenches": lambda q, v, a: pin.rnea(m, d, q, v, a),
        "forward_dynamics_derivatives": lambda q, v, a: pin.computeABADerivatives(m, d, q, v, a),
        "regressor": lambda q, v, a: pin.computeJointTorqueRegressor(m, d, q, v, a),
    }, m


def mujoco_calls(model):
    """Return name -> a call of MuJoCo's functions at one state, which is in its data already."""
    dyn = mb.dynamics(model, "mujoco")
    m, body = dyn.mj_model, dyn._maps.bodies[farthest(model)]
    d = mujoco.MjData(m)
    J, R = np.zeros((6, m.nv)), np.zeros(6)

    def kinematics():
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)

    def jacobian():
        kinematics()
        mujoco.mj_jacBody(m, d, J[:3], J[3:], body)

    def velocity():
        kinematics()
        mujoco.mj_comVel(m, d)
        mujoco.mj_objectVelocity(m, d, mujoco.mjtObj.mjOBJ_XBODY, body, R, 0)

    def momentum():
        kinematics()
        mujoco.mj_comVel(m, d)
        mujoco.mj_subtreeVel(m, d)

    return {
        "pose": lambda: mujoco.mj_kinematics(m, d),
        "jacobian": jacobian,
        "velocity": velocity,
        "center_of_mass": kinematics,
        "centroidal_momentum": momentum,
    }, d


def looped(call, rows):
    """Return ns a state of a loop over rows of arguments."""
    start = time.perf_counter()
    for row in rows:
        call(*row)
    return (time.perf_counter() - start) / len(rows) * 1e9


def measured(name, floating):
    """Return ns a state of each quantity: own derivation, Pinocchio, MuJoCo."""
    model = mb.load(name, floating_base=floating, mimic="free")
    own, (theirs, m), (mujocos, d) = own_calls(model), pinocchio_calls(model), mujoco_calls(model)
    rng = np.random.default_rng(1)
    states = [(pin.randomConfiguration(m), *rng.standard_normal((2, m.nv))) for _ in range(LOOP)]
    positions = [(d.qpos.copy(), rng.standard_normal(len(d.qvel))) for _ in range(LOOP)]
    out = {}
    for quantity, batch in own.items():
        size = FEW if quantity in ("forward_dynamics_derivatives", "regressor") else BATCH
        batch()
        ns = {"lagrangian": [], "pinocchio": [], "mujoco": []}
        for _ in range(ROUNDS):
            start = time.perf_counter()
            batch()
            ns["lagrangian"].append((time.perf_counter() - start) / size * 1e9)
            ns["pinocchio"].append(looped(theirs[quantity], states))
            if quantity in mujocos:

                def call(qpos, qvel, run=mujocos[quantity]):
                    d.qpos[:], d.qvel[:] = qpos, qvel
                    run()

                ns["mujoco"].append(looped(call, positions))
        out[quantity] = {engine: round(min(x), 1) for engine, x in ns.items() if x}
    return {"robot": model.name, "nv": model.nv, "floating": floating, "ns": out}


#: See `validation.smoke`.
SMOKE = {"ROBOTS": (("z1", True),), "BATCH": 3, "LOOP": 2, "ROUNDS": 1, "FEW": 2}


def main():
    found = [measured(*robot) for robot in ROBOTS]
    data = {**stamp(__file__), "batch": BATCH, "robots": found}
    results("bench_bodies.json").write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    for r in found:
        print(f"{r['robot']} ({r['nv']})")
        for quantity, ns in r["ns"].items():
            print(f"  {quantity:28}", "  ".join(f"{engine} {x:,.0f}" for engine, x in ns.items()))


if __name__ == "__main__":
    main()
