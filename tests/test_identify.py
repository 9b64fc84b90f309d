"""Identification: exact from exact data, honest deviations from noise, and what the data cannot tell."""

from __future__ import annotations

import json
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, MbkitWarning, ModelError, UnsupportedError
from mbkit.identify import Excitation, Identification
from mbkit.model import Model
from mbkit.model.base_parameters import pseudo_inertia
from tests.scenes import chain

ENGINES = ("pinocchio", "lagrangian", "mujoco")


def other_masses(model: Model, seed: int = 0) -> Model:
    """Return the geometry with other masses, centres of mass and inertias, as a worker knows them before."""
    rng = np.random.default_rng(seed)
    bodies = []
    for b in model.bodies:
        f, g = rng.uniform(0.7, 1.3, 2)
        shift = 0.02 * rng.standard_normal(3) if b.mass else np.zeros(3)
        bodies.append(replace(b, mass=f * b.mass, com=b.com + shift, inertia=g * b.inertia))
    return replace(model, bodies=tuple(bodies))


@cache
def robot(name: str) -> tuple[Model, Excitation]:
    """Return a robot and a motion that shows its parameters, from a few steps of the search."""
    model = mb.load(name)
    return model, mb.excitation(model, duration=8.0, rate=40.0, iterations=4, seed=3)


def exact(name: str, engine: str = "pinocchio") -> tuple[Model, tuple[np.ndarray, ...], np.ndarray]:
    """Return a robot, its motion and the torques of an engine."""
    model, x = robot(name)
    return model, (x.q, x.v, x.a), mb.dynamics(model, engine).inverse_dynamics(x.q, x.v, x.a)


def noise(tau: np.ndarray, size: object = 1.0, seed: int = 0) -> np.ndarray:
    return tau + size * np.random.default_rng(seed).standard_normal(tau.shape)


def values(found: Identification) -> np.ndarray:
    return np.array([p.value for p in found.parameters])


def deviations(found: Identification) -> np.ndarray:
    return np.array([p.deviation for p in found.parameters])


def arm() -> Model:
    """Return a small arm with dampers, dry friction, rotors and a spring."""
    links = []
    for k, axis in enumerate(((0, 0, 1), (0, 1, 0), (0, 1, 0))):
        body = {"mass": 2.0 - 0.5 * k, "com": (0.1, 0.02, -0.2), "inertia": np.diag([0.03, 0.04, 0.02])}
        place = {"body": f"link{k}", "axis": axis, "translation": (0.0, 0.0, -0.4 * (k > 0))}
        forces = {"damping": 0.3 + 0.1 * k, "friction": 0.5 - 0.1 * k, "stiffness": 2.0 * (k == 1), "rest": 0.2}
        links.append(body | place | forces | {"armature": 0.02 * (k + 1)})
    return chain(*links, name="arm").build()


def motion(model: Model, n: int = 200, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    q, v = model.random_state(rng, n)
    return q, v, rng.standard_normal((n, model.nv))


def torques(model: Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    return mb.dynamics(model, "pinocchio").inverse_dynamics(q, v, a)


@pytest.mark.thorough("pinocchio-ur5", "pinocchio-panda", "mujoco-ur5", "lagrangian-panda", "mujoco-panda")
@pytest.mark.parametrize("name", ["ur5", "panda"])
@pytest.mark.parametrize("engine", ENGINES)
def test_exact_from_exact_torques(name: str, engine: str) -> None:
    model, at, tau = exact(name, engine)
    found = mb.identify(other_masses(model), *at, tau)
    true = model.base_parameters().values
    assert np.abs(values(found) - true).max() <= 1e-10 * np.abs(true).max()
    assert found.undetermined == ()
    assert max(r.noise / r.torque for r in found.residuals) < 1e-12
    if (name, engine) == ("ur5", "mujoco"):
        # Consistency costs exact data nothing.
        found = mb.identify(other_masses(model), *at, tau, physical=True)
        assert np.abs(values(found) - true).max() < 1e-8 * np.abs(true).max()


@pytest.mark.thorough("panda")
@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_errors_are_within_three_of_the_deviations_told(name: str) -> None:
    model, at, tau = exact(name)
    size = np.sqrt((tau**2).mean(axis=0)) * np.geomspace(0.003, 0.03, model.nv)
    true, rng, off = model.base_parameters().values, np.random.default_rng(0), []
    for _ in range(8):
        found = mb.identify(model, *at, tau + size * rng.standard_normal(tau.shape))
        off.append((values(found) - true) / deviations(found))
        noise = np.array([r.noise for r in found.residuals])
        # The standard deviation of an estimate of a standard deviation is 1/√(2 N).
        assert (np.abs(noise / size - 1) < 5 / np.sqrt(2 * len(tau))).all()
    assert (np.abs(off) < 3).mean() >= 0.99
    # Neither too wide: they are normal of variance 1, independent trials of correlated parameters.
    assert 0.8 < np.std(off) < 1.2


def test_weights_by_the_residuals_beat_equal_ones() -> None:
    model, at, tau = exact("ur5")
    size = np.array([10.0, 10.0, 1.0, 0.01, 0.01, 0.01])
    weights = (None, 1 / size, np.ones(model.nv))
    own, known, equal = (mb.identify(model, *at, noise(tau, size), weights=w) for w in weights)
    assert np.allclose(deviations(own), deviations(known), rtol=0.05)
    assert np.median(deviations(equal) / deviations(own)) > 3
    true = model.base_parameters().values
    # Deviations stay honest with weights that are wrong.
    assert (np.abs(values(equal) - true) < 4 * deviations(equal)).all()


@pytest.mark.parametrize("known", [0, 5])
def test_an_exact_torque_does_not_hide_the_others(known: int) -> None:
    model, at, tau = exact("ur5")
    size = np.where(np.arange(model.nv) == known, 0.0, 0.1)
    found = mb.identify(other_masses(model), *at, noise(tau, size))
    assert found.undetermined == ()
    assert (np.abs(values(found) - model.base_parameters().values) < 5 * deviations(found) + 1e-9).all()


@pytest.mark.parametrize("physical", [False, True])
def test_friction_and_armature_are_found_and_written_back(physical: bool) -> None:
    true = arm()
    before = other_masses(true.without("damping", "friction", "armature"))
    q, v, a = motion(true)
    tau = torques(true, q, v, a)
    found = mb.identify(before, q, v, a, tau, friction=True, armature=True, physical=physical)
    # The first two rotors turn as their links do.
    assert {x.text for x in found.undetermined} == {"-link0.Izz + j0.armature", "-link1.Iyy + j1.armature"}
    told = {p.name: p.value for p in found.parameters if p.determined}
    assert [told[f"j{k}.damping"] for k in range(3)] == pytest.approx([0.3, 0.4, 0.5], rel=1e-6)
    assert [told[f"j{k}.friction"] for k in range(3)] == pytest.approx([0.5, 0.4, 0.3], rel=1e-6)
    assert told["j2.armature"] == pytest.approx(0.06, rel=1e-5)
    if not physical:
        # Where nothing tells them from the links' inertias, rotors may come out negative.
        with pytest.raises(ModelError, match=r"armature(?s:.)*physical=True"):
            _ = found.model
        return
    after = found.model
    assert np.abs(torques(after, q, v, a) - tau).max() < 1e-6 * np.abs(tau).max()
    assert [after.joint(f"j{k}").friction[0] for k in range(3)] == pytest.approx([0.5, 0.4, 0.3], rel=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_what_is_zero_but_for_rounding_or_noise_is_zero_in_the_model(seed: int) -> None:
    true = arm().without("damping", "friction", "armature")
    q, v, a = motion(true, seed=seed)
    tau = torques(true, q, v, a)
    for given in (tau, noise(tau, 0.01, seed)):
        found = mb.identify(true, q, v, a, given, friction=True, rest=0.0)
        told = {p.name: p for p in found.parameters}
        for j in found.model.joints:
            for field in ("damping", "friction"):
                estimate = told[f"{j.name}.{field}"]
                assert getattr(j, field) == (estimate.value if estimate.value > 0 else 0.0)
                assert abs(estimate.value) < 4 * estimate.deviation
    # A number that the data deny is refused.
    with pytest.raises(ModelError, match="j1': damping"):
        _ = mb.identify(true, q, v, a, noise(tau - 0.1 * v, 0.01), friction=True, rest=0.0).model


def test_what_is_not_asked_for_is_taken_from_the_model() -> None:
    true = arm().without("friction")
    q, v, a = motion(true)
    found = mb.identify(other_masses(true), q, v, a, torques(true, q, v, a))
    assert np.allclose(values(found), true.base_parameters().values, rtol=0, atol=1e-11)


def test_joints_that_mimic_keep_their_own_friction() -> None:
    finger = {"mass": 1.0, "com": (0.1, 0, 0.2), "inertia": 0.02 * np.eye(3), "parent": "world", "axis": (0, 1, 0)}
    finger |= {"damping": 0.1, "friction": 0.2}
    model = chain(finger, finger | {"mimic": ("j0", -2.0, 0.0)}).build()
    q, v, a = motion(model)
    # Damping 0.5 + 4 · 0.1 and friction 0.7 + 2 · 0.2 as the leader feels them.
    bodies = mb.dynamics(model.without("damping", "friction"), "pinocchio").inverse_dynamics(q, v, a)
    found = mb.identify(model, q, v, a, bodies + 0.9 * v + 1.1 * np.sign(v), friction=True)
    leader, follower = (found.model.joint(name) for name in ("j0", "j1"))
    assert (leader.damping[0], leader.friction[0]) == pytest.approx((0.5, 0.7))
    assert (follower.damping[0], follower.friction[0]) == (0.1, 0.2)


def test_directions_that_the_data_cannot_tell_are_named() -> None:
    model = arm().without("damping", "friction", "armature", "springs")
    q, v, a = motion(model)
    q[:, 1:], v[:, 1:], a[:, 1:] = 0.3, 0.0, 0.0
    tau = mb.dynamics(model, "pinocchio").inverse_dynamics(q, v, a)
    found = mb.identify(other_masses(model), q, v, a, tau)
    assert len(found.undetermined) == model.base_parameters().count - len({*found_rank(model, q, v, a)})
    lost = {name for x in found.undetermined for name in x.names}
    assert lost == {p.name for p in found.parameters if not p.determined}
    dyn = mb.dynamics(model, "lagrangian")
    names = model.regressor_columns("base")
    Y = dyn.regressor(q, v, a, "base")
    for x in found.undetermined:
        direction = np.zeros(len(names))
        direction[[names.index(n) for n in x.names]] = x.ratios
        assert np.abs(Y @ direction).max() < 1e-9 * np.abs(direction).max()
    # What is told is right: the torques are explained.
    assert max(r.noise for r in found.residuals) < 1e-11
    # Links that move as one share their inertia about the first axis, and torques of rounding do not hide it.
    assert "link0.Izz" in lost
    assert all(len(x.names) > 1 for x in found.undetermined if "link0.Izz" in x.names)


def test_motions_of_rounding_tell_nothing() -> None:
    """Joints that are held rest to some 1e-11: no use to call their parameters told, with huge deviations."""
    model = arm().without("damping", "friction", "armature", "springs")
    q, v, a = motion(model)
    for x, centre in ((q, 0.3), (v, 0.0), (a, 0.0)):
        x[:, 1:] = centre + 1e-11 * x[:, 1:]
    tau = mb.dynamics(model, "pinocchio").inverse_dynamics(q, v, a)
    found = mb.identify(other_masses(model), q, v, a, tau)
    assert len(found.undetermined) >= 5
    assert found.condition < 1e6


def found_rank(model: Model, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> range:
    Y = mb.dynamics(model, "lagrangian").regressor(q, v, a, "base")
    return range(np.linalg.matrix_rank(Y.reshape(-1, Y.shape[-1]), tol=1e-8))


def test_at_rest_only_gravity_is_told() -> None:
    model = mb.catalog.pendulum()
    still = np.zeros((20, 1))
    q = np.linspace(-2, 2, 20)[:, None]
    tau = mb.dynamics(model).inverse_dynamics(q, still, still)
    found = mb.identify(model, q, still, still, tau, friction=True)
    lost = [x.text for x in found.undetermined]
    assert lost == ["bob.Iyy", "theta.damping", "theta.friction"]
    # Nothing moves, nothing falls: not one parameter is told, and nothing fails.
    none = mb.identify(model.without("gravity"), q, still, still, 0 * tau)
    assert all(not p.determined and p.value == p.before for p in none.parameters)
    assert np.isnan(none.condition)


@pytest.mark.thorough("entropic")
@pytest.mark.parametrize("prior", ["entropic", "euclidean"])
def test_consistent_parameters_are_matter(prior: str) -> None:
    model, at, tau = exact("panda")
    noisy = noise(tau, 0.05 * np.sqrt((tau**2).mean(axis=0)), 1)
    free = mb.identify(other_masses(model), *at, noisy)
    found = mb.identify(other_masses(model), *at, noisy, physical=True, prior=prior)
    assert found.prior == prior
    J = pseudo_inertia(np.reshape(found.standard, (-1, 10)))
    masses = np.array([model.body(j.child).mass for j in model.tree])
    assert np.linalg.eigvalsh(J[masses > 0]).min() > 0
    assert not J[masses == 0].any()
    # The free estimates are not: constraints are what makes it so.
    assert np.linalg.eigvalsh(pseudo_inertia(np.reshape(free.standard, (-1, 10)))).min() < 0
    with pytest.raises(ModelError, match="physical=True"):
        _ = free.model
    after = mb.dynamics(found.model, "pinocchio").inverse_dynamics(*at)
    assert np.sqrt(((after - tau) ** 2).mean(axis=0) / (tau**2).mean(axis=0)).max() < 0.05
    for form in ("urdf", "mjcf"):
        assert mb.convert(found.model, form).worst < 1e-10


@pytest.mark.parametrize("prior", ["entropic", "euclidean"])
def test_a_heavy_prior_holds_the_model(prior: str) -> None:
    model, at, tau = exact("ur5")
    before, given = other_masses(model), {"physical": True, "prior": prior}
    light, heavy = (mb.identify(before, *at, noise(tau), prior_weight=w, **given) for w in (1.0, 1e9))
    nominal, true = before.base_parameters().values, model.base_parameters().values
    assert np.abs(values(heavy) - nominal).max() < 1e-3 * np.abs(nominal).max()
    assert np.abs(values(light) - true).max() < 0.05 * np.abs(true).max()


def test_without_the_solver_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mb.catalog.pendulum()
    q, v, a = motion(model)
    tau = mb.dynamics(model).inverse_dynamics(q, v, a)
    monkeypatch.setitem(__import__("sys").modules, "cvxpy", None)
    with pytest.raises(UnsupportedError, match=r"mbkit\[identify\]"):
        mb.identify(model, q, v, a, tau, physical=True)
    assert mb.identify(model, q, v, a, tau).parameters


def test_points_and_masses_of_zero_are_taken() -> None:
    """A bob is a point, and its pseudo-inertia has no inverse."""
    true = mb.catalog.double_pendulum(mass2=2.0)
    q, v, a = motion(true)
    tau = mb.dynamics(true).inverse_dynamics(q, v, a)
    for physical, most in ((False, 1e-8), (True, 1e-3)):
        found = mb.identify(mb.catalog.double_pendulum(), q, v, a, tau, physical=physical)
        assert np.abs(mb.dynamics(found.model).inverse_dynamics(q, v, a) - tau).max() < most * np.abs(tau).max()
    # A named parameter is a number in the model that is returned.
    named = mb.catalog.double_pendulum(mass2=mb.Parameter("m", 1.0))
    assert mb.identify(named, q, v, a, tau).model.mass == pytest.approx(3.0)


def test_the_result_reads_and_writes() -> None:
    model = arm()
    q, v, a = motion(model)
    found = mb.identify(model, q, v, a, torques(model, q, v, a), friction=True)
    back = Identification.from_json(found.to_json())
    assert back == replace(found, source=None)
    assert back.applied_to(model) == found.model
    with pytest.raises(InputError, match="applied_to"):
        _ = back.model
    with pytest.raises(InputError, match="bodies"):
        back.applied_to(mb.catalog.pendulum())
    data = json.loads(found.to_json())
    assert data["parameters"][0]["name"] == found.parameters[0].name
    assert "link2.Iyy" in found._repr_html_()
    assert found.to_csv().count("\n") == len(found.parameters) + 1
    assert "j2.friction" in found.to_markdown()


def test_large_data_are_read_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    model = arm()
    q, v, a = motion(model, 500)
    tau = torques(model, q, v, a)
    whole = mb.identify(model, q, v, a, tau, friction=True)
    reports: list[float] = []
    monkeypatch.setattr("mbkit.identify.measurements._MAX_BLOCK_NUMBERS", 1)
    parts = mb.identify(model, q, v, a, tau, friction=True, progress=reports.append)
    assert np.allclose(values(whole), values(parts), rtol=0, atol=1e-12)
    assert reports[-1] == 1.0


def test_bad_input() -> None:
    model = arm()
    q, v, a = motion(model, 50)
    tau = torques(model, q, v, a)
    for wrong, text in (
        ({"tau": tau[:40]}, "as many of each"),
        ({"a": np.where(a == a[3, 1], np.nan, a)}, "nan"),
        ({"weights": -np.ones(3)}, "at least 0"),
        ({"prior": "entropic"}, "physical=True"),
        ({"prior_weight": 0.0}, "above 0"),
    ):
        with pytest.raises(InputError, match=text):
            mb.identify(model, **{"q": q, "v": v, "a": a, "tau": tau} | wrong)
    with pytest.raises(InputError, match=r"at least \d+"):
        mb.identify(model, q[:3], v[:3], a[:3], tau[:3])
    with pytest.raises(UnsupportedError, match="no bodies"):
        mb.identify(mb.lagrangian.systems.pendulum().model, q, v, a, tau)


# Excitation


def test_the_motion_is_within_limits_and_consistent() -> None:
    model, x = robot("panda")
    assert (x.q >= model.lower).all()
    assert (x.q <= model.upper).all()
    fast = np.concatenate([j.velocity_limit for j in model.independent_joints])
    assert (np.abs(x.v) <= fast).all()
    # Fourier's series: the last sample is the first, and the rates are those of q.
    assert np.allclose(x.q[0], x.q[-1])
    h = 1e-5
    later, earlier = x.at(x.t + h), x.at(x.t - h)
    assert np.allclose((later[0] - earlier[0]) / (2 * h), x.v, atol=1e-7)
    assert np.allclose((later[1] - earlier[1]) / (2 * h), x.a, atol=1e-6)
    assert all(part.shape == (model.nv,) for part in x.at(0.3))


def test_the_search_lowers_the_condition_number() -> None:
    model = mb.load("ur5")
    start, end = (mb.excitation(model, duration=8.0, iterations=n, rate=40.0) for n in (0, 10))
    assert end.condition < 0.8 * start.condition
    again = mb.excitation(model, duration=8.0, iterations=10, rate=40.0)
    assert np.array_equal(again.q, end.q)
    Y = mb.dynamics(model, "lagrangian").regressor(end.q, end.v, end.a, "base").reshape(-1, 36)
    assert np.linalg.cond(Y / np.linalg.norm(Y, axis=0)) == pytest.approx(end.condition, rel=1e-6)


def test_the_gradient_is_that_of_the_value() -> None:
    from mbkit.identify.fourier_series import _Search

    search = _Search(mb.catalog.double_pendulum(), 5.0, 2, 0.05, True)
    x = np.random.default_rng(0).standard_normal(10)
    _, gradient = search.gradient(x)
    for k in range(10):
        step = 1e-5 * np.eye(10)[k]
        slope = (search.gradient(x + step)[0] - search.gradient(x - step)[0]) / 2e-5
        assert gradient[k] == pytest.approx(slope, rel=1e-3, abs=1e-4)


def test_bad_excitation() -> None:
    model = mb.catalog.pendulum()
    for wrong, text in (
        ({"duration": 0.0}, "duration"),
        ({"rate": 1.0, "duration": 1.0}, "rate"),
        ({"margin": 1.0}, "margin"),
    ):
        with pytest.raises(InputError, match=text):
            mb.excitation(model, **wrong)
    with pytest.raises(UnsupportedError, match="quaternion"):
        mb.excitation(mb.load("ur5", floating_base=True))
    with pytest.raises(UnsupportedError, match="no bodies"):
        mb.excitation(mb.lagrangian.systems.pendulum().model)


def measured(rate: float, seed: int, encoder: float, torque: float = 0.1) -> tuple[Model, np.ndarray, np.ndarray]:
    """Return a robot, noisy positions and noisy torques of a motion of 10 s."""
    model = mb.load("ur5")
    motion = mb.excitation(model, duration=10.0, seed=0, rate=rate, iterations=3)
    rng = np.random.default_rng(seed)
    tau = mb.dynamics(model, "pinocchio").inverse_dynamics(motion.q, motion.v, motion.a)
    tau = tau + torque * rng.standard_normal(tau.shape)
    return model, motion.q + encoder * rng.standard_normal(motion.q.shape), tau


def worst(found: Identification, what: str = "error") -> float:
    """Return the largest error, or bias that is told, in standard deviations."""
    offs = {"error": lambda p: p.value - p.before, "bias": lambda p: p.bias}
    return max(abs(offs[what](p)) / p.deviation for p in found.parameters if p.determined)


@pytest.mark.thorough("500.0")
@pytest.mark.parametrize("rate", [100.0, 500.0])
def test_noise_of_encoders_is_told_and_a_filter_takes_it_out(rate):
    """Positions with 1e-4 rad of noise, differentiated twice: errors of ten deviations and more, in silence before."""
    model, q, tau = measured(rate, 1, 1e-4)
    v = np.gradient(q, 1 / rate, axis=0)
    with pytest.warns(MbkitWarning, match="noise of the motion .* filter the positions first") as told:
        raw = mb.identify(model, q, v, np.gradient(v, 1 / rate, axis=0), tau)
    assert len(told) == 1
    assert worst(raw) > 5
    assert worst(raw, "bias") > 3
    motion = mb.identify.filtered_motion(model, q, 1 / rate, 8.0, tau=tau)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = mb.identify(model, motion.q, motion.v, motion.a, motion.tau, cutoff=motion.cutoff)
    # Of 36 normal errors the largest is beyond 4.5 deviations in one case of 4,000.
    assert worst(found) < 4.5
    assert found.cutoff == 8.0
    assert "cut-off 8 Hz" in str(found)
    assert len(str(found).splitlines()) <= 15


@pytest.mark.parametrize("torque", [0.0, 0.1])
def test_exact_motions_have_no_bias_whatever_the_torques_noise(torque):
    model = mb.load("ur5")
    motion = mb.excitation(model, duration=10.0, seed=0, iterations=3)
    tau = mb.dynamics(model, "pinocchio").inverse_dynamics(motion.q, motion.v, motion.a)
    tau = noise(tau, torque)
    shuffled = np.random.default_rng(1).permutation(len(tau))
    for order in (np.arange(len(tau)), shuffled):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = mb.identify(model, motion.q[order], motion.v[order], motion.a[order], tau[order])
        assert worst(found, "bias") < 0.1


def test_a_filter_has_no_shift_and_keeps_slow_motions():
    model, t = mb.catalog.pendulum(), np.arange(0, 6, 1e-3)
    q = (np.sin(2 * t) + 0.5 * np.cos(3 * t))[:, None]
    motion = mb.identify.filtered_motion(model, q, 1e-3, 20.0, tau=q)
    at = t[motion.samples]
    for found, exact in (
        (motion.q, np.sin(2 * at) + 0.5 * np.cos(3 * at)),
        (motion.v, 2 * np.cos(2 * at) - 1.5 * np.sin(3 * at)),
        (motion.a, -4 * np.sin(2 * at) - 4.5 * np.cos(3 * at)),
        (motion.tau, np.sin(2 * at) + 0.5 * np.cos(3 * at)),
    ):
        # What the ends leave has decayed by 2e-3 in the edge that is cut, and (f / f_c)⁸ of the two passes is 1e-13.
        np.testing.assert_allclose(found[:, 0], exact, atol=5e-3)
        np.testing.assert_allclose(found[20:-20, 0], exact[20:-20], atol=1e-9)
    for bad, words in (
        (lambda: mb.identify.filtered_motion(model, q, 1e-3, 600.0), "less than half of the sampling rate, 500 Hz"),
        (lambda: mb.identify.filtered_motion(model, q[:50], 1e-3, 20.0), "expected more than"),
        (lambda: mb.identify.filtered_motion(model, q[:, 0], 1e-3, 20.0), "q: expected"),
        (lambda: mb.identify.filtered_motion(mb.catalog.free_body(), q, 1e-3, 20.0), "has a quaternion"),
    ):
        with pytest.raises(InputError, match=words):
            bad()
