"""Holonomic constraints f(q, t) = 0 in numbers: the states that they allow, and whether they are independent there.

A state is consistent where f = 0 and ḟ = J v + ∂f/∂t = 0. Independence belongs to a pose: a set may have full rank on
one branch of a mechanism only (a row of equal four-bars).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final, NamedTuple, cast
from weakref import WeakKeyDictionary

import casadi as ca
import numpy as np

from mbkit._check import Array
from mbkit.derivation.mass_matrix_solve import solve
from mbkit.engines.base import Dynamics, at_time
from mbkit.engines.lagrangian import LagrangianDynamics
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.lagrangian.energies.casadi_equations import EnergyEquations
from mbkit.lagrangian.energies.energy_form import EnergyForm
from mbkit.model import Model

_EPS: Final = float(np.finfo(float).eps)
#: Of each row's scale: what rounding and a few typed digits leave of a consistent state.
_CONSISTENT: Final = 1e-8
# Newton's iteration squares the residual: from here it ends at rounding.
_NEAR: Final = 1e-8
_MOST: Final = 60
_TWIN: Final = "_constrained_twin"


def _function(eq: EnergyEquations, name: str) -> ca.Function:
    """Return a compiled function of (q), (q, v) or (q, v, τ), and the parameters."""
    c, m = eq.constraints, eq.constraints.value.shape[0]
    inputs = {"q": eq.q, "v": eq.v}
    if name == "constraint_rows":
        del inputs["v"]
        outputs = {"f": c.value, "J": c.jacobian}
    elif name == "constraint":
        M = eq.mass_matrix
        outputs = {"f": c.value, "J": c.jacobian, "by_time": c.by_time, "rate": c.rate, "W": c.weight(M), "M": M}
    elif name == "constraint_step":
        # q after a step of Newton's, v consistent there, f before it and its scale.
        Y = solve(c.weight(eq.mass_matrix), c.jacobian.T, eq.elimination_order)
        S = ca.mtimes(c.jacobian, Y)
        q1 = eq.q - ca.mtimes(Y, solve(S, c.value, range(m)))
        Y1, S1, rate1 = (ca.substitute(x, eq.q, q1) for x in (Y, S, c.rate))
        v1 = eq.v - ca.mtimes(Y1, solve(S1, rate1, range(m)))
        outputs = {"q1": q1, "v1": v1, "f": c.value, "scale": ca.sqrt(ca.sum2(c.jacobian**2))}
    elif name == "multipliers":
        inputs["tau"] = eq.tau
        outputs = {"lambda": eq.multipliers}
    elif name == "embedded":
        outputs = {
            "J": c.jacobian,
            "by_time": c.by_time,
            "gamma": c.gamma,
            "M": eq.mass_matrix,
            "force": eq.generalized_force,
        }
    else:
        # curvature: ∂(Jᵀ λ)/∂q; λ takes the place of v's first entries.
        outputs = {"H": ca.jacobian(ca.mtimes(c.jacobian.T, eq.v[:m]), eq.q)}
    inputs |= eq.extra_arguments
    dense = [ca.densify(x) for x in outputs.values()]
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs), {"cse": True})


class _Terms(NamedTuple):
    """Numbers at one state: f (m,), J (m, n), ḟ (m,), the weight W and the mass matrix (n, n)."""

    f: Array
    J: Array
    rate: Array
    W: Array
    M: Array

    @property
    def scale(self) -> Array:
        """What a row changes by when every coordinate changes by 1."""
        sizes = np.abs(self.J).sum(axis=1)
        return np.where(sizes > 0, sizes, 1.0)


class Manifold:
    """The consistent states of dynamics with constraints, in numbers."""

    def __init__(self, dyn: LagrangianDynamics) -> None:
        self.dyn = dyn

    def at(self, t: float) -> Manifold:
        """Return the states at a time."""
        return Manifold(at_time(self.dyn, t)) if self.dyn.model.time_parameter else self

    @property
    def equations(self) -> EnergyEquations:
        """The equations of the energies."""
        return cast("EnergyEquations", self.dyn.equations)

    def call(self, name: str, *arguments: Array) -> list[Array]:
        """Return the outputs of a compiled function, with its parameters behind."""
        code = self.dyn.code(name, make=lambda: _function(self.equations, name))
        if self.dyn.model.parameters:
            p, lead = self.dyn.parameter_values, arguments[0].shape[:-1]
            if p.ndim > 1 and not lead:
                # One of a batch is a batch of one.
                (p,) = p
            arguments = (*arguments, np.broadcast_to(p, (*lead, p.shape[-1])))
        return list(code(*arguments))

    def value(self, q: Array) -> Array:
        """Return f, (m,) or (N, m)."""
        return np.asarray(self.call("constraint_rows", q)[0][..., 0])

    def jacobian(self, q: Array) -> Array:
        """Return J, (m, n) or (N, m, n)."""
        return self.call("constraint_rows", q)[1]

    def multipliers(self, q: Array, v: Array, tau: Array) -> Array:
        """Return λ, (m,) or (N, m)."""
        return np.asarray(self.call("multipliers", q, v, tau)[0][..., 0])

    def _terms(self, q: Array, v: Array) -> _Terms:
        f, J, _, rate, W, M = self.call("constraint", q, v)
        return _Terms(f[:, 0], J, rate[:, 0], W, M)

    # Consistency

    def check(self, q: Array, v: Array) -> None:
        """Refuse an inconsistent state, of one or a batch, with the residuals (InputError)."""
        for k, (one_q, one_v) in enumerate(zip(np.atleast_2d(q), np.atleast_2d(v), strict=True)):
            terms = self.member(k)._terms(one_q, one_v)
            for name, what, residual, x in (("q0", "f", terms.f, one_q), ("v0", "J v + ∂f/∂t", terms.rate, one_v)):
                if not (np.abs(residual) <= _CONSISTENT * terms.scale * max(1.0, float(np.abs(x).max()))).all():
                    where = "" if q.ndim == 1 else f" of state {k}"
                    raise InputError(
                        f"{name}: the constraints of {self.dyn.model.name} ask for {what} = 0, which is "
                        f"{_residuals(residual)}{where}; lag.project(q0, v0) returns the nearest consistent state"
                    )

    def member(self, k: int) -> Manifold:
        """Return the states of one sample of a batch of parameters; the same where there is none."""
        if self.dyn.samples is None:
            return self
        one = self.dyn.of_samples([k])
        return Manifold(one.at(**dict(zip(one.model.parameters, one.parameter_values[0].tolist(), strict=True))))

    def pulled(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the consistent state beside one that has drifted a little, or of each of a batch.

        A state that is far from the constraints or not finite comes back as it is or as NaN.
        """
        for _ in range(4):
            q, v, f, scale = (x[..., 0] for x in self.call("constraint_step", q, v))
            if not bool((np.abs(f) / scale > _NEAR).any()):
                break
        return q, v

    def project(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return the nearest consistent state, in the metric of the mass matrix there; InputError if there is none."""
        x = self.restored(q, v)
        M, n = self._terms(q, v).M, len(q)
        # Stationary: M (x - q) + Jᵀ μ = 0 with f(x) = 0.
        last = np.inf
        for _ in range(_MOST):
            f, J, *_ = self._terms(x, v)
            K = np.block([[M, J.T], [J, np.zeros((len(J), len(J)))]])
            step = np.linalg.lstsq(K, np.concatenate([M @ (q - x), -f]), rcond=1e-14)[0][:n]
            size = float(np.linalg.norm(step))
            if size <= 1e-12 * (1 + float(np.linalg.norm(x))):
                break
            # Where the constraints bend strongly, whole steps go to and fro about the foot.
            x = self.restored(x + (step if size < last else 0.5 * step), v)
            last = min(last, size)
        terms = self._terms(x, v)
        return x, v + _least_change(terms.W, terms.J, -terms.rate)

    def restored(self, q: Array, v: Array) -> Array:
        """Return a configuration with f = 0, by steps that are the least in the mass matrix's metric."""
        x, terms = q, self._terms(q, v)
        best = float(np.linalg.norm(terms.f / terms.scale))
        for _ in range(_MOST):
            if best <= 4 * _EPS * (1 + float(np.abs(x).max())):
                break
            step, length = _least_change(terms.W, terms.J, -terms.f), 1.0
            while length > 1e-6:
                beyond = self._terms(x + length * step, v)
                size = float(np.linalg.norm(beyond.f / beyond.scale))
                if size < best:
                    break
                length *= 0.5
            else:
                break
            x, terms, best = x + length * step, beyond, size
        if not best <= 1e-10 * (1 + float(np.abs(x).max())):
            raise InputError(
                f"q: {self.dyn.model.name} has no consistent state near it; f = {_residuals(terms.f)} is the "
                "least reached"
            )
        return np.asarray(x)


def _residuals(x: Array) -> str:
    return f"[{', '.join(f'{e:.3g}' for e in x)}]"


def manifold_of(dyn: Dynamics) -> Manifold:
    """Return the consistent states of dynamics; those of another engine by the own derivation."""
    if isinstance(dyn, LagrangianDynamics):
        return Manifold(dyn)
    if dyn.model.has_bodies:
        raise UnsupportedError(f"{dyn.model.name}: has no constraints; mbkit.lagrangian.Lagrangian takes them")
    # Deriving costs more than most runs: once for each engine's object.
    if _TWIN not in vars(dyn):
        vars(dyn)[_TWIN] = LagrangianDynamics(dyn.model)
    return Manifold(vars(dyn)[_TWIN])


def _least_change(W: Array, J: Array, change: Array) -> Array:
    """Return the x with J x = change that is the least in xᵀ W x; the nearest to it where J has dependent rows."""
    try:
        L = np.linalg.cholesky(W)
    except np.linalg.LinAlgError:
        L = np.eye(len(W))
    A = np.linalg.solve(L, J.T).T
    y = np.linalg.lstsq(A, change, rcond=1e-12)[0]
    return np.asarray(np.linalg.solve(L.T, y))


# Independence

#: Random starts from which a consistent configuration is searched, and steps from each.
_STARTS: Final = 12
_STEPS: Final = 100
#: Configurations near a pose at which J is evaluated too, and how far they are away, rad or m.
_BESIDE: Final = 4
_ASIDE: Final = 0.05
#: Remainder of a row that follows from the others, relative to the row's size.
_DEPENDENT: Final = 1e-7
#: Of a row's size beside the pose: its slope where a square is nearly zero.
_FLAT: Final = 1e-4
#: A slope that is rounding alone.
_ROUNDED: Final = 1e-14
#: Residual of a consistent configuration, in terms of the rows' sizes.
_HOLDS: Final = 1e-10
#: Characters of a constraint in a message: of a loop in space it has thousands.
_SHOWN: Final = 100

#: Values of the parameters with which a system was independent at some pose.
_JUDGED: Final[WeakKeyDictionary[EnergyForm, set[tuple[float, ...]]]] = WeakKeyDictionary()


def is_judged(form: EnergyForm, model: Model) -> bool:
    """Return whether the constraints were independent at some pose, with the model's values of the parameters."""
    return _values(model) in _JUDGED.get(form, ())


def _values(model: Model) -> tuple[float, ...]:
    return tuple(float(x or 0.0) for n, x in model.parameters.items() if n != model.time_parameter)


def require_few(form: EnergyForm) -> None:
    """Refuse more constraints than coordinates."""
    rows, n = len(form.constraints), len(form.coordinates)
    if rows > n:
        raise InputError(f"constraints: {rows} of them for {n} coordinates; at most {n} can be independent")


def require_independent(dyn: Dynamics, q: Array, *, everywhere: bool = False) -> None:
    """Refuse constraints whose Jacobian has dependent rows around q (InputError) or at q alone (NumericalError).

    With `everywhere` a singular pose is allowed: only a set that is redundant around q is refused.
    """
    manifold = manifold_of(dyn)
    form = manifold.equations.form
    require_few(form)
    rng = np.random.default_rng(0)
    beside = [q + _ASIDE * rng.standard_normal(q.shape) for _ in range(_BESIDE)]
    sizes = np.max([np.linalg.norm(manifold.jacobian(x), axis=1) for x in (q, *beside)], axis=0)
    scale = np.where(sizes > _ROUNDED, sizes, 1.0)
    J = manifold.jacobian(q) / scale[:, None]
    dependent, others = _dependent(J)
    flat = bool((np.linalg.norm(J, axis=1) < _FLAT)[sizes > _ROUNDED].any())
    if not len(dependent) and not flat:
        _JUDGED.setdefault(form, set()).add(_values(dyn.model))
        return
    _explain(manifold, [q, *beside], scale, sizes)
    if everywhere or not len(dependent):
        return
    raise NumericalError(
        f"q: {dyn.model.name} is at a singular pose, where {_named(dependent, form)} "
        f"{_reason(others, form, 'has no slope')}: forces and accelerations are not determined there; take a pose "
        "beside it"
    )


def refuse_unreachable(dyn: Dynamics, q: Array | None = None) -> None:
    """Refuse constraints that no configuration satisfies, or that are redundant where one does (InputError).

    The search starts at q, then at random configurations.
    """
    manifold, model = manifold_of(dyn), dyn.model
    form, rng = manifold.equations.form, np.random.default_rng(0)
    starts = [rng.choice([1.0, 3.0]) * Model.random_state(model, rng)[0] for _ in range(_STARTS)]
    starts[:0] = [] if q is None else [q]
    least, left = np.inf, np.zeros(len(form.constraints))
    for start in starts:
        sizes = np.linalg.norm(manifold.jacobian(start), axis=1)
        end, f = _nearest(manifold, start, np.where(sizes > _ROUNDED, sizes, 1.0))
        size = float(np.linalg.norm(f))
        if size < _HOLDS:
            require_independent(dyn, end, everywhere=True)
            return
        if size < least:
            least, left = size, f
    against = np.flatnonzero(np.abs(left) > 1e-6 * np.abs(left).max())
    raise InputError(
        f"constraints: no configuration satisfies them all, from {len(starts)} starts; it seems that "
        f"{_named(against, form)} {'contradict each other' if len(against) > 1 else 'cannot hold'}: the least that is "
        f"left of them is {least:.3g}"
    )


def _explain(manifold: Manifold, starts: list[Array], scale: Array, sizes: Array) -> None:
    """Raise why J has dependent rows at and around the first start; return where it has full rank nearby."""
    form = manifold.equations.form
    consistent = [x for x, f in (_nearest(manifold, q, scale) for q in starts) if np.linalg.norm(f) < _HOLDS]
    if not consistent:
        refuse_unreachable(manifold.dyn, starts[0])
        return
    slopes = [manifold.jacobian(x) / scale[:, None] for x in consistent]
    flat = np.flatnonzero((np.max([np.linalg.norm(J, axis=1) for J in slopes], axis=0) < _FLAT) & (sizes > _ROUNDED))
    if len(flat):
        raise InputError(
            f"constraints: {_named(flat, form)} has no slope where it holds, here and at the poses around, so "
            "that no force can hold it; write a square as f = 0 instead of f**2 = 0, or start from another pose"
        )
    dependent, others = min((_dependent(J) for J in slopes), key=lambda pair: len(pair[0]))
    if len(dependent):
        raise InputError(
            f"constraints: the set is redundant, here and at poses around; {_named(dependent, form)} "
            f"{_reason(others, form, 'holds by itself')}; leave it out, as its multiplier is not determined, or start "
            "from another pose"
        )


def _nearest(manifold: Manifold, q: Array, scale: Array) -> tuple[Array, Array]:
    """Return where damped Gauss-Newton ends, and the scaled f there."""
    f = manifold.value(q) / scale
    for _ in range(_STEPS):
        step = _least_change(np.eye(len(q)), manifold.jacobian(q) / scale[:, None], -f)
        length = 1.0
        while length > 1e-9:
            beyond = manifold.value(q + length * step) / scale
            if np.linalg.norm(beyond) < (1 - 1e-4 * length) * np.linalg.norm(f):
                break
            length *= 0.5
        else:
            break
        q, f = q + length * step, beyond
        if np.linalg.norm(f) < 1e-13:
            break
    return q, f


def _dependent(J: Array) -> tuple[Array, Array]:
    """Return the rows that the others imply, and those others that are needed for it."""
    from scipy.linalg import qr

    _, R, order = qr(J.T, mode="economic", pivoting=True)
    rank = int(np.count_nonzero(np.abs(np.diag(R)) > _DEPENDENT))
    kept, dependent = order[:rank], np.sort(order[rank:])
    if not len(dependent) or not rank:
        return dependent, np.empty(0, dtype=int)
    # As a combination of those that were kept.
    weights = np.linalg.lstsq(J[kept].T, J[dependent].T, rcond=None)[0]
    return dependent, np.sort(kept[np.abs(weights).max(axis=1) > 1e-6])


def _named(which: Iterable[int], form: EnergyForm) -> str:
    texts = {k: str(form.constraints[k]) for k in which}
    return ", ".join(
        f"constraints[{k}] ({text if len(text) <= _SHOWN else f'{text[:_SHOWN]} ...'})" for k, text in texts.items()
    )


def _reason(others: Array, form: EnergyForm, alone: str) -> str:
    return f"follows from {_named(others, form)}" if len(others) else alone
