"""`simulate`: integrate a run, check it, and return its trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from numpy.typing import ArrayLike

from mbkit.engines import Dynamics
from mbkit.engines.base import no_dynamics
from mbkit.engines.frames_and_momenta import ALIGNED
from mbkit.errors import DoubtfulRunWarning, FunctionError, MbkitWarning, warn
from mbkit.methods.registry import DEFAULT_METHOD
from mbkit.simulate.events import Event
from mbkit.simulate.integrate import integrate
from mbkit.simulate.problem import RunRequest
from mbkit.simulate.progress import ProgressFunction
from mbkit.simulate.torque import RunWrenches, TorqueFunction
from mbkit.simulate.trajectory import Trajectory

if TYPE_CHECKING:
    from mbkit.lagrangian.independent_coordinates import Embedded


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
    wrenches: RunWrenches | None = None,
    wrench_axes: str = ALIGNED,
    hold: float | None = None,
    saturate: bool = False,
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
        s. The run ends exactly there: where it is no multiple of `dt`, the last step is shorter.
    method : str
        With a step: ``"rk4"`` and ``"semi_implicit_euler"``, MuJoCo 4's formulas on any engine; ``"moreau"``, for many
        joints with dry friction; ``"gauss4"`` and ``"gauss6"``, implicit, on any engine; ``"implicit_midpoint"``,
        symplectic, on the own derivation; ``"mujoco_euler"``, ``"mujoco_rk4"``, ``"mujoco_implicit"``,
        ``"mujoco_implicitfast"`` and ``"mujoco_discrete"``, MuJoCo's own on its engine. With a tolerance: ``"rk853"``,
        fastest on the own derivation, and ``"dop853"``, ``"radau"``, ``"bdf"``, ``"lsoda"``, SciPy's, on any engine
        (the last three are for stiff scenes); ``"taylor"``, heyoka's, on the own derivation, and on the oracle with
        34 digits. `mbkit.simulate.METHODS` describes them.
    dt : float, optional
        Step of a method with a fixed step, s; 1e-3 by default. An adaptive method has none.
    rtol, atol : float, optional
        Tolerances of an adaptive method, from ``METHODS[method].least`` upwards; by default 1e-10, `atol` as `rtol`.
    torque : array_like or callable, optional
        Generalized force τ: (nv,) all the time; (steps, nv) or (N, steps, nv), held over each step (for an adaptive
        method, each interval of `save`, which then runs from `t0` to the end); or a function of (t, q, v) that
        returns (nv,), called for one state at a time, at each stage; a controller that samples takes `hold`. A
        `StateFeedback` is such a function too, which fixed steps on the own derivation evaluate in machine code, and
        `mbkit.simulate.Policy` one of all states of a batch.
    save : int or (K,) array_like, optional
        Which states to keep: every n-th and the last, or those at these times (for a fixed step, multiples of it after
        `t0`); by default all. An adaptive method takes times alone; a batch needs them, and so do Drake's.
        Steps of ``"dop853"`` and ``"radau"`` end on them; the others' do not depend on them.
    progress : bool or callable, optional
        True shows a bar when the run takes more than 2 s; a callable gets the fraction done.
    events : Event or sequence of Event, optional
        What ends the run or is noted on the way, for methods that have events: `mbkit.simulate.at_limits`, `at_energy`,
        `at_section`, or an `Event` of any function of (t, q, v). ``Trajectory.events`` has those that happened. Where
        one ends a single run, its state is the last one of the trajectory too; each trajectory of a batch ends by
        itself, is NaN at the saved times after that, and has the event's state in ``Trajectory.events`` alone.
    doubt : bool
        Whether a finished run is checked for energy from nowhere, a singular mass matrix, coordinates beyond the
        digits of a double, tolerances that add up and gimbal lock. That takes a few percent of the run; so short
        runs, as of machine code with fewer than 4,000 evaluations, are checked for the first two only where two steps
        of half the length lead elsewhere than one. Signs of an error are warned of, and kept in
        ``Trajectory.stats.doubts``. `Trajectory.check` does all checks.
    t0 : float, optional
        Time of the first state, s; by default the time that `dyn` holds where time enters the equation of motion
        (``dyn.at(t=3.0)``), else 0. `save`, torque and event functions and ``Trajectory.t`` count from the same zero.

    wrenches : dict of str to array_like or callable, optional
        Frame or body -> force, N, then moment, Nm, about the frame's origin: (6,) all the time; (N, 6), one for each
        trajectory; (steps, 6) or (N, steps, 6), held over each step as `torque` is; or a function of (t, q, v) that
        returns (6,). What is held is the wrench: its generalized force Jᵀ w follows the configuration at every stage.
    wrench_axes : {"local", "local_world_aligned", "world"}
        Axes of the wrenches, with the default of `Dynamics.jacobian` and `Dynamics.generalized_force`: the world's
        axes. ``"local"`` are the frame's own. ``"world"`` has moments about the world's origin.
    hold : float, optional
        Period of a controller that samples, s: `torque` is called at the start and every `hold` seconds, with the state
        there, and its answer is held until the next call. A fixed step must divide it. On every method, MuJoCo's own
        too. Without `save`, an adaptive method keeps the states at the samples.
    saturate : bool
        Whether `torque`, of any kind, is clipped to the effort limits, ``model.effort_limits``; wrenches and passive
        forces are not. A limit is on the torque of the joint's own velocity: those of mimic joints, whose forces are
        part of the leader's torque, do not act, with a warning. ``Trajectory.tau`` and all that follows from it have
        the clipped torque; `stats.saturated` has where, how often and by how much it was clipped. For that a function
        without `hold` is called once more at each kept state; stages do not count.

    Returns
    -------
    Trajectory
        Of a run that diverged, the states up to then, with `stats.ended`, `stats.reached` and `stats.message`, and an
        `MbkitWarning`. In a batch the others go on. With dry friction `events` has where each of them
        stops, lets go or turns, with joint stops where it hits, leaves or comes to rest on one, and a run in which that
        cannot be decided ends there. A fixed step h does not see that a joint is beyond its stop within the step alone,
        by up to a h²/8; an adaptive method does.

    Raises
    ------
    InputError
        A wrong shape, state, time, tolerance, torque or wrench; `saturate` without an effort limit.
    TorqueError, EventError
        The function of the torque, of a wrench or of an event raised, or returned something else than (nv,) or (6,)
        finite numbers or one; the error's `trajectory` is the run up to then.
    UnknownNameError
        No method or frame of this name.
    UnsupportedError
        The engine does not have this method, or not for this model.

    Notes
    -----
    On the lagrangian engine, ``"rk4"`` and ``"semi_implicit_euler"`` with no torque or an array run as machine code:
    the whole step is one function, or, beyond 20,000 operations, parts around the forward dynamics. Chunks of a batch
    are shared among the cores, and no number depends on how. ``"implicit_midpoint"``, and ``"rk853"`` with the choice
    of its steps, are machine code too. The first run of a model compiles its step, which is kept on disk; so does the
    first run with wrenches on other frames or in other axes. A callable torque or wrench and an engine with
    ``compile=False`` are stepped stage by stage, by the same formulas.

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
    request = RunRequest(
        *(q0, v0, duration, method, dt, rtol, atol, torque, save),
        *(progress, events, doubt, t0, wrenches, wrench_axes, hold, saturate),
    )
    error: FunctionError | None
    if isinstance(dyn, Dynamics):
        data, error = integrate(dyn, request)
    elif hasattr(dyn, "chart"):
        # Only where SymPy and CasADi are loaded already.
        from mbkit.simulate.independent_coordinates import integrate_on_charts

        data, error = integrate_on_charts(dyn, request)
    else:
        raise no_dynamics(dyn)
    run = Trajectory(**vars(data))
    if error is not None:
        error.trajectory = run
        raise error
    title = f"{run.model.name}: {run.method}"
    if run.stats.message and run.stats.ended != "event":
        warn(f"{title} {run.stats.message}", MbkitWarning)
    for one in run.stats.doubts:
        warn(f"{title}: {one}", DoubtfulRunWarning)
    return run
