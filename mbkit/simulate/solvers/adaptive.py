"""Adaptive runs of one-step methods with an embedded error on the manifold: rk853, rodas5.

Steps do not depend on what is saved or looked for. A state within a step is computed by a shorter step from the same
start, of the same order as the others; no interpolant adds an error of its own.

The embedded step as machine code: many attempts in a row without going back to Python.

Near a singular pose steps are of collocation: there a trajectory steps in Python, from a few steps before, until the
pose is behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np

from mbkit._check import EPS, Array
from mbkit.codegen.compiled import aligned
from mbkit.codegen.step_loop import Arena, CompiledStepLoop, compiled_step_loop, width
from mbkit.derivation.steps.adaptive import STATE, embedded_parts
from mbkit.derivation.steps.rosenbrock import rosenbrock_parts
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import FunctionError
from mbkit.methods.one_step import FIRST_ROOT, MAX_GROWTH, first_length
from mbkit.methods.registry import Tolerances, method_of
from mbkit.methods.tableaus import EmbeddedTableau, RosenbrockTableau
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.solvers.step_attempts import RosenbrockAttempts, RungeKuttaAttempts, StepAttempts
from mbkit.simulate.solvers.trajectory_record import (
    ROUNDS,
    AcceptedSteps,
    StoppedError,
    TrajectoryRecord,
    assemble_result,
    below_rounding,
    diverged,
)
from mbkit.simulate.solvers.vector_field import DivergenceError, Field

#: A tolerance with which no error is seen, and a length with which a step is as long as its gap.
_HUGE: Final = 1e300
#: Number of accepted steps that are taken again in Python before the first one that ends near a singular pose: whoever
#: looks how fast the pose comes has to see it coming.
_STEPS_BEFORE_POSE: Final = 8


def _code(dyn: LagrangianDynamics, own: EmbeddedTableau | RosenbrockTableau) -> CompiledStepLoop:
    """Return the machine code of an attempted step."""
    codes: dict[str, CompiledStepLoop] = dyn.equations.kept.setdefault("lanes", {})
    if own.name not in codes:
        parts: Any = rosenbrock_parts if isinstance(own, RosenbrockTableau) else embedded_parts
        name = (dyn._form, own.name, own.digest)
        codes[own.name] = compiled_step_loop(name, lambda: parts(dyn.equations, own), STATE)
    return codes[own.name]


def _arena(code: CompiledStepLoop, tolerances: Tolerances, least: float) -> Arena:
    out = Arena(code, STATE)
    for name, value in (("rtol", tolerances.rtol), ("atol", tolerances.atol), ("least", least)):
        out[name][:] = value
    return out


class CompiledAttempts:
    """Some hundred attempts at once, of a few trajectories; `StepAttempts` says what its methods do."""

    def __init__(
        self,
        problem: IntegrationProblem,
        space: Space,
        tolerances: Tolerances,
        in_python: type[RungeKuttaAttempts] = RungeKuttaAttempts,
    ) -> None:
        assert isinstance(problem.dyn, LagrangianDynamics)
        self._dyn, self._torque, self._batch = problem.dyn, problem.torque, problem.batch
        self._space, self._parameters, self._wanted = space, problem.dyn._parameter_values, problem.tolerances
        self._problem, self._in_python = problem, in_python
        own = in_python.formula()
        self._stiff = isinstance(own, RosenbrockTableau)
        # Evaluations of an attempt, the name of ẇ after one of no length, the power of the length in the error.
        self._stages = own.stages + self._stiff
        self._rate, self._grows = ("k", 5) if self._stiff else ("k_0", 8)
        self._code = _code(problem.dyn, own)
        self._outer = _arena(self._code, tolerances, problem.duration * EPS)
        self._inner: Arena | None = None
        self._tolerances, self._of_place = tolerances, [tolerances] * width()
        self.width, self.rounds = width(), ROUNDS
        self._log = aligned(ROUNDS * self._outer.state.size).reshape(ROUNDS, *self._outer.state.shape)
        self._at = self._outer.at
        self._row = {name: part.start for name, part in self._at.items()}
        self._evaluations = self._jacobians = self._k = 0
        self._stop = 0.0
        # Steps in Python of each place near a singular pose, and the time of the first, s; all of these so far.
        self._near: dict[int, RungeKuttaAttempts] = {}
        self._from: dict[int, float] = {}
        self._taken: list[RungeKuttaAttempts] = []

    @property
    def evaluations(self) -> int:
        return self._evaluations + sum(x.evaluations for x in self._taken)

    @property
    def jacobians(self) -> int:
        return self._jacobians + sum(x.jacobians for x in self._taken)

    def _state(self, count: int, q: Array, w: Array, **values: Array | float) -> Array:
        """Return the rows of states side by side: (n, nq), (n, nv), and numbers by name."""
        state = np.zeros((len(self._outer.state), count))
        state[self._at["q"]], state[self._at["w"]] = q.T, w.T
        for name, value in values.items():
            state[self._row[name]] = value
        return state

    def start(self, which: Sequence[int], q: Array, w: Array, t: float = 0.0, h: float = 0.0) -> None:
        """Begin; lanes without a trajectory repeat the last one."""
        self._which = [*which, *[which[-1]] * (self.width - len(which))]
        self._places = len(which)
        pick = np.minimum(np.arange(self.width), self._places - 1)
        # Up to `hold` an attempt has no length.
        known = {"t": t, "end": t, "most": MAX_GROWTH, "last": FIRST_ROOT, "h": h}
        self._outer.state[:] = self._state(self.width, q[pick], w[pick], **known)
        self._set_parameters(self._outer, self._which)
        self._active = np.zeros(self.width, dtype=bool)
        self._dropped = np.zeros(self.width, dtype=bool)
        self._begun = h > 0
        self._near.clear()

    def _set_parameters(self, arena: Arena, which: Sequence[int]) -> None:
        if self._parameters.size:
            own = self._parameters[which].T if self._parameters.ndim == 2 else self._parameters[:, None]
            arena["parameters"][:] = own

    def _force(self, k: int, member: int) -> Array:
        force = self._torque.of_member(None if self._batch is None else member)(k)
        assert isinstance(force, np.ndarray)
        return force

    def hold(self, k: int, stop: float) -> None:
        arena, self._k, self._stop = self._outer, k, stop
        if self._torque.samples is not None:
            self._sample(k)
        arena["tau"][:] = np.column_stack([self._force(k, i) for i in self._which])
        if not self._begun:
            arena.state[self._row["h"]] = self._first(stop)
            self._begun = True
        self._active = ~self._dropped & (arena.state[self._row["t"]] < stop)
        self._active[self._places :] = False
        for place, attempts in self._near.items():
            self._active[place] = False
            attempts.hold(k, stop)
        # A lane that has no way to go stays where it is.
        arena.state[self._row["end"]] = np.where(self._active, stop, arena.state[self._row["t"]])

    def _sample(self, k: int) -> None:
        """Ask a torque that samples for its value from interval k on, in the states of all places that go on."""
        places = [i for i in range(self._places) if not self._dropped[i] and i not in self._near]
        if places:
            state = self._outer.state[:, places]
            t, q, w = float(state[self._row["t"], 0]), state[self._at["q"]].T.copy(), state[self._at["w"]].T
            v = self._space.to_body_velocity(q, w.copy())
            self._torque.sample(k, t, q, v, np.array(self._which)[places])

    def _first(self, stop: float) -> Array:
        arena = self._outer
        start = arena.state.copy()
        q, w = start[self._at["q"]].T.copy(), start[self._at["w"]].T.copy()

        def probe(q: Array, w: Array) -> Array:
            # An attempt of no length has the rates in its first stage.
            at = start.copy()
            at[self._at["q"]], at[self._at["w"]] = q.T, w.T
            arena.run(at, self._log, 1, on=False)
            return arena[self._rate].T.copy()

        h = first_length(self._space, q, w, probe(q, w), self._tolerances, probe, self._grows)
        arena.state[:] = start
        self._evaluations += 2 * self._places
        # The step finds out where there is no rate.
        return np.where(h > 0, h, 1e-6 * (stop - arena.state[self._row["t"]]))

    def advance(self) -> list[tuple[int, AcceptedSteps]]:
        for place in [place for place, attempts in self._near.items() if attempts.passed]:
            self._return(place)
        out = [(place, steps) for place, attempts in self._near.items() for _, steps in attempts.advance()]
        if not self._active.any():
            return out
        arena, log = self._outer, self._log
        before = arena.state.copy()
        count = arena.run(arena.state, log, self.rounds, on=True)
        for place in np.flatnonzero(self._active).tolist():
            going = log[:count, self._row["go"], place] != 0
            attempts = count if going[-1] else int(np.argmin(going)) + 1
            self._active[place] = bool(going[-1])
            states = np.concatenate([before[None, :, place], log[:attempts, :, place]])
            times, good = states[:, self._row["t"]], np.full(len(states), True)
            np.greater(times[1:], times[:-1], out=good[1:])
            singular = np.isposinf(states[1:, self._row["error"]])
            if singular.any():
                good[int(np.argmax(singular)) + 1 :] = False
                good[np.flatnonzero(good)[1:][-_STEPS_BEFORE_POSE:]] = False
                self._leave(place, states[np.flatnonzero(good)[-1]])
            accepted = states[good]
            t, q, w = (accepted[:, at] for at in (self._row["t"], self._at["q"], self._at["w"]))
            out.append((place, AcceptedSteps(t, q, w, attempts)))
            self._evaluations += self._stages * attempts
            self._jacobians += self._stiff * attempts
        return out

    def _leave(self, place: int, state: Array) -> None:
        """Go on in Python from a state."""
        attempts = self._in_python(self._problem, self._space, self._of_place[place])
        t, h, most, last = (float(state[self._row[name]]) for name in ("t", "h", "most", "last"))
        attempts.start([self._which[place]], state[None, self._at["q"]], state[None, self._at["w"]], t, h)
        attempts.go_on(most, last)
        attempts.hold(self._k, self._stop)
        self._near[place], self._from[place], self._active[place] = attempts, t, False
        self._taken.append(attempts)
        # The lane has no way to go.
        lane = self._outer.state[:, place]
        lane[self._row["end"]] = lane[self._row["t"]]

    def _return(self, place: int) -> None:
        """Go on in machine code from where Python is."""
        t, q, w, h, most, last = self._near.pop(place).now
        values = {"t": t, "h": h, "most": most, "last": last, "end": self._stop}
        self._outer.state[:, place] = self._state(1, q[None], w[None], **values)[:, 0]
        self._active[place] = not self._dropped[place] and t < self._stop

    def drop(self, place: int) -> None:
        self._dropped[place], self._active[place] = True, False
        if place in self._near:
            self._near[place].drop(0)
        state = self._outer.state
        state[self._row["end"], place] = state[self._row["t"], place]

    def stuck(self, place: int) -> StoppedError | None:
        if place in self._near:
            return self._near[place].stuck(0)
        state = self._outer.state[:, place]
        t, end, error, go = (float(state[self._row[name]]) for name in ("t", "end", "error", "go"))
        if go or t >= end:
            return None
        if not np.isnan(error):
            return below_rounding(self._wanted)
        member = self._which[place]
        field = Field(self._dyn._of_samples([member]), self._space)
        try:
            field(0.0, state[None, self._at["q"]], state[None, self._at["w"]], self._force(self._k, member)[None])
        except DivergenceError as reason:
            return diverged(str(reason))
        return diverged()

    def tighten(self, place: int, tolerances: Tolerances) -> None:
        for name, value in zip(("rtol", "atol"), tolerances, strict=True):
            self._outer[name][:, place] = value
        self._of_place[place] = tolerances
        if place in self._near:
            self._near[place].tighten(0, tolerances)

    def _beside(self, place: int) -> Arena:
        """Return room for other attempts of a lane's trajectory, in all lanes."""
        if self._inner is None:
            self._inner = _arena(self._code, Tolerances(0.0, _HUGE), 0.0)
        self._set_parameters(self._inner, [self._which[place]] * self.width)
        self._inner["tau"][:] = self._outer["tau"][:, place, None]
        return self._inner

    def rates(self, place: int, q: Array, w: Array) -> Array:
        if place in self._near:
            return self._near[place].rates(0, q, w)
        arena, out = self._beside(place), []
        for start in range(0, len(q), self.width):
            # Those beyond the last repeat it. An attempt of no length has the rates in its first stage.
            pick = np.minimum(np.arange(start, start + self.width), len(q) - 1)
            arena.run(self._state(self.width, q[pick], w[pick]), self._log, 1, on=False)
            out.append(arena[self._rate].T.copy())
        self._evaluations += len(q)
        return np.concatenate(out)[: len(q)]

    def within(self, place: int, start: AcceptedSteps, times: Array) -> tuple[Array, Array]:
        """Return states within steps, several side by side."""
        if place in self._near and start.t[0] >= self._from[place]:
            return self._near[place].within(0, start, times)
        arena, count = self._beside(place), len(times)
        rounds = -(-count // self.width)
        pick = np.minimum(np.arange(rounds * self.width), count - 1)
        ends: dict[str, Array | float] = {"t": start.t[pick], "end": times[pick], "h": _HUGE, "most": MAX_GROWTH}
        states = self._state(len(pick), start.q[pick], start.w[pick], **ends)
        queue = np.ascontiguousarray(states.reshape(-1, rounds, self.width).transpose(1, 0, 2))
        done = np.empty_like(queue)
        arena.run(queue, done, rounds, on=False)
        self._evaluations += self._stages * count
        after = done.transpose(0, 2, 1).reshape(len(pick), -1)[:count]
        # One that failed stayed at its start, and is no state at that time.
        failed = np.flatnonzero(~(after[:, self._row["error"]] < 1))
        after[failed] = np.nan
        q, w = after[:, self._at["q"]], after[:, self._at["w"]]
        # A step across a singular pose is good, and yet a shorter one may have stages too near to it.
        for begin in dict.fromkeys(start.t[failed].tolist()) if self._dyn._projects else ():
            group = failed[start.t[failed] == begin]
            own = RungeKuttaAttempts(self._problem, self._space, self._of_place[place])
            own.start([self._which[place]], start.q[group[:1]], start.w[group[:1]], begin)
            own.hold(self._k, self._stop)
            self._taken.append(own)
            while own.now[0] < times[group[-1]] and (step := own.step()):
                inside = group[(times[group] > step.t[0]) & (times[group] <= step.t[1])]
                if len(inside):
                    q[inside], w[inside] = own.within(0, step.rows(0 * inside), times[inside])
        return q, w


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
