"""Runs of described systems from one start under one controller, each with the settings of its simulator."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, count, finite_array, real
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.engines.registry import ENGINES, MUJOCO, PINOCCHIO
from mbkit.errors import InputError, MbkitError, MbkitWarning, TorqueError, UnsupportedError
from mbkit.methods.registry import METHODS, SCIPY_METHOD, method_of
from mbkit.methods.simulation_settings import Settings
from mbkit.model import Model
from mbkit.model.joint_types import JointType
from mbkit.simulate import simulate
from mbkit.studies.explain.worlds import World
from mbkit.studies.results import counted

#: u(t, q, v) -> (nv,): what the servo of each velocity takes, or its torque.
Controller = Callable[[float, Array, Array], ArrayLike]
#: What a simulation is run with where neither side says it.
DEFAULTS: Final = Settings(MUJOCO, ENGINES[MUJOCO].rk4, 1e-3, True, "newton", 100, 1e-8, False, (), 1e-2)
#: Engine and method where MuJoCo cannot hold a description as it is.
EXACT: Final = (PINOCCHIO, SCIPY_METHOD)
#: Bandwidth of the controller that holds a posture, rad/s.
_BANDWIDTH: Final = 10.0
#: Distance of the posture from the start, rad or m, and the size of the starting velocities, rad/s or m/s.
_POSTURE: Final = 0.3
_SPEED: Final = 0.5
#: Tolerance of methods with one.
_RTOL: Final = 1e-10
#: Step of engines' own integrators where nobody has said it, s.
_ENGINE_STEP: Final = 2e-3
#: Period of the times at which runs are compared, s.
_PERIOD: Final = 1e-2


@dataclass(frozen=True, kw_only=True)
class Motion:
    """How two described systems are moved by `mbkit.explain`.

    Attributes
    ----------
    controller : {"posture", "passive"}, callable or (K, nv) array_like
        ``"posture"`` holds a posture near the start: by the servos where a file has them, else by torques, a PD
        controller whose gains the result tells. A function of (t, q, v) returns (nv,): for each velocity what its servo
        takes (a target of a position servo), or its torque. It gets q and v in each side's own order, as a policy does
        that knows no names. One with a memory has a method ``reset()``, called before each run. A table is held row by
        row, each for a control period.
    times : tuple of float
        When the effects are read, s; the last one ends the runs.
    bound : float
        rad or m; the result says when each cause passes it.
    q, v : array_like, optional
        The start, in the first description's coordinates; by default a random one within its limits.
    seed : int
        Of the random start.
    settings : (Settings or None, Settings or None)
        Settings of the two simulators, as `mbkit.studies.explain.file_settings` reads them of an MJCF. What one side
        has not said it takes from the other, and the result names it as not compared. Where neither says an engine,
        both run with MuJoCo's RK4 at 1 ms, or with ``dop853`` where MuJoCo does not hold a description as it is.
    left_out : (tuple of str, tuple of str)
        What each side's simulator has besides, which no run has.

    Raises
    ------
    InputError
        An unusable time, bound or controller.
    """

    controller: str | Controller | ArrayLike = "posture"
    times: tuple[float, ...] = (0.1, 1.0, 5.0)
    bound: float = 0.05
    q: ArrayLike | None = None
    v: ArrayLike | None = None
    seed: int = 0
    settings: tuple[Settings | None, Settings | None] = (None, None)
    left_out: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())

    def __post_init__(self) -> None:
        times = finite_array("times", self.times, (len(self.times),))
        if not len(times) or not (np.diff([0.0, *times]) > 0).all():
            raise InputError(f"times: expected increasing times after 0 s, got {self.times}")
        real("bound", self.bound, positive=True)
        count("seed", self.seed)
        for name, x in (("q", self.q), ("v", self.v)):
            if x is not None and np.ndim(x) != 1:
                raise InputError(f"{name}: expected one state, (n,), got shape {np.shape(x)}")
        if isinstance(self.controller, str) and self.controller not in ("posture", "passive"):
            expected = "'posture', 'passive', a function of (t, q, v) or a table"
            raise InputError(f"controller: expected {expected}, got {self.controller!r}")


# Runs.


@dataclass(frozen=True, eq=False)
class Run:
    """Positions of joints by name, (K, nq of the joint), at the times of the grid up to the run's end."""

    model: Model
    positions: Mapping[str, Array]
    why: str

    def __len__(self) -> int:
        return min((len(x) for x in self.positions.values()), default=0)


class Runner:
    """Runs worlds from one start under one controller."""

    def __init__(self, first: World, motion: Motion, other: str, grid: Array | None = None) -> None:
        self.motion, self.other, model = motion, other, first.system.model
        duration = float(motion.times[-1])
        usual = np.arange(0.0, duration, min(_PERIOD, duration / 50))
        self.grid = np.unique(np.round([*usual, *motion.times], 12)) if grid is None else grid
        layout, (q, v) = model.layout, self._start(model)
        full_q, full_v = layout.expand_q(q), layout.expand_v(v)
        self.names = [j.name for j in model.independent_joints]
        self.q = {j.name: full_q[layout.full_q[j.name]] for j in layout.joints}
        self.v = {j.name: full_v[layout.full_v[j.name]] for j in layout.joints}
        self.law, self.controller = self._controller(first, q)
        self._known = dict[tuple[Any, ...], Run]()

    def _start(self, model: Model) -> tuple[Array, Array]:
        motion, rng = self.motion, np.random.default_rng(self.motion.seed)
        q, v = model.neutral(), _SPEED * rng.standard_normal(model.nv)
        if motion.q is not None:
            # A velocity that fits a given configuration under constraints is not known, but rest does.
            q, v = model.check_q(motion.q, "q"), np.zeros(model.nv) if model.constrained else v
        elif model.constrained:
            q, v = model.random_state(rng)
            v = _SPEED * v
        else:
            for rows, low, high in _bounds(model):
                q[rows] = np.clip(q[rows], 0.9 * low + 0.1 * high, 0.1 * low + 0.9 * high)
        return q, v if motion.v is None else model.check_v(motion.v, "v")

    def _controller(self, first: World, q: Array) -> tuple[Controller | None, str]:
        """Return the control law and a sentence on it."""
        chosen, period, nv = self.motion.controller, first.settings.control_period, first.system.model.nv
        assert period is not None
        if isinstance(chosen, str):
            passive = None, "none: no torque, and servos at zero"
            return passive if chosen == "passive" else self._posture(first, q)
        if callable(chosen):
            return chosen, f"{getattr(chosen, '__qualname__', 'a function')}, asked every {period:g} s"
        rows = finite_array("controller", chosen, np.shape(chosen))
        if rows.ndim != 2 or rows.shape[1] != nv or not len(rows):
            raise InputError(f"controller: expected a table of shape (K, {nv}), got {rows.shape}")

        def table(t: float, *_: Array) -> Array:
            row: Array = rows[min(int(t / period + 1e-6), len(rows) - 1)]
            return row

        return table, f"a table of {counted(len(rows), 'row')}, each held for {period:g} s"

    def _posture(self, first: World, q: Array) -> tuple[Controller, str]:
        """Return a law that holds a posture: targets of servos, or torques of a PD controller."""
        model, settings, rng = first.system.model, first.settings, np.random.default_rng([self.motion.seed, 1])
        felt = 1.0 / np.diag(np.linalg.inv(_engine(model, EXACT[0]).mass_matrix(q)))
        target, kp, kd, at = *np.zeros((3, model.nv)), np.zeros(model.nv, int)
        gains, servos = list[str](), list[str]()
        layout = model.layout
        for j, (columns, low, high) in zip(_straight(model), _bounds(model), strict=True):
            rows, servo = layout.v[j.name], settings.servo(j.name)
            at[rows] = np.r_[columns]
            posture = np.clip(q[columns] + _POSTURE * rng.choice([-1.0, 1.0], j.type.nv), low, high)
            if servo is not None and servo.kind == "position":
                target[rows] = servo.gear * posture
                servos.append(j.name)
            elif (servo is not None and servo.kind == "motor") or not settings.servos:
                # A passive joint of a system with drives has none.
                per = felt[rows] / (servo.gear if servo else 1.0)
                target[rows], kp[rows], kd[rows] = posture, _BANDWIDTH**2 * per, 2 * _BANDWIDTH * per
                gains.append(f"{j.name} {kp[rows][0]:.3g} {kd[rows][0]:.3g}")
        torques = kp > 0

        def law(_: float, q: Array, v: Array) -> Array:
            return np.where(torques, kp * (target - q[at]) - kd * v, target)

        says = [f"{counted(len(servos), 'position servo')} of the files"] if servos else []
        says += [f"a PD controller (joint, kp, kd: {'; '.join(gains)})"] if gains else []
        return law, f"{' and '.join(says) or 'nothing'} to the posture ({', '.join(f'{x:.3g}' for x in target)})"

    def require_no_memory(self, world: World) -> None:
        """Raise where a second run of a world is another one, as the controller keeps something from run to run."""
        if callable(self.motion.controller):
            one = self.of(world)
            self._known.clear()
            apart, _ = self.between(one, self.of(world))
            if np.nan_to_num(apart).any():
                says = "two runs from one start differ, so it keeps a state from run to run"
                raise InputError(f"controller: {says}; give it a method reset(), which is called before each run")

    def of(self, world: World) -> Run:
        """Return the run of a world."""
        # The key has its model alive, as the run holds it.
        key = (id(world.system.model), world.settings, world.order)
        if key not in self._known:
            with warnings.catch_warnings(action="ignore", category=MbkitWarning):
                self._known[key] = self._run(world)
        return self._known[key]

    def _run(self, world: World) -> Run:
        model, settings, layout = world.system.model, world.settings, world.system.model.layout
        free = [j.name for j in model.independent_joints]
        if callable(reset := getattr(self.motion.controller, "reset", None)):
            reset()
        # A joint that the first does not have begins at zero.
        q0, v0 = model.neutral(), np.zeros(model.nv)
        for name in (n for n in free if n in self.q):
            q0[layout.q[name]], v0[layout.v[name]] = self.q[name], self.v[name]
        law = self._in_order(world)
        if settings.engine == MUJOCO:
            from scipy.interpolate import CubicSpline

            from mbkit.engines.mujoco.simulation import OwnSimulation

            t, q, _ = OwnSimulation(model, settings).run(q0, v0, law, float(self.grid[-1]))
            grid = self.grid[self.grid <= t[-1] + 1e-9]
            full = CubicSpline(t, q)(grid) if len(t) > 3 else q[:1]
            why = "" if len(grid) == len(self.grid) else f"leaves all bounds at {t[-1]:g} s"
        else:
            dyn, method = _engine(model, str(settings.engine)), str(settings.integrator)
            setting = {"rtol": _RTOL} if method_of(method).kind == "adaptive" else {"dt": settings.time_step}
            more: dict[str, Any] = {"t0": model.time, "save": model.time + self.grid, "doubt": False}
            if law is not None:
                more |= {"torque": _with_servos(law, model, settings), "hold": settings.control_period}
            try:
                run = simulate(dyn, q0, v0, float(self.grid[-1]), method, **setting, **more)
            except TorqueError as error:
                raise InputError(f"controller: {error}") from error
            full, why = layout.expand_q(run.q), run.stats.message
        return Run(model, {j.name: full[:, layout.full_q[j.name]] for j in layout.joints}, why)

    def _in_order(self, world: World) -> Controller | None:
        """Return the controller as it acts on a world, whose joints it counts in another order.

        It always sees the first's joints: one that the world lacks stays where it began, and one that the first lacks
        has no control.
        """
        law, model, layout = self.law, world.system.model, world.system.model.layout
        if law is None or not self.names:
            return None
        names = [n for n in world.order if n in self.names]
        names += [n for n in self.names if n not in names]
        here = {j.name for j in model.independent_joints}
        sizes = np.cumsum([0, *(len(self.v[n]) for n in names)])
        rows = [(layout.v[n], slice(a, b)) for n, a, b in zip(names, sizes, sizes[1:], strict=False) if n in here]

        def ordered(t: float, q: Array, v: Array) -> Array:
            known = [(q[layout.q[n]], v[layout.v[n]]) if n in here else (self.q[n], 0.0 * self.v[n]) for n in names]
            try:
                given = np.asarray(law(t, *map(np.concatenate, zip(*known, strict=True))), dtype=np.float64)
            except MbkitError:
                raise
            except Exception as error:  # a user's function raises what it likes
                raise InputError(f"controller: at t = {t:g} s it raised {type(error).__name__}: {error}") from error
            if given.shape != (sizes[-1],) or not np.isfinite(given).all():
                got = f"shape {given.shape}" if given.shape != (sizes[-1],) else f"{given}"
                raise InputError(f"controller: expected {sizes[-1]} finite numbers at t = {t:g} s, got {got}")
            u = np.zeros(model.nv)
            for own, part in rows:
                u[own] = given[part]
            return u

        return ordered

    def apart(self, a: World, b: World) -> tuple[Array, list[str]]:
        """Return how far the runs of two worlds are apart; see `between`."""
        return self.between(self.of(a), self.of(b))

    def between(self, one: Run, other: Run) -> tuple[Array, list[str]]:
        """Return how far two runs are apart at each time of the grid, (K, joints), and the joints that both have."""
        n, names = min(len(one), len(other)), [x for x in one.positions if x in other.positions]
        # Where one run has ended and the other goes on they are as far apart as can be.
        out = np.full((len(self.grid), len(names)), np.nan if len(one) == len(other) else np.inf)
        for k, name in enumerate(names):
            # The place and the turn of a free joint, and not the screw between two poses.
            between = JointType.difference(
                one.model.joint(name).type, one.positions[name][:n], other.positions[name][:n]
            )
            out[:n, k] = np.abs(between).max(axis=1, initial=0.0)
        return out, names


def _straight(model: Model) -> list[Any]:
    """Return the independent joints whose coordinates have bounds."""
    return [j for j in model.independent_joints if j.type.nq == j.type.nv]


def _bounds(model: Model) -> list[tuple[slice, Array, Array]]:
    """Return rows of q and bounds of each of them, within ±1."""
    pairs = ((j, np.sort([np.maximum(j.lower, -1.0), np.minimum(j.upper, 1.0)], axis=0)) for j in _straight(model))
    return [(model.layout.q[j.name], low, high) for j, (low, high) in pairs]


def _engine(model: Model, name: str) -> Dynamics:
    """Return an engine on a description; the own derivation where Pinocchio does not carry a part."""
    try:
        return dynamics(model, name)
    except UnsupportedError:
        if name != EXACT[0]:
            raise
        return LagrangianDynamics(model, compile=False)


def _with_servos(law: Controller, model: Model, settings: Settings) -> Controller:
    """Return a controller's torques, those of servos held as the others over a control period."""
    layout = model.layout
    servos = [(x, layout.q[x.joint].start, layout.v[x.joint].start) for x in settings.servos or ()]

    def torque(t: float, q: Array, v: Array) -> Array:
        # A controller counts from the start.
        out = np.array(law(t - model.time, q, v), dtype=np.float64)
        for servo, i, k in servos:
            out[k] = servo.torque(out[k], q[i], v[k])
        return out

    return torque


def runnable(first: World, second: World) -> tuple[World, World, list[str]]:
    """Return both worlds with all settings, and a note where MuJoCo cannot run what its file asks for."""
    sides = first.settings.filled(second.settings), second.settings.filled(first.settings)
    asked = sides[0].engine is not None
    first, second = (replace(x, settings=s.filled(DEFAULTS)) for x, s in zip((first, second), sides, strict=True))
    from mbkit.engines.mujoco.simulation import OwnSimulation

    try:
        for world in (first, second):
            if world.settings.engine == DEFAULTS.engine:
                # Constraints and mimic joints are soft in MuJoCo: nobody gets that who has not asked.
                model = world.system.model
                if model.needs.stops or (not asked and (model.constrained or model.layout.reduced)):
                    raise UnsupportedError("constraints, mimic joints and stops hold exactly")
                OwnSimulation(world.system.model, world.settings)
    except UnsupportedError as error:
        exact = {"engine": EXACT[0], "integrator": EXACT[1]}
        note = [f"not run by MuJoCo, but by {exact['integrator']}: {error}"] if asked else []
        return first.put(("settings",), exact), second.put(("settings",), exact), note
    return first, second, []


def with_engines(motion: Motion, a: Any, b: Any) -> Motion:
    """Return the motion with the engines and their own integrators, where sides are engines and nobody said others."""
    held = list(motion.settings)
    for k, side in enumerate((a, b)):
        if held[k] is None and isinstance(side, Dynamics):
            own = next((m for m in METHODS.values() if m.kind == "native" and m.engines and m.on(side.engine)), None)
            held[k] = Settings(side.engine, own.name if own else EXACT[1], _ENGINE_STEP)
    return replace(motion, settings=(held[0], held[1]))
