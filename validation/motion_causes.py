"""Twenty pairs of files with drawn faults: are the true causes named, and is their effect on the motion right?

Each pair is a robot as an MJCF with servos, and the same text with one to three faults, changed as XML. The truth is
bare ``mj_step`` on the texts, with one fault alone and with all but one; no code of mbkit's runs in it.

``python -m validation.motion_causes`` writes ``motion_causes.json``.
"""

from __future__ import annotations

import copy
import json
import math
import sys
import tempfile
import time
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

import mbkit as mb
from mbkit.engines.mujoco.mjcf_writer import mjcf_text
from mbkit.studies.explain import Motion, Servo, Settings, file_settings
from validation.stamp import results, stamp

#: Name in example-robot-data, and whether the base floats.
ROBOTS = {
    "ur5": False,
    "panda": False,
    "kinova": False,
    "z1_description/z1": False,
    "talos_data/talos_left_arm": False,
    "double_pendulum_description/double_pendulum": False,
    "anymal_b_simple_description/anymal": True,
    "hyq_description/hyq_no_sensors": True,
    "solo_description/solo12": True,
    "talos_data/talos_reduced": True,
}
TIMES = (0.1, 1.0, 5.0)
PERIOD = 1e-2
PAIRS = 20
SMOKE = {"ROBOTS": {"double_pendulum_description/double_pendulum": False}, "TIMES": (0.02, 0.1), "PAIRS": 2}
Edit = Callable[[ET.Element, np.random.Generator], str]


def text_of(name: str, floating: bool) -> str:
    """Return a robot as an MJCF with a position servo on each joint."""
    model = mb.load(name, floating_base=floating)
    felt = 1.0 / np.diag(np.linalg.inv(mb.dynamics(model, "lagrangian", compile=False).mass_matrix(model.neutral())))
    servos = tuple(
        Servo(
            j.name,
            "position",
            400 * float(felt[model.layout.v[j.name]][0]),
            40 * float(felt[model.layout.v[j.name]][0]),
        )
        for j in model.independent_joints
        if j.type.nv == 1
    )
    settings = Settings(
        "mujoco",
        "mujoco_implicitfast",
        2e-3,
        True,
        "newton",
        100,
        1e-8,
        limits=False,
        servos=servos,
        control_period=PERIOD,
    )
    return mjcf_text(model, "a pair", settings)


def joints(root: ET.Element) -> list[ET.Element]:
    """Return the joints of one coordinate that no equality binds."""
    bound = {e.get(k) for e in root.iter("joint") for k in ("joint1", "joint2")}
    return [
        j
        for j in root.find("worldbody").iter("joint")
        if j.get("type") in ("hinge", "slide") and j.get("name") not in bound
    ]  # type: ignore[union-attr]


def numbers(element: ET.Element, name: str, change: Callable[[np.ndarray], Any], default: str = "0") -> None:
    """Change the numbers of an attribute."""
    new = np.atleast_1d(change(np.array(element.get(name, default).split(), dtype=float)))
    element.set(name, " ".join(repr(float(x)) for x in new))


def quaternion_product(a: Any, b: Any) -> np.ndarray:
    """Return the product of two quaternions, w first, of unit length."""
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.array(a, dtype=float), np.array(b, dtype=float) / np.linalg.norm(b))
    return out


def of_joint(name: str, change: Callable[[np.ndarray], Any], kind: str) -> Edit:
    """Return a fault in a number of one joint."""

    def edit(root: ET.Element, rng: np.random.Generator) -> str:
        some = joints(root)
        numbers(some[rng.integers(len(some))], name, change)
        return kind

    return edit


def of_body(name: str, change: Callable[[np.ndarray], Any], kind: str) -> Edit:
    """Return a fault in a number of the heavier half of the bodies that move."""

    def edit(root: ET.Element, rng: np.random.Generator) -> str:
        some = [b.find("inertial") for b in root.find("worldbody").iter("body") if b.find("joint") is not None]  # type: ignore[union-attr]
        heavy = sorted((x for x in some if x is not None), key=lambda x: -float(x.get("mass", "0")))
        numbers(heavy[rng.integers((len(heavy) + 1) // 2)], name, change)
        return kind

    return edit


def of_option(name: str, change: Callable[[str], str], kind: str) -> Edit:
    """Return a fault in an option."""

    def edit(root: ET.Element, _: np.random.Generator) -> str:
        option = root.find("option")
        assert option is not None
        option.set(name, change(option.get(name, "")))
        return kind

    return edit


def kp(root: ET.Element, rng: np.random.Generator) -> str:
    """A servo's kp is another."""
    some = root.findall("actuator/general")
    one = some[rng.integers(len(some))]
    numbers(one, "gainprm", lambda x: 1.2 * x)
    numbers(one, "biasprm", lambda x: x * np.array([1.0, 1.2, 1.0]))
    return "servo kp"


def force_range(root: ET.Element, rng: np.random.Generator) -> str:
    """A servo's force is bounded."""
    some = root.findall("actuator/general")
    one = some[rng.integers(len(some))]
    bound = 0.02 * float(one.get("gainprm", "1").split()[0])
    one.set("forcelimited", "true")
    one.set("forcerange", f"{-bound!r} {bound!r}")
    return "force range"


def order(root: ET.Element, _: np.random.Generator) -> str:
    """Two branches stand in each other's place, and with them their joints in q."""
    for body in root.find("worldbody").iter("body"):  # type: ignore[union-attr]
        children = body.findall("body")
        if len(children) > 1:
            first, second = children[:2]
            i, k = (list(body).index(x) for x in (first, second))
            body[i], body[k] = second, first
            return "joint order"
    raise LookupError


def base_frame(root: ET.Element, _: np.random.Generator) -> str:
    """The frame of a free body is turned by 0.4 rad about z."""
    base = next(
        (
            b
            for b in root.find("worldbody").findall("body")
            if (j := b.find("joint")) is not None and j.get("type") == "free"
        ),
        None,
    )  # type: ignore[union-attr]
    if base is None:
        raise LookupError
    turn = np.array([math.cos(-0.2), 0.0, 0.0, math.sin(-0.2)])
    c, s = math.cos(0.4), math.sin(0.4)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    for part in (*base.findall("inertial"), *base.findall("body"), *base.findall("site")):
        numbers(part, "pos", lambda x: R @ x, "0 0 0")
        if part.get("xyaxes"):
            numbers(part, "xyaxes", lambda x: (R @ x.reshape(2, 3).T).T.ravel())
        else:
            numbers(part, "quat", lambda x: quaternion_product(turn, x), "1 0 0 0")
    return "frame of the free joint"


def mimic(root: ET.Element, _: np.random.Generator) -> str:
    """A mimic joint follows nobody."""
    part = root.find("equality")
    if part is None:
        raise LookupError
    root.remove(part)
    return "coupler"


FAULTS: dict[str, Edit] = {
    "armature": of_joint("armature", lambda x: x + 0.05, "armature"),
    "damping": of_joint("damping", lambda x: x + 0.5, "damping"),
    "friction": of_joint("frictionloss", lambda x: x + 0.3, "friction"),
    "mass": of_body("mass", lambda x: 1.1 * x, "mass"),
    "com": of_body("pos", lambda x: x + np.array([0.01, 0.0, 0.0]), "centre of mass"),
    "inertia": of_body("quat", lambda x: quaternion_product(x, (0.9, 0.3, 0.3, 0.1)), "inertia axes"),
    "axis": of_joint("axis", lambda x: -x, "axis sign"),
    "order": order,
    "gravity": of_option("gravity", lambda _: "0 0 -9.8", "gravity"),
    "time step": of_option("timestep", lambda _: "0.004", "time step"),
    "integrator": of_option("integrator", lambda _: "Euler", "integrator"),
    "kp": kp,
    "force range": force_range,
    "base frame": base_frame,
    "mimic": mimic,
}


#: Faults that few robots can have, in some pairs of these.
OF_FEW = {1: "mimic", 6: "base frame", 11: "mimic", 17: "base frame"}


def bare(text: str, q: dict[str, np.ndarray], v: dict[str, np.ndarray], u: np.ndarray) -> dict[str, np.ndarray]:
    """Return the positions of all joints by name at the times, by MuJoCo alone."""
    m = mujoco.MjModel.from_xml_string(text)
    d = mujoco.MjData(m)
    rows = {
        m.joint(j).name: (int(m.jnt_qposadr[j]), len(m.joint(j).qpos0), int(m.jnt_dofadr[j])) for j in range(m.njnt)
    }
    for name, (i, n, k) in rows.items():
        d.qpos[i : i + n] = q[name]
        d.qvel[k : k + len(v[name])] = v[name]
    by_index = [k for _, _, k in rows.values()]
    assert by_index == sorted(by_index)
    at = {m.actuator(i).name: i for i in range(m.nu)}
    # The controller counts joints as they stand in q; one without a servo gets its number as a torque.
    straight = [(name, k) for name, (_, n, k) in rows.items() if n == 1]
    out: dict[str, list[np.ndarray]] = {name: [] for name in rows}
    for k in range(round(TIMES[-1] / m.opt.timestep) + 1):
        if any(abs(k * m.opt.timestep - t) < 1e-9 for t in TIMES):
            for name, (i, n, _) in rows.items():
                out[name].append(d.qpos[i : i + n].copy())
        for (name, dof), x in zip(straight, u, strict=False):
            if name in at:
                d.ctrl[at[name]] = x
            else:
                d.qfrc_applied[dof] = x
        mujoco.mj_step(m, d)
    return {name: np.array(x) for name, x in out.items()}


def apart(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> list[float]:
    """Return the largest difference of a coordinate at each time; of a turn its rotation vector."""
    worst = np.zeros(len(TIMES))
    for name, x in a.items():
        if name in b:
            y = b[name]
            if x.shape[1] == 7:
                turns = []
                for p, r in zip(x[:, 3:], y[:, 3:], strict=True):
                    back, between, w = np.zeros(4), np.zeros(4), np.zeros(3)
                    mujoco.mju_negQuat(back, p)
                    mujoco.mju_mulQuat(between, back, r)
                    mujoco.mju_quat2Vel(w, between, 1.0)
                    turns.append(w)
                worst = np.maximum(worst, np.abs(np.array(turns)).max(axis=1))
                x, y = x[:, :3], y[:, :3]
            worst = np.maximum(worst, np.abs(x - y).max(axis=1))
    return [float(x) for x in worst]


def pair(number: int, name: str, floating: bool) -> dict[str, Any]:
    """Return what was planted in a pair, what was found, and both effects."""
    rng = np.random.default_rng([7, number])
    text = text_of(name, floating)
    root = ET.fromstring(text)
    changed, planted = copy.deepcopy(root), list[tuple[str, str]]()
    alone = dict[str, str]()
    drawn = [str(x) for x in rng.permutation(list(FAULTS))]
    for fault in dict.fromkeys([*([OF_FEW[number]] if number in OF_FEW else []), *drawn]):
        if len(planted) > number % 3:
            break
        one = copy.deepcopy(root)
        state = rng.bit_generator.state
        try:
            kind = FAULTS[fault](changed, rng)
            rng.bit_generator.state = state
            FAULTS[fault](one, rng)
        except LookupError:
            continue
        alone[kind] = ET.tostring(one, encoding="unicode")
        planted.append((str(fault), kind))
    other = ET.tostring(changed, encoding="unicode")
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / x for x in ("a.xml", "b.xml")]
        for path, content in zip(paths, (text, other), strict=True):
            path.write_text(content, encoding="utf-8")
        began = time.process_time()
        sides = [mb.load(path) for path in paths]
        held = [file_settings(path, m)[0] for path, m in zip(paths, sides, strict=True)]
        q, v = sides[0].neutral(), 0.3 * rng.standard_normal(sides[0].nv)
        first = sides[0]
        u = np.zeros(first.nv)
        for j in first.independent_joints:
            if held[0] is not None and held[0].servo(j.name) is not None:
                u[first.layout.v[j.name]] = 0.3 * rng.choice([-1.0, 1.0])
        motion = Motion(controller=lambda *_: u, q=q, v=v, settings=(held[0], held[1]), times=TIMES)
        found = mb.explain(*sides, motion=motion)
        seconds = time.process_time() - began
    assert found.motion is not None
    layout = first.layout
    full_q, full_v = layout.expand_q(q), layout.expand_v(v)
    start_q = {j.name: full_q[layout.full_q[j.name]] for j in layout.joints}
    start_v = {j.name: full_v[layout.full_v[j.name]] for j in layout.joints}
    for j in (x for x in first.joints if x.type.floating):
        # MuJoCo writes w first; the base begins unturned, so that its velocity is the world's.
        start_q[j.name] = np.r_[start_q[j.name][:3], start_q[j.name][6], start_q[j.name][3:6]]
    controls = np.array([u[layout.v[j.name]][0] for j in first.independent_joints if j.type.nv == 1])
    here, there = bare(text, start_q, start_v, controls), bare(other, start_q, start_v, controls)
    truth = {kind: apart(here, bare(one, start_q, start_v, controls)) for kind, one in alone.items()}
    named = [e.kind for e in found.motion.effects]
    effects = {e.kind: list(e.alone) for e in found.motion.effects}
    return {
        "robot": name,
        "nv": first.nv,
        "planted": [kind for _, kind in planted],
        "named": named,
        "missed": [kind for _, kind in planted if kind not in named],
        "false": [kind for kind in named if kind not in {k for _, k in planted}],
        "whole": [apart(here, there), list(found.motion.whole)],
        "alone": {kind: [truth[kind], effects.get(kind, [])] for kind in truth},
        "unexplained": max(found.motion.unexplained),
        "cpu_s": seconds,
    }


def main() -> None:
    """Make the pairs one after the other."""
    warnings.simplefilter("ignore")
    rows = []
    wanted = [int(x) for x in sys.argv[1:]] or range(PAIRS)
    for number in wanted:
        name = [*ROBOTS][number % len(ROBOTS)]
        rows.append(pair(number, name, ROBOTS[name]))
        print(json.dumps(rows[-1]), flush=True)
    if not sys.argv[1:]:
        out = {"times": TIMES, "pairs": rows, **stamp(__file__)}
        results("motion_causes.json").write_text(json.dumps(out, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
