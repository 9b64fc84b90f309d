"""Functions of whole vectors, as LLVM code that calls the C library lane by lane.

What a lane gets depends on its own number alone, as with `mbkit.derivation.sincos`. An
exponential or a logarithm takes three times as long as a sine of `sincos`, the others ten
times. No error of glibc's is known above 2.5 ulps, nor above 1 but for hyperbolic functions.
"""

from __future__ import annotations

from typing import Final

from mbkit.derivation.llvm_text import Text
from mbkit.derivation.program import Program
from mbkit.derivation.sincos import sincos

__all__ = ["CALLS", "call", "library"]

#: Operation, which is its name in C too -> number of arguments.
CALLS: Final = {
    "tan": 1,
    "asin": 1,
    "acos": 1,
    "atan": 1,
    "exp": 1,
    "expm1": 1,
    "log": 1,
    "log1p": 1,
    "sinh": 1,
    "cosh": 1,
    "tanh": 1,
    "asinh": 1,
    "acosh": 1,
    "atanh": 1,
    "atan2": 2,
    "pow": 2,
    "hypot": 2,
}


def library(width: int, *programs: Program) -> str:
    """Return LLVM code of the functions that programs call, each once."""
    used = {o.name for p in programs for o in p.operations}
    return "\n".join([sincos(width), *(_lanes(width, name, n) for name, n in CALLS.items() if name in used)])


def call(text: Text, name: str, arguments: list[str]) -> str:
    """Append a call of one of `CALLS`, and return the name of its result."""
    given = ", ".join(f"{text.vector} {a}" for a in arguments)
    return text.put(f"call {text.vector} @mbkit_{name}({given})")


def _lanes(width: int, name: str, arguments: int) -> str:
    t = Text(width)
    V, made = t.vector, "poison"
    for lane in range(width):
        each = [t.put(f"extractelement {V} %x{i}, i64 {lane}") for i in range(arguments)]
        value = t.put(f"call double @{name}({', '.join(f'double {x}' for x in each)})")
        made = t.put(f"insertelement {V} {made}, double {value}, i64 {lane}")
    taken = ", ".join(f"{V} %x{i}" for i in range(arguments))
    told = "nounwind willreturn memory(none)"
    body = "\n".join(t.lines)
    return f"""
declare double @{name}({", ".join(["double"] * arguments)}) {told}

define internal {V} @mbkit_{name}({taken}) noinline {told} {{
{body}
  ret {V} {made}
}}
"""
