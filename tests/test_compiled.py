"""Machine code: the same numbers as the expressions, whatever the arrays and threads."""

from __future__ import annotations

import gc
import multiprocessing
import os
import platform
import resource
import stat
import subprocess
import sys
import threading
import time
import warnings
import weakref
from collections import Counter
from functools import cache
from pathlib import Path

import casadi as ca
import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import mbkit as mb
from mbkit import _process as _interrupt
from mbkit.codegen import backend, disk_cache, jit, simd_kernel
from mbkit.codegen.backend import Machine
from mbkit.codegen.compiled import Call, Compiled, KernelSequence, _runner, compiled
from mbkit.codegen.program import Program, program
from mbkit.codegen.python_call import python_call
from mbkit.errors import InputError
from tests.random_trees import random_tree, states
from validation.memory import allocated

EPS = np.finfo(float).eps


def built(function: ca.Function) -> Compiled:
    """Return machine code that no cache has seen."""
    derived = program(function)
    code, work = jit.program_object(derived)
    about = {"inputs": derived.inputs, "shapes": derived.shapes, "operations": derived.arithmetic, "work": work}
    return Compiled(about, code)


def sines() -> ca.Function:
    x = ca.SX.sym("x")
    return ca.Function("sines", [x], [ca.vertcat(ca.sin(x), ca.cos(x))])


def mixed() -> ca.Function:
    """A function of every operation, with two arguments, a matrix and a vector, and an entry that nothing reads."""
    x, y = ca.SX.sym("x", 9), ca.SX.sym("y", 3)
    a = ca.sin(x[0]) * y[0] + ca.cos(x[0]) / (2.0 + x[1] ** 2) - ca.sqrt(1.0 + y[1] * y[1])
    less = x[2] < y[2]
    yes = ca.SX.binary(ca.OP_IF_ELSE_ZERO, less, 2 * x[3])
    b = yes + ca.SX.binary(ca.OP_IF_ELSE_ZERO, 1 - less, -1 / (3.0 + x[4] ** 2))
    c = ca.horzcat(a, b, x[5] * y[0] + x[6] * y[1], x[7], 0.0, 4.5)
    return ca.Function("mixed", [x, y], [ca.densify(ca.reshape(c, 2, 3)), ca.vertcat(a * b, a + b, b)])


@pytest.fixture(scope="module")
def code() -> Compiled:
    return built(mixed())


@pytest.mark.thorough("far multiples", "multiples")
@pytest.mark.parametrize(
    "angles",
    [
        lambda rng: rng.uniform(-np.pi, np.pi, 3000),
        lambda rng: rng.uniform(-1e8, 1e8, 3000),
        lambda rng: 10.0 ** rng.uniform(-300, -1, 1000),
        lambda _: np.arange(1, 2000) * (np.pi / 2),
        lambda rng: rng.integers(-60_000_000, 60_000_000, 3000) * (np.pi / 2),
        lambda rng: rng.uniform(-1, 1, 500) * 10.0 ** rng.uniform(8, 300, 500),
        lambda rng: rng.integers(1, 2**50, 500) * (np.pi / 2) * 2.0 ** rng.integers(0, 900, 500),
        # The double nearest to a multiple of π/2 (Muller et al. 2018, section 10.2), the largest one, both ends.
        lambda _: np.array([6381956970095103 * 2.0**797, np.finfo(float).max, 1e8, np.nextafter(1e8, 2e8), -1e8, -0.0]),
    ],
    ids=["turn", "many turns", "tiny", "multiples", "far multiples", "beyond", "multiples beyond", "edges"],
)
def test_sine_and_cosine_are_right_to_three_quarters_of_an_ulp(angles):
    x = angles(np.random.default_rng(0))
    out = built(sines())(x[:, None])[0][..., 0]
    with mpmath.workprec(1200):
        for angle, pair in zip(x, out, strict=True):
            for got, exact in zip(pair, reversed(mpmath.cos_sin(angle)), strict=True):
                assert abs(mpmath.mpf(float(got)) - exact) <= 0.76 * np.spacing(abs(float(exact)))


def layouts(x: np.ndarray) -> dict[str, np.ndarray]:
    """Return the same numbers in memory in many ways."""
    n, k = x.shape
    wide = np.empty((2 * n, 3 * k))
    wide[::2, ::3] = x
    back = x[::-1].copy()[::-1]
    frozen = x.copy()
    frozen.setflags(write=False)
    odd = np.frombuffer(b"x" + x.tobytes(), dtype=np.uint8)[1:].view(np.float64).reshape(x.shape)
    return {
        "rows": x,
        "coordinate-major": np.asfortranarray(x),
        "every other": wide[::2, ::3],
        "backwards": back,
        "read-only": frozen,
        "not aligned": odd,
        "big-endian": x.astype(">f8"),
    }


@pytest.mark.parametrize("n", [0, 1, 2, 7, 8, 9, 31, 1033])
def test_every_layout_gives_the_same_bits(code, n):
    rng = np.random.default_rng(n)
    x, y = rng.standard_normal((n, 9)), rng.standard_normal((n, 3))
    expected = code(x, y)
    for (told, a), b in zip(layouts(x).items(), reversed(layouts(y).values()), strict=True):
        for got, want in zip(code(a, b), expected, strict=True):
            assert got.shape == want.shape, told
            np.testing.assert_array_equal(got, want, err_msg=told)
    for i in range(min(n, 20)):
        for got, want in zip(code(x[i], y[i]), expected, strict=True):
            np.testing.assert_array_equal(got, want[i])


@settings(max_examples=40)
@given(st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12))
def test_every_operation_agrees_with_casadi(code, numbers):
    given_ = np.array(numbers)
    for got, want in zip(code(given_[:9], given_[9:]), mixed()(given_[:9], given_[9:]), strict=True):
        # Contraction rounds once where CasADi rounds twice.
        scale = 4 * EPS * (1 + np.abs(given_).max() ** 2)
        np.testing.assert_allclose(got, np.array(want), rtol=0, atol=scale)


def test_a_program_in_pieces_gives_the_same_numbers_as_a_whole(monkeypatch):
    model = random_tree(3, 4)
    function = mb.dynamics(model, "lagrangian", compile=False).function("forward_dynamics")
    q, v, _, tau = states(model, 17)
    whole = built(function)(q, v, tau)[0]
    monkeypatch.setattr(simd_kernel, "_MAX_WHOLE_OPERATIONS", 100)
    monkeypatch.setattr(simd_kernel, "_PIECE_OPERATIONS", 150)
    pieces = built(function)(q, v, tau)[0]
    np.testing.assert_allclose(pieces, whole, rtol=0, atol=1e3 * EPS * np.abs(whole).max())


@pytest.mark.parametrize("place", [(0, 8), (0, 0), (1, 2)])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_found_even_if_nothing_reads_it(code, place, bad):
    rng = np.random.default_rng(2)
    for n in (1, 3, 40):
        for turn in (np.ascontiguousarray, np.asfortranarray):
            arrays = [turn(rng.standard_normal((n, k))) for k in (9, 3)]
            assert code.call_checked(*arrays)[1]
            arrays[place[0]][n - 1, place[1]] = bad
            assert not code.call_checked(*arrays)[1]


def test_threads_give_the_same_bits_as_one(code):
    rng = np.random.default_rng(3)
    x, y = rng.standard_normal((300_001, 9)), rng.standard_normal((300_001, 3))
    one = code(x, y, threads=1)
    for threads in (2, 3):
        for got, want in zip(code(x, y, threads=threads), one, strict=True):
            np.testing.assert_array_equal(got, want)
    many: list[list[np.ndarray]] = []
    callers = [threading.Thread(target=lambda: many.append(code(x, y, threads=2))) for _ in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert len(many) == 4
    for results in many:
        np.testing.assert_array_equal(results[0], one[0])


@pytest.mark.thorough
def test_memory_stays_flat_over_thousands_of_batches():
    model = mb.catalog.double_pendulum()
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    q, v, a, _ = states(model, 64)

    def calls(n: int) -> int:
        for _ in range(n):
            dyn.inverse_dynamics(q, v, a)
            dyn.forward_dynamics(q, v, a)
        gc.collect()
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    before = calls(500)
    assert calls(4_000) - before < 2000  # kB; a leak of one result of 1 kB a call would be 8,000


def times(k: int) -> ca.Function:
    """Return a function that differs from that of every other `k`."""
    x = ca.SX.sym("x")
    return ca.Function("times", [x], [ca.sin(x) * (k + 0.5)])


@pytest.mark.thorough
def test_compiling_leaves_no_memory_behind(monkeypatch):
    """`validation/memory.py` measures each stage over 2,000 models; here one pass builder a function would show."""
    monkeypatch.setenv("MBKIT_CACHE_DIR", "")
    if allocated() is None:
        pytest.skip("no mallinfo2 in this C library")

    def use(first: int, n: int) -> float:
        for k in range(first, first + n):
            code = compiled(("times", str(k)), lambda k=k: times(k))
            np.testing.assert_allclose(code(np.array([0.3]))[0], np.sin(0.3) * (k + 0.5))
        return allocated()

    before = use(0, 20)
    assert use(20, 80) - before < 80 * 0.5  # kB; a pass builder alone leaves 1.5 kB for each


@pytest.mark.thorough
def test_machine_code_lives_as_long_as_a_call_of_it(monkeypatch):
    monkeypatch.setenv("MBKIT_CACHE_DIR", "")
    x, out = np.array([[0.3]]), np.empty((12, 1, 1))
    codes = [compiled(("times", str(k)), lambda k=k: times(k)) for k in range(12)]
    calls = [python_call([(code, ["x"], ["y"])], {"x": 1}, {"y": (1,)}) for code in codes]
    sequence = KernelSequence([Call(code, [x], [y]) for code, y in zip(codes, out, strict=True)])
    engines = [weakref.ref(code.loaded._engine) for code in codes]
    del codes
    gc.collect()
    # What is compiled meanwhile would take the place of code that was released.
    built(mixed())
    ones = [call(x[0]) for call in calls]
    np.testing.assert_allclose(np.ravel(ones), np.sin(0.3) * (np.arange(12) + 0.5))
    out[:] = np.nan
    sequence.run(0, 12)
    np.testing.assert_allclose(out.ravel(), np.sin(0.3) * (np.arange(12) + 0.5))
    del calls, sequence
    gc.collect()
    assert [engine() for engine in engines] == [None] * 12


def test_calls_move_from_round_to_round_and_go_on_where_they_ended():
    x, y = ca.SX.sym("x"), ca.SX.sym("y", 2)
    turn, add = built(ca.Function("turn", [x, y], [ca.sin(x) + y])), built(ca.Function("add", [y, x], [ca.sum1(y) - x]))
    path, between, given = np.zeros((9, 1, 3)), np.zeros((2, 3)), np.arange(54.0).reshape(9, 2, 3)
    path[0] = 0.1, 0.2, 0.3
    step = path.strides[0]
    sequence = KernelSequence(
        [
            Call(turn, [path[0].T, given[0].T], [between.T], [step, given.strides[0], 0]),
            Call(add, [between.T, path[0].T], [path[1].T], [0, step, step]),
        ]
    )
    for first, last in ((0, 5), (5, 6), (6, 6), (6, 16)):
        sequence.run(first, last)
    for k in range(8):
        one = np.sum(np.sin(path[k]) + given[k], axis=0) - path[k, 0]
        np.testing.assert_allclose(path[k + 1, 0], one, rtol=4 * EPS)


@pytest.mark.thorough("rk853", "rodas5", "implicit_midpoint", "taylor")
@pytest.mark.parametrize("method", ["rk4", "rk853", "rodas5", "implicit_midpoint", "taylor"])
def test_equations_are_released_after_a_run(method):
    if method == "taylor":
        pytest.importorskip("heyoka")
    dyn = mb.dynamics(mb.catalog.pendulum(), "lagrangian", compile=True)
    released = weakref.ref(dyn.equations)
    step = {"dt": 0.01} if method in ("rk4", "implicit_midpoint") else {}
    mb.simulate(dyn, [0.3], [0.0], 0.02, method=method, **step)
    del dyn
    gc.collect()
    assert released() is None


def test_the_short_way_says_what_is_wrong_as_the_long_one_does():
    model = mb.load("ur5")
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    q, v, a, _ = states(model, 5)
    expected = dyn.inverse_dynamics(q, v, a)
    np.testing.assert_array_equal(dyn.inverse_dynamics(q[0].tolist(), v[0].tolist(), a[0].tolist()), expected[0])
    np.testing.assert_array_equal(dyn.inverse_dynamics(q=q, v=v, a=a[:1].repeat(5, 0))[0], expected[0])
    np.testing.assert_array_equal(dyn.inverse_dynamics(q[0], v, a)[0], expected[0])
    rounded = [x.astype(np.float32) for x in (q, v, a)]
    exact = dyn.inverse_dynamics(*(x.astype(np.float64) for x in rounded))
    np.testing.assert_array_equal(dyn.inverse_dynamics(*rounded), exact)
    assert dyn.inverse_dynamics(q[:0], v[:0], a[:0]).shape == (0, 6)
    for bad, told in (
        ((q[:, :5], v, a), "q: expected shape"),
        ((q, v[:3], a), "batches of different sizes"),
        ((q[0, :5], v[0], a[0]), "q: expected shape"),
        ((q, v, "x"), "a: "),
    ):
        with pytest.raises(mb.errors.InputError, match=told):
            dyn.inverse_dynamics(*bad)
    for place in (0, 1, 2):
        given_ = [x.copy() for x in (q, v, a)]
        given_[place][4, 0] = np.nan
        with pytest.raises(mb.errors.InputError, match="expected finite"):
            dyn.inverse_dynamics(*given_)
        with pytest.raises(mb.errors.InputError, match="expected finite"):
            dyn.inverse_dynamics(*(x[4] for x in given_))
    # q of the first joint turns about gravity: nothing reads it.
    blind = q[0].copy()
    blind[0] = np.nan
    with pytest.raises(mb.errors.InputError, match="q: nan at index"):
        dyn.gravity(blind)


def test_without_a_compiler_the_same_numbers_come_and_one_warning(monkeypatch):
    model = mb.load("ur5")
    q, v, a, _ = states(model, 3)
    expected = mb.dynamics(model, "lagrangian", compile=True).inverse_dynamics(q, v, a)
    monkeypatch.setattr(backend.importlib.util, "find_spec", lambda _: None)
    backend.has_compiler.cache_clear()
    try:
        dyn = mb.dynamics(model, "lagrangian", compile=True)
        with pytest.warns(mb.errors.NoCompilerWarning, match="pip install llvmlite"):
            got = dyn.inverse_dynamics(q, v, a)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            mb.dynamics(model, "lagrangian", compile=True).nle(q, v)
    finally:
        backend.has_compiler.cache_clear()
    assert isinstance(dyn._code("inverse_dynamics"), Machine)
    np.testing.assert_allclose(got, expected, rtol=0, atol=50 * EPS * np.abs(expected).max())


def test_options_are_checked_and_kept():
    model = mb.catalog.pendulum()
    with pytest.raises(mb.errors.InputError, match="threads: expected a whole number"):
        mb.dynamics(model, "lagrangian", threads=0)
    with pytest.raises(mb.errors.InputError, match="compile: expected True"):
        mb.dynamics(model, "lagrangian", compile=1)
    with pytest.raises(mb.errors.InputError, match="threads: pinocchio has no such option"):
        mb.dynamics(model, "pinocchio", threads=2)
    import pickle

    dyn = pickle.loads(pickle.dumps(mb.dynamics(model, "lagrangian", compile=True, threads=1)))
    assert dyn.compile is True
    assert dyn.threads == 1


@cache
def _sums() -> ca.Function:
    x = ca.SX.sym("x", 40)
    return ca.Function("sums", [x], [ca.densify(ca.sin(x) * ca.cumsum(x))])


def _compile_anew() -> None:
    # CasADi has locks of its own, which a fork during a call of somebody else's may leave held; mbkit's calls wait.
    built(_sums())


@pytest.mark.thorough("compiling", "compiled", "mujoco", "mujoco's text", "drake's reading")
@pytest.mark.parametrize(
    "work", ["compiling", "compiled", "interpreted", "mujoco", "drake", "mujoco's text", "drake's reading"]
)
def test_a_child_forked_during_another_threads_work_computes(work):
    if "fork" not in multiprocessing.get_all_start_methods():
        pytest.skip("this system does not fork")
    model = mb.load("panda")
    if "mujoco" in work or "drake" in work:
        pytest.importorskip("pydrake" if "drake" in work else "mujoco")
    if work in ("mujoco", "drake"):
        dyn = mb.dynamics(model, work)
    elif work == "mujoco's text":
        from mbkit.engines.mujoco.mjcf_writer import mjcf_text, read_back

        dyn = read_back(model, mjcf_text(model, ""))
    elif work == "drake's reading":
        from mbkit.engines.drake import importer

        dyn = importer.read(mb.convert(mb.catalog.double_pendulum(), "urdf").text, "urdf").terms.__self__
        model = dyn.model
    else:
        dyn = mb.dynamics(model, "lagrangian", compile=work != "interpreted")
    q, v, _, _ = states(model, 1)
    expected = dyn.nle(q[0], v[0])
    _sums()
    done = threading.Event()

    def calls() -> None:
        while not done.is_set():
            _compile_anew() if work == "compiling" else dyn.nle(q, v)

    def compute() -> None:
        if work == "compiling":
            _compile_anew()
        np.testing.assert_array_equal(dyn.nle(q[0], v[0]), expected)

    other = threading.Thread(target=calls)
    other.start()
    context = multiprocessing.get_context("fork")
    try:
        for _ in range(4):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                child = context.Process(target=compute)
                child.start()
            child.join(30)
            if child.exitcode is None:
                child.kill()
            assert child.exitcode == 0
    finally:
        done.set()
        other.join()


def test_a_folder_of_other_files_is_neither_closed_nor_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("MBKIT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(disk_cache, "_MAX_CACHE_BYTES", 1000)
    mine = tmp_path / "thesis.dat"
    mine.write_bytes(b"x" * 3000)
    os.utime(mine, (1, 1))
    tmp_path.chmod(0o755)
    disk_cache.write("a" * 64, {}, b"code")
    assert stat.S_IMODE(tmp_path.stat().st_mode) == 0o755
    assert list(tmp_path.iterdir()) == [mine]
    tmp_path.chmod(0o700)
    disk_cache.write("a" * 64, {}, b"code")
    disk_cache.write("b" * 64, {}, b"x" * 2000)
    assert mine.exists()
    assert disk_cache.read("a" * 64) is None


def test_a_user_without_a_home_has_no_cache(monkeypatch):
    def homeless(_: str) -> Path:
        raise RuntimeError("could not determine the home directory")

    monkeypatch.delenv("MBKIT_CACHE_DIR")
    monkeypatch.setattr(disk_cache, "user_cache_path", homeless)
    assert disk_cache.folder() is None
    assert disk_cache.read("a" * 64) is None


def test_more_arrays_than_the_loop_has_room_for_are_refused():
    for n in (16, 17):
        x = [ca.SX.sym(f"x{k}") for k in range(n)]
        function = ca.Function("sum", x, [sum(x)])
        if n > 16:
            with pytest.raises(ValueError, match="at most 16 arguments"):
                built(function)
        else:
            assert built(function)(*[np.ones((20, 1))] * n)[0][19, 0, 0] == n


# A level that many processors share


@pytest.mark.thorough
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="levels are those of x86-64")
def test_code_for_any_x86_64_has_the_same_numbers() -> None:
    """In a process of its own: a process has one level."""
    code = """
import numpy as np, mbkit as mb
from mbkit.codegen import jit
from tests.random_trees import random_tree
model = random_tree(4, n=4, kinds=("free", "ball", "revolute", "helical"))
q, v = model.random_state(0, 9)
a, b = (mb.dynamics(model, "lagrangian", compile=x).forward_dynamics(q, v, 0 * v) for x in (True, False))
print(jit.host().cpu, jit.host().width, np.abs(a - b).max() / np.abs(b).max())
"""
    env = {**os.environ, "MBKIT_CPU": "x86-64"}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    level, width, apart = done.stdout.split()
    assert (level, width) == ("x86-64", "2")
    # Code without FMA differs from this processor's own in the last bits alone.
    assert float(apart) < 1e3 * EPS


@pytest.mark.thorough
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="levels are those of x86-64")
def test_processors_that_fuse_have_the_same_bits() -> None:
    """Whatever the width of their registers: which products are fused is decided before any compiler sees them."""
    code = """
import hashlib, numpy as np, mbkit as mb
from tests.random_trees import random_tree
model = random_tree(4, n=2, kinds=("ball", "helical"))
dyn = mb.dynamics(model, "lagrangian", compile=True)
q, v = model.random_state(0, 9)
q[3:, 0] *= 1e12
numbers = dyn.forward_dynamics(q, v, v), *dyn.step(q, 0.1 * v, v, 1e-3)
bits = hashlib.sha256(b"".join(x.tobytes() for x in numbers)).hexdigest()
print(bits)
"""
    if not jit.host().fma:
        pytest.skip("this processor has no fused multiply-add")
    own: dict[str, str] = {}
    exec(code, own)
    found = {"here": own["bits"]}
    for level in ("x86-64-v4", "x86-64-v3"):
        env = {**os.environ, "MBKIT_CPU": level}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=False)
        if "expected a level that this processor has" not in done.stderr:
            found[level] = done.stdout.strip()
    assert len({*found.values()}) == 1, found


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_a_fused_program_has_fewer_operations_and_the_same_numbers(seed: int) -> None:
    """Sums of products of whole numbers are exact, with one rounding or two."""
    rng = np.random.default_rng(seed)
    x = ca.SX.sym("x", 6)
    known = [*ca.vertsplit(x), ca.SX(3.0)]
    for _ in range(30):
        a, b = (known[i] for i in rng.integers(7, size=2))
        c = known[rng.integers(len(known))]
        known.append([a * b + c, c - a * b, a * a - c, a + b, a * b][rng.integers(5)])
    made = program(ca.Function("f", [x], [ca.densify(ca.vertcat(*known[-12:]))], {"cse": False}).expand())
    fused = made.fused
    whole = rng.integers(-4, 5, 6).astype(float)
    exact, found = run_program(made, whole), run_program(fused, whole)
    assert found == exact
    products = sum(o.name in ("fma", "fms", "fnma") for o in fused.operations)
    assert len(fused.operations) == len(made.operations) - products
    # No product that is left is read by one sum alone.
    read = Counter(j for o in fused.operations if o.name != "input" for j in o.arguments)
    read.update(k for out in fused.outputs for k in out.ravel().tolist())
    for o in fused.operations:
        if o.name in ("add", "sub"):
            assert all(fused.operations[j].name not in ("mul", "sq") or read[j] > 1 for j in o.arguments)


def run_program(made: Program, x: np.ndarray) -> list[float]:
    """Return what a program gives, in Python's own numbers."""
    do = {
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "fma": lambda a, b, c: a * b + c,
        "fms": lambda a, b, c: a * b - c,
        "fnma": lambda a, b, c: c - a * b,
        "sq": lambda a: a * a,
        "twice": lambda a: 2 * a,
        "neg": lambda a: -a,
    }
    values: list[float] = []
    for o in made.operations:
        if o.name == "input":
            values.append(float(x[o.arguments[1]]))
        else:
            values.append(o.value if o.name == "const" else do[o.name](*(values[j] for j in o.arguments)))
    return [values[k] for out in made.outputs for k in out.ravel().tolist()]


def test_levels_that_are_none_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"MBKIT_CPU: expected a level that this processor has, .*, got 'x86-64-v9'"):
        jit.host_of("x86-64-v9")
    monkeypatch.setattr(jit, "LEVELS", {**jit.LEVELS, "x86-64-v9": (frozenset({"no such feature"}), 8)})
    with pytest.raises(InputError, match="MBKIT_CPU: expected a level that this processor has"):
        jit.host_of("x86-64-v9")


def test_a_fork_waits_for_locks_that_a_thread_takes_in_any_order():
    older, newer = (_interrupt.fork_safe(threading.RLock()) for _ in range(2))
    done, begun = threading.Event(), threading.Event()

    def work():
        while not done.is_set():
            for one, other in ((newer, older), (older, newer)):
                with one:
                    begun.set()
                    time.sleep(1e-3)
                    with other:
                        pass
                time.sleep(1e-4)

    def forks():
        begun.wait()
        for _ in range(10):
            _interrupt._take()
            _interrupt._release()
        done.set()

    threads = [threading.Thread(target=target, daemon=True) for target in (work, forks)]
    for thread in threads:
        thread.start()
    assert done.wait(timeout=60)


def test_a_fork_gets_its_turn_between_threads_that_are_always_busy():
    """Each holds a lock of its own nearly all the time."""
    done = threading.Event()

    def work():
        own = _interrupt.fork_safe(threading.RLock())
        while not done.is_set():
            with own:
                time.sleep(5e-3)
            time.sleep(1e-4)

    def forks():
        for _ in range(5):
            _interrupt._take()
            _interrupt._release()
        done.set()

    for target in (work, work, work, forks):
        threading.Thread(target=target, daemon=True).start()
    assert done.wait(timeout=60)


def test_a_sequence_keeps_the_code_that_it_runs():
    """Threads that meet an empty cache each load code, and the cache keeps that of one."""
    _runner.cache_clear()
    code = weakref.ref(_runner())
    sequence = KernelSequence([])
    _runner.cache_clear()
    gc.collect()
    assert code() is not None
    del sequence
    gc.collect()
    assert code() is None
