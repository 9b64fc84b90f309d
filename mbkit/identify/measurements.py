"""Measured motions and torques as one triangular system for each velocity, small however many samples there are.

The rows (Y_j, τ_j) of velocity j have the same least squares as the factor R_j of their QR decomposition, which takes
further rows one block after another (Golub and Van Loan 2013, Matrix Computations, ch. 6.5). With one factor for each
velocity, their noise can be found and weighted afterwards, without the samples.

Noise of measured motions: what it does to an identification, and filters that take it out.

Least squares take the regressor as exact. Noise of q, v and a in it makes the estimates biased, mostly towards zero,
and no standard deviation shows that. Its size is seen where samples follow each other in time: what is left of each
velocity and acceleration beside a polynomial through its neighbours. Simulation and extrapolation (Cook and Stefanski
1994, Simulation-extrapolation estimation in parametric measurement error models, JASA 89) then tells the bias: the
estimates with once and twice more of the same noise, extrapolated to none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import butter, sosfiltfilt

from mbkit._check import PROBES, Array, finite_array, real
from mbkit.engines.base import Dynamics
from mbkit.errors import InputError
from mbkit.model import Model
from mbkit.model.base_parameters import PARAMETER_SETS, BaseParameters, RegressorColumns, regressor_columns
from mbkit.model.elements.kinds import kind
from mbkit.simulate.progress import Progress

_BASE: Final = PARAMETER_SETS[1]
#: Effects of what acts beside bodies and gravity.
_KNOWN: Final = {"T", "V", "loss", "jump", "force"}
#: Part of a joint's greatest speed below which it counts as at rest.
REST_SPEED_RATIO: Final = 0.05
#: Numbers of a regressor that are held at once.
_MAX_BLOCK_NUMBERS: Final = 250_000


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The parameters of an identification: base parameters, then numbers of joints.

    Attributes
    ----------
    base : BaseParameters
    names, combinations : tuple of str
    nominal : (p,) array
        Their values in the model.
    acting : (p,) array
        The same: what of them is in the model's inverse dynamics.
    columns : RegressorColumns
        Those of the regressor.
    """

    base: BaseParameters
    names: tuple[str, ...]
    combinations: tuple[str, ...]
    nominal: Array
    columns: RegressorColumns

    @classmethod
    def of(cls, model: Model, losses: bool, rotors: bool) -> Unknowns:
        """Return the unknowns of a model, with numbers of joints that lose energy, and of rotors."""
        base, columns = model.base_parameters(), regressor_columns(model, _BASE, losses, rotors)
        names = columns.names(model)
        nominal = np.concatenate([base.values, *(model.per_velocity(f)[list(k)] for f, k in columns.along)])
        combinations = (*base.combinations, *names[base.count :])
        return cls(base, names, combinations, nominal, columns)


@dataclass(frozen=True, eq=False)
class Measurements:
    """Checked samples: q (N, nq), v, a and tau (N, nv), and weights (nv,) or (N, nv), None where noise decides."""

    q: Array
    v: Array
    a: Array
    tau: Array
    weights: Array | None

    @classmethod
    def of(
        cls, model: Model, q: ArrayLike, v: ArrayLike, a: ArrayLike, tau: ArrayLike, weights: ArrayLike | None
    ) -> Measurements:
        """Check shapes, numbers and sizes."""
        arrays = {"q": model.check_q(q), "v": model.check_v(v), "a": model.check_v(a, "a")}
        arrays["tau"] = model.check_v(tau, "tau")
        for name, x in arrays.items():
            if x.ndim != 2:
                raise InputError(f"{name}: expected one row per sample, shape (N, {x.shape[-1]}), got {x.shape}")
        sizes = {name: len(x) for name, x in arrays.items()}
        if len(set(sizes.values())) > 1:
            each = ", ".join(f"{name} has {n}" for name, n in sizes.items())
            raise InputError(f"samples: expected as many of each, but {each}")
        checked = _weights(weights, arrays["tau"])
        return cls(arrays["q"], arrays["v"], arrays["a"], arrays["tau"], checked)

    def moving(self, jumps: NDArray[np.bool_], rest: float) -> Measurements:
        """Return the samples without the torques of joints with a force that jumps, (nv,), that are at rest.

        There it holds with any force up to its bound, and noise decides the sign of v.
        """
        if not jumps.any():
            return self
        used = moving(self.v, rest) | ~jumps
        weights = np.ones(self.v.shape) if self.weights is None else self.weights
        return self if used.all() else replace(self, weights=np.asarray(weights * used))

    def __len__(self) -> int:
        return len(self.tau)


def moving(v: Array, rest: float) -> NDArray[np.bool_]:
    """Return where joints are faster than a part of their greatest speed, (..., N, nv); of none at rest all along."""
    speed = np.abs(v)
    return np.asarray(speed >= rest * speed.max(axis=-2, keepdims=True, initial=0.0), dtype=np.bool_)


def _weights(weights: ArrayLike | None, tau: Array) -> Array | None:
    if weights is None:
        return None
    nv = tau.shape[1]
    shape = np.shape(weights)
    if shape not in ((nv,), tau.shape):
        raise InputError(
            f"weights: expected shape ({nv},) or {tau.shape}, one over the standard deviation, got {shape}"
        )
    out = finite_array("weights", weights, shape)
    if (out < 0).any() or not out.any():
        raise InputError("weights: expected numbers of at least 0, some above 0")
    return out


@dataclass(frozen=True, eq=False)
class Equations:
    """The equations of one velocity, weighted: `factor` (k, p + 1) stands for rows (Y, τ).

    `count` is how many rows have a weight, `size` the root mean square of their torque.
    """

    factor: Array
    count: int
    size: float


def equations(dyn: Dynamics, unknowns: Unknowns, data: Measurements, progress: Progress) -> list[Equations]:
    """Return the equations of each velocity."""
    model, p = dyn.model, len(unknowns.names)
    factors = [np.zeros((0, p + 1)) for _ in range(model.nv)]
    used = _used(dyn, unknowns)
    for part, Y, tau in _blocks(dyn, unknowns, data):
        for j, columns in enumerate(used):
            block = np.empty((len(tau), columns.size + 1), order="F")
            block[:, :-1], block[:, -1] = Y[:, j, columns], tau[:, j]
            if data.weights is not None:
                block *= (data.weights[part, j] if data.weights.ndim == 2 else data.weights[j])[..., None]
            above = factors[j][:, [*columns, p]]
            small = np.linalg.qr(np.vstack([above, block]), mode="r")
            factors[j] = np.zeros((len(small), p + 1))
            factors[j][:, [*columns, p]] = small
        progress.update(part.stop / len(data))
    weights = np.broadcast_to(1.0 if data.weights is None else data.weights, data.tau.shape)
    counts = np.count_nonzero(weights, axis=0)
    sizes = [float(np.linalg.norm(f[:, -1]) / np.sqrt(max(n, 1))) for f, n in zip(factors, counts, strict=True)]
    return [Equations(f, int(n), size) for f, n, size in zip(factors, counts, sizes, strict=True)]


def _blocks(dyn: Dynamics, unknowns: Unknowns, data: Measurements) -> Iterator[tuple[slice, Array, Array]]:
    """Yield samples with their regressor and the torque that it has to explain."""
    model = dyn.model
    known = any(kind(name).effects & _KNOWN for name in model.acts if name != "gravity")
    size = max(64, _MAX_BLOCK_NUMBERS // max(model.nv * len(unknowns.names), 1))
    for start in range(0, len(data), size):
        part = slice(start, min(start + size, len(data)))
        q, v, a = data.q[part], data.v[part], data.a[part]
        Y = dyn._evaluate("regressor", unknowns.columns, q=q, v=v, a=a)
        tau = data.tau[part]
        if known:
            # Parameters that are not sought are those of the model.
            tau = tau - (dyn.inverse_dynamics(q, v, a) - Y @ unknowns.nominal)
        yield part, Y, tau


def _used(dyn: Dynamics, unknowns: Unknowns) -> list[NDArray[np.intp]]:
    """Return the columns that each velocity's torque depends on: those of bodies that it carries."""
    model, rng = dyn.model, np.random.default_rng(0)
    q, v = model.random_state(rng, PROBES)
    Y = dyn._evaluate("regressor", unknowns.columns, q=q, v=v, a=rng.standard_normal((PROBES, model.nv)))
    return [np.flatnonzero(Y[:, j].any(axis=0)) for j in range(model.nv)]


#: Samples of a polynomial of degree 5, beside the middle one on each side.
_SIDE_SAMPLES: Final = 4
#: Samples that are looked at: more make it no surer.
_MAX_SAMPLES: Final = 4000
#: Part of the spread of positions that a polynomial leaves of samples in the order of time, at the most.
_ORDERED_RESIDUAL_RATIO: Final = 0.1


@dataclass(frozen=True, eq=False)
class FilteredMotion:
    """Positions without noise, and what follows from them.

    Attributes
    ----------
    q : (M, nq) array
    v, a : (M, nv) arrays
    tau : (M, nv) array or None
        Torques through the same filter, so that both sides of the equation of motion are filtered alike.
    samples : slice
        Which of the measured samples these are. The ends, where the filter has not settled, are left out, and of the
        rest all but two a period of the cut-off, whose errors depend on each other.
    cutoff, dt : float
        Hz, s.
    """

    q: Array
    v: Array
    a: Array
    tau: Array | None
    samples: slice
    cutoff: float
    dt: float


def filtered_motion(
    model: Model, q: ArrayLike, dt: float, cutoff: float, *, tau: ArrayLike | None = None, order: int = 4
) -> FilteredMotion:
    """Filter measured positions without a shift in time, and differentiate them.

    A Butterworth filter runs forwards and backwards; velocities and accelerations are central differences of fourth
    order of what it leaves (Gautier and Poignet 2001; Swevers, Verdonck and De Schutter 2007, Dynamic model
    identification for industrial robots, IEEE Control Systems 27). The torques go through the same filter.

    Parameters
    ----------
    model : Model
    q : (N, nq) array_like
        Positions at equal times, rad or m.
    dt : float
        Time between two samples, s.
    cutoff : float
        Hz, where the two passes together let a half through: some five to ten times the highest frequency of the
        motion, and below half of the sampling rate.
    tau : (N, nv) array_like, optional
        Measured torques.
    order : int
        Of the filter in each direction.

    Returns
    -------
    FilteredMotion

    Raises
    ------
    InputError
        Wrong shapes or numbers, too few samples, a cut-off beyond half of the sampling rate, or a joint with a
        quaternion, whose numbers are no plain coordinates.

    Examples
    --------
    >>> import numpy as np
    >>> import mbkit as mb
    >>> model, t = mb.catalog.pendulum(), np.arange(0, 4, 1e-3)
    >>> measured = np.sin(2 * t) + 1e-4 * np.random.default_rng(0).standard_normal(len(t))
    >>> motion = mb.identify.filtered_motion(model, measured[:, None], 1e-3, cutoff=10.0)
    >>> bool(abs(motion.a[:, 0] + 4 * np.sin(2 * t[motion.samples])).max() < 0.1)
    True
    """
    if model.quaternions or model.nq != model.nv:
        names = ", ".join(name for _, name in model.quaternions)
        raise InputError(
            f"model: expected joints with plain coordinates, {names} has a quaternion; give v and a measured"
        )
    dt, cutoff = real("dt", dt, positive=True), real("cutoff", cutoff, positive=True)
    if cutoff >= 0.5 / dt:
        raise InputError(f"cutoff: expected less than half of the sampling rate, {0.5 / dt:g} Hz, got {cutoff:g} Hz")
    raw = model.check_q(q)
    if raw.ndim != 2:
        raise InputError(f"q: expected one row per sample, shape (N, {model.nq}), got {raw.shape}")
    # At the ends the filter settles within four periods of its cut-off, and differences need two neighbours.
    edge = int(np.ceil(4 / (cutoff * dt))) + 2
    if len(raw) <= 2 * edge + 3:
        raise InputError(f"q: expected more than {2 * edge + 3} samples for this cut-off, got {len(raw)}")
    sections = butter(order, cutoff, fs=1 / dt, output="sos")
    smooth = sosfiltfilt(sections, raw, axis=0)
    # Central differences of fourth order.
    v, a = np.zeros_like(smooth), np.zeros_like(smooth)
    v[2:-2] = (8 * (smooth[3:-1] - smooth[1:-3]) - (smooth[4:] - smooth[:-4])) / (12 * dt)
    near, far = smooth[3:-1] + smooth[1:-3], smooth[4:] + smooth[:-4]
    a[2:-2] = (16 * near - far - 30 * smooth[2:-2]) / (12 * dt**2)
    forces = None
    if tau is not None:
        forces = sosfiltfilt(sections, finite_array("tau", tau, (len(raw), model.nv)), axis=0)
    # A filtered signal has two independent samples a period of its cut-off: more would count one error often.
    used = slice(edge, len(raw) - edge, max(1, int(0.5 / (cutoff * dt))))
    return FilteredMotion(smooth[used], v[used], a[used], None if forces is None else forces[used], used, cutoff, dt)


def motion_noise(data: Measurements) -> tuple[Array, Array]:
    """Return the standard deviations of v and of a beside polynomials through their neighbours in time, (nv,) each."""
    v, a = (_beside_neighbours(x) for x in (data.v, data.a))
    return np.sqrt(np.mean(v**2, axis=0)), np.sqrt(np.mean(a**2, axis=0))


def bias(
    data: Measurements, values: Array, noise: Array, solve: Callable[[Measurements], tuple[Array, Array]]
) -> Array:
    """Return the estimated bias of the parameters by noise of the motion, (p,).

    Parameters
    ----------
    data : Measurements
        In the order of time. Samples in any other order, or too far apart, have neighbours that say nothing.
    values : (p,) array
        The estimates.
    noise : (nv,) array
        Standard deviations of the torques' residuals.
    solve : callable
        Returns the estimates and the residuals' deviations of other measurements.
    """
    if len(data) > _MAX_SAMPLES:
        data = _first(data, _MAX_SAMPLES)
        values, noise = solve(data)
    if len(data) <= 2 * _SIDE_SAMPLES:
        return np.zeros(len(values))
    if not (np.std(_beside_neighbours(data.q), axis=0) < _ORDERED_RESIDUAL_RATIO * np.std(data.q, axis=0)).all():
        # Neighbours far apart say nothing of noise.
        return np.zeros(len(values))
    errors = np.hstack([_beside_neighbours(x) for x in (data.v, data.a)])
    nv, rng = data.v.shape[1], np.random.default_rng(0)
    L = _root(errors.T @ errors / len(errors))

    # Each with its opposite: odd powers of the noise are chance, and the bias is even.
    halves = [rng.standard_normal((len(data), 2 * nv)) @ L.T for _ in range(2)]
    draws = [sign * x for x in halves for sign in (1.0, -1.0)]

    def noisy(times: float) -> tuple[Array, Array]:
        values = []
        for draw in draws:
            e = np.sqrt(times) * draw
            values.append(solve(replace(data, v=data.v + e[:, :nv], a=data.a + e[:, nv:])))
        return np.mean([x for x, _ in values], axis=0), np.mean([s for _, s in values], axis=0)

    (once, more), (twice, _) = noisy(1.0), noisy(2.0)
    # Curvature of an exact motion is no noise: noise of this size would be in the residuals too.
    added = np.maximum(more**2 - noise**2, 0.0).sum()
    share = min(1.0, float((noise**2).sum() / added)) if added else 0.0
    # The parabola through three estimates, at none of the noise; less of it has a share of the slope alone.
    return np.asarray(share * (values - (3 * values - 3 * once + twice)))


def _first(data: Measurements, count: int) -> Measurements:
    weights = data.weights if data.weights is None or data.weights.ndim == 1 else data.weights[:count]
    return replace(data, q=data.q[:count], v=data.v[:count], a=data.a[:count], tau=data.tau[:count], weights=weights)


def _beside_neighbours(x: Array) -> Array:
    """Return each sample's residual beside a polynomial through it and its neighbours, as large as its noise."""
    k = np.arange(-_SIDE_SAMPLES, _SIDE_SAMPLES + 1.0)
    A = np.vander(k / _SIDE_SAMPLES, 6)
    H = np.eye(len(k)) - A @ np.linalg.pinv(A)
    row = H[_SIDE_SAMPLES]
    out = sum(c * x[i : len(x) - 2 * _SIDE_SAMPLES + i] for i, c in enumerate(row))
    return np.asarray(out / np.sqrt(row @ row))


def _root(S: Array) -> Array:
    sizes, axes = np.linalg.eigh(S)
    return np.asarray(axes * np.sqrt(np.maximum(sizes, 0.0)))
