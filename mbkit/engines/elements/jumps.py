"""Dry friction and stops beside an engine's own terms: at speed a force, at rest a problem of complementarity.

A joint at rest holds by any force up to s, or it begins to move against f <= s. Of s alone, accelerations minimize
Gauss's function with the friction of what does not move (Moreau 1966, Comptes Rendus 262; Anitescu and Potra 1997,
Nonlinear Dynamics 14)::

    v̇ = argmin over a of ½ (a - a0)ᵀ M (a - a0) + Σ s_j |a_j| over the joints at rest,  M a0 = τ + τ_passive - nle

with one minimum. Its dual has a box alone: the forces λ_j of friction, |λ_j| <= s_j, with a = a0 + M⁻¹ λ. Where joints
are bound by loops, M⁻¹ is the response of the accelerations to forces, and a is unique all the same. Where s is above
f, a joint that would move has its bound lowered to f on that side, and the problem is solved again. A joint at rest
on a stop has a >= 0 inwards, and so no bound on the forces that push it there (Moreau 1988; `mbkit.model.stops`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mbkit._check import DOUBLE_BITS, Array
from mbkit._reproducible import unit_rows
from mbkit.engines.elements.passive import LOADS, UNDER_FORCE, AddedForce
from mbkit.errors import MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.methods.exchanges import ARRAYS, PATIENCE, PROXIMAL_SHIFT, Problem, Signs, exchange, noise, restricted
from mbkit.model import Model
from mbkit.model.changes.jumps import JumpLaw, Sliding, jump_bindings
from mbkit.model.elements.kinds import EFFECTS
from mbkit.model.parts import POSE_ROUNDING

#: Mask of the velocities at rest.
Mask = NDArray[np.bool_]
#: Phases that dynamics keep.
_MAX_KEPT_PHASES: Final = 256
_FORWARD: Final = "forward_dynamics"
#: Rounds of exchanges, at most; a nearly singular A takes more than two proximal points.
_MAX_ROUNDS: Final = 20_000
#: Joints with friction whose rounds are machine code: 2 s are spent on 18 of them, and 9 s on 24.
_MAX_COMPILED: Final = 18
_UNDECIDED: Final = (
    "which of {n} joints at rest begin to move cannot be decided: singular inertia, or rows and stops that contradict"
)


def forces_at_rest(A: Array, b: Array, bound: Array) -> Array:
    """Return the λ with |λ| <= bound that minimizes ½ λᵀ A λ + bᵀ λ of one problem whose A may be singular, (n,)."""
    every, most = np.ones((1, len(b)), dtype=bool), bound[None]
    return np.asarray(jump_forces(A[None], b[None], most, most, every, 0.0 * most, definite=False)[0][0])


def jump_forces(
    A: Array,
    b: Array,
    bound: Array,
    less: Array,
    on: Mask,
    known: Array,
    *,
    definite: bool = True,
    stop: Array | None = None,
    rounds: Callable[[Problem, Signs], tuple[Signs, Any, Any, Any]] | None = None,
) -> tuple[Array, Mask]:
    """Return the forces of friction and stops at rest, and which of them hold; those `known` do not; (N, n).

    A, (N, n, n), is positive definite or semidefinite. `stop` has 1 and -1 for joints at their lower and upper stops.
    The way is that of `mbkit.methods.exchanges`; `rounds` makes some of its rounds at once.
    """
    size, n = b.shape
    shift, own = None, A
    if not definite:
        diagonal = np.abs(np.einsum("nii->ni", A))
        # To each its own: a joint that hardly responds takes as few points as the others.
        shift = PROXIMAL_SHIFT * np.where(diagonal > 0, diagonal, 1.0)
        own = A + shift[..., None] * np.eye(n)
    least = noise(A, b, bound, stop)
    problem = Problem(A, own, b, bound, less, on, known, least, shift)
    if stop is not None:
        problem = problem._replace(stop=stop, slack=least / np.abs(np.einsum("nii->ni", A)))
    low, high = np.where(known < 0, known, -bound), np.where(known > 0, known, bound)
    none, one = np.zeros(b.shape), np.ones((size, 1))
    signs = Signs(low, high, on & (known != 0), none, (n + 1.0) * one, PATIENCE * one, none)
    forces, holds, rows = np.zeros(b.shape), np.zeros(b.shape, dtype=bool), np.arange(size)
    for _ in range(_MAX_ROUNDS):
        if not len(rows):
            return forces, holds
        signs, forces[rows], holds[rows], going = (rounds or _round)(problem, signs)
        left = going[:, 0] != 0
        if not left.all():
            rows = rows[left]
            problem = Problem._make(None if x is None else x[left] for x in problem)
            signs = Signs._make(x[left] for x in signs)
    raise NumericalError(_UNDECIDED.format(n=n))


def _round(problem: Problem, signs: Signs) -> tuple[Signs, Any, Any, Any]:
    return exchange(ARRAYS, problem, signs, problem.b.shape[1])


class Jumps(AddedForce):
    """Dry friction of a model, for the quantities of an engine."""

    def __init__(self, model: Model) -> None:
        self._model, self.law, self._varies = model, JumpLaw(model), bool(jump_bindings(model))
        self._constrained = model.constrained
        self._words = " or ".join(
            EFFECTS[x] for x, there in (("jump", model.needs.friction), ("stop", model.needs.stops)) if there
        )
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
        """Return an engine's method for a quantity with friction and stops; one with elements holds it at speed."""
        law, moving = self.law_of(dyn), method if dyn._has_force_elements else super().beside(quantity, method, dyn)
        if quantity in UNDER_FORCE:

            def pushed(q: Array, v: Array, tau: Array, *rest: Any) -> Any:
                resting = law.at_rest(q, v)
                if not resting.any():
                    return moving(q, v, tau, *rest)
                if dyn._significand_bits > DOUBLE_BITS:
                    return self._in_phase(quantity, dyn, q, v, tau, rest, resting)
                held, still = self._each(dyn, quantity, moving, q, v, tau, rest, resting)
                out = moving(q, v, tau + padded(held, tau), *rest)
                # A joint that friction or a stop holds does not move, not even by a rounding.
                return np.where(still, 0.0, out) if quantity.startswith(_FORWARD) else out

            return pushed
        if quantity == "forward_dynamics_derivatives":

            def of_forward(q: Array, v: Array, tau: Array) -> Any:
                if law.at_rest(q, v).any():
                    warn(
                        f"{self._model.name}: no derivative at rest under {self._words}, so left out of these; take "
                        "model.smooth to do so knowingly, or velocities that are not zero",
                        MbkitWarning,
                    )
                return moving(q, v, tau)

            return of_forward
        if quantity in LOADS:

            def loaded(q: Array, v: Array, *rest: Any) -> Any:
                if law.at_rest(q, v).any():
                    raise UnsupportedError(
                        f"loads of joints and loops: {self._model.name} has joints with {self._words} at rest, whose "
                        "share of the loads is not known; give velocities, or take model.smooth"
                    )
                return moving(q, v, *rest)

            return loaded
        return moving

    def warn_of_shares(self, dyn: Any, quantity: str, q: Array, v: Array, tau: Array) -> None:
        """Warn where joints rest together in fewer ways than there are joints: what holds them is not unique."""
        if not (resting := self.law_of(dyn).at_rest(q, v)).any():
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
        definite, forces, holds = not self._constrained, np.zeros(on.shape), np.zeros(on.shape, dtype=bool)
        w, stop = self.law.which, None
        if law.stops:
            stop = (law.stops.against(q) * resting).reshape(on.shape)[:, w]
        rounds = self._rounds(dyn) if definite and len(b) > 1 else None
        given: Any = A[:, w[:, None], w], *(x[:, w] for x in (b, bound, less, on, known))
        forces[:, w], holds[:, w] = jump_forces(*given, definite=definite, stop=stop, rounds=rounds)
        # A has the rounding of M; what the engine's own accelerations still leave corrects that.
        left = accelerate(tau + padded(forces.reshape(shape), tau))
        left = np.asarray(left, dtype=np.float64).reshape(on.shape)
        forces = forces - restricted(A, left, holds, definite=definite)
        return forces.reshape(shape), holds.reshape(shape)

    def _rounds(self, dyn: Any) -> Callable[[Problem, Signs], tuple[Signs, Any, Any, Any]] | None:
        """Return machine code of some rounds of exchanges, None where there is none."""
        size = len(self.law.which)
        if size > _MAX_COMPILED or not (dyn._derived and getattr(dyn, "_compiles_steps", False)):
            return None
        from mbkit.derivation.steps.exchanges import exchange_rounds

        stops = bool(self.law.stops)
        name = f"exchange_rounds{'_with_stops' * stops}"
        code = dyn._code(name, make=lambda: exchange_rounds(size, stops=stops))

        def run(p: Problem, s: Signs) -> tuple[Signs, Any, Any, Any]:
            given = *p[2:8], *(p[9:] if stops else ()), *s[:6]
            out = code(p.A.reshape(len(p.A), -1), *given, threads=dyn.threads)
            *signs, forces, holds, going = (x[..., 0] for x in out)
            return Signs._make([*signs, s.before]), forces, holds, going

        return run

    def directions(self, dyn: Any, q: Array) -> Array:
        """Return a basis of the velocities that constraints allow at configurations, (nv, k) or (N, nv, k)."""
        J = dyn.constraint_jacobian(q)[..., list(dyn._row_choice.independent), :]
        return np.asarray(np.linalg.svd(unit_rows(J))[2][..., J.shape[-2] :, :].mT)

    def responses(self, dyn: Any, q: Array) -> Array:
        """Return the accelerations of joints per force on each of them, (nv, nv) or (N, nv, nv)."""
        M = np.asarray((dyn._bare or dyn).mass_matrix(q))
        try:
            if not self._constrained:
                return np.linalg.inv(M)
            # Differences of accelerations have the rounding of the largest, by which a joint at its dead centre loses
            # all.
            N = self.directions(dyn, q)
            out = np.asarray(N @ np.linalg.solve(N.mT @ M @ N, N.mT))
        except np.linalg.LinAlgError:
            raise NumericalError(_UNDECIDED.format(n=M.shape[-1])) from None
        # A joint that loops hold responds by rounding alone, of either sign; the least response keeps A definite.
        masses, own = (np.einsum("...ii->...i", x) for x in (M, out))
        own[...] = np.maximum(own, PROXIMAL_SHIFT / np.where(masses > 0, masses, np.inf))
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
        locks = sliding.lock(sides, still)
        values |= {name: locks[:, i] for i, name in sliding.locks.items()}
        own = own._with(own.model, {**own._batched, **values})
        own._state_unchecked = False
        return own._under(*dyn._acting) if dyn._acting[0] else own

    @cached_property
    def sliding(self) -> Sliding:
        """The model whose joints slide one way or rest."""
        return Sliding(self._model)

    def stop_forces(self, dyn: Any, q: Array, v: Array, tau: Array) -> Array:
        """Return the forces of stops on what rests there, zero elsewhere; (nv,) or (N, nv).

        Where friction could hold a part, it holds none of it.
        """
        law, moving = self.law_of(dyn), dyn._without_jumps(_FORWARD)
        moving = moving if dyn._has_force_elements else super().beside(_FORWARD, moving, dyn)
        resting = law.at_rest(q, v)
        if not (law.stops and resting.any()):
            return np.zeros(v.shape)
        side = law.stops.against(q) * resting
        held, _ = self._each(dyn, _FORWARD, moving, q, v, tau, (), resting)
        return np.asarray(side * np.maximum(side * held, 0.0))

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
