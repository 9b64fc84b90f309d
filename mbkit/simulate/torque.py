"""What acts in a run: the generalized force and wrenches on frames; zero, an array held over each step, or a function.

A force in this module is τ, (nv,), and behind it six numbers for each frame with a wrench. A wrench is what is held:
its generalized force Σ Jᵀ w follows the configuration within a step (`mbkit.engines.Dynamics._under`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, TorqueError, UnsupportedError
from mbkit.model import Model
from mbkit.simulate.time_grid import Indices

#: torque(t, q, v) -> (nv,), of one state; of a wrench (6,)
TorqueFunction = Callable[[float, Array, Array], ArrayLike]
#: Wrenches by the names of the frames on which they act.
RunWrenches = Mapping[str, ArrayLike | TorqueFunction]


@dataclass(frozen=True, eq=False)
class PiecewiseConstantTorque:
    """A generalized force that is constant, or jumps at known times."""

    # (n,), (R, n) or (N, R, n); a constant (n,) or (N, 1, n)
    rows: Array
    # When each row begins to act, s; None for a constant.
    starts: Array | None

    def at(self, t: Array) -> Array:
        """Return the force from each time on: (n,), (K, n), (N, K, n) or (N, 1, n). The last row has no end."""
        return self.rows if self.starts is None else self.rows[..., self._row(t), :]

    def between(self, t: Array) -> Array:
        """Return the force between neighbouring times, with K - 1 rows or one; an error if it changes."""
        if self.starts is None:
            return self.rows
        differ = np.diff(self.rows, axis=-2).any(axis=(0, 2) if self.rows.ndim == 3 else 1)
        changes = self.starts[1:][differ]
        # An interval may begin or end with a change.
        broken = np.searchsorted(changes, t[1:], side="left") > np.searchsorted(changes, t[:-1], side="right")
        if broken.any():
            k = int(np.argmax(broken))
            raise UnsupportedError(
                f"the force changes between the saved states at {t[k]:.9g} and {t[k + 1]:.9g} s, where the motion is "
                "not known; keep every step (save=None) to have its work"
            )
        return self.rows[..., self._row(t[:-1]), :]

    def _row(self, t: Array) -> Indices:
        assert self.starts is not None
        return np.searchsorted(self.starts, t, side="right") - 1


class StateFeedback:
    """A state feedback u = u0 + K (x0 - x), x = (q, v): a torque as data, which compiled steps evaluate themselves.

    With an explicit fixed step on the own derivation it is machine code with the step, on every core or on a GPU;
    everywhere else it is a torque function like any other. It acts at every stage of a method, not held.

    Parameters
    ----------
    gain : (nv, nq + nv) array_like
        K, N m or N for each unit of q and v. A ball or free joint has its quaternion in q as it is.
    q : (nq,) array_like, optional
    v : (nv,) array_like, optional
        x0; zeros by default.
    torque : (nv,) array_like, optional
        u0; zeros by default.

    Raises
    ------
    InputError
        A shape that does not fit the others, or a number that is not finite.

    Examples
    --------
    >>> import numpy as np, mbkit as mb
    >>> arm = mb.catalog.double_pendulum()
    >>> hold = mb.simulate.StateFeedback(np.hstack([300 * np.eye(2), 30 * np.eye(2)]), q=[1.0, 0.5])
    >>> print(hold(0.0, np.array([1.0, 0.4]), np.zeros(2)))
    [ 0. 30.]
    """

    def __init__(
        self, gain: ArrayLike, q: ArrayLike | None = None, v: ArrayLike | None = None, torque: ArrayLike | None = None
    ) -> None:
        shape = _shape("gain", gain)
        if len(shape) != 2 or shape[1] < 2 * shape[0]:
            raise InputError(f"gain: expected shape (nv, nq + nv), got {shape}")
        nv, nq = shape[0], shape[1] - shape[0]
        self.gain = finite_array("gain", gain, shape)
        self.q, self.v, self.torque = (
            np.zeros(n) if x is None else finite_array(name, x, (n,))
            for name, x, n in (("q", q, nq), ("v", v, nv), ("torque", torque, nv))
        )
        for x in (self.gain, self.q, self.v, self.torque):
            x.setflags(write=False)
        self._constant = self.torque + self.gain @ np.concatenate([self.q, self.v])

    def __call__(self, t: float, q: Array, v: Array) -> Array:  # noqa: ARG002  # the same at any time
        """Return the torque at one state, (nv,), or at those of a batch, (N, nv)."""
        return np.asarray(self._constant - np.concatenate([q, v], axis=-1) @ self.gain.T)

    def __repr__(self) -> str:
        nv, nx = self.gain.shape
        return f"<StateFeedback of {nx} numbers to {nv} torques>"

    @property
    def numbers(self) -> Array:
        """Constant and gain of each torque, row after row, as compiled steps take them."""
        return np.column_stack([self._constant, self.gain]).ravel()


@dataclass(frozen=True, eq=False)
class SampledTorque:
    """Values at the saved states of a force with functions in it, (K, n) or (N, K, n)."""

    values: Array


@dataclass(frozen=True, eq=False)
class TorqueCallback:
    """A user's function of (t, q, v), which must return `size` numbers; `name` is what messages call it."""

    function: TorqueFunction
    size: int
    name: str = "torque"

    def one(self, t: float, q: Array, v: Array, member: int | None = None) -> Array:
        """Return the force on one state; a `TorqueError` where the function raises or returns something else."""
        when = f"at t = {t:.9g} s" + ("" if member is None else f" for trajectory {member}")
        try:
            # Copies: the function may write into them.
            value: Any = self.function(t, q.copy(), v.copy())
        except Exception as error:
            raise TorqueError(f"{self.name}: the callable raised {type(error).__name__} {when}: {error}") from error
        try:
            return finite_array(self.name, value, (self.size,))
        except InputError as error:
            raise TorqueError(f"{error}; it is what the callable returned {when}") from None
        except Exception as error:
            raise TorqueError(
                f"{self.name}: expected an array of numbers, got {type(value).__name__}; "
                f"it is what the callable returned {when}"
            ) from error


@dataclass(frozen=True, eq=False)
class ForceFunctions:
    """A force of which some numbers are functions of the state; `held` has the others."""

    held: PiecewiseConstantTorque
    functions: tuple[tuple[slice, TorqueCallback], ...]

    def one(self, row: Array, t: float, q: Array, v: Array, member: int | None = None) -> Array:
        """Return the force on one state, with the held numbers of a row."""
        out = row.copy()
        for part, function in self.functions:
            out[part] = function.one(t, q, v, member)
        return out

    def sampled(self, t: Array, q: Array, v: Array, *, strict: bool) -> SampledTorque:
        """Return the values at saved states; NaN where one is not finite or, unless strict, a function fails."""
        held = self.held.at(t)
        rows = np.broadcast_to(held, (*v.shape[:-1], held.shape[-1]))
        out = np.full(rows.shape, np.nan)
        for index in np.ndindex(v.shape[:-1]):
            if np.isfinite(q[index]).all() and np.isfinite(v[index]).all():
                member = index[0] if len(index) == 2 else None
                try:
                    out[index] = self.one(rows[index], float(t[index[-1]]), q[index], v[index], member)
                except TorqueError:
                    if strict:
                        raise
        return SampledTorque(out)


Applied = PiecewiseConstantTorque | ForceFunctions | SampledTorque


#: The force during one step: an array, or a function of (t, q, v) of one state or a batch. A function of a batch takes
#: as a fourth argument which of its trajectories the states are of, where they are not all.
Force = Array | Callable[..., Array]


class Torque:
    """The arguments `torque` and `wrenches` of a run, checked, and read step by step.

    As an array, τ is (nv,), (steps, nv) or (batch, steps, nv), and a wrench (6,), (batch, 6), (steps, 6) or
    (batch, steps, 6); without `steps` nothing may change in time.
    """

    def __init__(
        self,
        torque: ArrayLike | TorqueFunction | None,
        model: Model,
        batch: int | None,
        steps: int | None,
        wrenches: RunWrenches | None = None,
    ) -> None:
        parts: list[tuple[slice, Array]] = []
        functions: list[tuple[slice, TorqueCallback]] = []
        self._size = model.nv
        #: Of a torque that is nothing else.
        self.feedback = torque if isinstance(torque, StateFeedback) and not wrenches else None
        if isinstance(torque, StateFeedback) and torque.gain.shape != (model.nv, model.nq + model.nv):
            raise InputError(
                f"torque: expected a gain of shape {(model.nv, model.nq + model.nv)}, (nv, nq + nv) of {model.name}, "
                f"got {torque.gain.shape}"
            )
        if callable(torque):
            functions.append((slice(0, model.nv), TorqueCallback(torque, model.nv)))
        elif torque is not None:
            parts.append((slice(0, model.nv), _read(torque, model, batch, steps)))
        for frame, wrench in (wrenches or {}).items():
            part, self._size = slice(self._size, self._size + 6), self._size + 6
            if callable(wrench):
                functions.append((part, TorqueCallback(wrench, 6, f"wrench on {frame!r}")))
            else:
                parts.append((part, _read_wrench(f"wrench on {frame!r}", wrench, batch, steps)))
        shape = np.broadcast_shapes(*(x.shape[:-1] for _, x in parts))
        # (n,) or (N, 1, n) all the time; or (steps, n) or (N, steps, n).
        whole = np.zeros((*shape, self._size))
        for part, x in parts:
            whole[..., part] = x
        constant = all(x.ndim == 1 or x.shape[:-1] == (batch, 1) != (batch, steps) for _, x in parts)
        self._rows: Array | None = None if constant else whole
        self._constant: Array = whole if constant else np.zeros(self._size)
        self._of_all = self._constant
        if batch is not None:
            each = whole[:, 0] if constant and whole.ndim == 3 else self._constant
            self._of_all = np.ascontiguousarray(np.broadcast_to(each, (batch, self._size)))
        self._functions = tuple(functions)
        self._with_functions = ForceFunctions(PiecewiseConstantTorque(self._constant, None), self._functions)

    @classmethod
    def of_force(cls, force: Array, model: Model) -> Torque:
        """Return a constant force, (n,) or of a batch (N, n): τ, and behind it what wrenches there are."""
        out, constant = cls(None, model, None, None), force if force.ndim == 1 else force[:, None]
        out._size, out._constant, out._of_all = force.shape[-1], constant, force
        out._with_functions = ForceFunctions(PiecewiseConstantTorque(constant, None), ())
        return out

    @property
    def held(self) -> bool:
        """Whether the force jumps between steps."""
        return self._rows is not None

    @property
    def callable(self) -> bool:
        """Whether the force is a function of the state."""
        return bool(self._functions)

    def during(self, k: int, members: Indices | None) -> Force:
        """Return the force during step k on a single state, or on these members of a batch."""
        row, one = self._of_all if self._rows is None else self._rows[..., k, :], self._with_functions.one
        if members is None:
            return partial(one, row) if self._functions else row
        rows = row[members] if row.ndim == 2 else np.broadcast_to(row, (len(members), self._size))
        if not self._functions:
            return rows

        def many(t: float, q: Array, v: Array, part: Any = slice(None)) -> Array:
            each = zip(rows[part], q, v, members[part].tolist(), strict=True)
            return np.array([one(held, t, *state) for held, *state in each]).reshape(-1, self._size)

        return many

    def of_member(self, i: int | None) -> Callable[[int], Force]:
        """Return a function of the step that returns the force on one state (of a batch)."""
        if i is None:
            return lambda k: self.during(k, None)
        arrays = self._of_all if self._rows is None else self._rows

        def during(k: int) -> Force:
            row = arrays if self._rows is None else arrays[..., k, :]
            row = row[i] if row.ndim == 2 else row
            return partial(self._with_functions.one, row, member=i) if self._functions else row

        return during

    def of_part(self, member: int | None, start: int, stop: int | None) -> Torque:
        """Return the force of one trajectory from step `start` on, up to `stop`, as that of a run of one state."""
        out = copy(self)
        if self._rows is not None:
            rows = self._rows if self._rows.ndim == 2 else self._rows[0 if member is None else member]
            out._rows = rows[start:stop]
        else:
            out._constant = self._constant if member is None else self._of_all[member]
        out._of_all = out._constant
        out._with_functions = ForceFunctions(PiecewiseConstantTorque(out._constant, None), self._functions)
        return out

    def of_steps(self, members: Indices, starts: Indices, count: int) -> Torque:
        """Return the force on members of a batch over `count` steps, from a step of its own on for each of them."""
        out = copy(self)
        if self._rows is not None:
            out._rows = self.at_steps(members, starts, count)
        elif self._constant.ndim > 1:
            out._constant = self._constant[members]
        out._of_all = self._of_all[members]
        return out

    def at_steps(self, members: Indices, starts: Indices, count: int) -> Array:
        """Return the rows of `of_steps`, (m, count, n); behind the last step they are those of the last one."""
        if self._rows is None:
            return np.broadcast_to(self._of_all[members][:, None], (len(members), count, self._size))
        k = np.minimum(starts[:, None] + np.arange(count), self._rows.shape[-2] - 1)
        return np.asarray(self._rows[k] if self._rows.ndim == 2 else self._rows[members[:, None], k])

    def over_states(self, member: int | None, start: int, count: int) -> Array | None:
        """Return the force that leads to each of some states of one trajectory, (count, n); None of functions."""
        if self._functions:
            return None
        own = self.of_part(member, start, start + count)
        return np.broadcast_to(own._constant if own._rows is None else own._rows, (count, self._size))

    def columns(self, members: Indices | slice, start: int, stop: int) -> Array:
        """Return an array's rows of steps start to stop for members of a batch: (steps, n, members or 1)."""
        if self._rows is None:
            constant = self._constant
            columns: Array = constant[:, None] if constant.ndim == 1 else constant[members, 0].T
            return np.broadcast_to(columns, (stop - start, *columns.shape))
        if self._rows.ndim == 2:
            return self._rows[start:stop, :, None]
        return np.ascontiguousarray(self._rows[members, start:stop].transpose(1, 2, 0))

    def over(self, start: int, stop: int) -> Array | None:
        """Return the rows of steps start to stop, (steps, nv) or (N, steps, nv); None where all are zero."""
        if self._rows is not None:
            return self._rows[..., start:stop, :]
        return np.asarray(np.tile(self._constant, (stop - start, 1))) if self._constant.any() else None

    def applied(self, bounds: Array | None) -> PiecewiseConstantTorque | ForceFunctions | None:
        """Return the force of a finished run, whose rows were held between `bounds`, s; None where it was zero."""
        held = PiecewiseConstantTorque(self._constant, None)
        if self._rows is not None:
            assert bounds is not None  # rows are read only where there are intervals
            held = PiecewiseConstantTorque(self._rows, bounds[:-1])
        if self._functions:
            return ForceFunctions(held, self._functions)
        return held if held.rows.any() or self.held else None


def _read(torque: ArrayLike, model: Model, batch: int | None, steps: int | None) -> Array:
    """Return an array of torques, checked."""
    allowed = [(model.nv,), (steps, model.nv), (batch, steps, model.nv)][
        : 1 if steps is None else 2 + (batch is not None)
    ]
    shape = _shape("torque", torque)
    if shape not in allowed:
        raise InputError(
            f"torque: expected shape {' or '.join(map(str, allowed))}, got {shape}; {model.name} has nv = {model.nv}"
            + _why(steps)
        )
    return finite_array("torque", torque, shape)


def _read_wrench(name: str, wrench: ArrayLike, batch: int | None, steps: int | None) -> Array:
    """Return an array of a wrench, checked, (6,), (steps, 6), (batch, steps, 6) or one row each, (batch, 1, 6)."""
    shape, each, held = _shape(name, wrench), (batch, 6), (steps, 6)
    allowed: list[tuple[int | None, ...]] = [(6,)]
    allowed += [] if batch is None else [each]
    allowed += [] if steps is None else [held]
    allowed += [] if batch is None or steps is None else [(batch, steps, 6)]
    if shape not in allowed:
        raise InputError(
            f"{name}: expected shape {' or '.join(map(str, allowed))}, got {shape}; force and moment are six numbers"
            + _why(steps)
        )
    if shape == each == held and batch != 1:
        raise InputError(
            f"{name}: shape {shape} may be one row for each trajectory or for each step; give ({batch}, {steps}, 6)"
        )
    array = finite_array(name, wrench, shape)
    return array[:, None] if shape == each else array


def _shape(name: str, value: ArrayLike) -> tuple[int, ...]:
    try:
        return np.shape(value)
    except ValueError:
        raise InputError(f"{name}: expected an array or a callable, got rows of different lengths") from None


def _why(steps: int | None) -> str:
    if steps is None:
        return "; one row per interval needs save=, times from 0 to the end of the run"
    return f" and the run has {steps} steps"
