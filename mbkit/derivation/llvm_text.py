"""Writing LLVM's textual code for vectors of doubles."""

from __future__ import annotations

import struct

__all__ = ["Text", "declarations", "number"]


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
