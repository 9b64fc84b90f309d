"""d'Alembert: particles whose places are functions of coordinates, as a `Lagrangian`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.symbols import Plain
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.tidy import tidy
from mbkit.lagrangian.virtual_work import check_places, generalized_force, vectors

__all__ = ["from_particles"]


def from_particles(
    masses: Sequence[Any],
    positions: Sequence[Any],
    coordinates: Sequence[Any],
    velocities: Sequence[Any] | None = None,
    *,
    gravity: Sequence[Any] | None = None,
    potential: Any = 0,
    forces: Sequence[Any] | None = None,
    generalized: Mapping[Any, Any] | None = None,
    dissipation: Any = 0,
    time: sp.Symbol | None = None,
    parameters: Mapping[sp.Symbol, float | None] | Iterable[sp.Symbol] | None = None,
    constraints: Sequence[Any] = (),
    name: str = "particles",
) -> Lagrangian:
    """Return the system of particles at R_i(q, t): Σ (m_i R̈_i - f_i) · δR_i = 0.

    Parameters
    ----------
    masses : sequence of sympy.Expr
        m_i, kg.
    positions : sequence of vectors
        R_i(q, t): 1, 2 or 3 components along fixed axes, m.
    coordinates, velocities
        As of `Lagrangian`.
    gravity : vector, optional
        Its acceleration along the same axes, m/s²: V = -Σ m_i gravity · R_i.
    potential : sympy.Expr, optional
        Other potential energy, such as of springs, J.
    forces : sequence of vectors, optional
        f_i on each particle beside gravity, N, of coordinates, velocities, time and
        parameters; None for a particle that has none.
    generalized : mapping of coordinate to sympy.Expr, optional
        Generalized forces besides.
    dissipation, time, parameters, constraints, name
        As of `Lagrangian`.

    Raises
    ------
    InputError
        Other numbers of masses, positions and forces, or what `Lagrangian` refuses.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> th, m, l, g = sp.symbols("theta m l g")
    >>> R = [l * sp.sin(th), -l * sp.cos(th)]
    >>> lag = mb.lagrangian.from_particles([m], [R], [th], gravity=[0, -g], parameters=[m, l, g])
    >>> print(lag.equations())
    l**2*m*thetaddot + g*l*m*sin(theta) = 0
    """
    into = Plain(coordinates, velocities, time)
    R = vectors("positions", positions, into)
    check_places("positions", R, into)
    # A single vector stands for one particle, of which the mass may stand alone.
    m = [into("masses", x) for x in ([masses] if isinstance(masses, (sp.Basic, int, float)) else masses)]
    if len(m) != len(R):
        raise InputError(f"masses: {len(m)} of them for {len(R)} positions; give one for each")
    T, V = [], [into("potential", potential)]
    for mass, place in zip(m, R, strict=True):
        T.append(mass * sp.Add(*(_rate(x, into) ** 2 for x in place)) / 2)
    if gravity is not None:
        ((*down,),) = vectors("gravity", [gravity], into)
        for k, (mass, place) in enumerate(zip(m, R, strict=True)):
            if len(down) != len(place):
                raise InputError(f"gravity: {len(down)} components, but positions[{k}] has {len(place)}")
            V.append(-mass * sp.Add(*(a * x for a, x in zip(down, place, strict=True))))
    Q = {into("generalized", key): into(f"generalized[{key}]", x) for key, x in (generalized or {}).items()}
    for q, work in _work(forces or [], R, into).items():
        # What is zero must not hide an input that stands alone.
        if work != 0:
            Q[q] = Q.get(q, 0) + work
    return Lagrangian(
        tidy(sp.Add(*T)),
        tidy(sp.Add(*V)),
        into.coordinates,
        into.velocities,
        time=into.time,
        forces=Q,
        dissipation=into("dissipation", dissipation),
        parameters=parameters,
        constraints=[into(f"constraints[{k}]", c) for k, c in enumerate(constraints)],
        name=name,
    )


def _rate(x: sp.Expr, into: Plain) -> sp.Expr:
    """Return Ṙ's component: along the coordinates' velocities and with the time."""
    along = [sp.diff(x, q) * v for q, v in zip(into.coordinates, into.velocities, strict=True)]
    return sp.Add(*along, sp.diff(x, into.time) if into.time is not None else 0)


def _work(forces: Sequence[Any], R: list[tuple[sp.Expr, ...]], into: Plain) -> dict[Any, sp.Expr]:
    if not len(forces):
        return {}
    if len(forces) != len(R):
        raise InputError(f"forces: {len(forces)} of them for {len(R)} positions; give one for each, or None")
    given = [[0] * len(x) if f is None else f for f, x in zip(forces, R, strict=True)]
    plain = [[into(f"forces[{k}]", x) for x in f] for k, f in enumerate(given)]
    return generalized_force(plain, R, into.coordinates, velocities=into.velocities, time=into.time)
