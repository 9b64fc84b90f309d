"""The short way into machine code: what the good path needs and nothing else.

The code itself finds NaN and infinity in all that it reads and writes. On any doubt
the answer is None, and the checked way of `Dynamics` repeats the call and says what
is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

if TYPE_CHECKING:
    from mbkit.derivation.compiled import Compiled

__all__ = ["short_way"]

_FLOAT: Final = np.dtype(np.float64)
_NEAR_UNIT: Final = 1e-9
Call = Callable[..., Any]


def short_way(model: Model, code: Compiled, trim: Callable[[Array], Array], threads: int | None) -> Call:
    """Return a call for float64 arrays that are one state or one batch; None is its answer to all else.

    Parameters
    ----------
    model : Model
    code : Compiled
        Of one result, q its first argument.
    trim : callable
        Gives the code's (rows, columns) or (N, rows, columns) the quantity's shape.
    threads : int, optional
    """
    single = _single(code, trim)
    sizes = code.inputs
    starts = tuple(start for start, _ in model.quaternions)
    ones = [(n,) for n in sizes]

    def call(*given: Any) -> Any:
        # A subclass may be masked, and `is` would refuse the dtype of an array that was unpickled.
        if not all(type(x) is np.ndarray and x.dtype == _FLOAT for x in given):
            return None
        if [x.shape for x in given] == ones:
            return single(given) if not starts or _unit(given[0], starts) else None
        if not _is_batch(given, sizes) or (starts and not _all_unit(given[0], starts)):
            return None
        results, finite = code.watched(*given, threads=threads)
        return trim(results[0]) if finite else None

    return call


def _single(code: Compiled, trim: Callable[[Array], Array]) -> Callable[[tuple[Any, ...]], Any]:
    ends = np.cumsum([0, *code.inputs]).tolist()
    parts = [slice(a, b) for a, b in pairwise(ends)]
    rows, columns = code.shapes[0]

    def place() -> tuple[Any, ...]:
        given, out = np.zeros((1, ends[-1])), np.zeros((1, rows * columns))
        run, watch = code.bound([given[:, part] for part in parts], [out])
        return [given[0, part] for part in parts], run, watch, trim(out.reshape(rows, columns)).copy

    # A place belongs to one call at a time. Nobody waits for one: a forked child would
    # for ever, if another thread held it when it forked.
    free = [place()]

    def call(arguments: tuple[Any, ...]) -> Any:
        try:
            held = free.pop()
        except IndexError:
            held = place()
        views, run, watch, copy = held
        try:
            for view, x in zip(views, arguments, strict=True):
                view[:] = x
            run()
            if watch[0] != 0.0:
                watch[:] = 0.0
                return None
            return copy()
        finally:
            free.append(held)

    return call


def _is_batch(given: tuple[Any, ...], sizes: tuple[int, ...]) -> bool:
    n = given[0].shape[0] if given[0].ndim else 0
    return all(x.shape == (n, size) for x, size in zip(given, sizes, strict=True))


def _unit(q: Array, starts: tuple[int, ...]) -> bool:
    for start in starts:
        x, y, z, w = q[start : start + 4].tolist()
        if not -_NEAR_UNIT < x * x + y * y + z * z + w * w - 1.0 < _NEAR_UNIT:
            return False
    return True


def _all_unit(q: Array, starts: tuple[int, ...]) -> bool:
    for start in starts:
        x = q[:, start : start + 4]
        # A NaN is not below anything.
        if not bool((np.abs(np.einsum("ni,ni->n", x, x) - 1.0) < _NEAR_UNIT).all()):
            return False
    return True
