"""SUNDIALS' CVODES through CasADi: BDF of orders 1 to 5, with CasADi's exact Jacobian.

Hindmarsh and others 2005, SUNDIALS: Suite of nonlinear and differential/algebraic equation solvers. CasADi interprets
the right-hand side.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.equations import Equations
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.model import Model
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.result import SolverResult
from mbkit.simulate.solvers.step_attempts import AcrossPoses
from mbkit.simulate.solvers.trajectory_record import StoppedError, TrajectoryRecord, assemble_result, diverged, run_each
from mbkit.simulate.solvers.vector_field import is_bounded

_GRAPH: Final = "_cvodes_graph"
_EPS: Final = float(np.finfo(float).eps)
# Steps of a call. Progress is reported after it, and each starts with order 1, which costs some tens of steps.
_PIECE: Final = 2000
# Between two saved times: far more than any tolerance asks for, so that a run ends.
_MOST_STEPS: Final = 2_000_000

# Integrators, each for its own grid of times.
_REMEMBERED: Final = 32


def run_cvodes(problem: IntegrationProblem) -> SolverResult:
    """Integrate one state, or each of a batch by itself; CVODES interpolates, and starts again where a torque jumps."""
    _, times = problem.saved_times()
    solve, torque, across = _Solve(problem), problem.torque, AcrossPoses.of(problem)

    def walk(i: int, y: Array, record: TrajectoryRecord) -> Iterator[tuple[float, Array, None]]:
        member = problem.member(i)
        force, gap = torque.of_member(member), 0.0
        if across is not None:
            across.follow(i)
        # A jump within a call is one that CVODES does not know of: its error test fails.
        for first in range(len(times) - 1 if torque.held else 1):
            piece = (times[first : first + 2] if torque.held else times).copy()
            k = problem.interval(float(piece[0]))
            problem.sample(i, k, float(piece[0]), y)
            known = np.concatenate([np.asarray(force(k)), solve.parameters(member)])
            at, intervals, failing = 0, 1, 0
            while at < len(piece) - 1:
                if across is not None and across.crosses(float(piece[at]), y, gap):
                    piece[at], y = across.cross(k, float(piece[at + 1]))
                    record.steps += 1
                    at += int(piece[at] == piece[at + 1])
                    yield float(piece[at]), y, None
                    continue
                # Where intervals fail together, bisection finds those that can be reached.
                n = failing // 2 or min(intervals, len(piece) - 1 - at)
                try:
                    states, steps = solve(piece[at : at + n + 1], y, known, record)
                except StoppedError as error:
                    failing, failure = n, error
                else:
                    if across is not None and steps > n:
                        # States that are farther apart than steps do not tell of a pose between them.
                        piece, at, intervals = _refined(piece[at:], -(-steps // n)), 0, steps
                        continue
                    for j, state in enumerate(states, 1):
                        t = float(piece[at + j])
                        yield t, state, None
                        gap = t - float(piece[at + j - 1])
                        if across is not None and across.crosses(t, state, gap):
                            n = j
                            break
                    states = states[:n]
                    y, at, failing = states[-1], at + n, max(failing - n, 0)
                    intervals = max(1, min(4 * n, n * _PIECE // max(steps, 1)))
                if failing == 1:
                    raise failure

    records = run_each(problem, walk)
    evaluations = solve.evaluations + (0 if across is None else across.evaluations)
    return assemble_result(problem, records, evaluations=evaluations, jacobians=solve.jacobians)


def _refined(times: Array, parts: int) -> Array:
    """Return times with each of their intervals in equal parts."""
    places = np.arange(len(times))
    return np.interp(np.arange(parts * places[-1] + 1) / parts, places, times)


class _Solve:
    """CVODES from one time to several others."""

    def __init__(self, problem: IntegrationProblem) -> None:
        dyn, (self._rtol, atol) = problem.dyn, problem.tolerances
        assert isinstance(dyn, LagrangianDynamics)
        self._dyn, self._graph, clock = dyn, _graph(dyn), _clock(dyn.model)
        self._clock = None if clock is None else dyn.equations.force.numel() + clock
        self._options = {
            "reltol": self._rtol,
            "abstol": atol,
            "max_num_steps": _MOST_STEPS,
            "min_step_size": _EPS,
            # The result reports failures, not on the terminal.
            "show_eval_warnings": False,
            "disable_internal_warnings": True,
        }
        self._integrators: dict[tuple[float, ...], Any] = {}
        self.evaluations = self.jacobians = 0

    def parameters(self, member: int | None) -> Array:
        """Return the parameters' values of a member of the batch."""
        own = self._dyn if member is None else self._dyn.of_samples([member])
        return np.ravel(own.parameter_values)

    def __call__(self, times: Array, y: Array, known: Array, record: TrajectoryRecord) -> tuple[Array, int]:
        """Return states at times[1:], and the steps, which are recorded; `StoppedError` where there are none."""
        # In units of the whole call, so that one integrator serves every single interval.
        length = float(times[-1] - times[0])
        grid = tuple(((times[1:] - times[0]) / length).tolist())
        integrator = self._integrators.get(grid) or ca.integrator(
            "cvodes", "cvodes", self._graph, 0.0, list(grid), self._options
        )
        if len(self._integrators) > _REMEMBERED:
            self._integrators.clear()
        self._integrators[grid] = integrator
        known = np.append(known, length)
        if self._clock is not None:
            known[self._clock] = times[0]
        try:
            out = integrator(x0=y, p=known)
        except RuntimeError as error:
            raise self._failure(str(error)) from None
        finally:
            stats = integrator.stats()
            # Of a call that fails, CasADi counts what came before the interval at fault.
            self.evaluations += int(stats["nfevals"])
            self.jacobians += int(stats["nlinsetups"])
        states = np.array(out["xf"]).T
        if not is_bounded(states).all():
            raise diverged()
        record.steps += int(stats["nsteps"])
        record.rejected += int(stats["netfails"]) + int(stats["nncfails"])
        return states, int(stats["nsteps"])

    def _failure(self, message: str) -> StoppedError:
        code = match[1] if (match := re.search(r'"(CV_\w+)"', message)) else ""
        # CasADi looks for signals while it evaluates, and takes Ctrl-C for a failure of the function.
        if code in ("CV_RHSFUNC_FAIL", "CV_LSETUP_FAIL"):
            raise KeyboardInterrupt
        if "RHSFUNC" in code:
            return diverged(f"the acceleration is not finite ({code})")
        why = f"stopped with a step below rounding at rtol = {self._rtol:g}: stiff, singular or diverging"
        return StoppedError("step_too_small", f"{why} ({code or message})")


def _graph(dyn: LagrangianDynamics) -> ca.Function:
    """Return s, x, p -> dx/ds with p = (τ, parameters, length), cached.

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
    parameters = ca.vertcat(eq.force, eq.parameters, length)
    named = {"t": s, "x": ca.vertcat(q, v), "p": parameters, "ode": length * ca.densify(rate)}
    names_in, names_out = ca.dyn_in(), ca.dyn_out()
    ins, outs = ([named.get(name, ca.SX(0, 1)) for name in names] for names in (names_in, names_out))
    return ca.Function("rates", ins, outs, names_in, names_out, {"cse": True})


def _clock(model: Model) -> int | None:
    """Return which of the parameters is the time."""
    return None if model.time_parameter is None else list(model.parameters).index(model.time_parameter)
