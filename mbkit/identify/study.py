"""`identify`: inertial parameters, friction and armature from measured motions and torques.

Weighted least squares of triangular systems: estimates, standard deviations, and what the data cannot tell.

Noise of every velocity's torque has a variance of its own, taken from its residuals and used as weight, until both
agree (Gautier and Poignet 2001, Extended Kalman filtering and weighted least squares dynamic identification of robot;
Swevers et al. 1997, Optimal robot excitation and identification). Columns are scaled to equal length before the
singular value decomposition, so that its small values are directions that the data cannot tell, and no matter of units.

Physically consistent parameters: those of matter, nearest to the data and to prior knowledge.

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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import EPS, PRINTED, Array, real, shown
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, MbkitWarning, NumericalError, UnsupportedError, warn
from mbkit.identify.measurements import (
    REST_SPEED_RATIO,
    Equations,
    Measurements,
    Unknowns,
    bias,
    equations,
    motion_noise,
)
from mbkit.identify.result import SIGNIFICANT_DEVIATIONS, Identification, IdentifiedParameter, Residual, Undetermined
from mbkit.model import Model
from mbkit.model.base_parameters import (
    BASE_PARAMETERS,
    POWERS,
    STANDARD,
    BaseParameters,
    eliminated,
    length_of,
    parameters_of,
    pseudo_inertia,
    standard_names,
)
from mbkit.model.builder import expect_model
from mbkit.model.changes.jumps import JumpLaw
from mbkit.model.elements.forces import GravityCompensation
from mbkit.simulate.progress import Progress, ProgressFunction

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


#: Singular values below this part of the largest one are directions that the data cannot tell. The rest of
#: geometry that counts as parallel is 1e-7 for base parameters; noise would be blown up as much.
SINGULAR_VALUE_RATIO: Final = 1e-8
_MAX_REWEIGHTINGS: Final = 10
#: Change of variances between two rounds at which they are taken as settled.
_VARIANCE_CHANGE: Final = 1e-3


@dataclass(frozen=True, eq=False)
class Fit:
    """The least squares of all equations.

    Attributes
    ----------
    values : (p,) array
        Along directions that the data cannot tell they are as far as before.
    deviations : (p,) array
        Standard deviations, no less than rounding; infinite where the data cannot tell a parameter.
    null : (k, p) array
        Directions that change no torque, each with a one that the others do not have.
    condition : float
        Of the matrix with columns of equal length, without those directions.
    noise : (nv,) array
        Standard deviation of each velocity's torque.
    """

    values: Array
    deviations: Array
    null: Array
    condition: float
    noise: Array


def fit(equations: Sequence[Equations], start: Array, units: Array, *, weighted: bool) -> Fit:
    """Solve the equations.

    Parameters
    ----------
    given : sequence of Equations
        One for each velocity.
    start : (p,) array
        The parameters as they are known before.
    units : (p,) array
        Natural sizes of the columns: one whose length is nothing beside the others in these counts as zero.
    weighted : bool
        Whether the equations have their weights already; else those of their noise are found.
    """
    noise = np.ones(len(equations))
    for _ in range(_MAX_REWEIGHTINGS):
        solution = _Solution(equations, noise, start, units)
        residuals = solution.residual_noise()
        if weighted:
            break
        before, noise = noise, _weighing(residuals, equations)
        if np.abs(noise / before - 1).max(initial=0.0) < _VARIANCE_CHANGE:
            break
    null = solution.null
    # Rounding of a sum of equations moves the estimates together, unlike noise of each.
    rounding = EPS * max((x.count**0.5 * x.size for x in equations), default=0.0)
    deviations = np.where(null.any(axis=0), np.inf, solution.deviations(np.maximum(residuals, rounding)))
    return Fit(solution.values, deviations, null, solution.condition, residuals)


def stacked(equations: Sequence[Equations], noise: Array) -> Array:
    """Return all equations, each over its noise, as one triangular system, (m, p + 1)."""
    out: Array = np.vstack([x.factor / s for x, s in zip(equations, noise, strict=True)])
    return np.asarray(np.linalg.qr(out, mode="r")) if len(out) > out.shape[1] else out


def _weighing(noise: Array, equations: Sequence[Equations]) -> Array:
    """Return the noise that weighs: no less than rounding, nor so small that the other equations would not count."""
    rounding = EPS * (max((x.size for x in equations), default=0.0) or 1.0)
    return np.maximum(noise, max(rounding, PRINTED * float(noise.max(initial=0.0))))


class _Solution:
    """The least squares for noise that is given."""

    def __init__(self, equations: Sequence[Equations], noise: Array, start: Array, units: Array) -> None:
        self._given, self._noise = equations, noise
        system = stacked(equations, noise)
        A, b = system[:, :-1], system[:, -1]
        lengths = np.linalg.norm(A, axis=0)
        natural = lengths / units
        observable = natural > SINGULAR_VALUE_RATIO * natural.max(initial=0.0)
        scale = np.where(observable, lengths, 1.0)
        U, sizes, axes = np.linalg.svd(np.where(observable, A / scale, 0.0))
        rank = int(np.sum(sizes > SINGULAR_VALUE_RATIO * sizes.max(initial=0.0)))
        self.condition = float(sizes[0] / sizes[rank - 1]) if rank else np.nan
        #: Parameters of each unit of the directions that the data can tell.
        self._back = axes[:rank].T / sizes[:rank] / scale[:, None]
        self.values = start + self._back @ (U[:, :rank].T @ (b - A @ start))
        self.null = _directions(axes[rank:], scale)

    def residual_noise(self) -> Array:
        """Return the standard deviation of each velocity's residuals, less the freedom that parameters took."""
        equations, noise = self._given, self._noise
        squares = np.array([np.sum((x.factor[:, :-1] @ self.values - x.factor[:, -1]) ** 2) for x in equations])
        left = np.array([x.count - np.sum(part**2) for x, part in zip(equations, self._parts(), strict=True)])
        # A velocity with next to no freedom left takes the noise of all of them.
        shared = np.sum(squares / noise**2) / max(float(left.sum()), 1.0)
        return np.asarray(np.sqrt(np.where(left >= 1.0, squares / np.maximum(left, 1.0), shared * noise**2)))

    def deviations(self, noise: Array) -> Array:
        """Return the standard deviations of the parameters if the torques have this noise."""
        parts = [x * (s / own) for x, s, own in zip(self._parts(), noise, self._noise, strict=True)]
        return np.asarray(np.linalg.norm(np.vstack(parts) @ self._back.T, axis=0))

    def _parts(self) -> list[Array]:
        """Return the rows of each velocity for units of the directions that the data can tell."""
        return [x.factor[:, :-1] @ self._back / s for x, s in zip(self._given, self._noise, strict=True)]


def _directions(null: Array, scale: Array) -> Array:
    """Return directions in units of the parameters, with an identity matrix among their columns."""
    if not len(null):
        return null
    eliminated_columns, unit = eliminated(null)
    unit[np.abs(unit) < PRINTED * np.abs(unit).max(axis=1, keepdims=True)] = 0.0
    return np.asarray(unit * scale[eliminated_columns, None] / scale)


IDENTIFICATION: Final = replace(
    BASE_PARAMETERS,
    name="identification",
    words="identify: not known of",
    carries=BASE_PARAMETERS.carries - {"t", "stop"},
    why={"t": "samples have no times", "stop": "samples on one have its force"},
    also=lambda m: (
        f"{f}, which depends on masses that are sought" for f in m.forces if type(f) is GravityCompensation
    ),
)


def identify(
    model: Model,
    q: ArrayLike,
    v: ArrayLike,
    a: ArrayLike,
    tau: ArrayLike,
    *,
    weights: ArrayLike | None = None,
    physical: bool = False,
    friction: bool = False,
    armature: bool = False,
    prior: str | None = None,
    prior_weight: float = 1.0,
    progress: bool | ProgressFunction | None = None,
    cutoff: float | None = None,
    rest: float = REST_SPEED_RATIO,
) -> Identification:
    """Identify the base parameters of a model from measured motions and torques, by weighted least squares.

    Geometry, gravity, springs, and whatever is not asked for are taken from the model; its masses and inertias say only
    where to stay along directions that the data cannot tell.

    Parameters
    ----------
    model : Model
    q : (N, nq) array_like
        rad, m.
    v, a : (N, nv) array_like
        Velocities and accelerations, as free of noise as can be: only that of the torques is weighed. `filtered_motion`
        makes them of positions. Where samples follow each other in time, what their noise does is estimated.
    tau : (N, nv) array_like
        Measured generalized forces, N m, N.
    weights : (nv,) or (N, nv) array_like, optional
        One over the standard deviation of the torques, up to a common factor; 0 leaves a torque out. By default the
        residuals of each velocity tell its noise, and its weight.
    physical : bool
        Whether the parameters have to be those of matter: pseudo-inertias positive definite, friction and armature not
        negative. Needs the packages of ``pip install 'mbkit[identify]'``. Bodies without mass stay without.
    friction : bool
        Whether to identify viscous and dry friction of every velocity. Without, both are taken from the model.
    armature : bool
        Whether to identify the armature of joints with one velocity.
    prior : {"entropic", "euclidean"}, optional
        With `physical`, the distance from the model that is small besides: Bregman's divergence of the pseudo-inertias
        or its quadratic form. By default the first.
    prior_weight : float
        Factor of that distance. At 1 it weighs as much as one more measurement of each body's parameters, with a
        standard deviation of their own size.
    progress : bool or callable, optional
        True for a bar, or a function of the fraction done.
    cutoff : float, optional
        Hz, of the filter that the positions went through; it is kept in the result.
    rest : float
        Part of a joint's greatest speed below which its torque gets no weight, where it has dry friction or `friction`
        is asked for: at rest friction holds with any force, and near it noise decides the sign of v.

    Returns
    -------
    Identification
        With ``parameters``, ``undetermined``, ``residuals``, and ``model``, the description with the identified values.

    Raises
    ------
    InputError
        Wrong shapes, numbers that are not finite, fewer equations than parameters, an unknown prior.
    UnsupportedError
        A model written as energies, one with constraints, forces that depend on the time or on the masses, such as
        gravity compensation, or a package that is not installed.
    NumericalError
        The solver found no consistent parameters.

    Warns
    -----
    MbkitWarning
        Noise of the motion biases an estimate by more than three of its standard deviations.

    Notes
    -----
    Standard deviations are Cramér and Rao's bound for white noise of the torques, with the variance of each velocity's
    residuals. With `physical` they are those without the constraints. Gautier and Poignet 2001; Swevers et al. 1997,
    Optimal robot excitation and identification; Wensing, Kim and Slotine 2018.

    Examples
    --------
    >>> import mbkit as mb
    >>> model = mb.catalog.double_pendulum()
    >>> motion = mb.excitation(model, duration=5.0, seed=0)
    >>> heavier = mb.catalog.double_pendulum(mass2=2.0)
    >>> tau = mb.dynamics(heavier, "mujoco").inverse_dynamics(motion.q, motion.v, motion.a)
    >>> found = mb.identify(model, motion.q, motion.v, motion.a, tau)
    >>> [(p.name, round(p.before, 6), round(p.value, 6)) for p in found.parameters if p.name == "rod2.hz"]
    [('rod2.hz', -1.0, -2.0)]
    """
    expect_model(model)
    IDENTIFICATION.admit(model)
    for name, flag in (("physical", physical), ("friction", friction), ("armature", armature)):
        if not isinstance(flag, (bool, np.bool_)):
            raise InputError(f"{name}: expected True or False, got {shown(flag)}")
    if prior is not None and prior not in PRIORS:
        raise InputError(f"prior: expected {' or '.join(map(repr, PRIORS))}, got {shown(prior)}")
    if prior is not None and not physical:
        raise InputError("prior: expected physical=True with it; without, the data alone decide")
    prior_weight = real("prior_weight", prior_weight, positive=True)
    unknowns = Unknowns.of(model, bool(friction), bool(armature))
    rest = real("rest", rest, nonnegative=True)
    if rest >= 1:
        raise InputError(f"rest: expected a part of the greatest speed below 1, got {rest:g}")
    dry = np.full(model.nv, True) if friction else JumpLaw(model).bound > 0
    data = Measurements.of(model, q, v, a, tau, weights).moving(dry, rest)
    _require_enough(model, unknowns, data)
    with Progress(progress, "identify") as reported:
        given = equations(LagrangianDynamics(model), unknowns, data, reported)
    length = length_of(model)
    fitted = fit(given, unknowns.nominal, _units(model, unknowns, length), weighted=weights is not None)
    off = _bias(model, unknowns, data, fitted, length, weights is not None)
    values = fitted.values
    if physical:
        noise = np.maximum(fitted.noise, PRINTED * (max(x.size for x in given) or 1.0))
        if weights is not None:
            noise = np.sqrt(np.mean(noise**2)) * np.ones(len(noise))
        values, standard = consistent(stacked(given, noise), unknowns, length, prior or ENTROPIC, prior_weight)
    else:
        standard = nearest(unknowns.base, values, length)
    return Identification(
        model.name,
        _parameters(unknowns, values, fitted, off),
        tuple(_undetermined(unknowns, row) for row in fitted.null),
        _residuals(model, given, fitted),
        fitted.condition,
        len(data),
        bool(physical),
        (prior or ENTROPIC) if physical else "",
        standard_names(model),
        tuple(standard.tolist()),
        bool(friction),
        bool(armature),
        model,
        None if cutoff is None else real("cutoff", cutoff, positive=True),
    )


def _require_enough(model: Model, unknowns: Unknowns, data: Measurements) -> None:
    needed = -(-len(unknowns.names) // max(model.nv, 1))
    if not unknowns.names:
        raise InputError(f"model: expected one whose motion depends on inertial parameters, got {model.name}")
    if len(data) < needed:
        size = f"{len(unknowns.names)} parameters and {model.nv} torques a sample"
        raise InputError(f"samples: expected at least {needed}, for {size}, got {len(data)}")


def _units(model: Model, unknowns: Unknowns, length: float) -> Array:
    """Return the natural sizes of the columns of the equations."""
    powers = dict(zip(standard_names(model), np.tile(POWERS, len(model.tree)), strict=True))
    return np.array([length ** powers.get(name, 0) for name in unknowns.names])


def _bias(model: Model, unknowns: Unknowns, data: Measurements, fitted: Fit, length: float, weighted: bool) -> Array:
    """Return the bias of the estimates by noise of the motion, and warn where it is large."""
    dyn, units = LagrangianDynamics(model), _units(model, unknowns, length)

    def solve(other: Measurements) -> tuple[Array, Array]:
        again = fit(equations(dyn, unknowns, other, Progress(None, "")), unknowns.nominal, units, weighted=weighted)
        return again.values, again.noise

    out = bias(data, fitted.values, fitted.noise, solve)
    known = np.isfinite(fitted.deviations) & (fitted.deviations > 0)
    ratio = np.where(known, np.abs(out) / np.where(known, fitted.deviations, 1.0), 0.0)
    if (many := int(np.sum(ratio > SIGNIFICANT_DEVIATIONS))) > 0:
        worst, (v, a) = int(np.argmax(ratio)), motion_noise(data)
        warn(
            f"{model.name}: noise of the motion (up to {v.max():.2g} in v, {a.max():.2g} in a) biases {many} of "
            f"{len(ratio)} estimates by more than {SIGNIFICANT_DEVIATIONS:g} standard deviations, "
            f"{unknowns.names[worst]} by {ratio[worst]:.3g}; filter the positions "
            "first: mbkit.identify.filtered_motion",
            MbkitWarning,
        )
    return out


def _parameters(unknowns: Unknowns, values: Array, fitted: Fit, off: Array) -> tuple[IdentifiedParameter, ...]:
    numbers = (x.tolist() for x in (unknowns.nominal, values, fitted.deviations, off))
    return tuple(IdentifiedParameter(*x) for x in zip(unknowns.names, unknowns.combinations, *numbers, strict=True))


def _undetermined(unknowns: Unknowns, direction: Array) -> Undetermined:
    which = np.flatnonzero(direction).tolist()
    return Undetermined(tuple(unknowns.names[k] for k in which), tuple(float(direction[k]) for k in which))


def _residuals(model: Model, given: Sequence[Equations], fitted: Fit) -> tuple[Residual, ...]:
    noise = zip(model.velocity_names, given, fitted.noise.tolist(), strict=True)
    return tuple(Residual(name, x.count, x.size, s) for name, x, s in noise)
