"""A program as the body of a C99 function.

CasADi can write C of its own, but with a dozen exported symbols a function, names
that clash between two models, and work arrays that the caller has to bring. One
straight run of assignments needs none of that.
"""

from __future__ import annotations

import heapq
import math
import textwrap
from collections.abc import Sequence
from typing import Final

from mbkit.derivation.program import Program

__all__ = ["c_body", "places", "variables"]

#: Functions of math.h.
_OF_ONE: Final = (
    *("fabs", "sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "exp", "expm1", "log", "log1p"),
    *("sinh", "cosh", "tanh", "asinh", "acosh", "atanh"),
)
_OF_TWO: Final = ("atan2", "pow", "hypot")
_FORMS: Final = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "sq": "{0} * {0}",
    "twice": "2.0 * {0}",
    "inv": "1.0 / {0}",
    **{name: f"{name}({{0}})" for name in _OF_ONE},
    **{name: f"{name}({{0}}, {{1}})" for name in _OF_TWO},
    "sign": "{0} > 0.0 ? 1.0 : {0} < 0.0 ? -1.0 : {0}",
    # Not C's own, which pass over what is no number.
    "fmin": "{0} < {1} || {0} != {0} ? {0} : {1}",
    "fmax": "{0} > {1} || {0} != {0} ? {0} : {1}",
    "lt": "(double)({0} < {1})",
    "le": "(double)({0} <= {1})",
    "eq": "(double)({0} == {1})",
    "ne": "(double)({0} != {1})",
    "not": "(double)({0} == 0.0)",
    "and": "(double)({0} != 0.0 && {1} != 0.0)",
    "or": "(double)({0} != 0.0 || {1} != 0.0)",
    "if_else_zero": "{0} != 0.0 ? {1} : 0.0",
}


def places(program: Program) -> list[int | None]:
    """Return in which local variable each operation's value is kept, None for those written in place.

    A variable is taken again when its last reader has run, which keeps the stack small
    even where a compiler does not optimise. Constants and entries of the arguments are
    written where they are read. An entry that goes unchanged to the output is kept
    all the same, so that the output may lie over an argument.
    """
    results = {int(index) for out in program.outputs for index in out.flat}
    last = {}
    for k, operation in enumerate(program.operations):
        if operation.name != "input":
            for argument in operation.arguments:
                last[argument] = k
    where: list[int | None] = []
    free: list[int] = []
    count = 0
    for k, operation in enumerate(program.operations):
        if operation.name == "const" or (operation.name == "input" and k not in results):
            where.append(None)
            continue
        if operation.name != "input":
            for argument in set(operation.arguments):
                held = where[argument]
                if last[argument] == k and argument not in results and held is not None:
                    heapq.heappush(free, held)
        if free:
            where.append(heapq.heappop(free))
        else:
            where.append(count)
            count += 1
    return where


def c_body(program: Program, inputs: Sequence[str], outputs: Sequence[str]) -> list[str]:
    """Return the lines between a function's braces.

    Parameters
    ----------
    program : Program
    inputs, outputs : sequence of str
        Name of each argument's array of doubles; outputs are filled column after column.
    """
    where = places(program)
    texts: list[str] = []
    lines: list[str] = []
    for operation, place in zip(program.operations, where, strict=True):
        if operation.name == "const":
            text = _literal(operation.value)
        elif operation.name == "input":
            which, entry = operation.arguments
            text = f"{inputs[which]}[{entry}]"
        else:
            text = _FORMS[operation.name].format(*(texts[i] for i in operation.arguments))
        if place is not None:
            lines.append(f"t{place} = {text};")
            text = f"t{place}"
        texts.append(text)
    for name, out in zip(outputs, program.outputs, strict=True):
        lines += [f"{name}[{k}] = {texts[int(index)]};" for k, index in enumerate(out.ravel(order="F"))]
    read = {o.arguments[0] for o in program.operations if o.name == "input"}
    unread = [f"(void){name};" for k, name in enumerate(inputs) if k not in read]
    return [*_declaration(variables(where)), *unread, *lines]


def variables(where: Sequence[int | None]) -> int:
    """Return how many local variables `places` takes."""
    return max((place for place in where if place is not None), default=-1) + 1


def _declaration(count: int) -> list[str]:
    if not count:
        return []
    names = ", ".join(f"t{k}" for k in range(count))
    return textwrap.wrap(f"double {names};", width=96, subsequent_indent="    ")


def _literal(value: float) -> str:
    if math.isnan(value):
        return "NAN"
    if math.isinf(value):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    # The shortest digits that give the same double back.
    return repr(value) if math.copysign(1.0, value) > 0 else f"({value!r})"
