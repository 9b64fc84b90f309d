"""Inertia, inverse and null space of a task, as the mass matrix weighs them.

Khatib 1987, A unified approach for motion and force control of robot manipulators: the operational space formulation,
IEEE Journal on Robotics and Automation 3(1). Near singular poses the inverse is damped where singular values are small
(Nakamura and Hanafusa 1986, Inverse kinematic solutions with singularity robustness for robot manipulator control,
ASME Journal of Dynamic Systems, Measurement, and Control 108).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, real, with_shapes
from mbkit.engines.base import Dynamics, no_dynamics
from mbkit.engines.frames_and_momenta import ALIGNED
from mbkit.errors import InputError, NumericalError, SingularPoseWarning, warn
from mbkit.model.elements.paths import ALL, Path

#: Rows of a task by name.
_ROWS: Final = {"linear": (0, 1, 2), "angular": (3, 4, 5)}
OPERATIONAL_SPACE: Final = Path(
    "operational space",
    "operational_space: not known of",
    ALL - {"row", "speed", "stop", "energies"},
    dict.fromkeys(("row", "speed", "stop"), "changes the inertia that a frame feels"),
)


@with_shapes
@dataclass(frozen=True)
class OperationalSpace:
    """The dynamics of a task at one pose, or at N of them, with m rows.

    Attributes
    ----------
    jacobian : (m, nv) or (N, m, nv) array
        J of the task.
    inertia : (m, m) or (N, m, m) array
        Λ = (J M⁻¹ Jᵀ)⁻¹, the inertia that the task feels.
    inverse : (nv, m) or (N, nv, m) array
        J̄ = M⁻¹ Jᵀ Λ, the inverse of J with the least kinetic energy.
    null_space : (nv, nv) or (N, nv, nv) array
        N = 1 - J̄ J: velocities N v move nothing of the task, and forces Nᵀ τ accelerate nothing of it.
    reciprocal_condition : float or (N,) array
        Smallest over largest singular value of the task's rows, weighed by M, linear and angular ones each by their
        norm.
    damped : bool or (N,) array
        Where the inverse is damped: there J J̄ is not 1, and N projects but nearly.
    """

    jacobian: Array
    inertia: Array
    inverse: Array
    null_space: Array
    reciprocal_condition: Any
    damped: Any


def operational_space(
    dyn: Dynamics,
    q: ArrayLike,
    frame: str,
    axes: str = ALIGNED,
    *,
    rows: str | Sequence[int] | None = None,
    damping: float = 1e-4,
) -> OperationalSpace:
    """Return the operational-space inertia of a frame, its consistent inverse and its null space.

    Parameters
    ----------
    dyn : Dynamics
        Of any engine.
    q : (nq,) or (N, nq) array_like
    frame : str
    axes : {"local_world_aligned", "local", "world"}
        As in `Dynamics.jacobian`.
    rows : {"linear", "angular"} or sequence of int, optional
        Which of the six rows are the task; all by default.
    damping : float
        Reciprocal condition below which the inverse is damped; 0 for never.

    Returns
    -------
    OperationalSpace

    Raises
    ------
    InputError
        For unusable arguments.
    NumericalError
        M is singular, or the task is and `damping` is 0.
    UnsupportedError
        A model with loops or other constraints.

    Warns
    -----
    SingularPoseWarning
        The inverse is damped at some pose.

    Examples
    --------
    >>> import mbkit as mb
    >>> dyn = mb.dynamics(mb.load("panda"), "lagrangian")
    >>> space = mb.operational_space(dyn, [0, -0.8, 0, -2.4, 0, 1.6, 0.8, 0.02], "panda_hand")
    >>> space.inertia.shape, space.null_space.shape, bool(space.damped)
    ((6, 6), (8, 8), False)
    """
    if not isinstance(dyn, Dynamics):
        raise no_dynamics(dyn)
    OPERATIONAL_SPACE.admit(dyn.model)
    if not isinstance(frame, str):
        raise InputError(f"frame: expected a name, got {type(frame).__name__}; stack the Jacobians of several")
    threshold = real("damping", damping)
    if not 0 <= threshold < 1:
        raise InputError(f"damping: expected a number from 0 to below 1, got {damping!r}")
    chosen = _rows(rows)
    J, M = dyn.jacobian(q, frame, axes)[..., chosen, :], dyn.mass_matrix(q)
    try:
        factor = np.linalg.cholesky(M)
    except np.linalg.LinAlgError:
        raise NumericalError(
            f"operational_space: M of {dyn.model.name} is not positive definite at this pose"
        ) from None
    # J M⁻¹ Jᵀ = A Aᵀ, and M⁻¹ Jᵀ = L⁻ᵀ Aᵀ.
    A = np.linalg.solve(factor, J.swapaxes(-1, -2)).swapaxes(-1, -2)
    scale = _scales(A, chosen)
    U, s, Vt = np.linalg.svd(A / scale, full_matrices=False)
    m = len(chosen)
    # Fewer velocities than rows: the other directions are singular.
    U, s, Vt = _squared(U, s, Vt, m)
    largest = s.max(axis=-1, initial=0.0)
    least = s.min(axis=-1, initial=np.inf)
    condition = np.where(largest > 0, least / np.where(largest > 0, largest, 1.0), 0.0)
    small = threshold * largest
    damped = np.asarray(condition < threshold)
    if not threshold and (condition == 0).any():
        raise NumericalError(
            f"operational_space: {frame!r} of {dyn.model.name} is at a singular pose, where Λ is infinite; "
            "choose fewer rows, or a damping"
        )
    added = np.where(s < small[..., None], small[..., None] ** 2 - s**2, 0.0)
    # At a pose where nothing moves the task at all, no force is the least one.
    total = s**2 + added
    weight = np.where(total > 0, 1 / np.where(total > 0, total, 1.0), 0.0)
    across = U.swapaxes(-1, -2) / scale.swapaxes(-1, -2)
    inertia = across.swapaxes(-1, -2) @ (weight[..., None] * across)
    # A = scale U s Vᵀ, so M⁻¹ Jᵀ Λ = L⁻ᵀ V s weight Uᵀ / scale.
    inner = Vt.swapaxes(-1, -2) @ ((s * weight)[..., None] * across)
    inverse = np.linalg.solve(factor.swapaxes(-1, -2), inner)
    if damped.any():
        where = "" if not damped.ndim else f" of sample {int(np.argmax(damped))}"
        least_told = float(np.min(condition))
        warn(
            f"operational_space: {frame!r} of {dyn.model.name} is near a singular pose{where}: reciprocal condition "
            f"{least_told:.1e}, below {threshold:.0e}; the inverse is damped there",
            SingularPoseWarning,
        )
    null = np.eye(dyn.model.nv) - inverse @ J
    single = J.ndim == 2
    told = (float(condition), bool(damped)) if single else (condition, damped)
    return OperationalSpace(J, inertia, inverse, null, *told)


def _rows(rows: str | Sequence[int] | None) -> list[int]:
    if rows is None:
        return list(range(6))
    if isinstance(rows, str):
        if rows not in _ROWS:
            raise InputError(f"rows: expected {', '.join(map(repr, _ROWS))} or indices from 0 to 5, got {rows!r}")
        return list(_ROWS[rows])
    chosen = list(rows)
    if not chosen or len(set(chosen)) < len(chosen) or any(type(i) is not int or not 0 <= i < 6 for i in chosen):
        raise InputError(f"rows: expected different indices from 0 to 5, got {rows!r}")
    return chosen


def _scales(A: Array, rows: list[int]) -> Array:
    """Return the norm of the linear rows, and of the angular ones, for each row: (..., m, 1)."""
    out = np.ones((*A.shape[:-1], 1))
    for part in _ROWS.values():
        places = [k for k, i in enumerate(rows) if i in part]
        if places:
            norm = np.linalg.norm(A[..., places, :], axis=(-2, -1))
            out[..., places, :] = np.where(norm > 0, norm, 1.0)[..., None, None]
    return out


def _squared(U: Array, s: Array, Vt: Array, m: int) -> tuple[Array, Array, Array]:
    """Return a decomposition with m singular values, zeros where there were fewer."""
    missing = m - s.shape[-1]
    if not missing:
        return U, s, Vt
    full = np.linalg.qr(U, mode="complete")[0]
    U = np.concatenate([U, full[..., s.shape[-1] :]], axis=-1)
    pad = [(0, 0)] * (s.ndim - 1)
    return U, np.pad(s, [*pad, (0, missing)]), np.pad(Vt, [*pad, (0, missing), (0, 0)])
