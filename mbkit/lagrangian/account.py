"""All that is told of a system on one page: energies, matrices, equations, and what it keeps."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final

import sympy as sp

from mbkit._version import __version__
from mbkit.lagrangian.blackboard import Blackboard, spread, written
from mbkit.lagrangian.motion import EquationsOfMotion
from mbkit.lagrangian.system import Lagrangian

__all__ = ["Account"]

#: Operations of T above which C and the equations are left out of a page.
_READABLE: Final = 1500
#: Letters above which a conserved quantity is only named.
_LONG: Final = 800
_LOW: Final = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


class Account:
    """A system's energies, matrices and equations as text, LaTeX or data.

    Parameters
    ----------
    system : Lagrangian
    names : mapping of str to str, optional
        What each coordinate was called where it came from.
    """

    def __init__(self, system: Lagrangian, names: Mapping[str, str] | None = None) -> None:
        self.system, self._names = system, dict(names or {})
        self.long = system.T.count_ops() > _READABLE

    @cached_property
    def equations(self) -> EquationsOfMotion:
        """The equations of motion."""
        return self.system.equations()

    @cached_property
    def _board(self) -> Blackboard:
        return Blackboard(self.equations)

    @cached_property
    def _matrices(self) -> dict[str, tuple[sp.ImmutableMatrix, str]]:
        """Name -> matrix and what it is; of those that are not zero."""
        e = self.equations
        out = {"M": (e.mass_matrix, "mass matrix")}
        if not self.long:
            out["C"] = (e.coriolis_matrix, "Coriolis matrix, of Christoffel's symbols")
        out |= {
            "g": (e.potential_gradient.applyfunc(spread), "∂V/∂q"),
            "d": (e.drift, "drift: what time and T1, T0 add"),
        }
        out["Q"] = (e.forces, "forces")
        return {n: (A, told) for n, (A, told) in out.items() if n == "M" or any(x != 0 for x in A)}

    @cached_property
    def _kept(self) -> list[tuple[str, sp.Expr, str]]:
        return [(c.name, c.expression, c.meaning) for c in self.system.conserved_quantities()]

    # Text

    def text(self, width: int = 100) -> str:
        """Return the page for a terminal, matrices within a width if they can be."""
        s, board = self.system, self._board
        q = ", ".join(self._named(x) for x in s.coordinates)
        lines = [f"{s.name}: {'coordinate' if len(s.coordinates) == 1 else 'coordinates'} {q}"]
        if s.parameters:
            given = (written(p.name) + ("" if x is None else f" = {x:g}") for p, x in s.parameters.items())
            lines.append(f"parameters {', '.join(given)}")
        if s.time:
            lines.append(f"time {s.time}")
        lines += ["", *self._sum("T", s.T, width), *self._sum("V", s.V, width)]
        if s.dissipation != 0:
            lines += self._sum("R", s.dissipation, width)
        for name, (A, told) in self._matrices.items():
            lines += ["", f"{name}, {told}:", *_matrix(name, A, board, width)]
        lines.append("")
        if self.long:
            lines.append("The equations are too long for a page; --python and --c write them.")
        else:
            lines.append(f"Equation{'s' * (len(s.coordinates) > 1)} of motion:")
            for left, right in board.rows():
                lines += ["  " + line for line in _folded(f"{left} = {right}", width - 2)]
        lines += ["", *self._conserved(width)]
        return "\n".join(lines)

    def _named(self, coordinate: sp.Symbol) -> str:
        told, own = written(coordinate.name), self._names.get(coordinate.name, coordinate.name)
        return f"{told}" if own == coordinate.name else f"{told} ({own})"

    def _sum(self, name: str, x: sp.Expr, width: int) -> list[str]:
        return _folded(f"{name} = {self._board.text(x)}", width)

    def _conserved(self, width: int) -> list[str]:
        cyclic = [written(q.name) for q in self.system.cyclic_coordinates()]
        lines = [f"Cyclic: {', '.join(cyclic) or 'no coordinate'}"]
        if not self._kept:
            return [*lines, "Conserved: nothing that is told by the coordinates or the time"]
        energy = sp.expand(self.system.T + self.system.V)
        for name, x, meaning in self._kept:
            # T and V stand above.
            told = "T + V" if name == "E" and sp.expand(x - energy) == 0 else self._board.text(x)
            note = f" ({meaning})" if name == "h" else ""
            if len(told) > _LONG:
                told, note = "∂T/∂v" if name != "h" else "T2 - T0 + V", ", too long for a page"
            lines += _folded(f"Conserved: {written(name)} = {told}{note}", width)
        return lines

    # LaTeX

    def latex(self) -> str:
        """Return display equations that stand in any document with amsmath."""
        s, board = self.system, self._board
        rows = [rf"T &= {board.latex(s.T)}", rf"V &= {board.latex(s.V)}"]
        if s.dissipation != 0:
            rows.append(rf"R &= {board.latex(s.dissipation)}")
        for name, (A, _) in self._matrices.items():
            entries = r" \\ ".join(" & ".join(board.latex(x) for x in A[i, :]) for i in range(A.rows))
            rows.append(rf"{name} &= \begin{{bmatrix}} {entries} \end{{bmatrix}}")
        out = [f"% {s.name}, written by mbkit {__version__}; needs amsmath", _aligned(rows)]
        if not self.long:
            out.append(_aligned([f"{left} &= {right}" for left, right in board.rows(latex=True)]))
        if self._kept:
            out.append(_aligned([f"{sp.latex(sp.Symbol(n))} &= {board.latex(x)}" for n, x, _ in self._kept]))
        return "\n".join(out)

    # Data

    def data(self) -> dict[str, Any]:
        """Return everything as text that `sympy.sympify` reads, with the equations in LaTeX too."""
        s, e = self.system, self.equations
        told: dict[str, Any] = {"name": s.name, "mbkit": __version__, "sympy": sp.__version__}
        told["coordinates"] = [q.name for q in s.coordinates]
        told["velocities"] = [v.name for v in s.velocities]
        told["accelerations"] = [a.name for a in e.accelerations]
        told["names"] = [self._names.get(q.name, q.name) for q in s.coordinates]
        told["time"] = s.time.name if s.time else None
        told["parameters"] = {p.name: x for p, x in s.parameters.items()}
        told |= {"T": str(s.T), "V": str(s.V), "dissipation": str(s.dissipation)}
        told["mass_matrix"] = _listed(e.mass_matrix)
        told["coriolis_matrix"] = None if self.long else _listed(e.coriolis_matrix)
        told["gravity"] = [str(x) for x in e.potential_gradient]
        told["drift"] = [str(x) for x in e.drift]
        told["forces"] = [str(x) for x in e.forces]
        told["constraints"] = [str(x) for x in s.constraints]
        rows = [] if self.long else self._board.rows(latex=True)
        told["equations"] = [] if self.long else [f"{x.lhs} = {x.rhs}" for x in e.equations()]
        told["latex"] = [f"{left} = {right}" for left, right in rows]
        told["cyclic"] = [q.name for q in s.cyclic_coordinates()]
        told["conserved"] = [{"name": n, "expression": str(x), "meaning": m} for n, x, m in self._kept]
        return told


def _aligned(rows: list[str]) -> str:
    return "\\begin{align*}\n" + " \\\\\n".join(rows) + "\n\\end{align*}"


def _listed(A: sp.ImmutableMatrix) -> list[list[str]]:
    return [[str(x) for x in A[i, :]] for i in range(A.rows)]


def _matrix(name: str, A: sp.ImmutableMatrix, board: Blackboard, width: int) -> list[str]:
    """Return a matrix in brackets, or its entries one a line where it is too wide."""
    cells = [[board.text(x) for x in A[i, :]] for i in range(A.rows)]
    widths = [max(_width(row[j]) for row in cells) for j in range(A.cols)]
    if sum(widths) + 3 * A.cols + 4 <= width:
        edges = "[]" if A.rows == 1 else ("⎡⎤", *("⎢⎥",) * (A.rows - 2), "⎣⎦")
        rows = zip(cells, edges if A.rows > 1 else (edges,), strict=True)
        return [
            f"  {edge[0]} {'   '.join(c + ' ' * (w - _width(c)) for c, w in zip(row, widths, strict=True))} {edge[1]}"
            for row, edge in rows
        ]
    out = []
    symmetric = name == "M"
    for i in range(A.rows):
        for j in range(i if symmetric else 0, A.cols):
            if cells[i][j] != "0":
                place = str(i + 1) if A.cols == 1 else f"{i + 1}{j + 1}" if A.cols < 10 else f"{i + 1},{j + 1}"
                equal = f" = {name}{f'{j + 1}{i + 1}'.translate(_LOW)}" if symmetric and i != j and A.cols < 10 else ""
                out += _folded(f"  {name}{place.translate(_LOW)}{equal} = {cells[i][j]}", width)
    return out


def _width(text: str) -> int:
    """Return how many columns a text takes: dots above letters take none."""
    return sum(c not in "\u0307\u0308" for c in text)


def _folded(text: str, width: int) -> list[str]:
    """Return a sum on lines of a width, broken before + and - outside of brackets where there are such."""
    lines: list[str] = []
    indent = " " * (len(text) - len(text.lstrip()) + 6)
    while _width(text) > width:
        places, depth = [], 0
        for k, c in enumerate(text[: width + len(text) - _width(text)]):
            depth += (c in "([") - (c in ")]")
            if k > len(indent) + 2 and text[k : k + 3] in (" + ", " - ", " = "):
                places.append((depth, -k))
        if not places:
            break
        # The last place on the line that is within the fewest brackets.
        cut = -min(places)[1]
        lines.append(text[:cut])
        text = indent + text[cut + 1 :]
    return [*lines, text]
