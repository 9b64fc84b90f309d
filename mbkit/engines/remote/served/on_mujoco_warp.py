"""MuJoCo Warp of any version from 4.0, on a CPU: terms of a model of MJCF or URDF in MuJoCo's own coordinates.

The parser and the compiler are MuJoCo's; all that is evaluated is in single precision.
"""

from __future__ import annotations

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from common import center_of
from on_mujoco import body_of, built, places, smooth

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

__all__ = ["VERSION", "Engine", "built"]
wp.config.quiet = True
VERSION = mjw.__version__
_METHODS = ("euler", "implicitfast", "rk4")


def put(m: Any) -> Any:
    """Return a model as Warp holds it."""
    with wp.ScopedDevice("cpu"):
        return mjw.put_model(m)


class Engine:
    """A model on Warp, with all off that its smooth dynamics do not need. Each method takes a stack of states."""

    STACKED = True

    def __init__(self, m: Any, acting: bool = False) -> None:
        self._m, self._acting = smooth(m, acting), acting
        # It refuses flags that it has no counterpart of.
        m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self._w = put(m)
        self._data: dict[int, Any] = {}

    def joints(self) -> Any:
        """Return the places of each joint's numbers in qpos and qvel."""
        return places(self._m)

    def _at(self, q: Any, v: Any = None) -> Any:
        n = len(q)
        if n not in self._data:
            with wp.ScopedDevice("cpu"):
                self._data[n] = mjw.make_data(self._m, nworld=n)
        d = self._data[n]
        d.qpos.assign(q)
        d.qvel.assign(np.zeros((n, self._m.nv)) if v is None else v)
        d.qfrc_applied.zero_()
        return d

    def _placed(self, q: Any, v: Any = None) -> Any:
        d = self._at(q, v)
        mjw.fwd_position(self._w, d)
        mjw.fwd_velocity(self._w, d)
        return d

    def mass_matrix(self, q: Any) -> Any:
        m, d = self._m, self._placed(q)
        out = np.zeros((len(q), m.nv, m.nv))
        for i in range(m.nv):
            # Row i of the lower triangle.
            at = slice(m.M_rowadr[i], m.M_rowadr[i] + m.M_rownnz[i])
            columns, values = m.M_colind[at], d.M.numpy()[:, at]
            out[:, i, columns] = values
            out[:, columns, i] = values
        return out

    def nle(self, q: Any, v: Any) -> Any:
        d = self._placed(q, v)
        mjw.rne(self._w, d)
        return d.qfrc_bias.numpy()

    def gravity(self, q: Any) -> Any:
        return self.nle(q, np.zeros((len(q), self._m.nv)))

    def coriolis_force(self, q: Any, v: Any) -> Any:
        # Without gravity, so that nothing cancels.
        before = np.array(self._w.opt.gravity.numpy())
        self._w.opt.gravity.zero_()
        try:
            return self.nle(q, v)
        finally:
            self._w.opt.gravity.assign(before)

    def passive(self, q: Any, v: Any) -> Any:
        d = self._placed(q, v)
        if not self._acting:
            return d.qfrc_passive.numpy()
        mjw.fwd_actuation(self._w, d)
        return d.qfrc_passive.numpy() + d.qfrc_actuator.numpy()

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        d = self._at(q, v)
        d.qacc.assign(a)
        mjw.inverse(self._w, d)
        return d.qfrc_inverse.numpy()

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        d = self._at(q, v)
        d.qfrc_applied.assign(tau)
        mjw.forward(self._w, d)
        return d.qacc.numpy()

    def kinetic_energy(self, q: Any, v: Any) -> Any:
        d = self._placed(q, v)
        mjw.energy_vel(self._w, d)
        return d.energy.numpy()[:, 1]

    def potential_energy(self, q: Any) -> Any:
        d = self._placed(q)
        mjw.energy_pos(self._w, d)
        return d.energy.numpy()[:, 0]

    def frame(self, q: Any, body: str) -> Any:
        """Return R_WB, p_WB, and the Jacobians of the body's origin and turning in world axes."""
        d, k, n = self._placed(q), body_of(self._m, body), len(q)
        p = d.xpos.numpy()[:, k]
        rows = [wp.zeros((n, 3, self._m.nv), dtype=float, device="cpu") for _ in range(2)]
        at = wp.array(p, dtype=wp.vec3, device="cpu"), wp.full(n, k, dtype=int, device="cpu")
        mjw.jac(self._w, d, *rows, *at)
        return [d.xmat.numpy()[:, k], p, *(x.numpy() for x in rows)]

    def matter(self, q: Any) -> Any:
        """Return the mass of what moves and stands, kg, and its centre of mass, m."""
        return center_of(np.array(self._m.body_mass), self._placed(q).xipos.numpy())

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return qpos and qvel after each of so many steps; tau is held over each, (n, steps, nv)."""
        if method not in _METHODS:
            raise NotImplementedError(f"no integrator {method!r} here; there are {', '.join(_METHODS)}")
        opt, d = self._w.opt, self._at(q, v)
        before = opt.integrator, np.array(opt.timestep.numpy())
        opt.integrator = int(getattr(mujoco.mjtIntegrator, "mjINT_" + method.upper()))
        opt.timestep.fill_(dt)
        out = [(np.array(q), np.array(v))]
        for k in range(steps):
            if tau is not None:
                d.qfrc_applied.assign(tau[:, k])
            mjw.step(self._w, d)
            # A view of memory that the next step overwrites.
            out.append((np.array(d.qpos.numpy()), np.array(d.qvel.numpy())))
        opt.integrator = before[0]
        opt.timestep.assign(before[1])
        return [np.stack(x, axis=1) for x in zip(*out, strict=True)]
