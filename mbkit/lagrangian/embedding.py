"""Constraints embedded: the motion on independent coordinates alone.

A chart divides q into independent and dependent coordinates. The dependent ones follow
from f(q, t) = 0 by Newton's iteration, velocities from J v + ∂f/∂t = 0 as
v = N(q) u + v_t, and the equation is pulled back by N (Wehage and Haug 1982,
Generalized coordinate partitioning; Shabana 2013, Dynamics of Multibody Systems, ch. 5)::

    Nᵀ M N u̇ = Nᵀ (τ + applied - M a_t)

A chart serves while its dependent block of J is not much nearer to singular than J is.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.errors import InputError, UnknownNameError
from mbkit.lagrangian.constraints import Manifold
from mbkit.lagrangian.embedded_dynamics import Chart, EmbeddedDynamics, ReducedModel
from mbkit.lagrangian.redundancy import require_few

__all__ = ["SINGULAR", "Chart", "Embedded", "EmbeddedDynamics"]

#: A pose is near a singular one where the smallest singular value of J, or of the
#: dependent block, is below this part of the largest of J.
SINGULAR: Final = 1e-3
# Of the best that any choice can give: below, another one is due.
_WORN: Final = 0.25


class Embedded:
    """A system under constraints, to be simulated on independent coordinates: ``mbkit.simulate(embedded, ...)``.

    Parameters
    ----------
    manifold : Manifold
    independent : tuple of str, optional
        A choice that stays; else the best one, chosen anew when it no longer is.

    Attributes
    ----------
    dynamics : LagrangianDynamics
        On all coordinates, with multipliers.
    independent : tuple of str or None
    degrees : int
        Of freedom.
    """

    def __init__(self, manifold: Manifold, independent: tuple[str, ...] | None = None) -> None:
        self.manifold, self.dynamics, self.independent = manifold, manifold.dyn, independent
        self.model = manifold.dyn.model
        rows = len(self.model.system.constraints)  # type: ignore[attr-defined]  # of a written model
        require_few(self.model)
        self.degrees = self.model.nv - rows
        if self.degrees < 1:
            raise InputError(f"{self.model.name}: {rows} constraints leave none of {self.model.nv} coordinates free")
        # However chosen, the best block of a matrix is no worse than this (Gu and Eisenstat 1996).
        self.least = _WORN / float(np.sqrt(1 + rows * self.degrees))
        if independent is not None:
            self._check(independent)

    def _check(self, names: tuple[str, ...]) -> None:
        known = self.model.coordinate_names
        for name in names:
            if name not in known:
                raise UnknownNameError("coordinate", name, known)
        if len(set(names)) != self.degrees:
            raise InputError(
                f"independent: expected {self.degrees} of {', '.join(known)}, got {', '.join(names) or 'none'}"
            )

    def __repr__(self) -> str:
        chosen = "chosen as it runs" if self.independent is None else ", ".join(self.independent)
        return f"<Embedded {self.model.name!r}: {self.degrees} of {self.model.nv} coordinates, {chosen}>"

    def chart(self, q: Array, t: float) -> Chart:
        """Return the chart to start with at a configuration: the pivots of J, or what the user chose."""
        from scipy.linalg import qr

        names = self.model.coordinate_names
        if self.independent is not None:
            independent = np.array([names.index(n) for n in self.independent], dtype=np.intp)
            return Chart(independent, np.setdiff1d(np.arange(len(names)), independent))
        J = self.manifold.at(t).jacobian(q)
        _, _, order = qr(J, mode="economic", pivoting=True)
        return Chart(np.sort(order[len(J) :]), np.sort(order[: len(J)]))

    def names(self, chart: Chart) -> str:
        """Return the independent coordinates of a chart to read."""
        return ", ".join(self.model.coordinate_names[i] for i in chart.independent)

    def quality(self, chart: Chart, q: Array, t: float) -> float:
        """Return the smallest singular value of the dependent block over that of J: small where it is a bad choice."""
        J = self.manifold.at(t).jacobian(q)
        least = np.linalg.svd(J, compute_uv=False)[-1]
        return float(np.linalg.svd(J[:, chart.dependent], compute_uv=False)[-1] / max(least, np.finfo(float).tiny))

    def nearness(self, chart: Chart, q: Array, t: float) -> float:
        """Return the smallest singular value over the largest: of J, or of a dependent block that is to stay."""
        J = self.manifold.at(t).jacobian(q)
        block = J if self.independent is None else J[:, chart.dependent]
        largest = np.linalg.norm(J, 2)
        return float(np.linalg.svd(block, compute_uv=False)[-1] / max(largest, np.finfo(float).tiny))

    def on(self, chart: Chart, q: Array, t: float) -> EmbeddedDynamics:
        """Return the dynamics on a chart's independent coordinates, from a consistent configuration on."""
        names = tuple(self.model.coordinate_names[i] for i in chart.independent)
        out = EmbeddedDynamics(ReducedModel(self.model, names), self.dynamics, chart, t)
        out.remember(q)
        return out
