"""Systems on paper: the same as the catalog's in every engine, and as closed forms written here."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

import mbkit as mb
from mbkit.lagrangian import systems
from tests.twins import CRANK, PISTON, TWINS, paper
from validation import textbook

# A few dozen rounded operations.
CLOSE = 1e-14
INTERPRETED = {"compile": False}


def run(name, **values):
    return systems.get(name)(**values).dynamics(options=INTERPRETED)


def off(x, y, scale=0.0):
    """Return how far x is from y, by the size of y or of what y is a sum of."""
    return float(np.linalg.norm(np.asarray(x) - y) / max(np.linalg.norm(y), scale, 1e-300))


@pytest.mark.thorough(every=10)
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco"])
@pytest.mark.parametrize("name", [name for name in TWINS if not name.startswith("weightless")])
def test_paper_is_the_model_in_every_engine(name, engine):
    """With q' of q and t, v' = S v + s: M = SᵀM'S, and forces are Sᵀ(M'(v̇' - S v̇) + h')."""
    twin, lag = TWINS[name], paper(name)
    dyn, ref = lag.dynamics(options=INTERPRETED), mb.dynamics(twin.model(), engine)
    n, rng, lift = len(lag.coordinates), np.random.default_rng(5), []
    for _ in range(3):
        q, v, t = rng.uniform(0.2, 1.2, n), rng.standard_normal(n), 0.37 if lag.time else 0.0
        own = dyn.at(t=t) if lag.time else dyn
        there, S = twin.place(q, t), twin.turn(q, t)[0]
        M = ref.mass_matrix(there)
        size = np.linalg.norm(M)
        assert off(own.mass_matrix(q), S.T @ M @ S) <= CLOSE
        weight = np.linalg.norm(ref.gravity(there)) + np.linalg.norm(ref.passive(there, 0.0 * S[:, 0]))
        for rate in (0 * v, v):
            fast = twin.velocity(q, rate, t)
            acting = twin.force(ref, t, there, fast) if twin.force else np.zeros(ref.model.nv)
            bias = twin.bias(q, rate, t)
            h = ref.nle(there, fast) - ref.passive(there, fast) - acting
            scale = weight + np.linalg.norm(acting) + size * (np.linalg.norm(fast) ** 2 + np.linalg.norm(bias))
            assert off(own.nle(q, rate) - own.passive(q, rate), S.T @ (M @ bias + h), scale) <= CLOSE
        assert off(own.kinetic_energy(q, v), ref.kinetic_energy(there, fast), size * (fast @ fast)) <= CLOSE
        # A force of the model's may be of the paper's V, and what is carried along has a force of its own in T0.
        if not twin.force:
            lift.append(own.potential_energy(q) - ref.potential_energy(there))
            pull = ref.gravity(there) - ref.passive(there, 0.0 * S[:, 0])
            assert off(own.gravity(q), S.T @ pull, weight) <= CLOSE
            assert abs(lift[-1] - lift[0]) <= CLOSE * max(np.abs(ref.potential_energy(there)), weight)
        if not twin.drive:
            a = ref.forward_dynamics(there, fast, acting)
            scale = np.linalg.norm(a) + scale / size
            assert off(S @ own.forward_dynamics(q, v, 0 * v) + bias, a, scale) <= CLOSE * np.linalg.cond(M)


def test_bead_rests_where_the_hoop_turns_fast():
    form = textbook.BeadOnHoop(radius=0.5, spin=6.0)
    lag = systems.bead_on_hoop(radius=0.5, speed=6.0)
    dyn = lag.dynamics(options=INTERPRETED)
    for rest, _ in form.equilibria():
        assert dyn.forward_dynamics([rest], [0.0], [0.0]) == pytest.approx([0.0], abs=1e-14)
    th = np.array([[0.3], [2.0]])
    assert dyn.forward_dynamics(th, th, 0 * th) == pytest.approx(form.acceleration(th), rel=1e-14)
    split = [float(x.subs({**lag.parameters, "theta": 0.3, "thetadot": 1.2})) for x in lag.kinetic_split()]
    assert split == pytest.approx(form.kinetic_split(0.3, 1.2), rel=1e-14)


def test_driven_pendulum_has_its_closed_form():
    form = textbook.Kapitza(0.7, 0.05, 20.0)
    lag = systems.driven_pendulum(length=0.7, amplitude=0.05, frequency=20.0)
    th, t = np.array([[0.4], [2.5]]), 0.123
    a = lag.dynamics(options=INTERPRETED).at(t=t).forward_dynamics(th, 3 * th, 0 * th)
    assert a == pytest.approx(form.acceleration(t, th), rel=1e-13)
    put = {**lag.parameters, "theta": 0.4, "thetadot": 1.2, "t": t}
    split = [float(x.subs(put)) for x in lag.kinetic_split()]
    assert split == pytest.approx(form.kinetic_split(t, 0.4, 1.2), rel=1e-14)


def test_slider_crank_is_the_classic_text_s():
    tau, push = 0.7, 30.0
    dyn = run("slider_crank", mass=PISTON.mass, crank=PISTON.crank, rod=PISTON.rod, torque=tau, force=push)
    th, w = np.array([0.3, 1.4, 2.6, 4.0]), np.array([2.0, -1.0, 5.0, 0.3])
    assert dyn.mass_matrix(th[:, None])[:, 0, 0] == pytest.approx(PISTON.inertia(th), rel=1e-14)
    # Towards the shaft, as a gas pushes.
    Q = PISTON.force(th, tau, -push)
    assert dyn.passive(th[:, None], w[:, None])[:, 0] == pytest.approx(Q, rel=1e-14)
    h = dyn.nle(th[:, None], w[:, None])[:, 0]
    assert h == pytest.approx(PISTON.inertia_slope(th) * w**2 / 2, rel=1e-13)
    a = dyn.forward_dynamics(th[:, None], w[:, None], np.zeros((4, 1)))[:, 0]
    assert a == pytest.approx(PISTON.angular(th, w, tau, -push), rel=1e-13)


def test_dead_centres_have_no_inertia():
    dyn = run("slider_crank")
    assert dyn.mass_matrix([0.0])[0, 0] == 0.0
    assert systems.rigid_slider_crank().dynamics(options=INTERPRETED).mass_matrix([0.0])[0, 0] > 0


def test_rigid_slider_crank_has_the_published_inertia():
    dyn = run("rigid_slider_crank")
    assert dyn.mass_matrix([0.0])[0, 0] == pytest.approx(0.0013333333333333337, rel=1e-14)
    assert dyn.mass_matrix([np.pi / 2])[0, 0] == pytest.approx(0.006666666666666668, rel=1e-14)
    th = np.linspace(-3.0, 3.0, 13)
    assert dyn.mass_matrix(th[:, None])[:, 0, 0] == pytest.approx(CRANK.inertia(th), rel=1e-14)
    h = dyn.nle(th[:, None], 2.0 + 0 * th[:, None])[:, 0]
    assert h == pytest.approx(2.0 * CRANK.inertia_slope(th), rel=1e-13, abs=1e-17)


def test_one_degree_takes_functions_and_expressions():
    k = sp.Symbol("k")
    lag = systems.one_degree(lambda q: 1 + q**2, lambda q: k * q**2 / 2, lambda _, w: -w / 2, parameters={k: 4.0})
    dyn = lag.dynamics(options=INTERPRETED)
    q, w = 0.3, 1.2
    assert dyn.forward_dynamics([q], [w], [0.1])[0] == pytest.approx(
        (0.1 - w / 2 - q * w**2 - 4 * q) / (1 + q**2), rel=1e-14
    )
    x = sp.Symbol("x")
    squared = systems.one_degree(2, x**2, coordinate=x)
    assert squared.V - x**2 == 0


def test_friction_and_drag():
    block = run("sliding_block", slope=0.5, friction=0.2)
    down = 9.81 * (np.sin(0.5) - 0.2 * np.cos(0.5))
    assert block.forward_dynamics([0.0], [1.0], [0.0]) == pytest.approx([down], rel=1e-13)
    body = run("falling_body", mass=2.0, drag=0.5)
    limit = np.sqrt(2.0 * 9.81 / 0.5)
    assert body.forward_dynamics([0.0], [-limit], [0.0]) == pytest.approx([0.0], abs=1e-14)
    assert body.forward_dynamics([0.0], [1.0], [0.0]) == pytest.approx([-9.81 - 0.25], rel=1e-14)


@pytest.mark.thorough("acrobot", "rigid_slider_crank", "heavy_top", "rigid_body")
@pytest.mark.parametrize("name", systems.names())
def test_every_system_reads_and_says_where_it_is_from(name):
    function = systems.get(name)
    lag = function()
    assert lag.name == name
    assert "References" in function.__doc__
    assert all(f"``{q}``" in function.__doc__ for q in lag.coordinates)
    eq = lag.equations()
    assert str(eq)
    # M and the Christoffel matrix belong together: Ṁ - 2C is skew.
    rate = sum(
        (eq.mass_matrix.diff(q) * w for q, w in zip(lag.coordinates, lag.velocities, strict=True)),
        sp.zeros(*eq.mass_matrix.shape),
    )
    S = rate - 2 * eq.coriolis_matrix
    at = dict(zip((*lag.coordinates, *lag.velocities), (0.4, 0.7, 1.1, 0.3, -0.9, 0.5), strict=False))
    at |= {s: x or 0.3 for s, x in lag.parameters.items()} | ({lag.time: 0.1} if lag.time else {})
    defect = np.array((S + S.T).subs(at).evalf(), dtype=float)
    assert np.abs(defect).max() < 1e-13 * max(1.0, np.abs(np.array(rate.subs(at).evalf(), dtype=float)).max())
