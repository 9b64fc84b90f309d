"""What pushed a run: rows held over its steps, a function that is asked, or what that one answered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, TorqueError, UnsupportedError
from mbkit.simulate.grid import Indices

__all__ = ["Applied", "Asked", "Held", "Sampled", "TorqueFunction"]

#: torque(t, q, v) -> (nv,), of one state
TorqueFunction = Callable[[float, Array, Array], ArrayLike]


@dataclass(frozen=True, eq=False)
class Held:
    """A generalized force that is constant, or jumps at known times.

    Attributes
    ----------
    rows : (nv,), (R, nv) or (N, R, nv) array
    starts : (R,) array or None
        When each row begins to act, s; None for a constant.
    """

    rows: Array
    starts: Array | None

    def at(self, t: Array) -> Array:
        """Return what acts from each time on: (nv,), (K, nv) or (N, K, nv). The last row has no end."""
        return self.rows if self.starts is None else self.rows[..., self._row(t), :]

    def between(self, t: Array) -> Array:
        """Return what acts between neighbouring times: (nv,), (K - 1, nv) or (N, K - 1, nv).

        Raises
        ------
        UnsupportedError
            It changes between two of the times.
        """
        if self.starts is None:
            return self.rows
        differ = np.diff(self.rows, axis=-2).any(axis=(0, 2) if self.rows.ndim == 3 else 1)
        changes = self.starts[1:][differ]
        # An interval may begin or end with a change.
        broken = np.searchsorted(changes, t[1:], side="left") > np.searchsorted(changes, t[:-1], side="right")
        if broken.any():
            k = int(np.argmax(broken))
            raise UnsupportedError(
                f"the torque changes between the saved states at {t[k]:.9g} and {t[k + 1]:.9g} s, where the motion is "
                "not known; keep every step (save=None) to have its work"
            )
        return self.rows[..., self._row(t[:-1]), :]

    def _row(self, t: Array) -> Indices:
        assert self.starts is not None
        return np.searchsorted(self.starts, t, side="right") - 1


@dataclass(frozen=True, eq=False)
class Sampled:
    """What a function of the state gave at the saved states, (K, nv) or (N, K, nv)."""

    values: Array


@dataclass(frozen=True, eq=False)
class Asked:
    """A user's function of (t, q, v).

    Attributes
    ----------
    function : callable
    nv : int
        How many numbers it must return.
    """

    function: TorqueFunction
    nv: int

    def one(self, t: float, q: Array, v: Array, member: int | None = None) -> Array:
        """Return what acts on one state.

        Raises
        ------
        TorqueError
            The function raised, or returned something else than (nv,) finite numbers.
        """
        when = f"at t = {t:.9g} s" + ("" if member is None else f" for trajectory {member}")
        try:
            # Copies, so that nothing it writes there matters.
            given: Any = self.function(t, q.copy(), v.copy())
        except Exception as error:
            raise TorqueError(f"torque: the callable raised {type(error).__name__} {when}: {error}") from error
        try:
            return finite_array("torque", given, (self.nv,))
        except InputError as error:
            raise TorqueError(f"{error}; it is what the callable returned {when}") from None
        except Exception as error:
            raise TorqueError(
                f"torque: expected an array of numbers, got {type(given).__name__}; "
                f"it is what the callable returned {when}"
            ) from error

    def many(self, t: float, q: Array, v: Array, members: Indices) -> Array:
        """Return what acts on these members of a batch, (n, nv)."""
        rows = [self.one(t, *state) for state in zip(q, v, members.tolist(), strict=True)]
        return np.array(rows).reshape(-1, self.nv)

    def sampled(self, t: Array, q: Array, v: Array, *, strict: bool) -> Sampled:
        """Ask again at the saved states of a run; NaN where a state is none.

        Parameters
        ----------
        strict : bool
            Whether a function that fails raises, or leaves NaN.
        """
        out = np.full(v.shape, np.nan)
        for index in np.ndindex(v.shape[:-1]):
            if np.isfinite(q[index]).all() and np.isfinite(v[index]).all():
                member = index[0] if len(index) == 2 else None
                try:
                    out[index] = self.one(float(t[index[-1]]), q[index], v[index], member)
                except TorqueError:
                    if strict:
                        raise
        return Sampled(out)


Applied = Held | Asked | Sampled
