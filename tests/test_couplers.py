"""Couplers of several leaders: random trees on every engine, epicyclic trains, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.errors import InputError, ModelError, UnsupportedError
from mbkit.model import Coupler
from mbkit.studies.baseline.description import changes, described
from mbkit.studies.importers.study import Written, between_joints, coupler_differences
from tests.random_trees import IN_MUJOCO, coupled, off, random_tree
from tests.scenes import chain
from tests.test_loops_pinocchio import against_34_digits
from validation.closed_forms import differential, epicyclic_train

OWN = {"compile": False}
RIGID = ("oracle", "lagrangian", "pinocchio")
SEEDS = range(2)


def dynamics(model: mb.Model, engine: str, **options: Any) -> mb.Dynamics:
    return mb.dynamics(model, engine, **(OWN if engine == "lagrangian" else {}), **options)


def tree_of(seed: int) -> mb.Model:
    return random_tree(seed, 9, IN_MUJOCO, nearest=3)


def rows_of(model: mb.Model) -> np.ndarray:
    """Return the couplers' rows, from their numbers alone."""
    out, at = np.zeros((len(model.couplers), model.nv)), model.layout.v
    for row, x in zip(out, model.couplers, strict=True):
        row[at[x.joint]] = 1.0
        for name, ratio in zip(x.leaders, x.ratios, strict=True):
            row[at[name]] -= ratio
    return out


def null_space(J: np.ndarray) -> np.ndarray:
    return np.linalg.svd(J)[2][np.linalg.matrix_rank(J) :].T


def eliminated(model: mb.Model, J: np.ndarray, q: np.ndarray, v: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Return v̇ under constant rows J by elimination, v = N u, from Pinocchio's terms of the tree."""
    tree, N = mb.dynamics(model.without("loops"), "pinocchio"), null_space(J)
    right = tau + tree.passive(q, v) - tree.nle(q, v)
    return N @ np.linalg.solve(N.T @ tree.mass_matrix(q) @ N, N.T @ right)


def state(model: mb.Model, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q and v that satisfy the couplers, and forces."""
    rng = np.random.default_rng([seed, 97])
    q, v = dynamics(model, "oracle").project(*model.random_state(rng))
    return q, v, rng.standard_normal(model.nv)


# Random trees


@pytest.mark.thorough("0")
@pytest.mark.parametrize("seed", SEEDS)
def test_every_engine_moves_a_random_tree_as_elimination_does(seed: int) -> None:
    model = coupled(tree_of(seed), seed)
    q, v, tau = state(model, seed)
    J, moving = rows_of(model), model.integrate(q, 0.1 * tau)
    offsets = [x.offset for x in model.couplers]
    a = eliminated(model, J, q, v, tau)
    for engine in RIGID:
        dyn = dynamics(model, engine)
        assert dyn.constraint_names == tuple(f"coupler {x.name!r}" for x in model.couplers)
        assert np.array_equal(dyn.constraint_jacobian(moving), J)
        assert off(dyn.constraint_rate(moving, v), J @ v) < 1e-14
        assert not dyn.constraint_bias(moving, v).any()
        opened = J @ model.difference(q, moving)
        assert off(dyn.constraint_residual(moving), opened) < 1e-13
        assert np.linalg.norm(offsets) > 0
        assert off(dyn.forward_dynamics(q, v, tau), a) < 1e-11
        assert off(dyn.generalized_constraint_force(q, v, tau), J.T @ dyn.constraint_forces(q, v, tau)) < 1e-13
        left = dyn.newton_euler_residual(q, v, dyn.forward_dynamics(q, v, tau), tau)
        assert np.abs(left).max() < 1e-11 * max(1.0, np.abs(a).max())
    against_34_digits(model, q, seed, "LAPACK")


def test_a_file_says_the_same(tmp_path: Path) -> None:
    models = [coupled(tree_of(seed), seed) for seed in range(4)]
    # One leader is an equality of two joints there, and several are one of a tendon.
    assert {len(x.leaders) > 1 for model in models for x in model.couplers} == {False, True}
    for k, model in enumerate(models):
        assert mb.load(mb.convert(model, "mjcf").write(tmp_path / f"{k}.xml")).couplers == model.couplers


@pytest.mark.parametrize("seed", SEEDS)
def test_locked_joints_leave_the_rest_of_the_sum(seed: int) -> None:
    model = coupled(tree_of(seed), seed, 3)
    rng = np.random.default_rng([seed, 5])
    q, _, tau = state(model, seed)
    tied = sorted({name for x in model.couplers for name in (x.joint, *x.leaders)})
    names = [str(x) for x in rng.permutation(tied)[: 1 + seed % 3]]
    reduced = model.lock(names, q)
    kept = [i for name in reduced.joint_names for i in range(*model.layout.v[name].indices(model.nv))]
    left = [i for i in range(model.nv) if i not in kept]
    held = np.concatenate([rows_of(model), np.eye(model.nv)[left]])
    v = null_space(held) @ rng.standard_normal(null_space(held).shape[1])
    small_q, small_v = reduced.reduced_state(q, v)
    assert np.allclose(reduced.full_state(small_q)[0], q, rtol=0, atol=1e-12)
    dyn = dynamics(reduced, "lagrangian")
    if reduced.couplers:
        assert np.abs(dyn.constraint_residual(small_q)).max() < 1e-12
    assert off(dyn.forward_dynamics(small_q, small_v, tau[kept]), eliminated(model, held, q, v, tau)[kept]) < 1e-10
    # What is locked with them is what then follows, and no more.
    assert np.linalg.matrix_rank(held) == len(left) + np.linalg.matrix_rank(rows_of(reduced))


# Epicyclic trains

TEETH = (20, 60)
INERTIAS = {"sun": 0.1, "carrier": 0.5, "ring": 0.8}
PLANET = 0.02


def train(planets: int = 0) -> mb.Model:
    """Return sun, carrier and ring on one axis; without planets one row holds all three."""
    b = mb.ModelBuilder("train", gravity=(0, 0, 0))
    for name, inertia in INERTIAS.items():
        b.add_body(name, mass=1.0, inertia=(inertia,) * 3)
        b.add_joint(name, "revolute", parent="world", child=name, axis=(0, 0, 1))
    sun, ring = TEETH
    for k in range(planets):
        # A point mass in the carrier's inertia is taken off it here.
        b.add_body(f"planet{k}", mass=0.3, inertia=(PLANET,) * 3)
        turn = 2 * np.pi * k / planets
        at = 0.4 * np.array([np.cos(turn), np.sin(turn), 0])
        b.add_joint(f"planet{k}", "revolute", parent="carrier", child=f"planet{k}", translation=at, axis=(0, 0, 1))
        ratio = sun / ((ring - sun) / 2)
        b.add_coupler(f"inner{k}", f"planet{k}", ("sun", "carrier"), ratio=(-ratio, ratio))
        b.add_coupler(f"outer{k}", "ring", ("carrier", f"planet{k}"), ratio=(1.0, (ring - sun) / 2 / ring))
    if not planets:
        b.add_coupler("gears", "ring", ("carrier", "sun"), ratio=(1 + sun / ring, -sun / ring))
    return b.build()


@pytest.mark.thorough("torque0-0", "torque0-1", "torque0-3", "torque1-3", "torque2-3")
@pytest.mark.parametrize("planets", [0, 1, 3])
@pytest.mark.parametrize("torque", [(1.0, 0.5, 0.0), (0.0, -2.0, 0.7), (1.5, 0.0, 0.2)])
def test_an_epicyclic_train_has_the_accelerations_of_the_closed_form(planets: int, torque: Any) -> None:
    model = train(planets)
    carrier = INERTIAS["carrier"] + planets * 0.3 * 0.4**2
    exact, on_ring = epicyclic_train(
        TEETH, (INERTIAS["sun"], carrier, INERTIAS["ring"]), (planets, PLANET), np.array(torque)
    )
    tau, zero = np.array([*torque, *[0.0] * planets]), np.zeros(model.nv)
    for engine in RIGID:
        dyn = dynamics(model, engine)
        mobility = dyn.mobility()
        assert (mobility.degrees_of_freedom, len(model.couplers)) == (2, max(1, 2 * planets))
        a = dyn.forward_dynamics(zero, zero, tau)
        assert off(a[:3], exact) < 1e-12
        # Willis: beside the carrier, sun and ring turn against each other as their teeth are.
        assert (a[0] - a[1]) * TEETH[0] == pytest.approx(-(a[2] - a[1]) * TEETH[1], rel=1e-12)
        # On sun and carrier alone: what drives them to this motion, and the inertia that they feel.
        drives = dyn.actuator_forces(zero, zero, a, ["sun", "carrier"]).tau[:2]
        assert drives == pytest.approx([tau[0] - tau[2] / 3, tau[1] + tau[2] * 4 / 3], abs=1e-12)
        J, *_ = dyn.reduced_inertia(zero, ["sun", "carrier"])
        assert off(J @ exact[:2], drives) < 1e-12
        force = dyn.generalized_constraint_force(zero, zero, tau)
        assert force[2] == pytest.approx(on_ring, rel=1e-12)
        # The gears do no work, and have no resultant moment beside what the carrier's bearings take.
        assert force[:2] @ exact[:2] + force[2:] @ a[2:] == pytest.approx(0.0, abs=1e-12)
        if not planets:
            # In each leader its ratio of the multiplier acts.
            assert dyn.constraint_forces(zero, zero, tau) == pytest.approx([on_ring], rel=1e-12)
            assert force[:2] == pytest.approx([on_ring / 3, -on_ring * 4 / 3], rel=1e-12)
            loads = dyn.joint_wrenches(zero, zero, None, tau=tau)
            assert loads[:, 5] == pytest.approx(tau + force, rel=1e-12)
    run = mb.simulate(mb.dynamics(model, "lagrangian"), zero, zero, 1.0, dt=0.01, torque=tau)
    assert off(run.q[-1, :3], exact / 2) < 1e-12
    assert off(run.v[-1, :3], exact) < 1e-12


def test_a_differential_shares_the_torque() -> None:
    b = mb.ModelBuilder("differential", gravity=(0, 0, 0))
    for name, inertia in (("left", 1.2), ("right", 1.2), ("ring", 0.7)):
        b.add_body(name, mass=1.0, inertia=(inertia,) * 3)
        b.add_joint(name, "revolute", parent="world", child=name, axis=(0, 1, 0))
    b.add_coupler("gears", "ring", ["left", "right"], ratio=0.5)
    model = b.build()
    assert model.couplers[0].ratios.tolist() == [0.5, 0.5]
    for torque in ((0.0, 0.0, 3.0), (-1.0, 0.2, 3.0), (1.0, -1.0, 0.0)):
        exact = differential(1.2, 0.7, np.array(torque))
        for engine in RIGID:
            a = dynamics(model, engine).forward_dynamics(np.zeros(3), np.zeros(3), torque)
            assert off(a, exact) < 1e-12
    # One wheel is held: the other turns twice as fast as the ring.
    held = model.lock({"left": 0.0})
    assert (held.couplers[0].leader, held.couplers[0].ratio) == ("right", 0.5)
    # The ring is held: the wheels turn against each other.
    held = model.lock({"ring": 0.0})
    assert (held.couplers[0].joint, held.couplers[0].leader, held.couplers[0].ratio) == ("left", "right", -1.0)


@pytest.mark.thorough("constraints")
@pytest.mark.parametrize("rows", ["constraints", "velocity_constraints", "model"])
def test_an_epicyclic_train_on_paper(rows: str) -> None:
    q, v, torque = sp.symbols("sun carrier ring"), sp.symbols("w_s w_c w_r"), np.array([1.0, 0.5, 0.0])
    I_s, I_c, I_r, z_s, z_r = sp.symbols("I_s I_c I_r z_s z_r", positive=True)
    values = dict(zip((I_s, I_c, I_r, z_s, z_r), (*INERTIAS.values(), *TEETH), strict=True))
    x = v if rows == "velocity_constraints" else q
    willis = z_s * (x[0] - x[1]) + z_r * (x[2] - x[1])
    if rows == "model":
        lag = mb.lagrangian.from_model(train())
        (row,) = lag.constraints
        assert sp.simplify(row * TEETH[1] - willis.subs(values)) == 0
    else:
        T = sum(i * w**2 for i, w in zip((I_s, I_c, I_r), v, strict=True)) / 2
        lag = mb.lagrangian.Lagrangian(T, 0, q, v, parameters=values, name="train", **{rows: [willis]})
    exact, _ = epicyclic_train(TEETH, tuple(INERTIAS.values()), (0, PLANET), torque)
    zero = np.zeros(3)
    assert off(lag.dynamics(options=OWN).forward_dynamics(zero, zero, torque), exact) < 1e-12
    if rows == "constraints":
        run = mb.simulate(lag.embedded(["sun", "carrier"]), zero, zero, 1.0, "rk853", torque=torque, rtol=1e-12)
        assert off(run.q[-1], exact / 2) < 1e-12
        # A blow on the sun: every body takes what a torque of one second would give.
        blow, _ = epicyclic_train(TEETH, tuple(INERTIAS.values()), (0, PLANET), np.array([1.0, 0.0, 0.0]))
        after = mb.impact(lag.dynamics(options=OWN), zero, zero, impulse=[1.0, 0.0, 0.0]).v
        assert off(after, blow) < 1e-12
    # Of the two degrees of freedom each has a momentum that is kept.
    kept = [c for c in lag.conserved_quantities() if "symmetry" in str(c)]
    assert len(kept) == 2


# Other readings


def differ(a: Coupler, b: Coupler) -> list[tuple[float, str, str]]:
    names = {x: x for x in "abc"}
    model = mb.catalog.double_pendulum()
    (a,), (b,) = (between_joints(model, [x], names) for x in (a, b))
    return coupler_differences(Written([a], [a]), model, [b], 1e-12)


def test_a_row_is_the_same_whichever_of_its_joints_is_called_the_first() -> None:
    written = Coupler("c", "b", ("a", "c"), np.array([2.0, -0.5]), 0.3)
    # b = 2 a - c/2 + 0.3, solved for each of its joints.
    for other in (
        Coupler("", "b", ("c", "a"), np.array([-0.5, 2.0]), 0.3),
        Coupler("", "a", ("b", "c"), np.array([0.5, 0.25]), -0.15),
        Coupler("", "c", ("a", "b"), np.array([4.0, -2.0]), 0.6),
    ):
        assert differ(written, other) == []
        ((size, where, says),) = differ(written, replace(other, offset=other.offset + 1e-3))
        assert 1e-4 < size < 1e-2
        assert where == "'c' (of 'a', 'b' and 'c')"
        assert says.startswith("a = 0.5 b + 0.25 c - 0.1")
    assert [says for *_, says in differ(written, Coupler("", "b", "a", 2.0, 0.3))] == ["missing", "not in the file"]


def test_another_ratio_is_told_with_all_leaders() -> None:
    one = train()
    other = replace(one, couplers=(replace(one.couplers[0], ratio=np.array([4 / 3, -0.25])),))
    (cause,) = mb.explain(one, other).acting
    assert "has ring = 1.33333 carrier - 0.25 sun for ring = 1.33333 carrier - 0.333333 sun" in cause.says
    (change,) = changes(described(one), described(other))
    assert change.text == "ratio of coupler gears: 1 -0.333333 → -0.25"
    alone = replace(one, couplers=(Coupler("gears", "ring", "sun"),))
    texts = [x.text for x in changes(described(alone), described(one))]
    assert texts[0] == "leader of coupler gears: sun → carrier, sun"
    assert texts[1].startswith("ratio of coupler gears: 1.0 → [1.33333")


def test_one_leader_has_one_form() -> None:
    plain = Coupler("c", "a", "b", 2.0, 0.1)
    several = Coupler("c", "a", ("b",), np.array([2.0]), 0.1)
    assert several == plain
    assert hash(several) == hash(plain)
    assert (several.leader, several.ratio) == ("b", 2.0)
    assert Coupler("c", "a", ("b", "d"), 0.5).ratios.tolist() == [0.5, 0.5]
    for leaders in ("j1", ["j1"], ("j1",)):
        b = chain(*[{"mass": 1.0, "inertia": (0.1,) * 3, "axis": (0, 1, 0), "parent": "world"}] * 3)
        b.add_coupler("c", "j0", leaders, ratio=mb.Parameter("r", 2.0))
        b.set_coupler("c", ratio=[3.0])
        assert b.build().couplers == (Coupler("c", "j0", "j1", 3.0),)


# What is refused


@pytest.mark.parametrize(
    ("leader", "more", "words"),
    [
        ((), {}, "coupler 'gear': leader: expected a joint or several, got none"),
        (("j1", "j1"), {}, "leader 'j1' stands 2 times; give one ratio, the sum"),
        (("j1", "turn"), {}, "expected joints of one velocity that mimic none, got 'turn'"),
        (("j1", 3), {}, r"coupler 'gear': leader\[1\]: expected a name, got 3"),
        (("j1", "j2"), {"ratio": (1.0, 2.0, 3.0)}, r"coupler 'gear': ratio: expected shape \(2,\), got \(3,\)"),
        (("j1", "j2"), {"ratio": (0.0, 0.0)}, "ratio is zero for all leaders"),
        (("j1", "j2"), {"curve": (0.1, 0, 0)}, "curve with 2 leaders; a curve is of one leader"),
    ],
)
def test_what_is_no_coupler_is_refused_by_name(leader: Any, more: dict[str, Any], words: str) -> None:
    wheel = {"mass": 1.0, "com": (0.1, 0.1, 0), "inertia": (0.1,) * 3, "axis": (0, 1, 0), "parent": "world"}
    b = chain(wheel, wheel, wheel, {**wheel, "joint": "turn", "kind": "ball", "axis": None})
    b.add_coupler("gear", "j0", leader, **more)
    with pytest.raises(ModelError, match=words) as caught:
        b.build()
    # A faulty number brings no other fault along.
    assert ("zero for all" in str(caught.value)) is ("zero for all" in words)


def test_what_cannot_be_held_or_solved_is_refused_by_name() -> None:
    model = train()
    with pytest.raises(UnsupportedError, match="coupler 'gears' has several leaders, and Drake takes one alone"):
        mb.simulate(mb.dynamics(model, "drake"), np.zeros(3), np.zeros(3), 0.01, "drake_sap", dt=1e-3)
    b = mb.ModelBuilder.of(model)
    b.set_coupler("gears", ratio=(mb.Parameter("a", 0.0), mb.Parameter("b", 2.0)))
    free = b.build()
    # The ratio that is not zero is solved for, with its parameter.
    held = free.lock({"ring": 0.5})
    assert (held.couplers[0].joint, held.couplers[0].leader) == ("sun", "carrier")
    assert held.with_parameters(a=3.0, b=-2.0).couplers[0].ratio == 1.5
    assert held.with_parameters(a=3.0, b=-2.0).couplers[0].offset == -0.25
    with pytest.raises(InputError, match="coupler 'gears' has a parameter"):
        free.lock({"ring": 0.5, "sun": 0.25})
    with pytest.raises(InputError, match="does not tell 'carrier' from 'ring'; lock 'carrier' instead"):
        free.with_parameters(a=0.0, b=2.0).lock({"ring": 0.5, "sun": 0.25})
    with pytest.raises(InputError, match="asks for 'ring' at"):
        model.lock({"ring": 0.5, "sun": 0.25, "carrier": 0.1})
