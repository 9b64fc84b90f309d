"""MuJoCo of any version from 3.1: terms of a model of MJCF or URDF in MuJoCo's own coordinates."""

from __future__ import annotations

import mujoco
import numpy as np

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

VERSION = mujoco.__version__
_OFF = (
    *("CONTACT", "LIMIT", "FRICTIONLOSS", "EQUALITY", "CONSTRAINT", "ACTUATION", "SENSOR"),
    *("EULERDAMP", "AUTORESET", "WARMSTART", "ISLAND"),
)


def built(data: dict[str, Any]) -> Any:
    """Return the model of an MJCF that mbkit wrote."""
    return mujoco.MjModel.from_xml_string(data["text"])


def smooth(m: Any, acting: bool = False) -> Any:
    """Return a model with all off that its smooth dynamics do not need; actuators may stay `acting`."""
    for name in _OFF:
        if acting and name == "ACTUATION":
            continue
        m.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, "mjDSBL_" + name, 0))
    m.opt.jacobian = int(mujoco.mjtJacobian.mjJAC_DENSE)
    return m


def places(m: Any) -> dict[str, Any]:
    """Return the places of each joint's numbers in qpos and qvel."""
    out = {}
    for j in range(m.njnt):
        nq, nv = {0: (7, 6), 1: (4, 3)}.get(_plain(m.jnt_type[j]), (1, 1))
        q, v = _plain(m.jnt_qposadr[j]), _plain(m.jnt_dofadr[j])
        name = mujoco.mj_id2name(m, mujoco.mjtObj.mjOBJ_JOINT, j) or f"joint {j}"
        out[name] = [[*range(q, q + nq)], [*range(v, v + nv)]]
    return out


def body_of(m: Any, name: str) -> Any:
    """Return the number of a body."""
    k = mujoco.mj_name2id(m, mujoco.mjtObj.mjOBJ_BODY, name)
    if k < 0:
        raise ValueError(f"no body {name!r}")
    return k


def _plain(number: Any) -> int:
    return int(np.ravel(number)[0])


class Engine:
    """A compiled model, with all off that its smooth dynamics do not need."""

    def __init__(self, m: Any) -> None:
        self._m, self._d = smooth(m), mujoco.MjData(m)
        # Older ones compute no energy without it.
        m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)

    def joints(self) -> dict[str, Any]:
        return places(self._m)

    def _set(self, q: Any, v: Any = None) -> Any:
        d = self._d
        d.qpos[:] = q
        d.qvel[:] = 0.0 if v is None else v
        mujoco.mj_fwdPosition(self._m, d)
        mujoco.mj_fwdVelocity(self._m, d)
        return d

    def mass_matrix(self, q: Any) -> Any:
        d, out = self._set(q), np.zeros((self._m.nv, self._m.nv))
        try:
            mujoco.mj_fullM(self._m, d, out)
        except TypeError:
            # Older ones take the entries of the sparse matrix.
            mujoco.mj_fullM(self._m, out, d.qM)
        return out

    def gravity(self, q: Any) -> Any:
        return np.array(self._set(q).qfrc_bias)

    def nle(self, q: Any, v: Any) -> Any:
        return np.array(self._set(q, v).qfrc_bias)

    def coriolis_force(self, q: Any, v: Any) -> Any:
        # Without gravity, so that nothing cancels.
        before = np.array(self._m.opt.gravity)
        self._m.opt.gravity[:] = 0.0
        try:
            return self.nle(q, v)
        finally:
            self._m.opt.gravity[:] = before

    def passive(self, q: Any, v: Any) -> Any:
        return np.array(self._set(q, v).qfrc_passive)

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        self._d.qpos[:], self._d.qvel[:], self._d.qacc[:] = q, v, a
        mujoco.mj_inverse(self._m, self._d)
        return np.array(self._d.qfrc_inverse)

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        self._d.qpos[:], self._d.qvel[:], self._d.qfrc_applied[:] = q, v, tau
        mujoco.mj_forward(self._m, self._d)
        self._d.qfrc_applied[:] = 0.0
        return np.array(self._d.qacc)

    def kinetic_energy(self, q: Any, v: Any) -> Any:
        mujoco.mj_energyVel(self._m, self._set(q, v))
        return self._d.energy[1]

    def potential_energy(self, q: Any) -> Any:
        mujoco.mj_energyPos(self._m, self._set(q))
        return self._d.energy[0]

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        d, k = self._set(q), body_of(self._m, body)
        linear, angular = np.zeros((3, self._m.nv)), np.zeros((3, self._m.nv))
        mujoco.mj_jacBody(self._m, d, linear, angular, k)
        return [np.array(d.xmat[k]).reshape(3, 3), np.array(d.xpos[k]), linear, angular]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves and stands, kg, and its centre of mass, m."""
        d, masses = self._set(q), np.array(self._m.body_mass)
        return [masses.sum(), masses @ np.array(d.xipos) / masses.sum()]

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return qpos and qvel after each of so many steps; tau is held over each, (steps, nv)."""
        m = self._m
        before = m.opt.integrator, m.opt.timestep
        m.opt.integrator, m.opt.timestep = int(getattr(mujoco.mjtIntegrator, "mjINT_" + method.upper())), dt
        d = mujoco.MjData(m)
        d.qpos[:], d.qvel[:] = q, v
        out_q, out_v = [np.array(q)], [np.array(v)]
        for k in range(steps):
            d.qfrc_applied[:] = 0.0 if tau is None else tau[k]
            mujoco.mj_step(m, d)
            out_q.append(np.array(d.qpos))
            out_v.append(np.array(d.qvel))
        m.opt.integrator, m.opt.timestep = before
        return [np.array(out_q), np.array(out_v)]
