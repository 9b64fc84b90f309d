"""Rollouts: mbkit's integrators on each engine against MuJoCo's own, step for step.

Two right programs differ in the last bit of each step, and a chaotic system
multiplies that. So the growth of a small perturbation is measured beside, and the
comparison ends where it would measure chaos and not the engines.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics, dynamics
from mbkit.errors import MbkitError, MbkitWarning
from mbkit.model import Model
from mbkit.simulate import Trajectory, simulate
from mbkit.studies.result import Refusal, RolloutRow

__all__ = ["free_of_mimic", "quiet_simulate", "rollouts", "start_state"]

DURATION: Final = 1.0
STEP: Final = 1e-3
TOLERANCE: Final = 1e-12
# A thousand steps round about a thousand times; what remains of 1e-12 allows the
# perturbations of each to grow about this much.
_GROWTH: Final = 300.0
_NUDGE: Final = 1e-8
_PAIRS: Final = (("rk4", "mujoco_rk4"), ("semi_implicit_euler", "mujoco_euler"))


def free_of_mimic(model: Model) -> Model:
    """Return the model with its mimic joints independent."""
    return replace(model, joints=tuple(replace(j, mimic=None) for j in model.joints))


def start_state(model: Model, seed: int) -> tuple[Array, Array]:
    """Return where rollouts start: a random pose, at half the usual speed."""
    q, v = model.random_state(np.random.default_rng([seed, 1]))
    return q, 0.5 * v


def quiet_simulate(*args: object, **kwargs: object) -> Trajectory:
    """Simulate without the warning of a divergence, which the caller reads from the statistics."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        return simulate(*args, **kwargs)  # type: ignore[arg-type]


def rollouts(model: Model, made: Mapping[str, Dynamics], seed: int) -> tuple[tuple[RolloutRow, ...], list[Refusal]]:
    """Compare trajectories of 1 s at 1 ms, for Runge–Kutta 4 and semi-implicit Euler.

    Mimic joints move freely here, because MuJoCo's own steps know them only as
    soft equalities; the notes say so.
    """
    note = ""
    if model.layout.reduced:
        model = free_of_mimic(model)
        note = "mimic joints free"
        made = {}
    try:
        engines = {name: dynamics(model, name) for name in (*made, "pinocchio", "mujoco")}
    except MbkitError as error:
        return (), [Refusal("mujoco", "rollouts", str(error).removeprefix("mujoco: "))]
    if "lagrangian" not in engines:
        engines["lagrangian"] = dynamics(model, "lagrangian")
    rows = []
    q0, v0 = start_state(model, seed)
    for method, native in _PAIRS:
        theirs = quiet_simulate(engines["mujoco"], q0, v0, DURATION, native, STEP)
        growth = _growth(model, engines["mujoco"], native, theirs, q0, v0)
        last = _safe(growth)
        for name in ("pinocchio", "lagrangian"):
            ours = quiet_simulate(engines[name], q0, v0, STEP * last, method, STEP)
            rows.append(_row(model, method, name, native, ours, theirs, growth, last, note))
    if model.needs.damping:
        rows.append(_implicit_damping(model, engines["mujoco"], q0, v0))
    return tuple(rows), []


def _growth(model: Model, dyn: Dynamics, native: str, straight: Trajectory, q0: Array, v0: Array) -> Array:
    rng = np.random.default_rng(0)
    nudge = rng.standard_normal((2, model.nv))
    nudge *= _NUDGE / np.linalg.norm(nudge)
    bent = quiet_simulate(dyn, model.integrate(q0, nudge[0]), v0 + nudge[1], DURATION, native, STEP)
    n = min(len(bent.t), len(straight.t))
    return np.asarray(np.linalg.norm(model.difference(straight.q[:n], bent.q[:n]), axis=1) / _NUDGE)


def _safe(growth: Array) -> int:
    """Return the last step before perturbations have grown too much."""
    beyond = np.flatnonzero(growth > _GROWTH)
    return int(beyond[0]) - 1 if beyond.size else len(growth) - 1


def _row(
    model: Model,
    method: str,
    engine: str,
    native: str,
    ours: Trajectory,
    theirs: Trajectory,
    growth: Array,
    last: int,
    note: str,
) -> RolloutRow:
    n = min(len(ours.t), last + 1)
    error = float(np.abs(model.difference(theirs.q[:n], ours.q[:n])).max()) if n > 1 else 0.0
    notes = [note] if note else []
    if n <= last:
        notes.append(f"stopped at t = {ours.t[-1]:.3g} s: {ours.stats.message}")
    if last < round(DURATION / STEP):
        why = "perturbations grow beyond" if last + 1 < len(growth) else "MuJoCo diverges"
        notes.append(
            f"horizon cut to {last * STEP:.3g} s, where {why}" + (f" {_GROWTH:.0f} times" if "grow" in why else "")
        )
    return RolloutRow(
        method=method,
        engine=engine,
        against=native,
        dt=STEP,
        duration=(n - 1) * STEP,
        error=error,
        growth=float(growth[:n].max(initial=0.0)),
        tolerance=TOLERANCE,
        steps=n - 1,
        seconds=ours.stats.seconds,
        seconds_against=theirs.stats.seconds,
        passed=n > last and error <= TOLERANCE,
        note="; ".join(notes),
    )


def _implicit_damping(model: Model, dyn: Dynamics, q0: Array, v0: Array) -> RolloutRow:
    """Show what MuJoCo's Euler does by default: damping taken implicitly, another formula."""
    steps = round(DURATION / STEP)
    begun = quiet_simulate(dyn, q0, v0, DURATION, "mujoco_euler", STEP)
    q, _ = dyn.rollout("euler", q0, v0, STEP, None, steps, euler_damping=True)  # type: ignore[attr-defined]
    n = int(min(len(begun.t), np.isfinite(q).all(axis=1).sum()))
    difference = float(np.abs(model.difference(begun.q[:n], q[:n])).max())
    return RolloutRow(
        method="mujoco_euler, damping explicit",
        engine="mujoco",
        against="mujoco_euler, damping implicit (MuJoCo's default)",
        dt=STEP,
        duration=(n - 1) * STEP,
        error=difference,
        growth=float("nan"),
        tolerance=float("inf"),
        steps=n - 1,
        seconds=begun.stats.seconds,
        seconds_against=float("nan"),
        passed=True,
        note="for information: by default MuJoCo solves (M + h D) a = f, a first-order change; mbkit switches that off",
    )
