"""The reference that others are measured by: the own derivation at 113 bits, about 34 digits.

The formulas are the lagrangian engine's, so this measures rounding; that they are
right is shown apart, by a Newton–Euler recursion in `validation/`, to 30 digits.

What it takes for given: every number of the description and of the state is the
double that it is, exactly; and a quaternion stands for the rotation that it
describes, so it is divided by its norm, which a double quaternion misses by
about an eps. An engine that uses it as it is shows that eps as error. Rotation
matrices and axes of the description, orthonormal to rounding only, enter the
formulas as they stand.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, ClassVar, Final

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, batch_of
from mbkit.codegen.extended_precision import Backend, Extended, arithmetic, digits, product, solve
from mbkit.codegen.program import program
from mbkit.derivation.equations import equations_of
from mbkit.engines.base import Dynamics, ForwardDynamicsDerivatives, InverseDynamicsDerivatives
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Model

#: Quantity -> its arguments, as in `Dynamics`.
_ARGUMENTS: Final = {
    "mass_matrix": ("q",),
    "coriolis_matrix": ("q", "v"),
    "coriolis_force": ("q", "v"),
    "gravity": ("q",),
    "nle": ("q", "v"),
    "passive": ("q", "v"),
    "inverse_dynamics": ("q", "v", "a"),
    "forward_dynamics": ("q", "v", "tau"),
    "kinetic_energy": ("q", "v"),
    "potential_energy": ("q",),
    "energy_rate": ("q", "v", "a"),
    "inverse_dynamics_derivatives": ("q", "v", "a"),
    "forward_dynamics_derivatives": ("q", "v", "tau"),
    "pose": ("q",),
    "jacobian": ("q",),
}


_Key = tuple[tuple[int, ...], bytes]


def _key(x: Array) -> _Key:
    # Of arrays without entries the shape tells how many states there are.
    return x.shape, x.tobytes()


class OracleDynamics(Dynamics):
    """Terms with 34 digits. The methods of `Dynamics` round them once, to double.

    Parameters
    ----------
    model : Model
    constants : (k,) array or pair of them, optional
        Other values for the model's numbers, in the order of
        ``equations.constants``; as a pair (high, low) with 32 digits.
    backend : {"real128", "mpmath"}, optional
        What computes; by default heyoka's numbers where they are at hand.

    Attributes
    ----------
    equations : mbkit.derivation.Equations
        The expressions, with the model's numbers as symbols.
    """

    engine = "oracle"
    bits = 113
    takes_written = True
    lacks_derivatives = ""
    refuses: ClassVar = {"function": "a casadi.Function computes in double; the lagrangian engine gives it"}

    def __init__(
        self,
        model: Model,
        constants: ArrayLike | tuple[ArrayLike, ArrayLike] | None = None,
        backend: Backend | None = None,
    ) -> None:
        super().__init__(model)
        self._arithmetic = arithmetic(backend)
        self._given = constants
        self.equations = equations_of(model, constants="symbols")
        own = self._arithmetic
        if constants is None:
            values = own.array(self.equations.constant_values)
        elif isinstance(constants, tuple):
            values = own.from_pair(*(np.asarray(x, dtype=np.float64) for x in constants))
        else:
            values = own.array(np.asarray(constants, dtype=np.float64))
        if values.shape != (len(self.equations.constant_values),):
            raise InputError(
                f"constants: expected shape ({len(self.equations.constant_values)},), got {values.shape}; "
                "equations.constants has their order"
            )
        #: One row, the same for all states; nothing where no number is a symbol.
        self._constants = [values[None]] if values.size else []
        self._programs: dict[tuple[str, ...], Extended] = {}
        self._held: tuple[_Key, _Key, list[Any]] | None = None

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return type(self), (self.model, self._given, self._arithmetic.name)

    @property
    def constant_values(self) -> tuple[Array, Array]:
        """What stands for `equations.constants`, as (high, low) whose sum has 32 digits, each (k,)."""
        return self._arithmetic.pair(self._constants[0][0]) if self._constants else (np.empty(0), np.empty(0))

    def extended(self, quantity: str, *arguments: Any) -> tuple[Array, Array]:
        """Return a quantity as (high, low): its value rounded to double, and the rest.

        The sum has 32 digits, for measuring errors: (x - high) - low.

        Parameters
        ----------
        quantity : str
            Name of a method of `Dynamics`, or ``"energy_rate"``.
        *arguments
            As the method takes them, by position: ``extended("pose", q, "hand")``.
            Derivatives come stacked, shape (3, nv, nv) or (N, 3, nv, nv).

        Returns
        -------
        (high, low) : two arrays
            Of the shape that the method returns; a single number as an array of shape ().

        Raises
        ------
        UnknownNameError, InputError, NumericalError
            As the methods do.
        """
        value = self._exact(quantity, arguments)
        return self._arithmetic.pair(value)

    def digits(self, quantity: str, *arguments: Any) -> Any:
        """Return a quantity as an array of mpmath's numbers of 113 bits, for looking at it.

        Arguments are those of `extended`.
        """
        return digits(self._exact(quantity, arguments), self._arithmetic)

    def energy_rate(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Any:
        """Return dE/dt of kinetic and potential energy along (D v, a), exactly differentiated."""
        return self._scalar(self._evaluate("energy_rate", self._energy_rate, q=q, v=v, a=a))

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> InverseDynamicsDerivatives:
        """Return the partial derivatives of inverse dynamics, as the lagrangian engine defines them."""
        out = self._evaluate("inverse_dynamics_derivatives", self._inverse_dynamics_derivatives, q=q, v=v, a=a)
        return InverseDynamicsDerivatives(*np.moveaxis(out, -3, 0))

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> ForwardDynamicsDerivatives:
        """Return the partial derivatives of forward dynamics, as the lagrangian engine defines them."""
        out = self._evaluate("forward_dynamics_derivatives", self._forward_dynamics_derivatives, q=q, v=v, tau=tau)
        return ForwardDynamicsDerivatives(*np.moveaxis(out, -3, 0))

    def at(self, /, **values: float) -> OracleDynamics:
        """Return the same dynamics at other values of the model's named parameters."""
        if self._given is not None:
            raise InputError("at: this oracle was given its constants; give the parameters' values among them")
        return type(self)(self.model.with_nominal(values), backend=self._arithmetic.name)

    # Every method below takes batches, and returns 113-bit numbers.

    def _evaluate(self, quantity: str, method: Callable[..., Array], **arguments: ArrayLike) -> Array:
        def rounded(*checked: Array) -> Array:
            high, _ = self._arithmetic.pair(method(*(np.atleast_2d(x) for x in checked)))
            return np.asarray(high[0] if checked[0].ndim == 1 else high)

        return super()._evaluate(quantity, rounded, **arguments)

    def _exact(self, quantity: str, arguments: tuple[Any, ...]) -> Any:
        self._require(quantity)
        if quantity not in _ARGUMENTS:
            raise UnknownNameError("quantity", str(quantity), _ARGUMENTS)
        names = _ARGUMENTS[quantity]
        if len(arguments) < len(names):
            raise InputError(f"{quantity}: expected {', '.join(names)}, got {len(arguments)} arguments")
        states, more = arguments[: len(names)], arguments[len(names) :]
        if quantity in ("pose", "jacobian"):
            getattr(self, quantity)(*arguments)  # for its checks
        elif more:
            raise InputError(f"{quantity}: expected {', '.join(names)}, got {len(arguments)} arguments")
        model = self.model
        checked = {n: model.check_q(x) if n == "q" else model.check_v(x, n) for n, x in zip(names, states, strict=True)}
        size = batch_of(**checked)
        rows = [np.broadcast_to(x, (1 if size is None else size, x.shape[-1])) for x in checked.values()]
        value = getattr(self, f"_{quantity}")(*rows, *more)
        value = value[0] if size is None else value
        high, _ = self._arithmetic.pair(value)
        self._require_finite(quantity, high, checked)
        return value

    def _state(self, q: Array) -> Any:
        own = self._arithmetic
        out = own.array(q).copy()
        for start, _ in self.model.quaternions:
            part = out[:, start : start + 4]
            length = own.sqrt(sum((part[:, i] * part[:, i] for i in range(1, 4)), part[:, 0] * part[:, 0]))
            out[:, start : start + 4] = own.divide(part, length[:, None])
        return out

    def _run(self, name: tuple[str, ...], *arguments: Any) -> list[Any]:
        if name not in self._programs:
            self._programs[name] = Extended(program(self._function_of(*name)), self._arithmetic)
        return self._programs[name](*arguments, *self._constants)

    def _function_of(self, name: str, *extra: str) -> ca.Function:
        eq = self.equations
        if name != "terms":
            return getattr(eq, name)(*extra) if name in ("pose", "jacobian") else eq.function(name)
        outs = [ca.densify(x) for x in (eq.mass_matrix, eq.coriolis_force, eq.gravity, eq.passive, eq.nle)]
        return ca.Function("terms", [eq.q, eq.v, *eq.trailing.values()], outs)

    def _terms(self, q: Array, v: Array | None = None) -> list[Any]:
        """Return M, C v, g, the passive forces and nle; the last answer is kept, M and g for any v."""
        held = self._held
        if held and held[0] == _key(q) and (v is None or held[1] == _key(v)):
            return held[2]
        v = np.zeros((len(q), self.model.nv)) if v is None else v
        M, *vectors = self._run(("terms",), self._state(q), v)
        out = [M, *(x[:, :, 0] for x in vectors)]
        self._held = (_key(q), _key(v), out)
        return out

    def _mass_matrix(self, q: Array) -> Any:
        return self._terms(q)[0]

    def _gravity(self, q: Array) -> Any:
        return self._terms(q)[2]

    def _coriolis_force(self, q: Array, v: Array) -> Any:
        return self._terms(q, v)[1]

    def _passive(self, q: Array, v: Array) -> Any:
        return self._terms(q, v)[3]

    def _nle(self, q: Array, v: Array) -> Any:
        return self._terms(q, v)[4]

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Any:
        M, _, _, passive, nle = self._terms(q, v)
        return product(M, self._arithmetic.array(a)) + nle - passive

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Any:
        if self.model.constrained:
            self.model.require_independent(q, once=True)
            return self._run(("forward_dynamics",), self._state(q), v, tau)[0][:, :, 0]
        M, _, _, passive, nle = self._terms(q, v)
        force = self._arithmetic.array(tau) + passive - nle
        return solve(M, force, self._pattern, self.equations.elimination_order, self._arithmetic)

    @cached_property
    def _pattern(self) -> Array:
        return np.asarray(ca.DM(self.equations.mass_matrix.sparsity(), 1).full())

    def _coriolis_matrix(self, q: Array, v: Array) -> Any:
        return self._run(("coriolis_matrix",), self._state(q), v)[0]

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Any:
        return np.stack(self._run(("inverse_dynamics_derivatives",), self._state(q), v, a), axis=1)

    def _forward_dynamics_derivatives(self, q: Array, v: Array, tau: Array) -> Any:
        return np.stack(self._run(("forward_dynamics_derivatives",), self._state(q), v, tau), axis=1)

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        return self._run(("kinetic_energy",), self._state(q), v)[0][:, 0, 0]

    def _potential_energy(self, q: Array) -> Any:
        return self._run(("potential_energy",), self._state(q))[0][:, 0, 0]

    def _energy_rate(self, q: Array, v: Array, a: Array) -> Any:
        return self._run(("energy_rate",), self._state(q), v, a)[0][:, 0, 0]

    def _pose(self, q: Array, frame: str) -> Any:
        return self._run(("pose", frame), self._state(q))[0]

    def _jacobian(self, q: Array, frame: str, axes: str = "world") -> Any:
        return self._run(("jacobian", frame, axes), self._state(q))[0]
