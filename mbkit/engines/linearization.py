"""Linearization for control: A and B of the motion near a state and of one step, and higher derivatives.

A small change of a state is x = (δq, δv). δv is a change of v's components. δq is a vector of the tangent space, of
length nv: the changed configuration is ``model.integrate(q, δq)``. At a ball joint it is a small turn in the body's
axes, at a free joint a small shift and turn in the body's axes, elsewhere a change of the coordinates.

That tangent space moves with q, and adds a term to δq's rate. With the brackets [D_i, D_j] = Σ c_ijk D_k of the columns
of q̇ = D(q) v::

    d/dt δq = δv - S(v) δq        (S δq)_k = Σ c_ijk v_i δq_j

S is zero where v = q̇, ω̂ for a ball joint and ad_v = [[ω̂, v̂], [0, ω̂]] for a free joint, with v linear then angular in
body axes. With the Boltzmann-Hamel term, hamel(v, p) = -Sᵀ p.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, real, with_shapes
from mbkit.engines.evaluation import Evaluation
from mbkit.engines.steps import Slopes, differentiable_method, step_derivatives
from mbkit.errors import InputError, NumericalError, UnsupportedError, require_known
from mbkit.methods.registry import DEFAULT_METHOD, Method
from mbkit.methods.small_motions import graded
from mbkit.model import Model
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.quantities import QUANTITIES, of_groups

LINEARIZE: Final = Path("linearize", "linearize: not known of", ALL)
#: Quantities that `parameter_derivatives` differentiates.
DIFFERENTIABLE: Final = of_groups("equation")
#: Derivatives of a batch that are computed at a time; so many fit into a processor's cache.
_MAX_DERIVATIVES_AT_A_TIME: Final = 2**18


@with_shapes
class DiscreteLinearization(NamedTuple):
    """Small changes of a state over a step: x₁ = A x + B δτ, with τ held. See `Linearization` for x.

    x₁ is measured at the state that the step leads to.
    """

    #: (2nv, 2nv) or (N, 2nv, 2nv).
    A: Array
    #: (2nv, nv) or (N, 2nv, nv).
    B: Array
    #: The step of the state itself, (2nv,) or (N, 2nv): it leads to ``model.integrate(q, f[:nv])`` and ``v + f[nv:]``.
    f: Array


@with_shapes
class Linearization(NamedTuple):
    """Small changes of a state (q, v) under a force τ: ẋ = A x + B δτ.

    x = (δq, δv) is measured at the moving state: the changed one is ``model.integrate(q(t), δq)`` and ``v(t) + δv``. At
    free and ball joints δq is a shift and a turn in the body's axes, which turn with it: there A has -ad_v and -ω̂.
    """

    #: (2nv, 2nv) or (N, 2nv, 2nv).
    A: Array
    #: (2nv, nv) or (N, 2nv, nv).
    B: Array
    #: (v, v̇), the rate of the state itself, (2nv,) or (N, 2nv); zero at an equilibrium.
    f: Array
    #: A for the same changes measured at this very state, which stays: y = (difference(q, q(t)), v(t) - v) follows
    #: ẏ = f + A_fixed y + B δτ. It differs from A at moving free and ball joints, which have half of -ad_v and -ω̂ here.
    A_fixed: Array

    @property
    def eigenvalues(self) -> Any:
        """Eigenvalues of A, 1/s, (2nv,) or (N, 2nv); slow ones beside fast ones keep their digits."""
        rows = [graded(A, vectors=False)[0] for A in self.A.reshape(-1, *self.A.shape[-2:])]
        return np.array(rows, dtype=complex).reshape(self.A.shape[:-1])

    def discretize(self, dt: float) -> DiscreteLinearization:
        """Return the linear system's exact solution over dt seconds, with the force held (zero-order hold).

        A is exp(A dt), and B and f are integrals of it. A and B stay those of this state, though the state moves on:
        good to order dt² where it is no equilibrium. `Dynamics.discretize` has the exact derivative of a method's step.

        Parameters
        ----------
        dt : float
            s, above 0.

        Raises
        ------
        InputError
            dt is not positive.
        """
        from scipy.linalg import expm

        h, n, m = real("dt", dt, positive=True), self.A.shape[-1], self.B.shape[-1]
        # exp of [[A, B], [0, 0]] holds the integral too (Van Loan 1978, Computing integrals involving the matrix
        # exponential).
        moved = np.zeros((*self.A.shape[:-2], n + m, n + m))
        moved[..., :n, :n], moved[..., :n, n:] = self.A, self.B
        still = np.zeros((*self.A.shape[:-2], n + 1, n + 1))
        still[..., :n, :n], still[..., :n, n] = self.A_fixed, self.f
        changes, motion = (np.asarray(expm(h * x)) if x.size else x for x in (moved, still))
        out = DiscreteLinearization(changes[..., :n, :n], changes[..., :n, n:], motion[..., :n, n])
        if not all(np.isfinite(x).all() for x in out):
            raise NumericalError(f"discretize: the exponential over dt = {h:g} s overflows; take a shorter step")
        return out


@with_shapes
class InverseDynamicsDerivatives(NamedTuple):
    """Derivatives of τ = M a + nle - τ_passive, each (nv, nv) or (N, nv, nv)."""

    #: ∂τ/∂q along the manifold; column k is that of q ⊕ t e_k.
    q: Array
    #: ∂τ/∂v.
    v: Array
    #: ∂τ/∂a, the mass matrix.
    a: Array


@with_shapes
class ForwardDynamicsDerivatives(NamedTuple):
    """Derivatives of v̇ = M⁻¹ (τ + τ_passive - nle), each (nv, nv) or (N, nv, nv)."""

    #: ∂v̇/∂q along the manifold; column k is that of q ⊕ t e_k.
    q: Array
    #: ∂v̇/∂v.
    v: Array
    #: ∂v̇/∂τ, the inverse of the mass matrix.
    tau: Array


@with_shapes
class InverseDynamicsSecondDerivatives(NamedTuple):
    """Second derivatives of τ = M a + nle - τ_passive, each (nv, nv, nv) or (N, nv, nv, nv).

    Entry [i, j, k] is the derivative by the second variable's k of ∂τ_i by the first one's j; that by a twice is zero.
    Derivatives by q are along the manifold, as in `InverseDynamicsDerivatives`.
    """

    #: d/dt of ∂τ_i/∂q_j at q ⊕ t e_k. Symmetric in j and k where v = q̇; of free and ball joints the order matters:
    #: qq[i, j, k] - qq[i, k, j] = Σ_l c_kjl ∂τ_i/∂q_l, with c of the brackets of D's columns.
    qq: Array
    #: ∂²τ_i/∂q_j ∂v_k.
    qv: Array
    #: ∂²τ_i/∂v_j ∂v_k, symmetric in j and k.
    vv: Array
    #: ∂²τ_i/∂q_j ∂a_k, the derivatives of the mass matrix's column k.
    qa: Array


def of_second_order(out: Any) -> Any:
    """Return qq, qv, vv and qa, (..., 4, nv, nv, nv), of what the derivation gives side by side, (..., nv², 4 nv)."""
    n = out.shape[-1] // 4
    stacked = np.moveaxis(out.reshape(*out.shape[:-2], n, n, 4, n), (-2, -3), (-4, -3)).copy()
    # M's entries are by a, and then by q.
    stacked[..., 3, :, :, :] = stacked[..., 3, :, :, :].swapaxes(-1, -2).copy()
    return stacked


def of_parameters(model: Model, quantity: str, out: Any) -> Any:
    """Return derivatives by parameters, (..., entries, p), in the quantity's shape and a last axis of p."""
    n, p, axes = model.nv, out.shape[-1], len(QUANTITIES[quantity].shape)
    if axes == 2:
        return out.reshape(*out.shape[:-2], n, n, p).swapaxes(-2, -3)
    return out if axes else out[..., 0, :]


def tangent_rate(model: Model, q: Array, v: Array) -> tuple[Array, Array]:
    """Return X of d/dt δq = δv + X δq where δq is measured at the moving q, and where it is at the first one.

    Both (nv, nv) or (N, nv, nv).
    """
    X = np.zeros((*v.shape, v.shape[-1]))
    if model.velocity_map is not None:
        if v.ndim == 2:
            each = [tangent_rate(model, *row) for row in zip(q, v, strict=True)]
            return (np.array([x for x, _ in each]).reshape(X.shape), np.array([y for _, y in each]).reshape(X.shape))
        # q ⊕ δq is q + D(q) δq: the rate of D at the moving q enters.
        by_q, D, inverse = model.velocity_map.linear(q, v)
        rates = [model.velocity_map.linear(q, e)[0] @ (D @ v) for e in np.eye(model.nv)]
        fixed = inverse @ by_q @ D
        return fixed - inverse @ np.array(rates).reshape(X.shape).T, fixed
    for joint in model.independent_joints:
        if joint.type.quaternion is not None:
            own = model.layout.v[joint.name]
            components = list(v[..., own].T)
            for k, e in enumerate(np.eye(joint.type.nv).tolist()):
                for i, x in enumerate(joint.type.hamel(components, e)):
                    X[..., own.start + k, own.start + i] = x
    # Exponential coordinates move by v and half of the bracket, to first order.
    return X, X / 2


def _blocks(rate: Array, by_q: Array, by_v: Array) -> Array:
    n = by_q.shape[-1]
    A = np.zeros((*by_q.shape[:-2], 2 * n, 2 * n))
    A[..., :n, :n], A[..., n:, :n], A[..., n:, n:] = rate, by_q, by_v
    A[..., range(n), range(n, 2 * n)] = 1.0
    return A


class LinearizationQuantities(Evaluation):
    """The methods of `Dynamics` for control, for parameters, and of second order."""

    def linearize(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Linearization:
        """Return A, B and f of the motion near a state: ẋ = A x + B δτ.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, tau : (nv,) or (N, nv) array_like
            Velocity and generalized force. One state beside a batch is repeated.

        Returns
        -------
        Linearization
            Arrays A (2nv, 2nv), B (2nv, nv), f = (v, v̇) (2nv,) and A_fixed; a batch has N of each. Its
            ``discretize(dt)`` holds the force over a step.

        Raises
        ------
        UnsupportedError
            The engine has no derivatives of this model.

        Notes
        -----
        x = (δq, δv), with δq of the tangent space: the changed configuration is ``model.integrate(q, δq)``. At free
        and ball joints it is a shift and a turn in the body's axes, and d/dt δq = δv - ad_v δq, d/dt δq = δv - ω × δq.
        B's upper half is zero and its lower half M⁻¹. Under constraints A is that of the constrained acceleration, for
        changes that keep them.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum(mass=2.0, length=0.5), "lagrangian")
        >>> A, B, f, _ = dyn.linearize([0.0], [0.0], [0.0])
        >>> A.round(12).tolist(), B.round(12).tolist()
        ([[0.0, 1.0], [-19.62, 0.0]], [[0.0], [2.0]])
        """
        LINEARIZE.admit(self.model)
        states, _ = self._states({"q": q, "v": v, "tau": tau})
        a, by_q, by_v, by_tau, _ = self._forward_slopes(states["q"], states["v"], states["tau"])
        moving, fixed = tangent_rate(self.model, states["q"], states["v"])
        n = self.model.nv
        B = np.zeros((*by_tau.shape[:-2], 2 * n, n))
        B[..., n:, :] = by_tau
        f = np.concatenate([states["v"], a], axis=-1)
        return Linearization(_blocks(moving, by_q, by_v), B, f, _blocks(fixed, by_q, by_v))

    def discretize(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, dt: float, method: str = DEFAULT_METHOD
    ) -> DiscreteLinearization:
        """Return the exact derivative of one step of a method of integration: x₁ = A x + B δτ.

        The chain rule through the method's stages, in which forward dynamics has the engine's own derivatives; stages
        that are solved for are differentiated as an implicit function.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v, tau : (nv,) or (N, nv) array_like
            Velocity, and the generalized force that is held over the step.
        dt : float
            s, above 0.
        method : str
            One with a fixed step in mbkit's own code: ``"rk4"``, ``"semi_implicit_euler"``, ``"gauss4"``, ``"gauss6"``,
            a tableau of `mbkit.simulate.register_method`, or, on the lagrangian engine, ``"implicit_midpoint"``.

        Returns
        -------
        DiscreteLinearization
            A (2nv, 2nv), B (2nv, nv) and f (2nv,), of a batch N of each. A's columns are changes of the state before
            the step, its rows of the state after it, each in the tangent space there.

        Raises
        ------
        NumericalError
            The state after the step is not finite, or the stages of an implicit method are not solved.
        UnsupportedError
            A method without a fixed step of mbkit's own; an engine without derivatives; a model with constraints, with
            quasi-velocities of its own or with terms that depend on the time.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.pendulum())
        >>> step = dyn.discretize([1.0], [0.0], [0.0], dt=0.01, method="semi_implicit_euler")
        >>> float(round(step.A[0, 0] * step.A[1, 1] - step.A[0, 1] * step.A[1, 0], 12))  # keeps areas
        1.0
        """
        chosen, h = differentiable_method(self.model, self.engine, method), real("dt", dt, positive=True)
        states, _ = self._states({"q": q, "v": v, "tau": tau})
        q1, v1, slopes = self._step_slopes(chosen, h, parameters=False, **states)
        n, model = self.model.nv, self.model
        move = np.concatenate([model.difference(states["q"], q1), v1 - states["v"]], axis=-1)
        return DiscreteLinearization(slopes[..., : 2 * n], slopes[..., 2 * n :], move)

    def _forward_slopes(self, q: Array, v: Array, tau: Array, *, parameters: bool = False) -> Slopes:
        if q.ndim == 2 and len(q) == 1 and self._samples is None:
            # Calls for one state are several times quicker than those for a batch of one.
            one = self._forward_slopes(q[0], v[0], tau[0], parameters=parameters)
            return Slopes(*(x[None] for x in one))
        a, (by_q, by_v, by_tau) = self.forward_dynamics(q, v, tau), self.forward_dynamics_derivatives(q, v, tau)
        by_p = self.parameter_derivatives("forward_dynamics", q, v, tau) if parameters else np.empty((*a.shape, 0))
        return Slopes(a, by_q, by_v, by_tau, by_p)

    def _step_slopes(
        self, method: Method, dt: float, q: Array, v: Array, tau: Array, *, parameters: bool
    ) -> tuple[Array, Array, Array]:
        """Return q and v after a step, and (..., 2nv, 3nv) or, with parameters, (..., 2nv, 3nv + p).

        The columns of the derivatives are those by δq, δv, τ and the parameters.
        """
        count = len(self.model.parameters) if parameters else 0
        size = max(1, _MAX_DERIVATIVES_AT_A_TIME // max(1, 2 * self.model.nv * (3 * self.model.nv + count)))
        if q.ndim == 2 and len(q) > size:
            slices = [np.arange(k, min(k + size, len(q))) for k in range(0, len(q), size)]
            each = [
                self._of_samples(at)._step_slopes(method, dt, q[at], v[at], tau[at], parameters=parameters)
                for at in slices
            ]
            q1, v1, slopes = (np.concatenate(x) for x in zip(*each, strict=True))
            return q1, v1, slopes
        rates = partial(self._forward_slopes, tau=np.atleast_2d(tau), parameters=parameters)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            try:
                if method.in_momenta:
                    step = self._own_method("momentum_step_slopes")
                    q1, v1, slopes = step(dt, q, v, tau, parameters=parameters)
                else:
                    q1, v1, slopes = step_derivatives(self.model, method, rates, dt, q, v, count)
            except np.linalg.LinAlgError:
                raise NumericalError(
                    f"{self.engine}: the equations of the step of {self.model.name} by {method.name} are singular; "
                    "take shorter steps"
                ) from None
        if not all(np.isfinite(x).all() for x in (q1, v1, slopes)):
            raise NumericalError(
                f"{self.engine}: the step of {self.model.name} by {method.name}: the state or its derivative is not "
                f"finite after dt = {dt:g} s; take shorter steps"
            )
        return q1, v1, slopes

    def inverse_dynamics_second_derivatives(
        self, q: ArrayLike, v: ArrayLike, a: ArrayLike
    ) -> InverseDynamicsSecondDerivatives:
        """Return the second derivatives of inverse dynamics; the own derivation and the oracle only.

        Fields qq, qv, vv and qa, each (nv, nv, nv) or (N, nv, nv, nv): entry [i, j, k] is the derivative by the second
        variable's k of ∂τ_i by the first one's j, with derivatives by q along the manifold.

        Only entries that are not zero for every state are computed. Deriving and compiling takes some three seconds for
        an arm of six joints and six seconds for one of eight; beyond 200,000 operations they are interpreted.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum(), "lagrangian")
        >>> by = dyn.inverse_dynamics_second_derivatives([0.1, 0.2], [1.0, -2.0], [0.0, 0.0])
        >>> bool(by.vv[1, 0, 0] > 0)  # the centrifugal force on the second joint
        True
        """
        name = "inverse_dynamics_second_derivatives"
        out = self._differentiated(name, self._own_method(name), {"q": q, "v": v, "a": a})
        return InverseDynamicsSecondDerivatives(*(out[..., k, :, :, :] for k in range(4)))

    def parameter_derivatives(self, quantity: str, *arguments: ArrayLike) -> Array:
        """Return the exact derivatives of a quantity by the model's named parameters.

        For models with `mbkit.Parameter`, on the lagrangian engine and the oracle.

        Parameters
        ----------
        quantity : str
            ``"inverse_dynamics"``, ``"forward_dynamics"``, ``"mass_matrix"``, ``"coriolis_matrix"``,
            ``"coriolis_force"``, ``"gravity"``, ``"nle"``, ``"passive"``, ``"kinetic_energy"`` or
            ``"potential_energy"``.
        *arguments : array_like
            What the method of this name takes: q, and v, a or tau; one state or a batch.

        Returns
        -------
        array
            Of the quantity's shape with a last axis more, of the p parameters in the order of ``model.parameters``:
            (nv, p) or (N, nv, p) of forces and accelerations.

        Raises
        ------
        UnknownNameError
            No such quantity.
        UnsupportedError
            The engine has no derivatives by parameters.

        Examples
        --------
        >>> import mbkit as mb
        >>> model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0), length=mb.Parameter("l", 0.5))
        >>> dyn = mb.dynamics(model, "lagrangian")
        >>> list(model.parameters), dyn.parameter_derivatives("mass_matrix", [0.3]).tolist()  # M = m l²
        (['m', 'l'], [[[0.25, 2.0]]])
        """
        require_known("quantity", DIFFERENTIABLE, quantity)
        names = DIFFERENTIABLE[quantity]
        if len(arguments) != len(names):
            raise InputError(
                f"parameter_derivatives: {quantity} takes {', '.join(names)}, got {len(arguments)} arguments"
            )
        method = partial(self._own_method("parameter_derivatives"), quantity)
        return self._differentiated(
            f"derivatives of {quantity} by parameters", method, dict(zip(names, arguments, strict=True))
        )

    def _own_method(self, name: str) -> Callable[..., Any]:
        method: Callable[..., Any] | None = getattr(self, f"_{name}", None)
        if method is None:
            raise UnsupportedError(
                f"{self.engine} cannot give {name}: it has no expressions; mbkit.dynamics(model, 'lagrangian') has"
            )
        return method

    def _differentiated(self, name: str, method: Callable[..., Any], arguments: dict[str, ArrayLike]) -> Array:
        states, size = self._states(arguments)
        out = np.array(self._value(method, [*states.values()], (), size), dtype=np.float64)
        self._require_finite(name, out, states)
        return out
