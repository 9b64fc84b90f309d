"""`Model`: a whole description, frozen. Engines read it and never change it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from functools import cached_property
from math import hypot
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import TWO_TURNS, Array, batch_of, count, generator, hint_at_degrees, real, rows
from mbkit._escape import html
from mbkit._imports import from_above
from mbkit.errors import InputError, MbkitWarning, ModelError, UnknownNameError, UnsupportedError, require_known, warn
from mbkit.model import manifold
from mbkit.model.base_parameters import TOLERANCE, BaseParameters, base_parameters, regressor_columns
from mbkit.model.description import SERVOS, Description, expect_name
from mbkit.model.elements.kinds import PART_KINDS, that_do
from mbkit.model.parameters import Parameter
from mbkit.model.validation import check_substituted, model_faults

#: Seeds that look like a number of states.
_ROUND_NUMBERS: Final = (100, 1_000, 10_000, 100_000, 1_000_000)
#: Modules that evaluate runs, or states of their own.
_OF_RUNS: Final = (
    *(f"mbkit.simulate.{x}" for x in ("integrate", "run_data", "sensitivity", "trajectory")),
    "mbkit.studies",
)
#: Angle, rad, by which a motion may have come beyond two turns in a step.
_MAX_TURN_IN_A_STEP: Final = 1.0


_checked: Final = ContextVar("checked", default=True)


@contextmanager
def unchecked() -> Iterator[None]:
    """Create models without checks: in a builder that checks them, or with a defect on purpose."""
    token = _checked.set(False)
    try:
        yield
    finally:
        _checked.reset(token)


class Model(Description):
    """A multibody system: a tree of bodies and what acts on it.

    `ModelBuilder.build` and `mbkit.load` make it. Its attributes are those of `Description`. It is checked whenever one
    comes into being, by `dataclasses.replace` too: a `ModelError` has every fault. A body whose inertia no matter has
    is one, unless `nonphysical` lists it.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if _checked.get() and type(self) is Model and (faults := model_faults(self)):
            raise ModelError(self.name, faults)

    # Questions to every model, of bodies or of energies

    @property
    def has_bodies(self) -> bool:
        """Whether it consists of bodies and joints; False of energies T and V alone, whose T need not be ½ vᵀ M v."""
        return self.energy_equations is None

    @property
    def energy_equations(self) -> Callable[..., Any] | None:
        """A function of "literal" or "symbol" that returns the equations of energies; None with bodies."""
        return None

    @property
    def velocity_map(self) -> Any:
        """q̇ = D(q) v of quasi-velocities; None where the joints' types give q̇."""
        return None

    @property
    def jumping_forces(self) -> tuple[str, ...]:
        """Forces by name that jump with a velocity's sign and hold nothing at rest; none of joints' dry friction."""
        return ()

    @property
    def constrained(self) -> bool:
        """Whether constraints bind the coordinates to each other, so that not every (q, v) is a state."""
        return bool(self.constraints)

    @property
    def constraint_parts(self) -> str:
        """Names of the parts that bind its coordinates or velocities, for a message; its own where it is energies."""
        return ", ".join(repr(x.name) for x in self.constraints) or self.name

    @property
    def holds_velocities(self) -> bool:
        """Whether some constraints hold velocities alone, as contacts without slip do."""
        return self.needs.no_slip

    @property
    def constraints_do_work(self) -> bool:
        """Whether constraints may feed energy, as motions in time and blades with a speed do."""
        return self.time_parameter is not None or any(getattr(x, "speed", 0.0) for x in self.constraints)

    def require_independent(self, q: Array) -> None:
        """Refuse constraints that depend on each other at q, (nq,) or the first of (N, nq), with the rows."""
        if self.constrained and len(q) and None not in self.parameters.values():
            from_above("consistent_states").states_of(self).require_independent(q)

    # Configurations

    def neutral(self) -> Array:
        """Return the zero configuration with identity quaternions, shape (nq,); it may lie outside the limits."""
        return manifold.neutral(self)

    def random_state(self, rng: np.random.Generator | int, size: int | None = None) -> tuple[Array, Array]:
        """Draw a random state.

        Parameters
        ----------
        rng : numpy.random.Generator or int
            Or the seed of one.
        size : int, optional
            Number of states; without it, one state and no batch axis.

        Returns
        -------
        q : (nq,) or (size, nq) array
            Uniform within the limits, clipped to ±π rad; ±1 m where a length has none; uniform rotations. Under
            constraints the consistent state to which Newton's flow leads from there, also beyond the limits, away from
            singular poses. A seed gives the same state on every processor, to rounding.
        v : (nv,) or (size, nv) array
            Standard normal.
        """
        if size is not None:
            count("size", size)
        elif isinstance(rng, (int, np.integer)) and rng in _ROUND_NUMBERS:
            warn(
                f"random_state({rng}): {rng} is a seed, of one state; random_state(seed, {rng}) draws {rng}",
                MbkitWarning,
            )
        rng = generator("rng", rng)
        if not self.constrained:
            return manifold.random_state(self, rng, size)
        state: tuple[Array, Array] = from_above("consistent_states").states_of(self).random(rng, size)
        return state

    def check_q(self, q: ArrayLike, name: str = "q") -> Array:
        """Return `q` as float64, checked for shape, finite numbers and unit quaternions."""
        out = rows(name, q, self.nq, self.name, "nq")
        if self.quaternions:
            manifold.check_quaternions(self, out, name)
        first = out if out.ndim == 1 else out[:1].ravel()
        # Below this length no entry is beyond two turns.
        if hypot(*first.tolist()) > TWO_TURNS:
            self._look_for_degrees(first, name)
        return out

    def _look_for_degrees(self, q: Array, name: str = "q") -> None:
        """Warn of an angle beyond two turns in one configuration that a user wrote, once for each model.

        Runs turn as they like: a motion that has just come beyond two turns says that the model does, and so does what
        evaluates a run.
        """
        if "_turns" in self.__dict__ or not self._hinges:
            return
        k = max(self._hinges, key=lambda i: abs(q[i]))
        if abs(q[k]) > TWO_TURNS:
            self.__dict__["_turns"] = True
        if abs(q[k]) > TWO_TURNS + _MAX_TURN_IN_A_STEP:
            where = f"{self.name}: {name}: {self.coordinate_names[k]}"
            hint_at_degrees(where, q[k], unless=_OF_RUNS if name == "q" else ())

    @cached_property
    def _hinges(self) -> list[int]:
        """Indices of the angles in q."""
        return [self.layout.q[j.name].start + k for j in self.independent_joints for k in j.type.angular]

    def check_v(self, v: ArrayLike, name: str = "v") -> Array:
        """Return `v` (or an acceleration or force) as float64, checked."""
        return rows(name, v, self.nv, self.name, "nv")

    def integrate(self, q: ArrayLike, dq: ArrayLike) -> Array:
        """Move from q along dq with the joints' exponential.

        Parameters
        ----------
        q : (nq,) or (N, nq) array
        dq : (nv,) or (N, nv) array
            A displacement in the space of v; for a free joint a twist in body axes, whose exponential is SE(3)'s.

        Returns
        -------
        (nq,) or (N, nq) array
        """
        q, dq = self.check_q(q), self.check_v(dq, "dq")
        batch_of(q=q, dq=dq)
        return manifold.integrate(self, q, dq)

    def difference(self, q0: ArrayLike, q1: ArrayLike) -> Array:
        """Return the dq with ``integrate(q0, dq) = q1``, shape (nv,) or (N, nv).

        Rotations take the shorter way round: an angle of a ball or free joint is at most π.
        """
        q0, q1 = self.check_q(q0, "q0"), self.check_q(q1, "q1")
        batch_of(q0=q0, q1=q1)
        return manifold.difference(self, q0, q1)

    # Inertia

    def base_parameters(self, *, tolerance: float = TOLERANCE) -> BaseParameters:
        """Return the smallest set of inertial parameters that decides the motion.

        Each is a combination of the masses, first moments and inertias of bodies, such as ``link3.Ixx - link3.Iyy``.
        Torques and motion depend on these alone, so no experiment with them can tell more about the bodies
        (Gautier and Khalil 1990; Khalil and Dombre 2002, Modeling, Identification and Control of Robots, ch. 9.4).
        Armature, friction, springs and damping are taken as known, and do not count. Limits of joints are ignored.

        Parameters
        ----------
        tolerance : float
            What is smaller than this, relative to the largest, is taken as not there. An axis that a file's rounding
            tilts against another one by less counts as parallel to it.

        Returns
        -------
        BaseParameters
            With ``values == matrix @ standard``.

        Raises
        ------
        UnsupportedError
            A model written as energies, or one with constraints.
        InputError
            A parameter of the model has no value.
        NumericalError
            The tolerance falls where there is no clear gap.

        Examples
        --------
        >>> import mbkit as mb
        >>> print(mb.catalog.double_pendulum().base_parameters())
        double_pendulum: 6 base parameters of 20 standard ones
                   2  rod1.Iyy + rod2.m
                   0  rod1.hx
                  -2  rod1.hz - rod2.m
                   1  rod2.Iyy
                   0  rod2.hx
                  -1  rod2.hz
        """
        return base_parameters(self, tolerance)

    def regressor_columns(
        self, parameters: str = "standard", *, friction: bool = False, armature: bool = False
    ) -> tuple[str, ...]:
        """Return the names of the columns of `Dynamics.regressor`.

        Parameters
        ----------
        parameters, friction, armature
            Those of `Dynamics.regressor`: standard parameters in the order of ``base_parameters().standard_names``, or
            base parameters, each named after the standard one that leads it; then ``"joint.damping"`` and
            ``"joint.friction"`` of each velocity, and ``"joint.armature"`` of each joint with one velocity.

        Returns
        -------
        tuple of str

        Raises
        ------
        InputError
            Another set of parameters.
        UnsupportedError
            A model without bodies; for base parameters also one with constraints.

        Examples
        --------
        >>> import mbkit as mb
        >>> mb.catalog.pendulum().regressor_columns("base", friction=True)
        ('bob.Iyy', 'bob.hx', 'bob.hz', 'theta.damping', 'theta.friction')
        """
        self.require_bodies("regressor")
        return regressor_columns(self, parameters, friction, armature).names(self)

    def require_bodies(self, what: str) -> None:
        """Raise `UnsupportedError` for a model that was written as energies."""
        if not self.has_bodies:
            raise UnsupportedError(f"{what}: {self.name} was written as energies and has no bodies")

    # Variants

    def without(self, *features: str) -> Model:
        """Return the same description less some features.

        Parameters
        ----------
        *features : str
            Any of damping, springs, armature, friction, gravity, limits, stops, loops, couplers, prescribed, forces,
            no_slip.
            Springs and damping are those of joints, point-to-point elements and couplings, armature that of joints
            and couplings; forces are those given by functions, with bushings and gravity compensation.
            Couplers go with the loops. Or kinds of `acts`, such as ``"joint.stiction"`` or ``"loop.revolute"``.
        """
        model = self
        for feature in features:
            expect_name("feature", feature)
            kinds = [k for k in PART_KINDS.values() if k.features]
            if not (gone := [k for k in kinds if feature in (*k.features, k.name)]):
                known = (x for k in kinds for x in ((k.name,) if "." in feature else k.features))
                raise UnknownNameError("feature", feature, dict.fromkeys(known))
            for kind in gone:
                model = kind.removed(model)
        return model

    def with_stops(self, restitution: float = 0.0) -> Model:
        """Return the model in which the limits of all joints act as rigid stops, with Newton's restitution.

        Limits of free and ball joints stay data; InputError where no joint has others.
        """
        e = real("restitution", restitution)
        stopped = {
            j.name: replace(j, restitution=np.full(j.type.nv, e))
            for j in self.joints
            if j.type.coordinate_velocities and np.isfinite([j.lower, j.upper]).any()
        }
        if not stopped:
            raise InputError(f"stops: {self.name} has no joint with limits that could act; give lower, upper or both")
        return replace(self, joints=tuple(stopped.get(j.name, j) for j in self.joints))

    @property
    def smooth(self) -> Model:
        """The model without what jumps, such as dry friction and stops; itself where it has none."""
        return self.without(*that_do("jump")) if "jump" in self.effects else self

    def lock(self, joints: Mapping[str, Any] | Sequence[str], q: ArrayLike | None = None) -> Model:
        """Return the model with some joints fixed: its terms are those of this one with these velocities zero.

        Bodies and frames stay, and what they carry. What follows a locked joint is locked with it: joints that mimic
        it, and those that a coupler ties to it. A loop stays, unless nothing moves its ends any more. Springs at locked
        joints keep their energy, as springs between bodies that these hold together. `full_state` and `reduced_state`
        bring q and v from one model to the other.

        Parameters
        ----------
        joints : mapping of str to float or array_like, or sequence of str
            Joints and their coordinates, in rad and m; or names, with the coordinates in `q`.
        q : (nq,) array_like, optional
            A whole configuration; by default the neutral one.

        Raises
        ------
        UnknownNameError
            No joint of this name.
        InputError
            A joint without a coordinate of its own, a value beyond limits, a loop or a coupler that is open at these
            values, a motion in time, and others that the message names.

        Examples
        --------
        >>> import mbkit as mb
        >>> robot = mb.load("panda")
        >>> arm = robot.lock({"panda_finger_joint1": 0.02})
        >>> arm.nv, float(arm.full_state(arm.neutral())[0][-1])
        (7, 0.02)
        """
        locked: Model = from_above("locking").lock(self, joints, q)
        return locked

    def full_state(self, q: ArrayLike, v: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return q and v of the model that was locked, from those of this one; locked joints have their values.

        Parameters
        ----------
        q : (nq,) or (N, nq) array_like
        v : (nv,) or (N, nv) array_like, optional
            Or an acceleration; zero without.
        """
        full: tuple[Array, Array] = from_above("locking").full_state(self, q, v)
        return full

    def reduced_state(self, q: ArrayLike, v: ArrayLike | None = None) -> tuple[Array, Array]:
        """Return this model's q and v, from those of the model that was locked.

        Parameters
        ----------
        q, v : arrays
            Of the model before `lock`, one state or a batch. Numbers of locked joints are left out.
        """
        reduced: tuple[Array, Array] = from_above("locking").reduced_state(self, q, v)
        return reduced

    def segmented(self, segments: int) -> Model:
        """Return the model with each beam of `ModelBuilder.add_beam` as a chain of rigid segments, for every engine.

        Springs EI/h sit in hinges between segments of the length h, the first of them half a segment from the clamp, or
        at the root of a string:
        frequencies and motions come to those of the beam as h². Deflections may be large. Bodies ``name.s0``,
        ``name.s1``, ... are the segments, and the body at the beam's end stays.

        Parameters
        ----------
        segments : int
            Hinges of each beam.

        Raises
        ------
        UnsupportedError
            A part that acts on the modes or on points of a beam, or stiffnesses of modes that belong to no EI.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("wing")
        >>> b.add_beam("beam", parent="world", length=2.0, stiffness=30.0, density=0.4, modes=2)
        >>> mb.dynamics(b.build().segmented(10), "pinocchio").model.nv
        10
        """
        made: Model = from_above("segments").segmented(self, segments)
        return made

    def with_free(self, *paths: Any) -> Model:
        """Return the same model with numbers that are parameters, by path, for `Dynamics.at` and batches of variants.

        Parameters
        ----------
        *paths : str or Scale
            ``"body.mass"``, ``"body.com"``, ``"body.inertia"``, ``"joint.damping"``, ``"joint.armature"`` and other
            numbers of bodies and of all that acts: ``"mount.stiffness.rz"`` and ``"mount.stiffness.x.y"`` of a bushing,
            ``"force.k"`` of a constant ``k`` in its formula, ``"gear.ratio"``; ``"gravity"``; wildcards such as
            ``"*.damping"``.
            Each number becomes a parameter of its path's name with its present value; of a vector each component, as
            ``"body.com.x"``. A wildcard leaves out what is zero, and bodies that never move. `mbkit.scale` makes one
            factor of many numbers.

            ``"body.log_cholesky"`` makes ten parameters ``"body.log_cholesky.alpha"``, ``d1``, ``d2``, ``d3``, ``s12``,
            ``s23``, ``s13``, ``t1``, ``t2``, ``t3`` of mass, centre of mass and inertia. All their values are bodies
            that can be (Rucker and Wensing 2022): with V upper triangular of the s and the diagonal exp(d), the mass is
            exp(2 alpha), the centre of mass t, and the second moments about it are exp(2 alpha) V Vᵀ.

        Raises
        ------
        InputError
            A path that fits nothing, a link that was merged with a body, which the message names, or the factor of a
            body without mass or extent.

        Examples
        --------
        >>> import mbkit as mb
        >>> robot = mb.load("ur5").with_free("wrist_3_link.mass", mb.scale("*.inertia"))
        >>> dict(robot.parameters)
        {'wrist_3_link.mass': 0.1879, 'scale(*.inertia)': 1.0}
        >>> dyn = mb.dynamics(robot, "lagrangian").at(**{"wrist_3_link.mass": [0.2, 0.4, 0.8]})
        >>> dyn.gravity([0.0] * 6).shape
        (3, 6)
        """
        free: Model = from_above("freeing").with_free(self, paths)
        return free

    def with_parameters(self, /, **values: float) -> Model:
        """Return the same description with plain numbers, by name, for some or all parameters; the time stays one.

        Raises
        ------
        UnknownNameError
            A name that is no parameter of this model.
        InputError
            A value that is not a finite number.
        ModelError
            No matter is like the result, as `ModelBuilder.build` would say.
        """
        numbers = self._parameter_values(values)
        time = numbers.get(self.time_parameter or "", self.time)
        self.require_times("time", time)
        return check_substituted(self, replace(self._substituted(lambda p: numbers.get(p.name, p)), time=time))

    def with_nominal(self, values: Mapping[str, Any]) -> Model:
        """Return the same parametrised model at other nominal values."""
        numbers = self._parameter_values(values)
        time = numbers.pop(self.time_parameter or "", self.time)
        self.require_times("time", time)
        if not numbers:
            # A run asks so at every step: nothing but the time differs, and what follows from the rest is kept. Each
            # evaluation asks for the effects, which the copies of a model that has none yet would find again.
            _ = self.effects
            if self.constrained:
                # Before the copy, so that all times share one derivation and one choice of rows.
                from_above("consistent_states").states_of(self)
            out = object.__new__(type(self))
            out.__dict__.update({k: x for k, x in self.__dict__.items() if k != "parameters"}, time=time)
            return out
        moved = self._substituted(lambda p: Parameter(p.name, numbers.get(p.name, p.value)))
        return check_substituted(self, replace(moved, time=time))

    def _parameter_values(self, values: Mapping[str, Any]) -> dict[str, float]:
        require_known("parameter", self.parameters, *values)
        return {name: real(f"parameter {name!r}", value) for name, value in values.items()}

    # Reading

    def __repr__(self) -> str:
        between = f"; joint couplings {', '.join(c.name for c in self.couplings)}" if self.couplings else ""
        text = f"nq={self.nq}, nv={self.nv}, {self._mass_text()}{self._servos_text()}; {self.needs}{between}"
        return f"<Model {self.name!r}: {text}>"

    def _servos_text(self) -> str:
        notes = [n for n in self.notes if n.startswith(SERVOS)]
        return f"; {re.split('[;:]', notes[0])[0]}" if notes else ""

    def _mass_text(self) -> str:
        return "mass without a value" if any(np.isnan(b.mass) for b in self.bodies) else f"{self.mass:.4g} kg"

    def _repr_html_(self) -> str:
        cells = "".join(
            f"<tr><td>{html(j.name)}</td><td>{j.kind}</td><td>{html(j.parent)}</td>"
            f"<td>{html(j.child)}</td><td>{self.body(j.child).mass:.4g}</td>"
            f"<td>{html(f'{j.mimic.ratio:g} × {j.mimic.joint}') if j.mimic else ''}</td></tr>"
            for j in self.tree
        )
        head = "".join(f"<th>{h}</th>" for h in ("joint", "kind", "parent", "child", "child's mass, kg", "mimics"))
        parts = map(str, (*self.couplings, *self.forces, *self.no_slip))
        notes = "".join(f"<li>{html(n)}</li>" for n in (*parts, *self.notes))
        return (
            f"<p><b>{html(self.name)}</b>: nq = {self.nq}, nv = {self.nv}, "
            f"{self._mass_text()}{self._servos_text()}; {self.needs}</p>"
            f"<table><tr>{head}</tr>{cells}</table>" + (f"<ul>{notes}</ul>" if notes else "")
        )
