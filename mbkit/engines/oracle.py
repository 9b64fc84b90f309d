"""The reference that others are measured by: the own derivation at 113 bits, about 34 digits.

The formulas are derivatives of the energies, those of the lagrangian engine's elimination "mass matrix"; that they are
right is shown apart, by a Newton–Euler recursion in `validation/`, to 30 digits.

The oracle takes every number of the description and of the state as exactly the double that is stored. A quaternion
stands for its rotation: it is divided by its norm, which misses one by about an eps. An engine that uses it as it is
shows that eps as error. Rotation matrices and axes, orthonormal to rounding only, enter the formulas as they stand.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from copy import copy
from functools import cached_property
from inspect import signature
from typing import Any, ClassVar, Final

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array
from mbkit.codegen.backend import LastUsed
from mbkit.codegen.extended_precision import Backend, Extended, arithmetic, digits, product, solve
from mbkit.codegen.program import program
from mbkit.derivation import equations_of
from mbkit.derivation.body_motion import BODY_QUANTITIES
from mbkit.engines.derived import WRITTEN, Derived, function_of, names_of
from mbkit.errors import InputError, UnknownNameError
from mbkit.model import Frame, Model
from mbkit.model.quantities import QUANTITIES

#: Quantity -> its arguments, as in `Dynamics`.
_ARGUMENTS: Final = {
    name: tuple(x for x in QUANTITIES[name].arguments if x != "wrenches") for name in (*WRITTEN, *BODY_QUANTITIES)
}
#: Terms that one function gives together, in this order.
_TERMS: Final = ("mass_matrix", "coriolis_force", "gravity", "passive", "nle")


#: Programs by description and quantity. An operation takes some 400 bytes.
_DERIVED: Final[LastUsed[Extended]] = LastUsed(200_000, lambda x: len(x.program.operations))

_Key = tuple[tuple[int, ...], bytes]


def _key(x: Array) -> _Key:
    # The shape tells how many states there are, also where arrays have no entries.
    return x.shape, x.tobytes()


def _term(name: str) -> Callable[..., Any]:
    return lambda self, *states: self._terms(*states)[name]


def _of_shape(name: str) -> Callable[..., Any]:
    """Return the method of a quantity that one program gives."""
    of_bodies, shape = name in BODY_QUANTITIES, QUANTITIES[name].shape

    def evaluate(self: OracleDynamics, *given: Any) -> Any:
        n = sum(isinstance(x, np.ndarray) for x in given[: len(QUANTITIES[name].arguments)])
        out = self._run((name, *map(names_of, given[n:])), *given[:n])
        if len(shape) < 3:
            return out[0] if len(shape) == 2 else out[0][:, :, 0] if shape else out[0][:, 0, 0]
        if not of_bodies:
            return np.stack(out, axis=1)
        n, rows, columns = out[0].shape
        return out[0].reshape(n, rows // int(shape[1]), int(shape[1]), columns)

    return evaluate


class OracleDynamics(Derived):
    """Terms with 34 digits. The methods of `Dynamics` round them once, to double.

    Parameters
    ----------
    model : Model
    constants : (k,) array or pair of them, optional
        Other values for the model's numbers, in the order of ``equations.constants``; as a pair (high, low) with 32
        digits.
    backend : {"real128", "mpmath"}, optional
        What computes; by default heyoka's numbers where they are at hand.

    Attributes
    ----------
    equations : mbkit.derivation.Equations
        The expressions, with the model's numbers as symbols.
    """

    engine = "oracle"
    _significand_bits = 113
    _refuses: ClassVar = {"function": "a casadi.Function computes in double; the lagrangian engine gives it"}

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
        own, nominal = self._arithmetic, self.equations.constant_values
        if isinstance(constants, tuple):
            values = own.from_pair(*(np.asarray(x, dtype=np.float64) for x in constants))
        else:
            values = own.array(np.asarray(nominal if constants is None else constants, dtype=np.float64))
        if values.shape != nominal.shape:
            raise InputError(
                f"constants: expected shape {nominal.shape}, got {values.shape}; equations.constants has their order"
            )
        #: One row, the same for all states; nothing where no number is a symbol.
        self._constants = [values[None]] if values.size else []
        self._programs: dict[tuple[Any, ...], Extended] = {}
        #: The last value of each thread, in all its digits.
        self._values = threading.local()
        self._held: tuple[_Key, _Key, dict[str, Any]] | None = None
        self._digest = model.digest
        #: Dynamics of models that differ in the values of parameters alone, by their form.
        self._others: dict[str, OracleDynamics] = {}

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
        """
        return self._arithmetic.pair(self._exact(quantity, arguments))

    def digits(self, quantity: str, *arguments: Any) -> Any:
        """Return a quantity as an array of mpmath's numbers of 113 bits, to read them; arguments as of `extended`."""
        return digits(self._exact(quantity, arguments), self._arithmetic)

    def at(self, /, **values: float) -> OracleDynamics:
        """Return the same dynamics at other values of the model's named parameters."""
        if self._given is not None:
            raise InputError("at: this oracle already has its constants; put the parameters' values among them")
        out = type(self)(self.model.with_nominal(values), backend=self._arithmetic.name)
        out._state_unchecked, out._step_unchecked = self._state_unchecked, self._step_unchecked
        return out

    def _of_model(self, model: Model, form: str) -> OracleDynamics:
        if form not in self._others:
            self._others[form] = type(self)(model, backend=self._arithmetic.name)
        out, own = copy(self._others[form]), self._arithmetic
        vars(out).update(model=model, _held=None)
        values = own.array(np.array(list(model.parameters.values()), dtype=np.float64))
        out._constants = [np.concatenate([values, out._constants[0][0][len(values) :]])[None]]
        return out

    def _rounded(self, value: Any) -> Array:
        return np.asarray(self._arithmetic.pair(value)[0])

    def _under(self, frames: tuple[Frame, ...], axes: str) -> OracleDynamics:
        key = names_of(frames), axes
        kept: dict[Any, OracleDynamics] = self.equations.kept.setdefault("under", {})
        if key not in kept:
            own = kept[key] = copy(self)
            own.equations = equations_of(self.model, constants="symbols", acting=key)
            own._acting, own._bare, own._programs, own._held = (frames, axes), self, {}, None
        return kept[key]

    # The methods of quantities take batches, and return 113-bit numbers.

    def _value(self, method: Callable[..., Any], states: list[Array], more: tuple[Any, ...], size: int | None) -> Any:
        self._values.last = method(*(np.atleast_2d(x) for x in states), *more)
        high, _ = self._arithmetic.pair(self._values.last)
        return high[0] if size is None else high

    def _exact(self, quantity: str, arguments: tuple[Any, ...]) -> Any:
        names = _ARGUMENTS.get(quantity)
        if names is None:
            raise UnknownNameError("quantity", str(quantity), _ARGUMENTS)
        stacked = quantity.endswith("derivatives")
        most = len(names) if stacked else len(signature(getattr(self, quantity)).parameters)
        if not len(names) <= len(arguments) <= most:
            raise InputError(f"{quantity}: expected {', '.join(names)}, got {len(arguments)} arguments")
        if stacked:
            out = self._evaluate(quantity, **dict(zip(names, arguments, strict=True)))
        else:
            out = np.asarray(getattr(self, quantity)(*arguments))
        # The method has checked all, and gave its value the shape.
        return self._values.last.reshape(out.shape)

    def _normalized(self, q: Array) -> Any:
        """Return q with quaternions of unit length."""
        own = self._arithmetic
        out = own.array(q).copy()
        for start, _ in self.model.quaternions:
            part = out[:, start : start + 4]
            length = own.sqrt(sum((part[:, i] * part[:, i] for i in range(1, 4)), part[:, 0] * part[:, 0]))
            out[:, start : start + 4] = own.divide(part, length[:, None])
        return out

    def _run(self, name: tuple[Any, ...], q: Array, *arguments: Any) -> list[Any]:
        if name not in self._programs:
            self._programs[name] = _DERIVED.get(
                (self._form, *map(str, name)),
                lambda: Extended(program(self._function_of(*name)), self._arithmetic),
            )
        return self._programs[name](self._normalized(q), *arguments, *self._constants)

    def _first(self, name: str, *states: Any, extra: tuple[Any, ...] = ()) -> Any:
        return self._run((name, *extra), *states)[0]

    def _function_of(self, name: str, *extra: Any) -> ca.Function:
        eq = self.equations
        if name != "terms":
            return function_of(eq, name, *extra)
        outs = [ca.densify(getattr(eq, x)) for x in _TERMS]
        return ca.Function("terms", [eq.q, eq.v, *eq.extra_arguments.values()], outs)

    def _terms(self, q: Array, v: Array | None = None) -> dict[str, Any]:
        """Return M, C v, g, the passive forces and nle; the last answer is kept, M and g for any v."""
        held = self._held
        if held and held[0] == _key(q) and (v is None or held[1] == _key(v)):
            return held[2]
        v = np.zeros((len(q), self.model.nv)) if v is None else v
        M, *vectors = self._run(("terms",), q, v)
        out = dict(zip(_TERMS, (M, *(x[:, :, 0] for x in vectors)), strict=True))
        self._held = (_key(q), _key(v), out)
        return out

    _mass_matrix, _coriolis_force, _gravity, _passive, _nle = map(_term, _TERMS)

    def _inverse_dynamics(self, q: Array, v: Array, a: Array) -> Any:
        terms = self._terms(q, v)
        return product(terms["mass_matrix"], self._arithmetic.array(a)) + terms["nle"] - terms["passive"]

    def _forward_dynamics(self, q: Array, v: Array, tau: Array) -> Any:
        if self.model.constrained or self._acting[0]:
            return self._run(("forward_dynamics",), q, v, tau)[0][:, :, 0]
        terms = self._terms(q, v)
        force = self._arithmetic.array(tau) + terms["passive"] - terms["nle"]
        return solve(terms["mass_matrix"], force, self._pattern, self.equations.elimination_order, self._arithmetic)

    @property
    def _form(self) -> str:
        """All that the programs depend on but their names."""
        frames, axes = self._acting
        return f"{self._digest} under {[x.name for x in frames]} {axes} in {self._arithmetic.name}"

    @cached_property
    def _pattern(self) -> Array:
        return np.asarray(ca.DM(self.equations.mass_matrix.sparsity(), 1).full())

    def _mass_matrix_inverse(self, q: Array) -> Any:
        M, own = self._terms(q)["mass_matrix"], self._arithmetic
        unit = own.array(np.broadcast_to(np.eye(self.model.nv), M.shape))
        return solve(M, unit, self._pattern, self.equations.elimination_order, own)

    def _only(self, out: Array, first: int, last: int) -> Array:
        self._values.last = self._values.last[:, first:last]
        return super()._only(out, first, last)


for _name in _ARGUMENTS:
    # Accelerations take the force of wrenches as any other.
    if f"_{_name}" not in vars(OracleDynamics) and not _name.endswith("_with_wrenches"):
        setattr(OracleDynamics, f"_{_name}", _of_shape(_name))
