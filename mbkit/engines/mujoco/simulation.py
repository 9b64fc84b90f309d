"""MuJoCo's own simulation of a description: settings of an MJCF, and runs by bare `mj_step` with them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines.mujoco.engine import INTEGRATORS, _turned
from mbkit.engines.mujoco.mjcf_writer import mjcf_text
from mbkit.engines.mujoco.model import heard_warnings, mapped, specified
from mbkit.engines.mujoco.settings import Servo, Settings
from mbkit.model import Model

_SOLVERS: Final = {int(getattr(mujoco.mjtSolver, f"mjSOL_{x}")): x.lower() for x in ("PGS", "CG", "NEWTON")}
#: Largest size of a coordinate of a run that goes on.
_MAX_STATE: Final = 1e10
#: Length of the runs by which a file and its description are compared, s.
_CHECKED_S: Final = 0.3
#: Control u(t, q, v), (nv,): what the servo of each velocity takes, or its torque.
Law = Callable[[float, Array, Array], ArrayLike]


def settings_of(text: str, files: dict[str, bytes], joints: set[str]) -> tuple[Settings, list[str]]:
    """Return the settings of an MJCF's text, and what of its simulation they do not hold, as sentences.

    `joints` are the names of the description's joints.
    """
    m = mujoco.MjModel.from_xml_string(text, files)
    off = {x for x in ("LIMIT", "EULERDAMP", "ACTUATION", "CONTACT") if m.opt.disableflags & _bit(x)}
    servos, left = list[Servo](), list[str]()
    if "ACTUATION" in off and m.nu:
        left.append("actuation, which the file has off: controls act as torques")
    for i in range(0 if "ACTUATION" in off else m.nu):
        servo, called = _servo(m, i), f"actuator {m.actuator(i).name or i}"
        if m.opt.disableactuator & (1 << int(m.actuator_group[i])):
            left.append(f"{called}, whose group is off")
        elif servo is None or servo.joint not in joints:
            left.append(f"{called}, which is no motor or servo of one joint")
        elif servo.joint in (x.joint for x in servos):
            left.append(f"{called}, the second one of joint {servo.joint}")
        else:
            servos.append(servo)
    names = {int(x): f"mujoco_{n}" for n, x in INTEGRATORS.items()}
    if m.opt.integrator not in names:
        left.append(f"the integrator {mujoco.mjtIntegrator(m.opt.integrator).name}")
    touching = [g for g in range(m.ngeom) if m.geom_contype[g] or m.geom_conaffinity[g]]
    if touching and "CONTACT" not in off:
        left.append(f"contacts of {len(touching)} shape{'s' * (len(touching) != 1)}")
    if m.opt.density or m.opt.viscosity:
        left.append("forces of a medium")
    left += _softness(m, limits="LIMIT" not in off)
    held = Settings(
        engine="mujoco",
        integrator=names.get(m.opt.integrator, "mujoco_euler"),
        time_step=float(m.opt.timestep),
        implicit_damping="EULERDAMP" not in off,
        solver=_SOLVERS[int(m.opt.solver)],
        iterations=int(m.opt.iterations),
        tolerance=float(m.opt.tolerance),
        limits="LIMIT" not in off,
        servos=tuple(servos),
    )
    return held, left


def _softness(m: Any, *, limits: bool) -> list[str]:
    """Return which constraints have another softness than MuJoCo's own, which a description does not hold."""
    usual = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='1'/></body></worldbody></mujoco>"
    )
    kinds = {
        "joint limits": ("jnt_solref", "jnt_solimp", m.jnt_limited.astype(bool) & limits),
        "dry friction": ("dof_solref", "dof_solimp", m.dof_frictionloss > 0),
        "equality constraints": ("eq_solref", "eq_solimp", m.eq_active0.astype(bool)),
    }
    out = []
    for what, (*names, acts) in kinds.items():
        own = {n: usual.dof_solref if "ref" in n else usual.dof_solimp for n in names}
        if any(np.any(getattr(m, n)[acts] != x[0]) for n, x in own.items()):
            out.append(f"the softness of {what}")
    margin = m.jnt_margin[m.jnt_limited.astype(bool)] if limits else np.zeros(0)
    return [*out, *(["the margin of joint limits"] if margin.any() else [])]


def _bit(name: str) -> int:
    return int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))


def _servo(m: Any, i: int) -> Servo | None:
    """Return an actuator as a motor or a servo of one joint, or None."""
    bias, gain = m.actuator_biasprm[i], float(m.actuator_gainprm[i, 0])
    affine = int(m.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_AFFINE)
    # No zero has a sign.
    kp, kv = (0.0 - float(bias[1]), 0.0 - float(bias[2])) if affine else (0.0, 0.0)
    of_joint = int(m.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT)
    joint = m.joint(int(m.actuator_trnid[i, 0])) if of_joint else None
    simple = (
        int(m.actuator_dyntype[i]) == int(mujoco.mjtDyn.mjDYN_NONE)
        and int(m.actuator_gaintype[i]) == int(mujoco.mjtGain.mjGAIN_FIXED)
        and (affine or int(m.actuator_biastype[i]) == int(mujoco.mjtBias.mjBIAS_NONE))
        and not (affine and bias[0])
    )
    if not simple or joint is None or len(joint.qpos0) != 1:
        return None
    kinds = {
        "position": gain == kp != 0.0,
        "velocity": gain == kv != 0.0 == kp,
        "motor": gain == 1.0 and not (kp or kv),
    }
    kind = next((name for name, holds in kinds.items() if holds), None)
    ranges = (
        tuple(m.actuator_ctrlrange[i].tolist()) if m.actuator_ctrllimited[i] else (-np.inf, np.inf),
        tuple(m.actuator_forcerange[i].tolist()) if m.actuator_forcelimited[i] else (-np.inf, np.inf),
    )
    return None if kind is None else Servo(joint.name, kind, kp, kv, float(m.actuator_gear[i, 0]), *ranges)


class OwnSimulation:
    """Runs of a description by MuJoCo with the settings of a simulation.

    Raises `UnsupportedError` for what an MJCF cannot hold of the description.
    """

    def __init__(self, model: Model, settings: Settings) -> None:
        self.settings, text = settings, mjcf_text(model, "for a run", settings)
        _, placed, _ = specified(model)
        with heard_warnings():
            self._m = mujoco.MjModel.from_xml_string(text)
        self._maps = mapped(self._m, model, placed.joints)
        self._layout = layout = model.layout
        self._servos = [layout.full_v[x.joint].start for x in settings.servos or ()]
        # MuJoCo's coordinates have those of mimic joints, the law's do not.
        free = [j for j in layout.joints if j.mimic is None]
        self._q, self._v = (
            np.concatenate([np.r_[rows[j.name]] for j in free] or [np.empty(0, int)]).astype(int)
            for rows in (layout.full_q, layout.full_v)
        )

    def run(self, q0: Array, v0: Array, law: Law | None, duration: float) -> tuple[Array, Array, Array]:
        """Return times (K,), and the coordinates and velocities of all joints after each step while they are finite."""
        m, d, maps, h = self._m, mujoco.MjData(self._m), self._maps, self._m.opt.timestep
        d.qpos[:] = self._layout.expand_q(q0)[maps.q_index]
        d.qvel[:] = _turned(maps, d.qpos, self._layout.expand_v(v0)[maps.v_index])
        # To the end and beyond, and enough to interpolate.
        steps, period = max(math.ceil(duration / h - 1e-9), 4), self.settings.control_period or h
        states = np.full((steps + 1, m.nq + m.nv), np.nan)
        asked = 0
        with heard_warnings():
            for k in range(steps + 1):
                states[k, : m.nq], states[k, m.nq :] = d.qpos, d.qvel
                # MuJoCo begins again at zero where it diverges.
                if not np.abs(states[k]).max(initial=0.0) < _MAX_STATE or abs(d.time - k * h) > 0.5 * h:
                    states[k:] = np.nan
                    break
                # A sample is due at the first step from its time on.
                if law is not None and k * h >= asked * period - 1e-9 * h:
                    asked += 1
                    q, v = (x[0] for x in self._own(states[k : k + 1]))
                    self._act(d, np.asarray(law(k * h, q[self._q], v[self._v]), dtype=np.float64))
                if k < steps:
                    mujoco.mj_step(m, d)
        good = int(np.isfinite(states).all(axis=1).sum())
        return h * np.arange(good), *self._own(states[:good])

    def _own(self, states: Array) -> tuple[Array, Array]:
        """Return q and v in the description's coordinates, of rows of qpos and qvel."""
        maps, nq = self._maps, self._m.nq
        q, v = np.empty((len(states), nq)), np.empty((len(states), self._m.nv))
        q[:, maps.q_index] = states[:, :nq]
        v[:, maps.v_index] = _turned(maps, states[:, :nq], states[:, nq:], back=True)
        return q, v

    def _act(self, d: Any, u: Array) -> None:
        """Hand a control to the servos, and as a torque to the other joints."""
        full = np.zeros(self._m.nv)
        full[self._v] = u
        d.ctrl[:] = full[self._servos]
        full[self._servos] = 0.0
        d.qfrc_applied[:] = full[self._maps.v_index]


def off_the_file(text: str, files: dict[str, bytes], model: Model, settings: Settings) -> float | None:
    """Return how far a run of a description is from one of its file by `mj_step`, rad or m, contacts off.

    Under constant controls, from a start within the joints' limits and from one beyond some of them. What a file has
    and neither description nor settings hold shows here, whatever it is. None where the file's joints have no names.
    """
    m = mujoco.MjModel.from_xml_string(text, files)
    m.opt.disableflags |= _bit("CONTACT")
    own, layout, rng = OwnSimulation(model, settings), model.layout, np.random.default_rng(0)
    known = {m.joint(j).name: j for j in range(m.njnt)}
    if not all(j.name in known for j in layout.joints if j.type.nv):
        return None
    worst = 0.0
    for size in (0.1, 1.0):
        q, v = model.neutral(), 0.3 * rng.standard_normal(model.nv)
        for j in (x for x in model.independent_joints if x.type.nq == x.type.nv):
            low, high = np.maximum(j.lower, -1.0), np.minimum(j.upper, 1.0)
            q[layout.q[j.name]] = (low + high) / 2 + size * np.abs(high - low) * rng.uniform(-0.6, 0.6)
        controls = {x.joint: 4.0 * size * rng.standard_normal() for x in settings.servos or ()}
        u = np.zeros(model.nv)
        for name, x in controls.items():
            u[layout.v[name]] = x
        _, ours, _ = own.run(q, v, lambda *_, u=u: u, _CHECKED_S)
        d = mujoco.MjData(m)
        full_q, full_v = layout.expand_q(q), layout.expand_v(v)
        places = list[tuple[slice, slice]]()
        for j in (x for x in layout.joints if x.type.nv):
            there = m.joint(known[j.name])
            at, to = int(there.qposadr[0]), int(there.dofadr[0])
            here = np.array(full_q[layout.full_q[j.name]])
            if j.type.quaternion is not None:
                here[j.type.quaternion :] = np.roll(here[j.type.quaternion :], 1)
            places.append((slice(at, at + len(here)), layout.full_q[j.name]))
            d.qpos[at : at + len(here)] = here
            # A free joint begins unturned: its velocity is the world's and the body's.
            d.qvel[to : to + j.type.nv] = full_v[layout.full_v[j.name]]
        for i in range(m.nu):
            target = m.joint(int(m.actuator_trnid[i, 0])).name
            d.ctrl[i] = controls.get(target, 0.0) if int(m.actuator_trntype[i]) == 0 else 0.0
        with heard_warnings():
            for k in range(len(ours)):
                for at_file, at_own in places:
                    x, y = d.qpos[at_file], ours[k, at_own]
                    # The place and the vector part of a quaternion tell enough.
                    n = len(y) if len(y) < 4 else len(y) - 4
                    worst = max(worst, float(np.abs(x[:n] - y[:n]).max(initial=0.0)))
                    if len(y) >= 4:
                        w, z = x[n + 1 : n + 4] * np.sign(x[n]), y[n : n + 3] * np.sign(y[n + 3])
                        worst = max(worst, float(np.abs(w - z).max()))
                if not worst < 1.0:
                    break
                mujoco.mj_step(m, d)
    return worst
