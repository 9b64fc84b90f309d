"""Runs in phases by a method with a fixed step: trajectories side by side, each in a phase of its own.

All go blocks of steps by one solver, to whom the phase of each is a number. The margins of all states of a block are
computed together. A trajectory whose phase ends in a block keeps its states up to there and takes the step in which it
ends in parts, to the end of the phase and on from there; the parts are steps of the method, so that the order stays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import as_strided

from mbkit._check import EPS, Array
from mbkit.engines import Dynamics
from mbkit.engines.elements.jumps import Mask
from mbkit.errors import FunctionError, NumericalError
from mbkit.methods.registry import method_of
from mbkit.model.integration_space import Space
from mbkit.model.parts import STOPPED
from mbkit.simulate.events import Hit
from mbkit.simulate.problem import SIDE_BY_SIDE, IntegrationProblem, Solver
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import Ended, SolverResult
from mbkit.simulate.singular_poses import SingularPoses
from mbkit.simulate.solvers.in_phases.phases import Impact, Phase, Phases, force_of, in_order, of_each, side_by_side
from mbkit.simulate.solvers.stretches import MAX_EMPTY
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.time_grid import Grid, Indices

UNDECIDED: Final = "stopped, as which joints rest cannot be decided"
#: Steps of a block, at least.
_BLOCK: Final = 32
#: Steps of states in the time of a block's set-up and of its changes, by machine code and in Python.
_SET_UP: Final = {True: 2**14, False: 2**5}
#: States of a block, at most.
_MOST_STATES: Final = 2**16
#: Fraction of a step before which the end of a phase is not searched.
_FROM: Final = 1e-6
#: Rounds of the search for a phase's end, at most: two for each bit, and as many again.
_MAX_ROUNDS: Final = 200
#: Largest value there that may be rounding, in that of speeds.
_MAX_NOISE: Final = 2**10
#: Rest of a step, relative to the time, whose phase ends with it.
_TIMES: Final = 4 * EPS


def run_fixed_in_phases(problem: IntegrationProblem, solver: Callable[[Dynamics], Solver]) -> SolverResult:
    """Integrate a problem with forces that jump on a grid; `solver` gives that of smooth dynamics.

    Torque functions, and engines whose parameters are not numbers, take the members of a batch one by one.
    """
    every, record = np.arange(len(problem.q)), GridRecord(problem)
    together = side_by_side(problem)
    if together:
        try:
            _Members(problem, every, solver, record).to_end()
        except NumericalError:
            # One state failed: the others have nothing to do with it.
            together, record = False, GridRecord(problem)
    for i in () if together else every.tolist():
        _Members(problem, every[i : i + 1], solver, record, alone=True).to_end()
        if record.error is not None:
            break
    record.events = in_order(record.events, problem.end)
    return record.result()


class _Members:
    """Trajectories of a problem, side by side or one alone."""

    def __init__(
        self,
        problem: IntegrationProblem,
        members: Indices,
        solver: Callable[[Dynamics], Solver],
        record: GridRecord,
        *,
        alone: bool = False,
    ) -> None:
        self.problem, self.members, self.side_by_side, self._solver = problem, members, not alone, solver
        self._alone = problem.member(int(members[0])) if alone else None
        dyn = problem.dyn if self._alone is None else problem.dyn._of_sample(self._alone)
        self.phases = Phases(dyn, side_by_side=not alone)
        self._timed = dyn.model.time_parameter is not None
        self._force = problem.torque.of_member(self._alone) if alone else None
        self.q, self.v, self._record = problem.q[members].copy(), problem.v[members].copy(), record
        n = len(members)
        #: Steps done by each.
        self.k: Indices = np.zeros(n, dtype=np.intp)
        self._empty = np.zeros(n, dtype=int)
        self._going = np.full(n, True)
        self._phase: Phase
        self._step_room: tuple[dict[str, Array], Any] = {}, None
        #: States that have room there.
        self._most = 0

    def to_end(self) -> None:
        """Go over the grid."""
        try:
            self._to_end()
        except FunctionError as failed:
            self._record.error = failed
        except NumericalError as failed:
            if self.side_by_side:
                raise
            reached = self.problem.grid.time(int(self.k[0]))
            self._end_early(0, "diverged", f"diverged after t = {reached:.6g} s: {failed}")
        self._record.good[self.members] = self.k

    def _to_end(self) -> None:
        grid, record = self.problem.grid, self._record
        if not grid.steps or not len(self.k):
            return
        rows, start = np.arange(len(self.k)), self.times(np.full(len(self.k), grid.start))
        self._sample(rows)
        dyn = self.phases.dyn._of_samples(self.members) if self.side_by_side else self.phases.dyn
        self.v = self.phases.stopped(dyn, start, self.q, self.v, self.v == 0)
        self.v, _, impacts = self.phases.hit(dyn, start, self.q, self.v, self.forces(rows))
        self._tell(impacts, rows, np.full(len(rows), grid.start))
        self._phase = self.begin(rows, start)
        parts = len(self.problem.q) // len(self.k)
        #: Ends of phases for each step of a trajectory in the last block, and the steps of the next one at most.
        self._ends = 0.0, 2 * _BLOCK
        while record.error is None and self._going.any():
            self._block()
            self._going &= self.k < grid.steps
            self.problem.bar.update((self.members[0] / len(self.k) + self.k.mean() / grid.steps) / parts)

    def _end_early(self, row: int, ended: Ended, why: str) -> None:
        self._going[row] = False
        self._record.early[int(self.members[row])] = ended, why

    def _tell(self, impacts: Sequence[Impact], rows: Indices, t: Array) -> None:
        """Record impacts of rows in their states now."""
        for x in impacts:
            row, when = int(rows[x.row]), float(t[x.row])
            member = None if self.problem.batch is None else int(self.members[row])
            self._record.events.append(x.event(when, self.q[row].copy(), member))

    # Forces

    def _sample(self, rows: Indices) -> None:
        """Ask a torque that samples for its value, in the states of those who are hindmost."""
        torque = self.problem.torque
        if torque.samples is None:
            return
        k = int(self.k[rows].min())
        rows, t = rows[self.k[rows] == k], self.problem.grid.time(k)
        torque.sample(k, t, self.q[rows], self.v[rows], self.members[rows])

    def times(self, t: Array) -> Any:
        """Return times as dynamics and forces take them: one of each trajectory, or that of one."""
        return t if self.side_by_side else float(t[0])

    def forces(self, rows: Indices) -> Any:
        """Return the force in the step that follows."""
        return force_of(self.problem.torque, self._force, self.k[rows], self.members[rows])

    def _of_states(
        self, rows: Indices, phase: Phase, row: Indices, step: Indices, t: Array, q: Array, v: Array
    ) -> Array:
        """Return the margins of states in phases of rows, each behind one of the steps of a block."""
        phases = self.phases
        if self._force is None:
            torque = self.problem.torque
            k = self.k[rows[row]] + step
            own: Any = torque.feedback or torque.rows(k[:, None], self.members[rows[row]])[:, 0]
            return phases.margins(phase.take(row), t, q, v, own)
        first = int(self.k[0])
        torque = self.problem.torque
        forces = None if torque.callable else torque.rows(first + step, self._alone)
        if forces is not None and (not self._timed or phase.dyn._takes_parameters):
            return phases.margins(phase, t, q, v, forces)
        each = []
        for i, (j, when) in enumerate(zip(step.tolist(), t.tolist(), strict=True)):
            force: Any = of_each(self._force(first + j)) if forces is None else forces[i, None]
            each.append(phases.margins(phase, when, q[i : i + 1], v[i : i + 1], force))
        return np.concatenate(each)

    def begin(self, rows: Indices, t: Any, leaving: Array | None = None) -> Phase:
        """Return the phases from here."""
        members = self.members[rows] if self.side_by_side else None
        return self.phases.phase(t, self.q[rows], self.v[rows], self.forces(rows), leaving, members)

    def _keep(self, rows: Indices, k: Indices, count: Indices, q: Array, v: Array) -> None:
        """Put wanted states into the record: of (m, n + 1) behind k steps each row has so many, and one in front."""
        record, members, steps, n = self._record, self.members[rows], self.problem.grid.steps, q.shape[1]
        dense = len(record.kept) > steps
        # States behind the end of a phase are written again. Slices of each row take four times as long.
        fits: Any = dense & (k + n <= steps + 1)
        its: Any = slice(None) if fits.all() else np.flatnonzero(fits)
        for to, x in ((record.q, q), (record.v, v)) if fits.any() else ():
            _windows(to, n)[members[its] * (steps + 1) + k[its]] = x[its].reshape(-1, n * x.shape[2])
        wanted = dense | (record.kept.searchsorted(k + count, side="right") > record.kept.searchsorted(k, side="right"))
        for i in np.flatnonzero(~fits & wanted).tolist():
            first, last = int(k[i]) + 1, int(k[i] + count[i])
            saved = slice(first, last + 1) if dense else record.rows(first, last)
            which: Any = slice(1, last - first + 2) if dense else record.kept[saved] - first + 1
            record.q[members[i], saved], record.v[members[i], saved] = q[i, which], v[i, which]

    # A block

    def _next(self) -> tuple[Indices, Indices, int, float]:
        """Return who goes on, the equal steps before each, and how many of what length: where time enters, the last."""
        grid, rows = self.problem.grid, np.flatnonzero(self._going)
        stop = grid.steps if grid.last == grid.dt else grid.steps - 1
        # No torque is sampled in a state behind the end of a phase, and all go on from a sample together.
        stop = min(stop, self.problem.torque.next_sample(int(self.k[rows].min()), stop))
        left = stop - self.k[rows]
        if not left.any():
            return rows, left + 1, 1, grid.last
        rows, left = rows[left > 0], left[left > 0]
        n = min(self._window(len(rows)), _last_but_one(left, _SET_UP[self._compiled(self._phase.dyn)]))
        n = min(n, max(_MOST_STATES // len(rows), _BLOCK))
        if self._timed:
            # Up to where the next ones stand.
            ahead = left.max() - left[left < left.max()]
            n, rows, left = min([n, *ahead.tolist()]), rows[left == left.max()], left[left == left.max()]
        return rows, left, n, grid.dt

    def _block(self) -> None:
        rows, left, n, h = self._next()
        self._sample(rows)
        grid, record, k = self.problem.grid, self._record, self.k[rows]
        phase = self._phase if len(rows) == len(self.k) else self._phase.take(rows)
        start = grid.time(int(k.min()))
        stands = self._stands(phase)
        compiled = phase.still.any() and self._compiled(phase.dyn) and not stands
        margins = np.empty((len(rows), n)) if compiled and self.side_by_side else None
        together, *room = self._room(rows, k, n)
        if stands:
            margins = np.full((len(rows), n), np.nan)
            if not (self._timed or self.problem.torque.held):
                every = np.arange(len(rows)), np.zeros(len(rows), dtype=np.intp), np.full(len(rows), start)
                margins[:] = self._of_states(rows, phase, *every, self.q[rows], self.v[rows]).min(1)[:, None]
        result = self._solved(rows, phase, n, Grid(start, start + n * h, h, n, h), None if stands else margins, room)
        q, v = (x if self.side_by_side else x[None] for x in (result.q, result.v))
        count = q.shape[1]
        for here, x in zip(room, (q, v), strict=True):
            if not np.may_share_memory(here, x):
                here[:, :count] = x
        q, v = (x[:, :count] for x in room)
        made = np.rint((np.atleast_1d(result.reached) - start) / h).astype(np.intp)
        limit = np.minimum(np.minimum(made, q.shape[1] - 1), np.minimum(left, n))
        if compiled and margins is None:
            # One alone has the margins of its states side by side, behind the steps.
            times: Any = start + np.arange(1, q.shape[1]) * h
            margins = self._margins_of(phase, times, q[0, 1:], v[0, 1:])
        good = self._good(rows, phase, q, v, margins, limit, start, h)
        rate = float((good < limit).sum() / max(good.sum(), 1))
        # Many that move alike end their phases in every other block.
        self._ends = max(rate, self._ends[0] / 2), max(4 * n, self._ends[1])
        last = np.arange(len(rows)), good
        if phase.still.any() and not (compiled and self.side_by_side):
            # What rests keeps its place and no velocity, to the bit.
            np.copyto(q, q[:, :1].copy(), where=self.phases.places(phase.still)[:, None])
            np.copyto(v, 0.0, where=phase.still[:, None])
        if not together:
            self._keep(rows, k, good, q, v)
        self.q[rows], self.v[rows] = q[last], v[last]
        self.k[rows] = k + good
        for j, passed in result.poses.items():
            # States behind the step in which a phase ends are none of the run.
            found = record.poses.setdefault(int(self.members[rows[j]]), SingularPoses(self.phases.dyn))
            found.join(passed, (k[j] - k.min()) * h, grid.time(int(k[j])) + (good[j] + 1) * h)
        record.error = result.error
        if record.error is None:
            self._lose(rows[(good == limit) & (limit < np.minimum(left, n))], result)
            self._across(rows[good < limit])

    def _room(self, rows: Indices, k: Indices, n: int) -> tuple[bool, Array, Array]:
        """Return room for n steps: that of the record, if all go together and each state is kept, or another."""
        record, first = self._record, int(k[0])
        together = len(rows) == len(self.k) and bool((k == first).all())
        if not together or len(record.kept) <= self.problem.grid.steps:
            q, v = (np.empty((len(rows), n + 1, x.shape[1])) for x in (self.q, self.v))
            return False, q, v
        which = slice(None) if self.side_by_side else slice(int(self.members[0]), int(self.members[0]) + 1)
        # States behind the end of a phase are written again.
        return True, record.q[which, first : first + n + 1], record.v[which, first : first + n + 1]

    def _window(self, count: int) -> int:
        """Return the steps of a block: longer ones are set up less often, but steps behind ends are in vain."""
        compiled, (rate, most) = self._compiled(self._phase.dyn), self._ends
        together = max(count, SIDE_BY_SIDE) if compiled else count
        best = np.sqrt(2 * _SET_UP[compiled] / (rate * together)) if rate else np.inf
        return int(np.clip(best, _BLOCK, most))

    def _compiled(self, dyn: Dynamics) -> bool:
        """Return whether the margins of states are machine code with the steps."""
        known = dyn._derived and method_of(self.problem.method).explicit and not self.problem.torque.callable
        return known and getattr(dyn, "_compiles_steps", False) and getattr(dyn, "device", None) is None

    @cached_property
    def margin_part(self) -> Any:
        """The least margin, as a part behind a step."""
        return self.phases.margin_part(self._phase.dyn)

    def step_room(self, n: int) -> tuple[dict[str, Array], Any]:
        """Return room for a step of n states with their margins, and the calls on it."""
        if n > self._most:
            dyn: Any = self._phase.dyn
            self._most = max(n, 2 * self._most)
            self._step_room = dyn._step_with(self.problem.method, self.margin_part).room(self._most)
        return self._step_room

    def _margins_of(self, phase: Phase, t: Array, q: Array, v: Array) -> Array:
        """Return the least margins of the states of a block of one trajectory, (1, n)."""
        dyn: Any = phase.dyn
        part, k = self.margin_part, self.k[0] + np.arange(len(q))
        force = self.problem.torque.rows(k, self._alone)
        states = q, q, Space(dyn.model).to_integrator_velocity(q, v), force, np.zeros((1, 1))
        given = (
            np.broadcast_to(x, (len(q), np.shape(x)[1]))
            for x in (*states, self.phases.bounds(phase), with_time(dyn, t))
        )
        return np.asarray(dyn._code(part.name, make=part.make)(*given, threads=dyn.threads)[0][:, 0, 0][None])

    def _solved(
        self,
        rows: Indices,
        phase: Phase,
        n: int,
        grid: Grid,
        margins: Array | None = None,
        room: Sequence[Array] = (),
    ) -> SolverResult:
        """Return the run of a block, with its margins in an array where one is given, (m, n).

        Machine code puts its states into the `room`, where there is one.
        """
        problem, k = self.problem, self.k[rows]
        if self.side_by_side:
            torque: Any = problem.torque.of_steps(self.members[rows], k, n)
            q, v = self.q[rows], self.v[rows]
        else:
            torque = problem.torque.of_part(self._alone, int(k[0])).of_steps(None, 0, n)
            q, v = self.q[0], self.v[0]
        silent, every = Progress(None, ""), np.arange(n + 1, dtype=np.intp)
        own = IntegrationProblem.on_grid(phase.dyn, problem.method, q, v, grid, every, torque, silent)
        if self._stands(phase):
            apart = GridRecord(own, *room)
            apart.q[:], apart.v[:], apart.good[:] = own.q[:, None], own.v[:, None], n
            out = apart.result()
        elif margins is None and (not room or phase.dyn.model.constrained or not self._compiled(phase.dyn)):
            out = self._solver(phase.dyn)(own)
        else:
            from mbkit.simulate.solvers.compiled_fixed_step import run_rollout

            more: dict[str, Any] = {}
            if margins is not None:
                more = {"behind": [self.margin_part], "margins": margins, "bound": self.phases.bounds(phase)}
            out = run_rollout(own, record=GridRecord(own, *room), **more)
        self._record.count(out)
        return out

    def _stands(self, phase: Phase) -> bool:
        """Whether nothing moves, so that margins alone may change."""
        driven = self._timed and phase.dyn.model.constrained
        return bool(phase.still.all()) and not (self.problem.torque.callable or driven)

    def _good(
        self,
        rows: Indices,
        phase: Phase,
        q: Array,
        v: Array,
        margins: Array | None,
        limit: Indices,
        start: float,
        h: float,
    ) -> Indices:
        """Return how many states behind the first are of the phase, by their margins as far as these are known."""
        if margins is None:
            margins = self.phases.speeds(phase, q[:, 1:], v[:, 1:]).min(axis=2, initial=1.0)
            margins = np.where(phase.still.any(axis=1, keepdims=True) & (margins >= 0), np.nan, margins)
        good = _first(margins < 0, limit)
        row, step = np.nonzero(np.asarray(np.isnan(margins) & (np.arange(margins.shape[1]) < good[:, None])))
        if len(row):
            states, t = (row, step + 1), np.asarray(start + (step + 1.0) * h, dtype=np.float64)
            margins[row, step] = self._of_states(rows, phase, row, step, t, q[states], v[states]).min(axis=1)
        return _first(margins < 0, limit)

    def _lose(self, rows: Indices, result: SolverResult) -> None:
        for i in rows.tolist():
            message, own = result.message, self.members[i : i + 1]
            if self.side_by_side:
                apart = GridRecord(self.problem)
                _Members(self.problem, own, self._solver, apart, alone=True).to_end()
                message = apart.early.get(int(own[0]), ("", message))[1]
            self._end_early(i, "diverged", message)

    # The end of a phase

    def _across(self, rows: Indices) -> None:
        """Take the step in which phases end."""
        if not len(rows):
            return
        grid, whole, phase = self.problem.grid, rows, self._phase.take(rows)
        k = self.k[rows]
        start, left = grid.times_of(k), np.where(k == grid.steps - 1, grid.last, grid.dt)
        while len(rows):
            part, every = _PartOfStep(self, rows, phase, start), np.arange(len(rows))
            q, v, margins = part.ahead(every, left)
            over = (margins.min(axis=1) < 0) & (left > _TIMES * np.abs(start + left))
            self.q[rows[~over]], self.v[rows[~over]] = q[~over], v[~over]
            for kept, x in zip(self._phase.pattern, phase.pattern, strict=True):
                kept[rows[~over]] = x[~over]
            rows, start, left, every = rows[over], start[over], left[over], every[over]
            if not len(rows):
                break
            s, faded = part.ends(every, left, margins[over])
            state = part.ahead(every, s)
            self._record.steps += len(rows)
            moved = s >= _FROM * left
            start, left = start + s, left - s
            # A drive that has ended by the end of the step does so within rounding where its speed is zero first.
            later = start + np.where(faded, left, 0.0)
            phase, decided = self._following(rows, phase.take(every), start, later, state, moved, s > 0)
            if not decided.all():
                rows, start, left = rows[decided], start[decided], left[decided]
                phase = phase.take(np.flatnonzero(decided))
        self._phase = self.phases.given(*self._phase.pattern, self._phase.rubbed)
        whole = whole[self._going[whole]]
        self.k[whole] += 1
        record, k = self._record, self.k[whole]
        places = np.minimum(record.kept.searchsorted(k), len(record.kept) - 1)
        found = record.kept[places] == k
        members, which, places = self.members[whole][found], whole[found], places[found]
        record.q[members, places], record.v[members, places] = self.q[which], self.v[which]

    def _following(
        self,
        rows: Indices,
        before: Phase,
        t: Array,
        later: Array,
        state: tuple[Array, Array, Array],
        moved: Mask,
        pushed: Mask,
    ) -> tuple[Phase, Mask]:
        """Go to the ends of phases at t; return the next ones, as it is `later`, and which of them can be decided.

        `state` has margins behind q and v; `moved` tells that time has passed, `pushed` that it has at least begun to.
        """
        given = self.times(t), *state[:2], self.forces(rows), state[2]
        self.q[rows], self.v[rows], leaving, impacts = self.phases.after(before, *given)
        self._tell(impacts, rows, t)
        # Impacts come sooner and sooner, but come to an end.
        hit = np.isin(np.arange(len(rows)), [x.row for x in impacts]) & pushed
        self._empty[rows] = np.where(moved | hit, 0, self._empty[rows] + 1)
        decided = self._empty[rows] <= MAX_EMPTY
        for i, time in zip(rows[~decided].tolist(), t[~decided].tolist(), strict=True):
            self._end_early(i, "step_too_small", f"{UNDECIDED} at t = {time:.9g} s: their phases end where they begin")
        # A joint that let go and came to rest at once did not let go.
        after = self.begin(rows, self.times(later), leaving * (moved | pushed)[:, None])
        which = [None] * len(rows) if self.problem.batch is None else self.members[rows].tolist()
        at = [*zip(t.tolist(), self.q[rows], self.v[rows], which, strict=True)]
        changes = self.phases.changes(before, after, self.q[rows], impacts)
        self._record.events += [Hit(name, *at[i]) for i, name in changes if decided[i]]
        return after, decided


def _last_but_one(left: Indices, set_up: int) -> int:
    """Return the length of a block with which, and with another behind it, `left` steps take the least time.

    Trajectories that are at the end go on in vain; a block of its own for the others has a `set_up`.
    """
    ends, count = np.sort(left), np.arange(1, len(left) + 1)
    more = (len(left) - count) * ends[-1] - (left.sum() - ends.cumsum()) + set_up * (ends < ends[-1])
    return int(ends[np.argmin(ends * count - ends.cumsum() + more)])


def _windows(states: Array, n: int) -> Array:
    """Return n states in a row from each one of trajectories on, which share memory, (·, n of states)."""
    flat = states.reshape(-1, states.shape[2])
    return as_strided(flat, (len(flat) - n + 1, n * flat.shape[1]), (flat.strides[0], flat.itemsize))


def _first(over: Any, limit: Indices) -> Indices:
    """Return before which place each row is over first, (m,), or its limit if that comes before."""
    # A place behind the last, as a block whose first step fails has none.
    ends = np.column_stack([over, np.full(len(over), True)])
    return np.asarray(np.minimum(ends.argmax(axis=1), limit))


def with_time(dyn: Any, t: Array) -> Array:
    """Return values of parameters, (1, p) or (m, p), at a time of each sample."""
    values, clock = np.atleast_2d(dyn._parameter_values), dyn.model.time_parameter
    if clock is None:
        return values
    return np.where(np.arange(values.shape[1]) == list(dyn.model.parameters).index(clock), t[:, None], values)


class _PartOfStep:
    """The rest of a step in one phase, from the states of trajectories at times t on."""

    def __init__(self, run: _Members, rows: Indices, phase: Phase, t: Array) -> None:
        self._run, self._rows, self.phase, self._t = run, rows, phase, t
        self._force = run.forces(rows)
        self._method = method_of(run.problem.method)
        #: What a step reads and writes, where it is machine code with the margins of its end.
        self._arrays: dict[str, Array] = {}
        dyn: Any = phase.dyn
        timed = dyn.model.time_parameter
        if run._compiled(dyn):
            self._arrays, self._calls = run.step_room(len(rows))
            states = {"q": run.q[rows], "v": run.v[rows], "tau": self._force}
            states |= {"bound": run.phases.bounds(phase), "parameters": with_time(dyn, t)}
            for name, x in states.items():
                self._arrays[name][: len(rows)] = x
        self._stepped = self._method.explicit and timed is None and not callable(self._force)

    def ahead(self, i: Indices, s: Array) -> tuple[Array, Array, Array]:
        """Return the states after s seconds, by one step of the method, and their margins, (m, k)."""
        run, (q, v) = self._run, (x[self._rows[i]] for x in (self._run.q, self._run.v))
        if (margins := self._by_code(i, s)) is not None:
            ends = self._arrays["q1"][i], self._arrays["v1"][i]
            return *run.phases.held(self.phase.still[i], q, *ends), margins
        phase = self.phase if len(i) == len(self._rows) else self.phase.take(i)
        force, ends = self._force if callable(self._force) else self._force[i], (q.copy(), v.copy())
        for j in np.flatnonzero(s > 0):
            own, one = phase.take(np.array([j])), slice(j, j + 1)
            start, length = float(self._t[i[j]]), float(s[j])
            if self._stepped:
                states = own.dyn._step(self._method, q[one], v[one], force[one], length)
            else:
                out = run._solved(self._rows[i[one]], own, 1, Grid(start, start + length, length, 1, length))
                states = out.q, out.v
            for now, x in zip(ends, states, strict=True):
                now[j] = x.reshape(-1, x.shape[-1])[-1]
        margins = run.phases.margins(phase, run.times(self._t[i] + s), *ends, force)
        return *run.phases.held(phase.still, q, *ends), margins

    def _by_code(self, i: Indices, s: Array) -> Array | None:
        """Return the margins after s seconds by machine code, (m, k); None where there is none."""
        if not self._arrays:
            return None
        self._arrays["dt"][i, 0] = s
        finite = self._calls.run_once(len(self._rows))
        return self._arrays["margins1"][i] if finite else None

    def _margins(self, i: Indices, s: Array) -> Array:
        found = self._by_code(i, s)
        return self.ahead(i, s)[2] if found is None else found

    def ends(self, i: Indices, length: Array, over: Array) -> tuple[Array, Mask]:
        """Return after how many seconds phases end, before `length`, where margins are `over`; 0 if they do at once.

        With them, which end with a speed that is zero by rounding behind `length`, too.
        """
        first = _FROM * length
        noise = EPS * (1 + np.abs(self._run.v[self._rows[i]]).max(axis=1))
        soon = self._margins(i, first)
        now = np.full(soon.shape, np.inf)
        # A joint that rests at its bound to the last bits, and is pulled more and more, lets go in the next instant.
        at_once = soon.min(axis=1) <= -noise
        if at_once.any():
            now[at_once] = self._margins(i[at_once], 0 * length[at_once])
            # What begins to move has no speed yet; another one ends the phase.
            now = np.where(soon > -noise[:, None], np.maximum(now, 2 * noise[:, None]), now)
        low, high = np.where(at_once, 0.0, first), np.where(at_once, first, length)
        # A speed that is zero at the end may have faded out long before.
        faded = over.min(axis=1) > -noise
        unit = np.where(faded, STOPPED / (2 * _MAX_NOISE), noise)[:, None]
        # Coordinates are rounded less than speeds: a joint beside its stop may move by little.
        unit = unit * np.where(self._run.phases.with_stops, 1 / _MAX_NOISE, 1.0)
        before = np.where(at_once[:, None], now, np.maximum(soon, 2 * noise[:, None])) / unit
        after = np.where(at_once[:, None], soon, over) / unit
        out, open_ = np.zeros(len(i)), np.flatnonzero(before.min(axis=1) > 0)

        def margins(x: Array, j: Indices) -> Array:
            k = open_[j]
            return self._margins(i[k], low[k] + x * (high - low)[k]) / unit[k]

        if len(open_):
            q, v = (x[self._rows[i[open_]]] for x in (self._run.q, self._run.v))
            slope = self._run.phases.approach(q, v) * (high - low)[open_, None] / unit[open_]
            found = first_zero(margins, before[open_], after[open_], slope)
            out[open_] = low[open_] + found * (high - low)[open_]
        return out, faded


def first_zero(
    function: Callable[[Array, Indices], Array], before: Array, after: Array, slope: Array | float = np.nan
) -> Array:
    """Return where the first of some smooth functions falls to zero between 0 and 1, to ±1 or its noise, (m,).

    function(x, rows) has the values at x, (n, k). They are all positive `before`, at 0, and one is not `after`, at 1,
    (m, k) each. The least of them has a kink where another one becomes it. So the function whose chord falls first is
    interpolated, by the inverse parabola through three places or the chord, with bisection where that is slow. The
    first guess is on the parabola with a `slope` at 0, where that is finite: what bounces off rises before it falls.
    """
    m, going = len(before), np.arange(len(before))
    # Places above and below zero, and the last one that was replaced.
    x, f = np.array([[0.0], [1.0], [np.nan]]) + np.zeros(m), np.array([before, after, np.full(before.shape, np.nan)])
    out, slow, best = np.ones(m), np.zeros(m, dtype=int), np.full(m, np.inf)
    for count in range(_MAX_ROUNDS):
        if not len(going):
            break
        (low, high, old), (above, below, other), rows = x[:, going], f[:, going], np.arange(len(going))
        with np.errstate(divide="ignore", invalid="ignore"):
            chords = np.where(below < 0, above / (above - below), np.inf)
            if not count:
                bend = above + slope - below
                parabola = (slope + np.sqrt(slope**2 + 4 * bend * above)) / (2 * bend)
                chords = np.where((below < 0) & (parabola > 0) & (parabola < 1), parabola, chords)
            j = chords.argmin(axis=1)
            a, b, c = above[rows, j], below[rows, j], other[rows, j]
            parts = low * b * c / (a - b) / (a - c), high * a * c / (b - a) / (b - c), old * a * b / (c - a) / (c - b)
            curve, chord = sum(parts), low + chords[rows, j] * (high - low)
        guess = np.where((low < curve) & (curve < high), curve, chord)
        guess = np.where((slow[going] > 1) | ~((low < guess) & (guess < high)), 0.5 * (low + high), guess)
        values = function(guess, going)
        least, before = values.min(axis=1), best[going]
        end, width, size = (least < 0).astype(int), high - low, np.abs(least)
        x[2, going], f[2, going] = x[end, going], f[end, going]
        x[end, going], f[end, going] = guess, values
        out[going], best[going] = np.where(size < before, guess, out[going]), np.minimum(size, before)
        left = x[1, going] - x[0, going]
        slow[going] = np.where((left > 0.5 * width) & (size > 0.5 * before), slow[going] + 1, 0)
        # Small values that do not fall are rounding.
        noise = (size < _MAX_NOISE) & (size > 0.5 * before)
        going = going[(size > 1) & ~noise & (left > 4 * EPS * (1 + guess))]
    return out
