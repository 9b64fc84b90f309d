"""Dry friction beside an engine's own terms: at speed a force, at rest a problem of complementarity.

A joint at rest holds by any force up to s, or it begins to move against f <= s. Of s alone, accelerations minimize
Gauss's function with the friction of what does not move (Moreau 1966, Comptes Rendus 262; Anitescu and Potra 1997,
Nonlinear Dynamics 14)::

    v̇ = argmin over a of ½ (a - a0)ᵀ M (a - a0) + Σ s_j |a_j| over the joints at rest,  M a0 = τ + τ_passive - nle

with one minimum. Its dual has a box alone: the forces λ_j of friction, |λ_j| <= s_j, with a = a0 + M⁻¹ λ. Where joints
are bound by loops, M⁻¹ is the response of the accelerations to forces, and a is unique all the same. Where s is above
f, a joint that would move has its bound lowered to f on that side, and the problem is solved again.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import EPS, Array
from mbkit._reproducible import unit_rows
from mbkit.engines.elements.passive import LOADS, UNDER_FORCE, AddedForce
from mbkit.errors import MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.model import Model
from mbkit.model.changes.jumps import JumpLaw, Sliding, jump_bindings
from mbkit.model.parts import POSE_ROUNDING, RESTING, ROUNDING

#: Mask of the velocities at rest.
Mask = NDArray[np.bool_]
#: Rounds of exchanges that may leave as many conditions failing; then conditions are exchanged one by one.
_MAX_ROUNDS_WITHOUT_PROGRESS: Final = 3
#: Phases that dynamics keep.
_MAX_KEPT_PHASES: Final = 256
_FORWARD: Final = "forward_dynamics"
_DOUBLE_SIGNIFICAND_BITS: Final = 53
#: Part of the forces that their sums lose to rounding.
_FORCE_ROUNDING: Final = 64 * EPS
#: Addition to the diagonal of a singular A: far from its own rounding and from what is not rounding.
_PROXIMAL_SHIFT: Final = 2.0**-32
#: Proximal points; two are enough, unless A is nearly singular, too.
_MAX_PROXIMAL_POINTS: Final = 10_000
_UNDECIDED: Final = "dry friction: which of {n} joints at rest begin to move cannot be decided: singular inertia"
#: Joints whose power differs by less than this part let go together, as rounding does not break a symmetry.
_POWER_TIE_RATIO: Final = 1e-9


def forces_at_rest(A: Array, b: Array, bound: Array) -> Array:
    """Return the forces of `solve_at_rest` of one problem whose A may be singular, (n,)."""
    every, none = np.ones((1, len(b)), dtype=bool), np.zeros((1, len(b)))
    return np.asarray(solve_at_rest(A[None], b[None], bound[None], every, none, definite=False)[0][0])


def solve_at_rest(A: Array, b: Array, bound: Array, on: Mask, side: Array, *, definite: bool) -> tuple[Array, Array]:
    """Return the λ with |λ| <= bound that minimize ½ λᵀ A λ + bᵀ λ, and the signs of those at bounds; (N, n) each.

    λ is zero where `on` is False. A, (N, n, n), is positive definite or semidefinite. Of a semidefinite one, λ is the
    limit of proximal points, whose A is definite (Rockafellar 1976, SIAM Journal on Control and Optimization 14).
    `side` is a first guess of the signs.
    """
    if definite:
        return _of_definite(A, b, bound, on, side)
    size = np.abs(np.einsum("nii->ni", A))
    # To each its own: a joint that hardly responds takes as few points as the others.
    near = _PROXIMAL_SHIFT * np.where(size > 0, size, 1.0)
    own = A + near[..., None] * np.eye(b.shape[1])
    noise = _noise(A, b, bound)
    forces = np.zeros(b.shape)
    for _ in range(_MAX_PROXIMAL_POINTS):
        before = forces
        forces, side = _of_definite(own, b - near * before, bound, on, side)
        if (near * np.abs(forces - before) <= noise).all():
            return forces, side
    raise NumericalError(_UNDECIDED.format(n=b.shape[1]))


def _of_definite(A: Array, b: Array, bound: Array, on: Mask, side: Array) -> tuple[Array, Array]:
    """Return what `solve_at_rest` does, where A is positive definite.

    The set of forces at their bounds is exchanged as a whole as long as fewer conditions fail, then one by one, the
    last first, which ends (Murty 1974, Linear Algebra and its Applications 9; Júdice and Pires 1994, Computers and
    Operations Research 21).
    """
    size, n = b.shape
    forces = np.zeros((size, n))
    best, left = np.full(size, n + 1), np.full(size, _MAX_ROUNDS_WITHOUT_PROGRESS)
    side = np.where(on, side, 0.0)
    going = np.arange(size)
    # A velocity that is undecided to rounding is at rest.
    noise = _noise(A, b, bound)
    for _ in range(100 * (n + 1) ** 2):
        own, here = A[going], side[going]
        inner = on[going] & (here == 0)
        at_bound = here * bound[going]
        pushed = b[going] + (own @ at_bound[..., None])[..., 0]
        x = np.where(inner, _restricted(own, -pushed, inner), at_bound)
        a = b[going] + (own @ x[..., None])[..., 0]
        wrong = np.where(inner, np.abs(x) > bound[going] * (1 + ROUNDING), here * a > noise[going])
        forces[going] = x
        counts = wrong.sum(axis=1)
        fewer = counts < best[going]
        alone = ~fewer & (left[going] == 0)
        last = np.cumsum(wrong[:, ::-1], axis=1)[:, ::-1] == 1
        change = np.where(alone[:, None], wrong & last, wrong)
        best[going] = np.where(fewer, counts, best[going])
        left[going] = np.where(fewer, _MAX_ROUNDS_WITHOUT_PROGRESS, np.maximum(left[going] - 1, 0))
        side[going] = np.where(change, np.where(inner, np.sign(x), 0.0), here)
        going = going[counts > 0]
        if not len(going):
            return forces, side
    raise NumericalError(_UNDECIDED.format(n=n))


def _noise(A: Array, b: Array, bound: Array) -> Array:
    """Return the rounding of accelerations under forces up to their bounds, (N, n)."""
    return np.asarray(_FORCE_ROUNDING * (np.abs(b) + (np.abs(A) @ bound[..., None])[..., 0]))


def _restricted(A: Array, right: Array, on: Mask, *, definite: bool = True) -> Array:
    """Return the x with A x = right in the entries that are on, and zero in the others, (N, n)."""
    # The others have an equation of their own, of the size of A.
    size = np.abs(np.einsum("nii->ni", A)).max(axis=1, initial=1e-300)[:, None, None]
    own = np.where(on[:, :, None] & on[:, None, :], A, size * np.eye(A.shape[-1]) * ~on[:, :, None])
    right = np.where(on, right, 0.0)[..., None]
    x = np.linalg.solve(own, right) if definite else np.linalg.pinv(own, rcond=_PROXIMAL_SHIFT, hermitian=True) @ right
    return np.asarray(x[..., 0])


def jump_forces(
    A: Array, b: Array, bound: Array, less: Array, on: Mask, known: Array, *, definite: bool = True
) -> tuple[Array, Mask]:
    """Return the forces of friction at rest, and which of them hold; those `known` do not; (N, n).

    First all hold up to their bounds. Of those that would move, the one whose friction takes the most power lets go:
    on that side it has `less` from then on, the friction of motion, and the problem is solved again with what the
    others feel of it. It may come to hold after all. Each round lowers a bound, so that there are 2 n at most, and the
    last is consistent: a joint holds within its bound, or moves against the friction of motion.
    """
    forces, holds = np.zeros(b.shape), np.zeros(b.shape, dtype=bool)
    lower, upper, free = np.where(known < 0, known, -bound), np.where(known > 0, known, bound), on & (known != 0)
    rows, sides = np.arange(len(b)), np.zeros(b.shape)
    while len(rows):
        own, low, high, loose, act = A[rows], lower[rows], upper[rows], free[rows], on[rows]
        middle = np.where(act, np.where(loose, known[rows], 0.5 * (low + high)), 0.0)
        pushed = b[rows] + (own @ middle[..., None])[..., 0]
        given = own, pushed, 0.5 * (high - low), act & ~loose, sides[rows]
        x, sides[rows] = solve_at_rest(*given, definite=definite)
        side = sides[rows]
        forces[rows] = x = np.where(side < 0, low, np.where(side > 0, high, middle + x))
        a = b[rows] + (own @ x[..., None])[..., 0]
        # Forces of loops are not unique: what is at its bound may be held by the others, to the rounding of A.
        size = _PROXIMAL_SHIFT / _FORCE_ROUNDING * _noise(own, b[rows], bound[rows])
        moves = side != 0 if definite else side * a < -size
        holds[rows] = act & ~loose & ~moves
        falls = moves & (np.abs(x) > less[rows])
        power = np.where(falls, np.abs(a) * bound[rows], 0.0)
        first = falls & (power >= (1 - _POWER_TIE_RATIO) * power.max(axis=1, keepdims=True))
        lower[rows] = np.where(first & (side < 0), -less[rows], low)
        upper[rows] = np.where(first & (side > 0), less[rows], high)
        # A joint that is known to leave may be held by what the others do then.
        free[rows] &= ~first.any(axis=1, keepdims=True)
        rows = rows[first.any(axis=1)]
    return forces, holds


class Jumps(AddedForce):
    """Dry friction of a model, for the quantities of an engine."""

    def __init__(self, model: Model) -> None:
        self._model, self.law, self._varies = model, JumpLaw(model), bool(jump_bindings(model))
        self._constrained = model.constrained
        #: A model, and that whose joints slide, for `phases`.
        self._slid: tuple[Model, Model] | None = None

    def force(self, dyn: Any, q: Array, v: Array) -> Array:  # noqa: ARG002  # of the velocities alone
        return self.law_of(dyn).force(v)

    def slopes(self, dyn: Any, q: Array, v: Array) -> tuple[Array, Array]:  # noqa: ARG002  # as above
        by_v = self.law_of(dyn).slope(v)
        return np.zeros_like(by_v), by_v

    def law_of(self, dyn: Any) -> JumpLaw:
        """Return the law at the values of parameters of some dynamics of this model, or of each of their samples."""
        if not (self._varies and dyn._derived):
            return self.law
        held = vars(dyn)
        if "_law" not in held:
            held["_law"] = JumpLaw(self._model, dict(zip(dyn.model.parameters, dyn._parameter_values.T, strict=True)))
        out: JumpLaw = held["_law"]
        return out

    def beside(self, quantity: str, method: Callable[..., Any], dyn: Any) -> Callable[..., Any]:
        """Return an engine's method for a quantity with friction; terms of one with elements hold it at speed."""
        law, moving = self.law_of(dyn), method if dyn._has_force_elements else super().beside(quantity, method, dyn)
        if quantity in UNDER_FORCE:

            def pushed(q: Array, v: Array, tau: Array, *rest: Any) -> Any:
                resting = law.at_rest(v)
                if not resting.any():
                    return moving(q, v, tau, *rest)
                if dyn._significand_bits > _DOUBLE_SIGNIFICAND_BITS:
                    return self._in_phase(quantity, dyn, q, v, tau, rest, resting)
                held, still = self._each(dyn, quantity, moving, q, v, tau, rest, resting)
                out = moving(q, v, tau + padded(held, tau), *rest)
                # A joint that friction holds does not move, not even by a rounding.
                return np.where(still, 0.0, out) if quantity.startswith(_FORWARD) else out

            return pushed
        if quantity == "forward_dynamics_derivatives":

            def of_forward(q: Array, v: Array, tau: Array) -> Any:
                if law.at_rest(v).any():
                    warn(
                        f"{self._model.name}: dry friction at rest has no derivative, and is left out of these; take "
                        "model.without('friction') to do so knowingly, or velocities that are not zero",
                        MbkitWarning,
                    )
                return moving(q, v, tau)

            return of_forward
        if quantity in LOADS:

            def loaded(q: Array, v: Array, *rest: Any) -> Any:
                if law.at_rest(v).any():
                    raise UnsupportedError(
                        f"loads of joints and loops: {self._model.name} has joints with dry friction at rest, whose "
                        "share of the loads is not known; give velocities, or take model.without('friction')"
                    )
                return moving(q, v, *rest)

            return loaded
        return moving

    def warn_of_shares(self, dyn: Any, quantity: str, q: Array, v: Array, tau: Array) -> None:
        """Warn where joints rest together in fewer ways than there are joints: what holds them is not unique."""
        if not (resting := self.law_of(dyn).at_rest(v)).any():
            return
        still, N = np.atleast_2d(resting & (dyn.forward_dynamics(q, v, tau) == 0)), self.directions(dyn, q)
        N = np.broadcast_to(N, (len(still), *N.shape[-2:]))
        many = [k for k, r in enumerate(still) if np.linalg.matrix_rank(N[k][r], POSE_ROUNDING) < r.sum()]
        if many:
            names = ", ".join(self._model.velocity_names[i] for i in np.flatnonzero(still[many[0]]))
            where = f" in {len(many)} of {len(still)} states, first in {many[0]}" if len(still) > 1 else ""
            warn(
                f"{self._model.name}: {quantity}: what holds {names} at rest is one solution of many{where}; "
                "the motion is unique",
                MbkitWarning,
            )

    def _each(
        self,
        dyn: Any,
        quantity: str,
        method: Callable[..., Any],
        q: Array,
        v: Array,
        tau: Array,
        rest: tuple[Any, ...],
        resting: Mask,
    ) -> tuple[Array, Mask]:
        """Return `decided` of a state or of each of a batch, of which only those with joints at rest are looked at."""
        single = v.ndim == 1
        rows: Any = ... if single else np.flatnonzero(resting.any(axis=1))
        own = dyn if single else dyn._of_samples(rows)
        forward = quantity.startswith(_FORWARD)
        accelerate = method
        if own is not dyn or not forward:
            name = quantity if forward else _FORWARD
            accelerate = own._without_jumps(name)
            accelerate = accelerate if own._has_force_elements else super().beside(name, accelerate, own)
        more = [x[rows] if isinstance(x, np.ndarray) else x for x in rest] if forward else []
        held, still = np.zeros(v.shape), np.zeros(v.shape, dtype=bool)
        held[rows], still[rows] = self.decided(
            own, lambda f: accelerate(q[rows], v[rows], f, *more), q[rows], tau[rows], resting[rows]
        )
        return held, still

    def decided(
        self,
        dyn: Any,
        accelerate: Callable[[Array], Array],
        q: Array,
        tau: Array,
        resting: Mask,
        leaving: Array | None = None,
        law: JumpLaw | None = None,
    ) -> tuple[Array, Mask]:
        """Return the forces of friction at rest, and which joints stay at rest; (nv,) or (N, nv).

        `accelerate` gives accelerations under a force without friction at rest; `leaving` has the signs of the
        velocities that joints at rest are about to have, where that is known, (nv,) or (N, nv).
        """
        law, shape = law or self.law_of(dyn), resting.shape
        b = np.asarray(accelerate(tau), dtype=np.float64)
        # Where there are no accelerations nothing is held, and the engine says why there are none.
        none = np.asarray(~np.isfinite(b).all(axis=-1, keepdims=True))
        A = np.where(none[..., None], 0.0, self.responses(dyn, q))
        resting, b, n = resting & ~none, np.where(none, 0.0, b), shape[-1]
        A, b, on = A.reshape(-1, n, n), b.reshape(-1, n), resting.reshape(-1, n)
        bound, less = (np.broadcast_to(x, on.shape) for x in (law.bound, law.just_moving))
        known = np.zeros(on.shape) if leaving is None else (-leaving * law.just_moving).reshape(on.shape)
        definite = not self._constrained
        forces, holds = jump_forces(A, b, bound, less, on, known, definite=definite)
        # A has the rounding of M; what the engine's own accelerations still leave corrects that.
        left = accelerate(tau + padded(forces.reshape(shape), tau))
        left = np.asarray(left, dtype=np.float64).reshape(on.shape)
        forces = forces - _restricted(A, left, holds, definite=definite)
        return forces.reshape(shape), holds.reshape(shape)

    def directions(self, dyn: Any, q: Array) -> Array:
        """Return a basis of the velocities that constraints allow at configurations, (nv, k) or (N, nv, k)."""
        J = dyn.constraint_jacobian(q)[..., list(dyn._row_choice.independent), :]
        return np.asarray(np.linalg.svd(unit_rows(J))[2][..., J.shape[-2] :, :].mT)

    def responses(self, dyn: Any, q: Array) -> Array:
        """Return the accelerations of joints per force on each of them, (nv, nv) or (N, nv, nv)."""
        M = np.asarray((dyn._bare or dyn).mass_matrix(q))
        # Differences of accelerations have the rounding of the largest, by which a joint at its dead centre loses all.
        N = self.directions(dyn, q) if self._constrained else np.eye(M.shape[-1])
        try:
            out = np.asarray(N @ np.linalg.solve(N.mT @ M @ N, N.mT))
        except np.linalg.LinAlgError:
            raise NumericalError(_UNDECIDED.format(n=M.shape[-1])) from None
        if not self._constrained:
            return out
        # A joint that loops hold responds by rounding alone, of either sign; the least response keeps A definite.
        masses, own = (np.einsum("...ii->...i", x) for x in (M, out))
        own[...] = np.maximum(own, _PROXIMAL_SHIFT / np.where(masses > 0, masses, np.inf))
        return np.asarray(0.5 * (out + out.mT))

    def phase(self, dyn: Any, sides: Array, still: Mask) -> Any:
        """Return the dynamics in which velocities have these signs, or stay at rest: smooth, and without friction."""
        sliding, bare = self.sliding, dyn._bare or dyn
        # Steps of a controller ask for the same few again and again.
        held: dict[Any, Any] = vars(bare).setdefault("_phases", {})
        key = np.where(still, 0.0, np.sign(sides)).tobytes(), still.tobytes(), dyn.model.time
        if key not in held:
            if len(held) >= _MAX_KEPT_PHASES:
                held.clear()
            held[key] = bare._of_model(sliding.at(sides, still, dyn.model), sliding.form)
            # The dynamics with friction have looked at the state, and what a phase goes through is open by rounding.
            held[key]._state_unchecked = False
        return held[key]._under(*dyn._acting) if dyn._acting[0] else held[key]

    def phases(self, dyn: Any, sides: Array, still: Mask) -> Any:
        """Return the dynamics of a batch in which each state has its own signs and rest, (N, nv); own derivation."""
        sliding, bare, model = self.sliding, dyn._bare or dyn, dyn.model
        if self._slid is None or self._slid[0] is not model:
            none = np.zeros(model.nv)
            self._slid = model, sliding.at(none, none > 0, model)
        own = bare._of_model(self._slid[1], sliding.form)
        values = {name: np.where(still, 0.0, sides)[:, i] for i, name in sliding.sides.items()}
        values |= {name: RESTING * still[:, i] for i, name in sliding.locks.items()}
        own = own._with(own.model, {**own._batched, **values})
        own._state_unchecked = False
        return own._under(*dyn._acting) if dyn._acting[0] else own

    @cached_property
    def sliding(self) -> Sliding:
        """The model whose joints slide one way or rest."""
        return Sliding(self._model)

    def _in_phase(
        self, quantity: str, dyn: Any, q: Array, v: Array, tau: Array, rest: tuple[Any, ...], resting: Mask
    ) -> Any:
        """Return a quantity of more digits than a double's, by the model whose joints slide or rest; (N, ...)."""
        moves = quantity.startswith(_FORWARD)
        forward = dyn._without_jumps(quantity if moves else _FORWARD)

        def one(i: int) -> Any:
            # Frames and axes of wrenches are those of all states.
            states = [x[i : i + 1] for x in (q, v)]
            more = [x[i : i + 1] if isinstance(x, np.ndarray) else x for x in rest]

            def accelerate(force: Array) -> Array:
                return np.asarray(dyn._rounded(forward(*states, force[None], *(more if moves else ())))[0])

            held, still = self.decided(dyn, accelerate, q[i], tau[i], resting[i])
            phase = self.phase(dyn, np.where(resting[i], -np.sign(held), np.sign(v[i])), still)
            value = phase._without_jumps(quantity)(*states, tau[i : i + 1], *more)
            return value * phase._arithmetic.array(1.0 - still) if moves else value

        return np.concatenate([one(i) for i in range(len(v))])


def padded(force: Array, tau: Array) -> Array:
    """Return a force with zeros for the wrenches that stand behind τ."""
    lacking = tau.shape[-1] - force.shape[-1]
    return np.concatenate([force, np.zeros((*force.shape[:-1], lacking))], axis=-1) if lacking else force
