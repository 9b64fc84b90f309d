"""Pinocchio behind the protocol: CRBA for M, RNEA for nle, ABA for forward dynamics.

Carpentier et al. 2019, "The Pinocchio C++ library"; the algorithms are those of
Featherstone 2008, ch. 5 to 7. Single states go straight to Pinocchio.

Pinocchio's regressors in the description's parameters.

Pinocchio merges bodies that fixed joints hold. The pseudo-inertia of one is X J Xᵀ in the frame that its carrier's
joint moves, X being its pose there, so that each of its columns is a combination of its carrier's ten. These stand as
m, hx, hy, hz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz (`pinocchio.Inertia.toDynamicParameters`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from functools import cached_property
from math import hypot, isfinite
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
import pinocchio as pin

from mbkit._check import EPS, TWO_TURNS, Array
from mbkit.engines import known_defects
from mbkit.engines.base import MAX_NAMES, Dynamics
from mbkit.engines.elements.passive import JointPassive
from mbkit.engines.frames_and_momenta import ALIGNED, WORLD
from mbkit.engines.pinocchio.bodies import PinocchioBodies
from mbkit.engines.pinocchio.constraints import PinConstraints, PinocchioConstrained
from mbkit.engines.pinocchio.model import (
    FORWARD_DERIVATIVES,
    INVERSE_DERIVATIVES,
    PINOCCHIO,
    PinModel,
    PointSprings,
    build,
)
from mbkit.engines.regressors import with_joints
from mbkit.model import Model
from mbkit.model.base_parameters import STANDARD, RegressorColumns, parameters_of, pseudo_inertia
from mbkit.model.manifold import NEAR_UNIT
from mbkit.model.validation import listing

if TYPE_CHECKING:
    from mbkit.show import Kind


#: Where each of Pinocchio's parameters stands among the standard ones.
_ORDER: Final = tuple(map(STANDARD.index, ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz")))
_SIZE: Final = len(STANDARD)


class PinRegressors:
    """Regressors of all standard parameters, in Pinocchio's velocities.

    Its `_map` has Pinocchio's parameters in its rows, the description's in its columns.
    """

    def __init__(self, description: Model, maps: PinModel, data: Any) -> None:
        self._description, self._maps, self._m, self._d = description, maps, maps.model, data

    @cached_property
    def _map(self) -> Array:
        bodies = [self._maps.bodies[joint.child] for joint in self._description.tree]
        out = np.zeros((_SIZE * self._m.njoints, _SIZE * len(bodies)))
        for k, (carrier, R, p) in enumerate(bodies):
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = R, p
            moved = parameters_of(X @ pseudo_inertia(np.eye(_SIZE)) @ X.T).T
            out[_SIZE * carrier : _SIZE * (carrier + 1), _SIZE * k : _SIZE * (k + 1)] = moved[_ORDER, :]
        return out

    @cached_property
    def _ground(self) -> Array:
        """The potential energy of units of parameters of bodies at rest, which Pinocchio leaves out."""
        return np.asarray(-self._description.gravity @ self._map[1:4])

    def torques(self, q: Array, v: Array, a: Array) -> Array:
        """Return Y(q, v, a)."""
        # One row comes back as a vector.
        own = pin.computeJointTorqueRegressor(self._m, self._d, q, v, a).reshape(
            self._m.nv, _SIZE * (self._m.njoints - 1)
        )
        return np.asarray(own @ self._map[_SIZE:])

    def momentum(self, q: Array, v: Array) -> Array:
        """Return Y(q, v) of the momentum: the forces of accelerations v at rest, without gravity."""
        still = np.zeros(self._m.nv)
        return self.torques(q, still, v) - self.torques(q, still, still)

    def energies(self, q: Array, v: Array) -> Array:
        """Return Y(q, v) of kinetic and potential energy."""
        kinetic = pin.computeKineticEnergyRegressor(self._m, self._d, q, v) @ self._map[_SIZE:]
        potential = pin.computePotentialEnergyRegressor(self._m, self._d, q) @ self._map[_SIZE:]
        return np.vstack([kinetic, potential + self._ground])


# Calls for one state, with the fewest checks that are safe
#
# Arguments have to be plain vectors of native doubles: Pinocchio reads the memory of a byte-swapped array, and the data
# of a masked one, as if they were such vectors. One sum finds NaN and infinity in the answer, and so in the arguments;
# Pinocchio itself objects to wrong sizes. On any doubt the checked method of `Dynamics` takes over: it converts the
# arguments, or names their fault.

Call = Callable[..., Any]
Sound = Callable[[Array], bool]
#: Quantities with such a call, their arguments as in `Dynamics`, and Pinocchio's function of these arguments.
_DIRECT: Final[dict[str, tuple[str, Call]]] = {
    "mass_matrix": ("q", pin.crba),
    "gravity": ("q", pin.computeGeneralizedGravity),
    "nle": ("q, v", pin.nonLinearEffects),
    "inverse_dynamics": ("q, v, a", pin.rnea),
    "forward_dynamics": ("q, v, tau", pin.aba),
}


def _factory(name: str, arguments: str) -> Callable[[Call, Call, Sound, Call], Call]:
    """Return a function (bare, checked, sound, look) -> call; a common one with *arguments would cost 0.3 µs a call."""
    # Wrenches on frames go the checked way.
    loads = arguments.count(",") == 2
    plain = "wrenches is None and " * loads + " and ".join(
        f"type({x}) is ndarray and {x}.dtype == double and {x}.ndim == 1" for x in arguments.split(", ")
    )
    finite = "(x := out.ravel('K')).dot(x) < inf" if name == "mass_matrix" else "isfinite(sum(out.tolist()))"
    text = f"""
def factory(bare, checked, sound, look):
    def {name}({arguments}{", wrenches=None, axes=" + repr(ALIGNED) if loads else ""}):
        try:
            if {plain}:
                out = bare({arguments})
                if {finite} and sound(q):
                    if hypot(*q.tolist()) > far:
                        look(q)
                    return out
        except Exception:  # Pinocchio's own errors vary; the checked way words them
            pass
        return checked({arguments}{", wrenches, axes" if loads else ""})
    return {name}
"""
    scope: dict[str, Any] = {"ndarray": np.ndarray, "double": np.dtype(float), "inf": np.inf, "isfinite": isfinite}
    scope |= {"far": TWO_TURNS, "hypot": hypot}
    scope["__name__"] = __name__
    exec(text, scope)
    factory: Callable[[Call, Call, Sound, Call], Call] = scope["factory"]
    return factory


_FACTORIES: Final = {name: _factory(name, arguments) for name, (arguments, _) in _DIRECT.items()}


def _unread(state: Array, term: Call) -> set[int]:
    """Return the entries of a state in which a NaN leaves a term finite."""
    out = set()
    for i in range(state.size):
        state[i], before = np.nan, state[i]
        if not np.isnan(term()).any():
            out.add(i)
        state[i] = before
    return out


def _sound(model: Model, unread: set[int]) -> Sound:
    """Return a check of what the answer does not show: unread coordinates and quaternions."""
    starts = tuple(start for start, _ in model.quaternions)
    # A quaternion with a NaN is not of unit length.
    rest = unread - {start + k for start in starts for k in range(4)}
    if not rest and not starts:
        return lambda _: True
    if starts == (3,) and rest <= {0, 1, 2}:
        # A floating base: position, then quaternion.
        def floating(q: Array) -> bool:
            a, b, c, x, y, z, w = q[:7].tolist()
            return bool(-NEAR_UNIT < x * x + y * y + z * z + w * w - 1.0 < NEAR_UNIT and isfinite(a + b + c))

        return floating

    def sound(q: Array) -> bool:
        quaternions = (q[k : k + 4] for k in starts)
        return all(abs(x.dot(x) - 1.0) < NEAR_UNIT for x in quaternions) and isfinite(sum(q.tolist()))

    return sound


class PinocchioDynamics(PinocchioBodies, PinocchioConstrained, Dynamics):
    """Pinocchio's algorithms on a description.

    Attributes
    ----------
    pin_model : pinocchio.Model
        The model that was built, with a frame for each body and each frame of the description; free to read.
    """

    engine = "pinocchio"
    _refuses: ClassVar[dict[str, str]] = {
        "constraint_rate_gradient": "its derivatives are of trees; mbkit.dynamics(model, 'lagrangian') has this one",
    }
    _path = PINOCCHIO
    _takes_wrenches = ("inverse_dynamics", "forward_dynamics")
    # computeMinverse
    _inertias_about: ClassVar[dict[str, str]] = {"mass_matrix_inverse": WORLD}
    _batches = False

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        given = {
            "inverse_dynamics_derivatives": INVERSE_DERIVATIVES,
            "forward_dynamics_derivatives": FORWARD_DERIVATIVES,
        }
        # These are of this model alone, in the place of the class's.
        vars(self)["_refuses"] = self._refuses | {
            name: why for name, path in given.items() if (why := path.refuses(model))
        }
        self._pin: PinModel = build(model)
        self.pin_model = self._m = self._pin.model
        self._d = self._m.createData()
        self._joint_passive = JointPassive(model, self._pin.q_order, self._pin.v_order)
        self._springs = PointSprings(model, self._pin) if model.springs else None
        layout = model.layout
        self._reduced = layout.reduced
        #: Whether q and v go to Pinocchio as they are; else as G_q q + c and G v.
        self._direct = self._pin.ordered and not self._reduced
        self._G_q, self._c = layout.G_q[self._pin.q_order], layout.offsets[self._pin.q_order]
        self._G = layout.G[self._pin.v_order]
        self._Gt = np.ascontiguousarray(self._G.T)
        self._placements: dict[str, tuple[int, pin.SE3]] = {}
        if model.constrained:
            rotors = self._joint_passive.rotors is not None
            self._held = PinConstraints(model, self._pin, None if self._direct else self._G, rotors)
        # A class that derives from this one may have methods of its own.
        if type(self) is PinocchioDynamics:
            self._install_direct_calls()
        if tiny := self._tiny_bodies():
            known_defects.announce(known_defects.TINY_MASS, f"the mass of body {tiny}")

    def _locked(self, method: Call) -> Call:
        lock = self._lock

        def call(*states: Array) -> Any:
            with lock:
                return method(*states)

        return call

    def _install_direct_calls(self) -> None:
        """Put calls for one state in the place of this object's methods."""
        # One call of Pinocchio's holds the interpreter's lock, and needs no other on data that nothing else uses.
        m, d, needs, damping = self._m, self._m.createData(), self.model.needs, self._joint_passive.damping
        bare: dict[str, Call] = {name: self._locked(getattr(self, f"_{name}")) for name in _DIRECT}
        # The product G_q q spreads a NaN to every coordinate.
        unread: dict[str, set[int]] = {}
        if self._direct:
            q, v, zero = self.model.neutral(), np.zeros(m.nv), np.zeros(m.nv)
            for name, (arguments, function) in _DIRECT.items():
                term = functools.partial(function, m, d, *(q, v, zero)[: arguments.count(",") + 1])
                unread[name] = _unread(q, term)
                if "v" in arguments and _unread(v, term):
                    # A lone slide: nothing depends on v, so it must be looked at.
                    return
            own = {name: functools.partial(function, m, d) for name, (_, function) in _DIRECT.items()}
            if needs.springs or needs.damping:
                rnea, aba = own.pop("inverse_dynamics"), own.pop("forward_dynamics")
                if not (needs.springs or self.model.springs or self.model.couplings):
                    bare["inverse_dynamics"] = lambda q, v, a: rnea(q, v, a) + damping * v
                    bare["forward_dynamics"] = lambda q, v, tau: aba(q, v, tau - damping * v)
            if self._joint_passive.rotors is not None:
                own = {name: own[name] for name in ("gravity", "nle")}
            bare |= own
        if self.model.forces or "jump" in self.model.effects:
            # They are added the checked way.
            del bare["inverse_dynamics"], bare["forward_dynamics"]
        elif self.model.constrained:
            # States that are open, or on another branch, are told the checked way.
            del bare["forward_dynamics"]
        for name, call in bare.items():
            checked = getattr(self, name)
            sound = _sound(self.model, unread.get(name, set()))
            direct = _FACTORIES[name](call, checked, sound, lambda q: self.model._look_for_degrees(q))
            vars(self)[name] = functools.update_wrapper(direct, checked)

    def _method(self, quantity: str) -> Callable[..., Any]:
        if quantity.startswith("coriolis") and self._coriolis_fault:
            known_defects.announce(known_defects.CORIOLIS, self._coriolis_fault)
        if quantity == "kinetic_energy" and self._kinetic_fault:
            known_defects.announce(known_defects.KINETIC_ENERGY, self._kinetic_fault)
        if quantity in ("jacobian_dot_v", "centroidal_momentum_bias") and self._rate_fault:
            known_defects.announce(known_defects.JACOBIAN_RATE, self._rate_fault)
        return super()._method(quantity)

    def visual_model(self, shapes: Kind = "visual") -> pin.GeometryModel:
        """Return Pinocchio's model of the shapes to draw, for `pin_model` and its viewers; no pair of them collides."""
        # Imported late: few scripts draw.
        from mbkit.engines.pinocchio.model import geometry
        from mbkit.show import shapes_of

        return geometry(self._pin, shapes_of(self.model, shapes))

    def at(self, /, **values: Any) -> Dynamics:
        """Return the same dynamics at other values of the model's named parameters; the time alone builds nothing."""
        out = super().at(**values)
        if self.model.constrained and isinstance(out, PinocchioDynamics):
            out._held = out._held.at(out.model.time)
        return out

    # Between the description's coordinates and Pinocchio's.

    def _full_q(self, q: Array) -> Array:
        return q if self._direct else self._G_q.dot(q) + self._c

    def _full_v(self, v: Array) -> Array:
        return v if self._direct else self._G.dot(v)

    def _force(self, f: Array) -> Array:
        return f if self._direct else self._Gt.dot(f)

    def _matrix(self, A: Array) -> Array:
        return A if self._direct else self._Gt.dot(A).dot(self._G)

    # Terms at one state.

    def _mass_matrix(self, q: Array) -> Array:
        return self._matrix(self._full_mass_matrix(self._full_q(q)))

    def _full_mass_matrix(self, q: Array) -> Array:
        M: Array = pin.crba(self._m, self._d, q)
        rotors = self._joint_passive.rotors
        return M if rotors is None else M + rotors

    def _mass_matrix_inverse(self, q: Array) -> Array:
        if self._reduced or self._joint_passive.rotors is not None:
            return super()._mass_matrix_inverse(q)
        return self._matrix(pin.computeMinverse(self._m, self._d, self._full_q(q)))

    def _gravity(self, q: Array) -> Array:
        return self._force(pin.computeGeneralizedGravity(self._m, self._d, self._full_q(q)))

    def _nle(self, q: Array, v: Array) -> Array:
        return self._force(pin.nonLinearEffects(self._m, self._d, self._full_q(q), self._full_v(v)))

    def _inverse_dynamics(self, q: Array, v: Array, a: Array, *acting: Any) -> Array:
        q, v = self._full_q(q), self._full_v(v)
        a, rotors = self._full_v(a), self._joint_passive.rotors
        out: Array = pin.rnea(self._m, self._d, q, v, a, *self._outside(q, *acting))
        out -= self._full_passive(q, v)
        if rotors is not None:
            out += rotors @ a
        return self._force(out)

    def _forward_dynamics(self, q: Array, v: Array, tau: Array, *acting: Any) -> Array:
        if self.model.constrained:
            return self._constrained_motion(q, v, tau + self._generalized_force(q, *acting) if acting else tau)
        if self._reduced or self._joint_passive.rotors is not None:
            # ABA knows neither mimic joints nor rotors between joints.
            return self._solved_motion(q, v, tau, *acting)
        q, v = self._full_q(q), self._full_v(v)
        # G only puts the joints in order, so its transpose puts them back.
        force = self._full_v(tau) + self._full_passive(q, v)
        return self._force(pin.aba(self._m, self._d, q, v, force, *self._outside(q, *acting)))

    def _full_passive(self, q: Array, v: Array) -> Array:
        out = self._joint_passive.force(q, v)
        if self._springs is not None:
            out += self._springs.force(self._m, self._d, q, v)
        return out

    def _passive(self, q: Array, v: Array) -> Array:
        return self._force(self._full_passive(self._full_q(q), self._full_v(v)))

    @cached_property
    def _why_no_derivatives(self) -> str:
        """Why there are no derivatives of this model; empty where there are."""
        return self._refuses.get("inverse_dynamics_derivatives", "")

    def _inverse_dynamics_derivatives(self, q: Array, v: Array, a: Array) -> Array:
        passive = self._joint_passive
        q, v, a = self._full_q(q), self._full_v(v), self._full_v(a)
        by_q, by_v, M = pin.computeRNEADerivatives(self._m, self._d, q, v, a)
        by_q, by_v = by_q + passive.stiffness_matrix, by_v + passive.damping_matrix
        M = M if passive.rotors is None else M + passive.rotors
        return np.stack([self._matrix(x) for x in (by_q, by_v, M)])

    def _forward_dynamics_derivatives(self, q: Array, v: Array, tau: Array) -> Array:
        passive = self._joint_passive
        if self._reduced or passive.rotors is not None:
            return super()._forward_dynamics_derivatives(q, v, tau)
        q, v = self._full_q(q), self._full_v(v)
        force = self._full_v(tau) + passive.force(q, v)
        by_q, by_v, inverse = pin.computeABADerivatives(self._m, self._d, q, v, force)
        by_q, by_v = by_q - inverse @ passive.stiffness_matrix, by_v - inverse @ passive.damping_matrix
        return np.stack([self._matrix(x) for x in (by_q, by_v, inverse)])

    def _coriolis_matrix(self, q: Array, v: Array) -> Array:
        return self._matrix(pin.computeCoriolisMatrix(self._m, self._d, self._full_q(q), self._full_v(v)))

    def _kinetic_energy(self, q: Array, v: Array) -> Any:
        q, v, rotors = self._full_q(q), self._full_v(v), self._joint_passive.rotors
        own = pin.computeKineticEnergy(self._m, self._d, q, v)
        return own if rotors is None else own + 0.5 * float(v @ rotors @ v)

    def _potential_energy(self, q: Array) -> Any:
        q = self._full_q(q)
        stored = self._joint_passive.energy(q)
        if self._springs is not None:
            stored += self._springs.energy(self._m, self._d, q)
        ground = -float(self.model.gravity @ self._pin.ground_moment)
        return pin.computePotentialEnergy(self._m, self._d, q) + stored + ground

    @cached_property
    def _regressors(self) -> PinRegressors:
        return PinRegressors(self.model, self._pin, self._d)

    def _regressor(self, q: Array, v: Array, a: Array, columns: RegressorColumns) -> Array:
        Y = self._regressors.torques(self._full_q(q), self._full_v(v), self._full_v(a))
        return with_joints(self._reduced_rows(Y), columns, v, a)

    def _momentum_regressor(self, q: Array, v: Array, columns: RegressorColumns) -> Array:
        Y = self._regressors.momentum(self._full_q(q), self._full_v(v))
        return with_joints(self._reduced_rows(Y), columns, v, v)

    def _energy_regressor(self, q: Array, v: Array, columns: RegressorColumns) -> Array:
        Y = self._regressors.energies(self._full_q(q), self._full_v(v))[:, list(columns.bodies)]
        rotors = np.concatenate([np.zeros(0), *(0.5 * x[which] ** 2 for x, which in columns.of_rates(T=v))])
        return np.hstack([Y, np.vstack([rotors, 0.0 * rotors])])

    def _reduced_rows(self, Y: Array) -> Array:
        return Y if self._direct else self._Gt @ Y

    # Known defects, measured on this very model.

    def _tiny_bodies(self) -> str:
        """Return the names of bodies so light that Pinocchio's sum of inertias, and so M, is wrong."""
        out = []
        for body in self.model.bodies:
            if 0 < body.mass < EPS:
                one = pin.Inertia(body.mass, np.array([1.0, 0.0, 0.0]), np.zeros((3, 3)))
                out += [repr(body.name)] if abs((one + one).lever[0] - 1) > 1e-9 else []
        return listing(out, MAX_NAMES)

    @cached_property
    def _coriolis_fault(self) -> str:
        """Where C v + g is not nle; empty where it is."""

        def wrong(q: Array, v: Array) -> bool:
            C = pin.computeCoriolisMatrix(self._m, self._d, q, v)
            h = pin.nonLinearEffects(self._m, self._d, q, v)
            g = pin.computeGeneralizedGravity(self._m, self._d, q)
            # Without ‖M‖‖v‖² the rounding of a symmetric rotor, which has no such forces, would count.
            scale = np.abs(h).max() + np.abs(g).max() + np.abs(pin.crba(self._m, self._d, q)).max() * float(v @ v)
            return bool(np.abs(C @ v + g - h).max() > 1e-9 * scale)

        return self._joints_of(wrong)

    @cached_property
    def _kinetic_fault(self) -> str:
        """Where the kinetic energy is not ½ vᵀ M v; empty where it is."""
        if self._tiny_bodies():
            return ""  # M is wrong then, which is another defect

        def wrong(q: Array, v: Array) -> bool:
            M = pin.crba(self._m, self._d, q)
            off = abs(pin.computeKineticEnergy(self._m, self._d, q, v) - 0.5 * float(v @ M @ v))
            return bool(off > 1e-11 * float(np.abs(v) @ np.abs(M) @ np.abs(v)))

        return self._joints_of(wrong)

    def _joints_of(self, wrong: Callable[[Array, Array], bool]) -> str:
        """Return for which joints' motion a value is wrong, at a random state; empty where it is right.

        Each joint is moved alone too: what it adds may be small beside the rest.
        """
        if not self.model.nv:
            return ""
        q, v = self.model.random_state(np.random.default_rng(1))
        q, v = self._full_q(q), self._full_v(v)
        places, order = self.model.layout.full_v, self._pin.v_order
        alone = [
            repr(joint.name)
            for joint in self.model.tree
            if wrong(q, np.where(np.isin(order, np.arange(order.size)[places[joint.name]]), v, 0.0))
        ]
        if alone:
            return f"joint {', '.join(alone)}"
        return "several joints that move together" if wrong(q, v) else ""
