"""Expressions in the order of textbooks: ½ (m₁ + m₂) l₁² θ̇₁² + m₂ l₁ l₂ θ̇₁ θ̇₂ cos(θ₁ - θ₂).

A number comes first, then masses and inertias, g and lengths, coordinates, velocities, accelerations, and cosines last.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, Final

import sympy as sp
from sympy.core.function import Application, AppliedUndef
from sympy.printing.latex import LatexPrinter
from sympy.printing.pretty.pretty_symbology import pretty_symbol

from mbkit._escape import latex, one_line

_FRACTIONS: Final = {(1, 2): "½", (1, 3): "⅓", (1, 4): "¼", (1, 6): "⅙", (1, 8): "⅛", (2, 3): "⅔", (3, 4): "¾"}
_HIGH: Final = str.maketrans("0123456789-/", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻ᐟ")
_MASS: Final = re.compile(r"[mM](\d*|_\w+)")
#: Largest denominator of a fraction that is written as one; others are decimals.
MAX_DENOMINATOR: Final = 10_000
_INERTIA: Final = re.compile(r"[A-CIJ](\d*|_\w+)|EI")


class Printable:
    """A result with `latex()` and `str()`, shown as such by notebooks and in a terminal."""

    def latex(self) -> str:
        """Return LaTeX."""
        raise NotImplementedError

    def _repr_latex_(self) -> str:
        return f"${self.latex()}$"

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {one_line(str(self))}>"


def aligned(pairs: Iterable[tuple[str, str]]) -> str:
    """Return equations as an aligned LaTeX block, from their sides."""
    return "\\begin{aligned}" + r" \\ ".join(f"{left} &= {right}" for left, right in pairs) + "\\end{aligned}"


class ExpressionPrinter:
    """Expressions on one line of text or in LaTeX; `groups` of moving symbols give the order of factors."""

    def __init__(self, *groups: Iterable[sp.Symbol], time: sp.Symbol | None = None) -> None:
        self._moving = {s: k for k, group in enumerate(groups) for s in group}
        #: Velocities, accelerations and momenta: what holds most of them comes first in a sum.
        self._fast = {s: k for s, k in self._moving.items() if k}
        self._time = time

    # Order

    def _rank(self, x: sp.Expr) -> tuple[Any, ...]:
        """Return a factor's sort key: its kind, its place among the coordinates, whether it is Greek, its name."""
        base = x.base if x.is_Pow and x.exp.is_number else x
        if base.is_Number:
            return (0, 0, False, "")
        if base.is_Symbol:
            if base in self._moving:
                return (5 + self._moving[base], list(self._moving).index(base), False, "")
            name = base.name
            kinds = (_MASS.fullmatch(name), _INERTIA.fullmatch(name), name == "g")
            kind = 4.5 if base == self._time else next((k for k, hit in enumerate(kinds, start=1) if hit), 4)
            return (kind, 0, written(name)[0] != name[0], name)
        if base.is_Add:
            inside = [self._rank(s)[0] for s in base.free_symbols]
            parameters = max(inside, default=0) <= 4 and not base.has(sp.sin, sp.cos)
            return (min(inside, default=4) if parameters else 4.7, 0, False, str(base))
        if isinstance(base, (AppliedUndef, sp.Derivative)) and not base.free_symbols & self._moving.keys():
            return (4, 0, False, str(base))
        if isinstance(base, sp.Function):
            return (12, *self._place(base.args[0]), base.func is sp.cos, str(base))
        return (11, 0, False, str(base))

    def _place(self, x: sp.Expr) -> tuple[int, str]:
        """Return the sort key of a function's argument: how many coordinates it holds, and which."""
        order = list(self._moving)
        places = sorted(order.index(s) if s in self._moving else -1 for s in x.free_symbols)
        return len(places), " ".join(f"{k:4d}" for k in places) + str(x)

    def _ordered(self, terms: Iterable[sp.Expr]) -> list[sp.Expr]:
        """Return the terms of a sum, positive ones and those that do not turn first."""

        def key(term: sp.Expr) -> tuple[Any, ...]:
            factors = sp.Mul.make_args(term)
            powers = {b: int(e) if e.is_Integer else 1 for b, e in (f.as_base_exp() for f in factors)}
            speeds = [-powers.get(s, 0) for s in self._fast]
            degree = sum(e for b, e in powers.items() if b.free_symbols & self._fast.keys())
            turned = sorted((*self._place(a.args[0]), str(a)) for a in term.atoms(sp.sin, sp.cos))
            ranks = sorted(self._rank(f) for f in factors if not f.is_Number)
            return (-degree, speeds, len(turned), turned, _signed(term)[0], len(ranks) > 1, ranks, str(term))

        terms = list(terms)
        # A key of many parts, which one term alone does not need.
        out = sorted(terms, key=key) if len(terms) > 1 else terms
        # A sum does not begin with a minus where it need not.
        first = next((t for t in out if not _signed(t)[0]), None)
        if first is not None and _signed(out[0])[0]:
            out.remove(first)
            out.insert(0, first)
        return out

    def _factors(self, x: sp.Expr) -> list[sp.Expr]:
        return sorted(sp.Mul.make_args(x), key=self._rank)

    # Text

    def text(self, x: Any) -> str:
        """Return an expression on one line."""
        return self.text_of([sp.sympify(x)])

    def text_of(self, parts: Iterable[sp.Expr]) -> str:
        """Return a sum on one line, each part in its own order."""
        return self._joined(parts, self._product, "-")

    def _joined(self, parts: Iterable[sp.Expr], written: Callable[[sp.Expr], str], first_minus: str) -> str:
        out = ""
        for term in (term for part in parts if part != 0 for term in self._ordered(sp.Add.make_args(part))):
            minus, size = _signed(term)
            sign = (" - " if minus else " + ") if out else first_minus * minus
            out += sign + written(size)
        return out or "0"

    def _product(self, x: sp.Expr) -> str:
        if x.is_Add:
            return self._atom(x)
        if roots := {f: y for f in sp.Mul.make_args(x) if (y := _absolute(f)) is not None}:
            x = x.xreplace(roots)
        number, rest = x.as_coeff_Mul()
        below = sp.Mul(*(1 / f for f in sp.Mul.make_args(rest) if _below(f)))
        above = sp.Mul(*(f for f in sp.Mul.make_args(rest) if not _below(f)))
        factors = self._factors(above) if above != 1 else []
        parts = [self._atom(f) for f in factors]
        if (size := _number(number)) != "1" or not parts:
            parts.insert(0, size)
        line = " ".join(parts)
        if below == 1:
            return line
        under = self._factors(below)
        bottom = " ".join(self._atom(f) for f in under)
        return f"{line}/{bottom}" if len(under) == 1 else f"{line}/({bottom})"

    def _atom(self, x: sp.Expr) -> str:
        if x.is_Add:
            return f"({self.text(x)})"
        if x.is_Symbol:
            return written(x.name)
        if x.is_Number or x is sp.pi:
            return "π" if x is sp.pi else _number(x)
        if (size := _absolute(x)) is not None:
            return self.text(size)
        if x.is_Pow and x.exp == sp.Rational(1, 2):
            plain = x.base.is_Symbol or x.base.is_Integer
            return f"√{self._atom(x.base)}" if plain else f"√({self.text(x.base)})"
        if x.is_Pow and x.exp.is_Rational:
            high = str(x.exp).translate(_HIGH)
            if isinstance(x.base, (sp.sin, sp.cos, sp.tan)) and x.exp.is_Integer:
                text = self._argument(x.base.args[0])
                return f"{x.base.func.__name__}{high}{'' if text.startswith('(') else ' '}{text}"
            plain = x.base.is_Symbol or x.base.is_Add or isinstance(x.base, sp.Abs)
            return f"{self._atom(x.base) if plain else f'({self.text(x.base)})'}{high}"
        if isinstance(x, sp.Abs):
            return f"|{self.text(x.args[0])}|"
        if isinstance(x, sp.Derivative) and len(x.expr.args) == 1 and x.variables[0] == x.expr.args[0]:
            return f"{written(x.expr.func.__name__)}{'′' * x.derivative_count}({self.text(x.expr.args[0])})"
        if isinstance(x, sp.Subs) and isinstance(x.expr, sp.Derivative) and len(x.point) == len(x.expr.expr.args) == 1:
            name = written(x.expr.expr.func.__name__)
            return f"{name}{'′' * x.expr.derivative_count}({self.text(x.point[0])})"
        if isinstance(x, sp.Piecewise):
            cases = [f"{self.text(y)} if {_compared(c, self)}" if c != sp.true else self.text(y) for y, c in x.args]
            return f"({' else '.join(cases)})"
        if isinstance(x, Application) and len(x.args) > 1:
            name = x.func.__name__.lower() if isinstance(x, (sp.Min, sp.Max)) else x.func.__name__
            return f"{name}({', '.join(map(self.text, x.args))})"
        if isinstance(x, sp.Function):
            space = " " if isinstance(x, (sp.sin, sp.cos, sp.tan)) else ""
            text = self._argument(x.args[0]) if space else f"({self.text(x.args[0])})"
            name = written(x.func.__name__) if isinstance(x, AppliedUndef) else x.func.__name__
            return f"{name}{space if not text.startswith('(') else ''}{text}"
        if x.is_Mul:
            return self._product(x)
        return one_line(str(x))

    def _argument(self, x: sp.Expr) -> str:
        if x.is_Symbol:
            return self._atom(x)
        number, rest = x.as_coeff_Mul()
        letter = self._atom(rest)
        if rest.is_Symbol and number.is_Integer and number > 0 and sum(map(str.isalpha, letter)) == 1:
            return f"{number}{letter}"
        return f"({self.text(x)})"

    # LaTeX

    def latex(self, x: Any) -> str:
        """Return an expression in LaTeX."""
        return self.latex_of([sp.sympify(x)])

    def latex_of(self, parts: Iterable[sp.Expr]) -> str:
        """Return a sum in LaTeX, each part in its own order."""
        printer = _Latex({"order": "none", "full_prec": False, "fold_func_brackets": True})
        return self._joined(parts, lambda x: str(printer.doprint(self._arranged(x))), "- ")

    def _arranged(self, x: sp.Expr) -> sp.Expr:
        """Return an expression whose sums and products are in order, for a printer that keeps it."""
        if x.is_Add:
            return sp.Add(*(self._arranged(t) for t in self._ordered(x.args)), evaluate=False)
        if x.is_Mul:
            return sp.Mul(*(self._arranged(f) for f in self._factors(x)), evaluate=False)
        if (size := _absolute(x)) is not None:
            return self._arranged(size)
        if x.is_Pow:
            return sp.Pow(self._arranged(x.base), x.exp, evaluate=False)
        if isinstance(x, sp.Function) and len(x.args) == 1:
            return x.func(self._arranged(x.args[0]), evaluate=False)
        return x


#: p_theta1, which SymPy leaves as it is: it knows a letter's name alone below the line.
_NUMBERED: Final = re.compile(r"(.+)_([A-Za-z]+)(\d+)")


class _Latex(LatexPrinter):  # type: ignore[misc]
    """SymPy's printer, with ½ in front of a product, and with names that are not TeX escaped."""

    def _print_Symbol(self, expr: sp.Symbol, style: str = "plain") -> str:
        part, name, number = apart(expr.name)
        if part or number:
            return f"{self._print_Symbol(sp.Symbol(part[:-1]))}{part[-1:]}{self._print_Symbol(sp.Symbol(name))}{number}"
        numbered = _NUMBERED.fullmatch(name)
        if numbered and pretty_symbol(numbered[2]) != numbered[2]:
            stem, letter, digits = (self._print_Symbol(sp.Symbol(part), style) for part in numbered.groups())
            return f"{stem}_{{{letter}_{{{digits}}}}}"
        return latex(expr.name, lambda name: str(super(_Latex, self)._print_Symbol(sp.Symbol(name), style)))

    def _needs_function_brackets(self, expr: sp.Expr) -> bool:
        # sin 2 (a + b) may be a product.
        return bool(super()._needs_function_brackets(expr) or (expr.is_Mul and any(f.is_Add for f in expr.args)))

    def _print_Function(self, expr: sp.Function, exp: str | None = None) -> str:
        if not isinstance(expr, AppliedUndef):
            return str(super()._print_Function(expr, exp))
        # Without its bracket J(θ) is a product.
        power = "" if exp is None else f"^{{{exp}}}"
        arguments = ", ".join(map(self._print, expr.args))
        return rf"{self._print(sp.Symbol(expr.func.__name__))}{power}\left({arguments}\right)"

    def _print_Mul(self, expr: sp.Expr) -> str:
        number = expr.args[0]
        if number.is_Rational and number.q != 1 and len(expr.args) > 1 and not any(_below(f) for f in expr.args):
            rest = sp.Mul(*expr.args[1:], evaluate=False) if len(expr.args) > 2 else expr.args[1]
            text = self._print(rest)
            text = rf"\left({text}\right)" if rest.is_Add else text
            return rf"\tfrac{{{number.p}}}{{{number.q}}} {text}"
        return str(super()._print_Mul(expr))


def spread(x: sp.Expr) -> sp.Expr:
    """Return a sum over angles without what its terms share in front: m g l sin θ + m g l sin φ."""
    number, rest = x.as_coeff_Mul()
    sums = [f for f in sp.Mul.make_args(rest) if f.is_Add and f.has(sp.sin, sp.cos)]
    others = [f for f in sp.Mul.make_args(rest) if f not in sums]
    if (
        len(sums) != 1
        or any(f.has(sp.sin, sp.cos) for f in others)
        or not all(t.has(sp.sin, sp.cos) for t in sums[0].args)
    ):
        return x
    return sp.Add(*(sp.Mul(number, *others, term) for term in sums[0].args))


def apart(name: str) -> tuple[str, ...]:
    """Return a name's part, its coordinate, and the number of that: ``"arm."``, ``"wrist"``, ``".1"``."""
    return re.fullmatch(r"((?:.*\.(?!\d+$))?)(.*?)((?:\.\d+)?)", name, flags=re.S).groups()  # type: ignore[union-attr]


def written(name: str) -> str:
    """Return a symbol's name in Unicode: θ̇₁, arm.θ̇₁, ẋ.1; a letter below the line stays behind its mark: m_p."""
    part, name, number = apart(one_line(name))
    stem, mark, index = name.partition("_")
    split = mark and index[:1].isalpha() and stem
    # One letter with its dot where there is such a letter.
    text = f"{pretty_symbol(stem)}_{pretty_symbol(index)}" if split else str(pretty_symbol(name))
    return unicodedata.normalize("NFC", f"{part}{text}{number}")


def _below(x: sp.Expr) -> bool:
    return bool(x.is_Pow and x.exp.is_Rational and x.exp.is_negative)


def _absolute(x: sp.Expr) -> sp.Expr | None:
    """Return the root of even powers as absolute values, which it is of real numbers; None of anything else."""
    if not (x.is_Pow and x.exp.is_Rational and x.exp.q == 2):
        return None
    powers = [f.as_base_exp() for f in sp.Mul.make_args(x.base)]
    if not all(e.is_even for _, e in powers):
        return None
    return sp.Mul(*((b if (e * x.exp).is_even else sp.Abs(b)) ** (e * x.exp) for b, e in powers))


def _signed(x: sp.Expr) -> tuple[bool, sp.Expr]:
    """Return whether a term has a minus in front, and the term without; a sum of negative terms has one."""
    number, rest = x.as_coeff_Mul()
    factors = list(sp.Mul.make_args(rest))
    flipped = bool(number.is_negative)
    for k, f in enumerate(factors):
        if f.is_Add and all(t.as_coeff_Mul()[0].is_negative for t in f.args):
            factors[k], flipped = -f, not flipped
    # SymPy multiplies a number into a sum.
    size = sp.Mul(*factors)
    return flipped, sp.Mul(abs(number), size, evaluate=abs(number) == 1 or not size.is_Add)


def _compared(x: Any, board: ExpressionPrinter) -> str:
    """Return a comparison, or several joined, as text."""
    if isinstance(x, sp.core.relational.Relational):
        return f"{board.text(x.lhs)} {x.rel_op} {board.text(x.rhs)}"
    if isinstance(x, (sp.And, sp.Or)):
        word = " and " if isinstance(x, sp.And) else " or "
        return word.join(f"({_compared(c, board)})" for c in sorted(x.args, key=str))
    if isinstance(x, sp.Not):
        return f"not ({_compared(x.args[0], board)})"
    return one_line(str(x))


def _number(x: sp.Expr) -> str:
    if x.is_Rational and 1 < x.q <= MAX_DENOMINATOR:
        return _FRACTIONS.get((int(x.p), int(x.q)), str(x))
    return str(x) if x.is_Integer or not x.is_Number else f"{float(x):.15g}"


# Text within a width: sums on several lines, matrices in brackets.

#: Dots above letters take no column.
_MARKS: Final = "\u0307\u0308"
_LOW: Final = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def matrix(name: str, A: sp.ImmutableMatrix, text: Callable[[sp.Expr], str], width: int) -> list[str]:
    """Return a matrix in brackets, or its entries one a line where it is too wide."""
    cells = [[text(x) for x in A[i, :]] for i in range(A.rows)]
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
                place = f"{i + 1}{j + 1}" if A.cols < 10 else f"{i + 1},{j + 1}"
                if A.cols == 1:
                    place = str(i + 1) if A.rows > 1 else ""
                equal = f" = {name}{f'{j + 1}{i + 1}'.translate(_LOW)}" if symmetric and i != j and A.cols < 10 else ""
                out += folded(f"  {name}{place.translate(_LOW)}{equal} = {cells[i][j]}", width)
    return out


def _width(text: str) -> int:
    """Return how many columns a text takes: dots above letters take none."""
    return sum(c not in _MARKS for c in text)


def folded(text: str, width: int) -> list[str]:
    """Return a sum on lines of a width, broken before + and - outside of brackets where there are such."""
    out: list[str] = []
    indent = " " * (len(text) - len(text.lstrip()) + 6)
    while _width(text) > width:
        places, depth, column = [], 0, 0
        for k, c in enumerate(text):
            column += c not in _MARKS
            if column > width:
                break
            depth += (c in "([") - (c in ")]")
            if k > len(indent) + 2 and text[k : k + 3] in (" + ", " - ", " = "):
                places.append((depth, -k))
        if not places:
            break
        # The last place on the line that is within the fewest brackets.
        cut = -min(places)[1]
        out.append(text[:cut])
        text = indent + text[cut + 1 :]
    return [*out, text]


# Letters for roots that an equation holds in many places: ρ = √(l² - r² sin² θ).

#: A root gets a letter from this many operations and occurrences on.
_MIN_ROOT_OPERATIONS: Final = 4
_MIN_ROOT_OCCURRENCES: Final = 3


class Abbreviations:
    """Letters for the long roots among some expressions: `roots` holds ρ, or ρ1, ρ2, ..., and what each stands for."""

    def __init__(self, expressions: Iterable[sp.Expr], used: Iterable[sp.Symbol]) -> None:
        counts: Counter[sp.Expr] = Counter()
        roots: set[sp.Expr] = set()
        for x in expressions:
            for part in sp.preorder_traversal(x):
                if part.is_Pow and part.base.is_Add and part.base.count_ops() >= _MIN_ROOT_OPERATIONS:
                    counts[part.base] += 1
                    if part.exp.is_Rational and part.exp.q == 2:
                        roots.add(part.base)
        # They keep the order in which they were met.
        bases = [base for base, n in counts.items() if base in roots and n >= _MIN_ROOT_OCCURRENCES]
        names = {s.name for s in used}
        letter = next(name for name in ("rho", "varrho", "rho_") if name not in names)
        letters = [letter] if len(bases) == 1 else [f"{letter}{k + 1}" for k in range(len(bases))]
        self.roots = {sp.Symbol(name): sp.sqrt(base) for name, base in zip(letters, bases, strict=True)}

    def __call__(self, x: Any) -> Any:
        """Return an expression or a matrix with the letters."""
        for letter, root in self.roots.items():
            base = root.base
            x = x.replace(lambda e, base=base: e.is_Pow and e.base == base, lambda e, s=letter: s ** (2 * e.exp))
        return x
