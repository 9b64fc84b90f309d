"""Velocity constraints on paper: rolling and blades against closed forms, and three eliminations against each other."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import DoubtfulRunWarning, InputError, NumericalError, UnsupportedError
from mbkit.lagrangian import Lagrangian, NonholonomicEquations

EPS = float(np.finfo(float).eps)
# A run of some hundred adaptive steps at 1e-13.
CLOSE = 1e-11
x, y, phi, theta, psi, t = sp.symbols("x y phi theta psi t")
xdot, ydot, u, w, s = sp.symbols("xdot ydot phidot thetadot psidot")
m, J, a, r, g, I1, I3, slope, Omega = sp.symbols("m J a r g I1 I3 alpha Omega")
WAYS = ("maggi", "boltzmann_hamel", "appell")
HEADING = {"v": xdot * sp.cos(theta) + ydot * sp.sin(theta), "omega": w}


def sleigh() -> Lagrangian:
    """Chaplygin's sleigh: a blade at (x, y), its centre of mass at `a` before it."""
    speed = (xdot - a * sp.sin(theta) * w) ** 2 + (ydot + a * sp.cos(theta) * w) ** 2
    return Lagrangian(
        m * speed / 2 + J * w**2 / 2,
        0,
        [x, y, theta],
        parameters={m: 1.3, J: 0.4, a: 0.3},
        velocity_constraints=[ydot * sp.cos(theta) - xdot * sp.sin(theta)],
        name="sleigh",
    )


def disc(i1: float = 0.25, i3: float = 0.5) -> Lagrangian:
    """A disc of mass 1 and radius 1 with the contact (x, y), heading phi, tilt theta and spin psi."""
    centre = sp.Matrix([x - r * sp.sin(theta) * sp.sin(phi), y + r * sp.sin(theta) * sp.cos(phi), r * sp.cos(theta)])
    speed = centre.jacobian([x, y, phi, theta]) * sp.Matrix([xdot, ydot, u, w])
    T = m * speed.dot(speed) / 2 + I1 * (w**2 + (u * sp.cos(theta)) ** 2) / 2 + I3 * (s + u * sp.sin(theta)) ** 2 / 2
    return Lagrangian(
        T,
        m * g * centre[2],
        [x, y, phi, theta, psi],
        parameters={m: 1.0, r: 1.0, g: 9.81, I1: i1, I3: i3},
        velocity_constraints=[xdot + r * s * sp.cos(phi), sp.Eq(ydot, -r * s * sp.sin(phi))],
        name="disc",
    )


def knife() -> Lagrangian:
    """A knife edge on a slope, down which x points."""
    T, V = m * (xdot**2 + ydot**2) / 2 + J * w**2 / 2, -m * g * sp.sin(slope) * x
    return Lagrangian(
        T,
        V,
        [x, y, theta],
        parameters={m: 0.7, J: 0.2, g: 9.81, slope: 0.4},
        velocity_constraints=[xdot * sp.sin(theta) - ydot * sp.cos(theta)],
        name="knife edge",
    )


def ball() -> Lagrangian:
    """A homogeneous ball on a table that turns; its axes by three angles about z, x, z."""
    rates = sp.Matrix(
        [
            w * sp.cos(phi) + s * sp.sin(phi) * sp.sin(theta),
            w * sp.sin(phi) - s * sp.cos(phi) * sp.sin(theta),
            u + s * sp.cos(theta),
        ]
    )
    T = m * (xdot**2 + ydot**2) / 2 + m * r**2 * rates.dot(rates) / 5
    return Lagrangian(
        T,
        0,
        [x, y, phi, theta, psi],
        parameters={m: 0.5, r: 0.2, Omega: 1.5},
        velocity_constraints=[xdot - r * rates[1] + Omega * y, ydot + r * rates[0] - Omega * x],
        name="ball",
    )


def run(lag: Lagrangian, q, v, duration: float, **options):
    method = {"method": "rk853", "rtol": 1e-13, "atol": 1e-13} | options
    return mb.simulate(lag.dynamics(), q, v, duration=duration, **method)


# Closed forms


def test_a_knife_edge_on_a_slope_draws_a_cycloid() -> None:
    rate, force = 2.0, 9.81 * np.sin(0.4)
    out = run(knife(), [0.0, 0.0, 0.0], [0.0, 0.0, rate], 4.0)
    turned = rate * out.t
    expected = force / (2 * rate**2) * np.stack([np.sin(turned) ** 2, turned - np.sin(2 * turned) / 2], axis=1)
    assert out.q[:, :2] == pytest.approx(expected, abs=CLOSE)


# Three eliminations, the multipliers and the oracle


@cache
def made(seed: int, moving: bool) -> Lagrangian:
    """Return a system of two freedoms, with one row or two, of random numbers."""
    rng, n = np.random.default_rng(seed), 3 + seed % 2
    q, v = sp.symbols(f"q1:{n + 1}"), sp.symbols(f"qdot1:{n + 1}")

    def number() -> sp.Rational:
        return sp.Rational(int(rng.integers(-9, 10)), 10)

    def wave() -> sp.Expr:
        return number() * sp.sin(q[rng.integers(n)] + number())

    T = sum((3 + number()) * x**2 for x in v) / 2 + (v[0] * sp.sin(q[n - 2] + number()) + v[n - 1]) ** 2 / 4
    if moving:
        T += v[0] * wave() + (1 + t / 5) * wave()
    V = wave() + q[1] ** 2
    rows = [v[k] + sp.sin(q[n - 1 - k] + number()) * v[n - 2] + number() * q[1 - k] * v[n - 1] for k in range(n - 2)]
    if moving:
        rows = [row + wave() + number() * t for row in rows]
    return Lagrangian(
        T, V, q, v, time=t if moving else None, dissipation=sum(x**2 for x in v) / 9, velocity_constraints=rows
    )


@pytest.mark.thorough(every=7)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("moving", [False, True])
def test_each_elimination_is_the_motion_with_multipliers(seed, way, moving) -> None:
    lag, rng = made(seed, moving), np.random.default_rng(seed)
    e, now = getattr(lag, way)(), 0.3 if moving else 0.0
    n = len(lag.coordinates)
    q, v = lag.project(rng.uniform(-1, 1, n), rng.uniform(-1, 1, n), t=now)
    w = e.to_quasi_velocity(q, v, t=now)
    assert e.to_velocity(q, w, t=now) == pytest.approx(v, abs=20 * EPS)
    tau = rng.uniform(-1, 1, n)
    rate = e.field(tau)(now, np.concatenate([q, w]))
    dyn = lag.dynamics().at(t=now) if moving else lag.dynamics()
    exact = lag.dynamics("oracle").at(t=now) if moving else lag.dynamics("oracle")
    vdot = exact.forward_dynamics(q, v, tau)
    # Coordinates' rates stay in w, so that ẇ is part of v̇.
    kept = [lag.velocities.index(x) for x in e.velocities]
    assert rate[:n] == pytest.approx(v, abs=20 * EPS)
    scale = np.abs(vdot).max()
    assert rate[n:] == pytest.approx(vdot[kept], abs=1e3 * EPS * scale)
    assert dyn.forward_dynamics(q, v, tau) == pytest.approx(vdot, abs=1e3 * EPS * scale)
    symbols = [*lag.coordinates, *e.velocities, *e.accelerations, *([t] if moving else [])]
    place = dict(zip(symbols, [*q, *w, *(exact.forward_dynamics(q, v, 0 * tau)[kept]), now], strict=False))
    reactions = [float(row.subs(place)) for row in e.reactions]
    assert reactions == pytest.approx(lag.multipliers(q, v, t=now), abs=1e3 * EPS * max(1, scale))


@pytest.mark.parametrize("way", WAYS)
def test_quasi_velocities_by_definition_give_the_textbook_sleigh(way) -> None:
    e = getattr(sleigh(), way)(HEADING)
    v, omega, vdot, omegadot = (*e.velocities, *e.accelerations)
    rows = [m * vdot - m * a * omega**2, (J + m * a**2) * omegadot + m * a * v * omega]
    assert [sp.expand(eq.lhs - eq.rhs - row) for eq, row in zip(e.equations(), rows, strict=True)] == [0, 0]
    assert [sp.simplify(eq.rhs) for eq in e.kinematics()] == [v * sp.cos(theta), v * sp.sin(theta), omega]
    assert sp.expand(e.reactions[0] - m * (a * omegadot + v * omega)) == 0
    assert e.determinant.free_symbols == set()
    assert pickle.loads(pickle.dumps(e)).equations() == e.equations()
    assert r"\dot{\omega}" in e.latex()


A, B, C, D, E = sp.symbols("A B C D E")
#: Body rates of z-x-z angles.
RATES = sp.Matrix(
    [
        s * sp.sin(theta) * sp.sin(phi) + w * sp.cos(phi),
        s * sp.sin(theta) * sp.cos(phi) - w * sp.sin(phi),
        s * sp.cos(theta) + u,
    ]
)
BODY = {"O1": RATES[0], "O2": RATES[1]}


def suslov() -> Lagrangian:
    """A rigid body about a fixed point that does not turn about its third axis."""
    T = RATES.dot(sp.Matrix([[A, 0, D], [0, B, E], [D, E, C]]) * RATES) / 2
    rows = {"velocity_constraints": [RATES[2]]}
    return Lagrangian(T, 0, [psi, theta, phi], [s, w, u], parameters=[A, B, C, D, E], **rows)


def coin() -> Lagrangian:
    T = m * (xdot**2 + ydot**2) / 2 + J * u**2 / 2 + I1 * s**2 / 2
    rows = [xdot - r * sp.cos(psi) * u, ydot - r * sp.sin(psi) * u]
    return Lagrangian(T, 0, [x, y, phi, psi], parameters=[m, J, I1, r], velocity_constraints=rows)


ON_ONE_PAGE = {
    "suslov": (suslov, BODY),
    "sleigh": (sleigh, HEADING),
    "sleigh in rates": (sleigh, None),
    "disc": (disc, None),
    "knife": (knife, {"v": HEADING["v"], "omega": w}),
    "coin": (coin, None),
    "ball on a table": (ball, None),
}


@cache
def eliminated(name: str) -> list[NonholonomicEquations]:
    make, rates = ON_ONE_PAGE[name]
    lag = make()
    return [getattr(lag, way)(rates) for way in WAYS]


@pytest.mark.thorough("ball on a table", "suslov", "disc", "sleigh in rates")
@pytest.mark.parametrize("name", ON_ONE_PAGE)
def test_the_three_eliminations_print_the_same_text(name) -> None:
    made = eliminated(name)
    for texts in ([str(e) for e in made], [e.latex() for e in made], [str(e.reactions) for e in made]):
        assert max(map(len, texts)) <= 1.5 * min(map(len, texts))


def test_suslov_s_body_has_two_short_equations() -> None:
    """I ω̇ + ω x I ω = λ e3 with ω3 = 0 (Suslov 1946; Bloch 2003, ch. 8.6)."""
    e = suslov().appell(BODY)
    (O1, O2), (Odot1, Odot2) = e.velocities, e.accelerations
    rows = [A * Odot1 + O2 * (D * O1 + E * O2), B * Odot2 - O1 * (D * O1 + E * O2)]
    assert [sp.expand(eq.lhs - eq.rhs - row) for eq, row in zip(e.equations(), rows, strict=True)] == [0, 0]
    held = D * Odot1 + E * Odot2 + (B - A) * O1 * O2
    assert sp.expand(e.reactions[0] - held) == 0
    assert len(str(e)) < 70


# What is constant, and what is integrable


def test_integrability_tells_rolling_on_a_line_from_rolling_in_a_plane() -> None:
    assert not disc().integrability().holonomic
    assert disc().integrability().growth == (3, 4, 5)
    assert sleigh().integrability().integrable == (False,)
    T = m * xdot**2 / 2 + m * ydot**2 / 2 + J * w**2 / 2
    line = Lagrangian(T, 0, [x, y, theta], parameters=[m, J, r], velocity_constraints=[xdot - r * w])
    assert line.integrability().holonomic
    # sin θ (y ẋ - x ẏ) is integrable by the factor 1/y².
    factor = Lagrangian(
        T, 0, [x, y, theta], parameters=[m, J], velocity_constraints=[sp.sin(theta) * (y * xdot - x * ydot)]
    )
    assert factor.integrability().integrable == (True,)
    assert "1 function of the coordinates is constant" in str(factor.integrability())
    # Two rows: the first is integrable with the second, which holds dθ, and the pair leaves one.
    pair = Lagrangian(
        T, 0, [x, y, theta], parameters=[m, J], velocity_constraints=[ydot - theta * xdot, w - sp.Integer(2) * xdot]
    )
    assert pair.integrability().holonomic
    moving = Lagrangian(T, 0, [x, y, theta], time=t, parameters=[m, J], velocity_constraints=[ydot - t * xdot])
    assert not moving.integrability().holonomic


def test_a_row_that_only_the_first_brackets_keep_is_not_integrable() -> None:
    # Engel's two rows: dω1 ∧ ω1 ∧ ω2 = 0 holds, yet every configuration can be reached from every other.
    z, zdot, wdot = sp.symbols("z zdot wdot")
    W = sp.Symbol("w")
    T = (xdot**2 + ydot**2 + zdot**2 + wdot**2) / 2
    rows = [ydot - z * xdot, zdot - W * xdot]
    told = Lagrangian(T, 0, [x, y, z, W], velocity_constraints=rows).integrability()
    assert (told.growth, told.integrals, told.integrable) == ((2, 3, 4), 0, (False, False))


@pytest.mark.thorough
def test_many_rows_of_the_last_of_many_coordinates_are_solved() -> None:
    # The first 200 choices of five columns of twelve hold the first, which is zero.
    q, v = sp.symbols("q1:13"), sp.symbols("qdot1:13")
    rows = [v[7 + i] - sp.sin(q[3]) * v[2 + i] for i in range(5)]
    lag = Lagrangian(sum(z**2 for z in v) / 2, 0, q, v, velocity_constraints=rows)
    assert lag.maggi().velocities == v[:7]
    # sin q4 dq4 is exact, and no other row is.
    assert lag.integrability().integrable == (False, True, False, False, False)


@pytest.mark.parametrize(
    "rows", [[xdot - 1, xdot - 2], [xdot, ydot, w, xdot - w], [xdot * (sp.sin(x) ** 2 - 1 + sp.cos(x) ** 2)]]
)
def test_rows_that_depend_on_each_other_have_no_verdict(rows) -> None:
    lag = Lagrangian(m * (xdot**2 + ydot**2 + w**2) / 2, 0, [x, y, theta], parameters=[m], velocity_constraints=rows)
    with pytest.raises(InputError, match="follow from each other or contradict"):
        lag.integrability()


def test_a_knife_edge_on_a_slope_rests_across_it() -> None:
    rest = mb.equilibrium(knife().dynamics(), [0.0, 0.0, 0.1])
    assert rest.q[2] == pytest.approx(np.pi / 2, abs=CLOSE)
    assert abs(rest.multipliers[0]) == pytest.approx(0.7 * 9.81 * np.sin(0.4), rel=CLOSE)


def test_momenta_along_symmetries_that_the_rows_allow_are_constant() -> None:
    T = m * (xdot**2 + ydot**2) / 2 + J * w**2 / 2
    lag = Lagrangian(
        T,
        m * g * y,
        [x, y, theta],
        parameters={m: 1.0, J: 0.5, r: 0.3, g: 9.81},
        velocity_constraints=[xdot - r * w + ydot * sp.sin(y)],
    )
    (energy, momentum) = lag.conserved_quantities()
    assert energy.name == "E"
    assert sp.expand(momentum.expression - (r * m * xdot + J * w)) == 0
    q, v = lag.project([0.1, 0.4, 0.2], [1.0, -0.5, 2.0])
    out = run(lag, q, v, 1.0)
    values = 0.3 * out.v[:, 0] + 0.5 * out.v[:, 2]
    assert values == pytest.approx(values[0], abs=CLOSE)
    assert [k.name for k in sleigh().conserved_quantities()] == ["E"]
    # Rows that move feed energy; the spin about the vertical is constant.
    assert [k.name for k in ball().conserved_quantities()] == ["p_phi"]


# Bad input


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([xdot * ydot], "linear in the velocities"),
        ([x - y], "holds none of the velocities"),
        ([xdot - ydot, 2 * ydot - 2 * xdot], "follow from each other"),
        ({xdot: 1}, "expected a list of expressions"),
        ([sp.Derivative(xdot, t) - ydot], "no coordinate or velocity"),
        ([xdot - sp.Symbol("k") * ydot], "is not declared"),
    ],
)
def test_bad_rows_are_refused(rows, message) -> None:
    T = m * (xdot**2 + ydot**2 + w**2) / 2
    with pytest.raises(InputError, match=message):
        Lagrangian(T, 0, [x, y, theta], parameters=[m], velocity_constraints=rows).maggi()


@pytest.mark.parametrize(
    ("choice", "message"),
    [
        ([x, y, theta], "expected 2, one for each degree of freedom, got 3"),
        (["z", "x"], "z is no coordinate"),
        ({"v": xdot * w, "omega": w}, "a sum of velocities"),
        ({"x": xdot, "omega": w}, "stands for something else"),
        ({"v": HEADING["v"], "xddot": w}, "or its derivative stands for something else"),
        ({"v": ydot * sp.cos(theta) - xdot * sp.sin(theta), "omega": w}, "singular everywhere"),
    ],
)
def test_bad_choices_are_refused(choice, message) -> None:
    with pytest.raises(InputError, match=message):
        sleigh().maggi(choice)


def test_what_velocity_constraints_cannot_have_is_refused() -> None:
    lag = sleigh()
    with pytest.raises(UnsupportedError, match="whose forces no H holds"):
        lag.hamiltonian()
    with pytest.raises(UnsupportedError, match=r"velocity_constraints\[0\] is .*, and these bind no coordinates"):
        lag.embedded()
    q, v = lag.project([0, 0, 0], [1, 0, 0.2])
    with pytest.raises(UnsupportedError, match=r"sleigh has velocity constraints: velocity_constraints\[0\] is .*dot"):
        mb.simulate(lag.dynamics(), q, v, dt=0.1, duration=1, method="implicit_midpoint")
    with pytest.raises(UnsupportedError, match="has no constraints"):
        Lagrangian(m * xdot**2, 0, [x], parameters=[m]).maggi()
    with pytest.raises(InputError, match="nearest consistent state"):
        mb.simulate(lag.dynamics(), [0, 0, 0], [0, 1, 0], dt=0.1, duration=1)


def central(**rows) -> Lagrangian:
    T = m * (xdot**2 + ydot**2) / 2 + J * w**2 / 2
    return Lagrangian(T, 0, [x, y, theta], parameters={m: 1.0, J: 0.5}, **rows)


def test_where_quasi_velocities_say_nothing_of_a_velocity_there_are_no_numbers() -> None:
    lag = central(velocity_constraints=[x * ydot - y * xdot])
    equations = lag.maggi(["x", "theta"])
    for q in ([0.0, 1.0, 0.0], [0.0, 0.0, 0.0]):
        with pytest.raises(NumericalError, match=r"not finite at q = .* where -x is zero"):
            equations.field()(0.0, [*q, 1.0, 1.0])
        with pytest.raises(NumericalError, match=r"not finite at q = .* where -x is zero"):
            equations.to_velocity([[1.0, 1.0, 0.0], q], [1.0, 1.0])
    turned = central().quasi_velocities(sp.diag(1, 1 / x, 1))
    with pytest.raises(NumericalError, match="not finite at q = "):
        turned.to_velocity([0.0, 1.0, 0.0], [1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    "rows", [{"velocity_constraints": [x * ydot - y * xdot]}, {"constraints": [(x - y) * (x + y)]}]
)
def test_a_run_goes_through_a_pose_where_a_row_is_zero(rows) -> None:
    lag = central(**rows)
    with pytest.warns(DoubtfulRunWarning, match="passed a singular pose"):
        out = run(lag, [0.0, 0.0, 0.0], [1.0, 1.0, 1.0], 0.5, rtol=1e-8, atol=1e-8)
    assert out.q[-1] == pytest.approx([0.5, 0.5, 0.5], abs=1e-7)


def test_a_coordinate_that_a_row_holds_cannot_be_ignored() -> None:
    z, zdot = sp.symbols("z zdot")
    T = (xdot**2 + ydot**2 + zdot**2) / 2
    lag = Lagrangian(T, x**2, [x, y, z], velocity_constraints=[zdot - sp.sin(y) * xdot])
    assert [k.name for k in lag.conserved_quantities()] == ["p_y", "E"]
    with pytest.raises(InputError, match="holds y, which can therefore not be ignored"):
        lag.routhian([y])


def test_a_system_with_velocity_constraints_keeps_them_in_its_variants() -> None:
    lag = sleigh()
    again = pickle.loads(pickle.dumps(lag))
    assert again.velocity_constraints == lag.velocity_constraints
    assert again.model.digest == lag.model.digest != knife().model.digest
    less = lag.substituted({a: 0.25})
    assert isinstance(less.maggi(), NonholonomicEquations)
    w1, w2, w3 = sp.symbols("w1 w2 w3")
    D = sp.Matrix([[sp.cos(theta), -sp.sin(theta), 0], [sp.sin(theta), sp.cos(theta), 0], [0, 0, 1]])
    turned = lag.quasi_velocities(D, [w1, w2, w3])
    assert turned.velocity_constraints == (w2,)
    q, v = np.array([0.1, 0.2, 0.3]), np.array([1.0, 0.0, 0.5])
    vdot = turned.dynamics().forward_dynamics(q, v, np.zeros(3))
    assert vdot == pytest.approx([0.3 * 0.25, 0.0, -1.3 * 0.3 * 0.5 / (0.4 + 1.3 * 0.09)], abs=20 * EPS)
    assert turned.maggi().equations() == lag.maggi().equations()


# Descriptions


def sphere() -> mb.Model:
    """A ball that rolls on a plane that slopes, by three angles."""
    b = mb.ModelBuilder("sphere")
    b.add_body("ball", mass=0.4, inertia=(2e-3, 2e-3, 2e-3))
    b.add_body("slide", mass=0.0)
    b.add_body("shift", mass=0.0)
    b.add_body("lift", mass=0.0)
    for name, parent, child, axis in (
        ("x", "world", "slide", (1, 0, 0)),
        ("y", "slide", "shift", (0, 1, 0)),
        ("z", "shift", "lift", (0, 0, 1)),
    ):
        b.add_joint(name, "prismatic", parent=parent, child=child, axis=axis)
    b.add_joint("turn", "spherical_zyx", parent="lift", child="ball")
    b.add_rolling("contact", "sphere", body_a="ball", radius=0.1, axis_b=(0.1, 0.0, 1.0))
    return b.build()


@pytest.mark.thorough("rolling_disc", "sphere")
@pytest.mark.parametrize("make", [mb.catalog.rolling_disc, mb.catalog.chaplygin_sleigh, sphere])
def test_what_rolls_in_a_description_rolls_on_paper(make) -> None:
    model = make()
    lag, own = mb.lagrangian.from_model(model), mb.dynamics(model, "lagrangian")
    rng = np.random.default_rng(0)
    for _ in range(3):
        q, v = own.project(*model.random_state(rng))
        expected = own.forward_dynamics(q, v, np.zeros(model.nv))
        scale = max(1.0, np.abs(expected).max())
        # The rows are closed to 1e-13, and a disc near its side turns that into more.
        assert lag.dynamics().forward_dynamics(q, v, np.zeros(model.nv)) == pytest.approx(expected, abs=1e-10 * scale)
    assert len(lag.velocity_constraints) == len(own.velocity_constraint_names)


def wheel(*slides: str) -> mb.Model:
    """Return a wheel of 1 kg and 0.1 kg m² in a vertical plane, with an axle on these slides."""
    b, parent = mb.ModelBuilder("wheel"), "world"
    for name in slides:
        b.add_body(f"axle_{name}", mass=0.0)
        b.add_joint(name, "prismatic", parent=parent, child=f"axle_{name}", axis=np.eye(3)["xyz".index(name)])
        parent = f"axle_{name}"
    b.add_body("disc", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_joint("turn", "revolute", parent=parent, child="disc", axis=(0, 1, 0), translation=(0, 0, 0.5))
    b.add_rolling("floor", "disc", body_a="disc", radius=0.5, axis_a=(0, 1, 0))
    return b.build(nonphysical="warn")


def test_a_wheel_in_a_plane_has_the_rows_that_the_plane_leaves() -> None:
    """A torque turns it as if its mass sat on the rim: M = (I + m r²) / r along the way."""
    for slides in ("x", "xz"):
        lag = mb.lagrangian.from_model(wheel(*slides))
        assert (len(lag.constraints), len(lag.velocity_constraints)) == (len(slides) - 1, 1)
        a = lag.dynamics(options={"compile": False}).forward_dynamics(
            *np.zeros((2, len(slides) + 1)), [*[0] * len(slides), 1]
        )
        assert a[[0, -1]] == pytest.approx([0.5 / 0.35, 1 / 0.35], rel=1e-13)
    b = mb.ModelBuilder.of(wheel("x"))
    b.add_rolling("high", "disc", body_a="disc", radius=0.4, axis_a=(0, 1, 0))
    model = b.build()
    with pytest.raises(InputError, match=r"no slip 'high': 0\.1.* is left"):
        mb.lagrangian.from_model(model)


@pytest.mark.thorough("slider_crank-maggi", "slider_crank-boltzmann_hamel")
@pytest.mark.parametrize(
    ("make", "way"),
    [(mb.catalog.rolling_disc, "appell"), (mb.catalog.slider_crank, "maggi"), (mb.catalog.slider_crank, WAYS[1])],
)
def test_holonomic_constraints_are_eliminated_by_their_rates(make, way) -> None:
    """The height of a disc and the loop of a crank go the way of the rows that roll."""
    lag, own = mb.lagrangian.from_model(make()), mb.dynamics(make(), "lagrangian", compile=False)
    e = getattr(lag, way)()
    assert len(e.velocities) == own.mobility().degrees_of_freedom
    q, v = own.project(*own.model.random_state(np.random.default_rng(1)))
    expected = own.forward_dynamics(q, v, np.zeros(len(v)))
    kept = [lag.velocities.index(w) for w in e.velocities]
    rate = e.field()(0.0, np.concatenate([q, e.to_quasi_velocity(q, v)]))
    scale = max(1.0, np.abs(expected).max())
    # The configuration is closed to 1e-13.
    assert rate[: len(q)] == pytest.approx(v, abs=1e-11 * scale)
    assert rate[len(q) :] == pytest.approx(expected[kept], abs=1e-10 * scale)


def test_a_bicycle_is_too_long_to_be_written_out() -> None:
    with pytest.raises(UnsupportedError, match="at most 7 coordinates"):
        mb.lagrangian.from_model(mb.catalog.bicycle())


def test_a_ball_on_a_turning_table_goes_in_circles_at_two_sevenths_of_its_rate() -> None:
    lag = ball()
    q, v = lag.project([1.0, 0.3, 0.2, 1.4, 0.1], [0.4, -0.1, 0.3, 0.2, 0.5])
    out = run(lag, q, v, 2.0)
    turn = 2 / 7 * 1.5
    # v' = (2/7) Omega z × v.
    c, d = np.cos(turn * out.t), np.sin(turn * out.t)
    expected = np.stack([v[0] * c - v[1] * d, v[0] * d + v[1] * c], axis=1)
    assert out.v[:, :2] == pytest.approx(expected, abs=CLOSE)
    middle = q[:2] + np.array([-v[1], v[0]]) / turn
    assert np.linalg.norm(out.q[:, :2] - middle, axis=1) == pytest.approx(np.linalg.norm(v[:2]) / turn, abs=CLOSE)
