"""MuJoCo's own friction loss by its written law, and what studies say of robots with dry friction."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.mujoco import engine
from mbkit.engines.mujoco.constraints import stiffest
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.errors import InputError, MbkitWarning, UnsupportedError
from mbkit.identify import filtered_motion
from mbkit.model import Model
from mbkit.studies.compare.terms import OWN_LAW
from mbkit.studies.reference_motions import reference
from tests.random_trees import IN_MUJOCO, random_tree


def rubbing(model: Model, seed: int = 0, **more: float) -> Model:
    """Return a model with dry friction at each joint of one velocity."""
    rng = np.random.default_rng(seed)

    def rubbed(j: mb.Joint) -> mb.Joint:
        numbers = {name: np.array([x]) for name, x in more.items()}
        return replace(j, friction=rng.uniform(0.1, 2.0, 1), **numbers) if j.type.nv == 1 else j

    return replace(model, joints=tuple(rubbed(j) for j in model.joints))


def soft(model: Model, **options: object) -> MujocoDynamics:
    dyn = mb.dynamics(model, "mujoco", soft_friction=True, **options)
    assert isinstance(dyn, MujocoDynamics)
    return dyn


def states(model: Model, n: int, seed: int = 0) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield states that slide, creep and rest, under weak and strong forces."""
    rng = np.random.default_rng(seed)
    for k in range(n):
        q, v = model.random_state(rng)
        yield (
            q,
            v * rng.choice([0.0, 1e-3, 1.0], model.nv) ** (k % 2),
            rng.choice([0.1, 10.0]) * rng.standard_normal(model.nv),
        )


@pytest.fixture(autouse=True)
def _told_before(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "_TOLD", set())


OPTIONS = {"default": {}, "stiffest": stiffest(1e-3), "direct": {"solref": (-300.0, -40.0)}}


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
@pytest.mark.parametrize("seed", range(6))
def test_accelerations_are_those_of_the_written_law(seed: int, options: dict[str, object]) -> None:
    model = rubbing(random_tree(seed, 6, kinds=IN_MUJOCO), seed)
    dyn, exact = soft(model, **options), mb.dynamics(model, "mujoco")
    for q, v, tau in states(model, 12, seed):
        said, done = dyn.constraint_law(q, v, tau), dyn.forward_dynamics(q, v, tau)
        # Solutions with M lose its condition.
        allowed = 1e-12 + 1e-15 * np.linalg.cond(dyn.mass_matrix(q))
        assert np.linalg.norm(said.acceleration - done) <= allowed * np.linalg.norm(done)
        ours = exact.forward_dynamics(q, v, tau)
        assert np.linalg.norm(said.rigid - ours) <= allowed * max(1.0, np.linalg.norm(ours))
        assert (
            np.abs(said.force) <= dyn.mj_model.dof_frictionloss[dyn.mj_model.dof_frictionloss > 0] * (1 + 1e-12)
        ).all()


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
def test_a_block_at_rest_creeps_and_less_the_stiffer_the_law() -> None:
    model = rubbing(mb.catalog.pendulum())
    tau = 0.5 * model.joints[0].friction - mb.dynamics(model, "mujoco").gravity([0.0])
    errors = []
    for options in ({}, stiffest(1e-3)):
        dyn = soft(model, **options)
        creeping = dyn.forward_dynamics([0.0], [0.0], tau)
        law = dyn.constraint_law([0.0], [0.0], tau)
        (R,), M = law.regularizer, dyn.mass_matrix([0.0])[0, 0]
        # (1/M + R) f = -τ/M at rest: what is left of τ is R / (1/M + R) of it.
        assert np.allclose(creeping, tau / M * R / (1 / M + R), rtol=1e-12)
        assert (law.rigid == 0).all()
        errors.append(abs(creeping[0]))
    assert 0 < errors[1] < 2e-3 * errors[0]


def test_softness_is_warned_of_once_and_survives_copies() -> None:
    model = rubbing(mb.catalog.double_pendulum())
    q, v = model.random_state(0)
    with pytest.warns(MbkitWarning, match="holds dry friction by soft constraints"):
        a = soft(model).forward_dynamics(q, v, [0.1, 0.2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for dyn in (pickle.loads(pickle.dumps(soft(model))), soft(model).at()):
            assert (dyn.forward_dynamics(q, v, [0.1, 0.2]) == a).all()
    assert "FRICTIONLOSS" not in soft(model).disabled
    assert not soft(mb.catalog.double_pendulum())._soft_jumps
    with pytest.raises(InputError, match="soft_friction: expected True or False, got 2"):
        mb.dynamics(model, "mujoco", soft_friction=2)


@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
def test_own_integrators_step_the_soft_law_as_our_formulas_do() -> None:
    model = rubbing(mb.catalog.double_pendulum())
    dyn, (q, v) = soft(model), model.random_state(1)
    for own, ours in (("mujoco_rk4", "rk4"), ("mujoco_euler", "semi_implicit_euler")):
        a, b = (mb.simulate(dyn, q, v, 0.5, method, 1e-3) for method in (own, ours))
        assert np.abs(a.q - b.q).max() < 1e-12
    # The soft motion is another one.
    assert np.abs(mb.simulate(mb.dynamics(model, "mujoco"), q, v, 0.5, "rk4", 1e-3).q[-1] - b.q[-1]).max() > 1e-3


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda m: rubbing(m, stiction=3.0), "'theta1' has stiction .* no static friction and no Stribeck curve"),
        (lambda _: rubbing(mb.catalog.slider_crank()), "loops and friction at once"),
        (lambda _: mb.load("tiago_pro"), "a mimic joint is held softly"),
    ],
)
def test_what_friction_loss_is_not_is_refused_by_name(change: object, why: str) -> None:
    with pytest.raises(UnsupportedError, match=why):
        soft(change(mb.catalog.double_pendulum()))  # type: ignore[operator]


def test_exact_friction_is_no_motion_of_own_integrators() -> None:
    model = rubbing(mb.catalog.double_pendulum())
    dyn, (q, v) = mb.dynamics(model, "mujoco"), model.random_state(0)
    with pytest.raises(UnsupportedError, match="'mujoco', soft_friction=True"):
        mb.simulate(dyn, q, v, 0.1, "mujoco_rk4", 1e-3)
    with pytest.raises(UnsupportedError, match="do not hold all of double_pendulum: joint 'theta1' has dry friction"):
        dyn.rollout("rk4", q, v, 1e-3, None, 10)
    with pytest.raises(UnsupportedError, match="moreau: solves exact dry friction"):
        mb.simulate(soft(model), q, v, 0.1, "moreau", 1e-3)


# Studies


@pytest.mark.thorough("True")
@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
@pytest.mark.parametrize("floating", [False, True])
def test_a_comparison_judges_friction_at_speed_at_rest_and_by_the_soft_law(floating: bool) -> None:
    model = mb.load("z1", floating_base=floating)
    result = mb.compare(model, samples=4, terms_only=True)
    assert result.passed, result.verdict
    (row,) = (r for r in result.rows if r.term == "forward dynamics" and r.engine == "mujoco")
    assert row.reference == OWN_LAW
    assert "mujoco holds dry friction softly, and agrees with its own law of it" in result.verdict
    assert result.softness["mujoco"] < 3


@pytest.mark.thorough("slider_crank")
@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
@pytest.mark.parametrize("name", ["slider_crank", "double_pendulum"])
def test_a_comparison_says_where_exact_friction_stands_in(name: str) -> None:
    """Forces of loops counted friction twice in Pinocchio, and loads not at all; the oracle lost the wrenches."""
    more = {} if name == "slider_crank" else {"stiction": 3.0}
    result = mb.compare(rubbing(getattr(mb.catalog, name)(), **more), samples=4, terms_only=True)
    assert result.passed, result.verdict
    assert "not compared: dry friction as mujoco holds it" in result.verdict


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::mbkit.errors.MbkitWarning")
def test_rollouts_and_run_times_of_a_robot_with_friction() -> None:
    model = rubbing(mb.catalog.double_pendulum())
    result = mb.compare(model, samples=2)
    assert result.passed, result.verdict
    assert "no rollouts" not in result.verdict
    assert result.precision is not None
    assert "are without dry friction" in result.verdict


def test_a_reference_goes_through_changes_of_sign() -> None:
    model = rubbing(mb.catalog.pendulum())
    t = np.linspace(0.0, 3.0, 7)
    truth = reference(model, [1.0], [0.0], 3.0, t)
    assert truth.horizon == 3.0
    assert truth.digits > 11


def test_loads_of_a_mechanism_with_friction_at_rest_are_refused() -> None:
    model = rubbing(mb.catalog.slider_crank())
    for name in ("lagrangian", "pinocchio"):
        dyn = mb.dynamics(model, name)
        q, v = dyn.project([0.5, -0.2, -0.1], [1.0, 0.0, 0.0])
        with pytest.raises(UnsupportedError, match="dry friction at rest"):
            dyn.joint_wrenches(q, 0 * v, None, tau=[0.0] * 3)
        assert np.isfinite(dyn.joint_wrenches(q, v, None, tau=[0.0] * 3)).all()


# Identification


@pytest.mark.thorough
def test_coulomb_friction_is_found_across_reversals_under_noise() -> None:
    """With rows near rest, where joints stick and noise has the sign, dry friction was off by a third and more."""
    bare = mb.catalog.double_pendulum()
    dry, viscous = np.array([1.5, 0.6]), np.array([0.4, 0.2])
    true = replace(
        bare,
        joints=tuple(
            replace(j, friction=dry[k : k + 1], damping=viscous[k : k + 1]) for k, j in enumerate(bare.joints)
        ),
    )
    wanted = mb.excitation(bare, duration=10.0, seed=0, friction=True, iterations=10)
    nominal = mb.dynamics(bare, "lagrangian")

    def control(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        qd, vd, ad = wanted.at(t)
        return nominal.inverse_dynamics(q, v, ad + 25 * (qd - q) + 10 * (vd - v))

    run = mb.simulate(mb.dynamics(true, "lagrangian"), wanted.q[0], wanted.v[0], 10.0, "moreau", 2e-3, torque=control)
    assert (run.v == 0).sum() > 100
    rng = np.random.default_rng(0)
    tau = np.array([control(*x) for x in zip(run.t, run.q, run.v, strict=True)])
    tau += 0.01 * tau.std(axis=0) * rng.standard_normal(tau.shape)
    motion = filtered_motion(bare, run.q + 2e-5 * rng.standard_normal(run.q.shape), 2e-3, 10.0, tau=tau)

    def off(**options: float) -> float:
        found = mb.identify(bare, motion.q, motion.v, motion.a, motion.tau, friction=True, **options)
        return float(np.abs(np.array([p.value for p in found.parameters][-2:]) / dry - 1).max())

    assert off() < 0.03
    with warnings.catch_warnings(action="ignore"):
        assert off(rest=0.0) > 0.1


def test_torques_near_rest_get_no_weight_where_friction_matters() -> None:
    model, motion = mb.catalog.double_pendulum(), mb.excitation(mb.catalog.double_pendulum(), seed=0, iterations=0)
    rubbed = rubbing(model)
    tau = mb.dynamics(rubbed, "lagrangian").inverse_dynamics(motion.q, motion.v, motion.a)
    moving = (np.abs(motion.v) >= 0.05 * np.abs(motion.v).max(axis=0)).sum(axis=0)
    samples = len(tau)

    def counts(described: Model, **options: object) -> list[int]:
        found = mb.identify(described, motion.q, motion.v, motion.a, tau, **options)
        return [r.samples for r in found.residuals]

    assert counts(model, friction=True) == counts(rubbed) == moving.tolist() != [samples] * 2
    assert counts(model) == counts(model, friction=True, rest=0.0) == [samples] * 2
    with pytest.raises(InputError, match="rest: expected a part of the greatest speed below 1, got 1"):
        counts(model, friction=True, rest=1.0)
