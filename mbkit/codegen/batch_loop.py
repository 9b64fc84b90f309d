"""LLVM code of the loop that takes a body through a batch, whatever the arrays' strides.

One vector of states at a time: an array whose samples are neighbours (coordinate-major) is handed to the body where it
is; rows of an ordinary C-ordered array are transposed in registers on their way into a small tile; anything else, and
the end of a batch, is gathered entry by entry. Lanes beyond the end repeat the last state, so that a state's result
never depends on its place in the batch.

The function has the signature ::

    void run(int64 *table, double *work, int64 first, int64 last)

where ``table`` holds the numbers of inputs and outputs, the body's own share of the work space, and for each array its
address, rows, stride between rows and stride between samples, counted in doubles. Tiles follow the body's share.
"""

from __future__ import annotations

from typing import Any, Final

from llvmlite import ir

from mbkit.codegen.simd_kernel import BODY

RUN: Final = "mbkit_run"
#: Inputs, and outputs, of one function at most.
MAX_ARRAYS: Final = 16

_I64: Final = ir.IntType(64)
_DOUBLE: Final = ir.DoubleType()
_POINTER: Final = ir.PointerType()


class Builder(ir.IRBuilder):  # type: ignore[misc]  # llvmlite is not typed
    """Loads, stores and counted loops over opaque pointers."""

    def at(self, pointer: Any, index: Any, kind: Any = _DOUBLE) -> Any:
        """Return the address of an element."""
        return self.gep(pointer, [index], source_etype=kind)

    def get(self, pointer: Any, index: Any, kind: Any = _DOUBLE) -> Any:
        """Load an element of eight bytes."""
        return self.load(self.at(pointer, index, kind), typ=kind, align=8)

    def set(self, value: Any, pointer: Any, index: Any, kind: Any = _DOUBLE) -> None:
        """Store an element of eight bytes."""
        self.store(value, self.at(pointer, index, kind), align=8)

    def room(self, kind: Any, size: int) -> Any:
        """Return the address of an array on the stack."""
        # llvmlite gives it a typed pointer, which it would not mix with the others.
        return self.inttoptr(self.ptrtoint(self.alloca(ir.ArrayType(kind, size)), _I64), _POINTER)

    def count(self, first: Any, end: Any, step: int, body: Any) -> None:
        """Run ``body(i)`` for i = first, first + step, ... below end."""
        before = self.block
        head, inside, after = (self.append_basic_block(n) for n in ("head", "inside", "after"))
        self.branch(head)
        self.position_at_end(head)
        i = self.phi(_I64)
        i.add_incoming(first, before)
        self.cbranch(self.icmp_signed("<", i, end), inside, after)
        self.position_at_end(inside)
        body(i)
        i.add_incoming(self.add(i, _I64(step)), self.block)
        self.branch(head)
        self.position_at_end(after)


def _function(module: ir.Module, name: str, *arguments: Any) -> tuple[Any, Builder]:
    f = ir.Function(module, ir.FunctionType(ir.VoidType(), list(arguments)), name)
    f.attributes.add("nounwind")
    # Copied into every place of use they would take longer to compile than most bodies.
    f.attributes.add("noinline")
    return f, Builder(f.append_basic_block("entry"))


def _transposed(b: Builder, vectors: list[Any], width: int) -> list[Any]:
    """Transpose the square blocks of a list of vectors as long as a block's side."""
    side, vectors = len(vectors), list(vectors)
    step = 1
    while step < side:
        for i in range(side):
            if not i & step:
                low, high = vectors[i], vectors[i + step]
                for k, shift in ((i, 0), (i + step, step)):
                    mask = [e + shift if not e & step else width + e - step + shift for e in range(width)]
                    vectors[k] = b.shuffle_vector(low, high, ir.Constant(ir.VectorType(ir.IntType(32), width), mask))
        step *= 2
    return vectors


def _joined(b: Builder, parts: list[Any]) -> Any:
    """Return short vectors one after another in a long one."""
    while len(parts) > 1:
        n = parts[0].type.count
        mask = ir.Constant(ir.VectorType(ir.IntType(32), 2 * n), list(range(2 * n)))
        parts = [b.shuffle_vector(x, y, mask) for x, y in zip(parts[::2], parts[1::2], strict=True)]
    return parts[0]


def _blocks(b: Builder, rows: Any, side: int, body: Any) -> None:
    """Run ``body(j)`` over blocks of ``side`` rows; the last one may overlap."""
    last = b.sub(rows, _I64(side))

    def block(j: Any) -> None:
        body(b.select(b.icmp_signed("<", j, last), j, last))

    b.count(_I64(0), rows, side, block)


def _copies(module: ir.Module, width: int, *, inward: bool) -> Any:
    """Return the function between an array and a tile, entry by entry."""
    # array (at the first sample), rows, row stride, sample stride, samples left, tile
    f, b = _function(module, "copy_in" if inward else "copy_out", _POINTER, _I64, _I64, _I64, _I64, _POINTER)
    array, rows, across, along, left, tile = f.args

    def row(j: Any) -> None:
        start, place = b.mul(j, across), b.mul(j, _I64(width))

        def lane(k: Any) -> None:
            inside = b.icmp_signed("<", k, left)
            sample = b.select(inside, k, b.sub(left, _I64(1)))
            here = b.add(start, b.mul(sample, along))
            if inward:
                b.set(b.get(array, here), tile, b.add(place, k))
            else:
                # Lanes beyond the end hold the last state's result again.
                b.set(b.get(tile, b.add(place, k)), array, here)

        b.count(_I64(0), _I64(width), 1, lane)

    b.count(_I64(0), rows, 1, row)
    b.ret_void()
    return f


def _transposition(module: ir.Module, width: int, side: int, *, inward: bool) -> Any:
    """Return the function between rows of whole states and a tile, ``side`` coordinates at a time."""
    # array (at the first sample), rows, sample stride, tile
    f, b = _function(module, f"{'load' if inward else 'store'}_{side}", _POINTER, _I64, _I64, _POINTER)
    array, rows, along, tile = f.args
    short, long = ir.VectorType(_DOUBLE, side), ir.VectorType(_DOUBLE, width)

    def block(j: Any) -> None:
        starts = [b.at(array, b.add(j, b.mul(along, _I64(k)))) for k in range(width)]
        lines = [b.at(tile, b.mul(b.add(j, _I64(k)), _I64(width))) for k in range(side)]
        if inward:
            states = [b.load(p, typ=short, align=8) for p in starts]
            vectors = _transposed(b, [_joined(b, states[k::side]) for k in range(side)], width)
            for v, p in zip(vectors, lines, strict=True):
                b.store(v, p, align=8)
        else:
            vectors = _transposed(b, [b.load(p, typ=long, align=8) for p in lines], width)
            for k, p in enumerate(starts):
                first = k // side * side
                mask = ir.Constant(ir.VectorType(ir.IntType(32), side), list(range(first, first + side)))
                b.store(b.shuffle_vector(vectors[k % side], vectors[k % side], mask), p, align=8)

    _blocks(b, rows, side, block)
    b.ret_void()
    return f


def batch_code(width: int) -> str:
    """Return LLVM code of the loop for vectors of a width, a power of two from 2."""
    module = ir.Module("batch")
    sides = [side for side in (8, 4, 2) if side <= width]
    ways = {}
    for inward in (True, False):
        ways[inward] = (
            _copies(module, width, inward=inward),
            [(side, _transposition(module, width, side, inward=inward)) for side in sides],
        )
    f, b = _function(module, RUN, _POINTER, _POINTER, _I64, _I64)
    table, work, first, last = f.args
    W = _I64(width)
    kinds = {"p": _POINTER, "s": _I64}
    # They stand in the order of the body's arguments.
    held = {(name, i): b.room(kinds[name], MAX_ARRAYS) for i in (True, False) for name in kinds}
    n_in, n_out, share = (b.get(table, _I64(i), _I64) for i in range(3))
    used = b.room(_I64, 1)

    def fields(k: Any) -> list[Any]:
        start = b.add(b.mul(k, _I64(4)), _I64(3))
        return [b.get(table, b.add(start, _I64(i)), _I64) for i in range(4)]

    def described(k: Any, s: Any, full: Any) -> Any:
        address, rows, across, along = fields(k)
        array = b.at(b.inttoptr(address, _POINTER), b.mul(s, along))
        direct = b.and_(full, b.icmp_signed("==", along, _I64(1)))
        return array, rows, across, along, direct

    def carry(inward: bool, array: Any, rows: Any, across: Any, along: Any, full: Any, left: Any, tile: Any) -> None:
        plain, fast = ways[inward]
        whole = b.and_(full, b.icmp_signed("==", across, _I64(1)))
        done = b.append_basic_block("carried")
        for side, function in fast:
            fits = b.and_(whole, b.icmp_signed(">=", rows, _I64(side)))
            yes, no = b.append_basic_block("block"), b.append_basic_block("smaller")
            b.cbranch(fits, yes, no)
            b.position_at_end(yes)
            b.call(function, [array, rows, along, tile])
            b.branch(done)
            b.position_at_end(no)
        b.call(plain, [array, rows, across, along, left, tile])
        b.branch(done)
        b.position_at_end(done)

    def prepare(inward: bool, offset: Any, s: Any, full: Any, left: Any) -> Any:
        def one(i: Any) -> None:
            array, rows, across, along, direct = described(b.add(i, offset), s, full)
            place = b.load(used, typ=_I64)
            tile = b.at(work, place)
            with b.if_else(direct) as (here, there):
                with here:
                    b.set(array, held["p", inward], i, _POINTER)
                    b.set(across, held["s", inward], i, _I64)
                with there:
                    b.set(tile, held["p", inward], i, _POINTER)
                    b.set(W, held["s", inward], i, _I64)
                    b.store(b.add(place, b.mul(rows, W)), used)
                    if inward:
                        carry(inward, array, rows, across, along, full, left, tile)

        return one

    def finish(s: Any, full: Any, left: Any) -> Any:
        def one(i: Any) -> None:
            array, rows, across, along, direct = described(b.add(i, n_in), s, full)
            with b.if_then(b.not_(direct)):
                tile = b.get(held["p", False], i, _POINTER)
                carry(False, array, rows, across, along, full, left, tile)

        return one

    body = ir.Function(module, ir.FunctionType(ir.VoidType(), [_POINTER] * 5), BODY)

    def vector(s: Any) -> None:
        left = b.sub(last, s)
        full = b.icmp_signed(">=", left, W)
        b.store(share, used)
        b.count(_I64(0), n_in, 1, prepare(True, _I64(0), s, full, left))
        b.count(_I64(0), n_out, 1, prepare(False, n_in, s, full, left))
        b.call(body, [*held.values(), work])
        b.count(_I64(0), n_out, 1, finish(s, full, left))

    b.count(first, last, width, vector)
    b.ret_void()
    return str(module)
