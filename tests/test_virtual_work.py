"""Virtual work: generalized forces, particles, and systems at rest."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp
from sympy.physics.mechanics import dynamicsymbols

import mbkit as mb
from mbkit.errors import InputError, NumericalError, UnknownNameError
from mbkit.lagrangian import Lagrangian
from mbkit.lagrangian.statics.equilibrium import equilibrium
from mbkit.lagrangian.statics.virtual_work import from_particles, generalized_force
from mbkit.methods.small_motions import small_motion

th, w, r, vr, x, y, vx, vy = sp.symbols("theta omega r v_r x y vx vy")
m, ell, g, k, c, t, Om, R, a, F = sp.symbols("m l g k c t Omega R a F")
OWN = {"compile": False}


# Forces and particles


def test_force_on_the_piston_of_a_slider_crank():
    L1, L2, tau = sp.symbols("L1 L2 tau")
    phi = sp.asin(L1 / L2 * sp.sin(th))
    slider = L1 * sp.cos(th) + L2 * sp.cos(phi)
    Q = generalized_force([-F], [slider], [th], torques=[[tau]], angular_velocities=[[w]], velocities=[w])
    expected = tau + F * L1 * sp.sin(th + phi) / sp.cos(phi)
    at = {th: 0.7, L1: 0.1, L2: 0.3, F: 40.0, tau: 0.4}
    assert float(Q[th].subs(at)) == pytest.approx(float(expected.subs(at)), rel=1e-14)


def test_generalized_force_is_power_over_velocity():
    q1, q2, u1, u2 = sp.symbols("q1 q2 u1 u2")
    points = [[sp.cos(q1), sp.sin(q1), q2 * sp.sin(t)], [q1 * q2, sp.exp(q2), 0]]
    forces = [[x, 2, u1], [t, q1, 5]]
    Q = generalized_force(forces, points, [q1, q2], velocities=[u1, u2], time=t)
    power = sum(
        f * (sp.diff(p, q1) * u1 + sp.diff(p, q2) * u2)
        for row, place in zip(forces, points, strict=True)
        for f, p in zip(row, place, strict=True)
    )
    assert sp.simplify(power - Q[q1] * u1 - Q[q2] * u2) == 0


def test_dynamicsymbols_keep_their_names():
    q = dynamicsymbols("q")
    Q = generalized_force([[0, -m * g]], [[ell * sp.sin(q), -ell * sp.cos(q)]], [q])
    assert list(Q) == [q]
    assert str(Q[q]) == "-g*l*m*sin(q)"
    turned = generalized_force([], [], [q], torques=[[F]], angular_velocities=[[3 * q.diff()]])
    assert turned == {q: 3 * F}


def test_particles_are_the_textbook_pendulum_and_its_driven_pivot():
    place = [ell * sp.sin(th), a * sp.cos(Om * t) - ell * sp.cos(th)]
    lag = from_particles([m], [place], [th], gravity=[0, -g], time=t, parameters=[m, ell, g, a, Om])
    _, T1, T0 = lag.kinetic_split()
    assert sp.simplify(T0 - m * (a * Om * sp.sin(Om * t)) ** 2 / 2) == 0
    assert T1 != 0
    (equation,) = lag.equations().equations()
    expected = m * ell**2 * lag.accelerations[0] + m * ell * (g - a * Om**2 * sp.cos(Om * t)) * sp.sin(th)
    assert sp.simplify(equation.lhs - equation.rhs - expected) == 0


def test_particles_with_forces_obey_newton():
    # In Cartesian coordinates d'Alembert's equations are Newton's.
    lag = from_particles(
        [m, 3],
        [[x, y], [2 * x, 0]],
        [x, y],
        [vx, vy],
        gravity=[0, -g],
        potential=k * x**2 / 2,
        forces=[[F, -c * vy], None],
        parameters={m: 2.0, g: 9.81, k: 5.0, F: 7.0, c: 0.5},
    )
    acceleration = lag.dynamics(options=OWN).forward_dynamics([0.3, 0.1], [1.0, 2.0], [0, 0])
    assert np.allclose(acceleration, [(7.0 - 5.0 * 0.3) / (2 + 12), -9.81 - 0.5], rtol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: from_particles([m, m], [[x, y]], [x, y]), "masses: 2 of them for 1"),
        (lambda: from_particles([m], [[x, y]], [x, y], gravity=[0, 0, g]), "gravity: 3 components"),
        (lambda: from_particles([m], [[x, y]], [x, y], forces=[]), None),
        (lambda: from_particles([m], [[x, y]], [x, y], forces=[[1, 2], None], parameters=[m]), "forces: 2 of them"),
        (lambda: generalized_force([[1, 2]], [[x, y, 0]], [x, y]), r"forces\[0\]: 2 components"),
        (lambda: generalized_force([[1] * 4], [[x] * 4], [x]), r"forces\[0\]: expected a vector"),
        (lambda: generalized_force(3, [[x]], [x]), "forces: expected a list"),
        (lambda: generalized_force([["("]], [[x]], [x]), r"forces\[0\]: expected a SymPy"),
    ],
)
def test_bad_particles_and_forces(make, message):
    with pytest.raises(InputError, match=message):
        make()


# Rest


@pytest.mark.thorough("mujoco", "oracle")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco", "oracle"])
def test_pendulum_hangs_stably_and_stands_unstably(engine):
    dyn = mb.dynamics(mb.catalog.pendulum(), engine)
    hanging, upright = equilibrium(dyn, [0.3]), equilibrium(dyn, [3.0])
    assert hanging.stable is True
    assert upright.stable is False
    assert abs(hanging.q[0]) < 1e-14
    assert upright.q[0] == pytest.approx(np.pi, abs=1e-14)
    # Differences of fourth order, of a sine.
    assert hanging.frequencies[0] == pytest.approx(np.sqrt(9.81), rel=1e-11)
    assert not len(upright.frequencies)
    assert np.sort(upright.eigenvalues.real) == pytest.approx([-np.sqrt(9.81), np.sqrt(9.81)], rel=1e-11)
    tilted = equilibrium(dyn, tau=[1.0])
    assert np.sin(tilted.q[0]) == pytest.approx(1 / 9.81, rel=1e-12)
    with pytest.raises(NumericalError, match=r"no equilibrium found from 31 starts; .*90\.2.*theta"):
        equilibrium(dyn, tau=[100.0])


@pytest.mark.parametrize("robot", ["ur5", "panda"])
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
def test_holding_torque_of_a_robot_with_a_payload(robot, engine):
    model = mb.load(robot)
    dyn = mb.dynamics(model, engine, **(OWN if engine == "lagrangian" else {}))
    q, _ = model.random_state(np.random.default_rng(3))
    hand, weight = model.frames[-1].name, np.array([0, 0, -9.81 * 3.0])
    held = equilibrium(dyn, holding=q, forces={hand: weight})
    expected = dyn.gravity(q) - dyn.passive(q, np.zeros(model.nv)) - dyn.jacobian(q, hand)[:3].T @ weight
    assert np.abs(held.tau - expected).max() < 1e-13 * np.abs(expected).max()
    # By virtual work: the torque is what the potential of the robot and of its load changes by.
    h = 1e-5

    def potential(q):
        return dyn.potential_energy(q) - weight @ dyn.pose(q, hand)[:3, 3]

    work = [
        (potential(model.integrate(q, h * e)) - potential(model.integrate(q, -h * e))) / (2 * h)
        for e in np.eye(model.nv)
    ]
    assert np.abs(held.tau - work).max() < 1e-7
    assert held.residual < 1e-12


def test_rest_under_constraints():
    rod = Lagrangian(
        m * (vx**2 + vy**2) / 2,
        m * g * y,
        [x, y],
        [vx, vy],
        parameters={m: 2.0, ell: 1.5, g: 9.81},
        constraints=[(x**2 + y**2 - ell**2) / 2],
    )
    hanging, upright = equilibrium(rod, [0.3, -1.0]), equilibrium(rod, [0.3, 1.0])
    assert hanging.q == pytest.approx([0, -1.5], abs=1e-12)
    assert hanging.multipliers[0] * 1.5 == pytest.approx(-2.0 * 9.81, rel=1e-12)
    assert hanging.stable is True
    assert hanging.frequencies == pytest.approx([np.sqrt(9.81 / 1.5)], rel=1e-12)
    assert upright.q == pytest.approx([0, 1.5], abs=1e-12)
    assert upright.stable is False
    level = equilibrium(rod, holding=[1.5, 0.0])
    assert level.tau == pytest.approx([0.0, 2.0 * 9.81], abs=1e-13)
    assert equilibrium(rod).residual < 1e-10
    with pytest.raises(InputError, match="constraints"):
        equilibrium(rod, holding=[1.0, 0.0])


def test_stability_of_what_is_not_conservative():
    plane = Lagrangian(
        m * (vx**2 + vy**2) / 2,
        k * (x**2 + y**2) / 2,
        [x, y],
        [vx, vy],
        forces={x: a * y, y: -a * x},
        dissipation=c * (vx**2 + vy**2) / 2,
        parameters={m: 1.0, k: 1.0, a: None, c: 0.1},
    )
    # A circulatory force beats damping above c √(k/m).
    assert equilibrium(plane.dynamics(options=OWN, a=0.09), [0, 0]).stable is True
    assert equilibrium(plane.dynamics(options=OWN, a=0.11), [0, 0]).stable is False
    spinning = Lagrangian(
        m * (vx**2 + vy**2) / 2 + a * (x * vy - y * vx) / 2,
        -k * (x**2 + y**2) / 2,
        [x, y],
        [vx, vy],
        parameters={m: 1.0, k: 1.0, a: None},
    )
    # Gyroscopic forces above 2 √(k m) hold a maximum of V, which the linear equation cannot warrant.
    assert equilibrium(spinning.dynamics(options=OWN, a=3.0), [0, 0]).stable is None
    assert equilibrium(spinning.dynamics(options=OWN, a=1.0), [0, 0]).stable is False
    assert small_motion(np.zeros((0, 0)), np.zeros((0, 0)), np.zeros((0, 0))).stable is None


def test_free_directions_are_not_decided():
    rest = equilibrium(mb.dynamics(mb.catalog.cart_pole(), "lagrangian", compile=False))
    assert rest.stable is None
    assert len(rest.frequencies) == 1


def test_places_and_turns_are_those_of_the_coordinates():
    place = [ell * sp.sin(th), -ell * sp.cos(th)]
    force = generalized_force([[0, -m * g]], [place], [sp.Symbol(th.name, real=True)])
    assert list(force.values()) == [-m * g * ell * sp.sin(sp.Symbol(th.name, real=True))]
    with pytest.raises(InputError, match=r"points\[0\].*got the velocity xdot"):
        generalized_force([[1]], [[x + sp.Symbol("xdot")]], [x])
    with pytest.raises(InputError, match=r"positions\[0\].*got the velocity xdot"):
        from_particles([m], [[x + sp.Symbol("xdot")]], [x], parameters=[m])
    # A rate that nobody declared would do no work.
    with pytest.raises(InputError, match=r"angular_velocities\[0\].*holds none of the velocities xdot"):
        generalized_force([], [], [x], torques=[[k]], angular_velocities=[[sp.Symbol("omega")]])


def test_rest_that_the_time_does_not_move():
    """A pendulum on a driven pivot rests, and only its whole period says whether it is stable."""
    rest = equilibrium(mb.lagrangian.systems.driven_pendulum(), [0.3])
    assert rest.q == pytest.approx(0.0, abs=1e-12)
    assert rest.stable is None
    assert not len(rest.frequencies)


def test_bad_rest():
    dyn = mb.dynamics(mb.catalog.pendulum(), "pinocchio")
    for how, kind, message in (
        ({"tau": [1, 2]}, InputError, "tau: expected shape"),
        ({"q0": [np.nan]}, InputError, "q0"),
        ({"holding": [0.0], "tau": [0.0]}, InputError, "holding: expected without"),
        ({"forces": {"nowhere": [0, 0, 1]}}, UnknownNameError, "nowhere"),
        ({"forces": {"bob": [0, 1]}}, InputError, r"forces\['bob'\]: expected shape \(3,\)"),
    ):
        with pytest.raises(kind, match=message):
            equilibrium(dyn, **how)
    with pytest.raises(InputError, match="expected a Dynamics or a Lagrangian"):
        equilibrium(mb.catalog.pendulum())
    driven = Lagrangian(vx**2 / 2, k * (x - sp.sin(t)) ** 2, [x], [vx], time=t, parameters={k: 1.0})
    with pytest.raises(InputError, match="depends on the time t"):
        equilibrium(driven)
    falling = Lagrangian(m * vy**2 / 2, m * g * y, [y], [vy], parameters={m: 1.0, g: 9.81})
    with pytest.raises(NumericalError, match=r"no equilibrium found.*9\.81.*along"):
        equilibrium(falling, [0.0])


@pytest.fixture(scope="module")
def arm():
    """Two links on springs, with a load in the hand."""
    q1, q2, u1, u2, l1, l2, m1, m2, load = sp.symbols("q1 q2 u1 u2 l1 l2 m1 m2 load")
    elbow = [l1 * sp.cos(q1), l1 * sp.sin(q1)]
    hand = [elbow[0] + l2 * sp.cos(q1 + q2), elbow[1] + l2 * sp.sin(q1 + q2)]
    return from_particles(
        [m1, m2],
        [elbow, hand],
        [q1, q2],
        [u1, u2],
        gravity=[0, -g],
        potential=20 * (q1**2 + q2**2) / 2,
        forces=[None, [0, -load]],
        parameters={l1: 0.5, l2: 0.4, m1: 1.0, m2: 0.5, g: 9.81, load: 5.0},
        name="arm",
    )


def test_loaded_arm_on_springs(arm):
    rest = equilibrium(arm, [0.0, 0.0])
    q1, q2 = rest.q
    down = 0.5 * 9.81 + 5.0
    at_elbow = down * 0.4 * np.cos(q1 + q2)
    assert -20 * q2 == pytest.approx(at_elbow, rel=1e-12)
    assert -20 * q1 == pytest.approx(at_elbow + (9.81 + down) * 0.5 * np.cos(q1), rel=1e-12)
    assert rest.stable is True
    assert rest.residual < 1e-12
    held = equilibrium(arm, holding=[0.3, -0.2])
    assert np.allclose(equilibrium(arm, [0.2, 0.0], tau=held.tau).q, [0.3, -0.2], rtol=0, atol=1e-11)


def test_frequencies_are_those_of_small_motions(arm):
    dyn, rest = arm.dynamics(options=OWN), equilibrium(arm, [0.0, 0.0])
    told = dyn.forward_dynamics_derivatives(rest.q, [0, 0], [0, 0]).q
    assert np.allclose(rest.frequencies, np.sqrt(np.sort(np.linalg.eigvals(-told))), rtol=1e-12)


def test_bead_on_the_hoop_leaves_the_bottom_above_the_threshold():
    bead = Lagrangian(
        m * R**2 * (w**2 + Om**2 * sp.sin(th) ** 2) / 2,
        -m * g * R * sp.cos(th),
        [th],
        [w],
        parameters={m: 1.0, R: 0.7, g: 9.81, Om: None},
    )
    threshold = np.sqrt(9.81 / 0.7)
    for rate in (0.5 * threshold, 0.99 * threshold):
        bottom = equilibrium(bead.dynamics(options=OWN, Omega=rate), [0.0])
        assert bottom.stable is True
        assert bottom.frequencies[0] == pytest.approx(np.sqrt(threshold**2 - rate**2), rel=1e-12)
    for rate in (1.01 * threshold, 2.0 * threshold):
        dyn = bead.dynamics(options=OWN, Omega=rate)
        assert equilibrium(dyn, [0.0]).stable is False
        side = equilibrium(dyn, [1.3])
        assert np.cos(side.q[0]) == pytest.approx((threshold / rate) ** 2, rel=1e-12)
        assert side.stable is True
        assert side.frequencies[0] == pytest.approx(rate * np.sin(side.q[0]), rel=1e-11)
    assert equilibrium(bead.dynamics(options=OWN, Omega=threshold), holding=[0.0]).stable is None
