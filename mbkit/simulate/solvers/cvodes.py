"""SUNDIALS' CVODES through CasADi: BDF of orders 1 to 5, with CasADi's exact Jacobian.

Hindmarsh and others 2005, SUNDIALS: Suite of nonlinear and differential/algebraic equation solvers. CasADi interprets
the right-hand side.
"""

from __future__ import annotations

import re
from typing import Any, Final, NamedTuple

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.equations import Equations
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import UnsupportedError
from mbkit.methods.registry import METHODS, Tolerances
from mbkit.model import Model
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import Ended, SolverResult
from mbkit.simulate.solvers.trajectory_record import TrajectoryRecord, assemble_result, record_of
from mbkit.simulate.solvers.vector_field import DIVERGED, is_bounded

_GRAPH: Final = "_cvodes_graph"
_EPS: Final = float(np.finfo(float).eps)
# Steps of a call. Progress is reported after it, and each starts with order 1, which costs some tens of steps.
_PIECE: Final = 2000
# Between two saved times: far more than any tolerance asks for, so that a run ends.
_MOST_STEPS: Final = 2_000_000

# Integrators, each for its own grid of times.
_REMEMBERED: Final = 32


#: Methods that take what this one does not.
_OTHERS: Final = "method=" + " or ".join(repr(m.name) for m in METHODS.values() if m.multistep and m.callables)


class _Failure(NamedTuple):
    ended: Ended
    message: str


def run_cvodes(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself; CVODES interpolates, and starts again where a torque jumps."""
    dyn, torque = problem.dyn, problem.torque
    if not isinstance(dyn, LagrangianDynamics):
        raise UnsupportedError(
            f"{problem.method}: integrates expressions, which {dyn.engine} has not; "
            f"use mbkit.dynamics(model, 'lagrangian'), or {_OTHERS}"
        )
    if torque.callable or problem.events:
        raise UnsupportedError(f"{problem.method}: takes neither torque functions nor events; use {_OTHERS}")
    save, times = problem.saved_times()
    solve = _Solve(dyn, problem.tolerances)
    members = []
    for i, start in enumerate(problem.y):
        which = problem.member(i)
        run = _Run(solve, record_of(problem, i), save, problem.report(i))
        values = dyn.parameter_values if which is None else dyn.of_samples([which]).parameter_values
        force = torque.of_member(which)
        # A jump within a call is one that CVODES does not know of: its error test fails.
        pieces = [times[k : k + 2] for k in range(len(times) - 1)] if torque.held else [times]
        run.keep(problem.start, start)
        for k, piece in enumerate(pieces):
            given = np.concatenate([np.asarray(force(k)), np.ravel(values)])
            if not run.over(piece, given):
                break
        members.append(run.record)
    return assemble_result(problem, members, evaluations=solve.evaluations, jacobians=solve.jacobians)


class _Run:
    """One trajectory on its way."""

    def __init__(self, solve: _Solve, record: TrajectoryRecord, save: Array, done: Any) -> None:
        self._solve, self._saved, self._done = solve, frozenset(save.tolist()), done
        self.record = record
        self._y: Array = np.empty(0)
        self._intervals = 1

    def over(self, times: Array, given: Array) -> bool:
        """Go on to these times, of which the first is reached; return whether that was possible."""
        at, last = 0, len(times) - 1
        while at < last:
            n = min(self._intervals, last - at)
            steps, failure = self._piece(times[at : at + n + 1], given)
            if failure is not None:
                # What can be reached is found by halves.
                while n > 1:
                    half = n // 2
                    _, first = self._piece(times[at : at + half + 1], given)
                    at, n, failure = (at + half, n - half, failure) if first is None else (at, half, first)
                self.record.stop(*failure)
                return False
            at += n
            self._intervals = max(1, min(4 * n, n * _PIECE // max(steps, 1)))
        return True

    def _piece(self, times: Array, given: Array) -> tuple[int, _Failure | None]:
        out = self._solve(times, self._y, given)
        if isinstance(out, _Failure):
            return 0, out
        y, steps, rejected = out
        good = is_bounded(y)
        if not good.all():
            return 0, _Failure("diverged", f"diverged: {DIVERGED}")
        self.record.steps += steps
        self.record.rejected += rejected
        for t, state in zip(times[1:].tolist(), y, strict=True):
            self.keep(t, state)
            self._done(t)
        return steps, None

    def keep(self, t: float, y: Array) -> None:
        """Go on from a state."""
        self._y, self.record.reached = y, t
        if t in self._saved:
            self.record.keep(t, y)


class _Solve:
    """CVODES from one time to several others."""

    def __init__(self, dyn: LagrangianDynamics, tolerances: Tolerances) -> None:
        self._graph = _graph(dyn)
        clock = _clock(dyn.model)
        self._clock = None if clock is None else dyn.model.nv + clock
        self._options = {
            "reltol": tolerances.rtol,
            "abstol": tolerances.atol,
            "max_num_steps": _MOST_STEPS,
            "min_step_size": _EPS,
            # The result reports failures, not on the terminal.
            "show_eval_warnings": False,
            "disable_internal_warnings": True,
        }
        self._rtol = tolerances.rtol
        self._made: dict[tuple[float, ...], Any] = {}
        self.evaluations = self.jacobians = 0

    def __call__(self, times: Array, y: Array, given: Array) -> tuple[Array, int, int] | _Failure:
        """Return states at times[1:], steps and rejected steps, or why there are none."""
        # In units of the whole call, so that one integrator serves every single interval.
        length = float(times[-1] - times[0])
        grid = tuple(((times[1:] - times[0]) / length).tolist())
        integrator = self._made.get(grid) or ca.integrator(
            "cvodes", "cvodes", self._graph, 0.0, list(grid), self._options
        )
        if len(self._made) > _REMEMBERED:
            self._made.clear()
        self._made[grid] = integrator
        given = np.append(given, length)
        if self._clock is not None:
            given[self._clock] = times[0]
        try:
            out = integrator(x0=y, p=given)
        except RuntimeError as error:
            return _read(str(error), self._rtol)
        finally:
            stats = integrator.stats()
            # Of a call that fails, CasADi counts what came before the interval at fault.
            self.evaluations += int(stats["nfevals"])
            self.jacobians += int(stats["nlinsetups"])
        return np.array(out["xf"]).T, int(stats["nsteps"]), int(stats["netfails"]) + int(stats["nncfails"])


def _read(message: str, rtol: float) -> _Failure:
    found = re.search(r'"(CV_\w+)"', message)
    code = found[1] if found else ""
    # CasADi looks for signals while it evaluates, and takes Ctrl-C for a failure of the function.
    if code in ("CV_RHSFUNC_FAIL", "CV_LSETUP_FAIL"):
        raise KeyboardInterrupt
    if "RHSFUNC" in code:
        return _Failure("diverged", f"diverged: the acceleration is not finite ({code})")
    return _Failure(
        "step_too_small", f"step below rounding at rtol = {rtol:g}: stiff, singular or diverging ({code or message})"
    )


def _graph(dyn: LagrangianDynamics) -> ca.Function:
    """Return s, x, p -> dx/ds with p = (τ, parameters, length), made once.

    t is length s beyond the parameter that is the time, where the equation depends on it.
    """
    if _GRAPH not in vars(dyn):
        vars(dyn)[_GRAPH] = _derived(dyn.equations)
    graph: ca.Function = vars(dyn)[_GRAPH]
    return graph


def _derived(eq: Equations) -> ca.Function:
    model = eq.model
    q, v, length = ca.SX.sym("q", model.nq), eq.v, ca.SX.sym("length")
    unit, lengths = ca.SX(q), ca.SX.ones(model.nq)
    for start, _ in model.quaternions:
        part = slice(start, start + 4)
        lengths[part] = ca.norm_2(q[part])
        unit[part] = q[part] / lengths[part]
    rate = ca.vertcat(eq.kin.qdot, eq.forward_dynamics)
    rate = ca.substitute(rate, eq.q, unit)
    s, clock = ca.SX.sym("s"), _clock(model)
    if clock is not None:
        rate = ca.substitute(rate, eq.parameters[clock], eq.parameters[clock] + length * s)
    # D is linear in the quaternion: with its length put back, the drift of that length never bends the rotation.
    rate[: model.nq] *= lengths
    given = ca.vertcat(eq.tau, eq.parameters, length)
    named = {"t": s, "x": ca.vertcat(q, v), "p": given, "ode": length * ca.densify(rate)}
    names_in, names_out = ca.dyn_in(), ca.dyn_out()
    ins, outs = ([named.get(name, ca.SX(0, 1)) for name in names] for names in (names_in, names_out))
    return ca.Function("rates", ins, outs, names_in, names_out, {"cse": True})


def _clock(model: Model) -> int | None:
    """Return which of the parameters is the time."""
    return None if model.time_parameter is None else list(model.parameters).index(model.time_parameter)
