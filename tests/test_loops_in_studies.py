"""Studies of mechanisms: references and work-precision curves under loops and prescribed motions."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit.errors import InputError, UnsupportedError
from mbkit.model import Model
from mbkit.model.parts import Loop, Prescribed
from mbkit.studies import reference_motions as references
from mbkit.studies.explain import terms
from mbkit.studies.explain.hypotheses import exchanged
from mbkit.studies.reference_motions import reference
from mbkit.studies.study_runs import start_state
from tests.random_trees import rotation
from validation import four_bar as bare

TIMES = np.linspace(0.0, 1.0, 11)
#: The crank's motion: angle 0.5 + 2 t + 0.3 sin(3 t).
LAW = Prescribed("crank", offset=0.5, rate=2.0, amplitude=0.3, frequency=3.0)


def driven() -> Model:
    return replace(bare.described(), prescribed=(LAW,))


def by_geometry(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return angles and rates of the driven four-bar, from triangles in 64 bits of mantissa."""
    long = np.longdouble
    theta = long(0.5) + 2 * long(t) + long(0.3) * np.sin(3 * long(t))
    rate = 2 + long(0.3) * 3 * np.cos(3 * long(t))
    (phi, psi), (f, r), _ = bare.geometry(theta)
    return np.array([theta, phi - theta, psi]), rate * np.array([1, f - 1, r])


def test_the_reference_of_a_loop_is_the_closed_form() -> None:
    """Against an extrapolated midpoint rule on the one coordinate that is free, with nothing of mbkit's."""
    out = reference(bare.described(), *bare.start(), 1.0, TIMES)
    assert out.horizon == 1.0
    assert out.digits > 25
    y = np.array([np.longdouble(bare.START), np.longdouble(bare.SPEED)])
    for k in range(1, 11):
        for _ in range(10):
            y = bare.extrapolated(y, np.longdouble("0.01"))
        assert abs(float(out.q[k, 0] - y[0])) < 4e-15
        assert abs(float(out.v[k, 0] - y[1])) < 1e-13


def test_the_reference_of_a_driven_loop_is_geometry() -> None:
    model = driven()
    out = reference(model, *(np.asarray(x, dtype=float) for x in by_geometry(0.0)), 1.0, TIMES)
    assert out.digits > 25
    for k, t in enumerate(TIMES):
        q, v = by_geometry(t)
        assert np.abs(out.q[k] - q).max() < 4e-15
        assert np.abs(out.v[k] - v).max() < 2e-14
    # The other engine's accelerations are those of the same times: at one time they would differ by much more.
    assert float(out.how.split("differ by ")[1].split(" ")[0]) < 1e-12


@pytest.mark.thorough("free")
@pytest.mark.parametrize("model", [bare.described(), driven()], ids=["free", "driven"])
def test_its_start_and_its_way_are_closed_to_all_digits(model: Model) -> None:
    q, v = (np.asarray(x, dtype=float) for x in by_geometry(0.0))
    motion = references.checked_motion(model, q, v, 1.0, TIMES)
    (q, q_low), _ = motion.start
    assert motion.gap((q[None], q_low[None]), np.zeros(1)) < 1e-31
    # A double is not there.
    assert motion.gap((q[None], 0 * q[None]), np.zeros(1)) > 1e-19
    out = reference(model, q, v, 1.0, TIMES)
    assert motion.gap((out.q, out.q_low), TIMES).max() < 1e-29


@pytest.mark.thorough
def test_an_open_way_ends_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs that drift off alike agree all the same."""

    def gap(_motion: object, _q: object, t: np.ndarray) -> np.ndarray:
        return 1e-9 * (t > 0.55)

    monkeypatch.setattr(references.Motion, "gap", gap)
    out = reference(bare.described(), *bare.start(), 1.0, TIMES)
    assert out.horizon == 0.5


@pytest.mark.thorough
def test_two_engines_agree_on_a_loop_under_a_torque_that_is_a_function() -> None:
    def push(t: float, _q: np.ndarray, v: np.ndarray) -> np.ndarray:
        return np.array([np.sin(5 * t), 0.0, -0.1 * v[2]])

    for model in (bare.described(), driven()):
        q, v = (np.asarray(x, dtype=float) for x in by_geometry(0.0))
        out = reference(model, q, v, 0.2, np.linspace(0, 0.2, 5), push)
        assert out.how.startswith("rk853 on lagrangian and dop853 on pinocchio")
        assert out.horizon == 0.2
        own = mb.dynamics(model, "lagrangian")
        run = mb.simulate(own, q, v, 0.2, "radau", rtol=1e-12, torque=push, save=[0.0, 0.2])
        assert np.abs(run.q[-1] - out.q[-1]).max() < 1e-10


def test_an_engine_whose_loops_give_way_makes_no_reference() -> None:
    with pytest.raises(UnsupportedError, match="mujoco holds loops softly"):
        references._require_rigid(mb.dynamics(bare.described(), "mujoco"))


def test_an_open_start_is_refused() -> None:
    q, v = bare.start()
    for study in (
        lambda: mb.work_precision(bare.described(), ["lagrangian"], ["rk4"], q0=q + 0.01, v0=v),
        lambda: reference(bare.described(), q + 0.01, v, 1.0, TIMES),
    ):
        with pytest.raises(InputError, match=r"is open there: loop .* by .*project\(q0, v0\)"):
            study()


def test_studies_start_consistently() -> None:
    """A tenth of a consistent velocity is consistent only where nothing is driven."""
    for model in (bare.described(), driven(), mb.catalog.stewart_platform()):
        q, v = start_state(model, 3)
        own = mb.dynamics(model, "lagrangian", compile=False)
        assert np.abs(own.constraint_residual(q)).max() < 1e-13
        assert np.abs(own.constraint_rate(q, v)).max() < 1e-13


def test_work_precision_of_a_mechanism() -> None:
    pytest.importorskip("pydrake")
    methods = {
        "pinocchio": ("rk4",),
        "lagrangian": ("rk4", "semi_implicit_euler", "rk853", "taylor"),
        "mujoco": ("mujoco_rk4",),
        "drake": ("drake_sap",),
    }
    settings = {"steps": [0.01, 0.005, 0.0025, 0.00125], "tolerances": [1e-6, 1e-13]}
    result = mb.work_precision(bare.described(), tuple(methods), methods, duration=0.2, repeats=1, **settings)
    assert not result.refusals
    curves = {(c.engine, c.method): c for c in result.curves}
    assert set(curves) == {(engine, method) for engine, some in methods.items() for method in some}
    for key, order in {
        ("pinocchio", "rk4"): 4,
        ("lagrangian", "rk4"): 4,
        ("lagrangian", "semi_implicit_euler"): 1,
        ("drake", "drake_sap"): 1,
    }.items():
        assert curves[key].order == pytest.approx(order, abs=0.2), key
    least = {key: np.nanmin([p.error for p in c.points]) for key, c in curves.items()}
    assert least["lagrangian", "rk853"] < 1e-13
    assert least["lagrangian", "taylor"] < 1e-12
    assert least["pinocchio", "rk4"] < 1e-8
    # No step makes soft loops rigid ones, and the study says so.
    assert least["mujoco", "mujoco_rk4"] > 1e-5
    assert any(note.startswith("mujoco and drake: holds loops by its own law") for note in result.facts["notes"])


@pytest.mark.thorough
def test_work_precision_of_driven_mechanisms() -> None:
    steps = [0.02, 0.01, 0.005]
    model = mb.catalog.five_bar()
    driven_one = replace(model, prescribed=(Prescribed(model.joints[0].name, rate=1.0, amplitude=0.2, frequency=9.0),))
    (curve,) = mb.work_precision(driven_one, ["lagrangian"], ["rk4"], duration=0.2, repeats=1, steps=steps).curves
    assert curve.order == pytest.approx(4, abs=0.2)
    # Nothing is free in the other one, and its states are where the drive puts them, whatever the step.
    (curve,) = mb.work_precision(
        driven(), ["lagrangian"], ["rk4"], duration=0.2, repeats=1, steps=steps, reference=by_double
    ).curves
    assert max(p.error for p in curve.points) < 4e-15


def by_double(t: float) -> tuple[np.ndarray, np.ndarray]:
    q, v = by_geometry(t)
    return np.asarray(q, dtype=float), np.asarray(v, dtype=float)


@pytest.mark.thorough
def test_stress_finds_the_step_that_jumps_over_a_change_point() -> None:
    """A fixed step finds other speeds beyond it; error control holds to where doubles end."""
    result = mb.stress(
        "change_point", ("lagrangian", "mujoco"), ("rk4", "rk853"), values=[0.1, 1e-5], seconds=10.0, rtol=1e-10
    )
    (case,) = result.cases
    outcome = {(row.engine, row.method): [cell.outcome(1e-6) for cell in row.cells] for row in case.rows}
    assert outcome["lagrangian", "rk853"] == ["held", "held"]
    assert outcome["lagrangian", "rk4"][0] == "held"
    assert outcome["lagrangian", "rk4"][1] in ("silent", "warned")
    # Soft loops lose energy at the mildest value already.
    assert "held" not in outcome["mujoco", "rk853"]


@pytest.mark.thorough
def test_stress_of_a_stiff_drive_is_measured_by_its_closed_form() -> None:
    result = mb.stress("stiff_drive", ("lagrangian",), ("rk4",), values=[1e2, 1e10], seconds=10.0)
    (row,) = result.cases[0].rows
    assert [cell.outcome(1e-6) for cell in row.cells] == ["held", "diverged"]


# Explanations

TURN = rotation(np.random.default_rng(0))


def said(one: Loop, other: Loop | None) -> list[str]:
    model = mb.catalog.four_bar()
    found = mb.explain(replace(model, loops=(one,)), replace(model, loops=() if other is None else (other,)))
    assert found.agree == (not found.acting)
    return [cause.says.removeprefix("loop 'pin': second ") for cause in found.causes]


def pin(kind: str = "point", **fields: Any) -> Loop:
    (loop,) = mb.catalog.four_bar().loops
    frames = {"rotation_a": TURN, "rotation_b": TURN.T}
    return replace(loop, kind=kind, **frames | fields)


@pytest.fixture
def never_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Compare loops in words alone: most of these never close, which a search for states takes long to find."""
    monkeypatch.setattr(terms, "whole_gap", lambda *_: np.nan)


@pytest.mark.usefixtures("never_closed")
def test_what_differs_between_two_loops_is_named() -> None:
    moved = pin(translation_b=pin().translation_b + np.array([0.0, 0.03, 0.04]))
    assert said(pin(), moved)[0].startswith("has its point on 'rocker' 0.05 m away, at (")
    assert said(pin(), pin("revolute")) == ["closes it as revolute for point"]
    assert said(pin(), replace(pin(), body_b="crank")) == ["ends it on 'crank' for 'rocker'"]
    assert said(pin("distance", length=0.1), pin("distance", length=0.2)) == ["has a length of 0.2 m for 0.1 m"]
    assert said(pin(), None) == ["lacks it"]
    c, s = np.cos(0.1), np.sin(0.1)
    tilt, spin = np.array([[1, 0, 0], [0, c, -s], [0, s, c]]), np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    for kind in ("revolute", "cylindrical", "universal"):
        assert said(pin(kind), pin(kind, rotation_a=TURN @ tilt)) == ["has its axis on 'coupler' turned by 5.73°"]
    assert said(pin("frame"), pin("frame", rotation_a=TURN @ spin)) == ["turns its ends by 5.73° against each other"]


@pytest.mark.usefixtures("never_closed")
def test_what_changes_no_motion_is_no_difference() -> None:
    at_a, at_b = pin().translation_a, pin().translation_b
    c, s = np.cos(0.1), np.sin(0.1)
    spin, flip = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]), np.diag([1.0, -1.0, -1.0])
    along_a, along_b = TURN[:, 2], TURN.T[:, 2]
    for kind in ("point", "distance", "revolute", "cylindrical", "universal", "frame", "prismatic"):
        loop = pin(kind, length=0.1 if kind == "distance" else 0.0)
        assert said(loop, exchanged(loop)) == []
        (renamed,) = said(loop, replace(loop, name="other"))
        assert renamed == "second calls loops otherwise: 'pin' is 'other'"
    assert said(pin(), pin(rotation_a=np.eye(3))) == []
    for kind in ("revolute", "cylindrical", "universal"):
        assert said(pin(kind), pin(kind, rotation_a=TURN @ spin)) == []
        assert said(pin(kind), pin(kind, rotation_a=TURN @ flip, rotation_b=TURN.T @ flip)) == []
    # Of a hinge one axis alone turned round is another mechanism.
    assert said(pin("revolute"), pin("revolute", rotation_a=TURN @ flip)) != []
    together = {"translation_a": at_a + 0.1 * along_a, "translation_b": at_b + 0.1 * along_b}
    assert said(pin("revolute"), pin("revolute", **together)) == []
    assert said(pin("revolute"), pin("revolute", translation_a=together["translation_a"])) != []
    assert said(pin("cylindrical"), pin("cylindrical", translation_a=together["translation_a"])) == []
    # A weld at another point of the welded bodies, in other common axes.
    point = np.array([0.1, -0.2, 0.3])
    weld = {"translation_a": at_a + TURN @ point, "translation_b": at_b + TURN.T @ point}
    axes = {"rotation_a": TURN @ spin, "rotation_b": TURN.T @ spin}
    assert said(pin("frame"), pin("frame", **weld, **axes)) == []
    assert said(pin("frame"), pin("frame", translation_a=weld["translation_a"])) != []
