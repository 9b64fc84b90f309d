"""Motions that show the inertial parameters: Fourier series of small condition number within the limits.

Each coordinate is a finite Fourier series of the same base frequency ω (Swevers, Ganseman, Tükel, De Schutter and Van
Brussel 1997, Optimal robot excitation and identification)::

    q(t) = q₀ + Σ_l  a_l/(ω l) sin(ω l t) - b_l/(ω l) cos(ω l t)

so that velocities and accelerations are exact, and a measured period may be averaged with the next ones. Whatever the
coefficients, a coordinate's series is made as large as its limits allow, so that the search has none.

What is least is the logarithm of the condition number of the base regressor with columns of equal length. The extreme
singular values of A D, D scaling the columns, have the derivatives of |A D u|², u being their vectors; so a gradient
takes a regressor for each coefficient, and one singular value decomposition.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from mbkit._check import Array, count, generator, real
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError
from mbkit.identify.measurements import REST_SPEED_RATIO, moving
from mbkit.model import Model
from mbkit.model.base_parameters import BASE_PARAMETERS, PARAMETER_SETS, regressor_columns
from mbkit.model.builder import expect_model
from mbkit.model.elements.paths import Path
from mbkit.simulate.progress import Progress, ProgressFunction

EXCITATION: Final = Path(
    "excitation",
    "excitation: expected a tree of free joints without quaternions, got of",
    BASE_PARAMETERS.carries,
    also=lambda model: (f"joint {x!r} has a quaternion, which is no Fourier series" for _, x in model.quaternions),
)
_BASE: Final = PARAMETER_SETS[1]
#: Range of a coordinate without limits, to each side, rad or m, and largest speed without one, per second.
_RANGE: Final = {True: np.pi, False: 1.0}
_SPEED: Final = {True: 2.0, False: 0.5}
#: Samples of the search for each period of the highest harmonic, and step of differences of coefficients of order one.
_SAMPLES_PER_PERIOD: Final = 8
_COEFFICIENT_STEP: Final = 1e-6
#: Numbers of regressors that are held at once.
_MAX_BLOCK_NUMBERS: Final = 4_000_000


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion that shows the base parameters.

    Attributes
    ----------
    t : (N,) array
        s.
    q, v, a : (N, nv) arrays
        Coordinates, velocities and accelerations.
    condition : float
        Condition number of the base regressor of all samples, with columns of equal length.
    harmonics : int
    coefficients : (nv, 2 harmonics + 1) array
        Of each coordinate q₀, then the a_l, then the b_l, rad/s or m/s.
    frequency : float
        ω, rad/s.
    """

    t: Array
    q: Array
    v: Array
    a: Array
    condition: float
    harmonics: int
    coefficients: Array
    frequency: float

    def at(self, t: Any) -> tuple[Array, Array, Array]:
        """Return q, v and a at other times, each (nv,) or (N, nv); the motion is periodic."""
        times = np.asarray(t, dtype=np.float64)
        q, v, a = _series(np.atleast_1d(times), self.frequency, self.coefficients[None, :, 1:])
        q = q + self.coefficients[:, 0]
        return (q[0], v[0], a[0]) if times.ndim else (q[0, 0], v[0, 0], a[0, 0])

    def __repr__(self) -> str:
        return (
            f"<Excitation of {self.q.shape[1]} coordinates: {self.t[-1]:g} s, {len(self.t)} samples, "
            f"condition {self.condition:.3g}>"
        )


def excitation(
    model: Model,
    *,
    duration: float = 10.0,
    harmonics: int = 5,
    seed: int | np.random.Generator = 0,
    rate: float = 100.0,
    margin: float = 0.05,
    friction: bool = False,
    iterations: int = 50,
    progress: bool | ProgressFunction | None = None,
) -> Excitation:
    """Find a motion that shows the base parameters of a model, within its limits.

    Parameters
    ----------
    model : Model
        Joints with angles and lengths alone; of joints without a limit ±π rad, ±1 m, 2 rad/s and 0.5 m/s count.
    duration : float
        Period of the motion, s. Its base frequency is one over it.
    harmonics : int
        Frequencies of each coordinate.
    seed : int or numpy.random.Generator
        Of the first coefficients.
    rate : float
        Samples per second of the motion that is returned, Hz.
    margin : float
        Part of the range and of the speed that is left free, from 0 to below 1.
    friction : bool
        Whether the columns of friction count too; of joints near rest nothing counts then, as in `identify`.
    iterations : int
        Of the search, after the best of some random motions; 0 takes that.
    progress : bool or callable, optional
        True for a bar, or a function of the fraction done.

    Returns
    -------
    Excitation

    Raises
    ------
    InputError
        A wrong argument; a rate that the harmonics outrun; a joint with no room between its limits.
    UnsupportedError
        A model with quaternions or constraints, or without bodies.

    Examples
    --------
    >>> import mbkit as mb
    >>> motion = mb.excitation(mb.catalog.double_pendulum(), duration=5.0, seed=1)
    >>> motion.q.shape, motion.condition < 10
    ((501, 2), True)
    """
    expect_model(model)
    EXCITATION.admit(model)
    period, rate = real("duration", duration, positive=True), real("rate", rate, positive=True)
    harmonics, iterations = count("harmonics", harmonics, least=1), count("iterations", iterations)
    margin = real("margin", margin, nonnegative=True)
    if margin >= 1:
        raise InputError(f"margin: expected a part below 1, got {margin:g}")
    if rate * period < 4 * harmonics:
        least = 4 * harmonics / period
        raise InputError(
            f"rate: expected at least {least:g} Hz for {harmonics} harmonics of {period:g} s, got {rate:g}"
        )
    search = _Search(model, period, harmonics, margin, bool(friction))
    rng = generator("seed", seed)
    with Progress(progress, "excitation") as reported:
        best = search.run(rng, iterations, reported)
    coefficients = search.bounded(best[None])[0]
    out = Excitation(*(np.empty(0),) * 4, np.nan, harmonics, coefficients, 2 * np.pi / period)
    t = np.arange(int(np.floor(period * rate * (1 + 1e-12))) + 1) / rate
    q, v, a = out.at(t)
    condition = float(np.exp(search.value(search.regressor(q, v, a))[0]))
    return Excitation(t, q, v, a, condition, harmonics, coefficients, 2 * np.pi / period)


def _series(t: Array, frequency: float, coefficients: Array) -> tuple[Array, Array, Array]:
    """Return q, v and a of series without their constants, (B, N, nv), of coefficients (B, nv, 2 L)."""
    L = coefficients.shape[-1] // 2
    w = frequency * np.arange(1, L + 1)
    sin, cos = np.sin(np.outer(w, t)), np.cos(np.outer(w, t))
    bases = [sin / w[:, None], -cos / w[:, None]], [cos, sin], [-sin * w[:, None], cos * w[:, None]]
    q, v, a = ((coefficients @ np.vstack(rows)).swapaxes(-1, -2) for rows in bases)
    return q, v, a


class _Search:
    """The condition number as a function of free numbers, (nv, 2 L + 1): place in the range, shape of the series."""

    def __init__(self, model: Model, period: float, harmonics: int, margin: float, losses: bool) -> None:
        self._dyn, self._columns = LagrangianDynamics(model), regressor_columns(model, _BASE, losses, False)
        if not self._columns.bodies:
            raise InputError(f"model: expected one whose motion depends on inertial parameters, got {model.name}")
        self._frequency = 2 * np.pi / period
        self._shape = (model.nv, 2 * harmonics + 1)
        self._t = np.linspace(0.0, period, _SAMPLES_PER_PERIOD * harmonics, endpoint=False)
        self._fine = np.linspace(0.0, period, 8 * _SAMPLES_PER_PERIOD * harmonics, endpoint=False)
        self._low, self._high, self._speed = _limits(model, margin)

    def bounded(self, x: Array) -> Array:
        """Return q₀, a_l and b_l, (B, nv, 2 L + 1), of free numbers: as large as the limits allow."""
        middle, half = (self._high + self._low) / 2, (self._high - self._low) / 2
        # A constant near a limit leaves no room.
        centre = middle + 0.8 * half * np.tanh(x[..., 0])
        q, v, _ = _series(self._fine, self._frequency, x[..., 1:])
        room = np.minimum(self._high - centre, centre - self._low)
        peaks = np.maximum(np.abs(q).max(axis=-2) / room, np.abs(v).max(axis=-2) / self._speed)
        # Between two samples a series may be a little larger.
        grown = x[..., 1:] / (1.02 * np.maximum(peaks, np.finfo(float).tiny))[..., None]
        return np.concatenate([centre[..., None], grown], axis=-1)

    def regressor(self, q: Array, v: Array, a: Array) -> Array:
        """Return the equations of all samples of some motions, (..., N nv, p); with friction of those that move."""
        at, rates, second = (x.reshape(-1, self._shape[0]) for x in (q, v, a))
        Y: Array = self._dyn._evaluate("regressor", self._columns, q=at, v=rates, a=second)
        if self._columns.along:
            # As `identify` leaves them out.
            Y = Y * moving(v, REST_SPEED_RATIO).reshape(*Y.shape[:2], 1)
        return Y.reshape(*v.shape[:-2], -1, Y.shape[-1])

    def _equations(self, x: Array) -> Array:
        """Return the equations of some motions, (B, N nv, p)."""
        c = self.bounded(x)
        q, v, a = _series(self._t, self._frequency, c[..., 1:])
        return self.regressor(q + c[:, None, :, 0], v, a)

    @staticmethod
    def value(Y: Array) -> tuple[float, Array]:
        """Return the logarithm of the condition number, and the vectors of the least and largest singular value."""
        lengths = np.linalg.norm(Y, axis=0)
        _, sizes, axes = np.linalg.svd(np.linalg.qr(Y / np.where(lengths > 0, lengths, 1.0), mode="r"))
        least = max(float(sizes[-1]), float(np.finfo(float).tiny))
        return float(np.log(sizes[0] / least)), axes[[-1, 0]].T

    def gradient(self, x: Array) -> tuple[float, Array]:
        """Return the value at free numbers and its gradient."""
        x = x.reshape(self._shape)
        centre = self._equations(x[None])[0]
        value, vectors = self.value(centre)
        start = _stretches(centre[None], vectors)[0]
        steps = x + _COEFFICIENT_STEP * np.eye(x.size).reshape(-1, *self._shape)
        size = max(1, _MAX_BLOCK_NUMBERS // centre.size)
        blocks = [_stretches(self._equations(steps[i : i + size]), vectors) for i in range(0, len(steps), size)]
        least, largest = ((np.concatenate(blocks) - start) / start / _COEFFICIENT_STEP / 2).T
        return value, largest - least

    def run(self, rng: np.random.Generator, iterations: int, progress: Progress) -> Array:
        """Return the best free numbers found."""
        from scipy.optimize import minimize

        trials = rng.standard_normal((8, *self._shape))
        values = [self.value(self._equations(x[None])[0])[0] for x in trials]
        best = trials[int(np.argmin(values))]
        done = 0

        def step(_: Any) -> None:
            nonlocal done
            done += 1
            progress.update(done / max(iterations, 1))

        if iterations:
            minimum = minimize(
                self.gradient, best.ravel(), jac=True, method="L-BFGS-B", callback=step, options={"maxiter": iterations}
            )
            best = minimum.x.reshape(self._shape)
        return np.asarray(best)


def _stretches(Y: Array, vectors: Array) -> Array:
    """Return |A D u|² for the matrices A, (B, N, p), with columns scaled by D to equal length, (B, 2)."""
    lengths = np.linalg.norm(Y, axis=1)
    scaled = vectors / np.where(lengths > 0, lengths, 1.0)[..., None]
    return np.asarray(np.sum((Y @ scaled) ** 2, axis=1))


def _limits(model: Model, margin: float) -> tuple[Array, Array, Array]:
    """Return lower and upper limits and largest speeds, less the margin."""
    lower, upper, speed = [], [], []
    for joint in model.independent_joints:
        angles = [k in joint.type.angular for k in range(joint.type.nv)]
        most = np.array([_RANGE[x] for x in angles])
        # Far limits are none, and a range with one end begins there.
        low = np.where(
            np.isfinite(joint.lower), joint.lower, np.where(np.isfinite(joint.upper), joint.upper - 2 * most, -most)
        )
        high = np.where(
            np.isfinite(joint.upper), joint.upper, np.where(np.isfinite(joint.lower), joint.lower + 2 * most, most)
        )
        fast = np.where(np.isfinite(joint.velocity_limit), joint.velocity_limit, [_SPEED[x] for x in angles])
        lower += low.tolist()
        upper += high.tolist()
        speed += fast.tolist()
    low, high = np.array(lower), np.array(upper)
    shut = [name for name, a, b, s in zip(model.coordinate_names, low, high, speed, strict=True) if b <= a or s <= 0]
    if shut:
        raise InputError(f"model: expected room between the limits of every joint, got none of {', '.join(shut)}")
    middle, half = (high + low) / 2, (high - low) / 2 * (1 - margin)
    return middle - half, middle + half, np.array(speed) * (1 - margin)
