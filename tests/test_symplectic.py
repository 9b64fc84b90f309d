# Torques have the signature they are called with.
# ruff: noqa: ARG005
"""The implicit midpoint rule in (q, p): order, symplecticity, what it keeps, and runs that go wrong."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit import catalog
from mbkit.derivation.steps.midpoint import Midpoint, _MomentumSpace
from mbkit.derivation.steps.rosenbrock import Factors
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import MbkitWarning
from mbkit.model import Model, quaternions
from mbkit.simulate import simulate
from mbkit.spatial import rotate
from tests.random_trees import random_tree
from tests.scenes import slider

EPS = np.finfo(float).eps
METHOD = "implicit_midpoint"
TREE = ("free", "ball", "revolute", "prismatic")


def engine(model: Model, *, compile: bool = False) -> LagrangianDynamics:  # noqa: A002  # the engine's own word
    return LagrangianDynamics(model, compile=compile)


def cases() -> dict[str, tuple[Model, np.ndarray, np.ndarray, float]]:
    rng = np.random.default_rng(5)
    tree = random_tree(11, n=4, kinds=TREE)
    top, box = catalog.heavy_top(), catalog.free_body()
    return {
        "double pendulum": (catalog.double_pendulum(), np.array([0.6, 0.3]), np.array([0.5, -0.5]), 1.0),
        "heavy top": (top, top.random_state(rng)[0], np.array([1.0, 20.0, -4.0]), 0.2),
        "Dzhanibekov box": (box, box.random_state(rng)[0], np.array([1.0, 2.0, 3.0, 0.1, 5.0, 0.1]), 1.0),
        # With springs, damping and armature; the torque pushes it too.
        "random tree": (tree, *tree.random_state(rng), 0.5),
    }


def torque_on(model: Model) -> np.ndarray:
    return np.linspace(-1.0, 1.0, model.nv) if model.name.startswith("tree") else np.zeros(model.nv)


@pytest.mark.thorough("Dzhanibekov box", "random tree")
@pytest.mark.parametrize("case", cases())
def test_observed_order_is_two(case: str) -> None:
    model, q, v, duration = cases()[case]
    tau = torque_on(model)
    truth = simulate(mb.dynamics(model), q, v, duration, "dop853", rtol=3e-14, save=[0.0, duration], torque=tau)
    dyn, steps, errors = engine(model), [], []
    for n in (100, 140, 200, 280):
        run = simulate(dyn, q, v, duration, METHOD, dt=duration / n, torque=tau)
        steps.append(duration / n)
        apart = [model.difference(truth.q[-1], run.q[-1]), run.v[-1] - truth.v[-1]]
        errors.append(float(np.linalg.norm(np.concatenate(apart))))
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.2)


# Symplecticity


def canonical_step(model: Model, q: np.ndarray, v: np.ndarray, h: float) -> np.ndarray:
    """Return ∂(u1, p1)/∂(u0, p0) of one step, exactly, in canonical coordinates of charts around q0 and q1.

    A rotation's chart is R exp(u), and dexp(u)ᵀ takes its body-axes momentum to the one
    that belongs to u; around u = 0 that is p + ½ u × p.
    """
    dyn = engine(model)
    midpoint, space, nv = Midpoint(dyn.equations), _MomentumSpace(model), model.nv
    momentum, system, end = (part.make() for part in (midpoint.momentum, midpoint.system, midpoint.end))
    u, p, w = (ca.SX.sym(name, nv) for name in ("u", "p", "w"))
    zero = ca.SX(nv, 1)

    def turned(a: ca.SX, b: ca.SX, function: object) -> ca.SX:
        out = ca.SX(b)
        for _, part in space._turns:
            space.put(out, part, function(space.components(a, part), space.components(b, part)))  # type: ignore[operator]
        return out

    m = space.arithmetic(u)
    q0 = space.toward(ca.DM(q), u)
    body = turned(u, p, lambda x, y: quaternions.dexp_inverse(m, [-c for c in x], y))
    residual, _ = system(q0, space.to_fixed(q0, body), w, zero, h)
    q1, pi1, *_ = end(q0, space.to_fixed(q0, body), w, w, w, zero, h, 0, 0)

    start = ca.DM(momentum(q, v))
    p0 = np.array(ca.Function("p0", [], [space.to_body(ca.SX(ca.DM(q)), ca.SX(start))])()["o0"]).ravel()
    run = simulate(dyn, q, v, h, METHOD, dt=h)
    w0 = root(ca.Function("r", [w, u, p], [residual]), v, p0, nv)
    there = run.q[-1]

    u1 = ca.SX(nv, 1)
    for a, b in space._sums:
        u1[b] = q1[a] - ca.DM(there[a])
    for a, b in space._turns:
        back = [-1.0, -1.0, -1.0, 1.0] * there[a]
        space.put(u1, b, [2 * x for x in quaternions.product(back.tolist(), space.components(q1, a))[:3]])
    p_body = space.to_body(q1, pi1)
    p1 = p_body + 0.5 * (turned(u1, p_body, quaternions.cross) - plain(space, p_body))
    z, z1 = ca.vertcat(u, p), ca.vertcat(u1, p1)
    at = [w0, np.zeros(nv), p0]
    by_z, by_w = (
        np.array(ca.Function("d", [w, u, p], [x])(*at)) for x in (ca.jacobian(residual, z), ca.jacobian(residual, w))
    )
    out, out_w = (np.array(ca.Function("d", [w, u, p], [x])(*at)) for x in (ca.jacobian(z1, z), ca.jacobian(z1, w)))
    return np.asarray(out - out_w @ np.linalg.solve(by_w, by_z))


def plain(space: _MomentumSpace, p: ca.SX) -> ca.SX:
    out = ca.SX(p)
    for _, part in space._turns:
        out[part] = 0
    return out


def root(residual: ca.Function, guess: np.ndarray, p0: np.ndarray, nv: int) -> np.ndarray:
    by_w = residual.jacobian()
    w = np.array(guess)
    for _ in range(20):
        r = np.array(residual(w, np.zeros(nv), p0)).ravel()
        w = w - np.linalg.solve(np.array(by_w(w, np.zeros(nv), p0, r)[0]), r)
    return w


@pytest.mark.thorough("random tree")
@pytest.mark.parametrize("case", cases())
def test_a_step_is_symplectic(case: str) -> None:
    """Jᵀ Ω J = Ω to rounding, on plain coordinates and on rotations; springs are in, damping is not symplectic."""
    model, q, v, _ = cases()[case]
    model = model.without("damping")
    J = canonical_step(model, q, v, 0.02)
    nv = model.nv
    omega = np.block([[np.zeros((nv, nv)), np.eye(nv)], [-np.eye(nv), np.zeros((nv, nv))]])
    # Each entry sums 2 nv products of entries of J, themselves solved for.
    bound = 2 * nv * 16 * EPS * np.linalg.norm(J, 2) ** 2
    assert np.abs(J.T @ omega @ J - omega).max() <= bound
    # The map is no trifle: it differs from the identity, and RK4's would fail.
    assert np.abs(J - np.eye(2 * nv)).max() > 1e-2


def test_elimination_solves_matrices_without_symmetry() -> None:
    rng = np.random.default_rng(0)
    A = rng.standard_normal((5, 5)) + 6 * np.eye(5)
    b = rng.standard_normal(5)
    for order in ((0, 1, 2, 3, 4), (3, 0, 4, 1, 2)):
        factors = Factors.of(ca.SX(A), order)
        x = np.array(ca.DM(ca.evalf(factors.applied(factors.values, ca.vertsplit(ca.SX(b)))))).ravel()
        assert x == pytest.approx(np.linalg.solve(A, b), abs=64 * EPS)


# What is kept


def test_momentum_about_the_vertical_of_a_heavy_top_is_kept_to_rounding() -> None:
    top = catalog.heavy_top()
    dyn = engine(top, compile=True)
    q, v = top.random_state(np.random.default_rng(1))[0], np.array([1.0, 20.0, -4.0])
    run = simulate(dyn, q, v, 10.0, METHOD, dt=1e-3, save=100)
    L = rotate(run.q, np.einsum("nij,nj->ni", dyn.mass_matrix(run.q), run.v))
    # Reading L off a kept state rounds by itself, some eps; 1e4 steps add nothing to that.
    assert np.abs(L[:, 2] - L[0, 2]).max() <= 32 * EPS * np.linalg.norm(L[0])
    assert np.abs(L[:, 0] - L[0, 0]).max() > 1e-3 * np.linalg.norm(L[0])


@pytest.mark.thorough("linear0")
@pytest.mark.parametrize("linear", [(0.0, 0.0, 0.0), (1.0, 2.0, 3.0)])
def test_momenta_of_a_free_box_are_kept_to_rounding(linear: tuple[float, ...]) -> None:
    box = catalog.free_body()
    dyn = engine(box, compile=True)
    q, v = box.neutral(), np.array([*linear, 0.1, 5.0, 0.1])
    n, h = 20_000, 1e-2
    run = simulate(dyn, q, v, n * h, METHOD, dt=h, save=100)
    p = np.einsum("nij,nj->ni", dyn.mass_matrix(run.q), run.v)
    p, L = rotate(run.q[:, 3:], p[:, :3]), rotate(run.q[:, 3:], p[:, 3:])
    assert np.abs(p - p[0]).max() <= 32 * EPS * max(np.linalg.norm(p[0]), EPS)
    # v × m v is zero, but not to the last bit: it may add up while the box flies.
    flown = n * h * EPS * 10.0 * float(np.dot(linear, linear))
    assert np.abs(L - L[0]).max() <= 32 * EPS * np.linalg.norm(L[0]) + flown


@pytest.mark.thorough("double pendulum", "Dzhanibekov box")
@pytest.mark.parametrize("case", ["double pendulum", "heavy top", "Dzhanibekov box"])
def test_energy_does_not_drift(case: str) -> None:
    model, q, v, duration = cases()[case]
    h = duration / 200
    run = simulate(engine(model, compile=True), q, v, 40_000 * h, METHOD, dt=h)
    energy = run.energy()
    error = np.abs(energy - energy[0])[1:].reshape(8, -1).max(axis=1)
    # The error swings with the motion, whose beats the windows cut here and there.
    assert error[-1] <= 1.2 * error[0]
    assert abs(np.polyfit(np.arange(8), error / error.max(), 1)[0]) < 0.02


def test_damping_takes_energy() -> None:
    b = slider("slider", mass=2.0, damping=0.5)
    run = simulate(engine(b.build()), [0.0], [1.0], 4.0, METHOD, dt=1e-2)
    # Linear: each step divides by the same number.
    ratio = (1 - 0.5e-2 / 4) / (1 + 0.5e-2 / 4)
    assert run.v[:, 0] == pytest.approx(ratio ** np.arange(401), rel=401 * EPS)


# One state, a batch, machine code, torques


@pytest.mark.thorough("random tree")
@pytest.mark.parametrize("case", cases())
def test_every_way_to_run_gives_the_same(case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, q, v, duration = cases()[case]
    h = duration / 100
    rows = np.random.default_rng(3).standard_normal((100, model.nv))
    one = simulate(engine(model, compile=True), q, v, duration, METHOD, dt=h, torque=rows)
    slow = simulate(engine(model), q, v, duration, METHOD, dt=h, torque=rows)
    numeric = engine(model)
    monkeypatch.setattr("mbkit.simulate.solvers.implicit_midpoint._written_out", lambda dyn: dyn is not numeric)
    solved = simulate(numeric, q, v, duration, METHOD, dt=h, torque=rows)
    asked = simulate(engine(model), q, v, duration, METHOD, dt=h, torque=lambda t, q, v: rows[int(t / h)])
    for run in (slow, solved, asked):
        assert run.stats.finished
        # Rounding of 100 steps; of momenta it is M⁻¹ times as much.
        assert np.abs(run.q - one.q).max() <= 1e-12
        assert np.abs(run.v - one.v).max() <= 1e-11 * max(np.abs(v).max(), 1.0)


def test_a_torque_function_acts_at_the_midpoint() -> None:
    model, q, v, duration = cases()["double pendulum"]
    dyn = engine(model)

    def torque(t: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([np.sin(5 * t), 0.0]) - 2.0 * v - 3.0 * q

    truth = simulate(mb.dynamics(model), q, v, duration, "dop853", rtol=3e-14, save=[0.0, duration], torque=torque)
    steps = np.array([1 / 50, 1 / 80, 1 / 120])
    runs = [simulate(dyn, q, v, duration, METHOD, dt=h, torque=torque) for h in steps]
    errors = [np.abs(run.q[-1] - truth.q[-1]).max() for run in runs]
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] == pytest.approx(2.0, abs=0.2)
    times: list[float] = []
    simulate(dyn, q, v, 0.1, METHOD, dt=0.1, torque=lambda t, q, v: times.append(t) or np.zeros(2))  # type: ignore[func-returns-value]
    assert set(times) == {0.05}


# What goes wrong


@pytest.mark.parametrize("compile", [True, False])
def test_a_step_that_is_too_long_is_told_and_what_was_good_is_kept(compile: bool) -> None:  # noqa: A002
    model = catalog.double_pendulum()
    dyn = engine(model, compile=compile)
    with pytest.warns(MbkitWarning, match=r"diverged after t = .* s \(step .*Newton.*may be too long"):
        run = simulate(dyn, [2.0, 1.0], [8.0, -9.0], 300.0, METHOD, dt=1.5)
    assert run.stats.ended == "diverged"
    assert np.isfinite(run.q).all()
    assert run.t[-1] == run.stats.reached < 300.0
    # In a batch the others go on, and are what they are alone.
    q, v = np.array([[2.0, 1.0], [0.01, 0.0], [0.02, 0.0]]), np.array([[8.0, -9.0], [0.0, 0.0], [0.0, 0.0]])
    with pytest.warns(MbkitWarning, match="1 of 3 trajectories diverged"):
        batch = simulate(dyn, q, v, 150.0, METHOD, dt=1.5)
    assert np.isnan(batch.q[0, -1]).all()
    assert np.isfinite(batch.q[1:]).all()
    alone = simulate(dyn, q[1], v[1], 150.0, METHOD, dt=1.5)
    assert batch.q[1] == pytest.approx(alone.q, abs=1e-13)


@pytest.mark.parametrize("compile", [True, False])
def test_a_state_that_grows_beyond_all_bounds_is_told(compile: bool) -> None:  # noqa: A002
    b = slider("pushed away")
    with pytest.warns(MbkitWarning, match="beyond all bounds"):
        run = simulate(engine(b.build(), compile=compile), [0.0], [1.0], 10.0, METHOD, dt=0.5, torque=[1e99])
    # Half of 1e99 N for 4.5 s on 1 kg is beyond 1e100 m.
    assert run.stats.reached == 4.0


@pytest.mark.thorough("random tree")
@pytest.mark.parametrize("case", cases())
def test_time_can_be_turned_back(case: str) -> None:
    model, q, v, duration = cases()[case]
    model = model.without("damping")
    dyn, h = engine(model), duration / 100
    there = simulate(dyn, q, v, duration, METHOD, dt=h, torque=torque_on(model))
    back = simulate(dyn, there.q[-1], -there.v[-1], duration, METHOD, dt=h, torque=torque_on(model))
    # 200 steps' rounding, which the motion spreads like any other difference.
    assert np.abs(model.difference(q, back.q[-1])).max() <= 1e-12
    assert np.abs(back.v[-1] + v).max() <= 1e-11 * max(np.abs(v).max(), 1.0)
