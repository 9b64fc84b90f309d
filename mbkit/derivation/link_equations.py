"""The equations of motion from link to link: fewer operations than derivatives of the energies take.

The same quantities as `mbkit.derivation.equations`, which derives them from T and V: inverse dynamics by d'Alembert's
principle (`mbkit.derivation.link_mechanics`), M and forward dynamics from Gauss's function
(`mbkit.derivation.gauss_elimination`). The energies stay those of the bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any, Final

import casadi as ca

from mbkit.derivation.equations import Elimination, Equations
from mbkit.derivation.gauss_elimination import GaussElimination
from mbkit.derivation.least_constraint import loses_digits, regroups
from mbkit.derivation.link_mechanics import LinkMechanics
from mbkit.derivation.links import Links
from mbkit.derivation.mass_matrix_solve import solve
from mbkit.derivation.model_values import Constants, scalar
from mbkit.model import Model

#: Carrying the velocities of so many more links is tried in vain before the search for the fewest operations ends.
_PATIENCE: Final = 2


def elimination_of(model: Model) -> Elimination:
    """Return what a model's forward dynamics comes from, where nobody chooses: the quickest that keeps the digits."""
    if model.energy_equations is not None:
        return "mass matrix"
    return "least constraint" if loses_digits(model) else "links"


def equations_of(model: Model, constants: Constants = "literal", elimination: Elimination | None = None) -> Equations:
    """Return a model's equations: from the energies that it was written as, or from its bodies.

    With constants as symbols, and with the elimination ``"mass matrix"``, all comes from derivatives of the bodies'
    energies; else from link to link.
    """
    of_energies = model.energy_equations
    if of_energies is not None:
        written: Equations = of_energies(constants)
        return written
    if constants == "symbols" or elimination == "mass matrix":
        return Equations(model, constants)
    return LinkEquations(model, elimination=elimination or elimination_of(model))


class LinkEquations(Equations):
    """The equations of motion of a model with bodies, its numbers as floats; parameters may be symbols."""

    @cached_property
    def links(self) -> Links:
        """The tree in axes of its own."""
        return Links(self.kin, regroup=regroups(self.model))

    @cached_property
    def mechanics(self) -> LinkMechanics:
        """Motions and forces of the links."""
        return LinkMechanics(self.links)

    def _column(self, entries: list[Any]) -> Any:
        return ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for x in entries))

    @cached_property
    def gravity(self) -> Any:
        """Forces that hold the system against gravity."""
        return self._column(LinkMechanics(self.links, moving=False).forces())

    @cached_property
    def coriolis_force(self) -> Any:
        """C(q, v) v."""
        return self._column(LinkMechanics(self.links, falling=False).forces())

    @cached_property
    def nle(self) -> Any:
        """C v + g."""
        return self._column(self.mechanics.forces())

    @cached_property
    def inverse_dynamics(self) -> Any:
        """M a + C v + g - τ_passive."""
        return self._column(self.mechanics.forces(self._scalars(self.a))) - self.passive

    @cached_property
    def mass_matrix(self) -> Any:
        """M, by composite bodies: what Gauss's function leaves where no velocity is eliminated."""
        n = self.model.nv
        M: Any = ca.SX(n, n)
        for (i, j), x in GaussElimination(self.mechanics, range(n)).rest.items():
            M[i, j] = M[j, i] = x
        return ca.sparsify(M)

    @cached_property
    def forward_dynamics(self) -> Any:
        """M⁻¹ (τ + τ_passive - C v - g), in the form with the fewest operations.

        All accelerations are eliminated link by link, or those next to the root are carried and come from the factors
        of a small matrix.
        """
        if self.least_constraint is not None:
            return self.least_constraint.accelerations(self.tau + self.passive)
        best = self._reduced(())
        if not regroups(self.model):
            # A matrix of what is left would lose digits too.
            return best
        worse, least = 0, ca.n_nodes(best)
        for carried in self._carried():
            other = self._reduced(carried)
            size = ca.n_nodes(other)
            worse = 0 if size < least else worse + 1
            if not worse:
                best, least = other, size
            if worse == _PATIENCE:
                break
        return best

    def _carried(self) -> Iterator[tuple[int, ...]]:
        """Yield the velocities of the links next to the root, deeper and deeper."""
        links = self.links.links
        depths: list[int] = []
        for link in links:
            depths.append(depths[link.parent] + 1 if link.parent >= 0 else 1)
        by_depth = sorted(zip(depths, range(len(links)), strict=True), reverse=True)
        least = {k: depth for depth, index in by_depth for k, _ in links[index].columns}
        for depth in range(1, max(depths, default=0) + 1):
            yield tuple(k for k in self.elimination_order if least[k] <= depth)

    def _reduced(self, carried: tuple[int, ...]) -> Any:
        """Return the accelerations, those in `carried` from the factors of a matrix that is left."""
        elimination = GaussElimination(self.mechanics, carried)
        force, unfold = elimination.accelerations(self._scalars(self.tau + self.passive))
        place = {k: i for i, k in enumerate(carried)}
        M: Any = ca.SX(len(carried), len(carried))
        for (i, j), x in elimination.rest.items():
            M[place[i], place[j]] = M[place[j], place[i]] = x
        order = [place[k] for k in self.elimination_order if k in place]
        y = solve(ca.sparsify(M), self._column([force[k] for k in carried]), order)
        return self._column(unfold({k: scalar(y[i]) for k, i in place.items()}))

    @staticmethod
    def _scalars(x: Any) -> list[Any]:
        return [scalar(x[i]) for i in range(x.shape[0])]
