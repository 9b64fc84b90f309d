"""Numbers of printed formulas: reads what mbkit prints, in text or LaTeX, and shares no code with it."""

from __future__ import annotations

import operator
import re
import unicodedata
from collections.abc import Callable, Mapping

import numpy as np

_FRACTIONS = {"½": 1 / 2, "⅓": 1 / 3, "¼": 1 / 4, "⅙": 1 / 6, "⅛": 1 / 8, "⅔": 2 / 3, "¾": 3 / 4}
_HIGH = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻ᐟ", "0123456789-/")
_FUNCTIONS: dict[str, Callable[..., float]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "exp": np.exp, "log": np.log, "sign": np.sign, "acos": np.arccos,
    "asin": np.arcsin, "atan": np.arctan, "atan2": np.arctan2, "sqrt": np.sqrt, "tanh": np.tanh, "min": min, "max": max,
}  # fmt: skip
#: Comparisons of a formula by cases, in text and in LaTeX.
_COMPARED: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le, ">=": operator.ge, "leq": operator.le, "geq": operator.ge, "!=": operator.ne, "neq": operator.ne,
    "==": operator.eq, "<": operator.lt, ">": operator.gt, "=": operator.eq,
}  # fmt: skip
_CASES = re.compile(
    r"\\begin\{cases\} (.*?) & \\text\{for\}\\:(.*?)\\\\(.*?) & \\text\{otherwise\} \\end\{cases\}",
)
_NUMBER = r"\d+\.?\d*(?:e[-+]?\d+)?"
_TOKEN = re.compile(rf"{_NUMBER}|[A-Za-z]\w*(?:\.\w+)*|[⁰¹²³⁴⁵⁶⁷⁸⁹⁻ᐟ]+|[<>=!]=|\S", re.ASCII)
_GREEK = (
    "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi omicron pi rho sigma tau upsilon phi chi "
    "psi omega"
)
_LETTERS = dict(zip("αβγδεζηθικλμνξοπρστυφχψω", _GREEK.split(), strict=True))
_ENDS = {"(": ")", "{": "}", "|": "|", "[": "]"}
_JOINED: dict[str, Callable[[bool, bool], bool]] = {
    "and": operator.and_, "wedge": operator.and_, "or": operator.or_, "vee": operator.or_,
}  # fmt: skip
_AFTER = {*"+-)}|,]<>", *_COMPARED, *_JOINED, "if", "else", ""}


def plain(text: str) -> str:
    """Return a formula with names in ASCII, as of a symbol: ``q1``, ``jddot0``, ``tau2``, and without backslashes."""
    text = unicodedata.normalize("NFD", text.replace(r"\text{NaN}", "nan")).translate(
        str.maketrans("₀₁₂₃₄₅₆₇₈₉", "0123456789") | {ord(k): x for k, x in _LETTERS.items()}
    )
    for mark, word in (("\u0307", "dot"), ("\u0308", "ddot")):
        text = re.sub(rf"([A-Za-z]+){mark}", rf"\1{word}", text)
    text = re.sub(r"\\(d+ot)\{\\?(\w+)\}", r"\2\1", text)
    text = re.sub(r"\\operatorname\{(\w+)\}(?:_\{(\d)\})?", r" \1\2 ", text)
    text = re.sub(r"\\t?frac", "@", re.sub(r"\\(left|right|cdot)\b", " ", text))
    text = re.sub(r"_\{(\w+)\}", r"\1", text).replace("\\", "")
    return re.sub(r"\be\^", "E^", text)


class _Reader:
    def __init__(self, text: str, values: Mapping[str, float]) -> None:
        self.tokens, self.at, self.values = [*_TOKEN.findall(plain(text)), ""], 0, values

    @property
    def next(self) -> str:
        return self.tokens[self.at]

    def eat(self, *some: str) -> str:
        if (x := self.next) in some:
            self.at += 1
            return x
        return ""

    def sum(self) -> float:
        out, sign = 0.0, self.eat("-", "+")
        while True:
            out += -self.product() if sign == "-" else self.product()
            if not (sign := self.eat("-", "+")):
                return out

    def product(self) -> float:
        out = self.power()
        while self.next not in _AFTER:
            if self.eat("/"):
                out /= self.power()
            else:
                self.eat("*")
                out *= self.power()
        return out

    def exponent(self) -> float | None:
        if self.eat("^"):
            return self.atom()
        if self.next[:1] not in {*"⁰¹²³⁴⁵⁶⁷⁸⁹⁻"}:
            return None
        above, _, below = self.next.translate(_HIGH).partition("/")
        self.at += 1
        return float(above) / float(below or 1)

    def power(self) -> float:
        out, n = self.atom(), self.exponent()
        return out if n is None else out**n

    def group(self, start: str) -> float:
        out = self.sum()
        if self.eat("if"):
            holds = self.holds()
            assert self.eat("else")
            other = self.sum()
            out = out if holds else other
        assert self.eat(_ENDS[start]), self.tokens[self.at - 9 : self.at + 9]
        return abs(out) if start == "|" else out

    def holds(self) -> bool:
        out = self.one_holds()
        while word := self.eat(*_JOINED):
            out = _JOINED[word](out, self.one_holds())
        return out

    def one_holds(self) -> bool:
        if self.eat("not", "neg"):
            return not self.one_holds()
        start = self.at
        if self.eat("("):
            # Around a condition, or around a sum that is compared.
            try:
                out = self.holds()
                if self.eat(")") and self.next not in _COMPARED:
                    return out
            except KeyError:
                pass
            self.at = start
        left, how, right = self.sum(), self.eat(*_COMPARED), self.sum()
        return _COMPARED[how](left, right)

    def arguments(self) -> list[float]:
        wrapped = bool(self.eat("{"))
        if self.eat("("):
            out = [self.sum()]
            while self.eat(","):
                out.append(self.sum())
            assert self.eat(")")
        elif wrapped:
            out = [self.sum()]
        else:
            number = self.atom() if self.next[0].isdigit() else 1.0
            out = [number * self.atom()]
        assert not wrapped or self.eat("}")
        return out

    def atom(self) -> float:
        x = self.next
        self.at += 1
        if x in _ENDS:
            return self.group(x)
        if x in _FRACTIONS:
            return _FRACTIONS[x]
        if x[0].isdigit():
            return float(x)
        if x == "nan":
            return np.nan
        if x == "@":
            return self.atom() / self.atom()
        if x == "√":
            return float(np.sqrt(self.atom()))
        if x in self.values:
            return self.values[x]
        n = self.exponent()
        out = np.e if x == "E" else np.pi if x == "pi" else float(_FUNCTIONS[x](*self.arguments()))
        return float(out if n is None else out**n)


def number(text: str, values: Mapping[str, float]) -> float:
    """Return the number of a formula where its symbols have these values."""
    reader = _Reader(text, values)
    out = reader.sum()
    assert not reader.next, reader.tokens[reader.at :]
    return out


def lines_of_latex(latex: str) -> list[str]:
    """Return the equations of an aligned block, with cases as in text."""
    body = latex[latex.index("{aligned}") + 9 : latex.rindex("\\end{aligned}")]
    while _CASES.search(body):
        body = _CASES.sub(r"(\1 if \2 else \3)", body)
    return body.replace("&=", "=").split(r"\\ ")


def lines_of_text(text: str) -> list[str]:
    """Return the equations of printed text, whose long ones go on in further lines."""
    return [x for x in re.sub(r"\n {2,}", " ", text).splitlines() if " = " in x]


def assigned(lines: list[str], values: Mapping[str, float]) -> dict[str, float]:
    """Return all values after lines such as ``x = a + b``, each of which may use those before."""
    out = dict(values)
    for line in lines:
        name, _, formula = line.partition("=")
        out[plain(name).strip()] = number(formula, out)
    return out
