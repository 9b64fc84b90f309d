"""Sine and cosine of a whole vector, as LLVM code.

Reduction by Cody and Waite with π/2 in three parts: the first difference is exact in
a fused multiply-add, the second by Knuth's exact sum, so that the reduced angle has
twice the working precision. On [-π/4, π/4] the minimax polynomials of Ng's
``__kernel_sin`` and ``__kernel_cos`` (Sun's fdlibm, 1993) take that tail into
account. Measured against 70 digits: at most 0.76 ulp below `LIMIT`, next to multiples
of π/2 too; beyond it a lane takes the C library's value. Its neighbours keep theirs:
no state's bits depend on what stands beside it.

The function's name is not the C library's ``sincos``, which LLVM may call for a sine
and a cosine of one angle, and which it would take ours for.
"""

from __future__ import annotations

from typing import Final

from mbkit.derivation.llvm_text import Text, number

__all__ = ["LIMIT", "sincos"]

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
    sines, cosines = (
        s.put(f"select {B} %far, {far}, {V} {near}") for far, near in zip((sines, cosines), results, strict=True)
    )
    slow_out = s.put(f"insertvalue {pair} poison, {V} {sines}, 0")
    slow_out = s.put(f"insertvalue {pair} {slow_out}, {V} {cosines}, 1")
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
