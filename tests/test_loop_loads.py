"""Forces of actuators, loads of joints and loops, held coordinates, couplers, and the inertia that a crank feels."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, NumericalError, UnknownNameError, UnsupportedError
from tests.scenes import chain
from tests.test_loop_dynamics import closed_tree, four_bar
from validation.four_bar import COUPLER, CRANK, GRAVITY, LINE, ROCKER, geometry

OWN = {"compile": False}
#: Engines with rigid loops.
RIGID = ("lagrangian", "pinocchio")


#: Of engines to each other, in terms of the largest number.
CLOSE = 1e-12


def dynamics(model: mb.Model, engine: str) -> mb.Dynamics:
    return mb.dynamics(model, engine, **(OWN if engine == "lagrangian" else {}))


def off(x: np.ndarray, exact: np.ndarray) -> float:
    return float(np.abs(x - exact).max() / np.abs(exact).max())


@pytest.mark.thorough("point", "universal", "prismatic")
@pytest.mark.parametrize("kind", ["point", "universal", "prismatic", "distance"])
def test_random_trees_are_in_balance_with_every_kind_of_loop(kind: str) -> None:
    model, q = closed_tree(1, kind)
    rng = np.random.default_rng(3)
    tau, push = rng.standard_normal(model.nv), {model.bodies[2].name: rng.standard_normal(6)}
    engines = [dynamics(model, x) for x in ("oracle", *RIGID)]
    q, v = engines[1].project(q, rng.standard_normal(model.nv))
    axes = "local_world_aligned"
    exact = engines[0].joint_wrenches(q, v, None, push, axes, None, tau)
    for dyn in engines:
        assert off(dyn.joint_wrenches(q, v, None, push, axes, None, tau), exact) < 1e-11
        a = dyn.forward_dynamics(q, v, tau, push, axes)
        assert np.abs(dyn.newton_euler_residual(q, v, a, tau, push, axes)).max() < 1e-11 * np.abs(exact).max()
        # Loads belong to the force too: with another one the same motion is refused.
        with pytest.raises(InputError, match="does not move with these accelerations"):
            dyn.joint_wrenches(q, v, a, push, axes, None, tau + 1.0)


def test_actuators_that_are_as_many_as_the_degrees_of_freedom_have_one_answer() -> None:
    model = mb.catalog.get("planar_3rrr")()
    names, rng = [f"theta{k}" for k in (1, 2, 3)], np.random.default_rng(0)
    q, v = model.random_state(rng, 3)
    places = [model.velocity_names.index(x) for x in names]
    tau = np.zeros((3, model.nv))
    tau[:, places] = rng.standard_normal((3, 3))
    for engine in ("oracle", *RIGID, "mujoco"):
        dyn = dynamics(model, engine)
        a = dynamics(model, "lagrangian").forward_dynamics(q, v, tau)
        forces = dyn.actuator_forces(q, v, a, names)
        assert np.abs(forces.tau - tau).max() < 1e-11
        assert (np.delete(forces.tau, places, axis=1) == 0).all()
        if engine != "mujoco":
            assert off(forces.constraint_forces, dyn.constraint_forces(q, v, tau)) < 1e-10
        # A batch is its states.
        one = dyn.actuator_forces(q[1], v[1], a[1], names)
        assert np.array_equal(one.tau, forces.tau[1])
        # One more shares the load: of all such forces the one with the least norm.
        more = dyn.actuator_forces(q, v, a, [*names, "platform"]).tau
        assert (np.linalg.norm(more, axis=1) < np.linalg.norm(tau, axis=1)).all()
        assert off(dynamics(model, "lagrangian").forward_dynamics(q, v, more), a) < 1e-11


def test_actuators_and_motions_that_do_not_fit_are_refused() -> None:
    model = mb.catalog.get("five_bar")()
    q, v = model.random_state(1)
    for engine in ("oracle", *RIGID):
        dyn = dynamics(model, engine)
        a = dyn.forward_dynamics(q, v, np.zeros(model.nv))
        with pytest.raises(InputError, match="2 degrees of freedom, and with theta1 held still 1"):
            dyn.actuator_forces(q, v, a, ["theta1"])
        with pytest.raises(InputError, match="with no actuator held still 2"):
            dyn.actuator_forces(q, v, a, [])
        with pytest.raises(InputError, match=r"J a \+ γ = 0, which is missed: loop"):
            dyn.actuator_forces(q, v, a + 0.1)
        with pytest.raises(UnknownNameError):
            dyn.actuator_forces(q, v, a, ["elbow"])
        for wrong in ("all", 3):
            with pytest.raises(InputError, match="actuators: expected a list"):
                dyn.actuator_forces(q, v, a, wrong)  # type: ignore[arg-type]  # wrong
    tree = mb.dynamics(mb.catalog.double_pendulum())
    with pytest.raises(UnsupportedError, match="inverse_dynamics"):
        tree.actuator_forces([0.0, 0.0], [0.0, 0.0], [0.0, 0.0])
    gripper = mb.catalog.get("parallel_gripper")()
    q, v = gripper.random_state(0)
    with pytest.raises(InputError, match="mimics 'theta'"):
        mb.dynamics(gripper).actuator_forces(q, v, v, ["theta2"])


def test_a_joint_that_locks_with_the_mechanism_is_no_actuator() -> None:
    """At its dead centre the slider moves nothing: with it held still the crank turns."""
    model = crank_with_rod()
    for engine in RIGID:
        dyn = dynamics(model, engine)
        q, v = dyn.project([0.0, CRANK_RADIUS + ROD], np.zeros(2))
        assert dyn.actuator_forces(q, v, np.zeros(2), ["crank"]).tau[1] == 0.0
        with pytest.raises(InputError, match="which move crank"):
            dyn.actuator_forces(q, v, np.zeros(2), ["slider"])


def test_energies_on_paper_have_forces_of_actuators_too() -> None:
    from mbkit.lagrangian import from_model

    model = mb.catalog.slider_crank()
    paper, own = from_model(model).dynamics(options=OWN), dynamics(model, "lagrangian")
    q, v = model.random_state(0)
    a = own.forward_dynamics(q, v, np.ones(model.nv))
    for actuators in ("least", [model.joint_names[0]]):
        assert off(paper.actuator_forces(q, v, a, actuators).tau, own.actuator_forces(q, v, a, actuators).tau) < 1e-10


# Statics


def test_four_bar_at_rest_has_the_torque_and_the_pin_forces_of_statics() -> None:
    theta = 0.7
    (phi, psi), (f1, r1), _ = (tuple(float(x) for x in part) for part in geometry(np.longdouble(theta)))
    model = four_bar()
    q = [theta, phi - theta, psi]
    weights = [LINE * x * GRAVITY for x in (CRANK, COUPLER, ROCKER)]
    # Virtual work of the weights.
    rates = [CRANK / 2 * np.cos(theta), CRANK * np.cos(theta) + COUPLER / 2 * np.cos(phi) * f1]
    rates.append(ROCKER / 2 * np.cos(psi) * r1)
    torque = sum(w * x for w, x in zip(weights, rates, strict=True))
    # Force and moment of each rod about its lower end; unknowns: forces on crank, coupler and rocker there, that of the
    # rocker on the coupler, and the torque.
    A, b = np.zeros((9, 9)), np.zeros(9)
    for row, (length, angle, own, other) in enumerate(
        ((CRANK, theta, 0, 2), (COUPLER, phi, 2, 6), (ROCKER, psi, 4, 6))
    ):
        sign = -1.0 if row != 1 else 1.0
        A[3 * row : 3 * row + 2, own : own + 2] = np.eye(2)
        A[3 * row : 3 * row + 2, other : other + 2] = sign * np.eye(2)
        A[3 * row + 2, other : other + 2] = sign * length * np.array([-np.sin(angle), np.cos(angle)])
        b[3 * row + 1], b[3 * row + 2] = weights[row], weights[row] * length / 2 * np.cos(angle)
    A[2, 8] = 1.0
    forces = np.linalg.solve(A, b)
    assert forces[8] == pytest.approx(torque, rel=1e-13)
    zero = np.zeros(3)
    for engine in ("oracle", *RIGID, "mujoco"):
        dyn = dynamics(model, engine)
        tau, _ = dyn.actuator_forces(q, zero, zero, ["at_crank"])
        assert tau == pytest.approx([torque, 0.0, 0.0], abs=1e-12)
        # In child axes: x along the rod, and the angles turn x to z.
        loads = dyn.joint_wrenches(q, zero, zero, tau=tau)
        for k, angle in enumerate((theta, phi, psi)):
            along = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            assert along @ loads[k, [0, 2]] == pytest.approx(forces[2 * k : 2 * k + 2], abs=1e-12)
            assert loads[k, [1, 3, 5]] == pytest.approx(np.zeros(3), abs=1e-12)
        if engine != "mujoco":
            (pin,) = dyn.loop_wrenches(q, zero, tau)
            turned = np.array([[np.cos(phi), -np.sin(phi)], [np.sin(phi), np.cos(phi)]]) @ pin[[0, 2]]
            assert turned == pytest.approx(forces[6:8], abs=1e-12)
            assert pin[3:] == pytest.approx(np.zeros(3), abs=1e-12)


# What is not unique


def test_bricard_tells_which_loads_are_not_unique_and_gives_those_with_the_least_norm() -> None:
    model = mb.catalog.get("bricard")()
    q, v = model.random_state(0)
    tau = np.ones(model.nv)
    for engine in ("oracle", *RIGID, "mujoco"):
        found = dynamics(model, engine).undetermined_loads(q)
        assert found.strains == 1
        assert found.joints.shape == (model.nv, 6)
        assert found.joints.any()
        assert found.loops.any()
    dyn = dynamics(model, "lagrangian")
    J, forces = dyn.constraint_jacobian(q), dyn.constraint_forces(q, v, tau)
    strain = np.linalg.svd(J)[0][:, -1]
    assert np.abs(strain @ J).max() < 1e-12
    assert abs(strain @ forces) < 1e-12 * np.linalg.norm(forces)
    # What a joint's own drive takes is unique: a strain does no work on a motion that the joints allow.
    loads = dyn.joint_wrenches(q, v, None, tau=tau)
    for k, joint in enumerate(model.independent_joints):
        axis = joint.axes[0]
        assert loads[k, 3:] @ axis == pytest.approx(tau[k], abs=1e-11 * np.abs(loads).max())
    # A spatial mechanism without a redundant row has unique loads.
    stewart = mb.catalog.get("stewart_platform")()
    found = mb.dynamics(stewart).undetermined_loads(stewart.random_state(0)[0])
    assert found.strains == 0
    assert not found.joints.any()


def test_a_pin_in_a_plane_may_be_strained_across_it_and_a_hinge_in_three_ways() -> None:
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    hinge = {"kind": "revolute", "rotation_a": upright, "rotation_b": upright}
    for loop, strains in (({}, 1), (hinge, 3)):
        model = four_bar(**loop)
        q, v = model.random_state(0)
        dyn = mb.dynamics(model)
        found = dyn.undetermined_loads(q)
        assert found.strains == strains
        # In the plane all is unique: forces along x and z, and moments about y.
        assert not found.joints[:, [0, 2, 4]].any()
        assert found.joints[:, 1].all()
        assert np.abs(dyn.joint_wrenches(q, v, None, tau=np.zeros(3))[:, [1, 3, 5]]).max() < 1e-12


# MuJoCo


@pytest.mark.parametrize("kind", ["point", "frame"])
def test_mujoco_s_loads_are_its_own_internal_forces_with_soft_loops(kind: str) -> None:
    """mj_rnePostConstraint takes the forces that its solver found; here they come from the motion."""
    model, q = closed_tree(3, kind)
    dyn = mb.dynamics(model, "mujoco")
    rng = np.random.default_rng(1)
    q, v = dynamics(model, "lagrangian").project(q, rng.standard_normal(model.nv))
    tau = rng.standard_normal(model.nv)
    loads = dyn.joint_wrenches(q, v, None, tau=tau)
    m, d = dyn.mj_model, mujoco.MjData(dyn.mj_model)
    with dyn._with_loops():
        dyn._set(q, v)
        d.qpos[:], d.qvel[:], d.qfrc_applied[:] = dyn._d.qpos, dyn._d.qvel, dyn._to_engine(tau)
    mujoco.mj_forward(m, d)
    mujoco.mj_rnePostConstraint(m, d)
    for joint, load in zip((j for j in model.joints if j.type.nv), loads, strict=True):
        b = m.body(joint.child).id
        R, arm = d.xmat[b].reshape(3, 3), d.subtree_com[m.body_rootid[b]] - d.xpos[b]
        moment, force = d.cfrc_int[b, :3], d.cfrc_int[b, 3:]
        own = np.concatenate([R.T @ force, R.T @ (moment + np.cross(arm, force))])
        assert np.abs(load - own).max() < 1e-12 * np.abs(loads).max()
    left = dyn.newton_euler_residual(q, v, dyn.forward_dynamics(q, v, tau), tau)
    assert np.abs(left).max() < CLOSE * np.abs(loads).max()


def test_a_comparison_of_mechanisms_has_joint_loads() -> None:
    result = mb.compare(mb.catalog.four_bar(), samples=4, terms_only=True)
    rows = {r.engine: r for r in result.rows if r.term == "joint loads"}
    assert set(rows) == {"pinocchio", "lagrangian", "mujoco"}
    assert all(r.passed for r in rows.values())
    assert rows["mujoco"].reference == "own law"
    assert not [r for r in result.refusals if r.term == "joint loads"]


# Held coordinates


@pytest.mark.thorough("stewart_platform", "delta_robot")
@pytest.mark.parametrize("name", ["four_bar", "bricard", "stewart_platform", "delta_robot"])
def test_held_coordinates_stay_to_the_bit_and_the_others_follow(name: str) -> None:
    model = mb.catalog.get(name)()
    dyn = dynamics(model, "lagrangian")
    q, v = model.random_state(3)
    held = model.joint_names[0]
    at, moving = model.layout.q[held], model.layout.v[held]
    q = model.integrate(q, np.full(model.nv, 0.02))
    q1, v1 = dyn.project(q, v, hold=[held])
    assert np.array_equal(q1[at], q[at])
    assert np.array_equal(v1[moving], v[moving])
    assert np.abs(dyn.constraint_residual(q1)).max() < 1e-14
    assert np.abs(dyn.constraint_rate(q1, v1)).max() < 1e-13
    a = dyn.project_acceleration(q1, v1, np.ones(model.nv), hold=[held])
    assert (a[moving] == 1.0).all()
    assert np.abs(dyn.constraint_jacobian(q1) @ a + dyn.constraint_bias(q1, v1)).max() < 1e-12
    # Of all that hold it the nearest: what is left to change is across the motions that are still free.
    M, J = dyn.mass_matrix(q1), dyn.constraint_jacobian(q1)
    free = np.setdiff1d(np.arange(model.nv), np.arange(model.nv)[moving])
    null = np.linalg.svd(J[:, free])[2][np.linalg.matrix_rank(J[:, free], tol=1e-9) :]
    assert np.abs(null @ (M @ (v1 - v))[free]).max(initial=0.0) < 1e-12 * np.abs(M).max()
    # A batch, and another engine.
    both = mb.dynamics(model).project(np.stack([q, q]), np.stack([v, v]), hold=[held])
    assert off(both[0][1], q1) < 1e-12


def test_what_cannot_be_held_is_refused() -> None:
    model = crank_with_rod()
    dyn = dynamics(model, "lagrangian")
    with pytest.raises(InputError, match="hold: with slider held, crank_with_rod has no consistent state near"):
        dyn.project([0.3, 2.0], [0.0, 0.0], hold=["slider"])
    # At the dead centre any angle of the crank is as good, to first order, and a speed of the slider asks for none.
    dead = [0.0, CRANK_RADIUS + ROD]
    with pytest.raises(InputError, match="not determined at this pose"):
        dyn.project(dead, [0.0, 0.0], hold=["slider"])
    with pytest.raises(UnknownNameError):
        dyn.project(dead, [0.0, 0.0], hold=["wheel"])
    with pytest.raises(InputError, match="hold: expected a list"):
        dyn.project(dead, [0.0, 0.0], hold="crank")
    q, v = dyn.project([0.5, 0.8], [1.0, 0.0], hold=["crank"])
    with pytest.raises(InputError, match=r"cannot be met: open stay .* per second"):
        dyn.project(q, [1.0, 1.0], hold=["crank", "slider"])
    with pytest.raises(InputError, match=r"J a \+ γ = 0 of crank_with_rod cannot be met"):
        dyn.project_acceleration(q, v, [5.0, 5.0], hold=["crank", "slider"])
    ball, start = closed_tree(5, "point")
    quaternion = next(x for x in ball.coordinate_names if x not in ball.velocity_names)
    with pytest.raises(InputError, match="whose velocities are not the rates"):
        dynamics(ball, "lagrangian").project(start, np.zeros(ball.nv), hold=[quaternion])


# The inertia that a crank feels

CRANK_RADIUS, ROD, INERTIA, SLIDER = 0.3, 0.8, 0.05, 2.0


def crank_with_rod() -> mb.Model:
    """A crank, and a slider along x on a rod without mass."""
    wheel = {"body": "wheel", "joint": "crank", "mass": 1.0, "inertia": (INERTIA,) * 3, "axis": (0, 0, 1)}
    block = {"body": "block", "joint": "slider", "mass": SLIDER, "inertia": (0.01,) * 3, "axis": (1, 0, 0)}
    slide = {"kind": "prismatic", "parent": "world"}
    b = chain(wheel, block | slide, name="crank_with_rod", gravity=(0, 0, 0))
    b.add_loop("rod", "distance", body_a="wheel", translation_a=(CRANK_RADIUS, 0, 0), body_b="block", length=ROD)
    return b.build()


def test_reduced_inertia_of_a_slider_crank_is_its_closed_form() -> None:
    model = crank_with_rod()
    theta = np.array([0.3, 1.2, -2.0])
    s, c = np.sin(theta), np.cos(theta)
    r, root = CRANK_RADIUS, np.sqrt(ROD**2 - (CRANK_RADIUS * s) ** 2)
    x, first = r * c + root, -r * s - r * r * s * c / root
    second = -r * c - r * r * (c * c - s * s) / root - r**4 * s * s * c * c / root**3
    for engine in ("oracle", *RIGID):
        dyn = dynamics(model, engine)
        q = np.stack([theta, x], axis=1)
        J, slope, N = dyn.reduced_inertia(q, "crank")
        assert pytest.approx(INERTIA + SLIDER * first**2, rel=1e-13) == J
        assert slope == pytest.approx(2 * SLIDER * first * second, rel=1e-12)
        assert np.stack([np.ones(3), first], axis=1) == pytest.approx(N, rel=1e-13)
        one = dyn.reduced_inertia(q[1], "crank")
        assert (one.inertia, one.derivative) == (J[1], slope[1])
        with pytest.raises(NumericalError, match="slider of crank_with_rod does not determine"):
            dyn.reduced_inertia([0.0, r + ROD], "slider")


@pytest.mark.thorough("bricard-coordinates0", "andrews_squeezer-coordinates2")
@pytest.mark.parametrize(
    ("name", "coordinates"), [("bricard", ["q1"]), ("five_bar", ["theta1", "theta2"]), ("andrews_squeezer", ["beta"])]
)
def test_reduced_inertia_has_the_energy_and_its_derivatives_are_differences(name: str, coordinates: list[str]) -> None:
    model = mb.catalog.get(name)()
    dyn = dynamics(model, "lagrangian")
    q, v = model.random_state(3)
    J, slopes, N = dyn.reduced_inertia(q, coordinates)
    places = [model.coordinate_names.index(x) for x in coordinates]
    rates = v[places]
    assert 0.5 * rates @ J @ rates == pytest.approx(dyn.kinetic_energy(q, v), rel=1e-11)
    assert np.abs(J - J.T).max() < 1e-14 * np.abs(J).max()
    for k, place in enumerate(places):
        ends, h = [], 1e-5
        for sign in (1, -1):
            near = q + sign * h * N[:, k]
            near[places] = q[places]
            near[place] += sign * h
            ends.append(dyn.reduced_inertia(dyn.project(near, v, hold=coordinates)[0], coordinates).inertia)
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(slopes[..., k], abs=1e-6 * np.abs(slopes).max())
    # The reduced equation of motion: J θ̈ + Γ θ̇² = Nᵀ (τ - g).
    tau = np.ones(model.nv)
    a = dyn.forward_dynamics(q, v, tau)
    if len(places) == 1:
        pull = N[:, 0] @ (tau + dyn.passive(q, v) - dyn.gravity(q))
        left = J[0, 0] * a[places[0]] + 0.5 * slopes[0, 0, 0] * rates[0] ** 2
        assert left == pytest.approx(pull, abs=1e-10 * (abs(pull) + abs(left) + abs(J[0, 0] * a[places[0]])))


def test_coordinates_that_are_not_independent_are_refused() -> None:
    model = mb.catalog.get("five_bar")()
    dyn = mb.dynamics(model)
    q, _ = model.random_state(0)
    for wrong in ("theta1", ["theta1", "theta1"], ["theta1", "theta2", "phi1"]):
        with pytest.raises(InputError, match="2 degrees of freedom: expected as many different names"):
            dyn.reduced_inertia(q, wrong)
    with pytest.raises(UnknownNameError):
        dyn.reduced_inertia(q, ["theta1", "elbow"])
    driven, at = closed_tree(1, "point", drive=True)
    with pytest.raises(UnsupportedError, match=r"'j0' is moved in time.*N θ̇ alone.*without\('prescribed'\)"):
        mb.dynamics(driven).reduced_inertia(at, driven.coordinate_names[0])


# What else acts


def test_forces_by_functions_enter_the_forces_of_actuators_and_have_no_load_on_single_bodies() -> None:
    rod = {"mass": 1.0, "com": (0.1, 0, -0.2), "inertia": (0.1, 0.12, 0.05), "axis": (0, 1, 0)}
    b = chain(rod | {"joint": "a"}, rod | {"joint": "b", "translation": (0, 0, -0.4)}, name="closer")
    b.add_joint_force("drag", "b", lambda t, q, v: -2.0 * v**3 - q)  # noqa: ARG005
    b.add_coupler("gear", "b", "a", ratio=0.5)
    model = b.build()
    q, v = model.random_state(0)
    tau = np.array([1.0, 0.0])
    for engine in ("oracle", *RIGID):
        dyn = dynamics(model, engine)
        a = dyn.forward_dynamics(q, v, tau)
        assert dyn.actuator_forces(q, v, a, ["a"]).tau == pytest.approx(tau, abs=1e-12)
        with pytest.raises(UnsupportedError, match="forces by functions are known by what they do"):
            dyn.joint_wrenches(q, v, None, tau=tau)
        assert not dyn.supports & {"joint_wrenches", "loop_wrenches", "newton_euler_residual"}
