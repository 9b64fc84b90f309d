"""Dry friction at joints: its law, and a model in which every joint slides one way or rests.

At speed v the force is -f(|v|) sign(v); at rest it is any force up to the bound s::

    f(|v|) = f + (s - f) exp(-(v / v_s)²)        s: `Joint.stiction`, f where none is given

(Stribeck's curve; Armstrong-Hélouvry et al. 1994, Automatica 30(7), eq. 6. Without a Stribeck velocity v_s the force
falls from s to f at once.) A joint that mimics another has its own friction, which acts at its own rate.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mbkit._check import Array
from mbkit.model.elements.forces import JointForce
from mbkit.model.elements.formula import written
from mbkit.model.model import Model, unchecked
from mbkit.model.parameters import Binding, Expression, Parameter
from mbkit.model.parts import RESTING, Joint, acting
from mbkit.model.stops import StopLaw

#: The number that holds what rests.
_ROTOR: Final = Joint.adding_to("T")[0]
#: Numbers that may be parameters.
_BOUND: Final = ("friction", "stiction")


class JumpNumbers(NamedTuple):
    """Sliding friction, bound at rest and Stribeck velocity of each full velocity; (n,) each, and all zero without.

    Of samples with parameters of their own the first two are (N, n).
    """

    sliding: Array
    bound: Array
    stribeck: Array

    @classmethod
    def of(cls, joints: Sequence[Joint]) -> JumpNumbers:
        """Read them off joints, at nominal values of parameters."""
        none = np.zeros(0)
        fields = "friction", "stiction", "stribeck_velocity"
        return cls(*(np.concatenate([none, *(acting(j, field) for j in joints)]) for field in fields))

    @classmethod
    def at_values(cls, model: Model, values: Mapping[str, Any]) -> JumpNumbers:
        """Return them at values of parameters, a number or (N,) each."""
        numbers, joints = cls.of(model.joints), {j.name: j for j in model.joints}
        size = np.broadcast_shapes(*(np.shape(x) for x in values.values()))
        sliding, bound = (np.array(np.broadcast_to(x, (*size, len(x)))) for x in numbers[:2])
        for binding in jump_bindings(model):
            place = model.layout.full_v[binding.part].start + binding.index[0]
            value = binding.expression.evaluate(lambda p: values[p.name], float)
            if binding.field == "friction":
                sliding[..., place] = value
            if binding.field == "stiction" or joints[binding.part].stiction is None:
                bound[..., place] = value
        return cls(sliding, bound, numbers.stribeck)

    def at(self, v: Array) -> Array:
        """Return f(|v|) of full velocities, (n,) or (N, n)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            fall = np.exp(-np.square(v / self.stribeck))
        return self.sliding + np.where(self.stribeck > 0, (self.bound - self.sliding) * fall, 0.0)


def jump_bindings(model: Model) -> list[Binding]:
    """Return the numbers of dry friction that are expressions of parameters."""
    return [b for b in model.bindings if b.where == "joints" and b.field in _BOUND]


def jump_rates(kin: Any, exp: Callable[[Any], Any]) -> Iterator[tuple[Any, Any]]:
    """Yield the rate of each velocity with dry friction, and its f(|v|), as `mbkit.derivation.kinematics` has them."""
    free = {(b.part, b.index[0]) for b in jump_bindings(kin.model)}
    for joint in kin.model.joints:
        values, given = kin.values.of(joint), JumpNumbers.of([joint])
        for k in range(joint.type.nv):
            if not (given.sliding[k] + given.bound[k] or (joint.name, k) in free):
                continue
            rate, size = kin.velocities(joint)[k], values.friction[k]
            if given.stribeck[k]:
                size += (values.stiction[k] - size) * exp(-((rate / values.stribeck_velocity[k]) ** 2))
            yield rate, size


class JumpLaw:
    """The law of a model's friction by its independent velocities."""

    def __init__(self, model: Model, values: Mapping[str, Any] | None = None) -> None:
        nominal = JumpNumbers.of(model.joints)
        self._numbers = nominal if values is None else JumpNumbers.at_values(model, values)
        self._G = model.layout.G if model.layout.reduced else None
        n = len(nominal.bound)
        sizes = np.abs(self._G) if self._G is not None else np.eye(n)
        #: The largest force at rest, (nv,); zero where a joint has no friction. Of samples, (N, nv), as what follows.
        self.bound: Array = self._numbers.bound @ sizes
        moving = self._numbers.at(np.zeros(n)) @ sizes
        may = nominal.bound != 0
        for binding in jump_bindings(model):
            may[model.layout.full_v[binding.part].start + binding.index[0]] = True
        #: Velocities with friction, whatever parameters are; and those with friction or stops.
        self.stops = StopLaw(model)
        self.rubbing = np.flatnonzero(may @ sizes)
        self.which = np.union1d(self.rubbing, np.flatnonzero(self.stops.which))
        #: That of a joint that has just let go, (nv,); its sign tells the side, and so it is zero nowhere else.
        self.just_moving: Array = np.where(
            (self.bound > 0) | self.stops.which, np.maximum(moving, np.finfo(float).tiny), 0.0
        )

    def of_samples(self, which: NDArray[np.intp]) -> JumpLaw:
        """Return the law of these samples, by index."""
        out, own = copy(self), self._numbers
        out._numbers = own._replace(sliding=own.sliding[which], bound=own.bound[which])
        out.bound, out.just_moving = self.bound[which], self.just_moving[which]
        return out

    def force(self, v: Array) -> Array:
        """Return the force at speed, zero at rest; (nv,) or (N, nv)."""
        full = v if self._G is None else v @ self._G.T
        out = -self._numbers.at(full) * np.sign(full)
        return np.asarray(out if self._G is None else out @ self._G)

    def force_at(self, v: Array) -> Array:
        """Return the force of motion along each velocity at this speed, zero at rest or not; of the shape of v."""
        full = v if self._G is None else v @ self._G.T
        sizes = -self._numbers.at(full)
        return np.asarray(sizes if self._G is None else sizes @ np.abs(self._G))

    def slope(self, v: Array) -> Array:
        """Return ∂force/∂v where no joint rests, (nv, nv) or (N, nv, nv)."""
        full, own = (v if self._G is None else v @ self._G.T), self._numbers
        with np.errstate(divide="ignore", invalid="ignore"):
            fall = np.exp(-np.square(full / own.stribeck)) * 2 * np.abs(full) / np.square(own.stribeck)
        out = np.where(own.stribeck > 0, (own.bound - own.sliding) * fall, 0.0)[..., None] * np.eye(full.shape[-1])
        return np.asarray(out if self._G is None else self._G.T @ out @ self._G)

    def dissipated(self, h: Array, moved: Array, v: Array) -> Array:
        """Return ∫ f(|v|) |v| dt over K intervals of h, (K,), that move by `moved`, (K, nv), between v, (K + 1, nv).

        The part of f at high speed is exact where no velocity changes its sign in an interval; Simpson's rule, with
        velocities of the cubic through the ends, has that of Stribeck's curve.
        """
        own, h = self._numbers, h[:, None]
        d, v = (x if self._G is None else x @ self._G.T for x in (moved, v))
        with np.errstate(divide="ignore", invalid="ignore"):
            turning = np.square(v[1:]) + np.square(v[:-1])
            path = np.where(v[1:] * v[:-1] < 0, 0.5 * h * turning / np.abs(v[1:] - v[:-1]), np.abs(d))
            middle = np.where(h > 0, 1.5 * d / h - 0.25 * (v[1:] + v[:-1]), 0.0)
        ends, middle = ((own.at(x) - own.sliding) * np.abs(x) for x in (v, middle))
        return np.asarray(np.sum(own.sliding * path + h / 6 * (ends[1:] + 4 * middle + ends[:-1]), axis=1))

    def at_rest(self, q: Array, v: Array) -> NDArray[np.bool_]:
        """Return where joints with friction, or at their stops, have no velocity, of the shape of v."""
        return np.asarray((v == 0) & ((self.bound > 0) | (self.stops.against(q) != 0)), dtype=np.bool_)


def held_at_rest(model: Model) -> str:
    """Return in words what f sign(v) leaves out at rest; empty without dry friction."""
    bounds = zip(model.velocity_names, JumpLaw(model).bound, strict=True)
    held = " and ".join(f"{bound:g} at {name!r}" for name, bound in bounds if bound)
    return f"dry friction is f sign(v): zero at rest, where it can hold up to {held} (N or N m)" if held else ""


class Sliding:
    """The model whose joints slide one way or rest, as parameters say, and these parameters' values.

    Friction is a force with a given sign there, smooth through rest; a joint that rests has a rotor that nothing
    moves. So each phase between two changes is an ordinary smooth system, of one derivation.
    """

    def __init__(self, model: Model) -> None:
        self.law = JumpLaw(model)
        self.names = model.velocity_names
        #: Independent velocities with friction or stops.
        self.which = self.law.which
        self.sides = {int(i): f"friction side of {self.names[i]}" for i in self.law.rubbing}
        self.locks = {int(i): f"friction lock of {self.names[i]}" for i in self.which}
        self.model = self._of(model)
        with unchecked():
            self.form = self.model.form_digest

    def at(self, sides: Array, still: NDArray[np.bool_], model: Model) -> Model:
        """Return the model in which velocities have these signs, or stay at rest; (nv,) each.

        The time and the other parameters are those of `model`, which has the friction.
        """
        values: dict[str, Any] = dict(model.parameters)
        values |= {name: 0.0 if still[i] else float(sides[i]) for i, name in self.sides.items()}
        values |= {name: float(self.lock(sides, still)[i]) for i, name in self.locks.items()}
        with unchecked():
            out = replace(self.model._substituted(lambda p: Parameter(p.name, values[p.name])), time=model.time)
        vars(out)["form_digest"] = self.form
        return out

    def lock(self, sides: Array, still: NDArray[np.bool_]) -> Array:
        """Return the rotors that hold what rests, kg m² or kg, of the shape of v.

        A joint at a stop without friction, that rests as the rows hold it, has none but a number that says so.
        """
        plain = ~np.isin(np.arange(len(self.names)), self.law.rubbing)
        return np.where(still, RESTING, np.where(plain & (sides == 0), np.finfo(float).tiny, 0.0))

    def _of(self, model: Model) -> Model:
        layout, numbers = model.layout, JumpNumbers.of(model.joints)
        joints, forces, bindings = [], [], list[Binding]()
        free = {(b.part, b.field, b.index[0]): b.expression for b in jump_bindings(model)}
        for joint in model.joints:
            part = layout.full_v[joint.name]
            smooth: dict[str, Any] = {"friction": np.zeros(joint.type.nv), "stiction": None, "stribeck_velocity": None}
            joints.append(replace(joint, restitution=None, **smooth))
            # A joint that follows by a ratio of zero does not move.
            own_free = {(field, k): x for (name, field, k), x in free.items() if name == joint.name}
            if not (own_free or numbers.bound[part].any()) or not layout.G[part].any():
                continue
            name = f"friction of {joint.name}"
            rows = [np.flatnonzero(layout.G[i])[0] for i in range(part.start, part.stop)]
            signs = [float(np.sign(layout.G[part.start + k, i])) for k, i in enumerate(rows)]
            own = [k for k, i in enumerate(rows) if int(i) in self.sides]
            force, expressions = _force(name, joint, JumpNumbers(*(x[part] for x in numbers)), signs, own_free)
            forces.append(force)
            bindings += [Binding("forces", name, "numbers", (k,), x) for k, x in expressions.items()]
            bindings += [
                Binding("forces", name, "numbers", (k,), Parameter(self.sides[int(rows[k])], 0.0)) for k in own
            ]
        bound = {(b.part, b.index): b for b in model.bindings if b.where == "joints" and b.field == _ROTOR}
        of = [(joint, k) for joint in model.independent_joints for k in range(joint.type.nv)]
        for i, lock in self.locks.items():
            joint, k = of[i]
            held = bound.pop((joint.name, (k,)), None)
            own_number: Any = float(getattr(joint, _ROTOR)[k]) if held is None else held.expression
            bindings.append(Binding("joints", joint.name, _ROTOR, (k,), Parameter(lock, 0.0) + own_number))
        kept = [b for b in model.bindings if not (b.where == "joints" and b.field in (_ROTOR, *_BOUND))]
        with unchecked():
            return replace(
                model,
                joints=tuple(joints),
                forces=(*model.forces, *forces),
                bindings=(*kept, *bound.values(), *bindings),
            )


def _force(
    name: str,
    joint: Joint,
    numbers: JumpNumbers,
    signs: Sequence[float],
    free: Mapping[tuple[str, int], Expression],
) -> tuple[JointForce, dict[int, Expression]]:
    """Return -side f(|v|) of each velocity, with the side as a parameter.

    `free` has what f and s of velocities are expressions of; these are returned by their places among the numbers.
    """
    n = joint.type.nv
    sides = tuple("side" if n == 1 else f"side_{k}" for k in range(n))
    speeds = tuple("v" if n == 1 else f"v_{k}" for k in range(n))
    curved = bool((numbers.stribeck > 0).any())
    # Without a curve, stiction does nothing to what slides.
    used = [x for x in free if x[0] == "friction" or numbers.stribeck[x[1]] > 0]
    more = tuple(f"{field}_{k}" for field, k in used)

    def law(*given: Any) -> tuple[Any, ...]:
        at, out = {x: given[n + i] for i, x in enumerate(used)}, []
        for k, (f, s, w) in enumerate(zip(*(x.tolist() for x in numbers), strict=True)):
            f = at.get(("friction", k), f)
            s = at.get(("stiction", k), s if joint.stiction is not None else f)
            fall = (s - f) * (-((given[n + len(used) + k] * (1.0 / w)) ** 2)).exp() if w > 0 else 0.0
            out.append(given[k] * (-signs[k] * (f + fall)))
        return tuple(out)

    formula = written(law, *sides, *more, *(speeds if curved else ()))
    names = (*sides, *more)
    return JointForce(name, joint.name, formula, None, names, np.zeros(len(names))), {
        n + i: free[x] for i, x in enumerate(used)
    }
