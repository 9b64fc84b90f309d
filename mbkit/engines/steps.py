"""One step of a method, and its exact derivative by the chain rule through the method's own formula.

The formulas of `mbkit.methods` run on any arithmetic; here on values with their derivatives (forward-mode automatic
differentiation; Griewank and Walther 2008, Evaluating Derivatives, ch. 3), side by side for a batch, with CasADi's
derivatives of what rotates. Stages that are solved for are differentiated by the implicit function theorem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import EPS, ITERATED, Array, batch_of, real, real_array, require_finite
from mbkit._imports import from_above
from mbkit.engines.constrained import unwatched
from mbkit.engines.evaluation import Evaluation
from mbkit.engines.frames_and_momenta import ALIGNED, axes_named
from mbkit.engines.loads import Wrenches
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.methods.one_step import MAX_NEWTON_ITERATIONS, SemiImplicitEuler
from mbkit.methods.registry import DEFAULT_METHOD, METHODS, Method, explicit_method, method_of
from mbkit.methods.tableaus import ImplicitTableau, Tableau
from mbkit.model import Model
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.integration_space import Space
from mbkit.model.manifold import tangent_maps

if TYPE_CHECKING:
    from mbkit.codegen.backend import Machine

STEP_DERIVATIVE: Final = Path(
    "derivative of a step",
    "the derivative of a step is not known of",
    ALL - {"row", "speed", "t", "jump"},
    {
        "jump": "its steps have no derivative where a joint stops or lets go",
        "t": "terms that depend on the time have no slopes here",
    },
    also=lambda model: () if model.velocity_map is None else ("it has quasi-velocities of its own",),
    instead="linearize(q, v, tau).discretize(dt) holds the linear system's force",
)


class Steps(Evaluation):
    """The method of `Dynamics` that takes a step."""

    _states_held: Any

    def step(
        self,
        q: ArrayLike,
        v: ArrayLike,
        tau: ArrayLike,
        dt: float,
        method: str = DEFAULT_METHOD,
        wrenches: Wrenches | None = None,
        axes: str = ALIGNED,
        t: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return (q, v) after one step of length dt, with the force τ held: for control loops and environments.

        There is no record and no check of the run; `mbkit.simulate` has them, and every other method.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
            Units m and rad, quaternions of unit length, as are those of the result.
        v, tau : (nv,) or (N, nv) array_like
            Velocity and generalized force. One state beside a batch is repeated.
        dt : float
            s, above 0.
        method : str
            An explicit one with a fixed step: ``"rk4"``, ``"semi_implicit_euler"``, or an explicit tableau of
            `mbkit.simulate.register_method`.
        wrenches : dict of str to (6,) or (N, 6) array_like, optional
            That act on frames, as in `generalized_force`. The wrench is held over the step, and Σ Jᵀ w follows the
            configuration from stage to stage.
        axes : {"local", "local_world_aligned", "world"}
            Axes of the wrenches, as in `generalized_force`.
        t : float or (N,) array_like
            Time at the start of the step, s: of each state of a batch, or of all. Required where time enters the
            equation of motion, as by forces of t and motions in time; others do not use it.

        Returns
        -------
        q, v : (nq,) and (nv,), or (N, nq) and (N, nv) arrays
            New ones. They are those of ``mbkit.simulate(dyn, q, v, dt, method, dt, torque=tau, t0=t)``: the same bits;
            with constraints, and on the lagrangian engine with a free joint or quasi-velocities, the same up to
            rounding.

        Raises
        ------
        InputError
            A wrong shape, state, force, time or step, no time where the model depends on it, or a first step from a
            state that breaks constraints.
        NumericalError
            The state after the step, or an acceleration on the way, is not finite.
        UnknownNameError
            No method of this name.
        UnsupportedError
            A method without an explicit step.

        Notes
        -----
        The state that a step leads to is projected onto constraints. On the lagrangian engine the
        step is the same machine code as in `mbkit.simulate`: microseconds for a state, and batches are shared among
        threads. The first step of a model compiles it. Other engines and ``compile=False`` evaluate the forward
        dynamics stage by stage, by the same formulas.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum())
        >>> q, v = [1.0], [0.0]
        >>> for _ in range(1000):
        ...     q, v = dyn.step(q, v, [0.0], dt=1e-3)
        >>> run = mb.simulate(dyn, [1.0], [0.0], duration=1.0, dt=1e-3)
        >>> bool(q == run.q[-1])
        True
        """
        if wrenches:
            frames, w = self._stacked_wrenches(wrenches)
            held: Steps = self._under(frames, axes_named(axes))
            return held.step(q, v, _beside(self.model.check_v(tau, "tau"), w), dt, method, t=t)
        chosen, h = explicit_method(method), real("dt", dt, positive=True)
        self._method("forward_dynamics")
        states, size = self._states({"q": q, "v": v, "tau": tau})
        times = self._start_of_step(t, h, size)
        clock = str(self.model.time_parameter)
        if times is None or not times.ndim:
            own: Steps = self if times is None else self.at(**{clock: float(times)})
            out = own._checked_step(chosen, h, states)
            self._step_unchecked = False
            return out
        rows = zip(*(np.broadcast_to(x, (len(times), x.shape[-1])) for x in states.values()), strict=True)
        each = [
            self._of_sample(i).at(**{clock: time})._checked_step(chosen, h, dict(zip(states, row, strict=True)))
            for i, (time, row) in enumerate(zip(times.tolist(), rows, strict=True))
        ]
        self._step_unchecked, n = False, (self.model.nq, self.model.nv)
        return tuple(np.array([x[k] for x in each]).reshape(-1, n[k]) for k in (0, 1))  # type: ignore[return-value]

    def _start_of_step(self, t: ArrayLike | None, h: float, size: int | None = None) -> Array | None:
        """Return the time at which a step begins, () or (N,); None where the model does not depend on it."""
        name, timed = self.model.name, self.model.time_parameter is not None
        if t is None and timed:
            raise InputError(f"t: expected the time at the start of the step, s, on which {name} depends, got None")
        times = real_array("t", 0.0 if t is None else t)
        if times.ndim and (times.ndim > 1 or size not in (None, len(times))):
            raise InputError(f"t: expected a number or shape ({size or 'N'},), got {times.shape}")
        require_finite("t", times)
        if timed and times.size:
            self.model.require_times("t", float(times.min()), float(times.max()) + h)
        return times if timed else None

    def _checked_step(self, chosen: Method, h: float, states: dict[str, Array]) -> tuple[Array, Array]:
        """Return the state after a step from checked states, or the error of a state that is not finite."""
        if self._step_unchecked and states["q"].size:
            self._states_held.manifold_of(self).at(self.model.time).check(states["q"], states["v"])
        # An overflow is reported as an error.
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            if "jump" in self.model.effects and not self._soft_jumps:
                # Phases are those of runs, a floor above.
                q1, v1 = from_above("step_in_phases").step(self, chosen, **states, dt=h)
            else:
                with unwatched(self):
                    q1, v1 = self._step(chosen, **states, dt=h)
            good = np.isfinite(q1).all(axis=-1) & np.isfinite(v1).all(axis=-1)
        if not good.all():
            # A mass matrix that is singular at the start has a message of its own, and so have drives that part.
            clock = self.model.time_parameter
            for own in (self, *([] if clock is None else [self.at(**{clock: self.model.time + h})])):
                with unwatched(own):
                    own.forward_dynamics(states["q"], states["v"], states["tau"])
            sample = f" in sample {int(np.argmin(good))}" if good.ndim else ""
            raise NumericalError(
                f"{self.engine}: step of {self.model.name} by {chosen.name}: the state is not finite{sample} after "
                f"dt = {h:g} s; take shorter steps, or look at the accelerations of forward_dynamics(q, v, tau)"
            )
        return q1, v1

    def _step(self, method: Method, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
        """Return the state after a step, stage by stage; NaN where there is none."""
        # It is the step of runs, a floor above.
        q1, v1 = from_above("fixed_step").take_step(self, method.name, q, v, tau, dt)
        return q1, v1


def _beside(tau: Array, wrenches: Array) -> Array:
    """Return τ with wrenches behind it, (nv + 6 k,) or (N, nv + 6 k)."""
    size = batch_of(tau=tau, wrenches=wrenches)
    parts = (x if size is None or x.ndim == 2 else np.broadcast_to(x, (size, len(x))) for x in (tau, wrenches))
    return np.concatenate(tuple(parts), axis=-1)


# Derivatives of a step


class Slopes(NamedTuple):
    """Accelerations, (..., nv), and their derivatives by q, v and τ, (..., nv, nv), and by parameters, (..., nv, p)."""

    a: Array
    q: Array
    v: Array
    tau: Array
    parameters: Array


class Dual:
    """Vectors of a batch, (N, n), with their derivatives by all that a step depends on, (N, n, columns)."""

    __slots__ = ("slope", "value")
    # NumPy's own numbers leave operations with these to them.
    __array_ufunc__ = None

    def __init__(self, value: Array, slope: Array) -> None:
        self.value, self.slope = value, slope

    def __add__(self, other: Dual) -> Dual:
        return Dual(self.value + other.value, self.slope + other.slope)

    def __mul__(self, factor: float) -> Dual:
        return Dual(factor * self.value, factor * self.slope)

    __rmul__ = __mul__


class DualSpace(Space):
    """The integrators' space on `Dual` vectors, with the derivatives of its formulas by CasADi."""

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._model = model
        self._machines: dict[str, Machine] = vars(model).setdefault("_space_derivatives", {})

    def _at(self, name: str, *given: Dual) -> Dual:
        if name not in self._machines:
            # CasADi is loaded where rotations are differentiated.
            from mbkit.codegen.backend import Machine
            from mbkit.derivation.steps.symbols import space_derivative

            sizes = [x.value.shape[-1] for x in given]
            self._machines[name] = Machine(space_derivative(self._model, name, sizes))
        value, by = self._machines[name](*(np.ascontiguousarray(x.value) for x in given))
        return Dual(value[..., 0], by @ np.concatenate([x.slope for x in given], axis=-2))

    def retract(self, q: Dual, u: Dual) -> Dual:
        return q + u if self._adds else self._at("retract", q, u)

    def rate(self, u: Dual, w: Dual) -> Dual:
        return w if self._adds else self._at("rate", u, w)

    def to_integrator_velocity(self, q: Dual, v: Dual) -> Dual:
        return self._at("to_integrator_velocity", q, v) if self._free else v

    def to_body_velocity(self, q: Dual, w: Dual) -> Dual:
        return self._at("to_body_velocity", q, w) if self._free else w

    def acceleration(self, q: Dual, v: Dual, a: Dual) -> Dual:
        return self._at("acceleration", q, v, a) if self._free else a


class _DualStages:
    """Rates of the stages so far, as `mbkit.methods.one_step.Stages`."""

    def __init__(self) -> None:
        self._rates = list[tuple[Dual, Dual]]()

    def __len__(self) -> int:
        return len(self._rates)

    def append(self, u_rate: Dual, w_rate: Dual) -> None:
        """Add a stage."""
        self._rates.append((u_rate, w_rate))

    def moved(self, h: float, weights: Array) -> tuple[Dual, Dual]:
        """Return h times the weighted sums of u̇ and ẇ."""
        u, w = (0.0 * x for x in self._rates[0])
        for weight, (u_rate, w_rate) in zip(weights.tolist(), self._rates, strict=True):
            if weight:
                u, w = u + (h * weight) * u_rate, w + (h * weight) * w_rate
        return u, w

    def squares(self, weights: Array, scales: tuple[Any, Any]) -> Any:
        """Refuse: errors of steps choose their length, which here is fixed."""
        raise NotImplementedError


def differentiable_method(model: Model, engine: str, name: object) -> Method:
    """Return the method of this name, if the derivative of its step is known."""
    STEP_DERIVATIVE.admit(model)
    method = method_of(name)
    fixed = [m for m in METHODS.values() if m.kind == "fixed" and (m.formula or m.in_momenta)]
    known = [m.name for m in fixed if not m.engines or engine in m.engines]
    if method.name not in known:
        lacks = method.kind == "fixed" and f"{engine} {method.lacks}"
        raise UnsupportedError(
            f"method {method.name!r}: the derivative of its step is not known: "
            f"{lacks or 'it has no fixed step of mbkit'}; use {', '.join(map(repr, known))}"
        )
    return method


class _Rates:
    """u̇ and ẇ of states with their derivatives, from the engine's accelerations and theirs."""

    def __init__(self, space: DualSpace, model: Model, slopes: Callable[..., Slopes]) -> None:
        self._space, self._model, self._slopes = space, model, slopes

    def __call__(self, t: Any, q: Dual, u: Dual | None, w: Dual) -> tuple[Dual, Dual]:  # noqa: ARG002  # no time
        space, n = self._space, self._model.nv
        v = space.to_body_velocity(q, w)
        if not (np.isfinite(q.value).all() and np.isfinite(v.value).all()):
            raise NumericalError("the state within a step is not finite; take shorter steps")
        at = self._slopes(q.value, v.value)
        slope = at.q @ _on_tangents(self._model, q) + at.v @ v.slope
        # Behind δq and δv stand the columns of τ and the parameters.
        slope[..., 2 * n : 3 * n] += at.tau
        slope[..., 3 * n : 3 * n + at.parameters.shape[-1]] += at.parameters
        return w if u is None else space.rate(u, w), space.acceleration(q, v, Dual(at.a, slope))


def _on_tangents(model: Model, q: Dual) -> Array:
    """Return the derivatives of q as those of a displacement in the tangent space."""
    return tangent_maps(model, q.value)[1] @ q.slope if model.quaternions else q.slope


def step_derivatives(
    model: Model,
    method: Method,
    slopes: Callable[..., Slopes],
    dt: float,
    q: Array,
    v: Array,
    parameters: int = 0,
) -> tuple[Array, Array, Array]:
    """Return q and v after a step, and their derivatives by δq, δv, τ and the parameters.

    Parameters
    ----------
    model : Model
    method : Method
        With a formula of its own and a fixed step.
    slopes : callable
        (q, v) of a batch -> `Slopes`.
    dt : float
        s.
    q, v : (nq,) and (nv,), or (N, nq) and (N, nv) arrays
    parameters : int
        The number p of parameters in what `slopes` returns.

    Returns
    -------
    q, v, slopes
        The last of shape (2nv, 3nv + p) or (N, 2nv, 3nv + p), on the tangent spaces before and after.
    """
    if q.ndim == 1:
        q1, v1, out = step_derivatives(model, method, slopes, dt, q[None], v[None], parameters)
        return q1[0], v1[0], out[0]
    n, formula, space = model.nv, method.formula, DualSpace(model)
    columns, rates = 3 * n + parameters, _Rates(space, model, slopes)
    start_q, start_v = (Dual(x, np.zeros((*x.shape, columns))) for x in (q, v))
    start_q.slope[..., :n] = tangent_maps(model, q)[0]
    start_v.slope[:, range(n), range(n, 2 * n)] = 1.0
    w = space.to_integrator_velocity(start_q, start_v)
    if isinstance(formula, ImplicitTableau):
        end_q, end_w = _implicit_step(formula, space, rates, dt, start_q, w)
    else:
        assert isinstance(formula, (Tableau, SemiImplicitEuler))
        end_q, end_w, _ = formula.step(space, rates, _DualStages(), 0.0, dt, start_q, w)
    end_v = space.to_body_velocity(end_q, end_w)
    return end_q.value, end_v.value, np.concatenate([_on_tangents(model, end_q), end_v.slope], axis=-2)


def _implicit_step(tableau: ImplicitTableau, space: DualSpace, rates: _Rates, h: float, q: Dual, w: Dual) -> Any:
    """Return q and w after a step whose stages k = (u̇, ẇ) depend on each other.

    Newton's iteration solves G(k, x) = k - F(u(k), w + ..., x) = 0 to rounding; then dk = -G_k⁻¹ G_x dx.
    """
    n, size, columns = space.nv, len(q.value), q.slope.shape[-1]
    s, A = tableau.stages, tableau.A
    # Directions of one stage's u and w stand behind the columns of the result.
    wide = Dual(q.value, np.concatenate([q.slope, np.zeros((*q.value.shape, 2 * n))], axis=-1))
    seed_u, seed_w = (np.zeros((size, n, columns + 2 * n)) for _ in range(2))
    seed_u[:, range(n), range(columns, columns + n)] = 1.0
    seed_w[:, range(n), range(columns + n, columns + 2 * n)] = 1.0
    k = np.zeros((s, size, 2 * n))
    k[..., :n] = w.value
    last = np.full(size, np.inf)
    for _ in range(MAX_NEWTON_ITERATIONS):
        stages = h * np.einsum("ij,jbm->ibm", A, k)
        J, by_x, miss = np.empty((s, size, 2 * n, 2 * n)), np.empty((s, size, 2 * n, columns)), np.empty(k.shape)
        for i in range(s):
            u, speed = Dual(stages[i, :, :n], seed_u), Dual(w.value + stages[i, :, n:], seed_w)
            pair = rates(0.0, space.retract(wide, u), u, speed)
            slope = np.concatenate([x.slope for x in pair], axis=-2)
            miss[i] = k[i] - np.concatenate([x.value for x in pair], axis=-1)
            by_x[i], J[i] = slope[..., :columns], slope[..., columns:]
        coupled = -h * np.einsum("ij,ibkl->bikjl", A, J).reshape(size, s * 2 * n, s * 2 * n)
        coupled += np.eye(s * 2 * n)
        change = np.asarray(np.linalg.solve(coupled, miss.swapaxes(0, 1).reshape(size, s * 2 * n, 1))[..., 0])
        k = k - change.reshape(size, s, 2 * n).swapaxes(0, 1)
        done, last = _settled(change, last, k.swapaxes(0, 1).reshape(size, s * 2 * n))
        if done:
            break
    else:
        raise NumericalError(f"{tableau.name}: the iteration does not solve the stages; take shorter steps")
    # The stages depend on w through their own w.
    by_w = np.einsum("ibkl,blm->ibkm", J[..., n:], w.slope)
    right = (by_x + by_w).swapaxes(0, 1).reshape(size, s * 2 * n, columns)
    slopes = np.linalg.solve(coupled, right).reshape(size, s, 2 * n, columns)
    value, slope = h * np.einsum("i,ibm->bm", tableau.b, k), h * np.einsum("i,bimc->bmc", tableau.b, slopes)
    u, dw = (Dual(value[:, part], slope[:, part]) for part in (slice(n), slice(n, None)))
    return space.retract(q, u), w + dw


def _settled(change: Array, last: Array, numbers: Array) -> tuple[bool, Array]:
    """Return whether Newton's corrections, one row per state, are rounding of these numbers, and their sizes."""
    far, limit = np.abs(change).max(axis=-1, initial=0.0), np.abs(numbers).max(axis=-1, initial=1.0)
    done = (far <= 4 * EPS * limit) | ((far >= last / 2) & (far <= ITERATED * limit))
    return bool(done.all()), far


def momentum_step_slopes(
    model: Model, equations: Callable[..., list[Array]], q: Array, v: Array
) -> tuple[Array, Array, Array]:
    """Return what `step_derivatives` does, of a step whose velocity w and new v solve `equations`(q, w, v1).

    These are those of `mbkit.derivation.steps.midpoint.Midpoint.slopes`.
    """
    n = model.nv
    y = np.concatenate([Space(model).to_integrator_velocity(q, v), v], axis=-1)
    last = np.full(y.shape[:-1], np.inf)
    for _ in range(MAX_NEWTON_ITERATIONS):
        residual, by_y, by_x, q1, q1_by_y, q1_by_x = equations(q, y[..., :n], y[..., n:])
        change = np.asarray(np.linalg.solve(by_y, residual)[..., 0])
        y = y - change
        done, last = _settled(change, last, y)
        if done:
            break
    else:
        raise NumericalError("the iteration does not solve the step's equations; take shorter steps")
    slopes = -np.linalg.solve(by_y, by_x)
    q1 = q1[..., 0]
    moved = tangent_maps(model, q1)[1] @ (q1_by_y @ slopes + q1_by_x)
    return q1, y[..., n:], np.concatenate([moved, slopes[..., n:, :]], axis=-2)
