"""A system written out: energies, matrices, equations and conserved quantities on a page, or as a NumPy module."""

from __future__ import annotations

import keyword
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, Final

import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from mbkit._escape import identifier, one_line, python_docstring
from mbkit._version import __version__
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, equations_of_motion, printed_equations
from mbkit.lagrangian.printer import Abbreviations, ExpressionPrinter, folded, matrix, spread, written
from mbkit.lagrangian.reduction.quasi_equations import QuasiEquationsOfMotion
from mbkit.lagrangian.system import Lagrangian
from mbkit.model.elements.paths import ALL, Path

#: Operations of T above which C and the equations are left out of a page.
_MAX_FULL_PAGE_OPERATIONS: Final = 1500
#: And above which M is.
_MAX_MATRIX_OPERATIONS: Final = 6000
#: Letters above which a conserved quantity is only named.
_MAX_CONSERVED_LENGTH: Final = 800


class SystemSummary:
    """A system's energies, matrices and equations as text, LaTeX or data.

    `names` are the coordinates' names in their model, `note` says what the equations leave out, and `progress` gets the
    fraction done and the next part.
    """

    def __init__(
        self,
        system: Lagrangian,
        names: Mapping[str, str] | None = None,
        progress: Callable[[float, str], object] = lambda fraction, what: None,  # noqa: ARG005
        note: str = "",
    ) -> None:
        self.system, self._names, self._progress, self._note = system, dict(names or {}), progress, one_line(note)
        self._size = int(system.T.count_ops())
        self.long = self._size > _MAX_FULL_PAGE_OPERATIONS

    @cached_property
    def equations(self) -> EquationsOfMotion:
        """The equations of motion; where they are too long for a page, without C."""
        if self.long and self.system.quasi is None:
            return equations_of_motion(self.system, coriolis=False)
        return self.system.equations()

    @cached_property
    def _board(self) -> ExpressionPrinter:
        e = self.equations
        return ExpressionPrinter(e.coordinates, e.velocities, e.accelerations, e.multipliers, time=self.system.time)

    @cached_property
    def _short(self) -> Abbreviations:
        """Letters for the roots that stand on the page; where it is long there are none."""
        s = self.system
        shown = [] if self.long else [s.T, s.V, *(x for A, _ in self._matrices.values() for x in A)]
        symbols = (*s.parameters, *s.coordinates, *s.velocities, *s.inputs.values())
        return Abbreviations(shown, symbols)

    def _equations(self, short: Abbreviations, *, latex: bool = False) -> list[tuple[str, str]]:
        if self.long:
            return []
        # The matrices are there before; they take about a third of the time.
        return printed_equations(
            *(self.equations, self._board, short),
            latex=latex,
            progress=lambda x, what: self._progress(0.3 + 0.7 * x, what),
        )

    @cached_property
    def _matrices(self) -> dict[str, tuple[sp.ImmutableMatrix, str]]:
        """Name -> matrix and its meaning, of those that are not zero."""
        self._progress(0.0, "mass matrix and Coriolis matrix")
        e = self.equations
        out = {"M": (e.mass_matrix, "mass matrix")}
        if not self.long:
            out["C"] = (e.coriolis_matrix, "Coriolis matrix, of Christoffel's symbols")
        out |= {
            "g": (e.potential_gradient.applyfunc(spread), "∂V/∂q"),
            "d": (e.drift, "drift: what time and T1, T0 add"),
        }
        out["Q"] = (e.forces, "forces")
        return {n: (A, meaning) for n, (A, meaning) in out.items() if n == "M" or any(x != 0 for x in A)}

    @property
    def _kinematics(self) -> list[sp.Eq]:
        """q̇ = D w of velocities that are not the coordinates' rates."""
        rows = self.equations.kinematics() if isinstance(self.equations, QuasiEquationsOfMotion) else ()
        return [row for row in rows if row.lhs != row.rhs]

    @cached_property
    def _kept(self) -> list[tuple[str, sp.Expr, str]]:
        return [(c.name, c.expression, c.meaning) for c in self.system.conserved_quantities()]

    # Text

    def text(self, width: int = 100) -> str:
        """Return the page for a terminal, matrices within a width if they can be."""
        s, board = self.system, self._board
        q = ", ".join(self._named(x) for x in s.coordinates)
        out = [f"{one_line(s.name)}: {'coordinate' if len(s.coordinates) == 1 else 'coordinates'} {q}"]
        out += folded(f"note: {self._note}", width) if self._note else []
        if s.parameters:
            texts = (written(p.name) + ("" if x is None else f" = {x:g}") for p, x in s.parameters.items())
            out.append(f"parameters {', '.join(texts)}")
        if s.time:
            out.append(f"time {written(s.time.name)}")
        kinetic = [f"T is too long for a page ({self._size} operations): ½ vᵀ M v with"] if self.long else None
        out += ["", *(kinetic or self._sum("T", s.T, width)), *self._sum("V", s.V, width)]
        if s.dissipation != 0:
            out += self._sum("R", s.dissipation, width)
        for letter, root in self._short.roots.items():
            out.append(f"with {board.text(letter)} = {board.text(root)}")
        for name, (A, meaning) in self._matrices.items():
            if name == "M" and self._size > _MAX_MATRIX_OPERATIONS:
                out += ["", f"M is too long for a page as well; its size is {A.rows} by {A.cols}."]
                continue
            out += ["", f"{name}, {meaning}:", *matrix(name, A.applyfunc(self._short), board.text, width)]
        out.append("")
        if self.long:
            out.append("The equations are too long for a page; --python and --c write them.")
        else:
            out.append(f"Equation{'s' * (len(s.coordinates) > 1)} of motion:")
            for left, right in self._equations(self._short):
                out += ["  " + line for line in folded(f"{left} = {right}", width - 2)]
        if self._kinematics:
            out += ["", "Kinematics:"]
            for row in self._kinematics:
                out += ["  " + line for line in folded(f"{board.text(row.lhs)} = {board.text(row.rhs)}", width - 2)]
        out += ["", *self._conserved(width)]
        return "\n".join(out)

    def _named(self, coordinate: sp.Symbol) -> str:
        text, own = written(coordinate.name), self._names.get(coordinate.name, coordinate.name)
        return f"{text}" if own == coordinate.name else f"{text} ({one_line(own)})"

    def _sum(self, name: str, x: sp.Expr, width: int) -> list[str]:
        return folded(f"{name} = {self._board.text(self._short(x))}", width)

    def _conserved(self, width: int) -> list[str]:
        cyclic = [written(q.name) for q in self.system.cyclic_coordinates()]
        out = [f"Cyclic: {', '.join(cyclic) or 'no coordinate'}"]
        if not self._kept:
            return [*out, "Conserved: nothing that follows from missing coordinates or time"]
        for name, x, meaning in self._kept:
            # T and V stand above.
            text = "T + V" if x == self.system.T + self.system.V else self._board.text(self._short(x))
            note = f" ({meaning})" if name == "h" else ""
            if len(text) > _MAX_CONSERVED_LENGTH:
                text, note = "∂T/∂v" if name != "h" else "T2 - T0 + V", ", too long for a page"
            out += folded(f"Conserved: {written(name)} = {text}{note}", width)
        return out

    # LaTeX

    def latex(self) -> str:
        """Return display equations that stand in any document with amsmath."""
        s, board = self.system, self._board
        rows = [f"{name} &= {board.latex(self._short(x))}" for name, x in (("T", s.T), ("V", s.V))]
        if s.dissipation != 0:
            rows.append(f"R &= {board.latex(self._short(s.dissipation))}")
        rows += [f"{board.latex(letter)} &= {board.latex(root)}" for letter, root in self._short.roots.items()]
        for name, (original, _) in self._matrices.items():
            A = original.applyfunc(self._short)
            entries = r" \\ ".join(" & ".join(board.latex(x) for x in A[i, :]) for i in range(A.rows))
            rows.append(rf"{name} &= \begin{{bmatrix}} {entries} \end{{bmatrix}}")
        out = [f"% {one_line(s.name)}, written by mbkit {__version__}; needs amsmath"]
        out += [*([f"% {self._note}"] if self._note else []), _aligned(rows)]
        if not self.long:
            out.append(_aligned([f"{left} &= {right}" for left, right in self._equations(self._short, latex=True)]))
        if self._kinematics:
            out.append(_aligned([f"{board.latex(row.lhs)} &= {board.latex(row.rhs)}" for row in self._kinematics]))
        if self._kept:
            out.append(_aligned([f"{board.latex(sp.Symbol(n))} &= {board.latex(x)}" for n, x, _ in self._kept]))
        return "\n".join(out)

    # Data

    def data(self) -> dict[str, Any]:
        """Return everything as text that `sympy.sympify` reads, with Python names, and the equations in LaTeX too."""
        s, e = self.system, self.equations
        names = self._python_names()

        def name(x: sp.Symbol) -> str:
            return str(names.get(x, x))

        def text(x: sp.Basic) -> str:
            return str(x.xreplace(names))

        out: dict[str, Any] = {"name": s.name, "mbkit": __version__, "sympy": sp.__version__, "note": self._note}
        out["coordinates"] = [name(q) for q in s.coordinates]
        out["velocities"] = [name(v) for v in s.velocities]
        out["accelerations"] = [name(a) for a in e.accelerations]
        out["names"] = [self._names.get(q.name, q.name) for q in s.coordinates]
        out["time"] = name(s.time) if s.time else None
        out["parameters"] = {name(p): x for p, x in s.parameters.items()}
        out |= {"T": text(s.T), "V": text(s.V), "dissipation": text(sp.sympify(s.dissipation))}
        out["mass_matrix"] = [[text(x) for x in e.mass_matrix[i, :]] for i in range(e.mass_matrix.rows)]
        C = None if self.long else e.coriolis_matrix
        out["coriolis_matrix"] = None if C is None else [[text(x) for x in C[i, :]] for i in range(C.rows)]
        out["gravity"] = [text(x) for x in e.potential_gradient]
        out["drift"] = [text(x) for x in e.drift]
        out["forces"] = [text(x) for x in e.forces]
        out |= {n: [text(x) for x in getattr(s, n)] for n in ("constraints", "velocity_constraints")}
        # Each equation alone: no letter is explained elsewhere.
        rows = self._equations(Abbreviations((), ()), latex=True)
        out["equations"] = [] if self.long else [f"{text(x.lhs)} = {text(x.rhs)}" for x in e.equations()]
        out["latex"] = [f"{left} = {right}" for left, right in rows]
        out["cyclic"] = [name(q) for q in s.cyclic_coordinates()]
        out["conserved"] = [{"name": n, "expression": text(x), "meaning": m} for n, x, m in self._kept]
        return out

    def _python_names(self) -> dict[sp.Symbol, sp.Symbol]:
        """Return another symbol for each whose name is no Python name."""
        s, e = self.system, self.equations
        every = (*s.coordinates, *s.velocities, *e.accelerations, *s.parameters, *s.inputs.values(), *e.multipliers)
        every = (*every, *([s.time] if s.time else []))
        used = {x.name for x in every}
        out: dict[sp.Symbol, sp.Symbol] = {}
        for x in every:
            if not x.name.isidentifier() or keyword.iskeyword(x.name):
                out[x] = sp.Symbol(identifier(x.name, used))
                used.add(out[x].name)
        return out


def _aligned(rows: list[str]) -> str:
    return "\\begin{align*}\n" + " \\\\\n".join(rows) + "\n\\end{align*}"


# The equations as a Python module that needs NumPy only

MODULE: Final = Path("python module", "a Python module cannot say of", ALL - {"row", "speed"})
#: Names that the module itself uses, beside Python's own.
_RESERVED: Final = {"np", "q", "v", "tau", "t", "M", "h", "out", "given", "unknown", "parameters", "PARAMETERS"}
_FUNCTIONS: Final = {"mass_matrix", "nonlinear", "forward_dynamics"}


def python_code(system: Lagrangian, note: str = "") -> str:
    """Return a module with `mass_matrix`, `nonlinear` and `forward_dynamics` of M(q) v̇ + h(q, v) = τ.

    Its functions take one state, and parameters by keyword. Constraints are refused (UnsupportedError). `note` says
    what the equations leave out.
    """
    MODULE.admit(system.model)
    e = system.equations()
    n = len(e.coordinates)
    no_inputs = dict.fromkeys(system.inputs.values(), sp.Integer(0))
    h = e.coriolis_force + e.drift + e.potential_gradient - e.forces.subs(no_inputs)
    names = _names(system)
    written = {s: sp.Symbol(name) for s, name in names.items()}
    upper = [e.mass_matrix[i, j] for i in range(n) for j in range(i, n)]
    clock = ", t=0.0" if system.time else ""
    own = [names[s] for s in system.parameters]
    take = "    unknown = set(parameters) - set(PARAMETERS)\n    if unknown:\n"
    take += '        raise TypeError(f"no such parameters: {sorted(unknown)}")\n'
    if own:
        take += "    given = PARAMETERS | parameters\n" + "".join(f"    {name} = given[{name!r}]\n" for name in own)
    coordinates = python_docstring(", ".join(s.name for s in e.coordinates))
    values = "".join(f"    {names[s]!r}: {x!r},\n" for s, x in system.parameters.items())
    unpack = f"{take}    {', '.join(names[s] for s in e.coordinates)}, = q\n"
    moving = unpack + f"    {', '.join(names[s] for s in e.velocities)}, = v\n"
    about = f"\nNote: {python_docstring(note)}." if note else ""
    return f'''"""Equations of motion of {python_docstring(system.name)}: M(q) a + h(q, v) = tau, in SI units.

Coordinates q: {coordinates}. Written by mbkit {__version__}; needs NumPy only.{about}
"""

import numpy as np

PARAMETERS = {{
{values}}}


def mass_matrix(q{clock}, **parameters):
    """Return M, ({n}, {n})."""
{unpack}{_body(upper, written)}
    M = np.zeros(({n}, {n}))
    M[np.triu_indices({n})] = out
    return M + np.triu(M, 1).T


def nonlinear(q, v{clock}, **parameters):
    """Return h, ({n},): Coriolis, gravity, springs, damping and other forces of the system."""
{moving}{_body(list(h), written)}
    return np.array(out, dtype=float)


def forward_dynamics(q, v, tau={(0.0,) * n!r}{clock}, **parameters):
    """Return a = M^-1 (tau - h), ({n},)."""
    h = nonlinear(q, v{", t" if clock else ""}, **parameters)
    return np.linalg.solve(mass_matrix(q{", t" if clock else ""}, **parameters), np.asarray(tau) - h)
'''


def _body(expressions: list[sp.Expr], written: dict[sp.Symbol, sp.Symbol]) -> str:
    used = {s.name for s in written.values()}
    fresh = (s for s in sp.numbered_symbols("x") if s.name not in used)
    shared, out = sp.cse([x.xreplace(written) for x in expressions], symbols=fresh, order="none")
    code: Callable[[Any], str] = NumPyPrinter({"fully_qualified_modules": True}).doprint
    lines = [f"    {s} = {code(x)}" for s, x in shared]
    return "\n".join([*lines, f"    out = [{', '.join(map(code, out))}]"]).replace("numpy.", "np.")


def _names(system: Lagrangian) -> dict[sp.Symbol, str]:
    """Return a Python name for each symbol."""
    out: dict[sp.Symbol, str] = {}
    if system.time:
        out[system.time] = "t"
    for s in (*system.parameters, *system.coordinates, *system.velocities):
        out[s] = identifier(s.name, _RESERVED | _FUNCTIONS | set(out.values()))
    return out
