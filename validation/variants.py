"""Changed robots beside Pinocchio's and MuJoCo's own changes, and what a thousand variants cost beside one robot.

Run ``python -m validation.variants``; it takes some minutes. Two references of a locked, loaded, edited or joined robot
begin with the URDF alone. Pinocchio's is `pinocchio.buildModelFromUrdf`, then `buildReducedModel`, `appendBodyToJoint`
or `appendModel`; MuJoCo's is `mujoco.MjSpec`, of which joints are deleted and bodies added, changed or attached. mbkit
has no part in them but the robots' files and states. M and C v + g of three engines at random states are compared
normwise; with MuJoCo's spec the passive forces too. Rates are ratios of the minima of calls in turn, on one thread, of
the same states.
"""

from __future__ import annotations

import json
import time
import warnings
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin

import mbkit as mb
from mbkit.engines.mujoco.mjcf_writer import read_back
from validation.robots import FEW as TWO
from validation.robots import chosen
from validation.stamp import results, stamp

STATES, SIZE, ROUNDS, DT, STEPS = 3, 1000, 40, 1e-3, 100
#: All of them.
ROBOTS = None
ENGINES = ("lagrangian", "pinocchio", "mujoco")
#: Robots with few bodies and many, on a free base too.
FREE = ("anymal", "hyq", "solo8", "talos", "g1", "ur5", "iiwa7", "z1", "b1", "go2", "laikago", "a1")
LOAD = pin.Inertia(1.3, np.array([0.1, -0.2, 0.05]), np.diag([0.02, 0.03, 0.025]))
EYE = np.eye(3)
PLACE = pin.SE3(pin.rpy.rpyToMatrix(0.3, -0.2, 0.5), np.array([0.1, 0.2, 0.3]))


def robots():
    """Yield name, whether on a free base, and the model, of every robot that loads."""
    for robot in chosen(ROBOTS):
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


def spec(model, floating):
    """Return MuJoCo's own reading of a URDF, without its meshes."""
    root = ET.parse(model.source).getroot()
    for link in root.iter("link"):
        for shape in (*link.findall("visual"), *link.findall("collision")):
            link.remove(shape)
    for own in root.findall("mujoco"):
        root.remove(own)
    ET.SubElement(ET.SubElement(root, "mujoco"), "compiler", fusestatic="false", balanceinertia="false")
    out = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    for follows in out.equalities:
        # Mimic joints are free ones here.
        out.delete(follows)
    if floating:
        (base,) = out.worldbody.bodies
        base.add_freejoint(name="root_joint")
    return out


def link_of(model, made, name):
    """Return a link of a spec, of names that may be a fixed joint's, whose frame is that of its child."""
    child = {x.get("name"): x.find("child").get("link") for x in ET.parse(model.source).getroot().findall("joint")}
    found = made.body(name) or made.body(child.get(name, name))
    if found is None:
        raise ValueError(f"MuJoCo has no body {name!r}")
    return found


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


def by_pinocchio(model, raw):
    """Return a function of a state: M and C v + g of Pinocchio's model."""
    data = raw.createData()

    def terms(q, v):
        pin_q, pin_v, order = in_order(model, raw, q, v)
        M = np.triu(pin.crba(raw, data, pin_q))
        M = (M + np.triu(M, 1).T)[np.ix_(order, order)]
        return {"mass_matrix": M, "nle": pin.nonLinearEffects(raw, data, pin_q, pin_v)[order]}

    return terms


def by_mujoco(model, made):
    """Return a function of a state: M, C v + g and the passive forces of a spec's model."""
    raw = made.compile()
    data = mujoco.MjData(raw)
    if raw.nv != model.nv:
        raise ValueError(f"MuJoCo has {raw.nv} velocities of {model.nv}")

    def terms(q, v):
        order, T, rate = [], np.eye(model.nv), np.zeros(model.nv)
        for name in model.joint_names:
            joint, at = raw.joint(name), model.layout.v[name]
            own_q, own_v = q[model.layout.q[name]], v[at]
            if joint.type[0] == mujoco.mjtJoint.mjJNT_FREE:
                # There the quaternion begins with w, and the linear velocity is in world axes.
                x, y, z, w = own_q[3:]
                own_q = np.r_[own_q[:3], w, x, y, z]
                R = pin.Quaternion(w, x, y, z).toRotationMatrix()
                T[at, at][:3, :3], rate[at][:3] = R, R @ np.cross(own_v[3:], own_v[:3])
                own_v = np.r_[R @ own_v[:3], own_v[3:]]
            data.joint(name).qpos[:], data.joint(name).qvel[:] = own_q, own_v
            order += range(joint.dofadr[0], joint.dofadr[0] + len(own_v))
        mujoco.mj_forward(raw, data)
        M = np.zeros((raw.nv, raw.nv))
        mujoco.mj_fullM(raw, data, M)
        M = M[np.ix_(order, order)]
        h = data.qfrc_bias[order] + M @ rate
        return {"mass_matrix": T.T @ M @ T, "nle": T.T @ h, "passive": T.T @ data.qfrc_passive[order]}

    return terms


def apart(model, terms, rng):
    """Return the largest normwise difference of each term of a reference by engine, or why an engine refuses."""
    out = {}
    states = [model.random_state(rng) for _ in range(STATES)]
    for engine in ENGINES:
        try:
            dyn = mb.dynamics(model, engine)
        except mb.errors.MbkitError as error:
            out[engine] = f"{error}"[:160]
            continue
        worst = 0.0
        for q, v in states:
            theirs = terms(q, v)
            size = np.linalg.norm(theirs["mass_matrix"])
            for term, x in theirs.items():
                own = getattr(dyn, term)(*((q,) if term == "mass_matrix" else (q, v)))
                # Forces may be rounding alone, as of axes through centres of mass.
                worst = max(worst, float(np.linalg.norm(own - x) / max(np.linalg.norm(x), size)))
        out[engine] = worst
    return out


def frame_id(raw, name):
    """Return a link's frame, of names that a joint has too."""
    return raw.getFrameId(name, pin.BODY) if raw.existFrame(name, pin.BODY) else raw.getFrameId(name)


# Changes: mbkit's model, and functions that change Pinocchio's model and MuJoCo's spec alike


def locked(model, rng):
    q, v = model.random_state(rng)
    names = [name for name in model.joint_names[1:] if rng.random() < 0.5][: max(1, model.nv - 1)]
    if not names:
        return None

    def reduced(raw):
        return pin.buildReducedModel(raw, [raw.getJointId(x) for x in names], in_order(model, raw, q, v)[0])

    def held(made):
        for name in names:
            joint, at = made.joint(name), q[model.layout.q[name]]
            body, axis, turn = joint.parent, joint.axis / np.linalg.norm(joint.axis), np.zeros(4)
            if joint.type == mujoco.mjtJoint.mjJNT_HINGE:
                mujoco.mju_axisAngle2Quat(turn, axis, at[0])
                mujoco.mju_mulQuat(turn, body.quat.copy(), turn.copy())
                body.quat = turn
            elif joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
                mujoco.mju_rotVecQuat(away := np.zeros(3), axis * at[0], body.quat)
                body.pos = body.pos + away
            else:
                raise ValueError(f"joint {name!r} has several coordinates")
            made.delete(joint)
        return made

    return model.lock(names, q), reduced, held


def loaded(model, rng):
    frames = [f for f in model.frames if f.name != "world"]
    name = frames[int(rng.integers(len(frames)))].name if frames else model.bodies[-1].name
    b = mb.ModelBuilder.of(model)
    b.add_payload("the load", at=name, mass=LOAD.mass, com=LOAD.lever, inertia=LOAD.inertia)

    def appended(raw):
        raw = pin.Model(raw)
        frame = raw.frames[frame_id(raw, name)]
        raw.appendBodyToJoint(frame.parentJoint, LOAD, frame.placement)
        return raw

    def added(made):
        place = {"mass": LOAD.mass, "ipos": LOAD.lever, "inertia": np.diag(LOAD.inertia), "explicitinertial": True}
        link_of(model, made, name).add_body(name="the load", **place)
        return made

    return b.build(), appended, added


def edited(model, rng):
    """Give a link that no other is fixed to, and its joint, other numbers."""
    merged = {f.body for f in model.frames if f.name != f.body}
    moved = [j for j in model.joints if j.type.nv == 1 and j.child not in merged]
    if not moved:
        return None
    joint = moved[int(rng.integers(len(moved)))]
    A = rng.normal(size=(3, 3))
    matter = pin.Inertia(
        float(rng.uniform(0.5, 2)), rng.uniform(-0.1, 0.1, 3), 0.01 * (np.trace(A @ A.T) * EYE - A @ A.T)
    )
    b = mb.ModelBuilder.of(model)
    b.set_body(joint.child, mass=matter.mass, com=matter.lever, inertia=matter.inertia)
    b.set_joint(joint.name, damping=0.7, armature=0.2)

    def other(raw):
        raw = pin.Model(raw)
        k = raw.getJointId(joint.name)
        raw.inertias[k] = matter
        raw.armature[raw.joints[k].idx_v] = 0.2
        return raw

    def changed(made):
        body, own, I = made.body(joint.child), made.joint(joint.name), matter.inertia
        body.mass, body.ipos = matter.mass, matter.lever
        body.fullinertia = [I[0, 0], I[1, 1], I[2, 2], I[0, 1], I[0, 2], I[1, 2]]
        own.damping, own.armature = np.r_[0.7, own.damping[1:]], 0.2
        return made

    return b.build(), other, changed


def joined(model, _):
    arm = mb.load("ur5")
    name = next((f.name for f in reversed(model.frames) if f.name != "world"), model.bodies[-1].name)
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = PLACE.rotation, PLACE.translation

    def appended(raw):
        other = pin.buildModelFromUrdf(arm.source)
        for k in range(1, other.njoints):
            other.names[k] = "second_" + other.names[k]
        for f in list(other.frames)[1:]:
            f.name = "second_" + f.name
        return pin.appendModel(raw, other, frame_id(raw, name), PLACE)

    def attached(made):
        turn = pin.Quaternion(PLACE.rotation)
        frame = link_of(model, made, name).add_frame(pos=PLACE.translation, quat=[turn.w, turn.x, turn.y, turn.z])
        made.attach(spec(arm, False), prefix="second_", frame=frame)
        return made

    return mb.join(model, arm, at=name, pose=X, prefix="second_"), appended, attached


def same_bits(model, text):
    """Return whether MuJoCo makes the same terms, bit for bit, of a text and of the model that mbkit builds there."""
    q, v = model.random_state(1, STATES)
    read, built = read_back(model, text), mb.dynamics(model, "mujoco")
    pairs = [(x.mass_matrix(q), x.nle(q, v), x.passive(q, v)) for x in (read, built)]
    return all(np.array_equal(x, y) for x, y in zip(*pairs, strict=True))


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
                made = mb.convert(changed, form)
                rows.append(
                    row
                    | {"apart": made.worst}
                    | ({"same_bits": same_bits(changed, made.text)} if form == "mjcf" else {})
                )
            except mb.errors.MbkitError as error:
                rows.append(row | {"why": f"{error}"[:200]})
    return rows


def worst(row):
    return max((x for key in REFERENCES for x in row.get(key, {}).values() if not isinstance(x, str)), default=0.0)


def judged():
    rows, refused = [], []
    for name, floating, model in robots():
        for what in (locked, loaded, edited, joined):
            row = {"robot": name, "free": floating, "change": what.__name__}
            rng = np.random.default_rng([len(rows), 7])
            made = what(model, rng)
            if made is None:
                continue
            own, *changes = made
            for (reference, (read, terms)), change in zip(REFERENCES.items(), changes, strict=True):
                try:
                    row[reference] = apart(own, terms(own, change(read(model, floating))), rng)
                except Exception as error:  # a table of what was refused is part of the answer
                    why = " ".join(f"{error}".split())[:200]
                    refused.append({k: row[k] for k in ("robot", "free", "change")} | {"by": reference, "why": why})
            rows.append(row)
        print(f"{name:45} {max(map(worst, rows[-4:]), default=0.0):.1e}", flush=True)
    return rows, refused


#: How each reference reads a URDF, and gives its terms.
REFERENCES = {"pinocchio": (urdf, by_pinocchio), "mujoco": (spec, by_mujoco)}


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


RATED = {"ur5": lambda: mb.load("ur5"), "anymal, free base": lambda: mb.load("anymal", floating_base=True)}


#: Spreads of the numbers that differ between variants.
SPREADS = {
    "masses and a payload's mass": {"*.mass": 0.1},
    "all inertial numbers": {"*.inertial": 0.1},
    "masses and dampers": {"*.mass": 0.1, "*.damping": 0.3},
}


def rates():
    rows = []
    for label, make in RATED.items():
        model = make()
        b = mb.ModelBuilder.of(model)
        for name in model.joint_names:
            if model.joint(name).type.nv == 1:
                b.set_joint(name, damping=0.5)
        model = b.build()
        plain = mb.dynamics(model, "lagrangian", threads=1)
        q, v = model.random_state(0, SIZE)
        v = 0.1 * v
        for spread_label, spread in SPREADS.items():
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


#: See `validation.smoke`.
SMOKE = {
    "ROBOTS": TWO[:1],
    "FREE": (),
    "RATED": {"two links": mb.catalog.double_pendulum},
    "SPREADS": {"masses and dampers": SPREADS["masses and dampers"]},
    "SIZE": 3,
    "ROUNDS": 1,
    "STEPS": 2,
}


def main():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", mb.errors.MbkitWarning)
        rows, refused = judged()
        files = written()
    out = {**stamp(__file__), "judged": rows, "refused": refused, "written": files, "rates": rates()}
    with results("variants.json").open("w", encoding="utf-8") as file:
        json.dump(out, file, indent=1)
        file.write("\n")
    print(len(rows), "changes,", len(refused), "refused; worst", max(rows, key=worst))


if __name__ == "__main__":
    main()
