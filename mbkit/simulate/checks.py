"""Signs that a finished run is wrong: energy drift, unstable steps, lost digits.

A few of the run's states are evaluated, so that the cost does not grow with the run.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np

from mbkit._check import DOUBLE_BITS, EPS, ROUNDING, Array
from mbkit.engines import Dynamics
from mbkit.engines.base import at_time
from mbkit.engines.constrained import off_by
from mbkit.errors import MbkitError
from mbkit.methods.registry import ADAPTIVE_METHOD, AUTOMATIC_METHOD, SERIES_METHOD, Method, Tolerances
from mbkit.methods.stability import companion
from mbkit.model.integration_space import Space
from mbkit.model.manifold import magnitude, unit_quaternions
from mbkit.simulate.stiffness_measure import linearized

#: Most times at which the mass matrix and the energy are evaluated.
CHECKED_TIMES: Final = 7
#: Most trajectories of a batch for which they are.
_CHECKED_MEMBERS: Final = 4
#: Number of the run's evaluations in machine code for which a quick check evaluates one state: a few percent of its
#: time.
_EVALUATIONS_PER_STATE: Final = 3000
#: Largest difference of a step from two of half its length, relative to the step, of a method of order 1, and to the
#: power of the order of others: that of h|λ| = 1.
_MAX_HALVING_DIFFERENCE: Final = 0.3
#: Number of saved velocities among which a quick check looks for the largest kinetic energy.
_SAMPLED_VELOCITIES: Final = 32
#: Largest relative change of the energy by a method of first or second order, which oscillates by some parts of a
#: thousand at a common step, and by one of higher order, which has lost the motion by then.
_MAX_ENERGY_CHANGE_LOW_ORDER: Final = 0.01
_MAX_ENERGY_CHANGE_HIGH_ORDER: Final = 1e-3
_LOW_ORDERS: Final = (1, 2)
#: Largest relative error of accelerations by rounding.
_MAX_ROUNDING: Final = 1e-3
#: Largest h|λ| with which every method follows every mode for as long as runs are.
_MAX_FOLLOWED_STEP: Final = 1e-3
#: Largest loss of a mode's phase or amplitude over a run. Where amplitudes are large the motion is off by 2 to 4 times
#: that.
_MAX_MODE_LOSS: Final = 0.02
#: Largest sum of the errors that a tolerance allows, relative to the motion.
_MAX_ERROR_SUM: Final = 1e-3
#: Share of a run by whose end a transient has decayed.
_TRANSIENT_SHARE: Final = 0.01
#: Largest ratio of the mass matrix's smallest eigenvalue to its largest at which a joint moves next to no mass, where
#: a random configuration has a unit diagonal.
_MAX_EIGENVALUE_RATIO: Final = 1e-7
#: Largest velocity of a state at rest, m/s or rad/s: rounding of its projection.
_MAX_REST_VELOCITY: Final = 1e3 * EPS
#: Smallest motion of a run in units of `atol`, of which a hundredth is known.
_MIN_MOTION: Final = 100.0
#: Largest error of a position, m or rad.
_MAX_POSITION_ERROR: Final = 1e-6


def diagnostics(
    dyn: Dynamics,
    method: Method,
    setting: float | Tolerances,
    states: tuple[Array, Array, Array],
    *,
    driven: bool,
    steps: int,
    work: int | None = None,
) -> list[str]:
    """Return the signs that a run is wrong, each with its measured reason and a remedy.

    `states` are t, (N, K, ·) or (K, ·) q and v, with the start. `work` are the run's evaluations, each counted as the
    time of one in machine code: with it the checks take a few percent of that time, and the step is not checked.
    """
    t, model, quick = states[0], dyn.model, work is not None
    # The oracle's digits are not in doubt, and its terms take long.
    if len(t) < 2 or not model.nv or not states[2].size or dyn._significand_bits > DOUBLE_BITS:
        return []
    q, v = (x.reshape(-1, *x.shape[-2:]) for x in states[1:])
    most = _CHECKED_MEMBERS * CHECKED_TIMES if work is None else work // _EVALUATIONS_PER_STATE
    # The forces of a system on paper may drive it.
    free = not (driven or model.constraints_do_work or (not model.has_bodies and model.needs.damping))
    if most < 2 and free and not isinstance(setting, Tolerances) and _rushes(dyn, method, setting, q, v):
        most = 2
    members = max(1, min(_CHECKED_MEMBERS, len(q), most // 2))
    count = max(2, min(CHECKED_TIMES, most // members))
    times = sorted({k * (len(t) - 1) // (count - 1) for k in range(count)})
    at_q, at_v = q[:members].take(times, axis=1), v[:members].take(times, axis=1)
    samples: list[list[_Sample]] = [[] for _ in range(members)]
    try:
        if most >= 2:
            samples = [list(_samples(dyn, i, t.take(times), at_q[i], at_v[i])) for i in range(members)]
    except MbkitError:
        return []
    tolerances = setting if isinstance(setting, Tolerances) else None
    checks = [gimbal_lock(dyn, q)]
    if not isinstance(setting, Tolerances) and not quick and method.stability is not None:
        # The cause before its consequences.
        checks.insert(0, step_size(_smooth(dyn), method, setting, float(t[-1] - t[0]), q[0], v[0]))
    if most >= 2 and free:
        whole = [i for i in range(members) if len(samples[i]) == len(times)]
        fast = [_fastest(v[i]) if quick else at_v[i, 0] for i in whole]
        limit = _MAX_ENERGY_CHANGE_LOW_ORDER if method.order in _LOW_ORDERS else _MAX_ENERGY_CHANGE_HIGH_ORDER
        damped = model.loses_energy or dyn._soft_limits or (model.constrained and dyn._soft_constraints)
        checks.append(energy_drift([samples[i] for i in whole], fast, damped, limit))
    # Neither the engine nor the method may solve with the mass matrix.
    matrices = [one.M for member in samples for one in member]
    if matrices and (method.mass_matrix or not dyn._derived or getattr(dyn, "elimination", "") != "least constraint"):
        checks.append(condition(matrices[-1:] if quick else matrices))
    if not quick:
        checks.append(softness(dyn, at_q[0, 0], at_v[0, 0]))
        if tolerances and not method.scaled_by_start:
            checks.append(travel(q, v, tolerances))
    checks.append(coordinate_magnitude(at_q, None if method.scaled_by_start else tolerances))
    if tolerances and method.scaled_by_start:
        checks.append(scale_growth(at_q, at_v, tolerances))
    if tolerances and method.fills_tolerance:
        checks.append(accumulated_error(method.name, tolerances, 2 * model.nv, steps / len(q)))
    signs: list[str] = []
    for check in checks:
        # The engine may lack a term, or have none there.
        with suppress(MbkitError, np.linalg.LinAlgError):
            signs += check
    return signs


def _rushes(dyn: Dynamics, method: Method, h: float, q: Array, v: Array) -> bool:
    """Return whether a run that is too short for checks needs them: its step is not two steps of half the length.

    What has no such step is checked, unless the terms of a check would have to be compiled.
    """
    if not (method.explicit and method.order):
        return not dyn._derived
    i, k = np.unravel_index(np.nan_to_num(np.abs(v).max(axis=-1)).argmax(), v.shape[:-1])
    own, q, v, tau = dyn._of_sample(int(i)), q[i, k], v[i, k], np.zeros(v.shape[-1])
    try:
        q1, v1 = own.step(q, v, tau, h, method.name)
        q2, v2 = own.step(*own.step(q, v, tau, h / 2, method.name), tau, h / 2, method.name)
    except MbkitError:
        return True
    off, moved = (
        max(np.abs(dyn.model.difference(x, q2)).max(), h * np.abs(v2 - y).max()) for x, y in ((q1, v1), (q, v))
    )
    return bool(off > _MAX_HALVING_DIFFERENCE**method.order * moved)


def softness(dyn: Dynamics, q: Array, v: Array) -> Iterator[str]:
    """Yield how far an engine's soft constraints, or its soft law of jumps, take accelerations off exact ones."""
    law: Any = getattr(dyn, "constraint_law", None)
    if law and (dyn._soft_jumps or (dyn.model.needs.loops and dyn._soft_constraints)):
        error = law(q, v, np.zeros(len(v))).error
        if error > ROUNDING:
            yield f"soft constraints: accelerations at the start are {off_by(error, 'those of exact ones')}"


def _smooth(dyn: Dynamics) -> Dynamics:
    """Return the dynamics between jumps of forces, which no step goes across."""
    bare = dyn.model.smooth
    return dyn if bare is dyn.model else dyn._of_model(bare, bare.form_digest)


class _Sample:
    """A state of a run, and the terms of its dynamics there."""

    def __init__(self, dyn: Dynamics, q: Array, v: Array) -> None:
        self._dyn, self._q, self._v = dyn, q, v
        self.M = self._term("mass_matrix", q)

    def _term(self, name: str, *state: Array) -> Array:
        # Calls for single states take far less time than one for a few.
        term = getattr(self._dyn, name)
        return np.asarray(term(*state) if self._dyn._samples is None else term(*(x[None] for x in state))[0])

    def kinetic(self, v: Array) -> float:
        """Return vᵀ M v / 2: of a system on paper T2."""
        return 0.5 * float(v.dot(self.M.dot(v)))

    def energy(self) -> tuple[float, float]:
        """Return the kinetic and the potential energy; T2 - T0 of a system on paper, where T2 - T0 + V stays."""
        kinetic = self.kinetic(self._v)
        if not self._dyn.model.has_bodies:
            kinetic -= float(self._term("kinetic_energy", self._q, np.zeros_like(self._v)))
        return kinetic, float(self._term("potential_energy", self._q))


def _samples(dyn: Dynamics, member: int, t: Array, q: Array, v: Array) -> Iterator[_Sample]:
    """Yield the finite ones of a trajectory's states."""
    own = dyn if dyn._samples is None else dyn._of_samples([member])
    for k in range(len(t)):
        if math.isfinite(q[k].sum()):
            yield _Sample(at_time(own, float(t[k])), q[k], v[k])


def _fastest(v: Array) -> Array:
    """Return the largest of a few of a trajectory's velocities."""
    few = v[:: max(1, len(v) // _SAMPLED_VELOCITIES)]
    return np.asarray(few[np.abs(few).max(axis=1).argmax()])


def energy_drift(samples: list[list[_Sample]], fast: list[Array], damped: bool, most: float) -> Iterator[str]:
    """Find a change of the energy of a system without drive; `fast` has a velocity that sizes T of each trajectory."""
    worst, share = 0.0, most
    for member, velocity in zip(samples, fast, strict=True):
        kinetic, potential = (np.array(x) for x in zip(*(one.energy() for one in member), strict=True))
        change = (kinetic + potential - kinetic[0] - potential[0]).tolist()
        wrong = max(change) if damped else max(change, key=abs)
        sizes = np.abs(kinetic).max(), np.ptp(potential), *(one.kinetic(velocity) for one in member)
        size = float(max(*sizes, sys.float_info.min))
        if abs(wrong) > 1e4 * EPS * np.abs(potential).max() and abs(wrong) / size > share:
            worst, share = wrong, abs(wrong) / size
    if worst:
        yield (
            f"{'gained' if worst > 0 else 'lost'} {abs(worst):.2g} J, {100 * share:.3g} % of the run's largest kinetic "
            "energy or change of potential energy, with nothing that drives it; take a smaller step, or "
            f"method={AUTOMATIC_METHOD!r}"
        )


def gimbal_lock(dyn: Dynamics, q: Array) -> Iterator[str]:
    """Find steps over gimbal lock, after which the three angles may be wrong."""
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


def condition(matrices: list[Array]) -> Iterator[str]:
    """Find digits lost in solving with the mass matrix, whatever the units of its coordinates."""
    least, n = 1.0, 0
    for M in matrices[:: max(1, len(matrices) // 2)]:
        scale, n = np.sqrt(M.diagonal()), len(M)
        if not scale.min() > 0:
            return
        least = min(least, float(np.linalg.eigvalsh(M / scale / scale[:, None])[0]))
    if least < EPS * n / _MAX_ROUNDING:
        yield (
            f"the mass matrix is singular to {max(least, 0.0):.1g} of its size, so that accelerations hold "
            f"about {max(0, int(-np.log10(EPS / max(least, EPS)))):d} digits; leave out what has no mass, or compute "
            f"with 34 digits: mbkit.dynamics(model, 'oracle') and method={SERIES_METHOD!r}"
        )


def step_size(dyn: Dynamics, method: Method, h: float, duration: float, q: Array, v: Array) -> Iterator[str]:
    """Compare the step with the modes of the linearized motion at a trajectory's first, fastest and last state."""
    model, name = dyn.model, method.name
    if dyn._samples is not None or model.time_parameter is not None or model.constrained or method.stability is None:
        return
    space = Space(model)

    def accelerations(q: Array, w: Array) -> Array:
        v = space.to_body_velocity(q, w)
        return np.asarray(space.acceleration(q, v, dyn.forward_dynamics(q, v, np.zeros_like(v))))

    signs: list[tuple[float, str]] = []
    fastest_state = int(np.nan_to_num(np.abs(v).max(axis=-1), posinf=0.0).argmax())
    for k in sorted({0, fastest_state, len(q) - 1}):
        if not (np.isfinite(q[k]).all() and np.isfinite(v[k]).all()):
            continue
        # By differences on any engine: deriving would take longer than most runs.
        J = linearized(space, q[k], space.to_integrator_velocity(q[k], v[k]), accelerations)
        A, B = J[model.nv :, : model.nv], J[model.nv :, model.nv :]
        rates = np.linalg.eigvals(J)
        fastest = float(np.abs(rates).max())
        if h * fastest < _MAX_FOLLOWED_STEP:
            continue
        steps = np.linalg.eigvals(method.stability.matrix(h, A, B))
        # Growth of the motion itself, as of a pendulum upside down or a chaotic one, is not the method's.
        grows = float(np.log(max(np.abs(steps).max(), 1e-300))) - h * max(0.0, float(rates.real.max()))
        if grows * duration / h > 1 and h * fastest > 1:
            text = (
                f"a step of {h:g} s is too long for the fastest mode, {fastest:.2g} 1/s (h|λ| = {h * fastest:.2g}): "
                f"{name} makes it grow by {np.expm1(min(grows, 700.0)):.1g} a step; take a step below "
                f"{1 / fastest:.1g} s, or method={AUTOMATIC_METHOD!r}"
            )
            signs.append((np.inf, text))
            continue
        part, rate = lost(steps, h, np.linalg.eigvals(companion(A, B)), duration)
        if part > _MAX_MODE_LOSS:
            kind = f"an oscillation of {abs(rate.imag):.2g} rad/s" if abs(rate.imag) > abs(rate.real) else "a motion"
            text = (
                f"a step of {h:g} s is too long to follow {kind} with h|λ| = {h * abs(rate):.2g}: where it is "
                f"excited, {min(1.0, part):.0%} of it is lost over the run; take a smaller step, "
                f"or method={AUTOMATIC_METHOD!r}"
            )
            signs.append((part, text))
    if signs:
        yield max(signs)[1]


def lost(steps: Any, h: float, rates: Any, duration: float) -> tuple[float, complex]:
    """Return the largest loss of a mode's phase or amplitude over some time, and that mode's rate.

    A step of h (s) multiplies a mode by μ of `steps`, the exact flow by exp(h λ) of `rates`; n steps are off by the
    factor exp(n (ln μ - h λ)). It counts as long as the mode lasts; one that is soon gone is passed over (Hairer,
    Wanner 1996, IV.2).
    """
    # Zero has no logarithm.
    steps = np.log(np.where(np.abs(steps) > 1e-300, steps, 1e-300).astype(complex))
    gap = steps[None, :] - h * rates[:, None]
    gap.imag = (gap.imag + np.pi) % (2 * np.pi) - np.pi
    distances = np.abs(gap)
    modes, partners = np.arange(len(rates)), distances.argmin(axis=1)
    if len(set(partners)) < len(partners):
        # The nearest of some is the same. Its import would take longer than most runs.
        from scipy.optimize import linear_sum_assignment

        modes, partners = linear_sum_assignment(distances)
    off = distances[modes, partners]
    dies = np.minimum(-rates.real[modes], -steps.real[partners] / h)
    lasting = np.minimum(duration, 1 / np.maximum(dies, 1e-300))
    part = np.where(lasting < _TRANSIENT_SHARE * duration, 0.0, off * lasting / h)
    worst = int(part.argmax())
    return float(part[worst]), complex(rates[modes[worst]])


def coordinate_magnitude(q: Array, tolerances: Tolerances | None) -> Iterator[str]:
    """Find coordinates so large that their last digit, or a relative tolerance, is a distance that matters."""
    # Past NaN.
    largest = float(np.fmax.reduce(np.abs(q), axis=None))
    if EPS * largest > _MAX_POSITION_ERROR:
        yield (
            f"a coordinate of {largest:.2g} is known to {EPS * largest:.1g} in double precision; "
            "count it from a nearer origin"
        )
    elif tolerances is not None and tolerances.rtol * largest > max(1e3 * tolerances.atol, _MAX_POSITION_ERROR):
        yield (
            f"rtol = {tolerances.rtol:g} of a coordinate of {largest:.2g} allows an error of "
            f"{tolerances.rtol * largest:.1g} in each step; count it from a nearer origin, or take a smaller rtol"
        )


def travel(q: Array, v: Array, tolerances: Tolerances) -> Iterator[str]:
    """Find a motion as small as the error that a tolerance allows; what starts at rest may stay there."""
    moved = float(np.abs(q - q[:, :1]).max(initial=0.0))
    if np.abs(v[:, 0]).max(initial=0.0) > _MAX_REST_VELOCITY and moved < _MIN_MOTION * tolerances.atol:
        yield (
            f"coordinates move by at most {moved:.2g}, and atol = {tolerances.atol:g} allows an error of that size in "
            "each step; take a smaller atol"
        )


def scale_growth(q: Array, v: Array, tolerances: Tolerances) -> Iterator[str]:
    """Find numbers that have outgrown those of the start, which loosens the tolerance of the others."""
    largest = max(float(np.abs(x).max(initial=0.0, where=np.isfinite(x))) for x in (q, v))
    allowed = min(tolerances) * largest / magnitude(q[..., 0, :], v[..., 0, :])
    if allowed > max(1e3 * tolerances.atol, _MAX_POSITION_ERROR):
        yield (
            f"the state grew to {largest:.2g}, of which the tolerance allows an error of {allowed:.1g} to all "
            f"numbers in each step; take a smaller rtol, or method={ADAPTIVE_METHOD!r}"
        )


def accumulated_error(method: str, tolerances: Tolerances, numbers: int, steps: float) -> Iterator[str]:
    """Find so many steps that the errors allowed to each add up."""
    # The norm is a mean over the state's numbers.
    together = steps * tolerances.rtol * float(np.sqrt(numbers))
    if together > _MAX_ERROR_SUM:
        yield (
            f"errors of {steps:.2g} steps that each use the tolerance of {tolerances.rtol:g}, as those of {method} do, "
            f"add up to {together:.1g} of the motion and more; take a smaller rtol, or method={AUTOMATIC_METHOD!r}"
        )


def massless_joints(dyn: Dynamics, q: Array) -> str:
    """Return the end of a message that names the joints which move next to no mass at q, or nothing."""
    model = dyn.model
    if not model.has_bodies or dyn._samples is not None or not model.nv:
        return ""
    try:
        there = dyn.mass_matrix(model.random_state(np.random.default_rng(0))[0])
        scale = np.sqrt(np.diag(there))
        if not (scale > 0).all():
            # A link without mass inside a loop.
            return ""
        values, vectors = np.linalg.eigh(dyn.mass_matrix(unit_quaternions(model, q)[0]) / scale[:, None] / scale)
    except (MbkitError, np.linalg.LinAlgError, NotImplementedError):
        # A user's engine may lack the mass matrix.
        return ""
    if not values[0] < _MAX_EIGENVALUE_RATIO * values[-1]:
        return ""
    part = np.abs(vectors[:, 0])
    light = [j for j in model.independent_joints if part[model.layout.v[j.name]].max(initial=0.0) > 0.5 * part.max()]
    names = " and ".join(repr(j.name) for j in light)
    lock = " (gimbal lock)" if any(len(j.type.angular) > 1 for j in light) else ""
    return f"; there joint {names} moves next to no mass{lock}, so that the mass matrix is nearly singular"
