"""Inverse dynamics under constraints: the forces of actuators that make a motion, with the multipliers.

::

    M a + h = τ + τ_passive + Jᵀ λ        J a + γ = 0

Of f = M a + h - τ_passive, every force B u of the actuators with Nᵀ B u = Nᵀ f makes the motion, where the columns of N
span the motions that the constraints leave free (Featherstone 2008, Rigid Body Dynamics Algorithms, ch. 8.12, with
independent actuators). That with the least norm is taken, and Jᵀ λ is what it leaves.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import CONSISTENT, Array
from mbkit._reproducible import DEPENDENT, dependent, unit_rows
from mbkit.engines.constrained import ASKED, Constrained, singular_pose
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Joint
from mbkit.model.elements.paths import ALL, Path

if TYPE_CHECKING:
    from mbkit.derivation.constraints import RowChoice

#: Every joint acts.
LEAST: Final = "least"
_OF_A_TREE: Final = "inverse_dynamics(q, v, a) is the force of the joints of a tree"
ACTUATOR_FORCES: Final = Path("actuator forces", "actuator_forces: not known of", ALL, asks=ASKED, instead=_OF_A_TREE)


class ActuatorForces(NamedTuple):
    """Forces that make a motion under constraints.

    Attributes
    ----------
    tau : (nv,) or (N, nv) array
        Generalized force, zero where nothing acts. Unique where the velocities of the actuators are as many as the
        degrees of freedom; else the one with the least norm, in N and N m.
    constraint_forces : (m,) or (N, m) array
        λ of the rows `constraint_names`. With τ also Jᵀ λ is unique; where rows are redundant, λ has the least norm.
    """

    tau: Array
    constraint_forces: Array


class Actuation(Constrained):
    """The part of `Dynamics` for forces of actuators under constraints."""

    def actuator_forces(
        self, q: ArrayLike, v: ArrayLike, a: ArrayLike, actuators: str | Sequence[str] = LEAST
    ) -> ActuatorForces:
        """Return the forces that make a motion under constraints, and the multipliers.

        The inverse of `forward_dynamics`: under this τ the acceleration is a. `inverse_dynamics` is the tree's, where
        every joint needs a force of its own.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
            Where the loops are closed, which is not looked at.
        v, a : (nv,) or (N, nv) array_like
            A consistent motion; `project` and `project_acceleration` return one.
        actuators : sequence of str or "least"
            Names of the joints that act; the others have τ = 0. More of them than degrees of freedom share the load
            with the least norm. ``"least"`` lets all joints act: the smallest τ that there is.

        Returns
        -------
        ActuatorForces
            With `tau` and `constraint_forces`. The multiplier of a motion in time is the force of its drive.

        Raises
        ------
        InputError
            Accelerations that break the constraints, or actuators that leave the mechanism free to move while they
            hold still; both with the residual.
        NumericalError
            A singular pose.
        UnsupportedError
            A model without loops and other constraints: there `inverse_dynamics` gives τ.

        Examples
        --------
        >>> import numpy as np
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.slider_crank(), "lagrangian")
        >>> q, v = dyn.project([0.5, -0.2, -0.1], [2.0, 0.0, 0.0])
        >>> a = dyn.forward_dynamics(q, v, [3.0, 0.0, 0.0])
        >>> tau, forces = dyn.actuator_forces(q, v, a, actuators=[dyn.model.joint_names[0]])
        >>> bool(np.allclose(tau, [3.0, 0.0, 0.0]))
        True
        """
        ACTUATOR_FORCES.admit(self.model)
        self._require_motion(q, v)
        out = self._evaluate("actuator_forces", self._actuated(actuators), q=q, v=v, a=a)
        n = self.model.nv
        return ActuatorForces(out[..., :n], out[..., n:])

    def _actuated(self, actuators: Any) -> tuple[Joint, ...]:
        """Return the joints that act."""
        model = self.model
        if isinstance(actuators, str):
            if actuators != LEAST:
                raise InputError(f"actuators: expected a list of joints or {LEAST!r}, got {actuators!r}")
            return model.independent_joints
        if not isinstance(actuators, Sequence) or not all(isinstance(x, str) for x in actuators):
            raise InputError(f"actuators: expected a list of joints or {LEAST!r}, got {actuators!r}")
        for name in actuators:
            if name not in model.joint_names:
                follows = next((j.mimic.joint for j in model.joints if j.name == name and j.mimic), None)
                if follows is not None:
                    raise InputError(f"actuators: joint {name!r} mimics {follows!r}; name that one")
                raise UnknownNameError("joint", name, model.joint_names)
        return tuple(joint for joint in model.independent_joints if joint.name in actuators)

    def _moved_by(self, joints: tuple[Joint, ...]) -> tuple[int, ...]:
        """Return the velocities of joints."""
        parts = (self.model.layout.v[joint.name] for joint in joints)
        return tuple(i for part in parts for i in range(part.start, part.stop))

    @cached_property
    def _row_choice(self) -> RowChoice:
        """Which rows say something, and which of those are independent."""
        # The import loads CasADi.
        from mbkit.derivation.constraints import choose_rows

        if self.model.has_bodies:
            return choose_rows(self.model)
        choice: RowChoice = self._states_held.manifold_of(self).equations.row_choice
        return choice

    def _actuator_forces(self, q: Array, v: Array, a: Array, actuators: tuple[Joint, ...]) -> Array:
        """Return τ and λ at one state, from the engine's own terms by LAPACK."""
        which = self._moved_by(actuators)
        J, gamma = self._constraint_jacobian(q), self._constraint_bias(q, v)
        # With the forces that functions give, where there are some.
        f = self._method("inverse_dynamics")(q, v, a)
        own = list(self._row_choice.independent)
        rows = J[own]
        sizes = np.linalg.norm(rows, axis=1)
        self._require_consistent(rows @ a + gamma[own], sizes, a)
        self._require_determined(rows, which)
        others = [i for i in range(self.model.nv) if i not in which]
        Q, R = np.linalg.qr((rows / sizes[:, None]).T)
        # As `mbkit.derivation.constraints.OrthogonalColumns.balanced`.
        mu = Q.T @ f
        mu += np.linalg.lstsq(Q[others], f[others] - Q[others] @ mu, rcond=None)[0]
        tau = f - Q @ mu
        tau[others] = 0.0
        return np.concatenate([tau, spread(rows, J, np.linalg.solve(R, mu) / sizes)])

    def _judged(self, out: Array, q: Array, a: Array, which: tuple[int, ...]) -> Array:
        """Return τ and λ of `mbkit.derivation`'s answer for states, or raise why they are not determined."""
        n, kept = self.model.nv, len(self._row_choice.kept)
        m = (out.shape[-1] - n - kept - 1) // 2
        numbers = np.asarray(out, dtype=np.float64).reshape(-1, out.shape[-1])
        rates, sizes, left = numbers[:, n + kept : n + kept + m], numbers[:, n + kept + m : -1], numbers[:, -1]
        states, accelerations = np.atleast_2d(q), np.atleast_2d(a)
        fast = np.maximum(1.0, np.abs(accelerations).max(axis=1, initial=0.0))[:, None]
        broken = ~(np.abs(rates) <= CONSISTENT * np.maximum(sizes, 1.0) * fast).all(axis=1)
        flat = ~(sizes.min(axis=1) > DEPENDENT * sizes.max(axis=1))
        for k in np.flatnonzero(~(left > DEPENDENT**2) | flat | broken).tolist():
            own = self._of_samples([k])
            J = own._evaluate("constraint_jacobian", q=states[k]).reshape(kept, n)
            self._require_determined(J[list(self._row_choice.independent)], which)
            self._require_consistent(rates[k], sizes[k], accelerations[k])
        return out[..., : n + kept]

    def _require_consistent(self, rates: Array, sizes: Array, a: Array) -> None:
        """Refuse accelerations that break the constraints."""
        most = CONSISTENT * np.maximum(sizes, 1.0) * max(1.0, float(np.abs(a).max(initial=0.0)))
        if not (np.abs(rates) <= most).all():
            rows = zip(self._row_choice.independent_names, rates, most, strict=True)
            left = ", ".join(f"{name} by {x:.3g}" for name, x, high in rows if not abs(x) <= high)
            raise InputError(
                f"a: the constraints of {self.model.name} ask for J a + γ = 0, which is missed: {left}; "
                "project_acceleration(q, v, a) returns the nearest consistent one"
            )

    def _require_determined(self, J: Array, which: tuple[int, ...]) -> None:
        """Refuse a singular pose, and actuators that hold still while the mechanism moves."""
        model, n = self.model, self.model.nv
        scaled = unit_rows(J)
        if dependent(scaled):
            raise singular_pose(self.engine, model.name, self._row_choice.independent_names, J)
        others = [i for i in range(n) if i not in which]
        if not others:
            return
        heights = np.linalg.norm(scaled, axis=0)
        # A coordinate that the constraints leave alone, up to rounding.
        heights = np.where(heights > DEPENDENT * heights.max(), heights, np.inf)[others]
        _, singular, right = np.linalg.svd(scaled[:, others] / heights, full_matrices=True)
        rank = int(np.count_nonzero(singular > DEPENDENT))
        if rank == len(others):
            return
        loose = np.abs(right[rank:]).max(axis=0) > DEPENDENT
        names = [model.velocity_names[i] for i, moves in zip(others, loose, strict=True) if moves]
        holding = ", ".join(model.velocity_names[i] for i in which) or "no actuator"
        raise InputError(
            f"actuators: {model.name} has {n - len(J)} degrees of freedom, and with {holding} held still "
            f"{len(others) - rank} of them are left, which move {', '.join(names)}; let more joints act"
        )


def spread(independent: Array, J: Array, multipliers: Array) -> Array:
    """Return the multipliers of all rows J with the least norm whose force is that of the independent ones."""
    if len(independent) == len(J):
        return multipliers
    # J = C J_independent, so that Jᵀ μ = J_independentᵀ λ for every μ with Cᵀ μ = λ.
    C = np.linalg.lstsq(independent.T, J.T, rcond=None)[0].T
    return np.asarray(np.linalg.lstsq(C.T, multipliers, rcond=None)[0])
