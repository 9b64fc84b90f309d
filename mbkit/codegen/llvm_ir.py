"""Writing LLVM's textual code for vectors of doubles."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Final

from mbkit.codegen.program import Program


def number(x: float) -> str:
    """Return a double in every lane, as LLVM writes it without loss."""
    return f"splat (double 0x{struct.pack('>d', x).hex().upper()})"


def declarations(width: int) -> str:
    """Return the declarations of the intrinsics that `Text` calls."""
    V = f"<{width} x double>"
    unary = "\n".join(f"declare {V} @llvm.{name}.v{width}f64({V})" for name in ("rint", "fabs", "sqrt"))
    return f"{unary}\ndeclare {V} @llvm.fma.v{width}f64({V}, {V}, {V})\n"


class Text:
    """Lines of one function, each with a name of its own for its result."""

    def __init__(self, width: int, prefix: str = "t") -> None:
        self.width = width
        self.vector = f"<{width} x double>"
        self.lines: list[str] = []
        self._prefix = prefix
        self._count = 0

    def put(self, code: str) -> str:
        """Append an instruction and return the name of its result."""
        self._count += 1
        name = f"%{self._prefix}{self._count}"
        self.lines.append(f"  {name} = {code}")
        return name

    def do(self, code: str) -> None:
        """Append an instruction without a result."""
        self.lines.append(f"  {code}")

    def op(self, name: str, a: str, b: str, flags: str = "") -> str:
        """Append a binary instruction."""
        return self.put(f"{name} {flags}{self.vector} {a}, {b}")

    def neg(self, a: str) -> str:
        """Append -a."""
        return self.put(f"fneg {self.vector} {a}")

    def call(self, name: str, a: str) -> str:
        """Append a call of a unary intrinsic."""
        return self.put(f"call {self.vector} @llvm.{name}.v{self.width}f64({self.vector} {a})")

    def fma(self, a: str, b: str, c: str) -> str:
        """Append a b + c with one rounding."""
        V = self.vector
        return self.put(f"call {V} @llvm.fma.v{self.width}f64({V} {a}, {V} {b}, {V} {c})")

    def compare(self, how: str, a: str, b: str) -> str:
        """Append a comparison: a bit in every lane."""
        return self.put(f"fcmp {how} {self.vector} {a}, {b}")

    def bits(self, name: str, a: str, b: str) -> str:
        """Append a logical operation on bits."""
        return self.put(f"{name} <{self.width} x i1> {a}, {b}")

    def select(self, which: str, yes: str, no: str) -> str:
        """Append a choice of each lane by its bit."""
        return self.put(f"select <{self.width} x i1> {which}, {self.vector} {yes}, {self.vector} {no}")


# Sine and cosine of a whole vector.
#
# Reduction by Cody and Waite with π/2 in three parts: the first difference is exact in a fused multiply-add, the second
# by Knuth's exact sum, so that the reduced angle has twice the working precision. On [-π/4, π/4] the minimax
# polynomials of Ng's ``__kernel_sin`` and ``__kernel_cos`` (Sun's fdlibm, 1993) take that tail into account. Measured
# against 70 digits: at most 0.76 ulp below `LIMIT`, next to multiples of π/2 too; beyond it a lane takes the C
# library's value. Its neighbours keep theirs: no state's bits depend on what stands beside it.
#
# The function's name is not the C library's ``sincos``, which LLVM may call for a sine
# and a cosine of one angle, and which it would take ours for.

#: Angles above this in absolute value are left to the C library, rad.
LIMIT: Final = 1e8

#: π/2 = the sum of these to 161 bits.
_HALF_PI: Final = (1.5707963267948966, 6.123233995736766e-17, -1.4973849048591833e-33)
_SIN: Final = (
    -1.66666666666666324348e-01,
    8.33333333332248946124e-03,
    -1.98412698298579493134e-04,
    2.75573137070700676789e-06,
    -2.50507602534068634195e-08,
    1.58969099521155010221e-10,
)
_COS: Final = (
    4.16666666666666019037e-02,
    -1.38888888888741095749e-03,
    2.48015872894767294178e-05,
    -2.75573143513906633035e-07,
    2.08757232129817482790e-09,
    -1.13596475577881948265e-11,
)


def sincos(width: int) -> str:
    """Return LLVM code of ``@mbkit_sincos``: a vector of angles -> {sines, cosines}."""
    t = Text(width)
    V, Q, B = t.vector, f"<{width} x i64>", f"<{width} x i1>"
    half_pi = [number(x) for x in _HALF_PI]

    turns = t.call("rint", t.op("fmul", "%x", number(0.6366197723675814)))
    back = t.neg(turns)
    r0 = t.fma(back, half_pi[0], "%x")
    # r0 minus the second part, exactly: near a multiple of π/2 hardly a digit is left.
    middle = t.op("fmul", turns, half_pi[1])
    below = t.fma(turns, half_pi[1], t.neg(middle))
    first = t.op("fsub", r0, middle)
    moved = t.op("fsub", first, r0)
    lost = t.op("fsub", t.op("fsub", r0, t.op("fsub", first, moved)), t.op("fadd", middle, moved))
    rest = t.fma(back, half_pi[2], t.op("fsub", lost, below))
    r = t.op("fadd", first, rest)
    tail = t.op("fadd", t.op("fsub", first, r), rest)
    z = t.op("fmul", r, r)

    high = number(_SIN[5])
    for c in _SIN[4:0:-1]:
        high = t.fma(high, z, number(c))
    cube = t.op("fmul", z, r)
    low = t.op("fsub", t.op("fmul", number(0.5), tail), t.op("fmul", cube, high))
    low = t.fma(z, low, t.neg(tail))
    sine = t.op("fsub", r, t.fma(t.neg(cube), number(_SIN[0]), low))

    high = number(_COS[5])
    for c in _COS[4::-1]:
        high = t.fma(high, z, number(c))
    half = t.op("fmul", number(0.5), z)
    head = t.op("fsub", number(1.0), half)
    lost = t.op("fsub", t.op("fsub", number(1.0), head), half)
    low = t.fma(z, t.op("fmul", high, z), t.neg(t.op("fmul", r, tail)))
    cosine = t.op("fadd", head, t.op("fadd", lost, low))

    # The quadrant decides which is which, and the signs.
    quadrant = t.put(f"fptosi {V} {turns} to {Q}")
    odd = t.put(f"trunc {Q} {quadrant} to {B}")
    after = t.put(f"add {Q} {quadrant}, splat (i64 1)")
    results = []
    for q, yes, no in ((quadrant, cosine, sine), (after, sine, cosine)):
        sign = t.put(f"shl {Q} {t.put(f'and {Q} {q}, splat (i64 2)')}, splat (i64 62)")
        chosen = t.put(f"select {B} {odd}, {V} {yes}, {V} {no}")
        bits = t.put(f"xor {Q} {t.put(f'bitcast {V} {chosen} to {Q}')}, {sign}")
        results.append(t.put(f"bitcast {Q} {bits} to {V}"))
    pair = f"{{ {V}, {V} }}"
    out = t.put(f"insertvalue {pair} poison, {V} {results[0]}, 0")
    out = t.put(f"insertvalue {pair} {out}, {V} {results[1]}, 1")
    fast = "\n".join(t.lines)

    s = Text(width, prefix="s")
    sines = cosines = f"{V} poison"
    for lane in range(width):
        x = s.put(f"extractelement {V} %x, i64 {lane}")
        sines = f"{V} " + s.put(f"insertelement {sines}, double {s.put(f'call double @sin(double {x})')}, i64 {lane}")
        cosines = f"{V} " + s.put(
            f"insertelement {cosines}, double {s.put(f'call double @cos(double {x})')}, i64 {lane}"
        )
    both = [s.put(f"select {B} %far, {far}, {V} {near}") for far, near in zip((sines, cosines), results, strict=True)]
    slow_out = s.put(f"insertvalue {pair} poison, {V} {both[0]}, 0")
    slow_out = s.put(f"insertvalue {pair} {slow_out}, {V} {both[1]}, 1")
    slow = "\n".join(s.lines)
    return f"""
declare double @sin(double) nounwind willreturn memory(none)
declare double @cos(double) nounwind willreturn memory(none)
declare i1 @llvm.vector.reduce.or.v{width}i1({B})

define internal {pair} @mbkit_sincos({V} %x) noinline nounwind willreturn memory(none) {{
  %size = call {V} @llvm.fabs.v{width}f64({V} %x)
  %far = fcmp ugt {V} %size, {number(LIMIT)}
  %any = call i1 @llvm.vector.reduce.or.v{width}i1({B} %far)
{fast}
  br i1 %any, label %slow, label %done
done:
  ret {pair} {out}
slow:
{slow}
  ret {pair} {slow_out}
}}
"""


# Functions of whole vectors that call the C library lane by lane.
#
# A lane depends on its own number alone. An exponential or a logarithm takes three times as long as a sine of `sincos`,
# the others ten times. No error of glibc's is known above 2.5 ulps, nor above 1 but for hyperbolic functions.

#: Operation, which is its name in C too -> number of arguments.
CALLS: Final = {
    **dict.fromkeys(("tan", "asin", "acos", "atan", "exp", "expm1", "log", "log1p"), 1),
    **dict.fromkeys(("sinh", "cosh", "tanh", "asinh", "acosh", "atanh"), 1),
    **dict.fromkeys(("atan2", "pow", "hypot"), 2),
}


def library(width: int, *programs: Program) -> str:
    """Return LLVM code of the functions that programs call, each once."""
    used = {o.name for p in programs for o in p.operations}
    return "\n".join([sincos(width), *(_lanes(width, name, n) for name, n in CALLS.items() if name in used)])


def call(text: Text, name: str, arguments: list[str]) -> str:
    """Append a call of one of `CALLS`, and return the name of its result."""
    operands = ", ".join(f"{text.vector} {a}" for a in arguments)
    return text.put(f"call {text.vector} @mbkit_{name}({operands})")


def _lanes(width: int, name: str, arguments: int) -> str:
    t = Text(width)
    V, result = t.vector, "poison"
    for lane in range(width):
        each = [t.put(f"extractelement {V} %x{i}, i64 {lane}") for i in range(arguments)]
        value = t.put(f"call double @{name}({', '.join(f'double {x}' for x in each)})")
        result = t.put(f"insertelement {V} {result}, double {value}, i64 {lane}")
    parameters = ", ".join(f"{V} %x{i}" for i in range(arguments))
    attributes = "nounwind willreturn memory(none)"
    body = "\n".join(t.lines)
    return f"""
declare double @{name}({", ".join(["double"] * arguments)}) {attributes}

define internal {V} @mbkit_{name}({parameters}) noinline {attributes} {{
{body}
  ret {V} {result}
}}
"""


# Operations of a program that are no calls.

_ZERO: Final = number(0.0)
_ONE: Final = number(1.0)
_Operation = Callable[..., str]


def _contracted(instruction: str) -> _Operation:
    return lambda t, a, b: t.op(instruction, a, b, "contract ")


def _comparison(how: str) -> _Operation:
    return lambda t, a, b: t.select(t.compare(how, a, b), _ONE, _ZERO)


def _logical(how: str) -> _Operation:
    return lambda t, a, b: t.select(t.bits(how, t.compare("une", a, _ZERO), t.compare("une", b, _ZERO)), _ONE, _ZERO)


def _least(how: str) -> _Operation:
    # NaN is propagated.
    return lambda t, a, b: t.select(t.bits("or", t.compare(how, a, b), t.compare("uno", a, a)), a, b)


def _sign(t: Text, a: str) -> str:
    negative = t.select(t.compare("olt", a, _ZERO), number(-1.0), a)
    return t.select(t.compare("ogt", a, _ZERO), _ONE, negative)


#: Operation -> function that appends it to a text, and returns the name of its result.
OPERATIONS: Final[dict[str, _Operation]] = {
    **{name: _contracted(f"f{name}") for name in ("add", "sub", "mul", "div")},
    **{name: _comparison(how) for name, how in (("lt", "olt"), ("le", "ole"), ("eq", "oeq"), ("ne", "une"))},
    "and": _logical("and"),
    "or": _logical("or"),
    "fmin": _least("olt"),
    "fmax": _least("ogt"),
    "sq": lambda t, a: t.op("fmul", a, a, "contract "),
    "twice": lambda t, a: t.op("fadd", a, a, "contract "),
    "inv": lambda t, a: t.op("fdiv", _ONE, a),
    "neg": Text.neg,
    "sqrt": lambda t, a: t.call("sqrt", a),
    "fabs": lambda t, a: t.call("fabs", a),
    "sign": _sign,
    "not": lambda t, a: t.select(t.compare("oeq", a, _ZERO), _ONE, _ZERO),
    "if_else_zero": lambda t, a, b: t.select(t.compare("une", a, _ZERO), b, _ZERO),
}
