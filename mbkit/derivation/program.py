"""A CasADi function as a list of scalar operations, for whoever runs it elsewhere.

CasADi's own list reuses places in a work vector; here every operation has a value
of its own (single static assignment), so that a compiler may order them freely.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import casadi as ca
import numpy as np
from numpy.typing import NDArray

__all__ = ["Operation", "Program", "program"]

#: CasADi's codes -> our names, of the operations that derivations and steps use.
_NAMES: Final = {
    ca.OP_ASSIGN: "copy",
    ca.OP_ADD: "add",
    ca.OP_SUB: "sub",
    ca.OP_MUL: "mul",
    ca.OP_DIV: "div",
    ca.OP_NEG: "neg",
    ca.OP_SQ: "sq",
    ca.OP_TWICE: "twice",
    ca.OP_INV: "inv",
    ca.OP_SQRT: "sqrt",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_FABS: "fabs",
    ca.OP_SIGN: "sign",
    ca.OP_LT: "lt",
    ca.OP_IF_ELSE_ZERO: "if_else_zero",
}
_UNARY: Final = frozenset({"neg", "sq", "twice", "inv", "sqrt", "sin", "cos", "fabs", "sign"})


@dataclass(frozen=True, slots=True)
class Operation:
    """One scalar operation.

    Attributes
    ----------
    name : str
        "input", "const", or an arithmetic one: add, sub, mul, div, neg, sq, twice,
        inv, sqrt, sin, cos, fabs, sign (0 of 0), lt (1 where a < b, else 0), if_else_zero (b where a is
        not 0, else 0).
    arguments : tuple of int
        Indices of earlier operations; of an input, (which argument, which entry).
    value : float
        Of a constant.
    """

    name: str
    arguments: tuple[int, ...] = ()
    value: float = 0.0


@dataclass(frozen=True)
class Program:
    """What a function computes, as operations in an order that can be run.

    Attributes
    ----------
    inputs : tuple of int
        Entries of each argument, all of them vectors.
    shapes : tuple of (int, int)
        Rows and columns of each output.
    operations : tuple of Operation
    outputs : tuple of (rows, columns) int arrays
        Index of the operation that gives each entry.
    """

    inputs: tuple[int, ...]
    shapes: tuple[tuple[int, int], ...]
    operations: tuple[Operation, ...]
    outputs: tuple[NDArray[np.intp], ...]

    @cached_property
    def arithmetic(self) -> int:
        """Number of operations that compute something."""
        return sum(o.name not in ("input", "const") for o in self.operations)


def program(function: ca.Function) -> Program:
    """Return the operations of an expanded function with dense outputs.

    Raises
    ------
    ValueError
        A sparse output, or an operation that no derivation here makes.
    """
    where: dict[int, int] = {}
    operations: list[Operation] = []
    shapes = tuple((function.size1_out(i), function.size2_out(i)) for i in range(function.n_out()))
    outputs = [np.full(rows * columns, -1, dtype=np.intp) for rows, columns in shapes]
    if any(function.nnz_out(i) != out.size for i, out in enumerate(outputs)):
        raise ValueError(f"{function.name()}: expected dense outputs; casadi.densify makes them")
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        out, given = function.instruction_output(k), function.instruction_input(k)
        if code == ca.OP_OUTPUT:
            outputs[out[0]][out[1]] = where[given[0]]
            continue
        if code == ca.OP_INPUT:
            made = Operation("input", (given[0], given[1]))
        elif code == ca.OP_CONST:
            made = Operation("const", (), function.instruction_constant(k))
        elif code in _NAMES:
            name = _NAMES[code]
            if name == "copy":
                where[out[0]] = where[given[0]]
                continue
            # CasADi names the argument of a unary operation twice.
            used = given[:1] if name in _UNARY else given
            made = Operation(name, tuple(where[i] for i in used))
        else:
            raise ValueError(f"{function.name()}: operation {code} of CasADi is not known here")
        where[out[0]] = len(operations)
        operations.append(made)
    return Program(
        inputs=tuple(function.size1_in(i) for i in range(function.n_in())),
        shapes=shapes,
        operations=tuple(operations),
        # CasADi counts down the columns.
        outputs=tuple(out.reshape(shape, order="F") for out, shape in zip(outputs, shapes, strict=True)),
    )
