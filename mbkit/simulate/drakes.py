"""Drake's own integrators, with a tolerance."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.drake import DrakeDynamics
from mbkit.engines.drake_run import DrakeRun
from mbkit.errors import InputError, UnsupportedError
from mbkit.simulate.events import Event
from mbkit.simulate.members import Member, check_save, gathered, reporter
from mbkit.simulate.methods import Tolerances
from mbkit.simulate.outcome import Outcome
from mbkit.simulate.progress import Progress
from mbkit.simulate.steps import RAN_AWAY, credible
from mbkit.simulate.torque import Torque

__all__ = ["run_drake"]


def run_drake(
    dyn: Dynamics,
    method: str,
    q0: Array,
    v0: Array,
    duration: float,
    tolerances: Tolerances,
    torque: Torque,
    save: Array | None,
    events: tuple[Event, ...],
    bar: Progress,
) -> Outcome:
    """Integrate one state, or each of a batch by itself, to the times of `save`.

    Steps end on the saved times. Drake has one accuracy, relative to a state of size 1 and above, for which
    `rtol` is taken.
    """
    if not isinstance(dyn, DrakeDynamics) or torque.callable or events:
        raise UnsupportedError(f"{method}: takes neither torque functions nor events; use method='rk853' or 'dop853'")
    batch = None if q0.ndim == 1 else len(q0)
    if save is None:
        raise InputError(
            f"save: {method} does not tell its own steps; give the times to keep, such as [0, {duration:g}]"
        )
    check_save(save, batch, q0.shape[-1] + v0.shape[-1])
    times = np.array([0.0, *sorted({*save.tolist(), duration} - {0.0})])
    members, evaluations = [], 0
    for i, (q, v) in enumerate(zip(np.atleast_2d(q0), np.atleast_2d(v0), strict=True)):
        member = Member()
        run = DrakeRun(
            dyn,
            method.removeprefix("drake_"),
            tolerances.rtol,
            q,
            v,
            reporter(bar, i, len(np.atleast_2d(q0)), duration),
        )
        _over(member, run, times, frozenset(save.tolist()), torque.of_member(None if batch is None else i))
        member.steps, member.rejected = run.steps, run.rejected
        evaluations += run.evaluations
        members.append(member)
    return gathered(dyn.model, members, batch, save, evaluations=evaluations)


def _over(member: Member, run: DrakeRun, times: Array, saved: frozenset[float], force: object) -> None:
    """Take one trajectory through the times, as far as it goes."""
    y = np.concatenate(run.state())
    for k, t in enumerate(times.tolist()):
        if k:
            run.push(np.asarray(force(k - 1)))  # type: ignore[operator]  # of what is held
            try:
                y = np.concatenate(run.over(t))
            except RuntimeError as error:
                told = str(error).strip().splitlines()[0]
                member.stop("step_too_small", f"step below the smallest: stiff, singular or diverging ({told})")
                return
            if not credible(y[None]).all():
                member.stop("diverged", f"diverged: {RAN_AWAY}")
                return
        member.reached = t
        if t in saved:
            member.keep(t, y)
