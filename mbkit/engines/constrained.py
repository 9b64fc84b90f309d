"""Quantities of constraints: f(q, t) = 0 and A(q) v = b, their Jacobian and the forces that hold them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import CONSISTENT, EPS, ROUNDING, Array, batch_of
from mbkit._imports import from_above
from mbkit._reproducible import dependent, unit_rows
from mbkit.engines.elements.stop_impacts import between_stops
from mbkit.engines.evaluation import Evaluation
from mbkit.errors import InputError, MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.model import Model
from mbkit.model.elements.paths import ALL, Path

#: Words of each error of such a pose: no shorter step helps there.
AT_SINGULAR_POSE: Final = "at a singular pose"
#: Of the largest singular value of J, the smallest one at a singular pose: there v̇ from the equation of motion loses as
#: many digits, eps/σ, as that of the pose itself is off, σ. So it is no `DEPENDENT`, where no digit is left.
AT_POSE: Final = float(np.sqrt(EPS))
#: Least entry, in the unit vector of the smallest singular value, of a row that depends on others.
TAKES_PART: Final = 0.1
ASKED: Final = frozenset({"row", "speed"}), "it has no loops and no other constraints (add_loop, or constraints=[...])"
ROWS: Final = Path("constraint rows", "", ALL, asks=ASKED)


def off_by(error: float, exact: str) -> str:
    """Return how far accelerations are from exact ones, as text; what double precision cannot tell is rounding."""
    return f"{100 * error:.2g} % off {exact}" if error > ROUNDING else f"{exact} to rounding"


def singular_pose(who: str, name: str, rows: Sequence[str], J: Array) -> NumericalError:
    """Return the error of a pose at which rows J depend on each other, with those that take part."""
    # The vector of the smallest singular value says which.
    U, sizes, _ = np.linalg.svd(unit_rows(J))
    part = ", ".join(row for row, x in zip(rows, U[:, -1], strict=True) if abs(x) > TAKES_PART)
    return NumericalError(
        f"{who}: {name} is {AT_SINGULAR_POSE}, where rows depend on each other ({part}; singular values from "
        f"{sizes[0]:.2g} down to {sizes[-1]:.2g}): accelerations and forces are not determined there; take a pose "
        "beside it"
    )


def softly_limited(engine: str, model: Model, limits: object) -> tuple[Model, tuple[str, ...]]:
    """Return a model as it is beside an engine's own limits, and the joints that have some; `limits` is its option."""
    if limits not in (None, "soft"):
        raise InputError(f"limits: expected 'soft' or None, got {limits!r}")
    joints = model.acts.get("joint.limit", ()) if limits else ()
    if not joints:
        return model, ()
    if model.layout.reduced:
        raise UnsupportedError(f"limits: {engine}'s do not act on {model.name}'s mimic joints; load with mimic='free'")
    return model.without("stops"), joints


@contextmanager
def unwatched(*all_dynamics: Any) -> Iterator[None]:
    """Let no acceleration warn of an open state, as stages of a run are open by the order of a method's error."""
    before = [dyn._state_unchecked for dyn in all_dynamics]
    try:
        for dyn in all_dynamics:
            dyn._state_unchecked = False
        yield
    finally:
        for dyn, unchecked in zip(all_dynamics, before, strict=True):
            dyn._state_unchecked = unchecked


class Constrained(Evaluation):
    """The part of `Dynamics` for models with loops, motions in time, blades, and wheels and spheres that roll.

    ::

        M v̇ + C v + g = τ + τ_passive + Jᵀ λ        J v̇ + γ = 0

    The first k of the m rows hold positions, f(q, t) = 0: `constraint_residual` has these alone. The others hold
    velocities alone, A(q) v = b, and no function of q is zero with them; `velocity_constraint_names` are theirs. J, the
    rate J v + c, γ and λ have all m rows, in the order of `constraint_names`: c is ∂f/∂t of the first and -b of the
    others.

    Rows of loops stand in the axes of the body that carries both ends; those of motions in time follow, then the
    heights of what rolls, then velocities. The multiplier of a point is the force on body a, that of a frame's turn the
    torque on it, and that of a motion in time the force of its drive. That of a height is the normal force on what
    rolls, and those of its velocities are the forces that hold it along these directions. A model without any raises
    `UnsupportedError`.

    Accelerations of `forward_dynamics` hold the constraints, and `actuator_forces` and `joint_wrenches` have the forces
    of the constraints among theirs; every other term, such as `inverse_dynamics`, is that of the tree, without λ.
    """

    #: Whether the engine lets constraints give way: its states are those of its own equations, and none is projected.
    _soft_constraints: bool = False
    #: Options with which the engine has a soft law of its own for forces that jump, and whether it has.
    _soft_jump_options: ClassVar[Mapping[str, Any]] = {}
    _soft_jumps: bool = False
    #: Whether joint limits are the engine's own, which are soft.
    _soft_limits: bool = False

    def _jumps_beside_passive(self, q: Array, v: Array, tau: Array) -> Array:  # noqa: ARG002  # of a soft law
        """Return the forces of soft laws in accelerations under τ, less those in `passive`; (N, nv)."""
        return np.zeros_like(v)

    @property
    def _projects(self) -> bool:
        """Whether runs project their states onto constraints."""
        return self.model.constrained and not self._soft_constraints

    @property
    def _states_held(self) -> Any:
        # The consistent states are those of the own derivation, an engine above this protocol.
        return from_above("constraint_manifold")

    @property
    def constraint_names(self) -> tuple[str, ...]:
        """Names of the rows, such as ``"loop 'pin' x"``; empty without constraints."""
        return self._states_held.names_of(self) if self.model.constrained else ()

    @property
    def velocity_constraint_names(self) -> tuple[str, ...]:
        """Names of the rows that hold velocities alone, the last ones of `constraint_names`."""
        return self._states_held.names_of(self, moving=True) if self.model.holds_velocities else ()

    def _warn_of_open_states(self, q: ArrayLike) -> None:
        """Warn where configurations do not satisfy the constraints, whose accelerations are those of no motion."""
        residual = np.abs(self.constraint_residual(q))
        worst = np.unravel_index(int(np.argmax(residual)), residual.shape) if residual.size else ()
        if worst and residual[worst] > CONSISTENT * max(1.0, float(np.abs(q).max())):
            name = self.constraint_names[worst[-1]]
            if self._row_choice.closed is None:
                self._states_held.refuse_unreachable(self._states_held.manifold_of(self).dyn)
            warn(
                f"{self.model.name}: constraint {name} is open by {residual[worst]:.2g}: these accelerations "
                "are those of no motion; project(q, v) returns the nearest consistent state",
                MbkitWarning,
            )

    def _refuse_contradictory_rates(self, q: ArrayLike, v: ArrayLike) -> None:
        """Refuse velocities at which rows ask for other rates than the rows that imply them do (InputError)."""
        own, lost = list(self._row_choice.independent), list(self._row_choice.redundant)
        q, v = (np.atleast_2d(x) for x in (q, v))
        J, rates = self.constraint_jacobian(q), self.constraint_rate(q, v)
        weights = J[:, lost] @ np.linalg.pinv(J[:, own])
        # On another branch a row does not follow from the others, and accelerations tell.
        follows = (
            np.abs(weights @ J[:, own] - J[:, lost]).max(axis=-1) <= CONSISTENT * np.abs(J).max(axis=(1, 2))[:, None]
        )
        left = np.abs(rates[:, lost] - (weights @ rates[:, own, None])[..., 0])
        broken = follows & (left > CONSISTENT * np.maximum(1.0, np.abs(v).max(axis=-1, keepdims=True)))
        for k in np.flatnonzero(broken.any(axis=-1))[:1].tolist():
            still = self._states_held.manifold_of(self).member(k).still_open(q[k % len(q)], v[k % len(v)])
            raise InputError(f"v: {self.model.name}: no velocity satisfies all constraints: open stay {still}")

    def _warn_if_inconsistent(self, q: ArrayLike, v: ArrayLike | None = None) -> None:
        if self._state_unchecked:
            self._warn_of_open_states(q)
            if v is not None and self._row_choice.redundant and np.isfinite(q).all() and np.isfinite(v).all():
                self._refuse_contradictory_rates(q, v)
            self._state_unchecked = False

    def _require_motion(self, q: ArrayLike, v: ArrayLike | None = None, tau: ArrayLike | None = None) -> None:
        """Refuse a pose on another branch by its accelerations, under unit forces without τ (NumericalError)."""
        self._warn_if_inconsistent(q, v)
        if self._soft_constraints or not self._row_choice.redundant:
            return
        still = np.zeros(self.model.nv)
        with unwatched(self):
            self.forward_dynamics(q, still if v is None else v, still + 1.0 if tau is None else tau)

    def _require_regular(self, q: ArrayLike, v: ArrayLike) -> None:
        """Refuse a state at which rows depend on each other, or contradict those that imply them (NumericalError)."""
        choice, names, own = self._row_choice, self.constraint_names, list(self._row_choice.independent)
        try:
            rows = np.column_stack([self.constraint_jacobian(q), self.constraint_bias(q, v)])
        except NumericalError:
            # Numbers that overflow say nothing of the pose.
            return
        if dependent(unit_rows(rows[own, :-1])):
            raise singular_pose(self.engine, self.model.name, choice.independent_names, rows[own, :-1])
        lost = list(choice.redundant)
        rows[:, -1] /= max(1.0, float(np.abs(rows[:, -1]).max(initial=0.0)))
        rows = unit_rows(rows)
        left = rows[lost] - np.linalg.lstsq(rows[own].T, rows[lost].T, rcond=None)[0].T @ rows[own]
        if (sizes := np.linalg.norm(left, axis=1)).max(initial=0.0) > CONSISTENT:
            k = lost[int(sizes.argmax())]
            others = ", ".join(names[i] for i in self._states_held.needed(rows[:, :-1], np.array(own), [k]))
            raise NumericalError(
                f"q: {self.model.name}: {names[k]}, which follows from the other rows where the mechanism moves, "
                f"contradicts the accelerations that {others} allow, by {sizes.max():.2g} of the row: the pose is "
                f"singular or on another branch; mobility(q) has its rank; the mechanism moves at q = {choice.closed}"
            )

    def constraint_residual(self, q: ArrayLike) -> Array:
        """Return f(q, t), zero where all loops are closed and all that rolls touches its plane.

        (k,) or (N, k), in m and rad: the first k of the m rows of `constraint_names`. Rows that hold velocities alone
        have no such function; their residual is that of `constraint_rate`.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> bool(abs(dyn.constraint_residual(q)).max() < 1e-14)
        True
        """
        return self._evaluate("constraint_residual", q=q)

    def constraint_jacobian(self, q: ArrayLike) -> Array:
        """Return J of all rows, with the rates J v + c; (m, nv) or (N, m, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> J = dyn.constraint_jacobian(q)
        >>> J.shape, bool(abs(J @ v).max() < 1e-14)
        ((2, 3), True)
        """
        return self._evaluate("constraint_jacobian", q=q)

    def constraint_rate(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the rates J v + c of all rows, zero in a consistent state: ḟ, then A v - b; (m,) or (N, m).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> bool(abs(dyn.constraint_rate(q, v)).max() < 1e-14)
        True
        """
        return self._evaluate("constraint_rate", q=q, v=v)

    def constraint_rate_gradient(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the derivative of the rates J v + c by q, (m, nv) or (N, m, nv), on the own derivation and the oracle.

        Column k is that of q ⊕ t e_k, with the components of v held.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.model.random_state(0)
        >>> dyn.constraint_rate_gradient(q, v).shape
        (2, 3)
        """
        return self._evaluate("constraint_rate_gradient", q=q, v=v)

    def consistent_changes(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the small changes of a consistent state that keep it consistent, as columns of N, (2 nv, k).

        A change is x = (δq, δv), as in `Linearization`: ẋ = A x of ``linearize(q, v, tau)`` holds on these, so that
        ``N.T @ A @ N`` is the linear motion in k coordinates. Columns are orthonormal, and k is the sum of
        `configuration_freedoms` and `degrees_of_freedom` of ``mobility(q)``.

        Parameters
        ----------
        q : (nq,) array_like
        v : (nv,) array_like

        Raises
        ------
        UnsupportedError
            An engine without derivatives of constraints: the own derivation and the oracle have them.

        Examples
        --------
        >>> import mbkit as mb
        >>> import numpy as np
        >>> dyn = mb.dynamics(mb.catalog.rolling_disc(), "lagrangian")
        >>> q, v = dyn.project(np.zeros(6), [2.0, 0, 0, 0, 0, 4.0])
        >>> N = dyn.consistent_changes(q, v)
        >>> swings = np.linalg.eigvals(N.T @ dyn.linearize(q, v, np.zeros(6)).A @ N).imag.max()
        >>> bool(abs(swings - ((4.0**2 * 0.375 * 0.125 / 0.0625 - 4.905) / 0.3125) ** 0.5) < 1e-7)
        True
        """
        model = self.model
        q, v = model.check_q(q), model.check_v(v)
        if q.ndim > 1 or v.ndim > 1:
            raise InputError(f"consistent_changes: expected one state, got shapes {q.shape} and {v.shape}")
        if not model.constrained:
            return np.eye(2 * model.nv)
        J, by_q = self.constraint_jacobian(q), self.constraint_rate_gradient(q, v)
        held = len(self.constraint_names) - len(self.velocity_constraint_names)
        rows = np.block([[J[:held], np.zeros((held, model.nv))], [by_q, J]])
        sizes = np.linalg.norm(rows, axis=1, keepdims=True)
        free = self.mobility(q)
        left = free.configuration_freedoms + free.degrees_of_freedom
        return np.asarray(np.linalg.svd(rows / np.where(sizes > 0, sizes, 1.0))[2][2 * model.nv - left :].T)

    def constraint_bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return γ of all rows, with the rates' derivative J v̇ + γ = 0; (m,) or (N, m).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> a = dyn.forward_dynamics(q, v, [0.0] * 3)
        >>> bool(abs(dyn.constraint_jacobian(q) @ a + dyn.constraint_bias(q, v)).max() < 1e-12)
        True
        """
        return self._evaluate("constraint_bias", q=q, v=v)

    def constraint_forces(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Return the multipliers λ of all rows under the force τ, (m,) or (N, m).

        Where rows are redundant, λ is not unique: it is the one with the least norm, in N and N m. Jᵀ λ, which
        `generalized_constraint_force` returns, is unique all the same. Joints that are held at rest beside
        rows that let them move together alone share what they hold: neither is unique then, while the motion is.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> dyn.constraint_forces(q, v, [0.0] * 3).shape, len(dyn.constraint_names)
        ((2,), 2)
        """
        return self._reactions("constraint_forces", q, v, tau)

    def generalized_constraint_force(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Return Jᵀ λ, the generalized force that keeps the constraints under τ; (nv,) or (N, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.project([0.5, 0.0, 1.0], [1.0, 0.0, 0.0])
        >>> dyn.generalized_constraint_force(q, v, [0.0] * 3).shape
        (3,)
        """
        return self._reactions("generalized_constraint_force", q, v, tau)

    def _reactions(self, quantity: str, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        self._warn_if_inconsistent(q, v)
        out = self._evaluate(quantity, q=q, v=v, tau=tau)
        if "jump" in self.model.effects and self._projects:
            self._jumps.warn_of_shares(self, quantity, *(np.asarray(x) for x in (q, v, tau)))
        return out

    def _generalized_constraint_force(self, q: Array, v: Array, tau: Array) -> Any:
        # What holds joints at rest is in τ already.
        J, forces = self.constraint_jacobian(q), self._without_jumps("constraint_forces")(q, v, tau)
        return (np.swapaxes(J, -1, -2) @ forces[..., None])[..., 0]

    def project(self, q: ArrayLike, v: ArrayLike, hold: Sequence[str] = ()) -> tuple[Array, Array]:
        """Return the nearest consistent state, in the metric of the mass matrix.

        The configuration goes onto f = 0, which rows that hold velocities alone have no part in; then the velocity goes
        to where the rates of all rows are zero. Coordinates beyond joint stops go onto these, where impacts without
        restitution take velocities that lead outwards.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v : (nv,) or (N, nv) array_like
        hold : sequence of str, optional
            Names of coordinates or joints that keep their numbers in q and v, to the bit; the others follow.

        Returns
        -------
        q, v : arrays
            Of the same shapes. Without constraints they are the arguments.

        Raises
        ------
        InputError
            The constraints contradict each other or the held numbers, no consistent state is near, or the held numbers
            do not determine the rest at the pose, as at a dead centre.
        UnknownNameError
            Nothing of a name that is held.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.slider_crank(), "lagrangian")
        >>> q, v = dyn.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0])
        >>> bool(abs(dyn.constraint_residual(q)).max() < 1e-14)
        True
        >>> q, v = dyn.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0], hold=[dyn.model.coordinate_names[0]])
        >>> float(q[0]), float(v[0])
        (0.5, 1.0)
        """
        model = self.model
        q, v = model.check_q(q), model.check_v(v)
        batch_of(q=q, v=v)
        states = self._states_held
        stops = model.needs.stops
        if not model.constrained:
            states.held_parts(model, hold)
            return between_stops(self._jumps, self, q, v) if stops else (q, v)
        lead = np.broadcast_shapes(q.shape[:-1], v.shape[:-1])
        q, v = (np.broadcast_to(x, (*lead, x.shape[-1])) for x in (q, v))

        def one(q: Array, v: Array) -> tuple[Array, Array]:
            if stops:
                return between_stops(self._jumps, self, q, v, partial(states.projected, self), hold)
            return states.projected(self, q, v, hold)  # type: ignore[no-any-return]  # by name

        if not lead:
            return one(q, v)
        pairs = [one(*pair) for pair in zip(q, v, strict=True)]
        return np.array([x for x, _ in pairs]).reshape(q.shape), np.array([x for _, x in pairs]).reshape(v.shape)

    def project_acceleration(self, q: ArrayLike, v: ArrayLike, a: ArrayLike, hold: Sequence[str] = ()) -> Array:
        """Return the nearest acceleration that the constraints allow, J a + γ = 0, in the metric of the mass matrix.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, a : (nv,) or (N, nv) array_like
            A consistent state, and any acceleration.
        hold : sequence of str, optional
            Names of coordinates or joints that keep their numbers in a, to the bit; the others follow.

        Returns
        -------
        (nv,) or (N, nv) array

        Raises
        ------
        InputError
            The held numbers break the constraints.

        Examples
        --------
        The crank turns at a constant speed:

        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.slider_crank(), "lagrangian")
        >>> crank = dyn.model.joint_names[:1]
        >>> q, v = dyn.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0], hold=crank)
        >>> a = dyn.project_acceleration(q, v, [0.0, 0.0, 0.0], hold=crank)
        >>> float(a[0]), bool(abs(dyn.constraint_jacobian(q) @ a + dyn.constraint_bias(q, v)).max() < 1e-14)
        (0.0, True)
        """
        model, states = self.model, self._states_held
        q, v, a = model.check_q(q), model.check_v(v), model.check_v(a, "a")
        batch_of(q=q, v=v, a=a)
        if not model.constrained:
            states.held_parts(model, hold)
            return a
        self._require_motion(q, v)
        lead = np.broadcast_shapes(q.shape[:-1], v.shape[:-1], a.shape[:-1])
        q, v, a = (np.broadcast_to(x, (*lead, x.shape[-1])) for x in (q, v, a))
        if not lead:
            return states.accelerated(self, q, v, a, hold)  # type: ignore[no-any-return]  # by name
        return np.array([states.accelerated(self, *one, hold) for one in zip(q, v, a, strict=True)]).reshape(a.shape)

    def mobility(self, q: ArrayLike | None = None) -> Any:
        """Return the degrees of freedom and the redundant rows, at a configuration or where the loops are closed.

        Parameters
        ----------
        q : (nq,) array_like, optional
            Where the loops are closed; an open one is refused (`InputError`). By default some closed configuration at
            which most rows are independent.

        Returns
        -------
        Mobility
            With `degrees_of_freedom` of velocity, `configuration_freedoms`, `rows`, and the names of `redundant` ones.

        Examples
        --------
        >>> import mbkit as mb
        >>> print(mb.dynamics(mb.catalog.slider_crank(), "lagrangian").mobility())
        slider_crank: degrees of freedom 1, of 2 rows none is redundant
        """
        return self._states_held.mobility(self, None if q is None else self.model.check_q(q))
