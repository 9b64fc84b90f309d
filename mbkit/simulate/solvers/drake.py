"""Drake's own integrators, with a tolerance. Imported only for a run with one: Drake is an extra."""

from __future__ import annotations

import numpy as np

from mbkit._check import Array
from mbkit.engines.drake.engine import DrakeDynamics, DrakeRun
from mbkit.errors import UnsupportedError
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.runge_kutta import DIVERGED, is_bounded
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result

__all__ = ["run_drake"]


def run_drake(asked: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself, to the times of `save`.

    Steps end on the saved times. Drake has one accuracy, relative to a state of size 1 and above, for which
    `rtol` is taken.
    """
    dyn, torque = asked.dyn, asked.torque
    if not isinstance(dyn, DrakeDynamics) or torque.callable or asked.events:
        raise UnsupportedError(
            f"{asked.method}: takes neither torque functions nor events; use method='rk853' or 'dop853'"
        )
    save, times = asked.told()
    scheme, accuracy = asked.method.removeprefix("drake_"), asked.tolerances.rtol
    members, evaluations = [], 0
    for i, (q, v) in enumerate(zip(asked.q, asked.v, strict=True)):
        member = TrajectoryRecord()
        run = DrakeRun(dyn, scheme, accuracy, asked.start, q, v, asked.report(i))
        _over(member, run, times, frozenset(save.tolist()), torque.of_member(asked.member(i)))
        member.steps, member.rejected = run.steps, run.rejected
        evaluations += run.evaluations
        members.append(member)
    return assemble_result(dyn.model, members, asked.batch, save, evaluations=evaluations)


def _over(member: TrajectoryRecord, run: DrakeRun, times: Array, saved: frozenset[float], force: object) -> None:
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
            if not is_bounded(y[None]).all():
                member.stop("diverged", f"diverged: {DIVERGED}")
                return
        member.reached = t
        if t in saved:
            member.keep(t, y)
