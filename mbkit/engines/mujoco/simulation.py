"""MuJoCo's own simulation of a description: settings of an MJCF, and runs by bare `mj_step` with them."""

from __future__ import annotations

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
#: Control u(t, q, v), (nv,): what the servo of each velocity takes, or its torque.
Law = Callable[[float, Array, Array], ArrayLike]


def settings_of(text: str, files: dict[str, bytes], joints: set[str]) -> tuple[Settings, list[str]]:
    """Return the settings of an MJCF's text, and what of its simulation they do not hold, as sentences.

    `joints` are the names of the description's joints.
    """
    m = mujoco.MjModel.from_xml_string(text, files)
    off = {x for x in ("LIMIT", "EULERDAMP", "ACTUATION", "CONTACT") if m.opt.disableflags & _bit(x)}
    servos, left = list[Servo](), list[str]()
    for i in range(0 if "ACTUATION" in off else m.nu):
        servo = _servo(m, i)
        if servo is None or servo.joint not in joints:
            left.append(f"actuator {m.actuator(i).name or i}, which is no motor or servo of one joint")
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
        limits=bool(m.jnt_limited.any()) and "LIMIT" not in off,
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
    kp, kv = (-float(bias[1]), -float(bias[2])) if affine else (0.0, 0.0)
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
        steps, period = round(duration / h), self.settings.control_period or h
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
