"""The GPU's programs, on a driver that runs them on the CPU: the calls, the arrays, and every bit.

What a real GPU adds, `python -m validation.gpu` looks at.
"""

from __future__ import annotations

import gc
import pickle
import shutil
import sys
from types import ModuleType
from typing import Any

import casadi as ca
import numpy as np
import pytest

import mbkit as mb
from mbkit.codegen import backend, jit, simd_kernel
from mbkit.codegen.cuda import arrays, driver, runs
from mbkit.codegen.cuda.arrays import DeviceArray
from mbkit.codegen.cuda.kernels import kernel_code, steps_code
from mbkit.codegen.program import program
from mbkit.derivation import equations_of
from mbkit.derivation.steps.fixed import STATE, march_in_stages
from mbkit.errors import DeviceError, InputError, UnknownNameError, UnsupportedError
from mbkit.simulate.solvers import compiled_fixed_step
from tests.fake_cuda import FakeDriver, fake  # noqa: F401  # a fixture
from tests.random_trees import off, random_tree
from tests.test_saturation import crane
from validation import gpu as study

pytestmark = [
    pytest.mark.usefixtures("fake"),
    pytest.mark.skipif(not jit.host().fma, reason="without fused multiply-adds the CPU has other bits than a GPU"),
]


def both(model: mb.Model, **values: Any) -> tuple[Any, Any]:
    """Return the same dynamics on the CPU and on the GPU."""
    return tuple(mb.dynamics(model, "lagrangian", compile=True, device=x).at(**values) for x in (None, "cuda"))


def on_gpu(x: np.ndarray, *, major: bool = False) -> DeviceArray:
    return study.on_device(x, major=major)


def small_arm() -> mb.Model:
    return random_tree(22, 3, ("revolute",))


def varied_arm() -> mb.Model:
    """Return two links whose masses and dampers are parameters."""
    return mb.catalog.double_pendulum(mass1=mb.Parameter("m1", 1.0), mass2=mb.Parameter("m2", 2.0))


MODELS = {
    "a tree of every joint": lambda: random_tree(3, 6),
    "a floating tree": lambda: random_tree(5, 3, ("free", "revolute", "ball")),
    "panda": lambda: mb.load("panda"),
    "a loop": mb.catalog.four_bar,
}


@pytest.mark.thorough("a floating tree")
@pytest.mark.parametrize("name", [name for name in MODELS if name != "panda"])
def test_every_quantity_has_the_bits_of_the_cpu(name: str) -> None:
    model = MODELS[name]()
    cpu, gpu = both(model)
    given = study.states(model, 21)
    if model.constrained:
        given["q"], given["v"] = cpu.project(given["q"], given["v"])
    for quantity, arguments in study.QUANTITIES.items():
        if "derivatives" in quantity and name != "a loop":
            continue
        if name == "a tree of every joint" and quantity not in ("mass_matrix", "nle", "potential_energy"):
            continue
        own = [given[x] for x in arguments]
        want = study._parts(getattr(cpu, quantity)(*own))
        for layout in (np.ascontiguousarray, np.asfortranarray, lambda x: on_gpu(x), lambda x: on_gpu(x, major=True)):
            found = study._parts(getattr(gpu, quantity)(*map(layout, own)))
            assert len(found) == len(want)
            assert all(np.array_equal(a, b) for a, b in zip(found, want, strict=True)), (quantity, layout)


def test_one_state_runs_on_the_cpu(fake: FakeDriver) -> None:  # noqa: F811
    model = small_arm()
    cpu, dyn = both(model)
    q, v, a = (x[0] for x in study.states(model, 1).values())
    fake.calls.clear()
    assert np.array_equal(dyn.forward_dynamics(q, v, a), cpu.forward_dynamics(q, v, a))
    assert "cuLaunchKernel" not in fake.calls


def test_an_array_of_one_state_on_the_gpu_gives_one_of_its_shape() -> None:
    model = small_arm()
    cpu, gpu = both(model)
    q, v, a = (x[0] for x in study.states(model, 1).values())
    out = gpu.forward_dynamics(on_gpu(q[None])[0], v, a)
    assert out.shape == (3,)
    assert np.array_equal(out.numpy(), cpu.forward_dynamics(q[None], v[None], a[None])[0])


def test_a_program_in_pieces_has_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    model = small_arm()
    cpu, gpu = both(model)
    q, v, a = study.states(model, 9).values()
    want = cpu.forward_dynamics(q, v, a)
    monkeypatch.setattr(simd_kernel, "_MAX_WHOLE_OPERATIONS", 300)
    monkeypatch.setattr(simd_kernel, "_PIECE_OPERATIONS", 200)
    assert np.array_equal(gpu.forward_dynamics(q, v, a), want)


def without_reruns(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the GPU loses would be run again on the CPU, and be right."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("the CPU runs it again")

    monkeypatch.setattr(compiled_fixed_step, "Chunk", refuse)


TORQUES = {
    "none": lambda _model, _n, _steps: None,
    "constant": lambda model, _n, _steps: np.linspace(-1, 1, model.nv),
    "each step's": lambda model, _n, steps: np.random.default_rng(1).normal(size=(steps, model.nv)),
    "each step's of each run": lambda model, n, steps: np.random.default_rng(2).normal(size=(n, steps, model.nv)),
    "feedback": lambda model, _n, _steps: mb.simulate.StateFeedback(
        np.random.default_rng(3).normal(size=(model.nv, model.nq + model.nv)), torque=np.ones(model.nv)
    ),
}


@pytest.mark.thorough("panda-rk4-each step's of each run")
@pytest.mark.parametrize(
    ("name", "method", "torque"),
    [("a floating tree", "semi_implicit_euler", "constant"), ("panda", "rk4", "each step's of each run")],
)
def test_runs_have_the_bits_of_the_cpu(name: str, method: str, torque: str, monkeypatch: pytest.MonkeyPatch) -> None:
    model, n, steps = MODELS[name](), 7, 21
    cpu, gpu = both(model)
    q, v, _ = study.states(model, n).values()
    tau = TORQUES[torque](model, n, steps)
    # The last step is shorter.
    run = {"duration": 0.0205, "dt": 1e-3, "save": 8, "torque": tau, "doubt": False, "method": method}
    want = mb.simulate(cpu, q, 0.1 * v, **run)
    assert np.isfinite(want.q).all()
    without_reruns(monkeypatch)
    found = mb.simulate(gpu, q, 0.1 * v, **run)
    assert np.array_equal(found.q, want.q)
    assert np.array_equal(found.v, want.v)
    assert np.array_equal(found.t, want.t)


def test_a_feedback_within_effort_limits_has_the_bits_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    cpu, gpu = both(crane())
    q, v = np.random.default_rng(4).normal(size=(2, 7, 2))
    run: dict[str, Any] = {"duration": 0.02, "dt": 1e-3, "save": 8, "saturate": True, "doubt": False}
    run["torque"] = mb.simulate.StateFeedback(np.hstack([3 * np.eye(2), np.eye(2)]))
    want = mb.simulate(cpu, q, v, **run)
    without_reruns(monkeypatch)
    found = mb.simulate(gpu, q, v, **run)
    assert np.array_equal(found.v, want.v)
    assert found.stats.saturated == want.stats.saturated
    assert 0 < want.stats.saturated[0].fraction < 1


def test_a_step_in_stages_is_the_same_to_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    """The forward dynamics is then a function, which is called for each stage."""
    monkeypatch.setattr(runs, "MAX_STEP_OPERATIONS", 0)
    # A model of its own: steps are kept with the equations.
    model = random_tree(21, 2, ("free", "revolute"))
    cpu, gpu = both(model)
    q, v, _ = study.states(model, 5).values()
    run = {"duration": 0.02, "dt": 1e-3, "save": 20, "doubt": False, "method": "rk4"}
    for torque in ("each step's of each run", "feedback"):
        tau = TORQUES[torque](model, 5, 20)
        want = mb.simulate(cpu, q, 0.1 * v, torque=tau, **run)
        with monkeypatch.context() as alone:
            without_reruns(alone)
            found = mb.simulate(gpu, q, 0.1 * v, torque=tau, **run)
        assert off(found.q, want.q) < 1e-13
        assert off(found.v, want.v) < 1e-12


def test_runs_of_a_loop_have_the_bits_of_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    model = mb.catalog.four_bar()
    cpu, gpu = both(model)
    q, v = cpu.project(*model.random_state(0))
    start = np.tile(q, (3, 1)), np.outer([0.5, 1.0, 2.0], v)
    run = {"duration": 0.02, "dt": 1e-3, "save": 5, "method": "rk4", "doubt": False}
    want = mb.simulate(cpu, *start, **run)
    without_reruns(monkeypatch)
    found = mb.simulate(gpu, *start, **run)
    assert np.array_equal(found.q, want.q)


def test_each_sample_may_have_parameters_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    n = 11
    values = {"m1": np.linspace(0.5, 2, n), "m2": np.linspace(3, 1, n)}
    cpu, gpu = both(varied_arm(), **values)
    q, v, a = study.states(varied_arm(), n).values()
    want = cpu.forward_dynamics(q, v, a)
    assert np.array_equal(gpu.forward_dynamics(q, v, a), want)
    assert np.array_equal(gpu.forward_dynamics(on_gpu(q), on_gpu(v), on_gpu(a)).numpy(), want)
    # One value for all is one number on the GPU.
    assert np.array_equal(*(d.at(m1=1.5, m2=2.0).forward_dynamics(q, v, a) for d in (cpu, gpu)))
    run = {"duration": 0.01, "dt": 1e-3, "save": 10, "method": "rk4", "doubt": False}
    want = mb.simulate(cpu, q, v, **run)
    without_reruns(monkeypatch)
    assert np.array_equal(mb.simulate(gpu, q, v, **run).q, want.q)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("where", [np.asarray, on_gpu])
def test_numbers_that_are_not_finite_are_named(bad: float, where: Any) -> None:
    model = small_arm()
    _, gpu = both(model)
    q, v, a = study.states(model, 5).values()
    v[3, 1] = bad
    with pytest.raises(InputError, match=r"v: (nan|inf) at index \(3, 1\)"):
        gpu.forward_dynamics(where(q), where(v), where(a))


def test_a_quaternion_that_is_not_of_unit_length_is_named() -> None:
    model = random_tree(5, 3, ("free", "revolute", "ball"))
    cpu, gpu = both(model)
    q, v, a = study.states(model, 5).values()
    start, _ = model.quaternions[-1]
    q[4, start : start + 4] *= 1.01
    for d, given in ((cpu, (q, v, a)), (gpu, (q, v, a)), (gpu, map(on_gpu, (q, v, a)))):
        with pytest.raises(InputError, match="quaternion"):
            d.forward_dynamics(*given)


def test_arrays_of_a_wrong_shape_or_type_are_refused() -> None:
    model = small_arm()
    _, gpu = both(model)
    q, v, a = study.states(model, 5).values()
    with pytest.raises(InputError, match=r"v: expected shape \(3,\) or \(5, 3\), got \(4, 3\)"):
        gpu.forward_dynamics(on_gpu(q), on_gpu(v[:4]), a)

    class Single(Foreign):
        @property
        def __cuda_array_interface__(self) -> dict[str, Any]:
            return super().__cuda_array_interface__ | {"typestr": "<f4"}

    with pytest.raises(InputError, match="q: expected float64 on the GPU of the dynamics, got <f4"):
        gpu.forward_dynamics(Single(on_gpu(q)), v, a)
    with pytest.raises(UnsupportedError, match="a_quantity_of_the_host takes arrays of the host"):
        gpu._evaluate("a_quantity_of_the_host", q=on_gpu(q))


class Foreign:
    """An array of a library that knows Numba's protocol alone."""

    def __init__(self, x: DeviceArray) -> None:
        self.x = x

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        return self.x.__cuda_array_interface__

    def get(self) -> np.ndarray:
        return self.x.numpy()


def test_arrays_come_and_go_by_numba_s_protocol(fake: FakeDriver) -> None:  # noqa: F811
    model = small_arm()
    cpu, dyn = both(model)
    q, v, a = study.states(model, 5).values()
    for major in (False, True):
        arrays = [Foreign(on_gpu(x, major=major)) for x in (q, v, a)]
        fake.calls.clear()
        out = dyn.forward_dynamics(*arrays)
        # The flags alone cross over.
        assert [fake.calls.count(f"cuMemcpy{x}") for x in ("HtoD", "DtoHAsync")] == [1, 1]
        assert isinstance(out, DeviceArray)
        assert np.array_equal(np.asarray(out), cpu.forward_dynamics(q, v, a))


def test_results_are_arrays_of_the_library_that_gave_the_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    library = ModuleType("fakelib")

    class Tensor:
        __module__ = "fakelib.inside"

        def __init__(self, x: Any) -> None:
            self.x = x

        def __dlpack_device__(self) -> tuple[int, int]:
            return self.x.__dlpack_device__()

        def __dlpack__(self, stream: int) -> Any:
            assert stream == 1
            return self.x.__dlpack__(stream=stream)

    library.from_dlpack = Tensor  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "fakelib", library)
    model = small_arm()
    cpu, gpu = both(model)
    q, v, a = study.states(model, 5).values()
    out = gpu.mass_matrix(Tensor(on_gpu(q, major=True)))
    assert isinstance(out, Tensor)
    assert np.array_equal(out.x.numpy(), cpu.mass_matrix(q))
    # Other arguments may stay on the host.
    assert np.array_equal(gpu.forward_dynamics(Tensor(on_gpu(q)), v, a).x.numpy(), cpu.forward_dynamics(q, v, a))


def test_dlpack_hands_over_what_is_there_and_takes_it_back(fake: FakeDriver) -> None:  # noqa: F811
    x = np.arange(24.0).reshape(2, 3, 4)
    array = DeviceArray.empty(driver.device_of("cuda"), (2, 12), major=False)
    with array._device.current():
        array._device.upload(x, array._address)
    shaped = array.seen(lambda y: y.reshape(2, 3, 4)).seen(lambda y: y.swapaxes(1, 2))
    assert np.array_equal(shaped.numpy(), x.swapaxes(1, 2))
    assert np.array_equal(shaped[1].numpy(), x.swapaxes(1, 2)[1])
    assert (len(shaped), shaped.ndim, shaped.shape) == (2, 3, (2, 4, 3))

    class OnHost:
        """NumPy reads the memory of the host alone, where the fake driver's is."""

        def __dlpack_device__(self) -> tuple[int, int]:
            return 1, 0

        def __dlpack__(self, **_: Any) -> Any:
            capsule = handed.pop().__dlpack__()
            address = arrays._API.PyCapsule_GetPointer(capsule, arrays._NAME)
            arrays._Managed.from_address(address).tensor.device_type = 1
            return capsule

    handed = [shaped]
    taken = np.from_dlpack(OnHost())
    assert np.array_equal(taken, x.swapaxes(1, 2))
    del array, shaped
    assert fake.left
    del taken, OnHost
    gc.collect()
    assert not fake.left


def test_a_batch_too_large_for_the_gpu_goes_in_parts(fake: FakeDriver) -> None:  # noqa: F811
    fake.room = 10_000
    model = small_arm()
    cpu, gpu = both(model)
    q, v, a = study.states(model, 300).values()
    assert np.array_equal(gpu.forward_dynamics(q, v, a), cpu.forward_dynamics(q, v, a))
    assert fake.calls.count("cuLaunchKernel") > 1
    assert not fake.left
    ends = [mb.simulate(d, q, v, 5e-3, "rk4", dt=1e-3, save=5, doubt=False) for d in (cpu, gpu)]
    assert np.array_equal(ends[0].q, ends[1].q)
    assert not fake.left
    fake.room = 32
    with pytest.raises(DeviceError, match="device: out of memory"):
        gpu.forward_dynamics(q[:2], v[:2], a[:2])
    assert not fake.left


def test_machine_code_is_kept_on_disk(fake: FakeDriver, monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:  # noqa: F811
    monkeypatch.setenv("MBKIT_CACHE_DIR", str(tmp_path / "kept"))
    model = random_tree(17, 3, ("revolute",))
    q, v, a = study.states(model, 3).values()
    for made in (1, 0):
        fake.calls.clear()
        _, dyn = both(model)
        dyn.forward_dynamics(q, v, a)
        mb.simulate(dyn, q, v, 2e-3, "rk4", dt=1e-3, save=2, doubt=False)
        assert fake.calls.count("cuLinkComplete") == 2 * made
        del dyn
        equations_of(model).kept.pop("device", None)


def test_pickled_dynamics_come_back_on_the_gpu() -> None:
    model = small_arm()
    _, gpu = both(model)
    again = pickle.loads(pickle.dumps(gpu))
    assert again.device == gpu.device == "cuda:0"
    q, v, a = study.states(model, 3).values()
    assert np.array_equal(again.forward_dynamics(q, v, a), gpu.forward_dynamics(q, v, a))


@pytest.mark.parametrize("name", ["gpu", "cuda:x", 3])
def test_other_devices_are_unknown(name: Any) -> None:
    with pytest.raises(UnknownNameError, match="device"):
        mb.dynamics(small_arm(), "lagrangian", device=name)


def test_a_gpu_that_is_not_there_is_named() -> None:
    with pytest.raises(UnsupportedError, match="device: expected one of 1 NVIDIA GPUs, numbered from 0; got 1"):
        mb.dynamics(small_arm(), "lagrangian", device="cuda:1")
    with pytest.raises(InputError, match="device: expected None where nothing is compiled"):
        mb.dynamics(small_arm(), "lagrangian", device="cuda", compile=False)


@pytest.mark.parametrize(
    ("failing", "message"),
    [
        (lambda *_: (100,), "device: cuInit failed with 100"),
        (lambda *_: (_ for _ in ()).throw(RuntimeError("no libcuda")), "this machine has no NVIDIA driver"),
    ],
)
def test_what_the_driver_lacks_is_said(failing: Any, message: str, fake: FakeDriver) -> None:  # noqa: F811
    fake.cuInit = failing  # type: ignore[method-assign]
    with pytest.raises((DeviceError, UnsupportedError), match=message):
        mb.dynamics(small_arm(), "lagrangian", device="cuda")


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    driver.driver.cache_clear()
    monkeypatch.setitem(sys.modules, "cuda.bindings", None)
    with pytest.raises(
        UnsupportedError, match=r"^device: cuda-bindings is not installed; pip install 'mbkit\[cuda\]'$"
    ):
        mb.dynamics(small_arm(), "lagrangian", device="cuda")
    driver.driver.cache_clear()


def test_a_function_too_large_to_compile_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend, "_MAX_COMPILED_OPERATIONS", 20)
    model = random_tree(19, 3, ("revolute",))
    _, gpu = both(model)
    q, v, a = study.states(model, 3).values()
    for states in ((q, v, a), (q[0], v[0], a[0])):
        with pytest.raises(
            UnsupportedError, match=r"at most 20 operations, forward_dynamics of this model has [\d,]+; use"
        ):
            gpu.forward_dynamics(*states)


def test_functions_without_a_counterpart_are_named() -> None:
    x = ca.SX.sym("x")
    with pytest.raises(UnsupportedError, match="device: exp, tan of this model"):
        kernel_code(program(ca.Function("f", [x], [ca.exp(x) + ca.tan(x)])))


@pytest.mark.thorough("sm_90")
@pytest.mark.skipif(study.ptxas_path() is None, reason="ptxas of nvidia-cuda-nvcc is not installed")
@pytest.mark.parametrize("target", ["sm_80", "sm_90"])
def test_ptx_is_assembled_for_real_gpus(target: str) -> None:
    model = small_arm()
    dyn = mb.dynamics(model, "lagrangian", compile=True)
    ptxas = study.ptxas_path() or shutil.which("ptxas") or ""
    forward = kernel_code(program(dyn.equations.function("forward_dynamics")).fused)[0]
    found = study.assemble(forward, target, ptxas)
    assert found["registers"] <= 255
    assert found["spilled"] == 0
    full = mb.simulate.StateFeedback(np.ones((model.nv, model.nq + model.nv))).pattern
    steps = steps_code(march_in_stages(dyn.equations, "rk4", fed=full), STATE)[0]
    assert study.assemble(steps, target, ptxas)["registers"] <= 255
