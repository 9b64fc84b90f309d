"""From one simulator to the other: how far each engine's own integrator is from the exact motion, and why.

``python -m validation.transfer [PART ...]`` writes ``transfer.json``; a part is a robot below, ``steps`` or ``files``.

Each robot falls from a posture within its limits, and is held by a PD controller that samples every 10 ms, as a policy
does. The exact motion is that of the same description under the same samples: rk853 at 1e-13 on the own derivation,
beside Taylor's series at 1e-15. What differs by precision, by the integrator and by the model is told apart:

- precision: an engine in single precision beside MuJoCo's run in double precision with the same formula and step;
- integrator: that run in double precision beside the exact motion;
- model: the exact motion of a changed description beside that of the right one, for each usual change.
"""

from __future__ import annotations

import json
import math
import re
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import mbkit as mb
from mbkit.engines.remote.packages import engine, remote_engines
from validation.stamp import results, stamp

RECORD = Path(__file__).with_name("importers.json")
#: Whether the base floats, and the name in example-robot-data.
ROBOTS = {
    "panda": (False, "panda_description/panda"),
    "anymal": (True, "anymal_b_simple_description/anymal"),
    "hyq": (False, "hyq_description/hyq_no_sensors"),
    "talos": (False, "talos_data/talos_reduced"),
}
TIMES = (0.1, 1.0, 5.0)
HOLD = 1e-2
STEP = 2e-3
#: Bandwidth of the controller, rad/s: kp = w² and kd = 2 w, for each unit of the inertia that a joint feels.
BANDWIDTH = 30.0
#: Talos, whose joints feel each other more, does not stay at its posture with that and these samples.
SLOWER = {"talos": 15.0}
#: Engine, method, and the run in double precision with the same formula.
TWIN = ("mujoco", "mujoco_euler")
RUNS = (
    TWIN,
    ("mujoco", "mujoco_implicitfast"),
    ("mujoco", "mujoco_rk4"),
    ("drake", "drake_sap"),
    ("mjx-single", "mujoco_euler"),
    ("newton", "newton_featherstone"),
    ("mujoco-warp", "mujoco_euler"),
)
#: At the default step alone: a step of Warp on a CPU takes milliseconds.
AT_DEFAULT = ("mujoco-warp",)
#: Engine, method, and the shortest step of its error over the step, s.
STEPS = (
    (*TWIN, 1e-5),
    ("mujoco", "mujoco_rk4", 1e-4),
    ("newton", "newton_featherstone", 1e-4),
    ("mjx-single", "mujoco_euler", 1e-5),
    ("mjx-single", "mujoco_rk4", 2e-5),
)
FALLS = "panda"
Law = Callable[[float, Any, Any], Any]
Runs = dict[str, list[float]]


class Case:
    """A robot, its start, and its controller."""

    def __init__(self, name: str) -> None:
        self.name, (self.floating, self.robot) = name, ROBOTS[name]
        self.model = mb.load(self.robot, mimic="free", floating_base=self.floating).without("friction")
        m, self.first = self.model, 6 if self.floating else 0
        rng = np.random.default_rng(0)
        lower, upper = (np.concatenate([getattr(j, x) for j in m.joints]) for x in ("lower", "upper"))
        low, high = np.maximum(lower, -1.0), np.minimum(upper, 1.0)
        self.q = m.neutral()
        at = slice(m.nq - m.nv + self.first, None)
        self.q[at] = np.clip(self.q, low + 0.1 * (high - low), high - 0.1 * (high - low))[at]
        if self.floating:
            # A frame of the base that is confused with another acts.
            self.q[3:7] = [0.0, 0.0, math.sin(0.5), math.cos(0.5)]
        self.v = 0.5 * rng.standard_normal(m.nv)
        felt = 1.0 / np.diag(np.linalg.inv(mb.dynamics(m, "lagrangian").mass_matrix(self.q)))
        self.felt = felt[self.first :]
        self.target = self.q[at] + 0.3 * rng.choice([-1.0, 1.0], m.nv - self.first)

    def order_of_file(self) -> list[int]:
        """Return the place of each joint of the file, in its order, among the model's."""
        text = next(r.path for r in mb.robots() if r.name == self.robot).read_text(encoding="utf-8")
        own = list(self.model.joint_names)[1 if self.floating else 0 :]
        return [own.index(x) for x in dict.fromkeys(re.findall(r'<joint\s+name="([^"]+)"', text)) if x in own]

    def law(self, order: Any = slice(None)) -> Law:
        """Return the controller; `order` is that in which its targets are read."""
        w, first = SLOWER.get(self.name, BANDWIDTH), self.first
        kp, kd = w**2 * self.felt, 2 * w * self.felt

        def torque(_: float, q: Any, v: Any) -> Any:
            at, out = len(q) - len(v) + first, np.zeros(len(v))
            out[first:] = kp * (self.target[order] - q[at:]) - kd * v[first:]
            return out

        return torque

    def run(self, dyn: Any, law: Law | None, method: str, v: Any = None, **setting: float) -> Any:
        """Return the trajectory at the times."""
        more = {} if law is None else {"torque": law, "hold": HOLD}
        start = self.q, self.v if v is None else v
        return mb.simulate(dyn, *start, TIMES[-1], method, save=[0.0, *TIMES], doubt=False, **more, **setting)

    def exact(self, model: Any, law: Law | None, **start: Any) -> Any:
        return self.run(mb.dynamics(model, "lagrangian"), law, "rk853", rtol=1e-13, **start)


def apart(model: Any, one: Any, other: Any) -> list[float]:
    """Return the largest difference of a coordinate at each of the times; NaN after a run has ended."""
    out = [math.nan] * len(TIMES)
    for k in range(1, min(len(one.t), len(other.t))):
        assert abs(one.t[k] - other.t[k]) < 1e-9
        out[k - 1] = float(np.abs(model.difference(one.q[k], other.q[k])).max())
    return out


def energy(dyn: Any, run: Any) -> list[float]:
    """Return kinetic plus potential energy at the start and the times, J, of the exact model."""
    total = np.full(len(TIMES) + 1, math.nan)
    total[: len(run.t)] = dyn.kinetic_energy(run.q, run.v) + dyn.potential_energy(run.q)
    return [float(x) for x in total]


def truth(case: Case, law: Law | None, row: dict[str, Any]) -> Any:
    """Return the exact motion; fill in how well it is known, and how it multiplies a small error."""
    model, own = case.model, mb.dynamics(case.model, "lagrangian")
    exact = case.exact(model, law)
    other = case.run(own, law, "taylor", rtol=1e-15) if law is None else case.run(own, law, "rk853", rtol=1e-11)
    row["floor"] = apart(model, exact, other)
    nudge = 1e-9 * np.random.default_rng(1).choice([-1.0, 1.0], model.nv)
    row["growth"] = [x / 1e-9 for x in apart(model, exact, case.exact(model, law, v=case.v + nudge))]
    row["moved"] = [float(np.abs(model.difference(case.q, q)).max()) for q in exact.q[1:]]
    row["energy"] = energy(own, exact)
    return exact


def motion(case: Case, law: Law | None, row: dict[str, Any], exact: Any, step: float) -> Iterator[None]:
    """Fill in the runs of every engine at a step; yield after each."""
    model, own, runs = case.model, mb.dynamics(case.model, "lagrangian"), row.setdefault("runs", {})
    twin = case.run(mb.dynamics(model, TWIN[0]), law, TWIN[1], dt=step)
    for name, method in RUNS:
        key = f"{name} {method} {step:g}"
        if name in AT_DEFAULT and step < STEP:
            continue
        try:
            run = twin if (name, method) == TWIN else case.run(mb.dynamics(model, name), law, method, dt=step)
        except mb.errors.MbkitError as error:
            runs[key] = {"refused": str(error)}
            continue
        runs[key] = {"error": apart(model, exact, run), "energy": energy(own, run), "ended": run.stats.message}
        if name in remote_engines():
            runs[key]["precision"] = apart(model, twin, run)
        print(name, method, step, runs[key]["error"], runs[key].get("precision"), flush=True)
        yield


def changed(case: Case) -> dict[str, Any]:
    """Return the changed descriptions by cause."""
    m = case.model
    rotors = iter(0.1 * case.felt)
    joints = tuple(
        j if j.name == "root_joint" else replace(j, armature=np.array([next(rotors) for _ in j.armature]))
        for j in m.joints
    )
    bodies = tuple(replace(b, inertia=1.1 * b.inertia) for b in m.bodies)
    out = {"armature": replace(m, joints=joints), "inertia": replace(m, bodies=bodies)}
    out["gravity"] = replace(m, gravity=np.array([0.0, 0.0, -9.80665]))
    return out | ({"damping": m.without("damping")} if m.needs.damping else {})


def causes(case: Case, law: Law | None, row: dict[str, Any], exact: Any) -> None:
    """Fill in what each cause does to the exact motion."""
    m, found = case.model, row.setdefault("causes", {})
    for cause, model in changed(case).items():
        found[cause] = apart(m, exact, case.exact(model, law))
    order = case.order_of_file()
    if law is not None and order != sorted(order):
        found["joint order"] = apart(m, exact, case.exact(m, case.law(order)))
    if case.floating:
        v = case.v.copy()
        v[3:6] = mb.spatial.matrix_from_quaternion(case.q[3:7]) @ v[3:6]
        found["frame of the base"] = apart(m, exact, case.exact(m, law, v=v))


def files() -> dict[str, Any]:
    """Return on how many robots each cause can act, by what the files say and the importers' record has."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))["robots"]
    every = [r for r in mb.robots() if r.name in record]
    texts = {r.name: r.path.read_text(encoding="utf-8") for r in every}

    def said(pattern: str) -> set[str]:
        return {name for name, text in texts.items() if re.search(pattern, text)}

    def recorded(test: Callable[[dict[str, Any]], bool]) -> set[str]:
        return {name for name, row in record.items() if any(map(test, row.values()))}

    nonzero = r'="0*(\.0*)?[1-9]'
    found = {
        "armature": said("armature|rotor_inertia"),
        "damping": said(r"<dynamics[^>]*damping" + nonzero),
        "friction": said(r"<dynamics[^>]*friction" + nonzero),
        "mimic": said("<mimic"),
        "joint order": recorded(lambda x: any("another order" in y for y in x.get("data", ()))),
        "inertia refused": recorded(lambda x: "inertia" in x.get("why", "")),
        "inertia replaced": recorded(lambda x: any(y["kind"] == "replaced inertia" for y in x.get("causes", ()))),
        "gravity": recorded(lambda x: any(y["kind"] == "gravity" for y in x.get("causes", ()))),
    }
    found["inertia"] = found["inertia refused"] | found["inertia replaced"]
    return {"robots": len(record), **{cause: len(names) for cause, names in found.items()}}


def steps() -> dict[str, Any]:
    """Return errors after 0.3 s of a Panda that falls, over the step, in both precisions."""
    case, out, ends = Case(FALLS), dict[str, list[list[float]]](), [0.0, 0.3]
    own = mb.dynamics(case.model, "lagrangian")
    exact = mb.simulate(own, case.q, case.v, ends[-1], "rk853", rtol=1e-13, save=ends)
    for name, method, least in STEPS:
        dyn = mb.dynamics(case.model, name)
        for step in (x for x in (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5, 2e-5, 1e-5) if x >= least):
            run = mb.simulate(dyn, case.q, case.v, ends[-1], method, dt=step, save=ends, doubt=False)
            out.setdefault(f"{name} {method}", []).append([step, float(np.abs(exact.q[-1] - run.q[-1]).max())])
            print(name, method, out[f"{name} {method}"][-1], flush=True)
    return out


#: Parts that are no robot.
WHOLE: dict[str, Callable[[], Any]] = {"files": files, "steps": steps}


#: See `validation.smoke`.
SMOKE = {
    "ROBOTS": {"two links": (False, "double_pendulum_description/double_pendulum")},
    "TIMES": (0.02, 0.04),
    "RUNS": (TWIN, ("mujoco", "mujoco_rk4"), ("drake", "drake_sap")),
    "STEPS": (("mujoco", "mujoco_rk4", 1e-2),),
    "FALLS": "two links",
}


def main() -> None:
    """Measure the parts one after the other, and write after each run."""
    warnings.simplefilter("ignore")
    wanted = sys.argv[1:] or ["files", *ROBOTS, "steps"]

    def write(part: str, value: Any) -> None:
        # Another process may measure other parts.
        out = results("transfer.json")
        held = json.loads(out.read_text(encoding="utf-8")) if out.exists() else {}
        robots = held.get("robots", {})
        text = {"times": TIMES, "hold": HOLD, "step": STEP, "bandwidth": BANDWIDTH, "slower": SLOWER}
        text |= {"engines": {name: engine(name).version for name in remote_engines()}}
        text |= {x: value if part == x else held.get(x, {}) for x in WHOLE}
        text |= {"robots": robots | ({part: value} if part in ROBOTS else {}), **stamp(__file__)}
        out.write_text(json.dumps(text, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

    kept: dict[str, Any] = {}
    for part in wanted:
        if part in WHOLE:
            write(part, WHOLE[part]())
            continue
        case = Case(part)
        row: dict[str, Any] = {"floating": case.floating, "nv": case.model.nv, "passive": {}, "controlled": {}}
        laws = {"passive": None, "controlled": case.law()}
        exact = {name: truth(case, law, row[name]) for name, law in laws.items()}
        for name, law in laws.items():
            causes(case, law, row[name], exact[name])
        write(part, row)
        kept[part] = case, laws, exact, row
    # All robots at the default step first.
    for step in (STEP, STEP / 10):
        for part, (case, laws, exact, row) in kept.items():
            print(part, flush=True)
            for name, law in laws.items():
                for _ in motion(case, law, row[name], exact[name], step):
                    write(part, row)


if __name__ == "__main__":
    main()
