"""The embedded step as machine code: many tries in a row without going back to Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.codegen import disk_cache as disk
from mbkit.codegen.compiled import aligned
from mbkit.codegen.step_loop import CompiledStepLoop, compiled_step_loop, width
from mbkit.derivation import Equations
from mbkit.derivation.steps.adaptive import STATE, embedded_parts
from mbkit.derivation.steps.fixed import Part
from mbkit.derivation.steps.rosenbrock import rosenbrock_parts
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.methods.one_step import FIRST_ROOT, MAX_GROWTH
from mbkit.methods.registry import ADAPTIVE_METHOD, Tolerances, method_of
from mbkit.methods.tableaus import RosenbrockTableau, dormand_prince_853
from mbkit.model.integration_space import Space
from mbkit.simulate.solvers.step_attempts import ROUNDS, AcceptedSteps, first_length
from mbkit.simulate.solvers.vector_field import DIVERGED, DivergenceError, Field
from mbkit.simulate.torque import Torque

#: Larger than any scale or length: no error is seen, and a step is as long as its gap.
_HUGE: Final = 1e300


@dataclass(frozen=True)
class _Scheme:
    """The attempted step of a method."""

    name: str
    coefficients: Sequence[list[float]]  # for the key of cached code
    parts: Callable[[Equations], tuple[Part, ...]]
    stages: int
    rate: str  # name of ẇ at the start, after an attempt of no length
    grows: int  # power of a step's length with which its error grows
    jacobians: int  # of each attempt


@cache
def _scheme(method: str) -> _Scheme:
    own = method_of(method).formula
    if isinstance(own, RosenbrockTableau):
        tables = own.A, own.C, own.b, own.error, own.dense
        return _Scheme(
            own.name,
            [[own.gamma], *(x.tolist() for x in tables)],
            lambda equations: rosenbrock_parts(equations, own),
            stages=own.stages + 1,
            rate="k",
            grows=5,
            jacobians=1,
        )
    pair = dormand_prince_853()
    first, second = pair.errors
    return _Scheme(
        pair.name,
        [x.tolist() for x in (pair.A, pair.b, first, second)],
        lambda equations: embedded_parts(equations, pair),
        stages=pair.stages,
        rate="k_0",
        grows=8,
        jacobians=0,
    )


def _code(dyn: LagrangianDynamics, scheme: _Scheme) -> CompiledStepLoop:
    made: dict[str, CompiledStepLoop] = dyn.equations.kept.setdefault("lanes", {})
    if scheme.name not in made:
        made[scheme.name] = compiled_step_loop(
            (dyn.form, scheme.name, disk.key_of(repr(scheme.coefficients))),
            lambda: scheme.parts(dyn.equations),
            STATE,
        )
    return made[scheme.name]


class _Arena:
    """The room of one function, and its calls."""

    def __init__(self, code: CompiledStepLoop, tolerances: Tolerances, least: float) -> None:
        self._code, self.width = code, width()
        self.room = aligned(code.size * self.width).reshape(code.size, self.width)
        self.room[:] = 0.0
        self.first = code.rows[f"{STATE[0]}1"][0]
        self.rows = sum(code.rows[name][1] for name in STATE)
        for name, value in (("rtol", tolerances.rtol), ("atol", tolerances.atol), ("least", least)):
            self[name][:] = value
        self.state = self.room[self.first : self.first + self.rows]
        self._ways = np.zeros(5, dtype=np.int64)

    def __getitem__(self, name: str) -> Array:
        start, count = self._code.rows[name]
        return self.room[start : start + count]

    def within_state(self, name: str) -> slice:
        """Return the rows of a name of the state, counted from the state's first."""
        start, count = self._code.rows[f"{name}1"]
        return slice(start - self.first, start - self.first + count)

    def run(self, source: Array, log: Array, rounds: int, *, on: bool) -> int:
        """Run rounds and return how many; `on` from the state that the last one left, else from one each."""
        self._ways[:] = source.ctypes.data, 0 if on else self.state.nbytes, log.ctypes.data, 0, on
        self._code.loaded.run(self.room.ctypes.data, self._ways.ctypes.data, 0, rounds)
        return int(self._ways[3])


class CompiledAttempts:
    """Tries up to some hundred steps at once; `StepAttempts` says what its methods do."""

    def __init__(
        self,
        dyn: LagrangianDynamics,
        space: Space,
        tolerances: Tolerances,
        torque: Torque,
        duration: float,
        batch: int | None,
        method: str = ADAPTIVE_METHOD,
    ) -> None:
        self._dyn, self._tolerances, self._torque, self._batch = dyn, tolerances, torque, batch
        self._space, self._parameters = space, dyn.parameter_values
        self._scheme = _scheme(method)
        code = _code(dyn, self._scheme)
        self._outer = _Arena(code, tolerances, duration * float(np.finfo(float).eps))
        self._code = code
        self._inner: _Arena | None = None
        self.width, self.rounds = self._outer.width, ROUNDS
        self._log = aligned(ROUNDS * self._outer.state.size).reshape(ROUNDS, *self._outer.state.shape)
        self._at = {name: self._outer.within_state(name) for name in STATE}
        self._row = {name: part.start for name, part in self._at.items()}
        self.evaluations = self.jacobians = 0

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin; lanes without a trajectory repeat the last one."""
        self._which = [*which, *[which[-1]] * (self.width - len(which))]
        self._places = len(which)
        pick = np.minimum(np.arange(self.width), self._places - 1)
        state = self._outer.state
        state[:] = 0.0
        state[self._at["q"]], state[self._at["w"]], state[self._row["t"]] = q[pick].T, w[pick].T, t
        state[self._row["most"]], state[self._row["last"]], state[self._row["h"]] = MAX_GROWTH, FIRST_ROOT, h
        self._give_parameters(self._outer, self._which)
        self._active = np.zeros(self.width, dtype=bool)
        self._dropped = np.zeros(self.width, dtype=bool)
        self._begun = h > 0

    def _give_parameters(self, arena: _Arena, which: Sequence[int]) -> None:
        if self._parameters.size:
            own = self._parameters[which].T if self._parameters.ndim == 2 else self._parameters[:, None]
            arena["parameters"][:] = own

    def _force(self, k: int, member: int) -> Array:
        force = self._torque.of_member(None if self._batch is None else member)(k)
        assert isinstance(force, np.ndarray)
        return force

    def hold(self, k: int, stop: float) -> None:
        """Go on to a time; at the beginning, with a first step."""
        arena, self._k = self._outer, k
        arena["tau"][:] = np.column_stack([self._force(k, i) for i in self._which])
        if not self._begun:
            arena.state[self._row["h"]] = self._first(stop)
            self._begun = True
        self._active = ~self._dropped & (arena.state[self._row["t"]] < stop)
        self._active[self._places :] = False
        # A lane that has no way to go stays where it is.
        arena.state[self._row["end"]] = np.where(self._active, stop, arena.state[self._row["t"]])

    def _first(self, stop: float) -> Array:
        arena = self._outer
        start = arena.state.copy()
        q, w = start[self._at["q"]].T.copy(), start[self._at["w"]].T.copy()

        def probe(q: Array, w: Array) -> Array:
            # A try of no length has the rates in its first stage.
            at = start.copy()
            at[self._at["q"]], at[self._at["w"]] = q.T, w.T
            arena.run(at, self._log, 1, on=False)
            return arena[self._scheme.rate].T.copy()

        h = first_length(self._space, q, w, probe(q, w), self._tolerances, probe, self._scheme.grows)
        arena.state[:] = start
        self.evaluations += 2 * self._places
        # Where there is no rate, the step finds that out.
        return np.where(h > 0, h, 1e-6 * (stop - arena.state[self._row["t"]]))

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        """Try until all have arrived or are stuck, some hundred times at most."""
        if not self._active.any():
            return []
        arena, log = self._outer, self._log
        before = arena.state.copy()
        count = arena.run(arena.state, log, self.rounds, on=True)
        out = []
        for place in np.flatnonzero(self._active).tolist():
            going = log[:count, self._row["go"], place] != 0
            tried = count if going[-1] else int(np.argmin(going)) + 1
            self._active[place] = bool(going[-1])
            out.append((place, self._stretch(before[:, place], log[:tried, :, place])))
            self.evaluations += self._scheme.stages * tried
            self.jacobians += self._scheme.jacobians * tried
        return out

    def _stretch(self, before: Array, tries: Array) -> AcceptedSteps:
        t = np.concatenate([before[None, self._row["t"]], tries[:, self._row["t"]]])
        accepted = np.flatnonzero(np.diff(t) > 0)
        states = np.concatenate([before[None], tries[accepted]])
        return AcceptedSteps(states[:, self._row["t"]], states[:, self._at["q"]], states[:, self._at["w"]], len(tries))

    def drop(self, place: int) -> None:
        """Leave a lane where it is."""
        self._dropped[place], self._active[place] = True, False
        state = self._outer.state
        state[self._row["end"], place] = state[self._row["t"], place]

    def stuck(self, place: int) -> bool | None:
        """Return whether a lane that has a way to go and no step was given no number."""
        t, end, error, go = (float(self._outer.state[self._row[n], place]) for n in ("t", "end", "error", "go"))
        return None if go or t >= end else bool(np.isnan(error))

    def why(self, place: int) -> str:
        """Return what the engine says where a lane is."""
        state, member = self._outer.state[:, place].copy(), self._which[place]
        q, w = state[None, self._at["q"]], state[None, self._at["w"]]
        field = Field(self._dyn.of_samples([member]), self._space)
        try:
            field(0.0, q, w, self._force(self._k, member)[None])
        except DivergenceError as error:
            return str(error)
        return DIVERGED

    def tighten(self, place: int, tolerances: Tolerances) -> None:
        """Go on with other tolerances."""
        for name, value in zip(("rtol", "atol"), tolerances, strict=True):
            self._outer[name][:, place] = value

    def _beside(self, place: int) -> _Arena:
        """Return room for other tries of a lane's trajectory, in all lanes."""
        if self._inner is None:
            self._inner = _Arena(self._code, Tolerances(0.0, _HUGE), 0.0)
        self._give_parameters(self._inner, [self._which[place]] * self.width)
        self._inner["tau"][:] = self._outer["tau"][:, place, None]
        return self._inner

    def rates(self, place: int, q: Array, w: Array) -> Array:
        """Return ẇ at states."""
        arena, found = self._beside(place), []
        task = np.zeros(arena.state.shape)
        for start in range(0, len(q), self.width):
            # Those beyond the last repeat it. A try of no length has the rates in its first stage.
            pick = np.minimum(np.arange(start, start + self.width), len(q) - 1)
            task[self._at["q"]], task[self._at["w"]] = q[pick].T, w[pick].T
            arena.run(task, self._log, 1, on=False)
            found.append(arena[self._scheme.rate].T.copy())
        self.evaluations += len(q)
        return np.concatenate(found)[: len(q)]

    def within(self, place: int, start: AcceptedSteps, times: Array) -> tuple[Array, Array]:
        """Return states within steps, several side by side."""
        arena, count = self._beside(place), len(times)
        rounds = -(-count // self.width)
        pick = np.minimum(np.arange(rounds * self.width), count - 1)
        tasks = np.zeros((len(pick), arena.rows))
        tasks[:, self._at["q"]], tasks[:, self._at["w"]] = start.q[pick], start.w[pick]
        given: dict[str, Array | float] = {"t": start.t[pick], "end": times[pick], "h": _HUGE, "most": MAX_GROWTH}
        for name, value in given.items():
            tasks[:, self._row[name]] = value
        queue = np.ascontiguousarray(tasks.reshape(rounds, self.width, -1).transpose(0, 2, 1))
        done = np.empty_like(queue)
        arena.run(queue, done, rounds, on=False)
        self.evaluations += self._scheme.stages * count
        ends = done.transpose(0, 2, 1).reshape(len(pick), -1)[:count]
        # One that failed stayed at its start, and is no state at that time.
        ends[~(ends[:, self._row["error"]] < 1)] = np.nan
        return ends[:, self._at["q"]], ends[:, self._at["w"]]
