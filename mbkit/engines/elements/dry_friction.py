"""Dry friction beside an engine's own terms: at speed a force, at rest the answer of Gauss's principle.

Accelerations at rest minimize Gauss's function with the friction of what does not move (Moreau 1966, Comptes Rendus
262; Anitescu and Potra 1997, Nonlinear Dynamics 14)::

    v̇ = argmin over a of ½ (a - a0)ᵀ M (a - a0) + Σ s_j |a_j| over the joints at rest,  M a0 = τ + τ_passive - nle

with one minimum. Its dual has a box alone: the forces λ_j of friction, |λ_j| <= s_j, with a = a0 + M⁻¹ λ. Where joints
are bound by loops, M⁻¹ is the response of the accelerations to forces, and a is unique all the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit._warn import warn
from mbkit.errors import MbkitWarning, NumericalError, UnsupportedError
from mbkit.model import Model
from mbkit.model.changes.dry_friction import ROUNDING, DryFrictionLaw, Sliding

Indices = NDArray[np.intp]
#: What is at rest of velocities.
Mask = NDArray[np.bool_]
#: Quantities whose argument is a force, the third one.
UNDER_FORCE: Final = (
    *("forward_dynamics", "forward_dynamics_with_wrenches"),
    *("constraint_forces", "generalized_constraint_force"),
)
#: Loads of mechanisms, by the place of the force among their arguments.
_LOADS: Final = {"loads_under_force": 2, "loads_of_motion": 3}
#: Phases that dynamics keep, at most.
_PHASES: Final = 256
_FORWARD: Final = "forward_dynamics"
_DOUBLE: Final = 53
_EPS: Final = float(np.finfo(float).eps)
#: Of forces, what their sums lose to rounding.
_ROUNDING: Final = 64 * _EPS


def forces_at_rest(A: Array, b: Array, bound: Array) -> Array:
    """Return the forces of `solve_at_rest`."""
    return solve_at_rest(A, b, bound)[0]


def solve_at_rest(A: Array, b: Array, bound: Array) -> tuple[Array, Mask]:
    """Return the λ with |λ| <= bound that minimizes ½ λᵀ A λ + bᵀ λ, and where it is inside; (n,) each.

    A is positive semidefinite.

    The set of forces at their bounds is exchanged as a whole as long as fewer conditions fail, then one by one, the
    last first, which ends (Murty 1974, Linear Algebra and its Applications 9; Júdice and Pires 1994, Computers and
    Operations Research 21).
    """
    n, side = len(b), np.zeros(len(b))
    best, left = n + 1, 3
    for _ in range(100 * (n + 1) ** 2):
        inner = side == 0
        forces = side * bound
        if inner.any():
            right = -(b[inner] + A[np.ix_(inner, ~inner)] @ forces[~inner])
            forces[inner] = np.linalg.lstsq(A[np.ix_(inner, inner)], right, rcond=None)[0]
        a = b + A @ forces
        # What is undecided to rounding is at rest.
        noise = _ROUNDING * (np.abs(b) + np.abs(A) @ bound)
        wrong = np.where(inner, np.abs(forces) > bound * (1 + ROUNDING), side * a > noise)
        count = int(wrong.sum())
        if not count:
            return forces, inner
        if count < best:
            best, left = count, 3
        elif left:
            left -= 1
        else:
            wrong[: np.flatnonzero(wrong)[-1]] = False
        side = np.where(wrong, np.where(inner, np.sign(forces), 0.0), side)
    raise NumericalError(
        f"dry friction: which of {n} joints at rest begin to move cannot be decided; their inertia is singular"
    )


def friction_forces(A: Array, b: Array, bound: Array, less: Array, known: Array) -> tuple[Array, Mask]:
    """Return the forces of friction as `forces_at_rest` does, and which of them hold; those `known` beforehand do not.

    What lets go has the friction of motion. Where that is `less` than the bound, the others feel it.
    """
    forces, free = known.copy(), known != 0
    holds = ~free
    while True:
        on = ~free
        pushed = b[on] + A[np.ix_(on, free)] @ forces[free]
        forces[on], holds[on] = solve_at_rest(A[np.ix_(on, on)], pushed, bound[on])
        if not (drops := on & ~holds & (less < bound)).any():
            return forces, holds
        forces[drops], free, holds = np.sign(forces[drops]) * less[drops], free | drops, holds & ~drops


class DryFriction:
    """Dry friction of a model, for the quantities of an engine."""

    def __init__(self, model: Model) -> None:
        self._model, self.law = model, DryFrictionLaw(model)
        self._constrained = model.constrained

    def beside(self, quantity: str, method: Callable[..., Any], dyn: Any) -> Callable[..., Any]:
        """Return an engine's method for a quantity with friction; terms of one with elements hold it at speed."""
        law, added = self.law, not dyn.has_elements
        if quantity in UNDER_FORCE:

            def pushed(q: Array, v: Array, tau: Array, *rest: Any) -> Any:
                force = tau + _padded(law.force(v), tau) if added else tau
                resting = law.at_rest(v)
                if not resting.any():
                    return method(q, v, force, *rest)
                if dyn.bits > _DOUBLE:
                    return self._in_phase(quantity, dyn, q, v, tau, rest, resting)
                held, still = self._each(dyn, quantity, method, q, v, force, rest, resting)
                out = method(q, v, force + _padded(held, tau), *rest)
                # What friction holds does not move, not even by a rounding.
                return np.where(still, 0.0, out) if quantity.startswith(_FORWARD) else out

            return pushed
        if quantity == "forward_dynamics_derivatives":

            def of_forward(q: Array, v: Array, tau: Array) -> Array:
                if law.at_rest(v).any():
                    warn(
                        f"{self._model.name}: dry friction at rest has no derivative, and is left out of these; take "
                        "model.without('friction') to do so knowingly, or velocities that are not zero",
                        MbkitWarning,
                    )
                if not added:
                    return np.asarray(method(q, v, tau))
                own = method(q, v, tau + law.force(v))
                return np.asarray(own + _by_velocity(own[..., 2, :, :] @ law.slope(v)))

            return of_forward
        if quantity in _LOADS:
            place = _LOADS[quantity]

            def loaded(*states: Any) -> Any:
                if law.at_rest(states[1]).any():
                    raise UnsupportedError(
                        f"loads of joints and loops: {self._model.name} has joints with dry friction at rest, whose "
                        "share of the loads is not known; give velocities, or take model.without('friction')"
                    )
                force = law.force(states[1]) if added else 0.0
                return method(*states[:place], states[place] + force, *states[place + 1 :])

            return loaded
        if not added:
            return method
        if quantity == "passive":
            return lambda q, v: method(q, v) + law.force(v)
        if quantity in ("inverse_dynamics", "inverse_dynamics_with_wrenches"):
            return lambda q, v, *rest: method(q, v, *rest) - law.force(v)
        if quantity == "inverse_dynamics_derivatives":
            return lambda q, v, a: method(q, v, a) - _by_velocity(law.slope(v))
        return method

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
        """Return `decided` of a state or of each of a batch."""
        forward = quantity.startswith(_FORWARD)

        def one(i: Any, own: Any) -> tuple[Array, Mask]:
            same = own is dyn and forward
            accelerate = method if same else own._without_friction(quantity if forward else _FORWARD)
            more = tuple(x[i] if isinstance(x, np.ndarray) else x for x in rest) if forward else ()
            return self.decided(own, lambda tau: accelerate(q[i], v[i], tau, *more), q[i], tau[i], resting[i])

        if v.ndim == 1:
            return one(..., dyn)
        held, still = np.zeros_like(v), np.zeros(v.shape, dtype=bool)
        for i in np.flatnonzero(resting.any(axis=1)):
            held[i], still[i] = one(i, dyn._of_sample(int(i)))
        return held, still

    def decided(
        self,
        dyn: Any,
        accelerate: Callable[[Array], Array],
        q: Array,
        tau: Array,
        resting: Mask,
        leaving: Array | None = None,
    ) -> tuple[Array, Mask]:
        """Return the forces of friction at rest of one state, (nv,), and which joints stay at rest.

        `accelerate` gives accelerations under a force without friction at rest; `leaving` has the signs of the
        velocities that joints at rest are about to have, where that is known, (nv,).
        """
        law, which = self.law, np.flatnonzero(resting)
        A = self._responses(dyn, accelerate, q, tau, which)
        b = np.asarray(accelerate(tau), dtype=np.float64)[which]
        less = law.just_moving[which]
        known = np.zeros(len(which)) if leaving is None else -leaving[which] * less
        forces, holds = friction_forces(A, b, law.bound[which], less, known)
        held, still = np.zeros(len(tau[..., : len(resting)])), np.zeros(len(resting), dtype=bool)
        held[which], still[which] = forces, holds
        return held, still

    def _responses(self, dyn: Any, accelerate: Callable[[Array], Array], q: Array, tau: Array, which: Indices) -> Array:
        """Return the accelerations of joints per force on each of them, (k, k)."""
        n = len(self.law.bound)
        unit = np.eye(n)[which]
        if not self._constrained:
            return np.asarray(np.linalg.solve(np.asarray((dyn._bare or dyn).mass_matrix(q)), unit.T)[which])
        # Accelerations are linear in the force; a large one loses fewest digits of the difference.
        size = max(1.0, float(np.abs(tau).max()), float(self.law.bound.max()))
        out = np.array([accelerate(tau + _padded(size * e, tau)) - accelerate(tau) for e in unit])[:, which] / size
        return np.asarray(0.5 * (out + out.T))

    def phase(self, dyn: Any, sides: Array, still: Mask) -> Any:
        """Return the dynamics in which velocities have these signs, or stay at rest: smooth, and without friction."""
        sliding, bare = self.sliding, dyn._bare or dyn
        # Steps of a controller ask for the same few again and again.
        held: dict[Any, Any] = vars(bare).setdefault("_phases", {}) if dyn.model.time_parameter is None else {}
        key = np.where(still, 0.0, np.sign(sides)).tobytes(), still.tobytes()
        if key not in held:
            if len(held) >= _PHASES:
                held.clear()
            held[key] = bare._of_model(sliding.at(sides, still, dyn.model), sliding.form)
        return held[key]._under(*dyn._acting) if dyn._acting[0] else held[key]

    def sliding_together(self, dyn: Any, signs: Array, rows: Indices, which: Indices) -> Iterator[tuple[Indices, Any]]:
        """Yield the dynamics of rows of a batch that slide along their signs, (N, nv), and which rows they are."""
        none = np.zeros(signs.shape[1], dtype=bool)
        if hasattr(type(dyn), "of_samples") and dyn.takes_parameters and not dyn._acting[0]:
            own = self.phase(dyn.of_samples(rows), np.ones(len(none)), none)
            yield rows, own.at(**{name: signs[rows, i] for i, name in self.sliding.sides.items()})
            return
        for row in np.unique(signs[np.ix_(rows, which)], axis=0):
            same = rows[(signs[np.ix_(rows, which)] == row).all(axis=1)]
            yield same, self.phase(dyn.of_samples(same), signs[same[0]], none)

    @cached_property
    def sliding(self) -> Sliding:
        """The model whose joints slide one way or rest."""
        return Sliding(self._model)

    def _in_phase(
        self, quantity: str, dyn: Any, q: Array, v: Array, tau: Array, rest: tuple[Any, ...], resting: Mask
    ) -> Any:
        """Return a quantity of more digits than a double's, by the model whose joints slide or rest; (N, ...)."""
        moves = quantity.startswith(_FORWARD)
        forward = dyn._without_friction(quantity if moves else _FORWARD)

        def one(i: int) -> Any:
            # Frames and axes of wrenches are those of all states.
            states = [x[i : i + 1] for x in (q, v)]
            more = [x[i : i + 1] if isinstance(x, np.ndarray) else x for x in rest]

            def accelerate(force: Array) -> Array:
                return np.asarray(dyn._rounded(forward(*states, force[None], *(more if moves else ())))[0])

            held, still = self.decided(dyn, accelerate, q[i], tau[i], resting[i])
            phase = self.phase(dyn, np.where(resting[i], -np.sign(held), np.sign(v[i])), still)
            value = phase._without_friction(quantity)(*states, tau[i : i + 1], *more)
            return value * phase._arithmetic.array(1.0 - still) if moves else value

        return np.concatenate([one(i) for i in range(len(v))])


def _by_velocity(slope: Array) -> Array:
    """Return derivatives by q, v and a of which that by v is not zero, (..., 3, nv, nv)."""
    return np.stack([np.zeros_like(slope), slope, np.zeros_like(slope)], axis=-3)


def _padded(force: Array, tau: Array) -> Array:
    """Return a force with zeros for the wrenches that stand behind τ."""
    lacking = tau.shape[-1] - force.shape[-1]
    return np.concatenate([force, np.zeros((*force.shape[:-1], lacking))], axis=-1) if lacking else force
