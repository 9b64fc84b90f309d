"""Arrays that stay on a GPU: taken from other libraries, and handed to them, without a copy.

CuPy, PyTorch, JAX and Warp hand arrays over by DLPack (v0.8, ``dlpack.h``), others by Numba's
``__cuda_array_interface__`` (version 3).
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from math import prod
from typing import Any, Final, NamedTuple
from weakref import finalize

import numpy as np

from mbkit._check import GPU, Array, is_on_device
from mbkit.codegen.cuda.driver import Device
from mbkit.codegen.cuda.runs import OnDevice, Place
from mbkit.errors import InputError

#: The stream on which `Device` works, as both protocols number it: the one that waits for all others.
_LEGACY_STREAM: Final = 1


class _Tensor(ctypes.Structure):
    _fields_ = (
        ("data", ctypes.c_void_p),
        ("device_type", ctypes.c_int32),
        ("device_id", ctypes.c_int32),
        ("ndim", ctypes.c_int32),
        ("code", ctypes.c_uint8),
        ("bits", ctypes.c_uint8),
        ("lanes", ctypes.c_uint16),
        ("shape", ctypes.POINTER(ctypes.c_int64)),
        ("strides", ctypes.POINTER(ctypes.c_int64)),
        ("byte_offset", ctypes.c_uint64),
    )


class _Managed(ctypes.Structure):
    _fields_ = (("tensor", _Tensor), ("context", ctypes.c_void_p), ("deleter", ctypes.c_void_p))


_DL_FLOAT: Final = 2  # kDLFloat
_NAME: Final = b"dltensor"
_DELETER: Final = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)
_API: Final = ctypes.pythonapi
_API.PyCapsule_New.restype = ctypes.py_object
_API.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
_API.PyCapsule_GetPointer.restype = ctypes.c_void_p
_API.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
# A capsule that is dying may not be counted again.
_IS_VALID: Final = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_char_p)(("PyCapsule_IsValid", _API))
_POINTER: Final = ctypes.PYFUNCTYPE(ctypes.c_void_p, ctypes.c_void_p, ctypes.c_char_p)(("PyCapsule_GetPointer", _API))
#: Arrays that were handed over and not given back, by address.
_SHARED: Final[dict[int, Any]] = {}


@_DELETER  # type: ignore[untyped-decorator]  # ctypes
def _returned(address: int) -> None:
    _SHARED.pop(address, None)


@_DELETER  # type: ignore[untyped-decorator]  # ctypes
def _unused(capsule: int) -> None:
    if _IS_VALID(capsule, _NAME):
        _SHARED.pop(_POINTER(capsule, _NAME), None)


class _View(NamedTuple):
    """Doubles on a GPU: address, shape and strides in doubles; `kept` owns them."""

    address: int
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    kept: Any


def viewed(name: str, x: Any, device: Device) -> _View:
    """Return where an array on this GPU is.

    Raises
    ------
    InputError
        It holds no doubles, or is on another GPU.
    """
    if isinstance(x, DeviceArray):
        _require(name, x._device is device, x._device.name)
        return _View(x._address, x.shape, x._strides, x)
    if not hasattr(x, "__dlpack__"):
        facts = x.__cuda_array_interface__
        shape, kind = tuple(map(int, facts["shape"])), facts["typestr"]
        strides = facts.get("strides") or _contiguous(shape, 8)
        _require(name, kind == "<f8", kind)
        _require(name, all(s % 8 == 0 for s in strides), f"strides {strides}")
        if (stream := facts.get("stream")) not in (None, _LEGACY_STREAM):
            device.wait(int(stream))
        return _View(int(facts["data"][0] or 0), shape, tuple(s // 8 for s in strides), x)
    kind, ordinal = map(int, x.__dlpack_device__())
    _require(name, (kind, ordinal) == (GPU, device.ordinal), f"device {(kind, ordinal)}")
    capsule = x.__dlpack__(stream=_LEGACY_STREAM)
    tensor = _Managed.from_address(_API.PyCapsule_GetPointer(capsule, _NAME)).tensor
    _require(name, (tensor.code, tensor.bits, tensor.lanes) == (_DL_FLOAT, 64, 1), f"{tensor.bits} bits")
    shape = tuple(tensor.shape[i] for i in range(tensor.ndim))
    strides = tuple(tensor.strides[i] for i in range(tensor.ndim)) if tensor.strides else _contiguous(shape, 1)
    return _View((tensor.data or 0) + tensor.byte_offset, shape, strides, (x, capsule))


def _require(name: str, good: bool, got: str) -> None:
    if not good:
        raise InputError(f"{name}: expected float64 on the GPU of the dynamics, got {got}")


def _contiguous(shape: tuple[int, ...], size: int) -> tuple[int, ...]:
    return tuple(size * prod(shape[i + 1 :]) for i in range(len(shape)))


class DeviceArray:
    """Doubles on a GPU, for other libraries to take: ``cupy.asarray(x)``, ``torch.from_dlpack(x)``; ``x.numpy()``.

    Attributes
    ----------
    shape : tuple of int
    """

    def __init__(
        self, device: Device, address: int, shape: tuple[int, ...], strides: tuple[int, ...], owner: Any
    ) -> None:
        self._device, self._address, self._strides, self._owner = device, address, strides, owner
        self.shape = shape

    @classmethod
    def empty(cls, device: Device, shape: tuple[int, ...], *, major: bool) -> DeviceArray:
        """Return new room for (N, ...); `major`: samples are neighbours."""
        with device.current():
            memory = _Memory(device, 8 * prod(shape))
        strides = _contiguous(shape, 1)
        if major:
            strides = (1, *(shape[0] * s for s in _contiguous(shape[1:], 1)))
        return cls(device, memory.address, shape, strides, memory)

    def __repr__(self) -> str:
        return f"<DeviceArray {self.shape} on {self._device.name}>"

    def __len__(self) -> int:
        return self.shape[0]

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    def __getitem__(self, key: Any) -> DeviceArray:
        """Return a part that a view of NumPy's would be."""
        return self.seen(lambda x: x[key])

    def as_batch(self) -> Place:
        """Return the array as (N, n), the shape that a kernel takes."""
        return Place(self._address, 1 if self._strides[-1] == 1 else self.shape[0], self._strides[0])

    def seen(self, view: Callable[[Array], Array]) -> DeviceArray:
        """Return what a function that only looks at an array makes of it, without a copy."""
        # Never read: there is one number behind it.
        element = np.empty(1)
        strided = np.lib.stride_tricks.as_strided(element, self.shape, [8 * s for s in self._strides], writeable=False)
        out = view(strided)
        offset = (out.ctypes.data - element.ctypes.data) // 8 if out.size else 0
        strides = tuple(s // 8 for s in out.strides)
        return DeviceArray(self._device, self._address + 8 * offset, out.shape, strides, self._owner)

    def numpy(self) -> Array:
        """Return a copy on the host."""
        if not prod(self.shape):
            return np.empty(self.shape)
        span = np.empty(1 + sum((n - 1) * s for n, s in zip(self.shape, self._strides, strict=True)))
        with self._device.current():
            self._device.download(self._address, span)
        return np.lib.stride_tricks.as_strided(span, self.shape, [8 * s for s in self._strides])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        """Return a copy on the host; see `numpy.asarray`."""
        if copy is False:
            raise ValueError("an array on a GPU cannot be read without a copy")
        return self.numpy().astype(dtype or np.float64, copy=False)

    @property
    def __cuda_array_interface__(self) -> dict[str, Any]:
        """The description by Numba's protocol."""
        strides = tuple(8 * s for s in self._strides)
        facts = {"shape": self.shape, "typestr": "<f8", "data": (self._address, False), "strides": strides}
        return facts | {"version": 3, "stream": _LEGACY_STREAM}

    def __dlpack_device__(self) -> tuple[int, int]:
        return GPU, self._device.ordinal

    def __dlpack__(self, **_: Any) -> Any:
        """Return a capsule; all work on the array is done already, whatever the stream."""
        n = len(self.shape)
        shape, strides = (ctypes.c_int64 * n)(*self.shape), (ctypes.c_int64 * n)(*self._strides)
        tensor = _Tensor(self._address, GPU, self._device.ordinal, n, _DL_FLOAT, 64, 1, shape, strides, 0)
        managed = _Managed(tensor, None, ctypes.cast(_returned, ctypes.c_void_p))
        address = ctypes.addressof(managed)
        _SHARED[address] = managed, shape, strides, self
        return _API.PyCapsule_New(address, _NAME, ctypes.cast(_unused, ctypes.c_void_p))


class _Memory:
    """Memory on a GPU, freed with this object."""

    def __init__(self, device: Device, size: int) -> None:
        self.address = device.take(size)
        finalize(self, device.release, self.address)


def like(x: DeviceArray, arguments: Any) -> Any:
    """Return an array of the library that `given` is of, where it takes DLPack; else `x`."""
    if isinstance(arguments, DeviceArray):
        return x
    library = sys.modules.get({"jaxlib": "jax.numpy"}.get(root := type(arguments).__module__.partition(".")[0], root))
    take = getattr(library, "from_dlpack", None)
    return x if take is None else take(x)


def batch_on_device(code: OnDevice, trim: Callable[[Array], Array], arguments: dict[str, Any]) -> Any:
    """Return a quantity of arrays on the GPU, (N, size) or (size,), in the first one's library; None where it is bad.

    Other arguments may be arrays of the host. Results have their samples side by side where all arguments have.
    """
    on_device = {k: viewed(k, x, code.device) if is_on_device(x) else None for k, x in arguments.items()}
    on_host = {k: np.asarray(arguments[k], dtype=np.float64) for k, x in on_device.items() if x is None}
    shapes = [(on_host[k] if x is None else x).shape for k, x in on_device.items()]
    single = all(len(shape) == 1 for shape in shapes)
    n = 1 if single else next((shape[0] for shape in shapes if len(shape) == 2), 0)
    for (name, shape), size in zip(zip(arguments, shapes, strict=True), code.inputs, strict=True):
        if shape not in ((size,), (n, size)):
            raise InputError(f"{name}: expected shape {(size,)} or {(n, size)}, got {shape}")
    places: list[Any] = []
    for name, x in on_device.items():
        if x is None:
            places.append(np.broadcast_to(on_host[name], (n, on_host[name].shape[-1])))
        else:
            places.append(Place(x.address, x.strides[-1], x.strides[0] if len(x.shape) == 2 else 0))
    major = n > 1 and all(x is None or x.shape[-1] == 1 or x.strides[0] == 1 for x in on_device.values())
    outs = [DeviceArray.empty(code.device, (n, r * c), major=major) for r, c in code.shapes]
    if n and not code.on_device(places, [out.as_batch() for out in outs], n):
        return None
    rows, columns = code.shapes[0]
    result = outs[0].seen(lambda x: trim(x.reshape(n, rows, columns))[0 if single else slice(None)])
    return like(result, next(x for x in arguments.values() if is_on_device(x)))
