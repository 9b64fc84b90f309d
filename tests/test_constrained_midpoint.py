"""The midpoint rule in (q, p) under constraints: order, symmetry, symplectic form, energy, and every way to run it."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from scipy.linalg import null_space

import mbkit as mb
from mbkit.derivation.steps.midpoint import ConstrainedMidpoint
from tests.test_loop_dynamics import closed_tree

EPS = float(np.finfo(float).eps)
METHOD = "implicit_midpoint"


def moving(model: mb.Model, compiled: bool = False, q: np.ndarray | None = None, seed: int = 3) -> tuple:
    """Return dynamics and a consistent state, not at rest."""
    dyn = mb.dynamics(model.without("damping"), "lagrangian", compile=compiled)
    rng = np.random.default_rng(seed)
    if q is None:
        q, v = model.random_state(rng, None)
    else:
        v = rng.standard_normal(model.nv)
    return dyn, *dyn.project(q, 0.3 * v)


def light_coupler() -> mb.Model:
    """Return a four-bar whose coupler has no mass, so that the tree's mass matrix has no inverse."""
    b = mb.ModelBuilder("light_coupler", gravity=(0, 0, -9.81))
    for name, parent, at, mass in (
        ("crank", "world", 0.0, 1.0),
        ("coupler", "crank", 0.3, 0.0),
        ("rocker", "world", 1.0, 2.0),
    ):
        b.add_body(name, mass=mass, com=(0.2, 0, 0) if mass else (0, 0, 0), inertia=(mass / 100,) * 3)
        b.add_joint(f"at_{name}", "revolute", parent=parent, child=name, translation=(at, 0, 0), axis=(0, -1, 0))
    b.add_loop("pin", "point", body_a="coupler", translation_a=(0.9, 0, 0), body_b="rocker", translation_b=(0.7, 0, 0))
    return b.build()


def cases() -> dict:
    """Return mechanisms in the plane and in space, with turning bodies, redundant rows, a drive, links without mass."""
    return {
        "four-bar": (mb.catalog.four_bar(), None),
        "slider-crank": (mb.catalog.slider_crank(), None),
        "Bricard": (mb.catalog.bricard(), None),
        "no mass": (light_coupler(), None),
        "tree of many joints": closed_tree(0, "point"),
        "driven": closed_tree(1, "point", drive=True),
        "ball and free joints": closed_tree(2, "universal"),
    }


@pytest.mark.thorough("Bricard", "no mass", "tree of many joints", "driven", "ball and free joints")
@pytest.mark.parametrize("case", cases())
def test_order_is_two_and_time_can_be_turned_back(case: str) -> None:
    model, q = cases()[case]
    dyn, q, v = moving(model, q=q)
    duration = 0.1
    # Of order 4, with steps a tenth as long: an error below 1e-4 of the midpoint rule's.
    exact = mb.simulate(dyn, q, v, duration, "rk4", dt=duration / 400, save=[duration])
    errors = []
    for n in (20, 40):
        run = mb.simulate(dyn, q, v, duration, METHOD, dt=duration / n)
        errors.append(np.abs(model.difference(run.q[-1], exact.q[-1])).max())
        at = dyn.at(t=duration) if model.time_parameter else dyn
        assert np.abs(at.constraint_residual(run.q[-1])).max() < 1e-14 * max(1.0, np.abs(run.q).max())
    assert 3.7 < errors[0] / errors[1] < 4.3
    if model.time_parameter is None:
        back = mb.simulate(dyn, run.q[-1], -run.v[-1], duration, METHOD, dt=duration / 40)
        assert np.abs(model.difference(q, back.q[-1])).max() < 1e-12
        assert np.abs(back.v[-1] + v).max() < 1e-11 * max(1.0, np.abs(v).max())


def constrained_step(dyn: mb.Dynamics, q: np.ndarray, v: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivative of a step by (q, p), and the tangent of the constrained phase space before it."""
    parts, nv = ConstrainedMidpoint(dyn.equations), dyn.model.nv
    system, end, momentum = (part.make() for part in (parts.system, parts.end, parts.momentum))
    p = np.array(momentum(q, v))[:, 0]
    w, zero = np.concatenate([v, np.zeros(parts.unknowns - nv)]), np.zeros(nv)
    for _ in range(30):
        residual, by_w = (np.array(x) for x in system(q, p, w, zero, h))
        w = w - np.linalg.solve(by_w, residual[:, 0])
    Q, P, W = (ca.SX.sym(n, len(x)) for n, x in (("q", q), ("p", p), ("w", w)))
    z = ca.vertcat(Q, P)
    equations = system(Q, P, W, zero, h)[0]
    arrived = ca.vertcat(*end(Q, P, W, W, W, zero, h, 0, 0)[:2])
    c, eq = dyn.equations.constraints, dyn.equations
    rows = ca.Function("rows", [eq.q, eq.v], [c.value, c.rate])
    M = ca.Function("M", [eq.q], [eq.mass_matrix])
    held = ca.vertcat(*rows(Q, ca.solve(ca.densify(M(Q)), P)))
    out = [ca.jacobian(x, y) for x, y in ((equations, z), (equations, W), (arrived, z), (arrived, W), (held, z))]
    by_z, by_w, out_z, out_w, tangent = (np.array(x) for x in ca.Function("d", [Q, P, W], out)(q, p, w))
    return out_z - out_w @ np.linalg.solve(by_w, by_z), null_space(tangent)


@pytest.mark.thorough("four-bar", "Bricard")
@pytest.mark.parametrize("case", ["four-bar", "slider-crank", "Bricard"])
def test_a_step_keeps_the_symplectic_form_of_the_constrained_phase_space(case: str) -> None:
    """(D T)ᵀ Ω (D T) = Tᵀ Ω T with D the exact derivative of the step and T a basis of the tangent space."""
    model, _ = cases()[case]
    dyn, q, v = moving(model)
    n = model.nv
    D, T = constrained_step(dyn, q, v, 0.02)
    assert T.shape == (2 * n, 2 * (n - len(dyn.equations.constraints.names)))
    omega = np.block([[np.zeros((n, n)), np.eye(n)], [-np.eye(n), np.zeros((n, n))]])
    before, after = T.T @ omega @ T, (D @ T).T @ omega @ (D @ T)
    assert np.abs(after - before).max() < 2 * n * 64 * EPS * np.linalg.norm(D @ T, 2) ** 2
    assert np.abs(before).max() > 1e-2
    # The step is no identity.
    assert np.abs(D @ T - T).max() > 1e-3


@pytest.mark.thorough("slider_crank")
@pytest.mark.parametrize("name", ["four_bar", "slider_crank"])
def test_energy_does_not_drift(name: str) -> None:
    model = mb.catalog.get(name)()
    dyn, q, v = moving(model, compiled=True)
    run = mb.simulate(dyn, q, v, 400.0, METHOD, dt=1e-2)
    energy = run.energy()
    error = np.abs(energy - energy[0])[1:].reshape(8, -1).max(axis=1)
    assert error[-1] <= 1.3 * error[0]
    assert abs(np.polyfit(np.arange(8), error / error.max(), 1)[0]) < 0.02
    assert np.abs(dyn.constraint_residual(run.q)).max() < 1e-14 + 2 * EPS * np.abs(run.q).max()


def test_every_way_to_run_gives_the_same() -> None:
    model = mb.catalog.four_bar()
    dyn, q, v = moving(model, compiled=True)
    slow = mb.dynamics(model, "lagrangian", compile=False)
    rows = np.random.default_rng(1).standard_normal((50, model.nv))
    options = {"method": METHOD, "dt": 0.01}
    one = mb.simulate(dyn, q, v, 0.5, torque=rows, **options)
    for other in (
        mb.simulate(slow, q, v, 0.5, torque=rows, **options),
        mb.simulate(slow, q, v, 0.5, torque=lambda t, _q, _v: rows[int(t / 0.01)], **options),
    ):
        assert np.abs(other.q - one.q).max() < 1e-12
        assert np.abs(other.v - one.v).max() < 1e-11 * np.abs(one.v).max()
    batch = mb.simulate(dyn, np.tile(q, (11, 1)), np.linspace(0.5, 1.0, 11)[:, None] * v, 0.5, **options)
    assert np.abs(batch.q[-1] - mb.simulate(dyn, q, v, 0.5, **options).q).max() < 1e-12
