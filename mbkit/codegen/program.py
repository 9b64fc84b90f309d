"""A CasADi function as a list of scalar operations, the input of all backends.

CasADi's own list reuses places in a work vector; here every operation has a value of its own (single static
assignment), so that a compiler may order them freely. Repeated operations are computed once (value numbering), which
takes a tenth of the time of CasADi's own search for common subexpressions.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from mbkit.derivation.forces import BINARY, UNARY
from mbkit.errors import UnsupportedError

#: CasADi's codes -> our names, of the operations that every backend knows.
_UNARY: Final[dict[int, str]] = {getattr(ca, f"OP_{name.upper()}"): name for name in UNARY}
_BINARY: Final[dict[int, str]] = {getattr(ca, f"OP_{name.upper()}"): name for name in BINARY} | {ca.OP_CONSTPOW: "pow"}


class Operation(NamedTuple):
    """One scalar operation: an input, a constant, or one of `UNARY` and `BINARY`.

    Decisions are 1 or 0; if_else_zero is b where a is not 0, else 0. fmin and fmax propagate NaN; every comparison with
    NaN is false except ne, and in a logical operation NaN counts as true, as in C.
    """

    name: str
    #: Indices of earlier operations; of an input, (which argument, which entry).
    arguments: tuple[int, ...] = ()
    value: float = 0.0


@dataclass(frozen=True)
class Program:
    """Operations of a function, in an order that can be run."""

    #: Entries of each argument, all of them vectors, and rows and columns of each output.
    inputs: tuple[int, ...]
    shapes: tuple[tuple[int, int], ...]
    operations: tuple[Operation, ...]
    #: (rows, columns): index of the operation that gives each entry.
    outputs: tuple[NDArray[np.intp], ...]

    @cached_property
    def fused(self) -> Program:
        """The same with fused multiply-adds, a b ± c with one rounding, and without the products that they take in.

        A product is taken in where nothing else reads it. Which ones is decided here and not by a compiler, so that
        every processor that has the instruction rounds alike.
        """
        uses = np.zeros(len(self.operations), dtype=np.intp)
        for o in self.operations:
            if o.name != "input":
                for j in o.arguments:
                    uses[j] += 1
        for out in self.outputs:
            np.add.at(uses, out.ravel(), 1)

        def factors(j: int) -> tuple[int, ...] | None:
            o = self.operations[j]
            if uses[j] != 1 or o.name not in ("mul", "sq"):
                return None
            return o.arguments if o.name == "mul" else o.arguments * 2

        absorbed, operations = set[int](), list[Operation]()
        for o in self.operations:
            if o.name in ("add", "sub"):
                a, b = o.arguments
                if (pair := factors(a)) is not None:
                    absorbed.add(a)
                    o = Operation("fma" if o.name == "add" else "fms", (*pair, b), 0.0)
                elif (pair := factors(b)) is not None:
                    absorbed.add(b)
                    o = Operation("fma" if o.name == "add" else "fnma", (*pair, a), 0.0)
            operations.append(o)
        place = np.cumsum([k not in absorbed for k in range(len(operations))]) - 1
        left = (o for k, o in enumerate(operations) if k not in absorbed)
        packed = tuple(
            o if o.name == "input" else o._replace(arguments=tuple(place[list(o.arguments)].tolist())) for o in left
        )
        return Program(self.inputs, self.shapes, packed, tuple(place[out] for out in self.outputs))

    @cached_property
    def arithmetic(self) -> int:
        """Number of operations that compute something."""
        return sum(o.name not in ("input", "const") for o in self.operations)


def program(function: ca.Function) -> Program:
    """Return the operations of an expanded function with dense outputs."""
    where: dict[int, int] = {}
    # In the order of their first appearance. Plain tuples are quicker to make and to look up than their kind.
    known: dict[tuple[str, tuple[int, ...], float], int] = {}
    shapes = tuple((function.size1_out(i), function.size2_out(i)) for i in range(function.n_out()))
    outputs = [np.full(rows * columns, -1, dtype=np.intp) for rows, columns in shapes]
    if any(function.nnz_out(i) != out.size for i, out in enumerate(outputs)):
        raise ValueError(f"{function.name()}: expected dense outputs; casadi.densify makes them")
    entry: tuple[str, tuple[int, ...], float]
    code_of, results_of, arguments_of = function.instruction_id, function.instruction_output, function.instruction_input
    for k in range(function.n_instructions()):
        code, out, args = code_of(k), results_of(k), arguments_of(k)
        if code in _BINARY:
            entry = (_BINARY[code], (where[args[0]], where[args[1]]), 0.0)
        elif code == ca.OP_OUTPUT:
            outputs[out[0]][out[1]] = where[args[0]]
            continue
        elif code == ca.OP_INPUT:
            entry = ("input", (args[0], args[1]), 0.0)
        elif code == ca.OP_CONST:
            entry = ("const", (), function.instruction_constant(k))
        elif code == ca.OP_ASSIGN:
            where[out[0]] = where[args[0]]
            continue
        elif code in _UNARY:
            # CasADi names the argument of some of them twice.
            entry = (_UNARY[code], (where[args[0]],), 0.0)
        else:
            name = next((n for n in dir(ca) if n.startswith("OP_") and getattr(ca, n) == code), f"number {code}")
            raise UnsupportedError(
                f"{function.name()}: CasADi's operation {name.removeprefix('OP_').lower()} has no counterpart in "
                "machine code, 113-bit numbers, Taylor series and C; write it with "
                f"{', '.join(sorted({*_UNARY.values(), *_BINARY.values()}))} (of an MX function, .expand() first)"
            )
        # CasADi has one zero, so that equal constants are the same.
        where[out[0]] = known.setdefault(entry, len(known))
    return Program(
        inputs=tuple(function.size1_in(i) for i in range(function.n_in())),
        shapes=shapes,
        operations=tuple(map(Operation._make, known)),
        # CasADi counts down the columns.
        outputs=tuple(out.reshape(shape, order="F") for out, shape in zip(outputs, shapes, strict=True)),
    )
