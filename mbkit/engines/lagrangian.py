"""mbkit's own derivation behind the protocol: kinematics and energies, no rigid-body algorithm."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, wraps
from inspect import signature
from typing import TYPE_CHECKING, Any, Final, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import Array, count, finite_array, is_on_device, on_host, real
from mbkit.codegen.backend import DERIVING, Machine, compile_by_default, executable, has_compiler
from mbkit.codegen.c_source import WITHOUT_STOPS
from mbkit.derivation import ELIMINATIONS, Elimination, Equations, elimination_of, equations_of
from mbkit.derivation.body_motion import BODY_QUANTITIES
from mbkit.derivation.least_constraint import has_squares
from mbkit.engines.base import Dynamics
from mbkit.engines.derived import Derived, function_of, names_of
from mbkit.engines.elements.passive import UNDER_FORCE
from mbkit.engines.frames_and_momenta import ALIGNED
from mbkit.engines.loads import Wrenches
from mbkit.engines.steps import momentum_step_slopes
from mbkit.errors import (
    InputError,
    MbkitWarning,
    NumericalError,
    UnknownNameError,
    UnsupportedError,
    require_known,
    warn,
)
from mbkit.methods.registry import DEFAULT_METHOD, METHODS, Method
from mbkit.model import Frame, Model
from mbkit.model.elements.kinds import that_do
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.quantities import QUANTITIES, of_groups

if TYPE_CHECKING:
    from mbkit.codegen.compiled_calls import CompiledStep, Plan, QuantityCall
    from mbkit.codegen.cuda.runs import CudaSteps
    from mbkit.derivation.steps.fixed import Part

_Function = TypeVar("_Function", bound=Callable[..., Any])


def _column(name: str, value: ArrayLike) -> Array:
    """Return a parameter's values, one per sample."""
    if np.ndim(value) != 1:
        raise InputError(f"parameter {name!r}: expected a number or shape (N,), got {np.shape(value)}")
    return finite_array(f"parameter {name!r}", value, (len(np.asarray(value)),))


def _trimmed(shape: tuple[str, ...]) -> Callable[[Array], Array]:
    """Return what takes the axes from a compiled function's matrix that a quantity of this shape does not have."""
    if len(shape) < 2:
        return lambda x: x[..., 0] if shape else x[..., 0, 0]
    if len(shape) == 2:
        return lambda x: x
    rows = int(shape[1])
    return lambda x: x.reshape(*x.shape[:-2], x.shape[-2] // rows, rows, x.shape[-1])


_NOT_ON_GPU: Final = {
    "force.bushing": "its angles take an atan2, which a GPU's code does not have",
    "joint.stiction": "its Stribeck curve takes an exp, which a GPU's code does not have",
}
_ON_GPU: Final = ALL - {"jump", "force"} | {"force.joint", "force.frame", "force.compensation.partial"}
GPU: Final = Path(
    "gpu", "device: not known of", _ON_GPU.union(that_do("jump")) - {*_NOT_ON_GPU}, _NOT_ON_GPU, instead="use the CPU"
)
#: The host decides the forces at rest of what jumps.
GPU_ARRAYS: Final = Path("gpu under force", "", _ON_GPU, instead="copy them with numpy first")
#: Quantities of three derivatives.
_DERIVATIVES: Final = tuple(of_groups("derivatives"))
#: Three derivatives side by side, which `_TRIM` puts one behind the other.
_STACKED: Final = "stacked"
#: Compiled functions by name, and how their results lose the axes that the quantity does not have.
_TRIM: Final[dict[str, Callable[[Array], Array]]] = {
    name: _trimmed(x.shape)
    for name, x in QUANTITIES.items()
    if name in BODY_QUANTITIES or x.group in ("equation", "inverse", "rate") or (x.group == "row" and x.listed)
}
_TRIM[_STACKED] = lambda x: x.reshape(*x.shape[:-1], 3, x.shape[-1] // 3).swapaxes(-2, -3)


def _quick(checked: _Function) -> _Function:
    """Return this method of `Dynamics`, which first tries machine code with the arguments as they are.

    A common one with *arguments would cost 0.2 µs a call.
    """
    name, given = checked.__name__, [*signature(checked).parameters.values()][1:]
    arguments = ", ".join(x.name for x in given if x.default is x.empty)
    loads = "".join(f", {x.name}={x.default!r}" for x in given if x.default is not x.empty)
    rest = "".join(f", {x.name}" for x in given if x.default is not x.empty)
    # Accelerations look first whether their state is open.
    looking = " and not self._state_unchecked" if name == "forward_dynamics" else ""
    text = f"""
def {name}(self, {arguments}{loads}):
    call = self._direct.get("{name}"){f" if wrenches is None{looking} else None" if loads else ""}
    if call is not None:
        out = call[0]({arguments})
        if out is not None or (out := call[1]({arguments})) is not None:
            return out
    return checked(self, {arguments}{rest})
"""
    scope: dict[str, Any] = {"checked": checked, "__name__": __name__}
    exec(text, scope)
    return wraps(checked)(scope[name])  # type: ignore[return-value]  # of the same signature


def _term(name: str) -> Callable[..., Any]:
    def evaluate(self: LagrangianDynamics, *arguments: Array) -> Array:
        return self._trimmed(name, *arguments)

    return evaluate


def _body_term(name: str) -> Callable[..., Any]:
    states = BODY_QUANTITIES[name].arguments

    def evaluate(self: LagrangianDynamics, *given: Any) -> Array:
        # Without frames to act on there is no argument of wrenches.
        n = sum(isinstance(x, np.ndarray) for x in given[: len(states)])
        return _TRIM[name](self._machine(name, *map(names_of, given[n:]))(*given[:n])[0])

    return evaluate


class LagrangianDynamics(Derived):
    """Terms derived from kinematics and energies, each at its first use.

    Parameters
    ----------
    model : Model
    compile : bool, optional
        Whether to make machine code of the terms, which is kept on disk; else CasADi's machine interprets them, right
        for a few evaluations. By default compiled, unless the environment says ``MBKIT_COMPILE=0``.
    threads : int, optional
        Threads that share a large batch; by default as many as the process has cores.
    device : {"cuda", "cuda:1", ...}, optional
        An NVIDIA GPU on which batches of quantities and their fixed steps run, to the same bits; single states and all
        else stay on the CPU. `UnsupportedError` says what is missing for it.
    elimination : {"links", "mass matrix", "least constraint"}, optional
        What accelerations come from; by default the first, or the last where the first would lose digits.

    Notes
    -----
    ``"links"`` eliminates one acceleration after the other, link by link, from Gauss's function, and M and inverse
    dynamics are those of the links too; with the operations of the articulated-body, composite-rigid-body and recursive
    Newton-Euler algorithms (Featherstone 2008, ch. 5 to 7). ``"mass matrix"`` derives every term from the bodies'
    energies by Lagrange's equations, and factors M = LᵀDL: an independent route, with about two to four times as many
    operations. ``"least constraint"`` makes the columns of the bodies' velocities orthogonal, and forms no M.

    Elimination loses M_kk/D_k of the digits, D_k being the remainder of a diagonal entry once all beyond joint k gives
    way. Where that is more than five digits at some pose, as of a light cart below a heavy pole, the default is
    ``"least constraint"``. It is decided from the description, at the nominal values of parameters when the dynamics
    were built: `at` changes masses but not the way. The pose is searched within the limits, and may be missed where
    several coordinates have to be right at once. Systems that were written as energies have the mass matrix only, and
    so have the methods that solve with it themselves, ``"rodas5"`` and ``"implicit_midpoint"``.
    """

    engine = "lagrangian"
    _derived = True
    _takes_parameters = True

    def __init__(
        self,
        model: Model,
        *,
        compile: bool | None = None,  # noqa: A002  # the word that users look for
        threads: int | None = None,
        elimination: Elimination | None = None,
        device: str | None = None,
    ) -> None:
        super().__init__(model)
        self._chosen = None if elimination is None else _elimination(model, elimination)
        if compile is not None and not isinstance(compile, bool):
            raise InputError(f"compile: expected True, False or None, got {compile!r}")
        if device is not None:
            GPU.admit(model)
        self.device = None if device is None else _checked_device(device, compile)
        self.compile = (compile_by_default() or device is not None) if compile is None else compile
        self.threads = None if threads is None else count("threads", threads, least=1)
        #: Values of parameters that differ from sample to sample, (N,) each; the others are in the model.
        self._batched: dict[str, Array] = {}
        self._machines: dict[tuple[str, ...], Any] = {}
        self._short: dict[tuple[str, ...], QuantityCall] = {}
        #: Those of them whose arguments are the state alone.
        self._direct: dict[str, QuantityCall] = {}
        self._steps: dict[str, tuple[Method, CompiledStep]] = {}
        #: For steps that the others lose to their constraints.
        self._thorough_steps: dict[str, tuple[Method, CompiledStep]] = {}
        self._wrenched: dict[Any, LagrangianDynamics] = {}
        #: Dynamics of models that differ in the values of parameters alone, by their form.
        self._others: dict[str, LagrangianDynamics] = {}
        self._parametric = bool(model.parameters)

    @cached_property
    def equations(self) -> Equations:
        """The expressions, free to read."""
        return equations_of(self.model, elimination=self.elimination)

    @cached_property
    def elimination(self) -> Elimination:
        """The elimination that gives accelerations."""
        return self._chosen or elimination_of(self.model)

    @cached_property
    def _form(self) -> str:
        """The digest of the derivation: of the description without parameters' values, and of what these decide."""
        digest = self.model.form_digest
        chosen = self._chosen or self.model.parameters
        return f"{digest} by {self.elimination}" if chosen else digest

    def _code(self, name: str, *extra: Any, make: Callable[[], Any] | None = None) -> Any:
        """Return a `Compiled` or `Machine` of a quantity, or of what `make` derives from this model.

        Its arguments are not checked.
        """
        key = (name, *extra)
        if key not in self._machines:

            def derive() -> Any:
                return function_of(self.equations, name, *extra) if make is None else make()

            with DERIVING:
                starts = [start for start, _ in self.model.quaternions] if name in _TRIM else None
                named = self._form, *map(str, key)
                code = executable(named, derive, compile=self.compile, device=self.device, quaternions=starts)
            # At rest, a force that jumps is decided outside of machine code, and has no derivative.
            undecided = "jump" in self.model.effects and {name, *extra} & {*UNDER_FORCE, _DERIVATIVES[1]}
            if name in _TRIM and not (isinstance(code, Machine) or undecided):
                # Loads LLVM, which interpreting never needs.
                from mbkit.codegen.compiled_calls import quantity_call

                short = quantity_call(self.model, code, _TRIM[name], self.threads)
                # Derivatives go by the name of what they are of.
                self._short[key[key[0] == _STACKED :]] = short
                if not (extra or self._parametric):
                    self._direct[name] = short
            self._machines[key] = code
        return self._machines[key]

    def _machine(self, name: str, *extra: Any) -> Callable[..., list[Array]]:
        code = self._code(name, *extra)
        return lambda *arguments: code(*arguments, *self._trailing(arguments[0]), threads=self.threads)

    def _trailing(self, first: Any) -> tuple[Array, ...]:
        """Return the argument of parameters that a compiled function takes behind its own, if it takes one."""
        if not self.model.parameters:
            return ()
        values = self._parameter_values
        if values.ndim == 1 and np.ndim(first) == 2:
            return (np.broadcast_to(values, (len(first), len(values))),)
        return (values,)

    @cached_property
    def _parameter_values(self) -> Array:
        """Values of the model's parameters in their order, (p,) or one row per sample."""
        parameters = self.model.parameters
        missing = [name for name, x in parameters.items() if x is None and name not in self._batched]
        if missing:
            raise InputError(
                f"{self.model.name}: no value for parameter {', '.join(map(repr, missing))}; "
                f"give it with dynamics.at({', '.join(f'{name}=...' for name in missing)})"
            )
        if not parameters:
            return np.empty(0)
        columns = np.broadcast_arrays(*(np.asarray(self._batched.get(name, x)) for name, x in parameters.items()))
        return np.stack(columns, axis=-1).astype(np.float64)

    def at(self, /, **values: ArrayLike) -> LagrangianDynamics:
        """Return the same dynamics at other values of parameters, as `Dynamics.at` does; nothing is derived again."""
        require_known("parameter", self.model.parameters, *values)
        many = {name: _column(name, x) for name, x in values.items() if np.ndim(x)}
        if (times := many.get(self.model.time_parameter or "")) is not None and len(times):
            self.model.require_times("time", float(times.min()), float(times.max()))
        batched = {name: x for name, x in self._batched.items() if name not in values} | many
        if len({len(x) for x in batched.values()}) > 1:
            message = ", ".join(f"{name} has {len(x)}" for name, x in batched.items())
            raise InputError(f"parameters: batches of different sizes: {message}")
        single: dict[str, Any] = {name: x for name, x in values.items() if name not in many}
        return self._with(self.model.with_nominal(single) if single else self.model, batched)

    @property
    def _samples(self) -> int | None:
        """Size of the batch that the parameters' values make, None where every sample has the same."""
        return next((len(x) for x in self._batched.values()), None)

    def _of_samples(self, which: ArrayLike) -> LagrangianDynamics:
        """Return the dynamics of these samples of a batch, by index, which may repeat."""
        if not self._batched:
            return self
        index = np.asarray(which)
        # A mask would be read as the samples 0 and 1.
        if index.ndim != 1 or (index.size and index.dtype.kind not in "iu"):
            raise InputError(
                f"samples: expected a list of indices, got {which!r}; numpy.flatnonzero makes one of a mask"
            )
        index = index.astype(int)
        if "_parameter_values" not in vars(self):
            return self._with(self.model, {name: x[index] for name, x in self._batched.items()})
        values = self._parameter_values[index]
        columns = dict(zip(self.model.parameters, values.T, strict=True))
        out = self._with(self.model, {name: columns[name] for name in self._batched})
        vars(out)["_parameter_values"] = values
        if "_law" in vars(self):
            vars(out)["_law"] = vars(self)["_law"].of_samples(index)
        return out

    def _of_sample(self, i: int) -> LagrangianDynamics:
        own = {name: float(x[i]) for name, x in self._batched.items()}
        return self._with(self.model.with_nominal(own), {}) if own else self

    def _of_model(self, model: Model, form: str) -> LagrangianDynamics:
        if form not in self._others:
            # The choice of the elimination is this model's own.
            chosen: Any = {"compile": self.compile, "elimination": self.elimination, "device": self.device}
            self._others[form] = type(self)(model, threads=self.threads, **chosen)
        return self._others[form]._with(model, self._batched)

    def _with(self, model: Model, batched: dict[str, Array]) -> LagrangianDynamics:
        out = object.__new__(type(self))
        # Both share derived and compiled functions, now and later.
        out.__dict__.update(self.__dict__, equations=self.equations, elimination=self.elimination, _form=self._form)
        for name in ("_parameter_values", "_phases", "_matter", "_law"):
            out.__dict__.pop(name, None)
        bare: Any = self._bare
        vars(out).update(model=model, _batched=batched, _wrenched={}, _bare=bare and bare._with(model, batched))
        return out

    def __reduce__(self) -> tuple[Any, ...]:
        options = {"compile": self.compile, "threads": self.threads, "elimination": self._chosen, "device": self.device}
        return _restore, (self.model, self._batched, options)

    def _states(self, arguments: dict[str, ArrayLike]) -> tuple[dict[str, Array], int | None]:
        n = self._samples
        if n is not None:
            for name, x in arguments.items():
                if np.ndim(x) == 2 and len(np.asarray(x)) != n:
                    raise InputError(f"{name}: a batch of {len(np.asarray(x))}, but the parameters' values are {n}")
            arguments = {
                k: np.broadcast_to(x, (n, *np.shape(x))) if np.ndim(x) == 1 else x for k, x in arguments.items()
            }
        return super()._states(arguments)

    def _evaluate(self, quantity: str, *more: Any, **arguments: Any) -> Any:
        if self.device is not None and any(map(is_on_device, arguments.values())):
            return self._on_device(quantity, more, arguments)
        short = self._short.get((quantity, *more))
        if short is None and more:
            # Frames and joints are the same objects in the next call, and quicker to look up than their names.
            short = self._short.get((quantity, *map(names_of, more)))
            if short is not None:
                self._short[quantity, *more] = short
        if short is not None:
            own = (*arguments.values(), *self._trailing(arguments["q"])) if self._parametric else arguments.values()
            one: Array | None = short.single(*own)
            if one is not None:
                return short.turned(one)
            many: Array | None = short.batch(*own)
            if many is not None:
                return many
        return super()._evaluate(quantity, *more, **arguments)

    def _on_device(self, quantity: str, more: tuple[Any, ...], given: dict[str, Any]) -> Any:
        from mbkit.codegen.cuda.arrays import batch_on_device

        if quantity in UNDER_FORCE:
            GPU_ARRAYS.admit(self.model, f"{quantity} takes arrays of the host, not of a GPU, for")
        names = tuple(map(names_of, more))
        key = (quantity, *names) if quantity in _TRIM else (_STACKED, quantity)
        if key[0] == _STACKED and quantity not in _DERIVATIVES:
            raise UnsupportedError(f"{quantity} takes arrays of the host, not of a GPU; copy them with numpy first")
        trailing = self._trailing(np.empty(0))
        arguments = {**given, **({"parameters": trailing[0]} if trailing else {})}
        out = batch_on_device(self._code(*key), _TRIM[key[0]], arguments)
        if out is None:
            # The host's checks say what is wrong.
            near = {k: on_host(x) for k, x in given.items()}
            super()._evaluate(quantity, *more, **near)
            raise NumericalError(f"{quantity}: the GPU gave numbers that are not finite, and the CPU did not")
        return out

    def _warn_of_open_states(self, q: ArrayLike) -> None:
        super()._warn_of_open_states(on_host(q))

    mass_matrix, coriolis_matrix = _quick(Dynamics.mass_matrix), _quick(Dynamics.coriolis_matrix)
    coriolis_force, gravity = _quick(Dynamics.coriolis_force), _quick(Dynamics.gravity)
    nle, passive = _quick(Dynamics.nle), _quick(Dynamics.passive)
    inverse_dynamics, forward_dynamics = _quick(Dynamics.inverse_dynamics), _quick(Dynamics.forward_dynamics)
    kinetic_energy, potential_energy = _quick(Dynamics.kinetic_energy), _quick(Dynamics.potential_energy)

    def _trimmed(self, name: str, *arguments: Array) -> Array:
        return _TRIM[name](self._machine(name)(*arguments)[0])

    def _first(self, name: str, *states: Array, extra: tuple[Any, ...] = ()) -> Array:
        return np.asarray(self._machine(name, *extra)(*states)[0])

    def _every_jacobian(self, q: Array) -> Array:
        return self._first("every_jacobian", q)

    def _stacked(self, name: str, *arguments: Array) -> Array:
        return _TRIM[_STACKED](self._machine(_STACKED, name)(*arguments)[0])

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Array:
        return self._stacked("inverse_dynamics_derivatives", q, v, a)

    def _forward_dynamics_derivatives(self, q: Array, v: Array, tau: Array) -> Array:
        return self._stacked("forward_dynamics_derivatives", q, v, tau)

    # Steps

    def _under(self, frames: tuple[Frame, ...], axes: str) -> LagrangianDynamics:
        key = names_of(frames), axes
        if key in self._wrenched:
            return self._wrenched[key]
        kept: dict[Any, LagrangianDynamics] = self.equations.kept.setdefault("under", {})
        if key not in kept:
            own = LagrangianDynamics(self.model, compile=self.compile, threads=self.threads, device=self.device)
            own.elimination, own._form, own._acting = self.elimination, f"{self._form} under {key}", (frames, axes)
            own.equations = equations_of(self.model, elimination=self.elimination, acting=key)
            kept[key] = own
        out = self._wrenched[key] = kept[key]._with(self.model, self._batched)
        out._bare = self
        return out

    @property
    def _compiles_steps(self) -> bool:
        """Whether whole steps are machine code: with a compiler, for a model that moves."""
        if not self.model.nv:
            return False
        return not isinstance(self._code("forward_dynamics"), Machine)

    def _step_plan(self, method: str, *, thorough: bool = False, fed: str = "", behind: Sequence[Part] = ()) -> Plan:
        """Return the compiled parts of an explicit method's step; `_compiles_steps` says whether there are some.

        `thorough`: with the projection for steps that the usual one loses to their constraints; `fed`: under a state
        feedback with a gain of this pattern; `behind`: with these parts at its end.
        """
        from mbkit.codegen.compiled_calls import Plan

        plans: dict[Any, Plan] = self.equations.kept.setdefault("rollout", {})
        key = METHODS[method].code_name, thorough, fed, *(part.name for part in behind)
        if key not in plans:
            plans[key] = Plan(self.equations, method, self._part, thorough=thorough, fed=fed, behind=behind)
        return plans[key]

    def _step_with(self, method: str, part: Part) -> CompiledStep:
        """Return an explicit method's step with a part at its end."""
        from mbkit.codegen.compiled_calls import CompiledStep

        steps: dict[Any, CompiledStep] = self.equations.kept.setdefault("steps", {})
        key = METHODS[method].code_name, part.name
        if key not in steps:
            steps[key] = CompiledStep(self.model, self.equations, self._step_plan(method, behind=[part]), self._part)
        return steps[key]

    def _device_steps(self, method: str, *, thorough: bool = False, fed: str = "") -> CudaSteps:
        """Return the same steps on the GPU of these dynamics."""
        from mbkit.codegen.cuda.driver import device_of
        from mbkit.codegen.cuda.runs import MAX_STEP_OPERATIONS, steps_on_device
        from mbkit.derivation.steps.fixed import STATE, parts_of

        assert self.device is not None
        held: dict[Any, CudaSteps] = self.equations.kept.setdefault("device", {})
        name = METHODS[method].code_name, str(thorough), fed
        if (key := (self.device, *name)) not in held:

            def parts() -> tuple[Part, ...]:
                def operations(part: Part) -> int:
                    return int(self._part(part).operations)

                return parts_of(
                    self.equations, method, operations, thorough=thorough, fed=fed, most=MAX_STEP_OPERATIONS
                )

            held[key] = steps_on_device((self._form, *name), parts, STATE, device_of(self.device))
        return held[key]

    def _part(self, part: Part) -> Any:
        return self._code(part.name, make=part.make)

    def step(
        self,
        q: ArrayLike,
        v: ArrayLike,
        tau: ArrayLike,
        dt: float,
        method: str = DEFAULT_METHOD,
        wrenches: Wrenches | None = None,
        axes: str = ALIGNED,
        t: ArrayLike | None = None,
    ) -> tuple[Array, Array]:
        """Return (q, v) after one step, as `Dynamics.step` does; as machine code where `simulate` compiles the step."""
        try:
            held = self._steps[method]
            # Another method may have been registered by this name.
            known = held[0] is METHODS[method] and not wrenches
        except (KeyError, TypeError):
            known = False
        if known:
            single, behind = held[1].single, self._trailing(q) if self._parametric else ()
            if t is not None or self.model.time_parameter is not None:
                times = self._start_of_step(t, real("dt", dt, positive=True), *np.shape(behind)[1:-1])
                if times is not None:
                    # The time is the last parameter.
                    last = np.arange(len(self.model.parameters)) == len(self.model.parameters) - 1
                    behind = (np.where(last, times[..., None], behind[0]),)
            # A call with *arguments costs a tenth of a small step.
            out: tuple[Array, Array] | None = single(q, v, tau, dt, 0.0) if not behind else None
            if out is None and (dt := real("dt", dt)) > 0:
                out = single(q, v, tau, dt, 0.0, *behind)
                if out is None:
                    out = held[1].batch(q, v, tau, dt, *behind, threads=self.threads)
            if out is not None:
                return out
        return super().step(q, v, tau, dt, method, wrenches, axes, t)

    def _single_step(self, method: str) -> Callable[..., tuple[Array, Array] | None]:
        """Return the machine code of a step as a function of q, v, tau, dt and 0.0; None where it refuses them."""
        return self._compiled_step(METHODS[method]).single

    def _compiled_step(self, method: Method, *, thorough: bool = False) -> CompiledStep:
        steps = self._thorough_steps if thorough else self._steps
        held = steps.get(method.name)
        if held is None or held[0] is not method:
            from mbkit.codegen.compiled_calls import CompiledStep

            plan = self._step_plan(method.name, thorough=thorough)
            held = steps[method.name] = method, CompiledStep(self.model, self.equations, plan, self._part)
        return held[1]

    def _step(self, method: Method, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
        if not self._compiles_steps:
            return super()._step(method, q, v, tau, dt)
        for thorough in (False, True) if self.model.constrained else (False,):
            step = self._compiled_step(method, thorough=thorough)
            q1, v1, finite = step.run(q, v, tau, dt, *self._trailing(q), threads=self.threads)
            if finite:
                break
        # Lost to its constraints all the same: in Python the projection goes on until it is done.
        return (q1, v1) if finite or not self.model.constrained else super()._step(method, q, v, tau, dt)

    def _momentum_step_slopes(
        self, dt: float, q: Array, v: Array, tau: Array, *, parameters: bool
    ) -> tuple[Array, Array, Array]:
        from mbkit.derivation.steps.midpoint import Midpoint

        part = Midpoint(self.equations).slopes
        code = self._code(part.name, make=part.make)

        def equations(q: Array, w: Array, v1: Array) -> list[Array]:
            h = np.full((*q.shape[:-1], 1), dt)
            return list(code(q, v, w, v1, tau, h, *self._trailing(q), threads=self.threads))

        q1, v1, slopes = momentum_step_slopes(self.model, equations, q, v)
        return q1, v1, slopes if parameters else slopes[..., : 3 * self.model.nv]

    def _function(self, name: str, frame: str | None, axes: str, kind: str) -> Any:
        f = self.equations.function(name, frame, axes, kind)
        given = f.sx_in()
        if "stop" in self.model.effects and "tau" in f.name_in():
            warn(f"{self.model.name}: {name}: {WITHOUT_STOPS}", MbkitWarning)
        # Users inline and differentiate it: small is worth a search.
        return ca.Function(name, given, f.call(given), f.name_in(), f.name_out(), {"cse": True})


for _name in _TRIM.keys() - {_STACKED}:
    setattr(LagrangianDynamics, f"_{_name}", (_body_term if _name in BODY_QUANTITIES else _term)(_name))


def _restore(model: Model, batched: dict[str, Array], options: dict[str, Any]) -> LagrangianDynamics:
    return LagrangianDynamics(model, **options).at(**batched)


def _checked_device(device: str, compile: bool | None) -> str:  # noqa: A002  # as above
    """Return the full name of a GPU that is there."""
    from mbkit.codegen.cuda.driver import device_of

    if compile is False or not has_compiler():
        raise InputError(f"device: expected None where nothing is compiled, got {device!r}")
    return device_of(device).name


def _elimination(model: Model, name: str) -> Elimination:
    if name not in ELIMINATIONS:
        raise UnknownNameError("elimination", name, ELIMINATIONS)
    if name != "mass matrix" and model.energy_equations is not None:
        raise UnsupportedError(f"{model.name}: written as energies, it has the elimination 'mass matrix', not {name!r}")
    if name == "least constraint" and not has_squares(model):
        raise UnsupportedError(
            f"{model.name}: an inertia is no sum of squares, which elimination 'least constraint' needs; "
            "give 'links' or 'mass matrix'"
        )
    return name
