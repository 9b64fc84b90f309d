"""A model as a Lagrangian to read: it moves as the model does, and it is short."""

from __future__ import annotations

import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian.from_description import from_model
from mbkit.lagrangian.summary import in_symbols, letters
from mbkit.lagrangian.system import QuasiLagrangian
from mbkit.lagrangian.trig.shortest_form import number
from mbkit.lagrangian.trig.simplify import forms, settled, tidy
from mbkit.model.parts import Loop
from mbkit.spatial import matrix_from_quaternion
from tests.random_trees import off, random_tree, states
from tests.scenes import mounted

ONE = ("revolute", "continuous", "prismatic", "helical")
_HERE = (np.eye(3), np.zeros(3))
# Sums of some hundred rounded terms, in another order than the derivation's.
CLOSE = 1e-13
SMALL = {"chain": {"n": 3}, "clamped_beam": {"segments": 3}, "flexible_spacecraft": {"segments": 2}}
# The system with a loop is in test_loops.py, those that roll in test_rolling.py.
READ = [n for n, f in mb.catalog.systems().items() if not f().constrained]


def in_chart(model, q):
    """Return coordinates with each quaternion as yaw, pitch and roll."""
    out, taken = [], 0
    for joint in model.independent_joints:
        own, k = q[..., taken : taken + joint.type.nq], joint.type.quaternion
        taken += joint.type.nq
        out.append(own[..., :k])
        if k is not None:
            R = matrix_from_quaternion(own[..., k:])
            yaw, roll = (np.arctan2(R[..., i, j], R[..., k, k]) for i, j, k in ((1, 0, 0), (2, 1, 2)))
            out.append(np.stack([yaw, -np.arcsin(R[..., 2, 0]), roll], axis=-1))
    return np.concatenate(out, axis=-1)


def assert_same(model, lag):
    """Compare at random states; velocities are the model's own."""
    dyn, ref = lag.dynamics(options={"compile": False}), mb.dynamics(model, "lagrangian")
    q, v, a, tau = states(model, 4)
    M = ref.mass_matrix(q)
    p = in_chart(model, q)
    assert off(dyn.mass_matrix(p), M) < CLOSE
    assert off(dyn.kinetic_energy(p, v), ref.kinetic_energy(q, v)) < CLOSE
    assert off(dyn.coriolis_matrix(p, v), ref.coriolis_matrix(q, v)) < CLOSE
    # Springs are in V on paper, and among the passive forces of a model.
    for x in (0 * v, v):
        assert off(dyn.nle(p, x) - dyn.passive(p, x), ref.nle(q, x) - ref.passive(q, x)) < CLOSE
    assert off(dyn.inverse_dynamics(p, v, a), ref.inverse_dynamics(q, v, a)) < CLOSE
    close = 1e-14 * np.linalg.cond(M).max()
    assert off(dyn.forward_dynamics(p, v, tau), ref.forward_dynamics(q, v, tau)) < max(close, CLOSE)
    potential = dyn.potential_energy(p) - ref.potential_energy(q)
    assert np.abs(potential - potential[0]).max() < CLOSE * max(1.0, np.abs(ref.potential_energy(q)).max())
    return dyn, ref


@pytest.mark.thorough(every=4)
@pytest.mark.parametrize("name", READ)
def test_catalog_systems_move_as_they_do(name):
    model = mb.catalog.get(name)(**SMALL.get(name, {}))
    lag = from_model(model)
    assert lag.parameters
    if not model.quaternions:
        assert [s.name for s in lag.coordinates] == list(model.coordinate_names)
    assert_same(model, lag)


@pytest.mark.thorough("2", "3")
@pytest.mark.parametrize("seed", [0, 2, 3])
def test_random_trees_move_as_they_do(seed):
    model = random_tree(seed, 3, ONE, mimic=seed == 2, nearest=None if seed < 2 else 1)
    assert_same(model, from_model(model))


@pytest.mark.thorough("1-kinds1", "1-kinds2", "2-kinds1", "2-kinds2")
@pytest.mark.parametrize("kinds", [("free",), ("ball", "revolute"), ("free", "prismatic")])
@pytest.mark.parametrize("seed", [1, 2])
def test_ball_and_free_joints_move_as_they_do_in_their_own_velocities(seed, kinds):
    model = random_tree(seed, len(kinds), kinds, nearest=1)
    lag = from_model(model)
    assert isinstance(lag, QuasiLagrangian)
    assert_same(model, lag)


def satellite(links: int = 1) -> mb.Model:
    """Return a hub that floats, with an arm of thin links."""
    b = mb.ModelBuilder("satellite", gravity=(0, 0, 0))
    values = {"m_0": 100.0, "I1": 10.0, "I2": 12.0, "I3": 9.0, "m_1": 5.0, "J": 1.0, "l": 1.0}
    m_0, I1, I2, I3, m_1, J, length = (mb.Parameter(*x) for x in values.items())
    b.add_body("hub", mass=m_0, inertia=(I1, I2, I3))
    b.add_joint("base", "free", parent="world", child="hub")
    for k in range(1, links + 1):
        b.add_body(f"link{k}", mass=m_1, com=(length, 0, 0), inertia=(0, J, J))
        carrier, at = (f"link{k - 1}", (2 * length, 0, 0)) if k > 1 else ("hub", (length, 0, 0))
        b.add_joint(f"q{k}", "revolute", parent=carrier, child=f"link{k}", axis=(0, 0, 1), translation=at)
    return b.build()


def test_newton_and_euler_s_equations_come_out_of_a_free_body():
    lag = from_model(satellite(0))
    m_0, I1, I2, I3 = sp.symbols("m_0 I1 I2 I3")
    assert [s.name for s in lag.coordinates] == ["x", "y", "z", "psi", "theta", "phi"]
    v, w = sp.Matrix(lag.velocities[:3]), sp.Matrix(lag.velocities[3:])
    vdot, wdot = sp.Matrix(sp.symbols("vdot1:4")), sp.Matrix(sp.symbols("omegadot1:4"))
    inertia = sp.diag(I1, I2, I3)
    expected = [*(m_0 * (vdot + w.cross(v))), *(inertia * wdot + w.cross(inertia * w))]
    rows = lag.equations().equations()
    assert all(sp.expand(row.lhs - x) == 0 and row.rhs == 0 for row, x in zip(rows, expected, strict=True))
    # Momenta along x and y are as constant as those of z; of the angles the chart shows the first alone.
    assert [c.name for c in lag.conserved_quantities()] == ["p_x", "p_y", "p_z", "p_psi", "E"]
    again = pickle.loads(pickle.dumps(lag))
    assert again.equations() == lag.equations()
    assert again.model.digest == lag.model.digest


def test_a_satellite_with_an_arm_moves_on_paper_as_it_does():
    model = satellite(1)
    lag = from_model(model)
    # The pose of the base stands in no term but the kinematics.
    pose = {*lag.coordinates[:6]}
    e = lag.equations()
    assert not pose & (e.mass_matrix.free_symbols | e.coriolis_matrix.free_symbols)
    q, v, *_ = states(model, 1, seed=3)
    tau = np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1, 0.5])
    runs = [
        mb.simulate(dyn, start, v[0], 0.5, "rk853", rtol=1e-12, torque=tau, save=[0.0, 0.5])
        for dyn, start in (
            (lag.dynamics(options={"compile": False}), in_chart(model, q[0])),
            (mb.dynamics(model, "lagrangian", compile=False), q[0]),
        )
    ]
    # Two adaptive runs of some tens of steps.
    assert off(runs[0].v, runs[1].v) < 1e-10
    # Angles may differ by whole turns.
    assert np.abs(np.sin((runs[0].q - in_chart(model, runs[1].q)) / 2)).max() < 1e-10
    # The momenta that the symbols call conserved are so, without a force.
    dyn = lag.dynamics(options={"compile": False})
    run = mb.simulate(dyn, runs[0].q[0], v[0], 0.5, "rk853", rtol=1e-12, save=[0.0, 0.5])
    symbols = (*lag.coordinates, *lag.velocities, *lag.parameters)
    for kept in lag.conserved_quantities():
        value = sp.lambdify(symbols, kept.expression)
        first, last = (value(*a, *b, *lag.parameters.values()) for a, b in zip(run.q, run.v, strict=True))
        assert last == pytest.approx(first, abs=1e-9)
    with pytest.raises(InputError, match="singular at"):
        mb.simulate(dyn, [0, 0, 0, 0, np.pi / 2, 0, 0], v[0], 0.1, "rk4", dt=0.1)


def test_names_of_several_free_bodies_differ():
    b = mb.ModelBuilder("two", gravity=(0, 0, 0))
    for name in ("a", "c"):
        b.add_body(name, mass=1.0, inertia=(1, 2, 2.5))
        b.add_joint(name, "free" if name == "a" else "ball", parent="world", child=name)
    lag = from_model(b.build())
    assert [s.name for s in lag.coordinates] == [
        *(f"{x}_a" for x in ("x", "y", "z", "psi", "theta", "phi")),
        *(f"{x}_c" for x in ("psi", "theta", "phi")),
    ]
    assert [s.name for s in lag.velocities][-3:] == ["omega_c1", "omega_c2", "omega_c3"]
    assert r"\dot{\omega}" in lag.equations().latex()


def test_named_parameters_stay_and_move():
    m, c = mb.Parameter("bob", 0.7), mb.Parameter("c", 0.2)
    place = {"axis": (0, 1, 0), "damping": c, "stiffness": m * c, "rest": 0.1}
    b = mounted(
        "swing",
        "bob",
        "swing",
        "revolute",
        mass=m,
        com=(0, 0, -0.5 * c / m),
        inertia=(c**2, c**2 + 0.005, c**0.5 / 50),
        **place,
    )
    model = b.build()
    lag = from_model(model)
    assert {s.name for s in lag.parameters} == {"bob", "c"}
    dyn, ref = assert_same(model, lag)
    q, v, _, tau = states(model, 3)
    moved = {"bob": 0.9, "c": 0.4}
    assert off(dyn.at(**moved).forward_dynamics(q, v, tau), ref.at(**moved).forward_dynamics(q, v, tau)) < CLOSE


def test_a_cart_pole_reads_as_on_a_blackboard():
    lag = from_model(mb.catalog.cart_pole())
    m_c, m_p, l, g, th, w, u = sp.symbols("m_c m_p l g theta thetadot xdot")
    assert (m_c + m_p) * u**2 / 2 + m_p * l * u * w * sp.cos(th) + m_p * l**2 * w**2 / 2 == lag.T
    assert -m_p * g * l * sp.cos(th) == lag.V
    assert {s.name: x for s, x in lag.parameters.items()} == {"g": 9.81, "m_c": 1.0, "m_p": 1.0, "l": 1.0}


def test_a_double_pendulum_holds_the_second_angle_only():
    lag = from_model(mb.catalog.double_pendulum(mass1=3.0))
    m1, m2, l1, l2, th2 = sp.symbols("m1 m2 l1 l2 theta2")
    M = lag.equations().mass_matrix
    assert M[0, 0] == (m1 + m2) * l1**2 + m2 * l2**2 + 2 * m2 * l1 * l2 * sp.cos(th2)
    assert M[0, 1] == m2 * l2 * (l2 + l1 * sp.cos(th2))
    assert M[1, 1] == m2 * l2**2
    assert lag.parameters[m1] == 3.0


def test_squares_are_found():
    lag = from_model(mb.catalog.elastic_pendulum())
    m, l, s, w, u = sp.symbols("m l stretch thetadot stretchdot")
    assert m * u**2 / 2 + m * (l + s) ** 2 * w**2 / 2 == lag.T


def test_gravity_is_not_lost_in_products():
    place = {"axis": (0, 1, 0)}
    b = mounted(
        "rod",
        "rod",
        "theta",
        "revolute",
        gravity=(0, 0, -9.81),
        mass=1.0,
        com=(0, 0, -0.5),
        inertia=(0.1, 0.1, 0.1),
        **place,
    )
    lag = mb.lagrangian.from_model(b.build())
    assert str(lag.equations()) == "0.35*thetaddot + g*sin(theta)/2 = 0"
    assert {s.name: x for s, x in lag.parameters.items()} == {"g": 9.81}
    kept = mb.lagrangian.from_model(b.build(), symbols=False)
    at = [0.3], [0.1], [0.0]
    assert not kept.parameters
    assert lag.dynamics().forward_dynamics(*at) == pytest.approx(kept.dynamics().forward_dynamics(*at), rel=1e-14)


def test_numbers_are_the_description_s():
    lag = from_model(mb.catalog.pendulum(length=0.5, mass=2.0), symbols=False)
    w, th = sp.symbols("thetadot theta")
    assert not lag.parameters
    assert w**2 / 4 == lag.T
    assert -9.81 * sp.cos(th) == lag.V


@pytest.mark.parametrize("part", ["couplers", "forces", "prescribed", "friction"])
def test_a_system_of_the_catalog_keeps_the_parts_that_a_user_adds(part):
    base = mb.catalog.cart_pole()
    b = mb.ModelBuilder.of(base)
    if part == "couplers":
        b.add_coupler("belt", joint="theta", leader="x", ratio=2.0)
    elif part == "forces":
        b.add_joint_force("spring", "x", -3.0 * sp.Symbol("q") ** 3, potential=lambda q: 2.0 * q**4)
    elif part == "prescribed":
        b.prescribe("x", amplitude=0.2, frequency=2.0)
    else:
        b.set_joint("x", friction=0.3)
    model = b.build()
    named = in_symbols(model)
    assert set(named.parameters) - {"t"} == {"g", "m_c", "m_p", "l"}
    engines = [mb.dynamics(m, "lagrangian", compile=False) for m in (model, named)]
    q, v = engines[0].project(*model.random_state(3)) if model.constrained else model.random_state(3)
    expected, other = (dyn.forward_dynamics(q, v, np.ones(2)) for dyn in engines)
    assert off(other, expected) < CLOSE
    kept = [1] if part == "prescribed" else [0, 1]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore" if part == "friction" else "error")
        lag = from_model(model, symbols=True)
    own = lag.dynamics(options={"compile": False}).forward_dynamics(q[kept], v[kept], np.ones(len(kept)))
    assert off(own, expected[kept]) < CLOSE


def test_the_needs_of_a_system_on_paper_name_its_time_and_constraints():
    b = mounted("pendulum", "bob", "theta", "revolute", mass=1.0, com=(0.1, 0, -1.0), axis=(0, -1, 0))
    b.add_joint_force("push", "theta", 3 * sp.cos(5 * sp.Symbol("t")))
    assert from_model(b.build()).model.needs.time
    assert not from_model(mb.catalog.pendulum()).model.needs.time
    crank, sleigh = (from_model(f()).model.needs for f in (mb.catalog.slider_crank, mb.catalog.chaplygin_sleigh))
    assert (crank.loops, crank.no_slip, crank.time) == (True, False, False)
    assert (sleigh.loops, sleigh.no_slip) == (False, True)


def test_a_system_of_other_form_keeps_its_numbers():
    b = mounted("pendulum", "bob", "theta", "continuous", mass=1.0, com=(0.1, 0, -1.0), axis=(0, -1, 0))
    assert in_symbols(b.build()) is None
    with pytest.raises(InputError, match="no system of the catalog"):
        from_model(b.build(), symbols=True)
    with pytest.raises(InputError, match="parameters already"):
        from_model(mb.catalog.pendulum(mass=mb.Parameter("m", 1.0)), symbols=True)


def test_a_catalog_system_is_known_without_its_gravity():
    lag = from_model(mb.catalog.cart_pole(length=0.3).without("gravity"))
    assert lag.V == 0
    assert {s.name for s in lag.parameters} == {"m_c", "m_p", "l"}
    assert lag.parameters[sp.Symbol("l")] == 0.3


def test_letters_for_coordinates_of_long_names():
    assert letters(mb.catalog.cart_pole()) is None
    assert letters(mb.catalog.gyroscope()) == ["alpha", "beta", "gamma"]
    assert letters(mb.load("ur5"))[5] == "q6"


@pytest.mark.thorough
def test_what_cannot_be_written_is_refused_with_the_reason():
    with pytest.raises(UnsupportedError, match=r"too many terms.*dynamics\(model, "):
        from_model(mb.load("panda"))
    bound = replace(satellite(1), loops=(Loop("grip", "point", "link1", np.eye(3), np.zeros(3), "world", *_HERE),))
    with pytest.raises(UnsupportedError, match=r"'base' has velocities .* beside loops"):
        from_model(bound)
    with pytest.raises(UnsupportedError, match="32 coordinates"):
        from_model(mb.load("talos"))
    with pytest.raises(InputError, match="expected a Model, got str"):
        from_model("cart_pole")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="2 different names"):
        from_model(mb.catalog.cart_pole(), coordinates=["q"])
    with pytest.raises(InputError, match="'l' is a parameter"):
        from_model(mb.catalog.pendulum(), coordinates=["l"])


a, b, c, x, y = sp.symbols("a b c x y")


@pytest.mark.parametrize(
    ("long", "short"),
    [
        (sp.sin(a) * sp.cos(b) - sp.cos(a) * sp.sin(b), sp.sin(a - b)),
        (x * sp.sin(a) ** 2 + x * sp.cos(a) ** 2, x),
        (x * sp.sin(a) ** 2 + y * sp.cos(a) ** 2, x * sp.sin(a) ** 2 + y * sp.cos(a) ** 2),
        (x**2 + 2 * x * y + y**2, (x + y) ** 2),
        (x / y * sp.cos(a) - x / y * sp.cos(a), 0),
        (sp.Rational(2, 5) * x - x / 3, x / 15),
        (sp.cos(a + b) + sp.cos(a - b), 2 * sp.cos(a) * sp.cos(b)),
        (sp.sin(a * b) ** 2 + sp.cos(a * b) ** 2, 1),
        (x * sp.sqrt(1 + y) ** 3 - x * (1 + y) * sp.sqrt(1 + y), 0),
    ],
)
def test_short_forms(long, short):
    assert tidy(long).equals(short)
    assert tidy(long).count_ops() <= sp.sympify(short).count_ops()


@pytest.mark.parametrize("seed", [2, 5])
def test_short_forms_are_equal(seed):
    rng = np.random.default_rng(seed)

    def term():
        turned = [
            f(int(rng.integers(1, 3)) * p + int(rng.integers(-1, 2)) * r)
            for f, p, r in ((sp.sin, a, b), (sp.cos, b, c))
        ]
        return (
            int(rng.integers(-3, 4))
            * x ** int(rng.integers(0, 3))
            * y
            * sp.prod(f ** int(rng.integers(0, 3)) for f in turned)
        )

    long = sum(term() for _ in range(6))
    at = dict(zip((a, b, c, x, y), rng.uniform(0.3, 1.2, 5), strict=True))
    assert abs(float((forms(long)[0] - long).subs(at))) < 1e-12


def test_fractions_where_people_write_them():
    from fractions import Fraction

    assert number(Fraction(1, 12)) == sp.Rational(1, 12)
    assert number(Fraction("9.81")) == sp.Float(9.81)
    assert number(Fraction(7, 2)) == sp.Rational(7, 2)


def test_angles_that_cancel_are_left_out_and_signs_stay():
    turned = x * (sp.sin(a) * sp.cos(b) - sp.cos(a) * sp.sin(b)) ** 2 + x * sp.cos(a - b) ** 2 + sp.sin(c)
    assert settled(turned) == x + sp.sin(c)
    # 1 or -1: the slope is zero, and the value is not known.
    sign = sp.cos(a) / sp.sqrt(sp.cos(a) ** 2)
    assert settled(sign).has(a)
