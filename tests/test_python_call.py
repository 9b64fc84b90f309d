"""The built-in function that reads arrays itself: what it takes, what it refuses, and that it keeps nothing."""

from __future__ import annotations

import gc
import pickle
import sys
import tracemalloc
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen import python_call as page
from mbkit.codegen.compiled import Compiled, compiled
from mbkit.codegen.python_call import FLOAT, POSITIVE, python_call

N = 5


def made(name: str, *expressions: Any, inputs: Any) -> Compiled:
    return compiled((f"test of a Python call: {name}",), lambda: ca.Function(name, inputs, [*expressions]))


@pytest.fixture(scope="module")
def call() -> Any:
    """y = sin(a) + 2 b, then z = y h, of vectors a and b and a float h; y is kept inside."""
    a, b, y, h = ca.SX.sym("a", N), ca.SX.sym("b", N), ca.SX.sym("y", N), ca.SX.sym("h")
    first, second = made("sum", ca.sin(a) + 2 * b, inputs=[a, b]), made("product", y * h, inputs=[y, h])
    steps = [(first, ["a", "b"], ["y"]), (second, ["y", "h"], ["z"])]
    return python_call(steps, {"a": N, "b": N, "h": FLOAT}, {"z": (N,)})


A, B = np.linspace(-1, 1, N), np.linspace(3, 4, N)
RIGHT = (np.sin(A) + 2 * B) * 0.5


def test_compiled_functions_run_one_after_another(call: Any) -> None:
    out = call(A, B, 0.5)
    assert type(out) is np.ndarray
    assert out.dtype == np.float64
    assert out.flags.owndata
    assert out.flags.c_contiguous
    assert out.flags.writeable
    np.testing.assert_allclose(out, RIGHT, rtol=1e-15)


def unaligned(x: np.ndarray) -> np.ndarray:
    room = np.empty(8 * N + 8, dtype=np.uint8)
    out = room[3 : 3 + 8 * N].view(np.float64)
    out[:] = x
    return out


@pytest.mark.parametrize(
    "turn",
    [
        lambda x: np.repeat(x, 3)[::3],
        lambda x: x[::-1].copy()[::-1],
        lambda x: np.asfortranarray(np.tile(x, (4, 1)))[2],
        lambda x: pickle.loads(pickle.dumps(x)),
        lambda x: np.lib.stride_tricks.as_strided(x.copy(), x.shape, x.strides, writeable=False),
    ],
)
def test_any_strides_have_the_same_bits(call: Any, turn: Any) -> None:
    np.testing.assert_array_equal(call(turn(A), turn(B), 0.5), call(A, B, 0.5))


class Subclass(np.ndarray):
    """May read its entries in another way."""


@pytest.mark.parametrize(
    "bad",
    [
        A.tolist(),
        A[:-1],
        np.append(A, 0.0),
        A[None],
        np.tile(A, (N, 1)),
        np.zeros(N, [("x", "f8"), ("flag", "i4")])["x"],
        np.array(1.0),
        np.empty(0),
        A.astype(np.float32),
        A.astype(">f8"),
        A.astype(np.complex128),
        np.arange(N),
        A.view(np.int64),
        A.view("M8[s]"),
        A.astype(object),
        np.ma.masked_array(A, A > 0),
        A.view(Subclass),
        unaligned(A),
        1.0,
        None,
        np.float64,
    ],
)
def test_other_arguments_are_refused(call: Any, bad: Any) -> None:
    assert call(bad, B, 0.5) is None
    assert call(A, bad, 0.5) is None


@pytest.mark.parametrize("bad", [1, True, np.float64(1.0), np.array([1.0]), None, "1", np.nan, np.inf])
def test_a_number_must_be_a_finite_float(call: Any, bad: Any) -> None:
    assert call(A, B, bad) is None


@pytest.mark.parametrize("arguments", [(), (A,), (A, B), (A, B, 0.5, 0.5)])
def test_the_number_of_arguments_is_checked(call: Any, arguments: tuple[Any, ...]) -> None:
    assert call(*arguments) is None


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("i", range(N))
def test_no_entry_that_is_not_finite_passes(call: Any, i: int, value: float) -> None:
    bad = A.copy()
    bad[i] = value
    assert call(bad, B, 0.5) is None
    assert call(A, bad, 0.5) is None


def test_numbers_that_overflow_between_the_functions_are_seen(call: Any) -> None:
    assert call(A, np.full(N, 1.7e308), 1e-300) is None


@pytest.mark.parametrize("size", [1 - 1e-6, 1 - 1e-12, 1.0, 1 + 1e-12, 1 + 1e-6, np.nan])
def test_quaternions_are_of_unit_length(size: float) -> None:
    q = ca.SX.sym("q", 9)
    check = python_call([(made("twice", 2 * q, inputs=[q]), ["q"], ["y"])], {"q": 9}, {"y": (9,)}, (1, 5))
    for place in (1, 5):
        x = np.array([9, 0.6, 0, 0.8, 0, 0, 0, 0, 1.0])
        x[place : place + 4] *= size
        wide = np.repeat(x, 2)[::2]
        assert (check(x) is not None) is (check(wide) is not None) is (abs(size - 1) < 1e-9)


@pytest.fixture(scope="module")
def several() -> Any:
    """2 a as (2, 3), (3, 2) and (1, 6, 1, 1), h² as a float, of a vector a of 6 and a float h above zero."""
    a, h = ca.SX.sym("a", 6), ca.SX.sym("h")
    twice, square = made("twice_six", 2 * a, inputs=[a]), made("square", h * h, inputs=[h])
    steps = [(twice, ["a"], [name]) for name in ("x", "y", "z")]
    shapes = {"x": (2, 3), "y": (3, 2), "s": (), "z": (1, 6, 1, 1)}
    return python_call([*steps, (square, ["h"], ["s"])], {"a": 6, "h": POSITIVE}, shapes)


def test_results_have_their_shapes_and_their_own_memory(several: Any) -> None:
    a = np.arange(6.0)
    x, y, s, z = several(a, 1.5)
    assert type(s) is float
    assert s == 2.25
    for out, shape in ((x, (2, 3)), (y, (3, 2)), (z, (1, 6, 1, 1))):
        np.testing.assert_array_equal(out, (2 * a).reshape(shape))
        assert not np.shares_memory(out, a)
    assert not any(np.shares_memory(x, other) for other in (y, z))
    x[:] = 7.0
    np.testing.assert_array_equal(several(a, 1.5)[0].ravel(), 2 * a)


@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, np.nan, np.inf, 1, True, np.float64(1.0)])
def test_a_positive_number_must_be_positive_and_finite(several: Any, bad: Any) -> None:
    assert several(np.arange(6.0), 5e-324) is not None
    assert several(np.arange(6.0), bad) is None


def test_a_shape_of_another_size_is_refused() -> None:
    x = ca.SX.sym("x", 3)
    code = made("squares", x * x, inputs=[x])
    for shape in ((4,), (), (1, 1, 1, 1, 3)):
        with pytest.raises(ValueError, match="3 numbers have no shape"):
            python_call([(code, ["x"], ["y"])], {"x": 3}, {"y": shape})


def test_nothing_is_kept_or_lost(call: Any, several: Any) -> None:
    q, six = A.copy(), np.arange(6.0)
    before = [sys.getrefcount(x) for x in (q, six, np.dtype(np.float64))]
    nothing = sys.getrefcount(None)
    tracemalloc.start()
    try:
        sizes = []
        for _ in range(3):
            for _ in range(300):
                call(q, B, 0.5)
                call(q, B, np.nan)
                call(q, B, None)
                call(q, B)
                several(six, 0.5)
                several(six, -0.5)
            sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert sizes[2] - sizes[1] < 1000
    assert [sys.getrefcount(x) for x in (q, six, np.dtype(np.float64))] == before
    # Counted until Python 3.12; other threads may hold it too.
    assert abs(sys.getrefcount(None) - nothing) < 300


def test_results_are_released(several: Any) -> None:
    def counts(results: Any) -> list[int]:
        return [sys.getrefcount(x) for x in (results, *results)]

    kept = several(np.arange(6.0), 0.5)
    like = (np.empty(6), np.empty(6), float("0.25"), np.empty(6))
    assert counts(kept) == counts(like)
    seen = weakref.ref(kept[0])
    del kept
    assert seen() is None


def test_the_code_lives_as_long_as_the_function() -> None:
    x = ca.SX.sym("x", 3)
    code = made("squares", x * x, inputs=[x])
    alone, seen = python_call([(code, ["x"], ["y"])], {"x": 3}, {"y": (3,)}), weakref.ref(code)
    del code
    gc.collect()
    assert seen() is not None
    assert alone(np.arange(3.0)).tolist() == [0, 1, 4]
    del alone
    gc.collect()
    assert seen() is None


def test_another_layout_of_arrays_leads_to_the_checked_way(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mb.load("ur5")
    q, v = model.random_state(np.random.default_rng(0))
    expected = mb.dynamics(model, "lagrangian", compile=True).nle(q, v)
    page._layout_is_known.cache_clear()
    monkeypatch.setattr(page, "_DATA", page._DATA + 1)
    try:
        dyn = mb.dynamics(model, "lagrangian", compile=True)
        for _ in range(2):
            np.testing.assert_array_equal(dyn.nle(q, v), expected)
        assert dyn._short["nle",].single(q, v) is None
    finally:
        monkeypatch.undo()
        page._layout_is_known.cache_clear()
    assert page._layout_is_known()


def test_threads_do_not_meet() -> None:
    model = mb.load("solo12", floating_base=True)
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    q, v = model.random_state(np.random.default_rng(1), 40)
    expected = dyn.nle(q, v)
    dyn.nle(q[0], v[0])
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(lambda i: dyn.nle(q[i % 40], v[i % 40]), range(2000)))
    finally:
        sys.setswitchinterval(interval)
    for i, x in enumerate(results):
        np.testing.assert_array_equal(x, expected[i % 40])


ASKED: dict[str, tuple[int, tuple[str, ...]]] = {
    "mass_matrix": (1, ()),
    "gravity": (1, ()),
    "kinetic_energy": (2, ()),
    "nle": (2, ()),
    "forward_dynamics": (3, ()),
    "inverse_dynamics_derivatives": (3, ()),
    "forward_dynamics_derivatives": (3, ()),
    "pose": (1, ("tool0",)),
    "jacobian": (1, ("tool0", "body")),
}


@pytest.mark.thorough("forward_dynamics_derivatives-False", "inverse_dynamics_derivatives-False")
@pytest.mark.parametrize("parametric", [False, True])
@pytest.mark.parametrize("name", ASKED)
def test_every_way_to_ask_has_the_same_bits(name: str, parametric: bool) -> None:
    model = mb.load("ur5")
    if parametric:
        model = mb.catalog.double_pendulum(mass1=mb.Parameter("m", 2.0))
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    count, frame = ASKED[name]
    if frame and parametric:
        frame = (model.bodies[-1].name, *frame[1:])
    states = np.random.default_rng(2).standard_normal((3, 4, model.nv))[:count]
    ask = getattr(dyn, name)
    first = ask(*states[:, 1].tolist(), *frame)
    batch = ask(*states, *frame)
    single = ask(*states[:, 1], *frame)
    for x, y, z in zip(*((out if isinstance(out, tuple) else (out,)) for out in (first, batch, single)), strict=True):
        assert np.shape(x) == np.shape(z) == y.shape[1:]
        np.testing.assert_array_equal(z, x)
        np.testing.assert_array_equal(z, y[1])
    for bad in (np.nan, np.inf):
        states[-1, 1, -1] = bad
        with pytest.raises(mb.errors.InputError, match="expected finite numbers"):
            ask(*states[:, 1], *frame)


def test_frames_that_are_not_there_are_named() -> None:
    dyn = mb.dynamics(mb.load("ur5"), "lagrangian", compile=True)
    q = np.zeros(6)
    for _ in range(2):
        dyn.pose(q, "tool0")
        dyn.jacobian(q, "tool0")
    with pytest.raises(mb.errors.UnknownNameError, match="did you mean 'tool0'"):
        dyn.pose(q, "tool")
    with pytest.raises(mb.errors.InputError, match="axes: expected one of 'local'"):
        dyn.jacobian(q, "tool0", "tool0")


@pytest.mark.parametrize("name", ["mass_matrix", "gravity", "nle", "forward_dynamics", "kinetic_energy"])
def test_results_share_no_memory(name: str) -> None:
    model = mb.load("ur5")
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    states = np.random.default_rng(2).standard_normal((3, 6))
    arguments = states[: {"mass_matrix": 1, "gravity": 1, "forward_dynamics": 3}.get(name, 2)]
    held = states.copy()
    first = getattr(dyn, name)(*arguments)
    kept = np.array(first)
    for _ in range(3):
        other = getattr(dyn, name)(*arguments)
        if np.ndim(other):
            assert not any(np.shares_memory(other, x) for x in (first, states))
            other[:] = 7.0
    np.testing.assert_array_equal(first, kept)
    np.testing.assert_array_equal(states, held)
