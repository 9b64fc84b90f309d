"""Motion of frames, centre of mass, momenta and loads: the engines against 34 digits, and all against mechanics."""

from __future__ import annotations

import inspect
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import ENGINES
from mbkit.engines.frames_and_momenta import ALIGNED, AXES, CLASSICAL, LOCAL, SPATIAL
from mbkit.engines.registry import composes
from mbkit.errors import UnsupportedError
from mbkit.model import Model
from tests.quantities import MODELS
from tests.random_trees import off, states

EPS = np.finfo(float).eps
#: Normwise, of trees of ten bodies: what large terms leave of their rounding where they cancel.
CLOSE = 500 * EPS
#: Engines that tell joint loads.
LOADED = [x for x in ENGINES if "joint_wrenches" in mb.dynamics(mb.catalog.pendulum(), x).supports]


@cache
def tree(name: str) -> Model:
    return MODELS[name]()[0]


@cache
def at(name: str) -> dict[str, np.ndarray]:
    return dict(zip(("q", "v", "a", "tau"), states(tree(name), 2), strict=True))


def wrenches(model: Model) -> dict[str, np.ndarray]:
    """Return wrenches on a frame, on a body, and on what does not move."""
    w = np.random.default_rng(7).standard_normal((3, 2, 6))
    return dict(zip(("tip", model.bodies[1].name, "world"), w, strict=True))


def rate(f, h: float = 2e-3):
    """Return df/dt at 0 with an error of h⁴."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


@pytest.mark.parametrize("name", ["floating", "all joint types"])
def test_rates_are_the_derivatives_along_a_motion(name):
    model = tree(name)
    dyn = mb.dynamics(model, "lagrangian")
    q, v, a, _ = (0.3 * x[0] if x.shape[1] == model.nv else x[0] for x in at(name).values())
    zero = np.zeros(model.nv)

    def along(method, *more, moved):
        """Return the rate of a quantity of q, or of q and v, at this v̇."""

        def value(t):
            velocity = () if moved is None else (v + t * moved,)
            return getattr(dyn, method)(model.integrate(q, t * v), *velocity, *more)

        return rate(value)

    for axes in AXES:
        # Six numbers in axes that stay are those of a point; the others turn with the frame.
        kind = CLASSICAL if axes == ALIGNED else SPATIAL
        pairs = [
            (along("velocity", "tip", axes, moved=a), dyn.acceleration(q, v, a, "tip", axes, kind)),
            (along("velocity", "tip", axes, moved=zero), dyn.jacobian_dot_v(q, v, "tip", axes)),
            (along("jacobian", "tip", axes, moved=None) @ v, dyn.jacobian_dot_v(q, v, "tip", axes)),
            (dyn.jacobian(q, "tip", axes) @ v, dyn.velocity(q, v, "tip", axes)),
        ]
        for found, expected in pairs:
            assert off(found, expected) < 1e-8, axes
    momentum = dyn.centroidal_momentum_matrix(q) @ a + dyn.centroidal_momentum_bias(q, v)
    pairs = [
        (along("pose", "tip", moved=None)[:3, 3], dyn.velocity(q, v, "tip")[:3]),
        (along("center_of_mass", moved=None), dyn.center_of_mass_velocity(q, v)),
        (along("center_of_mass_velocity", moved=a), dyn.center_of_mass_acceleration(q, v, a)),
        (along("centroidal_momentum", moved=a), momentum),
        (along("centroidal_momentum_matrix", moved=None) @ v, dyn.centroidal_momentum_bias(q, v)),
    ]
    for found, expected in pairs:
        assert off(found, expected) < 1e-8


@pytest.mark.parametrize("name", ["without springs", "sound"])
def test_momentum_changes_by_weight_wrenches_and_the_loads_of_the_ground(name):
    model, (q, v, a, _) = tree(name), at(name).values()
    on = wrenches(model)
    dyn = mb.dynamics(model, "lagrangian")
    center = dyn.center_of_mass(q)
    out = np.zeros((2, 6))
    out[:, :3] += model.mass * model.gravity

    def add(point, force, moment):
        out[:, :3] += force
        out[:, 3:] += moment + np.cross(point - center, force)

    for frame, w in on.items():
        if frame != "world":
            add(dyn.pose(q, frame)[:, :3, 3], w[:, :3], w[:, 3:])
    roots = [j for j in model.joints if j.parent == "world"]
    carried = dyn.joint_wrenches(q, v, a, on, ALIGNED, [j.name for j in roots])
    for k, joint in enumerate(roots):
        X = dyn.pose(q, joint.child)
        force, moment = (np.einsum("nij,nj->ni", X[:, :3, :3], carried[:, k, i : i + 3]) for i in (0, 3))
        add(X[:, :3, 3], force, moment)
    change = np.einsum("nij,nj->ni", dyn.centroidal_momentum_matrix(q), a) + dyn.centroidal_momentum_bias(q, v)
    assert off(change, out) < CLOSE


@pytest.mark.parametrize("name", ["all joint types", "floating"])
def test_wrenches_do_the_work_of_their_generalized_force(name):
    model, (q, v, _, _) = tree(name), at(name).values()
    dyn, on = mb.dynamics(model, "lagrangian"), wrenches(tree(name))
    for axes in AXES:
        power = sum(np.sum(w * dyn.velocity(q, v, frame, axes), axis=1) for frame, w in on.items())
        assert off(np.sum(dyn.generalized_force(q, on, axes) * v, axis=1), power) < CLOSE


@pytest.mark.thorough("lagrangian")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.filterwarnings("ignore::mbkit.errors.KnownDefectWarning")
def test_wrenches_and_jacobians_have_one_default(engine):
    """Jᵀ w with defaults is the generalized force, and what acts in dynamics, steps and runs."""
    model, (q, v, a, tau) = tree("floating"), (x[0] for x in at("floating").values())
    dyn, w = mb.dynamics(model, engine), np.arange(1.0, 7.0)
    on = {"tip": w}
    pushed = dyn.jacobian(q, "tip").T @ w
    assert off(dyn.generalized_force(q, on), pushed) < CLOSE
    assert off(dyn.inverse_dynamics(q, v, a, on), dyn.inverse_dynamics(q, v, a) - pushed) < CLOSE
    assert off(dyn.forward_dynamics(q, v, tau, on), dyn.forward_dynamics(q, v, tau + pushed)) < CLOSE
    takers = [getattr(type(dyn), name) for name in dir(type(dyn)) if not name.startswith("_")]
    signatures = [inspect.signature(x).parameters for x in takers if inspect.isfunction(x)]
    defaults = [x["axes"].default for x in signatures if "axes" in x]
    defaults.append(inspect.signature(mb.simulate).parameters["wrench_axes"].default)
    assert len(defaults) > 9
    assert set(defaults) == {ALIGNED}


@pytest.mark.thorough("floating-lagrangian", "floating-mujoco", "floating-drake")
@pytest.mark.parametrize("engine", [x for x in LOADED if x != "oracle"])
@pytest.mark.parametrize("name", ["fixed to the world", "floating"])
@pytest.mark.filterwarnings("ignore::mbkit.errors.KnownDefectWarning")
def test_bodies_are_in_balance_at_forward_dynamics_and_nowhere_else(engine, name):
    model, (q, v, _, tau) = tree(name), at(name).values()
    dyn, on = mb.dynamics(model, engine), wrenches(model)
    acting = dyn.forward_dynamics(q, v, tau, on, LOCAL)
    scale = np.abs(dyn.joint_wrenches(q, v, acting, on)).max()
    assert np.abs(dyn.newton_euler_residual(q, v, acting, tau, on, LOCAL)).max() < 1000 * EPS * scale
    off_by = np.random.default_rng(1).standard_normal(model.nv)
    found = dyn.newton_euler_residual(q, v, acting + off_by, tau, on, LOCAL)
    J = dyn.jacobian(q, [b.name for b in model.bodies], LOCAL)
    for k, body in enumerate(model.bodies):
        linear, angular = np.split(J[:, k] @ off_by, 2, axis=1)
        expected = -np.hstack([body.mass * (linear + np.cross(angular, body.com)), angular @ body.inertia])
        assert np.abs(found[:, k] - expected).max() < 1000 * EPS * scale


def test_a_pendulums_pivot_carries_weight_and_centripetal_force():
    m, L, g = 2.0, 1.5, 9.81
    model = mb.catalog.pendulum(mass=m, length=L)
    angle, speed = 0.7, 3.0
    for engine in LOADED:
        dyn = mb.dynamics(model, engine)
        a = dyn.forward_dynamics([angle], [speed], [0.0])
        assert a[0] == pytest.approx(-g / L * np.sin(angle), rel=1e-13)
        (load,) = dyn.joint_wrenches([angle], [speed], a)
        down = dyn.pose([angle], "tip")[:3, :3].T @ np.array([0.0, 0.0, -1.0])
        out = np.array(model.frame("tip").translation) / L
        # The tension holds the weight's part along the rod, and turns the mass; across it nothing is left.
        tension = m * (g * np.cos(angle) + L * speed**2)
        assert down @ out == pytest.approx(np.cos(angle), rel=1e-13)
        assert np.allclose(load[:3], -tension * out, atol=1e-13 * tension), engine
        assert np.allclose(load[3:], 0.0, atol=1e-13 * tension * L), engine


@pytest.mark.parametrize("engine", ["pinocchio", "mujoco", "drake"])
def test_far_from_the_origin_loads_and_momenta_keep_their_digits(engine):
    b = mb.ModelBuilder("far")
    b.add_body("base", mass=3.0, com=(0.1, 0, 0), inertia=(0.2, 0.3, 0.4))
    b.add_body("arm", mass=1.0, com=(0, 0, 0.2), inertia=(0.02, 0.03, 0.04))
    b.add_joint("float", "free", parent="world", child="base")
    b.add_joint("elbow", "revolute", parent="base", child="arm", axis=(0, 1, 0), translation=(0, 0, 0.5))
    model = b.build()
    q, v, a, _ = (x[0] for x in states(model, 1))
    q[:3] = 1e3, -2e3, 5e2
    dyn, own = mb.dynamics(model, engine), mb.dynamics(model, "oracle")
    # Thousands of metres leave their rounding in positions of parts of a metre, and in Drake's inertias their squares:
    # it adds them about the world's origin.
    square = 10 * EPS * model.mass * float(q[:3] @ q[:3])
    for quantity, given in (("joint_wrenches", (q, v, a)), ("centroidal_momentum", (q, v)), ("locked_inertia", (q,))):
        tolerance = square if (engine, quantity) == ("drake", "locked_inertia") else 1e4 * CLOSE
        assert off(getattr(dyn, quantity)(*given), getattr(own, quantity)(*given)) < tolerance, quantity


def test_mujoco_names_a_body_that_it_has_not():
    b = mb.ModelBuilder("gimbal")
    b.add_body("ring", mass=0.0, com=(0, 0, 0), inertia=(0, 0, 0))
    b.add_body("bob", mass=1.0, com=(0, 0, -1), inertia=(0.1, 0.1, 0.1))
    b.add_joint("outer", "revolute", parent="world", child="ring", axis=(1, 0, 0))
    b.add_joint("inner", "revolute", parent="ring", child="bob", axis=(0, 1, 0), translation=(0, 0.1, 0))
    model = b.build()
    dyn, own = mb.dynamics(model, "mujoco"), mb.dynamics(model, "oracle")
    q, v, a = np.array([[0.3, 0.4], [1.0, -2.0], [0.5, 0.6]])
    with pytest.raises(UnsupportedError, match=r"'ring'.*without mass"):
        dyn.velocity(q, v, "ring")
    with pytest.raises(UnsupportedError, match=r"'outer'.*'ring'"):
        dyn.joint_wrenches(q, v, a)
    assert off(dyn.joint_wrenches(q, v, a, joints=["inner"]), own.joint_wrenches(q, v, a, joints=["inner"])) < CLOSE


@pytest.mark.parametrize("engine", LOADED)
def test_wrenches_that_fail_leave_nothing_behind(engine):
    """Engines hold forces in their data; the next call is not to feel them."""
    model = tree("without springs")
    dyn = mb.dynamics(model, engine)
    q, v, a, tau = (x[0] for x in at("without springs").values())
    before = dyn.forward_dynamics(q, v, tau), dyn.joint_wrenches(q, v, a), dyn.inverse_dynamics(q, v, a)
    dyn.forward_dynamics(q, v, tau, {"tip": np.ones(6)})
    dyn.joint_wrenches(q, v, a, {"tip": np.ones(6)})
    with pytest.raises(mb.errors.InputError):
        dyn.joint_wrenches(q, v, a, {"tip": np.full(6, np.nan)})
    with pytest.raises(mb.errors.UnknownNameError):
        dyn.forward_dynamics(q, v, tau, {"tipp": np.ones(6)})
    after = dyn.forward_dynamics(q, v, tau), dyn.joint_wrenches(q, v, a), dyn.inverse_dynamics(q, v, a)
    assert all(np.array_equal(x, y) for x, y in zip(before, after, strict=True))


def test_a_batch_of_wrenches_beside_one_state_has_a_residual_each():
    model = mb.load("ur5")
    dyn = mb.dynamics(model, "lagrangian")
    q, v = model.random_state(np.random.default_rng(0))
    wrenches = {"tool0": np.random.default_rng(1).standard_normal((3, 6))}
    moved = dyn.forward_dynamics(q, v, v, wrenches)
    residual = dyn.newton_euler_residual(q, v, moved, v, wrenches)
    assert residual.shape == (3, len(model.bodies), 6)
    assert np.abs(residual).max() < CLOSE * np.abs(dyn.joint_wrenches(q, v, moved, wrenches)).max()
    weights = mb.dynamics(mb.catalog.pendulum(mass=mb.Parameter("m")), "lagrangian").at(m=np.array([1.0, 2.0]))
    assert weights.newton_euler_residual([0.1], [1.0], [1.0], [0.0]).shape == (2, 1, 6)


@pytest.mark.parametrize("engine", ["lagrangian", "oracle"])
def test_energies_without_bodies_have_none_of_this(engine):
    model = mb.lagrangian.from_model(mb.catalog.slider_crank()).model
    dyn = mb.dynamics(model, engine)
    q, zero = model.neutral(), np.zeros(3)
    assert not {"center_of_mass", "joint_wrenches", "pose", "regressor"} & dyn.supports
    for call in (
        lambda: dyn.center_of_mass(q),
        lambda: dyn.locked_inertia(q),
        lambda: dyn.joint_wrenches(q, zero, zero),
        lambda: dyn.velocity(q, zero, "crank"),
        lambda: dyn.generalized_force(q, {"crank": np.ones(6)}),
    ):
        with pytest.raises(UnsupportedError, match="written as energies"):
            call()


@pytest.mark.parametrize("engine", ["pinocchio", "lagrangian", "mujoco"])
def test_poses_of_bodies_are_theirs_where_a_frame_has_the_name(engine, tmp_path):
    """An MJCF's body frame stays at the body's origin, and the description's body is at its joint."""
    path = tmp_path / "m.xml"
    path.write_text(
        '<mujoco><worldbody><body name="a" pos="0 0 1" euler="10 20 30"><joint name="j" axis="0 1 0" pos=".3 0 .1"/>'
        '<geom size=".1" pos=".5 0 0"/><body name="b" pos="0 1 0"><joint name="k" pos="0 .2 0"/><geom size=".1"/>'
        "</body></body></worldbody></mujoco>"
    )
    model = mb.load(path)
    dyn = mb.dynamics(model, engine)
    Q, V = model.random_state(0, 4)
    X = dyn.body_poses(Q)
    com = sum(b.mass * (X[:, k] @ np.append(b.com, 1.0)) for k, b in enumerate(model.bodies)) / model.mass
    np.testing.assert_allclose(com[:, :3], dyn.center_of_mass(Q), atol=1e-14)
    assert not np.allclose(dyn.pose(Q, "a"), X[:, 0])
    tau = np.ones_like(V)
    left = dyn.newton_euler_residual(Q, V, dyn.forward_dynamics(Q, V, tau), tau)
    assert np.abs(left).max() < 1e-12 * 9.81 * model.mass


def test_a_frame_has_not_the_name_of_another_body():
    b = mb.ModelBuilder("two")
    for name, parent in (("a", "world"), ("b", "a")):
        b.add_joint(f"to {name}", "revolute", parent=parent, child=name, axis=(0, 0, 1))
        b.add_body(name, mass=1.0, com=(1, 0, 0), inertia=np.eye(3))
    b.add_frame("a", body="b")
    with pytest.raises(mb.errors.ModelError, match="frame 'a' on body 'b' has the name of another body"):
        b.build()


def test_the_book_says_which_quantities_of_an_engine_are_its_own():
    root = Path(mb.__file__).parent
    page = (root.parent / "notebooks" / "reference" / "engines.md").read_text("utf-8")
    table = page.split("| quantity | Pinocchio | MuJoCo | Drake |\n")[1].split("\n\n")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[1:]]
    assert {"jacobian_dot_v", "locked_inertia", "joint_wrenches"} <= {row[0].strip("`") for row in rows}
    for name, *cells in rows:
        quantity = re.match(r"`?([a-z_ ]+)", name)[1].strip().replace(" ", "_")
        for engine, cell in zip(("pinocchio", "mujoco", "drake"), cells, strict=True):
            if not cell:
                continue
            assert cell.startswith("composed") == composes(ENGINES[engine].load(), quantity), (name, engine)
            source = "".join(path.read_text("utf-8") for path in (root / "engines" / engine).glob("*.py"))
            for function in re.findall(r"`[\w.]*?(\w+)`", cell):
                assert function in source, (name, engine)


@pytest.mark.thorough("all joint types", "floating", "sound")
@pytest.mark.parametrize("name", ["all joint types", "fixed to the world", "floating", "without springs", "sound"])
def test_the_whole_has_the_mass_weight_and_momentum_of_its_parts(name):
    model, (q, v, _, _) = tree(name), at(name).values()
    dyn = mb.dynamics(model, "lagrangian")
    weight = model.mass * model.gravity
    J, A = dyn.center_of_mass_jacobian(q), dyn.centroidal_momentum_matrix(q)
    still = mb.dynamics(model.without("springs"), "lagrangian") if model.needs.springs else dyn
    assert off(still.potential_energy(q), -dyn.center_of_mass(q) @ weight) < CLOSE
    assert off(dyn.gravity(q), -np.einsum("nij,i->nj", J, weight)) < CLOSE
    assert off(A[:, :3], model.mass * J) < CLOSE
    assert off(np.einsum("nij,nj->ni", A, v), dyn.centroidal_momentum(q, v)) < CLOSE
    assert off(np.einsum("nij,nj->ni", J, v), dyn.center_of_mass_velocity(q, v)) < CLOSE
    locked = dyn.locked_inertia(q)
    assert np.array_equal(locked[0, :3, :3], locked[0, 0, 0] * np.eye(3))
    assert locked[0, 0, 0] == pytest.approx(model.mass, rel=1e-14)
    assert np.linalg.eigvalsh(locked).min() > 0
