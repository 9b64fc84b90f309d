"""`ModelBuilder`: collect the parts of a system, and report all faults at once."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike

from mbkit import spatial
from mbkit._check import TYPED, Array, finite_array, real, real_array, shown
from mbkit._reproducible import length
from mbkit.errors import InputError, ModelError, NonPhysicalWarning, nearest
from mbkit.model.elements.declare import ElementBuilder
from mbkit.model.elements.editing import NUMBERS_OF_JOINTS, EditingBuilder, restitution_of
from mbkit.model.elements.references import KINDS_OF_PARTS
from mbkit.model.joint_types import FIXED, KINDS, JointType, kind_of
from mbkit.model.loops import LOOP_KINDS, ROLLING_KINDS, LoopKind, RollingKind
from mbkit.model.model import Model, unchecked
from mbkit.model.parameters import Binding, Expression, Number, nominal, split
from mbkit.model.parts import Body, Frame, Joint, JointCoupling, Loop, Mimic, NoSlip, NumberRule, PointSpring, rules_of
from mbkit.model.stops import stop_faults
from mbkit.model.validation import body_faults, fault_sentences, static_bodies, structure_faults, suspects

# The squares of sums of such lengths still fit a double.
MAX_LENGTH: Final = 1e150
MAX_NAME_LENGTH: Final = 1000
#: Types of a vector, and of one number or several, in the builder's methods.
_Vector = ArrayLike | Sequence[Number]
_Numbers = ArrayLike | Sequence[Number] | Number


class ArgumentReader:
    """Converts arguments to arrays and numbers, and collects their faults; a harmless value replaces a faulty one."""

    def __init__(self) -> None:
        self.faults: list[str] = []

    def name(self, what: str, value: Any, longest: int = MAX_NAME_LENGTH) -> str:
        """Return a name: text that UTF-8 can hold, short enough for a message."""
        if not isinstance(value, str):
            self.faults.append(f"{what}: expected a name, got {shown(value)}")
            return shown(value)
        text = value.encode("utf-8", "backslashreplace").decode()
        if text != value:
            self.faults.append(f"{what}: expected text, got lone surrogates, which UTF-8 cannot hold: {text[:60]!r}")
        if len(text) > longest:
            self.faults.append(f"{what}: expected up to {longest} characters, got {len(text)}")
        return text[:longest]

    def names(self, what: str, value: Any) -> str | tuple[str, ...]:
        """Return a name, or a tuple of none or several."""
        if not isinstance(value, (list, tuple)):
            return self.name(what, value)
        several = tuple(self.name(f"{what}[{i}]", x) for i, x in enumerate(value))
        return several[0] if len(several) == 1 else several

    def choice(self, item: str, what: str, value: Any, known: Collection[str]) -> str:
        """Return one of these words; the first after a fault."""
        if isinstance(value, str) and value in known:
            return value
        self.faults.append(f"{item}: unknown {what} {shown(value)}; there are {', '.join(map(repr, known))}")
        return next(iter(known))

    def array(self, name: str, value: Any, shape: tuple[int, ...], *, each: bool = False) -> Array:
        """Return finite numbers; a single one stands for `each` of a vector that says so, as of velocities."""
        try:
            if shape_of(value) == () and not _has_expressions(value):
                number = real(name, value)
                if not each:
                    raise InputError(f"{name}: expected shape {shape}, got the single number {number:g}")
                value = np.full(shape, number)
            return finite_array(name, value, shape)
        except InputError as error:
            self._refuse(error, value)
            return np.eye(3) if shape == (3, 3) else np.zeros(shape)

    def real(self, name: str, value: Any) -> float:
        """Return a finite number."""
        try:
            return real(name, value)
        except InputError as error:
            self._refuse(error, value)
            return 0.0

    def _refuse(self, error: InputError, value: Any) -> None:
        hint = "; no parameter can stand here, give a number" if _has_expressions(value) else ""
        self.faults.append(f"{error}{hint}")

    def quantity(self, name: str, value: Any) -> Number:
        """Return a finite number, or an expression of parameters."""
        if not isinstance(value, Expression):
            return self.real(name, value)
        try:
            nominal(value)
        except InputError as error:
            self.faults.append(f"{name}: {error}")
            return 0.0
        return value

    def quantities(self, name: str, value: Any, n: int, *, each: bool = False) -> Array:
        """Return n finite numbers or expressions, of dtype object where there are any; `each` as of `array`."""
        if not _has_expressions(value):
            return self.array(name, value, (n,), each=each)
        array = np.array(value, dtype=object)
        if each and array.ndim == 0:
            array = np.full(n, value, dtype=object)
        if array.shape != (n,):
            self.faults.append(f"{name}: expected shape ({n},), got {array.shape}")
            return np.zeros(n)
        return np.array([self.quantity(f"{name}[{i}]", x) for i, x in enumerate(array)], dtype=object)

    def place(self, name: str, value: Any) -> Array:
        """Return three lengths, or expressions, whose squares do not overflow."""
        lengths = self.quantities(name, value, 3)
        largest = max(abs(nominal(x)) for x in lengths)
        if largest > MAX_LENGTH:
            self.faults.append(f"{name}: expected lengths up to {MAX_LENGTH:g} m, got {largest:g}")
            return np.zeros(3)
        return lengths

    def inertia(self, name: str, value: Any) -> Array:
        """Return a symmetric 3 by 3 matrix of a matrix or its diagonal, or zeros for None."""
        if value is None:
            return np.zeros((3, 3))
        if shape_of(value) == (3,):
            return np.diag(self.quantities(name, value, 3))
        if not _has_expressions(value):
            matrix = self.array(name, value, (3, 3))
            if np.abs(matrix - matrix.T).max() > TYPED * np.abs(matrix).max():
                self.faults.append(f"{name} is not symmetric; expected I = Iᵀ")
            return np.asarray((matrix + matrix.T) / 2)
        if shape_of(value) != (3, 3):
            self.faults.append(f"{name}: expected shape (3, 3), got {shape_of(value)}")
            return np.eye(3)
        matrix = np.array([self.quantities(name, row, 3) for row in np.array(value, dtype=object)], dtype=object)
        if any(matrix[i, j] != matrix[j, i] for i, j in ((0, 1), (0, 2), (1, 2))):
            self.faults.append(f"{name} is not symmetric; expected the same expression on both sides of the diagonal")
            return np.eye(3)
        return matrix

    def limits(self, name: str, value: ArrayLike, n: int, default: float) -> Array:
        """Return n numbers, which may be infinite; `default` after a fault."""
        try:
            array = real_array(name, value)
        except InputError:
            array = np.full(n, np.nan)
        if array.ndim == 0:
            array = np.full(n, float(array))
        if array.shape != (n,) or np.isnan(array).any():
            self.faults.append(f"{name}: expected {n} numbers (infinite where there is no limit), got {shown(value)}")
            return np.full(n, default)
        return array

    def rotation(self, name: str, value: ArrayLike | None) -> Array:
        """Return a rotation matrix; the identity for None."""
        if value is None:
            return np.eye(3)
        R = self.array(name, value, (3, 3))
        if np.abs(R @ R.T - np.eye(3)).max() > TYPED or np.linalg.det(R) < 0:
            self.faults.append(f"{name} is not a rotation matrix; expected R Rᵀ = 1 and det R = 1")
            return np.eye(3)
        return R

    def orientation(self, item: str, rotation: ArrayLike | None, rpy: ArrayLike | None) -> Array:
        """Return the matrix of a rotation matrix or of roll, pitch, yaw."""
        if rotation is not None and rpy is not None:
            self.faults.append(f"{item}: expected rotation or rpy, got both; give one")
        if rpy is not None:
            return spatial.matrix_from_rpy(*self.array(f"{item}: rpy", rpy, (3,)))
        return self.rotation(f"{item}: rotation", rotation)

    def axes(self, item: str, type_: JointType, *vectors: ArrayLike | None) -> Array:
        """Return the unit axes of a joint of this type."""
        n = type_.n_axes
        axes: list[ArrayLike] = [a for a in vectors if a is not None]
        if len(axes) != n:
            names = ("no axis", "axis", "axis and axis2")[n]
            self.faults.append(f"{item}: a {type_.name} joint takes {names}, got {len(axes)}")
            axes = list(np.eye(3)[:n])
        out = np.zeros((n, 3))
        for i, a in enumerate(axes):
            out[i] = self.direction(f"{item}: axis", a)
        return out

    def direction(self, name: str, value: ArrayLike | None) -> Array:
        """Return a unit vector; zeros for None."""
        if value is None:
            return np.zeros(3)
        known = len(self.faults)
        vector = self.array(name, value, (3,))
        if len(self.faults) > known:
            return np.array([1.0, 0.0, 0.0])
        # The square of a component may overflow, or vanish.
        largest = float(np.abs(vector).max())
        if largest and not 1e-100 < largest < 1e100:
            vector = vector / largest
        size = length(vector)
        if not size:
            self.faults.append(f"{name} is zero; expected a direction")
            vector, size = np.array([1.0, 0.0, 0.0]), 1.0
        # A unit vector to rounding keeps its bits.
        return vector if abs(size - 1) < 1e-15 else np.asarray(vector / size)

    def mimic(self, item: str, value: Mimic | Iterable[Any]) -> tuple[str, dict[str, Number]] | None:
        """Return the leader of a mimic joint, and ratio and offset; None after a fault."""
        if isinstance(value, Mimic):
            value = (value.joint, value.ratio, value.offset)
        try:
            joint, ratio, offset = value
        except Exception:
            # Any: iterating over an object may raise what it likes.
            self.faults.append(f"{item}: mimic: expected (joint, ratio, offset), got {shown(value)}")
            return None
        numbers = {n: self.quantity(f"{item}: mimic {n}", x) for n, x in (("ratio", ratio), ("offset", offset))}
        return self.name(f"{item}: mimic joint", joint), numbers


#: How fields of parts are read that are no numbers, and numbers with a meaning beside their shape.
_READERS: Final[Mapping[str, Callable[[ArgumentReader, str, Any], Any]]] = {
    **dict.fromkeys(("parent", "child", "body", "body_a", "body_b", "joint"), ArgumentReader.name),
    "inertia": ArgumentReader.inertia,
    "joints": lambda read, name, value: tuple(read.name(name, x) for x in value),
    "leader": ArgumentReader.names,
    "factors": lambda read, name, value: read.quantities(name, value, np.size(value)),
}


def _reader(rule: NumberRule) -> Callable[[ArgumentReader, str, Any], Any]:
    """Return how a number with this rule is read."""
    if rule.direction:
        return ArgumentReader.rotation if rule.shape == (3, 3) else ArgumentReader.direction
    if rule.shape == (3,):
        return ArgumentReader.place
    return ArgumentReader.quantity if rule.shape == () else lambda read, name, value: read.quantities(name, value, 3)


def _has_expressions(value: Any, depth: int = 3) -> bool:
    """Return whether any entry of a number, array or nested sequence is an expression; matrices are the deepest."""
    if isinstance(value, np.ndarray):
        return value.dtype == object and any(_has_expressions(x, 0) for x in value.flat)
    if isinstance(value, (list, tuple)):
        return depth > 0 and any(_has_expressions(x, depth - 1) for x in value)
    return isinstance(value, Expression)


def shape_of(value: Any) -> tuple[int, ...] | None:
    """Return the shape, or None for a ragged list and other objects without one."""
    try:
        return tuple(np.shape(value))
    except Exception:
        # Any: objects may bring conversions of their own.
        return None


class ModelBuilder(ElementBuilder, EditingBuilder):
    """Collects bodies, joints and forces, and builds a frozen `Model` of them.

    A faulty call is remembered and not raised: `build` reports all faults in one `ModelError`. Parts may be declared
    in any order; coordinates follow the order of the joints. Masses, lengths, inertias, constants of springs and
    dampers, of motions in time, and gravity may be a `Parameter` or an expression of some.

    Parameters
    ----------
    name : str
        Name of the system.
    gravity : (3,) array_like
        m/s², in world axes.

    Examples
    --------
    >>> import mbkit as mb
    >>> b = mb.ModelBuilder("pendulum")
    >>> b.add_body("bob", mass=1.0, com=(0, 0, -1.0))
    >>> b.add_joint("hinge", "revolute", parent="world", child="bob", axis=(0, 1, 0))
    >>> b.build().nv
    1
    """

    def __init__(self, name: str, gravity: _Vector = (0.0, 0.0, -9.81)) -> None:
        self._read = ArgumentReader()
        self._name = self._read.name("name", name)
        self._bindings: list[Binding] = []
        self._gravity = self._numbers("gravity", "", gravity=self._read.quantities("gravity", gravity, 3))["gravity"]
        self._parts: dict[str, list[Any]] = {kind: [] for kind in KINDS_OF_PARTS}
        self._notes: list[str] = []
        #: For a model that is edited: bodies that were used as written, and where its shapes are.
        self._odd: set[str] = set()
        self._sources: list[Any] = []
        self._locked: list[tuple[Any, ...]] = []
        self._time = 0.0

    def add_body(
        self,
        name: str,
        *,
        mass: Number = 0.0,
        com: _Vector = (0.0, 0.0, 0.0),
        inertia: ArrayLike | Sequence[Any] | None = None,
    ) -> None:
        """Add a rigid body.

        Parameters
        ----------
        name : str
        mass : float
            kg; zero for a frame.
        com : (3,) array_like
            Centre of mass in body axes, m.
        inertia : (3, 3) or (3,) array_like, optional
            About the centre of mass, in body axes (or its diagonal), kg m². Without it the body is a point mass.
        """
        self._add(Body, "body", name, {"mass": mass, "com": com, "inertia": inertia})

    def add_joint(
        self,
        name: str,
        kind: str,
        *,
        parent: str,
        child: str,
        translation: _Vector = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
        axis: ArrayLike | None = None,
        axis2: ArrayLike | None = None,
        pitch: Number = 0.0,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        velocity_limit: ArrayLike | None = None,
        effort_limit: ArrayLike | None = None,
        armature: _Numbers = 0.0,
        damping: _Numbers = 0.0,
        friction: ArrayLike = 0.0,
        stiffness: _Numbers = 0.0,
        rest: _Numbers = 0.0,
        stiction: ArrayLike | None = None,
        stribeck_velocity: ArrayLike | None = None,
        mimic: Mimic | tuple[str, Number, Number] | None = None,
        stops: bool = False,
        restitution: ArrayLike | None = None,
    ) -> None:
        """Add the joint that carries `child`.

        Parameters
        ----------
        name, kind : str
            `kind` is one of fixed, revolute, continuous, prismatic, helical, universal, spherical_zyx, ball, planar,
            free.
        parent, child : str
            Names of bodies; `parent` may be ``"world"``.
        translation : (3,) array_like
            Origin of the joint's frame in the parent's axes, m.
        rotation, rpy : (3, 3) or (3,) array_like, optional
            Orientation of the joint's frame in the parent: a matrix, or URDF's roll, pitch, yaw in rad. At most one.
        axis, axis2 : (3,) array_like, optional
            Axes in the joint's frame; normalized here. A universal joint takes two; ball, planar, spherical_zyx and
            free take none.
        pitch : float
            Helical: metres per radian.
        lower, upper, velocity_limit, effort_limit : float, (nq,) or (nv,) array_like, optional
            Data, not dynamics, without `stops`.
        armature : float
            Added to M's diagonal, kg m² (kg for a prismatic joint); joints of one velocity, and ball joints.
        damping, stiffness, rest : float or (nv,) array_like
            N m s/rad (N s/m), and a spring's torque -stiffness (q - rest), not for ball and free joints.
        friction, stiction, stribeck_velocity : float or (nv,) array_like, optional
            Dry friction, N m or N; the largest at rest, if another; and the velocity at which it falls to the first.
        mimic : Mimic or (joint, ratio, offset), optional
            The joint that this one follows.
        stops : bool
            Whether `lower` and `upper` are rigid stops, also of a joint that follows another.
        restitution : float or (nv,) array_like, optional
            Newton's e of an impact on a stop, from 0, the default, to 1.
        """
        read = self._read
        name = read.name("joint name", name)
        item = f"joint {name!r}"
        limits = lower, upper, velocity_limit, effort_limit
        numbers: Sequence[Any] = *limits, armature, damping, friction, stiffness, rest, stiction, stribeck_velocity
        numbers = *numbers, restitution_of(read, name, stops, restitution)
        if not isinstance(kind, str) or kind not in KINDS:
            near = nearest(kind, KINDS) if isinstance(kind, str) else []
            read.faults.append(f"{item}: unknown kind {shown(kind)}; use one of {', '.join(near or KINDS)}")
            # The other faults of this call would follow from this one.
            kind, axis, axis2, pitch, mimic, numbers = FIXED.name, None, None, 0.0, None, ()
        given = dict[str, Any]((n, x) for n, x in zip(NUMBERS_OF_JOINTS, numbers, strict=False) if x is not None)
        given |= {"axes": (axis, axis2)} | ({} if mimic is None else {"mimic": mimic})
        turn = {"kind": kind, "rotation": read.orientation(item, rotation, rpy)}
        ready = turn | self._joint_fields(name, kind_of(kind), given)
        if (follows := ready.pop("mimic", None)) is not None:
            ready["mimic"] = Mimic(follows[0], **self._numbers("joints", name, **follows[1]))
        values = {"parent": parent, "child": child, "translation": translation, "pitch": pitch}
        fields = self._numbers("joints", name, **self._read_fields(Joint, item, values), **ready)
        self._parts["joints"].append(Joint._of(name, **fields))

    def _joint_fields(self, name: str, type_: JointType, given: Mapping[str, Any]) -> dict[str, Any]:
        """Return what a joint's arguments say, by field; of a mimic the leader, and ratio and offset."""
        read, out = self._read, {}
        for field, x in given.items():
            item, rule = f"joint {name!r}: {field}", rules_of(Joint).get(field)
            if field == "axes":
                out[field] = read.axes(f"joint {name!r}", type_, *x)
            elif rule is None:
                out |= {} if (follows := read.mimic(f"joint {name!r}", x)) is None else {field: follows}
            elif not rule.acts:
                out[field] = read.limits(item, x, type_.nq if field in ("lower", "upper") else type_.nv, rule.nothing)
            elif rule.fixed:
                out[field] = read.array(item, x, (type_.nv,), each=True)
            else:
                out[field] = read.quantities(item, x, type_.nv, each=True)
        return out

    def add_frame(
        self,
        name: str,
        *,
        body: str,
        translation: _Vector = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
    ) -> None:
        """Name a frame that is fixed to a body, for poses and Jacobians.

        Parameters
        ----------
        name, body : str
        translation : (3,) array_like
            Origin in body axes, m.
        rotation, rpy : (3, 3) or (3,) array_like, optional
            Orientation: a matrix, or URDF's roll, pitch, yaw in rad. At most one.
        """
        R = self._read.orientation(f"frame {shown(name)}", rotation, rpy)
        self._add(Frame, "frame", name, {"body": body, "translation": translation}, {"rotation": R})

    def add_spring(
        self,
        name: str,
        *,
        body_a: str,
        body_b: str,
        point_a: _Vector = (0.0, 0.0, 0.0),
        point_b: _Vector = (0.0, 0.0, 0.0),
        stiffness: Number = 0.0,
        rest_length: Number = 0.0,
        damping: Number = 0.0,
    ) -> None:
        """Add a spring and damper along the line between two points.

        Where the points meet, a damper or a rest length has no direction to act in, and every engine raises
        `NumericalError`. A joint's own spring and damper have no such pose.

        Parameters
        ----------
        name, body_a, body_b : str
            A body may be ``"world"``.
        point_a, point_b : (3,) array_like
            In the axes of the two bodies, m.
        stiffness, rest_length, damping : float
            N/m, m, and N s/m on the rate of the distance.
        """
        ends = {"body_a": body_a, "point_a": point_a, "body_b": body_b, "point_b": point_b}
        numbers = {"stiffness": stiffness, "rest_length": rest_length, "damping": damping}
        self._add(PointSpring, "spring", name, ends | numbers)

    def add_coupling(
        self,
        name: str,
        factors: Mapping[str, Number],
        *,
        stiffness: Number = 0.0,
        rest_length: Number = 0.0,
        damping: Number = 0.0,
        armature: Number = 0.0,
    ) -> None:
        """Add a spring, damper and rotor on a weighted sum of joint coordinates, l = Σ factor q.

        Parameters
        ----------
        name : str
        factors : mapping of str to float
            Joint name -> factor; joints of one velocity.
        stiffness, rest_length, damping, armature : float
            The potential energy is ½ stiffness (l - rest_length)², the power lost damping (dl/dt)², and the kinetic
            energy ½ armature (dl/dt)².
        """
        value: Any = factors
        if not isinstance(value, Mapping):
            expected = f"expected a mapping from joint names to numbers, got {shown(value)}"
            self._read.faults.append(f"coupling {shown(name)}: factors: {expected}")
            return
        numbers = {"rest_length": rest_length, "stiffness": stiffness, "damping": damping, "armature": armature}
        values = {"joints": [*factors], "factors": [*factors.values()], **numbers}
        self._add(JointCoupling, "coupling", name, values)

    def add_loop(
        self,
        name: str,
        kind: LoopKind,
        *,
        body_a: str,
        body_b: str,
        translation_a: _Vector = (0.0, 0.0, 0.0),
        rotation_a: ArrayLike | None = None,
        translation_b: _Vector = (0.0, 0.0, 0.0),
        rotation_b: ArrayLike | None = None,
        length: Number = 0.0,
    ) -> None:
        """Close a loop by a joint between two bodies that the tree has already placed.

        Parameters
        ----------
        name, body_a, body_b : str
            One body may be ``"world"``.
        kind : {"point", "frame", "revolute", "universal", "cylindrical", "prismatic", "distance"}
            Points that coincide, as in a ball joint (in a plane: a hinge), or frames that do, as if welded. The next
            four are joints: the frames' z-axes are that of a hinge or slider, and the two of a universal joint. The
            last is a rod between the points, without mass.
        translation_a, translation_b : (3,) array_like
            The points, or the frames' origins, in the axes of the two bodies, m.
        rotation_a, rotation_b : (3, 3) array_like, optional
            The frames' orientations in their bodies.
        length : float
            Of a rod, m; of no other kind.
        """
        ready = {"kind": self._read.choice(f"loop {shown(name)}", "kind", kind, LOOP_KINDS)}
        a = {"body_a": body_a, "rotation_a": rotation_a, "translation_a": translation_a}
        b = {"body_b": body_b, "rotation_b": rotation_b, "translation_b": translation_b}
        self._add(Loop, "loop", name, a | b | {"length": length}, ready)

    def add_blade(
        self,
        name: str,
        *,
        body_a: str,
        body_b: str = "world",
        translation_a: _Vector = (0.0, 0.0, 0.0),
        axis_a: ArrayLike | None = None,
        axis_b: ArrayLike | None = None,
        speed: Number = 0.0,
    ) -> None:
        """Let a point of a body have no velocity along a direction: a blade, knife edge, or wheel without side slip.

        The row holds velocities alone. Two blades of a car are its axles; steering axes are ordinary joints.

        Parameters
        ----------
        name, body_a, body_b : str
            Body b sees the velocity; one body may be ``"world"``.
        translation_a : (3,) array_like
            The point in the axes of body a, m.
        axis_a, axis_b : (3,) array_like, optional
            The direction in the axes of body a, or in those of body b; one of them. Normalized here.
        speed : float
            Velocity along the direction instead of zero, m/s, such as that of a conveyor.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("skate", gravity=(0, 0, 0))
        >>> b.add_body("skate", mass=1.0, inertia=(0.1, 0.1, 0.1))
        >>> b.add_joint("glide", "planar", parent="world", child="skate")
        >>> b.add_blade("edge", body_a="skate", axis_a=(0, 1, 0))
        >>> print(mb.dynamics(b.build(), "lagrangian").mobility())
        skate: degrees of freedom 2 of velocity and 3 of configuration, of 1 row none is redundant
        """
        a = {"body_a": body_a, "translation_a": translation_a, "axis_a": axis_a}
        b = {"body_b": body_b, "axis_b": axis_b, "speed": speed}
        ready = {"kind": "blade", "translation_b": np.zeros(3)}
        self._add(NoSlip, "no slip", name, a | b, ready)

    def add_rolling(
        self,
        name: str,
        kind: RollingKind,
        *,
        body_a: str,
        radius: Number,
        translation_a: _Vector = (0.0, 0.0, 0.0),
        axis_a: ArrayLike | None = None,
        body_b: str = "world",
        translation_b: _Vector = (0.0, 0.0, 0.0),
        axis_b: ArrayLike = (0.0, 0.0, 1.0),
    ) -> None:
        """Let a body roll on a plane without slip, as a thin disc or a sphere.

        One row holds the height of the centre, a position; two hold the velocity of the contact point along the plane.
        It is kept even where the plane would have to pull. A disc that lies flat on its plane touches in no single
        point: engines raise `NumericalError` there.

        Parameters
        ----------
        name, body_a, body_b : str
            Body a rolls on a plane of body b, by default of the ground.
        kind : {"disc", "sphere"}
            A wheel is a disc.
        radius : float
            m.
        translation_a : (3,) array_like
            The centre in the axes of body a, m.
        axis_a : (3,) array_like, optional
            Of a disc, its axis in the axes of body a; a sphere has none. Turning positively about it, the disc rolls
            forward along axis x normal. Normalized here.
        translation_b, axis_b : (3,) array_like
            A point and the normal of the plane in the axes of body b, m; the body is on the side of the normal.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("marble")
        >>> b.add_body("marble", mass=0.1, inertia=(4e-6, 4e-6, 4e-6))
        >>> b.add_joint("move", "free", parent="world", child="marble", translation=(0, 0, 0.01))
        >>> b.add_rolling("floor", "sphere", body_a="marble", radius=0.01)
        >>> mb.dynamics(b.build(), "lagrangian").mobility().degrees_of_freedom
        3
        """
        ready = {"kind": self._read.choice(f"no slip {shown(name)}", "kind", kind, ROLLING_KINDS)}
        a = {"body_a": body_a, "translation_a": translation_a, "axis_a": axis_a, "radius": radius}
        b = {"body_b": body_b, "translation_b": translation_b, "axis_b": axis_b}
        self._add(NoSlip, "no slip", name, a | b, ready)

    def note(self, text: str) -> None:
        """Add a sentence to the model's notes."""
        self._notes.append(self._read.name("note text", text, longest=1_000_000))

    def build(
        self,
        *,
        nonphysical: Literal["error", "warn"] = "error",
        point_masses: bool = True,
        parts: Mapping[str, Sequence[tuple[str, str]]] | None = None,
    ) -> Model:
        """Check everything and return the frozen model.

        Parameters
        ----------
        nonphysical : {"error", "warn"}
            Raise for bodies with an inconsistent inertia (not positive, against the triangle inequality, or joints
            that move no inertia), or keep them as written and warn. Of a body that is fixed to the world only a
            negative mass counts; the rest is noted.
        point_masses : bool
            Whether a mass without inertia is meant that way.
        parts : mapping of str to sequence of (str, str), optional
            Of bodies merged from several links the faulty ones, each with the reason, for messages.

        Raises
        ------
        ModelError
            With every fault.
        """
        if not isinstance(nonphysical, str) or nonphysical not in ("error", "warn"):
            raise InputError(f"nonphysical: expected 'error' or 'warn', got {shown(nonphysical)}")
        if not isinstance(point_masses, bool):
            raise InputError(f"point_masses: expected True or False, got {shown(point_masses)}")
        if parts is not None and not isinstance(parts, Mapping):
            raise InputError(f"parts: expected a mapping from bodies to links, got {shown(parts)}")
        parts = parts or {}
        bodies, joints = self._parts["bodies"], self._parts["joints"]
        model = self._assemble(joints, self._bindings)
        faults = [*self._read.faults, *structure_faults(model), *self._two_valued()]
        inconsistent = body_faults(bodies, point_masses=point_masses)
        if not faults:
            # Mimic joints without leaders, and joints that move nothing, are for a connected tree only.
            model = self._assemble(*_resolve(joints, self._bindings))
            faults = [*stop_faults(model)]
            inconsistent = suspects(model, point_masses=point_masses)
        # Bodies that a model was used with already stay used.
        known = {n for n, _ in inconsistent} & self._odd
        negative = {b.name for b in bodies if b.mass < 0}
        static = static_bodies(joints) - negative
        idle = fault_sentences([(n, why) for n, why in inconsistent if n in static], parts)
        inconsistent = tuple((n, why) for n, why in inconsistent if n not in static)
        if nonphysical == "error" and (refused := [(n, why) for n, why in inconsistent if n not in negative | known]):
            faults += fault_sentences(refused, parts)
            faults[-1] += '; correct it, or take it as written with nonphysical="warn"'
        faults += fault_sentences([(n, why) for n, why in inconsistent if n in negative], parts)
        if faults:
            raise ModelError(self._name, faults)
        if new := [(n, why) for n, why in inconsistent if n not in known]:
            impossible = "; ".join(fault_sentences(new, parts))
            message = f"{self._name}: physically impossible, used as written: {impossible}"
            warnings.warn(message, NonPhysicalWarning, stacklevel=2)
        notes = dict.fromkeys((*model.notes, *(f"never moves, so this cannot act: {text}" for text in idle)))
        # Tables of motions need not begin at time 0.
        with unchecked():
            return replace(
                model, notes=(*notes,), nonphysical=inconsistent, time=float(np.clip(self._time, *model.interval))
            )

    def _add(
        self,
        part: type[Any],
        what: str,
        name: Any,
        values: Mapping[str, Any],
        ready: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        """Read a part's fields by `_READERS`, keep the bindings of its expressions, and add it."""
        name = self._read.name(f"{what} name", name)
        numbers = self._numbers(part.section, name, **self._read_fields(part, f"{what} {name!r}", values), **ready)
        self._parts[part.section].append(part(name, **numbers))

    def _read_fields(self, part: type, item: str, values: Mapping[str, Any]) -> dict[str, Any]:
        return {
            n: (_READERS.get(n) or _reader(rules_of(part)[n]))(self._read, f"{item}: {n}", x) for n, x in values.items()
        }

    def _holding(self) -> Model:
        return self._assemble(self._parts["joints"], self._bindings)

    def _numbers(self, where: str, part: str, **fields: Any) -> dict[str, Any]:
        """Return a part's fields as floats, and remember which of them stand for expressions."""
        numbers, bindings = split(where, part, fields)
        self._bindings += bindings
        return numbers

    def _two_valued(self) -> list[str]:
        values: dict[str, float | None] = {}
        return [
            f"parameter {p.name!r}: two values, {values[p.name]} and {p.value}; one name is one parameter"
            for p in dict.fromkeys(p for b in self._bindings for p in b.expression.parameters())
            if values.setdefault(p.name, p.value) != p.value
        ]

    def _assemble(self, joints: Iterable[Joint], bindings: Iterable[Binding]) -> Model:
        parts: dict[str, Any] = {kind: tuple(parts) for kind, parts in self._parts.items()} | {"joints": tuple(joints)}
        # `build` tells all faults at once.
        with unchecked():
            return Model(
                name=self._name,
                gravity=self._gravity,
                notes=tuple(self._notes),
                bindings=tuple(bindings),
                drawn_from=tuple(self._sources),
                locked=tuple(self._locked),
                **parts,
            )


def with_loops(model: Model, loops: Iterable[Mapping[str, Any]]) -> Model:
    """Return a model with more loops, given by the arguments of `ModelBuilder.add_loop`; a `ModelError` of all faults.

    What the file of a robot cannot hold is added here to the model that was read.
    """
    b = ModelBuilder(model.name)
    for one in loops:
        b.add_loop(**one)
    bindings = (*model.bindings, *b._bindings)
    with unchecked():
        added = replace(model, loops=(*model.loops, *b._parts["loops"]), bindings=bindings)
    if faults := [*b._read.faults, *structure_faults(added)]:
        raise ModelError(model.name, faults)
    return added


def _resolve(joints: Iterable[Joint], bindings: Iterable[Binding]) -> tuple[tuple[Joint, ...], tuple[Binding, ...]]:
    """Make every mimic joint follow a joint that is independent."""
    by_name = {j.name: j for j in joints}
    bound: dict[tuple[str, str], Number] = {(b.part, b.field): b.expression for b in bindings if b.where == "joints"}
    changed = {}
    kept = list(bindings)
    for joint in by_name.values():
        if joint.mimic is None:
            continue
        at, ratio, offset = _leader_of(joint.name, joint.mimic, bound)
        while (further := by_name[at].mimic) is not None:
            at, r, o = _leader_of(at, further, bound)
            ratio, offset = ratio * r, ratio * o + offset
        numbers, new = split("joints", joint.name, {"ratio": ratio, "offset": offset})
        changed[joint.name] = replace(joint, mimic=Mimic(at, **numbers))
        kept = [b for b in kept if (b.where, b.part) != ("joints", joint.name) or b.field not in numbers]
        kept += new
    return tuple(changed.get(j.name, j) for j in by_name.values()), tuple(kept)


def _leader_of(joint: str, mimic: Mimic, bound: Mapping[tuple[str, str], Number]) -> tuple[str, Number, Number]:
    return mimic.joint, bound.get((joint, "ratio"), mimic.ratio), bound.get((joint, "offset"), mimic.offset)


def expect_model(value: Any, name: str = "model") -> Model:
    """Return an argument that is a `Model`, or raise `InputError` with the way to get one."""
    if isinstance(value, Model):
        return value
    holds = not isinstance(value, type) and isinstance(getattr(value, "model", None), Model)
    way = "its .model is one" if holds else "mbkit.load(...) makes one"
    raise InputError(f"{name}: expected a Model, got {type(value).__name__}; {way}")
