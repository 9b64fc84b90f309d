"""The adaptive run of a one-step method with an embedded error on the manifold: rk853, rodas5.

Steps do not depend on what is saved or looked for. A state within a step is computed by a shorter step from the same
start, of the same order as the others; no interpolant adds an error of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError
from mbkit.methods.registry import Tolerances, method_of
from mbkit.methods.tableaus import RosenbrockTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.events import Hit, State, Watch
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.step_attempts import AcceptedSteps, RungeKuttaAttempts, StepAttempts
from mbkit.simulate.solvers.trajectory_record import assemble_result, record_of
from mbkit.simulate.solvers.vector_field import DIVERGED, is_bounded
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Torque

_BEYOND: Final = f"diverged: {DIVERGED}"


def run_embedded(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or a batch of them, each with steps of its own.

    Where the own derivation is compiled and the torque is no function, the steps run
    as machine code; elsewhere stage by stage, by the same formulas. Torques held as an
    array start a new step at each interval.
    """
    dyn, tolerances, batch = problem.dyn, problem.tolerances, problem.batch
    q0, v0, space = problem.q, problem.v, Space(problem.dyn.model)
    trials = make_attempts(problem.method, dyn, space, tolerances, problem.torque, problem.duration, batch)
    tracks = [TrajectoryRecorder(problem, space, i) for i in range(len(q0))]
    stops = stop_times(problem)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for first in range(0, len(q0), trials.width):
            part = slice(first, first + trials.width)
            group = tracks[part]
            try:
                for track, q, v in zip(group, q0[part], v0[part], strict=True):
                    track.begin(q, v)
                begun = space.enter(q0[part], v0[part])
                trials.start(range(first, first + len(group)), q0[part], begun, problem.start)
                for _ in march(trials, group, stops):
                    done = sum(track.member.reached - problem.start for track in group) / problem.duration
                    problem.bar.update((first + done) / len(q0))
            except FunctionError as error:
                # Where the torque is a function, trajectories run one by one.
                which = getattr(error, "member", None)
                group[0 if which is None else which - first].member.fail(error)
                break
    records = [track.member for track in tracks]
    return assemble_result(problem, records, evaluations=trials.evaluations, jacobians=trials.jacobians)


def make_attempts(
    method: str,
    dyn: Dynamics,
    space: Space,
    tolerances: Tolerances,
    torque: Torque,
    duration: float,
    batch: int | None,
) -> StepAttempts:
    """Return what tries the steps of ``"rk853"`` or ``"rodas5"``: machine code where there can be some."""
    given = dyn, space, tolerances, torque, duration, batch
    # A compiled step has one value of the time, and does not look for constraints.
    plain = not torque.callable and not dyn.model.time_parameter and not dyn.model.constrained
    if dyn.derived and plain and dyn.model.nv:
        # Other engines need no CasADi.
        from mbkit.codegen.backend import has_compiler
        from mbkit.engines.lagrangian import LagrangianDynamics

        if isinstance(dyn, LagrangianDynamics) and dyn.compile and dyn.written_out and has_compiler():
            # Loads LLVM, which interpreting never needs.
            from mbkit.simulate.solvers.adaptive_compiled import CompiledAttempts

            return CompiledAttempts(dyn, *given[1:], method)
    if isinstance(method_of(method).formula, RosenbrockTableau):
        # Its Jacobian loads CasADi.
        from mbkit.simulate.solvers.step_attempts import RosenbrockAttempts

        return RosenbrockAttempts(*given)
    return RungeKuttaAttempts(*given)


def stop_times(problem: IntegrationProblem) -> list[float]:
    """Return the times at which a run must stop on its way: where a held torque jumps, and the end."""
    held = problem.save.tolist() if problem.save is not None and problem.torque.held else []
    return sorted({*held, problem.end} - {problem.start})


def march(
    trials: StepAttempts, group: Sequence[TrajectoryRecorder], stops: Sequence[float], first: int = 0
) -> Iterator[list[tuple[int, AcceptedSteps]]]:
    """Take trajectories to the end, from stop `first` on; yields accepted steps after they are recorded."""
    for k in range(first, len(stops)):
        trials.hold(k, stops[k])
        while made := trials.advance():
            for place, stretch in made:
                track = group[place]
                if not track.take(trials, place, stretch) or track.stuck(trials, place):
                    trials.drop(place)
            yield made


class TrajectoryRecorder:
    """Puts the steps of one trajectory into its record, `member`."""

    def __init__(self, problem: IntegrationProblem, space: Space, index: int) -> None:
        self.member = record_of(problem, index)
        self._space, self._save, self._tolerances = space, problem.save, problem.tolerances
        self._watch = Watch(problem.events, problem.member(index)) if problem.events else None

    def begin(self, q: Array, v: Array) -> None:
        """Start at a state."""
        start = self.member.reached
        if self._save is None or (len(self._save) and self._save[0] == start):
            self.member.add(np.array([start]), q[None], v[None])
        if self._watch is not None:
            self._watch.start(start, q, v)

    def take(self, trials: StepAttempts, place: int, made: AcceptedSteps) -> bool:
        """Take in some steps; return whether to go on."""
        member = self.member
        steps = len(made.t) - 1
        member.rejected += made.tried - steps
        # A state that is none stays so: the last one tells.
        lost = not (is_bounded(made.q[-1]) and is_bounded(made.w[-1]))
        if lost:
            good = is_bounded(made.q[1:]) & is_bounded(made.w[1:])
            steps = int(np.argmin(good)) if len(good) else 0
        hit = self._look(trials, place, made, steps)
        if hit is not None:
            steps = int(np.searchsorted(made.t, hit.t))
        until = float(made.t[steps]) if hit is None else hit.t
        if not self._keep(trials, place, made, steps, until):
            # Never seen: a shorter step than one that was good met what is no number.
            steps, hit, lost = 0, None, True
            until = float(made.t[0])
        member.steps += steps
        member.reached = until
        for k in range(1 if member.poses is not None else max(steps, 1), steps + 1):
            member.saw(float(made.t[k]), made.q[k])
        if hit is not None:
            member.stop_at(hit)
        elif lost:
            member.stop("diverged", _BEYOND)
        return hit is None and not lost

    def stuck(self, trials: StepAttempts, place: int) -> bool:
        """Return whether no step can be made any more, and end there."""
        stuck = trials.stuck(place)
        if stuck:
            self.member.stop("diverged", f"diverged: {trials.why(place)}")
        elif stuck is False:
            self.member.stop_below_rounding(self._tolerances)
        return stuck is not None or (self.member.ended == "finished" and self.member.crawls())

    def _look(self, trials: StepAttempts, place: int, made: AcceptedSteps, steps: int) -> Hit | None:
        if self._watch is None:
            return None
        for k in range(steps):
            hits, last = self._watch.look(float(made.t[k + 1]), self._within(trials, place, made, k))
            self.member.events += hits
            if last is not None:
                return last
        return None

    def _within(self, trials: StepAttempts, place: int, made: AcceptedSteps, k: int) -> State:
        """Return the states of step k by time, each made by a step that ends there."""

        def state(t: float) -> tuple[Array, Array]:
            if t in (made.t[k], made.t[k + 1]):
                at = k + int(t == made.t[k + 1])
                return made.q[at], self._space.leave(made.q[at], made.w[at])
            q, w = trials.within(place, _rows(made, np.array([k])), np.array([t]))
            return q[0], self._space.leave(q[0], w[0])

        return state

    def _keep(self, trials: StepAttempts, place: int, made: AcceptedSteps, steps: int, until: float) -> bool:
        """Keep the wanted states up to a time in the last step; return False, and keep none, if one is unbounded."""
        if self._save is None:
            ends = slice(1, steps + 1 - int(until != made.t[steps]))
            return self._add(made.t[ends], made.q[ends], made.w[ends])
        first, last = np.searchsorted(self._save, (made.t[0], until), side="right")
        times = self._save[first:last]
        after = np.searchsorted(made.t, times)
        q, w = made.q[after], made.w[after]
        between = np.flatnonzero(made.t[after] != times)
        if len(between):
            q[between], w[between] = trials.within(place, _rows(made, after[between] - 1), times[between])
        return self._add(times, q, w)

    def _add(self, t: Array, q: Array, w: Array) -> bool:
        good = bool(is_bounded(q).all() and is_bounded(w).all())
        if good and len(t):
            self.member.add(t, q, self._space.leave(q, w))
        return good


def _rows(made: AcceptedSteps, which: Indices) -> AcceptedSteps:
    return AcceptedSteps(made.t[which], made.q[which], made.w[which], 0)
