"""Generalized forces by virtual work: the work of forces along each coordinate."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import sympy as sp

from mbkit.errors import InputError
from mbkit.lagrangian.energies.symbols import PlainSymbols, expression, listed, plain
from mbkit.lagrangian.system import Lagrangian
from mbkit.lagrangian.trig.simplify import tidy


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
        f_i: of 1, 2 or 3 components along fixed axes, N; one vector for one point.
    points : sequence of vectors
        R_i(q, t), where the forces act, along the same axes, m.
    coordinates : sequence of sympy symbols
        Plain symbols or dynamicsymbols.
    torques : sequence of vectors, optional
        n_k on bodies, N m.
    angular_velocities : sequence of vectors, optional
        ω_k(q, v, t) of those bodies, along the torques' axes; one component in a plane.
    velocities : sequence of sympy symbols, optional
        As of `Lagrangian`, for forces and angular velocities that contain them.
    time : sympy.Symbol, optional

    Returns
    -------
    dict
        Each coordinate of the input -> Q_j, as the `forces` of a `Lagrangian`; what the time moves does no work.

    Raises
    ------
    InputError
        Vectors of other numbers or lengths, points that depend on a velocity, or an angular velocity that does not.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> th, l, m, g = sp.symbols("theta l m g")
    >>> tip = [l * sp.sin(th), -l * sp.cos(th)]
    >>> mb.lagrangian.generalized_force([[0, -m * g]], [tip], [th])
    {theta: -g*l*m*sin(theta)}
    """
    into = PlainSymbols(coordinates, velocities, time)
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


def check_places(what: str, places: list[tuple[sp.Expr, ...]], into: PlainSymbols) -> None:
    """Refuse places that depend on a velocity, where nothing can be."""
    for k, place in enumerate(places):
        moving = {s for x in place for s in x.free_symbols} & set(into.velocities)
        if moving:
            raise InputError(f"{what}[{k}]: expected coordinates and time only, got the velocity {plain(moving)}")


def vectors(what: str, source: Any, into: PlainSymbols) -> list[tuple[sp.Expr, ...]]:
    """Return vectors of expressions in plain symbols; a single vector is a list of one."""
    try:
        rows = [list(x) if hasattr(x, "__len__") and not isinstance(x, str) else x for x in source]
    except TypeError:
        raise InputError(f"{what}: expected a list of vectors, got {source!r}") from None
    if rows and not any(isinstance(x, list) for x in rows):
        rows = [rows]
    out = []
    for k, row in enumerate(rows):
        name = f"{what}[{k}]"
        if not isinstance(row, list) or not 1 <= len(row) <= 3:
            raise InputError(f"{name}: expected a vector of 1, 2 or 3 components, got {row!r}")
        out.append(tuple(into(name, expression(name, x)) for x in row))
    return out


def _pairs(first: str, a: Sequence[Any], second: str, b: Sequence[Any], hint: str = "") -> None:
    if len(a) != len(b):
        raise InputError(f"{first}: {len(a)} of them for {len(b)} {second}; give one for each{hint}")
    for k, (x, y) in enumerate(zip(a, b, strict=True)):
        if isinstance(x, tuple) and len(x) != len(y):
            raise InputError(f"{first}[{k}]: {len(x)} components, but {second}[{k}] has {len(y)}")


# d'Alembert: particles whose places are functions of coordinates, as a `Lagrangian`.


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
    velocity_constraints: Sequence[Any] = (),
    inertias: Sequence[Any] | None = None,
    angular_velocities: Sequence[Any] | None = None,
    name: str = "particles",
) -> Lagrangian:
    """Return the system of particles or rigid bodies at R_i(q, t): Σ (m_i R̈_i - f_i) · δR_i = 0 and what turns.

    Parameters
    ----------
    masses : sequence of sympy.Expr
        m_i, kg.
    positions : sequence of vectors
        R_i(q, t): 1, 2 or 3 components along fixed axes, m; of a body its centre of mass.
    coordinates, velocities
        As of `Lagrangian`.
    inertias : sequence of sympy.Expr, of 3 of them, or of (3, 3) matrices, optional
        About the centre of mass, kg m²: one number in a plane, else principal ones or a matrix in the body's axes; None
        for a particle.
    angular_velocities : sequence of vectors, optional
        ω_i(q, v, t) in the axes of the inertia: 1 component in a plane, else 3; None for a particle.
    gravity : vector, optional
        Its acceleration along the same axes, m/s²: V = -Σ m_i gravity · R_i.
    potential : sympy.Expr, optional
        Other potential energy, such as of springs, J.
    forces : sequence of vectors, optional
        f_i on each particle beside gravity, N; None for a particle without.
    generalized : mapping of coordinate to sympy.Expr, optional
        Further generalized forces.
    dissipation, time, parameters, constraints, velocity_constraints, name
        As of `Lagrangian`.

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
    into, R, m, down = read_bodies(masses, positions, PlainSymbols(coordinates, velocities, time), gravity)
    T = [mass * sp.Add(*(_rate(x, into) ** 2 for x in place)) / 2 for mass, place in zip(m, R, strict=True)]
    T += [
        (w.T * A * w)[0] / 2 for turn in turning(into, len(m), inertias, angular_velocities) if turn for A, w in [turn]
    ]
    V = [into("potential", potential)]
    for mass, place in zip(m, R, strict=True) if down is not None else ():
        V.append(-mass * sp.Add(*(a * x for a, x in zip(down or (), place, strict=True))))
    Q = {into("generalized", key): into(f"generalized[{key}]", x) for key, x in (generalized or {}).items()}
    if forces is not None and len(forces):
        _pairs("forces", forces, "positions", R, ", or None")
        rows = [[0] * len(x) if f is None else f for f, x in zip(forces, R, strict=True)]
        acting = [[into(f"forces[{k}]", x) for x in row] for k, row in enumerate(rows)]
        work = generalized_force(acting, R, into.coordinates, velocities=into.velocities, time=into.time)
        # A zero must not hide an input that is a force of its own.
        Q |= {q: Q.get(q, 0) + x for q, x in work.items() if x != 0}
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
        velocity_constraints=velocity_constraints,
        name=name,
    )


def read_bodies(
    masses: Any, positions: Any, into: PlainSymbols, gravity: Any
) -> tuple[PlainSymbols, list[tuple[sp.Expr, ...]], list[sp.Expr], tuple[sp.Expr, ...] | None]:
    """Return the symbols, places and masses of particles or bodies, and the acceleration of gravity or None."""
    R = vectors("positions", positions, into)
    check_places("positions", R, into)
    # A single vector stands for one particle, of which the mass may stand alone.
    m = [into("masses", x) for x in listed("masses", [masses] if isinstance(masses, (int, float)) else masses)]
    _pairs("masses", m, "positions", R)
    if gravity is None:
        return into, R, m, None
    (down,) = vectors("gravity", [gravity], into)
    for k, place in enumerate(R):
        if len(down) != len(place):
            raise InputError(f"gravity: {len(down)} components, but positions[{k}] has {len(place)}")
    return into, R, m, down


def turning(
    into: PlainSymbols, count: int, inertias: Sequence[Any] | None, angular_velocities: Sequence[Any] | None
) -> list[tuple[sp.Matrix, sp.Matrix] | None]:
    """Return inertia and angular velocity of each body, as matrices of 1 or 3 rows; None for a particle."""
    if inertias is None and angular_velocities is None:
        return [None] * count
    A, w = list(inertias or [None] * count), list(angular_velocities or [None] * count)
    for what, rows in (("inertias", A), ("angular_velocities", w)):
        if len(rows) != count:
            raise InputError(f"{what}: {len(rows)} of them for {count} positions; give one for each, or None")
    out: list[tuple[sp.Matrix, sp.Matrix] | None] = []
    for k, (inertia, rate) in enumerate(zip(A, w, strict=True)):
        if (inertia is None) != (rate is None):
            raise InputError(f"inertias[{k}]: expected an inertia and an angular velocity, or None for both")
        if inertia is None:
            out.append(None)
            continue
        (turn,) = vectors(f"angular_velocities[{k}]", [rate if hasattr(rate, "__len__") else [rate]], into)
        shown = sp.Matrix(inertia) if hasattr(inertia, "__len__") else sp.Matrix([inertia])
        matrix = shown if shown.is_square else sp.diag(*shown)
        if matrix.rows != len(turn) or len(turn) == 2:
            raise InputError(
                f"inertias[{k}]: expected 1 number with 1 angular velocity, or 3 or a (3, 3) matrix with 3, got "
                f"{shown.shape} with {len(turn)}"
            )
        if matrix != matrix.T:
            raise InputError(f"inertias[{k}]: expected a symmetric matrix, got {matrix.tolist()}")
        out.append((matrix.applyfunc(lambda x, k=k: into(f"inertias[{k}]", x)), sp.Matrix(turn)))
    return out


def _rate(x: sp.Expr, into: PlainSymbols) -> sp.Expr:
    """Return Ṙ's component: along the coordinates' velocities and with the time."""
    along = [sp.diff(x, q) * v for q, v in zip(into.coordinates, into.velocities, strict=True)]
    return sp.Add(*along, sp.diff(x, into.time) if into.time is not None else 0)
