"""One GPU through its driver: memory, machine code, launches; no toolkit is needed."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any, Final
from weakref import finalize

import numpy as np
from numpy.typing import NDArray

from mbkit.codegen.cuda.kernels import BLOCK_THREADS, TARGETS, ptx
from mbkit.errors import DeviceError, UnknownNameError, UnsupportedError

#: Values of `device=`, but for the number of a GPU behind it, as in "cuda:1".
CUDA: Final = "cuda"
_CAPABILITY: Final = "CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY"
_OUT_OF_MEMORY: Final = 2  # CUDA_ERROR_OUT_OF_MEMORY


class OutOfMemoryError(DeviceError):
    """The GPU has no room for an array."""


@cache
def driver() -> Any:
    """Return the module of the driver's functions, of the package cuda-bindings."""
    try:
        from cuda.bindings import driver as module
    except ImportError as error:
        raise UnsupportedError("device: cuda-bindings is not installed; pip install 'mbkit[cuda]'") from error
    return module


def _ask(name: str, *arguments: Any) -> Any:
    """Return what a function of the driver gives, without the code of its success."""
    function = getattr(driver(), name)
    try:
        code, *out = function(*arguments)
    except (RuntimeError, OSError) as error:
        raise UnsupportedError(f"device: this machine has no NVIDIA driver ({error})") from error
    if int(code) == _OUT_OF_MEMORY:
        raise OutOfMemoryError(f"device: out of memory in {name}({', '.join(map(str, arguments))})")
    if int(code):
        raise DeviceError(f"device: {name} failed with {getattr(code, 'name', code)}")
    return out[0] if len(out) == 1 else out


class Device:
    """One GPU: its memory, and kernels on it. Everything happens in order, on the stream that others wait for too."""

    def __init__(self, ordinal: int) -> None:
        _ask("cuInit", 0)
        count = int(_ask("cuDeviceGetCount"))
        if ordinal >= count:
            raise UnsupportedError(f"device: expected one of {count} NVIDIA GPUs, numbered from 0; got {ordinal}")
        self.ordinal, self._handle = ordinal, _ask("cuDeviceGet", ordinal)
        self._context = _ask("cuDevicePrimaryCtxRetain", self._handle)
        #: NVIDIA's name of it.
        self.title = _ask("cuDeviceGetName", 100, self._handle).decode().strip("\0 ")
        kinds = driver().CUdevice_attribute
        major, minor = (
            int(_ask("cuDeviceGetAttribute", getattr(kinds, f"{_CAPABILITY}_{x}"), self._handle))
            for x in ("MAJOR", "MINOR")
        )
        known = [x for x in TARGETS if x <= 10 * major + minor]
        if not known:
            raise UnsupportedError(
                f"device: expected compute capability {TARGETS[0] / 10} or later, this GPU has {major}.{minor}"
            )
        #: Compute capability, on which machine code depends.
        self.target = f"sm_{known[-1]}"
        self.code_name = (f"sm_{major}{minor}", self.target, str(_ask("cuDriverGetVersion")))
        with self.current(), suppress(DeviceError):
            # Freed memory stays with the process: asking for it again takes longer than most kernels.
            pool, attributes = _ask("cuDeviceGetDefaultMemPool", self._handle), driver().CUmemPool_attribute
            threshold = driver().cuuint64_t(2**63)
            _ask("cuMemPoolSetAttribute", pool, attributes.CU_MEMPOOL_ATTR_RELEASE_THRESHOLD, threshold)

    @contextmanager
    def current(self) -> Iterator[None]:
        """Make this GPU the thread's own meanwhile."""
        _ask("cuCtxPushCurrent", self._context)
        try:
            yield
        finally:
            _ask("cuCtxPopCurrent")

    def machine_code(self, text: str) -> bytes:
        """Return the machine code of LLVM's text, made by the driver."""
        code = ptx(text, self.target)
        with self.current():
            state = _ask("cuLinkCreate", 0, [], [])
            try:
                kind = driver().CUjitInputType.CU_JIT_INPUT_PTX
                _ask("cuLinkAddData", state, kind, code, len(code), b"mbkit", 0, [], [])
                address, size = _ask("cuLinkComplete", state)
                return bytes((ctypes.c_char * int(size)).from_address(int(address)))
            finally:
                _ask("cuLinkDestroy", state)

    def load(self, code: bytes, name: str, owner: Any) -> Any:
        """Return a function of machine code, which is dropped with its owner."""
        with self.current():
            module = _ask("cuModuleLoadData", code)
            finalize(owner, self.unload, module)
            return _ask("cuModuleGetFunction", module, name.encode())

    def take(self, size: int) -> int:
        """Return the address of new memory, bytes."""
        return int(_ask("cuMemAllocAsync", max(size, 8), 0))

    def give(self, address: int) -> None:
        """Free memory."""
        _ask("cuMemFreeAsync", address, 0)

    def release(self, address: int) -> None:
        """Free memory at any time, in any thread."""
        # At the end of the process the driver has freed it.
        with suppress(Exception), self.current():
            self.give(address)

    def unload(self, module: Any) -> None:
        """Drop machine code at any time, in any thread."""
        with suppress(Exception), self.current():
            _ask("cuModuleUnload", module)

    def wait(self, stream: int) -> None:
        """Wait for all work on a stream of another library."""
        with self.current():
            _ask("cuStreamSynchronize", stream)

    def upload(self, x: NDArray[Any], address: int) -> None:
        """Copy a contiguous array of the host to the GPU."""
        if x.size:
            # Not asynchronous: the array may be gone before a copy that is.
            _ask("cuMemcpyHtoD", address, x.ctypes.data, x.nbytes)

    def download(self, address: int, x: NDArray[Any]) -> None:
        """Copy from the GPU into a contiguous array of the host, and wait for it."""
        if x.size:
            _ask("cuMemcpyDtoHAsync", x.ctypes.data, address, x.nbytes, 0)
        _ask("cuStreamSynchronize", 0)

    def launch(self, function: Any, threads: int, *arguments: int) -> None:
        """Start one thread for each of so many states; arguments are of eight bytes."""
        values = np.array(arguments, dtype=np.int64)
        places = values.ctypes.data + 8 * np.arange(len(values), dtype=np.uint64)
        blocks = -(-threads // BLOCK_THREADS)
        _ask("cuLaunchKernel", function, blocks, 1, 1, BLOCK_THREADS, 1, 1, 0, 0, places.ctypes.data, 0)

    @property
    def name(self) -> str:
        """As in ``device="cuda:0"``."""
        return f"{CUDA}:{self.ordinal}"


def in_parts(count: int, work: Callable[[slice], None]) -> None:
    """Run `work` on the whole batch, or on one part after the other where the GPU has no room for all."""
    start, size = 0, count
    while start < count:
        try:
            work(slice(start, min(start + size, count)))
        except OutOfMemoryError:
            if size == 1:
                raise
            size = -(-size // 2)
        else:
            start += size


_DEVICES: Final[dict[int, Device]] = {}


def device_of(name: str) -> Device:
    """Return the GPU of a name, "cuda" or "cuda:1".

    Raises
    ------
    UnknownNameError
        Another name.
    UnsupportedError
        Without cuda-bindings, a driver or this GPU; the message names the missing one.
    """
    kind, _, number_ = name.partition(":") if isinstance(name, str) else ("", "", "")
    if kind != CUDA or (number_ and not number_.isdecimal()) or (not number_ and ":" in name):
        raise UnknownNameError("device", str(name), (CUDA, f"{CUDA}:0"))
    ordinal = int(number_ or 0)
    if ordinal not in _DEVICES:
        _DEVICES[ordinal] = Device(ordinal)
    return _DEVICES[ordinal]
