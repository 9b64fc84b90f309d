"""The generalized force of a run: zero, an array held over each step, or a function of the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, TorqueError, UnsupportedError
from mbkit.model import Model
from mbkit.simulate.time_grid import Indices

#: torque(t, q, v) -> (nv,), of one state
TorqueFunction = Callable[[float, Array, Array], ArrayLike]


@dataclass(frozen=True, eq=False)
class PiecewiseConstantTorque:
    """A generalized force that is constant, or jumps at known times."""

    # (nv,), (R, nv) or (N, R, nv)
    rows: Array
    # When each row begins to act, s; None for a constant.
    starts: Array | None

    def at(self, t: Array) -> Array:
        """Return the force from each time on: (nv,), (K, nv) or (N, K, nv). The last row has no end."""
        return self.rows if self.starts is None else self.rows[..., self._row(t), :]

    def between(self, t: Array) -> Array:
        """Return the force between neighbouring times: (nv,), (K - 1, nv) or (N, K - 1, nv); an error if it changes."""
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
class SampledTorque:
    """Values of a torque function at the saved states, (K, nv) or (N, K, nv)."""

    values: Array


@dataclass(frozen=True, eq=False)
class TorqueCallback:
    """A user's function of (t, q, v), which must return nv numbers."""

    function: TorqueFunction
    nv: int

    def one(self, t: float, q: Array, v: Array, member: int | None = None) -> Array:
        """Return the force on one state; a `TorqueError` where the function raises or returns something else."""
        when = f"at t = {t:.9g} s" + ("" if member is None else f" for trajectory {member}")
        try:
            # Copies: the function may write into them.
            value: Any = self.function(t, q.copy(), v.copy())
        except Exception as error:
            raise TorqueError(f"torque: the callable raised {type(error).__name__} {when}: {error}") from error
        try:
            return finite_array("torque", value, (self.nv,))
        except InputError as error:
            raise TorqueError(f"{error}; it is what the callable returned {when}") from None
        except Exception as error:
            raise TorqueError(
                f"torque: expected an array of numbers, got {type(value).__name__}; "
                f"it is what the callable returned {when}"
            ) from error

    def many(self, t: float, q: Array, v: Array, members: Indices) -> Array:
        """Return the force on these members of a batch, (n, nv)."""
        rows = [self.one(t, *state) for state in zip(q, v, members.tolist(), strict=True)]
        return np.array(rows).reshape(-1, self.nv)

    def sampled(self, t: Array, q: Array, v: Array, *, strict: bool) -> SampledTorque:
        """Return the values at saved states; NaN where one is not finite or, unless strict, the function fails."""
        out = np.full(v.shape, np.nan)
        for index in np.ndindex(v.shape[:-1]):
            if np.isfinite(q[index]).all() and np.isfinite(v[index]).all():
                member = index[0] if len(index) == 2 else None
                try:
                    out[index] = self.one(float(t[index[-1]]), q[index], v[index], member)
                except TorqueError:
                    if strict:
                        raise
        return SampledTorque(out)


Applied = PiecewiseConstantTorque | TorqueCallback | SampledTorque


#: The force during one step: an array, or a function of (t, q, v) of one state or a batch. A function of a batch takes
#: as a fourth argument which of its trajectories the states are of, where they are not all.
Force = Array | Callable[..., Array]


class Torque:
    """The argument `torque` of a run, checked, and read step by step.

    An array is (nv,), (steps, nv) or (batch, steps, nv); without `steps` only a constant (nv,) is possible.
    """

    def __init__(
        self, torque: ArrayLike | TorqueFunction | None, model: Model, batch: int | None, steps: int | None
    ) -> None:
        self._nv = model.nv
        self._callback = TorqueCallback(torque, model.nv) if callable(torque) else None
        self._constant = np.zeros(model.nv)
        self._rows: Array | None = None
        if torque is not None and not callable(torque):
            array = _read(torque, model, batch, steps)
            if array.ndim == 1:
                self._constant = self._constant + array
            else:
                self._rows = array
        self._of_all = self._constant if batch is None else np.tile(self._constant, (batch, 1))

    @property
    def held(self) -> bool:
        """Whether the force jumps between steps."""
        return self._rows is not None

    @property
    def callable(self) -> bool:
        """Whether the force is a function of the state."""
        return self._callback is not None

    def during(self, k: int, members: Indices | None) -> Force:
        """Return the force during step k on a single state, or on these members of a batch."""
        if self._callback is not None:
            callback = self._callback
            if members is None:
                return callback.one
            return lambda t, q, v, part=slice(None): callback.many(t, q, v, members[part])
        row = self._of_all if self._rows is None else self._rows[..., k, :]
        if members is None:
            return row
        return row[members] if row.ndim == 2 else np.broadcast_to(row, (len(members), self._nv))

    def of_member(self, i: int | None) -> Callable[[int], Force]:
        """Return a function of the step that returns the force on one state (of a batch)."""
        if i is None:
            return lambda k: self.during(k, None)
        if self._callback is not None:
            force = partial(self._callback.one, member=i)
            return lambda _: force
        return lambda k: np.asarray(self.during(k, np.array([i])))[0]

    def columns(self, members: Indices | slice, start: int, stop: int) -> Array:
        """Return an array's rows of steps start to stop for members of a batch: (steps, nv, members or 1)."""
        if self._rows is None:
            return np.broadcast_to(self._constant[:, None], (stop - start, self._nv, 1))
        if self._rows.ndim == 2:
            return self._rows[start:stop, :, None]
        return np.ascontiguousarray(self._rows[members, start:stop].transpose(1, 2, 0))

    def over(self, start: int, stop: int) -> Array | None:
        """Return the rows of steps start to stop, (steps, nv) or (N, steps, nv); None where all are zero."""
        if self._rows is not None:
            return self._rows[..., start:stop, :]
        return np.tile(self._constant, (stop - start, 1)) if self._constant.any() else None

    def applied(self, bounds: Array | None) -> PiecewiseConstantTorque | TorqueCallback | None:
        """Return the force of a finished run, whose rows were held between `bounds`, s; None where it was zero."""
        if self._callback is not None:
            return self._callback
        if self._rows is not None:
            assert bounds is not None  # rows are read only where there are intervals
            return PiecewiseConstantTorque(self._rows, bounds[:-1])
        return PiecewiseConstantTorque(self._constant, None) if self._constant.any() else None


def _read(torque: ArrayLike, model: Model, batch: int | None, steps: int | None) -> Array:
    """Return an array of torques, checked."""
    try:
        shape = np.shape(torque)
    except ValueError:
        raise InputError("torque: expected an array or a callable, got rows of different lengths") from None
    allowed = [(model.nv,), (steps, model.nv), (batch, steps, model.nv)][
        : 1 if steps is None else 2 + (batch is not None)
    ]
    if shape not in allowed:
        hint = "; one row per interval needs save=, times from 0 to the end of the run"
        raise InputError(
            f"torque: expected shape {' or '.join(map(str, allowed))}, got {shape}; {model.name} has nv = {model.nv}"
            + (hint if steps is None else f" and the run has {steps} steps")
        )
    return finite_array("torque", torque, shape)
