"""`simulate`: check what was asked, choose the integrator, wrap what it found."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of, real
from mbkit.engines import Dynamics
from mbkit.engines.base import DOUBLE_BITS, no_dynamics
from mbkit.errors import DoubtfulRunWarning, InputError, MbkitWarning, UnsupportedError
from mbkit.methods.registry import ADAPTIVE_METHOD, DEFAULT_METHOD, METHODS, Method, Tolerances, method_of
from mbkit.model import Model
from mbkit.simulate.constraint_projection import along_constraints, from_consistent
from mbkit.simulate.diagnostics.checks import doubts, halved, idle
from mbkit.simulate.events import Event, as_events
from mbkit.simulate.problem import IntegrationProblem
from mbkit.simulate.progress import Progress, ProgressFunction
from mbkit.simulate.result import SolverResult, Stats
from mbkit.simulate.time_grid import DEFAULT_STEP, Grid, save_times
from mbkit.simulate.torque import Applied, Torque, TorqueFunction
from mbkit.simulate.trajectory import Trajectory

if TYPE_CHECKING:
    from mbkit.lagrangian.independent_coordinates import Embedded

__all__ = ["fixed_runner", "simulate", "solver_of"]


# Which solver runs a method, each imported when it is first needed.


def solver_of(method: Method) -> Callable[..., SolverResult]:
    """Return the function that runs a method: run(problem), or with a step what `run_fixed` takes."""
    module, function = method.solver.split(":")
    run: Callable[..., SolverResult] = getattr(import_module(f"mbkit.simulate.solvers.{module}"), function)
    return run


def fixed_runner(method: Method, dyn: Dynamics, torque: Torque) -> Callable[..., SolverResult]:
    """Return run(dyn, method, q0, v0, grid, kept, torque, bar)."""
    if method.compiled and method.formula is not None and not torque.callable and _compiles(dyn):
        from mbkit.simulate.solvers.compiled_fixed_step import run_rollout

        return run_rollout
    return solver_of(method)


def _compiles(dyn: Dynamics) -> bool:
    """Return whether whole steps can be compiled: own derivation, written out, and a compiler."""
    if not dyn.derived:
        return False
    # Other engines need no CasADi.
    from mbkit.codegen.interpreter import Machine
    from mbkit.engines.lagrangian import LagrangianDynamics

    # A compiled step has one value of each parameter, the time among them.
    if not isinstance(dyn, LagrangianDynamics) or not dyn.model.nv or not dyn.written_out or dyn.model.time_parameter:
        return False
    # Nor does it look for constraints after each step.
    if dyn.model.constrained:
        return False
    return not isinstance(dyn.code("forward_dynamics"), Machine)


# The oracle computes with 113 bits.
_LEAST_EXTENDED: Final = 1e-32
#: Steps between which a method of first order is held against itself at twice the step, which costs half a run.
_FEWEST: Final = 4
_MOST: Final = 20_000


def simulate(
    dyn: Dynamics | Embedded,
    q0: ArrayLike,
    v0: ArrayLike,
    duration: float,
    method: str = DEFAULT_METHOD,
    dt: float | None = None,
    rtol: float | None = None,
    atol: float | None = None,
    torque: ArrayLike | TorqueFunction | None = None,
    save: ArrayLike | int | None = None,
    progress: bool | ProgressFunction | None = None,
    events: Event | Sequence[Event] | None = None,
    doubt: bool = True,
    t0: float | None = None,
) -> Trajectory:
    """Integrate v̇ = forward_dynamics(q, v, τ), q̇ = D(q) v from one state or a batch.

    Parameters
    ----------
    dyn : Dynamics or Embedded
        From `mbkit.dynamics`; or a system under constraints on independent coordinates,
        from ``lag.embedded()``, with states and torques on all coordinates.
    q0 : (nq,) or (N, nq) array_like
    v0 : (nv,) or (N, nv) array_like
        A single state beside a batch is repeated.
    duration : float
        s. The run ends exactly there: where it is no multiple of `dt`, the last
        step is shorter.
    method : str
        With a step: ``"rk4"`` and ``"semi_implicit_euler"``, MuJoCo 4's formulas on
        any engine; ``"gauss4"`` and ``"gauss6"``, implicit, on any engine;
        ``"implicit_midpoint"``, symplectic, on the own derivation; ``"mujoco_euler"``,
        ``"mujoco_rk4"``, ``"mujoco_implicit"``, ``"mujoco_implicitfast"`` and
        ``"mujoco_discrete"``, MuJoCo's own on its engine. With a tolerance:
        ``"rk853"``, fastest on the own derivation, and ``"dop853"``, ``"radau"``,
        ``"bdf"``, ``"lsoda"``, SciPy's, on any engine (the last three are for stiff
        scenes); ``"taylor"``, heyoka's, and ``"cvodes"``, SUNDIALS', on the own
        derivation; ``"taylor"`` on the oracle computes with 34 digits.
        `mbkit.simulate.METHODS` describes them.
    dt : float, optional
        Step of a method with a fixed step, s; 1e-3 when not given. An adaptive method has none.
    rtol, atol : float, optional
        Tolerances of an adaptive method, from ``METHODS[method].least`` upwards;
        1e-10, and `atol` as `rtol`, when not given. A method with a fixed step has none.
    torque : array_like or callable, optional
        Generalized force τ: (nv,) all the time; (steps, nv) or (N, steps, nv),
        held over each step (for an adaptive method, each interval of `save`, which
        then runs from `t0` to the end); or a function of (t, q, v) that returns
        (nv,), called for one state at a time, at each stage.
    save : int or (K,) array_like, optional
        Which states to keep: every n-th and the last, or those at these times (for a
        fixed step, multiples of it after `t0`). Everything when not given. An adaptive method
        takes times alone; a batch needs them, and so does ``"cvodes"``. Steps of
        ``"dop853"`` and ``"radau"`` end on them; the others' do not depend on them.
    progress : bool or callable, optional
        True shows a bar when the run takes more than 2 s; a callable gets the
        fraction done.
    events : Event or sequence of Event, optional
        What ends the run or is noted on the way, for methods that have events:
        `mbkit.simulate.at_limits`, `at_energy`, `at_section`, or an `Event` of any
        function of (t, q, v). What happened is in ``Trajectory.events``. Where one ends
        a single run, its state is the last one of the trajectory too; each trajectory
        of a batch ends by itself, is NaN at the saved times after that, and has the
        event's state in ``Trajectory.events`` alone.
    doubt : bool
        Whether a finished run is looked at for signs that it is wrong: energy from nowhere, a step
        too long for the fastest mode, a singular mass matrix, coordinates beyond the digits of a
        double. That takes 0.2 to 2 ms for a small robot, whatever the length of the run. A method of
        first order without torques, up to 20,000 steps, is also compared with itself at twice the step,
        which takes up to half a run more (of a batch, of its first trajectory). What is found is warned of,
        and in ``Trajectory.stats.doubts``.

    t0 : float, optional
        Time of the first state, s. When not given, the time that `dyn` holds where time enters the
        equation of motion (``dyn.at(t=3.0)``), else 0. All times of the run count from the same zero:
        `save`, those of torque and event functions, ``Trajectory.t``.

    Returns
    -------
    Trajectory
        Of a run that diverged, what there is up to then, with `stats.ended`,
        `stats.reached` and `stats.message`, and an `MbkitWarning`. In a batch the
        others go on.

    Raises
    ------
    InputError
        A wrong shape, state, time, tolerance or torque.
    TorqueError
        The torque function raised, or returned something else than (nv,) finite
        numbers; its `trajectory` is the run up to then.
    EventError
        An event's function did; its `trajectory` likewise.
    UnknownNameError
        No method of this name.
    UnsupportedError
        The engine does not have this method, or not for this model.

    Notes
    -----
    On the lagrangian engine, ``"rk4"`` and ``"semi_implicit_euler"`` with no torque or
    an array run as machine code: the whole step is one function, or, where that would be
    beyond 20,000 operations, parts around the forward dynamics; chunks of a batch are
    shared among the cores, and no number depends on how. ``"implicit_midpoint"``, and
    ``"rk853"`` with the choice of its steps, are machine code too. The first run of a
    model compiles its step, which is kept on disk. A callable torque, an engine made with
    ``compile=False``, and models so large that their forward dynamics is not written
    out are stepped stage by stage, by the same formulas.

    Examples
    --------
    >>> import mbkit as mb
    >>> dyn = mb.dynamics(mb.catalog.pendulum())
    >>> run = mb.simulate(dyn, [1.0], [0.0], duration=2.0, dt=1e-3)
    >>> run.q.shape
    (2001, 1)
    >>> bool(abs(run.energy() - run.energy()[0]).max() < 1e-12)
    True
    """
    if not isinstance(dyn, Dynamics):
        if hasattr(dyn, "chart"):
            # Only where SymPy and CasADi are loaded already.
            from mbkit.simulate.independent_coordinates import run_on_charts

            chosen = method_of(method)
            start, duration, dt = _times(dyn.dynamics, chosen, t0, duration, dt)
            given = q0, v0, start, duration, dt, rtol, atol, torque, save, as_events(events)
            bar = Progress(progress, f"{dyn.model.name}: {method} on independent coordinates")
            return run_on_charts(dyn, chosen, *given, bar)
        raise no_dynamics(dyn)
    chosen = method_of(method)
    model = dyn.model
    q, v = model.check_q(q0, "q0"), model.check_v(v0, "v0")
    if model.velocity_map is not None:
        model.velocity_map.check_start(q, v)
    batch = _batch(dyn, batch_of(q0=q, v0=v))
    if batch is not None:
        q, v = np.broadcast_to(q, (batch, model.nq)), np.broadcast_to(v, (batch, model.nv))
    start, duration, dt = _times(dyn, chosen, t0, duration, dt)
    _require_engine(dyn, chosen)
    q, v = from_consistent(dyn, q, v, start)
    wanted = as_events(events)
    if wanted and not chosen.events:
        _refuse("events", chosen, [m.name for m in METHODS.values() if m.events])
    if callable(torque) and not chosen.callables:
        _refuse("torque functions", chosen, [m.name for m in METHODS.values() if m.callables])
    _warn_beyond_limits(model, q)
    bar = Progress(progress, f"{model.name}: {method} on {dyn.engine}")
    arguments: dict[str, Any] = {"batch": batch, "torque": torque, "save": save, "bar": bar}
    started = time.perf_counter()
    with bar:
        if chosen.kind == "adaptive":
            applied, outcome = _adaptive(dyn, chosen, q, v, start, duration, rtol, atol, events=wanted, **arguments)
        else:
            _refuse_tolerances(chosen, rtol, atol)
            applied, outcome = _stepped(dyn, chosen, q, v, Grid.of(start, duration, dt), **arguments)
    seconds = time.perf_counter() - started
    setting = dt if chosen.kind != "adaptive" else _tolerances(dyn, chosen, rtol, atol)
    outcome = along_constraints(dyn, outcome)
    if outcome.last is not None:
        outcome = replace(outcome, message=outcome.message + idle(dyn, outcome.last))
    found: list[str] = []
    if doubt and outcome.ended in ("finished", "event"):
        states = _from_start(outcome, start, q, v)
        found = doubts(dyn, chosen, setting, *states, pushed=torque is not None, steps=outcome.steps)
        steps = round(duration / dt)
        first_order = chosen.order == 1 and chosen.kind != "adaptive"
        if first_order and torque is None and _FEWEST <= steps <= _MOST and not model.time_parameter and v.size:
            one = (dyn, q, v) if batch is None else (dyn.of_samples([0]), q[:1], v[:1])
            found += halved(model, chosen.name, dt, states, lambda times: _coarser(one, chosen.name, start, dt, times))
    return _wrapped(dyn, chosen, applied, outcome, seconds, (*outcome.doubts, *found))


@runtime_checkable
class TakesParameters(Protocol):
    """An engine whose parameters may have a value for each sample."""

    @property
    def parameter_values(self) -> Array:
        """Values of the model's parameters, (p,) or one row per sample."""


def _times(
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
    shortest = duration if method.kind == "adaptive" else min(duration, step)
    if 4 * np.finfo(float).eps * abs(start) > shortest > 0:
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
        warnings.warn(
            f"{model.name}: q0: {which}{model.coordinate_names[i]} = {rows[row, i]:g} is beyond its limits "
            f"[{low[i]:g}, {high[i]:g}]"
            + (f", and {more} more" if more else "")
            + "; limits do not act in a run, and angles are in radians",
            MbkitWarning,
            stacklevel=3,
        )


def _held_time(dyn: Dynamics) -> float:
    """Return the time at which the dynamics stands, s; 0 where time does not enter."""
    clock = dyn.model.time_parameter
    if clock is None:
        return 0.0
    if isinstance(dyn, TakesParameters):
        held = np.unique(np.atleast_2d(dyn.parameter_values)[:, list(dyn.model.parameters).index(clock)])
    else:
        held = np.array([dyn.model.parameters[clock]])
    if len(held) != 1:
        raise InputError(f"t0: the samples hold {len(held)} different values of {clock}; give one start time, t0=")
    return float(held[0])


def _from_start(outcome: SolverResult, start: float, q0: Array, v0: Array) -> tuple[Array, Array, Array]:
    """Return what was kept, with the start."""
    if len(outcome.t) and outcome.t[0] == start:
        return outcome.t, outcome.q, outcome.v
    q, v = (np.concatenate([x[..., None, :], kept], -2) for x, kept in ((q0, outcome.q), (v0, outcome.v)))
    return np.append(start, outcome.t), q, v


def _coarser(
    one: tuple[Dynamics, Array, Array], method: str, start: float, dt: float, times: Array
) -> tuple[Array, Array] | None:
    """Return q and v at some times with a step twice as long; None where it does not get there."""
    dyn, q, v = one
    if dyn.samples is None:
        q, v = np.atleast_2d(q)[0], np.atleast_2d(v)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MbkitWarning)
        run = simulate(dyn, q, v, float(times[-1]) - start, method, 2 * dt, save=times, doubt=False, t0=start)
    count = len(times)
    return (run.q.reshape(count, -1), run.v.reshape(count, -1)) if run.stats.finished else None


def _require_engine(dyn: Dynamics, method: Method) -> None:
    if method.engines and dyn.engine not in method.engines:
        has = " or ".join(f"mbkit.dynamics(model, {name!r})" for name in method.engines)
        why = f", which {method.lacks}" if method.lacks else ""
        raise UnsupportedError(
            f"{method.name}: not on the {dyn.engine} engine{why}; use {has}, or a method that any engine has: "
            + ", ".join(m.name for m in METHODS.values() if not m.engines)
        )


def _refuse(what: str, method: Method, others: Sequence[str]) -> None:
    raise UnsupportedError(f"{method.name}: {what} are not there with this method; use {', '.join(others)}")


def _batch(dyn: Dynamics, states: int | None) -> int | None:
    samples = states if dyn.samples is None else dyn.samples
    if states not in (None, samples):
        raise InputError(f"q0, v0: a batch of {states}, but the parameters' values are {samples}")
    return samples


def _adaptive(
    dyn: Dynamics,
    method: Method,
    q: Array,
    v: Array,
    start: float,
    duration: float,
    rtol: float | None,
    atol: float | None,
    *,
    batch: int | None,
    torque: ArrayLike | TorqueFunction | None,
    save: ArrayLike | int | None,
    bar: Progress,
    events: tuple[Event, ...],
) -> tuple[Applied | None, SolverResult]:
    tolerances = _tolerances(dyn, method, rtol, atol)
    if isinstance(save, (int, np.integer)):
        raise InputError(f"save: expected a grid of times for an adaptive method, got the count {save}")
    times = None if save is None else save_times(save, start, start + duration)
    whole = times is not None and times[0] == start and times[-1] == start + duration
    read = Torque(torque, dyn.model, batch, len(times) - 1 if whole and times is not None else None)
    given = dyn, method.name, q, v, start, duration, tolerances, read, times, events, bar
    outcome = solver_of(method)(IntegrationProblem(*given))
    return read.applied(times), outcome


def _tolerances(dyn: Dynamics, method: Method, rtol: float | None, atol: float | None) -> Tolerances:
    rtol = 1e-10 if rtol is None else real("rtol", rtol, positive=True)
    least = _LEAST_EXTENDED if dyn.bits > DOUBLE_BITS and method.extended else method.least
    if rtol < least:
        raise InputError(f"rtol: expected at least {least:.3g} for {method.name} on {dyn.engine}, got {rtol:g}")
    return Tolerances(rtol, rtol if atol is None else real("atol", atol, positive=True))


def _refuse_tolerances(method: Method, rtol: float | None, atol: float | None) -> None:
    for name, value in (("rtol", rtol), ("atol", atol)):
        if value is not None:
            raise InputError(
                f"{name}: {method.name} has a fixed step and no tolerance; give dt, or method={ADAPTIVE_METHOD!r}"
            )


def _stepped(
    dyn: Dynamics,
    method: Method,
    q: Array,
    v: Array,
    grid: Grid,
    *,
    batch: int | None,
    torque: ArrayLike | TorqueFunction | None,
    save: ArrayLike | int | None,
    bar: Progress,
) -> tuple[Applied | None, SolverResult]:
    model = dyn.model
    kept = grid.kept(save, (model.nq + model.nv) * (1 if batch is None else batch))
    read = Torque(torque, model, batch, grid.steps)
    if method.kind == "native":
        outcome = solver_of(method)(dyn, method, q, v, grid, kept, read, bar)
        bar.update(1.0)
    else:
        outcome = fixed_runner(method, dyn, read)(dyn, method.name, q, v, grid, kept, read, bar)
    return read.applied(grid.times), outcome


def _wrapped(
    dyn: Dynamics,
    method: Method,
    applied: Applied | None,
    outcome: SolverResult,
    seconds: float,
    found: tuple[str, ...],
) -> Trajectory:
    reached = outcome.reached
    stats = Stats(
        steps=outcome.steps,
        evaluations=outcome.evaluations,
        seconds=seconds,
        ended=outcome.ended,
        reached=float(reached) if reached.ndim == 0 else tuple(reached.tolist()),
        message=outcome.message,
        rejected=outcome.rejected,
        jacobians=outcome.jacobians,
        chosen=outcome.chosen,
        doubts=found,
    )
    states = outcome.t, outcome.q, outcome.v
    run = Trajectory(*states, dyn.model, method.name, dyn.engine, stats, dyn, outcome.events, applied)
    if outcome.error is not None:
        outcome.error.trajectory = run
        raise outcome.error
    if outcome.message and outcome.ended != "event":
        warnings.warn(f"{dyn.model.name}: {method.name} {outcome.message}", MbkitWarning, stacklevel=3)
    for one in found:
        warnings.warn(f"{dyn.model.name}: {method.name}: {one}", DoubtfulRunWarning, stacklevel=3)
    return run
