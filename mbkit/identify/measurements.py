"""Measured motions and torques as one triangular system for each velocity, small however many samples there are.

The rows (Y_j, τ_j) of velocity j have the same least squares as the factor R_j of their QR decomposition, which takes
further rows one block after another (Golub and Van Loan 2013, Matrix Computations, ch. 6.5). With one factor for each
velocity, their noise can be found and weighted afterwards, without the samples.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbkit._check import PROBES, Array, finite_array
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
