"""The linearized motion near a state: its Jacobian, exact or by differences, and the rates of its modes.

The exact Jacobian is that of q̇ = D(q) v, v̇ = forward_dynamics on y = (q, v), for implicit methods. The derivatives of
the acceleration come from the engine, or from the lagrangian engine where the engine has none. They are along the
manifold; for a quaternion x of any length the tangent of a change dx is 2 Eᵀ dx / |x|², with ẋ = ½ E(x) ω, since
Eᵀ E = |x|².

Small changes (u, w) of a state follow d/dt (u, w) = J (u, w); with plain coordinates J = [[0, 1], [∂a/∂q, ∂a/∂v]]. The
eigenvalues λ limit an explicit method's step: h|λ| of at most about 5 for rk853, 2.8 for rk4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import CENTRAL_STEP, EPS, Array, batch_of, finite_array, real
from mbkit.engines import Dynamics, dynamics
from mbkit.engines.base import at_time, no_dynamics
from mbkit.engines.registry import DERIVED
from mbkit.errors import InputError, NumericalError
from mbkit.methods.small_motions import graded
from mbkit.model import Model
from mbkit.model.integration_space import Space
from mbkit.model.manifold import tangent_maps, unit_quaternions
from mbkit.simulate.torque import Force, TorqueCallback, TorqueFunction

_TWIN: Final = "_derived_twin"
#: Smallest Re λ over |λ| of a motion that grows rather than oscillates.
_MIN_GROWTH_SHARE: Final = 0.1
#: Number of rows up to which a norm is not worth its time.
_MAX_SMALL_ROWS: Final = 20


class RateJacobian:
    """∂ẏ/∂y of one state, for the right-hand side `Rates`; `evaluations` counts Jacobians."""

    def __init__(self, dyn: Dynamics) -> None:
        self._twin, self._model, self._acting = _twin(dyn._bare or dyn), dyn.model, dyn._acting
        self._own = self._twin
        layout = dyn.model.layout
        self._joints = [(j.type, layout.q[j.name], layout.v[j.name]) for j in dyn.model.independent_joints]
        nq, nv = dyn.model.nq, dyn.model.nv
        self._last: Array = np.zeros((nq + nv,) * 2)
        # Positions add and v is q̇.
        self._plain = np.eye(nq + nv, k=nq) if dyn.model.velocity_map is None and not dyn.model.quaternions else None
        self.evaluations = 0

    def only(self, member: int) -> None:
        """Go on with this member of a batch."""
        self._own = self._twin._of_samples([member])

    def __call__(self, t: float, y: Array, force: Force) -> Array:
        """Return the Jacobian, (nq + nv, nq + nv); the last one where the state is not finite or singular."""
        nq, nv = self._model.nq, self._model.nv
        # The step from such a state fails by its rate.
        if not np.isfinite(y).all():
            return self._last
        q, lengths = unit_quaternions(self._model, y[:nq])
        v = y[nq:]
        own = at_time(self._own, t)
        if self._acting[0]:
            force = self._with_wrenches(own, force)
        tau = force if isinstance(force, np.ndarray) else force(t, q, v)
        try:
            by_q, by_v, by_tau = (x.reshape(nv, nv) for x in own.forward_dynamics_derivatives(q, v, tau))
        except NumericalError:
            return self._last
        self.evaluations += 1
        if not isinstance(force, np.ndarray):
            torque_by_q, torque_by_v = _differences(self._model, force, t, q, v, tau)
            by_q, by_v = by_q + by_tau @ torque_by_q, by_v + by_tau @ torque_by_v
        if self._plain is not None:
            self._last = self._plain.copy()
            self._last[nq:, :nq], self._last[nq:, nq:] = by_q, by_v
        else:
            self._last = np.empty((nq + nv, nq + nv))
            self._last[:nq, :nq], self._last[:nq, nq:], tangent = self._kinematics(q, v, lengths)
            self._last[nq:, :nq], self._last[nq:, nq:] = by_q @ tangent, by_v
        return self._last

    def _with_wrenches(self, own: Dynamics, force: Force) -> Force:
        """Return the generalized force of τ and wrenches, whose slope is that of a function."""
        nv = self._model.nv

        def whole(t: float, q: Array, v: Array) -> Array:
            u = force if isinstance(force, np.ndarray) else force(t, q, v)
            of_wrenches = own._evaluate("generalized_force", *self._acting, q=q, wrenches=u[nv:])
            return np.asarray(u[:nv] + of_wrenches.reshape(nv))

        return whole

    def _kinematics(self, q: Array, v: Array, lengths: Array) -> tuple[Array, Array, Array]:
        """Return ∂(D v)/∂q, D, and the tangent of a change of q, (nv, nq)."""
        if self._model.velocity_map is not None:
            return cast("tuple[Array, Array, Array]", tuple(self._model.velocity_map.linear(q, v)))
        rate = np.zeros((len(q), len(q)))
        D, tangent = (x.copy() for x in tangent_maps(self._model, q))
        left = iter(lengths.tolist())
        for kind, a, b in self._joints:
            start = kind.quaternion
            if start is None:
                continue
            # The quaternion's own rate is linear in it.
            for i, e in enumerate(np.eye(kind.nq)[start:].tolist()):
                rate[a.start + start : a.stop, a.start + start + i] = kind.qdot(e, v[b].tolist())[start:]
            length, turn = next(left), slice(a.start + start, a.stop)
            tangent[b, turn] /= length
            if kind.floating:
                # d(R v) = -R (v × dθ)
                linear, angular = slice(b.start, b.start + start), slice(b.start + start, b.stop)
                change = np.cross(v[linear], tangent[angular, turn], axisb=0, axisc=0)
                rate[a.start : a.start + start, turn] = -D[a.start : a.start + start, linear] @ change
            D[turn, b] *= length
        return rate, D, tangent


def _differences(
    model: Model, force: Callable[[float, Array, Array], Array], t: float, q: Array, v: Array, tau: Array
) -> tuple[Array, Array]:
    """Return ∂τ/∂q along the manifold and ∂τ/∂v of a user's function, good to half of the digits."""
    by_q, by_v = np.empty((model.nv, model.nv)), np.empty((model.nv, model.nv))
    root = float(np.sqrt(EPS))
    for k, e in enumerate(np.eye(model.nv)):
        h = root * max(1.0, abs(float(v[k])))
        by_q[:, k] = (force(t, model.integrate(q, root * e), v) - tau) / root
        by_v[:, k] = (force(t, q, v + h * e) - tau) / h
    return by_q, by_v


def _twin(dyn: Dynamics) -> Dynamics:
    if not dyn._why_no_derivatives:
        return dyn
    # Deriving and compiling costs more than most runs: once for each engine's object.
    if _TWIN not in vars(dyn):
        vars(dyn)[_TWIN] = dynamics(dyn.model, DERIVED)
    return cast("Dynamics", vars(dyn)[_TWIN])


def linearized(space: Space, q: Array, w: Array, rates: Callable[[Array, Array], Array]) -> Array:
    """Return J by central differences, (2 nv, 2 nv); w is the integrators' own velocity, rates(q, w) is ẇ of rows."""
    nv = space.nv
    length = CENTRAL_STEP * np.maximum(1.0, np.abs(space.magnitude(q, w)))
    # Wide for the digits: accelerations are of second order in v, and so exact.
    speed = np.full(nv, 1e-4 * max(1.0, float(np.abs(w).max(initial=0.0))))
    changes = np.diag(np.concatenate([length, speed]))
    both = np.concatenate([changes, -changes])
    u, there = both[:, :nv], w + both[:, nv:]
    places = space.retract(np.broadcast_to(q, (len(u), len(q))), u)
    slopes = np.concatenate([space.rate(u, there), rates(places, there)], axis=1)
    return np.asarray((slopes[: 2 * nv] - slopes[2 * nv :]).T / (2 * np.diag(changes)))


@dataclass(frozen=True, eq=False)
class Stiffness:
    """The rates of the motions near a state.

    Attributes
    ----------
    eigenvalues : (n,) complex array
        Of the linearized system, fastest first, 1/s; empty where the bound was enough.
    bound : float
        No rate is larger, 1/s: the fastest, or where eigenvalues were left out a norm.
    exact : bool
        Whether by derivatives, or by differences, which resolve the fastest rates only.
    member : int or None
        Of a batch, the trajectory whose fastest rate is the largest.
    """

    eigenvalues: Array
    bound: float
    exact: bool = True
    member: int | None = None

    @property
    def rate(self) -> float:
        """Fastest ``|λ|``, 1/s; the bound where no eigenvalues were asked for."""
        return float(np.abs(self.eigenvalues[0])) if len(self.eigenvalues) else self.bound

    @property
    def stable(self) -> float:
        """Fastest ``|λ|`` of what decays or oscillates, 1/s; any method's steps follow what grows."""
        if not len(self.eigenvalues):
            return self.bound
        size = np.abs(self.eigenvalues)
        return float(size[self.eigenvalues.real <= _MIN_GROWTH_SHARE * size].max(initial=0.0))

    @property
    def decay(self) -> float:
        """Fastest -Re λ, 1/s; 0 where nothing decays."""
        return self._fastest(-self.eigenvalues.real)

    @property
    def growth(self) -> float:
        """Fastest Re λ, 1/s; 0 where nothing grows."""
        return self._fastest(self.eigenvalues.real)

    @property
    def oscillation(self) -> float:
        """Fastest ``|Im λ|``, rad/s."""
        return self._fastest(self.eigenvalues.imag)

    @staticmethod
    def _fastest(rates: Array) -> float:
        return max(0.0, float(rates.max(initial=0.0)))

    def __str__(self) -> str:
        if not len(self.eigenvalues):
            return f"no rate above {self.bound:.2g} 1/s"
        units = {"decay": "1/s", "oscillation": "rad/s", "growth": "1/s"}
        rates = {name: getattr(self, name) for name in units}
        parts = [f"fastest {k} {x:.2g} {units[k]}" for k, x in rates.items() if x > 1e-3 * self.rate]
        return ", ".join(parts) or "no motion of its own"

    def __repr__(self) -> str:
        which = "" if self.member is None else f" of trajectory {self.member}"
        return f"<Stiffness{which}: {self}>"


def stiffness(
    dyn: Dynamics,
    q: ArrayLike,
    v: ArrayLike,
    tau: ArrayLike | TorqueFunction | None = None,
    t: float = 0.0,
    *,
    enough: float = 0.0,
) -> Stiffness:
    """Return how fast the motions near a state are.

    Parameters
    ----------
    dyn : Dynamics
        The own derivation differentiates exactly; other engines use finite differences, in one call.
    q, v : (nq,) and (nv,), or (N, nq) and (N, nv) array_like
        Of a batch, the member with the fastest rate counts.
    tau : (nv,) array_like or callable, optional
        The generalized force; the slope of a function of (t, q, v) counts too.
    t : float
        s.
    enough : float
        Where a norm shows that no rate is above this, 1/s, eigenvalues of large systems are left out.

    Raises
    ------
    NumericalError
        The engine has no acceleration there.

    Examples
    --------
    >>> import mbkit as mb
    >>> b = mb.ModelBuilder("slider")
    >>> b.add_body("mass", mass=1.0)
    >>> b.add_joint("x", "prismatic", parent="world", child="mass", axis=(1, 0, 0), stiffness=1e12, damping=1e3)
    >>> mb.simulate.stiffness(mb.dynamics(b.build()), [0.0], [0.0])
    <Stiffness: fastest oscillation 1e+06 rad/s>
    """
    if not isinstance(dyn, Dynamics):
        raise no_dynamics(dyn)
    model = dyn.model
    q, v, t, enough = model.check_q(q), model.check_v(v), real("t", t), real("enough", enough, nonnegative=True)
    torque = tau if callable(tau) else finite_array("tau", np.zeros(model.nv) if tau is None else tau, (model.nv,))
    states, count = batch_of(q=q, v=v), dyn._samples
    if states is not None and count is not None and states != count:
        raise InputError(f"q, v: a batch of {states}, but the parameters' values are {count}")
    count = states if count is None else count
    if count is None:
        return _of_one(dyn, q, v, torque, t, enough)
    if not count:
        raise InputError("q: expected at least one state, got an empty batch")
    q, v = np.broadcast_to(q, (count, model.nq)), np.broadcast_to(v, (count, model.nv))
    each = [_of_one(dyn._of_samples([i]), q[i], v[i], torque, t, enough, i) for i in range(count)]
    return max(each, key=lambda one: one.rate)


def _of_one(
    dyn: Dynamics, q: Array, v: Array, tau: Any, t: float, enough: float, member: int | None = None
) -> Stiffness:
    model = dyn.model
    force: Force = TorqueCallback(tau, model.nv).one if callable(tau) else tau
    if not model.nv:
        return Stiffness(np.zeros(0, dtype=complex), 0.0, member=member)
    if dyn._derived:
        exact = RateJacobian(dyn)
        J = exact(t, np.concatenate([q, v]), force)
        if not exact.evaluations:
            raise NumericalError(f"stiffness: {model.name} has no derivative of its acceleration at q = {q.tolist()}")
        return stiffness_of(J, enough, exact=True, member=member)
    space, own = Space(model), at_time(dyn, t)

    def rates(q: Array, w: Array) -> Array:
        v = space.to_body_velocity(q, w)
        rows = force if isinstance(force, np.ndarray) else np.array([force(t, *x) for x in zip(q, v, strict=True)])
        return np.asarray(space.acceleration(q, v, own.forward_dynamics(q, v, rows)))

    return stiffness_of(
        linearized(space, q, space.to_integrator_velocity(q, v), rates), enough, exact=False, member=member
    )


def stiffness_of(J: Array, enough: float, *, exact: bool, member: int | None = None) -> Stiffness:
    """Return the rates of a linearized system's matrix; see `stiffness`."""
    if not np.isfinite(J).all():
        raise NumericalError("stiffness: the accelerations near the state are not finite")
    # The eigenvalues of a small matrix take no longer than the norm.
    if len(J) > _MAX_SMALL_ROWS:
        from scipy.linalg import matrix_balance

        # Scaled, positions and velocities count alike.
        balanced = np.abs(matrix_balance(J, permute=False)[0])
        bound = float(min(balanced.sum(axis=axis).max(initial=0.0) for axis in (0, 1)))
        if bound <= enough:
            return Stiffness(np.zeros(0, dtype=complex), bound, exact, member)
    rates = graded(J, vectors=False)[0]
    rates = rates[np.argsort(-np.abs(rates), kind="stable")]
    return Stiffness(rates, float(np.abs(rates).max(initial=0.0)), exact, member)
