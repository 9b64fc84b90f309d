"""Integrators of others: SciPy's adaptive methods, and the engines' own.

Interpolants of DOP853 and Radau are less accurate than their steps (order 7 beside 8, 3 beside 5), so these end where a
state is wanted; multistep methods interpolate, since stopping often would slow them.

The engines' own integrators: MuJoCo's and those in a process of their own with a step, Drake's with a tolerance.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from mbkit._check import EPS, Array
from mbkit.engines import Dynamics
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.errors import FunctionError, InputError, MbkitError
from mbkit.methods.registry import method_of
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.fixed_step import SteppedRun, Stepper
from mbkit.simulate.solvers.step_attempts import AcrossPoses
from mbkit.simulate.solvers.trajectory_record import (
    GridRecord,
    StoppedError,
    TrajectoryRecord,
    assemble_result,
    below_rounding,
    diverged,
    run_each,
)
from mbkit.simulate.solvers.vector_field import DivergenceError, Rates, are_bounded, is_bounded
from mbkit.simulate.time_grid import check_room
from mbkit.simulate.torque import Force


def run_scipy(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself; a jump of a held torque starts every method again."""
    solve = _Solve(problem)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"), warnings.catch_warnings():
        # LSODA warns of what the result reports as the end of the run.
        warnings.filterwarnings("ignore", message="lsoda: ", category=UserWarning)
        records = run_each(problem, solve.steps)
    jacobians = 0 if solve.jacobian is None else solve.jacobian.evaluations
    return assemble_result(problem, records, evaluations=solve.evaluations, jacobians=jacobians)


class _Solve:
    """Integrates one trajectory after the other."""

    def __init__(self, problem: IntegrationProblem) -> None:
        self._problem, self._method = problem, method_of(problem.method)
        self.rates, self._across = Rates(problem.dyn), AcrossPoses.of(problem)
        self.jacobian: Any = None
        if self._method.jacobian:
            from mbkit.simulate.stiffness_measure import RateJacobian

            self.jacobian = RateJacobian(problem.dyn)
        self._stops = problem.stops
        if problem.save is not None and not self._method.multistep:
            self._stops = sorted({*problem.save.tolist(), *problem.stops, problem.end} - {problem.start})

    @property
    def evaluations(self) -> int:
        return self.rates.evaluations + (0 if self._across is None else self._across.evaluations)

    def steps(self, i: int, y: Array, record: TrajectoryRecord) -> Iterator[tuple[float, Array, Any]]:
        """Yield the end of each step, and a function of time for states within it."""
        problem, member = self._problem, self._problem.member(i)
        if member is not None:
            self.rates.only(member)
            if self.jacobian is not None:
                self.jacobian.only(member)
        force_of, t = problem.torque.of_member(member), problem.start
        across = self._across
        if across is not None:
            across.follow(i)
        solver: Any = None
        first: float | None = None
        interval = -1
        for stop in self._stops:
            before, interval = interval, problem.interval(t)
            problem.sample(i, interval, t, y)
            force = force_of(interval)
            if solver is not None and interval != before:
                # A held force jumps here, and with it all that the solver remembers. A multistep method starts again
                # with order 1, for which its last step is too long.
                first, solver = None if self._method.multistep else solver.h_abs, None
            while t < stop:
                if across is not None and across.crosses(t, y, solver and _length(solver), interval, stop):
                    # Not to a time that is saved, which may be so near the pose that no step goes on from there.
                    (t, y), first, solver = across.cross(interval, problem.stops[interval]), None, None
                    yield t, y, across.at
                    continue
                if solver is None:
                    solver = self._solver(t, y, force, stop, first and min(first, stop - t))
                    if solver is None:
                        raise diverged(self.rates.why)
                    # It has a length now.
                    continue
                solver.t_bound, solver.status = stop, "running"
                start = t, y
                solver = self._step(record, solver, force, stop)
                t, y = float(solver.t), solver.y.copy()
                yield t, y, self._within(solver, start, force)

    def _solver(self, t: float, y: Array, force: Force, stop: float, first: float | None) -> Any:
        from scipy import integrate

        # SciPy would start from a rate that is not finite.
        if not np.isfinite(self.rates(t, y, force)).all():
            return None
        jacobian, (rtol, atol) = self.jacobian, self._problem.tolerances
        more = {} if jacobian is None else {"jac": lambda t, y: jacobian(t, y, force)}
        scheme = getattr(integrate, self._method.scheme)
        return scheme(lambda t, y: self.rates(t, y, force), t, y, stop, rtol=rtol, atol=atol, first_step=first, **more)

    def _step(self, record: TrajectoryRecord, solver: Any, force: Force, stop: float) -> Any:
        """Take a step; return the solver, which is another one where a step was repeated."""
        t, y, duration = float(solver.t), solver.y.copy(), self._problem.duration
        self.rates.why = ""
        before = self.rates.evaluations
        wanted = self._shorten(solver, stop)
        if not _stepped(solver):
            raise diverged(self.rates.why)
        # One short step on the way is no reason to grow from its length again.
        if not self._method.multistep and solver.status == "finished" and solver.step_size < wanted:
            _resize(solver, max(wanted, solver.h_abs))
        if not self._method.jacobian:
            # DOP853 evaluates the forward dynamics so often in each step that it tries.
            attempts = (self.rates.evaluations - before) // 12
            record.rejected += max(0, attempts - (solver.status != "failed"))
        while self._method.scheme == "LSODA" and solver.status != "failed" and not is_bounded(solver.y):
            # It steps into non-finite states; the others shorten the step by themselves.
            first = (solver.t - t) / 4
            again = self._solver(t, y, force, stop, first) if first > duration * EPS else None
            if again is None:
                break
            record.rejected += 1
            solver = again
            _stepped(solver)
        if solver.status == "failed" or _below_rounding(solver, duration):
            # Steps may have become this short because the engine failed just ahead of them.
            raise diverged(self.rates.why) if self.rates.why else below_rounding(self._problem.tolerances)
        # Radau and DOP853 go on from the rate at the end of a step.
        if not is_bounded(solver.y) or not np.isfinite(getattr(solver, "f", 0.0)).all():
            raise diverged(self.rates.why)
        if self._problem.dyn._projects and not self._method.multistep:
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
            _resize(solver, room)
        return wanted

    def _within(self, solver: Any, start: tuple[float, Array], force: Force) -> Callable[[float], Array]:
        """Return the states within the last step by time."""
        interpolant: Any = None

        def state(t: float) -> Array:
            nonlocal interpolant
            if self._method.multistep:
                interpolant = interpolant or solver.dense_output()
                return np.asarray(interpolant(t))
            shorter = self._solver(*start, force, t, t - start[0])
            while shorter.status == "running" and _stepped(shorter):
                pass
            return np.asarray(shorter.y)

        return state


def _length(solver: Any) -> float:
    """Return the length of the next step; of LSODA, which does not tell it, that of the last one."""
    return float(getattr(solver, "h_abs", solver.step_size or 0.0))


def _resize(solver: Any, length: float) -> None:
    if length != solver.h_abs:
        solver.h_abs = length
        # Radau keeps a factorization for the length that it knew.
        solver.LU_real = solver.LU_complex = None


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
    # 1/eps steps would never end, though near t = 0 they are above rounding. LSODA does not tell the next step.
    if not hasattr(solver, "h_abs"):
        return bool(solver.status == "running" and solver.step_size < duration * EPS)
    return bool(solver.h_abs < duration * EPS)


def run_native(problem: IntegrationProblem) -> SolverResult:
    """Run the engine's integrator; nothing is kept after a trajectory's last bounded state."""
    method, grid, torque = method_of(problem.method), problem.grid, problem.torque
    q0, v0 = problem.q0, problem.v0
    # MuJoCo is an extra.
    dyn: Any = problem.dyn
    apart = isinstance(dyn, VersionDynamics)
    rollout = partial(dyn.own_run, method=method.scheme) if apart else partial(dyn.rollout, method.scheme)
    check_room((grid.steps + 1) * len(problem.q), q0.shape[-1] + v0.shape[-1])
    record, parts, now = GridRecord(problem), [(q0[..., None, :], v0[..., None, :])], (q0, v0)
    # MuJoCo's step is fixed for a rollout, so a shortened last step is a rollout of its own.
    whole = grid.steps if grid.last == grid.dt else grid.steps - 1
    for k, end in pairwise(sorted({0, *torque.changes(grid.steps), whole, grid.steps})):
        # A state that diverged stays void; it only must not stop the others.
        good = are_bounded(*now)
        if not good.any():
            break
        q, v = (np.where(good[..., None], x, first) for x, first in zip(now, (q0, v0), strict=True))
        try:
            who = np.flatnonzero(good)
            torque.sample(k, grid.time(k), np.atleast_2d(q)[who], np.atleast_2d(v)[who], who)
        except FunctionError as failed:
            record.error = failed
            break
        tau = torque.rows(range(k, end)) if torque.held or torque.table.any() else None
        if tau is not None and torque.samples is not None:
            # Nobody is asked for the torque of what diverged.
            tau = np.nan_to_num(tau)

        def report(done: float, k: int = k, end: int = end) -> None:
            problem.bar.update((k + done * (end - k)) / grid.steps)

        q, v = rollout(q0=q, v0=v, dt=grid.step(k), tau=tau, steps=end - k, progress=report)
        q, v = (np.where(good[..., None, None], np.asarray(x), np.nan) for x in (q, v))
        parts.append((q[..., 1:, :], v[..., 1:, :]))
        now = q[..., -1, :], v[..., -1, :]
    q, v = (np.concatenate(x, axis=-2) for x in zip(*parts, strict=True))
    missing = grid.steps + 1 - q.shape[-2]
    q, v = (np.pad(x, [(0, 0)] * (x.ndim - 2) + [(0, missing), (0, 0)], constant_values=np.nan) for x in (q, v))
    q, v = (x[None] if problem.batch is None else x for x in (q, v))
    good = are_bounded(q, v)
    good[:, 0] = True  # the start is the caller's
    # After the first bad state everything is void, even what looks like numbers.
    record.good[:] = np.logical_and.accumulate(good, axis=1).sum(1) - 1
    record.q, record.v = q[:, record.kept], v[:, record.kept]
    problem.bar.update(1.0)
    record.evaluations = int(record.good.sum()) * method.stages
    return record.result()


# Drake's own integrators, with a tolerance.


def run_drake(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself, to the times of `save`.

    Steps end on the saved times. Drake has one accuracy, relative to a state of size 1 and above, for which
    `rtol` is taken.
    """
    # Drake is an extra.
    from mbkit.engines.drake.engine import DrakeDynamics, DrakeRun

    dyn = problem.dyn
    assert isinstance(dyn, DrakeDynamics)
    if problem.save is None:
        raise InputError(
            f"save: {problem.method} does not tell its own steps; give the times to keep, "
            f"such as [{problem.start:g}, {problem.end:g}]"
        )
    samples = problem.stops if problem.torque.samples is not None else []
    times = sorted({problem.start, *problem.save.tolist(), *samples, problem.end})
    scheme, runs = method_of(problem.method).scheme, list[DrakeRun]()

    def walk(i: int, y: Array, record: TrajectoryRecord) -> Iterator[tuple[float, Array, Any]]:
        force = problem.torque.of_member(problem.member(i))
        run = DrakeRun(
            dyn, scheme, problem.tolerances.rtol, problem.start, problem.q[i], problem.v[i], problem.report(i)
        )
        runs.append(run)
        try:
            for begin, t in pairwise(times):
                k = problem.interval(begin)
                problem.sample(i, k, begin, y)
                run.push(np.asarray(force(k)))
                try:
                    y = np.concatenate(run.over(t))
                except RuntimeError as error:
                    text = str(error).strip().splitlines()[0]
                    why = f"stopped with a step below the smallest: stiff, singular or diverging ({text})"
                    raise StoppedError("step_too_small", why) from None
                # Saved times lie at the ends of these parts alone.
                yield t, y, None
        finally:
            # Drake's own steps, and not the parts.
            record.steps, record.rejected = run.steps, run.rejected

    records = run_each(problem, walk)
    return assemble_result(problem, records, evaluations=sum(run.evaluations for run in runs))


class _DiscreteStepper(Stepper):
    """Steps of Drake's discrete plants, state by state; the step's length is part of a plant."""

    def __init__(self, dyn: Dynamics) -> None:
        self._dyn, self._runs = dyn, dict[float, Any]()

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:  # noqa: ARG002
        from mbkit.engines.drake.engine import DiscreteRun, DrakeDynamics

        assert isinstance(self._dyn, DrakeDynamics)
        if h not in self._runs:
            self._runs[h] = DiscreteRun(self._dyn, h)
        tau = np.broadcast_to(np.asarray(force), w.shape)
        try:
            if q.ndim == 1:
                return self._runs[h].step(q, w, tau)  # type: ignore[no-any-return]  # Drake is an extra
            pairs = [self._runs[h].step(*state) for state in zip(q, w, tau, strict=True)]
        except RuntimeError as error:
            raise DivergenceError(str(error).strip().splitlines()[0]) from None
        return np.array([x for x, _ in pairs]), np.array([x for _, x in pairs])


def run_drake_discrete(problem: IntegrationProblem) -> SolverResult:
    """Step one state, or each of a batch by itself, on Drake's discrete plant."""
    stepper = _DiscreteStepper(problem.dyn)
    run = SteppedRun(problem, stepper, problem.v0.copy())
    run.to_end()
    run.record.evaluations = int(run.record.good.sum())
    return run.record.result(lambda _: run.why)
