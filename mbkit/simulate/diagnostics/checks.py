"""What speaks against a run that finished: energy that came from nowhere, steps too long, digits that are not there.

A run that ends early says so. One that ends with plausible numbers that are wrong does not, unless
somebody looks; this looks at a few of its states, at a cost that does not grow with the run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.base import DOUBLE_BITS, at_times
from mbkit.errors import MbkitError
from mbkit.methods.registry import ADAPTIVE_METHOD, AUTOMATIC_METHOD, SERIES_METHOD, Method, Tolerances
from mbkit.model import Model
from mbkit.model.integration_space import Space
from mbkit.simulate.along_trajectory import along, is_damped, kinetic_energy, potential_energy
from mbkit.simulate.diagnostics.eigenvalues import linearized
from mbkit.simulate.diagnostics.stability import growth, lost
from mbkit.simulate.solvers.vector_field import magnitude, unit_quaternions

__all__ = ["doubts", "halved", "idle"]

_EPS: Final = float(np.finfo(float).eps)
#: States and trajectories of a batch that are looked at.
_TIMES: Final = 7
_MEMBERS: Final = 4
#: Where a quantity is no longer inaccurate but wrong. A method of first or second order at a common step
#: oscillates in energy by some parts of a thousand, and means no harm; one of higher order has lost the motion.
_ENERGY: Final = 0.01
_ENERGY_HIGH: Final = 1e-3
_LOW: Final = (1, 2)
_DIGITS: Final = 1e-3
#: h|λ| below which every method follows every mode for as long as runs are.
_FOLLOWED: Final = 1e-3
#: Of the motion: a hundredth is wrong, and at a few times the gap is not yet the largest.
_OFF: Final = 0.008
_BEYOND: Final = 3.0
#: Of a mode's phase or amplitude, over a run. Where amplitudes are large the motion is off by two to four times that.
_LOST: Final = 0.02
_SUM: Final = 1e-3
#: Least eigenvalue of a mass matrix beside its largest, in units in which it has ones at a random configuration.
_IDLE: Final = 1e-7
#: m or rad: what engineers still call a position.
_POSITION: Final = 1e-6


def doubts(
    dyn: Dynamics,
    method: Method,
    setting: float | Tolerances,
    t: Array,
    q: Array,
    v: Array,
    *,
    pushed: bool,
    steps: int,
) -> list[str]:
    """Return what speaks against a run, in sentences with the measured reason and the remedy.

    Parameters
    ----------
    dyn : Dynamics
    method : Method
    setting : float or Tolerances
        The step, s, or what an adaptive method was given.
    t : (K,) array
    q, v : (K, nq), (K, nv) or (N, K, nq), (N, K, nv) arrays
        What was kept; states that are not finite are passed over.
    pushed : bool
        Whether a generalized force acted.
    steps : int
        Of all trajectories.
    """
    nv = dyn.model.nv
    # The oracle's digits are not in doubt, and its terms take long.
    if len(t) < 2 or not nv or not v.size or dyn.bits > DOUBLE_BITS:
        return []
    # The first trajectory's fastest state is where a step is longest for it.
    fastest = int(np.nan_to_num(np.abs(v.reshape(-1, *v.shape[-2:])[0]).max(axis=-1), posinf=0.0).argmax())
    ends = [_first(q, v, k) for k in sorted({0, fastest, len(t) - 1})]
    crossed, members = q, len(q) if q.ndim == 3 else 1
    times = np.unique(np.linspace(0, len(t) - 1, _TIMES).astype(int))
    q, v = q[..., times, :], v[..., times, :]
    if q.ndim == 3:
        if dyn.samples is not None:
            # Each has parameters of its own.
            dyn = dyn.of_samples(list(range(min(_MEMBERS, len(q)))))
        q, v = q[:_MEMBERS], v[:_MEMBERS]
    try:
        here = at_times(dyn, t[times], len(q) if q.ndim == 3 else None)
        M = along(here, (nv, nv), lambda own, q: own.mass_matrix(q), q)
    except MbkitError:
        return []
    looks = [
        _pole(dyn, crossed),
        _energy(here, M, q, v, pushed, _ENERGY if method.order in _LOW else _ENERGY_HIGH),
        [] if _keeps_digits(dyn, method) else _condition(M),
        _far(q, setting if isinstance(setting, Tolerances) and not method.scaled_by_start else None),
    ]
    if not isinstance(setting, Tolerances) and method.stability is not None:
        # The cause is told before what came of it.
        looks.insert(0, _step(dyn, method.name, setting, float(t[-1] - t[0]), ends))
    if isinstance(setting, Tolerances) and method.scaled_by_start:
        looks.append(_outgrown(q, v, setting))
    if isinstance(setting, Tolerances) and method.fills_tolerance:
        looks.append(_adding(method.name, setting, 2 * nv, steps / members))
    found: list[str] = []
    for look in looks:
        try:
            found += look
        except (MbkitError, np.linalg.LinAlgError):
            # An engine that lacks a term, or has none there, has no opinion on it.
            continue
    return found


def idle(dyn: Dynamics, q: Array) -> str:
    """Return which joints move next to no mass at a configuration, to stand behind a message; empty where all do."""
    model = dyn.model
    if not model.has_bodies or dyn.samples is not None or not model.nv:
        return ""
    try:
        there = dyn.mass_matrix(model.random_state(np.random.default_rng(0))[0])
        scale = np.sqrt(np.diag(there))
        values, vectors = np.linalg.eigh(dyn.mass_matrix(unit_quaternions(model, q)[0]) / scale[:, None] / scale)
    except (MbkitError, np.linalg.LinAlgError, NotImplementedError):
        # An engine of a user's own may lack the mass matrix.
        return ""
    if not values[0] < _IDLE * values[-1]:
        return ""
    part = np.abs(vectors[:, 0])
    found = [j for j in model.independent_joints if part[model.layout.v[j.name]].max(initial=0.0) > 0.5 * part.max()]
    names = " and ".join(repr(j.name) for j in found)
    lock = " (gimbal lock)" if any(len(j.type.angular) > 1 for j in found) else ""
    return f"; there joint {names} moves next to no mass{lock}, so that the mass matrix is nearly singular"


def halved(
    model: Model,
    method: str,
    h: float,
    states: tuple[Array, Array, Array],
    coarser: Callable[[Array], tuple[Array, Array] | None],
) -> Iterator[str]:
    """Hold a run by a method of first order against that of twice the step: the gap is about the error.

    Parameters
    ----------
    model : Model
    method : str
    h : float
        s.
    states : arrays
        t, q and v that were kept, with the start.
    coarser : callable
        Returns q and v at some times with twice the step; None where that failed.
    """
    t, q, v = states[0], *(x.reshape(-1, *x.shape[-2:])[0] for x in states[1:])
    # A longer last step would be another run's.
    if not np.isfinite(q).all():
        return
    both = np.flatnonzero(np.abs(t / (2 * h) - np.rint(t / (2 * h))) < 1e-6)[1:]
    if not len(both):
        return
    both = both[np.unique(np.linspace(0, len(both) - 1, _TIMES).astype(int))]
    motion = float(np.abs(model.difference(np.broadcast_to(q[0], q.shape), q)).max(initial=0.0))
    found = coarser(t[both])
    if found is None or not motion:
        return
    if np.abs(found[1]).max() > _BEYOND * np.abs(v).max():
        # Unstable at twice the step: that says nothing of the step that was taken.
        return
    off = float(np.abs(model.difference(q[both], found[0])).max()) / motion
    if off > _OFF:
        yield (
            f"by a run with a step of {2 * h:g} s it is off by {off:.2g} of the motion, since {method} is of "
            f"first order; take a smaller step, or method={AUTOMATIC_METHOD!r}"
        )


def _first(q: Array, v: Array, k: int) -> tuple[Array, Array]:
    """Return the k-th state of the first trajectory."""
    return q.reshape(-1, *q.shape[-2:])[0, k], v.reshape(-1, *v.shape[-2:])[0, k]


def _energy(dyn: Dynamics, M: Array, q: Array, v: Array, pushed: bool, most: float) -> Iterator[str]:
    """Hold against a run what nothing drives: its energy stays, or with dampers falls."""
    model = dyn.model
    if pushed or model.time_parameter is not None or (not model.has_bodies and is_damped(model)):
        # What was written on paper may have forces that drive.
        return
    # Of a system on paper this is T2, and Jacobi's integral T2 - T0 + V is what stays.
    kinetic, potential = 0.5 * np.einsum("...i,...ij,...j->...", v, M, v), potential_energy(dyn, q)
    if not model.has_bodies:
        kinetic = kinetic - kinetic_energy(dyn, q, 0 * v)
    total = kinetic + potential
    whole = np.isfinite(total).all(axis=-1)
    if not whole.any():
        return
    kinetic, potential, total = (np.atleast_2d(x[whole] if x.ndim == 2 else x) for x in (kinetic, potential, total))
    size = np.maximum(np.abs(kinetic).max(axis=1), np.ptp(potential, axis=1))
    floor = 1e4 * _EPS * np.abs(potential).max(axis=1)
    change = total - total[:, :1]
    wrong = change.max(axis=1) if is_damped(model) else np.abs(change).max(axis=1)
    share = np.where(wrong > floor, wrong / np.maximum(size, np.finfo(float).tiny), 0.0)
    worst = int(share.argmax())
    if share[worst] > most:
        gained = "gained" if change[worst][np.abs(change[worst]).argmax()] > 0 or is_damped(model) else "lost"
        yield (
            f"{gained} {share[worst]:.2g} of its energy ({wrong[worst]:.2g} J) with nothing that drives it; "
            f"take a smaller step, or method={AUTOMATIC_METHOD!r}"
        )


def _pole(dyn: Dynamics, q: Array) -> Iterator[str]:
    """Look for steps over gimbal lock, after which three angles are those of another sheet."""
    if not dyn.model.has_bodies:
        return
    for joint in dyn.model.independent_joints:
        if joint.type.gimbal is not None:
            side = np.sign(np.cos(q[..., dyn.model.layout.q[joint.name].start + joint.type.gimbal]))
            if (side != side[..., :1])[np.isfinite(side)].any():
                yield (
                    f"joint {joint.name!r} was stepped over gimbal lock: its pose holds, and its first and last angle "
                    "may be off by π each; take a ball joint, whose quaternion has no pole"
                )


def _condition(M: Array) -> Iterator[str]:
    """Look for digits that solving with the mass matrix loses, whatever the units of its coordinates."""
    M = M.reshape(-1, *M.shape[-2:])
    M = M[np.isfinite(M).all(axis=(1, 2))]
    if not len(M):
        return
    M = M[[0, len(M) // 2, -1]]
    scale = np.sqrt(np.diagonal(M, axis1=1, axis2=2))
    if not (scale > 0).all():
        return
    least = np.linalg.eigvalsh(M / scale[:, :, None] / scale[:, None, :])[:, 0].min()
    if least < _EPS * M.shape[-1] / _DIGITS:
        yield (
            f"the mass matrix is singular to {max(float(least), 0.0):.1g} of its size, so that accelerations hold "
            f"about {max(0, int(-np.log10(_EPS / max(least, _EPS)))):d} digits; leave out what has no mass, or compute "
            f"with 34 digits: mbkit.dynamics(model, 'oracle') and method={SERIES_METHOD!r}"
        )


def _step(dyn: Dynamics, method: str, h: float, duration: float, states: list[tuple[Array, Array]]) -> Iterator[str]:
    """Hold the step against the modes of the motion's linearization, at its first, last and fastest state."""
    model = dyn.model
    if dyn.samples is not None or model.time_parameter is not None or model.constrained:
        return
    space = Space(model)

    def accelerations(q: Array, w: Array) -> Array:
        v = space.leave(q, w)
        return np.asarray(space.acceleration(q, v, dyn.forward_dynamics(q, v, np.zeros_like(v))))

    found: list[tuple[float, str]] = []
    for q, v in states:
        if not (np.isfinite(q).all() and np.isfinite(v).all()):
            continue
        # By differences on any engine: deriving would take longer than most runs.
        J = linearized(space, q, space.enter(q, v), accelerations)
        A, B = J[model.nv :, : model.nv], J[model.nv :, model.nv :]
        rates = np.linalg.eigvals(J)
        fastest = float(np.abs(rates).max())
        if h * fastest < _FOLLOWED:
            continue
        # What the motion itself does, a pendulum upside down or a chaotic one, is not the method's doing.
        grows = float(np.log(max(growth(method, h, A, B), 1e-300))) - h * max(0.0, float(rates.real.max()))
        if grows * duration / h > 1 and h * fastest > 1:
            told = (
                f"a step of {h:g} s is too long for the fastest mode, {fastest:.2g} 1/s (h|λ| = {h * fastest:.2g}): "
                f"{method} makes it grow by {np.expm1(min(grows, 700.0)):.1g} a step; take a step below "
                f"{1 / fastest:.1g} s, or method={AUTOMATIC_METHOD!r}"
            )
            found.append((np.inf, told))
            continue
        part, rate = lost(method, h, A, B, duration)
        if part > _LOST:
            kind = f"an oscillation of {abs(rate.imag):.2g} rad/s" if abs(rate.imag) > abs(rate.real) else "a motion"
            told = (
                f"a step of {h:g} s is too long to follow {kind} with h|λ| = {h * abs(rate):.2g}: where it is "
                f"excited, {min(1.0, part):.0%} of it is lost over the run; take a smaller step, "
                f"or method={AUTOMATIC_METHOD!r}"
            )
            found.append((part, told))
    if found:
        yield max(found)[1]


def _far(q: Array, tolerances: Tolerances | None) -> Iterator[str]:
    """Look for coordinates so large that their last digit, or a relative tolerance, is a distance that matters."""
    finite = q[np.isfinite(q).all(axis=-1)]
    if not finite.size:
        return
    largest = float(np.abs(finite).max())
    if _EPS * largest > _POSITION:
        yield (
            f"a coordinate of {largest:.2g} is known to {_EPS * largest:.1g} in double precision; "
            "count it from a nearer origin"
        )
    elif tolerances is not None and tolerances.rtol * largest > max(1e3 * tolerances.atol, _POSITION):
        yield (
            f"rtol = {tolerances.rtol:g} of a coordinate of {largest:.2g} allows an error of "
            f"{tolerances.rtol * largest:.1g} in each step; count it from a nearer origin, or take a smaller rtol"
        )


def _outgrown(q: Array, v: Array, tolerances: Tolerances) -> Iterator[str]:
    """Look for numbers that have outgrown those of the start, and what their tolerance allows to the others."""
    largest = max(float(np.nan_to_num(np.abs(x), posinf=0.0).max()) for x in (q, v))
    allowed = min(tolerances) * largest / magnitude(q[..., 0, :], v[..., 0, :])
    if allowed > max(1e3 * tolerances.atol, _POSITION):
        yield (
            f"the state grew to {largest:.2g}, of which the tolerance allows an error of {allowed:.1g} to all "
            f"numbers in each step; take a smaller rtol, or method={ADAPTIVE_METHOD!r}"
        )


def _keeps_digits(dyn: Dynamics, method: Method) -> bool:
    """Return whether no accelerations come from the mass matrix: not by the engine, nor by the method."""
    return getattr(dyn, "elimination", "") == "least constraint" and not method.mass_matrix


def _adding(method: str, tolerances: Tolerances, numbers: int, steps: float) -> Iterator[str]:
    """Look for so many steps that the errors allowed to each add up."""
    # The norm is a mean over the state's numbers.
    together = steps * tolerances.rtol * float(np.sqrt(numbers))
    if together > _SUM:
        yield (
            f"errors of {steps:.2g} steps that each use the tolerance of {tolerances.rtol:g}, as those of {method} do, "
            f"add up to {together:.1g} of the motion and more; take a smaller rtol, or method={AUTOMATIC_METHOD!r}"
        )
