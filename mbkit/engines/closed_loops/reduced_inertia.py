"""The inertia of a mechanism seen from independent coordinates θ, and its derivatives.

Velocities follow as v = N θ̇, with J N = 0 and N the identity in θ, so that T = ½ θ̇ᵀ J(θ) θ̇ with J(θ) = Nᵀ M N
(Eksergian 1931, Dynamical analysis of machines, Journal of the Franklin Institute 211). Where the loops bend, a
constant θ̇ takes accelerations a_γ, with J a_γ = -γ and zero in θ. By Lagrange's equation the forces of such a motion
are Christoffel's symbols of J(θ)::

    Nᵀ (M a_γ + C v)_i = Σ Γ_ijk θ̇_j θ̇_k        ∂J_ij/∂θ_k = Γ_ijk + Γ_jik

So derivatives come from terms that every engine has, and nothing is differenced.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit._reproducible import dependent, unit_rows
from mbkit.engines.closed_loops.loop_loads import LoopLoads
from mbkit.engines.constrained import ASKED
from mbkit.errors import InputError, NumericalError
from mbkit.model.elements.paths import ALL, Path

#: Forces of the time leave the inertia as it is.
REDUCED_INERTIA: Final = Path(
    "reduced inertia",
    "reduced_inertia: not known of",
    (ALL - {"speed", "t"}) | {"force.of_time"},
    {
        "speed": "its velocities lead to no path of coordinates; consistent_changes(q, v) has the motions it allows",
        "t": "velocities are not N θ̇ alone",
    },
    asks=(frozenset(["row"]), ASKED[1]),
)


class ReducedInertia(NamedTuple):
    """A mechanism seen from independent coordinates θ, with T = ½ θ̇ᵀ J(θ) θ̇.

    Attributes
    ----------
    inertia : float, (N,), (d, d) or (N, d, d) array
        J(θ): a number for one coordinate by name, a matrix for a list of d.
    derivative : float, (N,), (d, d, d) or (N, d, d, d) array
        dJ/dθ; of several, entry [i, j, k] is ∂J_ij/∂θ_k.
    motion : (nv,), (N, nv), (nv, d) or (N, nv, d) array
        N = ∂v/∂θ̇, the transmission ratios.
    """

    inertia: Any
    derivative: Any
    motion: Array


class IndependentMotion(LoopLoads):
    """The part of `Dynamics` for motion seen from independent coordinates."""

    def reduced_inertia(self, q: ArrayLike, coordinates: str | Sequence[str]) -> ReducedInertia:
        """Return the inertia that independent coordinates of a mechanism feel, and its derivatives.

        The equation of a mechanism with one degree of freedom is J θ̈ + ½ dJ/dθ θ̇² = Nᵀ (τ + τ_passive - g).

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
            Where the loops are closed, which is not looked at.
        coordinates : str or sequence of str
            Names of coordinates, or of joints with one, as many as degrees of freedom.

        Returns
        -------
        ReducedInertia
            With `inertia` J(θ), `derivative` dJ/dθ and `motion` N.

        Raises
        ------
        InputError
            Not as many coordinates as degrees of freedom, or one whose rate is no velocity.
        NumericalError
            The coordinates do not determine the others at a pose, as at a dead centre.
        UnsupportedError
            A model without loops, or with constraints that depend on the time or hold velocities alone.

        Examples
        --------
        All of the energy is that of the crank's motion:

        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.four_bar(), "lagrangian")
        >>> q, v = dyn.model.random_state(0)
        >>> crank = dyn.model.coordinate_names[0]
        >>> J, slope, N = dyn.reduced_inertia(q, crank)
        >>> energy = dyn.kinetic_energy(q, v)
        >>> bool(abs(0.5 * J * v[0] ** 2 - energy) < 1e-14 * energy)
        True
        """
        model = self.model
        REDUCED_INERTIA.admit(model)
        q = model.check_q(q)
        names = [coordinates] if isinstance(coordinates, str) else coordinates
        _, which = self._states_held.held_parts(model, names)
        named = [model.velocity_names.index(x) for x in self._single(names)]
        own = list(self._row_choice.independent)
        if len(named) != (degrees := model.nv - len(own)) or len(which) != len(named):
            raise InputError(
                f"coordinates: {model.name} has {degrees} degrees of freedom: expected as many different names, got "
                f"{', '.join(names) or 'none'}"
            )
        self._require_motion(q)
        J, M = self.constraint_jacobian(q)[..., own, :], self.mass_matrix(q)
        sizes = np.linalg.norm(J, axis=-1, keepdims=True)
        J = unit_rows(J)
        rest = np.setdiff1d(np.arange(model.nv), named)
        self._require_leading(J[..., rest], q, names)
        N = np.zeros((*J.shape[:-2], model.nv, degrees))
        N[..., named, range(degrees)] = 1.0
        N[..., rest, :] = -np.linalg.solve(J[..., rest], J[..., named])
        inertia = N.swapaxes(-1, -2) @ M @ N

        def symbols(v: Array) -> Array:
            """Return Nᵀ (M a_γ + C v)."""
            gamma = self.constraint_bias(q, v)[..., own] / sizes[..., 0]
            a = np.zeros_like(v)
            a[..., rest] = -np.linalg.solve(J[..., rest], gamma[..., None])[..., 0]
            moving = (M @ a[..., None])[..., 0] + self._of_velocities(q, v)
            return np.asarray((N.swapaxes(-1, -2) @ moving[..., None])[..., 0])

        alone = [symbols(N[..., j]) for j in range(degrees)]
        G = np.zeros((*inertia.shape, degrees))
        for j in range(degrees):
            G[..., j, j] = alone[j]
            for k in range(j):
                both = symbols(N[..., j] + N[..., k])
                G[..., j, k] = G[..., k, j] = 0.5 * (both - alone[j] - alone[k])
        slopes = G + G.swapaxes(-3, -2)
        if isinstance(coordinates, str):
            return ReducedInertia(scalar(inertia[..., 0, 0]), scalar(slopes[..., 0, 0, 0]), N[..., 0])
        return ReducedInertia(inertia, slopes, N)

    def _single(self, names: Sequence[str]) -> list[str]:
        """Return coordinates that velocities are the rates of."""
        model = self.model
        for name in names:
            if name not in model.velocity_names:
                raise InputError(
                    f"coordinates: {name!r} of {model.name} is no coordinate whose rate is a velocity; there are: "
                    f"{', '.join(x for x in model.coordinate_names if x in model.velocity_names)}"
                )
        return list(names)

    def _of_velocities(self, q: Array, v: Array) -> Array:
        """Return C v."""
        if not self.model.has_bodies:
            return self.coriolis_force(q, v)
        # Not from the Coriolis matrix, which an engine may have wrong.
        return np.asarray(self.nle(q, v) - self.nle(q, np.zeros_like(v)))

    def _require_leading(self, J: Array, q: Array, names: Sequence[str]) -> None:
        """Refuse poses at which the other coordinates do not follow."""
        if not (bad := dependent(J)).any():
            return
        k = int(np.argmax(bad))
        pose = np.atleast_2d(q)[k]
        where = ", ".join(f"{n} = {x:.6g}" for n, x in zip(self.model.coordinate_names, pose, strict=True))
        raise NumericalError(
            f"{self.engine}: {', '.join(names)} of {self.model.name} does not determine the other coordinates at "
            f"{where}: a dead centre; take another coordinate there"
        )


def scalar(x: Any) -> Any:
    """Return one state's number as a float, a batch's as an array."""
    return x if np.ndim(x) else float(x)
