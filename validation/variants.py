"""Changed robots beside Pinocchio's own changes, and what a thousand variants cost beside one robot.

Run ``python -m validation.variants``; it takes some minutes. The reference of a locked, loaded or joined robot begins
with the URDF alone: `pinocchio.buildModelFromUrdf`, then `buildReducedModel`, `appendBodyToJoint` or `appendModel`.
mbkit has no part in it but the robots' files and states. M and C v + g of three engines at random states are compared
normwise. Rates are ratios of the minima of calls in turn, on one thread, of the same states.
"""

from __future__ import annotations

import json
import time
import warnings

import numpy as np
import pinocchio as pin

import mbkit as mb
from validation.stamp import stamp

STATES, SIZE, ROUNDS, DT, STEPS = 3, 1000, 40, 1e-3, 100
ENGINES = ("lagrangian", "pinocchio", "mujoco")
#: Robots with few bodies and many, on a free base too.
FREE = ("anymal", "hyq", "solo8", "talos", "g1", "ur5", "iiwa7", "z1", "b1", "go2", "laikago", "a1")
LOAD = pin.Inertia(1.3, np.array([0.1, -0.2, 0.05]), np.diag([0.02, 0.03, 0.025]))
PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.5), np.array([0.1, 0.2, 0.3]))


def robots():
    """Yield name, whether on a free base, and the model, of every robot that loads."""
    for robot in mb.robots():
        if robot.reason is None:
            yield robot.name, False, mb.load(robot.name, mimic="free")
    for name in FREE:
        try:
            yield name, True, mb.load(name, floating_base=True, mimic="free")
        except mb.errors.UnknownNameError:
            continue


def urdf(model, floating):
    if floating:
        return pin.buildModelFromUrdf(model.source, pin.JointModelFreeFlyer(), "root_joint")
    return pin.buildModelFromUrdf(model.source)


def in_order(model, raw, q, v):
    """Return a state in Pinocchio's order, and where our velocities are in it."""
    pin_q, pin_v, order = pin.neutral(raw), np.zeros(raw.nv), []
    for name in model.joint_names:
        joint = raw.joints[raw.getJointId(name)]
        own_q, own_v = q[model.layout.q[name]], v[model.layout.v[name]]
        # An angle without limits has two coordinates there.
        own_q = [np.cos(own_q[0]), np.sin(own_q[0])] if joint.nq == 2 and len(own_q) == 1 else own_q
        pin_q[joint.idx_q : joint.idx_q + joint.nq] = own_q
        pin_v[joint.idx_v : joint.idx_v + joint.nv] = own_v
        order += range(joint.idx_v, joint.idx_v + joint.nv)
    return pin_q, pin_v, order


def apart(model, raw, rng):
    """Return the largest normwise difference of M and of C v + g by engine, or why an engine refuses the model."""
    out = {}
    data = raw.createData()
    for engine in ENGINES:
        worst = 0.0
        try:
            dyn = mb.dynamics(model, engine)
        except mb.errors.MbkitError as error:
            out[engine] = f"{error}"[:160]
            continue
        for _ in range(STATES):
            q, v = model.random_state(rng)
            pin_q, pin_v, order = in_order(model, raw, q, v)
            M = np.triu(pin.crba(raw, data, pin_q))
            M = (M + np.triu(M, 1).T)[np.ix_(order, order)]
            h = pin.nonLinearEffects(raw, data, pin_q, pin_v)[order]
            size = np.linalg.norm(M)
            # Forces may be rounding alone, as of axes through centres of mass.
            worst = max(worst, float(np.linalg.norm(dyn.mass_matrix(q) - M) / size))
            worst = max(worst, float(np.linalg.norm(dyn.nle(q, v) - h) / max(np.linalg.norm(h), size)))
        out[engine] = worst
    return out


def frame_id(raw, name):
    """Return a link's frame, of names that a joint has too."""
    return raw.getFrameId(name, pin.BODY) if raw.existFrame(name, pin.BODY) else raw.getFrameId(name)


def locked(model, raw, rng):
    q, v = model.random_state(rng)
    names = [name for name in model.joint_names[1:] if rng.random() < 0.5][: max(1, model.nv - 1)]
    if not names:
        return None
    reference = pin.buildReducedModel(raw, [raw.getJointId(x) for x in names], in_order(model, raw, q, v)[0])
    return model.lock(names, q), reference


def loaded(model, raw, rng):
    frames = [f for f in model.frames if f.name != "world" and raw.existFrame(f.name)]
    name = frames[int(rng.integers(len(frames)))].name if frames else model.bodies[-1].name
    b = mb.ModelBuilder.of(model)
    b.add_payload("the load", at=name, mass=LOAD.mass, com=LOAD.lever, inertia=LOAD.inertia)
    reference = pin.Model(raw)
    frame = reference.frames[frame_id(reference, name)]
    reference.appendBodyToJoint(frame.parentJoint, LOAD, frame.placement)
    return b.build(), reference


def joined(model, raw, _):
    arm = mb.load("ur5")
    other = pin.buildModelFromUrdf(arm.source)
    for k in range(1, other.njoints):
        other.names[k] = "second_" + other.names[k]
    for f in list(other.frames)[1:]:
        f.name = "second_" + f.name
    name = next(f.name for f in reversed(model.frames or ()) if raw.existFrame(f.name)) if model.frames else None
    name = name or model.bodies[-1].name
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = PLACE.rotation, PLACE.translation
    reference = pin.appendModel(raw, other, frame_id(raw, name), PLACE)
    return mb.join(model, arm, at=name, pose=X, prefix="second_"), reference


def written():
    """Return how far terms are off after each robot, changed in three ways, was written and read back."""
    rows = []
    for name, floating, model in robots():
        b = mb.ModelBuilder.of(model)
        at = (model.frames or model.bodies)[-1].name
        b.add_payload("the load", at=at, mass=LOAD.mass, com=LOAD.lever, inertia=LOAD.inertia)
        b.add_prefix("my_")
        changed = b.build()
        q, _ = changed.random_state(0)
        if changed.nv > 2:
            changed = changed.lock(changed.joint_names[1:3], q)
        for form in ("urdf", "mjcf"):
            row = {"robot": name, "free": floating, "format": form}
            try:
                rows.append(row | {"apart": mb.convert(changed, form).worst})
            except mb.errors.MbkitError as error:
                rows.append(row | {"why": f"{error}"[:200]})
    return rows


def worst(row):
    return max(x for x in row["apart"].values() if not isinstance(x, str))


def judged():
    rows, refused = [], []
    for name, floating, model in robots():
        raw = urdf(model, floating)
        for what in (locked, loaded, joined):
            rng = np.random.default_rng([len(rows), 7])
            try:
                made = what(model, raw, rng)
                if made is not None:
                    rows.append({"robot": name, "free": floating, "change": what.__name__, "apart": apart(*made, rng)})
            except Exception as error:  # a table of what was refused is part of the answer
                refused.append({"robot": name, "free": floating, "change": what.__name__, "why": f"{error}"[:200]})
        print(f"{name:45} {max(map(worst, rows[-3:]), default=0.0):.1e}", flush=True)
    return rows, refused


def accelerations(dyn, q, v):
    dyn.forward_dynamics(q, v, np.zeros_like(v))


def rollouts(dyn, q, v):
    mb.simulate(dyn, q, v, STEPS * DT, "rk4", dt=DT, save=[STEPS * DT])


#: What is timed, and how often.
CALLS = {"forward_dynamics": (accelerations, ROUNDS), "rk4": (rollouts, 5)}


def seconds(call, *arguments):
    start = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - start


def rates():
    rows = []
    spreads = {
        "masses and a payload's mass": {"*.mass": 0.1},
        "all inertial numbers": {"*.inertial": 0.1},
        "masses and dampers": {"*.mass": 0.1, "*.damping": 0.3},
    }
    for label, model in (("ur5", mb.load("ur5")), ("anymal, free base", mb.load("anymal", floating_base=True))):
        b = mb.ModelBuilder.of(model)
        for name in model.joint_names:
            if model.joint(name).type.nv == 1:
                b.set_joint(name, damping=0.5)
        model = b.build()
        plain = mb.dynamics(model, "lagrangian", threads=1)
        q, v = model.random_state(0, SIZE)
        v = 0.1 * v
        for spread_label, spread in spreads.items():
            many = mb.variants(model, spread, size=SIZE, seed=1)
            varied = many.dynamics(threads=1)
            row = {"model": label, "spread": spread_label, "numbers": len(many.values)}
            for what, (call, rounds) in CALLS.items():
                first = seconds(call, varied, q, v)
                call(plain, q, v)
                pairs = [(seconds(call, plain, q, v), seconds(call, varied, q, v)) for _ in range(rounds)]
                one, other = (min(x) for x in zip(*pairs, strict=True))
                row[what] = {"one_s": one, "variants_s": other, "ratio": other / one, "first_call_s": first}
            print(label, spread_label, {k: round(row[k]["ratio"], 2) for k in CALLS}, flush=True)
            rows.append(row)
    return rows


def main():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mb.errors.MbkitWarning)
        rows, refused = judged()
        files = written()
    out = {**stamp(), "judged": rows, "refused": refused, "written": files, "rates": rates()}
    with open("validation/variants.json", "w", encoding="utf-8") as file:
        json.dump(out, file, indent=1)
        file.write("\n")
    print(len(rows), "changes,", len(refused), "refused; worst", max(rows, key=worst))


if __name__ == "__main__":
    main()
