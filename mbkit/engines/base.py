"""The protocol of the engines: `Dynamics`, one description evaluated by one engine.

The equation of motion stands in the package's docstring. An adapter fills in the
``_``-methods for one state or a batch; checks of arguments and results, and the
quantities that follow from others, are here.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from types import MethodType
from typing import Any, ClassVar, Final, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, all_finite, batch_of
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.model import Joint, Model

QUANTITIES: Final = (
    "mass_matrix",
    "coriolis_matrix",
    "coriolis_force",
    "gravity",
    "nle",
    "passive",
    "inverse_dynamics",
    "forward_dynamics",
    "kinetic_energy",
    "potential_energy",
    "pose",
    "jacobian",
    "function",
)

#: Bits of a double's significand.
DOUBLE_BITS: Final = 53

#: Loops or prescribed joints that a refusal names.
_NAMED: Final = 3

_Method = TypeVar("_Method", bound=Callable[..., Any])
_Dynamics = TypeVar("_Dynamics", bound="Dynamics")


def require_tree(model: Model, user: str) -> None:
    """Raise `UnsupportedError` for a model with loops or prescribed motions, in the name of an engine or study."""
    for feature, text in (("loops", "loop closures"), ("prescribed", "motions prescribed in time")):
        parts = getattr(model, feature)
        if parts:
            names = ", ".join(repr(x.name) for x in parts[:_NAMED]) + (", ..." if parts[_NAMED:] else "")
            raise UnsupportedError(
                f"{user}: {model.name} has {text} ({names}), and an engine takes the tree alone; "
                "mbkit.lagrangian.from_model(model).dynamics() solves it with them, "
                f"and model.without({feature!r}) is the tree without them"
            )


class InverseDynamicsDerivatives(NamedTuple):
    """Derivatives of τ = M a + nle - τ_passive, each (nv, nv) or (N, nv, nv)."""

    #: ∂τ/∂q along the manifold: column k is that of q ⊕ t e_k.
    q: Array
    v: Array
    #: ∂τ/∂a, the mass matrix.
    a: Array


class ForwardDynamicsDerivatives(NamedTuple):
    """Derivatives of v̇ = M⁻¹ (τ + τ_passive - nle), each (nv, nv) or (N, nv, nv)."""

    #: ∂v̇/∂q along the manifold: column k is that of q ⊕ t e_k.
    q: Array
    v: Array
    #: ∂v̇/∂τ, the inverse of the mass matrix.
    tau: Array


class Dynamics(ABC):
    """A model evaluated by one engine; `mbkit.dynamics` returns one.

    Every method takes one state or a batch with one leading axis, checks shapes,
    finite numbers and unit quaternions, and returns new arrays.

    Raises
    ------
    InputError
        An argument of the wrong shape, not finite, or with a quaternion that is
        not of unit length.
    NumericalError
        The engine's answer is not finite.
    UnsupportedError
        The engine cannot give this quantity, with the reason.
    """

    engine: ClassVar[str]
    #: Quantities this engine cannot give, each with the reason.
    refuses: ClassVar[dict[str, str]] = {}
    #: Whether parameters may still be without values when the adapter is built.
    takes_parameters: ClassVar[bool] = False
    #: Whether a model may be energies without bodies.
    takes_written: ClassVar[bool] = False
    #: Whether it has `mbkit.derivation.Equations` and compiles whole steps of them.
    derived: ClassVar[bool] = False
    #: Of the significand with which it computes.
    bits: ClassVar[int] = DOUBLE_BITS

    def __init__(self, model: Model) -> None:
        if not model.has_bodies and not self.takes_written:
            raise UnsupportedError(
                f"{self.engine}: {model.name} was written as energies and has no bodies; "
                "the lagrangian engine and the oracle take it"
            )
        if not self.takes_parameters:
            model.require_values(self.engine)
        require_tree(model, self.engine)
        self.model = model

    @property
    def supports(self) -> frozenset[str]:
        """Names of the quantities that this engine can give."""
        return frozenset(QUANTITIES) - frozenset(self.refuses)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.model.name!r}: nq={self.model.nq}, nv={self.model.nv}>"

    def __reduce__(self) -> tuple[type, tuple[Model]]:
        return type(self), (self.model,)

    def at(self, /, **values: Any) -> Dynamics:
        """Return the same dynamics at other values of the model's named parameters.

        The lagrangian engine passes the values as arguments to its compiled functions; the others are built again.

        Parameters
        ----------
        **values : float
            By name; parameters that are not named keep their values. A number is
            checked as `ModelBuilder.build` would, which takes a millisecond or so. The
            lagrangian engine also takes (N,) arrays, one value per sample of a batch,
            checked for finite numbers only.

        Raises
        ------
        UnknownNameError
            A name that is no parameter of the model.
        InputError
            A value that is not a finite number.
        ModelError
            No system of matter has these values, such as a negative mass.

        Examples
        --------
        >>> import mbkit as mb
        >>> model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0))
        >>> dyn = mb.dynamics(model, "lagrangian")
        >>> float(dyn.mass_matrix([0.0])[0, 0]), float(dyn.at(m=3.0).mass_matrix([0.0])[0, 0])
        (2.0, 3.0)
        """
        return type(self)(self.model.with_nominal(values))

    @property
    def samples(self) -> int | None:
        """Size of the batch that the parameters' values make, None where every sample has the same."""
        return None

    def of_samples(self, which: ArrayLike) -> Dynamics:  # noqa: ARG002  # for the engine whose samples differ
        """Return the dynamics of these samples of a batch, by index: itself, unless parameters differ between them."""
        return self

    # Terms of the equation of motion

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return M(q), shape (nv, nv) or (N, nv, nv)."""
        return self._evaluate("mass_matrix", self._mass_matrix, q=q)

    def coriolis_matrix(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) with Ṁ - 2C skew, shape (nv, nv) or (N, nv, nv).

        Coriolis matrices are not unique; mbkit's own is Christoffel's. Compare C v
        between engines, not the entries. A value that an engine is known to get
        wrong comes with a `KnownDefectWarning`.
        """
        return self._evaluate("coriolis_matrix", self._coriolis_matrix, q=q, v=v)

    def coriolis_force(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) v, shape (nv,) or (N, nv).

        Formed with the engine's own Coriolis matrix where it has one, so that a
        wrong matrix shows.
        """
        return self._evaluate("coriolis_force", self._coriolis_force, q=q, v=v)

    def gravity(self, q: ArrayLike) -> Array:
        """Return g(q), on the left of the equation, without springs; (nv,) or (N, nv)."""
        return self._evaluate("gravity", self._gravity, q=q)

    def nle(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) v + g(q), shape (nv,) or (N, nv)."""
        return self._evaluate("nle", self._nle, q=q, v=v)

    def passive(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the generalized force of springs and dampers, shape (nv,) or (N, nv)."""
        return self._evaluate("passive", self._passive, q=q, v=v)

    def inverse_dynamics(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """Return τ = M a + nle - τ_passive, shape (nv,) or (N, nv)."""
        return self._evaluate("inverse_dynamics", self._inverse_dynamics, q=q, v=v, a=a)

    def forward_dynamics(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Return v̇ = M⁻¹ (τ + τ_passive - nle), shape (nv,) or (N, nv)."""
        return self._evaluate("forward_dynamics", self._forward_dynamics, q=q, v=v, tau=tau)

    def kinetic_energy(self, q: ArrayLike, v: ArrayLike) -> Any:
        """Return ½ vᵀ M v in J, a float or shape (N,)."""
        return self._scalar(self._evaluate("kinetic_energy", self._kinetic_energy, q=q, v=v))

    def potential_energy(self, q: ArrayLike) -> Any:
        """Return the energy of gravity and springs in J, a float or shape (N,).

        Gravity's part is zero where every centre of mass is at the world's origin.
        """
        return self._scalar(self._evaluate("potential_energy", self._potential_energy, q=q))

    def pose(self, q: ArrayLike, frame: str) -> Array:
        """Return X_WF of a frame or body, shape (4, 4) or (N, 4, 4)."""
        self.model.frame(frame)
        return self._evaluate("pose", lambda q: self._pose(q, frame), q=q)

    def jacobian(self, q: ArrayLike, frame: str, axes: str = "world") -> Array:
        """Return the Jacobian of a frame's velocity, shape (6, nv) or (N, 6, nv).

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        frame : str
            Name of a frame or body.
        axes : {"world", "body"}
            Axes in which the velocity is written. It is that of the frame's
            origin either way, linear then angular.
        """
        self.model.frame(frame)
        if axes not in ("world", "body"):
            raise InputError(f"axes: expected 'world' or 'body', got {axes!r}")
        return self._evaluate("jacobian", lambda q: self._jacobian(q, frame, axes), q=q)

    def function(self, name: str) -> Any:
        """Return a quantity as a `casadi.Function`; the lagrangian engine only.

        Inputs are named as in `mbkit.derivation.FUNCTIONS` (q, v, a, tau), all of them
        column vectors; of a model with parameters the last one is "parameters", in
        the order of ``model.parameters``. The output has the quantity's name and is
        dense: (nv, nv), (nv, 1) or (1, 1); derivatives are by_q, by_v and by_a or
        by_tau. It may be called with MX or SX and differentiated.
        `mbkit.lagrangian.export_c` writes it as C.
        """
        self._require("function")
        return self._function(name)

    # Derivatives

    @property
    def lacks_derivatives(self) -> str:
        """Why there are no derivatives of this model; empty where there are."""
        return "it has none; mbkit.dynamics(model, 'lagrangian') has"

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> InverseDynamicsDerivatives:
        """Return the partial derivatives of inverse dynamics: fields q, v and a, each (nv, nv) or (N, nv, nv).

        That by q is along the manifold: column k is d/dt of ``model.integrate(q, t e_k)``,
        with v and a held fixed. That by a is M.
        """
        self._require_derivatives("inverse_dynamics_derivatives")
        out = self._evaluate("inverse_dynamics_derivatives", self._inverse_dynamics_derivatives, q=q, v=v, a=a)
        return InverseDynamicsDerivatives(*np.split(out, 3, axis=-1))

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> ForwardDynamicsDerivatives:
        """Return the partial derivatives of forward dynamics: fields q, v and tau, each (nv, nv) or (N, nv, nv).

        That by q is along the manifold: column k is d/dt of ``model.integrate(q, t e_k)``,
        with v and tau held fixed. That by tau is M⁻¹.
        """
        self._require_derivatives("forward_dynamics_derivatives")
        out = self._evaluate("forward_dynamics_derivatives", self._forward_dynamics_derivatives, q=q, v=v, tau=tau)
        return ForwardDynamicsDerivatives(*np.split(out, 3, axis=-1))

    def _require_derivatives(self, quantity: str) -> None:
        if self.lacks_derivatives:
            raise UnsupportedError(f"{self.engine} cannot give {quantity}: {self.lacks_derivatives}")

    def mass_matrix_rounding(self, q: ArrayLike) -> Array | None:  # noqa: ARG002  # for the engines that override it
        """Return how far the engine's own formula amplifies rounding in M, per sample.

        Σ |terms| / M_jj of the sum that makes the worst diagonal entry, (N,) or a
        scalar; None where the formula is not known to amplify.
        """
        return None

    # For an adapter to define. Arguments are float64, checked, and either all single states or all batches of one size.

    @abstractmethod
    def _mass_matrix(self, q: Array) -> Array: ...

    @abstractmethod
    def _gravity(self, q: Array) -> Array: ...

    @abstractmethod
    def _nle(self, q: Array, v: Array) -> Array: ...

    @abstractmethod
    def _passive(self, q: Array, v: Array) -> Array: ...

    @abstractmethod
    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Array: ...

    @abstractmethod
    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Array: ...

    @abstractmethod
    def _kinetic_energy(self, q: Array, v: Array) -> Array: ...

    @abstractmethod
    def _potential_energy(self, q: Array) -> Array: ...

    @abstractmethod
    def _pose(self, q: Array, frame: str) -> Array: ...

    @abstractmethod
    def _jacobian(self, q: Array, frame: str, axes: str) -> Array: ...

    def _coriolis_matrix(self, q: Array, v: Array) -> Array:
        raise NotImplementedError

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return np.asarray((self._coriolis_matrix(q, v) @ v[..., None])[..., 0])

    def _function(self, name: str) -> Any:
        raise NotImplementedError

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Array:
        """Return the three matrices side by side, (nv, 3 nv) or (N, nv, 3 nv)."""
        raise NotImplementedError

    def _forward_dynamics_derivatives(self, q: Array, v: Array, tau: Array) -> Array:
        return through_inverse(self._inverse_dynamics_derivatives(q, v, self._forward_dynamics(q, v, tau)))

    # Shared by all

    def _require(self, quantity: str) -> None:
        if quantity in self.refuses:
            raise UnsupportedError(f"{self.engine} cannot give {quantity}: {self.refuses[quantity]}")

    def _evaluate(self, quantity: str, method: Callable[..., Array], **arguments: ArrayLike) -> Array:
        if self.refuses:
            self._require(quantity)
        checked = {k: (self.model.check_q(x) if k == "q" else self.model.check_v(x, k)) for k, x in arguments.items()}
        size = batch_of(**checked)
        if size is not None:
            checked = {k: np.broadcast_to(x, (size, x.shape[-1])) for k, x in checked.items()}
        try:
            out = np.asarray(method(*checked.values()), dtype=np.float64)
        except np.linalg.LinAlgError:
            raise NumericalError(
                f"{self.engine}: {quantity} of {self.model.name}: the mass matrix is singular{self._blame()}"
            ) from None
        self._require_finite(quantity, out, checked)
        return out

    def _require_finite(self, quantity: str, out: Array, arguments: dict[str, Array]) -> None:
        if all_finite(out):
            return
        where = np.argwhere(~np.isfinite(out))[0]
        state = f" in sample {where[0]}" if next(iter(arguments.values())).ndim == 2 else ""
        index = tuple(int(i) for i in where)
        if not self.model.has_bodies:
            q = np.atleast_2d(arguments["q"])[where[0] if arguments["q"].ndim == 2 else 0]
            there = ", ".join(f"{n} = {x:.6g}" for n, x in zip(self.model.coordinate_names, q, strict=True))
            # Rows that depend on each other are named.
            self.model.require_independent(q)
            constraints = ", or the constraints depend on each other," if self.model.constrained else ""
            raise NumericalError(
                f"{self.engine}: {quantity} of {self.model.name} is not finite at {there}{state}; perhaps the mass "
                f"matrix is singular{constraints} there, or numbers are so large that they overflow"
            )
        raise NumericalError(
            f"{self.engine}: {quantity} of {self.model.name} is not finite at index {index}{state}{self._blame()}"
        )

    def _blame(self) -> str:
        suspects = [f"{name!r} ({why})" for name, why in self.model.nonphysical]
        # A joint that moves no mass is the likeliest cause; say it first.
        suspects.sort(key=lambda text: "no mass moves" not in text)
        more = f" and {len(suspects) - 3} more" if len(suspects) > 3 else ""
        if suspects:
            return f"; suspect: {', '.join(suspects[:3])}{more}"
        springs = [repr(s.name) for s in self.model.springs if s.needs_direction]
        if springs:
            return (
                f"; possible cause: a point spring with a damper or a rest length has no direction where "
                f"its length is zero: {', '.join(springs[:3])}"
            )
        return "; perhaps links without mass, or numbers so large that they overflow"

    @staticmethod
    def _scalar(value: Array) -> Any:
        return float(value) if value.ndim == 0 else value


_X, _Y, _Z = np.eye(3)
#: Joint type -> type and axis of each joint of a stack of one-coordinate joints with the same motion.
STACKS: Final[dict[str, Callable[[Joint], list[tuple[str, Array]]]]] = {
    "revolute": lambda joint: [("revolute", joint.axes[0])],
    "continuous": lambda joint: [("revolute", joint.axes[0])],
    "prismatic": lambda joint: [("prismatic", joint.axes[0])],
    "universal": lambda joint: [("revolute", axis) for axis in joint.axes],
    "spherical_zyx": lambda _: [("revolute", axis) for axis in (_Z, _Y, _X)],
    "planar": lambda _: [("prismatic", _X), ("prismatic", _Y), ("revolute", _Z)],
}


def unknown_joint(engine: str, joint: Joint) -> UnsupportedError:
    """Return the error for a joint of a type that an adapter has no counterpart of."""
    return UnsupportedError(
        f"{engine}: joint {joint.name!r} is {joint.kind}, a type that this engine does not have; "
        "the lagrangian engine takes every joint type"
    )


def per_sample(method: Callable[..., Array], *arguments: Array) -> Array:
    """Call a single-state method on one state, or on each of a batch."""
    if arguments[0].ndim == 1:
        return np.array(method(*arguments))
    if not len(arguments[0]):
        return np.empty((0, *np.shape(method(*(np.zeros(a.shape[1]) for a in arguments)))))
    return np.array([np.array(method(*row)) for row in zip(*arguments, strict=True)])


def by_sample(method: _Method) -> _Method:
    """Return a method for one state or a batch, made of one for a single state."""

    def evaluate(self: Dynamics, *arguments: Array) -> Array:
        if arguments[0].ndim == 1:
            return np.array(method(self, *arguments))
        return per_sample(MethodType(method, self), *arguments)

    return evaluate  # type: ignore[return-value]  # the same arguments


def through_inverse(inverse_derivatives: Array) -> Array:
    """Return ∂FD/∂q, ∂FD/∂v and ∂FD/∂τ side by side, from ∂ID/∂q, ∂ID/∂v and M side by side at a = FD(q, v, τ)."""
    by_q, by_v, M = np.split(inverse_derivatives, 3, axis=-1)
    unit = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
    return np.asarray(np.linalg.solve(M, np.concatenate([-by_q, -by_v, unit], axis=-1)))


def no_dynamics(value: Any, name: str = "dyn") -> InputError:
    """Return the error for an argument that is no `Dynamics`, with the call that makes one."""
    own = not isinstance(value, type) and callable(getattr(value, "dynamics", None))
    way = "its .dynamics() makes one" if own else "mbkit.dynamics(model, engine) makes one"
    return InputError(f"{name}: expected a Dynamics, got {type(value).__name__}; {way}")


# Dynamics that depend on the time: the time is one of their model's parameters.


def at_time(dyn: _Dynamics, t: float) -> _Dynamics:
    """Return the dynamics at a time; the same ones where time does not enter."""
    clock = dyn.model.time_parameter
    return dyn if clock is None else dyn.at(**{clock: t})  # type: ignore[return-value]  # of its own kind


def at_times(dyn: _Dynamics, t: Array, trajectories: int | None = None) -> _Dynamics:
    """Return the dynamics with a sample for each time of a run, of each trajectory of a batch, where time enters."""
    clock = dyn.model.time_parameter
    if clock is None:
        return dyn
    if not dyn.takes_parameters:
        raise UnsupportedError(f"{dyn.engine}: holds one time; evaluate along a run with the lagrangian engine")
    own = dyn
    if trajectories is not None and dyn.samples is not None:
        own = dyn.of_samples(np.repeat(np.arange(trajectories), len(t)))  # type: ignore[assignment]
    return own.at(**{clock: np.tile(t, trajectories or 1)})  # type: ignore[return-value]
