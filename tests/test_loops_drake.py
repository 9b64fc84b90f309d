"""Loops on Drake: its continuous plant has none, its discrete one runs them, and what it lacks is refused by name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines import Dynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.model import Model
from mbkit.model.parts import Prescribed
from tests.quantities import closed
from tests.random_trees import random_tree
from validation import four_bar as bare

pytest.importorskip("pydrake")

from mbkit.engines.drake.engine import DiscreteRun
from tests.scenes import slider

#: Kinds of loops that Drake has.
HELD = ("point", "frame", "distance")


def four_bar() -> tuple[Dynamics, np.ndarray, np.ndarray]:
    return mb.dynamics(bare.described(), "drake"), *bare.start()


def closed_tree(seed: int, kind: str) -> tuple[Model, np.ndarray, np.ndarray]:
    """Return a random tree with a closed loop between two of its bodies, and a consistent state."""
    model, q = closed(random_tree(seed, 8, ("revolute", "prismatic")), seed, kind)
    v = 0.3 * np.random.default_rng(seed).standard_normal(model.nv)
    return model, *mb.dynamics(model, "lagrangian", compile=False).project(q, v)


def test_drake_s_continuous_plant_refuses_to_accelerate_loops_and_has_the_tree_s_other_terms() -> None:
    """What mbkit's texts say of Drake, with Drake alone: a version that changes it fails here."""
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import MultibodyForces, RevoluteJoint, SpatialInertia

    def plant(constrained: bool) -> tuple[Any, Any]:
        plant = MultibodyPlant(0.0)
        bodies = []
        for name in "ab":
            bodies.append(plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1)))
            frames = plant.world_frame(), bodies[-1].body_frame()
            plant.AddJoint(RevoluteJoint(name, *frames, [1.0, 0.0, 0.0]))
        if constrained:
            plant.AddDistanceConstraint(bodies[0], [0, 0, 1.0], bodies[1], [0, 1.0, 0], 2.0**0.5)
        plant.Finalize()
        context = plant.CreateDefaultContext()
        plant.SetVelocities(context, [1.0, 2.0])
        return plant, context

    (free, at), (held, where) = plant(False), plant(True)
    assert (free.num_constraints(), held.num_constraints()) == (0, 1)
    assert free.get_generalized_acceleration_output_port().Eval(at).shape == (2,)
    for call in (held.get_generalized_acceleration_output_port().Eval, held.get_reaction_forces_output_port().Eval):
        with pytest.raises(RuntimeError, match="Continuous time does not support constraints"):
            call(where)
    # These ignore the constraint in silence.
    assert np.array_equal(held.CalcMassMatrix(where), free.CalcMassMatrix(at))
    forces = MultibodyForces(held), MultibodyForces(free)
    demand = np.array([3.0, -1.0])
    assert np.array_equal(
        held.CalcInverseDynamics(where, demand, forces[0]), free.CalcInverseDynamics(at, demand, forces[1])
    )


def test_derivatives_and_other_methods_are_refused_with_the_reason() -> None:
    dyn, q, v = four_bar()
    with pytest.raises(UnsupportedError, match="continuous plant"):
        dyn.forward_dynamics_derivatives(q, v, np.zeros(3))
    for method in ("rk4", "dop853", "drake_runge_kutta5"):
        more = {} if method == "rk4" else {"save": [0.0, 0.1]}
        with pytest.raises(UnsupportedError, match="drake_sap"):
            mb.simulate(dyn, q, v, 0.1, method, **more)


def test_a_run_is_drake_s_own_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same plant, written with Drake alone in `validation.four_bar`."""
    monkeypatch.setattr(bare, "TIMES", (0.5,))
    states, _ = bare.drake()
    dyn, q, v = four_bar()
    run = mb.simulate(dyn, q, v, 0.5, "drake_sap", dt=bare.DT)
    assert np.array_equal(run.q, states)
    assert run.stats.steps == 500


@pytest.mark.thorough("1-point", "1-frame", "1-distance", "4-point", "4-frame")
@pytest.mark.parametrize("kind", HELD)
@pytest.mark.parametrize("seed", [1, 4])
def test_runs_tend_to_the_rigid_motion_in_first_order(kind: str, seed: int) -> None:
    model, q, v = closed_tree(seed, kind)
    exact = mb.simulate(
        mb.dynamics(model, "lagrangian", compile=False), q, v, 0.1, "rk853", rtol=1e-12, save=[0.0, 0.1]
    )
    dyn, errors, gaps = mb.dynamics(model, "drake"), [], []
    own = mb.dynamics(model, "lagrangian", compile=False)
    for dt in (1e-3, 5e-4, 2.5e-4):
        run = mb.simulate(dyn, q, v, 0.1, "drake_sap", dt=dt, save=[0.0, 0.1])
        errors.append(np.abs(run.q[-1] - exact.q[-1]).max())
        gaps.append(np.abs(own.constraint_residual(run.q[-1])).max())
    assert np.diff(np.log2(errors)) == pytest.approx(-1.0, abs=0.1)
    # It is the engine's own run: nothing is projected onto closed loops, whose rounding would be 1e-15.
    assert gaps[0] > 1e-11
    assert gaps[0] > 1.8 * gaps[1] > 3.2 * gaps[2]


def test_couplers_are_held_in_runs() -> None:
    b = mb.ModelBuilder("gears")
    for k in (1, 2):
        b.add_body(f"wheel{k}", mass=1.0, com=(0.1, 0, 0), inertia=(0.1, 0.1, 0.1))
        b.add_joint(f"axle{k}", "revolute", parent="world", child=f"wheel{k}", axis=(0, 1, 0))
    b.add_coupler("pair", "axle1", "axle2", ratio=-2.0, offset=0.3)
    model = b.build()
    exact = mb.simulate(
        mb.dynamics(model, "lagrangian", compile=False), [0.3, 0.0], [0.0, 0.0], 0.1, "rk853", rtol=1e-12
    )
    errors = []
    for dt in (1e-3, 5e-4):
        run = mb.simulate(mb.dynamics(model, "drake"), [0.3, 0.0], [0.0, 0.0], 0.1, "drake_sap", dt=dt)
        errors.append(np.abs(run.q[-1] - exact.q[-1]).max())
    # To first order in the step. Without the coupler the second wheel would turn the other way.
    assert errors[1] < 1e-3
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.3)


def test_a_batch_a_torque_and_a_shortened_last_step() -> None:
    dyn, q, v = four_bar()
    torque = np.array([0.5, 0.0, -0.2])
    both = mb.simulate(
        dyn, np.stack([q, q]), np.stack([v, 0 * v]), 0.0105, "drake_sap", dt=1e-3, torque=torque, save=[0.0, 0.0105]
    )
    alone = mb.simulate(dyn, q, v, 0.0105, "drake_sap", dt=1e-3, torque=torque)
    assert np.array_equal(both.q[0, -1], alone.q[-1])
    whole = mb.simulate(dyn, q, v, 0.01, "drake_sap", dt=1e-3, torque=torque)
    half, _ = DiscreteRun(dyn, 5e-4).step(whole.q[-1], whole.v[-1], torque)
    # The last step is the duration less ten steps, which rounds.
    assert np.abs(alone.q[-1] - half).max() < 1e-15
    free = mb.simulate(dyn, q, v, 0.01, "drake_sap", dt=1e-3)
    assert np.abs(free.q[-1] - whole.q[-1]).max() > 1e-6


def test_a_step_of_a_tree_is_semi_implicit_with_damping_at_its_end() -> None:
    """x⁺ = x + h v⁺ and (m + h d) v⁺ = m v - h k x, in closed form."""
    b = slider("slider", gravity=(0, 0, 0), mass=2.0, damping=3.0, stiffness=50.0)
    dyn, x, v, h = mb.dynamics(b.build(), "drake"), 0.3, -1.0, 0.01
    run = mb.simulate(dyn, [x], [v], 0.1, "drake_sap", dt=h)
    for k in range(10):
        v = (2.0 * v - h * 50.0 * x) / (2.0 + h * 3.0)
        x += h * v
        assert run.v[k + 1, 0] == pytest.approx(v, rel=1e-12)
        assert run.q[k + 1, 0] == pytest.approx(x, rel=1e-12)


def test_prescribed_motions_and_open_starts_are_refused() -> None:
    model = bare.described()
    driven = replace(model, prescribed=(Prescribed("crank", offset=0.5, rate=5.0),))
    q, v = mb.dynamics(driven, "lagrangian", compile=False).project(*bare.start())
    with pytest.raises(UnsupportedError, match="joint 'crank' is moved in time"):
        mb.simulate(mb.dynamics(driven, "drake"), q, v, 0.01, "drake_sap")
    with pytest.raises(InputError, match=r"q0: \w+ is open there: loop .*project\(q0, v0\)"):
        mb.simulate(mb.dynamics(model, "drake"), [0.5, 0.0, 1.0], np.zeros(3), 0.01, "drake_sap")
