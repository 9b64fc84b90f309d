"""The oracle has 34 digits: a Newton–Euler recursion of its own agrees, and so do the laws of mechanics."""

from __future__ import annotations

import math
import pickle
import sys

import casadi as ca
import mpmath
import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen.extended_precision import Extended, arithmetic, mpmath_context
from mbkit.codegen.program import program
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from tests.random_trees import ALL, random_tree, states
from tests.scenes import chain, hinge
from validation import newton_euler
from validation.plain_model import plain

EPS = np.finfo(float).eps
#: Of numbers with 113 bits.
EPS_113 = 2.0**-112
BACKENDS = ["mpmath", *(["real128"] if arithmetic().name == "real128" else [])]

CALLS = {
    "mass_matrix": "q",
    "coriolis_matrix": "qv",
    "coriolis_force": "qv",
    "gravity": "q",
    "nle": "qv",
    "passive": "qv",
    "inverse_dynamics": "qva",
    "forward_dynamics": "qvt",
    "kinetic_energy": "qv",
    "potential_energy": "q",
    "energy_rate": "qva",
    "inverse_dynamics_derivatives": "qva",
    "forward_dynamics_derivatives": "qvt",
}


def arguments(quantity, q, v, a, tau):
    return [{"q": q, "v": v, "a": a, "t": tau}[letter] for letter in CALLS[quantity]]


def size(x):
    return max((abs(e) for e in np.ravel(x)), default=0)


def as_read(model, reading):
    """Return the oracle's constants with the rotations and axes that the witness reads, to 32 digits."""
    exact = {}
    for joint in model.joints:
        R, axes = reading.rotations[joint.name], reading.axes[joint.name]
        pairs = [(joint.rotation[i, k], R[i, k]) for i in range(3) for k in range(3)]
        pairs += [(x, axes[n][k]) for n, axis in enumerate(joint.axes) for k, x in enumerate(axis)]
        for given, found in pairs:
            # Numbers that are equal share a symbol, so they must have been read alike.
            known = exact.setdefault(abs(float(given)), abs(found))
            assert abs(known - abs(found)) < 1e-40
    values = mb.dynamics(model, "oracle").equations.constant_values
    return values, np.array([float(exact.get(x, x) - x) for x in values])


def witnessed(model, seed=0):
    """Yield each term: its name, the oracle's value and the witness's."""
    reading = newton_euler.Reading(plain(model))
    oracle = OracleDynamics(model, as_read(model, reading))
    q, v, a, _ = (x[0] for x in states(model, 1, seed))
    yield "M", oracle.digits("mass_matrix", q), newton_euler.mass_matrix(reading, q)
    yield "nle", oracle.digits("nle", q, v), newton_euler.nle(reading, q, v)
    inverse = newton_euler.inverse_dynamics(reading, q, v, a)
    yield "inverse dynamics", oracle.digits("inverse_dynamics", q, v, a), inverse


def off(x, y):
    """Return the largest difference, relative to the largest entry."""
    y = np.array(y.tolist(), dtype=object).reshape(x.shape)
    return float(size([newton_euler.mp.mpf(a) - b for a, b in zip(x.flat, y.flat, strict=True)]) / size(y))


@pytest.mark.thorough("1-True")
@pytest.mark.parametrize(("seed", "mimic"), [(0, False), (1, True)])
def test_newton_and_euler_agree_on_trees_of_every_joint_kind(seed, mimic):
    model = random_tree(seed, 12, mimic=mimic)
    assert {j.kind for j in model.joints} == set(ALL)
    for term, ours, theirs in witnessed(model, seed):
        assert off(ours, theirs) < 1e-30, term


@pytest.mark.thorough("universal", "spherical_zyx", "ball", "planar", "free")
@pytest.mark.parametrize("kind", [k for k in ALL if k != "fixed"])
def test_newton_and_euler_agree_on_each_joint_kind_alone(kind):
    for term, ours, theirs in witnessed(random_tree(5, 2, (kind,))):
        assert off(ours, theirs) < 1e-30, term


@pytest.mark.thorough("panda-False", "solo12-True", "anymal_b-True")
@pytest.mark.parametrize(
    ("robot", "floating"), [("panda", False), ("talos_arm", False), ("solo12", True), ("anymal_b", True)]
)
def test_newton_and_euler_agree_on_robots(robot, floating):
    for term, ours, theirs in witnessed(mb.load(robot, floating_base=floating)):
        assert off(ours, theirs) < 1e-30, term


@pytest.mark.thorough("0-False", "0-True", "1-True")
@pytest.mark.parametrize("mimic", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_newton_and_euler_witness_bodies_and_loads(seed, mimic):
    model = random_tree(seed, 11, mimic=mimic)
    reading = newton_euler.Reading(plain(model))
    oracle = OracleDynamics(model, as_read(model, reading))
    q, v, a, _ = (x[0] for x in states(model, 1, seed))
    names = [b.name for b in model.bodies]
    pushed = {names[0]: [1.0, 2.0, -3.0, 0.5, 0.25, 1.0], names[-1]: [-2.0, 0.5, 1.0, 0.0, -1.0, 0.75]}
    found = newton_euler.bodies(reading, q, v, a, pushed)
    carried = {joint.child: joint.name for joint in model.joints}
    ours = {
        "twist": oracle.digits("velocity", q, v, names, "local"),
        "acceleration": oracle.digits("acceleration", q, v, a, names, "local", "spatial"),
        "load": oracle.digits("joint_wrenches", q, v, a, pushed, "local", [carried[n] for n in names]),
    }
    for k, (what, values) in enumerate(ours.items()):
        theirs = np.array([list(found[name][2 + k]) for name in names])
        assert off(values, theirs) < 1e-30, what


def test_newton_and_euler_see_an_eps():
    """Rotations that miss orthogonality by an eps, as doubles do, are 14 decades above the tolerance."""
    model = random_tree(0, 6, ("revolute",))
    reading = newton_euler.Reading(plain(model))
    q, v, _, _ = (x[0] for x in states(model, 1))
    given = mb.dynamics(model, "oracle").digits("nle", q, v)
    assert 1e-18 < off(given, newton_euler.nle(reading, q, v)) < 1e-14


@pytest.mark.thorough("1-coriolis_matrix", "1-inverse_dynamics_derivatives", "1-forward_dynamics_derivatives")
@pytest.mark.skipif("real128" not in BACKENDS, reason="heyoka is not installed")
@pytest.mark.parametrize("quantity", CALLS)
@pytest.mark.parametrize("seed", [1])
def test_both_backends_agree(quantity, seed):
    model = random_tree(seed, 4, mimic=bool(seed))
    given = arguments(quantity, *states(model, 3, seed))
    ours, theirs = (OracleDynamics(model, backend=b).digits(quantity, *given) for b in BACKENDS)
    condition = np.linalg.cond(mb.dynamics(model).mass_matrix(given[0])).max() if "forward" in quantity else 1.0
    assert size(ours - theirs) <= 1000 * EPS_113 * condition * size(ours)


TERMS = ("mass_matrix", "coriolis_matrix", "gravity", "nle")


@pytest.mark.thorough("coriolis_matrix", "inverse_dynamics_derivatives", "forward_dynamics_derivatives")
@pytest.mark.parametrize("quantity", CALLS)
def test_methods_give_the_rounded_value_and_pairs_the_rest(quantity):
    model = random_tree(2, 6)
    oracle = mb.dynamics(model, "oracle")
    given = arguments(quantity, *states(model, 2))
    high, low = oracle.extended(quantity, *given)
    rounded = getattr(oracle, quantity)(*given)
    assert np.array_equal(np.stack(rounded, axis=1) if isinstance(rounded, tuple) else rounded, high)
    assert np.dtype(np.float64) == high.dtype == low.dtype
    assert (np.abs(low) <= np.spacing(np.abs(high)) / 2).all()
    assert low.any()
    exact = oracle.digits(quantity, *given)
    rest = [float(x - mpmath_context().mpf(float(h))) for x, h in zip(exact.flat, high.flat, strict=True)]
    assert np.array_equal(rest, low.ravel())


def test_a_quaternion_stands_for_its_rotation():
    """The length of a quaternion, which a double misses by an eps, changes nothing."""
    model = random_tree(0, 4, ("ball", "free"))
    q, v, _, _ = states(model, 4)
    longer = q.copy()
    for start, _ in model.quaternions:
        longer[:, start : start + 4] *= 1 + 2.0**-33
    oracle, own = mb.dynamics(model, "oracle"), mb.dynamics(model, "lagrangian")
    scale = np.abs(oracle.nle(q, v)).max()
    assert np.abs(oracle.nle(longer, v) - oracle.nle(q, v)).max() < 100 * EPS * scale
    assert np.abs(own.nle(longer, v) - own.nle(q, v)).max() > 1e-12 * scale


def test_an_unfavourable_angle_keeps_its_digits():
    """1e5 turns: the double's own sine is off by 1e-11, the sine of the double is not."""
    oracle = mb.dynamics(hinge(gravity=(0, 0, -1)).build(), "oracle")
    angle = 2e5 * math.pi
    with mpmath.workdps(50):
        assert abs(oracle.digits("gravity", [angle])[0] - mpmath.sin(mpmath.mpf(angle))) < 1e-34


def test_nobodys_precision_is_touched_or_used():
    model = random_tree(1, 5)
    q, v, _, _ = states(model, 2)
    straight = OracleDynamics(model, backend="mpmath").digits("nle", q, v)
    before = mpmath.mp.prec
    try:
        mpmath.mp.prec = 20
        again = OracleDynamics(model, backend="mpmath").digits("nle", q, v)
        assert mpmath.mp.prec == 20
    finally:
        mpmath.mp.prec = before
    assert all(a == b for a, b in zip(straight.flat, again.flat, strict=True))


def test_without_heyoka_mpmath_computes(monkeypatch):
    monkeypatch.setitem(sys.modules, "heyoka", None)
    arithmetic.cache_clear()
    try:
        assert arithmetic().name == "mpmath"
        with pytest.raises(UnsupportedError, match="pip install heyoka"):
            arithmetic("real128")
    finally:
        arithmetic.cache_clear()


@pytest.mark.parametrize("backend", BACKENDS)
def test_every_operation_of_a_program(backend):
    x, c = ca.SX.sym("x", 2), ca.SX.sym("c", 1)
    a, b = x[0], x[1]
    outs = [a + b, a - b, a * b, a / b, -a, a**2, 2 * a, 1 / a]
    outs += [ca.sqrt(a), ca.sin(a), ca.cos(a), a < b, ca.if_else(a < b, c, 0)]
    made = program(ca.Function("f", [x, c], [ca.densify(ca.vertcat(*outs))]))
    own = arithmetic(backend)
    states = np.array([[0.3, 0.7], [0.7, 0.3]])
    high, low = own.pair(Extended(made, own)(states, np.array([[0.1]]))[0][:, :, 0])
    with mpmath.workdps(60):
        for (p, q), h, r in zip(states, high, low, strict=True):
            s, t, u = mpmath.mpf(p), mpmath.mpf(q), mpmath.mpf(0.1)
            exact = [s + t, s - t, s * t, s / t, -s, s * s, 2 * s, 1 / s]
            exact += [mpmath.sqrt(s), mpmath.sin(s), mpmath.cos(s), int(s < t), u if s < t else 0]
            for e, x_high, x_low in zip(exact, h, r, strict=True):
                assert abs(e - mpmath.mpf(x_high) - mpmath.mpf(x_low)) <= 1e-32 * abs(e)


def test_it_survives_pickling_with_what_it_was_given():
    model = random_tree(2, 5)
    q, v, _, _ = states(model, 2)
    values = mb.dynamics(model, "oracle").equations.constant_values
    others = OracleDynamics(model, 2 * values), OracleDynamics(model, backend="mpmath")
    for oracle in (mb.dynamics(model, "oracle"), *others):
        again = pickle.loads(pickle.dumps(oracle))
        assert type(again) is OracleDynamics
        for ours, theirs in zip(oracle.extended("nle", q, v), again.extended("nle", q, v), strict=True):
            assert np.array_equal(ours, theirs)


def test_parameters_are_taken_at_their_values():
    model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0))
    oracle = mb.dynamics(model, "oracle")
    assert oracle.at(m=3.0).mass_matrix([0.0]) == pytest.approx(1.5 * oracle.mass_matrix([0.0]))
    with pytest.raises(InputError, match="already has its constants"):
        OracleDynamics(model, oracle.equations.constant_values).at(m=3.0)


def test_misuse_is_explained():
    model = mb.load("ur5")
    oracle = mb.dynamics(model, "oracle")
    q, two = np.zeros(6), np.zeros((2, 6))
    for method, arguments, error, words in (
        ("extended", ("mas_matrix", q), UnknownNameError, "'mass_matrix'"),
        ("digits", ("nle", q), InputError, "expected q, v, got 1"),
        ("digits", ("mass_matrix", q, q), InputError, "expected q, got 2"),
        ("extended", ("nle", q, np.zeros(5)), InputError, r"expected shape \(6,\)"),
        ("extended", ("nle", two, np.zeros((3, 6))), InputError, "different sizes"),
        ("function", ("nle",), UnsupportedError, "lagrangian engine"),
    ):
        with pytest.raises(error, match=words):
            getattr(oracle, method)(*arguments)
    with pytest.raises(InputError, match="constants: expected shape"):
        OracleDynamics(model, [1.0, 2.0])
    with pytest.raises(InputError, match="'real128' or 'mpmath'"):
        OracleDynamics(model, backend="float64")
    assert "function" not in oracle.supports


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_singular_mass_matrix_is_named(backend):
    empty = {"axis": (0, 0, 1)}
    with pytest.warns(mb.errors.NonPhysicalWarning):
        model = chain(empty | {"mass": 1.0, "inertia": (1, 1, 1)}, empty, name="empty").build(nonphysical="warn")
    oracle = OracleDynamics(model, backend=backend)
    z = np.zeros(2)
    assert oracle.mass_matrix(z)[1, 1] == 0
    for call in (oracle.forward_dynamics, lambda *x: oracle.extended("forward_dynamics", *x)):
        with pytest.raises(NumericalError, match="oracle: forward_dynamics of empty is not finite"):
            call(z, z, np.ones(2))
