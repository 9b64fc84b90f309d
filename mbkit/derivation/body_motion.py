"""Motion, momentum and loads of single bodies and of the whole, as CasADi expressions.

Everything follows from twists (v, ω), each body's linear and angular velocity at its origin in its own axes, and from
momenta; rates are exact derivatives along (D v, a), so that no acceleration is written down apart.

**Loads**. Free all six directions of a joint. The momentum that belongs to them, ∂T/∂ν, is that of all that the joint
carries: P linear and L angular about the child's origin, in the child's axes. Hamel's equations for the six velocities
(Greenwood 2003, Advanced Dynamics, ch. 4.3) give the forces that hold them at zero, which are the joint's load::

    f = dP/dt + ω × P - Σ f_ext            n = dL/dt + ω × L + v × P - Σ n_ext

Gravity, point springs and applied wrenches are the external forces. Projected on the directions that the joint has,
the load is τ + τ_passive of the joint, without the force that its rotor takes.

Regressors: torques, momentum and energies as linear functions of the inertial parameters of the bodies.

A body with mass m, first moment h = m c and inertia I about the origin of its frame takes a wrench that is linear in
these ten parameters. With the acceleration a of the origin less gravity and the angular velocity ω, in the body's axes
(Khalil and Dombre 2002, Modeling, Identification and Control of Robots, ch. 12.3)::

    force   m a + ω̇ × h + ω × (ω × h)
    moment  h × a + I ω̇ + ω × I ω

By d'Alembert's principle in Lagrange's form τ = Σ Jᵀ A π, with the Jacobian J of the velocity of the body's frame and
the matrix A (6, 10) of this wrench. The kinetic energy ½ m v² + h · (v × ω) + ½ ω · I ω gives the momentum by its
derivative, and the potential energy of gravity is -g · (m p + R h). J, v and ω are those of the kinematics, and
accelerations one directional derivative along (D v, v̇).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, NamedTuple

import casadi as ca

from mbkit.derivation.kinematics import Kinematics, Vector, add, constant_times, constant_transposed_times
from mbkit.derivation.links import Inertia
from mbkit.derivation.model_values import is_zero, scalar
from mbkit.derivation.rotations import SYMMETRIC, Matrix
from mbkit.model.base_parameters import PAIRS, STANDARD, RegressorColumns
from mbkit.model.joint_types import cross3, dot3
from mbkit.model.quantities import QUANTITIES, of_groups

_SIZE: Final = len(STANDARD)
_UNITS: Final[list[Vector]] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


@dataclass
class _Motion:
    """Velocity of a body's frame, its rate without gravity, and its Jacobian's columns, in the body's axes."""

    velocity: Vector
    spin: Vector
    acceleration: Vector
    spin_rate: Vector
    #: Index of a velocity, with the linear and the angular part of its column.
    columns: list[tuple[int, Vector, Vector]]

    def wrenches(self) -> list[tuple[Vector, Vector]]:
        """Return force and moment of a unit of each parameter: the columns of A."""
        a, w, rate = self.acceleration, self.spin, self.spin_rate
        inertias = [([0.0] * 3, add(_times(pair, rate), cross3(w, _times(pair, w)))) for pair in PAIRS]
        moments = [(add(cross3(rate, e), cross3(w, cross3(w, e))), cross3(e, a)) for e in _UNITS]
        return [*inertias, *moments, (a, [0.0] * 3)]

    def momenta(self) -> list[tuple[Vector, Vector]]:
        """Return linear and angular momentum of a unit of each parameter, about the body's origin."""
        v, w = self.velocity, self.spin
        inertias = [([0.0] * 3, _times(pair, w)) for pair in PAIRS]
        return [*inertias, *((cross3(w, e), cross3(e, v)) for e in _UNITS), (v, [0.0] * 3)]

    def kinetic_energies(self) -> Vector:
        """Return the kinetic energy of a unit of each parameter."""
        v, w = self.velocity, self.spin
        return [*(0.5 * dot3(w, _times(pair, w)) for pair in PAIRS), *cross3(v, w), 0.5 * dot3(v, v)]


def torque_regressor(kin: Kinematics, a: ca.SX, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v, a), nv rows, of the forces τ = Y π; a are the rates of v."""
    inertial = _by_velocity(kin, _motions(kin, columns.bodies, a), _Motion.wrenches, columns.bodies)
    own = columns.of_rates(loss=kin.v, jump=ca.sign(kin.v), T=a)
    return ca.horzcat(inertial, *(_columns_of(*x) for x in own))


def momentum_regressor(kin: Kinematics, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v), nv rows, of the generalized momentum ∂T/∂v = Y π."""
    inertial = _by_velocity(kin, _motions(kin, columns.bodies), _Motion.momenta, columns.bodies)
    return ca.horzcat(inertial, *(_columns_of(*x) for x in columns.of_rates(T=kin.v)))


def energy_regressor(kin: Kinematics, columns: RegressorColumns) -> Any:
    """Return the matrix Y(q, v) of two rows, T = Y₀ π and gravity's V = Y₁ π."""
    motions, down = _motions(kin, columns.bodies), _gravity(kin)
    bodies = [joint.child for joint in kin.model.tree]
    kinetic, potential = [], []
    for index, kind in (divmod(k, _SIZE) for k in columns.bodies):
        kinetic.append(motions[index].kinetic_energies()[kind] if index in motions else 0.0)
        heights = [*([0.0] * len(PAIRS)), *(-x for x in down[bodies[index]])]
        if kind == len(heights):
            heights.append(-dot3(kin.values.gravity, kin.to_world(bodies[index], [0.0] * 3)))
        potential.append(heights[kind])
    rotors = [0.5 * v[k] ** 2 for v, which in columns.of_rates(T=kin.v) for k in which]
    kinetic, potential = kinetic + rotors, potential + [0.0] * len(rotors)
    return ca.vertcat(_row(kinetic), _row(potential))


def _columns_of(x: ca.SX, which: Sequence[int]) -> Any:
    """Return these columns of a diagonal matrix."""
    return ca.diag(x)[:, list(which)] if which else ca.SX(x.numel(), 0)


def _by_velocity(
    kin: Kinematics,
    motions: dict[int, _Motion],
    of: Callable[[_Motion], list[tuple[Vector, Vector]]],
    columns: Sequence[int],
) -> Any:
    """Return Jᵀ times what a unit of each parameter gives."""
    pairs = {index: of(motion) for index, motion in motions.items()}
    entries: list[Any] = []
    for index, kind in (divmod(k, _SIZE) for k in columns):
        column: list[Any] = [0.0] * kin.model.nv
        if index in motions:
            force, moment = pairs[index][kind]
            for k, linear, angular in motions[index].columns:
                column[k] = dot3(linear, force) + dot3(angular, moment)
        entries += column
    return ca.reshape(_row(entries), kin.model.nv, len(columns))


def _row(entries: list[Any]) -> Any:
    return ca.horzcat(ca.SX(1, 0), *entries)


def _motions(kin: Kinematics, columns: Sequence[int], a: ca.SX | None = None) -> dict[int, _Motion]:
    """Return the motions of the bodies that have these parameters, by their index; those at rest are left out."""
    bodies = [joint.child for joint in kin.model.tree]
    indices = sorted({k // _SIZE for k in columns})
    moving = [k for k in indices if not all(is_zero(x) for half in kin.twists[bodies[k]] for x in half)]
    twists = ca.vertcat(ca.SX(0, 1), *(ca.SX(x) for k in moving for half in kin.twists[bodies[k]] for x in half))
    J = ca.jacobian(twists, kin.v)
    rates = ca.SX(twists.numel(), 1)
    down = _gravity(kin)
    if a is not None:
        rates = ca.jtimes(twists, ca.vertcat(kin.q, kin.v), ca.vertcat(kin.qdot, a))
    columns_of: dict[int, dict[int, Vector]] = {}
    for i, k in zip(*J.sparsity().get_triplet(), strict=True):
        columns_of.setdefault(i // 6, {}).setdefault(k, [0.0] * 6)[i % 6] = scalar(J[i, k])
    out = {}
    for at, index in enumerate(moving):
        v, w = kin.twists[bodies[index]]
        rate = [_entry(rates[6 * at + i]) for i in range(6)]
        acceleration = [x - y for x, y in zip(add(rate[:3], cross3(w, v)), down[bodies[index]], strict=True)]
        own = [(k, x[:3], x[3:]) for k, x in sorted(columns_of.get(at, {}).items())]
        out[index] = _Motion(v, w, acceleration, rate[3:], own)
    return out


def _gravity(kin: Kinematics) -> dict[str, Vector]:
    """Return the acceleration of gravity in the axes of every body."""
    out: dict[str, Vector] = {"world": kin.values.gravity}
    for joint in kin.model.tree:
        out[joint.child] = kin.from_parent(joint, out[joint.parent])
    return out


def _times(pair: tuple[int, int], x: Vector) -> Vector:
    """Return I x of an inertia with a one at this place, and at that across the diagonal."""
    i, j = pair
    out: Vector = [0.0] * 3
    out[i], out[j] = x[j], x[i]
    return out


def _entry(x: Any) -> Any:
    return 0.0 if x.is_zero() else scalar(x)


#: Linear and angular part.
Pair = tuple[Vector, Vector]


class BodyMotion:
    """What bodies and frames do at q, v and a.

    Parameters
    ----------
    kin : Kinematics
    a : casadi.SX
        Accelerations, v̇.
    """

    def __init__(self, kin: Kinematics, a: ca.SX) -> None:
        self.kin, self.model, self.a = kin, kin.model, a

    def rate(self, x: Any, a: Any) -> Any:
        """Return dx/dt of an expression of q and v along (D v, a)."""
        return ca.jtimes(x, ca.vertcat(self.kin.q, self.kin.v), ca.vertcat(self.kin.qdot, a))

    # Frames

    def _place(self, name: str) -> tuple[str, Any]:
        frame = self.model.frame(name)
        return frame.body, self.kin.values.of(frame)

    def _origin(self, name: str) -> Vector:
        body, f = self._place(name)
        return self.kin.to_world(body, f.translation)

    def _in_world(self, name: str, pair: Pair) -> Pair:
        """Return a frame's vectors in world axes."""
        body, f = self._place(name)
        linear, angular = (self.kin.to_world(body, constant_times(f.rotation, x), 0.0) for x in pair)
        return linear, angular

    def twist(self, name: str) -> Pair:
        """Return the velocity of a frame's origin and its angular velocity, in its own axes."""
        body, f = self._place(name)
        linear, angular = self.kin.twists[body]
        linear = add(linear, cross3(angular, f.translation))
        return constant_transposed_times(f.rotation, linear), constant_transposed_times(f.rotation, angular)

    def _seen(self, name: str, pair: Pair, axes: str) -> Pair:
        """Return a twist, or a spatial acceleration, of a frame in these axes."""
        if axes == "local":
            return pair
        linear, angular = self._in_world(name, pair)
        if axes == "world":
            linear = add(linear, cross3(self._origin(name), angular))
        return linear, angular

    def velocity(self, name: str, axes: str) -> Pair:
        """Return a frame's velocity."""
        return self._seen(name, self.twist(name), axes)

    def acceleration(self, name: str, axes: str, kind: str, a: Any) -> Pair:
        """Return a frame's acceleration: the rate of its twist, or, if classical, of the point's velocity."""
        twist = self.twist(name)
        rate = ca.vertsplit(self.rate(_column(*twist), a))
        linear, angular = self._seen(name, (rate[:3], rate[3:]), axes)
        if kind == "classical":
            v, w = self._seen(name, twist, axes)
            linear = add(linear, cross3(w, v))
        return linear, angular

    def jacobian_rate_times_v(self, name: str, axes: str) -> Pair:
        """Return J̇ v, the acceleration without v̇."""
        # The rate of velocities in world axes at a point that moves with the frame is the point's own acceleration.
        kind = "classical" if axes == "local_world_aligned" else "spatial"
        return self.acceleration(name, axes, kind, ca.SX(self.model.nv, 1))

    def pose(self, name: str) -> Any:
        """Return X_WF, 4 by 4."""
        body, f = self._place(name)
        columns = [self.kin.to_world(body, [row[k] for row in f.rotation], 0.0) for k in range(3)]
        columns.append(self.kin.to_world(body, f.translation))
        top = ca.horzcat(*(ca.vertcat(*c) for c in columns))
        return ca.vertcat(ca.SX(top), ca.SX([[0.0, 0.0, 0.0, 1.0]]))

    # Wrenches on frames

    def in_body(self, body: str, x: Vector, above: str = "world") -> Vector:
        """Return a vector in a body's axes, of one in the axes of a body that carries it."""
        branch = []
        while body != above:
            joint = self.kin.carrier(body)
            branch.append(joint)
            body = joint.parent
        for joint in reversed(branch):
            x = self.kin.from_parent(joint, x)
        return x

    def _on_body(self, name: str, wrench: Any, axes: str) -> tuple[str, Pair]:
        """Return a frame's body, and a wrench on it about the body's origin, in its axes."""
        body, f = self._place(name)
        parts = ca.vertsplit(wrench)
        force, moment = parts[:3], parts[3:]
        if axes == "local":
            force, moment = (constant_times(f.rotation, x) for x in (force, moment))
        else:
            if axes == "world":
                moment = add(moment, cross3(force, self._origin(name)))
            force, moment = (self.in_body(body, x) for x in (force, moment))
        return body, (force, add(moment, cross3(f.translation, force)))

    def generalized_force(self, names: Sequence[str], axes: str, wrenches: Any) -> Any:
        """Return Σ Jᵀ w of wrenches on frames, (6 k, 1) for k of them."""
        power: Any = ca.SX(0)
        for i, name in enumerate(names):
            body, (force, moment) = self._on_body(name, wrenches[6 * i : 6 * i + 6], axes)
            linear, angular = self.kin.twists[body]
            power += dot3(linear, force) + dot3(angular, moment)
        return ca.gradient(power, self.kin.v)

    # Matter of the whole

    @cached_property
    def _matter(self) -> dict[str, Inertia]:
        """Mass, first moment and inertia of all that a body carries, about its origin."""
        kin, out = self.kin, {"world": Inertia()}
        for body in self.model.bodies:
            values = kin.values.of(body)
            central = Inertia(0.0, [0.0] * 3, [values.inertia[i][j] for i in range(3) for j in range(i, 3)])
            out[body.name] = central + Inertia(values.mass).shifted(values.com)
        for joint in reversed(self.model.tree):
            R, _ = kin.placements[joint.name]
            turned = out[joint.child].rotated([Matrix(kin.values.of(joint).rotation), Matrix(R)])
            out[joint.parent] = out[joint.parent] + turned.shifted(kin.to_parent(joint, [0.0] * 3))
        return out

    @cached_property
    def _momenta(self) -> dict[str, Pair]:
        """Linear and angular momentum of all that a body carries, about its origin, in its axes."""
        kin = self.kin
        out: dict[str, Pair] = {"world": ([0.0] * 3, [0.0] * 3)}
        for body in self.model.bodies:
            values, (linear, angular) = kin.values.of(body), kin.twists[body.name]
            P = [values.mass * x for x in add(linear, cross3(angular, values.com))]
            out[body.name] = P, add(cross3(values.com, P), constant_times(values.inertia, angular))
        for joint in reversed(self.model.tree):
            P, L = (kin.to_parent(joint, x, 0.0) for x in out[joint.child])
            L = add(L, cross3(kin.to_parent(joint, [0.0] * 3), P))
            above = out[joint.parent]
            out[joint.parent] = add(above[0], P), add(above[1], L)
        return out

    @cached_property
    def center_of_mass(self) -> Any:
        """p_G in the world."""
        whole = self._matter["world"]
        return ca.vertcat(*(ca.SX(x) / whole.mass for x in whole.moment))

    @cached_property
    def center_of_mass_velocity(self) -> Any:
        """Rate of p_G."""
        return ca.vertcat(*(ca.SX(x) / self._matter["world"].mass for x in self._momenta["world"][0]))

    @cached_property
    def centroidal_momentum(self) -> Any:
        """Linear momentum, and angular momentum about p_G, in world axes."""
        P, L = self._momenta["world"]
        center = ca.vertsplit(self.center_of_mass)
        return _column(P, add(L, cross3(P, center)))

    @cached_property
    def locked_inertia(self) -> Any:
        """Inertia of the whole about p_G as if its joints were locked, 6 by 6 in world axes."""
        whole, center = self._matter["world"], ca.vertsplit(self.center_of_mass)
        central = whole.shifted([-1.0 * x for x in center]).inertia
        out: Any = ca.SX(6, 6)
        for i in range(3):
            out[i, i] = whole.mass
            for j in range(3):
                out[3 + i, 3 + j] = central[SYMMETRIC[i][j]]
        return out

    # Loads

    def joint_wrenches(
        self,
        joints: Sequence[str],
        frames: Sequence[str],
        axes: str,
        wrenches: Any,
        pushes: Sequence[tuple[str, Vector, Vector]] = (),
    ) -> Any:
        """Return the load of each joint about its child's origin, in the child's axes: one row each, (n, 6).

        `pushes` are forces and moments on bodies about their origins, in their axes.
        """
        kin = self.kin
        outside = self._external(frames, axes, wrenches, pushes)
        gravity = {"world": list(kin.values.gravity)}
        for joint in self.model.tree:
            gravity[joint.child] = kin.from_parent(joint, gravity[joint.parent])
        bodies = [next(j.child for j in self.model.joints if j.name == name) for name in joints]
        rates = ca.vertsplit(self.rate(ca.vertcat(ca.SX(0, 1), *(_column(*self._momenta[b]) for b in bodies)), self.a))
        rows = []
        for k, body in enumerate(bodies):
            (v, w), (P, L), matter = kin.twists[body], self._momenta[body], self._matter[body]
            force = add(rates[6 * k : 6 * k + 3], cross3(w, P))
            moment = add(rates[6 * k + 3 : 6 * k + 6], add(cross3(w, L), cross3(v, P)))
            weight = [matter.mass * x for x in gravity[body]]
            push = add(weight, outside[body][0])
            turn = add(cross3(matter.moment, gravity[body]), outside[body][1])
            rows.append(ca.horzcat(*(ca.SX(x) - y for x, y in zip((*force, *moment), (*push, *turn), strict=True))))
        return ca.vertcat(ca.SX(0, 6), *rows)

    def _external(
        self, frames: Sequence[str], axes: str, wrenches: Any, pushes: Sequence[tuple[str, Vector, Vector]]
    ) -> dict[str, Pair]:
        """Return the wrench of springs and applied ones on all that a body carries, about its origin."""
        kin = self.kin
        out: dict[str, Pair] = {
            name: ([0.0] * 3, [0.0] * 3) for name in ("world", *(b.name for b in self.model.bodies))
        }

        def push(body: str, force: Vector, moment: Vector) -> None:
            out[body] = add(out[body][0], force), add(out[body][1], moment)

        for i, name in enumerate(frames):
            body, (force, moment) = self._on_body(name, wrenches[6 * i : 6 * i + 6], axes)
            push(body, force, moment)
        for body, force, moment in pushes:
            push(body, force, moment)
        for spring in self.model.springs:
            values = kin.values.of(spring)
            ends = (spring.body_a, values.point_a), (spring.body_b, values.point_b)
            a, b = (kin.to_world(body, point) for body, point in ends)
            gap = [y - x for x, y in zip(a, b, strict=True)]
            pull: Any = values.stiffness
            if spring.needs_direction:
                square = kin.squared_length(spring)
                length = kin.length(square)
                tension = values.stiffness * (length - values.rest_length) + values.damping * kin.length_rate(square)
                pull = tension / length
            for sign, (body, point) in zip((1.0, -1.0), ends, strict=True):
                if body != "world":
                    force = self.in_body(body, [sign * pull * x for x in gap])
                    push(body, force, cross3(point, force))
        for joint in reversed(self.model.tree):
            force, moment = (kin.to_parent(joint, x, 0.0) for x in out[joint.child])
            push(joint.parent, force, add(moment, cross3(kin.to_parent(joint, [0.0] * 3), force)))
        return out


def _column(linear: Vector, angular: Vector) -> Any:
    return ca.vertcat(*(ca.SX(x) for x in (*linear, *angular)))


def _rows(pairs: Sequence[Pair]) -> Any:
    return ca.vertcat(ca.SX(0, 6), *(_column(*pair).T for pair in pairs))


class BodyQuantity(NamedTuple):
    """A quantity that `BodyMotion` gives.

    Attributes
    ----------
    make : callable
        ``make(motion, *extra, wrenches)`` returns a matrix; `wrenches` is left out where it is no argument. Values of
        several frames stand below each other.
    arguments, shape : tuple of str
        Those of `mbkit.model.quantities.Quantity`.
    acts_on : str
        Where the matrix is a force: the term of the equation of motion that is meant, with this force on the system.
    """

    make: Callable[..., Any]
    arguments: tuple[str, ...]
    shape: tuple[str, ...]
    acts_on: str = ""


def _frame_jacobians(motion: BodyMotion, frames: tuple[str, ...], axes: str) -> Any:
    return ca.vertcat(*(ca.jacobian(_column(*motion.velocity(name, axes)), motion.kin.v) for name in frames))


def _by_v(name: str) -> Callable[[BodyMotion], Any]:
    return lambda motion: ca.jacobian(getattr(motion, name), motion.kin.v)


def _rate(name: str, *, moved: bool) -> Callable[[BodyMotion], Any]:
    return lambda motion: motion.rate(getattr(motion, name), motion.a if moved else ca.SX(motion.model.nv, 1))


#: Quantities of a frame, and of the whole, that have a function in CasADi and in C.
OF_FRAME: Final = tuple(of_groups("frame"))
OF_WHOLE: Final = tuple(of_groups("whole"))
_MAKE: Final[dict[str, Callable[..., Any]]] = {
    "pose": lambda m, frames: ca.vertcat(*(m.pose(name) for name in frames)),
    "jacobian": _frame_jacobians,
    "velocity": lambda m, frames, axes: _rows([m.velocity(name, axes) for name in frames]),
    "acceleration": lambda m, frames, axes, kind: _rows([m.acceleration(name, axes, kind, m.a) for name in frames]),
    "jacobian_dot_v": lambda m, frames, axes: _rows([m.jacobian_rate_times_v(name, axes) for name in frames]),
    "center_of_mass": lambda m: m.center_of_mass,
    "center_of_mass_velocity": lambda m: m.center_of_mass_velocity,
    "center_of_mass_acceleration": _rate("center_of_mass_velocity", moved=True),
    "center_of_mass_jacobian": _by_v("center_of_mass_velocity"),
    "centroidal_momentum": lambda m: m.centroidal_momentum,
    "centroidal_momentum_matrix": _by_v("centroidal_momentum"),
    "centroidal_momentum_bias": _rate("centroidal_momentum", moved=False),
    "locked_inertia": lambda m: m.locked_inertia,
    "generalized_force": BodyMotion.generalized_force,
    "inverse_dynamics_with_wrenches": BodyMotion.generalized_force,
    "forward_dynamics_with_wrenches": BodyMotion.generalized_force,
    "joint_wrenches": BodyMotion.joint_wrenches,
    "regressor": lambda m, columns: torque_regressor(m.kin, m.a, columns),
    "momentum_regressor": lambda m, columns: momentum_regressor(m.kin, columns),
    "energy_regressor": lambda m, columns: energy_regressor(m.kin, columns),
}
_ACTS_ON: Final = {f"{x}_with_wrenches": x for x in ("inverse_dynamics", "forward_dynamics")}
#: Name of each quantity -> how it is derived. Those of frames take their names and axes, and return one value a frame.
BODY_QUANTITIES: Final = {
    name: BodyQuantity(make, QUANTITIES[name].arguments, QUANTITIES[name].shape, _ACTS_ON.get(name, ""))
    for name, make in _MAKE.items()
}
