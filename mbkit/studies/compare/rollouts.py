"""Rollouts: mbkit's integrators on each engine against MuJoCo's own, step for step.

Two right programs round differently in every step, and a system multiplies that, a
chaotic one without bound. So each rollout's condition is measured beside it: how far
q moves when the forces are disturbed in every step, relative to |M||a| + |nle|,
the size at which any backward-stable program rounds them. Over examples from 1 to
1e7 two engines differed by 2 to 125 eps times that number. What may differ is a
multiple of it, and the comparison ends where that would say little.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.registry import DERIVED, MUJOCO, PINOCCHIO
from mbkit.methods.registry import DEFAULT_METHOD, EULER_METHOD, METHODS
from mbkit.model import Model
from mbkit.simulate import Trajectory
from mbkit.studies.compare.result import RolloutRow
from mbkit.studies.study_runs import quiet_simulate, start_state

DURATION: Final = 1.0
STEP: Final = 1e-3
TOLERANCE: Final = 1e-12
_EPS: Final = float(np.finfo(float).eps)
#: Multiples of eps times the condition that two engines may differ by.
_ROUNDINGS: Final = 256.0
#: Beyond this condition a comparison could not see an error below 1e-9.
_CHAOS: Final = 1e-9 / (_ROUNDINGS * _EPS)
_DISTURBANCE: Final = 1e-8
#: Steps below which a rollout says nothing.
_FEWEST: Final = 50
#: MuJoCo's own method of the same formula.
_NATIVE: Final = {m.own: m.name for m in METHODS.values() if m.own}


def rollouts(model: Model, engines: Mapping[str, Dynamics], seed: int, note: str) -> tuple[RolloutRow, ...]:
    """Compare trajectories of 1 s at 1 ms of MuJoCo and other engines, for rk4 and semi-implicit Euler."""
    ours_on = [name for name in (PINOCCHIO, DERIVED) if name in engines]
    if MUJOCO not in engines or not ours_on:
        return ()
    rows = []
    q0, v0 = start_state(model, seed)
    for method in (DEFAULT_METHOD, EULER_METHOD):
        native = _NATIVE[method]
        theirs = quiet_simulate(engines[MUJOCO], q0, v0, DURATION, native, STEP)
        condition = _condition(engines[MUJOCO], engines[ours_on[0]], native, theirs)
        # The last step before the condition says too little.
        last = int(next(iter(np.flatnonzero(condition > _CHAOS)), len(condition))) - 1
        for name in ours_on:
            # One step first: compiling it is not run time.
            quiet_simulate(engines[name], q0, v0, STEP, method, STEP)
            ours = quiet_simulate(engines[name], q0, v0, STEP * last, method, STEP)
            rows.append(_row(model, method, name, native, ours, theirs, condition, last, note))
    if model.needs.damping:
        rows.append(_implicit_damping(model, engines[MUJOCO], q0, v0))
    return tuple(rows)


def _condition(mujoco: Dynamics, own: Dynamics, native: str, straight: Trajectory) -> Array:
    """Return the condition of the rollout up to each step."""
    model, q, v = mujoco.model, straight.q, straight.v
    M, a = own.mass_matrix(q), own.forward_dynamics(q, v, np.zeros(model.nv))
    size = np.einsum("nij,nj->ni", np.abs(M), np.abs(a)) + np.abs(own.nle(q, v))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size[:-1].shape)
    disturbance = _DISTURBANCE * size[:-1] * signs
    for joint in model.independent_joints:
        if joint.type.floating:
            # MuJoCo holds such a force in other axes; the torques disturb enough.
            start = model.layout.v[joint.name].start
            disturbance[:, start : start + 3] = 0.0
    steps = len(disturbance)
    bent, _ = mujoco.rollout(native.removeprefix("mujoco_"), q[0], v[0], STEP, disturbance, steps)  # type: ignore[attr-defined]
    off = np.abs(model.difference(q, np.where(np.isfinite(bent), bent, q))).max(axis=1) / _DISTURBANCE
    off[~np.isfinite(bent).all(axis=1)] = np.inf
    return np.asarray(np.maximum.accumulate(off))


def _row(
    model: Model,
    method: str,
    engine: str,
    native: str,
    ours: Trajectory,
    theirs: Trajectory,
    condition: Array,
    last: int,
    note: str,
) -> RolloutRow:
    n = min(len(ours.t), last + 1)
    grown = float(condition[:n].max(initial=0.0))
    tolerance = max(TOLERANCE, _ROUNDINGS * _EPS * grown)
    error = float(np.abs(model.difference(theirs.q[:n], ours.q[:n])).max()) if n > 1 else 0.0
    notes = [note] if note else []
    if n <= last:
        notes.append(f"stopped at t = {ours.t[-1]:.3g} s: {ours.stats.message}")
    if last < round(DURATION / STEP):
        why = "rounding grows too much" if last + 1 < len(condition) else "MuJoCo's own run diverges"
        notes.append(f"horizon cut to {last * STEP:.3g} s, where {why}")
    judged = last >= _FEWEST
    if not judged:
        notes.append("not judged: too few steps are well conditioned; use a smaller step or a stiff method")
    return RolloutRow(
        method=method,
        engine=engine,
        against=native,
        dt=STEP,
        duration=(n - 1) * STEP,
        error=error,
        condition=grown,
        tolerance=tolerance,
        steps=n - 1,
        seconds=ours.stats.seconds,
        seconds_against=theirs.stats.seconds,
        passed=not judged or (n > last and error <= tolerance),
        note="; ".join(notes),
        judged=judged,
        asked=DURATION,
    )


def _implicit_damping(model: Model, dyn: Dynamics, q0: Array, v0: Array) -> RolloutRow:
    """Compare with MuJoCo's default Euler, whose damping is implicit: another formula."""
    steps = round(DURATION / STEP)
    begun = quiet_simulate(dyn, q0, v0, DURATION, _NATIVE[EULER_METHOD], STEP)
    q, _ = dyn.rollout("euler", q0, v0, STEP, None, steps, euler_damping=True)  # type: ignore[attr-defined]
    n = int(min(len(begun.t), np.isfinite(q).all(axis=1).sum()))
    difference = float(np.abs(model.difference(begun.q[:n], q[:n])).max())
    return RolloutRow(
        method="mujoco_euler, damping explicit",
        engine=MUJOCO,
        against="mujoco_euler, damping implicit (MuJoCo's default)",
        dt=STEP,
        duration=(n - 1) * STEP,
        error=difference,
        condition=float("nan"),
        tolerance=float("inf"),
        steps=n - 1,
        seconds=begun.stats.seconds,
        seconds_against=float("nan"),
        passed=True,
        note="for information: by default MuJoCo solves (M + h D) a = f, a first-order change; mbkit switches that off",
    )
