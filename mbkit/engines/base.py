"""The protocol of the engines: `Dynamics`, one description evaluated by one engine.

The equation of motion stands in the package's docstring. Checks of arguments and results, batches, and the
quantities that follow from others are here.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from mbkit._attributes import ReadOnly, single_values
from mbkit._check import DOUBLE_BITS, Array, all_finite, batch_of, rows
from mbkit._process import fork_safe
from mbkit.engines import constrained, loads
from mbkit.engines.closed_loops.actuation import ACTUATOR_FORCES
from mbkit.engines.closed_loops.loop_loads import LOOP_LOADS
from mbkit.engines.closed_loops.reduced_inertia import REDUCED_INERTIA, IndependentMotion
from mbkit.engines.elements.jumps import Jumps
from mbkit.engines.elements.passive import UNDER_FORCE
from mbkit.engines.frames_and_momenta import (
    ALIGNED,
    JOINT,
    LOCAL,
    OF_THE_WHOLE,
    FrameByFrame,
    FramesAndMomenta,
    axes_named,
    composite_rounding,
)
from mbkit.engines.linearization import (
    ForwardDynamicsDerivatives,
    InverseDynamicsDerivatives,
    LinearizationQuantities,
)
from mbkit.engines.loads import Wrenches
from mbkit.engines.regressors import Regressors
from mbkit.engines.steps import Steps
from mbkit.errors import InputError, NumericalError, UnsupportedError
from mbkit.model import Frame, Joint, Model
from mbkit.model.elements.kinds import EFFECTS, that_do
from mbkit.model.elements.paths import Path
from mbkit.model.loops import discs_of
from mbkit.model.quantities import OF_BODIES
from mbkit.model.quantities import QUANTITIES as TABLE
from mbkit.model.validation import listing

if TYPE_CHECKING:
    from mbkit.engines.elements.compiled_forces import CompiledForces
    from mbkit.show import Kind

#: Names of the quantities that `Dynamics.supports` may list.
QUANTITIES: Final = tuple(name for name, x in TABLE.items() if x.listed)
#: Path of the quantities of a group that not every model has.
_GATES: Final = {
    "load": loads.LOADS,
    "loop": LOOP_LOADS,
    "row": constrained.ROWS,
    "actuator": ACTUATOR_FORCES,
    "motion": REDUCED_INERTIA,
}
#: Names in a list of an error message.
MAX_NAMES: Final = 3

_Dynamics = TypeVar("_Dynamics", bound="Dynamics")


#: Joints of several velocities that turn rotors.
ROTORS_OF_SEVERAL: Final = "joint.armature.several"
_OF_JOINTS: Final = "joint.armature joint.spring joint.damping"
_OF_FORCES: Final = "joint frame bushing compensation compensation.partial of_time"
#: Kinds that stand beside the terms of any adapter, at least in part: what holds a rotor's weight is a force.
BESIDE: Final = frozenset(["body.rotor", *that_do("jump"), *(f"force.{x}" for x in _OF_FORCES.split())])
#: And what every adapter here carries of trees by itself.
OF_TREES: Final = BESIDE.union(
    _OF_JOINTS.split(),
    (f"{x}.several" for x in _OF_JOINTS.split()),
    ("gravity", "mimic", "point.spring", "point.damper", "bound"),
)
OF_COUPLINGS: Final = frozenset(["coupling.spring", "coupling.damper", "coupling.armature"])
OF_ANY_ENGINE: Final = "use a method that any engine has, such as rk4"
SOLVED: Final = "mbkit.dynamics(model, 'lagrangian') takes all of them"
#: Engines of one's own, unless they have another path.
OWN_ENGINE: Final = Path("own engine", "", OF_TREES | OF_COUPLINGS | {"q"}, instead=SOLVED)
#: The own derivation, which goes through the laws of energies, forces and rows.
DERIVATION: Final = Path("derivation", "", frozenset([*EFFECTS, "energies"]))


def scalar(value: Array | float) -> Any:
    """Return one state's number as a float, a batch's as an array."""
    return value if np.ndim(value) else float(value)


class Dynamics(ReadOnly, FramesAndMomenta, IndependentMotion, LinearizationQuantities, Regressors, Steps):
    """A model evaluated by one engine; `mbkit.dynamics` returns one.

    Every method takes one state or a batch with one leading axis, checks shapes, finite numbers and unit quaternions,
    and returns new arrays.

    An adapter defines a method for each quantity, named after it: `_mass_matrix(q)`, `_nle(q, v)`,
    `_velocity(q, v, frames, axes)`. States are checked float64 arrays, and come first; of frames there are several, and
    their values are stacked: (k, 6) or (N, k, 6). Derivatives are stacked, (3, nv, nv) or (N, 3, nv, nv).

    Raises
    ------
    InputError
        An argument of the wrong shape, not finite, or with a quaternion that is not of unit length.
    NumericalError
        The engine's answer is not finite.
    UnsupportedError
        The engine cannot give this quantity, with the reason.
    """

    engine: ClassVar[str]
    _elsewhere: ClassVar[Mapping[str, str]] = {name: x for x, own in TABLE.items() for name in own.elsewhere}
    #: Reason for each quantity that this engine cannot give.
    _refuses: ClassVar[dict[str, str]] = {}
    #: Whether parameters may still be without values when the adapter is built.
    _takes_parameters: ClassVar[bool] = False
    #: The kinds of parts that it carries.
    _path: Path = OWN_ENGINE
    #: The point about which it writes composite inertias, by quantity, or for all others by the empty name; of each
    #: joint its own origin by default. `mbkit.engines.frames_and_momenta` has the choices.
    _inertias_about: ClassVar[dict[str, str]] = {}
    #: Whether it has `mbkit.derivation.Equations` and compiles whole steps of them.
    _derived: ClassVar[bool] = False
    #: Significand bits of its arithmetic.
    _significand_bits: ClassVar[int] = DOUBLE_BITS
    #: Whether the adapter's own terms hold the forces that are given by functions; else they are added to them.
    _has_force_elements: ClassVar[bool] = False
    #: Whether an evaluation uses memory of the object, so that one thread at a time may evaluate.
    _one_at_a_time: ClassVar[bool] = True
    #: Whether the adapter's methods take batches too, all of one size, and not single states alone.
    _batches: ClassVar[bool] = True
    #: Frames whose wrenches stand behind τ in that argument, six numbers each, and their axes.
    _acting: tuple[tuple[Frame, ...], str] = ((), LOCAL)
    #: The same dynamics without these wrenches, where there are some.
    _bare: Dynamics | None = None

    def __init__(self, model: Model) -> None:
        self._take(model)
        self._path.admit(model, f"{self.engine}:")

    def _take(self, model: Model) -> None:
        """Take a model, whatever its parts."""
        if not self._takes_parameters:
            model.require_values(self.engine)
        #: Whether no acceleration, and no step, has yet checked that its state satisfies the constraints.
        self._state_unchecked = self._step_unchecked = model.constrained and not self._soft_constraints
        self._lock: Any = fork_safe(threading.RLock()) if self._one_at_a_time else nullcontext()
        # Also where a copy begins again.
        vars(self)["model"] = model

    @property
    def supports(self) -> frozenset[str]:
        """Names of the quantities that this engine can give."""
        closed = {group for group, path in _GATES.items() if path.refuses(self.model)}
        closed |= frozenset() if self.model.has_bodies else OF_BODIES
        needed = {x: TABLE[x].follows or x for x in QUANTITIES}
        return frozenset(
            x
            for x, y in needed.items()
            if y not in self._refuses and hasattr(self, f"_{y}") and not {TABLE[x].group, TABLE[y].group} & closed
        )

    def __repr__(self) -> str:
        return f"<{type(self).__name__} of {self.model.name!r}: nq={self.model.nq}, nv={self.model.nv}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.model,)

    def at(self, /, **values: Any) -> Dynamics:
        """Return the same dynamics at other values of the model's named parameters.

        The lagrangian engine passes the values as arguments to its compiled functions; the others are built again.

        Parameters
        ----------
        **values : float
            By name; the others keep their values. A number is checked as `ModelBuilder.build` would, which takes a
            millisecond or so. The lagrangian engine also takes (N,) arrays, one value per sample of a batch, checked
            for finite numbers only.

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
        rebuilt, (model, *choices) = self.__reduce__()
        return self._at_time(values) or rebuilt(model.with_nominal(single_values(values)), *choices)

    def _at_time(self, values: Mapping[str, Any]) -> Self | None:
        """Return the same dynamics, with all that was built, at another time; None for other values."""
        if not values or set(values) - {self.model.time_parameter}:
            return None
        # copy.copy pickles, and so builds again.
        out = object.__new__(type(self))
        vars(out).update(vars(self), model=self.model.with_nominal(values))
        return out

    def _of_samples(self, which: ArrayLike) -> Dynamics:  # noqa: ARG002  # for the engine whose samples differ
        """Return the dynamics of these samples of a batch, by index: itself, unless parameters differ between them.

        Examples
        --------
        >>> import mbkit as mb
        >>> model = mb.catalog.pendulum(mass=mb.Parameter("m", 2.0))
        >>> dyn = mb.dynamics(model, "lagrangian").at(m=[1.0, 2.0, 3.0])
        >>> dyn._of_samples([0, 2])._samples
        2
        """
        return self

    # Terms of the equation of motion

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return M(q), shape (nv, nv) or (N, nv, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> print(dyn.mass_matrix([0.1, 0.2]).round(4))
        [[4.9601 1.9801]
         [1.9801 1.    ]]
        """
        return self._evaluate("mass_matrix", q=q)

    def coriolis_matrix(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) with Ṁ - 2C skew, shape (nv, nv) or (N, nv, nv).

        Coriolis matrices are not unique; mbkit's own is Christoffel's. Compare C v between engines, not the entries.
        A value that an engine is known to get wrong comes with a `KnownDefectWarning`.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> q, v = [0.1, 0.2], [1.0, -2.0]
        >>> C = dyn.coriolis_matrix(q, v)
        >>> bool(abs(C @ v - dyn.coriolis_force(q, v)).max() < 1e-14)
        True
        """
        return self._evaluate("coriolis_matrix", q=q, v=v)

    def coriolis_force(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) v, shape (nv,) or (N, nv).

        It is formed with the engine's own Coriolis matrix where it has one, so that a wrong matrix shows.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> print(dyn.coriolis_force([0.1, 0.2], [1.0, -2.0]).round(4))
        [0.     0.1987]
        """
        return self._evaluate("coriolis_force", q=q, v=v)

    def gravity(self, q: ArrayLike) -> Array:
        """Return g(q), on the left of the equation, without springs; (nv,) or (N, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> print(dyn.gravity([0.1, 0.2]).round(4))
        [4.8578 2.8991]
        """
        return self._evaluate("gravity", q=q)

    def nle(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return C(q, v) v + g(q), shape (nv,) or (N, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> print(dyn.nle([0.1, 0.2], [1.0, -2.0]).round(4))
        [4.8578 3.0977]
        """
        return self._evaluate("nle", q=q, v=v)

    def passive(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the generalized force of springs and dampers, and of dry friction at speed; (nv,) or (N, nv).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.elastic_pendulum())
        >>> print(dyn.passive([0.1, 0.2], [0.0, 0.0])[1].round(4))
        -20.0
        """
        return self._evaluate("passive", q=q, v=v)

    def inverse_dynamics(
        self, q: ArrayLike, v: ArrayLike, a: ArrayLike, wrenches: Wrenches | None = None, axes: str = ALIGNED
    ) -> Array:
        """Return τ = M a + nle - τ_passive - Σ Jᵀ w, shape (nv,) or (N, nv).

        `wrenches` on frames and their `axes` are those of `generalized_force`.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> q, v, a = [0.1, 0.2], [1.0, -2.0], [0.5, 0.0]
        >>> tau = dyn.inverse_dynamics(q, v, a)
        >>> bool(abs(tau - (dyn.mass_matrix(q) @ a + dyn.nle(q, v))).max() < 1e-14)
        True
        """
        if not wrenches:
            return self._evaluate("inverse_dynamics", q=q, v=v, a=a)
        frames, w = self._stacked_wrenches(wrenches)
        return self._evaluate("inverse_dynamics_with_wrenches", frames, axes_named(axes), q=q, v=v, a=a, wrenches=w)

    def forward_dynamics(
        self, q: ArrayLike, v: ArrayLike, tau: ArrayLike, wrenches: Wrenches | None = None, axes: str = ALIGNED
    ) -> Array:
        """Return v̇ = M⁻¹ (τ + τ_passive - nle + Σ Jᵀ w), shape (nv,) or (N, nv).

        `wrenches` on frames and their `axes` are those of `generalized_force`. Under constraints the first call warns
        where the state does not satisfy them; `constraint_residual` tells it of any. Where velocities with dry friction
        are zero, it holds them as Gauss's principle has it, or lets them go (Moreau 1966, Comptes Rendus 262); so do
        joint stops.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> print(dyn.forward_dynamics([0.1, 0.2], [1.0, -2.0], [0.0, 0.0]).round(4))
        [ 1.2275 -5.5282]
        """
        self._warn_if_inconsistent(q, v)
        if wrenches:
            frames, w = self._stacked_wrenches(wrenches)
            acting = frames, axes_named(axes)
            return self._evaluate("forward_dynamics_with_wrenches", *acting, q=q, v=v, tau=tau, wrenches=w)
        return self._evaluate("forward_dynamics", q=q, v=v, tau=tau)

    def stop_forces(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> Array:
        """Return the generalized forces of joint stops under τ, N m or N, shape (nv,) or (N, nv).

        They are above zero at lower stops and below at upper ones, and zero where nothing rests on a stop. A force that
        dry friction of the same joint could hold counts as the stop's. Where joints share them beside constraints, they
        are one solution of many, with a warning.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("block")
        >>> b.add_body("block", mass=2.0)
        >>> b.add_joint("z", "prismatic", parent="world", child="block", axis=(0, 0, 1), lower=0.0, stops=True)
        >>> dyn = mb.dynamics(b.build())
        >>> dyn.forward_dynamics([0.0], [0.0], [1.0]), dyn.stop_forces([0.0], [0.0], [1.0]).round(9)
        (array([0.]), array([18.62]))
        """
        of_state = self._reactions if self.model.constrained else self._evaluate
        return of_state("stop_forces", q=q, v=v, tau=tau)

    def _stop_forces(self, q: Array, v: Array, tau: Array) -> Array:
        return self._jumps.stop_forces(self, q, v, tau)

    def kinetic_energy(self, q: ArrayLike, v: ArrayLike) -> Any:
        """Return ½ vᵀ M v in J, a float or shape (N,).

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> round(dyn.kinetic_energy([0.1, 0.2], [1.0, -2.0]), 4)
        0.5199
        """
        return scalar(self._evaluate("kinetic_energy", q=q, v=v))

    def potential_energy(self, q: ArrayLike) -> Any:
        """Return the energy of gravity and springs in J, a float or shape (N,).

        Gravity's part is zero where every centre of mass is at the world's origin.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> round(dyn.potential_energy([0.1, 0.2]), 4)
        -28.8938
        """
        return scalar(self._evaluate("potential_energy", q=q))

    def visual_model(self, shapes: Kind = "visual") -> Any:
        """Return the engine's own model of what there is to draw, for its viewers; nothing of it acts on the motion.

        Parameters
        ----------
        shapes : {"visual", "collision", "sticks"}
            As in `mbkit.show`.

        Raises
        ------
        UnsupportedError
            An engine without viewers, or a model written as energies.
        """
        raise UnsupportedError(f"{self.engine}: no viewer that takes a model with {shapes} shapes; mbkit.show has one")

    # Derivatives

    @property
    def _why_no_derivatives(self) -> str:
        """Why there are no derivatives of this model; empty where there are."""
        return "it has none; mbkit.dynamics(model, 'lagrangian') has"

    def inverse_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> InverseDynamicsDerivatives:
        """Return the partial derivatives of inverse dynamics: fields q, v and a, each (nv, nv) or (N, nv, nv).

        That by q is along the manifold: column k is d/dt of ``model.integrate(q, t e_k)``, with v and a held.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> by = dyn.inverse_dynamics_derivatives([0.1, 0.2], [1.0, -2.0], [0.5, 0.0])
        >>> bool(abs(by.a - dyn.mass_matrix([0.1, 0.2])).max() < 1e-14)
        True
        """
        return InverseDynamicsDerivatives(*self._derivatives("inverse_dynamics_derivatives", q=q, v=v, a=a))

    def forward_dynamics_derivatives(self, q: ArrayLike, v: ArrayLike, tau: ArrayLike) -> ForwardDynamicsDerivatives:
        """Return the partial derivatives of forward dynamics: fields q, v and tau, each (nv, nv) or (N, nv, nv).

        That by q is along the manifold: column k is d/dt of ``model.integrate(q, t e_k)``, with v and tau held.

        Examples
        --------
        >>> import mbkit as mb
        >>> by = mb.dynamics(mb.catalog.double_pendulum()).forward_dynamics_derivatives([0.1, 0.2], [1, -2], [0, 0])
        >>> by.q.shape, by.v.shape, by.tau.shape
        ((2, 2), (2, 2), (2, 2))
        """
        if self.model.constrained:
            self._require_motion(q, v, tau)
        return ForwardDynamicsDerivatives(*self._derivatives("forward_dynamics_derivatives", q=q, v=v, tau=tau))

    def _derivatives(self, quantity: str, **arguments: ArrayLike) -> list[Array]:
        if reason := self._refuses.get(quantity, self._why_no_derivatives):
            raise UnsupportedError(f"{self.engine} cannot give {quantity}: {reason}")
        out = self._evaluate(quantity, **arguments)
        return [out[..., k, :, :] for k in range(3)]

    def _mass_matrix_rounding(self, q: ArrayLike, quantity: str = "mass_matrix") -> float:
        """Return how far the engine's own formula amplifies rounding in M at one configuration.

        ``Σ |terms| / M_jj`` of the sum that makes the worst diagonal entry, at least 1. `quantity` is M or what is
        computed like it: an engine may take other formulas for M⁻¹ or forward dynamics.

        Examples
        --------
        >>> import mbkit as mb
        >>> dyn = mb.dynamics(mb.catalog.double_pendulum())
        >>> round(dyn._mass_matrix_rounding([0.1, 0.2]), 1)
        1.0
        """
        if not self.model.has_bodies:
            return 1.0
        about = self._inertias_about.get(quantity, self._inertias_about.get("", JOINT))
        return composite_rounding(self, self.model.check_q(q), about)

    # Wrenches behind the force

    def _under(self, frames: tuple[Frame, ...], axes: str) -> Dynamics:
        """Return the same dynamics with wrenches on frames behind τ in that argument: nv + 6 k numbers.

        So whatever holds τ, or asks a function for it, holds the wrenches, while Σ Jᵀ w follows the configuration. For
        `forward_dynamics` and `step` only.
        """
        return WrenchedDynamics(self, frames, axes)

    # Quantities that follow from others

    def _coriolis_force(self, q: Array, v: Array) -> Array:
        return np.asarray((self._coriolis_matrix(q, v) @ v[..., None])[..., 0])

    def _forward_dynamics_derivatives(self, q: Array, v: Array, tau: Array) -> Array:
        by_q, by_v, M = np.moveaxis(self._inverse_dynamics_derivatives(q, v, self._forward_dynamics(q, v, tau)), -3, 0)
        unit = np.broadcast_to(np.eye(M.shape[-1]), M.shape)
        right = np.concatenate([-by_q, -by_v, unit], axis=-1)
        return np.stack(np.split(np.linalg.solve(M, right), 3, axis=-1), axis=-3)

    # Checks and batches

    def _method(self, quantity: str) -> Callable[..., Any]:
        """Return the method for a quantity, with dry friction; raise `UnsupportedError` where there is none."""
        if quantity in OF_THE_WHOLE and self.model.rotors:
            return self._matter._without_jumps(quantity)
        method = self._without_jumps(quantity)
        exact = "jump" in self.model.effects and not (self._soft_jumps and quantity in UNDER_FORCE)
        return self._jumps.beside(quantity, method, self) if exact else method

    def _of_sample(self, i: int) -> Dynamics:  # noqa: ARG002  # for the engine whose samples differ
        """Return the dynamics of one sample of a batch."""
        return self

    def _of_model(self, model: Model, form: str) -> Dynamics:  # noqa: ARG002  # for engines that derive a form once
        """Return the dynamics of another model on this engine, with the same choices; `form` is its form's digest."""
        return type(self)(model)

    def _rounded(self, value: Any) -> Array:
        """Return what the adapter's methods return in double precision."""
        return np.asarray(value, dtype=np.float64)

    @cached_property
    def _matter(self) -> Dynamics:
        """The dynamics of the bodies alone: what else adds to T is no matter."""
        return self._of_model(self.model.without(*that_do("T")), "bodies alone")

    @cached_property
    def _jumps(self) -> Jumps:
        """Dry friction of the model's joints."""
        return Jumps(self.model)

    def _without_jumps(self, quantity: str) -> Callable[..., Any]:
        """Return the adapter's method for a quantity; raise `UnsupportedError` where it has none."""
        group = TABLE[quantity].group if quantity in TABLE else ""
        if group in OF_BODIES:
            self.model.require_bodies(quantity)
        if group in _GATES:
            _GATES[group].admit(self.model, f"{quantity}: not known of")
        method = getattr(self, f"_{quantity}", None)
        if method is None or quantity in self._refuses:
            none = f"{type(self).__name__} has no _{quantity}; mbkit.dynamics(model, 'lagrangian') has"
            reason = self._refuses.get(quantity, none)
            raise UnsupportedError(f"{self.engine} cannot give {quantity}: {reason}")
        if self.model.forces and not self._has_force_elements:
            return self._elements.beside(quantity, method, self)
        return method  # type: ignore[no-any-return]  # by name

    def _lost_force(self, q: Array, v: Array) -> Array:
        """Return the generalized force of functions without a potential, (nv,) or (N, nv), of checked states.

        It is the part of `passive` beside springs and dampers whose work no energy accounts for.
        """
        if not self.model.forces:
            return np.zeros((*np.broadcast_shapes(np.shape(q)[:-1], np.shape(v)[:-1]), self.model.nv))
        return np.asarray(self._elements.lost(self, q, v))

    @cached_property
    def _elements(self) -> CompiledForces:
        """Forces given by functions, compiled; CasADi is loaded for a model that has some."""
        from mbkit.engines.elements.compiled_forces import CompiledForces

        return CompiledForces(self.model)

    def _evaluate(self, quantity: str, *more: Any, **arguments: ArrayLike) -> Array:
        """Return a quantity at states, checked; `more` are arguments that are the same for every state."""
        method = self._method(quantity)
        states, size = self._states(arguments)
        try:
            # Two threads in here would mix their states.
            with self._lock:
                value = self._value(method, [*states.values()], more, size)
                # One state's value may be the engine's own memory.
                out = np.array(value, dtype=np.float64, copy=None if self._batches or size is not None else True)
        except np.linalg.LinAlgError:
            raise NumericalError(
                f"{self.engine}: {quantity} of {self.model.name}: the mass matrix is singular{self._suspects()}"
            ) from None
        self._require_finite(quantity, out, states)
        return out

    def _states(self, arguments: dict[str, ArrayLike]) -> tuple[dict[str, Array], int | None]:
        """Return arguments as checked arrays, all single states or all batches, and the size of the batch."""
        wrenches = arguments.pop("wrenches", None)
        checked = {k: self._checked(k, x) for k, x in arguments.items()}
        if wrenches is not None:
            checked["wrenches"] = np.asarray(wrenches)
        size = batch_of(**checked)
        if size is not None:
            checked = {k: np.broadcast_to(x, (size, x.shape[-1])) for k, x in checked.items()}
        return checked, size

    def _checked(self, name: str, x: ArrayLike) -> Array:
        if name == "q":
            return self.model.check_q(x)
        if name == "tau" and self._acting[0]:
            n = self.model.nv + 6 * len(self._acting[0])
            return rows(name, x, n, "the force with its wrenches", "its size")
        return self.model.check_v(x, name)

    def _value(self, method: Callable[..., Any], states: list[Array], more: tuple[Any, ...], size: int | None) -> Any:
        if self._batches or size is None:
            return method(*states, *more)
        if not size:
            one = method(self.model.neutral(), *(np.zeros(x.shape[1]) for x in states[1:]), *more)
            return np.empty((0, *np.shape(one)))
        return np.array([np.array(method(*row, *more)) for row in zip(*states, strict=True)])

    def _require_finite(self, quantity: str, out: Array, states: dict[str, Array]) -> None:
        if all_finite(out):
            return
        model, index = self.model, tuple(np.argwhere(~np.isfinite(out))[0].tolist())
        sample = f" in sample {index[0]}" if next(iter(states.values())).ndim == 2 else ""
        if model.has_bodies:
            if model.constrained and not self._soft_constraints and "tau" in states:
                i = index[0] if sample else 0
                self._of_sample(i)._require_regular(*(np.atleast_2d(states[k])[i] for k in "qv"))
            where, why = f"index {index}{sample}", self._suspects()
        else:
            q = states["q"][index[0]] if sample else states["q"]
            where = ", ".join(f"{n} = {x:.6g}" for n, x in zip(model.coordinate_names, q, strict=True)) + sample
            # Rows that depend on each other are named.
            model.require_independent(q)
            constraints = ", or the constraints depend on each other," if model.constrained else ""
            why = (
                f"; perhaps the mass matrix is singular{constraints} there, or numbers are so large that they overflow"
            )
        raise NumericalError(f"{self.engine}: {quantity} of {model.name} is not finite at {where}{why}")

    def _suspects(self) -> str:
        """Return what in the model may make numbers that are not finite, for a message."""
        # A joint that moves no mass is the likeliest cause; say it first.
        inconsistent = sorted(self.model.nonphysical, key=lambda pair: "no mass moves" not in pair[1])
        if inconsistent:
            return f"; suspect: {listing([f'{name!r} ({why})' for name, why in inconsistent], MAX_NAMES)}"
        springs = [repr(s.name) for s in self.model.springs if s.needs_direction]
        if springs:
            return (
                f"; possible cause: a point spring with a damper or a rest length has no direction where "
                f"its length is zero: {', '.join(springs[:MAX_NAMES])}"
            )
        discs = [repr(x.name) for x in discs_of(self.model)]
        if discs:
            return f"; possible cause: a disc that lies flat on its plane: {', '.join(discs[:MAX_NAMES])}"
        return "; perhaps links without mass, or numbers so large that they overflow"


class WrenchedDynamics(Dynamics):
    """`Dynamics._under` of an engine, by its own Jacobians."""

    _takes_parameters = _has_force_elements = True
    _bare: Dynamics

    def __init__(self, dyn: Dynamics, frames: tuple[Frame, ...], axes: str) -> None:
        self._bare, self._acting, self._path = dyn, (frames, axes), dyn._path
        self._soft_constraints, self._soft_jumps = dyn._soft_constraints, dyn._soft_jumps
        self._soft_limits = dyn._soft_limits
        super().__init__(dyn.model)
        self._forward_dynamics = dyn._method("forward_dynamics")
        dyn._method("jacobian")

    @property
    def engine(self) -> str:  # type: ignore[override]  # that of another
        """Name of the engine."""
        return self._bare.engine

    def at(self, /, **values: Any) -> Dynamics:
        return WrenchedDynamics(self._bare.at(**values), *self._acting)

    def forward_dynamics(
        self,
        q: ArrayLike,
        v: ArrayLike,
        tau: ArrayLike,
        wrenches: Wrenches | None = None,
        axes: str = ALIGNED,  # noqa: ARG002  # the wrenches are in tau
    ) -> Array:
        assert not wrenches
        force, n = np.asarray(tau), self.model.nv
        states = {"q": q, "v": v, "tau": force[..., :n], "wrenches": force[..., n:]}
        return self._bare._evaluate("forward_dynamics_with_wrenches", *self._acting, **states)


def applied(A: Array, x: Array) -> Array:
    """Return A x, of one state or a stack of them."""
    return np.asarray((A @ x[..., None])[..., 0])


class MappedDynamics(FrameByFrame, Dynamics):
    """An engine with velocities of its own, v_engine = T v.

    Entry i is full velocity `_v_index[i]`; then rotations, set with each state or stack of them, turn three entries
    each. T is orthogonal, so forces map as velocities do.
    """

    _batches = False
    _v_index: np.ndarray
    _turned: list[tuple[Array, slice]]

    @classmethod
    def holding(cls, model: Model, compiled: Any) -> Self:
        """Return the dynamics of what the engine compiled of a model elsewhere."""
        out = object.__new__(cls)
        out._take(model)
        out._hold(compiled)
        return out

    def _hold(self, compiled: Any) -> None:
        """Take what the engine compiled of the model, with its coordinates."""
        raise NotImplementedError

    def _to_engine(self, x: Array) -> Array:
        """Return T x for velocities, accelerations or forces, (..., nv)."""
        # NumPy takes entries of the first axis in half the time of those behind an ellipsis.
        out: Array = self.model.layout.expand_v(x).T[self._v_index].T
        for R, part in self._turned:
            out[..., part] = applied(R, out[..., part])
        return out

    def _columns(self, J: Array) -> Array:
        """Return J T, (..., k, nv), in the description's order and reduced."""
        full = np.empty_like(J)
        if self._turned:
            J = J.copy()
        for R, part in self._turned:
            J[..., part] = J[..., part] @ R
        full.T[self._v_index] = J.T
        return np.asarray(full @ self.model.layout.G) if self.model.layout.reduced else full

    def _force(self, f: Array) -> Array:
        if self._turned or self.model.layout.reduced:
            return np.asarray(self._columns(f[..., None, :])[..., 0, :])
        out = np.empty_like(f)
        out.T[self._v_index] = f.T
        return out


_X, _Y, _Z = np.eye(3)
#: Joint type -> type and axis of each joint of a stack of one-coordinate joints with the same motion.
STACKS: Final[dict[str, Callable[[Joint], list[tuple[str, Array]]]]] = {
    **dict.fromkeys(("revolute", "continuous"), lambda joint: [("revolute", joint.axes[0])]),
    "prismatic": lambda joint: [("prismatic", joint.axes[0])],
    "universal": lambda joint: [("revolute", axis) for axis in joint.axes],
    "spherical_zyx": lambda _: [("revolute", axis) for axis in (_Z, _Y, _X)],
    "planar": lambda _: [("prismatic", _X), ("prismatic", _Y), ("revolute", _Z)],
}


def no_dynamics(value: Any, name: str = "dyn") -> InputError:
    """Return the error for an argument that is no `Dynamics`, with the call that makes one."""
    own = not isinstance(value, type) and callable(getattr(value, "dynamics", None))
    way = "its .dynamics() makes one" if own else "mbkit.dynamics(model, engine) makes one"
    return InputError(f"{name}: expected a Dynamics, got {type(value).__name__}; {way}")


# Dynamics that depend on the time: the time is one of their model's parameters.


def at_time(dyn: _Dynamics, t: float | Array) -> _Dynamics:
    """Return the dynamics at a time, or at that of each sample; the same ones where time does not enter."""
    clock = dyn.model.time_parameter
    return dyn if clock is None else dyn.at(**{clock: t})  # type: ignore[return-value]  # of its own kind


def at_times(dyn: _Dynamics, t: Array, trajectories: int | None = None) -> _Dynamics:
    """Return the dynamics with a sample for each time of a run, of each trajectory of a batch, where time enters."""
    clock = dyn.model.time_parameter
    if clock is None:
        return dyn
    if not dyn._takes_parameters:
        raise UnsupportedError(f"{dyn.engine}: holds one time; evaluate along a run with the lagrangian engine")
    own = dyn
    if trajectories is not None and dyn._samples is not None:
        own = dyn._of_samples(np.repeat(np.arange(trajectories), len(t)))  # type: ignore[assignment]
    return own.at(**{clock: np.tile(t, trajectories or 1)})  # type: ignore[return-value]
