"""Native rollouts: MuJoCo's own integrators over whole trajectories and batches."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, Final

import mujoco
import mujoco.rollout
import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._warn import warn
from mbkit.engines.mujoco.model import MujocoModel, heard_warnings
from mbkit.errors import DoubtfulRunWarning, UnknownNameError, UnsupportedError
from mbkit.model import Model

# All but RK4 are of first order. "euler" takes damping as it is, because the description
# is built with MuJoCo's implicit damping off; the three implicit ones take it at the
# step's end, "discrete" springs too: stable at any stiffness, by damping what the step
# cannot resolve. "implicit" has the derivatives of all velocity terms, and damps whatever
# turns; "implicitfast" and "discrete" have them for free bodies only.
INTEGRATORS: Final = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
_STATE: Final = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SINGULAR: Final = int(mujoco.mjtWarning.mjWARN_INERTIA)
_FORCE: Final = mujoco.mjtState.mjSTATE_QFRC_APPLIED


# MuJoCo's code cannot be interrupted: it is left this often, s, for signals and progress. States do not depend on it.
_PERIOD: Final = 0.1


class Rollout:
    """One call integrates one state or a batch on all cores."""

    def __init__(self, description: Model, maps: MujocoModel, model: Any) -> None:
        self._description, self._maps, self._m = description, maps, model

    def __call__(
        self,
        integrator: str,
        q0: Array,
        v0: Array,
        dt: float,
        tau: Array | None,
        steps: int,
        progress: Callable[[float], object] | None = None,
    ) -> tuple[Array, Array]:
        if integrator not in INTEGRATORS:
            raise UnknownNameError("integrator of MuJoCo", integrator, INTEGRATORS)
        self._m.opt.integrator = INTEGRATORS[integrator]
        self._m.opt.timestep = dt
        single = q0.ndim == 1
        q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
        n = len(q0)
        if not steps or not n:
            # Nothing to do, and MuJoCo does not survive an empty batch.
            q, v = (np.repeat(x[:, None], steps + 1, axis=1) for x in (q0, v0))
            return (q[0], v[0]) if single else (q, v)
        start = np.zeros((n, mujoco.mj_stateSize(self._m, _STATE)))
        nq = self._m.nq
        start[:, 1 : 1 + nq] = q0[:, self._maps.q_index]
        start[:, 1 + nq : 1 + nq + self._m.nv] = self._velocity_in(q0, v0)
        control = None if tau is None else self._forces(tau, n, steps)
        threads = max(1, min(n, os.cpu_count() or 1))
        data = [mujoco.MjData(self._m) for _ in range(threads)]
        # A divergence is read off the states themselves.
        with heard_warnings():
            states = self._run(data, start, control, steps, progress)
        if any(d.warning.number[_SINGULAR] for d in data):
            reason = "MuJoCo met a mass matrix that is too close to singular, and went on with another one"
            warn(f"{self._description.name}: {reason}; compare with rk853", DoubtfulRunWarning)
        states[np.logical_not(self._alive(states, dt))] = np.nan
        q, v = self._read(states[..., 1 : 1 + nq], states[..., 1 + nq : 1 + nq + self._m.nv])
        return (q[0], v[0]) if single else (q, v)

    def _run(
        self,
        data: list[Any],
        start: Array,
        control: Array | None,
        steps: int,
        progress: Callable[[float], object] | None,
    ) -> Array:
        """Return the states after 0, 1, ... steps, (N, steps + 1, size)."""
        states = np.empty((len(start), steps + 1, start.shape[1]))
        states[:, 0] = start
        done, count = 0, 16
        while done < steps:
            end = min(done + count, steps)
            part = None if control is None else np.ascontiguousarray(control[:, done:end])
            started = time.perf_counter()
            states[:, done + 1 : end + 1], _ = mujoco.rollout.rollout(
                self._m,
                data,
                np.ascontiguousarray(states[:, done]),
                part,
                control_spec=int(_FORCE),
                nstep=end - done,
                skip_checks=False,
            )
            seconds = time.perf_counter() - started
            count = max(1, int(count * min(16.0, _PERIOD / max(seconds, 1e-6))))
            done = end
            if progress is not None:
                progress(done / steps)
        return states

    def _velocity_in(self, q: Array, v: Array) -> Array:
        out = v[:, self._maps.v_index].copy()
        for iq, iv in self._maps.free:
            quaternion = q[:, self._maps.q_index[iq + 3 : iq + 7]][:, [1, 2, 3, 0]]
            out[:, iv : iv + 3] = spatial.rotate(quaternion, out[:, iv : iv + 3])
        return np.asarray(out)

    def _forces(self, tau: Array, n: int, steps: int) -> Array:
        out = np.broadcast_to(tau, (n, steps, self._description.nv))[..., self._maps.v_index].copy()
        for _, iv in self._maps.free:
            if out[..., iv : iv + 3].any():
                raise UnsupportedError(
                    "mujoco: native rollouts hold a force on a free joint in world axes, mbkit in body axes; "
                    "use method='rk4' or 'semi_implicit_euler' on this engine"
                )
        return out

    @staticmethod
    def _alive(states: Array, dt: float) -> Array:
        # A diverged rollout may be restarted or stand still: time must advance by
        # one step each, and everything before must have been finite.
        steps = np.arange(states.shape[1])
        good = np.isfinite(states).all(axis=-1) & (np.abs(states[..., 0] - steps * dt) < 0.5 * dt)
        return np.asarray(np.logical_and.accumulate(good, axis=1))

    def _read(self, qpos: Array, qvel: Array) -> tuple[Array, Array]:
        q, v = np.empty_like(qpos), np.empty_like(qvel)
        qvel = qvel.copy()
        for iq, iv in self._maps.free:
            quaternion = qpos[..., iq + 3 : iq + 7][..., [1, 2, 3, 0]]
            qvel[..., iv : iv + 3] = spatial.rotate(spatial.conjugate(quaternion), qvel[..., iv : iv + 3])
        q[..., self._maps.q_index] = qpos
        v[..., self._maps.v_index] = qvel
        return q, v
