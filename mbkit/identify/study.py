"""`identify`: inertial parameters, friction and armature from measured motions and torques."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import PRINTED, Array, real, shown
from mbkit._warn import warn
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, MbkitWarning
from mbkit.identify.consistency import ENTROPIC, PRIORS, consistent, nearest
from mbkit.identify.least_squares import Fit, fit, stacked
from mbkit.identify.measurements import REST_SPEED_RATIO, Equations, Measurements, Unknowns, equations
from mbkit.identify.motion_noise import bias, motion_noise
from mbkit.identify.result import SIGNIFICANT_DEVIATIONS, Identification, IdentifiedParameter, Residual, Undetermined
from mbkit.model import Model
from mbkit.model.base_parameters import BASE_PARAMETERS, POWERS, length_of, standard_names
from mbkit.model.builder import expect_model
from mbkit.model.changes.jumps import JumpLaw
from mbkit.model.elements.forces import GravityCompensation
from mbkit.simulate.progress import Progress, ProgressFunction

IDENTIFICATION: Final = replace(
    BASE_PARAMETERS,
    name="identification",
    words="identify: not known of",
    carries=BASE_PARAMETERS.carries - {"t"},
    why={"t": "samples have no times"},
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
