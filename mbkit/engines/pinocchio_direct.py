"""Single states straight into Pinocchio: what the good path needs and nothing else.

One dot product finds NaN and infinity in the answer, and with it in the arguments;
Pinocchio itself objects to wrong sizes. On any doubt the checked way of `Dynamics`
takes over, repeats the call and says what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["direct_calls", "unread_coordinates"]

_INFINITY: Final = float("inf")
#: Squared size of q below which no square of a coordinate overflows.
_TAME: Final = 1e200
_NEAR_UNIT: Final = 1e-9
Call = Callable[..., Any]
Sound = Callable[[Array], bool]


def direct_calls(
    model: Model, unread: tuple[int, ...], bare: Mapping[str, Call], checked: Mapping[str, Call]
) -> dict[str, Call]:
    """Return calls that take one state and look only at what must be looked at.

    Parameters
    ----------
    model : Model
    unread : tuple of int
        Coordinates in which a NaN would not show in the answers.
    bare : mapping
        The engine's calls for one state, without checks.
    checked : mapping
        The calls that take over on any doubt.
    """
    sound = _sound(model, unread)
    makers: dict[str, Callable[[Call, Call, Sound], Call]] = {
        "mass_matrix": _of_q,
        "gravity": _of_q,
        "nle": _of_q_v,
        "inverse_dynamics": _of_q_v_x,
        "forward_dynamics": _of_q_v_x,
    }
    return {name: make(bare[name], checked[name], sound) for name, make in makers.items()}


def unread_coordinates(m: Any, d: Any, neutral: Array) -> tuple[tuple[int, ...], bool]:
    """Return where a NaN leaves some answer of Pinocchio finite.

    Returns
    -------
    tuple of int
        Such coordinates.
    bool
        Whether there is such a velocity.
    """
    q, v, zero = neutral.copy(), np.zeros(m.nv), np.zeros(m.nv)

    def shown() -> bool:
        answers = (pin.rnea(m, d, q, v, zero), pin.aba(m, d, q, v, zero), pin.nonLinearEffects(m, d, q, v))
        return all(np.isnan(x).any() for x in answers)

    hidden: list[list[int]] = [[], []]
    for found, state in zip(hidden, (q, v), strict=True):
        for i in range(state.size):
            state[i], kept = np.nan, state[i]
            if not shown():
                found.append(i)
            state[i] = kept
    return tuple(hidden[0]), bool(hidden[1])


def _always(_q: Array) -> bool:
    return True


def _sound(model: Model, unread: tuple[int, ...]) -> Sound:
    """Return a check of what the answer does not show: unread coordinates and quaternions."""
    starts = tuple(start for start, _ in model.quaternions)
    if not unread and not starts:
        return _always
    if starts == (3,) and set(unread) <= {0, 1, 2}:
        # A floating base: position, then quaternion.
        def floating(q: Array) -> bool:
            a, b, c, x, y, z, w = q[:7].tolist()
            return bool(-_NEAR_UNIT < x * x + y * y + z * z + w * w - 1.0 < _NEAR_UNIT and a + b + c - a - b - c < 1.0)

        return floating

    def general(q: Array) -> bool:
        for start in starts:
            x = q[start : start + 4]
            if not -_NEAR_UNIT < x.dot(x) - 1.0 < _NEAR_UNIT:
                return False
        return bool(q.dot(q) < _INFINITY)

    return general


def _of_q(bare: Call, checked: Call, sound: Sound) -> Call:
    def call(q: Any) -> Any:
        try:
            out = bare(q)
            if q.dot(q) < _TAME and q.ndim == 1 and sound(q):
                return out
        except Exception:  # Pinocchio's own errors vary; the checked way words them
            pass
        return checked(q)

    return call


def _of_q_v(bare: Call, checked: Call, sound: Sound) -> Call:
    if sound is _always:

        def call(q: Any, v: Any) -> Any:
            try:
                out = bare(q, v)
                if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim:
                    return out
            except Exception:  # as above
                pass
            return checked(q, v)

        return call

    def guarded(q: Any, v: Any) -> Any:
        try:
            out = bare(q, v)
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v)

    return guarded


def _of_q_v_x(bare: Call, checked: Call, sound: Sound) -> Call:
    if sound is _always:

        def call(q: Any, v: Any, x: Any) -> Any:
            try:
                out = bare(q, v, x)
                if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == x.ndim:
                    return out
            except Exception:  # as above
                pass
            return checked(q, v, x)

        return call

    def guarded(q: Any, v: Any, x: Any) -> Any:
        try:
            out = bare(q, v, x)
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == x.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v, x)

    return guarded
