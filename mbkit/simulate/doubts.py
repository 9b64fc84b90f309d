"""What speaks against a run that finished: energy that came from nowhere, steps too long, digits that are not there.

A run that ends early says so. One that ends with plausible numbers that are wrong does not, unless
somebody looks; this looks at a few of its states, at a cost that does not grow with the run.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.clock import at_times
from mbkit.errors import MbkitError
from mbkit.model.space import Space
from mbkit.simulate.along import along
from mbkit.simulate.balance import is_damped, kinetic_energy, potential_energy
from mbkit.simulate.methods import Method, Tolerances
from mbkit.simulate.stability import STEPS, growth
from mbkit.simulate.stiffness import linearized

__all__ = ["doubts"]

_EPS: Final = float(np.finfo(float).eps)
#: States and trajectories of a batch that are looked at.
_TIMES: Final = 7
_MEMBERS: Final = 4
#: Where a quantity is no longer inaccurate but wrong. A first-order method at a common step
#: oscillates in energy by a percent or so, and means no harm.
_ENERGY: Final = 0.05
_DIGITS: Final = 1e-3
#: h|λ| up to which any method follows a mode.
_RESOLVED: Final = 1.0
#: m or rad: what engineers still call a position.
_POSITION: Final = 1e-6


def doubts(
    dyn: Dynamics, method: Method, setting: float | Tolerances, t: Array, q: Array, v: Array, *, pushed: bool
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
    """
    nv = dyn.model.nv
    # The oracle's digits are not in doubt, and its terms take long.
    if len(t) < 2 or not nv or dyn.engine == "oracle":
        return []
    times = np.unique(np.linspace(0, len(t) - 1, _TIMES).astype(int))
    q, v = q[..., times, :], v[..., times, :]
    if q.ndim == 3:
        if dyn.samples is not None:
            # Each has parameters of its own.
            dyn = dyn.of_samples(list(range(min(_MEMBERS, len(q)))))
        q, v = q[:_MEMBERS], v[:_MEMBERS]
    here = at_times(dyn, t[times], len(q) if q.ndim == 3 else None)
    try:
        M = along(here, (nv, nv), lambda own, q: own.mass_matrix(q), q)
    except MbkitError:
        return []
    looks = [
        _energy(here, M, q, v, pushed),
        _condition(M),
        _far(q, setting if isinstance(setting, Tolerances) else None),
    ]
    if not isinstance(setting, Tolerances) and method.name in STEPS:
        # The cause is told before what came of it.
        looks.insert(0, _step(dyn, method.name, setting, float(t[-1]), q, v))
    found: list[str] = []
    for look in looks:
        try:
            found += look
        except (MbkitError, np.linalg.LinAlgError):
            # An engine that lacks a term, or has none there, has no opinion on it.
            continue
    return found


def _energy(dyn: Dynamics, M: Array, q: Array, v: Array, pushed: bool) -> Iterator[str]:
    """Hold against a run what nothing drives: its energy stays, or with dampers falls."""
    model = dyn.model
    if pushed or model.clock is not None or (model.written is not None and is_damped(model)):
        # What was written on paper may have forces that drive.
        return
    # Of a system on paper this is T2, and Jacobi's integral T2 - T0 + V is what stays.
    kinetic, potential = 0.5 * np.einsum("...i,...ij,...j->...", v, M, v), potential_energy(dyn, q)
    if model.written is not None:
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
    if share[worst] > _ENERGY:
        gained = "gained" if change[worst][np.abs(change[worst]).argmax()] > 0 or is_damped(model) else "lost"
        yield (
            f"{gained} {share[worst]:.2g} of its energy ({wrong[worst]:.2g} J) with nothing that drives it; "
            "take a smaller step, or method='auto'"
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
            "with 34 digits: mbkit.dynamics(model, 'oracle') and method='taylor'"
        )


def _step(dyn: Dynamics, method: str, h: float, duration: float, q: Array, v: Array) -> Iterator[str]:
    """Hold the step against the fastest mode of the motion's linearization, at its first and last state."""
    model = dyn.model
    if dyn.samples is not None or model.clock is not None or model.constrained:
        return
    states = [(q[..., k, :].reshape(-1, model.nq)[0], v[..., k, :].reshape(-1, model.nv)[0]) for k in (0, -1)]
    space, worst, told = Space(model), 0.0, ""

    def accelerations(q: Array, w: Array) -> Array:
        v = space.leave(q, w)
        return np.asarray(space.acceleration(q, v, dyn.forward_dynamics(q, v, np.zeros_like(v))))

    for at in states:
        if not all(np.isfinite(x).all() for x in at):
            continue
        # By differences on any engine: deriving would take longer than most runs.
        J = linearized(space, at[0], space.enter(*at), accelerations)
        A, B = J[model.nv :, : model.nv], J[model.nv :, model.nv :]
        rates = np.linalg.eigvals(J)
        fastest, swing = float(np.abs(rates).max()), float(np.abs(rates.imag).max())
        if h * fastest <= max(_RESOLVED, worst):
            continue
        worst = h * fastest
        # What the motion itself does, a pendulum upside down or a chaotic one, is not the method's doing.
        grows = np.log(max(growth(method, h, A, B), 1e-300)) - h * max(0.0, float(rates.real.max()))
        if grows * duration / h > 1:
            told = (
                f"a step of {h:g} s is too long for the fastest mode, {fastest:.2g} 1/s (h|λ| = {h * fastest:.2g}): "
                f"{method} makes it grow by {np.expm1(min(grows, 700.0)):.1g} a step; take a step below "
                f"{_RESOLVED / fastest:.1g} s, or method='auto'"
            )
        elif h * swing > _RESOLVED:
            told = (
                f"a step of {h:g} s is too long to follow an oscillation of {swing:.2g} rad/s (hω = {h * swing:.2g}): "
                f"where that is excited, its phase is lost; take a step below {0.1 / swing:.1g} s, or method='auto'"
            )
    if told:
        yield told


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
