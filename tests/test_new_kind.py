"""Two kinds of elements of one's own (`tests.kinds_of_ones_own`): one file makes them known to every path."""

from __future__ import annotations

import ctypes
import pickle
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen.c_source import export_c
from mbkit.errors import InputError, UnsupportedError
from mbkit.lagrangian import from_model, program
from mbkit.model import Model
from mbkit.model.elements.formula import written
from mbkit.model.elements.kinds import PART_KINDS, register_kind
from tests.kind_paths import registered
from tests.kinds_of_ones_own import HardeningSpring, RateDamper

K, H, C = 3.0, 50.0, 0.7
Q, V, TAU = np.array([0.3, -0.7, 0.5]), np.array([1.0, -0.4, 0.6]), np.array([0.1, 0.2, 0.3])
NAMES = ("spring", "damper")


def bare() -> Model:
    b = mb.ModelBuilder("arm")
    for k, axis in enumerate(((0, 0, 1), (0, 1, 0), (0, 0, 1))):
        b.add_body(f"b{k}", mass=1.0 + k, com=(0.3, 0.1, 0.0), inertia=(0.1, 0.2, 0.25))
        up = f"b{k - 1}" if k else "world"
        b.add_joint(f"j{k}", "revolute", parent=up, child=f"b{k}", axis=axis, translation=(0.4 * (k > 0), 0.0, 0.0))
    return b.build()


def arm(name: str) -> Model:
    part = {
        "spring": HardeningSpring("spring", "j1", np.array([K, H])),
        "damper": RateDamper("damper", ("j0", "j2"), np.array([C])),
    }[name]
    return replace(bare(), forces=(part,))


def force(name: str, q: np.ndarray = Q, v: np.ndarray = V) -> np.ndarray:
    if name == "spring":
        return np.array([0.0, -K * q[1] - H * q[1] ** 3, 0.0])
    return C * (v[0] - v[2]) * np.array([-1.0, 0.0, 1.0])


def energy(q: float) -> float:
    return K * q**2 / 2 + H * q**4 / 4


def accelerated(name: str) -> np.ndarray:
    return mb.dynamics(bare(), "oracle").forward_dynamics(Q, V, TAU + force(name))


@pytest.fixture
def unknown() -> Iterator[None]:
    for name, cls in zip(NAMES, (HardeningSpring, RateDamper), strict=True):
        register_kind("forces", f"force.{name}", "{p}", "", "", "forces", lambda _, p, c=cls: type(p) is c)
    yield
    for name in NAMES:
        del PART_KINDS[f"force.{name}"]


@pytest.fixture
def known(unknown: None) -> None:  # noqa: ARG001  # it has registered them
    for name in NAMES:
        PART_KINDS[f"force.{name}"] = replace(PART_KINDS[f"force.{name}"], does=frozenset(["force.joint"]))


@pytest.mark.parametrize("power", [0, -1, 0.5])
def test_a_law_with_another_power_is_refused(power) -> None:
    with pytest.raises(InputError, match="expected a whole number above zero"):
        written(lambda q: q**power, "q")


@pytest.mark.parametrize("name", NAMES)
def test_one_that_no_kind_has_is_refused_on_every_path(name) -> None:
    model = arm(name)
    words = f"is a {type(model.forces[0]).__name__}, which no kind has"
    assert [path for path, gate in registered().items() if words not in gate.refuses(model)] == []
    with pytest.raises(UnsupportedError, match="which no kind has"):
        mb.convert(arm(name), "mjcf")


@pytest.mark.usefixtures("unknown")
@pytest.mark.parametrize("name", NAMES)
def test_on_its_first_day_every_path_refuses_it_by_name(name) -> None:
    told = {"spring": "force 'spring' at joint 'j1', of ", "damper": "force 'damper' at joint 'j0' and 'j2', of "}
    model = arm(name)
    assert [path for path, gate in registered().items() if told[name] not in gate.refuses(model)] == []


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("engine", ["lagrangian", "pinocchio", "mujoco", "drake", "oracle"])
@pytest.mark.parametrize("name", NAMES)
def test_engines_have_it(name, engine) -> None:
    if engine == "drake":
        pytest.importorskip("pydrake")
    dyn = mb.dynamics(arm(name), engine)
    assert dyn.forward_dynamics(Q, V, TAU) == pytest.approx(accelerated(name), rel=1e-12, abs=1e-12)
    assert dyn.passive(Q, V) == pytest.approx(force(name), rel=1e-14, abs=1e-14)
    more = mb.dynamics(bare(), engine).potential_energy(Q) + (energy(Q[1]) if name == "spring" else 0.0)
    assert dyn.potential_energy(Q) == pytest.approx(more, rel=1e-14)


@pytest.mark.thorough("damper")
@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", NAMES)
def test_texts_have_it(name, tmp_path: Path) -> None:
    model, wanted = arm(name), pytest.approx(accelerated(name), rel=1e-11)
    assert from_model(model).dynamics(options={"compile": False}).forward_dynamics(Q, V, TAU) == wanted
    names: dict = {}
    exec(program(model, "forward_dynamics").python(), names)
    assert names["forward_dynamics"](Q, V, TAU) == wanted
    assert mb.dynamics(model, "lagrangian").function("forward_dynamics")(Q, V, TAU).full()[:, 0] == wanted
    made = export_c(model, ["forward_dynamics"], name="case")
    _, source = made.write(tmp_path)
    library, out = tmp_path / "library.so", np.full(3, np.nan)
    subprocess.run(["cc", "-O0", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
    call = getattr(ctypes.CDLL(str(library)), made.functions[0].name)
    call.restype = None
    call(*(x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for x in (Q, V, TAU, out)))
    assert out == wanted
    for kind in ("urdf", "mjcf"):
        with pytest.raises(UnsupportedError, match=f"force '{name}' at joint"):
            mb.convert(model, kind)


@pytest.mark.thorough("taylor", "gauss6")
@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("method", ["rk853", "rk4", "implicit_midpoint", "gauss6", "rodas5", "taylor"])
def test_a_spring_keeps_the_energy_and_a_damper_takes_what_it_should(method) -> None:
    setting = {"dt": 1e-3} if method in ("rk4", "implicit_midpoint", "gauss6") else {"rtol": 1e-10}
    run = mb.simulate(mb.dynamics(arm("spring"), "lagrangian"), Q, V, 0.3, method, **setting)
    total = run.energy()
    assert np.ptp(total) < (1e-4 if method == "implicit_midpoint" else 1e-7) * np.abs(total).max()
    run = mb.simulate(mb.dynamics(arm("damper"), "lagrangian"), Q, V, 0.3, method, **setting)
    power = -C * (run.v[:, 0] - run.v[:, 2]) ** 2
    assert run.energy()[-1] - run.energy()[0] == pytest.approx(np.trapezoid(power, run.t), rel=2e-2)
    assert not run.check().doubts


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", NAMES)
def test_changes_of_a_model_have_it(name) -> None:
    model = arm(name)
    assert pickle.loads(pickle.dumps(model)).digest == model.digest != bare().digest
    assert model.without(f"force.{name}").digest == bare().digest
    both = mb.join(bare(), model, at="world", prefix="other_")
    q, v = np.tile(Q, 2), np.tile(V, 2)
    assert mb.dynamics(both).passive(q, v) == pytest.approx([0, 0, 0, *force(name)])
    held = mb.dynamics(model.lock({"j2": Q[2]}))
    still = force(name, Q, np.array([V[0], V[1], 0.0]))
    assert held.passive(Q[:2], V[:2]) == pytest.approx(still[:2], rel=1e-14)
    if name == "spring":
        moved = mb.dynamics(model.lock({"j1": -0.7})).potential_energy([0.1, 0.2])
        assert moved - mb.dynamics(bare().lock({"j1": -0.7})).potential_energy([0.1, 0.2]) == pytest.approx(
            energy(-0.7)
        )


@pytest.mark.usefixtures("known")
@pytest.mark.parametrize("name", NAMES)
def test_explain_sees_it_gone_and_each_number_changed(name) -> None:
    model = arm(name)
    assert [c.subject for c in mb.explain(model, bare()).causes] == [f"force {name!r}"]
    part = model.forces[0]
    for k in range(len(part.numbers)):
        numbers = part.numbers.copy()
        numbers[k] *= 1.5
        other = mb.explain(model, replace(model, forces=(replace(part, numbers=numbers),)))
        assert [c.subject for c in other.causes] == [f"force {name!r}"]
