"""Loops, motions in time and contacts without slip by Pinocchio. A part of `PinocchioDynamics`.

`pinocchio.constraintDynamics` gives the accelerations where it can: every loop is a "point" or a "frame", nothing is
moved in time, nothing rolls, as its constraints hold positions, no coupler holds joints, no joint mimics another, no
coupling has a rotor, and no row is redundant but those of a plane that does not move. It factors J M⁻¹ Jᵀ + μ and
iterates (Carpentier, Budhiraja and Mansard 2021, Proximal and sparse resolution of constrained dynamic equations).
Elsewhere the equation

    M v̇ - Jᵀ λ = τ + τ_passive - h        J v̇ = -γ

is solved by LAPACK, with M of `crba`, h of `rnea`, and rows from Pinocchio's placements, Jacobians and accelerations of
frames. `PinConstraints.solver` tells which. An answer of constraintDynamics is looked at: its numbers are finite, the
ends' accelerations agree, and no pivot says that rows depend on each other. LAPACK takes over where one of this fails,
and says so where nothing is determined. Without regularization constraintDynamics returns NaN for a loop in a plane,
whose third row is redundant.

Both solve the same equation where loops are closed. Beside such states, as at a stage of a Runge-Kutta step,
constraintDynamics holds the ends' accelerations in the axes of end a, and the rows here those of the body that carries
both: v̇ differs by the gap times squared speeds.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from functools import cached_property
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import ITERATED, Array
from mbkit._reproducible import under_rows
from mbkit.engines.closed_loops.actuation import spread
from mbkit.engines.closed_loops.rows_of_frames import RowsOfFrames
from mbkit.engines.constrained import ROWS, singular_pose
from mbkit.engines.pinocchio.model import PinModel
from mbkit.errors import NumericalError
from mbkit.model import Model
from mbkit.model.elements.motion_laws import motions_of
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop, NoSlip

if TYPE_CHECKING:
    from mbkit.derivation.constraints import RowChoice
    from mbkit.engines.closed_loops.frame_rows import Laws, MovingFrame, Rows

#: Kinds of loops that Pinocchio's rigid constraints have.
_RIGID: Final = {"point": pin.ContactType.CONTACT_3D, "frame": pin.ContactType.CONTACT_6D}
#: μ in terms of the largest pivot of J M⁻¹ Jᵀ. An iteration leaves μ / σ of the error along a singular value σ, and
#: rounding of a redundant row, eps / μ, must stay small.
_PROXIMAL_RATIO: Final = 1e-10
_MAX_PROXIMAL_ITERATIONS: Final = 20
_PROXIMAL_ACCURACY: Final = 1e-14
#: Pivot of a row that may depend on the others, in terms of μ, which leaves about as much of it: LAPACK decides then.
_DEPENDENT_PIVOT_RATIO: Final = 1e3
_ALIGNED: Final = pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
_LOCAL: Final = pin.ReferenceFrame.LOCAL
_ONE: Final = np.eye(3)


def _frame(m: Any, d: Any, G: Array | None, joint: int, X_JF: Any) -> MovingFrame:
    """Return how a frame on a joint moves."""
    # The import loads CasADi, which trees never need here.
    from mbkit.engines.closed_loops.frame_rows import MovingFrame

    X = d.oMi[joint] * X_JF
    # Pinocchio would read beyond an array for the world's joint in a model without others.
    J = np.zeros((6, m.nv))
    if joint:
        J = pin.getFrameJacobian(m, d, joint, X_JF, _ALIGNED).reshape(6, m.nv)
    J = J if G is None else J @ G
    moves = (pin.getFrameVelocity, pin.getFrameClassicalAcceleration)
    return MovingFrame(X.rotation, X.translation, J, *(own(m, d, joint, X_JF, _ALIGNED).vector for own in moves))


class PinConstraints:
    """The rows of a model's constraints, and its motion under them, in Pinocchio's numbers.

    Configurations and velocities are Pinocchio's; J and forces are on the description's velocities.
    """

    def __init__(self, model: Model, maps: PinModel, G: Array | None, rotors: bool) -> None:
        self._model, self._m, self._d = model, maps.model, maps.model.createData()
        self._G, self._rotors, self._time = G, rotors, model.time
        self._still = np.zeros(self._m.nv)

        def placed(body: str, p: Array, R: Array = _ONE) -> tuple[int, Any]:
            """Return the joint of a place on a body, and its placement there."""
            joint, R_JB, p_JB = maps.bodies[body]
            return joint, pin.SE3(R_JB @ R, p_JB + R_JB @ p)

        #: Both ends of each loop, and the body that carries both.
        self._ends = [
            (
                placed(x.body_a, x.translation_a, x.rotation_a),
                placed(x.body_b, x.translation_b, x.rotation_b),
                placed(model.carrier(x), np.zeros(3)),
            )
            for x in model.loops
        ]
        #: Both bodies' points of each contact without slip.
        self._touching = [
            (x, placed(x.body_a, x.translation_a), placed(x.body_b, x.translation_b))
            for x in model.constraints
            if isinstance(x, NoSlip)
        ]

    def at(self, time: float) -> PinConstraints:
        """Return the same at another time."""
        # A run asks so at every stage: what does not depend on the time is found once.
        _ = self.choice, self._laws
        out = copy(self)
        out._time = time
        return out

    # Rows

    @cached_property
    def choice(self) -> RowChoice:
        """Which rows say something, and which of those are independent."""
        # The import loads CasADi, which trees never need here.
        from mbkit.derivation.constraints import choose_rows

        return choose_rows(self._model)

    def every(self, q: Array, v: Array) -> Rows:
        """Return all rows of loops, those that say nothing among them."""
        from mbkit.engines.closed_loops.frame_rows import Rows, loop_rows

        self._move(q, v)
        parts = [
            loop_rows(loop, *(_frame(self._m, self._d, self._G, *end) for end in ends))
            for loop, ends in zip(self._model.loops, self._ends, strict=True)
        ]
        return Rows.stacked(parts) if parts else Rows(*(np.zeros((0, *x)) for x in ((), (self._model.nv,), (), ())))

    def _move(self, q: Array, v: Array) -> None:
        pin.forwardKinematics(self._m, self._d, q, v, self._still)
        pin.computeJointJacobians(self._m, self._d)

    def _contacts(self) -> tuple[list[Rows], list[Rows]]:
        """Return the rows of contacts that hold positions, and those that hold velocities, after `every`."""
        from mbkit.engines.closed_loops.frame_rows import contact_rows

        m, d, held, moving = self._m, self._d, [], []
        with np.errstate(divide="ignore", invalid="ignore"):
            for part, *ends in self._touching:
                own = contact_rows(part, *(_frame(m, d, self._G, *end) for end in ends))
                held.append(own[0])
                moving.append(own[1])
        return held, moving

    def all_rows(self, q: Array, v: Array, given: tuple[Array, Array]) -> Rows:
        """Return the rows of all constraints; `given` are q and v of the description."""
        from mbkit.engines.closed_loops.frame_rows import Rows, coordinate_rows

        loops = self.every(q, v)
        held, moving = self._contacts()
        others = coordinate_rows(self._model, *given, self._laws, self._time)
        return Rows.stacked([loops, *others, *held, *moving])

    @cached_property
    def _laws(self) -> Laws:
        from mbkit.derivation.forces import law_rates

        return {x.name: law_rates(x) for x in motions_of(self._model)}

    # Motion

    @cached_property
    def solver(self) -> str:
        """What gives the accelerations: "constraintDynamics", or "LAPACK" from Pinocchio's terms."""
        model = self._model
        rigid = all(isinstance(x, Loop) and x.kind in _RIGID for x in model.constraints)
        if not rigid or model.layout.reduced or self._rotors:
            return "LAPACK"
        kept, independent = self.choice.kept, self.choice.independent
        first = 0
        for loop, (*_, (carrier, _)) in zip(model.loops, self._ends, strict=True):
            last = first + LOOP_KINDS[loop.kind]
            # On a plane that is carried along, rows are redundant where the loop is closed, and not beside.
            if carrier and any(i not in kept for i in range(first, last)):
                return "LAPACK"
            first = last
        return "constraintDynamics" if len(independent) == len(kept) else "LAPACK"

    @cached_property
    def _rigid(self) -> tuple[Any, Any]:
        """Pinocchio's models and data of the loops."""
        models, data = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
        for loop, (a, b, _) in zip(self._model.loops, self._ends, strict=True):
            models.append(pin.RigidConstraintModel(_RIGID[loop.kind], self._m, *a, *b, _LOCAL))
            data.append(models[-1].createData())
        pin.initConstraintDynamics(self._m, self._d, models, data)
        return models, data

    @cached_property
    def _mu(self) -> float:
        q = pin.neutral(self._m)
        settings = pin.ProximalSettings(_PROXIMAL_ACCURACY, _PROXIMAL_ACCURACY, _PROXIMAL_RATIO, 1)
        pin.constraintDynamics(self._m, self._d, q, self._still, self._still, *self._rigid, settings)
        largest = float(np.max(self._pivots(), initial=0.0))
        return _PROXIMAL_RATIO * largest if 0.0 < largest < inf else _PROXIMAL_RATIO

    def _pivots(self) -> Array:
        """Return those of J M⁻¹ Jᵀ + μ, after constraintDynamics."""
        rows = sum(LOOP_KINDS[loop.kind] for loop in self._model.loops)
        # Pinocchio factors the whole of the equation, where they are the negative ones.
        return np.asarray(-self._d.constraint_chol.D[:rows])

    def iterated(self, q: Array, v: Array, force: Array) -> Array | None:
        """Return v̇ of constraintDynamics under a force without h, all by Pinocchio; None where it is refused."""
        m, d, mu = self._m, self._d, self._mu
        models, data = self._rigid
        settings = pin.ProximalSettings(_PROXIMAL_ACCURACY, _PROXIMAL_ACCURACY, mu, _MAX_PROXIMAL_ITERATIONS)
        a: Array = pin.constraintDynamics(m, d, q, v, force, models, data, settings).copy()
        if not isfinite(sum(a.tolist())):
            return None
        pivots = self._pivots()
        if np.count_nonzero(pivots - mu > _DEPENDENT_PIVOT_RATIO * mu) != len(self.choice.independent):
            return None
        return a if self._agree(q, v, a) else None

    def _agree(self, q: Array, v: Array, a: Array) -> bool:
        """Return whether the accelerations of the loops' ends agree, as constraintDynamics means it."""
        m = self._m
        # The data of constraintDynamics is kept for the multipliers.
        own = self._kinematic
        pin.forwardKinematics(m, own, q, v, a)
        for loop, (one, other, _) in zip(self._model.loops, self._ends, strict=True):
            if loop.kind == "point":
                x, y = (pin.getFrameClassicalAcceleration(m, own, *e, _ALIGNED).linear for e in (one, other))
            else:
                place = (own.oMi[one[0]] * one[1]).actInv(own.oMi[other[0]] * other[1])
                (v_a, v_b), (x, y) = (
                    [of(m, own, *e, _LOCAL) for e in (one, other)]
                    for of in (pin.getFrameVelocity, pin.getFrameAcceleration)
                )
                v_b, y = place.act(v_b), place.act(y)
                x, y = (x + v_a.cross(v_b)).vector, y.vector
            (*x,), (*y,) = x.tolist(), y.tolist()
            if not max(abs(s - t) for s, t in zip(x, y, strict=True)) <= ITERATED * max(map(abs, (*x, *y))):
                return False
        return True

    @cached_property
    def _kinematic(self) -> Any:
        return self._m.createData()

    def iterated_forces(self, q: Array) -> Array:
        """Return λ of all rows after `iterated`, in the axes of the body that carries both ends."""
        m, own = self._m, self._kinematic
        pin.forwardKinematics(m, own, q)
        out, first, given = [], 0, np.asarray(self._d.lambda_c)
        for loop, (a, _, c) in zip(self._model.loops, self._ends, strict=True):
            R = (own.oMi[c[0]].rotation @ c[1].rotation).T @ own.oMi[a[0]].rotation @ a[1].rotation
            last = first + LOOP_KINDS[loop.kind]
            out += [R @ part for part in given[first:last].reshape(-1, 3)]
            first = last
        return np.concatenate(out)

    def solved(self, rows: Rows, M: Array, force: Array) -> tuple[Array, Array]:
        """Return v̇ and λ of all rows by LAPACK, in the description's velocities; `force` includes -h.

        Raises
        ------
        NumericalError
            A singular pose, or a mass matrix that is singular on what the rows leave free.
        """
        from mbkit.derivation.constraints import off_branch

        which = list(self.choice.independent)
        J, gamma = rows.J[which], rows.gamma[which]
        if not np.isfinite(J).all() or not np.isfinite(force).all():
            raise NumericalError(f"pinocchio: the terms of {self._model.name} are not finite at this state")
        a, forces, rank = under_rows(M, J, force, -gamma)
        if rank < len(J):
            raise singular_pose("pinocchio", self._model.name, self.choice.independent_names, J)
        lost = list(self.choice.redundant)
        doubt = float(off_branch(rows.J[lost], rows.gamma[lost], a, force, M)) if lost else 0.0
        return a + doubt, spread(J, rows.J, forces) + doubt


class PinocchioConstrained(RowsOfFrames):
    """Quantities of constraints; `PinocchioDynamics` inherits it."""

    _held: PinConstraints
    # These stand in the other parts.
    _full_q: Callable[[Array], Array]
    _full_v: Callable[[Array], Array]
    _force: Callable[[Array], Array]
    _full_passive: Callable[[Array, Array], Array]
    _mass_matrix: Callable[[Array], Array]
    _nle: Callable[[Array, Array], Array]
    _passive: Callable[[Array, Array], Array]

    @property
    def constraint_solver(self) -> str:
        """What gives accelerations under constraints: "constraintDynamics" or "LAPACK"."""
        ROWS.admit(self.model, "constraint_solver: not known of")
        return self._held.solver

    def _every_row(self, q: Array, v: Array) -> Rows:
        return self._held.all_rows(self._full_q(q), self._full_v(v), (q, v))

    def _constrained_motion(self, q: Array, v: Array, tau: Array) -> Array:
        """Return v̇ under the constraints."""
        a = self._iterated(q, v, tau)
        return self._solved(q, v, tau)[0] if a is None else self._force(a)

    def _constraint_forces(self, q: Array, v: Array, tau: Array) -> Array:
        held = self._held
        if self._iterated(q, v, tau) is None:
            return self._solved(q, v, tau)[1]
        forces = held.iterated_forces(self._full_q(q))
        if len(held.choice.kept) == len(forces):
            return forces
        J = held.every(self._full_q(q), self._full_v(np.zeros_like(v))).J
        # Rows that are left out follow from the others.
        return np.asarray(np.linalg.lstsq(J[list(held.choice.kept)].T, J.T @ forces, rcond=None)[0])

    def _iterated(self, q: Array, v: Array, tau: Array) -> Array | None:
        if self._held.solver != "constraintDynamics":
            return None
        q, v = self._full_q(q), self._full_v(v)
        return self._held.iterated(q, v, self._full_v(tau) + self._full_passive(q, v))

    def _solved(self, q: Array, v: Array, tau: Array) -> tuple[Array, Array]:
        force = tau + self._passive(q, v) - self._nle(q, v)
        return self._held.solved(self._rows(q, v), self._mass_matrix(q), force)
