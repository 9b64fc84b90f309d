"""States of a run over time, and the quantities that follow from them.

Result of a solver, and the cost and end of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from itertools import pairwise
from typing import Any, Final, Literal, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.engines import ENGINES, Dynamics, dynamics
from mbkit.engines.base import at_times
from mbkit.engines.constrained import unwatched
from mbkit.errors import FunctionError, InputError, UnsupportedError
from mbkit.methods.registry import Tolerances
from mbkit.model import Body, Frame, Model
from mbkit.simulate.events import Hit
from mbkit.simulate.singular_poses import SingularPoses
from mbkit.simulate.torque import Applied, ForceFunctions, PiecewiseConstantTorque, SampledTorque, within

Ended = Literal["finished", "event", "diverged", "step_too_small", "function_failed"]


class Saturation(NamedTuple):
    """A velocity whose torque was clipped to its effort limit in a run with ``saturate=True``.

    Attributes
    ----------
    velocity : str
    fraction : float
        Share of the time, over all trajectories of a batch; of a torque function, share of the kept states.
    first : float
        Time at which that began first, s; of a torque function, of the first such kept state.
    excess : float
        Largest amount of the torque beyond the limit, N or Nm.
    """

    velocity: str
    fraction: float
    first: float
    excess: float

    def __str__(self) -> str:
        share = f"{100 * self.fraction:.3g} % of the run, first at t = {self.first:.6g} s"
        return f"torque on {self.velocity} clipped in {share}, by at most {self.excess:.3g}"


@dataclass(frozen=True)
class Stats:
    """Cost and end of a run.

    Attributes
    ----------
    steps, evaluations : int
        Accepted steps, and evaluations of the forward dynamics, summed over a batch.
    seconds : float
        Time on the wall.
    ended : {"finished", "event", "diverged", "step_too_small", "function_failed"}
        ``"event"`` when one asked for the end; ``"diverged"`` when a state or acceleration of any trajectory stopped
        being finite, or a state passed 1e100; ``"step_too_small"`` when an adaptive method could not go on;
        ``"function_failed"`` when a torque or event function did.
    reached : float or tuple of float
        Time of the last good state, s; one per trajectory of a batch.
    message : str
        Why a run ended early; empty for one that finished.
    rejected : int
        Steps that an adaptive method rejected, where it reports them.
    jacobians : int
        Of implicit adaptive methods: evaluations of the Jacobian of the forward dynamics, summed over a batch; of
        ``"implicit_midpoint"``: iterations of Newton's method, each with the exact Jacobian of the step's equations.
    chosen : str
        Of ``"auto"``: which methods ran, from when to when, and why.
    doubts : tuple of str
        Signs that a finished run is wrong, each with its measured reason and a remedy.
    saturated : tuple of Saturation
        With ``saturate=True``, the velocities whose torque was clipped: how often, from when on and by how much.
    """

    steps: int = 0
    evaluations: int = 0
    seconds: float = 0.0
    ended: Ended = "finished"
    reached: float | tuple[float, ...] = 0.0
    message: str = ""
    rejected: int = 0
    jacobians: int = 0
    chosen: str = ""
    doubts: tuple[str, ...] = ()
    saturated: tuple[Saturation, ...] = ()

    @property
    def finished(self) -> bool:
        """Whether every trajectory reached the end, or the event that was to stop it."""
        return self.ended in ("finished", "event")

    def __str__(self) -> str:
        end = self.message or ("finished, with doubts" if self.doubts else "finished")
        more = "".join(f"; {x}" for x in (self.chosen, *self.saturated) if x)
        return f"{self.steps} steps, {self.evaluations} evaluations, {self.seconds:.3g} s; {end}{more}"


_FIGURES: Final = tuple(x.name for x in fields(Stats))


@dataclass(frozen=True, kw_only=True)
class SolverResult(Stats):
    """Kept states of a run, with its cost and end.

    `last` is the last good configuration of the first trajectory that could not go on, where the method reports it;
    `error` is that of a torque or event function, `poses` are the singular ones that each trajectory passed.
    """

    t: Array
    q: Array
    v: Array
    events: tuple[Hit, ...] = ()
    error: FunctionError | None = None
    last: Array | None = None
    poses: Mapping[int, SingularPoses] = field(default_factory=dict)

    def stats(self, **more: Any) -> Stats:
        """Return the cost and the end alone, with what else is known of them."""
        return Stats(**{name: getattr(self, name) for name in _FIGURES} | more)


def saturated(
    asked: Applied | None, limits: Array | None, names: tuple[str, ...], start: float, run: SolverResult
) -> tuple[Applied | None, tuple[Saturation, ...]]:
    """Return the force of a run within limits from the one that was asked for, and where the two differ."""
    if asked is None or limits is None or isinstance(asked, SampledTorque):
        return asked, ()
    applied: Applied
    if isinstance(asked, ForceFunctions) and not asked.functions[0][0].start:
        t, force = run.t, asked.sampled(run.t, run.q, run.v, strict=False).values
        weights, applied = 1.0 * np.isfinite(force).all(-1).reshape(-1, len(t)), SampledTorque(within(limits, force))
    else:
        # Functions are of wrenches alone, if there are some.
        held = asked.held if isinstance(asked, ForceFunctions) else asked
        t, force = np.array([start]) if held.starts is None else held.starts, held.rows
        weights = np.diff(np.minimum(np.append(t, np.inf), np.atleast_2d(run.reached).T))
        held = replace(held, rows=within(limits, force))
        applied = replace(asked, held=held) if isinstance(asked, ForceFunctions) else held
    excess, found = np.where(weights[..., None] > 0, (np.abs(force) - limits).reshape(-1, len(t), len(limits)), 0.0), []
    for name, own in zip(names, np.moveaxis(excess, -1, 0), strict=False):
        if (beyond := own > 0).any():
            share, first = weights[beyond].sum() / weights.sum(), t[beyond.any(0).argmax()]
            found.append(Saturation(name, float(share), float(first), float(own.max())))
    return applied, tuple(found)


#: Most states at once: the matrices of a long run would fill the memory.
_MAX_STATES: Final = 4096

#: Frames on which wrenches acted, and the axes of these.
Acting = tuple[tuple[Frame, ...], str]


@dataclass(frozen=True, eq=False)
class RunSettings:
    """The start of a run, for checks afterwards."""

    t0: float
    q0: Array
    v0: Array
    # The step, s, or the tolerances of an adaptive method.
    setting: float | Tolerances
    # Those of the solver itself.
    doubts: tuple[str, ...]

    def with_start(self, t: Array, q: Array, v: Array) -> tuple[Array, Array, Array]:
        """Return saved times and states with the start."""
        if len(t) and t[0] == self.t0:
            return t, q, v
        q, v = (np.concatenate([x[..., None, :], saved], -2) for x, saved in ((self.q0, q), (self.v0, v)))
        return np.append(self.t0, t), q, v


@dataclass(frozen=True, eq=False, repr=False)
class RunData:
    """States over time of one run or of a batch, with its model and its settings; see `Trajectory`."""

    t: Array
    q: Array
    v: Array
    model: Model
    method: str
    engine: str
    stats: Stats
    _dyn: Dynamics | None = None
    events: tuple[Hit, ...] = ()
    _applied: Applied | None = None
    _settings: RunSettings | None = None
    _acting: Acting | None = None

    def __post_init__(self) -> None:
        for name in ("t", "q", "v"):
            array = getattr(self, name)
            if array.flags.writeable or array.base is not None or not array.flags.c_contiguous:
                array = np.array(array, order="C")
                array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        # A process pool would derive an engine that is sent along for every trajectory.
        known = self.engine in ENGINES and (self._dyn is None or self._dyn._samples is None)
        applied = self._applied
        if isinstance(applied, ForceFunctions):
            # Functions can seldom be pickled; their values can.
            applied = applied.sampled(self.t, self.q, self.v, strict=False)
        dyn = None if known else self._dyn
        return type(self), (
            *(self.t, self.q, self.v, self.model, self.method, self.engine, self.stats),
            *(dyn, self.events, applied, self._settings, self._acting),
        )

    # Energies, work and momenta

    def energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return kinetic plus potential energy in J, shape (K,) or (N, K), by the run's own engine or another."""
        return self.kinetic_energy(engine) + self.potential_energy(engine)

    def kinetic_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return ½ vᵀ M v in J, which no known defect of an engine touches; shape (K,) or (N, K)."""
        if not self.model.has_bodies:
            # T may have terms of lower degree.
            return along(self._by(engine), (), lambda own, q, v: own.kinetic_energy(q, v), self.q, self.v)
        return along(self._by(engine), (), _quadratic, self.q, self.v)

    def potential_energy(self, engine: str | Dynamics | None = None) -> Array:
        """Return the energy of gravity and springs in J, shape (K,) or (N, K)."""
        return along(self._by(engine), (), lambda own, q: own.potential_energy(q), self.q)

    @property
    def driven(self) -> bool:
        """Whether a torque, or a wrench on a frame, acted."""
        return self._applied is not None

    @property
    def tau(self) -> Array:
        """The generalized force that acted at each state, of the shape of v; read-only.

        Of an array: the row that acts from there on, at the end the last one. A function is called once more at the
        saved states (when the trajectory is pickled, then); TorqueError where it fails now and did not before. Where
        the function ended the run, the last state has NaN.
        """
        out = self._force()[..., : self.v.shape[-1]]
        out.setflags(write=False)
        return out

    def wrenches(self) -> dict[str, Array]:
        """Return the wrench on each frame at each state, (K, 6) or (N, K, 6), in the run's axes, as `tau` does.

        Examples
        --------
        >>> import mbkit as mb
        >>> push = {"tip": lambda t, q, v: [t, 0, 0, 0, 0, 0]}
        >>> run = mb.simulate(mb.dynamics(mb.catalog.pendulum()), [0.0], [0.0], 0.2, dt=0.1, wrenches=push)
        >>> run.wrenches()["tip"][:, 0]
        array([0. , 0.1, 0.2])
        """
        frames, nv = () if self._acting is None else self._acting[0], self.v.shape[-1]
        whole = self._force()
        return {frame.name: whole[..., nv + 6 * k : nv + 6 * k + 6] for k, frame in enumerate(frames)}

    @property
    def _numbers(self) -> int:
        """How many numbers τ and wrenches are."""
        return int(self.v.shape[-1]) + (6 * len(self._acting[0]) if self._acting else 0)

    def _force(self) -> Array:
        """Return τ and wrenches at each state."""
        acted, size = self._acted(), self._numbers
        if isinstance(acted, SampledTorque):
            return acted.values.copy()
        rows = np.broadcast_to(np.zeros(size) if acted is None else acted.at(self.t), (*self.v.shape[:-1], size))
        return rows.copy() if acted is None else np.where(np.isfinite(self.v).all(-1, keepdims=True), rows, np.nan)

    def work(self, engine: str | Dynamics | None = None) -> Array:
        """Return ∫ (τ + τ_lost + Σ Jᵀ w)·v dt since the first state in J, shape (K,) or (N, K).

        τ_lost are the forces of joints and elements without a potential, and those of constraints that do work: drives
        of motions in time, blades with a speed, soft loops. Of a system written as energies it holds what changes
        T + V beside its forces, as where a frame is moved.

        The work of a constant or held torque is τ·Δq, exact for the saved positions, where v = q̇; UnsupportedError
        where its rows change between two saved states. So is that of a force f that jumps, ``f |Δq|`` from one stop or
        turn in `events` to the next. All else, also torque on quasi-velocities, is a quadrature of fourth order in the
        distance of the saved states, of second order in an interval with a turn or stop of theirs; a function that
        jumps makes it first order, and so do rows that jump beside a function. So do impacts on joint stops within an
        interval, and beside a function of the state. Their energy is that of `events`; moreau tells none, and leaves it
        in `power_balance`.
        """
        dyn, force, t, q, v = self._by(engine), self._acted(), self.t, self.q, self.v
        with unwatched(dyn):
            if isinstance(force, SampledTorque):
                whole = _generalized(dyn, q, force.values, self._acting)
                lost = along(dyn, (), _lost_power, q, v, whole) + np.sum(whole * v, axis=-1)
                steps = self._by_phases(dyn, lost)
            else:
                held = np.zeros(self._numbers) if force is None else force.between(t)
                steps = _of_held(dyn, np.diff(t), q, (v[..., :-1, :], self._arrivals), held, self._acting)
        if "jump" in self.model.effects and not dyn._soft_jumps:
            steps = steps - self._rubbed(dyn) + self._struck
        out = np.zeros(q.shape[:-1])
        np.cumsum(steps, axis=-1, out=out[..., 1:])
        return out

    def _by_phases(self, dyn: Dynamics, power: Array) -> Array:
        """Return the integral of a power over each interval; no cubic goes across the end of a phase."""
        if "jump" not in self.model.effects or dyn._soft_jumps or not self.events:
            return _by_cubics(self.t, power)
        rows = power.reshape(-1, len(self.t))
        out, which = np.zeros((len(rows), len(self.t) - 1)), dyn._jumps.law.which
        for i, row in enumerate(rows):
            # Phases end where a velocity whose force jumps is zero; other events part nothing.
            ends = [
                x.t for x in self.events if x.member in (None, i) and (x.before is not None or (x.v[which] == 0).any())
            ]
            around = [np.searchsorted(self.t, ends), np.searchsorted(self.t, ends, side="right") - 1]
            cuts = np.unique(np.clip([0, *around[0], *around[1], len(row) - 1], 0, len(row) - 1)).tolist()
            for a, b in pairwise(cuts):
                out[i, a:b] = _by_cubics(self.t[a : b + 1], row[a : b + 1])
        return out.reshape(*power.shape[:-1], -1)

    def _rubbed(self, dyn: Dynamics) -> Array:
        """Return the energy that forces that jump take in each interval; states of events part them."""
        t, q, v = self.t, *(x.reshape(-1, *x.shape[-2:]) for x in (self.q, self.v))
        coordinates, plain = np.array(_plain(dyn.model), dtype=int).T
        out = np.zeros((len(q), max(len(t) - 1, 0)))
        for i in range(len(q)):
            hits = [x for x in self.events if x.member in (None, i)]
            # An impact has velocities on both sides; a state that is kept there has the second.
            hits = [y for x in hits for y in ([] if x.before is None else [replace(x, v=x.before)]) + [x]]
            times = np.append([x.t for x in hits], t)
            order = np.argsort(times, kind="stable")
            speeds = np.concatenate([*(x.v[None] for x in hits), v[i]])[order]
            moved = np.zeros((max(len(times) - 1, 0), v.shape[-1]))
            moved[:, plain] = np.diff(np.concatenate([*(x.q[None] for x in hits), q[i]])[order][:, coordinates], axis=0)
            law = dyn._jumps.law_of(dyn._of_sample(i))
            taken = np.append(0.0, np.cumsum(law.dissipated(np.diff(times[order]), moved, speeds)))
            out[i] = np.diff(taken[np.argsort(order)[len(hits) :]])
        return out.reshape(*self.q.shape[:-2], -1)

    @property
    def _arrivals(self) -> Array:
        """The velocities at the end of each interval, (..., K - 1, nv): before an impact that is at the saved time."""
        out, place = self.v[..., 1:, :].copy(), {x: k for k, x in enumerate(self.t[1:].tolist())}
        for x in self.events:
            if x.before is not None and x.t in place:
                out[... if x.member is None else x.member, place[x.t], :] = x.before
        return out

    @property
    def _struck(self) -> Array:
        """The energy that impacts on stops change in each interval."""
        out = np.zeros((*self.q.shape[:-2], max(len(self.t) - 1, 0)))
        for x in self.events if out.size else ():
            k = np.clip(np.searchsorted(self.t, x.t) - 1, 0, out.shape[-1] - 1)
            out[... if x.member is None else x.member, k] += x.energy_change
        return out

    def power_balance(self, engine: str | Dynamics | None = None) -> Array:
        """Return E(t) - E(0) - work(t) in J: zero for a run without error, shape (K,) or (N, K).

        It holds the error of the run and that of `work`: save every step to make the second small. Where `work` is
        exact for the saved positions, only the error of the run is left.
        """
        energy = self.energy(engine)
        return np.asarray(energy - energy[..., :1] - self.work(engine))

    def momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return the bodies' linear momentum, kg m/s, and angular one about the world's origin, kg m²/s.

        The shape is (K, 6) or (N, K, 6), in world axes; rotors belong to no body and are left out.
        """
        dyn, q, v = self._by(engine), self.q, self.v
        if not self.model.has_bodies:
            raise UnsupportedError(f"momentum: {self.model.name} was written as energies and has no bodies")
        if dyn._samples is None:
            return along(dyn, (6,), _momentum, q, v)
        # Each trajectory of a batch with values of its own is a system of its own.
        each = [along(dynamics_of_trajectory(dyn, i), (6,), _momentum, q[i], v[i]) for i in range(len(q))]
        return np.array(each).reshape(*q.shape[:-1], 6)

    def canonical_momentum(self, engine: str | Dynamics | None = None) -> Array:
        """Return p = ∂T/∂v, M v for a system of bodies, shape (K, nv) or (N, K, nv)."""
        return along(self._by(engine), self.v.shape[-1:], _canonical, self.q, self.v)

    def _by(self, engine: str | Dynamics | None) -> Dynamics:
        if engine is None or engine == self.engine:
            dyn = self._own()
        elif isinstance(engine, Dynamics):
            if engine.model.coordinate_names != self.model.coordinate_names:
                raise InputError(f"engine: expected a Dynamics of {self.model.name}, got one of {engine.model.name}")
            dyn = engine
        elif self._dyn is not None and self._dyn._samples is not None:
            raise UnsupportedError(
                f"{engine}: the trajectories have parameters of their own, which only the {self.engine} engine holds"
            )
        else:
            dyn = dynamics(self.model, engine)
        return at_times(dyn, self.t, len(self.q) if self.q.ndim == 3 else None)

    def _own(self) -> Dynamics:
        if self._dyn is None:
            object.__setattr__(self, "_dyn", dynamics(self.model, self.engine))
        assert self._dyn is not None
        return self._dyn

    def _acted(self) -> PiecewiseConstantTorque | SampledTorque | None:
        if isinstance(self._applied, ForceFunctions):
            strict = self.stats.ended != "function_failed"
            answers = self._applied.sampled(self.t, self.q, self.v, strict=strict)
            object.__setattr__(self, "_applied", answers)
        acted = self._applied
        assert not isinstance(acted, ForceFunctions)
        return acted


def along(dyn: Dynamics, shape: tuple[int, ...], evaluate: Callable[..., Array], *states: Array) -> Array:
    """Return evaluate(dyn, q, v, ...), of a shape, at states (K, ·) or (N, K, ·); NaN where one is not finite."""
    lead = states[0].shape[:-1]
    flat = [x.reshape(int(np.prod(lead)), x.shape[-1]) for x in states]
    good = np.flatnonzero(np.logical_and.reduce([np.isfinite(x).all(-1) for x in flat]))
    out = np.full((int(np.prod(lead)), *shape), np.nan)
    for start in range(0, len(good), _MAX_STATES):
        which = good[start : start + _MAX_STATES]
        own = dyn
        if dyn.model.time_parameter is not None:
            # One sample for each state (`mbkit.engines.base.at_times`).
            own = dyn._of_samples(which)
        elif len(lead) == 2:
            own = dyn._of_samples(which // lead[1])
        out[which] = evaluate(own, *(x[which] for x in flat))
    return out.reshape(*lead, *shape)


def integrate_finite(model: Model, q: Array, u: Array) -> Array:
    """Return `model.integrate(q, u)` on any number of leading axes; NaN where a state is not finite."""
    out = np.full(q.shape, np.nan)
    good = np.isfinite(q).all(-1) & np.isfinite(u).all(-1)
    out[good] = model.integrate(q[good], u[good])
    return out


def _quadratic(dyn: Dynamics, q: Array, v: Array) -> Array:
    return np.asarray(0.5 * np.einsum("ni,nij,nj->n", v, dyn.mass_matrix(q), v))


# The work of a held force is τ·Δq over each interval, exactly, where v = q̇. Else, and for what is lost, it is the
# trapezoid's rule with its end correction, h/2 (p₀ + p₁) + h²/12 (ṗ₀ - ṗ₁), of fourth order. A force that is known
# at the states alone is integrated by the cubic through four of them.


def _of_held(dyn: Dynamics, h: Array, q: Array, v: tuple[Array, Array], held: Array, acting: Acting | None) -> Array:
    """Return the work in each interval, of a force and wrenches that are constant there; v are those at its ends."""
    nv = v[0].shape[-1]
    held = np.broadcast_to(held, (*v[0].shape[:-1], held.shape[-1]))
    pushed, wrenches = held[..., :nv], held[..., nv:]
    coordinates, plain = np.array(_plain(dyn.model), dtype=int).reshape(-1, 2).T
    model = dyn.model
    lossy = dyn._soft_jumps or model.needs.damping or model.forces or not model.has_bodies or _driven(dyn)
    losing, turned = bool(lossy or wrenches.any()), len(plain) < nv and bool(pushed.any())
    moved, jumps = np.diff(q, axis=-2)[..., coordinates], "jump" in model.effects and not dyn._soft_jumps
    # Forces that jump keep their sides up to the states in which they change them, and what rests is held up to there.
    sides, keeps = np.zeros(pushed.shape), np.zeros(pushed.shape, dtype=bool)
    sides[..., plain], keeps[..., plain] = np.sign(moved), jumps
    keeps &= (sides * v[0] >= 0) & (sides * v[1] >= 0)
    keeps &= (sides != 0) | ((v[0] == 0) & (v[1] == 0))

    def sided(v: Array) -> Array:
        return np.where(keeps, sides * np.maximum(sides * v, np.finfo(float).tiny), v)

    ends = [(q[..., i : len(h) + i, :], sided(v[i])) for i in (0, 1)]
    owns = [_at_end(dyn, q.shape[:-1], i) for i in (0, 1)]
    a = [np.zeros(0)] * 2
    if losing or turned:
        forces = [_generalized(own, end[0], held, acting) for own, end in zip(owns, ends, strict=True)]
        a = [
            along(own, (nv,), lambda one, *at: one.forward_dynamics(*at), *end, force)
            for own, end, force in zip(owns, ends, forces, strict=True)
        ]
    distance = np.zeros(pushed.shape)
    if turned:
        distance = _corrected(h[:, None], *((v, rate) for (_, v), rate in zip(ends, a, strict=True)))
    distance[..., plain] = moved
    out = np.sum(pushed * distance, axis=-1)
    if losing:

        def power(own: Dynamics, q: Array, v: Array) -> Array:
            force, v = _generalized(own, q, held, acting), sided(v)
            return np.asarray(along(own, (), _lost_power, q, v, force) + np.sum((force - pushed) * v, axis=-1))

        each = zip(owns, ends, a, (jumps, -jumps), strict=True)
        pairs = (_with_rate(own, power, h[:, None], *end, rate, inward) for own, end, rate, inward in each)
        out = out + _corrected(h, *pairs)
    return np.asarray(out)


def _at_end(dyn: Dynamics, lead: tuple[int, ...], end: int) -> Dynamics:
    """Return the dynamics at the first or last states of all intervals, where time enters."""
    if dyn.model.time_parameter is None:
        return dyn
    samples = np.arange(int(np.prod(lead))).reshape(lead)
    return dyn._of_samples(samples[..., end : lead[-1] - 1 + end].ravel())


def _corrected(h: Array, start: tuple[Array, Array], end: tuple[Array, Array]) -> Array:
    """Return the integral over an interval from values and rates at its ends."""
    return np.asarray(h / 2 * (start[0] + end[0]) + h**2 / 12 * (start[1] - end[1]))


def _generalized(dyn: Dynamics, q: Array, force: Array, acting: Acting | None) -> Array:
    """Return τ + Σ Jᵀ w of τ with wrenches behind it."""
    if acting is None:
        return force
    tau, wrenches = np.split(force, [force.shape[-1] - 6 * len(acting[0])], axis=-1)

    def of_wrenches(own: Dynamics, q: Array, w: Array) -> Array:
        return own._evaluate("generalized_force", *acting, q=q, wrenches=w)

    return np.asarray(tau + along(dyn, tau.shape[-1:], of_wrenches, q, wrenches))


def _with_rate(
    dyn: Dynamics, power: Callable[[Dynamics, Array, Array], Array], h: Array, q: Array, v: Array, a: Array, inward: int
) -> tuple[Array, Array]:
    """Return a power of (q, v), and its rate along the motion; by states on one side where `inward` is 1 or -1."""
    model, clock = dyn.model, dyn.model.time_parameter
    of_samples: Any = dyn
    # Differences over so small a part of an interval lose a third of the digits of a term that is h/12 of the whole.
    up = down = np.broadcast_to(1e-4 * h, (*q.shape[:-1], 1))
    if clock is not None:
        # The time is the last parameter; beyond its ends a table is not known.
        times = of_samples._parameter_values[:, -1].reshape(up.shape)
        up, down = np.minimum(up, model.interval[1] - times), np.minimum(up, times - model.interval[0])

    def after(s: Array) -> Array:
        there = (integrate_finite(model, q, s * v), v + s * a)
        return power(dyn if clock is None else dyn.at(**{clock: (times + s).ravel()}), *there)

    if inward:
        # At its end what rests is at its bound, and may let go.
        s = up if inward > 0 else -down
        near, far = after(0.5 * s), after(s)
        return 2 * near - far, (far - near) / (0.5 * s)[..., 0]
    return power(dyn, q, v), (after(up) - after(-down)) / (up + down)[..., 0]


def _driven(dyn: Dynamics) -> bool:
    """Return whether constraints do work, among them soft limits."""
    return dyn._soft_limits or (dyn.model.constrained and (dyn._soft_constraints or dyn.model.constraints_do_work))


def _lost_power(dyn: Dynamics, q: Array, v: Array, tau: Array) -> Array:
    """Return the power under τ of all forces but τ itself, exact ones that jump and those in the energy; (N,)."""
    model = dyn.model
    if not model.has_bodies:
        rate = dyn._evaluate("energy_rate", q=q, v=v, a=dyn.forward_dynamics(q, v, tau))
        return np.asarray(rate - np.sum(tau * v, axis=-1))
    force = np.asarray(dyn._lost_force(q, v))
    if model.needs.damping:
        # At rest the passive force is that of springs; forces by functions are counted above.
        force = force + _dampers(dyn, q, v) - _dampers(dyn, q, np.zeros_like(v))
    if dyn._soft_jumps or dyn._soft_limits:
        force = force + dyn._jumps.law_of(dyn).force(v) + dyn._jumps_beside_passive(q, v, tau)
    elif _driven(dyn):
        force = force + dyn.generalized_constraint_force(q, v, tau)
    return np.asarray(np.sum(force * v, axis=-1))


def _dampers(dyn: Dynamics, q: Array, v: Array) -> Array:
    """Return the passive force of springs and dampers alone."""
    own = dyn.passive(q, v) - dyn._lost_force(q, v)
    return np.asarray(own - dyn._jumps.law_of(dyn).force(v) if "jump" in dyn.model.effects else own)


def _plain(model: Model) -> list[tuple[int, int]]:
    """Return (coordinate, velocity) of those where v = q̇: all but free and ball joints'."""
    out: list[tuple[int, int]] = []
    if model.velocity_map is not None:
        return out
    for joint in model.independent_joints:
        if joint.type.coordinate_velocities:
            q, v = model.layout.q[joint.name], model.layout.v[joint.name]
            out += zip(range(q.start, q.stop), range(v.start, v.stop), strict=True)
    return out


def _by_cubics(t: Array, p: Array) -> Array:
    """Return ∫ p dt over each interval, by the cubic through four states near it, or fewer where there are fewer."""
    n = len(t)
    if n < 2:
        return np.zeros((*p.shape[:-1], 0))
    width = min(n, 4)
    first = np.clip(np.arange(n - 1) - (width - 2) // 2, 0, n - width)
    around = first[:, None] + np.arange(width)
    # In each interval's own unit, whatever the times are: weights w with V w = moments.
    h = np.diff(t)
    x = (t[around] - t[:-1, None]) / h[:, None]
    powers = np.arange(width)
    V = x[:, None, :] ** powers[:, None]
    moments = np.broadcast_to((1.0 / (powers + 1))[:, None], (n - 1, width, 1))
    weights = np.linalg.solve(V, moments)[..., 0] * h[:, None]
    return np.asarray(np.sum(weights * p[..., around], axis=-1))


# Momenta


def _canonical(dyn: Dynamics, q: Array, v: Array) -> Array:
    p = np.einsum("nij,nj->ni", dyn.mass_matrix(q), v)
    if dyn.model.has_bodies:
        return np.asarray(p)
    # T's part of first degree is half of what changes with the sign of v.
    first = [dyn.kinetic_energy(q, e + 0 * v) - dyn.kinetic_energy(q, -e + 0 * v) for e in np.eye(v.shape[1])]
    return np.asarray(p + 0.5 * np.array(first).T)


def dynamics_of_trajectory(dyn: Dynamics, i: int) -> Dynamics:
    """Return the dynamics of one trajectory of a batch, with plain values of the parameters."""
    if dyn._samples is None:
        return dyn
    # Other engines need no CasADi.
    from mbkit.engines.lagrangian import LagrangianDynamics

    assert isinstance(dyn, LagrangianDynamics)  # the others have no samples
    values = dyn._of_samples([i])._parameter_values[0].tolist()
    return dyn.at(**dict(zip(dyn.model.parameters, values, strict=True)))


def _momentum(dyn: Dynamics, q: Array, v: Array) -> Array:
    out = np.zeros((len(q), 6))
    for body in dyn.model.bodies:
        if not body.mass and not body.inertia.any():
            continue
        frame = _frame_of(dyn.model, body)
        X, J = dyn.pose(q, frame.name), dyn.jacobian(q, frame.name)
        twist = np.einsum("nij,nj->ni", J, v)
        R = X[:, :3, :3] @ frame.rotation.T
        arm, turning = R @ (body.com - frame.translation), twist[:, 3:]
        p = body.mass * (twist[:, :3] + np.cross(turning, arm))
        spin = np.einsum("nij,jk,nlk,nl->ni", R, body.inertia, R, turning)
        out[:, :3] += p
        out[:, 3:] += np.cross(X[:, :3, 3] + arm, p) + spin
    return out


def _frame_of(model: Model, body: Body) -> Frame:
    """Return a frame on the body that engines know by its name: its own, unless another goes by that name."""
    own = model.frame(body.name)
    if own.body == body.name:
        return own
    for frame in model.frames:
        if frame.body == body.name and model.frame(frame.name) is frame:
            return frame
    raise UnsupportedError(
        f"{model.name}: frame {own.name!r} on {own.body!r} hides the body of that name; rename one of them"
    )
