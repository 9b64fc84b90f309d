"""Rates of the motions near a state: the spectrum of the linearized system.

Small changes (u, w) of a state follow d/dt (u, w) = J (u, w); with plain coordinates J = [[0, 1], [∂a/∂q, ∂a/∂v]]. Its
eigenvalues λ limit an explicit method's step: h|λ| of at most about 5 for rk853, 2.8 for rk4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of, finite_array, real
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time, no_dynamics
from mbkit.errors import InputError, NumericalError
from mbkit.model.integration_space import Space
from mbkit.simulate.torque import TorqueCallback, TorqueFunction

_EPS: Final = float(np.finfo(float).eps)
#: Of central differences in q: where truncation and rounding are alike for a function of its own size.
_STEP: Final = _EPS ** (1 / 3)
#: In v accelerations are of second order, which central differences do exactly: a wide step, for the digits.
_WIDE: Final = 1e-4


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
        Whether by derivatives, or by differences, which tell the fastest rates and not the slowest beside them.
    member : int or None
        Of a batch, the trajectory whose fastest rate is the largest.
    """

    eigenvalues: Array
    bound: float
    exact: bool = True
    member: int | None = None

    @property
    def rate(self) -> float:
        """Fastest |λ|, 1/s; the bound where no eigenvalues were asked for."""
        return float(np.abs(self.eigenvalues[0])) if len(self.eigenvalues) else self.bound

    @property
    def stable(self) -> float:
        """Fastest |λ| of what decays or oscillates, 1/s: what grows is followed by any method's steps."""
        if not len(self.eigenvalues):
            return self.bound
        size = np.abs(self.eigenvalues)
        return float(size[self.eigenvalues.real <= _GROWS * size].max(initial=0.0))

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
        """Fastest |Im λ|, rad/s."""
        return self._fastest(self.eigenvalues.imag)

    @staticmethod
    def _fastest(rates: Array) -> float:
        return max(0.0, float(rates.max(initial=0.0)))

    def __str__(self) -> str:
        if not len(self.eigenvalues):
            return f"no rate above {self.bound:.2g} 1/s"
        rates = {
            "decay": (self.decay, "1/s"),
            "oscillation": (self.oscillation, "rad/s"),
            "growth": (self.growth, "1/s"),
        }
        parts = [f"fastest {k} {x:.2g} {unit}" for k, (x, unit) in rates.items() if x > _SHARE * self.rate]
        return ", ".join(parts) or "no motion of its own"

    def __repr__(self) -> str:
        which = "" if self.member is None else f" of trajectory {self.member}"
        return f"<Stiffness{which}: {self}>"


#: Re λ over |λ| above which a motion grows rather than oscillates.
_GROWS: Final = 0.1
#: Rates below this part of the fastest are not shown.
_SHARE: Final = 1e-3
#: Rows up to which a norm is not worth its time.
_SMALL: Final = 20


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
        The own derivation differentiates exactly; of other engines differences are taken, in one call.
    q, v : (nq,) and (nv,), or (N, nq) and (N, nv) array_like
        Of a batch, the member with the fastest rate counts.
    tau : (nv,) array_like or callable, optional
        The generalized force; of a function of (t, q, v) the slope counts too.
    t : float
        Where time enters, s.
    enough : float
        Where a norm shows that no rate is above this, 1/s, eigenvalues of large systems are left out.

    Raises
    ------
    InputError
        A state or torque of a wrong shape, or not finite.
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
    states, count = batch_of(q=q, v=v), dyn.samples
    if states is not None and count is not None and states != count:
        raise InputError(f"q, v: a batch of {states}, but the parameters' values are {count}")
    count = states if count is None else count
    if count is None:
        return _of_one(dyn, q, v, torque, t, enough, None)
    if not count:
        raise InputError("q: expected at least one state, got an empty batch")
    q, v = np.broadcast_to(q, (count, model.nq)), np.broadcast_to(v, (count, model.nv))
    found = [_of_one(dyn.of_samples([i]), q[i], v[i], torque, t, enough, i) for i in range(count)]
    return max(found, key=lambda one: one.rate)


def _of_one(
    dyn: Dynamics,
    q: Array,
    v: Array,
    tau: Array | TorqueFunction,
    t: float,
    enough: float,
    member: int | None,
) -> Stiffness:
    model = dyn.model
    force = TorqueCallback(tau, model.nv).one if callable(tau) else tau
    if not model.nv:
        return Stiffness(np.zeros(0, dtype=complex), 0.0, member=member)
    if dyn.derived:
        # Other engines need no CasADi.
        from mbkit.simulate.diagnostics.linearization import Linearization

        exact = Linearization(dyn)
        J = exact(t, np.concatenate([q, v]), force)
        if not exact.evaluations:
            raise NumericalError(f"stiffness: {model.name} has no derivative of its acceleration at q = {q.tolist()}")
        return stiffness_of(J, enough, exact=True, member=member)
    space, own = Space(model), at_time(dyn, t)

    def rates(q: Array, w: Array) -> Array:
        v = space.leave(q, w)
        if isinstance(force, np.ndarray):
            tau = force
        else:
            tau = np.array([force(t, *state) for state in zip(q, v, strict=True)])
        return np.asarray(space.acceleration(q, v, own.forward_dynamics(q, v, tau)))

    return stiffness_of(linearized(space, q, space.enter(q, v), rates), enough, exact=False, member=member)


def stiffness_of(J: Array, enough: float, *, exact: bool, member: int | None = None) -> Stiffness:
    """Return the rates of a linearized system's matrix; see `stiffness`."""
    if not np.isfinite(J).all():
        raise NumericalError("stiffness: the accelerations near the state are not finite")
    # Of a small matrix the eigenvalues take no longer than the norm.
    if len(J) > _SMALL and (bound := _bound(J)) <= enough:
        return Stiffness(np.zeros(0, dtype=complex), bound, exact, member)
    found = np.linalg.eigvals(J).astype(complex)
    found = found[np.argsort(-np.abs(found), kind="stable")]
    return Stiffness(found, float(np.abs(found).max(initial=0.0)), exact, member)


def _bound(J: Array) -> float:
    """Return a bound on the eigenvalues: a norm, after scaling by which positions and velocities count alike."""
    from scipy.linalg import matrix_balance

    balanced = matrix_balance(J, permute=False)[0]
    return float(min(np.abs(balanced).sum(axis=axis).max(initial=0.0) for axis in (0, 1)))


def linearized(space: Space, q: Array, w: Array, rates: Callable[[Array, Array], Array]) -> Array:
    """Return J by central differences, (2 nv, 2 nv); w is the integrators' own velocity, rates(q, w) is ẇ of rows."""
    nv = space.nv
    length = _STEP * np.maximum(1.0, np.abs(space.sizes(q, w)))
    speed = np.full(nv, _WIDE * max(1.0, float(np.abs(w).max(initial=0.0))))
    changes = np.diag(np.concatenate([length, speed]))
    both = np.concatenate([changes, -changes])
    u, there = both[:, :nv], w + both[:, nv:]
    moved = space.move(np.broadcast_to(q, (len(u), len(q))), u)
    slopes = np.concatenate([space.rate(u, there), rates(moved, there)], axis=1)
    return np.asarray((slopes[: 2 * nv] - slopes[2 * nv :]).T / (2 * np.diag(changes)))
