"""A joint type of one's own in thirty lines (`tests.joint_of_ones_own`): what works with it, and what refuses it."""

# ruff: noqa: ARG005  # formulas keep their arguments

from __future__ import annotations

import pickle
import subprocess
import sys

import numpy as np
import pytest

import mbkit as mb
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, UnsupportedError
from mbkit.model import KINDS, JointType, kind_of, register_joint_type
from mbkit.testing import assert_engines_agree
from tests.joint_of_ones_own import OWN, Cylindrical
from tests.scenes import mounted

MASS, RADIUS, INERTIA, G, STIFFNESS = 2.0, 0.3, 0.05, 9.81, 7.0


def rod(**more) -> mb.Model:
    """Return a body on a vertical axis, with its centre of mass beside it."""
    b = mb.ModelBuilder("rod", gravity=(0.0, 0.0, -G))
    b.add_body("body", mass=MASS, com=(RADIUS, 0.0, 0.0), inertia=(INERTIA, INERTIA, INERTIA))
    b.add_joint("j", "cylindrical", parent="world", child="body", axis=(0, 0, 1), **more)
    return b.build()


# It moves as the closed form says.


@pytest.mark.parametrize("engine", ["lagrangian", "oracle"])
def test_its_equations_are_those_of_a_slide_and_a_hinge(engine):
    dyn = mb.dynamics(rod(stiffness=(0.0, STIFFNESS)), engine)
    q, v = [0.2, 0.5], [0.3, -2.0]
    assert dyn.mass_matrix(q) == pytest.approx(np.diag([MASS, INERTIA + MASS * RADIUS**2]), abs=1e-15)
    assert dyn.gravity(q) == pytest.approx([MASS * G, 0.0], abs=1e-14)
    assert dyn.passive(q, v) == pytest.approx([0.0, -STIFFNESS * 0.5], abs=1e-14)
    angle = -STIFFNESS * 0.5 / (INERTIA + MASS * RADIUS**2)
    assert dyn.forward_dynamics(q, v, [0, 0]) == pytest.approx([-G, angle], rel=1e-13)
    assert dyn.forward_dynamics_derivatives(q, v, [0, 0]).q[1, 1] == pytest.approx(angle / 0.5, rel=1e-13)


@pytest.mark.parametrize("method", ["rk853", "rk4", "implicit_midpoint", "rodas5", "auto"])
def test_its_motion_is_the_closed_form(method):
    setting = {"dt": 1e-3} if method in ("rk4", "implicit_midpoint") else {"rtol": 1e-10}
    model = rod(stiffness=(0.0, STIFFNESS))
    run = mb.simulate(mb.dynamics(model, "lagrangian"), [0.0, 0.4], [1.0, 0.0], 0.5, method=method, **setting)
    frequency = np.sqrt(STIFFNESS / (INERTIA + MASS * RADIUS**2))
    exact = np.stack([run.t - G * run.t**2 / 2, 0.4 * np.cos(frequency * run.t)], axis=1)
    assert np.abs(run.q - exact).max() < (1e-5 if method == "implicit_midpoint" else 1e-7)


def test_it_can_be_drawn_and_exported():
    run = mb.simulate(mb.dynamics(rod(), "lagrangian"), [0.0, 0.4], [1.0, 0.0], 0.1, method="rk4", dt=1e-2)
    run.plot()
    assert "cylindrical" in rod()._repr_html_()
    assert "mass_matrix" in mb.lagrangian.export_c(rod(), ["mass_matrix"]).header


# Studies take it on the engines that have it, and name what has not.


def test_studies_take_it():
    paper = mb.lagrangian.from_model(rod(stiffness=(0.0, STIFFNESS)))
    assert paper is not None
    result = mb.work_precision(rod(), ["lagrangian"], ["rk4", "rk853"], steps=[0.02, 0.01], repeats=1, duration=0.1)
    assert {c.method for c in result.curves} == {"rk4", "rk853"}
    compared = mb.compare(rod(), ("lagrangian", "pinocchio"), 2)
    assert [r.engine for r in compared.refusals if not r.term] == ["pinocchio"]
    assert "cylindrical" in compared.refusals[0].reason
    with pytest.raises(AssertionError, match=r"! pinocchio: .*cylindrical"):
        assert_engines_agree(rod(), ("lagrangian", "pinocchio"), samples=2)


@pytest.mark.parametrize("kind", OWN)
@pytest.mark.parametrize("engine", ["pinocchio", "mujoco", "drake"])
def test_other_engines_refuse_it_by_name(engine, kind):
    b = mounted("m", "body", "j", kind, mass=1.0, inertia=(1.0, 1.0, 1.0), axis=(0, 0, 1))
    with pytest.raises(UnsupportedError, match=rf"{engine}: (m: )?joint 'j' is {kind}.*lagrangian"):
        mb.dynamics(b.build(), engine)


@pytest.mark.parametrize("form", ["urdf", "mjcf"])
def test_file_formats_refuse_it_by_name(form):
    with pytest.raises(UnsupportedError, match=rf"(?i){form}.*joint 'j' is cylindrical"):
        mb.convert(rod(), form)


# Another process, and compiled code that is kept on disk.


def test_another_process_learns_it_from_the_model():
    program = "import pickle, sys; print(pickle.load(sys.stdin.buffer).joints[0].type)"
    done = subprocess.run([sys.executable, "-c", program], input=pickle.dumps(rod()), capture_output=True, check=True)
    assert done.stdout.decode().strip() == "<joint type 'cylindrical': nq=2, nv=2>"


def test_a_process_without_it_says_so():
    with pytest.raises(UnsupportedError, match=r"'bayonet' is not registered.*register_joint_type"):
        kind_of("bayonet")


class Twisted(Cylindrical):
    """Cylindrical, with another formula under the same name."""

    def placement(self, m, joint, q):
        return super().placement(m, joint, [2.0 * q[0], q[1]])

    def twist(self, m, joint, q, v):
        return super().twist(m, joint, q, [2.0 * v[0], v[1]])


def test_kept_code_is_that_of_the_formulas(monkeypatch):
    q = [0.1, 0.2]
    first = rod()
    digest, M = first.digest, LagrangianDynamics(first, compile=True).mass_matrix(q)
    monkeypatch.setitem(KINDS, "cylindrical", Twisted())
    second = rod()
    assert second.digest != digest
    assert LagrangianDynamics(second, compile=True).mass_matrix(q)[0, 0] == pytest.approx(4 * M[0, 0], rel=1e-14)


# What cannot be a joint type is refused with the reason.


def faulty(**attributes) -> JointType:
    return type("Faulty", (Cylindrical,), {"name": "faulty", **attributes})()


@pytest.mark.parametrize(
    ("joint_type", "reason"),
    [
        (Cylindrical, "expected an instance"),
        ("cylindrical", "expected an instance"),
        (Twisted(), "registered with other formulas"),
        (type("Planar", (Cylindrical,), {"name": "planar"})(), "registered with other formulas"),
        (faulty(name="two words"), "name: expected a word"),
        (faulty(nq=3), "expected nq = nv"),
        (faulty(suffixes=("d",)), "suffixes: expected 2"),
        (faulty(angular=()), "each coordinate"),
        (faulty(angular=(2,)), "indices below 2"),
        (faulty(gimbal=0), "gimbal"),
        (faulty(floating=True), "floating"),
        (faulty(like="nothing"), "like"),
        (faulty(twist=lambda self, m, joint, q, v: ([0.0] * 3, [v[1] * a for a in joint.axes[0]])), "twist: expected"),
        (faulty(placement=lambda self, m, joint, q: ([[1.0, 0.0, 0.0]] * 3, [0.0] * 3)), "not a rotation"),
        (faulty(placement=lambda self, m, joint, q: ([m.exp(q[0])], [0.0])), "a formula fails"),
        (faulty(hamel=lambda self, v, p: [v[0], p[0]]), "hamel: expected"),
        (faulty(pullback=lambda self, q, g: [g[1], g[0]]), "pullback: expected"),
        (faulty(qdot=lambda self, q, v: [2 * v[0], v[1]]), "qdot: expected v"),
        (faulty(lengths=(), angular=(0, 1)), "list it in screws"),
    ],
)
def test_what_is_no_joint_type_is_refused(joint_type, reason):
    with pytest.raises(InputError, match=reason):
        register_joint_type(joint_type)
    assert "faulty" not in KINDS
    assert type(kind_of("planar")).__name__ == "_Planar"


def test_the_same_type_may_be_registered_again():
    assert register_joint_type(Cylindrical()) is kind_of("cylindrical")
