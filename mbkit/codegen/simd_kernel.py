"""LLVM code that runs a `Program` on several states at once, one in each lane.

The function written has the signature ::

    void body(double **in, int64 *in_strides, double **out, int64 *out_strides, double *work)

Entry j of argument i is the vector at ``in[i] + j * in_strides[i]``; entries of an
output count along the rows. Nothing is reordered, and only what the program says is fused.

The first vector of the work space gathers 0 times the numbers read and returned: it
stays zero in a lane until one of them is not finite, whether a graph reads it or not.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from mbkit._check import by_key
from mbkit.codegen.llvm_ir import CALLS, Text, call, declarations, library, number
from mbkit.codegen.program import Program

BODY: Final = "mbkit_body"
#: LLVM's time to compile one block grows faster than its length, most of all with
#: what it stores. A program heavier than _MAX_WHOLE_OPERATIONS is compiled in pieces of _PIECE_OPERATIONS.
_MAX_WHOLE_OPERATIONS: Final = 20000
_PIECE_OPERATIONS: Final = 1000
_STORE_OPERATIONS: Final = 4  # weight of a store, in operations
_ARGUMENTS: Final = "ptr noalias %in, ptr noalias %is, ptr noalias %out, ptr noalias %os, ptr noalias %work"
#: Operations that can be finite where an argument is not: 1/inf, exp(-inf), atan(inf), NaN to the power of 0.
_HIDING: Final = frozenset(
    {"div", "inv", "sign", "fmin", "fmax", "not", "if_else_zero", "lt", "le", "eq", "ne", "and", "or"}
    | {"exp", "expm1", "tanh", "atan", "atan2", "pow"}
)
_CALLED: Final = frozenset({"sin", "cos", *CALLS})


def vector_code(program: Program, width: int) -> tuple[str, int]:
    """Return LLVM code of a program, and how many vectors of work space it needs."""
    pieces = pieces_of(program)
    written = [Piece(program, piece, width) for piece in pieces]
    slots = slots_of(program, pieces)
    for k, piece in enumerate(written):
        piece.write(slots, first=k == 0)
    zeros = _zeros(program, width)
    if len(written) == 1 and not zeros:
        functions = [written[0].function(BODY, "")]
    else:
        functions = [p.function(f"{BODY}_{k}") for k, p in enumerate(written)]
        calls = [f"  call void @{BODY}_{k}({_ARGUMENTS.replace('noalias ', '')})" for k in range(len(written))]
        calls += [f"  call void @{BODY}_zeros(ptr %out, ptr %os)"] if zeros else []
        functions += [zeros, "\n".join([f"define void @{BODY}({_ARGUMENTS}) nounwind {{", *calls, "  ret void\n}\n"])]
    text = "\n".join([declarations(width), library(width, program), *functions])
    return text, max(slots.values(), default=0) + 1


def pieces_of(program: Program) -> list[list[int]]:
    """Split the operations, in their order, into the pieces that are compiled as one function each."""
    stored: dict[int, int] = {}
    for out in program.outputs:
        for k in out.ravel().tolist():
            stored[k] = stored.get(k, 0) + 1
    order = [k for k, o in enumerate(program.operations) if o.name not in ("input", "const")]
    ends = np.cumsum([1 + _STORE_OPERATIONS * stored.get(k, 0) for k in order])
    if not order or ends[-1] <= _MAX_WHOLE_OPERATIONS:
        return [order]
    cuts = np.searchsorted(ends, np.arange(_PIECE_OPERATIONS, ends[-1], _PIECE_OPERATIONS)).tolist()
    return [order[a:b] for a, b in zip([0, *cuts], [*cuts, len(order)], strict=True) if a < b]


def _zeros(program: Program, width: int) -> str:
    """Return the function that stores zeros, if there are any: mass matrices of trees are full of them."""
    t = Text(width, prefix="z")
    tables = []
    for i, out in enumerate(program.outputs):
        places = [j for j, k in enumerate(out.ravel().tolist()) if _is_zero(program, k)]
        if not places:
            continue
        tables.append(
            f"@{BODY}_zeros_{i} = internal constant [{len(places)} x i64] [{', '.join(f'i64 {j}' for j in places)}]"
        )
        base = t.put(f"load ptr, ptr {t.put(f'getelementptr ptr, ptr %out, i64 {i}')}, align 8")
        stride = t.put(f"load i64, ptr {t.put(f'getelementptr i64, ptr %os, i64 {i}')}, align 8")
        before = f"%before{i}"
        t.lines += [f"  br label {before}", f"before{i}:", f"  br label %loop{i}", f"loop{i}:"]
        t.lines.append(f"  %k{i} = phi i64 [0, {before}], [%next{i}, %loop{i}]")
        place = t.put(f"load i64, ptr {t.put(f'getelementptr i64, ptr @{BODY}_zeros_{i}, i64 %k{i}')}, align 8")
        at = t.put(f"getelementptr double, ptr {base}, i64 {t.put(f'mul i64 {stride}, {place}')}")
        t.do(f"store {t.vector} zeroinitializer, ptr {at}, align 8")
        t.lines += [f"  %next{i} = add i64 %k{i}, 1", f"  %more{i} = icmp ult i64 %next{i}, {len(places)}"]
        t.lines += [f"  br i1 %more{i}, label %loop{i}, label %after{i}", f"after{i}:"]
    if not tables:
        return ""
    lines = "\n".join([*t.lines, "  ret void"])
    head = f"define internal void @{BODY}_zeros(ptr %out, ptr %os) noinline nounwind {{\n{lines}\n}}\n"
    return "\n".join([*tables, head])


def _is_zero(program: Program, k: int) -> bool:
    return program.operations[k].name == "const" and program.operations[k].value == 0.0


def _seen(program: Program) -> set[tuple[int, ...]]:
    """Return the entries of the arguments whose NaN or infinity shows in some result.

    An entry that is read shows where no operation hides it; one that is itself a result shows because results are
    watched.
    """
    if any(o.name in _HIDING for o in program.operations):
        return set()
    return {o.arguments for o in program.operations if o.name == "input"}


def slots_of(program: Program, pieces: list[list[int]]) -> dict[int, int]:
    """Return the place in the work space of each value that another piece reads."""
    at = {k: n for n, piece in enumerate(pieces) for k in piece}
    last: dict[int, int] = {}
    for n, piece in enumerate(pieces):
        for k in piece:
            for j in program.operations[k].arguments:
                if j in at and at[j] != n:
                    last[j] = n
    free: list[int] = []
    slots: dict[int, int] = {}
    ending: dict[int, list[int]] = {}
    size = 1  # after the vector that finds numbers that are not finite
    for n, piece in enumerate(pieces):
        for k in piece:
            if k in last:
                if not free:
                    free.append(size)
                    size += 1
                slots[k] = free.pop()
                ending.setdefault(last[k], []).append(k)
        free += [slots[k] for k in ending.pop(n, [])]
    return slots


class Piece:
    """One function over a run of operations."""

    def __init__(self, program: Program, piece: list[int], width: int) -> None:
        self._program, self._own, self._text = program, piece, Text(width, prefix="v")
        self._names: dict[int, str] = {}
        self._pairs: dict[int, str] = {}
        self._pointers: dict[tuple[str, str, int], str] = {}
        self._watched: list[str] = []
        stored = ((k, (i, j)) for i, out in enumerate(program.outputs) for j, k in enumerate(out.ravel().tolist()))
        self._stored = by_key(stored)
        self._outputs = {k: places for k, places in self._stored.items() if not _is_zero(program, k)}

    def store_zeros(self) -> None:
        """Store zeros like everything else, and not by a function of their own."""
        self._outputs = self._stored

    def write(self, slots: dict[int, int], *, first: bool) -> None:
        """Write every operation of this piece, each result to where it is wanted."""
        operations = self._program.operations
        if first:
            seen = _seen(self._program)
            entries = ((i, j) for i, size in enumerate(self._program.inputs) for j in range(size))
            self._watched += [self._load(self._place("in", "is", *at)) for at in entries if at not in seen]
        # A call spills live values: functions of inputs come first, when few are live.
        free = {k for k, o in enumerate(operations) if o.name in ("input", "const")}
        early = [k for k in self._own if operations[k].name in _CALLED and free.issuperset(operations[k].arguments)]
        for k in [*early, *self._own]:
            if k in self._names:
                continue
            self._names[k] = self._operation(k, slots)
            if k in slots:
                self._store(self._names[k], self._work(slots[k]))
            self._give(k)
        # Outputs that are inputs or numbers belong to no piece.
        for k in self._outputs if first else ():
            if k in free:
                self._value(k, slots)
                self._give(k)
        self._watch()

    def _watch(self) -> None:
        """Add 0 times all numbers read and written to the vector that finds those that are not finite."""
        total = self._load("%work")
        for name in self._watched:
            total = self._text.fma(name, number(0.0), total)
        self._store(total, "%work")

    def _give(self, k: int) -> None:
        places = self._outputs.get(k, [])
        for i, j in places:
            self._store(self._names[k], self._place("out", "os", i, j))
        operation = self._program.operations[k]
        if places and not (operation.name == "const" and math.isfinite(operation.value)):
            self._watched.append(self._names[k])

    def _load(self, pointer: str) -> str:
        return self._text.put(f"load {self._text.vector}, ptr {pointer}, align 8")

    def _store(self, value: str, pointer: str) -> None:
        self._text.do(f"store {self._text.vector} {value}, ptr {pointer}, align 8")

    def _place(self, arrays: str, strides: str, i: int, j: int) -> str:
        t = self._text
        if (arrays, "p", i) not in self._pointers:
            for key, kind, source in (("p", "ptr", arrays), ("s", "i64", strides)):
                at = t.put(f"getelementptr {kind}, ptr %{source}, i64 {i}")
                self._pointers[arrays, key, i] = t.put(f"load {kind}, ptr {at}, align 8")
        offset = t.put(f"mul i64 {self._pointers[arrays, 's', i]}, {j}")
        return t.put(f"getelementptr inbounds double, ptr {self._pointers[arrays, 'p', i]}, i64 {offset}")

    def _work(self, slot: int) -> str:
        return self._text.put(f"getelementptr {self._text.vector}, ptr %work, i64 {slot}")

    def _value(self, k: int, slots: dict[int, int]) -> str:
        """Return the name of a value, fetched if another piece made it."""
        if k not in self._names:
            o = self._program.operations[k]
            if o.name == "const":
                self._names[k] = number(o.value)
            else:
                at = self._place("in", "is", *o.arguments) if o.name == "input" else self._work(slots[k])
                self._names[k] = self._load(at)
        return self._names[k]

    def _operation(self, k: int, slots: dict[int, int]) -> str:
        o, t = self._program.operations[k], self._text
        a = [self._value(j, slots) for j in o.arguments]
        if o.name in ("sin", "cos"):
            x, pair = o.arguments[0], f"{{ {t.vector}, {t.vector} }}"
            if x not in self._pairs:
                self._pairs[x] = t.put(f"call {pair} @mbkit_sincos({t.vector} {a[0]})")
            return t.put(f"extractvalue {pair} {self._pairs[x]}, {int(o.name == 'cos')}")
        return call(t, o.name, a) if o.name in CALLS else t.operations[o.name](*a)

    def function(self, name: str, linkage: str = "internal") -> str:
        """Return this piece's text."""
        return self._function(f"{linkage} void @{name}({_ARGUMENTS})")

    def _function(self, head: str) -> str:
        # Vectors put aside on a stack that is aligned to 16 bytes only would lie across cache lines.
        lines = "\n".join(self._text.lines)
        attributes = f"noinline nounwind alignstack({8 * self._text.width})"
        return f"define {head} {attributes} {{\n{lines}\n  ret void\n}}\n"
