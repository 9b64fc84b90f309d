"""Steady motions: cyclic coordinates turn at constant rates while all others rest, and whether they are stable.

They are the equilibria of Routh's reduced system, the stationary points of the effective potential (Routh 1877, A
Treatise on the Stability of a Given State of Motion; Pars 1965, A Treatise on Analytical Dynamics, ch. IX). Stability
is that of the others, with the momenta of the cyclic coordinates held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from mbkit._check import Array, real, real_array, rows
from mbkit._escape import html, terminal
from mbkit.engines.base import Dynamics
from mbkit.errors import InputError, NumericalError, require_known
from mbkit.lagrangian.energies.symbols import name_of
from mbkit.lagrangian.reduction.routh import Routhian
from mbkit.lagrangian.statics.equilibrium import Equilibrium, equilibrium
from mbkit.lagrangian.system import Lagrangian

#: Condition of the scaled mass matrix of cyclic coordinates; its square times eps is the error of the stiffness.
_SINGULAR_CONDITION: Final = 1e5


@dataclass(frozen=True, eq=False)
class SteadyMotion:
    """A steady motion, the result of `mbkit.steady_motion`.

    Attributes
    ----------
    equilibrium : Equilibrium
        Of the reduced system: where the other coordinates rest, whether that is stable, and how fast they oscillate.
    rates : mapping of str to float
        Cyclic coordinate -> its constant rate.
    momenta : mapping of str to float
        Its constant momentum, by name: ``"p_phi"``.
    q, v : (n,) array
        A state of the whole system on this motion, with the cyclic coordinates at zero.
    """

    equilibrium: Equilibrium
    rates: Mapping[str, float]
    momenta: Mapping[str, float]
    q: Array
    v: Array

    @property
    def stable(self) -> bool | None:
        """Whether small motions of the other coordinates stay small; None where the linear equation does not decide."""
        return self.equilibrium.stable

    @property
    def frequencies(self) -> Array:
        """Angular frequencies of small motions that oscillate, rad/s, increasing."""
        return self.equilibrium.frequencies

    def __str__(self) -> str:
        lines = [str(self.equilibrium).replace(": equilibrium,", ": steady motion,", 1)]
        lines += [f"  rate of {name} = {x:.9g}" for name, x in self.rates.items()]
        return terminal("\n".join([*lines, *(f"  {name} = {x:.9g}" for name, x in self.momenta.items())]))

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<pre>{html(str(self))}</pre>"


def steady_motion(
    system: Lagrangian,
    q0: ArrayLike | None = None,
    *,
    momenta: Mapping[str, float] | None = None,
    rates: Mapping[Any, float] | None = None,
    seed: int = 0,
    **values: float,
) -> SteadyMotion:
    """Return a motion in which cyclic coordinates turn steadily and all others rest, with its stability.

    Parameters
    ----------
    system : Lagrangian
        With cyclic coordinates.
    q0 : (n,) or (r,) array_like, optional
        Start of the search: a whole configuration, or of the r others; by default zeros, then random ones.
    momenta : mapping of str to float
        Of each cyclic coordinate by name: ``{"p_phi": 2.0}``.
    rates : mapping of coordinate to float
        In place of momenta: the rates that the cyclic coordinates are to have.
    seed : int
        Of the random starts.
    **values
        Of parameters, by name.

    Raises
    ------
    InputError
        Both or neither of momenta and rates, one of them without a number, no cyclic coordinate, or a system that
        depends on the time.
    NumericalError
        The search ends nowhere, or where coordinates are singular, as Euler's angles are where a top sleeps.

    Examples
    --------
    A spherical pendulum that circles at 5 rad/s hangs at cos θ = g/(l Ω²):

    >>> import numpy as np
    >>> import mbkit as mb
    >>> cone = mb.steady_motion(mb.lagrangian.systems.spherical_pendulum(), [1.0], rates={"phi": 5.0}, l=1.0, m=1.0)
    >>> bool(abs(np.cos(cone.equilibrium.q[0]) - 9.81 / 25) < 1e-12), cone.stable
    (True, True)
    """
    if not isinstance(system, Lagrangian):
        raise InputError(f"system: expected a Lagrangian, got {type(system).__name__}")
    if system.time is not None:
        raise InputError(f"system: {system.name} depends on the time {system.time}, and no motion of it is steady")
    reduced = system.routhian()
    remaining, cyclic = reduced._places
    start = _start(reduced, q0)
    if (momenta is None) == (rates is None):
        raise InputError("momenta: expected momenta or rates of the cyclic coordinates, one of the two")
    if momenta is None:
        start, momenta = _of_rates(system, reduced, start, rates or {}, values, seed)
    names = [p.name for p in reduced.momenta]
    _complete("momenta", momenta, names)
    numbers = {name: real(f"momenta[{name}]", momenta[name]) for name in names}
    rest = equilibrium(_at(reduced.lagrangian, {**values, **numbers}), start, seed=seed)
    still = np.zeros((1, len(remaining)))
    turning = reduced._rates(np.zeros(1), rest.q[None], still, _numbers(reduced, {**values, **numbers}))[0]
    q, v = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    q[remaining], v[cyclic] = rest.q, turning
    if turning.any():
        steps = 1e-3 * np.diag(np.maximum(1.0, abs(q)))[remaining]
        neighbours = np.concatenate([[q], q + steps, q - steps])
        _refuse_pole(_at(system, values).mass_matrix(neighbours)[:, cyclic][:, :, cyclic], reduced, rest.q)
    rates_by_name = {s.name: float(x) for s, x in zip(reduced.cyclic, turning, strict=True)}
    return SteadyMotion(rest, rates_by_name, numbers, q, v)


def _at(system: Lagrangian, values: dict[str, float]) -> Dynamics:
    dyn = system.dynamics()
    return dyn.at(**values) if values else dyn


def _refuse_pole(neighbours: Array, reduced: Routhian[Any], q: Array) -> None:
    """Refuse a place where cyclic coordinates turn about one axis, or one turns nothing (NumericalError).

    `beside` are the mass matrices of cyclic coordinates there, first, and at places beside it.
    """
    M, around = neighbours[0], np.diagonal(neighbours, axis1=1, axis2=2).max(axis=0)
    still = [
        x.name
        for x, own, most in zip(reduced.cyclic, np.diag(M), around, strict=True)
        if own * _SINGULAR_CONDITION**2 < most
    ]
    if still:
        raise NumericalError(
            f"{reduced.system.name}: {', '.join(still)} turns nothing at {np.array2string(q, precision=4)}, where the "
            "coordinates are singular and a rate says nothing; take other coordinates, or another q0"
        )
    scale = 1 / np.sqrt(np.diag(M))
    if np.linalg.cond(scale[:, None] * M * scale) > _SINGULAR_CONDITION:
        names = ", ".join(x.name for x in reduced.cyclic)
        raise NumericalError(
            f"{reduced.system.name}: {names} turn about one axis at {np.array2string(q, precision=4)}, where terms of "
            "their momenta cancel and stability has no digits left; take other coordinates, or another q0"
        )


def _numbers(reduced: Routhian[Any], values: Mapping[str, float]) -> dict[str, float]:
    return {s.name: values.get(s.name, x) for s, x in reduced.lagrangian.parameters.items()}


def _start(reduced: Routhian[Any], q0: ArrayLike | None) -> Array | None:
    if q0 is None:
        return None
    remaining, _ = reduced._places
    whole, name = len(reduced.system.coordinates), reduced.system.name
    start = real_array("q0", q0)
    if start.shape == (whole,):
        return start[remaining]
    return rows("q0", start, len(remaining), name, "coordinates that are not cyclic")


def _complete(what: str, values: Mapping[Any, float], names: list[str]) -> None:
    if not isinstance(values, Mapping):
        raise InputError(f"{what}: expected a mapping of names to numbers, got {values!r}")
    require_known(what, names, *values)
    missing = [name for name in names if name not in values]
    if missing:
        raise InputError(f"{what}: expected a number for each of {', '.join(names)}, got none for {', '.join(missing)}")


def _of_rates(
    system: Lagrangian,
    reduced: Routhian[Any],
    start: Array | None,
    rates: Mapping[Any, float],
    values: dict[str, float],
    seed: int,
) -> tuple[Array, dict[str, float]]:
    """Return where the other coordinates rest while the cyclic ones are driven at these rates, and their momenta."""
    named = (
        {name_of(key): real(f"rates[{key}]", x) for key, x in rates.items()} if isinstance(rates, Mapping) else rates
    )
    _complete("rates", named, [q.name for q in reduced.cyclic])
    remaining, cyclic = reduced._places
    put = {system.velocities[i]: sp.Float(named[q.name], 17) for i, q in zip(cyclic, reduced.cyclic, strict=True)}
    forces = {system.coordinates[i]: system.forces[i].subs(put) for i in remaining}
    driven = Lagrangian(
        system.T.subs(put),
        system.V,
        [system.coordinates[i] for i in remaining],
        [system.velocities[i] for i in remaining],
        forces={q: x for q, x in forces.items() if x != 0},
        parameters=system.parameters,
        constraints=system.constraints,
        velocity_constraints=[x.subs(put) for x in system.velocity_constraints],
        name=f"{system.name} at these rates",
    )
    rest = equilibrium(_at(driven, values), start, seed=seed)
    q, v = np.zeros(len(system.coordinates)), np.zeros(len(system.coordinates))
    q[remaining], v[cyclic] = rest.q, [named[x.name] for x in reduced.cyclic]
    return rest.q, dict(reduced.reduce(q, v, **values).values)
