"""SciPy's adaptive methods on q and v, with the exact Jacobian for the implicit ones.

Interpolants of DOP853 and Radau are less accurate than their steps (order 7 beside 8, 3 beside 5), so these
end where a state is wanted; multistep methods interpolate, since stopping often would slow them.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, MbkitError
from mbkit.methods.registry import Method, Tolerances, method_of
from mbkit.model import Model
from mbkit.model.manifold import unit_quaternions
from mbkit.simulate.events import State, Watch
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result, record_of
from mbkit.simulate.solvers.vector_field import DIVERGED, Rates, is_bounded
from mbkit.simulate.torque import Force

_EPS: Final = float(np.finfo(float).eps)


#: Forward dynamics of each step that DOP853 tries.
_STAGES: Final = 12


class _Jacobian(Protocol):
    evaluations: int

    def only(self, member: int) -> None: ...

    def __call__(self, t: float, y: Array, force: Force) -> Array: ...


@dataclass(frozen=True)
class _Task:
    """One state to integrate from a time; `stops` are the times that steps must end on."""

    t0: float
    y0: Array
    stops: tuple[float, ...]
    force: Callable[[int], Force]
    held: bool
    watch: Watch | None


def run_scipy(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself; a jump of a held torque starts every method again."""
    dyn, save, torque = problem.dyn, problem.save, problem.torque
    method = method_of(problem.method)
    dense = method.multistep
    ends = (problem.end,) if save is None or (dense and not torque.held) else (*save.tolist(), problem.end)
    stops = tuple(sorted({*ends} - {problem.start}))
    solve = _Solve(dyn, method, problem.tolerances)
    records = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"), _quiet():
        for i, start in enumerate(problem.y):
            which = problem.member(i)
            if which is not None:
                solve.only(which)
            watch = Watch(problem.events, which) if problem.events else None
            task = _Task(problem.start, start, stops, torque.of_member(which), torque.held, watch)
            records.append(record_of(problem, i))
            try:
                solve.integrate(records[-1], task, problem.report(i))
            except FunctionError as error:
                records[-1].fail(error)
                break
    return assemble_result(problem, records, evaluations=solve.rates.evaluations, jacobians=solve.jacobian_evaluations)


@contextmanager
def _quiet() -> Iterator[None]:
    # LSODA warns of what the result reports as the end of the run.
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="lsoda: ", category=UserWarning)
        yield


class _Solve:
    """Integrates one trajectory after the other."""

    def __init__(self, dyn: Dynamics, method: Method, tolerances: Tolerances) -> None:
        self.rates = Rates(dyn, explicit=not method.jacobian)
        self._model: Model = dyn.model
        self._method, self._tolerances = method, tolerances
        self._jacobian: _Jacobian | None = None
        if method.jacobian:
            from mbkit.simulate.diagnostics.linearization import Linearization

            self._jacobian = Linearization(dyn)

    @property
    def jacobian_evaluations(self) -> int:
        return 0 if self._jacobian is None else self._jacobian.evaluations

    def only(self, member: int) -> None:
        """Go on with this member of a batch."""
        self.rates.only(member)
        if self._jacobian is not None:
            self._jacobian.only(member)

    def integrate(self, member: TrajectoryRecord, task: _Task, done: Callable[[float], None]) -> None:
        """Take one trajectory to the end, or as far as it goes."""
        member.begin(task.t0, task.y0)
        if task.watch is not None:
            task.watch.start(task.t0, *self._state(task.y0))
        solver: Any = None
        for k, stop in enumerate(task.stops):
            force = task.force(k)
            if solver is None or task.held:
                # A held force jumps here, and with it all that the solver remembers.
                solver = self._anew(task, solver, force, stop)
            if solver is None:
                member.stop("diverged", f"diverged: {self.rates.why or DIVERGED}")
                return
            solver.t_bound, solver.status = stop, "running"
            while solver.status == "running":
                start = solver.t, solver.y.copy()
                solver = self._step(member, solver, force, stop, task.stops[-1] - task.t0)
                if solver is None or self._stopped(member, task, solver, start, force):
                    return
                member.steps += 1
                member.reached = float(solver.t)
                self._keep(member, solver)
                member.saw(member.reached, solver.y[: self._model.nq])
                done(member.reached)
                if member.crawls():
                    return

    def _anew(self, task: _Task, last: Any, force: Force, stop: float) -> Any:
        t, y = (task.t0, task.y0) if last is None else (float(last.t), last.y)
        # A multistep method starts again with order 1, for which its last step is too long.
        first = None if last is None or self._method.multistep else min(last.h_abs, stop - t)
        return self._solver(t, y, force, stop, first)

    def _solver(self, t: float, y: Array, force: Force, stop: float, first: float | None) -> Any:
        from scipy import integrate

        # SciPy would start from a rate that is none.
        if not np.isfinite(self.rates(t, y, force)).all():
            return None
        more: dict[str, Any] = {}
        jacobian = self._jacobian
        if jacobian is not None:
            more["jac"] = lambda t, y: jacobian(t, y, force)
        return getattr(integrate, self._method.scheme)(
            lambda t, y: self.rates(t, y, force),
            t,
            y,
            stop,
            rtol=self._tolerances.rtol,
            atol=self._tolerances.atol,
            first_step=first,
            **more,
        )

    def _step(self, member: TrajectoryRecord, solver: Any, force: Force, stop: float, duration: float) -> Any:
        """Take a step and return the solver, or end the member and return None."""
        t, y = float(solver.t), solver.y.copy()
        self.rates.why = ""
        before = self.rates.evaluations
        wanted = self._shorten(solver, stop)
        if not _stepped(solver):
            member.stop("diverged", f"diverged: {self.rates.why or DIVERGED}")
            return None
        self._lengthen(solver, wanted)
        if not self._method.jacobian:
            tried = (self.rates.evaluations - before) // _STAGES
            member.rejected += max(0, tried - (solver.status != "failed"))
        while self._method.scheme == "LSODA" and solver.status != "failed" and not is_bounded(solver.y):
            # It takes a step into what is no state; the others try a shorter one by themselves.
            first = (solver.t - t) / 4
            again = self._solver(t, y, force, stop, first) if first > duration * _EPS else None
            if again is None:
                break
            member.rejected += 1
            solver = again
            _stepped(solver)
        stuck = solver.status == "failed" or _below_rounding(solver, duration)
        if stuck and self.rates.why:
            # Steps became this short because the engine failed just ahead of them.
            member.stop("diverged", f"diverged: {self.rates.why}")
            return None
        if stuck:
            member.stop_below_rounding(self._tolerances)
            return None
        # Radau and DOP853 go on from the rate at the end of a step.
        if not is_bounded(solver.y) or not np.isfinite(getattr(solver, "f", 0.0)).all():
            member.stop("diverged", f"diverged: {self.rates.why or DIVERGED}")
            return None
        if self._model.constrained and not self._method.multistep:
            solver.y = self.rates.settled(float(solver.t), solver.y)
            solver.f = self.rates(float(solver.t), solver.y, force)
        return solver

    def _shorten(self, solver: Any, stop: float) -> float:
        """Let a one-step method's next step end at the stop; return the length that it had chosen."""
        if self._method.multistep:
            return 0.0
        room, wanted = stop - float(solver.t), float(solver.h_abs)
        # A little longer is better than a rest below rounding; the error is judged either way.
        if room < 1.01 * wanted:
            self._resize(solver, room)
        return wanted

    def _lengthen(self, solver: Any, wanted: float) -> None:
        # One short step on the way is no reason to grow from its length again.
        if not self._method.multistep and solver.status == "finished" and solver.step_size < wanted:
            self._resize(solver, max(wanted, solver.h_abs))

    def _resize(self, solver: Any, length: float) -> None:
        if length != solver.h_abs:
            solver.h_abs = length
            # Radau keeps a factorization for the length that it knew.
            solver.LU_real = solver.LU_complex = None

    def _stopped(
        self, member: TrajectoryRecord, task: _Task, solver: Any, start: tuple[float, Array], force: Force
    ) -> bool:
        if task.watch is None:
            return False
        t = float(solver.t)
        hits, last = task.watch.look(t, self._within(solver, start, force))
        member.events += hits
        if last is None:
            return False
        member.steps += 1
        self._keep(member, solver, last.t)
        member.stop_at(last)
        return True

    def _within(self, solver: Any, start: tuple[float, Array], force: Force) -> State:
        """Return the states of the last step by time."""
        interpolant: Any = None

        def state(t: float) -> tuple[Array, Array]:
            nonlocal interpolant
            if t == solver.t:
                return self._state(solver.y)
            if t == start[0]:
                return self._state(start[1])
            if not self._method.multistep:
                return self._state(self._shorter(start, t, force))
            interpolant = interpolant or solver.dense_output()
            return self._state(interpolant(t))

        return state

    def _shorter(self, start: tuple[float, Array], t: float, force: Force) -> Array:
        """Return the state at a time within a step, by a step that ends there."""
        solver = self._solver(*start, force, t, t - start[0])
        while solver.status == "running" and _stepped(solver):
            pass
        return np.asarray(solver.y)

    def _keep(self, member: TrajectoryRecord, solver: Any, end: float | None = None) -> None:
        """Keep what is wanted of the last step, up to its end or an earlier one."""
        last, interpolant = float(solver.t), None

        def state(t: float) -> Array:
            nonlocal interpolant
            if t == last:
                return np.asarray(solver.y)
            interpolant = interpolant or solver.dense_output()
            return np.asarray(interpolant(t))

        member.keep_step(last, last if end is None else end, state)

    def _state(self, y: Array) -> tuple[Array, Array]:
        nq = self._model.nq
        return unit_quaternions(self._model, y[:nq])[0], y[nq:]


def _stepped(solver: Any) -> bool:
    """Take a step; return whether its numbers were any."""
    try:
        solver.step()
    except MbkitError:
        raise  # a torque function's, which is a ValueError too
    except ValueError:
        # SciPy's linear solver, of a matrix that overflowed.
        return False
    return True


def _below_rounding(solver: Any, duration: float) -> bool:
    # 1/eps steps would never end, though near t = 0 they are above rounding. LSODA does
    # not tell the next step.
    if not hasattr(solver, "h_abs"):
        return bool(solver.status == "running" and solver.step_size < duration * _EPS)
    return bool(solver.h_abs < duration * _EPS)
