"""A driver for tests: the calls are those of the real one, memory is the host's, and kernels run on the CPU.

In the place of PTX it is given LLVM's text, of which it makes code for this processor: thread by thread the operations
of a GPU. It knows nothing of a GPU's order of threads, caches and time.
"""

from __future__ import annotations

import ctypes
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from llvmlite import binding as llvm

from mbkit.codegen import jit
from mbkit.codegen.cuda import driver

_REGISTERS = ("tid", "ntid", "ctaid")
OK, OUT_OF_MEMORY = 0, 2


class FakeDriver:
    """The functions of `cuda.bindings.driver` that mbkit calls; `calls` has their names in order.

    `room` is the memory in bytes, `left` what is not given back.
    """

    def __init__(self, room: int = 2**30, devices: int = 1) -> None:
        self.calls: list[str] = []
        self.devices, self.room, self.left = devices, room, dict[int, Any]()
        self.CUdevice_attribute = SimpleNamespace(
            CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MAJOR=9, CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_MINOR=0
        )
        self.CUmemPool_attribute = SimpleNamespace(CU_MEMPOOL_ATTR_RELEASE_THRESHOLD=4)
        self.CUjitInputType = SimpleNamespace(CU_JIT_INPUT_PTX=1)
        self.cuuint64_t = int
        self._linked: dict[int, Any] = {}
        self._current: list[Any] = []
        self.unloaded: list[Any] = []

    def __getattribute__(self, name: str) -> Any:
        if name.startswith("cu") and name != "cuuint64_t":
            self.calls.append(name)
        return super().__getattribute__(name)

    def cuInit(self, flags: int) -> tuple[int]:
        assert flags == 0
        return (OK,)

    def cuDeviceGetCount(self) -> tuple[int, int]:
        return OK, self.devices

    def cuDeviceGet(self, ordinal: int) -> tuple[int, int]:
        assert 0 <= ordinal < self.devices
        return OK, 100 + ordinal

    def cuDeviceGetName(self, size: int, device: int) -> tuple[int, bytes]:
        assert device >= 100
        return OK, b"Fake\0".ljust(size, b"\0")

    def cuDeviceGetAttribute(self, kind: int, device: int) -> tuple[int, int]:
        assert device >= 100
        return OK, kind

    def cuDriverGetVersion(self) -> tuple[int, int]:
        return OK, 13000

    def cuDevicePrimaryCtxRetain(self, device: int) -> tuple[int, str]:
        return OK, f"context {device}"

    def cuCtxPushCurrent(self, context: str) -> tuple[int]:
        self._current.append(context)
        return (OK,)

    def cuCtxPopCurrent(self) -> tuple[int, str]:
        return OK, self._current.pop()

    def cuDeviceGetDefaultMemPool(self, device: int) -> tuple[int, int]:
        return OK, device

    def cuMemPoolSetAttribute(self, _pool: int, kind: int, value: int) -> tuple[int]:
        assert (kind, value) == (4, 2**63)
        return (OK,)

    @property
    def _taken(self) -> int:
        return sum(x.nbytes for x in self.left.values())

    def cuMemAllocAsync(self, size: int, stream: int) -> tuple[int, int]:
        assert self._current
        assert stream == 0
        if self._taken + size > self.room:
            return OUT_OF_MEMORY, 0
        # What was not written shows.
        block = np.full(-(-size // 8), np.nan)
        self.left[block.ctypes.data] = block
        return OK, block.ctypes.data

    def cuMemFreeAsync(self, address: int, stream: int) -> tuple[int]:
        assert self._current
        assert stream == 0
        del self.left[address]
        return (OK,)

    def _require(self, address: int, size: int) -> None:
        assert any(a <= address and address + size <= a + x.nbytes for a, x in self.left.items())

    def cuMemcpyHtoD(self, target: int, source: int, size: int) -> tuple[int]:
        assert self._current
        self._require(target, size)
        ctypes.memmove(target, source, size)
        return (OK,)

    def cuMemcpyDtoHAsync(self, target: int, source: int, size: int, stream: int) -> tuple[int]:
        assert stream == 0
        self._require(source, size)
        ctypes.memmove(target, source, size)
        return (OK,)

    def cuStreamSynchronize(self, _stream: int) -> tuple[int]:
        return (OK,)

    def cuLinkCreate(self, count: int, options: list[Any], values: list[Any]) -> tuple[int, int]:
        assert (count, options, values) == (0, [], [])
        self._linked[len(self._linked)] = None
        return OK, len(self._linked) - 1

    def cuLinkAddData(self, state: int, kind: int, data: bytes, size: int, *rest: Any) -> tuple[int]:
        assert (kind, size, rest[1:]) == (1, len(data), (0, [], []))
        assert data.endswith(b"\0")
        self._linked[state] = np.frombuffer(_for_this_processor(data[:-1].decode()), dtype=np.uint8).copy()
        return (OK,)

    def cuLinkComplete(self, state: int) -> tuple[int, int, int]:
        return OK, self._linked[state].ctypes.data, self._linked[state].size

    def cuLinkDestroy(self, state: int) -> tuple[int]:
        del self._linked[state]
        self._linked[state] = None
        return (OK,)

    def cuModuleLoadData(self, image: bytes) -> tuple[int, Any]:
        head, _, code = image.partition(b"\n")
        engine = jit._target()
        engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), engine, use_lmm=True)
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        engine.finalize_object()
        return OK, (engine, json.loads(head))

    def cuModuleGetFunction(self, module: Any, name: bytes) -> tuple[int, Any]:
        return OK, (*module, name.decode())

    def cuModuleUnload(self, module: Any) -> tuple[int]:
        assert self._current
        self.unloaded.append(module)
        return (OK,)

    def cuLaunchKernel(self, function: Any, *sizes: Any) -> tuple[int]:
        (engine, counts, name), (x, y, z, block, by, bz, shared, stream, places, extra) = function, sizes
        assert (y, z, by, bz, shared, stream, extra) == (1, 1, 1, 1, 0, 0, 0)
        assert self._current
        count = counts[name]
        values = [
            ctypes.c_int64.from_address(ctypes.c_int64.from_address(int(places) + 8 * i).value).value
            for i in range(count)
        ]
        run = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * count)(engine.get_function_address(name))
        tid, ntid, ctaid = (
            ctypes.c_int32.from_address(engine.get_global_value_address(f"fake_{r}")) for r in _REGISTERS
        )
        ntid.value = block
        for i in range(x):
            for j in range(block):
                ctaid.value, tid.value = i, j
                run(*values)
        return (OK,)


def _for_this_processor(text: str) -> bytes:
    """Return the counts of the kernels' parameters, a line, and this processor's code of LLVM's text."""
    text = "\n".join(line for line in text.splitlines() if not line.startswith("target "))
    for r in _REGISTERS:
        own = f"@fake_{r} = global i32 0\ndefine i32 @fake.{r}() {{\n  %x = load i32, ptr @fake_{r}\n  ret i32 %x\n}}"
        text = text.replace(f"declare i32 @llvm.nvvm.read.ptx.sreg.{r}.x()", own)
        text = text.replace(f"@llvm.nvvm.read.ptx.sreg.{r}.x()", f"@fake.{r}()")
    kernels = re.findall(r"define ptx_kernel void @(\w+)\(([^)]*)\)", text)
    text = text.replace("ptx_kernel ", "")
    counts = {name: len(given.split(",")) for name, given in kernels}
    return json.dumps(counts).encode() + b"\n" + jit.object_code(text)


@contextmanager
def fake_gpu() -> Iterator[FakeDriver]:
    """A GPU that is none, with a gibibyte."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield _in_place(monkeypatch)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    return _in_place(monkeypatch)


def _in_place(monkeypatch: pytest.MonkeyPatch) -> FakeDriver:
    stands_in, real = FakeDriver(), driver.ptx

    def text_after_ptx(text: str, target: str) -> bytes:
        # PTX must come of it all the same.
        assert b".entry" in real(text, target)
        return text.encode() + b"\0"

    monkeypatch.setattr(driver, "driver", lambda: stands_in)
    monkeypatch.setattr(driver, "ptx", text_after_ptx)
    monkeypatch.setattr(driver, "_DEVICES", {})
    # Code of a real GPU, kept by the same names, is no code for this one.
    monkeypatch.setenv("MBKIT_CACHE_DIR", "")
    return stands_in
