"""Single states passed straight to Pinocchio, with the fewest checks that are safe.

Arguments have to be plain vectors of native doubles: Pinocchio reads the memory of a
byte-swapped array, and the data of a masked one, as if they were such vectors. One sum
finds NaN and infinity in the answer, and so in the arguments; Pinocchio itself objects
to wrong sizes. On any doubt the checked method of `Dynamics` takes over: it
converts the arguments, or says what is wrong with them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import isfinite
from typing import Any, Final

import numpy as np
import pinocchio as pin

from mbkit._check import Array
from mbkit.model import Model

__all__ = ["direct_calls", "unread_coordinates"]

_INFINITY: Final = float("inf")
_DOUBLE: Final = np.dtype(np.float64)
_Plain: Final = np.ndarray
_NEAR_UNIT: Final = 1e-9
Call = Callable[..., Any]
Sound = Callable[[Array], bool]


def direct_calls(
    model: Model, unread: Mapping[str, tuple[int, ...]], bare: Mapping[str, Call], checked: Mapping[str, Call]
) -> dict[str, Call]:
    """Return calls for one state, under the quantities' names and with the arguments of `Dynamics`.

    Parameters
    ----------
    model : Model
    unread : mapping
        Quantity -> coordinates in which a NaN would not show in its value; none where it is missing.
    bare : mapping
        The engine's calls for one state, without checks.
    checked : mapping
        The calls that take over on any doubt.
    """
    kinds: tuple[Callable[[Call, Call, Sound], Call], ...]
    kinds = _mass_matrix, _gravity, _nle, _inverse_dynamics, _forward_dynamics
    names = (kind.__name__[1:] for kind in kinds)
    return {
        name: kind(bare[name], checked[name], _sound(model, unread.get(name, ())))
        for name, kind in zip(names, kinds, strict=True)
    }


def unread_coordinates(m: Any, d: Any, neutral: Array) -> tuple[dict[str, tuple[int, ...]], bool]:
    """Return where a NaN leaves an answer of Pinocchio finite.

    Returns
    -------
    dict
        Quantity -> such coordinates.
    bool
        Whether any quantity has such a velocity.
    """
    q, v, zero = neutral.copy(), np.zeros(m.nv), np.zeros(m.nv)
    terms: dict[str, Callable[[], Any]] = {
        "mass_matrix": lambda: pin.crba(m, d, q),
        "gravity": lambda: pin.computeGeneralizedGravity(m, d, q),
        "nle": lambda: pin.nonLinearEffects(m, d, q, v),
        "inverse_dynamics": lambda: pin.rnea(m, d, q, v, zero),
        "forward_dynamics": lambda: pin.aba(m, d, q, v, zero),
    }

    def hidden(state: Array, term: Callable[[], Any]) -> tuple[int, ...]:
        found = []
        for i in range(state.size):
            state[i], kept = np.nan, state[i]
            if not np.isnan(term()).any():
                found.append(i)
            state[i] = kept
        return tuple(found)

    unread = {name: hidden(q, term) for name, term in terms.items()}
    return unread, any(hidden(v, terms[name]) for name in terms if name not in ("mass_matrix", "gravity"))


def _always(_q: Array) -> bool:
    return True


def _sound(model: Model, unread: tuple[int, ...]) -> Sound:
    """Return a check of what the answer does not show: unread coordinates and quaternions."""
    starts = tuple(start for start, _ in model.quaternions)
    # A quaternion with a NaN is not of unit length.
    rest = set(unread) - {start + k for start in starts for k in range(4)}
    if not rest and not starts:
        return _always
    if starts == (3,) and rest <= {0, 1, 2}:
        # A floating base: position, then quaternion.
        def floating(q: Array) -> bool:
            a, b, c, x, y, z, w = q[:7].tolist()
            return bool(-_NEAR_UNIT < x * x + y * y + z * z + w * w - 1.0 < _NEAR_UNIT and isfinite(a + b + c))

        return floating

    def general(q: Array) -> bool:
        for start in starts:
            x = q[start : start + 4]
            if not -_NEAR_UNIT < x.dot(x) - 1.0 < _NEAR_UNIT:
                return False
        return isfinite(sum(q.tolist()))

    return general


# One closure for each quantity: a common one with *arguments would cost a third of a microsecond.


def _mass_matrix(bare: Call, checked: Call, sound: Sound) -> Call:
    def mass_matrix(q: Any) -> Any:
        try:
            if type(q) is _Plain and q.dtype == _DOUBLE and q.ndim == 1:
                out = bare(q)
                entries = out.ravel("K")
                if entries.dot(entries) < _INFINITY and sound(q):
                    return out
        except Exception:  # Pinocchio's own errors vary; the checked way words them
            pass
        return checked(q)

    return mass_matrix


def _gravity(bare: Call, checked: Call, sound: Sound) -> Call:
    def gravity(q: Any) -> Any:
        try:
            if type(q) is _Plain and q.dtype == _DOUBLE and q.ndim == 1:
                out = bare(q)
                if isfinite(sum(out.tolist())) and sound(q):
                    return out
        except Exception:  # as above
            pass
        return checked(q)

    return gravity


def _nle(bare: Call, checked: Call, sound: Sound) -> Call:
    def nle(q: Any, v: Any) -> Any:
        try:
            if type(q) is type(v) is _Plain and q.dtype == v.dtype == _DOUBLE and q.ndim == v.ndim == 1:
                out = bare(q, v)
                if isfinite(sum(out.tolist())) and sound(q):
                    return out
        except Exception:  # as above
            pass
        return checked(q, v)

    return nle


def _inverse_dynamics(bare: Call, checked: Call, sound: Sound) -> Call:
    def inverse_dynamics(q: Any, v: Any, a: Any) -> Any:
        try:
            if (
                type(q) is type(v) is type(a) is _Plain
                and q.dtype == v.dtype == a.dtype == _DOUBLE
                and q.ndim == v.ndim == a.ndim == 1
            ):
                out = bare(q, v, a)
                if isfinite(sum(out.tolist())) and sound(q):
                    return out
        except Exception:  # as above
            pass
        return checked(q, v, a)

    return inverse_dynamics


def _forward_dynamics(bare: Call, checked: Call, sound: Sound) -> Call:
    def forward_dynamics(q: Any, v: Any, tau: Any) -> Any:
        try:
            if (
                type(q) is type(v) is type(tau) is _Plain
                and q.dtype == v.dtype == tau.dtype == _DOUBLE
                and q.ndim == v.ndim == tau.ndim == 1
            ):
                out = bare(q, v, tau)
                if isfinite(sum(out.tolist())) and sound(q):
                    return out
        except Exception:  # as above
            pass
        return checked(q, v, tau)

    return forward_dynamics
