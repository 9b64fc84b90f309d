"""Equations of a robot as a short program of named terms: s1, c2, x7, ... in place of a thousand lines of sums.

It is the program that engines compile, from link to link (`mbkit.derivation.link_equations`): a term that is used once
stands where it is used, and all others have a name.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from itertools import count
from typing import Any, Final

import sympy as sp
from sympy.printing.c import C99CodePrinter
from sympy.printing.numpy import NumPyPrinter

from mbkit._escape import c_comment, identifier, one_line, python_docstring, terminal
from mbkit.codegen.c_source import C_CODE
from mbkit.codegen.program import Operation
from mbkit.codegen.program import program as operations_of
from mbkit.derivation import FUNCTIONS, equations_of
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.lagrangian.elements import SYMPY
from mbkit.lagrangian.energies.symbols import free_name
from mbkit.lagrangian.printer import ExpressionPrinter, Printable, aligned, folded
from mbkit.model import Model
from mbkit.model.elements.kinds import that_do

PROGRAM: Final = replace(C_CODE, name="program", words="program: not known of")
#: Operations of a term from which on it gets a name of its own: a line of text has some 100 letters.
_MIN_NAMED_OPERATIONS: Final = 10
TEXT_WIDTH: Final = 100
_PRINTED_DIGITS: Final = 6
#: Keywords of C, and functions that its lines call.
_C_WORDS: Final = {*C99CodePrinter().reserved_words, *(SYMPY.operations.keys() & dir(math)), "fmin", "fmax"}

_Inputs = tuple[tuple[str, tuple[sp.Symbol, ...]], ...]


@dataclass(frozen=True, repr=False)
class ProgramText(Printable):
    """A quantity as named terms, the result of `mbkit.lagrangian.program`.

    Attributes
    ----------
    model, quantity : str
    operations : int
        Arithmetic ones of the program; a sine counts as one.
    inputs : tuple of (str, tuple of sympy.Symbol)
        Each argument with the symbols of its entries.
    terms : tuple of (sympy.Symbol, sympy.Expr)
        Named terms in the order in which they are computed.
    results : sympy.Matrix
        The quantity, in named terms.
    note : str
        What holds joints at rest, or at stops, in no term, and where constraints hold; empty without all of these.
    """

    model: str
    quantity: str
    operations: int
    inputs: _Inputs
    terms: tuple[tuple[sp.Symbol, sp.Expr], ...]
    results: sp.ImmutableMatrix
    note: str = ""

    def _pairs(self) -> list[tuple[sp.Symbol, sp.Expr]]:
        """Return the terms, then the entries of the result; of a symmetric matrix those from the diagonal on."""
        rows, columns = self.results.shape
        symmetric = columns > 1 and self.results == self.results.T
        out = list(self.terms)
        for i in range(rows):
            for j in range(i if symmetric else 0, columns):
                place = "" if rows == columns == 1 else f"{i + 1}" + (f"_{j + 1}" if columns > 1 else "")
                out.append((sp.Symbol(f"{self.quantity}{'_' if place else ''}{place}"), self.results[i, j]))
        return out

    def __str__(self) -> str:
        board, lines = ExpressionPrinter(), []
        for left, right in self._pairs():
            lines += folded(f"{left} = {board.text(_rounded(right))}", TEXT_WIDTH)
        head = f"{self.quantity} of {self.model}: {self.operations} operations, {len(self.terms)} named terms"
        notes = [f"note: {one_line(self.note)}"] if self.note else []
        return terminal("\n".join([f"{one_line(head)}; numbers to {_PRINTED_DIGITS} digits", *notes, *lines]))

    def latex(self) -> str:
        """Return an aligned LaTeX block, numbers to 6 digits."""
        board = ExpressionPrinter()
        names = {left: sp.Symbol(str(left).replace("_", "")) for left, _ in self._pairs()[len(self.terms) :]}
        note = f"% {one_line(self.note)}\n" if self.note else ""
        pairs = ((board.latex(names.get(left, left)), board.latex(_rounded(x))) for left, x in self._pairs())
        return note + aligned(pairs)

    def python(self) -> str:
        """Return a Python module with one function, which needs NumPy only; numbers have all their digits."""
        code = NumPyPrinter({"fully_qualified_modules": True}).doprint
        lines = [f"    {', '.join(map(str, entries))}, = {name}" for name, entries in self.inputs]
        lines += [f"    {left} = {code(right)}" for left, right in self.terms]
        rows, columns = self.results.shape
        cells = [f"[{', '.join(code(x) for x in self.results[i, :])}]" for i in range(rows)]
        cells = [code(x) for x in self.results] if columns == 1 else cells
        result = code(self.results[0]) if rows == columns == 1 else f"np.array([{', '.join(cells)}])"
        lines.append(f"    return {result}")
        arguments = ", ".join(name for name, _ in self.inputs)
        head = f'"""{self.quantity} of {python_docstring(self.model)}, in SI units; needs NumPy only."""'
        body = "\n".join(lines).replace("numpy.", "np.")
        about = f"{self.operations} operations{'; ' * bool(self.note)}{python_docstring(self.note)}."
        head += "\n\nimport functools" if "functools." in body else ""
        return f'{head}\n\nimport numpy as np\n\n\ndef {self.quantity}({arguments}):\n    """{about}"""\n{body}\n'

    def c(self) -> str:
        """Return a C99 function ``void quantity(const double q[], ..., double out[])``; matrices by rows."""
        printer = C99CodePrinter()
        arguments = ", ".join(f"const double {name}_[]" for name, _ in self.inputs)
        lines = [f"const double {x} = {name}_[{k}];" for name, entries in self.inputs for k, x in enumerate(entries)]
        lines += [f"const double {left} = {printer.doprint(right)};" for left, right in self.terms]
        lines += [f"out[{k}] = {printer.doprint(x)};" for k, x in enumerate(self.results)]
        body = "\n".join(f"    {line}" for line in lines)
        note = f"/* {c_comment(self.note)} */\n" if self.note else ""
        return f"{note}#include <math.h>\n\nvoid {self.quantity}({arguments}, double out[])\n{{\n{body}\n}}\n"


def _rounded(x: sp.Expr) -> sp.Expr:
    short = {f: float(f"{float(f):.{_PRINTED_DIGITS}g}") for f in x.atoms(sp.Float)}
    # A product keeps a factor 1.0, and drops 1.
    return x.xreplace({f: sp.Integer(int(y)) if abs(y) == 1 else sp.Float(y) for f, y in short.items()})


def program(model: Model, quantity: str = "inverse_dynamics") -> ProgramText:
    """Return the equations of a model as a program of named terms, to read, in Python, LaTeX and C.

    Parameters
    ----------
    model : Model
        Any robot or system; one of named parameters keeps their names.
    quantity : str
        A key of `mbkit.lagrangian.FUNCTIONS`, such as ``"inverse_dynamics"``, ``"forward_dynamics"`` or
        ``"mass_matrix"``.

    Raises
    ------
    UnknownNameError
        Another quantity.
    UnsupportedError
        The model has no joint that moves; a quantity of several results.

    Examples
    --------
    >>> import mbkit as mb
    >>> text = mb.lagrangian.program(mb.load("ur5"), "gravity")
    >>> text.operations < 120, text.results.shape
    (True, (6, 1))
    """
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {type(model).__name__}; one of T and V is its .model")
    if not isinstance(quantity, str) or quantity not in FUNCTIONS:
        raise UnknownNameError("quantity", str(quantity), FUNCTIONS)
    notes = PROGRAM.admit(model)
    if not model.nv:
        raise UnsupportedError(f"program: {model.name} has no joint that moves")
    function = equations_of(model).function(quantity)
    operations = operations_of(function)
    if len(operations.outputs) > 1:
        raise UnsupportedError(f"program: {quantity} has {len(operations.outputs)} results; expected a quantity of one")
    inputs, used = _inputs(function, model)
    named = dict(inputs)
    uses = Counter(j for o in operations.operations if o.name != "input" for j in o.arguments)
    uses.update(int(j) for out in operations.outputs for j in out.ravel())
    known, terms = list[sp.Expr](), list[tuple[sp.Symbol, sp.Expr]]()

    def called(x: sp.Expr, name: str) -> sp.Symbol:
        symbol = sp.Symbol(free_name(name, used))
        used.add(symbol.name)
        terms.append((symbol, x))
        return symbol

    numbered = count(1)
    for k, o in enumerate(operations.operations):
        x = _expression(o, known, [named[name] for name, _ in inputs])
        turned = isinstance(x, (sp.sin, sp.cos)) and x.args[0] in named.get("q", ())
        if turned:
            x = called(x, f"{'s' if isinstance(x, sp.sin) else 'c'}{named['q'].index(x.args[0]) + 1}")
        elif not x.is_Atom and not (-x).is_Atom and (uses[k] > 1 or x.count_ops() >= _MIN_NAMED_OPERATIONS):
            x = called(x, f"x{next(numbered)}")
        known.append(x)
    (shape,), (out,) = operations.shapes, operations.outputs
    results = sp.ImmutableMatrix(*shape, lambda i, j: known[int(out[i, j])])
    jumps = model.acts.keys() & {*that_do("jump")} - {*that_do("stop")}
    if jumps and all(o.name != "sign" for o in operations.operations):
        notes = PROGRAM.admit(model.without(*jumps))
    return ProgramText(model.name, quantity, operations.arithmetic, inputs, tuple(terms), results, "; ".join(notes))


def _inputs(function: Any, model: Model) -> tuple[_Inputs, set[str]]:
    """Return the symbols of each argument, and the names that are taken."""
    out, used = list[tuple[str, tuple[sp.Symbol, ...]]](), {"out", "np", *_C_WORDS}
    used |= {f"{name}_" for name in function.name_in()}
    for i, name in enumerate(function.name_in()):
        numbered = [f"{name}{k + 1}" for k in range(function.size1_in(i))]
        names = list(model.parameters) if name == "parameters" else numbered
        entries = []
        for entry in names:
            entries.append(sp.Symbol(identifier(entry, used)))
            used.add(entries[-1].name)
        out.append((name, tuple(entries)))
    return tuple(out), used


def _expression(o: Operation, known: list[sp.Expr], inputs: list[tuple[sp.Symbol, ...]]) -> sp.Expr:
    if o.name == "input":
        return inputs[o.arguments[0]][o.arguments[1]]
    if o.name == "const" and math.isnan(o.value):
        return sp.nan
    if o.name == "const":
        return sp.Integer(int(o.value)) if o.value == int(o.value) and abs(o.value) < 1e6 else sp.Float(o.value, 17)
    return sp.sympify(SYMPY.operations[o.name](*(known[j] for j in o.arguments)))
