"""Integration of one run: check the arguments, choose the solver, return the run's data."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from mbkit._check import DOUBLE_BITS, EPS, PRINTED, Array, batch_of, real
from mbkit.engines import Dynamics
from mbkit.engines.constrained import unwatched
from mbkit.engines.frames_and_momenta import axes_named
from mbkit.errors import FunctionError, InputError, MbkitWarning, UnsupportedError, warn
from mbkit.methods.registry import ADAPTIVE_METHOD, DEFAULT_METHOD, EULER_METHOD, METHODS, Method, Tolerances, method_of
from mbkit.model import Joint, Model
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.stops import StopLaw
from mbkit.simulate import solvers
from mbkit.simulate.checks import diagnostics, massless_joints
from mbkit.simulate.constraint_projection import along_constraints, from_consistent
from mbkit.simulate.events import as_events
from mbkit.simulate.problem import RUNS, SIDE_BY_SIDE, IntegrationProblem, RunRequest, Solver
from mbkit.simulate.progress import Progress
from mbkit.simulate.run_data import Acting, RunData, RunSettings, SolverResult, saturated
from mbkit.simulate.singular_poses import describe_poses
from mbkit.simulate.time_grid import DEFAULT_STEP, Grid, Indices, check_room, save_times
from mbkit.simulate.torque import RunWrenches, Torque, TorqueFunction

_OTHERS: Final = f"use {DEFAULT_METHOD!r} or {ADAPTIVE_METHOD!r}"
_DRY: Final = EFFECTS["jump"]
_UNKNOWN: Final = {x: f"this method does not know {EFFECTS[x]}" for x in ("stop", "jump")}
_UNKNOWN["stop"] += " (limits='soft' of mujoco and drake has their own instead)"
#: Methods without events and equal steps, at which a joint could stop or let go.
SMOOTH_RUNS: Final = Path("runs without phases", "", ALL - {"jump"}, _UNKNOWN, instead=_OTHERS)
#: Smallest rtol of Taylor's method on the oracle, which computes with 113 bits.
_MIN_RTOL_EXTENDED: Final = 1e-32
#: Cost of an evaluation from Python, in evaluations in machine code.
_COST_IN_PYTHON: Final = 40


#: The run of a problem in parts, of which each is solved by the solver of its dynamics.
InParts = Callable[[IntegrationProblem, Callable[[Dynamics], Solver]], SolverResult]


def integrate(
    dyn: Dynamics, request: RunRequest, in_parts: InParts | None = None
) -> tuple[RunData, FunctionError | None]:
    """Return a run's data, and the error of the torque or event function that ended it.

    Errors are those of `mbkit.simulate`.
    """
    chosen, model = method_of(request.method), dyn.model
    q, v = model.check_q(request.q0, "q0"), model.check_v(request.v0, "v0")
    if model.velocity_map is not None:
        model.velocity_map.check_start(q, v)
    batch = _batch(dyn, batch_of(q0=q, v0=v))
    if batch is not None:
        q, v = np.broadcast_to(q, (batch, model.nq)), np.broadcast_to(v, (batch, model.nv))
    start, duration, dt = times_of(dyn, chosen, request.t0, request.duration, request.dt)
    _require_engine(dyn, chosen)
    q, v = from_consistent(dyn, q, v, start)
    wanted, acting = as_events(request.events), _acting(dyn, request.wrenches, request.wrench_axes)
    span = start, start + duration, 0.0 if chosen.kind == "adaptive" else dt
    hold = _period(request, *span, (1 if batch is None else batch) * model.nv)
    at_stages, limits = None if hold else request.torque, _limits(model, request.saturate)
    functions = any(map(callable, [at_stages, *(request.wrenches or {}).values()]))
    optional = ("events", wanted, "events"), ("wrenches on frames", acting, "wrenches")
    for what, given, name in (*optional, ("torque functions", functions, "callables")):
        if given and not getattr(chosen, name):
            others = ", ".join(m.name for m in METHODS.values() if getattr(m, name))
            raise UnsupportedError(f"{chosen.name}: {what} are not there with this method; use {others}")
    if model.needs.stops and (beyond := StopLaw(model).beyond(q)):
        raise InputError(f"q0: {beyond}; start between the stops, or where dyn.project(q, v) leads")
    if not dyn._soft_limits:
        _warn_beyond_limits(model, q)
    if model.jumping_forces:
        warn(
            f"{model.name}: {', '.join(model.jumping_forces)} jumps where a velocity changes its sign. There it holds "
            "nothing, and a run that comes to rest is wrong or goes on in ever smaller steps. Joints of a description "
            f"have exact {_DRY}: add_joint(..., {Joint.adding_to('jump')[0]}=...); or write tanh(v/v_s) for sign(v)",
            MbkitWarning,
        )
    own = dyn._under(*acting) if acting else dyn
    bar = Progress(request.progress, f"{model.name}: {request.method} on {dyn.engine}")
    started = time.perf_counter()
    setting: float | Tolerances
    with bar, unwatched(dyn, own):
        if chosen.kind == "adaptive":
            setting = _tolerances(dyn, chosen, request.rtol, request.atol)
            if isinstance(request.save, (int, np.integer)):
                raise InputError(f"save: expected a grid of times for an adaptive method, got the count {request.save}")
            times = None if request.save is None else save_times(request.save, start, start + duration)
            whole = times is not None and times[0] == start and times[-1] == start + duration
            rows = len(times) - 1 if whole and times is not None else None
            read, jumps = Torque(at_stages, model, batch, rows, request.wrenches, limits), times
            if hold:
                jumps, begins, table = _intervals(times, start, duration, hold[0], rows=read.held)
                read, times = read.sampled(hold[1], begins, table), jumps if times is None else times
            motion = q, v, start, duration
            problem = IntegrationProblem(own, request.method, *motion, setting, read, times, wanted, bar, jumps)
        else:
            setting = dt
            _refuse_tolerances(chosen, request.rtol, request.atol)
            grid = Grid.of(start, duration, dt)
            indices = grid.kept(request.save, (model.nq + model.nv) * (1 if batch is None else batch))
            read = Torque(at_stages, model, batch, grid.steps, request.wrenches, limits)
            if hold:
                steps = max(grid.steps, 1)
                read = read.sampled(hold[1], [*range(0, steps, round(hold[0] / dt)), steps])
            problem = IntegrationProblem.on_grid(own, request.method, q, v, grid, indices, read, bar)
            jumps = grid.times if read.held else None
        if hold and not duration:
            # No step does.
            read.sample(0, start, q, v, None if batch is None else np.arange(batch))
        asked = read.applied(jumps)
        outcome = _outcome(problem, chosen, in_parts)
        applied, clipped = saturated(asked, read.limits, model.velocity_names, start, outcome)
        passed = describe_poses(outcome.poses, batch, tolerance=chosen.kind == "adaptive")
        doubts = (passed, *outcome.doubts) if passed else outcome.doubts
    seconds = time.perf_counter() - started
    settings = RunSettings(start, q.copy(), v.copy(), setting, doubts)
    if request.doubt and outcome.ended in ("finished", "event"):
        states = settings.with_start(outcome.t, outcome.q, outcome.v)
        compiled = chosen.kind == "native" or (_compiles(own) and not read.callable)
        work = max(outcome.steps, outcome.evaluations)
        work = work // min(batch or 1, SIDE_BY_SIDE) if compiled else work * _COST_IN_PYTHON
        driven = applied is not None or model.driven_by_forces
        doubts += tuple(diagnostics(dyn, chosen, setting, states, driven=driven, steps=outcome.steps, work=work))
    message = outcome.message + ("" if outcome.last is None else massless_joints(dyn, outcome.last))
    stats = outcome.stats(seconds=seconds, message=message, doubts=doubts, saturated=clipped)
    kept = outcome.t, outcome.q, outcome.v
    data = RunData(*kept, model, chosen.name, dyn.engine, stats, dyn, outcome.events, applied, settings, acting)
    return data, outcome.error


def _period(
    request: RunRequest, start: float, end: float, dt: float, numbers: int
) -> tuple[float, TorqueFunction] | None:
    """Return the period of a controller that samples, s, and its function, checked.

    A fixed step divides the period; a sample has so many numbers.
    """
    if request.hold is None:
        return None
    if not callable(request.torque):
        raise InputError("hold: expected a torque function, which is sampled; an array is held as it is")
    hold, eps = real("hold", request.hold, positive=True), EPS
    steps = hold / dt if dt else 1.0
    if not (1 - PRINTED <= steps < np.inf and abs(steps - round(steps)) <= PRINTED):
        raise InputError(f"hold: expected a multiple of the step, {dt:g} s, got {hold:g} s")
    if not hold > 4 * eps * max(abs(start), abs(end)):
        raise InputError(f"hold: expected samples at times that differ, got {hold:g} s beside t = {end:g} s")
    check_room((end - start) / hold, numbers, f"hold: {hold:g} s makes", "sample less often")
    return hold, request.torque


def _limits(model: Model, saturate: bool) -> Array | None:
    """Return the effort limits of a run that saturates, (nv,); a warning names those of mimic joints."""
    if not isinstance(saturate, (bool, np.bool_)):
        raise InputError(f"saturate: expected True or False, got {saturate!r}")
    if not saturate:
        return None
    mimics = ", ".join(j.name for j in model.joints if j.mimic and np.isfinite(j.effort_limit).any())
    left_out = f"; those of mimic joints do not act in a run: {mimics}" if mimics else ""
    if not np.isfinite(model.effort_limits).any():
        raise InputError(f"saturate: expected joints with effort_limit=...; {model.name} has none{left_out}")
    if left_out:
        warn(f"{model.name}: saturate: effort limits act on independent joints{left_out}", MbkitWarning)
    return model.effort_limits


def _intervals(
    times: Array | None, start: float, duration: float, hold: float, *, rows: bool
) -> tuple[Array, list[int], Indices | None]:
    """Return the ends of the intervals with one force each, where samples begin among them, and rows of a table.

    A table of wrenches, where there are `rows` of one, has a row between two `times`.
    """
    count = max(1, int(np.ceil(duration / hold - PRINTED)))
    ends: Array = np.append(start + hold * np.arange(count, dtype=float), start + duration)
    if times is not None and len(times):
        # A saved time that is a sample's to rounding is the same time.
        inner, allowed = ends[1:-1], PRINTED * hold
        near = times[np.minimum(np.searchsorted(times, inner - allowed), len(times) - 1)]
        ends[1:-1] = np.where(np.abs(near - inner) <= allowed, near, inner)
    if not rows or times is None:
        return ends, [*range(count + 1)], None
    every = np.union1d(times, ends)
    table = np.clip(np.searchsorted(times, every[:-1], side="right") - 1, 0, len(times) - 2)
    return every, np.searchsorted(every, ends).tolist(), table


def _acting(dyn: Dynamics, wrenches: RunWrenches | None, axes: str) -> Acting | None:
    """Return the frames on which wrenches act, and the axes of these; None where there are none."""
    axes = axes_named(axes)
    if wrenches is not None and not isinstance(wrenches, Mapping):
        raise InputError(
            "wrenches: expected a dict of frame names to arrays or functions of (t, q, v), "
            f"got {type(wrenches).__name__}"
        )
    return (tuple(map(dyn.model.frame, wrenches)), axes) if wrenches else None


def _outcome(problem: IntegrationProblem, method: Method, in_parts: InParts | None) -> SolverResult:
    dyn, read = problem.dyn, problem.torque
    if "jump" in method.carries and "jump" not in dyn.model.effects:
        # Without jumps its step is that of this method.
        method = METHODS[EULER_METHOD]
    elif method.kind == "adaptive" and not dyn.model.nv:
        # Where nothing moves, other methods have no scale and no series.
        method = METHODS[ADAPTIVE_METHOD]
    problem = replace(problem, method=method.name)
    if dyn._soft_jumps and "jump" in method.carries:
        raise UnsupportedError(
            f"{method.name}: solves exact {_DRY}, and {dyn.engine} was asked for its own; "
            f"leave {', '.join(dyn._soft_jump_options)} out"
        )
    native = method.kind == "native"
    if not dyn._soft_jumps and (native or not (method.events or problem.equal_steps)):
        options = dyn._soft_jump_options if native and dyn.model.needs.friction else {}
        own = ", ".join(f"{name}={value}" for name, value in options.items())
        soft = f" (mbkit.dynamics(model, {dyn.engine!r}, {own}) has {_DRY} of its own, which is soft)" if own else ""
        SMOOTH_RUNS.admit(dyn.model, f"{method.name}{soft}: not known of")
    elif not dyn._soft_jumps:
        RUNS.admit(dyn.model)
    if "jump" in method.carries:
        return _solver(dyn, method, read)(problem)

    def solver(smooth: Dynamics) -> Solver:
        return lambda part: along_constraints(smooth, _solver(smooth, method, read)(part))

    if "jump" in dyn.model.effects and not dyn._soft_jumps:
        from mbkit.simulate.solvers.in_phases.runs import run_in_phases as in_parts
    return solver(dyn)(problem) if in_parts is None else in_parts(problem, solver)


def _solver(dyn: Dynamics, method: Method, torque: Torque) -> Solver:
    """Return the function that runs a method, imported when it is first needed."""
    module, function = method.solver.split(":")
    compiles = method.kind == "fixed" and method.compiled and method.formula
    as_data = not torque.callable or (torque.feedback is not None and method.explicit)
    if compiles and as_data and _compiles(dyn):
        module, function = "compiled_fixed_step", "run_rollout"
    run: Solver = solvers.load(module, function)
    return run


def _compiles(dyn: Dynamics) -> bool:
    """Return whether whole steps can be compiled: own derivation, written out, and a compiler."""
    return bool(getattr(dyn, "_compiles_steps", False))


def times_of(
    dyn: Dynamics, method: Method, t0: float | None, duration: float, dt: float | None
) -> tuple[float, float, float]:
    """Return the first time, the duration and the step, checked; s."""
    duration = real("duration", duration, nonnegative=True)
    if 0 < duration < np.finfo(float).tiny:
        raise InputError(f"duration: expected 0 or at least {np.finfo(float).tiny:.3g} s, got {duration:g} s")
    step = DEFAULT_STEP if dt is None else real("dt", dt, positive=True)
    if dt is not None and method.kind == "adaptive":
        raise InputError(f"dt: {method.name} chooses its own steps; give rtol, or method={DEFAULT_METHOD!r} with dt")
    start = _held_time(dyn) if t0 is None else real("t0", t0)
    dyn.model.require_times("simulate", start, start + duration)
    shortest = duration if method.kind == "adaptive" else min(duration, step)
    if 4 * EPS * abs(start) > shortest > 0:
        raise InputError(f"t0: expected times that differ after {shortest:g} s, got {start:g} s; shift the time's zero")
    return start, duration, step


def _warn_beyond_limits(model: Model, q: Array) -> None:
    """Warn of a start beyond a joint's limits, which do not act: degrees are a common reason."""
    low, high = model.lower, model.upper
    room = 1e-9 * np.maximum(1.0, np.maximum(np.abs(low), np.abs(high)))
    rows = np.atleast_2d(q)
    beyond = (rows < low - room) | (rows > high + room)
    if beyond.any():
        row, i = np.argwhere(beyond)[0]
        which = f"trajectory {row}: " if q.ndim == 2 else ""
        more = np.count_nonzero(beyond) - 1
        warn(
            f"{model.name}: q0: {which}{model.coordinate_names[i]} = {rows[row, i]:g} is beyond its limits "
            f"[{low[i]:g}, {high[i]:g}]"
            + (f", and {more} more" if more else "")
            + "; limits do not act in a run, and angles are in radians",
            MbkitWarning,
        )


def _held_time(dyn: Dynamics) -> float:
    """Return the time at which the dynamics stands, s; 0 where time does not enter."""
    clock = dyn.model.time_parameter
    if clock is None:
        return 0.0
    values = getattr(dyn, "_parameter_values", np.array([*dyn.model.parameters.values()]))
    held = np.unique(np.atleast_2d(values)[:, list(dyn.model.parameters).index(clock)])
    if len(held) != 1:
        raise InputError(f"t0: the samples hold {len(held)} different values of {clock}; give one start time, t0=")
    return float(held[0])


def _require_engine(dyn: Dynamics, method: Method) -> None:
    if not method.on(dyn.engine):
        has = " or ".join(f"mbkit.dynamics(model, {name!r})" for name in method.engines)
        why = f", which {method.lacks}" if method.lacks else ""
        raise UnsupportedError(
            f"{method.name}: not on the {dyn.engine} engine{why}; use {has}, or a method that any engine has: "
            + ", ".join(m.name for m in METHODS.values() if not m.engines)
        )


def _batch(dyn: Dynamics, states: int | None) -> int | None:
    samples = states if dyn._samples is None else dyn._samples
    if states not in (None, samples):
        raise InputError(f"q0, v0: a batch of {states}, but the parameters' values are {samples}")
    return samples


def _tolerances(dyn: Dynamics, method: Method, rtol: float | None, atol: float | None) -> Tolerances:
    rtol = 1e-10 if rtol is None else real("rtol", rtol, positive=True)
    least = _MIN_RTOL_EXTENDED if dyn._significand_bits > DOUBLE_BITS and method.extended else method.least
    if rtol < least:
        raise InputError(f"rtol: expected at least {least:.3g} for {method.name} on {dyn.engine}, got {rtol:g}")
    return Tolerances(rtol, rtol if atol is None else real("atol", atol, positive=True))


def _refuse_tolerances(method: Method, rtol: float | None, atol: float | None) -> None:
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            raise InputError(
                f"{name}: {method.name} has a fixed step and no tolerance; give dt, or method={ADAPTIVE_METHOD!r}"
            )
