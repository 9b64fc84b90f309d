"""Newton's and Euler's equations of free bodies, and their way to the equations of motion by d'Alembert's principle.

Each body is cut free: m_i R̈_i = f_i + F_i and I_i ω̇_i + ω_i × I_i ω_i = n_i + N_i, with its reactions F_i and N_i.
With the partial velocities P = ∂(Ṙ_i, ω_i)/∂v the reactions of ideal joints do no virtual work, Pᵀ (F, N) = 0, and Pᵀ
times the rows are the equations of motion (Kane and Levinson 1985, Dynamics: Theory and Applications, ch. 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy as sp

from mbkit._escape import terminal
from mbkit.errors import InputError
from mbkit.lagrangian.energies.symbols import PlainSymbols, accelerations_of, free_name
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned
from mbkit.lagrangian.statics.virtual_work import read_bodies, turning
from mbkit.lagrangian.trig.simplify import tidy, tidy_matrix


@dataclass(frozen=True, repr=False)
class FreeBodies(Printable):
    """The rows of all bodies that were cut free, the result of `mbkit.lagrangian.newton_euler`.

    Attributes
    ----------
    coordinates, velocities, accelerations : tuple of sympy.Symbol
        n of each.
    inertial : (k, 1) sympy.Matrix
        m R̈, and I ω̇ + ω × I ω, of body after body.
    applied : (k, 1) sympy.Matrix
        Forces and moments that are given, weight among them.
    reactions : tuple of sympy.Symbol
        One for each row: ``F1x`` on the first body along x, ``N1z`` its moment about z.
    partial_velocities : (k, n) sympy.Matrix
        P, the slopes of Ṙ_i and ω_i in the velocities.
    """

    coordinates: tuple[sp.Symbol, ...]
    velocities: tuple[sp.Symbol, ...]
    accelerations: tuple[sp.Symbol, ...]
    inertial: sp.ImmutableMatrix
    applied: sp.ImmutableMatrix
    reactions: tuple[sp.Symbol, ...]
    partial_velocities: sp.ImmutableMatrix

    def rows(self) -> tuple[sp.Eq, ...]:
        """Return Newton's and Euler's equations of all bodies, k of them, with k reactions."""
        right = self.applied + sp.Matrix(self.reactions)
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(self.inertial, right, strict=True))

    @cached_property
    def _projected(self) -> tuple[sp.ImmutableMatrix, sp.ImmutableMatrix]:
        P = self.partial_velocities
        return tidy_matrix(P.T * self.inertial), tidy_matrix(P.T * self.applied)

    def equations(self) -> tuple[sp.Eq, ...]:
        """Return Pᵀ times the rows, n equations without reactions: those of Lagrange."""
        return tuple(sp.Eq(a, b, evaluate=False) for a, b in zip(*self._projected, strict=True))

    def loads(self) -> dict[sp.Symbol, sp.Expr]:
        """Return each reaction in coordinates, velocities and accelerations: the sum of all joints' on its body."""
        left = self.inertial - self.applied
        return {name: tidy(x) for name, x in zip(self.reactions, left, strict=True)}

    def latex(self) -> str:
        """Return the rows as an aligned LaTeX block."""
        board = ExpressionPrinter(self.coordinates, self.velocities, self.accelerations, self.reactions)
        return aligned((board.latex(e.lhs), board.latex(e.rhs)) for e in self.rows())

    def __str__(self) -> str:
        k, n = len(self.reactions), len(self.coordinates)
        head = f"{k} equations of {k} reactions and {n} accelerations; {n} without reactions:"
        lines = [*(f"{e.lhs} = {e.rhs}" for e in self.rows()), head]
        return terminal("\n".join([*lines, *(f"{e.lhs} = {e.rhs}" for e in self.equations())]))


def newton_euler(
    masses: Sequence[Any],
    positions: Sequence[Any],
    coordinates: Sequence[Any],
    velocities: Sequence[Any] | None = None,
    *,
    inertias: Sequence[Any] | None = None,
    angular_velocities: Sequence[Any] | None = None,
    gravity: Sequence[Any] | None = None,
    forces: Sequence[Any] | None = None,
    torques: Sequence[Any] | None = None,
    time: sp.Symbol | None = None,
) -> FreeBodies:
    """Return Newton's and Euler's equations of all bodies, with their reactions, and the way to those of motion.

    Parameters
    ----------
    masses, positions, coordinates, velocities, inertias, angular_velocities, gravity, time
        As of `from_particles`.
    forces : sequence of vectors, optional
        On each body at its centre of mass beside gravity, N; None for one without.
    torques : sequence of vectors, optional
        On each body, N m, in the axes of its angular velocity; None for one without.

    Raises
    ------
    InputError
        As of `from_particles`.

    Examples
    --------
    >>> import sympy as sp
    >>> import mbkit as mb
    >>> th, m, l, g = sp.symbols("theta m l g")
    >>> rod = mb.lagrangian.newton_euler(
    ...     [m], [[l / 2 * sp.sin(th), -l / 2 * sp.cos(th)]], [th], inertias=[m * l**2 / 12],
    ...     angular_velocities=[sp.Symbol("thetadot")], gravity=[0, -g])
    >>> rod.equations()
    (Eq(l**2*m*thetaddot/3, -g*l*m*sin(theta)/2),)
    >>> rod.loads()[sp.Symbol("F1y")]
    m*(2*g + l*(thetaddot*sin(theta) + thetadot**2*cos(theta)))/2
    """
    into, R, m, down = read_bodies(masses, positions, PlainSymbols(coordinates, velocities, time), gravity)
    turns = turning(into, len(m), inertias, angular_velocities)
    own = accelerations_of(into.coordinates, into.velocities)
    loads = {
        "forces": _given("forces", forces, [len(x) for x in R], into),
        "torques": _given("torques", torques, [len(t[1]) if t else 0 for t in turns], into),
    }
    used = {s.name for s in (*into.coordinates, *into.velocities, *own)}
    inertial, applied, names, speeds = [], [], [], []

    def rate(x: Any) -> Any:
        moved = sum((sp.diff(x, q) * v for q, v in zip(into.coordinates, into.velocities, strict=True)), 0 * x)
        moved += sum((sp.diff(x, v) * a for v, a in zip(into.velocities, own, strict=True)), 0 * x)
        return moved if into.time is None else moved + sp.diff(x, into.time)

    def add(left: Any, right: Any, speed: Any, letter: str, k: int) -> None:
        axes = "xyz" if len(left) > 1 or letter == "F" else "z"
        for axis, a, b, v in zip(axes, left, right, speed, strict=False):
            names.append(sp.Symbol(free_name(f"{letter}{k + 1}{axis}", used)))
            used.add(names[-1].name)
            inertial.append(tidy(a))
            applied.append(tidy(b))
            speeds.append(v)

    for k, (mass, place) in enumerate(zip(m, R, strict=True)):
        velocity = rate(sp.Matrix(place))
        force = loads["forces"][k] + (mass * sp.Matrix(down) if down is not None else sp.zeros(len(place), 1))
        add(mass * rate(velocity), force, velocity, "F", k)
        if (turn := turns[k]) is not None:
            A, w = turn
            spun = A * rate(w) + (w.cross(A * w) if len(w) == 3 else sp.zeros(1, 1))
            add(spun, loads["torques"][k], w, "N", k)
    P = sp.Matrix(speeds).jacobian(into.velocities)
    return FreeBodies(
        coordinates=into.coordinates,
        velocities=into.velocities,
        accelerations=own,
        inertial=sp.ImmutableMatrix(inertial),
        applied=sp.ImmutableMatrix(applied),
        reactions=tuple(names),
        partial_velocities=tidy_matrix(P),
    )


def _given(what: str, source: Sequence[Any] | None, sizes: list[int], into: PlainSymbols) -> list[sp.Matrix]:
    """Return a vector for each body, zero where None is given."""
    if source is None:
        return [sp.zeros(n, 1) for n in sizes]
    if len(source) != len(sizes):
        raise InputError(f"{what}: {len(source)} of them for {len(sizes)} bodies; give one for each, or None")
    out = []
    for k, (x, n) in enumerate(zip(source, sizes, strict=True)):
        row = [0] * n if x is None else list(x) if hasattr(x, "__len__") else [x]
        if len(row) != n:
            raise InputError(f"{what}[{k}]: expected {n} components, got {len(row)}")
        out.append(sp.Matrix(n, 1, [into(f"{what}[{k}]", e) for e in row]))
    return out
