"""The equations of motion from link to link: fewer operations than derivatives of the energies take.

The same quantities as `mbkit.derivation.equations`, which derives them from T and V: inverse dynamics by d'Alembert's
principle and M by composite bodies (`mbkit.derivation.link_mechanics`), forward
dynamics from Gauss's function (`mbkit.derivation.gauss_elimination`). The energies stay those of the bodies.

Forces and accelerations are derived twice: in short frames, with matter moved, and in the description's own. The short
form is taken where it has fewer operations and both agree to rounding at hard poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, cached_property
from itertools import product
from typing import Any, Final

import casadi as ca
import numpy as np

from mbkit._check import EPS, Array
from mbkit.derivation.constraints import ConstrainedMotion, Constraints, loop_drifts
from mbkit.derivation.equations import NOTHING, Acting, ConstrainedEquations, Elimination, Equations
from mbkit.derivation.gauss_elimination import GaussElimination
from mbkit.derivation.kinematics import column
from mbkit.derivation.least_constraint import (
    LeastConstraint,
    hard_poses,
    has_squares,
    loses_digits,
    mass_matrices,
    squares,
)
from mbkit.derivation.link_derivatives import Entries, LinkDerivatives, has_constant_columns
from mbkit.derivation.link_mechanics import LinkMechanics, mass_matrix
from mbkit.derivation.links import Links
from mbkit.derivation.mass_matrix_solve import implicit, solve
from mbkit.derivation.model_values import Constants, scalar
from mbkit.model import Model
from mbkit.model.parts import RESTING, Joint

#: Carrying the velocities of so many more links is tried in vain before the search for the fewest operations ends.
_PATIENCE: Final = 2
#: Poses at the ends of limits.
_CORNERS: Final = 8
#: Velocities and forces at each pose.
_STATES: Final = 3
#: Random choices of rotors that hold.
_HELD: Final = 2
#: Distance in eps from which a short form of accelerations has lost digits, and one of forces: rounding of the forms
#: themselves makes up to 1.3 on robots, and up to 38 on a chain of 128 links.
_MAX_ERROR: Final = 1.4
_MAX_FORCE_ERROR: Final = 40.0
#: A bit: what a short form may lose against the plain frames.
_MOST_LOST: Final = 2.0


def elimination_of(model: Model) -> Elimination:
    """Return the default elimination of a model's forward dynamics: the fastest that keeps the digits."""
    if model.energy_equations is not None:
        return "mass matrix"
    return "least constraint" if loses_digits(model) else "links"


def equations_of(
    model: Model, constants: Constants = "literal", elimination: Elimination | None = None, acting: Acting = NOTHING
) -> Equations:
    """Return a model's equations: from the energies that it was written as, or from its bodies.

    With constants as symbols, and with the elimination ``"mass matrix"``, all comes from derivatives of the bodies'
    energies; else from link to link.
    """
    of_energies = model.energy_equations
    if of_energies is not None:
        written: Equations = of_energies(constants)
        return written
    if constants == "symbols" or elimination == "mass matrix":
        energies = ConstrainedEquations if model.constrained else Equations
        return energies(model, constants, acting=acting)
    links = ConstrainedLinkEquations if model.constrained else LinkEquations
    return links(model, elimination=elimination or elimination_of(model), acting=acting)


class LinkEquations(Equations):
    """The equations of motion of a model with bodies, its numbers as floats; parameters may be symbols."""

    @cached_property
    def mechanics(self) -> LinkMechanics:
        """Motions and forces of the links, in the frames with the fewest operations."""
        return LinkMechanics(Links(self.kin))

    @cached_property
    def plain(self) -> LinkMechanics:
        """The same in the description's own frames, with its constants to the last digit."""
        return LinkMechanics(Links(self.kin, short=False))

    @cached_property
    def gravity(self) -> Any:
        """Forces that hold the system against gravity."""
        return column(LinkMechanics(self.sound.tree, moving=False).forces())

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v."""
        return column(LinkMechanics(self.sound.tree, falling=False).forces())

    @cached_property
    def nle(self) -> Any:
        """C v + g."""
        return column(self.sound.forces())

    @cached_property
    def inverse_dynamics(self) -> Any:
        """M a + C v + g - τ_passive."""
        return column(self.sound.forces(self._scalars(self.a))) - self.passive

    @cached_property
    def sound(self) -> LinkMechanics:
        """The short frames, if inverse dynamics keeps its digits there with fewer operations; else the plain ones."""
        a = self._scalars(self.a)
        exact, form = (column(mechanics.forces(a)) for mechanics in (self.plain, self.mechanics))
        shorter = ca.n_nodes(form) < ca.n_nodes(exact)
        return self.mechanics if shorter and self._force_error(form, exact) < _MAX_FORCE_ERROR else self.plain

    @cached_property
    def mass_matrix(self) -> Any:
        """M, by composite bodies.

        From the energies where matter depends on parameters, which may be zero, and where an inertia is no sum of
        squares: then the composite bodies' terms are none either, and cancel.
        """
        composite = self.plain.tree.literal and has_squares(self.model)
        return mass_matrix(self.plain) if composite else super().mass_matrix

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - C v - g), in the form with the fewest operations that keeps the digits.

        All accelerations are eliminated link by link, or those next to the root are carried and come from the factors
        of a small matrix. Short frames and moved matter are taken where they agree with the description's own frames at
        hard poses.
        """
        if self.least_constraint is not None:
            return self.least_constraint.accelerations(self.tau + self.passive)
        exact = self._reduced(self.plain, ())
        for form in (self._shortest(), self._reduced(self.mechanics, ())):
            if ca.n_nodes(form) < ca.n_nodes(exact) and self._keeps_digits(form, exact):
                return form
        return exact

    def _keeps_digits(self, form: Any, exact: Any) -> bool:
        """Return whether a short form of the accelerations is as good as that of the plain frames, but for one bit.

        Where they differ by more than rounding, both may be off: with axes that lie anyhow the plain frames round as
        much. The orthogonal elimination, which forms no M, tells how far each is.
        """
        if self._error(form, exact) < _MAX_ERROR:
            return True
        if self._witness is None:
            return False
        return self._error(form, self._witness) < _MOST_LOST * self._error(exact, self._witness)

    @cached_property
    def _witness(self) -> Any:
        if not has_squares(self.model):
            return None
        other = LeastConstraint(squares(self.kin), self.elimination_order)
        return other.accelerations(self.tau + self.passive)

    def _shortest(self) -> Any:
        best = self._reduced(self.mechanics, ())
        worse, least = 0, _size(best)
        for carried in self._carried():
            other = self._reduced(self.mechanics, carried)
            size = _size(other)
            worse = 0 if size < least else worse + 1
            if not worse:
                best, least = other, size
            if worse == _PATIENCE:
                break
        return best

    def _error(self, form: Any, exact: Any) -> float:
        """Return how far two forms of the accelerations are apart at hard poses, in eps.

        Accelerations are √M_jj a_j, beside those of the forces that act; their gap counts per cond(M), and so does the
        force that it amounts to. Infinite where M is singular.
        """
        model, rng, idle = self.model, np.random.default_rng(0), np.zeros(self.force.numel() - self.model.nv)
        given = [self.q, self.v, self.force, *self.extra_arguments.values()]
        forms = ca.Function("forms", given, [ca.densify(x) for x in (form, exact, self.nle, self.passive)])
        worst = 0.0
        with np.errstate(all="ignore"):
            poses = self._poses(rng)
            for more, (pose, M) in product(self._values, zip(poses, mass_matrices(model, poses), strict=True)):
                root = np.sqrt(np.diag(M))
                scaled = M / np.outer(root, root)
                if not np.isfinite(scaled).all():
                    return np.inf
                condition, norm = np.linalg.cond(scaled), np.linalg.norm(scaled, 2)
                for v, tau in rng.standard_normal((_STATES, 2, model.nv)):
                    one, two, nle, passive = (np.array(x)[:, 0] for x in forms(pose, v, np.append(tau, idle), *more))
                    acting = (np.abs(tau) + np.abs(nle) + np.abs(passive)) / root
                    size = max(np.linalg.norm(root * two), np.linalg.norm(acting))
                    gap = root * (one - two)
                    error = max(np.linalg.norm(gap) / condition, np.linalg.norm(scaled @ gap) / norm) / size
                    if not np.isfinite(error):
                        return np.inf
                    worst = max(worst, float(error))
        return worst / EPS

    def _force_error(self, form: Any, exact: Any) -> float:
        """Return how far two forms of inverse dynamics are apart at hard poses, in eps."""
        model, rng, worst = self.model, np.random.default_rng(0), 0.0
        given = [self.q, self.v, self.a, *self.extra_arguments.values()]
        forms = ca.Function("forms", given, [ca.densify(x) for x in (form, exact)])
        with np.errstate(all="ignore"):
            for pose, more in product(self._poses(rng), self._values):
                one, two = (np.array(x)[:, 0] for x in forms(pose, *rng.standard_normal((2, model.nv)), *more))
                error = np.linalg.norm(one - two) / np.linalg.norm(two)
                if not np.isfinite(error):
                    return np.inf
                worst = max(worst, float(error))
        return worst / EPS

    @cached_property
    def _values(self) -> list[tuple[Array, ...]]:
        """Values of the parameters: rotors turn or hold, forces act, and NaN is of those that may do anything else."""
        does: dict[str, set[str]] = {name: set() for name in self.model.parameters}
        for b in self.model.bindings:
            rotor = b.where == "joints" and b.field in Joint.adding_to("T")
            for p in b.expression.parameters():
                does[p.name].add("rotor" if rotor else b.where)
        held = np.array([RESTING if of == {"rotor"} else 0.0 for of in does.values()])
        plain = np.array([1.0 if of == {"forces"} else 0.0 if of == {"rotor"} else np.nan for of in does.values()])
        choices = np.random.default_rng(0).integers(0, 2, size=(_HELD, len(held)))
        return [(plain + choice * held,) for choice in (0, *choices)] if does else [()]

    def _poses(self, rng: np.random.Generator) -> Array:
        """Return poses at which axes align, the ends of limits among them."""
        model = self.model
        q = np.concatenate([[model.neutral()], hard_poses(model, rng), np.tile(model.neutral(), (_CORNERS, 1))])
        limits = np.where(rng.random((_CORNERS, model.nq)) < 0.5, model.lower, model.upper)
        q[-_CORNERS:] = np.where(np.isfinite(limits), limits, q[-_CORNERS:])
        return q

    def _carried(self) -> Iterator[tuple[int, ...]]:
        """Yield the velocities of the links next to the root, deeper and deeper."""
        links = self.mechanics.links
        depths: list[int] = []
        for link in links:
            depths.append(depths[link.parent] + 1 if link.parent >= 0 else 1)
        by_depth = sorted(zip(depths, range(len(links)), strict=True), reverse=True)
        least = {k: depth for depth, index in by_depth for k, _ in links[index].columns}
        for depth in range(1, max(depths, default=0) + 1):
            yield tuple(k for k in self.elimination_order if least[k] <= depth)

    def _reduced(self, mechanics: LinkMechanics, carried: tuple[int, ...]) -> Any:
        """Return the accelerations, those in `carried` from the factors of a matrix that is left."""
        elimination = GaussElimination(mechanics, carried)
        force, unfold = elimination.accelerations(self._scalars(self.tau + self.passive))
        place = {k: i for i, k in enumerate(carried)}
        M: Any = ca.SX(len(carried), len(carried))
        for (i, j), x in elimination.rest.items():
            M[place[i], place[j]] = M[place[j], place[i]] = x
        order = [place[k] for k in self.elimination_order if k in place]
        y = solve(ca.sparsify(M), column([force[k] for k in carried]), order)
        return column(unfold({k: scalar(y[i]) for k, i in place.items()}))

    @cached_property
    def _derivatives(self) -> LinkDerivatives | None:
        """Derivatives from link to link; None where a joint's columns move in its link."""
        return LinkDerivatives(self.sound) if has_constant_columns(self.sound.tree) else None

    @cached_property
    def _coriolis_by_v(self) -> Any:
        return super()._coriolis_by_v if self._derivatives is None else self._matrix(self._derivatives.by_v)

    @cached_property
    def inverse_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂ID/∂q, ∂ID/∂v and ∂ID/∂a = M, from link to link."""
        if self._derivatives is None:
            return super().inverse_dynamics_derivatives
        return *self._derivatives_at(self._derivatives, self.a), self.mass_matrix

    @cached_property
    def forward_dynamics_derivatives(self) -> tuple[Any, Any, Any]:
        """∂FD/∂q, ∂FD/∂v and ∂FD/∂τ = M⁻¹, from those of inverse dynamics at a = FD."""
        if self._derivatives is None:
            return super().forward_dynamics_derivatives
        if self.least_constraint is not None:
            by_q, by_v = self._derivatives_at(self._derivatives, self.forward_dynamics)
            by_q, by_v, by_tau = (self.over_mass(x) for x in (-by_q, -by_v, ca.SX.eye(self.model.nv)))
        else:
            elimination = GaussElimination(self._elimination_frames)
            _, unfold = elimination.accelerations(self._scalars(self.tau + self.passive))
            by_q, by_v = self._derivatives_at(self._derivatives, column(unfold({})))
            inverse, factors = elimination.inverse_factors()
            by_q, by_v, by_tau = implicit(column(inverse), self._matrix(factors), by_q, by_v)
        return by_q, by_v, by_tau

    @cached_property
    def mass_matrix_inverse(self) -> Any:
        """M⁻¹, from the factors of forward dynamics."""
        if self.least_constraint is not None:
            return super().mass_matrix_inverse
        inverse, factors = GaussElimination(self._elimination_frames).inverse_factors()
        return implicit(column(inverse), self._matrix(factors))[0]

    @cached_property
    def _elimination_frames(self) -> LinkMechanics:
        """The short frames, if an elimination of all accelerations keeps its digits there, else the plain ones."""
        exact, form = (self._reduced(mechanics, ()) for mechanics in (self.plain, self.mechanics))
        shorter = ca.n_nodes(form) < ca.n_nodes(exact)
        return self.mechanics if shorter and self._keeps_digits(form, exact) else self.plain

    def _derivatives_at(self, own: LinkDerivatives, a: Any) -> tuple[Any, Any]:
        """Return ∂ID/∂q and ∂ID/∂v at these accelerations."""
        tangent = ca.jacobian(self.kin.qdot, self.v)
        by_q = self._matrix(own.by_q(self._scalars(a))) - ca.mtimes(ca.jacobian(self.passive, self.q), tangent)
        return by_q, self._matrix(own.by_v) - ca.jacobian(self.passive, self.v)

    def _matrix(self, entries: Entries) -> Any:
        n = self.model.nv
        rows, columns = ([key[i] for key in entries] for i in (0, 1))
        return ca.SX.triplet(rows, columns, column(list(entries.values())), n, n)

    @staticmethod
    def _scalars(x: Any) -> list[Any]:
        return [scalar(x[i]) for i in range(x.shape[0])]


class ConstrainedLinkEquations(ConstrainedMotion, LinkEquations):
    """The same with constraints."""

    @cached_property
    def constraint_rows(self) -> Constraints:
        """All rows, and which of them are independent, with γ of loops from the motion of the links."""
        # Without gravity, of which rounding would be left at rest.
        links = cache(lambda: loop_drifts(self.kin, LinkMechanics(self.sound.tree, falling=False)))
        return Constraints(self.kin, self.time, links)


def _size(x: Any) -> int:
    """Return how many operations an expression has, repeated ones once."""
    return int(ca.n_nodes(ca.cse(x)))
