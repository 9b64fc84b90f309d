"""The same on every processor: seeds, choices of rows, and one formula of a step under constraints.

Another BLAS sums in another order, and another libm rounds a sine in another way: both are imitated by noise in the
last bits, and the first by OpenBLAS's own kernels, where that is the BLAS.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mbkit as mb
from mbkit._reproducible import length, pivoted, product, turned
from mbkit.derivation.constraints import choose_rows, independent_rows
from mbkit.engines.constraint_manifold import Manifold
from mbkit.errors import UnsupportedError
from mbkit.lagrangian import from_model, systems
from mbkit.simulate import METHODS

EPS = float(np.finfo(float).eps)
#: Frames, shapes and joints turned and moved against each other, whose numbers are sums of products.
MJCF = """<mujoco><compiler angle="radian"/><worldbody>
<body name="a" pos=".1 .2 .3" euler=".4 -.7 1.1"><joint axis=".3 .5 .7" pos=".1 .2 .05" ref=".3"/>
<geom type="box" size=".1 .2 .3" pos=".1 0 .2" euler="1 2 3"/>
<geom type="capsule" size=".05" fromto="0 .1 .2 .3 .1 .7"/>
<body name="b" pos=".3 .1 .2" xyaxes=".6 .8 .1 -.7 .5 .2"><joint type="slide" axis=".2 .9 .1"/>
<inertial pos=".1 .2 .1" mass="1" diaginertia=".1 .2 .25" axisangle=".3 .2 .9 .7"/></body></body>
</worldbody></mujoco>"""
URDF = """<robot name="turned"><link name="base"/>
<link name="a"><inertial><origin xyz=".1 .2 .3" rpy=".4 .5 .6"/><mass value="1"/>
<inertia ixx=".3" ixy=".01" ixz=".02" iyy=".4" iyz=".03" izz=".5"/></inertial></link>
<link name="b"><inertial><origin xyz=".3 .1 .2" rpy="1 .2 .3"/><mass value="2"/>
<inertia ixx=".2" ixy=".02" ixz=".01" iyy=".3" iyz=".02" izz=".4"/></inertial></link>
<joint name="j" type="continuous"><parent link="base"/><child link="a"/><origin rpy=".1 .2 .3"/><axis xyz=".3 .5 .7"/>
</joint><joint name="f" type="fixed"><parent link="a"/><child link="b"/><origin xyz=".1 .3 .2" rpy=".7 .1 .4"/></joint>
</robot>"""


MECHANISMS = [name for name, make in mb.catalog.systems().items() if make().constrained]
PAPER = "slider_crank on paper"


@cache
def mechanism(name: str, compiled: bool = False) -> Any:
    """Return the own dynamics of a system with constraints, of bodies or on paper."""
    if name == "driven_pendulum":
        return systems.driven_pendulum().dynamics(options={"compile": compiled})
    if name == PAPER:
        return from_model(mb.catalog.slider_crank()).dynamics(options={"compile": compiled})
    return mb.dynamics(mb.catalog.get(name)(), "lagrangian", compile=compiled)


def states(seeds: int, names: tuple[str, ...] = (*MECHANISMS, PAPER)) -> dict[str, Any]:
    """Return states of mechanisms for some seeds, the rows that are kept, and the digests of all systems."""
    out: dict[str, Any] = {f"{name}, digest": make().digest for name, make in mb.catalog.systems().items()}
    with tempfile.TemporaryDirectory() as folder:
        for name, text in {"turned.xml": MJCF, "turned.urdf": URDF}.items():
            path = Path(folder, name)
            path.write_text(text)
            out[f"{name}, digest"] = mb.load(path).digest
    for name in names:
        model = mechanism(name).model
        q, v = zip(*(model.random_state(seed) for seed in range(seeds)), strict=True)
        out[name] = [np.array(q).tolist(), np.array(v).tolist()]
        if model.has_bodies:
            out[f"{name}, rows"] = [*choose_rows(model).kept, *choose_rows(model).independent]
    return out


def assert_same(got: dict[str, Any], expected: dict[str, Any]) -> None:
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        if name.endswith(("rows", "digest")):
            assert got[name] == value, name
            continue
        for x, y in zip(got[name], value, strict=True):
            # A draw goes on where rounding grows less than thirtyfold in a step, ten thousandfold on the way.
            size = max(1.0, float(np.abs(y).max()))
            assert np.abs(np.array(x) - y).max() < 1e5 * EPS * size, name


@pytest.mark.thorough
def test_a_seed_has_the_same_state_under_another_kernel() -> None:
    code = "import json; from tests.test_processors import states; print(json.dumps(states(3)))"
    env = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem"}
    text = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True).stdout
    assert_same(json.loads(text.splitlines()[-1]), states(3))


def test_a_seed_has_the_same_state_though_every_number_is_rounded_otherwise(monkeypatch: pytest.MonkeyPatch) -> None:
    names = (*MECHANISMS[::3], PAPER)
    expected, rng, call = states(1, names), np.random.default_rng(0), Manifold.call

    def noisy(self: Manifold, name: str, *arguments: np.ndarray) -> list[np.ndarray]:
        out = call(self, name, *arguments)
        return [x * (1 + EPS * rng.choice([-1, 0, 1], x.shape)) for x in out]

    monkeypatch.setattr(Manifold, "call", noisy)
    assert_same(states(1, names), expected)


def test_of_equal_rows_the_first_are_kept_whatever_the_last_bits_are() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        basis = np.linalg.qr(rng.standard_normal((6, 3)))[0].T
        rows = np.vstack([basis, basis[::-1], basis[0] + basis[1]])
        expected = independent_rows(rows)[0]
        assert len(expected) == 3
        for _ in range(5):
            noisy = rows * (1 + 4 * EPS * rng.standard_normal(rows.shape))
            assert independent_rows(noisy)[0] == expected
    order, sizes, found = pivoted(np.diag([1.0, 3.0, 2.0, 0.0]), 1e-12)
    assert (order, sizes) == ([1, 2, 0], [3.0, 2.0, 1.0])
    assert np.abs(found.T @ found - np.eye(3)).max() < 4 * EPS


def test_products_in_one_order_are_products() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        A, B, x = rng.standard_normal((3, 3)), rng.standard_normal((3, 4)), rng.standard_normal(3)
        assert np.abs(product(A, B) - A @ B).max() < 16 * EPS
        assert np.abs(product(A, x) - A @ x).max() < 16 * EPS
        assert np.abs(turned(A, A + A.T) - A @ (A + A.T) @ A.T).max() < 64 * EPS * np.abs(A).max() ** 3
        assert abs(length(x) - np.linalg.norm(x)) < 4 * EPS * length(x)
    for bad in (np.ones(2), np.ones((2, 3)), np.array(1.0)):
        with pytest.raises(ValueError, match="do not fit"):
            product(np.eye(3), bad)


# One formula

EXPLICIT = ("rk4", "semi_implicit_euler")
#: One mechanism of each kind of row, with few links, for the methods that take seconds to compile for many: loops,
#: rolling, a motion in time, rows on paper. Of gauss6, whose parts are gauss4's, one is enough.
FEW = ("slider_crank", "rolling_disc", "chaplygin_sleigh", "flyball_governor", PAPER, "driven_pendulum")
#: A step in which each mechanism moves visibly, and no more.
STEP = {"andrews_squeezer": 1e-4}


def ways(own: Any, paper: Any, q: np.ndarray, v: np.ndarray, method: str, h: float) -> dict[str, Any]:
    """Return the state after three steps, taken in every way: compiled or not, by a run, steps, and in a batch."""
    out, clock, zero = {}, own.model.time_parameter, np.zeros(own.model.nv)
    other = own.model.random_state(7)
    for name, dyn in (("compiled", own), ("interpreted", paper)):
        run = mb.simulate(dyn, q, v, 3 * h, method, dt=h, doubt=False)
        out[f"{name}, run"] = run.q[-1], run.v[-1]
        batch = mb.simulate(dyn, np.stack([other[0], q]), np.stack([other[1], v]), 3 * h, method, dt=h, doubt=False)
        out[f"{name}, batch"] = batch.q[1, -1], batch.v[1, -1]
        if method in EXPLICIT:
            x = q, v
            for k in range(3):
                x = dyn.step(*x, zero, h, method, t=k * h if clock else None)
            out[f"{name}, steps"] = x
    return out


# One of each kind of row in the suite, and one that moves in space.
@pytest.mark.thorough(
    *("rolling_disc", "flyball_governor", PAPER), *(m for m in MECHANISMS if m not in (*FEW, "delta_robot"))
)
# The robot on three arms compiles longest; the platform on six legs has as many loops.
@pytest.mark.parametrize("name", [*(m for m in MECHANISMS if m != "delta_robot"), PAPER, "driven_pendulum"])
def test_a_method_is_one_formula_under_constraints(name: str) -> None:
    own, paper = mechanism(name, compiled=True), mechanism(name)
    q, v = own.model.random_state(3)
    for method in [m.name for m in METHODS.values() if m.kind == "fixed" and m.compiled]:
        if method != "semi_implicit_euler" and name not in (FEW if method != "gauss6" else FEW[:1]):
            continue
        try:
            found = ways(own, paper, q, v, method, STEP.get(name, 0.01))
        except UnsupportedError:
            assert method == "implicit_midpoint"
            continue
        expected = found["interpreted, run"]
        for way, state in found.items():
            for x, y in zip(state, expected, strict=True):
                # Near a singular pose, σ away, a velocity loses eps/σ².
                assert np.abs(x - y).max() < 1e3 * EPS * max(1.0, float(np.abs(y).max())), (method, way)
        if method in EXPLICIT and own.model.constrained:
            # The end is on the constraints, wherever the step was taken.
            at = own.at(**{own.model.time_parameter: 3 * STEP.get(name, 0.01)}) if own.model.time_parameter else own
            for way, (q1, v1) in found.items():
                size = np.abs(at.constraint_jacobian(q1)).max() * max(1.0, float(np.abs(v1).max()))
                assert np.abs(at.constraint_rate(q1, v1)).max() < 100 * EPS * size, (method, way)


def test_the_published_step_has_one_answer() -> None:
    """The crank of a slider-crank at H = 0.01, of which `simulate` and `step` had answers that differed by 1e-6."""
    compiled, interpreted = (mechanism(PAPER, compiled=x) for x in (True, False))
    q, v = compiled.project([-6.5092389, 6.5840197, -0.0033826], [-2.5008301, 3.3155086, -0.0743116])
    for method in EXPLICIT:
        found = [x[1] for x in ways(compiled, interpreted, q, v, method, 0.01).values()]
        assert np.ptp(found, axis=0).max() < 1e-13
