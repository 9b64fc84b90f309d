"""Graphs that are written down quickly are CasADi's own, and what they repeat is computed once."""

from __future__ import annotations

import operator

import casadi as ca
import numpy as np
import pytest

from mbkit.codegen.program import program
from mbkit.derivation import model_values
from mbkit.derivation.model_values import Scalar, scalar


@pytest.mark.parametrize("operation", [operator.add, operator.sub, operator.mul, operator.truediv])
@pytest.mark.parametrize("other", [0.0, -0.0, 1.0, -1.0, 2, 2.5, np.float64(0.3), "y"])
def test_operators_write_what_casadis_write(operation, other):
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    written = []
    for a, b in ((scalar(ca.SX(x)), scalar(ca.SX(y))), (x, y)):
        given = b if isinstance(other, str) else other
        written.append([str(ca.SX(operation(*pair))) for pair in ((a, given), (given, a))])
    assert written[0] == written[1]


def test_a_scalar_stays_one_and_is_casadis():
    x, raw = scalar(ca.SX.sym("x")), ca.SX.sym("raw")
    for out in (
        x + raw,
        raw + x,
        raw * x,
        x / raw,
        raw / x,
        raw - x,
        -x,
        1 - x,
        model_values.sin(x),
        model_values.cos(x),
    ):
        assert isinstance(out, Scalar)
    assert x * 0.0 == 0.0
    row = scalar(ca.SX(ca.Sparsity.triplet(1, 3, [0], [1]), raw))
    assert (x * row).nnz() == 1
    assert ca.vertcat(x, 0.0, raw).shape == (3, 1)


def test_what_stands_twice_is_computed_once():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    once = program(ca.Function("f", [x, y], [ca.sin(x * y) + 2.5])).arithmetic
    twice = program(ca.Function("f", [x, y], [ca.vertcat(ca.sin(x * y) + 2.5, ca.sin(x * y) + 2.5)]))
    assert twice.arithmetic == once == 3
    assert twice.outputs[0][0, 0] == twice.outputs[0][1, 0]
    # a - b is not b - a.
    assert program(ca.Function("f", [x, y], [ca.vertcat(x - y, y - x)])).arithmetic == 2
