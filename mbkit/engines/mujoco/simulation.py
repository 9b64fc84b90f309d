"""MuJoCo's own simulation of a description: settings of an MJCF, and runs by bare `mj_step` with them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.engines.mujoco.constraints import Softness, limit_softness
from mbkit.engines.mujoco.engine import INTEGRATORS, _turned
from mbkit.engines.mujoco.mjcf_writer import mjcf_text
from mbkit.engines.mujoco.model import heard_warnings, mapped, specified
from mbkit.methods.simulation_settings import Servo, Settings
from mbkit.model import Model

_SOLVERS: Final = {int(getattr(mujoco.mjtSolver, f"mjSOL_{x}")): x.lower() for x in ("PGS", "CG", "NEWTON")}
#: Largest size of a coordinate of a run that goes on.
_MAX_STATE: Final = 1e10
#: Length of the runs by which a file and its description are compared, s, and their starts in parts of the ranges.
_CHECKED_S: Final = 0.1
_STARTS: Final = (0.1, 1.3)
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
    limits = {} if "LIMIT" in off else limit_softness(m, joints)
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
        limit_softness=tuple((j, x.solref, x.solimp) for j, x in limits.items() if x != Softness()),
    )
    return held, left


def _softness(m: Any, *, limits: bool) -> list[str]:
    """Return which constraints have another softness than MuJoCo's own, which a description does not hold."""
    usual, kinds = (
        Softness(),
        {
            "dry friction": (m.dof_solref, m.dof_solimp, m.dof_frictionloss > 0),
            "equality constraints": (m.eq_solref, m.eq_solimp, m.eq_active0.astype(bool)),
        },
    )
    other = {x: np.any(r[on] != usual.solref) or np.any(i[on] != usual.solimp) for x, (r, i, on) in kinds.items()}
    out = [f"the softness of {what}" for what, there in other.items() if there]
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
    name = dict(_driven(m)).get(i)
    joint = None if name is None else m.joint(int(m.actuator_trnid[i, 0]))
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

    def off_the_file(self, text: str, files: dict[str, bytes]) -> float | None:
        """Return how far its runs are from those of a file by `mj_step`, rad or m, contacts off.

        From a start within the joints' limits and from one beyond them, under constant controls: what the file has and
        neither description nor settings hold shows here, whatever it is. None where the file has joints of other names.
        """
        m, other = self._m, mujoco.MjModel.from_xml_string(text, files)
        other.opt.disableflags |= _bit("CONTACT")
        joints, there = [m.joint(j) for j in range(m.njnt)], {other.joint(j).name: j for j in range(other.njnt)}
        if other.nq != m.nq or any(m.jnt_type[x.id] != other.jnt_type[there.get(x.name, -1)] for x in joints):
            return None
        if {x.name for x in joints} != there.keys():
            return None
        pairs = [(x, other.joint(there[x.name])) for x in joints]
        q_at, v_at = np.zeros(m.nq, int), np.zeros(m.nv, int)
        for mine, own in pairs:
            q_at[mine.qposadr[0] :][: len(mine.qpos0)] = own.qposadr[0] + np.arange(len(mine.qpos0))
            v_at[mine.dofadr[0] :][: len(mine.damping)] = own.dofadr[0] + np.arange(len(mine.damping))
        straight = [x for x in joints if len(x.qpos0) == 1]
        bounds = np.array([x.range if m.jnt_limited[x.id] else (-1.0, 1.0) for x in straight]).reshape(-1, 2)
        servos, rng, worst = [x.joint for x in self.settings.servos or ()], np.random.default_rng(0), 0.0
        for size in _STARTS:
            d, e = mujoco.MjData(m), mujoco.MjData(other)
            away = size * rng.uniform(-0.5, 0.5, len(straight)) * np.ptp(bounds, axis=1)
            d.qpos[[x.qposadr[0] for x in straight]] = bounds.mean(axis=1) + away
            d.qvel[:] = 0.3 * rng.standard_normal(m.nv)
            # Beyond the usual ranges of control too.
            d.ctrl[:] = 4.0 * size * rng.standard_normal(m.nu)
            e.qpos[q_at], e.qvel[v_at] = d.qpos, d.qvel
            for i, joint in _driven(other):
                e.ctrl[i] = d.ctrl[servos.index(joint)] if joint in servos else 0.0
            with heard_warnings():
                for _ in range(round(_CHECKED_S / m.opt.timestep)):
                    mujoco.mj_step(m, d)
                    mujoco.mj_step(other, e)
                    worst = max(worst, float(np.abs(d.qpos - e.qpos[q_at]).max(initial=0.0)))
                    if not worst < 1.0:
                        return worst
        return worst


def _driven(m: Any) -> Iterator[tuple[int, str]]:
    """Yield each actuator of one joint, and the joint's name."""
    for i in range(m.nu):
        if int(m.actuator_trntype[i]) == int(mujoco.mjtTrn.mjTRN_JOINT):
            yield i, m.joint(int(m.actuator_trnid[i, 0])).name
