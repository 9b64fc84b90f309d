"""LLVM code of kernels: a program on a batch, and many steps of a method; one state in each thread.

A thread reads its state where the arrays have it: entry j of sample s of argument i is the double at
``in[i] + j * across[i] + s * along[i]``, coordinate-major or not. The operations are those of the CPU in the same
order, fused where those are, so that results are the same to the bit.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from itertools import accumulate, count
from typing import Any, Final

from llvmlite import binding as llvm

from mbkit._attributes import forwarded
from mbkit.codegen import jit
from mbkit.codegen.llvm_ir import CALLS, Text, declarations, library, number
from mbkit.codegen.program import Program, program
from mbkit.codegen.simd_kernel import Piece, pieces_of, slots_of
from mbkit.derivation.steps.fixed import LAW, Part
from mbkit.errors import UnsupportedError
from mbkit.model.manifold import NEAR_UNIT

#: Names of the two kernels.
BATCH: Final = "mbkit_batch"
STEPS: Final = "mbkit_steps"
_TRIPLE: Final = "nvptx64-nvidia-cuda"
_LAYOUT: Final = "e-p6:32:32-i64:64-i128:128-i256:256-v16:16-v32:32-n16:32:64"
#: Compute capabilities that PTX is written for; later ones run that of the last.
TARGETS: Final = (75, 80, 86, 89, 90)
_PTX: Final = "+ptx80"
#: Threads of a block. A kernel's registers leave room for two such blocks on a multiprocessor.
BLOCK_THREADS: Final = 128
_REGISTERS: Final = ("tid", "ntid", "ctaid")
#: Marks of a batch's kernel: a number that is not finite, a quaternion that is not of unit length.
_NOT_FINITE, _NOT_UNIT = 1, 2


def ptx(text: str, target: str) -> bytes:
    """Return PTX of LLVM's text for a target such as "sm_80", with a zero behind it."""
    with jit.COMPILING, llvm.create_context() as context, llvm.parse_assembly(text, context) as module:
        llvm.initialize_all_targets()
        llvm.initialize_all_asmprinters()
        machine = llvm.Target.from_triple(_TRIPLE).create_target_machine(cpu=target, features=_PTX, opt=3)
        return str(machine.emit_assembly(module)).encode() + b"\0"


def kernel_code(code: Program, quaternions: Sequence[int] = ()) -> tuple[str, int]:
    """Return LLVM code of a program's kernel, and how many doubles of work space each thread needs.

    `quaternions` are the places in the first argument where unit quaternions begin.
    """
    _require_known(code)
    pieces = pieces_of(code)
    slots = slots_of(code, pieces)
    check = _Entry(code, [], "c")
    check.require_unit(quaternions)
    written = [_Entry(code, piece) for piece in pieces]
    for k, piece in enumerate(written):
        piece.write(slots, first=k == 0)
    parameters = _Entry.parameters(code)
    functions, lines = [], check.lines if quaternions else []
    if len(written) == 1:
        lines = [*lines, *written[0].lines]
    else:
        functions = [p.function(f"{BATCH}_{k}") for k, p in enumerate(written)]
        plain = parameters.replace("noalias ", "")
        lines = [*lines, *(f"  call void @{BATCH}_{k}({plain}, i64 %s)" for k in range(len(written)))]
    text = "\n".join([declarations(1), library(1, code), *functions, _entry(BATCH, parameters, "\n".join(lines))])
    return _HEAD + text, max(slots.values(), default=0) + 1


_HEAD: Final = f'target triple = "{_TRIPLE}"\ntarget datalayout = "{_LAYOUT}"\n' + "\n".join(
    f"declare i32 @llvm.nvvm.read.ptx.sreg.{name}.x()" for name in _REGISTERS
)


def _require_known(*programs: Program) -> None:
    missing = sorted({o.name for p in programs for o in p.operations if o.name in CALLS})
    if missing:
        raise UnsupportedError(f"device: {', '.join(missing)} of this model has no counterpart on the GPU; use the CPU")


def _entry(name: str, parameters: str, body: str) -> str:
    """Return a kernel that runs `body` where the thread %s is below %n."""
    registers = "\n".join(
        f"  %{r}32 = call i32 @llvm.nvvm.read.ptx.sreg.{r}.x()\n  %{r} = zext i32 %{r}32 to i64" for r in _REGISTERS
    )
    return f"""
define ptx_kernel void @{name}({parameters}) "nvvm.maxntid"="{BLOCK_THREADS}" "nvvm.minctasm"="1" {{
entry:
{registers}
  %before = mul i64 %ctaid, %ntid
  %s = add i64 %before, %tid
  %inside = icmp ult i64 %s, %n
  br i1 %inside, label %begin, label %done
begin:
{body}
  br label %done
done:
  ret void
}}
"""


class _Entry(Piece):
    """A piece of a batch's kernel, with its arrays among the parameters."""

    def __init__(self, code: Program, piece: list[int], prefix: str = "v") -> None:
        super().__init__(code, piece, 1)
        self._made, self._text = code, Text(1, prefix)
        self.store_zeros()

    lines: list[str] = forwarded("_text.lines", "The piece's instructions.")

    @staticmethod
    def parameters(code: Program) -> str:
        """Return the kernel's parameters."""
        arrays = [f"{side}{i}" for side, many in (("in", code.inputs), ("out", code.shapes)) for i in range(len(many))]
        each = [
            (kind, f"{a}{end}") for a in arrays for kind, end in (("ptr", ""), ("i64", "_across"), ("i64", "_along"))
        ]
        every = [*each, ("i64", "n"), ("ptr", "flags"), ("ptr", "work")]
        return ", ".join(f"{kind} {'noalias ' if kind == 'ptr' else ''}%{name}" for kind, name in every)

    def _place(self, arrays: str, strides: str, i: int, j: int) -> str:  # noqa: ARG002  # strides go by the array's name
        t, name = self._text, f"%{arrays}{i}"
        if (arrays, "p", i) not in self._pointers:
            offset = t.put(f"mul i64 {name}_along, %s")
            self._pointers[arrays, "p", i] = t.put(f"getelementptr double, ptr {name}, i64 {offset}")
        offset = t.put(f"mul i64 {name}_across, {j}")
        return t.put(f"getelementptr double, ptr {self._pointers[arrays, 'p', i]}, i64 {offset}")

    def _work(self, slot: int) -> str:
        offset = self._text.put(f"add i64 {self._text.put(f'mul i64 %n, {slot}')}, %s")
        return self._text.put(f"getelementptr double, ptr %work, i64 {offset}")

    def _watch(self) -> None:
        total = number(0.0)
        for name in self._watched:
            total = self._text.fma(name, number(0.0), total)
        self._mark(self._text.compare("une", total, number(0.0)), _NOT_FINITE)

    def _mark(self, bad: str, flag: int) -> None:
        t = self._text
        one = t.put(f"extractelement <1 x i1> {bad}, i64 0")
        t.lines += [f"  br i1 {one}, label %mark{flag}, label %good{flag}", f"mark{flag}:"]
        at = t.put(f"getelementptr i32, ptr %flags, i64 {flag - 1}")
        t.lines += [f"  store i32 1, ptr {at}, align 4", f"  br label %good{flag}", f"good{flag}:"]

    def require_unit(self, starts: Sequence[int]) -> None:
        """Mark quaternions of the first argument that are not of unit length."""
        t, worst = self._text, number(0.0)
        for start in starts:
            error = number(-1.0)
            for j in range(4):
                x = self._load(self._place("in", "is", 0, start + j))
                error = t.fma(x, x, error)
            worst = t.select(t.compare("ugt", t.call("fabs", error), worst), t.call("fabs", error), worst)
        # NaN counts as larger too.
        self._mark(t.compare("uge", worst, number(NEAR_UNIT)), _NOT_UNIT)

    def function(self, name: str, linkage: str = "internal") -> str:
        return self._function(f"{linkage} void @{name}({self.parameters(self._made)}, i64 %s)")


class _Values(Piece):
    """A program among others of one function: its arguments are values there, and so are its results."""

    def __init__(self, code: Program, text: Text, arguments: Sequence[Sequence[str] | str]) -> None:
        super().__init__(code, [k for k, o in enumerate(code.operations) if o.name not in ("input", "const")], 1)
        self.store_zeros()
        self._text, self._given, self._made = text, arguments, dict[tuple[int, int], str]()
        self.write({}, first=True)
        self.results = [[self._made[i, j] for j in range(out.size)] for i, out in enumerate(code.outputs)]

    def _place(self, arrays: str, strides: str, i: int, j: int) -> Any:  # noqa: ARG002  # values have no address
        return i, j

    def _load(self, pointer: Any) -> str:
        i, j = pointer
        argument = self._given[i]
        # Numbers that all threads share are read where they are used: registers have no room for them.
        return _read(self._text, argument, str(j)) if isinstance(argument, str) else argument[j]

    def _store(self, value: str, pointer: Any) -> None:
        self._made[pointer] = value

    def _watch(self) -> None:
        # The sum of squares of a run shows numbers that are not finite.
        pass


_V: Final = "<1 x double>"


def steps_code(parts: Sequence[Part], state: Sequence[str], force: str = "tau") -> tuple[str, dict[str, Any]]:
    """Return LLVM code of many steps in one launch, and the rows of what a thread reads first and leaves at last.

    `state` has the names at the start of a step, which the last part writes with a 1 behind: between steps they stay
    in registers. A part that stands several times, the forward dynamics, is a function. Before each step the force is
    read from an array of its own, with strides between steps, entries and samples; the numbers of a state feedback are
    the same for every thread.
    """
    programs = {part.name: program(part.make()).fused for part in {part.name: part for part in parts}.values()}
    _require_known(*programs.values())
    sizes = dict.fromkeys(state, 1)
    for part in parts:
        sizes |= dict(zip(part.reads, programs[part.name].inputs, strict=True))
        sizes |= dict(zip(part.writes, (r * c for r, c in programs[part.name].shapes), strict=True))
    written = {name for part in parts for name in part.writes}
    stored = [*state, *(name for name in sizes if name not in written and name not in (*state, force, LAW))]
    starts = accumulate((sizes[name] for name in stored), initial=0)
    rows = {name: (start, sizes[name]) for name, start in zip(stored, starts, strict=False)}

    first, t, last = (Text(1, prefix) for prefix in "bvl")
    values: dict[str, Any] = {LAW: LAW}
    values |= {name: [_read(first, "arena", _row(first, a + j)) for j in range(n)] for name, (a, n) in rows.items()}
    before = {name: values[name] for name in state}
    values |= {name: [f"%{name}_{j}" for j in range(rows[name][1])] for name in state}
    now = t.put(f"add i64 {t.put('mul i64 %k, %force_step')}, {t.put('mul i64 %s, %force_along')}")
    places = [t.put(f"add i64 {now}, {t.put(f'mul i64 %force_across, {j}')}") for j in range(sizes.get(force, 0))]
    values[force] = [_read(t, "force", place) for place in places]
    times = Counter(part.name for part in parts)
    functions = [_part_function(name, programs[name]) for name, n in times.items() if n > 1]
    for part in parts:
        code, arguments, several = programs[part.name], [values[name] for name in part.reads], times[part.name] > 1
        results = _called(t, part.name, code, arguments) if several else _Values(code, t, arguments).results
        values |= dict(zip(part.writes, results, strict=True))
    phis = [
        f"  {old} = phi {_V} [ {start}, %begin ], [ {new}, %one ]"
        for name in state
        for old, start, new in zip(values[name], before[name], values[f"{name}1"], strict=True)
    ]
    for name in state:
        for j, x in enumerate(values[f"{name}1"]):
            last.do(f"store {_V} {x}, ptr {_address(last, 'arena', _row(last, rows[name][0] + j))}, align 8")
    loop = ["  br label %one", "one:", "  %k = phi i64 [ 0, %begin ], [ %next, %one ]"]
    more = ["  %next = add i64 %k, 1", "  %more = icmp ult i64 %next, %steps", "  br i1 %more, label %one, label %over"]
    body = "\n".join([*first.lines, *loop, *phis, *t.lines, *more, "over:", *last.lines])
    parameters = f"ptr %arena, ptr noalias %{LAW}, i64 %n, i64 %steps, ptr %force"
    parameters += ", i64 %force_step, i64 %force_across, i64 %force_along"
    texts = [_HEAD, declarations(1), library(1, *programs.values()), *functions, _entry(STEPS, parameters, body)]
    return "\n".join(texts), {"rows": rows, "size": sum(n for _, n in rows.values())}


def _row(t: Text, row: int) -> str:
    return t.put(f"add i64 {t.put(f'mul i64 %n, {row}')}, %s")


def _address(t: Text, array: str, place: str) -> str:
    return t.put(f"getelementptr double, ptr %{array}, i64 {place}")


def _read(t: Text, array: str, place: str) -> str:
    return t.put(f"load {_V}, ptr {_address(t, array, place)}, align 8")


def _results(code: Program) -> str:
    return "{ " + ", ".join([_V] * sum(out.size for out in code.outputs)) + " }"


def _part_function(name: str, code: Program) -> str:
    """Return the function of a part, of values."""
    t = Text(1, "f")
    arguments = [[f"%x{i}_{j}" for j in range(n)] for i, n in enumerate(code.inputs)]
    out = "poison"
    for i, x in enumerate(x for each in _Values(code, t, arguments).results for x in each):
        out = t.put(f"insertvalue {_results(code)} {out}, {_V} {x}, {i}")
    parameters = ", ".join(f"{_V} {x}" for each in arguments for x in each)
    lines = "\n".join(t.lines)
    head = f"define internal {_results(code)} @mbkit_part_{name}({parameters}) noinline nounwind"
    return f"{head} {{\n{lines}\n  ret {_results(code)} {out}\n}}\n"


def _called(t: Text, name: str, code: Program, arguments: Sequence[Sequence[str]]) -> list[list[str]]:
    values = ", ".join(f"{_V} {x}" for each in arguments for x in each)
    out = t.put(f"call {_results(code)} @mbkit_part_{name}({values})")
    each = (t.put(f"extractvalue {_results(code)} {out}, {i}") for i in count())
    return [[next(each) for _ in range(x.size)] for x in code.outputs]
