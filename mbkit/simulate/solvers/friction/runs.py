"""Runs with dry friction by any method: phase after phase, each ended where something stops or lets go.

A method with a fixed step takes the step in which a phase ends in parts, to the end of the phase and on from there; the
parts are steps of the method, so that the order stays. An adaptive method has the end as an event.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from scipy.optimize import brentq

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.errors import FunctionError, NumericalError
from mbkit.methods.registry import method_of
from mbkit.simulate.events import Followed, Hit
from mbkit.simulate.problem import RUNS, IntegrationProblem
from mbkit.simulate.result import Ended, SolverResult
from mbkit.simulate.solvers.friction.phases import Friction, Phase
from mbkit.simulate.time_grid import Grid

#: problem -> result, of a smooth problem.
Solver = Callable[[IntegrationProblem], SolverResult]
#: Phases in a row that end where they begin, at most.
_MOST: Final = 20
#: Steps at once at the start, and the factor by which they grow while nothing changes.
_WINDOW, _GROWTH = 32, 4
_EPS: Final = float(np.finfo(float).eps)
#: Of a step, from where on the end of a phase is looked for.
_FROM: Final = 1e-6
_END: Final = "end of a phase"
_UNDECIDED: Final = "stopped, as which joints rest cannot be decided"


def run_in_phases(problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    """Integrate a problem with dry friction; `solver` gives that of smooth dynamics."""
    dyn = problem.dyn
    RUNS.admit(dyn.model)
    walk = _fixed if problem.equal_steps is not None else _adaptive
    parts = []
    for i in range(len(problem.q)):
        run = _Member(problem, i, solver)
        parts.append(run.part)
        try:
            walk(run)
        except FunctionError as error:
            # Of a torque that is asked whether a phase ends.
            run.part.error = error
            break
        except NumericalError as error:
            run.part.ended, run.part.message = "diverged", f"diverged after t = {run.part.reached:.6g} s: {error}"
    return _merged(problem, parts)


@dataclass(eq=False)
class _Part:
    """What a trajectory has so far."""

    t: list[Array]
    q: list[Array]
    v: list[Array]
    hits: list[Hit]
    last: SolverResult | None = None
    steps: int = 0
    evaluations: int = 0
    rejected: int = 0
    jacobians: int = 0
    #: How it ended, and why, where the solver of its last phase does not tell.
    ended: Ended | None = None
    message: str = ""
    error: FunctionError | None = None
    reached: float = 0.0

    def count(self, result: SolverResult) -> None:
        """Add the cost of a phase."""
        self.last = result
        self.steps += result.steps
        self.evaluations += result.evaluations
        self.rejected += result.rejected
        self.jacobians += result.jacobians
        self.reached = float(result.reached)

    def keep(self, t: Array, q: Array, v: Array) -> None:
        """Keep states."""
        if len(t):
            self.t.append(t)
            self.q.append(q)
            self.v.append(v)

    def end(self) -> tuple[Ended, str]:
        """Return how it ended, and why."""
        if self.error is not None:
            return "function_failed", str(self.error)
        if self.ended is not None:
            return self.ended, self.message
        if self.last is None or not self.message:
            return "finished", ""
        return self.last.ended, self.message


class _Member:
    """One trajectory of a problem."""

    def __init__(self, problem: IntegrationProblem, i: int, solver: Callable[[Dynamics], Solver]) -> None:
        self.problem, self.member, self._solver = problem, problem.member(i), solver
        dyn = problem.dyn if self.member is None else problem.dyn._of_sample(i)
        self.friction = Friction(dyn)
        self.names = dyn.model.velocity_names
        self.q, self.v = problem.q[i].copy(), problem.v[i].copy()
        self.force = problem.torque.of_member(self.member)
        self.part = _Part([], [], [], [])
        self._stuck = 0

    def begin(self, k: int, t: float, leaving: Array | None = None) -> Phase:
        """Return the phase from here."""
        return self.friction.phase(t, self.q, self.v, self.force(k), leaving)

    def solve(self, phase: Phase, k: int, steps: int | None, **changes: object) -> SolverResult:
        """Solve a part of the problem from here, with the force from row k on."""
        torque = self.problem.torque.of_part(self.member, k, k + steps if steps else None)
        own = replace(self.problem, dyn=phase.dyn, q0=self.q, v0=self.v, torque=torque, **changes)  # type: ignore[arg-type]
        result = self._solver(phase.dyn)(own)
        q, v = self.friction.held(phase, self.q, result.q, result.v)
        return replace(result, q=q, v=v)

    def next(
        self, phase: Phase, k: int, t: float, q: Array, v: Array, *, moved: bool, pushed: bool = False
    ) -> Phase | None:
        """Go to the end of a phase, and return the next one; None where it cannot be decided.

        `moved` tells that time has passed, `pushed` that it has at least begun to.
        """
        q, v = self.friction.held(phase, self.q, q, v)
        v, leaving = self.friction.after(phase, t, q, v, self.force(k))
        self._stuck = 0 if moved else self._stuck + 1
        if self._stuck > _MOST:
            self.part.ended = "step_too_small"
            self.part.message = f"{_UNDECIDED} at t = {t:.9g} s: their phases end where they begin"
            return None
        self.q, self.v = q, v
        # What let go and came to rest at once did not let go.
        out = self.begin(k, t, leaving if moved or pushed else None)
        self._tell(phase, out, t)
        return out

    def _tell(self, before: Phase, after: Phase, t: float) -> None:
        turned = (before.sides * after.sides < 0) & ~(before.still | after.still)
        for i in np.flatnonzero((before.still != after.still) | turned):
            what = "stops" if after.still[i] else "lets go" if before.still[i] else "turns"
            self.part.hits.append(Hit(f"{self.names[i]} {what}", t, self.q.copy(), self.v.copy(), self.member))


def _fixed(run: _Member) -> None:
    problem, grid, part = run.problem, run.problem.grid, run.part
    wanted = set(problem.kept.tolist())
    if 0 in wanted:
        part.keep(np.array([grid.start]), run.q[None], run.v[None])
    part.reached, k, window = grid.start, 0, _WINDOW
    phase = run.begin(0, grid.start) if grid.steps else None
    while k < grid.steps and phase is not None:
        n = min(window, grid.steps - k)
        result = run.solve(
            phase, k, n, **_on_grid(Grid(grid.time(k), grid.time(k + n), grid.dt, n, grid.step(k + n - 1)))
        )
        good = _good(run, phase, k, result)
        states = range(k + 1, k + 1 + good)
        rows = np.array([i - k for i in states if i in wanted], dtype=int)
        part.keep(np.array([grid.time(k + int(i)) for i in rows]), result.q[rows], result.v[rows])
        part.count(result)
        k += good
        part.reached = grid.time(k)
        run.q, run.v = result.q[good], result.v[good]
        problem.report(run.member or 0)(part.reached)
        if good == n:
            window = min(window * _GROWTH, 1 << 16)
            continue
        if good == len(result.t) - 1:
            # The solver stopped before any phase ended.
            part.message = result.message
            break
        window = _WINDOW
        phase = _across(run, phase, k)
        if phase is not None:
            k += 1
            part.reached = grid.time(k)
            if k in wanted:
                part.keep(np.array([grid.time(k)]), run.q[None], run.v[None])


def _on_grid(grid: Grid) -> dict[str, object]:
    return {
        "start": grid.start,
        "duration": grid.end - grid.start,
        "equal_steps": grid,
        "kept": np.arange(grid.steps + 1, dtype=np.intp),
    }


def _good(run: _Member, phase: Phase, k: int, result: SolverResult) -> int:
    """Return how many states behind the first are of the phase."""
    friction, grid, n = run.friction, run.problem.grid, len(result.t) - 1
    sliding = np.flatnonzero(((phase.sides * result.v[1:])[:, friction.which] < 0).any(axis=1))
    n = int(sliding[0]) if sliding.size else n
    if not (n and phase.still.any()):
        return n
    rows = run.problem.torque.over_states(run.member, k, n)
    timed = phase.dyn.model.time_parameter is not None
    if rows is None or (timed and not phase.dyn.takes_parameters):
        forces = [run.force(k + i) for i in range(n)]
        states = zip(forces, result.q[1 : n + 1], result.v[1 : n + 1], strict=True)
        each = [friction.margins(phase, grid.time(k + 1 + i), q, v, f) for i, (f, q, v) in enumerate(states)]
        margins = np.array(each).reshape(n, -1)
    else:
        times: Any = np.array([grid.time(k + 1 + i) for i in range(n)]) if timed else 0.0
        margins = friction.margins(phase, times, result.q[1 : n + 1], result.v[1 : n + 1], rows)
    over = np.flatnonzero((margins < 0).any(axis=1))
    return int(over[0]) if over.size else n


class _PartOfStep:
    """The rest of a step in one phase, from the state of a trajectory at time t on."""

    def __init__(self, run: _Member, phase: Phase, k: int, t: float) -> None:
        self._run, self._phase, self._k, self._t, self._force = run, phase, k, t, run.force(k)
        method = method_of(run.problem.method)
        self._stepped = method.explicit and phase.dyn.model.time_parameter is None and not callable(self._force)

    def state(self, s: float) -> tuple[Array, Array]:
        """Return the state after s seconds, by one step of the method."""
        run, phase = self._run, self._phase
        if self._stepped:
            q, v = phase.dyn.step(run.q, run.v, np.asarray(self._force), s, run.problem.method)
            return run.friction.held(phase, run.q, q, v)
        result = run.solve(phase, self._k, 1, **_on_grid(Grid(self._t, self._t + s, s, 1, s)))
        run.part.evaluations += result.evaluations
        return result.q[-1], result.v[-1]

    def least(self, s: float) -> float:
        """Return how far the velocities are from the end of the phase after s seconds, the nearest one."""
        return float(self._run.friction.margins(self._phase, self._t + s, *self.state(s), self._force).min())

    def end(self, length: float) -> float:
        """Return after how many seconds the phase ends, before `length`; 0 where it ends at once."""
        first, noise = _FROM * length, _EPS * (1 + float(np.abs(self._run.v).max()))
        known = {first: noise}
        if (soon := self.least(first)) <= -noise:
            run = self._run
            now = float(run.friction.margins(self._phase, self._t, run.q, run.v, self._force).min())
            if not now > 0:
                return 0.0
            # What rests at its bound to the last bits, and is pulled more and more, lets go in the next instant.
            known, first, length = {0.0: now, first: soon}, 0.0, first

        def least(s: float) -> float:
            return known.get(s) or self.least(s)

        return float(brentq(least, first, length, xtol=4 * _EPS * length, rtol=4 * _EPS))


def _across(run: _Member, phase: Phase, k: int) -> Phase | None:
    """Take the step in which a phase ends; return the phase at its end."""
    grid, current, done = run.problem.grid, phase, 0.0
    start, h = grid.time(k), grid.step(k)
    while True:
        rest = _PartOfStep(run, current, k, start + done)
        if not rest.least(h - done) < 0:
            run.q, run.v = rest.state(h - done)
            return current
        s = rest.end(h - done)
        q, v = rest.state(s) if s else (run.q, run.v)
        done += s
        run.part.steps += 1
        following = run.next(current, k, start + done, q, v, moved=s >= _FROM * (h - done + s), pushed=s > 0)
        if following is None:
            return None
        current = following


def _adaptive(run: _Member) -> None:
    problem, part = run.problem, run.part
    t, k, rows = problem.start, 0, problem.save
    stops = np.array(problem.stops)
    part.reached = t
    # Steps of what rests do not feel a force that changes with time.
    timed = callable(run.force(0)) or problem.dyn.model.time_parameter is not None
    noise = max(1e-9, problem.tolerances.rtol)
    if rows is None or (len(rows) and rows[0] == t):
        part.keep(np.array([t]), run.q[None], run.v[None])
    phase: Phase | None = run.begin(0, t) if problem.duration else None
    while phase is not None and t < problem.end:
        own, begun = phase, t

        def end(s: float, q: Array, v: Array, own: Phase = own, begun: float = begun, k: int = k) -> float:
            row = run.force(max(k, int(np.searchsorted(stops, s, side="left"))))
            out = float(run.friction.margins(own, s, q, np.where(own.still, 0.0, v), row).min())
            return max(out, _EPS) if s == begun else out

        save = None if rows is None else np.append(rows[(rows > t) & (rows < problem.end)], problem.end)
        events = (*problem.events, Followed(end, _END, parts=2 if timed and own.still.any() else 1, noise=noise))
        result = run.solve(own, k, None, start=t, duration=problem.end - t, save=save, events=events)
        part.count(result)
        part.hits += [replace(x, member=run.member) for x in result.events if x.name != _END]
        phase_ended = bool(result.events) and result.events[-1].name == _END and result.ended == "event"
        _keep(part, result, rows, t, at_end=not phase_ended)
        if not phase_ended:
            part.message = result.message
            break
        hit = result.events[-1]
        moved = hit.t - t > 1e-12 * max(abs(t), problem.duration)
        t, k = hit.t, int(np.searchsorted(stops, hit.t, side="right"))
        phase = run.next(own, min(k, len(stops) - 1), t, hit.q, hit.v, moved=moved)
        if rows is None and moved:
            part.keep(np.array([t]), run.q[None], run.v[None])


def _keep(part: _Part, result: SolverResult, rows: Array | None, begun: float, *, at_end: bool) -> None:
    which = result.t > begun
    if not at_end and len(result.t):
        which[-1] = rows is not None and bool(np.isin(result.t[-1], rows))
    elif rows is not None and result.ended == "finished":
        which &= np.isin(result.t, rows)
    part.keep(result.t[which], result.q[which], result.v[which])


def _merged(problem: IntegrationProblem, parts: list[_Part]) -> SolverResult:
    """Return the trajectories as one result."""
    nq, nv, n = problem.q.shape[1], problem.v.shape[1], len(problem.q)
    none = np.empty(0), np.empty((0, nq)), np.empty((0, nv))
    states = [[np.concatenate([x, *kept]) for x, kept in zip(none, (p.t, p.q, p.v), strict=True)] for p in parts]
    ends = [part.end() for part in parts]
    early = [i for i, end in enumerate(ends) if end[0] != "finished"]
    ended, message = ends[early[0]] if early else ("finished", "")
    if problem.batch is None:
        (t, q, v), reached = states[0], np.asarray(parts[0].reached)
    else:
        wanted = problem.save
        if wanted is None:
            wanted = np.array([problem.grid.time(int(i)) for i in problem.kept])
        count = max((len(x[0]) for x in states), default=len(wanted))
        t, reached = wanted[:count], np.full(n, problem.start)
        reached[: len(parts)] = [part.reached for part in parts]
        q, v = np.full((n, count, nq), np.nan), np.full((n, count, nv), np.nan)
        for i, (own, *state) in enumerate(states):
            inside = min(len(own), count)
            q[i, :inside], v[i, :inside] = (x[:inside] for x in state)
        message += f"; {len(early)} of {n} trajectories ended early, see reached" if early else ""
    lasts = [part.last for part in parts if part.last is not None]
    return SolverResult(
        t=t,
        q=q,
        v=v,
        steps=sum(part.steps for part in parts),
        evaluations=sum(part.evaluations for part in parts),
        ended=ended,
        reached=reached,
        message=message,
        rejected=sum(part.rejected for part in parts),
        jacobians=sum(part.jacobians for part in parts),
        events=tuple(sorted((hit for part in parts for hit in part.hits), key=lambda hit: (hit.member or 0, hit.t))),
        error=next((p.error for p in parts if p.error), next((x.error for x in lasts if x.error), None)),
        chosen=next((x.chosen for x in lasts if x.chosen), ""),
        doubts=tuple(dict.fromkeys(one for x in lasts for one in x.doubts)),
        last=next((x.last for x in lasts if x.last is not None), None),
    )
