"""MuJoCo of any version from 3.1: terms of a model of MJCF or URDF in MuJoCo's own coordinates."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from common import center_of, run

METHODS = ("euler", "implicitfast", "rk4")
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


def integrator(method: str) -> int:
    """Return the number of an integrator that MuJoCo and its kin have."""
    if method not in METHODS:
        raise NotImplementedError(f"no integrator {method!r} here; there are {', '.join(METHODS)}")
    return int(getattr(mujoco.mjtIntegrator, "mjINT_" + method.upper()))


class OfMujoco:
    """Quantities of MuJoCo's model ``_m``, on MuJoCo or its kin, at a state or a stack of them.

    ``_terms(q, v, gravity)`` are M, the bias and passive forces, and each body's centre of mass; by default at rest and
    in the model's gravity.
    """

    _m: Any
    _terms: Any

    def joints(self) -> dict[str, Any]:
        return places(self._m)

    def mass_matrix(self, q: Any) -> Any:
        return self._terms(q)[0]

    def gravity(self, q: Any) -> Any:
        return self._terms(q)[1]

    def nle(self, q: Any, v: Any) -> Any:
        return self._terms(q, v)[1]

    def coriolis_force(self, q: Any, v: Any) -> Any:
        # Without gravity, so that nothing cancels.
        return self._terms(q, v, np.zeros(3))[1]

    def passive(self, q: Any, v: Any) -> Any:
        return self._terms(q, v)[2]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves and stands, kg, and its centre of mass, m."""
        return center_of(np.array(self._m.body_mass), self._terms(q)[3])


class Engine(OfMujoco):
    """A compiled model, with all off that its smooth dynamics do not need."""

    def __init__(self, m: Any) -> None:
        self._m, self._d, self._gravity = smooth(m), mujoco.MjData(m), np.array(m.opt.gravity)
        # Older ones compute no energy without it.
        m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)

    def _set(self, q: Any, v: Any = 0.0, gravity: Any = None, tau: Any = 0.0) -> Any:
        d = self._d
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = q, v, tau
        self._m.opt.gravity[:] = self._gravity if gravity is None else gravity
        return d

    def _terms(self, *state: Any) -> Any:
        d, M = self._set(*state), np.zeros((self._m.nv, self._m.nv))
        mujoco.mj_fwdPosition(self._m, d)
        mujoco.mj_fwdVelocity(self._m, d)
        try:
            mujoco.mj_fullM(self._m, d, M)
        except TypeError:
            # Older ones take the entries of the sparse matrix.
            mujoco.mj_fullM(self._m, M, d.qM)
        return [M, *map(np.array, (d.qfrc_bias, d.qfrc_passive, d.xipos))]

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        self._set(q, v).qacc[:] = a
        mujoco.mj_inverse(self._m, self._d)
        return np.array(self._d.qfrc_inverse)

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        mujoco.mj_forward(self._m, self._set(q, v, tau=tau))
        return np.array(self._d.qacc)

    def kinetic_energy(self, q: Any, v: Any) -> Any:
        self._terms(q, v)
        mujoco.mj_energyVel(self._m, self._d)
        return self._d.energy[1]

    def potential_energy(self, q: Any) -> Any:
        self._terms(q)
        mujoco.mj_energyPos(self._m, self._d)
        return self._d.energy[0]

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        self._terms(q)
        d, k = self._d, body_of(self._m, body)
        linear, angular = np.zeros((3, self._m.nv)), np.zeros((3, self._m.nv))
        mujoco.mj_jacBody(self._m, d, linear, angular, k)
        return [np.array(d.xmat[k]).reshape(3, 3), np.array(d.xpos[k]), linear, angular]

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return qpos and qvel after each of so many steps; tau is held over each, (steps, nv)."""
        m, d = self._m, mujoco.MjData(self._m)
        before = m.opt.integrator, m.opt.timestep
        self._set(q)
        m.opt.integrator, m.opt.timestep = int(getattr(mujoco.mjtIntegrator, "mjINT_" + method.upper())), dt
        d.qpos[:], d.qvel[:] = q, v

        def step(k: int) -> Any:
            d.qfrc_applied[:] = 0.0 if tau is None else tau[k]
            mujoco.mj_step(m, d)
            return d.qpos, d.qvel

        out = run(q, v, steps, step)
        m.opt.integrator, m.opt.timestep = before
        return out
