"""What acts in a run: the generalized force and wrenches on frames; zero, an array held over each step, or a function.

A force in this module is τ, (nv,), and behind it six numbers for each frame with a wrench. A wrench is what is held:
its generalized force Σ Jᵀ w follows the configuration within a step (`mbkit.engines.Dynamics._under`).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, finite_array
from mbkit.errors import InputError, TorqueError, UnsupportedError
from mbkit.model import Model
from mbkit.simulate.time_grid import Indices

_DOUBLE = np.dtype(np.float64)
#: torque(t, q, v) -> (nv,), of one state; of a wrench (6,)
TorqueFunction = Callable[[float, Array, Array], ArrayLike]
#: Wrenches by the names of the frames on which they act.
RunWrenches = Mapping[str, ArrayLike | TorqueFunction]


def within(limits: Array | None, force: Array) -> Array:
    """Return a force whose amounts are at most the limits, (n,); the same numbers where they are, or without limits."""
    return force if limits is None else np.minimum(np.maximum(force, -limits), limits)


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
        #: Effort limits, (nv,), of a run that saturates.
        self._limits: Array | None = None

    def __call__(self, t: float, q: Array, v: Array) -> Array:  # noqa: ARG002  # the same at any time
        """Return the torque at one state, (nv,), or at those of a batch, (N, nv)."""
        return np.asarray(within(self._limits, self._constant - np.concatenate([q, v], axis=-1) @ self.gain.T))

    def __repr__(self) -> str:
        nv, nx = self.gain.shape
        return f"<StateFeedback of {nx} numbers to {nv} torques>"

    @property
    def pattern(self) -> str:
        """Which entries of the gain are not zero, row after row, and which torques are limited, as digits of bits."""
        bits = [self.gain.ravel() != 0, *([] if self._limits is None else [np.isfinite(self._limits)])]
        return np.packbits(np.concatenate(bits)).tobytes().hex()

    @property
    def numbers(self) -> Array:
        """Constants, entries of the gain that are not zero and limits, as compiled steps take them."""
        limits = np.full(1, np.inf) if self._limits is None else self._limits
        return np.concatenate([self._constant, self.gain[self.gain != 0], limits[np.isfinite(limits)]])


class Policy:
    """A torque function of many states: one call computes the torques of all trajectories of a batch.

    With a fixed step it is called once for each stage, or with ``hold`` once for each sample. An adaptive method has
    steps of its own for each trajectory, and asks for few of them or one.

    Parameters
    ----------
    function : callable
        function(t, q, v, members) -> (m, nv), of the time in s, states (m, nq) and (m, nv), and the indices (m,) of
        the trajectories that these are the states of: a trajectory that ended is not asked for. A run of one state
        has the index 0.

    Raises
    ------
    InputError
        No callable.

    Examples
    --------
    >>> import numpy as np, mbkit as mb
    >>> targets = np.array([[0.5], [1.0]])
    >>> servo = mb.simulate.Policy(lambda t, q, v, members: 20 * (targets[members] - q) - 4 * v)
    >>> dyn = mb.dynamics(mb.catalog.pendulum())
    >>> run = mb.simulate(dyn, np.zeros((2, 1)), [0.0], 0.1, dt=1e-3, torque=servo, hold=0.01)
    >>> print(run.tau[:, 0, 0])
    [10. 20.]
    """

    def __init__(self, function: Callable[[float, Array, Array, Indices], ArrayLike]) -> None:
        if not callable(function):
            raise InputError(f"function: expected a callable of (t, q, v, members), got {type(function).__name__}")
        self.function = function

    def __call__(self, t: float, q: Array, v: Array) -> Array:
        """Return the torque at one state, (nv,)."""
        return np.asarray(np.asarray(self.function(t, q[None], v[None], np.zeros(1, dtype=np.intp)))[0])


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
        if isinstance(self.function, Policy):
            return np.asarray(self.many(t, q[None], v[None], np.array([member or 0]))[0])
        try:
            # Copies: the function may write into them.
            value = self.function(t, q.copy(), v.copy())
        except TorqueError:
            # A function within this one failed.
            raise
        except Exception as error:
            raise self.failure(error, t, member) from error
        return self.checked(value, t, member)

    def many(self, t: float, q: Array, v: Array, members: Indices) -> Array:
        """Return the forces on states of these members of a batch, (m, size)."""
        if isinstance(self.function, StateFeedback):
            return self.checked(self.function(t, q, v), t, count=len(q))
        if not isinstance(self.function, Policy):
            each = zip(q, v, members.tolist(), strict=True)
            return np.array([self.one(t, *state).copy() for state in each]).reshape(-1, self.size)
        try:
            value = self.function.function(t, q.copy(), v.copy(), members.copy())
        except Exception as error:
            raise self.failure(error, t) from error
        return self.checked(value, t, count=len(q))

    def failure(self, error: Exception, t: float, member: int | None = None) -> TorqueError:
        """Return the error of a function that raised one."""
        what = f"{type(error).__name__} {_when(t, member)}: {error}"
        failed = TorqueError(f"{self.name}: the callable raised {what}")
        failed.__cause__ = error
        return failed

    def checked(self, value: Any, t: float, member: int | None = None, count: int | None = None) -> Array:
        """Return the answer of a function for one state or so many; the caller copies it before it asks again."""
        shape = (self.size,) if count is None else (count, self.size)
        plain = type(value) is np.ndarray and value.dtype == _DOUBLE and value.shape == shape
        # The checks below take as long as a step.
        if plain and isfinite(np.vdot(value, value)):
            return np.asarray(value)
        try:
            return finite_array(self.name, value, shape)
        except InputError as error:
            raise TorqueError(f"{error}; it is what the callable returned {_when(t, member)}") from None
        except Exception as error:
            raise TorqueError(
                f"{self.name}: expected an array of numbers, got {type(value).__name__}; "
                f"it is what the callable returned {_when(t, member)}"
            ) from error


def _when(t: float, member: int | None) -> str:
    return f"at t = {t:.9g} s" + ("" if member is None else f" for trajectory {member}")


#: Numbers of a force, and the function that returns them.
Functions = tuple[tuple[slice, TorqueCallback], ...]


def _on(
    functions: Functions, rows: Array, t: float, q: Array, v: Array, members: Any = None, limits: Array | None = None
) -> Array:
    """Return the force on one state, or on those of these members of a batch, with the held numbers of rows."""
    out = np.array(rows)
    for part, function in functions:
        out[..., part] = (function.one if q.ndim == 1 else function.many)(t, q, v, members)
    return within(limits, out)


@dataclass(frozen=True, eq=False)
class ForceFunctions:
    """A force of which some numbers are functions of the state; `held` has the others."""

    held: PiecewiseConstantTorque
    functions: Functions

    def sampled(self, t: Array, q: Array, v: Array, *, strict: bool) -> SampledTorque:
        """Return the values at saved states; NaN where one is not finite or, unless strict, a function fails."""
        held = self.held.at(t)
        rows = np.broadcast_to(held, (*v.shape[:-1], held.shape[-1]))
        out, good = np.full(rows.shape, np.nan), np.isfinite(q).all(-1) & np.isfinite(v).all(-1)
        groups: Iterable[Any] = zip(*np.nonzero(good), strict=True)
        if v.ndim == 3 and all(isinstance(x.function, (Policy, StateFeedback)) for _, x in self.functions):
            groups = ((np.flatnonzero(x), k) for k, x in enumerate(np.asarray(good.T)) if x.any())
        for index in groups:
            members = index[0] if v.ndim == 3 else None
            try:
                out[index] = _on(self.functions, rows[index], float(t[index[-1]]), q[index], v[index], members)
            except TorqueError:
                if strict:
                    raise
        return SampledTorque(out)


Applied = PiecewiseConstantTorque | ForceFunctions | SampledTorque


#: The force during one step: an array, or a function of (t, q, v) of one state or a batch. A function of a batch takes
#: as a fourth argument which of its trajectories the states are of, where they are not all.
Force = Array | Callable[..., Array]


@dataclass(frozen=True, eq=False)
class Samples:
    """When a controller is asked, and whom it has answered: sample s acts from step begins[s] to begins[s + 1]."""

    controller: TorqueCallback
    begins: list[int]
    #: Samples so far of each trajectory, (N,).
    asked: Indices
    #: Each step has a row of its own in the table of forces, not each sample.
    fine: bool

    def at(self, k: int) -> int:
        """Return which sample acts in step k."""
        return bisect_right(self.begins, k) - 1

    def row(self, k: int) -> int:
        """Return the row of the table that acts in step k."""
        return k if self.fine else self.at(k)

    def rows(self, s: int) -> slice:
        """Return the rows that sample s fills."""
        return slice(self.begins[s], self.begins[s + 1]) if self.fine else slice(s, s + 1)


class Torque:
    """The arguments `torque` and `wrenches` of a run, checked, and read step by step.

    As an array, τ is (nv,), (steps, nv) or (batch, steps, nv), and a wrench (6,), (batch, 6), (steps, 6) or
    (batch, steps, 6); without `steps` nothing may change in time. A sampled torque is such a table, of which a
    controller fills in each row when the run gets there (`sample`). Rows and functions have what is asked for; whoever
    reads them gets τ within its `limits`.
    """

    #: When a sampled torque is asked; and which trajectory a part of a run is, and the step with which it begins.
    samples: Samples | None = None
    _member: int | None = None
    _first = 0

    def __init__(
        self,
        torque: ArrayLike | TorqueFunction | None,
        model: Model,
        batch: int | None,
        steps: int | None,
        wrenches: RunWrenches | None = None,
        limits: Array | None = None,
    ) -> None:
        parts: list[tuple[slice, Array]] = []
        functions: list[tuple[slice, TorqueCallback]] = []
        size, self._nv, self._batch = model.nv, model.nv, batch
        #: The state feedback where nothing else acts.
        self.feedback = torque if isinstance(torque, StateFeedback) and not wrenches else None
        if isinstance(torque, StateFeedback) and torque.gain.shape != (model.nv, model.nq + model.nv):
            raise InputError(
                f"torque: expected a gain of shape {(model.nv, model.nq + model.nv)}, (nv, nq + nv) of {model.name}, "
                f"got {torque.gain.shape}"
            )
        if callable(torque):
            functions.append((slice(0, model.nv), TorqueCallback(torque, model.nv)))
        elif torque is not None:
            about = f"{model.name} has nv = {model.nv}"
            parts.append((slice(0, model.nv), _read("torque", torque, model.nv, batch, steps, about)))
        for frame, wrench in (wrenches or {}).items():
            part, size = slice(size, size + 6), size + 6
            name = f"wrench on {frame!r}"
            if callable(wrench):
                functions.append((part, TorqueCallback(wrench, 6, name)))
            else:
                about = "force and moment are six numbers"
                parts.append((part, _read(name, wrench, 6, batch, steps, about, each=True)))
        #: Whether the force jumps between steps.
        self.held = any(x.ndim > 1 and (x.shape[:-1] != (batch, 1) or steps == 1) for _, x in parts)
        #: Rows that are held, one for each step, or sample, or one for all: (rows, n), or (N, rows, n).
        if len(parts) == 1 and size == model.nv:
            self.table = np.atleast_2d(parts[0][1])
        else:
            self.table = np.zeros((*(np.broadcast_shapes(*(x.shape[:-1] for _, x in parts)) or (1,)), size))
            for part, x in parts:
                self.table[..., part] = x
        self._functions: Functions = tuple(functions)
        #: Effort limits of τ, and infinite ones of wrenches, (n,); None where the run does not saturate.
        self.limits = None if limits is None else np.append(limits, np.full(size - model.nv, np.inf))
        if self.feedback is not None and limits is not None:
            self.feedback = copy(self.feedback)
            self.feedback._limits = limits

    @classmethod
    def of_force(cls, force: Array, model: Model) -> Torque:
        """Return a constant force, (n,) or of a batch (N, n): τ, and behind it what wrenches there are."""
        out = cls(None, model, None if force.ndim == 1 else len(force), None)
        out.table = force[..., None, :]
        return out

    @property
    def in_each_step(self) -> bool:
        """Whether each step may have another force, and not each sample alone."""
        return self.held and (self.samples is None or self.samples.fine)

    @property
    def callable(self) -> bool:
        """Whether the force is a function of the state."""
        return bool(self._functions)

    # The rows

    def rows(self, k: range | Indices, members: int | Indices | slice | None = None) -> Array:
        """Return what is held in steps k: (count, n), or (m, count, n) where members of a batch differ.

        Steps in an array may be those of each member, (m, count); behind the last step, or the last answer of a
        controller, they are the last one.
        """
        table, places = self.table, self._places(k, members)
        if table.ndim == 2:
            return within(self.limits, np.asarray(table[places]))
        if members is None:
            members = slice(None)
        elif isinstance(members, np.ndarray) and not isinstance(places, slice):
            members = members[:, None]
        return within(self.limits, np.asarray(table[members, places]))

    def _places(self, k: range | Indices, members: Any) -> slice | Indices:
        """Return which rows of the table act in steps."""
        samples = self.samples
        if isinstance(k, range) and (self.in_each_step or len(k) == 1):
            place = self._place(k.start)
            return slice(place, place + len(k))
        steps = np.asarray(k) + self._first
        if not self.held:
            return np.zeros(steps.shape, dtype=np.intp)
        if samples is not None and not samples.fine:
            steps = np.searchsorted(samples.begins, steps, side="right") - 1
        if isinstance(k, range):
            return steps
        last: Any = self.table.shape[-2] - 1
        if samples is not None:
            asked = samples.asked[slice(None) if members is None else members]
            last = (np.array(samples.begins)[asked] if samples.fine else asked) - 1
            last = last[:, None] if isinstance(members, np.ndarray) else last
        return np.asarray(np.minimum(steps, last))

    def _place(self, k: int) -> int:
        """Return which row of the table acts in a step."""
        step = self._first + k
        return 0 if not self.held else step if self.samples is None else self.samples.row(step)

    def columns(self, members: Indices | slice, start: int, stop: int) -> Array:
        """Return the rows of steps start to stop side by side, (steps, n, members or 1)."""
        rows = self.rows(range(start, stop), members)
        return rows[:, :, None] if rows.ndim == 2 else np.ascontiguousarray(rows.transpose(1, 2, 0))

    def during(self, k: int, members: int | Indices | None) -> Force:
        """Return the force during step k on a single state, on one of a batch, or on these members of it."""
        row, functions, limits = self.table[..., self._place(k), :], self._functions, self.limits
        if members is None or isinstance(members, int):
            row = row if row.ndim == 1 else row[members]
            return partial(_on, functions, row, members=members, limits=limits) if functions else within(limits, row)
        rows = row[members] if row.ndim == 2 else np.broadcast_to(row, (len(members), len(row)))
        if not functions:
            return within(limits, rows)

        def many(t: float, q: Array, v: Array, part: Any = slice(None)) -> Array:
            return _on(functions, rows[part], t, q, v, members[part], limits)

        return many

    def of_member(self, i: int | None) -> Callable[[int], Force]:
        """Return a function of the step that returns the force on one state (of a batch)."""
        return partial(self.during, members=i)

    # Parts of a run

    def of_part(self, member: int | None, start: int) -> Torque:
        """Return the force of one trajectory from step `start` on, as that of a run of one state."""
        out = copy(self)
        out._first = self._first + start
        if member is not None:
            out._member, out._batch = member, None
            out.table = self.table[member] if self.table.ndim == 3 else self.table
            if self.samples is not None:
                out.samples = replace(self.samples, asked=self.samples.asked[member : member + 1])
        return out

    def of_steps(self, members: Indices | None, starts: Indices | int, count: int) -> Torque:
        """Return the force over `count` steps, from a step of its own on for each of these members of a batch."""
        out = copy(self)
        if self.held:
            steps = np.arange(count) + (starts if members is None else np.asarray(starts)[:, None])
            out.table, out.samples, out._first = self.rows(steps, members), None, 0
        elif members is not None and self.table.ndim == 3:
            out.table = self.table[members]
        return out

    # Samples

    def sampled(self, controller: TorqueFunction, begins: list[int], table: Indices | None = None) -> Torque:
        """Return this force with the torque that a controller gives for the steps from each of `begins` to the next.

        Where the force has rows, `table` has the row of each step; by default one after the other.
        """
        out, lead = copy(self), () if self._batch is None else (self._batch,)
        rows = self.table if table is None or not self.held else self.table[..., table, :]
        count = rows.shape[-2] if self.held else len(begins) - 1
        # Nothing is known of a torque that was never sampled.
        out.table, out.held = np.full((*lead, count, rows.shape[-1]), np.nan), True
        out.table[..., self._nv :] = rows[..., self._nv :]
        asked = np.zeros(lead or 1, dtype=np.intp)
        out.samples = Samples(TorqueCallback(controller, self._nv), begins, asked, fine=self.held)
        return out

    def sample(self, k: int, t: float, q: Array, v: Array, members: Indices | None = None) -> None:
        """Ask a sampled torque for its value from step k on, of the states of these members; a single run has one.

        A trajectory that was asked there already is not asked again, so that whoever begins with a step may ask.
        """
        samples = self.samples
        if samples is None:
            return
        s = samples.at(self._first + k)
        if self._batch is None or members is None:
            if samples.asked[0] <= s:
                state = np.atleast_2d(q)[0], np.atleast_2d(v)[0]
                self.table[samples.rows(s), : self._nv] = samples.controller.one(t, *state, self._member)
                samples.asked[0] = s + 1
            return
        new = samples.asked[members] <= s
        if new.any():
            if not new.all():
                q, v, members = q[new], v[new], members[new]
            answers = samples.controller.many(t, q, v, members)
            self.table[members, samples.rows(s), : self._nv] = answers[:, None]
            samples.asked[members] = s + 1

    def next_sample(self, k: int, steps: int) -> int:
        """Return the first step behind k at which a sampled torque is asked, or how many `steps` there are."""
        begins = [] if self.samples is None else self.samples.begins
        i = bisect_right(begins, self._first + k)
        return begins[i] - self._first if i < len(begins) else steps

    def changes(self, steps: int) -> list[int]:
        """Return the steps, of so many, at which a sampled torque is asked."""
        begins = [] if self.samples is None else self.samples.begins[:-1]
        return [k - self._first for k in begins if 0 <= k - self._first < steps] if self._first else begins

    def applied(self, bounds: Array | None) -> PiecewiseConstantTorque | ForceFunctions | None:
        """Return the force that a run asks for, with rows held between `bounds`, s; None where it is zero."""
        if self.held:
            assert bounds is not None  # rows are read only where there are intervals
            which = slice(-1) if self.in_each_step or self.samples is None else self.samples.begins[:-1]
            held = PiecewiseConstantTorque(self.table, bounds[which])
        else:
            held = PiecewiseConstantTorque(self.table if self.table.ndim == 3 else self.table[0], None)
        if self._functions:
            return ForceFunctions(held, self._functions)
        return held if self.held or held.rows.any() else None


def _read(
    name: str, value: ArrayLike, size: int, batch: int | None, steps: int | None, about: str, *, each: bool = False
) -> Array:
    """Return an array of a force, checked; one row for each trajectory becomes (batch, 1, size).

    `each` is whether each trajectory may have one row, (batch, size).
    """
    shape, held = _shape(name, value), (steps, size)
    one = (batch, size) if each else (None,)
    allowed = [x for x in ((size,), one, held, (batch, steps, size)) if None not in x]
    if shape not in allowed:
        why = f" and the run has {steps} steps"
        if steps is None:
            why = "; one row per interval needs save=, times from 0 to the end of the run"
        raise InputError(f"{name}: expected shape {' or '.join(map(str, allowed))}, got {shape}; {about}{why}")
    if shape == one == held and batch != 1:
        raise InputError(
            f"{name}: shape {shape} may be one row for each trajectory or for each step; "
            f"give ({batch}, {steps}, {size})"
        )
    array = finite_array(name, value, shape)
    return array[:, None] if shape == one else array


def _shape(name: str, value: ArrayLike) -> tuple[int, ...]:
    try:
        return np.shape(value)
    except ValueError:
        raise InputError(f"{name}: expected an array or a callable, got rows of different lengths") from None
