"""The motion that a study of run time is about, and what its errors are measured by."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, NumericalError
from mbkit.model import Model
from mbkit.studies.reference import Reference
from mbkit.studies.reference import reference as known_motion
from mbkit.studies.rollouts import start_state
from mbkit.studies.sweep import INTERVALS, save_grid
from mbkit.studies.walk import Scene

__all__ = ["Exact", "scene_of"]

#: From a time to q and v there.
Exact = Callable[[float], tuple[ArrayLike, ArrayLike]]

#: A reference that starts farther than this from q0 and v0 is of another motion.
_SAME_START: Final = 1e-9
_EPS: Final = float(np.finfo(float).eps)


def scene_of(
    model: Model,
    duration: float,
    start: tuple[ArrayLike | None, ArrayLike | None],
    torque: Any,
    seed: int,
    reference: Reference | Exact | None,
    tell: Callable[[float], object],
    seconds: float,
) -> tuple[Scene, str]:
    """Return what is integrated with its reference, and how the reference was made.

    Parameters
    ----------
    model : Model
    duration : float
        Asked for, s.
    start : (q0, v0)
        None for the reference's own start, or one by `seed`.
    torque : (nv,) array, callable or None
    seed : int
    reference : Reference, callable or None
        None to search for one.
    tell : callable
        Gets the fraction of the search that is done.
    seconds : float
        What the search may take.

    Raises
    ------
    InputError
        A start or a reference of another model or motion.
    NumericalError
        No reference holds for even a hundredth of the duration.
    """
    tell(0.0)
    q0, v0 = _start(model, start, seed, reference)
    if reference is None:
        made = _searched(model, q0, v0, duration, torque, seconds, tell)
        times, q, floor, how = made.t, made.q, float(made.floor.max()), made.how
    elif isinstance(reference, Reference):
        made = reference
        keep = made.t <= duration * (1 + 1e-12)
        times, q, how = _multiples(made.t[keep]), made.q[keep], made.how
        floor = float(made.floor[keep].max())
    else:
        times = save_grid(duration)
        q = np.stack([_state(model, reference, t)[0] for t in times])
        floor, how = 8 * _EPS * float(np.abs(q).max()), "an exact function, to rounding"
    if q.shape != (len(times), model.nq):
        raise InputError(f"reference: expected states of {model.nq} coordinates, got {q.shape}; it is of another model")
    if float(np.abs(model.difference(q0, q[0])).max()) > _SAME_START:
        raise InputError(
            "reference: does not start at q0 (and v0); leave them out, or take the reference of this start"
        )
    return Scene(model, q0, v0, torque, times, q, floor), how


def _start(
    model: Model, start: tuple[ArrayLike | None, ArrayLike | None], seed: int, reference: Reference | Exact | None
) -> tuple[Array, Array]:
    own = start_state(model, seed)
    known: tuple[Array, Array] | None = None
    if isinstance(reference, Reference):
        known = np.asarray(reference.q[0]), np.asarray(reference.v[0])
    elif callable(reference):
        known = _state(model, reference, 0.0)
    elif reference is not None:
        raise InputError(
            f"reference: expected a Reference or a function from t to (q, v), got {type(reference).__name__}"
        )
    own = own if known is None else known
    q, v = (mine if given is None else given for given, mine in zip(start, own, strict=True))
    q0, v0 = model.check_q(q, "q0"), model.check_v(v, "v0")
    if q0.ndim != 1 or v0.ndim != 1:
        raise InputError(f"q0, v0: expected one state, got shapes {q0.shape} and {v0.shape}")
    if known is not None and float(np.abs(v0 - known[1]).max()) > _SAME_START:
        raise InputError("reference: does not start with v0; leave it out, or take the reference of this start")
    return q0, v0


def _state(model: Model, exact: Exact, t: float) -> tuple[Array, Array]:
    try:
        told = exact(float(t))
    except Exception as error:
        raise InputError(f"reference: the function raised {type(error).__name__} at t = {t:g} s: {error}") from error
    if not isinstance(told, Sequence) or len(told) != 2:
        raise InputError(f"reference: expected the function to return (q, v), got {told!r} at t = {t:g} s")
    q = finite_array("reference's q", told[0], (model.nq,))
    return q, finite_array("reference's v", told[1], (model.nv,))


def _searched(
    model: Model, q0: Array, v0: Array, duration: float, torque: Any, seconds: float, tell: Callable[[float], object]
) -> Reference:
    """Return a reference up to where it holds, or of a tenth of the time where it does not hold for that."""
    for part in (duration, duration / INTERVALS):
        made = known_motion(model, q0, v0, part, save_grid(part), torque, seconds=seconds, progress=tell)
        if len(made.t) > 1:
            return made
    raise NumericalError(f"{model.name}: no reference holds for even {part / INTERVALS:g} s; {made.how}")


def _multiples(times: Array) -> Array:
    """Return a reference's times, if steps of equal length can end on all of them."""
    if len(times) < 2 or np.abs(times / times[1] - np.rint(times / times[1])).max() > 1e-9:
        raise InputError(
            "reference: expected times that are 0 and multiples of the first after it, within the duration"
        )
    return times
