"""Physically consistent parameters: those of matter, nearest to the data and to prior knowledge.

A body's ten parameters belong to some distribution of mass if and only if its pseudo-inertia J is positive definite
(Wensing, Kim and Slotine 2018, Linear matrix inequalities for physically consistent inertial parameter
identification; Traversaro et al. 2016, Identification of fully physical consistent inertial parameters using
optimization on manifolds). With J = L X Lᵀ and L Lᵀ the pseudo-inertia before, X = 1 is no change, whatever units
and axes. The prior is D(X), of one body ::

    entropic   tr X - log det X - 4      (Lee, Wensing and Park 2020, Geometric robot dynamic identification)
    euclidean  ½ ‖X - 1‖²

and ½ Σ (residual/noise)² + weight · Σ D(X) is least. So with weight 1 a body may well be half or twice as heavy as
before where the data says little, and what the data says is hardly moved.
"""

from __future__ import annotations

import warnings
from typing import Any, Final

import numpy as np

from mbkit._check import PRINTED, Array
from mbkit.errors import NumericalError, UnsupportedError
from mbkit.identify.measurements import Unknowns
from mbkit.model.base_parameters import STANDARD, BaseParameters, parameters_of, pseudo_inertia

ENTROPIC, EUCLIDEAN = "entropic", "euclidean"
PRIORS: Final = (ENTROPIC, EUCLIDEAN)
_SIZE: Final = len(STANDARD)


def consistent(system: Array, unknowns: Unknowns, length: float, prior: str, weight: float) -> tuple[Array, Array]:
    """Return the unknowns, (p,), and the standard parameters of all bodies, (10 nb,), that are matter.

    Bodies without mass stay without. Numbers of joints are not negative.

    Parameters
    ----------
    system : (m, p + 1) array
        The equations, each over its noise.
    unknowns : Unknowns
    length : float
        m, of the mechanism.
    prior : {"entropic", "euclidean"}
    weight : float

    Raises
    ------
    UnsupportedError
        Without the solver.
    NumericalError
        The solver found nothing.
    """
    cp = _solver()
    base, p = unknowns.base, len(unknowns.names)
    A, b = system[:, :p], system[:, p]
    inertial = A[:, : base.count] @ base.matrix
    loss: Any = cp.Variable(p - base.count, nonneg=True)
    predicted: Any = A[:, base.count :] @ loss if p > base.count else 0.0
    columns = _columns(base, length)
    shapes: dict[int, Any] = {k: cp.Variable((4, 4), symmetric=True) for k in columns}
    total: Any = 0.0
    for k, X in shapes.items():
        predicted = predicted + inertial[:, _SIZE * k : _SIZE * (k + 1)] @ columns[k] @ cp.vec(X, order="C")
        total += cp.trace(X) - cp.log_det(X) if prior == ENTROPIC else 0.5 * cp.sum_squares(X - np.eye(4))
    # The solver likes numbers of the order of one.
    objective = (0.5 * cp.sum_squares(predicted - b) + weight * total) / (len(b) + weight)
    # Written numbers are matter after rounding too.
    problem = cp.Problem(cp.Minimize(objective), [X >> PRINTED * np.eye(4) for X in shapes.values()])
    with warnings.catch_warnings():
        # Its accuracy has fewer digits than it aims at, which data without noise do not allow.
        warnings.filterwarnings("ignore", "Solution may be inaccurate")
        try:
            problem.solve(solver=cp.CLARABEL)
            status = str(problem.status)
        except cp.SolverError as error:
            status = str(error)
    if any(X.value is None for X in shapes.values()) or status not in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE):
        raise NumericalError(
            f"identify: Clarabel found no physically consistent parameters ({status}); "
            "look for torques or weights of very different sizes, or take another prior_weight"
        )
    standard = base.standard.copy()
    for k, X in shapes.items():
        standard[_SIZE * k : _SIZE * (k + 1)] = columns[k] @ X.value.ravel()
    rest = np.zeros(0) if p == base.count else np.maximum(loss.value, 0.0)
    return np.concatenate([base.matrix @ standard, rest]), standard


def _solver() -> Any:
    try:
        import clarabel  # noqa: F401  # the solver behind cvxpy
        import cvxpy
    except ModuleNotFoundError as error:
        raise UnsupportedError(
            f"identify: physical=True needs {error.name}, which is not installed; pip install 'mbkit[identify]'"
        ) from None
    return cvxpy


def nearest(base: BaseParameters, values: Array, length: float) -> Array:
    """Return the standard parameters with these base parameters that are nearest to the model's, (10 nb,).

    Their distance is Σ ‖X - 1‖², over the bodies with mass; others stay.
    """
    columns = _columns(base, length)
    together = np.zeros((base.standard.size, 16 * len(columns)))
    for i, (k, own) in enumerate(columns.items()):
        together[_SIZE * k : _SIZE * (k + 1), 16 * i : 16 * (i + 1)] = own
    off = values[: base.count] - base.values
    return np.asarray(base.standard + together @ np.linalg.lstsq(base.matrix @ together, off, rcond=None)[0])


def _columns(base: BaseParameters, length: float) -> dict[int, Array]:
    """Return, of each body with mass, the ten parameters of units of the entries of X, (10, 16)."""
    out = {}
    for k, J in enumerate(pseudo_inertia(base.standard.reshape(-1, _SIZE))):
        if J.any():
            L = _root(J, length)
            out[k] = parameters_of(np.einsum("ia,jb->abij", L, L).reshape(16, 4, 4)).T
    return out


def _root(J: Array, length: float) -> Array:
    """Return L with L Lᵀ = J, of a body without extent with a little of it."""
    lengths = np.array([length, length, length, 1.0])
    values, axes = np.linalg.eigh(J / np.outer(lengths, lengths))
    values = np.maximum(values, PRINTED * values.max())
    return np.asarray(lengths[:, None] * axes * np.sqrt(values))
