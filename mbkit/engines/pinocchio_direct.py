"""Single states straight into Pinocchio: what the good path needs and nothing else.

Each call goes to the bare function. One dot product finds NaN and infinity in the
answer, and with it in the arguments; Pinocchio itself objects to wrong sizes. On
any doubt the checked way of `Dynamics` takes over, repeats the call and says what is
wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["direct_calls"]

_INFINITY: Final = float("inf")
#: Squared size of q below which no square of a coordinate overflows.
_TAME: Final = 1e200
_NEAR_UNIT: Final = 1e-9
Call = Callable[..., Any]
Passive = Callable[[Array, Array], Array]


def direct_calls(model: Model, m: Any, d: Any, passive: Passive | None, checked: Mapping[str, Call]) -> dict[str, Call]:
    """Return the direct calls by name.

    Parameters
    ----------
    model : Model
        Whose coordinates are Pinocchio's.
    m, d : pinocchio.Model, pinocchio.Data
    passive : callable, optional
        (q, v) -> passive forces, where there are any.
    checked : mapping
        The calls that take over.
    """
    sound = _sound(model, m, d)
    calls = {
        "mass_matrix": _of_q(pin.crba, m, d, checked["mass_matrix"], sound),
        "gravity": _of_q(pin.computeGeneralizedGravity, m, d, checked["gravity"], sound),
        "nle": _of_q_v(pin.nonLinearEffects, m, d, checked["nle"], sound),
        "inverse_dynamics": _of_q_v_x(pin.rnea, m, d, checked["inverse_dynamics"], sound),
        "forward_dynamics": _of_q_v_x(pin.aba, m, d, checked["forward_dynamics"], sound),
    }
    if passive is not None:
        calls["inverse_dynamics"] = _inverse(m, d, passive, checked["inverse_dynamics"], sound)
        calls["forward_dynamics"] = _forward(m, d, passive, checked["forward_dynamics"], sound)
    return calls


def _always(_q: Array) -> bool:
    return True


def _sound(model: Model, m: Any, d: Any) -> Callable[[Array], bool]:
    """Return a check of what the answer does not show: unread coordinates and quaternions."""
    unread = _unread(model, m, d)
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


def _unread(model: Model, m: Any, d: Any) -> tuple[int, ...]:
    """Return the coordinates in which a NaN leaves some answer finite."""
    q, v = model.neutral(), np.zeros(model.nv)
    found = []
    for i in range(q.size):
        q[i], kept = np.nan, q[i]
        if not all(np.isnan(f(m, d, q, v, v)).any() for f in (pin.rnea, pin.aba)):
            found.append(i)
        q[i] = kept
    return tuple(found)


def _of_q(f: Call, m: Any, d: Any, checked: Call, sound: Callable[[Array], bool]) -> Call:
    def call(q: Any) -> Any:
        try:
            out = f(m, d, q)
            if q.dot(q) < _TAME and q.ndim == 1 and sound(q):
                return out
        except Exception:  # Pinocchio's own errors vary; the checked way words them
            pass
        return checked(q)

    return call


def _of_q_v(f: Call, m: Any, d: Any, checked: Call, sound: Callable[[Array], bool]) -> Call:
    if sound is _always:

        def call(q: Any, v: Any) -> Any:
            try:
                out = f(m, d, q, v)
                if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim:
                    return out
            except Exception:  # as above
                pass
            return checked(q, v)

        return call

    def guarded(q: Any, v: Any) -> Any:
        try:
            out = f(m, d, q, v)
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v)

    return guarded


def _of_q_v_x(f: Call, m: Any, d: Any, checked: Call, sound: Callable[[Array], bool]) -> Call:
    if sound is _always:

        def call(q: Any, v: Any, x: Any) -> Any:
            try:
                out = f(m, d, q, v, x)
                if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == x.ndim:
                    return out
            except Exception:  # as above
                pass
            return checked(q, v, x)

        return call

    def guarded(q: Any, v: Any, x: Any) -> Any:
        try:
            out = f(m, d, q, v, x)
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == x.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v, x)

    return guarded


def _inverse(m: Any, d: Any, passive: Passive, checked: Call, sound: Callable[[Array], bool]) -> Call:
    rnea = pin.rnea

    def call(q: Any, v: Any, a: Any) -> Any:
        try:
            out = rnea(m, d, q, v, a)
            out -= passive(q, v)
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == a.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v, a)

    return call


def _forward(m: Any, d: Any, passive: Passive, checked: Call, sound: Callable[[Array], bool]) -> Call:
    aba = pin.aba

    def call(q: Any, v: Any, tau: Any) -> Any:
        try:
            out = aba(m, d, q, v, tau + passive(q, v))
            if out.dot(out) < _INFINITY and q.ndim == 1 == v.ndim == tau.ndim and sound(q):
                return out
        except Exception:  # as above
            pass
        return checked(q, v, tau)

    return call
