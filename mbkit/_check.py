"""Checks of arguments that come from users: one shape, one type, one message."""

from __future__ import annotations

import math
import reprlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit.errors import InputError, MbkitWarning, UnsupportedError, warn

Array = NDArray[np.float64]
K = TypeVar("K")
V = TypeVar("V")
#: Bits of a double's significand.
DOUBLE_BITS: Final = 53
#: Distance from 1 to the next double.
EPS: Final = float(np.finfo(float).eps)
# Tolerances by what leaves them; a decision that needs another one says why where it is made.
#: Part of a number that sums and solutions lose to rounding.
ROUNDING: Final = 1e-12
#: The same of iterations, and of formulas of some thousand operations.
ITERATED: Final = 1e-11
#: Part of a number, or of the largest one beside it, that a typed number with its few digits misses.
TYPED: Final = 1e-9
#: Residual of a consistent state beside each row's scale: rounding and a few typed digits.
CONSISTENT: Final = 1e-8
#: Part of a number that a file with six digits leaves open.
PRINTED: Final = 1e-6
#: Larger than anything that moves, and the products of several still fit a double.
MAX_MAGNITUDE: Final = 1e30
#: A state with a number of this size has diverged: no machine goes there, and its energy can still be computed.
BOUND: Final = 1e100
#: Least size by which something is divided.
TINY: Final = 1e-300
#: Step of central differences, relative to what changes: there truncation and rounding are alike.
CENTRAL_STEP: Final = EPS ** (1 / 3)
#: Random places, poses or states at which a property of formulas is looked for.
PROBES: Final = 4
#: Imaginary step of derivatives that are right to rounding.
COMPLEX_STEP: Final = 1e-30
#: Numbers of a piece of an array that is checked, copied or computed in pieces.
PIECE_SIZE: Final = 2**16
#: Lines of a list in a message or on a first screen: people act on the first few, and the data has the rest.
MAX_LINES: Final = 8
_SHORT: Final = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlong = 3, 60, 120, 60


@contextmanager
def needed(package: str, by: str) -> Iterator[None]:
    """Raise `UnsupportedError` that names a package, and who needs it, where an import within finds none."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != package:
            raise
        raise UnsupportedError(f"{by} needs {package}, which is not installed; pip install {package}") from error


def with_shapes(kind: type[K]) -> type[K]:
    """Give results that hold arrays a short repr: their names and shapes, and numbers as they are."""

    def shapes(self: Any) -> str:
        fields = self._asdict() if hasattr(self, "_asdict") else vars(self)
        texts = (f"{k} {x.shape}" if isinstance(x, np.ndarray) else f"{k} {x!r}" for k, x in fields.items())
        return f"<{type(self).__name__}: {', '.join(texts)}>"

    kind.__repr__ = shapes  # type: ignore[method-assign]  # of every one
    return kind


def all_finite(array: Array) -> bool:
    """Return whether an array holds only finite numbers."""
    # A plain sum of few numbers is several times cheaper than isfinite; huge finite ones
    # overflow it and are checked again.
    if array.size <= 64 and math.isfinite(sum(array.ravel().tolist())):
        return True
    return bool(np.isfinite(array).all())


def real_array(name: str, value: ArrayLike) -> Array:
    if type(value) is np.ndarray and value.dtype == np.float64:
        return value
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        raise InputError(f"{name}: expected an array of numbers, got a masked array with masked entries; fill them")
    try:
        raw = np.asarray(value)
    except Exception as error:
        # Any: objects may bring conversions of their own.
        why = f" ({error})" if isinstance(error, (ValueError, TypeError)) else ""
        raise InputError(f"{name}: expected an array of numbers, got {type(value).__name__}{why}") from None
    if raw.dtype.kind not in "fiu":
        called = getattr(value, "__name__", "")
        got = f"a function; call it: {called}()" if called else f"dtype {raw.dtype}"
        raise InputError(f"{name}: expected real numbers, got {got}")
    return np.asarray(raw, dtype=np.float64)


def finite_array(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return `value` as a new float64 array of exactly this shape, all finite."""
    array = real_array(name, value)
    if array.shape != shape:
        raise InputError(f"{name}: expected shape {shape}, got {array.shape}")
    if array.size <= PIECE_SIZE:
        require_finite(name, array)
        return array.copy()
    # In pieces that stay in a cache; between them Ctrl-C is heard.
    flat, out = array.reshape(-1), np.empty(array.size)
    for start in range(0, len(flat), PIECE_SIZE):
        piece = flat[start : start + PIECE_SIZE]
        if not all_finite(piece):
            require_finite(name, array)
        out[start : start + PIECE_SIZE] = piece
    return out.reshape(shape)


def require_finite(name: str, array: Array) -> None:
    """Raise `InputError` that says where `array` holds NaN or infinity."""
    if not all_finite(array):
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise InputError(f"{name}: {array[where]} at index {where}; expected finite numbers")


def rows(name: str, value: ArrayLike, n: int, owner: str, size: str) -> Array:
    """Return `value` as float64, ``(n,)`` or ``(N, n)``, all finite; `owner` and `size` serve the message alone."""
    array = real_array(name, value)
    if array.ndim not in (1, 2) or array.shape[-1] != n:
        raise InputError(f"{name}: expected shape ({n},) or (N, {n}), got {array.shape}; {owner} has {size} = {n}")
    require_finite(name, array)
    return array


def batch_of(**arrays: Array) -> int | None:
    """Return the common batch size, or None when every array is a single state; one beside a batch is repeated."""
    sizes: dict[str, int] = {name: a.shape[0] for name, a in arrays.items() if a.ndim == 2}
    if not sizes:
        return None
    if len(set(sizes.values())) > 1:
        each = ", ".join(f"{k} has {v}" for k, v in sizes.items())
        raise InputError(f"batches of different sizes: {each}; give every array the same N, or one state")
    return next(iter(sizes.values()))


def count(name: str, value: Any, *, least: int = 0) -> int:
    """Return `value` as a whole number of at least `least`."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
    if not whole or not least <= value < 2**63:
        raise InputError(f"{name}: expected a whole number of at least {least}, got {shown(value)}")
    return int(value)


def generator(name: str, value: Any) -> np.random.Generator:
    """Return a random generator; a whole number is the seed of one."""
    if isinstance(value, np.random.Generator):
        return value
    if isinstance(value, (int, np.integer)) and not isinstance(value, bool) and value >= 0:
        return np.random.default_rng(int(value))
    raise InputError(f"{name}: expected a numpy Generator or a seed of at least 0, got {shown(value)}")


def real(name: str, value: Any, *, positive: bool = False, nonnegative: bool = False) -> float:
    """Return `value` as a finite float, optionally of a required sign."""
    if isinstance(value, np.ndarray) and not value.ndim:
        value = value[()]
    # NumPy would cut a complex number to its real part.
    if isinstance(value, (str, bytes, bytearray, bool, np.bool_, np.ndarray, np.complexfloating)):
        raise InputError(f"{name}: expected a number, got {shown(value)}")
    try:
        number = float(value)
    except OverflowError:
        raise InputError(f"{name}: expected a number that a double can hold, got one beyond 1e308") from None
    except Exception:
        # Any: objects may bring conversions of their own.
        raise InputError(f"{name}: expected a number, got {shown(value)}") from None
    if not np.isfinite(number):
        raise InputError(f"{name}: expected a finite number, got {number}")
    if (positive and number <= 0) or (nonnegative and number < 0):
        raise InputError(f"{name}: expected a number {'above' if positive else 'of at least'} 0, got {number}")
    return number


#: rad: an angle beyond two turns that somebody wrote is likely one in degrees.
TWO_TURNS: Final = 4 * math.pi


def hint_at_degrees(item: str, *angles: float, unless: tuple[str, ...] = ()) -> None:
    """Warn of an angle beyond two turns, rad, unless some modules asked."""
    if beyond := [x for x in angles if abs(x) > TWO_TURNS]:
        says = "beyond two turns; angles are in radians here, numpy.radians makes them of degrees"
        warn(f"{item} = {beyond[0]:g} rad is {says}", MbkitWarning, unless)


def shown(value: Any) -> str:
    """Return any value as a short text for a message; it holds no lone surrogates and never fails."""
    try:
        text = _SHORT.repr(value)
    except Exception:
        text = f"an object of type {type(value).__name__}"
    return text.encode("utf-8", "backslashreplace").decode()


def by_key(pairs: Iterable[tuple[K, V]]) -> dict[K, list[V]]:
    """Return the values of each key, keys and values in their order."""
    out: dict[K, list[V]] = {}
    for key, value in pairs:
        out.setdefault(key, []).append(value)
    return out


# Axes of six-vectors, and kinds of accelerations.

LOCAL: Final = "local"
WORLD: Final = "world"
ALIGNED: Final = "local_world_aligned"
AXES: Final = (LOCAL, WORLD, ALIGNED)
SPATIAL: Final = "spatial"
CLASSICAL: Final = "classical"


def axes_named(axes: str) -> str:
    """Return these axes, checked."""
    # The name that jacobian() had for them before there were three.
    axes = LOCAL if axes == "body" else axes
    if axes not in AXES:
        raise InputError(f"axes: expected one of {', '.join(map(repr, AXES))}, got {axes!r}")
    return axes


# Arrays on a GPU

#: A GPU's kind in DLPack (kDLCUDA).
GPU: Final = 2


def is_on_device(x: Any) -> bool:
    """Return whether an argument says that it is an array on a GPU."""
    if isinstance(x, (np.ndarray, float, int, list, tuple)):
        return False
    if hasattr(x, "__cuda_array_interface__"):
        return True
    return hasattr(x, "__dlpack_device__") and int(x.__dlpack_device__()[0]) == GPU


def on_host(x: Any) -> Any:
    """Return an array on a GPU as one of NumPy's, and anything else as it is."""
    if not is_on_device(x):
        return x
    # CuPy's is `get`, PyTorch's `cpu`, Warp's `numpy`; JAX copies by itself.
    for name in ("get", "cpu", "numpy"):
        if callable(own := getattr(x, name, None)):
            return np.asarray(own())
    return np.asarray(x)
