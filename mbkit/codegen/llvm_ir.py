"""Writing LLVM's textual code for vectors of doubles."""

from __future__ import annotations

import itertools
import struct
from collections.abc import Callable
from functools import cached_property, partial
from typing import Final

import mpmath

from mbkit.codegen.program import Program
from mbkit.model.elements.formula import completed


def _hex(x: float) -> str:
    return f"0x{struct.pack('>d', x).hex().upper()}"


def number(x: float) -> str:
    """Return a double in every lane, as LLVM writes it without loss."""
    return f"splat (double {_hex(x)})"


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

    def op(self, name: str, a: str, b: str) -> str:
        """Append a binary instruction."""
        return self.put(f"{name} {self.vector} {a}, {b}")

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

    @cached_property
    def operations(self) -> dict[str, Callable[..., str]]:
        """What appends each operation of a program that is no call, and returns the name of its result."""
        compared = {"lt": "olt", "le": "ole", "eq": "oeq", "ne": "une"}
        conditions = {name: partial(self.compare, how) for name, how in compared.items()}
        conditions |= {name: partial(self.bits, name) for name in ("and", "or")}
        own: dict[str, Callable[..., str]] = {
            name: partial(self.op, f"f{name}") for name in ("add", "sub", "mul", "div")
        }
        own |= {name: partial(self.call, name) for name in ("sqrt", "fabs")}
        own |= {"neg": self.neg, "fma": self.fma}
        own["fms"] = lambda a, b, c: self.fma(a, b, self.neg(c))
        own["fnma"] = lambda a, b, c: self.fma(self.neg(a), b, c)
        return completed(own, number, self.select, conditions)


# Sine and cosine of a whole vector.
#
# Reduction by Cody and Waite with π/2 in three parts: the first difference is exact in a fused multiply-add, the second
# by Knuth's exact sum, so that the reduced angle has twice the working precision. Beyond
# `MAX_REDUCED_ANGLE` a lane is reduced by
# Payne and Hanek's method (1983), with as many bits of 2/π as its exponent asks for. On [-π/4, π/4] the minimax
# polynomials of Ng's ``__kernel_sin`` and ``__kernel_cos`` (Sun's fdlibm, 1993) take the tail into account. Measured
# against 70 digits: at most 0.76 ulp, next to multiples of π/2 too. No library is called, so that every processor gives
# the same bits; and no lane's depend on what stands beside it.
#
# The function's name is not the C library's ``sincos``, which LLVM may call for a sine
# and a cosine of one angle, and which it would take ours for.

#: Angles above this in absolute value are reduced with more bits of 2/π, rad.
MAX_REDUCED_ANGLE: Final = 1e8

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


def sincos(width: int, attributes: str = "noinline") -> str:
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
    near = t.op("fadd", first, rest)
    near_tail = t.op("fadd", t.op("fsub", first, near), rest)
    near_quadrant = t.put(f"fptosi {V} {turns} to {Q}")
    reduction = "\n".join(t.lines)

    s = Text(width, prefix="s")
    kinds = (f"<{width} x double>", f"<{width} x double>", Q)
    sums = list(zip(kinds, (near, near_tail, near_quadrant), strict=True))
    for lane in range(width):
        x = s.put(f"extractelement {V} %x, i64 {lane}")
        far = s.put(f"extractelement {B} %far, i64 {lane}")
        found = s.put(f"call {_FAR} @mbkit_far(double {x})")
        for i, (kind, held) in enumerate(sums):
            entry = kind.split(" x ")[1][:-1]
            own = s.put(f"extractelement {kind} {held}, i64 {lane}")
            new = s.put(f"select i1 {far}, {entry} {s.put(f'extractvalue {_FAR} {found}, {i}')}, {entry} {own}")
            sums[i] = kind, s.put(f"insertelement {kind} {held}, {entry} {new}, i64 {lane}")
    distant = "\n".join(s.lines)

    p = Text(width, prefix="p")
    r, tail, quadrant = (
        p.put(f"phi {kind} [{here}, %entry], [{there}, %distant]")
        for (kind, there), here in zip(sums, (near, near_tail, near_quadrant), strict=True)
    )
    z = p.op("fmul", r, r)
    high = number(_SIN[5])
    for c in _SIN[4:0:-1]:
        high = p.fma(high, z, number(c))
    cube = p.op("fmul", z, r)
    low = p.op("fsub", p.op("fmul", number(0.5), tail), p.op("fmul", cube, high))
    low = p.fma(z, low, p.neg(tail))
    sine = p.op("fsub", r, p.fma(p.neg(cube), number(_SIN[0]), low))

    high = number(_COS[5])
    for c in _COS[4::-1]:
        high = p.fma(high, z, number(c))
    half = p.op("fmul", number(0.5), z)
    head = p.op("fsub", number(1.0), half)
    lost = p.op("fsub", p.op("fsub", number(1.0), head), half)
    low = p.fma(z, p.op("fmul", high, z), p.neg(p.op("fmul", r, tail)))
    cosine = p.op("fadd", head, p.op("fadd", lost, low))

    # The quadrant decides which is which, and the signs.
    odd = p.put(f"trunc {Q} {quadrant} to {B}")
    after = p.put(f"add {Q} {quadrant}, splat (i64 1)")
    out, pair = "poison", f"{{ {V}, {V} }}"
    for i, (q, yes, no) in enumerate(((quadrant, cosine, sine), (after, sine, cosine))):
        sign = p.put(f"shl {Q} {p.put(f'and {Q} {q}, splat (i64 2)')}, splat (i64 62)")
        chosen = p.put(f"select {B} {odd}, {V} {yes}, {V} {no}")
        bits = p.put(f"xor {Q} {p.put(f'bitcast {V} {chosen} to {Q}')}, {sign}")
        out = p.put(f"insertvalue {pair} {out}, {V} {p.put(f'bitcast {Q} {bits} to {V}')}, {i}")
    polynomials = "\n".join(p.lines)
    return f"""
declare i1 @llvm.vector.reduce.or.v{width}i1({B})
{_far()}
define internal {pair} @mbkit_sincos({V} %x) {attributes} nounwind willreturn memory(none) {{
entry:
  %size = call {V} @llvm.fabs.v{width}f64({V} %x)
  %far = fcmp ugt {V} %size, {number(MAX_REDUCED_ANGLE)}
  %any = call i1 @llvm.vector.reduce.or.v{width}i1({B} %far)
{reduction}
  br i1 %any, label %distant, label %done
distant:
{distant}
  br label %done
done:
{polynomials}
  ret {pair} {out}
}}
"""


_FAR: Final = "{ double, double, i64 }"
#: Words of 64 bits of 2/π that the largest double asks for, behind one of zeros.
_TWO_OVER_PI_WORDS: Final = 20


def _two_over_pi() -> list[int]:
    bits = 64 * _TWO_OVER_PI_WORDS
    with mpmath.workprec(bits + 64):
        digits = int(mpmath.floor(mpmath.ldexp(2 / mpmath.pi, bits)))
    return [0, *(digits >> (bits - 64 * (i + 1)) & (2**64 - 1) for i in range(_TWO_OVER_PI_WORDS))]


def _far() -> str:
    """Return LLVM code of the reduction of one large angle: rest, its tail, and number of quarter turns.

    |x| = m 2^e, and 2/π from the bit of weight 4 2^-e on, 192 of them, times m is the angle in full turns: bits before
    are whole turns. 128 of its bits are enough: no double is nearer than 2^-62 quarter turns to a whole number of them
    (Muller et al., Handbook of Floating-Point Arithmetic, 2nd ed. 2018, section 10.2).
    """
    words = _two_over_pi()
    table = (
        f"@mbkit_two_over_pi = internal constant [{len(words)} x i64] [{', '.join(f'i64 {_signed(w)}' for w in words)}]"
    )
    t = Text(1)

    def op(code: str) -> str:
        return t.put(code)

    def wide(x: str) -> str:
        return op(f"zext i64 {x} to i128")

    def low(x: str) -> str:
        return op(f"trunc i128 {x} to i64")

    def high(x: str) -> str:
        return low(op(f"lshr i128 {x}, 64"))

    bits = op("bitcast double %x to i64")
    e = op(f"and i64 {op(f'lshr i64 {bits}, 52')}, 2047")
    m = op(f"or i64 {op(f'and i64 {bits}, {2**52 - 1}')}, {2**52}")
    # e - 1075 is the exponent of m; from the bit behind that of weight 4 on, and behind the 64 zeros.
    start = op(f"add i64 {e}, {64 - 2 - 1075}")
    # Neighbours in a vector may be small.
    start = op(f"call i64 @llvm.smax.i64(i64 {start}, i64 0)")
    word, shift = op(f"lshr i64 {start}, 6"), op(f"and i64 {start}, 63")
    loaded = []
    for i in range(4):
        at = op(f"getelementptr i64, ptr @mbkit_two_over_pi, i64 {op(f'add i64 {word}, {i}')}")
        loaded.append(op(f"load i64, ptr {at}, align 8"))
    f = [op(f"call i64 @llvm.fshl.i64(i64 {a}, i64 {b}, i64 {shift})") for a, b in itertools.pairwise(loaded)]
    last, middle, top = (op(f"mul i128 {wide(m)}, {wide(x)}") for x in reversed(f))
    above = op(f"add i128 {middle}, {wide(high(last))}")
    first = op(f"add i64 {low(top)}, {high(above)}")
    whole = op(f"or i128 {op(f'shl i128 {wide(first)}, 64')}, {wide(low(above))}")
    # Now 126 bits behind two of quarter turns; the nearest whole number of these.
    rest = op(f"shl i128 {whole}, 2")
    rest = op(f"or i128 {rest}, {wide(op(f'lshr i64 {low(last)}, 62'))}")
    up = op(f"icmp slt i128 {rest}, 0")
    quarters = op(f"add i64 {op(f'lshr i64 {first}, 62')}, {op(f'zext i1 {up} to i64')}")
    size = op(f"select i1 {up}, i128 {op(f'sub i128 0, {rest}')}, i128 {rest}")
    # Three parts that are doubles, to a sum of two.
    parts = []
    for drop, n in ((85, 43), (42, 43), (0, 42)):
        part = op(f"and i64 {low(op(f'lshr i128 {size}, {drop}'))}, {2**n - 1}")
        parts.append(op(f"fmul double {op(f'uitofp i64 {part} to double')}, {_hex(2.0 ** (drop - 128))}"))

    def summed(a: str, b: str) -> tuple[str, str]:
        total = op(f"fadd double {a}, {b}")
        return total, op(f"fsub double {b}, {op(f'fsub double {total}, {a}')}")

    head, back = summed(parts[0], parts[1])
    head, back = summed(head, op(f"fadd double {back}, {parts[2]}"))
    fma = "call double @llvm.fma.f64"
    product = op(f"fmul double {head}, {_hex(_HALF_PI[0])}")
    error = op(f"{fma}(double {head}, double {_hex(_HALF_PI[0])}, double {op(f'fneg double {product}')})")
    error = op(f"{fma}(double {head}, double {_hex(_HALF_PI[1])}, double {error})")
    error = op(f"{fma}(double {back}, double {_hex(_HALF_PI[0])}, double {error})")
    r, tail = summed(product, error)
    negative = op(f"icmp slt i64 {bits}, 0")
    signs = op(f"select i1 {op(f'xor i1 {negative}, {up}')}, double -1.0, double 1.0")
    # NaN of infinity and NaN.
    void = op("fsub double %x, %x")
    r = op(f"fadd double {op(f'fmul double {r}, {signs}')}, {void}")
    tail = op(f"fmul double {tail}, {signs}")
    turned = op(f"select i1 {negative}, i64 {op(f'sub i64 0, {quarters}')}, i64 {quarters}")
    out = op(f"insertvalue {_FAR} poison, double {r}, 0")
    out = op(f"insertvalue {_FAR} {out}, double {tail}, 1")
    out = op(f"insertvalue {_FAR} {out}, i64 {turned}, 2")
    body = "\n".join(t.lines)
    return f"""
{table}
declare i64 @llvm.fshl.i64(i64, i64, i64)
declare i64 @llvm.smax.i64(i64, i64)
declare double @llvm.fma.f64(double, double, double)

define internal {_FAR} @mbkit_far(double %x) noinline nounwind willreturn memory(none) {{
{body}
  ret {_FAR} {out}
}}
"""


def _signed(word: int) -> int:
    return word - 2**64 if word >= 2**63 else word


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
