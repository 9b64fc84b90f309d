"""Adaptive runs of one-step methods with an embedded error on the manifold: rk853, rodas5.

Steps do not depend on what is saved or looked for. A state within a step is computed by a shorter step from the same
start, of the same order as the others; no interpolant adds an error of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from mbkit.errors import FunctionError
from mbkit.methods.registry import Tolerances, method_of
from mbkit.methods.tableaus import RosenbrockTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.step_attempts import RosenbrockAttempts, RungeKuttaAttempts, StepAttempts
from mbkit.simulate.solvers.trajectory_record import AcceptedSteps, TrajectoryRecord, assemble_result


def run_embedded(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or a batch of them, each with steps of its own.

    Where the own derivation is compiled and the torque is no function, the steps run as machine code; elsewhere stage
    by stage, by the same formulas. Torques held as an array start a new step at each interval.
    """
    space, stops = Space(problem.dyn.model), problem.stops
    attempts = make_attempts(problem, problem.method, space, problem.tolerances)
    records = [TrajectoryRecord(problem, i, space) for i in range(len(problem.q))]

    def to_end(group: Sequence[TrajectoryRecord], report: Callable[[], None]) -> None:
        for _ in march(attempts, group, stops):
            report()

    run_groups(problem, space, attempts, records, to_end)
    return assemble_result(problem, records, evaluations=attempts.evaluations, jacobians=attempts.jacobians)


def run_groups(
    problem: IntegrationProblem,
    space: Space,
    attempts: StepAttempts,
    records: Sequence[TrajectoryRecord],
    to_end: Callable[[Sequence[TrajectoryRecord], Callable[[], None]], None],
) -> None:
    """Begin as many trajectories as go side by side, and take them to the end by to_end(group, report)."""
    q0, v0 = problem.q, problem.v
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for first in range(0, len(q0), attempts.width):
            part = slice(first, first + attempts.width)
            group = records[part]
            try:
                for record, q, v in zip(group, q0[part], v0[part], strict=True):
                    record.begin(q, v)
                which = range(first, first + len(group))
                attempts.start(which, q0[part], space.to_integrator_velocity(q0[part], v0[part]), problem.start)
                to_end(group, partial(_report, problem, group, first))
            except FunctionError as error:
                # Trajectories run one by one under a torque function.
                member = getattr(error, "member", None)
                group[0 if member is None else member - first].fail(error)
                break


def _report(problem: IntegrationProblem, group: Sequence[TrajectoryRecord], first: int) -> None:
    done = sum(record.reached - problem.start for record in group) / problem.duration
    problem.bar.update((first + done) / len(problem.q))


def make_attempts(problem: IntegrationProblem, method: str, space: Space, tolerances: Tolerances) -> StepAttempts:
    """Return the step attempts of ``"rk853"`` or ``"rodas5"``: machine code where there can be some."""
    stiff = isinstance(method_of(method).formula, RosenbrockTableau)
    in_python = RosenbrockAttempts if stiff else RungeKuttaAttempts
    if _compiles(problem, method):
        # Loads LLVM, which interpreting never needs.
        from mbkit.simulate.solvers.adaptive_compiled import CompiledAttempts

        return CompiledAttempts(problem, space, tolerances, in_python)
    return in_python(problem, space, tolerances)


def _compiles(problem: IntegrationProblem, method: str) -> bool:
    """Return whether there can be machine code of an attempt."""
    dyn, stiff = problem.dyn, isinstance(method_of(method).formula, RosenbrockTableau)
    # A compiled step has one value of the time.
    plain = not problem.torque.callable and not dyn.model.time_parameter
    if not (dyn._derived and plain and dyn.model.nv):
        return False
    # Other engines need no CasADi.
    from mbkit.codegen.backend import has_compiler
    from mbkit.derivation.mass_matrix_solve import factors_written_out
    from mbkit.engines.lagrangian import LagrangianDynamics

    small = not stiff or factors_written_out(dyn.model, compiled=True)
    return isinstance(dyn, LagrangianDynamics) and dyn.compile and small and has_compiler()


def march(
    attempts: StepAttempts, group: Sequence[TrajectoryRecord], stops: Sequence[float], first: int = 0
) -> Iterator[list[tuple[int, AcceptedSteps]]]:
    """Take trajectories to the end, from stop `first` on; yields accepted steps after they are recorded."""
    for k in range(first, len(stops)):
        attempts.hold(k, stops[k])
        while accepted := attempts.advance():
            for place, steps in accepted:
                if not group[place].take(steps, partial(attempts.within, place)) or _ended(attempts, place, group):
                    attempts.drop(place)
            yield accepted


def _ended(attempts: StepAttempts, place: int, group: Sequence[TrajectoryRecord]) -> bool:
    reason = attempts.stuck(place)
    if reason is not None:
        group[place].stop(reason)
    return reason is not None or group[place].crawls()
