"""Generalized forces by virtual work: what given forces do along each coordinate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.symbols import Plain, expression, listed, plain
from mbkit.lagrangian.tidy import tidy

__all__ = ["check_places", "generalized_force", "vectors"]


def generalized_force(
    forces: Any,
    points: Any,
    coordinates: Sequence[Any],
    *,
    torques: Any = (),
    angular_velocities: Any = (),
    velocities: Sequence[Any] | None = None,
    time: sp.Symbol | None = None,
) -> dict[Any, sp.Expr]:
    """Return Q_j = Σ f_i · ∂R_i/∂q_j + Σ n_k · ∂ω_k/∂v_j of each coordinate.

    Parameters
    ----------
    forces : sequence of vectors
        f_i: of 1, 2 or 3 components along fixed axes, N; a single vector where there is
        one point.
    points : sequence of vectors
        R_i(q, t), where the forces act, along the same axes, m.
    coordinates : sequence of sympy symbols
        Plain symbols or dynamicsymbols.
    torques : sequence of vectors, optional
        n_k on bodies, N m.
    angular_velocities : sequence of vectors, optional
        ω_k(q, v, t) of those bodies, along the torques' axes; in a plane of one component.
    velocities : sequence of sympy symbols, optional
        As of `Lagrangian`, for forces and angular velocities that contain them.
    time : sympy.Symbol, optional

    Returns
    -------
    dict
        Coordinate as it was given -> Q_j, fit to be the `forces` of a `Lagrangian`. At
        the given time: what the time moves does no virtual work.

    Raises
    ------
    InputError
        Other numbers of forces than of points, vectors of other lengths, points that depend on a
        velocity, or an angular velocity that depends on none.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> th, l, m, g = sp.symbols("theta l m g")
    >>> tip = [l * sp.sin(th), -l * sp.cos(th)]
    >>> mb.lagrangian.generalized_force([[0, -m * g]], [tip], [th])
    {theta: -g*l*m*sin(theta)}
    """
    into = Plain(coordinates, velocities, time)
    f, R = vectors("forces", forces, into), vectors("points", points, into)
    n, w = vectors("torques", torques, into), vectors("angular_velocities", angular_velocities, into)
    _pairs("forces", f, "points", R)
    _pairs("torques", n, "angular_velocities", w)
    check_places("points", R, into)
    for k, turn in enumerate(w):
        if any(turn) and not any(x.free_symbols & set(into.velocities) for x in turn):
            raise InputError(
                f"angular_velocities[{k}]: {list(turn)} holds none of the velocities {plain(into.velocities)}; "
                "velocities=... gives them other names"
            )
    out = {}
    for key, q, v in zip(listed("coordinates", coordinates), into.coordinates, into.velocities, strict=True):
        work = [a * sp.diff(b, q) for fi, Ri in zip(f, R, strict=True) for a, b in zip(fi, Ri, strict=True)]
        work += [a * sp.diff(b, v) for nk, wk in zip(n, w, strict=True) for a, b in zip(nk, wk, strict=True)]
        out[key] = tidy(sp.Add(*work))
    return out


def check_places(what: str, places: list[tuple[sp.Expr, ...]], into: Plain) -> None:
    """Refuse places that depend on a velocity, where nothing can be."""
    for k, place in enumerate(places):
        moving = {s for x in place for s in x.free_symbols} & set(into.velocities)
        if moving:
            raise InputError(f"{what}[{k}]: expected coordinates and time only, got the velocity {plain(moving)}")


def vectors(what: str, given: Any, into: Plain) -> list[tuple[sp.Expr, ...]]:
    """Return vectors of expressions in plain symbols; a single vector is a list of one."""
    try:
        rows = [list(x) if _several(x) else x for x in given]
    except TypeError:
        raise InputError(f"{what}: expected a list of vectors, got {given!r}") from None
    if rows and not any(isinstance(x, list) for x in rows):
        rows = [rows]
    out = []
    for k, row in enumerate(rows):
        name = f"{what}[{k}]"
        if not isinstance(row, list) or not 1 <= len(row) <= 3:
            raise InputError(f"{name}: expected a vector of 1, 2 or 3 components, got {row!r}")
        out.append(tuple(into(name, expression(name, x)) for x in row))
    return out


def _several(x: Any) -> bool:
    return isinstance(x, (list, tuple, sp.Tuple, sp.MatrixBase)) or (hasattr(x, "__len__") and not isinstance(x, str))


def _pairs(first: str, a: list[tuple[sp.Expr, ...]], second: str, b: list[tuple[sp.Expr, ...]]) -> None:
    if len(a) != len(b):
        raise InputError(f"{first}: {len(a)} of them for {len(b)} {second}; give one for each")
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        if len(x) != len(y):
            raise InputError(f"{first}[{k}]: {len(x)} components, but {second}[{k}] has {len(y)}")
