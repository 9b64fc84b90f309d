"""Engines that robots are trained in, and the precision by which an engine is judged."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit._child_process import end_all
from mbkit.engines.pinocchio.engine import PinocchioDynamics
from mbkit.engines.registry import EngineInfo, register_engine
from mbkit.engines.remote.description import STACKED, Convention, travelling
from mbkit.engines.remote.packages import (
    PACKAGES,
    Package,
    names_version,
    register_remote_engine,
    remote_engines,
)
from mbkit.engines.remote.served import serve
from mbkit.errors import EngineProcessError, InputError, UnknownNameError, UnsupportedError
from mbkit.studies._targets import engine_names
from mbkit.studies.compare.errors import digits_of, epsilon
from mbkit.studies.measurement import Measurement
from mbkit.studies.work_precision.sweep import Curve
from tests.random_trees import random_tree
from tests.test_engine_versions import environments, installer, present  # noqa: F401  # fixtures

EXUDYN = Path(__file__).parent / "on_exudyn.py"
OURS = ("newton", "mujoco-warp", "mjx", "mjx-single")


# Names.


@pytest.mark.parametrize("name", OURS)
def test_a_name_alone_is_the_newest_version_that_was_tested(name):
    version = mb.engine(name)
    assert version.version == PACKAGES[name].tested[-1]
    assert mb.engine(f"{name}==9.9").version == "9.9"
    assert engine_names((name, "pinocchio")) == (f"{name}=={version.version}", "pinocchio")
    assert engine_names((version, name)) == (version.name,)


def test_an_unknown_engine_is_answered_with_these_too():
    with pytest.raises(UnknownNameError, match="newton"):
        engine_names(("newtn", "pinocchio"))
    with pytest.raises(UnknownNameError, match="newton"):
        mb.dynamics(mb.catalog.pendulum(), "newtn")


# Precision, of an engine that rounds what it takes and gives to single precision.


class Single(PinocchioDynamics):
    engine = "single"
    _significand_bits = 24
    wrong = 1.0

    def _value(self, method, states, more, size):
        rounded = [np.float64(np.float32(x)) for x in states]
        own = method.__name__ == "_mass_matrix"
        return np.float64(np.float32(super()._value(method, rounded, more, size) * (self.wrong if own else 1.0)))


@pytest.fixture
def single():
    register_engine(EngineInfo("single", Single, package="single", shown=()))
    yield Single
    mb.engines.ENGINES.pop("single")


def compared(**more):
    return mb.compare(mb.load("double_pendulum"), ("pinocchio", "single"), samples=8, terms_only=True, **more)


@pytest.mark.usefixtures("single")
def test_single_precision_agrees_and_says_its_digits():
    result = compared()
    own = [r for r in result.rows if r.engine == "single"]
    assert result.passed
    assert max(r.relative for r in own) > 1e-9, "it does round"
    assert {r.bits for r in own} == {24}
    assert result.digits > 12, "of those in double precision"
    least = min(-np.log10(r.relative) for r in own if r.relative)
    assert result.verdict.startswith(f"pinocchio agrees with the oracle to {result.digits:.1f} digits; ")
    assert f"single agrees to single precision ({least:.1f} of 7.2 digits)" in result.verdict
    assert "agrees to single precision" in result.to_markdown()
    assert "7.2 digits" in result._repr_html_()


@pytest.mark.parametrize("wrong", [1 + 1e-4, 1 + 3e-5])
@pytest.mark.usefixtures("single")
def test_what_single_precision_does_not_explain_is_an_error(monkeypatch, wrong):
    monkeypatch.setattr(Single, "wrong", wrong)
    failed = {(r.engine, r.term) for r in compared().rows if not r.passed}
    assert ("single", "M") in failed
    assert {engine for engine, _ in failed} == {"single"}


@pytest.mark.usefixtures("single")
def test_an_engine_in_double_precision_is_judged_as_before(monkeypatch):
    monkeypatch.setattr(Single, "_significand_bits", 53)
    assert not compared().passed


def test_digits_and_eps_of_a_significand():
    assert epsilon(24) == np.finfo(np.float32).eps
    assert epsilon(53) == np.finfo(float).eps
    assert digits_of(24) == pytest.approx(7.22, abs=0.01)


def curve(*errors):
    points = [
        Measurement(10.0**-k, error=e, seconds=1.0, steps=1, setting="dt", evaluations=1, repeats=1)
        for k, e in enumerate(errors, start=1)
    ]
    return Curve("e", "m", tuple(points), np.nan, 0, 1.0, 0.0)


def test_a_curve_that_rounding_bends_back_names_its_best_step():
    assert curve(1e-2, 1e-3, 2e-6, 1e-5, 1e-4).turn.value == pytest.approx(1e-3)
    # The least error is the last one, or is as small as the next.
    assert curve(1e-2, 1e-3, 1e-4).turn is None
    assert curve(1e-2, 1e-6, 1.1e-6).turn is None


# Stacks of states in one call, and an engine in a file of one's own.

ENGINE = """
calls = []


def built(data):
    return data


class Engine:
    STACKED = {stacked}

    def __init__(self, data):
        self.names = [j["name"] for j in data["joints"] if j["steps"]]

    def joints(self):
        return {{name: [[k], [k]] for k, name in enumerate(self.names)}}

    def gravity(self, q):
        calls.append(q.shape)
        {before}
        return 2.0 * q

    def calls(self, q):
        return [float(len(calls))] if not self.STACKED else [[float(len(calls))]]
"""


@pytest.fixture
def one_of_ones_own(tmp_path):
    """Return a function that registers an engine of one's own, in an environment of the present interpreter."""

    def register(stacked=True, before="pass", **more):
        file = tmp_path / "on_mine.py"
        file.write_text(ENGINE.format(stacked=stacked, before=before), encoding="utf-8")
        own = Package("mine", "numpy", Convention(), STACKED, tested=("1.0",), file=str(file), **more)
        register_remote_engine("mine", own)
        present("mine", "1.0")
        return mb.dynamics(mb.catalog.double_pendulum(), "mine")

    yield register
    end_all()
    PACKAGES.pop("mine", None)


@pytest.mark.parametrize(("stacked", "calls"), [(True, 2), (False, 4)])
def test_a_stack_of_states_is_one_call_of_an_engine_that_takes_stacks(one_of_ones_own, stacked, calls):
    dyn = one_of_ones_own(stacked)
    q = np.arange(6.0).reshape(3, 2)
    assert np.array_equal(dyn.gravity(q), 2.0 * q)
    assert np.array_equal(dyn.gravity(q[0]), 2.0 * q[0])
    assert dyn.gravity(np.empty((0, 2))).shape == (0, 2)
    assert dyn._ask("calls", q[0])[0] == calls + 1, "an empty stack asks for its shape"


def test_an_engine_of_ones_own_is_refused_what_it_lacks(one_of_ones_own):
    dyn = one_of_ones_own()
    with pytest.raises(UnsupportedError, match="without the matrix"):
        dyn.coriolis_matrix([0.0, 0.0], [0.0, 0.0])
    with pytest.raises(UnsupportedError, match=r"mujoco_rk4: not on the mine==1\.0 engine"):
        mb.simulate(dyn, [0.0, 0.0], [0.0, 0.0], 0.1, "mujoco_rk4", dt=0.01)
    with pytest.raises(UnsupportedError, match="no rollout"):
        dyn.rollout([0.0, 0.0], [0.0, 0.0], 0.01, 1)


def test_an_engine_that_hangs_is_ended_after_its_time(one_of_ones_own):
    dyn = one_of_ones_own(before="__import__('time').sleep(60)", limit=1.0)
    with pytest.raises(EngineProcessError, match=r"mine==1\.0: its process was ended after 1 s"):
        dyn.gravity([0.0, 0.0])


def test_what_is_no_engine_of_ones_own_is_refused(tmp_path):
    file = tmp_path / "on_mine.py"
    file.touch()
    good = Package("mine", "mine", Convention(), tested=("1.0",), file=str(file))
    for name, package, match in (
        ("newton", good, "not in use"),
        ("Mine engine", good, "not in use"),
        ("mine", "good", "expected a Package"),
        ("mine", good._replace(file="/nowhere.py"), "the path of the engine's file"),
        ("mine", good._replace(tested=()), "at least one version"),
        ("mine", good._replace(steps={"fixed": STACKED["fixed"]}), "none of .*joint_type.ball"),
    ):
        with pytest.raises(InputError, match=match):
            register_remote_engine(name, package)
    assert not names_version("mine")


def test_a_wheel_that_does_not_install_says_pips_reason_and_leaves_nothing(installer, environments):  # noqa: F811
    installer('[ "$1" = pip ] && echo "ERROR: No matching distribution found for newton" >&2; exit 1')
    with pytest.raises(UnsupportedError, match=r"newton 1\.8\.0: no environment of it can be made here") as caught:
        mb.dynamics(mb.catalog.pendulum(), "newton")
    assert "No matching distribution" in str(caught.value)
    assert len(str(caught.value)) < 240
    assert [p for p in environments.iterdir() if p.is_dir()] == []


def test_extras_of_a_distribution_are_installed(installer):  # noqa: F811
    log = installer("exit 1")
    with pytest.raises(UnsupportedError):
        mb.dynamics(mb.catalog.pendulum(), "newton")
    assert f"newton[sim]=={PACKAGES['newton'].tested[-1]}" in log.read_text()


def test_helical_joints_are_refused_by_name_before_anything_is_made(environments):  # noqa: F811
    model = random_tree(1, 3, ("helical",), springs=False, damping=False, armature=False)
    with pytest.raises(UnsupportedError, match=r"newton.*helical"):
        mb.dynamics(model, "newton")
    assert not environments.exists()


def test_messages_name_stacks():
    head, _ = serve.unpacked(serve.packed({"call": "x", "stacked": True}, [np.zeros((2, 3))]))
    assert head["stacked"]


# A run in another process.

ROLLOUT = """

    def rollout(self, q, v, tau=None, *, method, dt, steps):
        calls.append(steps)
        import time
        time.sleep(0.01 * steps)
        out = [(q, v)]
        for k in range(steps):
            q = q + dt * v + (0.0 if tau is None else tau[:, k])
            out.append((q, v))
        return [np.stack(x, axis=1) for x in zip(*out)]
"""


def test_a_run_in_another_process_is_left_so_that_it_can_be_ended(one_of_ones_own, monkeypatch):
    monkeypatch.setitem(globals(), "ENGINE", "import numpy as np\n" + ENGINE.rstrip() + ROLLOUT)
    dyn = one_of_ones_own()
    done = []

    def enough(fraction):
        done.append(fraction)
        if fraction > 0.1:
            raise TimeoutError

    with pytest.raises(TimeoutError):
        dyn.own_run(np.zeros(2), np.ones(2), 1e-3, 1000, "any", progress=enough)
    assert 0.1 < done[-1] < 0.2
    q, _ = dyn.own_run(np.zeros(2), np.ones(2), 1e-3, 40, "any", np.ones(2))
    assert q.shape == (41, 2)
    assert q[-1] == pytest.approx([40.04, 40.04]), "no step is lost between two calls"


# The engines themselves, where their environments are.


def floating(joints: tuple[str, ...] = ("root", "hip", "foot", "neck", "eye")) -> mb.Model:
    """A floating trunk with a ball joint, hinges, a slide, rotors, springs and dampers."""
    b = mb.ModelBuilder("floating")
    for name, kind, parent, body in (
        ("root", "free", "world", "trunk"),
        ("hip", "revolute", "trunk", "leg"),
        ("foot", "prismatic", "leg", "toe"),
        ("neck", "ball", "trunk", "head"),
        ("eye", "universal", "head", "lens"),
    ):
        if name not in joints:
            continue
        b.add_body(body, mass=2.0, com=(0.1, 0.2, 0.3), inertia=(0.3, 0.4, 0.5))
        numbers = {}
        if kind in ("revolute", "prismatic"):
            numbers = {"axis": (0.6, 0.0, 0.8), "damping": 0.3, "stiffness": 2.0, "rest": 0.1, "armature": 0.2}
        elif kind == "universal":
            numbers = {"axis": (1.0, 0.0, 0.0), "axis2": (0.0, 1.0, 0.0)}
        b.add_joint(name, kind, parent=parent, child=body, translation=(0.1, 0.0, 0.4), **numbers)
    return b.build()


@pytest.fixture
def users_own(monkeypatch):
    """Leave the folder of environments as the user has it."""
    monkeypatch.undo()
    end_all()
    yield
    end_all()


@pytest.fixture(params=OURS)
def real(request, users_own):  # noqa: ARG001  # for its effect
    """Return an engine in its real environment, or skip."""
    version = mb.engine(request.param)
    if not version.installed:
        pytest.skip(f"no environment of {version}; mbkit check panda --engines lagrangian,{request.param} makes it")
    return version


def test_terms_of_a_floating_tree_agree(real):
    result = mb.compare(floating(), ("lagrangian", real), samples=8, terms_only=True)
    own = {r.term: r for r in result.rows if r.engine == real.name}
    assert result.passed, result.verdict
    assert {"M", "g", "nle", "C v", "passive", "inverse dynamics", "forward dynamics", "pose", "Jacobian"} <= {*own}
    assert {r.bits for r in own.values()} == {PACKAGES[real.engine].bits}


def test_a_stack_gives_what_single_states_give(real):
    model = floating()
    dyn, (q, v) = mb.dynamics(model, real), model.random_state(0, 3)
    for term, arguments in (("mass_matrix", (q,)), ("nle", (q, v)), ("forward_dynamics", (q, v, v))):
        whole = getattr(dyn, term)(*arguments)
        each = np.array([getattr(dyn, term)(*state) for state in zip(*arguments, strict=True)])
        # Sums may come in another order.
        lost = np.linalg.cond(dyn.mass_matrix(q)).max() if term == "forward_dynamics" else 4.0
        assert np.abs(whole - each).max() <= lost * epsilon(dyn._significand_bits) * np.abs(whole).max(), term


def test_own_integrators_have_their_order(real):
    model = floating(("root", "hip", "foot", "neck"))
    dyn, (q0, v0) = mb.dynamics(model, real), model.random_state(3)
    truth = mb.simulate(mb.dynamics(model, "lagrangian"), q0, v0, 0.1, "rk853", rtol=1e-12)
    methods = {"mujoco_rk4": 1e-4} if real.engine != "newton" else {"mujoco_rk4": 1e-4, "newton_featherstone": 0.1}
    for method, tolerance in methods.items():
        runs = [mb.simulate(dyn, q0, v0, 0.1, method, dt=dt) for dt in (0.01, 0.005)]
        errors = [np.abs(model.difference(truth.q[-1], run.q[-1])).max() for run in runs]
        assert errors[0] < tolerance, method
        if method == "newton_featherstone":
            assert errors[1] < 0.65 * errors[0]
        if real.engine == "mjx":
            assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1), "its RK4, where rotations turn"


def run_of_sums(dyn, q, v, dt, steps, law, hold=1):
    """Return q of every step of RK4 as MJX 3.17 and MuJoCo 3 have it; the law is asked every `hold` steps.

    A stage's pose is that at the start, moved by a sum of velocities: exact to second order where the base turns.
    """
    model = dyn.model

    def turn(q):
        return mb.spatial.matrix_from_quaternion(q[3:7])

    def moved(q, u):
        # MuJoCo's velocity of a free base is linear in the world's axes and angular in its own.
        out = model.integrate(q, np.r_[np.zeros(3), u[3:]])
        out[:3] = q[:3] + u[:3]
        return out

    def rate(q, u, tau):
        R, a = turn(q), np.r_[turn(q).T @ u[:3], u[3:]]
        out = dyn.forward_dynamics(q, a, tau)
        out[:3] = R @ (out[:3] + np.cross(a[3:6], a[:3]))
        return out

    u, tau, rows = np.r_[turn(q) @ v[:3], v[3:]], None, [q]
    for k in range(steps):
        tau = tau if k % hold else law(k, q, u)
        speeds, rates = [u], [rate(q, u, tau)]
        for part in (0.5, 0.5, 1.0):
            pose = moved(q, part * dt * speeds[-1])
            speeds.append(u + part * dt * rates[-1])
            rates.append(rate(pose, speeds[-1], tau))
        weights = np.array([1, 2, 2, 1]) * dt / 6
        q, u = moved(q, weights @ speeds), u + weights @ rates
        rows.append(q)
    return np.array(rows)


# Newton's SolverMuJoCo damps its Euler implicitly.
@pytest.mark.parametrize(("method", "twin"), [("mujoco_rk4", "mujoco_rk4"), ("newton_featherstone", "mujoco_euler")])
def test_own_runs_take_torques_that_a_controller_samples(real, method, twin):
    """As MuJoCo's run of the same formula and step, to what single precision costs a hundred steps."""
    if method == "newton_featherstone" and real.engine != "newton":
        pytest.skip("Newton's own")
    model = floating(("root", "hip", "foot"))
    # Newton's Euler is another one on a free base: 1.4e-3 after 0.2 s here.
    dyn, mujoco = mb.dynamics(model, real), mb.dynamics(model, "mujoco")
    q0, v0 = model.random_state(5)

    def law(_, q, v):
        out = np.zeros(model.nv)
        out[6:8] = 30.0 * (0.4 - q[7:9]) - 3.0 * v[6:8]
        return out

    setting = {"dt": 2e-3, "torque": law, "hold": 4e-3, "doubt": False}
    own = mb.simulate(dyn, q0, v0, 0.2, method, **setting)
    same = mb.simulate(mujoco, q0, v0, 0.2, twin, **setting)
    free = mb.simulate(mujoco, q0, v0, 0.2, twin, dt=2e-3)
    limit = 1e3 * epsilon(dyn._significand_bits) if method == twin else 5e-3
    if sums := real.engine.startswith("mjx"):
        assert np.abs(model.difference(same.q, own.q)).max() < 1e-5
    expected = run_of_sums(mujoco, q0, v0, 2e-3, 100, law, hold=2) if sums else same.q
    rounding = np.abs(model.difference(expected, own.q)).max()
    assert rounding < limit
    assert np.abs(model.difference(free.q, own.q)).max() > 10 * rounding
    rows = np.zeros((50, model.nv))
    rows[:, 6] = np.linspace(0.0, 1.0, 50)
    whole = mb.simulate(dyn, q0, v0, 0.1, method, dt=2e-3, torque=rows)
    same = mb.simulate(mujoco, q0, v0, 0.1, twin, dt=2e-3, torque=rows)
    expected = run_of_sums(mujoco, q0, v0, 2e-3, 50, lambda k, *_: rows[k]) if sums else same.q
    assert np.abs(model.difference(expected, whole.q)).max() < limit
    batch = mb.simulate(dyn, [q0, q0], v0, 0.1, method, dt=2e-3, torque=np.stack([rows, 0 * rows]))
    assert np.abs(batch.q[0] - whole.q).max() < 1e3 * epsilon(dyn._significand_bits)
    assert np.abs(batch.q[1] - whole.q).max() > 1e-3
    with pytest.raises(UnsupportedError, match="in the world's axes"):
        mb.simulate(dyn, q0, v0, 0.1, method, dt=2e-3, torque=np.ones(model.nv))


def test_newtons_euler_of_mujoco_damps_implicitly(real):
    """What the book says of it; the others take damping as it is."""
    b = mb.ModelBuilder("slider")
    b.add_body("box", mass=1.0, inertia=(0.1, 0.1, 0.1))
    b.add_joint("slide", "prismatic", parent="world", child="box", axis=(1.0, 0.0, 0.0), damping=20.0)
    run = mb.simulate(mb.dynamics(b.build(), real), [0.0], [1.0], 0.01, "mujoco_euler", dt=0.01)
    expected = 1 / 1.2 if real.engine == "newton" else 1 - 0.2
    assert run.v[-1, 0] == pytest.approx(expected, rel=1e-6)


def test_a_method_that_an_engine_lacks_is_refused_by_name(real):
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, real)
    with pytest.raises(UnsupportedError, match="no integrator 'discrete'"):
        dyn.rollout([0.1, 0.2], [0.0, 0.0], 1e-3, 2, "discrete")
    with pytest.raises(UnsupportedError, match="mujoco_discrete: not on"):
        mb.simulate(dyn, [0.1, 0.2], [0.0, 0.0], 0.01, "mujoco_discrete", dt=1e-3)


def test_the_file_of_the_book_asks_for_what_is_sent():
    """Its engine is in few environments; the names that it reads are checked in all."""
    sent, _ = travelling(STACKED, floating())
    text, places = EXUDYN.read_text(), {"data": sent, "joint": sent["joints"][0], "body": sent["bodies"]["trunk"]}
    for name, there in places.items():
        asked = set(re.findall(rf'{name}\["(\w+)"\]', text))
        assert asked
        assert asked <= {*there}, name


@pytest.mark.usefixtures("users_own")
def test_the_engine_of_the_book_agrees():
    """Exudyn, as the page on extending has it."""
    own = Package("exudyn", "exudyn", Convention(), STACKED, tested=("1.13.6",), file=str(EXUDYN))
    register_remote_engine("exudyn", own)
    try:
        version = mb.engine("exudyn")
        if not version.installed:
            pytest.skip("no environment of exudyn; mbkit.engine('exudyn').interpreter() makes it when it is registered")
        for robot in ("ur5", "panda"):
            result = mb.compare(mb.load(robot), ("lagrangian", version), samples=8, terms_only=True)
            assert result.passed, result.verdict
            assert {"M", "g", "nle", "C v", "forward dynamics"} <= {r.term for r in result.rows if "==" in r.engine}
        with pytest.raises(UnsupportedError, match="'root_joint' is free"):
            mb.dynamics(mb.load("ur5", floating_base=True), version)
    finally:
        PACKAGES.pop("exudyn")


def test_every_engine_here_is_registered():
    assert set(OURS) <= set(remote_engines())
