"""Stops on paper: what is printed of them, impacts on them, and what holds them or refuses them by name."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import sympy as sp
from click.testing import CliRunner
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.cli import cli
from mbkit.errors import InputError, MbkitWarning, UnsupportedError
from mbkit.lagrangian import Lagrangian, QuasiLagrangian, systems
from mbkit.lagrangian.summary import MODULE, SystemSummary, python_code

EPS = np.finfo(float).eps
m, l, g, a, e, Om = sp.symbols("m l g a e Omega")
x, y, th, t = sp.symbols("x y theta t")
u, v, w = sp.symbols("xdot ydot thetadot")


def slider(**more) -> Lagrangian:
    """A slide between two stops, of which the upper one is hard."""
    return Lagrangian(
        **{"T": m * u**2 / 2, "coordinates": [x], "parameters": {m: 2.0, a: 0.5, e: 0.4}, "name": "slider"}
        | {"stops": {x: (-1, a)}, "restitution": [e, 1]}
        | more
    )


def pendulum_at_a_wall() -> Lagrangian:
    arguments = systems.double_pendulum()._arguments()
    l1, l2, th1, th2 = sp.symbols("l1 l2 theta1 theta2")
    wall = [a - l1 * sp.sin(th1) - l2 * sp.sin(th2)]
    parameters = arguments["parameters"] | {a: 0.7, e: 0.3}
    return Lagrangian(**arguments | {"stops": wall, "restitution": e, "parameters": parameters})


def rod(floor=0, **more) -> Lagrangian:
    """A thin rod in a plane, whose end falls on a floor."""
    T = m * (u**2 + v**2) / 2 + m * l**2 / 12 * w**2 / 2
    parameters = {m: 0.7, l: 0.9, g: 9.81, e: 0.35} | ({a: 0.1, Om: 3.0} if floor else {})
    stops = [y - l / 2 * sp.sin(th) - floor]
    whole = {"time": t, "parameters": parameters, "stops": stops, "restitution": e, "name": "rod"}
    return Lagrangian(T, m * g * y, [x, y, th], **whole | more)


# What is printed


def test_a_double_pendulum_at_a_wall_has_its_conditions() -> None:
    text = str(pendulum_at_a_wall().equations())
    for line in (
        "sin(theta1) = -l1*lambda1*cos(theta1)\n",
        "\n0 ≤ a - l1*sin(theta1) - l2*sin(theta2) ⟂ lambda1 ≥ 0\n",
        "\nin contact, ġ = 0: 0 ≤ l1*(-thetaddot1*cos(theta1) + thetadot1**2*sin(theta1)) + ",
        "\nin contact, ġ = -l1*thetadot1*cos(theta1) - l2*thetadot2*cos(theta2) < 0: ġ⁺ = -e ġ⁻, M (v⁺ - v⁻) = Jᵀ Λ, ",
        "J = [-l1*cos(theta1), -l2*cos(theta2)], Λ = -(e + 1) ġ⁻/(J M⁻¹ Jᵀ) ≥ 0",
    ):
        assert line in text
    latex = pendulum_at_a_wall().equations()._repr_latex_()
    assert r"= - l_{1} \lambda_{1} \cos {\theta_{1}}" in latex
    assert r"\\ 0 \le a - l_{1} \sin {\theta_{1}} - l_{2} \sin {\theta_{2}} \perp \lambda_{1} \ge 0 \\" in latex
    assert r"\dot{g}^{+} = -e \dot{g}^{-},\ M (v^{+} - v^{-}) = J^{T} \Lambda,\ J = [- l_{1} \cos" in latex
    assert latex.count(r"\begin{") == latex.count(r"\end{") == 2


def test_a_slider_between_stops_on_a_page() -> None:
    page = SystemSummary(slider())
    assert """
Equation of motion:
  m ẍ = λ₁ - λ₂
  0 ≤ 1 + x ⟂ λ₁ ≥ 0
  in contact, ġ = 0: 0 ≤ ẍ ⟂ λ₁ ≥ 0
  in contact, ġ = ẋ < 0: ġ⁺ = -e ġ⁻, M (v⁺ - v⁻) = Jᵀ Λ, J = [1], Λ = -(1 + e) ġ⁻/(J M⁻¹ Jᵀ) ≥ 0
  0 ≤ a - x ⟂ λ₂ ≥ 0
  in contact, ġ = 0: 0 ≤ -ẍ ⟂ λ₂ ≥ 0
  in contact, ġ = -ẋ < 0: ġ⁺ = -ġ⁻, M (v⁺ - v⁻) = Jᵀ Λ, J = [-1], Λ = -2 ġ⁻/(J M⁻¹ Jᵀ) ≥ 0
""" in page.text()
    assert "Conserved: nothing" in page.text()
    assert "\n& 0 \\le a - x \\perp \\lambda_{2} \\ge 0 \\\\\n" in page.latex()
    data = page.data()
    assert (data["stops"], data["restitution"]) == (["x + 1", "a - x"], ["e", "1"])
    assert r"0 \le 1 + x \perp \lambda_{1} \ge 0" in data["latex"]
    for none in (0, 0.0):
        assert "ġ⁺ = 0, " in str(slider(restitution=none).equations())
    for shown in (slider()._repr_latex_(), slider().model._repr_html_()):
        assert r"V = 0,\quad 1 + x \ge 0,\quad a - x \ge 0$" in shown


def test_the_command_prints_stops_and_writes_no_code_without_them() -> None:
    def derive(*options: str, status: int = 0):
        out = CliRunner().invoke(cli, ["derive", "tests.test_stops_on_paper:slider", *options])
        assert out.exit_code == status, out.output
        return out

    assert "0 ≤ a - x ⟂ λ₂ ≥ 0" in derive().stdout
    assert r"\perp" in derive("--latex").stdout
    assert json.loads(derive("--json").stdout)["stops"] == ["x + 1", "a - x"]
    for form in ("--python", "--c", "--program=mass_matrix"):
        assert (
            "slider has stops on paper, where engines run those of joints: stops[0] is x + 1 >= 0"
            in derive(form, status=2).stderr
        )


def test_names_that_are_taken_stay_and_bounds_may_be_sides_of_a_comparison() -> None:
    own = sp.Symbol("lambda1")
    lag = slider(parameters={m: 2.0, own: 0.5}, stops=[x >= own, sp.Le(x, 3)], restitution=0)
    assert lag.stops == (x - own, 3 - x)
    assert lag.stop_multipliers == (sp.Symbol("Lambda1"), sp.Symbol("lambda2"))


def test_rates_of_g_are_its_derivatives_along_a_motion() -> None:
    floor = rod(a * sp.sin(Om * t))
    q, clock = dynamicsymbols("x y theta"), dynamicsymbols._t
    moved = dict(zip(floor.coordinates, q, strict=True)) | {t: clock}
    fast = [*(x.diff(clock) for x in q), *(x.diff(clock, 2) for x in q)]
    rates = dict(zip((*floor.velocities, *floor.accelerations), fast, strict=True))
    (stop,) = floor.equations().stops
    along = stop.gap.subs(moved)
    for order, told in ((1, stop.rate), (2, stop.acceleration)):
        assert sp.simplify(along.diff(clock, order) - told.subs(moved).subs(rates)) == 0
    # In velocities that are no rates: the same, with q̇ = D w + e put in.
    D, drift = sp.Matrix([[2, 0, 0], [x, 1, 0], [0, 0, l]]), sp.Matrix([0, a, x])
    quasi = floor.quasi_velocities(D, "p r s", drift=drift)
    (other,) = quasi.equations().stops
    qdot = dict(zip(floor.velocities, D * sp.Matrix(quasi.velocities) + drift, strict=True))
    assert sp.expand(other.rate - stop.rate.subs(qdot)) == 0
    assert sp.simplify(other.jacobian - stop.jacobian * D) == sp.zeros(1, 3)
    whole = quasi.equations()
    assert sp.simplify(whole._right_side - D.T * floor.equations()._right_side) == sp.zeros(3, 1)


def test_a_stop_carries_what_lies_on_it() -> None:
    """The slope on which a rod lies takes its weight: λ of g̈ = 0."""
    e_ = rod().equations()
    (stop,) = e_.stops
    put = dict(zip(e_.accelerations, (row.rhs for row in e_.explicit()), strict=True)) | dict.fromkeys((u, v, w), 0)
    force = sp.solve(stop.acceleration.subs(put), stop.multiplier)[0]
    assert sp.simplify(force - m * g / (1 + 3 * sp.cos(th) ** 2)) == 0


# Impacts


def test_a_rod_that_hits_the_floor_is_the_closed_form_and_the_impact_of_its_numbers() -> None:
    lag = rod()
    hit = lag.impulse(stop=0)
    (impulse,) = hit.reactions().values()
    rate = v - l / 2 * sp.cos(th) * w
    assert sp.simplify(impulse + (1 + e) * rate * m / (1 + 3 * sp.cos(th) ** 2)) == 0
    M, J = lag.kinetic.M, lag.equations().stops[0].jacobian
    assert sp.simplify(impulse + (1 + e) * rate / (J * M.inv() * J.T)[0]) == 0
    q, speed = np.array([0.2, 0.31, -0.8]), np.array([0.5, -1.2, 0.7])
    place = dict(zip((x, y, th, u, v, w), (*q, *speed), strict=True)) | dict(lag.parameters)
    row = [0.0, 1.0, -0.45 * np.cos(-0.8)]
    free = Lagrangian(**lag._arguments() | {"stops": (), "restitution": 0})
    number = mb.impact(free.dynamics(), q, speed, jacobian=row, restitution=0.35)
    assert number.v == pytest.approx([float(x.subs(place)) for x in hit.after().values()], rel=20 * EPS)
    assert number.impulses == pytest.approx([float(impulse.subs(place))], rel=20 * EPS)
    assert number.impulses > 0


def test_an_impact_on_a_floor_that_moves_is_one_of_the_relative_velocity() -> None:
    (impulse,) = rod(a * sp.sin(Om * t)).impulse(stop=0).reactions().values()
    rate = v - l / 2 * sp.cos(th) * w - a * Om * sp.cos(Om * t)
    assert sp.simplify(impulse + (1 + e) * rate * m / (1 + 3 * sp.cos(th) ** 2)) == 0


def test_constraints_take_their_part_of_an_impact() -> None:
    """A rod whose middle slides on a vertical rail at an angle that a guide holds is a point of mass m."""
    guided = rod(constraints=[x, th - y])
    assert "M (v⁺ - v⁻) = Jᵀ Λ + Aᵀ P, J = [0, 1, -l*cos(theta)/2], Λ ≥ 0" in str(guided.equations())
    assert " + A^{T} P," in guided.equations().latex()
    assert guided.stop_multipliers == (sp.Symbol("lambda3"),)
    hit = guided.impulse(stop=0)
    q, speed = np.array([0.0, 0.4, 0.4]), np.array([0.0, -1.5, -1.5])
    place = dict(zip((x, y, th, u, v, w), (*q, *speed), strict=True)) | dict(guided.parameters)
    free = Lagrangian(**guided._arguments() | {"stops": (), "restitution": 0})
    number = mb.impact(free.dynamics(), q, speed, jacobian=[0, 1, -0.45 * np.cos(0.4)], restitution=0.35)
    assert number.v == pytest.approx([float(x.subs(place)) for x in hit.after().values()], abs=50 * EPS)
    assert number.impulses == pytest.approx([float([*hit.reactions().values()][-1].subs(place))], rel=50 * EPS)


# What holds them


def test_variants_of_a_system_keep_its_stops() -> None:
    lag = slider()
    for same in (
        pickle.loads(pickle.dumps(lag)),
        lag.conservative(),
        mb.lagrangian.from_model(lag.model),
        pickle.loads(pickle.dumps(lag.model)).form,
        lag.model.without("damping").form,
        lag.quasi_velocities([[2]]),
        pickle.loads(pickle.dumps(lag.quasi_velocities([[2]]))),
        lag.quasi_velocities([[2]]).system,
    ):
        assert (same.stops, same.restitution) == (lag.stops, lag.restitution)
    numbers = lag.substituted({a: 3, e: sp.Rational(1, 4)})
    assert (numbers.stops, numbers.restitution) == ((x + 1, 3 - x), (sp.Rational(1, 4), 1))
    assert lag.quasi_velocities([[2]]).substituted({a: 3}).stops == (x + 1, 3 - x)
    assert (
        len({lag.model.digest, slider(restitution=0).model.digest, slider(stops=(), restitution=0).model.digest}) == 3
    )
    (first,) = lag.quasi_velocities([[2]]).impulse(stop=0).reactions().values()
    assert sp.expand(first + (1 + e) * m * u) == 0


def test_a_momentum_that_a_stop_changes_is_not_conserved() -> None:
    def kept(lag: Lagrangian) -> list[str]:
        return [c.name for c in lag.conserved_quantities()]

    free = {"T": m * (u**2 + v**2) / 2, "coordinates": [x, y]}
    assert kept(slider(**free)) == ["p_y"]
    quasi = slider(**free).quasi_velocities(sp.diag(2, 3))
    assert kept(quasi) == ["p_y"]
    native = QuasiLagrangian.of_energies(quasi.quasi, **quasi._arguments())
    for same in (slider(**free), quasi, native):
        assert same.forced_cyclic_coordinates() == {x: sp.Symbol("lambda1") - sp.Symbol("lambda2")}
    assert kept(slider(**free | {"stops": (), "restitution": 0})) == ["p_x", "p_y", "E"]


@pytest.mark.parametrize(
    "ask",
    [
        lambda s: s.dynamics(),
        lambda s: s.dynamics("oracle"),
        lambda s: mb.equilibrium(s),
        lambda s: s.embedded(),
        lambda s: s.constraint([0.1]),
        lambda s: s.multipliers([0.1], [0.2]),
        lambda s: s.project([0.1], [0.2]),
        lambda s: s.routhian(),
        lambda s: mb.steady_motion(s),
        lambda s: s.hamiltonian(),
        lambda s: s.maggi(),
        lambda s: s.boltzmann_hamel(),
        lambda s: s.appell(),
        lambda s: s.quasi_velocities([[2]]).hamiltonian(),
        lambda s: mb.lagrangian.portrait(s, [-1, 1], [-1, 1]),
        lambda s: python_code(s),
        lambda s: mb.lagrangian.export_c(s.model),
        lambda s: mb.lagrangian.program(s.model),
    ],
)
def test_what_does_not_hold_stops_refuses_them_by_name(ask) -> None:
    with pytest.raises(UnsupportedError, match="stops"):
        ask(slider())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"stops": {y: (0, 1)}}, "stops: y is no coordinate; the coordinates are x, and stops="),
        ({"stops": {x: (1, 0)}}, r"stops\[x\]: expected lower < upper, got \(1, 0\); exchange them"),
        ({"stops": {x: (a, 0.5)}}, r"stops\[x\]: expected lower < upper"),
        ({"stops": {x: (1,)}}, r"stops\[x\]: expected \(lower, upper\), one of which may be None, got \(1,\)"),
        ({"stops": {x: (None, None)}}, "one of which may be None"),
        ({"stops": {x: 3}}, "one of which may be None, got 3"),
        ({"stops": {x: (-sp.oo, 1)}}, r"stops\[x\]: -oo is not finite"),
        ({"stops": [a - 1]}, r"stops\[0\]: a - 1 holds no coordinate"),
        ({"stops": [x + u]}, r"stops\[0\]: expected coordinates, time and parameters only, got the velocity xdot"),
        ({"stops": {x: (u, None)}}, r"stops\[0\]: expected coordinates, .*the velocity xdot"),
        ({"stops": [x - l]}, r"l stands in stops\[0\] and is not declared"),
        ({"stops": [sp.Eq(x, 1)]}, r"stops\[0\]: expected a scalar SymPy expression, got Equality"),
        ({"stops": 5}, "stops: expected a list of expressions, got 5"),
        ({"restitution": 1.5}, "restitution: expected a number from 0 to 1, got 1.5"),
        ({"restitution": -e}, "restitution: expected a number from 0 to 1, got -0.4"),
        ({"restitution": [0, 0, 1]}, "restitution: expected one e, or one for each of 2 stops"),
        ({"stops": (), "restitution": 0.3}, "restitution: expected one e, or one for each of 0 stops, got 0.3"),
        ({"restitution": u}, r"restitution\[0\]: expected a number or parameters only, got xdot"),
        ({"restitution": l}, r"l stands in restitution\[0\], restitution\[1\] and is not declared"),
    ],
)
def test_bad_stops_are_refused(arguments, message) -> None:
    with pytest.raises(InputError, match=message):
        slider(**{"restitution": e} | arguments)


@pytest.mark.parametrize("asked", [{"stop": 2}, {"stop": "x"}, {"stop": 0, "rows": [u]}, {"stop": 0, "restitution": 1}])
def test_an_impact_is_on_a_stop_that_there_is(asked) -> None:
    with pytest.raises(InputError, match="stop: expected one of 2 stops, counted from 0, without rows"):
        slider().impulse(**asked)


# Descriptions


def arm() -> mb.Model:
    """Two links with stops at their hinges, and a third one that follows the second against its direction."""
    b = mb.ModelBuilder("arm")
    stops = {"axis": (0, 1, 0), "stops": True}
    bounds = {"lower": -1.2, "upper": 2.5}, {"lower": -0.5, "upper": 2.0}, {"lower": -0.6, "mimic": ("j2", -0.5, 0.1)}
    for k, more in enumerate(bounds, start=1):
        own = {"restitution": 0.25 * k, "translation": (0, 0, -0.8 * (k > 1))} | stops | more
        b.add_body(f"l{k}", mass=1.0, com=(0, 0, -0.4), inertia=(0.06, 0.06, 0.01))
        b.add_joint(f"j{k}", "revolute", parent="world" if k == 1 else f"l{k - 1}", child=f"l{k}", **own)
    return b.build()


def test_joint_stops_of_a_description_are_stops_on_paper() -> None:
    lag = mb.lagrangian.from_model(arm())
    first, second = lag.coordinates
    # The follower's lower bound is an upper one of its leader, nearer than its own.
    assert lag.stops == (first + 1.2, sp.Rational(5, 2) - first, second + sp.Rational(1, 2), 1.4 - second)
    assert lag.restitution == (*[sp.Rational(1, 4)] * 2, sp.Rational(1, 2), sp.Rational(3, 4))
    out = CliRunner().invoke(cli, ["derive", "tests.test_stops_on_paper:arm"])
    assert out.exit_code == 0, out.output
    for line in ("0 ≤ 1.2 + j₁ ⟂ λ₁ ≥ 0", "0 ≤ 1.4 - j₂ ⟂ λ₄ ≥ 0", "ġ⁺ = -¾ ġ⁻", "Λ = -7/4 ġ⁻/(J M⁻¹ Jᵀ) ≥ 0"):
        assert line in out.stdout
    assert mb.lagrangian.from_model(arm().without("stops")).stops == ()


def test_what_rests_on_a_stop_is_the_engines_in_the_conditions_on_paper() -> None:
    """With g̈ = 0 at the stops that push, and λ = 0 at the one that lets go."""
    model = arm()
    lag, dyn = mb.lagrangian.from_model(model), mb.dynamics(model, "lagrangian", compile=False)
    eom = lag.equations()
    q, speed = np.array([-1.2, 1.4]), np.zeros(2)
    for tau in ([-30.0, 20.0], [-30.0, -40.0], [30.0, 20.0]):
        put = dict(zip((*lag.coordinates, *lag.velocities), (*q, *speed), strict=True)) | dict(lag.parameters)
        left = [row.lhs - row.rhs - x for row, x in zip(eom.equations(), tau, strict=True)]
        forces = dyn.stop_forces(q, speed, tau)[[0, 0, 1, 1]]
        pushing = [s for s, x in zip(eom.stops, forces, strict=True) if x and abs(s.gap.subs(put)) < 8 * EPS]
        idle = dict.fromkeys((s.multiplier for s in eom.stops if s not in pushing), 0)
        unknown = [*eom.accelerations, *(s.multiplier for s in pushing)]
        rows = [x.subs(put).subs(idle) for x in (*left, *(s.acceleration for s in pushing))]
        solved = sp.solve(rows, unknown)
        a = [float(solved[x]) for x in eom.accelerations]
        assert dyn.forward_dynamics(q, speed, tau) == pytest.approx(a, abs=1e4 * EPS)
        reaction = sum((s.jacobian.T * solved[s.multiplier] for s in pushing), sp.zeros(2, 1))
        assert dyn.stop_forces(q, speed, tau) == pytest.approx([float(x) for x in reaction], abs=1e4 * EPS)
        # Signorini: no pull, and nothing that leads outwards.
        assert all(solved[s.multiplier] > 0 for s in pushing)
        for s in eom.stops:
            outwards = s.acceleration.subs(put).subs(solved)
            assert abs(s.gap.subs(put)) > 0.1 or outwards >= -1e4 * EPS
    hit = mb.impact(dyn, q, [0.4, 1.1], jacobian=[0, -1], restitution=0.75)
    put |= dict(zip(lag.velocities, (0.4, 1.1), strict=True))
    assert hit.v == pytest.approx([float(x.subs(put)) for x in lag.impulse(stop=3).after().values()], rel=50 * EPS)


def test_a_stop_beside_a_ball_joint_is_on_its_own_coordinate() -> None:
    b = mb.ModelBuilder("ball_and_hinge")
    for k in (1, 2):
        b.add_body(f"l{k}", mass=1.0, com=(0, 0, -0.4), inertia=(0.06, 0.06, 0.01))
    b.add_joint("ball", "ball", parent="world", child="l1")
    b.add_joint("elbow", "revolute", parent="l1", child="l2", axis=(0, 1, 0), lower=0.0, stops=True)
    lag = mb.lagrangian.from_model(b.build())
    assert lag.stops == (lag.coordinates[3],)
    (stop,) = lag.equations().stops
    assert (stop.jacobian, stop.acceleration) == (sp.Matrix([[0, 0, 0, 1]]), lag.accelerations[3])
    assert lag.equations()._right_side == sp.Matrix([0, 0, 0, stop.multiplier])
    assert lag.system.stops == pickle.loads(pickle.dumps(lag)).stops == lag.stops


def test_a_stop_on_a_joint_that_is_moved_in_time_needs_its_drive() -> None:
    b = mb.ModelBuilder.of(arm())
    b.prescribe("j1", amplitude=0.3, frequency=1.0)
    with pytest.raises(UnsupportedError, match="joint 'j1' with stops is moved in time; drives=True keeps both"):
        mb.lagrangian.from_model(b.build())
    assert len(mb.lagrangian.from_model(b.build(), drives=True).stops) == 4


def test_code_of_a_description_with_stops_says_what_it_lacks() -> None:
    model = arm()
    for quantity in ("forward_dynamics", "inverse_dynamics"):
        text = mb.lagrangian.program(model, quantity)
        for form in (str(text), text.latex(), text.python(), text.c()):
            assert "joint stops are in no term" in form
    assert "joint stops are in no term" in " ".join(mb.lagrangian.export_c(model).header.split())
    dyn = mb.dynamics(model, "lagrangian", compile=False)
    with pytest.warns(MbkitWarning, match="arm: forward_dynamics: joint stops are in no term"):
        dyn.function("forward_dynamics")
    dyn.function("mass_matrix")
    assert "joint 'j1' has stops" in MODULE.refuses(model)
    with pytest.raises(UnsupportedError, match=r"joint 'j1' has stops; .*model.without\('stops'\) leaves them out"):
        mb.equilibrium(mb.dynamics(model))
