"""Batches and steps on a GPU.

`OnDevice` runs batches on the GPU, and single states on the CPU. `CudaSteps` takes states through many steps in one
launch; what a step's parts read and write has a place for each thread in one array, the arena, row after row.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property
from typing import Any, Final, NamedTuple
from weakref import WeakValueDictionary

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit._version import __version__
from mbkit.codegen import disk_cache as disk
from mbkit.codegen import jit
from mbkit.codegen.compiled import Compiled, compiled
from mbkit.codegen.cuda.driver import CUDA, Device, in_parts
from mbkit.codegen.cuda.kernels import BATCH, STEPS, kernel_code, steps_code
from mbkit.codegen.program import program
from mbkit.derivation.fingerprint import SOURCES
from mbkit.derivation.steps.fixed import Part


class Place(NamedTuple):
    """An array of (N, n) on the GPU: its address, and the strides between rows and samples, in doubles."""

    address: int
    across: int
    along: int


class OnDevice(Compiled):
    """A function of vectors whose batches run on a GPU, and whose single states run on the CPU.

    Either's code is made at its first use; `first` says whose knows of arguments and results.
    """

    device: Device

    def __init__(self, device: Device, kernel: Callable[[], _Kernel], host: Callable[[], Compiled], first: str) -> None:
        self.device, self._make_kernel, self._make_host, self._first = device, kernel, host, first

    @cached_property
    def _kernel(self) -> _Kernel:
        return self._make_kernel()

    @cached_property
    def _host(self) -> Compiled:
        return self._make_host()

    def __getattr__(self, name: str) -> Any:
        if name in ("inputs", "shapes", "operations"):
            return getattr(self._kernel if self._first == CUDA else self._host, name)
        if name in ("loaded", "share", "work_size", "_local"):
            return getattr(self._host, name)
        raise AttributeError(name)

    def run(self, inputs: Sequence[Array], outputs: Sequence[Array], threads: int | None = None) -> bool:  # noqa: ARG002
        """Fill (N, n) outputs, as `Compiled.run` does; where the GPU has no room, part after part."""
        good: list[bool] = []

        def one(part: slice) -> None:
            good.append(self._near([x[part] for x in inputs], [x[part] for x in outputs]))

        in_parts(len(inputs[0]), one)
        return all(good)

    def _near(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> bool:
        with self._room() as allocate:
            places = [self._sent(x, allocate) for x in inputs]
            makes = [_as_sent(x, copy=False) for x in outputs]
            results = [Place(allocate(x.size), across, along) for x, across, along in makes]
            good = self._kernel.launch(places, results, len(inputs[0]), allocate)
            for x, (host, _, _), place in zip(outputs, makes, results, strict=True):
                self.device.download(place.address, host)
                if not np.may_share_memory(host, x):
                    x[:] = host.T if host.shape != x.shape else host
        return good

    def on_device(self, inputs: Sequence[Place | Array], outputs: Sequence[Place], n: int) -> bool:
        """Fill outputs on the GPU from inputs on it, or on the host; return what `run` does."""
        with self._room() as allocate:
            places = [x if isinstance(x, Place) else self._sent(x, allocate) for x in inputs]
            return self._kernel.launch(places, outputs, n, allocate)

    @contextmanager
    def _room(self) -> Iterator[Callable[[int], int]]:
        """Give a function that takes room for so many doubles, which is freed at the end."""
        with self.device.current(), ExitStack() as stack:

            def allocate(size: int) -> int:
                address = self.device.take(8 * size)
                stack.callback(self.device.give, address)
                return address

            yield allocate

    def _sent(self, x: Array, allocate: Callable[[int], int]) -> Place:
        host, across, along = _as_sent(x)
        place = Place(allocate(host.size), across, along)
        self.device.upload(host, place.address)
        return place


def _as_sent(x: Array, *, copy: bool = True) -> tuple[Array, int, int]:
    """Return an array as it goes to the GPU in one piece, with its strides there."""
    if copy and len(x) > 1 and x.strides[0] == 0:
        return np.ascontiguousarray(x[0]), 1, 0
    if x.shape[1] > 1 and x.strides[0] == 8:
        whole = x.T if x.T.flags.c_contiguous else np.ascontiguousarray(x.T) if copy else np.empty(x.T.shape)
        return whole, len(x), 1
    return (x if x.flags.c_contiguous else np.ascontiguousarray(x) if copy else np.empty(x.shape)), 1, x.shape[1]


class _Kernel:
    """A program's kernel on one GPU."""

    def __init__(self, device: Device, about: dict[str, Any], code: bytes) -> None:
        self.device, self._work = device, int(about["work"])
        self.inputs, self.operations = tuple(about["inputs"]), int(about["operations"])
        self.shapes = tuple((r, c) for r, c in about["shapes"])
        self._function = device.load(code, BATCH, self)

    def launch(self, inputs: Sequence[Place], outputs: Sequence[Place], n: int, allocate: Callable[[int], int]) -> bool:
        """Run it, and wait; return whether all numbers are finite and quaternions are of unit length."""
        flags, marks = allocate(1), np.zeros(2, dtype=np.int32)
        self.device.upload(marks, flags)
        work = allocate(self._work * n) if self._work > 1 else flags
        self.device.launch(self._function, n, *(x for place in (*inputs, *outputs) for x in place), n, flags, work)
        self.device.download(flags, marks)
        return not marks.any()


_HELD: Final[WeakValueDictionary[str, _Kernel]] = WeakValueDictionary()


def on_device(
    name: Sequence[str], make: Callable[[], ca.Function], device: Device, quaternions: Sequence[int] | None
) -> OnDevice:
    """Return a compiled function whose batches run on a GPU; the names are those of `compiled`.

    `quaternions` begin at these places of the first argument; None of a function that is no quantity, which batches
    may never see.
    """

    def kernel() -> tuple[dict[str, Any], bytes]:
        code = program(make()).fused
        text, work = kernel_code(code, quaternions or ())
        about = {"inputs": code.inputs, "shapes": code.shapes, "operations": code.arithmetic, "work": work}
        return about, device.machine_code(text)

    def held() -> _Kernel:
        with jit.COMPILING:
            key = _key("batch", [*name, *map(str, quaternions or ())], device)
            return disk.cached(key, _HELD, lambda *entry: _Kernel(device, *entry), kernel)

    return OnDevice(device, held, lambda: compiled(name, make), "" if quaternions is None else CUDA)


def _key(kind: str, name: Sequence[str], device: Device) -> str:
    versions = __version__, ca.CasadiMeta.version(), SOURCES, jit.host().llvm
    return disk.key_of(CUDA, kind, *name, *device.code_name, str(device.ordinal), *versions)


class CudaSteps:
    """Steps of a method on one GPU; `rows` has the first row and number of rows of each name, of `size` in all."""

    def __init__(self, device: Device, about: dict[str, Any], code: bytes) -> None:
        self.device, self.size = device, int(about["size"])
        self.rows = {name: (int(a), int(n)) for name, (a, n) in about["rows"].items()}
        self._function = device.load(code, STEPS, self)

    def arena(self, count: int) -> Arena:
        """Return the room of so many states; `OutOfMemoryError` where there is none."""
        return Arena(self, count)


class Arena:
    """The room of states on the GPU, (rows, count), and steps of all of them; a context that frees it."""

    def __init__(self, steps: CudaSteps, count: int) -> None:
        self._steps, self._device, self._count = steps, steps.device, count
        self._shared: int | None = None
        with self._device.current():
            self._address = self._device.take(8 * steps.size * count)

    def __enter__(self) -> Arena:
        return self

    def __exit__(self, *error: object) -> None:
        with self._device.current():
            for address in (self._address, self._shared):
                if address is not None:
                    self._device.give(address)

    def _place(self, name: str) -> int:
        return self._address + 8 * self._steps.rows[name][0] * self._count

    def put(self, name: str, x: Array) -> None:
        """Copy values in, (rows, count) or what broadcasts to it; what no part reads is left out."""
        if name in self._steps.rows:
            with self._device.current():
                shape = self._steps.rows[name][1], self._count
                host = np.ascontiguousarray(np.broadcast_to(x, shape))
                self._device.upload(host, self._place(name))

    def share(self, numbers: Array) -> None:
        """Copy in the numbers of a state feedback."""
        with self._device.current():
            self._shared = self._device.take(numbers.nbytes)
            self._device.upload(numbers, self._shared)

    def get(self, name: str) -> Array:
        """Return values, (rows, count)."""
        out = np.empty((self._steps.rows[name][1], self._count))
        with self._device.current():
            self._device.download(self._place(name), out)
        return out

    def take_steps(self, count: int, force: Array) -> None:
        """Take steps, and wait; the force is (steps or 1, rows, count or 1)."""
        with self._device.current():
            address = self._device.take(force.nbytes)
            try:
                host = np.ascontiguousarray(force)
                self._device.upload(host, address)
                many, rows, wide = host.shape
                strides = rows * wide if many > 1 else 0, wide, int(wide > 1)
                arguments = self._address, self._shared or self._address, self._count, count, address, *strides
                self._device.launch(self._steps._function, self._count, *arguments)
                self._device.download(address, np.empty(0))
            finally:
                self._device.give(address)


#: Operations of a step that is one function: Talos' 19,000, or 27,000 under a feedback, kept the driver's compiler busy
#: for more than two minutes.
MAX_STEP_OPERATIONS: Final = 10_000
_STEPS: Final[WeakValueDictionary[str, CudaSteps]] = WeakValueDictionary()


def steps_on_device(
    name: Sequence[str], make: Callable[[], Sequence[Part]], state: Sequence[str], device: Device
) -> CudaSteps:
    """Return steps of parts on a GPU, as `compiled_step_loop` does on the CPU."""

    def code() -> tuple[dict[str, Any], bytes]:
        text, about = steps_code(make(), state)
        return about, device.machine_code(text)

    with jit.COMPILING:
        return disk.cached(_key("steps", name, device), _STEPS, lambda *entry: CudaSteps(device, *entry), code)
