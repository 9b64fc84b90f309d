"""A system written out: energies, matrices, equations and conserved quantities on a page, or as a NumPy module.

The symbols in which textbooks write the catalog's systems, and the numbers that stand for them.
"""

from __future__ import annotations

import inspect
import keyword
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import fields, replace
from functools import cached_property
from itertools import count
from typing import Any, Final

import numpy as np
import sympy as sp
from sympy.printing.numpy import NumPyPrinter

from mbkit import catalog
from mbkit._check import ROUNDING
from mbkit._escape import identifier, one_line, python_docstring
from mbkit._version import __version__
from mbkit.errors import MbkitError
from mbkit.lagrangian.energies.charts import chart_names
from mbkit.lagrangian.energies.energy_form import ROWS
from mbkit.lagrangian.energies.equations_of_motion import EquationsOfMotion, equations_of_motion, printed_equations
from mbkit.lagrangian.printer import Abbreviations, ExpressionPrinter, folded, matrix, spread, written
from mbkit.lagrangian.reduction.quasi_equations import QuasiEquationsOfMotion
from mbkit.lagrangian.system import Lagrangian
from mbkit.load.urdf_reader import Snapper
from mbkit.model import Expression, Model, Parameter
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.parts import rules_of

#: Textbook symbols of arguments whose symbol is not the usual one: argument=symbol, or three symbols of a vector.
_SYMBOLS: Final = {
    "acrobot": "com1=l_c1 com2=l_c2 inertia1=I1 inertia2=I2",
    "cart_pole": "cart_mass=m_c pole_mass=m_p",
    "clamped_beam": "length=L bending_stiffness=EI",
    "flexible_spacecraft": "length=L bending_stiffness=EI hub_mass=m_h hub_inertia=J_x,J_y,J hub_radius=r",
    "free_body": "sides=a,b,c",
    "furuta_pendulum": "arm_length=L arm_mass=m_a arm_com=l_a arm_inertia=J_a "
    "pendulum_mass=m pendulum_com=l pendulum_inertia=J_x,J_y,J_z",
    "gyroscope": "rotor_mass=m rotor_axial=C rotor_across=A offset=l gimbal_mass=m_g "
    "inner_inertia=A_i,B_i,C_i outer_inertia=J_o",
    "slider_crank": "crank=L1 rod=L2 crank_mass=m1 rod_mass=m2 piston_mass=m3",
}
#: Symbols of coordinates that the catalog calls by a word.
_LETTERS: Final = {
    "elastic_pendulum": ("theta", "s"),
    "furuta_pendulum": ("alpha", "theta"),
    "gyroscope": ("alpha", "beta", "gamma"),
}
_LETTER: Final = re.compile(r"([A-Za-z]|alpha|beta|gamma|delta|theta|phi|psi)(_?\d+)?")
_USUAL: Final = {"gravity": "g", "mass": "m", "length": "l", "stiffness": "k", "damping": "d", "inertia": "J"}


def in_symbols(model: Model) -> Model | None:
    """Return a catalog system with a parameter for each argument, at the values of a model; None for other models.

    The values are solved from the model's numbers. An argument of zero stays the number zero.
    """
    system = next((n for n in catalog.systems() if model.name == n or _numbered(model.name, n)), None)
    if system is None or model.bindings:
        return None
    names, numbers = _content(model)
    for size in range(1, model.nv + 1):
        # A system may have another size, or take no parameters; values solved for may be no system's.
        with suppress(MbkitError, TypeError):
            symbolic = _with_parameters(system, size)
            if _content(symbolic)[0] != names:
                continue
            values = _solved(symbolic, model)
            moved = symbolic.with_nominal(values)
            pairs = zip(_content(moved)[1], numbers, strict=True)
            if all(
                np.allclose(x, y, rtol=ROUNDING, atol=ROUNDING * float(np.abs(y).max(initial=0.0))) for x, y in pairs
            ):
                zeros = {name: 0.0 for name, x in values.items() if x == 0.0}
                named = moved.with_parameters(**zeros) if zeros else moved
                # Parts that the catalog's system lacks, such as forces, are the model's own.
                return replace(model, bindings=tuple(b for b in named.bindings if b.where != "frames"))
            return None
    return None


def letters(model: Model) -> list[str] | None:
    """Return names of coordinates that are short enough for equations; None where the model's own are."""
    own = chart_names(model)
    if all(_LETTER.fullmatch(n) for n in own):
        return None
    if model.name in _LETTERS and len(_LETTERS[model.name]) == len(own):
        return list(_LETTERS[model.name])
    # The last part of a name such as hub.x, of a joint with several coordinates, may be a symbol.
    tails = [n.rpartition(".")[2] for n in own]
    known = {t for t in tails if _LETTER.fullmatch(t) and tails.count(t) == 1 and not t.startswith("q")}
    numbers = count(1)
    return [t if t in known else f"q{next(numbers)}" for t in tails]


def with_plain_turns(model: Model, reach: float) -> tuple[Model, str | None]:
    """Return a model whose rotations within `reach` of 0, 1 or -1 are exact, and a note if that changed it.

    A file's 1.57079632679 for π/2 leaves 5e-12 instead of zero, and with it a term in every equation.
    """
    snap = Snapper(reach)
    joints = tuple(
        replace(j, rotation=snap(j.rotation), axes=np.array([snap(axis) for axis in j.axes]).reshape(-1, 3))
        for j in model.joints
    )
    if not snap.count:
        return model, None
    return replace(model, joints=joints), snap.note


def _numbered(name: str, system: str) -> bool:
    return name.startswith(f"{system}_") and name.removeprefix(f"{system}_").isdigit()


def _with_parameters(system: str, size: int) -> Model:
    """Return a catalog system with a parameter for each number; arguments that count parts are the size."""
    function, own = catalog.systems()[system], dict(x.split("=") for x in _SYMBOLS.get(system, "").split())
    arguments: dict[str, Any] = {}
    for name, argument in inspect.signature(function).parameters.items():
        default, symbol = argument.default, own.get(name) or _usual(name)
        if type(default) is int:
            arguments[name] = size
        elif isinstance(default, float):
            arguments[name] = Parameter(symbol, default)
        elif isinstance(default, tuple) and all(isinstance(x, float) for x in default):
            names = symbol.split(",") if name in own else [f"{symbol}_{axis}" for axis in "xyz"]
            arguments[name] = [Parameter(n, x) for n, x in zip(names, default, strict=True)]
    return function(**arguments)


def _usual(name: str) -> str:
    stem = name.rstrip("0123456789")
    return _USUAL.get(stem, stem) + name[len(stem) :]


def _content(model: Model) -> tuple[list[Any], list[Any]]:
    """Return the names, and apart from them the numbers, of what a description's equations hold."""
    names: list[Any] = []
    numbers: list[Any] = [model.gravity]
    for where in ("bodies", "joints", "springs", "couplings", "loops"):
        for part in getattr(model, where):
            values, rules = {f.name: getattr(part, f.name) for f in fields(part)}, rules_of(type(part))
            # Data and what jumps are those of the model.
            own = (f for f, rule in rules.items() if rule.direction or (not rule.fixed and rule.absent is None))
            numbers += [values[f] for f in own if "jump" not in rules[f].does]
            names += [(where, f, x) for f, x in values.items() if f not in rules]
    return names, numbers


def _solved(symbolic: Model, model: Model) -> dict[str, float]:
    """Return the values of parameters that give a model's numbers, as far as they follow from them."""
    values: dict[str, float] = {}
    # Frames move nothing, and a model may be without them.
    left = [(b.expression, _number(model, b)) for b in symbolic.bindings if b.where != "frames"]
    progress = True
    while progress:
        progress = False
        for expression, target in left:
            unknown = {p.name for p in expression.parameters()} - set(values)
            if len(unknown) == 1:
                (name,) = unknown
                at = [_evaluated(expression, {**values, name: x}) for x in (0.0, 1.0, 2.0)]
                slope = at[1] - at[0]
                # Linear expressions only are solved.
                if slope and np.isfinite(at).all() and abs(at[2] - at[1] - slope) <= 1e-9 * abs(slope):
                    values[name], progress = _rounded((target - at[0]) / slope), True
    return values


def _rounded(x: float) -> float:
    """Return the shorter decimal where a number is one to rounding."""
    short = float(f"{x:.12g}")
    return short if abs(short - x) <= ROUNDING * abs(x) else x


def _evaluated(expression: Expression, values: Mapping[str, float]) -> float:
    try:
        return float(expression.evaluate(lambda p: values[p.name], float))
    except ZeroDivisionError:
        return float("nan")


def _number(model: Model, binding: Any) -> float:
    part: Any = model
    if binding.where != "gravity":
        part = next(p for p in getattr(model, binding.where) if p.name == binding.part)
    value = getattr(part, binding.field)
    return float(value[binding.index] if binding.index else value)


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
        out += ["  " + line for x in self._conditions() for line in folded(x, width - 2)]
        if self._kinematics:
            out += ["", "Kinematics:"]
            for row in self._kinematics:
                out += ["  " + line for line in folded(f"{board.text(row.lhs)} = {board.text(row.rhs)}", width - 2)]
        out += ["", *self._conserved(width)]
        return "\n".join(out)

    def _conditions(self, *, latex: bool = False) -> list[str]:
        write = self._board.latex if latex else self._board.text
        return self.equations.conditions(lambda x: write(self._short(x)), latex=latex)

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
        if s.stops:
            out.append(_aligned([f"& {x}" for x in self._conditions(latex=True)]))
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
        out |= {n: [text(x) for x in getattr(s, n)] for n in ROWS}
        # Each equation alone: no letter is explained elsewhere.
        rows = self._equations(Abbreviations((), ()), latex=True)
        out["equations"] = [] if self.long else [f"{text(x.lhs)} = {text(x.rhs)}" for x in e.equations()]
        out["latex"] = [*(f"{left} = {right}" for left, right in rows), *self._conditions(latex=True)]
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

MODULE: Final = Path("python module", "a Python module cannot say of", ALL - {"row", "speed", "stop"})
#: Names that the module itself uses, beside Python's own.
_RESERVED: Final = {"np", "q", "v", "tau", "t", "M", "h", "out", "given", "unknown", "parameters", "PARAMETERS"}
_FUNCTIONS: Final = {"mass_matrix", "nonlinear", "forward_dynamics"}


def python_code(system: Lagrangian, note: str = "") -> str:
    """Return a module with `mass_matrix`, `nonlinear` and `forward_dynamics` of M(q) v̇ + h(q, v) = τ.

    Its functions take one state, and parameters by keyword. Constraints and stops are refused (UnsupportedError).
    `note` says what the equations leave out.
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
