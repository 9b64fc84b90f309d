"""Sensitivities along a run: the exact derivatives of the discrete motion by the start, forces and parameters.

A run by a method with a fixed step is a composition of steps, so its derivative is the product of theirs::

    X_{k+1} = A_k X_k + (0, B_k, P_k)        X_0 = (1, 0, 0)

with A_k, B_k and P_k those of `mbkit.engines.steps` at the states of the run. They are derivatives of the
numbers that the run computes, not of the exact motion, from which they differ by the method's order.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, count, real
from mbkit.engines import Dynamics
from mbkit.engines.base import no_dynamics
from mbkit.engines.steps import differentiable_method
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.methods.registry import DEFAULT_METHOD
from mbkit.simulate.run import simulate
from mbkit.simulate.time_grid import DEFAULT_STEP, MAX_NUMBERS, Grid
from mbkit.simulate.torque import Torque
from mbkit.simulate.trajectory import Trajectory


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivities:
    """A run of K states and its derivatives; those of a batch have N in front.

    Changes of a state are x = (δq, δv), (2nv,), with δq of the tangent space at that state, as in
    `mbkit.engines.Linearization`.

    Attributes
    ----------
    run : Trajectory
        Every step of it.
    A : (K - 1, 2nv, 2nv) array
        ∂x_{k+1}/∂x_k of each step.
    B : (K - 1, 2nv, nv) array
        ∂x_{k+1}/∂τ_k by the force that is held over the step.
    state : (K, 2nv, 2nv) array
        ∂x_k/∂x_0, the state transition matrix from the start.
    tau : (K, 2nv, nv) array
        ∂x_k/∂τ by a force that is added from the start on, and held.
    parameters : (K, 2nv, p) array
        ∂x_k by the model's named parameters, in the order of ``run.model.parameters``; p is 0 without them.
    """

    run: Trajectory
    A: Array
    B: Array
    state: Array
    tau: Array
    parameters: Array

    def transition(self, start: int, end: int) -> Array:
        """Return ∂x_end/∂x_start, (2nv, 2nv) or (N, 2nv, 2nv), by indices of states with start <= end.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum())
        >>> out = mb.sensitivities(dyn, [1.0], [0.0], 0.5, dt=0.01)
        >>> bool(abs(out.transition(20, 50) @ out.state[20] - out.state[50]).max() < 1e-13)
        True
        """
        last = self.A.shape[-3]
        first, end = count("start", start), count("end", end)
        if not first <= end <= last:
            raise InputError(f"start, end: expected 0 <= start <= end <= {last}, got {first} and {end}")
        out = np.broadcast_to(np.eye(self.A.shape[-1]), (*self.A.shape[:-3], *self.A.shape[-2:])).copy()
        for k in range(first, end):
            out = self.A[..., k, :, :] @ out
        return out

    @cached_property
    def t(self) -> Array:
        """Times of the states, (K,), s."""
        return self.run.t

    def __repr__(self) -> str:
        shape, p = self.state.shape, self.parameters.shape[-1]
        return f"<Sensitivities of {self.run.model.name!r}: states {shape[:-2]}, 2nv = {shape[-1]}, p = {p}>"


def sensitivities(
    dyn: Dynamics,
    q0: ArrayLike,
    v0: ArrayLike,
    duration: float,
    dt: float = DEFAULT_STEP,
    method: str = DEFAULT_METHOD,
    torque: ArrayLike | None = None,
    parameters: bool = True,
) -> Sensitivities:
    """Simulate with a fixed step and return the exact derivatives of the discrete motion.

    Parameters
    ----------
    dyn : Dynamics
        With derivatives of its forward dynamics.
    q0 : (nq,) or (N, nq) array_like
    v0 : (nv,) or (N, nv) array_like
    duration, dt : float
        s.
    method : str
        One that `Dynamics.discretize` differentiates.
    torque : array_like, optional
        Generalized force, (nv,) all the time, or (steps, nv) or (N, steps, nv), held over each step.
    parameters : bool
        Whether to differentiate by the model's named parameters, where it has some.

    Returns
    -------
    Sensitivities
        The run with ∂x(t)/∂x₀, ∂x(t)/∂τ, ∂x(t)/∂parameters, and A and B of each step.

    Raises
    ------
    InputError
        A wrong shape, state, time or torque.
    NumericalError
        The run or a derivative does not stay finite.
    UnsupportedError
        A torque function; a method, model or engine without the derivative of its step.

    Notes
    -----
    The run is that of `mbkit.simulate`. All its steps are differentiated side by side, and then multiplied. In chaotic
    motion the derivatives grow as fast as neighbouring motions part.

    Examples
    --------
    A pendulum's amplitude changes its period, so neighbours fall behind:

    >>> import mbkit as mb
    >>> dyn = mb.dynamics(mb.catalog.pendulum(length=mb.Parameter("l", 1.0)), "lagrangian")
    >>> out = mb.sensitivities(dyn, [1.0], [0.0], 2.0, dt=0.01)
    >>> out.state.shape, out.parameters.shape
    ((201, 2, 2), (201, 2, 1))
    """
    if not isinstance(dyn, Dynamics):
        raise no_dynamics(dyn)
    if not isinstance(parameters, (bool, np.bool_)):
        raise InputError(f"parameters: expected True or False, got {parameters!r}")
    if callable(torque):
        raise UnsupportedError(
            "torque: expected an array; the slope of a function is not known: give the forces that it returned, "
            "(steps, nv), and close the loop with A + B K"
        )
    chosen, model = differentiable_method(dyn.model, dyn.engine, method), dyn.model
    h, n = real("dt", dt, positive=True), model.nv
    by_parameters = bool(parameters) and bool(model.parameters)
    run = simulate(dyn, q0, v0, duration, chosen.name, h, torque=torque, doubt=False)
    if not run.stats.finished:
        raise NumericalError(f"sensitivities: the run of {model.name} {run.stats.message}; take shorter steps")
    batch = None if run.q.ndim == 2 else len(run.q)
    grid = Grid.of(float(run.t[0]), real("duration", duration), h)
    columns = 3 * n + (len(model.parameters) if by_parameters else 0)
    numbers = 4 * n * columns * len(run.t) * (batch or 1)
    if numbers > MAX_NUMBERS:
        raise InputError(
            f"duration, dt: the derivatives of {grid.steps} steps would take {numbers * 8 / 2**30:.3g} GiB; "
            "take longer steps, or a shorter run at a time: transition matrices multiply"
        )
    force = Torque(torque, model, batch, grid.steps)
    members, steps = 1 if batch is None else batch, grid.steps
    q, v = (x.reshape(members, steps + 1, x.shape[-1])[:, :-1] for x in (run.q, run.v))
    tau = np.broadcast_to(np.moveaxis(force.columns(slice(None), 0, steps), -1, 0), (members, steps, n))
    slopes = np.empty((members, steps, 2 * n, columns))
    # The last step may be shorter.
    for at in (slice(0, steps - 1), slice(steps - 1, steps)) if steps else ():
        many = at.stop - at.start
        rows = [x[:, at].reshape(members * many, x.shape[-1]) for x in (q, v, tau)]
        if many and members:
            own = dyn._of_samples(np.repeat(np.arange(members), many))
            out = own._step_slopes(chosen, grid.step(at.start), *rows, parameters=by_parameters)[2]
            slopes[:, at] = out.reshape(members, many, 2 * n, columns)
    change = np.zeros((members, steps + 1, 2 * n, columns))
    change[:, 0, range(2 * n), range(2 * n)] = 1.0
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(steps):
            change[:, k + 1] = slopes[:, k, :, : 2 * n] @ change[:, k]
            change[:, k + 1, :, 2 * n :] += slopes[:, k, :, 2 * n :]
    if not np.isfinite(change).all():
        k = int(np.argmin(np.isfinite(change).all(axis=(0, 2, 3))))
        raise NumericalError(f"sensitivities: of {model.name} are beyond all bounds at {run.t[k]:.6g} s")
    if batch is None:
        slopes, change = slopes[0], change[0]
    split = np.split(change, [2 * n, 3 * n], axis=-1)
    return Sensitivities(run, slopes[..., : 2 * n], slopes[..., 2 * n : 3 * n], *split)
