"""Runs by Moreau and Jean's step: forces that jump and stops with a fixed step, at any number of joints, no events.

On the own derivation the step with its choice of sides is machine code; elsewhere, near singular poses of constraints,
beside stops and under torques that are functions, the same problem is solved in Python for each step.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import BOUND, Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.engines.elements.jumps import Mask, jump_forces
from mbkit.errors import FunctionError, NumericalError
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.run_data import SolverResult
from mbkit.simulate.singular_poses import SingularPosesOfBatch
from mbkit.simulate.solvers.fixed_step import SteppedRun, Stepper
from mbkit.simulate.solvers.in_phases.phases import Phases, applied, side_by_side
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.solvers.vector_field import DIVERGED, DivergenceError
from mbkit.simulate.time_grid import Indices
from mbkit.simulate.torque import Force

#: Attempts at once, and the most for one step for each velocity with a force that jumps.
_ROUNDS: Final = 512
_PATIENCE: Final = 40
#: Responses of velocities to forces at rest, beside constraints, beyond which compiling a step takes longer than ten
#: thousand steps in Python: 16 s for a delta robot with friction at 21 joints.
_MAX_RESPONSES: Final = 200
_UNDECIDED: Final = "which joints rest cannot be decided"


def run_moreau(problem: IntegrationProblem) -> SolverResult:
    """Step one state or a batch over the grid."""
    dyn, left = problem.dyn, np.arange(len(problem.q))
    record, reasons = GridRecord(problem), dict[int, str]()
    if _compiles(problem):
        for i in left.tolist():
            member = problem.member(i)
            one = _Compiled(problem, dyn if member is None else dyn._of_sample(i), left[[i]], record)
            steps, attempts, reasons[i] = one.run()
            record.good[i], record.error = steps, one.error
            record.evaluations += attempts
            if one.error is not None:
                break
            if problem.grid.steps:
                problem.report(i)(problem.end)
        # Beside constraints a step is lost where it may be near a singular pose, and Python tells the reason.
        again = dyn.model.constrained and record.error is None
        left = left[(record.good < problem.grid.steps) & again]
    together = problem.batch is None or side_by_side(problem)
    for members in ([left] if together else [left[[i]] for i in range(len(left))]) if len(left) else ():
        stepper = _Stepper(problem, members)
        run = SteppedRun(problem, stepper, problem.v0.copy(), record, members)
        run.to_end()
        reasons |= dict.fromkeys(members.tolist(), run.why)
        record.poses = {**record.poses, **stepper.poses}
        record.evaluations += int(record.good[members].sum())
        if record.error is not None:
            break
    return record.result(lambda i: reasons[i])


def _compiles(problem: IntegrationProblem) -> bool:
    dyn = problem.dyn
    known = dyn._derived and not problem.torque.callable and dyn.model.needs.friction and not dyn.model.needs.stops
    if known and dyn.model.constrained and len(dyn._jumps.law.which) * dyn.model.nv > _MAX_RESPONSES:
        return False
    return known and bool(getattr(dyn, "_compiles_steps", False))


class _Stepper(Stepper):
    """Steps of one trajectory, or of several side by side, each as a problem of impulses with bounds."""

    def __init__(self, problem: IntegrationProblem, members: Indices) -> None:
        self._problem, self._alone = problem, not side_by_side(problem)
        self._space = Space(problem.dyn.model)
        watched = members.tolist() if problem.dyn._projects else ()
        self._poses = SingularPosesOfBatch(problem.dyn, problem.start, problem.q, watched)
        self.poses = self._poses.members
        self.only(members)

    def only(self, members: Indices, good: NDArray[np.bool_] | None = None) -> None:  # noqa: ARG002
        dyn, self._members = self._problem.dyn, members
        if self._problem.batch is not None:
            dyn = dyn._of_sample(int(members[0])) if self._alone else dyn._of_samples(members)
        self._dyn, self._phases = dyn, Phases(dyn, side_by_side=not self._alone)
        none = np.zeros((len(members), dyn.model.nv))
        self._law = dyn._jumps.law_of(dyn)
        self._rubs = np.broadcast_to(self._law.bound > 0, none.shape)
        # Nothing jumps there: neither a side nor rest.
        self._smooth = self._phases.given(none, none > 0, none > 0, dyn).dyn if self._rubs.any() else dyn

    def settled(self, t: float, q: Array, w: Array) -> tuple[Array, Array]:
        if self.poses:
            self._poses.saw(t, np.atleast_2d(q), self._members)
        return q, w

    def __call__(self, t: float, h: float, q: Array, w: Array, force: Force) -> tuple[Array, Array]:
        tau = np.atleast_2d(applied(force, t, q, w))
        try:
            q1, v1 = self._step(t, h, np.atleast_2d(q), np.atleast_2d(w), tau)
        except (NumericalError, np.linalg.LinAlgError) as error:
            raise DivergenceError(str(error)) from None
        return q1.reshape(q.shape), v1.reshape(w.shape)

    def _step(self, t: float, h: float, q: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        dyn, space, bound = at_time(self._smooth, t), self._space, self._dyn.model.constrained
        smooth = v + h * dyn.forward_dynamics(q, v, tau)
        inverse = self._dyn._jumps.responses(dyn, q)
        if bound:
            # Rows hold velocities, not their rates: else no velocities of what rests together may be zero.
            own, M = at_time(dyn, t + h), (dyn._bare or dyn).mass_matrix(q)
            chosen = list(own._row_choice.independent)
            J, rate = own.constraint_jacobian(q)[:, chosen], own.constraint_rate(q, smooth)[:, chosen]
            K = np.block([[M, J.mT], [J, np.zeros((len(q), len(chosen), len(chosen)))]])
            right = np.concatenate([np.zeros(v.shape), -rate], axis=1)[..., None]
            smooth = smooth + np.linalg.solve(K, right)[:, : v.shape[1], 0]
        stops, side = self._law.stops, self._law.stops.against(q)
        while True:
            free, holds = self._struck(h, v, smooth, inverse, side)
            q1 = space.retract(q, h * space.to_integrator_velocity(q, free))
            passed = np.where(side == 0, stops.passed(q1), 0.0)
            if not passed.any():
                break
            # A stop that is reached within the step takes its part in all of it.
            side = side + passed
        start, ends = q, holds & (side != 0)
        if ends.any():
            start, q1 = stops.onto(q, ends), stops.onto(q1, ends)
            self._phases.require_response(dyn, t, q, smooth, side * ends)
            # What comes to a stop in this step moves what rows tie to it, also what rests then.
            holds = np.where((start != q).any(axis=1, keepdims=True), ends, holds)
        return self._phases.onto_rows(t + h, holds & (free == 0), start, q1, free) if bound else (q1, free)

    def _struck(self, h: float, v: Array, smooth: Array, inverse: Array, side: Array) -> tuple[Array, Mask]:
        """Return the velocity behind a step with friction and the stops at these sides, and which of them hold."""
        rubs, law = self._rubs, self._law
        on = rubs | (side != 0)
        if not on.any():
            return smooth, on
        # Newton's law: v⁺ + e v⁻ is zero or leads inwards.
        back = np.where(side * v < 0, law.stops.restitution_at(side) * v, 0.0)
        slides, rests = np.abs(law.force_at(v)), v == 0
        # A joint that stops or turns may be held by its stiction.
        while True:
            most = h * np.where(rests, law.bound, slides)
            given = inverse, smooth + back, most, h * slides, on, np.zeros(v.shape)
            impulse, holds = jump_forces(
                *given, definite=not self._dyn.model.constrained, stop=side if law.stops else None
            )
            free = np.where(holds, 0.0, smooth + back + (inverse @ impulse[..., None])[..., 0]) - back
            if not (turns := rubs & ~rests & (v * free <= 0) & (slides < law.bound)).any():
                return free, holds
            rests = rests | turns


class _Compiled:
    """The steps of one trajectory as machine code: rounds of attempts."""

    error: FunctionError | None = None

    def __init__(self, problem: IntegrationProblem, dyn: Dynamics, members: Indices, record: GridRecord) -> None:
        from mbkit.codegen.compiled import aligned
        from mbkit.codegen.step_loop import Arena, compiled_step_loop
        from mbkit.derivation.steps.moreau import HELD_STATE, MANY, STATE, moreau_parts
        from mbkit.methods.exchanges import PATIENCE

        self._problem, self._record, self._i = problem, record, int(members[0])
        phases, sliding = Phases(dyn), dyn._jumps.sliding
        self._force, self._space = problem.torque.of_member(problem.member(self._i)), Space(dyn.model)
        none = np.zeros(dyn.model.nv)
        own: Any = dyn._jumps.phase(dyn, none, none > 0)
        names, state = own.model.parameters, HELD_STATE if own.model.constrained else STATE
        which, sides, locks = sliding.which.tolist(), [*sliding.sides.values()], [*sliding.locks.values()]
        kept: dict[str, Any] = own.equations.kept
        if problem.method not in kept:
            kept[problem.method] = compiled_step_loop(
                (own._form, problem.method), lambda: moreau_parts(own.equations, which, sides, locks), state
            )
        self._arena = arena = Arena(kept[problem.method], state)
        self._clock: int | None = None
        arena["bound"][:] = dyn._jumps.law_of(dyn).bound[which, None]
        if "parameters" in arena.code.rows:
            others = {name: x for name, x in names.items() if name not in {*sides, *locks}}
            arena["parameters"][:] = np.array([*others.values()], dtype=float)[:, None]
            self._clock = [*others].index(own.model.time_parameter) if own.model.time_parameter else None
        self._now, self._at = arena.state, arena.at
        q, w = problem.q[self._i], self._space.to_integrator_velocity(problem.q[self._i], problem.v[self._i])
        self._put(q=q, w=w, best=MANY, left=PATIENCE, go=1.0, **({"new": 1.0} if own.model.constrained else {}))
        self._phases, self._which = phases, which
        self._log = aligned(_ROUNDS * self._now.size).reshape(_ROUNDS, *self._now.shape)
        self._most = _PATIENCE * (len(which) + 1)

    def _put(self, **values: Array | float) -> None:
        for name, value in values.items():
            self._now[self._at[name]] = np.reshape(value, (-1, 1))

    def run(self) -> tuple[int, int, str]:
        """Return the good steps, the attempts, and why there are not more steps."""
        grid, held = self._problem.grid, self._problem.torque.held
        k, attempts, why = 0, 0, ""
        while k < grid.steps and not why:
            # As many steps at once as have one length and one force.
            q, w = (self._now[self._at[name], 0] for name in ("q", "w"))
            v = self._space.to_body_velocity(q, w) if k else self._problem.v[self._i]
            try:
                self._problem.sample(self._i, k, grid.time(k), np.concatenate([q, v]))
            except FunctionError as error:
                self.error = error
                return k, attempts, str(error)
            if not k and "new" not in self._at:
                phase = self._phases.phase(grid.start, q, v, self._force(0))
                self._put(side=phase.sides[self._which], still=phase.still[self._which].astype(float))
            last = k + 1 if held or k == grid.steps - 1 else grid.steps - (grid.step(grid.steps - 1) != grid.dt)
            self._arena["tau"][:] = np.asarray(self._force(k))[:, None]
            self._arena["dt"][:] = grid.step(k)
            if self._clock is not None:
                self._arena["parameters"][self._clock] = grid.time(k) - k * grid.step(k)
            since = 0
            while k < last and not why:
                done, tried, since, why = self._advance(k, last, since)
                k, attempts = k + done, attempts + tried
        return k, attempts, why

    def _advance(self, k: int, last: int, since: int) -> tuple[int, int, int, str]:
        """Return the steps made, the attempts, those since the last step, and why there are not more."""
        self._now[self._at["end"]] = last
        self._now[self._at["go"]] = 1.0
        count = self._arena.run(self._now, self._log, min(_ROUNDS, max(2, 2 * (last - k))), on=True)
        states = self._log[:count, :, 0]
        reached = states[:, self._at["k"].start]
        good = np.flatnonzero(np.diff(np.append(float(k), reached)) > 0)
        q, w = states[good][:, self._at["q"]], states[good][:, self._at["w"]]
        with np.errstate(invalid="ignore"):
            fine = (np.abs(q).max(axis=1, initial=0) < BOUND) & (np.abs(w).max(axis=1, initial=0) < BOUND)
        made, why = len(good), ""
        if not fine.all():
            made, why = int(np.argmin(fine)), DIVERGED
        since = count - 1 - int(good[-1]) if len(good) else since + count
        lost = not states[-1, self._at["go"]].any() and k + made < last
        if not why and (since > self._most or lost):
            why = DIVERGED if not np.isfinite(states[-1]).all() else _UNDECIDED
        self._keep(k, q[:made], w[:made])
        return made, count, since, why

    def _keep(self, k: int, q: Array, w: Array) -> None:
        record, i = self._record, self._i
        rows = record.rows(k + 1, k + len(q))
        which = record.kept[rows] - (k + 1)
        record.q[i, rows] = q[which]
        record.v[i, rows] = self._space.to_body_velocity(q[which], w[which])
