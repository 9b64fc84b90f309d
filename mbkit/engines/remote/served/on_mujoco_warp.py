"""MuJoCo Warp of any version from 4.0, on a CPU: terms of a model of MJCF or URDF in MuJoCo's own coordinates.

The parser and the compiler are MuJoCo's; all that is evaluated is in single precision.
"""

from __future__ import annotations

from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from common import run
from on_mujoco import OfMujoco, body_of, built, integrator, smooth

__all__ = ["Engine", "built"]
wp.config.quiet = True


def put(m: Any) -> Any:
    """Return a model as Warp holds it."""
    with wp.ScopedDevice("cpu"):
        return mjw.put_model(m)


class Engine(OfMujoco):  # type: ignore[misc]  # of the file beside
    """A model on Warp, with all off that its smooth dynamics do not need. Each method takes a stack of states."""

    STACKED = True

    def __init__(self, m: Any, acting: bool = False) -> None:
        self._m, self._acting = smooth(m, acting), acting
        # It refuses flags that it has no counterpart of.
        m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self._w = put(m)
        self._gravity = np.array(self._w.opt.gravity.numpy())
        self._data: dict[int, Any] = {}

    def _at(self, q: Any, v: Any = 0.0, gravity: Any = None, tau: Any = 0.0) -> Any:
        n = len(q)
        if n not in self._data:
            with wp.ScopedDevice("cpu"):
                self._data[n] = mjw.make_data(self._m, nworld=n)
        d, shape = self._data[n], (n, self._m.nv)
        d.qpos.assign(q)
        d.qvel.assign(np.zeros(shape) + v)
        d.qfrc_applied.assign(np.zeros(shape) + tau)
        self._w.opt.gravity.assign(self._gravity if gravity is None else np.zeros_like(self._gravity) + gravity)
        return d

    def _placed(self, *state: Any) -> Any:
        d = self._at(*state)
        mjw.fwd_position(self._w, d)
        mjw.fwd_velocity(self._w, d)
        return d

    def _terms(self, *state: Any) -> Any:
        m, d = self._m, self._placed(*state)
        mjw.rne(self._w, d)
        M, passive = np.zeros((*d.qvel.shape, m.nv)), d.qfrc_passive.numpy()
        for i in range(m.nv):
            # Row i of the lower triangle.
            at = slice(m.M_rowadr[i], m.M_rowadr[i] + m.M_rownnz[i])
            columns, values = m.M_colind[at], d.M.numpy()[:, at]
            M[:, i, columns] = values
            M[:, columns, i] = values
        if self._acting:
            mjw.fwd_actuation(self._w, d)
            passive = passive + d.qfrc_actuator.numpy()
        return M, d.qfrc_bias.numpy(), passive, d.xipos.numpy()

    def inverse_dynamics(self, q: Any, v: Any, a: Any) -> Any:
        d = self._at(q, v)
        d.qacc.assign(a)
        mjw.inverse(self._w, d)
        return d.qfrc_inverse.numpy()

    def forward_dynamics(self, q: Any, v: Any, tau: Any) -> Any:
        d = self._at(q, v, tau=tau)
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

    def rollout(self, q: Any, v: Any, tau: Any = None, *, method: str, dt: float, steps: int) -> Any:
        """Return qpos and qvel after each of so many steps; tau is held over each, (n, steps, nv)."""
        opt, d = self._w.opt, self._at(q, v)
        before = opt.integrator, np.array(opt.timestep.numpy())
        opt.integrator = integrator(method)
        opt.timestep.fill_(dt)

        def step(k: int) -> Any:
            if tau is not None:
                d.qfrc_applied.assign(tau[:, k])
            mjw.step(self._w, d)
            return d.qpos.numpy(), d.qvel.numpy()

        out = run(q, v, steps, step)
        opt.integrator = before[0]
        opt.timestep.assign(before[1])
        return out
