"""Motions prescribed by expressions, tables and splines: against SciPy, fractions and the closed form of a pendulum."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi as ca
import numpy as np
import pytest
import sympy as sp
from scipy.interpolate import BSpline, CubicSpline, PchipInterpolator, PPoly, make_interp_spline

import mbkit as mb
from mbkit.errors import InputError, ModelError
from tests.scenes import chain, hinge, linkage

MASS, LENGTH, MOMENT, G = 2.0, 0.7, 0.05, 9.81
TIMES = [0.0, 0.4, 1.0, 1.3, 2.5, 3.0]
VALUES = [0.0, 0.5, -0.3, 0.2, 1.1, 0.9]


def pendulum(law: Any = None, **given: Any) -> mb.Model:
    """Return a pendulum that is moved in time."""
    b = hinge("driven", joint="hinge", mass=MASS, com=(0, 0, -LENGTH), inertia=(MOMENT, MOMENT, 0.01))
    b.prescribe("hinge", law, **given)
    return b.build()


def double() -> mb.Model:
    """Return two rods of which a table moves the first."""
    rod = {"mass": 1.0, "com": (0, 0, -0.5), "inertia": (0.1, 0.1, 0.02), "axis": (0, 1, 0)}
    b = chain(rod, rod | {"translation": (0, 0, -1)})
    b.prescribe("j0", (TIMES, VALUES))
    return b.build()


def rates(dyn: mb.Dynamics, t: float) -> tuple[float, float, float]:
    """Return x, x' and x'' of the law: what is left of the constraint at q = v = 0."""
    now, zero = dyn.at(t=t), [0.0]
    return (
        -float(now.constraint_residual(zero)[0]),
        -float(now.constraint_rate(zero, zero)[0]),
        -float(now.constraint_bias(zero, zero)[0]),
    )


SPLINES: dict[str, Any] = {
    "natural": CubicSpline(TIMES, VALUES, bc_type="natural"),
    "not-a-knot": CubicSpline(TIMES, VALUES),
    "clamped": CubicSpline(TIMES, VALUES, bc_type="clamped"),
    "quintic": make_interp_spline(TIMES, VALUES, k=5, bc_type=([(1, 0.0), (2, 0.0)], [(1, 0.0), (2, 0.0)])),
    "septic": make_interp_spline(np.linspace(0, 3, 12), np.sin(np.linspace(0, 3, 12)), k=7),
    "cubic basis": make_interp_spline(TIMES, VALUES, k=3),
    "one piece": PPoly(np.array([[1.0], [-2.0], [0.5], [0.25]]), np.array([0.0, 3.0])),
}


@pytest.mark.parametrize("name", SPLINES)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio"])
def test_a_spline_and_its_derivatives_are_those_of_scipy(engine: str, name: str) -> None:
    spline = SPLINES[name]
    dyn = mb.dynamics(pendulum(spline), engine)
    for t in (*TIMES, *np.linspace(0, 3, 23)):
        for order, x in enumerate(rates(dyn, float(t))):
            # SciPy evaluates a basis of B-splines by another recursion.
            worst = 1e-12 if isinstance(spline, BSpline) else 2e-14
            size = np.abs(spline(np.linspace(0, 3, 200), order)).max()
            assert abs(x - spline(t, order)) < worst * size, (t, order)


def test_a_spline_of_34_digits_is_the_polynomial_of_its_coefficients() -> None:
    spline = SPLINES["natural"]
    oracle = mb.dynamics(pendulum(spline), "oracle")
    for t in (0.1, 0.4, 0.41, 1.7, 2.5, 2.9999):
        i = int(np.searchsorted(spline.x, t, side="right")) - 1
        s = Fraction(t) - Fraction(float(spline.x[i]))
        c = [Fraction(float(x)) for x in spline.c[:, i]]
        exact = {
            "constraint_residual": c[0] * s**3 + c[1] * s**2 + c[2] * s + c[3],
            "constraint_rate": 3 * c[0] * s**2 + 2 * c[1] * s + c[2],
            "constraint_bias": 6 * c[0] * s + 2 * c[1],
        }
        for quantity, x in exact.items():
            high, low = oracle.at(t=t).extended(quantity, *[[0.0]] * (1 + (quantity != "constraint_residual")))
            assert abs(-Fraction(float(high[0])) - Fraction(float(low[0])) - x) < Fraction(1, 10**30) * max(abs(x), 1)


@pytest.mark.parametrize("ends", ["natural", "clamped", "quintic"])
def test_a_table_passes_its_nodes_and_has_the_ends_that_are_asked_for(ends: Any) -> None:
    model = pendulum((TIMES, VALUES), spline=ends)
    dyn = mb.dynamics(model, "lagrangian")
    for t, x in zip(TIMES, VALUES, strict=True):
        assert rates(dyn, t)[0] == pytest.approx(x, abs=1e-14)
        for order in (1, 2):
            before, after = (rates(dyn, s)[order] for s in (max(t - 1e-9, 0.0), min(t + 1e-9, 3.0)))
            # Over 2e-9 s a continuous one moves by that times its slope.
            assert abs(after - before) < 1e-5
    for t in (0.0, 3.0):
        _, speed, change = rates(dyn, t)
        assert abs(change) < 1e-10 or ends == "clamped"
        assert abs(speed) < 1e-12 or ends == "natural"
    assert model == pendulum(np.array([TIMES, VALUES]), spline=ends)


t_, w_ = ca.SX.sym("t"), ca.SX.sym("w")
s_, z_ = sp.symbols("t w")
EXPRESSIONS = {
    "casadi": ((1 - ca.cos(w_ * t_)) * ca.exp(-t_), {"w": mb.Parameter("w", 2.0)}),
    "sympy": ((1 - sp.cos(z_ * s_)) * sp.exp(-s_), {"w": 2.0}),
    "function": (lambda t: (1 - np.cos(2 * t)) * np.exp(-t), None),
}


def exact_law(t: float) -> tuple[float, float, float]:
    """Return (1 - cos 2t) e⁻ᵗ and its derivatives."""
    e, c, s = math.exp(-t), math.cos(2 * t), math.sin(2 * t)
    return (1 - c) * e, (2 * s - 1 + c) * e, (4 * c - 2 * s - 2 * s + 1 - c) * e


@pytest.mark.parametrize("name", EXPRESSIONS)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "oracle"])
def test_an_expression_and_its_derivatives_are_exact(engine: str, name: str) -> None:
    law, parameters = EXPRESSIONS[name]
    dyn = mb.dynamics(pendulum(law, parameters=parameters), engine)
    for t in (-1.0, 0.0, 0.3, 2.0):
        assert np.allclose(rates(dyn, t), exact_law(t), rtol=0, atol=2e-14)


def test_a_parameter_of_a_law_is_one_of_the_model_and_an_expression_may_be_a_built_in_law() -> None:
    law, parameters = EXPRESSIONS["casadi"]
    model = pendulum(law, parameters=parameters)
    assert dict(model.parameters) == {"w": 2.0, "t": 0.0}
    assert model.with_parameters(w=3.0).parameters == {"t": 0.0}
    own = pendulum(offset=0.1, rate=0.2, amplitude=0.3, frequency=4.0, phase=0.5)
    same = pendulum(0.1 + 0.2 * t_ + 0.3 * ca.sin(4 * t_ + 0.5))
    assert own != same
    for engine in ("lagrangian", "pinocchio"):
        x = rates(mb.dynamics(model, engine).at(w=3.0), 0.5)[0]
        assert x == pytest.approx((1 - math.cos(1.5)) * math.exp(-0.5), rel=1e-14)
        one, other = (mb.dynamics(m, engine) for m in (own, same))
        assert np.allclose(rates(one, 0.7), rates(other, 0.7), rtol=1e-14)


LAWS: dict[str, tuple[mb.Model, Any]] = {
    "expression": (pendulum(EXPRESSIONS["sympy"][0], parameters={"w": 2.0}), exact_law),
    "table": (
        pendulum((TIMES, VALUES)),
        lambda t: tuple(float(SPLINES["natural"](t, k)) for k in range(3)),
    ),
    "harmonic": (
        pendulum(amplitude=0.5, frequency=3.0),
        lambda t: (0.5 * math.sin(3 * t), 1.5 * math.cos(3 * t), -4.5 * math.sin(3 * t)),
    ),
}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "oracle"])
def test_the_force_of_a_drive_is_that_of_the_closed_form(engine: str, name: str) -> None:
    """τ = (I + m l²) x'' + m g l sin x."""
    model, law = LAWS[name]
    dyn = mb.dynamics(model, engine)
    for t in (0.0, 0.7, 1.3, 2.9):
        x, speed, change = law(t)
        now = dyn.at(t=t)
        force = (MOMENT + MASS * LENGTH**2) * change + MASS * G * LENGTH * math.sin(x)
        assert now.constraint_forces([x], [speed], [0.0])[0] == pytest.approx(force, rel=1e-12, abs=1e-12)
        assert now.forward_dynamics([x], [speed], [0.0])[0] == pytest.approx(change, rel=1e-12, abs=1e-12)


# Runs


def driven_bar(law: Any) -> mb.Model:
    """Return a four-bar whose crank is moved in time."""
    b = linkage()
    b.prescribe("at_crank", law)
    return b.build()


def test_a_mechanism_follows_a_table_on_every_engine() -> None:
    model, spline = driven_bar((TIMES, VALUES)), SPLINES["natural"]
    own = mb.dynamics(model, "lagrangian")
    q, v = own.at(t=0.2).project([float(spline(0.2)), 0.5, 2.0], [0.0, 0.0, 0.0])
    exact = mb.dynamics(model, "oracle").at(t=0.2)
    for dyn in (own.at(t=0.2), mb.dynamics(model, "pinocchio").at(t=0.2)):
        for quantity in ("forward_dynamics", "constraint_forces"):
            x, y = (getattr(d, quantity)(q, v, [0.0, 1.0, 2.0]) for d in (dyn, exact))
            assert np.abs(x - y).max() < 1e-12 * np.abs(y).max()
    runs = [
        mb.simulate(own, q, v, 2.0, "rk4", 1e-2, t0=0.2),
        mb.simulate(own, q, v, 2.0, "rk853", rtol=1e-10, t0=0.2),
        mb.simulate(mb.dynamics(model, "pinocchio"), q, v, 0.1, "rk4", 1e-2, t0=0.2),
    ]
    for run in runs:
        assert run.t[0] == 0.2
        assert np.abs(run.q[:, 0] - spline(run.t)).max() < 1e-13
        assert np.abs(run.v[:, 0] - spline(run.t, 1)).max() < 1e-12
    # The mechanism has no other freedom: where it is follows from the table.
    assert np.abs(runs[1].q[-1] - runs[0].q[-1]).max() < 1e-12
    assert np.abs(runs[2].q[-1] - runs[0].q[10]).max() < 1e-12


def test_a_table_is_written_out_in_symbols() -> None:
    model, spline = double(), SPLINES["natural"]
    paper = mb.lagrangian.from_model(model).dynamics()
    run = mb.simulate(paper, [0.1], [0.0], 3.0, "rk853", rtol=1e-11)
    start = [float(spline(0)), 0.1], [float(spline(0, 1)), 0.0]
    own = mb.simulate(mb.dynamics(model, "lagrangian"), *start, 3.0, "rk853", rtol=1e-11)
    assert abs(run.q[-1, 0] - own.q[-1, 1]) < 1e-8


# Outside of the table


@pytest.mark.thorough
def test_times_beyond_a_table_are_refused_with_the_joint_and_the_time() -> None:
    model = pendulum(([1.0, 2.0, 3.0], [0.0, 1.0, 0.5]))
    assert model.time == 1.0
    assert model.interval == (1.0, 3.0)
    for engine in ("lagrangian", "pinocchio", "oracle"):
        dyn = mb.dynamics(model, engine)
        for t in (0.5, 3.1):
            with pytest.raises(InputError, match=f"'hinge' is a table from 1 to 3 s, and is not known at {t} s"):
                dyn.at(t=t)
        with pytest.raises(InputError, match=r"simulate: .*'hinge'.*at 3\.5 s"):
            mb.simulate(dyn, [0.0], [0.0], 2.5)
        with pytest.raises(InputError, match=r"'hinge'.*at 0 s"):
            mb.simulate(dyn, [0.0], [0.0], 1.0, t0=0.0)
    with pytest.raises(InputError, match=r"at 4 s"):
        mb.dynamics(model, "lagrangian").at(t=np.array([1.5, 4.0]))
    with pytest.raises(InputError, match=r"at 4 s"):
        model.with_parameters(t=4.0)
    start = mb.dynamics(model, "lagrangian").project([0.0], [0.0])
    run = mb.simulate(mb.dynamics(model, "lagrangian"), *start, 2.0)
    assert (run.t[0], run.t[-1]) == (1.0, 3.0)
    # Steps whose sum is 2 s to rounding only.
    assert mb.simulate(mb.dynamics(model, "lagrangian"), *start, 0.7 + 1.3, dt=1 / 30).stats.finished


# Bad input


@pytest.mark.parametrize(
    ("law", "given", "words"),
    [
        (PchipInterpolator(TIMES, VALUES), {}, ["acceleration jumps", "at 1.3 s", "CubicSpline"]),
        (PPoly(np.array([[1.0, 2.0], [0, 0]]), np.array([0.0, 1, 2])), {}, ["position jumps", "at 1 s"]),
        (make_interp_spline(TIMES, VALUES, k=1), {}, ["velocity jumps"]),
        (CubicSpline(TIMES, np.transpose([VALUES, VALUES])), {}, ["one at each time"]),
        (([0.0, 1.0, 1.0], [0.0, 1, 2]), {}, ["increasing"]),
        (([0.0, 1.0], [0.0, 1, 2]), {}, ["table"]),
        (([0.0], [0.0]), {}, ["at least two"]),
        (([0.0, 1.0, math.nan], [0.0, 1, 2]), {}, ["times"]),
        ((TIMES, VALUES), {"spline": "linear"}, ["spline", "'linear'", "natural"]),
        ((np.arange(3000.0), np.zeros(3000)), {}, ["2000 knots"]),
        (t_ * ca.SX.sym("k"), {}, ["unknown symbol 'k'", "parameters="]),
        (t_, {"parameters": {"k": 2.0}}, ["'k'", "in no expression"]),
        (ca.vertcat(t_, t_), {}, ["expected 1 number, got 2"]),
        (t_, {"rate": 1.0}, ["a law and rate"]),
        (lambda t: math.sin(t), {}, ["the function raised", "torque="]),
        (lambda t: np.interp(t, TIMES, VALUES), {}, ["hinge"]),
        ("t**2", {}, ["'t**2'", "SymPy"]),
    ],
)
def test_what_is_no_law_is_refused_with_the_reason(law: Any, given: Any, words: list[str]) -> None:
    with pytest.raises(ModelError) as caught:
        pendulum(law, **given)
    for word in words:
        assert word in str(caught.value)


def test_models_at_other_times_share_what_does_not_depend_on_the_time() -> None:
    """Else each evaluation of a run would look through all parts anew."""
    model = replace(double())
    one, other = (model.with_nominal({model.time_parameter: t}) for t in (0.5, 0.6))
    assert one.effects is other.effects
    assert one.time == 0.5


def test_tables_without_a_common_time_are_refused() -> None:
    body = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0), "axis": (0, 0, 1), "parent": "world"}
    b = chain(body, body)
    for name, t in (("j0", [0.0, 1.0]), ("j1", [2.0, 3.0])):
        b.prescribe(name, (t, [0.0, 1.0]))
    with pytest.raises(ModelError, match="'j1': its table begins at 2 s, where that of 'j0' is over"):
        b.build()


# The description


def test_coordinates_that_follow_a_table_are_filled_in_where_it_is_drawn() -> None:
    pytest.importorskip("plotly")
    model = double()
    run = mb.simulate(mb.lagrangian.from_model(model).dynamics(), [0.1], [0.0], 3.0, "rk4", 0.1)
    from mbkit.show.view import _with_prescribed

    q = _with_prescribed(model, run.q, run.t)
    assert np.abs(q[:, 0] - SPLINES["natural"](run.t)).max() < 1e-13
