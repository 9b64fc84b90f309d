"""Error against run time of rollouts: a first look, on one short horizon."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.studies.result import CostPoint, Refusal
from mbkit.studies.rollouts import patience, quiet_simulate, start_state

__all__ = ["costs"]

DURATION: Final = 0.5
_REPEATS: Final = 3
#: Seconds that a run may take; a stiff scene needs other methods than these.
_PATIENCE: Final = 5.0
_REFERENCE_PATIENCE: Final = 10.0
#: (engine, method, steps or tolerances)
_SWEEP: Final = (
    ("pinocchio", "semi_implicit_euler", (1e-2, 3.125e-3, 1e-3, 3.125e-4)),
    ("pinocchio", "rk4", (1e-2, 5e-3, 2.5e-3, 1e-3, 5e-4)),
    ("pinocchio", "dop853", (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    ("lagrangian", "rk4", (1e-2, 5e-3, 2.5e-3, 1e-3, 5e-4)),
    ("lagrangian", "dop853", (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)),
    ("mujoco", "mujoco_euler", (1e-2, 3.125e-3, 1e-3, 3.125e-4, 1e-4)),
    ("mujoco", "mujoco_implicitfast", (1e-2, 3.125e-3, 1e-3, 3.125e-4, 1e-4)),
    ("mujoco", "mujoco_rk4", (1e-2, 5e-3, 2.5e-3, 1e-3, 5e-4, 2.5e-4)),
)


def costs(model: Model, made: Mapping[str, Dynamics], seed: int) -> tuple[tuple[CostPoint, ...], float, list[Refusal]]:
    """Return points of error and run time, and how well the reference is known.

    The reference is DOP853 at 1e-13 on the first engine at hand; its floor is the
    difference to a second engine at 3e-13, so it holds against both sources of
    error. Errors are the largest difference of q on a common grid.
    """
    grid = np.linspace(0.0, DURATION, 6)
    q0, v0 = start_state(model, seed)
    pair = [made[n] for n in ("lagrangian", "pinocchio", "mujoco") if n in made][:2]
    if len(pair) < 2:
        return (), float("nan"), [Refusal("", "error against run time", "a reference takes two engines")]
    try:
        tight = [
            quiet_simulate(
                dyn, q0, v0, DURATION, "dop853", rtol=tol, atol=tol, save=grid, progress=patience(_REFERENCE_PATIENCE)
            )
            for dyn, tol in zip(pair, (1e-13, 3e-13), strict=True)
        ]
    except MbkitError as error:
        return (), float("nan"), [Refusal("", "error against run time", f"no reference: {error}")]
    for run in tight:
        if not run.stats.finished:
            return (), float("nan"), [Refusal(run.engine, "error against run time", run.stats.message)]
    reference = tight[0].q
    floor = float(np.abs(model.difference(reference, tight[1].q)).max())
    points, refusals = [], []
    for engine, method, settings in _SWEEP:
        if engine not in made:
            continue
        for setting in settings:
            try:
                points.append(_point(model, made[engine], method, setting, q0, v0, grid, reference))
            except MbkitError as error:
                refusals.append(Refusal(engine, f"{method}, {setting:g}", str(error).removeprefix(f"{engine}: ")))
                # The settings that follow take longer.
                break
    return tuple(p for p in points if p is not None), floor, refusals


def _point(
    model: Model, dyn: Dynamics, method: str, setting: float, q0: Array, v0: Array, grid: Array, reference: Array
) -> CostPoint | None:
    tolerance = {"rtol": setting, "atol": setting} if method == "dop853" else {}
    step = {} if tolerance else {"dt": setting}
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        run = quiet_simulate(
            dyn, q0, v0, DURATION, method, save=grid, progress=patience(_PATIENCE), **step, **tolerance
        )
        times.append(time.perf_counter() - start)
        if not run.stats.finished:
            # A step too large for the scene has no error to show.
            return None
        if times[0] > 1.0:
            break
    low, median, high = np.percentile(times, [25, 50, 75])
    return CostPoint(
        engine=dyn.engine,
        method=method,
        setting=f"{'tol' if tolerance else 'dt'} {setting:g}",
        error=float(np.abs(model.difference(reference, run.q)).max()),
        seconds=float(median),
        spread=float(high - low) / 2,
        evaluations=run.stats.evaluations,
    )
