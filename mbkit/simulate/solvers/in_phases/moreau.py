"""Runs by Moreau and Jean's step: dry friction with a fixed step, any number of joints, no events.

On the own derivation the step with its choice of sides is machine code; elsewhere, beside constraints, and under
torques that are functions, the same problem is solved in Python for each step.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.engines.elements.jumps import friction_forces
from mbkit.errors import FunctionError, NumericalError
from mbkit.model.integration_space import Space
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.singular_poses import SingularPosesOfBatch
from mbkit.simulate.solvers.in_phases.phases import Phases, applied, force_of, side_by_side
from mbkit.simulate.solvers.trajectory_record import GridRecord
from mbkit.simulate.solvers.vector_field import DIVERGED
from mbkit.simulate.time_grid import Indices

#: Attempts at once, and the most for one step for each velocity with friction.
_ROUNDS: Final = 512
_PATIENCE: Final = 40
_RUNAWAY: Final = 1e100
_UNDECIDED: Final = "which joints rest cannot be decided"


def run_moreau(problem: IntegrationProblem) -> SolverResult:
    """Step one state or a batch over the grid."""
    dyn, torque, every = problem.dyn, problem.torque, np.arange(len(problem.q))
    record, reasons = GridRecord(problem), dict[int, str]()
    compiled = dyn._derived and not torque.callable and "jump" in dyn.model.effects
    compiled = compiled and getattr(dyn, "_compiles_steps", False) and not dyn.model.constrained
    if not compiled and side_by_side(problem):
        run = _InPython(problem, dyn, every, record, side_by_side=True)
        steps, attempts, why = run.run()
        if not why:
            record.good[:], record.evaluations = steps, attempts
            problem.bar.update(1.0)
            return record.result()
        # One state failed: the others have nothing to do with it.
    for i in every.tolist():
        member = problem.member(i)
        own = dyn if member is None else dyn._of_sample(i)
        one = (_Compiled if compiled else _InPython)(problem, own, every[[i]], record)
        steps, attempts, reasons[i] = one.run()
        record.good[i], record.error = steps, one.error
        record.evaluations += attempts
        if one.error is not None:
            break
        if problem.grid.steps:
            problem.report(i)(problem.end)
    return record.result(lambda i: reasons[i])


class _InPython:
    """The steps of one trajectory, or of several side by side, each as a problem of impulses with bounds."""

    #: Error of a torque function that failed.
    error: FunctionError | None = None

    def __init__(
        self,
        problem: IntegrationProblem,
        dyn: Dynamics,
        members: Indices,
        record: GridRecord,
        *,
        side_by_side: bool = False,
    ) -> None:
        self._problem, self._dyn, self._record, self._members = problem, dyn, record, members
        self._force = None if side_by_side else problem.torque.of_member(problem.member(int(members[0])))
        self._phases, self._space = Phases(dyn, side_by_side=side_by_side), Space(dyn.model)
        none = np.zeros((len(members), dyn.model.nv))
        self._law = dyn._jumps.law_of(dyn)
        self._rubs = np.broadcast_to(self._law.bound > 0, none.shape)
        # Without friction: neither a side nor rest.
        self._smooth = self._phases.given(none, none > 0, none > 0, dyn).dyn if self._rubs.any() else dyn
        self._poses: SingularPosesOfBatch | None = None
        if dyn._projects:
            self._poses = SingularPosesOfBatch(problem.dyn, problem.start, problem.q, members.tolist())
            record.poses = {**record.poses, **self._poses.members}

    def run(self) -> tuple[int, int, str]:
        """Return the good steps, the evaluations, and why there are not more."""
        problem, record, members = self._problem, self._record, self._members
        grid, torque = problem.grid, problem.torque
        q, v = problem.q[members], problem.v[members]
        for k in range(grid.steps):
            evaluations = k * len(members)
            try:
                torque.sample(k, grid.time(k), q, v, members)
                force = force_of(torque, self._force, np.full(len(members), k), members)
                q, v = self._step(grid.time(k), grid.step(k), q, v, force)
            except (NumericalError, np.linalg.LinAlgError) as error:
                return k, evaluations, str(error)
            except FunctionError as error:
                self.error = error
                return k, evaluations, str(error)
            if not (np.abs(q).max(initial=0) < _RUNAWAY and np.abs(v).max(initial=0) < _RUNAWAY):
                return k, evaluations, DIVERGED
            if self._poses is not None:
                self._poses.saw(self._dyn, grid.time(k + 1), q, members)
            rows = record.rows(k + 1, k + 1)
            record.q[members, rows], record.v[members, rows] = q[:, None], v[:, None]
        return grid.steps, grid.steps * len(members), ""

    def _step(self, t: float, h: float, q: Array, v: Array, force: Any) -> tuple[Array, Array]:
        dyn, space, bound = at_time(self._smooth, t), self._space, self._dyn.model.constrained
        smooth = v + h * dyn.forward_dynamics(q, v, applied(force, t, q, v))
        inverse = self._dyn._jumps.responses(dyn, q)
        if bound:
            # Rows hold velocities, not their rates: else no velocities of what rests together may be zero.
            own, M = at_time(dyn, t + h), (dyn._bare or dyn).mass_matrix(q)
            chosen = list(own._row_choice.independent)
            J, rate = own.constraint_jacobian(q)[:, chosen], own.constraint_rate(q, smooth)[:, chosen]
            K = np.block([[M, J.mT], [J, np.zeros((len(q), len(chosen), len(chosen)))]])
            right = np.concatenate([np.zeros(v.shape), -rate], axis=1)[..., None]
            smooth = smooth + np.linalg.solve(K, right)[:, : v.shape[1], 0]
        free, holds = smooth, v != v
        if self._rubs.any():
            slides = np.abs(self._law.force_at(v))
            rests = v == 0
            # A joint that stops or turns may be held by its stiction.
            while True:
                most = h * np.where(rests, self._law.bound, slides)
                given = inverse, smooth, most, h * slides, self._rubs, np.zeros(v.shape)
                impulse, holds = friction_forces(*given, definite=not bound)
                free = np.where(holds, 0.0, smooth + (inverse @ impulse[..., None])[..., 0])
                if not (turns := self._rubs & ~rests & (v * free <= 0) & (slides < self._law.bound)).any():
                    break
                rests = rests | turns
        q1 = space.retract(q, h * space.to_integrator_velocity(q, free))
        return self._phases.onto_rows(t + h, holds, q, q1, free) if bound else (q1, free)


class _Compiled:
    """The steps of one trajectory as machine code: rounds of attempts."""

    error: FunctionError | None = None

    def __init__(self, problem: IntegrationProblem, dyn: Dynamics, members: Indices, record: GridRecord) -> None:
        from mbkit.codegen.compiled import aligned
        from mbkit.codegen.step_loop import Arena, compiled_step_loop
        from mbkit.derivation.steps.moreau import MANY, PATIENCE, STATE, moreau_parts

        self._problem, self._record, self._i = problem, record, int(members[0])
        phases, sliding = Phases(dyn), dyn._jumps.sliding
        self._force, self._space = problem.torque.of_member(problem.member(self._i)), Space(dyn.model)
        none = np.zeros(dyn.model.nv)
        own: Any = dyn._jumps.phase(dyn, none, none > 0)
        names = own.model.parameters
        which, sides, locks = sliding.which.tolist(), [*sliding.sides.values()], [*sliding.locks.values()]
        kept: dict[str, Any] = own.equations.kept
        if problem.method not in kept:
            kept[problem.method] = compiled_step_loop(
                (own._form, problem.method), lambda: moreau_parts(own.equations, which, sides, locks), STATE
            )
        self._arena = arena = Arena(kept[problem.method], STATE)
        self._clock: int | None = None
        arena["bound"][:] = dyn._jumps.law_of(dyn).bound[which, None]
        if "parameters" in arena.code.rows:
            others = {name: x for name, x in names.items() if name not in {*sides, *locks}}
            arena["parameters"][:] = np.array([*others.values()], dtype=float)[:, None]
            self._clock = [*others].index(own.model.time_parameter) if own.model.time_parameter else None
        self._now, self._at = arena.state, arena.at
        q, w = problem.q[self._i], self._space.to_integrator_velocity(problem.q[self._i], problem.v[self._i])
        self._put(q=q, w=w, best=MANY, left=PATIENCE, go=1.0)
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
            if not k:
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
            fine = (np.abs(q).max(axis=1, initial=0) < _RUNAWAY) & (np.abs(w).max(axis=1, initial=0) < _RUNAWAY)
        made, why = len(good), ""
        if not fine.all():
            made, why = int(np.argmin(fine)), DIVERGED
        since = count - 1 - int(good[-1]) if len(good) else since + count
        if not why and since > self._most:
            why = DIVERGED if not np.isfinite(states[-1]).all() else _UNDECIDED
        self._keep(k, q[:made], w[:made])
        return made, count, since, why

    def _keep(self, k: int, q: Array, w: Array) -> None:
        record, i = self._record, self._i
        rows = record.rows(k + 1, k + len(q))
        which = record.kept[rows] - (k + 1)
        record.q[i, rows] = q[which]
        record.v[i, rows] = self._space.to_body_velocity(q[which], w[which])
