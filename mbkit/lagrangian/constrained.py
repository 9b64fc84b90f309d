"""What a `Lagrangian` with constraints answers by number."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import Array, real
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.symbols import name_of

if TYPE_CHECKING:
    from mbkit.engines import Dynamics
    from mbkit.lagrangian.constraints import Manifold
    from mbkit.lagrangian.embedding import Embedded
    from mbkit.lagrangian.written import WrittenModel

__all__ = ["Constrained"]


class Constrained:
    """Constraints, their Jacobian and multipliers, consistent states and the embedded form."""

    name: str
    coordinates: tuple[sp.Symbol, ...]
    constraints: tuple[sp.Expr, ...]

    @property
    @abstractmethod
    def model(self) -> WrittenModel:
        """The system as engines take it."""

    @abstractmethod
    def dynamics(
        self, engine: str = "lagrangian", *, options: Mapping[str, Any] | None = None, **values: float
    ) -> Dynamics:
        """Return the compiled dynamics."""

    def constraint(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return f(q, t), (m,) or (N, m); zero where the constraints hold.

        Parameters
        ----------
        q : (n,) or (N, n) array_like
        t : float
            s.
        **values
            Of parameters, by name.
        """
        manifold = self._manifold(t, values)
        return manifold.value(self.model.check_q(q))

    def constraint_jacobian(self, q: ArrayLike, t: float = 0.0, **values: float) -> Array:
        """Return J = ∂f/∂q, (m, n) or (N, m, n); arguments are those of `constraint`."""
        manifold = self._manifold(t, values)
        return manifold.jacobian(self.model.check_q(q))

    def multipliers(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike | None = None, t: float = 0.0, **values: float
    ) -> Array:
        """Return λ, (m,) or (N, m): the forces Jᵀ λ that hold the constraints.

        Parameters
        ----------
        q, v : (n,) or (N, n) array_like
            A consistent state; `project` makes one.
        tau : (n,) or (N, n) array_like, optional
            Zero when not given.
        t : float
            s.
        **values
            Of parameters, by name.
        """
        from mbkit.lagrangian.redundancy import require_independent

        q, v = self.model.check_q(q), self.model.check_v(v)
        tau = self.model.check_v(np.zeros_like(v) if tau is None else tau, "tau")
        manifold, (q, v, tau) = self._manifold(t, values), np.broadcast_arrays(q, v, tau)
        for one in np.atleast_2d(q):
            require_independent(manifold.dyn, one)
        out = manifold.multipliers(q, v, tau)
        if not np.isfinite(out).all():
            raise NumericalError(
                f"{self.name}: the multipliers are not finite at q = {q.tolist()}; perhaps the constraints depend on "
                "each other in this pose, or the mass matrix is singular"
            )
        return out

    def project(self, q: ArrayLike, v: ArrayLike, t: float = 0.0, **values: float) -> tuple[Array, Array]:
        """Return the nearest state that the constraints allow, by the mass matrix's measure.

        Parameters
        ----------
        q, v : (n,) or (N, n) array_like
        t : float
            s.
        **values
            Of parameters, by name.

        Returns
        -------
        q, v : (n,) or (N, n) arrays
            With f(q, t) = 0 and J v + ∂f/∂t = 0 to rounding.

        Raises
        ------
        InputError
            Constraints that contradict or follow from each other, or too far a way.
        """
        manifold = self._manifold(t, values)
        q, v = np.broadcast_arrays(self.model.check_q(q), self.model.check_v(v))
        if q.ndim == 1:
            return self._projected(manifold, q, v)
        found = [self._projected(manifold, *pair) for pair in zip(q, v, strict=True)]
        return np.array([pair[0] for pair in found]), np.array([pair[1] for pair in found])

    def _projected(self, manifold: Manifold, q: Array, v: Array) -> tuple[Array, Array]:
        from mbkit.lagrangian.redundancy import refuse_unreachable, require_independent

        try:
            found = manifold.project(q, v)
        except InputError:
            refuse_unreachable(manifold.dyn, q)
            raise
        require_independent(manifold.dyn, found[0], everywhere=True)
        return found

    def embedded(self, independent: Sequence[Any] | None = None, **values: float) -> Embedded:
        """Return the system on independent coordinates alone, for `mbkit.simulate`.

        Parameters
        ----------
        independent : sequence of coordinates or their names, optional
            As many as there are coordinates less constraints. When not given, those on
            which the others depend best, chosen anew where that changes.
        **values
            Of parameters, by name.
        """
        from mbkit.lagrangian.embedding import Embedded

        dyn = self.dynamics().at(**values)
        if isinstance(independent, (str, sp.Basic)):
            independent = [independent]
        names = None if independent is None else tuple(name_of(x) for x in independent)
        return Embedded(self._consistent(dyn), names)

    def _manifold(self, t: float, values: Mapping[str, float]) -> Manifold:
        return self._consistent(self._interpreted.at(**values) if values else self._interpreted).at(real("t", t))

    def _consistent(self, dyn: Dynamics) -> Manifold:
        # It loads CasADi.
        from mbkit.lagrangian.constraints import manifold_of

        if not self.constraints:
            raise UnsupportedError(f"{self.name}: has no constraints; give them as constraints=[...]")
        return manifold_of(dyn)

    @cached_property
    def _interpreted(self) -> Dynamics:
        return self.dynamics(options={"compile": False})
