"""Models with loops and prescribed motions: by Pinocchio's trees, the textbook's systems and published values."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import sympy as sp
from scipy.linalg import null_space
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.engines.applications.random_states import flowed, states_of
from mbkit.engines.constraint_manifold import manifold_of, refuse_unreachable
from mbkit.errors import InputError, ModelError, UnsupportedError
from mbkit.lagrangian import from_model, systems
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.manifold import random_state
from mbkit.model.parts import Loop, Prescribed
from tests.random_trees import off, random_tree
from tests.scenes import chain
from validation import four_bar as bare
from validation.closed_forms import published

OWN = {"compile": False}
# Sums of some hundred rounded terms, in another order than the tree's.
CLOSE = 1e-13
P = mb.Parameter
ABOUT_Z = {"axis": (0, 0, 1)}


def bar(b: mb.ModelBuilder, name: str, length, mass=1.0, part=1.0, thick=1e-3) -> None:
    """Add a uniform rod along x, or the first part of one."""
    J = mass * length**2 * (part**3 / 12)
    b.add_body(name, mass=mass * part, com=(length * part / 2, 0, 0), inertia=(thick * part, J, J))


# The slider-crank


def slider_crank(*changes) -> mb.Model:
    """Crank, rod and piston of `mbkit.catalog.slider_crank` with named parameters, and what else is added."""
    L1, L2, m1, m2 = P("L1", 0.1), P("L2", 0.3), P("m1", 0.2), P("m2", 0.2)
    b = mb.ModelBuilder("slider_crank", gravity=(0, 0, 0))
    bar(b, "crank", L1, m1, thick=0.0)
    bar(b, "rod", L2, m2, thick=0.0)
    b.add_body("piston", mass=P("m3", 0.4))
    b.add_joint("theta", "continuous", parent="world", child="crank", **ABOUT_Z)
    b.add_joint("phi", "continuous", parent="crank", child="rod", translation=(L1, 0, 0), **ABOUT_Z)
    b.add_joint("x", "prismatic", parent="world", child="piston", axis=(1, 0, 0), translation=(L1 + L2, 0, 0))
    b.add_loop("pin", "point", body_a="rod", translation_a=(L2, 0, 0), body_b="piston")
    for change in changes:
        change(b)
    return b.build()


def at_angle(th: float) -> np.ndarray:
    phi = -th - math.asin(math.sin(th) / 3)
    return np.array([th, phi, 0.1 * math.cos(th) + 0.3 * math.cos(th + phi) - 0.4])


@pytest.fixture(scope="module")
def crank():
    return from_model(mb.catalog.slider_crank())


def test_a_slider_crank_closes_as_in_the_textbook(crank):
    L1, L2, th, phi, x = sp.symbols("L1 L2 theta phi x")
    row = L1 * (sp.cos(th) - 1) + L2 * (sp.cos(th + phi) - 1) - x, L1 * sp.sin(th) + L2 * sp.sin(th + phi)
    assert [sp.expand(a - b) for a, b in zip(crank.constraints, row, strict=True)] == [0, 0]
    assert {s.name: value for s, value in crank.parameters.items()} == slider_crank().parameters
    told, one = published()["rigid_slider_crank"], systems.rigid_slider_crank().dynamics(options=OWN)
    embedded = crank.embedded(["theta"])
    for angle, J in ((0.0, told["J0"]), (0.7, None), (math.pi / 2, told["J_half_pi"]), (2.5, None)):
        q = at_angle(angle)
        own = embedded.on(embedded.chart(q, 0.0), q, 0.0)
        assert off(own.mass_matrix([angle]), one.mass_matrix([angle])) < 1e-14
        assert J is None or own.mass_matrix([angle])[0, 0] == pytest.approx(J, rel=1e-14)
        pushed, alone = (x.forward_dynamics([angle], [3.0], [tau]) for x, tau in ((own, 0.1), (one, 0.0)))
        assert pushed == pytest.approx(alone, rel=1e-12)


def test_a_slider_crank_reaches_the_published_digits(crank):
    exact = np.array([float(s) for s in published()["rigid_slider_crank"]["exact_t3_theta_thetadot"]])
    given = {"rtol": 1e-9, "torque": [0.1, 0, 0], "save": [3.0]}
    run = mb.simulate(crank.dynamics(options=OWN), at_angle(0.0), np.zeros(3), 3.0, "rk853", **given)
    # 19 turns at 100 rad/s; the tolerance is that of each of 1200 steps.
    assert np.abs(np.array([run.q[0, 0], run.v[0, 0]]) / exact - 1).max() < 1e-7
    # Of angles of 122 rad, rounded.
    assert np.abs(crank.constraint(run.q)).max() < 1e-14


def test_symbols_stand_for_the_numbers_of_the_loop_too():
    model = mb.catalog.slider_crank(rod=0.5)
    assert {s.name: x for s, x in from_model(model).parameters.items()}["L2"] == 0.5
    # A pin inside the rod is another system, of numbers.
    inside = replace(model, loops=(replace(model.loops[0], translation_a=np.array([0.45, 0.0, 0.0])),))
    assert not from_model(inside).parameters


def test_andrews_squeezing_mechanism_is_the_published_one():
    """At its start; tests/test_published_mechanisms.py follows it to the printed end."""
    told = published()["andrews_squeezing_mechanism"]
    lag, zero = from_model(mb.catalog.andrews_squeezer()), np.zeros(7)
    tau = np.array([told["drive_torque_on_beta"], *np.zeros(6)])
    assert np.abs(lag.constraint(zero)).max() < 1e-16
    a, lam = (np.array([float(x) for x in told[n]]) for n in ("qdd0", "lambda0"))
    assert off(lag.dynamics(options=OWN).forward_dynamics(zero, zero, tau), a) < CLOSE
    # The test set's multipliers stand on the other side of the equation.
    assert off(lag.multipliers(zero, zero, tau), -lam) < CLOSE


# Andrews' squeezing mechanism: seven bodies, three loops


# Four bars: point and frame, in any plane


def four_bar(kind: str, R: np.ndarray | None = None) -> mb.Model:
    R = np.eye(3) if R is None else R
    b = mb.ModelBuilder("four_bar", gravity=R @ [0, -9.81, 0])
    bar(b, "a", 1.0)
    bar(b, "b", 2.0)
    b.add_joint("q1", "continuous", parent="world", child="a", rotation=R, **ABOUT_Z)
    b.add_joint("q2", "continuous", parent="a", child="b", translation=(1, 0, 0), **ABOUT_Z)
    half = 1.0 if kind == "point" else 0.5
    bar(b, "c", 1.5, part=half)
    # An axis that points the other way.
    b.add_joint("q3", "continuous", parent="world", child="c", axis=(0, 0, -1), rotation=R, translation=R @ [2, 0, 0])
    if kind == "point":
        b.add_loop("pin", "point", body_a="b", translation_a=(2, 0, 0), body_b="c", translation_b=(1.5, 0, 0))
    else:
        # The other half hangs on the coupler, and is welded to the first.
        bar(b, "d", 1.5, part=half)
        b.add_joint("q4", "continuous", parent="b", child="d", translation=(2, 0, 0), **ABOUT_Z)
        ends = {"body_a": "d", "translation_a": (0.75, 0, 0), "body_b": "c", "translation_b": (0.75, 0, 0)}
        b.add_loop("weld", "frame", **ends, rotation_b=np.diag([-1.0, -1, 1]))
    return b.build()


def test_a_four_bar_however_it_is_closed():
    save = np.linspace(0, 1.0, 3)
    lag = from_model(four_bar("point"))
    q, v = lag.project([1.2, -0.7, -1.6], [1.0, 0, 0])
    run = mb.simulate(lag.dynamics(options=OWN), q, v, 1.0, "rk853", rtol=1e-13, save=save)
    assert np.ptp(run.energy()) < 1e-12
    assert np.abs(lag.constraint(run.q)).max() < 1e-14
    embedded = mb.simulate(lag.embedded(), q, v, 0.5, "rk853", rtol=1e-11, save=[0.5])
    assert np.abs(embedded.q[0] - run.q[1]).max() < 1e-9
    tilted = Rotation.from_euler("xyz", [0.4, 0.3, -0.8]).as_matrix()
    # The welded half turns with the rod that it is a half of, and may have turned around before.
    turn = -(q[2] + q[0] + q[1]) + math.pi
    for k, (R, turns) in enumerate(((None, 0.0), (tilted, 2 * math.pi))):
        weld = from_model(four_bar("frame", R))
        assert len(weld.constraints) == 3
        assert str(weld.constraints[2]) == "2*cos(q1/2 + q2/2 + q3/2 + q4/2)"
        start = [*q, turn + turns], [*v, -v.sum()]
        dyn = weld.dynamics(options=OWN)
        accelerations = lag.dynamics(options=OWN).forward_dynamics(q, v, v * 0)
        assert off(dyn.forward_dynamics(*start, np.zeros(4))[:3], accelerations) < 1e-12
        if k == 0:
            other = mb.simulate(dyn, *start, 1.0, "rk853", rtol=1e-12, save=save)
            assert np.abs(other.q[:, :3] - run.q).max() < 1e-11
    assert np.abs(from_model(four_bar("point", tilted)).constraint(q)).max() < 1e-15


def ball_linkage(kind: str) -> mb.Model:
    """A crank, a ball joint, a coupler, a universal joint and a rocker whose axis is square to the crank's."""
    b = mb.ModelBuilder("linkage")
    bar(b, "crank", 0.4, thick=0.01)
    bar(b, "rocker", 0.8, thick=0.01)
    b.add_joint("q1", "continuous", parent="world", child="crank", **ABOUT_Z)
    b.add_joint("q3", "continuous", parent="world", child="rocker", axis=(0, 1, 0), translation=(1, 0.2, 0))
    bar(b, "coupler", 1.0, part=1.0 if kind == "point" else 0.5, thick=0.01)
    axes = {"axis": (0, 1, 0), "axis2": (0, 0, 1), "translation": (0.8, 0, 0)}
    b.add_joint("u", "universal", parent="rocker", child="coupler", **axes)
    if kind == "point":
        ends = {"translation_a": (1, 0, 0), "translation_b": (0.4, 0, 0)}
        b.add_loop("ball", "point", body_a="coupler", body_b="crank", **ends)
    else:
        bar(b, "half", 1.0, part=0.5, thick=0.01)
        b.add_joint("s", "spherical_zyx", parent="crank", child="half", translation=(0.4, 0, 0))
        ends = {"translation_a": (0.5, 0, 0), "translation_b": (0.5, 0, 0), "rotation_b": np.diag([-1.0, -1, 1])}
        b.add_loop("weld", "frame", body_a="coupler", body_b="half", **ends)
    for side in "ab":
        name = {"a": "coupler", "b": "crank" if kind == "point" else "half"}[side]
        b.add_frame(f"end_{side}", body=name, translation=ends[f"translation_{side}"])
    return b.build()


def pinocchios_jacobian(tree, q):
    """Return that of end a less end b's, linear then angular, in the world's axes."""
    return tree.jacobian(q, "end_a") - tree.jacobian(q, "end_b")


@pytest.fixture(scope="module")
def linkage():
    lag, model = from_model(ball_linkage("point")), ball_linkage("point").without("loops")
    return lag, model, *lag.project([0.3, -1.5, 3.76, -0.1], [1.0, 0, 0, 0])


def test_a_loop_in_space_has_the_tree_s_terms(linkage):
    lag, model, q, v = linkage
    dyn, pin, tau = lag.dynamics(options=OWN), mb.dynamics(model), np.array([0.3, -0.2, 0.5, 0.1])
    for other in (pin, mb.dynamics(model, "mujoco")):
        assert off(dyn.mass_matrix(q), other.mass_matrix(q)) < CLOSE
        assert off(dyn.nle(q, v), other.nle(q, v)) < CLOSE
    J = pinocchios_jacobian(pin, q)[:3]
    assert off(lag.constraint_jacobian(q), J) < CLOSE
    # What the tree's own equation leaves is Jᵀ λ.
    a, lam = dyn.forward_dynamics(q, v, tau), lag.multipliers(q, v, tau)
    assert off(pin.inverse_dynamics(q, v, a) - tau, J.T @ lam) < CLOSE


def loose(kind: str, gravity=(0.3, 0.2, -9.81)) -> mb.Model:
    """Return a body on three slides and three hinges, about z, y and x, whose origin a loop holds at the world's."""
    slides, hinges = np.eye(3), np.eye(3)[::-1]
    b, parent = mb.ModelBuilder("loose", gravity=gravity), "world"
    for k, (joint, axis) in enumerate([*(("prismatic", x) for x in slides), *(("revolute", x) for x in hinges)]):
        own = {"mass": 1.3, "com": (0.2, 0.1, -0.3), "inertia": (0.03, 0.02, 0.04)} if k == 5 else {"mass": 0.0}
        b.add_body(f"b{k}", **own)
        b.add_joint(f"j{k}", joint, parent=parent, child=f"b{k}", axis=axis)
        parent = f"b{k}"
    turned, across = Rotation.from_rotvec([0.7, -0.2, 0.4]), Rotation.from_rotvec([np.pi / 2, 0, 0])
    more = {"rotation_a": turned.as_matrix(), "rotation_b": turned.as_matrix()}
    if kind == "universal":
        more["rotation_b"] = (turned * across).as_matrix()
    if kind == "distance":
        more |= {"translation_a": -0.7 * more["rotation_a"][:, 2], "length": 0.7}
    b.add_loop("held", kind, body_a="world", body_b=parent, **more)
    return b.build(nonphysical="warn")


@pytest.mark.thorough("revolute", "cylindrical", "frame", "universal", "distance")
@pytest.mark.parametrize("kind", LOOP_KINDS)
def test_a_body_that_a_loop_holds_begins_to_move_as_newton_and_euler_say(kind):
    model = loose(kind)
    (loop,) = model.loops
    u, across = loop.rotation_a[:, 2], loop.rotation_a[:, :2]
    turns, slides = np.vstack([np.zeros((3, 3)), np.eye(3)]), np.vstack([np.eye(3), np.zeros((3, 3))])
    free = {
        "point": turns,
        "frame": turns[:, :0],
        "revolute": turns @ u[:, None],
        "universal": turns @ np.stack([u, loop.rotation_b[:, 2]], axis=1),
        "cylindrical": np.hstack([slides @ u[:, None], turns @ u[:, None]]),
        "prismatic": slides @ u[:, None],
        "distance": np.hstack([slides @ across, turns]),
    }[kind]
    m, c = 1.3, np.array([[0, 0.3, 0.1], [-0.3, 0, -0.2], [-0.1, 0.2, 0]])
    inertia = np.block([[m * np.eye(3), -m * c], [m * c, np.diag([0.03, 0.02, 0.04]) - m * c @ c]])
    weight = m * np.concatenate([model.gravity, c @ model.gravity])
    expected = free @ np.linalg.solve(free.T @ inertia @ free, free.T @ weight)
    a = from_model(model).dynamics(options=OWN).forward_dynamics(*np.zeros((3, 6)))
    # Hinges about z, y and x.
    assert a == pytest.approx(expected[[0, 1, 2, 5, 4, 3]], abs=1e-12)


@pytest.mark.thorough("universal", "prismatic", "point", "revolute", "distance")
@pytest.mark.parametrize("kind", LOOP_KINDS)
def test_every_kind_of_loop_has_the_rows_and_accelerations_of_the_engine(kind):
    model = loose(kind)
    engine, paper = mb.dynamics(model, "lagrangian", compile=False), from_model(model).dynamics(options=OWN)
    q, v = engine.project(np.array([0.1, -0.1, 0.05, 0.2, -0.1, 0.1]), np.array([1.0, -2, 0.5, 2, 1, -1]))
    tau = np.linspace(-1, 1, 6)
    moved = q + 0.1
    assert off(paper.constraint_residual(moved), engine.constraint_residual(moved)) < CLOSE
    assert off(paper.constraint_jacobian(q), engine.constraint_jacobian(q)) < CLOSE
    assert off(paper.forward_dynamics(q, v, tau), engine.forward_dynamics(q, v, tau)) < CLOSE


TILTED = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()


@pytest.mark.thorough("revolute-0-2", "prismatic-1-2")
@pytest.mark.parametrize(("kind", "turn", "rows"), [("revolute", 0, 2), ("cylindrical", 1, 2), ("prismatic", 1, 2)])
def test_a_loop_in_a_tilted_plane_has_the_rows_that_the_plane_leaves(kind, turn, rows):
    """Of named lengths too: what rounding leaves of directions is no row."""
    n, (e, f) = TILTED[:, 2], TILTED[:, :2].T
    b = mb.ModelBuilder("arm")
    for k, parent in enumerate(("world", "b0", "b1", "b2")):
        b.add_body(f"b{k}", mass=1.0, com=0.2 * e, inertia=(0.03, 0.02, 0.025))
        b.add_joint(f"j{k}", "revolute", parent=parent, child=f"b{k}", axis=n, translation=[P("L", 0.5) * x for x in e])
    frame = np.stack([[e, f, n], [f, n, e]][turn], axis=1)
    b.add_loop("end", kind, body_a="world", body_b="b3", translation_a=0.6 * e, rotation_a=frame, rotation_b=frame)
    model = b.build()
    engine, lag = mb.dynamics(model, "lagrangian", compile=False), from_model(model)
    q, v = engine.project(*model.random_state(1))
    assert len(lag.constraints) == rows
    paper = lag.dynamics(options=OWN)
    assert off(paper.forward_dynamics(q, v, np.ones(4)), engine.forward_dynamics(q, v, np.ones(4))) < CLOSE


@pytest.mark.thorough
def test_seven_joints_closed_in_space_are_judged_at_the_pose_that_is_given():
    E, links = np.eye(3), []
    for i, kind in enumerate("PRRRPRP"):
        place = {"axis": E[(2 * i + i // 3) % 3], "translation": 0.5 * E[i % 3] + 0.25 * (i % 2) * E[(i + 1) % 3]}
        links.append(place | {"kind": {"R": "revolute", "P": "prismatic"}[kind], "armature": 1.0 + i})
    tree, q = chain(*links, gravity=(0, 0, 0)).build(), np.array([0.3, -0.5, 0.7, 0.2, -0.4, 0.6, 0.9])
    X = mb.dynamics(tree).pose(q, "b6")
    loop = Loop("closed", "frame", "b6", E, np.zeros(3), "world", X[:3, :3], X[:3, 3])
    dyn = from_model(replace(tree, loops=(loop,))).dynamics(options=OWN)
    a = dyn.forward_dynamics(q, np.zeros(7), np.ones(7))
    # One freedom is left, along which M a = tau.
    J = manifold_of(dyn).jacobian(q)
    assert np.linalg.matrix_rank(J) == 6
    (free,) = null_space(J).T
    assert a == pytest.approx(free * (free.sum() / (free**2 @ np.arange(1.0, 8.0))), abs=1e-12)
    # The false closures that a search from elsewhere ends in, half a turn off, have dependent rows.
    with pytest.raises(InputError, match="redundant"):
        refuse_unreachable(dyn)


def test_a_plane_that_is_carried_along_stays_one():
    """A governor's two rods and sleeve on a shaft that turns."""
    b = mb.ModelBuilder("governor")
    b.add_body("shaft", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_joint("turn", "continuous", parent="world", child="shaft", **ABOUT_Z)
    bar(b, "upper", 0.5)
    bar(b, "lower", 0.5)
    b.add_joint("alpha", "continuous", parent="shaft", child="upper", axis=(0, 1, 0), translation=(0, 0, 1))
    b.add_joint("beta", "continuous", parent="upper", child="lower", axis=(0, 1, 0), translation=(0.5, 0, 0))
    b.add_body("sleeve", mass=1.0)
    b.add_joint("s", "prismatic", parent="shaft", child="sleeve", axis=(0, 0, 1))
    b.add_loop("pin", "point", body_a="lower", translation_a=(0.5, 0, 0), body_b="sleeve")
    lag = from_model(b.build())
    assert len(lag.constraints) == 2
    assert not any(lag.coordinates[0] in row.free_symbols for row in lag.constraints)
    assert lag.embedded().degrees == 2


# Motions in time


def driven_pendulum() -> mb.Model:
    b = mb.ModelBuilder("driven_pendulum")
    b.add_body("pivot")
    b.add_body("bob", mass=P("m", 1.0), com=(0, 0, -P("l", 1.0)))
    b.add_joint("z", "prismatic", parent="world", child="pivot", axis=(0, 0, 1))
    b.add_joint("theta", "continuous", parent="pivot", child="bob", axis=(0, -1, 0))
    b.prescribe("z", amplitude=P("a", 0.1), frequency=P("Omega", 100.0), phase=math.pi / 2)
    return b.build()


def test_a_pendulum_on_a_moved_pivot_is_the_textbook_s():
    lag, ref = from_model(driven_pendulum()), systems.driven_pendulum()
    assert [s.name for s in lag.coordinates] == ["theta"]
    assert {s.name: x for s, x in lag.parameters.items()} == {"m": 1.0, "l": 1.0, "a": 0.1, "Omega": 100.0}
    assert sp.expand(lag.T - ref.T) == 0
    assert sp.expand(lag.V - ref.V.subs(sp.Symbol("g"), 9.81)) == 0
    own, textbook = (x.dynamics(options=OWN, Omega=40.0) for x in (lag, ref))
    runs = [mb.simulate(dyn, [1.0], [0.3], 0.3, "rk853", save=[0.3]) for dyn in (own, textbook)]
    assert np.abs(runs[0].q - runs[1].q).max() < 1e-12


def test_the_multiplier_of_a_drive_is_its_force():
    lag = from_model(driven_pendulum(), drives=True)
    q, v = np.array([0.1, 0.7]), np.array([0.0, 0.4])
    a = lag.dynamics(options=OWN).forward_dynamics(q, v, [0, 0])
    assert a[0] == pytest.approx(-0.1 * 100.0**2, rel=1e-14)
    rise = a[0] + math.cos(0.7) * 0.4**2 + math.sin(0.7) * a[1]
    assert lag.multipliers(q, v)[0] == pytest.approx(9.81 + rise, rel=1e-13)
    # A slider-crank at constant speed has no freedom left, and its torque is the textbook's.
    driven = from_model(slider_crank(lambda b: b.prescribe("theta", rate=10.0)), drives=True)
    q, v = driven.project(at_angle(0.3), [10.0, 0, 0], t=0.03)
    expected = systems.rigid_slider_crank().dynamics(options=OWN).inverse_dynamics([0.3], [10.0], [0.0])
    assert driven.multipliers(q, v, t=0.03)[-1] == pytest.approx(expected[0] + 0.1, rel=1e-12)


@pytest.mark.thorough("7-3-0")
@pytest.mark.parametrize(("seed", "n", "which"), [(6, 2, 1), (7, 3, 0)])
def test_a_tree_with_a_prescribed_joint_is_the_tree_along_its_motion(seed, n, which):
    # The last joint; and one that another mimics, with a damper to the ground.
    tree = random_tree(seed, n, ("revolute", "prismatic", "helical"), mimic=n == 3, springs=n == 2, nearest=1)
    moved = tree.joint_names[which]
    given = {moved: (0.2, 0.7, 0.3, 2.0, 0.4)}
    lag = from_model(replace(tree, prescribed=tuple(Prescribed(n, *x) for n, x in given.items())))
    free = [i for i, n in enumerate(tree.coordinate_names) if n != moved]
    assert [s.name for s in lag.coordinates] == [tree.coordinate_names[i] for i in free]
    q, v, a = np.random.default_rng(0).standard_normal((3, tree.nv))
    t = 0.6
    for name, (offset, rate, size, frequency, phase) in given.items():
        i, turn = tree.coordinate_names.index(name), frequency * t + phase
        q[i], v[i] = offset + rate * t + size * math.sin(turn), rate + size * frequency * math.cos(turn)
        a[i] = -size * frequency**2 * math.sin(turn)
    own = lag.dynamics(options=OWN).at(t=t)
    ref = mb.dynamics(tree)
    assert off(own.inverse_dynamics(q[free], v[free], a[free]), ref.inverse_dynamics(q, v, a)[free]) < CLOSE
    assert off(own.mass_matrix(q[free]), ref.mass_matrix(q)[np.ix_(free, free)]) < CLOSE
    assert own.kinetic_energy(q[free], v[free]) == pytest.approx(v @ ref.mass_matrix(q) @ v / 2, rel=CLOSE)


def test_a_loop_of_which_one_joint_is_moved():
    lag = from_model(slider_crank(lambda b: b.prescribe("theta", offset=0.2, rate=3.0)))
    assert lag.time == sp.Symbol("t")
    q, v = lag.project(at_angle(0.2)[1:], [0.0, 0.0])
    for method, how in (("rk4", {"dt": 0.01}), ("rodas5", {"rtol": 1e-9})):
        run = mb.simulate(lag.dynamics(options=OWN), q, v, 1.0, method, save=[0.5, 1.0], **how)
        # Its constraints say all of it, whatever the method.
        assert np.abs(run.q - [at_angle(0.2 + 3 * t)[1:] for t in run.t]).max() < 1e-14


# What cannot be


def another(kind, body_a="rod", body_b="world", **more):
    return lambda b: b.add_loop("other", kind, body_a=body_a, body_b=body_b, **more)


def with_plate(b):
    b.add_body("plate")
    b.add_joint("fixed", "fixed", parent="piston", child="plate")


FLIP = np.diag([1.0, -1, -1])
REFUSED = {
    "across the plane": ([another("point", translation_a=(0.3, 0, 0.1))], "'other': its points never meet.*: 0.1 is"),
    "by a parameter": ([another("point", translation_a=(0.3, 0, P("d")))], "never meet.*: d is left"),
    "another plane": ([another("frame", rotation_b=FLIP)], "its frames are never parallel.*rotation_a"),
    "turned": ([another("frame", body_a="piston", rotation_b=np.diag([-1.0, -1, 1]))], "never parallel"),
    "rigid": ([with_plate, another("frame", body_a="piston", body_b="plate")], "'other' closes nothing"),
    "moved open": (
        [lambda b: b.prescribe("x", rate=1.0), another("point", body_a="piston")],
        "'other': the prescribed motions alone move it.*t = 0",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_loop_that_cannot_close_is_told(case):
    changes, told = REFUSED[case]
    with pytest.raises(InputError, match=f"slider_crank: loop {told}" if told[0] == "'" else told):
        from_model(slider_crank(*changes))


def test_faults_of_loops_and_motions_and_what_nothing_is_left_of_are_refused():
    with pytest.raises(ModelError, match="both ends on 'rod'"):
        slider_crank(another("point", body_b="rod"))
    with pytest.raises(ModelError, match="prescribed 'theta': moved 2 times"):
        slider_crank(*[lambda b: b.prescribe("theta", rate=1.0)] * 2)
    moves = [lambda b, n=n: b.prescribe(n, rate=1.0) for n in ("theta", "phi", "x")]
    with pytest.raises(UnsupportedError, match="drives=True"):
        from_model(slider_crank(*moves).without("loops"))
    twice = from_model(slider_crank(another("point", translation_a=(P("L2", 0.3), 0, 0), body_b="piston")))
    with pytest.raises(InputError, match="4 of them for 3 coordinates"):
        twice.embedded()


def test_the_truth_of_the_four_bar_has_the_accelerations_of_the_derivation():
    """J(θ) θ̈ + ½ J' θ̇² + V' = 0 in closed form, beside multipliers, all around the circle."""
    model = bare.described()
    dyn = from_model(model).dynamics(options=OWN)
    for theta in np.linspace(-3.0, 3.0, 7):
        (phi, psi), first, second = bare.geometry(np.longdouble(theta))
        rate = np.longdouble(2.5)
        a, _ = bare.acceleration(np.longdouble(theta), rate)
        q = np.array([theta, phi - theta, psi], dtype=float)
        v = np.array([rate, (first[0] - 1) * rate, first[1] * rate], dtype=float)
        exact = np.array([a, second[0] * rate**2 + (first[0] - 1) * a, second[1] * rate**2 + first[1] * a], dtype=float)
        assert bare.opened(q[None])[0] < 1e-15
        assert np.abs(dyn.forward_dynamics(q, v, np.zeros(3)) - exact).max() < 1e-12 * np.abs(exact).max()


@pytest.mark.parametrize(
    ("name", "q"),
    [
        ("four_bar", [-1.1, -2.1, -4.6]),
        ("slider_crank", [1.6, 2.8, -0.2]),
        ("five_bar", [-0.5, 1.9, 2.4, -1.7]),
        ("planar_3rrr", [-0.1, 0.5, 0.7, -0.5, -4.2, 0.2, -0.1, -2.0, -1.7]),
    ],
)
def test_a_projection_from_afar_is_a_foot_of_its_start(name: str, q: list[float]) -> None:
    """M (x - q) stands on every motion at x; whole steps, and halves of them, go to and fro about it."""
    dyn = mb.dynamics(getattr(mb.catalog, name)(), "lagrangian", compile=False)
    x, _ = dyn.project(q, np.zeros(len(q)))
    J = dyn.constraint_jacobian(x)
    motions = np.linalg.svd(J)[2][len(J) :]
    assert np.abs(dyn.constraint_residual(x)).max() < 1e-14
    assert np.abs(motions @ dyn.mass_matrix(q) @ (x - q)).max() < 1e-11


def test_a_random_state_hangs_little_on_its_draw(monkeypatch) -> None:
    """So that rounding does not choose it; most draws are taken."""
    model = mb.catalog.slider_crank()
    manifold, rng, aside = (
        states_of(model).manifold,
        np.random.default_rng(0),
        1e-8 * np.random.default_rng(1).standard_normal(3),
    )
    well, taken = 0.3 * manifold.apartness(manifold.equations.row_choice.closed), []
    for _ in range(150):
        q, v = random_state(model, rng)
        if (state := flowed(manifold, q, v, well)) is not None:
            taken.append((q, v, state[0]))
    assert len(taken) > 120
    monkeypatch.setattr("mbkit.engines.applications.random_states._SLOPE", np.inf)
    moved = [flowed(manifold, q + aside, v, 0.0)[0] - end for q, v, end in taken]
    assert np.linalg.norm(moved, axis=1).max() < 1e3 * np.linalg.norm(aside)


def test_random_states_are_off_singular_poses_and_need_no_projection(monkeypatch) -> None:
    """Rounding would choose where a projection from afar ends."""
    model = mb.catalog.five_bar()
    manifold = states_of(model).manifold
    monkeypatch.setattr(type(manifold), "project", None)
    least = 0.3 * manifold.apartness(manifold.equations.row_choice.closed)
    assert min(manifold.apartness(q) for q in model.random_state(0, 30)[0]) > least


def test_random_states_of_many_loops_are_found_nearer_to_a_closed_one_and_are_not_all_there() -> None:
    assert np.isfinite(mb.catalog.bricard().random_state(0, 2)[0]).all()
    assert 0.2 < np.std(mb.catalog.four_bars(n=6).random_state(0, 12)[0], axis=0).mean() < 2.0
