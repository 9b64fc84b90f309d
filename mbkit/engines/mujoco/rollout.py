"""Native rollouts: MuJoCo's own integrators over whole trajectories and batches."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import mujoco
import mujoco.rollout
import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit._child_process import cores
from mbkit._warn import warn
from mbkit.engines.mujoco.model import MujocoModel, heard_warnings
from mbkit.errors import DoubtfulRunWarning, UnsupportedError, require_known
from mbkit.model import Model

# All but RK4 are of first order. "euler" takes damping as it is, because the description is built with MuJoCo's
# implicit damping off; the three implicit ones take it at the step's end, "discrete" springs too: stable at any
# stiffness, by damping what the step cannot resolve. "implicit" has the derivatives of all velocity terms, and damps
# whatever turns; "implicitfast" and "discrete" have them for free bodies only.
INTEGRATORS: Final = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
_STATE: Final = mujoco.mjtState.mjSTATE_FULLPHYSICS
_SINGULAR: Final = int(mujoco.mjtWarning.mjWARN_INERTIA)
_FORCE: Final = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
# MuJoCo's code cannot be interrupted: it is left this often, s, for signals and progress. States do not depend on it.
_SIGNAL_PERIOD: Final = 0.1


def rollout(
    description: Model,
    compiled: MujocoModel,
    integrator: str,
    q0: Array,
    v0: Array,
    dt: float,
    tau: Array | None,
    steps: int,
    progress: Callable[[float], object] | None = None,
) -> tuple[Array, Array]:
    """Integrate one state or a batch on all cores, with options of the compiled model; see `MujocoDynamics.rollout`."""
    m = compiled.model
    require_known("integrator of MuJoCo", INTEGRATORS, integrator)
    m.opt.integrator, m.opt.timestep = INTEGRATORS[integrator], dt
    single = q0.ndim == 1
    q0, v0 = np.atleast_2d(q0), np.atleast_2d(v0)
    n, end_q = len(q0), 1 + m.nq
    if steps and n:
        start = np.zeros((n, mujoco.mj_stateSize(m, _STATE)))
        qpos = start[:, 1:end_q] = q0[:, compiled.q_index]
        start[:, end_q : end_q + m.nv] = _turned(compiled, qpos, v0[:, compiled.v_index])
        control = None if tau is None else _forces(compiled, np.broadcast_to(tau, (n, steps, description.nv)))
        data = [mujoco.MjData(m) for _ in range(max(1, min(n, cores())))]
        # A divergence is read off the states themselves.
        with heard_warnings():
            states = _run(m, data, start, control, steps, progress)
        if any(d.warning.number[_SINGULAR] for d in data):
            reason = "MuJoCo met a mass matrix that is too close to singular, and went on with another one"
            warn(f"{description.name}: {reason}; compare with rk853", DoubtfulRunWarning)
        states[np.logical_not(_alive(states, dt))] = np.nan
        qpos, qvel = states[..., 1:end_q], states[..., end_q : end_q + m.nv]
        q, v = np.empty_like(qpos), np.empty_like(qvel)
        q[..., compiled.q_index], v[..., compiled.v_index] = qpos, _turned(compiled, qpos, qvel, back=True)
    else:
        # Nothing to do, and MuJoCo does not survive an empty batch.
        q, v = (np.repeat(x[:, None], steps + 1, axis=1) for x in (q0, v0))
    return (q[0], v[0]) if single else (q, v)


def _run(
    m: Any, data: list[Any], start: Array, control: Array | None, steps: int, progress: Callable[[float], object] | None
) -> Array:
    """Return the states after 0, 1, ... steps, (N, steps + 1, size)."""
    states = np.empty((len(start), steps + 1, start.shape[1]))
    states[:, 0] = start
    done, count = 0, 16
    while done < steps:
        end = min(done + count, steps)
        part = None if control is None else np.ascontiguousarray(control[:, done:end])
        first = np.ascontiguousarray(states[:, done])
        started = time.perf_counter()
        states[:, done + 1 : end + 1], _ = mujoco.rollout.rollout(
            m, data, first, part, control_spec=_FORCE, nstep=end - done, skip_checks=False
        )
        seconds = time.perf_counter() - started
        count = max(1, int(count * min(16.0, _SIGNAL_PERIOD / max(seconds, 1e-6))))
        done = end
        if progress is not None:
            progress(done / steps)
    return states


def _turned(compiled: MujocoModel, qpos: Array, velocities: Array, back: bool = False) -> Array:
    """Return velocities with those of free joints turned into the world's axes, or back."""
    out = velocities.copy()
    for iq, iv in compiled.free:
        quaternion = np.roll(qpos[..., iq + 3 : iq + 7], -1, axis=-1)
        turn = spatial.conjugate(quaternion) if back else quaternion
        out[..., iv : iv + 3] = spatial.rotate(turn, out[..., iv : iv + 3])
    return out


def _forces(compiled: MujocoModel, tau: Array) -> Array:
    out = tau[..., compiled.v_index]
    if any(out[..., iv : iv + 3].any() for _, iv in compiled.free):
        raise UnsupportedError(
            "mujoco: native rollouts hold a force on a free joint in world axes, mbkit in body axes; "
            "use method='rk4' or 'semi_implicit_euler' on this engine"
        )
    return out


def _alive(states: Array, dt: float) -> Array:
    # A diverged rollout may be restarted or stand still: time must advance by one step each, and everything before must
    # have been finite.
    steps = np.arange(states.shape[1])
    good = np.isfinite(states).all(axis=-1) & (np.abs(states[..., 0] - steps * dt) < 0.5 * dt)
    return np.asarray(np.logical_and.accumulate(good, axis=1))
