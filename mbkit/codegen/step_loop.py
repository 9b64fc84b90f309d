"""Parts of a step run round after round on a few states side by side, in one piece of machine code.

A single state uses one lane of a vector, and a loop around each part would cost as much as the parts. So all that the
parts read and write has a fixed place in one array, the arena, and the loop over rounds is compiled with them: a
function that stands several times among the parts, the forward dynamics, is compiled once and called. Vectors are of
four numbers, which for one state are faster than eight: shorter divisions and roots, and less to keep aside.

The function has the signature ::

    void run(double *arena, int64 *ways, int64 first, int64 last)

Every round it fetches the rows of the state from ``ways[0] + round * ways[1]``, runs the parts, and copies the rows of
the new state to ``ways[2] + round * bytes``. The number of rounds done is left in ``ways[3]``: all, or as many as were
made before no lane of the new state's last row was other than zero, if ``ways[4]`` asks to look.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import accumulate, pairwise
from typing import Any, Final
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit._version import __version__
from mbkit.codegen import disk_cache as disk
from mbkit.codegen import jit
from mbkit.codegen.batch_loop import RUN
from mbkit.codegen.compiled import aligned
from mbkit.codegen.llvm_ir import declarations, library
from mbkit.codegen.program import Program, program
from mbkit.codegen.simd_kernel import Piece, pieces_of, slots_of
from mbkit.derivation.fingerprint import SOURCES
from mbkit.derivation.steps.fixed import Part

_NAME: Final = "mbkit_part"


def width() -> int:
    """Return the number of states side by side."""
    return min(4, jit.host().width)


class CompiledStepLoop:
    """The machine code of parts, `loaded`, and where everything is in the arena.

    `rows` has the first row and number of rows of each name that the parts read or write; the arena has `size` rows,
    each with a number for each lane. `operations` are the scalar ones of one round.
    """

    def __init__(self, about: dict[str, Any], code: bytes) -> None:
        self.rows = {name: (int(a), int(n)) for name, (a, n) in about["rows"].items()}
        self.size = int(about["size"])
        self.operations = int(about["operations"])
        self.loaded = jit.load(code)


class Arena:
    """The numbers of a compiled step loop, in rows with one for each lane, and its calls.

    `state` are the rows with which a round ends, of the names from which the next one starts; `at` is where each is
    among these.
    """

    def __init__(self, code: CompiledStepLoop, names: Sequence[str]) -> None:
        self.code, rows = code, code.rows
        self._numbers = aligned(code.size * width()).reshape(code.size, width())
        self._numbers[:] = 0.0
        first = rows[f"{names[0]}1"][0]
        self.at = {name: slice(rows[f"{name}1"][0] - first, sum(rows[f"{name}1"]) - first) for name in names}
        self.state = self._numbers[first : first + sum(rows[name][1] for name in names)]
        self._ways = np.zeros(5, dtype=np.int64)

    def __getitem__(self, name: str) -> Array:
        start, count = self.code.rows[name]
        return self._numbers[start : start + count]

    def run(self, source: Array, log: Array, rounds: int, *, on: bool) -> int:
        """Run rounds and return how many; `on` from the state that the last one left, else from one each."""
        self._ways[:] = source.ctypes.data, 0 if on else self.state.nbytes, log.ctypes.data, 0, on
        self.code.loaded.run(self._numbers.ctypes.data, self._ways.ctypes.data, 0, rounds)
        return int(self._ways[3])


def compiled_step_loop(
    name: Sequence[str], make: Callable[[], Sequence[Part]], state: Sequence[str]
) -> CompiledStepLoop:
    """Return machine code of parts: kept in this process, from disk, or derived by `make` and compiled now.

    `name` is all that the parts depend on but the code of mbkit. Parts of one name are one function. `state` has the
    names at the start of a round; the last part writes these names with a 1 behind, in this order.
    """
    key = disk.key_of("lanes", *name, __version__, ca.CasadiMeta.version(), SOURCES, *map(str, (*jit.host(), width())))
    return disk.cached(key, _HELD, CompiledStepLoop, lambda: _compile(make(), state))


_HELD: Final[WeakValueDictionary[str, CompiledStepLoop]] = WeakValueDictionary()


def _compile(parts: Sequence[Part], state: Sequence[str]) -> tuple[dict[str, Any], bytes]:
    makers = {part.name: part.make for part in parts}
    programs = {name: jit.host().lowered(program(make())) for name, make in makers.items()}
    rows, size = _rows(parts, programs, state)
    written = {part.name: _function(part, programs[part.name], rows, size) for part in parts}
    size += max(work for _, work in written.values())
    calls = [f"  call void @{_NAME}_{p.name}(ptr %arena, ptr %out_{p.writes[0]})" for p in parts]
    first, count = rows[state[0]][0], sum(rows[name][1] for name in state)
    round_ = _round(calls, {p.writes[0]: rows[p.writes[0]][0] for p in parts}, (first, rows[f"{state[0]}1"][0], count))
    text = "\n".join(
        [declarations(width()), library(width(), *programs.values()), *(text for text, _ in written.values()), round_]
    )
    operations = sum(programs[part.name].arithmetic for part in parts)
    return {"rows": rows, "size": size, "operations": operations}, jit.object_code(text)


def _rows(
    parts: Sequence[Part], programs: dict[str, Program], state: Sequence[str]
) -> tuple[dict[str, tuple[int, int]], int]:
    """Return a place for every name: what a part writes, one after another; and the number of rows."""
    sizes: dict[str, int] = {}
    order: list[str] = [*state]
    for part in parts:
        sizes.update(zip(part.reads, programs[part.name].inputs, strict=True))
        sizes.update(zip(part.writes, (r * c for r, c in programs[part.name].shapes), strict=True))
        order += part.writes
    for name in state:
        # A row that is only handed on may have no reader.
        sizes.setdefault(name, sizes[f"{name}1"])
    order += [name for part in parts for name in part.reads]
    order = list(dict.fromkeys(order))
    starts = [0, *accumulate(sizes[name] for name in order)]
    rows = {name: (start, sizes[name]) for name, start in zip(order, starts, strict=False)}
    for part in parts:
        places = [rows[name] for name in part.writes]
        if any(a + n != b for (a, n), (b, _) in pairwise(places)):
            raise ValueError(f"part {part.name!r}: what it writes is written elsewhere in another order")
    return rows, starts[-1]


def _function(part: Part, code: Program, rows: dict[str, tuple[int, int]], size: int) -> tuple[str, int]:
    """Return the code of one part, a function of the arena and of where its results go, and its rows of work space."""
    pieces = pieces_of(code)
    slots = slots_of(code, pieces)
    names = [f"{_NAME}_{part.name}_{k}" for k in range(len(pieces))]
    texts = []
    for k, piece in enumerate(pieces):
        one = _Placed(code, piece, [rows[name][0] for name in part.reads], size)
        one.write(slots, first=k == 0)
        texts.append(one.function(names[k]))
    calls = "\n".join(f"  call void @{name}(ptr %arena, ptr %out)" for name in names)
    head = f"define internal void @{_NAME}_{part.name}(ptr noalias %arena, ptr noalias %out) nounwind {{"
    return "\n".join([*texts, f"{head}\n{calls}\n  ret void\n}}\n"]), max(slots.values(), default=0) + 1


class _Placed(Piece):
    """A piece whose arguments, results and work space have fixed places."""

    def __init__(self, code: Program, piece: list[int], reads: list[int], work: int) -> None:
        super().__init__(code, piece, width())
        self._reads, self._start = reads, work
        self._writes = [0, *accumulate(out.size for out in code.outputs)]
        self.store_zeros()

    def _place(self, arrays: str, strides: str, i: int, j: int) -> str:  # noqa: ARG002  # rows are all alike
        row = (self._reads if arrays == "in" else self._writes)[i] + j
        return self._row("arena" if arrays == "in" else "out", row)

    def _work(self, slot: int) -> str:
        return self._row("arena", self._start + slot)

    def _row(self, base: str, row: int) -> str:
        return self._text.put(f"getelementptr inbounds {self._text.vector}, ptr %{base}, i64 {row}")

    def _watch(self) -> None:
        # The error of a step shows numbers that are not finite.
        pass

    def function(self, name: str, linkage: str = "internal") -> str:
        return self._function(f"{linkage} void @{name}(ptr noalias %arena, ptr noalias %out)")


def _round(calls: list[str], outs: dict[str, int], state: tuple[int, int, int]) -> str:
    """Return the loop over rounds; `state` has the first rows of old and new state, and how many they are."""
    w = width()
    V, row = f"<{w} x double>", 8 * w
    old, new, count = state
    places = "\n".join(
        f"  %out_{name} = getelementptr inbounds {V}, ptr %arena, i64 {place}" for name, place in outs.items()
    )
    ways = "\n".join(
        f"  %at{i} = getelementptr i64, ptr %ways, i64 {i}\n  %{name} = load i64, ptr %at{i}"
        for i, name in enumerate(("source", "stride", "log", "unused", "heed"))
    )
    body = "\n".join(calls)
    return f"""
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)

define void @{RUN}(ptr %arena, ptr %ways, i64 %first, i64 %last) nounwind {{
entry:
  %old = getelementptr inbounds {V}, ptr %arena, i64 {old}
  %new = getelementptr inbounds {V}, ptr %arena, i64 {new}
  %flag = getelementptr inbounds {V}, ptr %arena, i64 {new + count - 1}
{places}
{ways}
  %heeds = icmp ne i64 %heed, 0
  store i64 %first, ptr %at3
  %any = icmp slt i64 %first, %last
  br i1 %any, label %one, label %done
one:
  %i = phi i64 [ %first, %entry ], [ %next, %one ]
  %from = mul i64 %i, %stride
  %fromwhere = add i64 %source, %from
  %fromthere = inttoptr i64 %fromwhere to ptr
  call void @llvm.memcpy.p0.p0.i64(ptr %old, ptr %fromthere, i64 {count * row}, i1 false)
{body}
  %to = mul i64 %i, {count * row}
  %towhere = add i64 %log, %to
  %tothere = inttoptr i64 %towhere to ptr
  call void @llvm.memcpy.p0.p0.i64(ptr %tothere, ptr %new, i64 {count * row}, i1 false)
  %flags = load {V}, ptr %flag, align 8
  %goes = fcmp une {V} %flags, zeroinitializer
  %go = call i1 @llvm.vector.reduce.or.v{w}i1(<{w} x i1> %goes)
  %stays = xor i1 %go, true
  %ends = and i1 %heeds, %stays
  %next = add i64 %i, 1
  store i64 %next, ptr %at3
  %last_one = icmp sge i64 %next, %last
  %over = or i1 %ends, %last_one
  br i1 %over, label %done, label %one
done:
  ret void
}}
"""
