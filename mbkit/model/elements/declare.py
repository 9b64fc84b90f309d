"""The part of `ModelBuilder` for elements: beams, what couples joints, and forces, bushings and motions by formula."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Final, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from mbkit._check import MAX_MAGNITUDE, Array, shown
from mbkit._imports import from_above
from mbkit.errors import MbkitError
from mbkit.model.elements.beams import beam_types, modes_of
from mbkit.model.elements.forces import (
    DISPLACEMENT,
    POINT,
    RATE,
    TIME,
    TWIST,
    Bushing,
    FrameForce,
    GravityCompensation,
    JointForce,
)
from mbkit.model.elements.formula import Formula
from mbkit.model.elements.motion_laws import FormulaMotion, SplineMotion
from mbkit.model.joint_types import FIXED
from mbkit.model.parameters import Expression, Number, nominal
from mbkit.model.parts import Coupler, Prescribed

Axes = Literal["local", "local_world_aligned", "world"]
Ends = Literal["natural", "clamped", "quintic"]
_Vector = ArrayLike | Sequence[Number]
#: Limit of a beam's amplitudes together, as a part of its length.
_MAX_DEFLECTION_RATIO: Final = 0.1
#: Values by the names that stand for them in expressions.
Constants = Mapping[str, Number]


def _is_zero(x: Any) -> bool:
    return isinstance(x, (int, float)) and x == 0


class ElementBuilder:
    """Declares forces by functions, motions in time and what couples joints; `ModelBuilder` inherits it."""

    _read: Any
    _parts: dict[str, list[Any]]
    _add: Callable[..., None]
    _numbers: Callable[..., dict[str, Any]]
    add_body: Callable[..., None]
    add_joint: Callable[..., None]

    def prescribe(
        self,
        joint: str,
        law: Any = None,
        *,
        offset: Number = 0.0,
        rate: Number = 0.0,
        amplitude: Number = 0.0,
        frequency: Number = 0.0,
        phase: Number = 0.0,
        spline: Ends = "natural",
        parameters: Constants | None = None,
    ) -> None:
        """Move a one-velocity joint in time, by a law or by offset + rate t + amplitude sin(frequency t + phase).

        The joint keeps its coordinate, which a constraint holds on this motion; its multiplier is the drive's force.

        Parameters
        ----------
        joint : str
        law : object, optional
            An expression of a symbol ``t``, s, by CasADi (SX) or SymPy, or a function that returns one; a spline of
            SciPy: `PPoly`, such as `CubicSpline`, or `BSpline`; or a table, the pair (times, values). Its second
            derivative must be continuous. A spline or table is known from its first to its last time: a run or an
            evaluation beyond it is refused with the time.
        offset, rate, amplitude : float
            rad or m, per second for the rate; without a law.
        frequency, phase : float
            rad/s and rad.
        spline : {"natural", "clamped", "quintic"}
            Between the values of a table: a cubic spline without acceleration or at rest at its ends, or a quintic one
            at rest there without acceleration.
        parameters : dict of str to float, optional
            Constants of the expression by the names of their symbols; each may be a `Parameter`.

        Examples
        --------
        >>> import casadi as ca
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("arm")
        >>> b.add_body("link", mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.01))
        >>> b.add_joint("hinge", "revolute", parent="world", child="link", axis=(0, 1, 0))
        >>> t, w = ca.SX.sym("t"), ca.SX.sym("w")
        >>> b.prescribe("hinge", 0.5 * (1 - ca.cos(w * t)), parameters={"w": mb.Parameter("w", 2.0)})
        >>> dyn = mb.dynamics(b.build(), "lagrangian")
        >>> dyn.at(t=1.5).project([0.0], [0.0])[0].round(9).tolist()
        [0.994996248]
        """
        harmonic = {"offset": offset, "rate": rate, "amplitude": amplitude, "frequency": frequency, "phase": phase}
        if law is None:
            if parameters is not None:
                self._read.faults.append(f"prescribed {shown(joint)}: parameters without a law; give them as numbers")
            self._add(Prescribed, "prescribed", joint, harmonic)
            return
        item = f"prescribed {shown(joint)}"
        if given := [name for name, x in harmonic.items() if not _is_zero(x)]:
            self._read.faults.append(f"{item}: a law and {given[0]}; expected one of them")
        ends = self._read.choice(item, "spline", spline, get_args(Ends))
        good, pieces = self._asked(item, law, lambda: from_above("formulas").read_spline(law, ends))
        if not good:
            return
        if pieces is not None:
            ready = {"knots": pieces[0], "coefficients": pieces[1]}
            self._add(SplineMotion, "prescribed", joint, {}, ready)
            return
        formulas, constants = self._formulas(item, parameters, law=((law, 1),), given={"law": (TIME,)})
        if formulas["law"] is not None:
            self._add(FormulaMotion, "prescribed", joint, {}, {"formula": formulas["law"]} | constants)

    def add_coupler(
        self,
        name: str,
        joint: str,
        leader: str | Sequence[str],
        *,
        ratio: Number | Sequence[Number] | ArrayLike = 1.0,
        offset: Number = 0.0,
        curve: _Vector = (0.0, 0.0, 0.0),
    ) -> None:
        """Hold a joint's coordinate at a sum of others, q = Σ ratio leader + offset, by a constraint.

        A pair of gears, a belt, a screw; with several leaders an epicyclic train or a differential; with a curve a cam
        or a knee. Each joint keeps its coordinate; the multiplier is the torque on `joint`, between its parent and
        child, and in a leader acts -∂q/∂leader times it. A mimic joint has no coordinate, and is the cheaper one where
        it follows one joint and nothing else closes on it.

        Parameters
        ----------
        name : str
        joint : str
            A joint of one velocity, as every leader.
        leader : str or sequence of str
            The joint that leads, or several.
        ratio : float or (k,) array_like
            As rad or m of `joint` for rad or m of the leader; one number is that of each leader.
        offset : float
            rad or m.
        curve : (3,) array_like
            Coefficients of the second, third and fourth power of a single leader, which are added.

        Examples
        --------
        The ring gear of a differential turns at the mean of both wheels.

        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("differential", gravity=(0, 0, 0))
        >>> for part, inertia in (("left", 1.0), ("right", 1.0), ("ring", 2.0)):
        ...     b.add_body(part, mass=1.0, inertia=(inertia,) * 3)
        ...     b.add_joint(f"{part}_axle", "revolute", parent="world", child=part, axis=(0, 1, 0))
        >>> b.add_coupler("gears", "ring_axle", ("left_axle", "right_axle"), ratio=0.5)
        >>> mb.dynamics(b.build(), "lagrangian").forward_dynamics([0.0] * 3, [0.0] * 3, [0.0, 0.0, 4.0]).tolist()
        [1.0, 1.0, 1.0]
        """
        values = {"joint": joint, "leader": leader, "offset": offset, "curve": curve}
        ready = {"ratio": self._ratio(f"coupler {shown(name)}", leader, ratio)}
        self._add(Coupler, "coupler", name, values, ready)

    def _ratio(self, item: str, leader: Any, ratio: Any) -> Any:
        """Return a number or expression for one leader, an array of them for several."""
        several, known = isinstance(leader, (list, tuple)) and len(leader) != 1, len(self._read.faults)
        numbers = self._read.quantities(f"{item}: ratio", ratio, len(leader) if several else 1, each=True)
        # Zeros, which stand for faulty numbers, would be another fault.
        numbers = np.ones(len(numbers)) if len(self._read.faults) > known else numbers
        return numbers if several else numbers[0]

    def add_joint_force(
        self, name: str, joint: str, force: Any = None, *, potential: Any = None, parameters: Constants | None = None
    ) -> None:
        """Add a generalized force at a joint, a function of (t, q, v): a spring, a damper, a motor.

        It is one of the passive forces on every engine, and enters derivatives and linearizations exactly.

        Parameters
        ----------
        name, joint : str
        force : object, optional
            N m or N, one per velocity of the joint: an expression by CasADi (SX) or SymPy, or a function of (t, q, v)
            that returns one when it is called with symbols. Its symbols are ``t``, the joint's ``q`` and ``v`` (of a
            joint with several, ``q_0``, ``q_1``, ... as ``casadi.SX.sym("q", n)`` names them), and of the rest of the
            model the names of coordinates, and with ``_dot`` behind them of velocities: ``elbow``, ``elbow_dot``.
        potential : object, optional
            An energy of the same positions, J: the force is less its derivative, and `potential_energy` holds it.
        parameters : dict of str to float, optional
            Constants of the expressions by the names of their symbols; each may be a `Parameter`.

        Notes
        -----
        A function that needs numbers, such as a measured table or a controller with a memory, is no part of a
        description: it is the argument `torque` of `mbkit.simulate`.

        Examples
        --------
        A spring that hardens, and a damper that grows with the square of the speed:

        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("door")
        >>> b.add_body("leaf", mass=20.0, com=(0.4, 0, 0), inertia=(1.0, 1.0, 1.0))
        >>> b.add_joint("hinge", "revolute", parent="world", child="leaf", axis=(0, 0, 1))
        >>> b.add_joint_force("closer", "hinge", lambda t, q, v: -2.0 * abs(v) * v, potential=lambda q: 3.0 * q**4)
        >>> dyn = mb.dynamics(b.build())
        >>> dyn.passive([0.5], [1.0]).tolist(), dyn.potential_energy([0.5])
        ([-3.5], 0.1875)
        """
        item = f"force {shown(name)}"
        given = {"formula": (TIME, "q", "v"), "potential": ("q",)}
        formulas, constants = self._formulas(
            item, parameters, formula=((force, None),), potential=((potential, 1),), given=given
        )
        joint = self._read.name(f"{item}: joint", joint)
        self._add(JointForce, "force", name, {}, {"joint": joint} | formulas | constants)

    def add_force(
        self,
        name: str,
        frame: str,
        *,
        force: Any = None,
        moment: Any = None,
        axes: Axes = "local",
        potential: Any = None,
        parameters: Constants | None = None,
    ) -> None:
        """Add a force and a moment on a frame, constant or functions of the time and the state.

        Parameters
        ----------
        name : str
        frame : str
            The frame whose origin the force acts on, or a body's own frame.
        force, moment : (3,) sequence or object, optional
            N and N m. Numbers, `Parameter`, or expressions by CasADi (SX) or SymPy; or a function of (t, p, twist) that
            returns three. Symbols are ``t``; the origin's place ``x, y, z`` in the world, m; the frame's velocity
            ``vx, vy, vz, wx, wy, wz`` in `axes`, m/s and rad/s; and names of coordinates and velocities, as in
            `add_joint_force`.
        axes : {"local", "local_world_aligned", "world"}
            Of force, moment and velocity, as in `Dynamics.generalized_force`, but with the frame's own axes as the
            default: a part of the description, such as a thruster, moves with its body.
        potential : object, optional
            An energy V(x, y, z), also of coordinates, J: the force is less its gradient; a function is one of p.
        parameters : dict of str to float, optional
            Constants of the expressions by the names of their symbols; each may be a `Parameter`.

        Examples
        --------
        Drag against the square of the speed:

        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("ball")
        >>> b.add_body("ball", mass=1.0, inertia=(0.1, 0.1, 0.1))
        >>> b.add_joint("free", "free", parent="world", child="ball")
        >>> def drag(t, p, twist):
        ...     speed = (twist[0] ** 2 + twist[1] ** 2 + twist[2] ** 2) ** 0.5
        ...     return -0.1 * speed * twist[:3]
        >>> b.add_force("drag", "ball", force=drag)
        >>> dyn = mb.dynamics(b.build())
        >>> dyn.passive([0, 0, 0, 0, 0, 0, 1], [2.0, 0, 0, 0, 0, 0])[:1].round(9).tolist()
        [-0.4]
        """
        item = f"force {shown(name)}"
        own = self._read.choice(item, "axes", axes, get_args(Axes))
        parts = None if force is None and moment is None else [(0.0,) * 3 if x is None else x for x in (force, moment)]
        given = {"formula": (TIME, POINT, TWIST), "potential": (POINT,)}
        formulas, constants = self._formulas(
            item,
            parameters,
            formula=((None, 6),) if parts is None else tuple((x, 3) for x in parts),
            potential=((potential, 1),),
            given=given,
        )
        frame = self._read.name(f"{item}: frame", frame)
        self._add(FrameForce, "force", name, {}, {"frame": frame, "axes": own} | formulas | constants)

    def add_gravity_compensation(self, body: str, fraction: Number = 1.0, *, without: Sequence[str] = ()) -> None:
        """Hold a part of a body's weight by a force at its centre of mass, as MuJoCo's ``gravcomp`` does.

        The force -fraction m g, N, is one of the passive forces; `gravity` and `nle` keep the whole weight. It has a
        potential energy, unless joints are left out.

        Parameters
        ----------
        body : str
            It has one compensation at most.
        fraction : float
            Of the weight: 1 holds all of it, and more lifts the body. It may be a `Parameter`.
        without : sequence of str
            Joints at which it does not act, as where actuators take its part.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("arm")
        >>> b.add_body("link", mass=2.0, com=(0.5, 0, 0), inertia=(0.1, 0.1, 0.1))
        >>> b.add_joint("hinge", "revolute", parent="world", child="link", axis=(0, -1, 0))
        >>> b.add_gravity_compensation("link", 0.75)
        >>> dyn = mb.dynamics(b.build())
        >>> [x.round(9).tolist() for x in (dyn.gravity([0.0]), dyn.passive([0.0], [0.0]))]
        [[9.81], [7.3575]]
        """
        body = self._read.name("gravity compensation: body", body)
        name = GravityCompensation.named(body)
        joints = tuple(without) if isinstance(without, (list, tuple)) else (without,)
        fixed = tuple(self._read.name(f"{name}: without", x) for x in joints)
        numbers = self._numbers("forces", name, fraction=self._read.quantity(f"force {name!r}: fraction", fraction))
        self._parts["forces"].append(GravityCompensation(body, without=fixed, **numbers))

    def add_bushing(
        self,
        name: str,
        *,
        body_a: str,
        body_b: str,
        translation_a: _Vector = (0.0, 0.0, 0.0),
        rotation_a: ArrayLike | None = None,
        translation_b: _Vector = (0.0, 0.0, 0.0),
        rotation_b: ArrayLike | None = None,
        stiffness: Any = 0.0,
        damping: Any = 0.0,
        force: Any = None,
        potential: Any = None,
        parameters: Constants | None = None,
    ) -> None:
        """Join two bodies by springs and dampers in all six directions.

        The displacement x is the position of frame b's origin and the rotation vector of frame b, in frame a. On it
        acts -(stiffness x + damping ẋ) and, where they are given, a function and a potential; the forces on both bodies
        follow from their virtual work, so that the elastic part has an energy however far it is displaced. Rotations
        go up to half a turn, near which digits are lost.

        Parameters
        ----------
        name, body_a, body_b : str
            A body may be ``"world"``.
        translation_a, translation_b : (3,) array_like
            Origins of the frames, in the axes of the two bodies, m.
        rotation_a, rotation_b : (3, 3) array_like, optional
            Orientations of the frames in their bodies.
        stiffness, damping : float, (6,) or (6, 6) array_like
            Of x: N/m and N m/rad, N s/m and N m s/rad; a diagonal or a matrix. Numbers or `Parameter`.
        force : object, optional
            The six forces on x, N and N m, as expressions by CasADi (SX) or SymPy, or as a function of (t, x, x_dot).
            Symbols are ``t``, ``x, y, z, rx, ry, rz`` and their rates ``x_dot`` to ``rz_dot``, and names of coordinates
            and velocities, as in `add_joint_force`.
        potential : object, optional
            An energy of the displacement, J; a function is one of x.
        parameters : dict of str to float, optional
            Constants of the expressions by the names of their symbols; each may be a `Parameter`.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("mount")
        >>> b.add_body("engine", mass=100.0, inertia=(5.0, 5.0, 5.0))
        >>> b.add_joint("free", "free", parent="world", child="engine")
        >>> k = [2e5, 2e5, 1e5, 3e3, 3e3, 2e3]
        >>> b.add_bushing("rubber", body_a="world", body_b="engine", stiffness=k, damping=50.0)
        >>> dyn = mb.dynamics(b.build(), "lagrangian")
        >>> dyn.potential_energy([0.001, 0, 0, 0, 0, 0, 1])
        0.1
        """
        item = f"bushing {shown(name)}"
        given = {"formula": (TIME, DISPLACEMENT, tuple(x + RATE for x in DISPLACEMENT)), "potential": (DISPLACEMENT,)}
        formulas, constants = self._formulas(
            item, parameters, formula=((force, 6),), potential=((potential, 1),), given=given
        )
        matrices = {n: self._matrix(f"{item}: {n}", x) for n, x in (("stiffness", stiffness), ("damping", damping))}
        a = {"body_a": body_a, "rotation_a": rotation_a, "translation_a": translation_a}
        b = {"body_b": body_b, "rotation_b": rotation_b, "translation_b": translation_b}
        self._add(Bushing, "bushing", name, a | b, matrices | formulas | constants)

    def add_beam(
        self,
        name: str,
        *,
        parent: str,
        length: float,
        stiffness: Number | Sequence[Number],
        density: Number,
        modes: int | None = None,
        shapes: Any = None,
        damping: Number = 0.0,
        translation: _Vector = (0.0, 0.0, 0.0),
        rotation: ArrayLike | None = None,
        rpy: ArrayLike | None = None,
    ) -> None:
        """Add a beam clamped to a body, or a string, by assumed modes: small deflections on any motion.

        It is Euler and Bernoulli's. Its axis is x of the root's frame; it deflects along y, and in space along z too.
        The coordinates are amplitudes a of normal modes φ with ∫ φ_i φ_j ds = length δ_ij, as
        `mbkit.lagrangian.clamped_free` writes them: the end of an exact mode deflects by ±2 a. It does not stretch: as
        it bends, its points move towards the root by ½ ∫ (v′² + w′²) ds, without which a beam that turns would soften
        (Kane, Ryan, Banerjee 1987). Rotary inertia, shear and torsion are left out, and terms beyond the second order
        in the deflections.

        A body of the beam's name is the frame at its end, which turns with the axis; bodies and joints may hang on it.
        ``name.root`` is the clamp, and ``name.1``, ``name.2``, ... are the points of Gauss's quadrature with the mass.
        The lagrangian engine and the oracle take it; `Model.segmented` makes rigid segments for the others.

        Parameters
        ----------
        name, parent : str
        length : float
            m.
        stiffness : float or (EI_v, EI_w)
            EI against bending along y alone, or along y and along z, N m². A string has zero: its slope is free at the
            root, and what pulls it straight is gravity or the motion.
        density : float
            Mass a metre, kg/m.
        modes : int, optional
            How many exact modes of a clamped and free beam in each plane; of a string, how many powers of s from 1 on.
        shapes : sequence of numpy.polynomial.Polynomial, optional
            Instead: shapes of s/length, which are zero with their slopes at 0; of a string the slopes are free. The
            modes are those of the uniform beam within their span, by Ritz's method.
        damping : float
            Of the material (Kelvin and Voigt), s: on rates it is this times the stiffness on deflections.
        translation, rotation, rpy : array_like, optional
            The root's frame in the parent, as of `add_joint`.

        Notes
        -----
        `random_state` bends a beam by a tenth of its length or so; a limit of the coordinates says that. Two to four
        modes in a plane do for most motions, and the time to derive and compile grows fast with their number. Where a
        heavy body turns at the end, shapes of polynomials come closer than exact modes, which fit a free end.

        Examples
        --------
        >>> import mbkit as mb
        >>> b = mb.ModelBuilder("rotor", gravity=(0, 0, 0))
        >>> b.add_body("hub", mass=1.0, inertia=(50.0, 50.0, 50.0))
        >>> b.add_joint("turn", "revolute", parent="world", child="hub", axis=(0, 0, 1))
        >>> b.add_beam("blade", parent="hub", length=10.0, stiffness=1.4e4, density=1.2, modes=2)
        >>> dyn = mb.dynamics(b.build(), "lagrangian")
        >>> dyn.model.coordinate_names, dyn.mass_matrix([0.0, 0.0, 0.0]).diagonal().round(6).tolist()
        (('turn', 'blade.1', 'blade.2'), [450.0, 12.0, 12.0])
        """
        read, known = self._read, len(self._read.faults)
        name = read.name("beam name", name)
        item = f"beam {name!r}"
        long = read.real(f"{item}: length", length)
        pair = isinstance(stiffness, (list, tuple, np.ndarray))
        EI = read.quantities(f"{item}: stiffness", stiffness, 2 if pair else 1, each=not pair)
        rho, tau = read.quantity(f"{item}: density", density), read.quantity(f"{item}: damping", damping)
        least = [("length", long, True), *(("stiffness", x, False) for x in EI)]
        for what, x, above in (*least, ("density", rho, True), ("damping", tau, False)):
            value = nominal(x)
            if len(read.faults) == known and (value < 0 or (above and value == 0)):
                read.faults.append(f"{item}: {what}: expected a number {'above' if above else 'from'} 0, got {value:g}")
        if len(read.faults) == known and not 1 / MAX_MAGNITUDE <= long <= MAX_MAGNITUDE:
            # The third power of a length keeps its digits beside 1.
            bounds = f"{1 / MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}"
            read.faults.append(f"{item}: length: expected a number from {bounds}, got {long:g}")
        string = all(map(_is_zero, EI))
        good, found = self._asked(item, (modes, shapes), lambda: modes_of(modes, shapes, string=string))
        root = f"{name}.root"
        self.add_body(root)
        self.add_joint(
            *(root, FIXED.name), parent=parent, child=root, translation=translation, rotation=rotation, rpy=rpy
        )
        self.add_body(name)
        if not good or len(read.faults) > known:
            # Whatever hangs on the beam finds its body.
            self.add_joint(name, FIXED.name, parent=root, child=name)
            return
        end, points = beam_types(long, found, len(EI))
        each = end.nv // len(EI)
        K = [EI[k // each] * c for k, c in enumerate(end.squares)]
        loss = 0.0 if _is_zero(tau) else [tau * k for k in K]
        reach = _MAX_DEFLECTION_RATIO * long / each
        self.add_joint(*(name, end.name), parent=root, child=name, stiffness=K, damping=loss, lower=-reach, upper=reach)
        for k, (point, weight) in enumerate(zip(points, end.weights, strict=True)):
            own = f"{name}.{k + 1}"
            self.add_body(own, mass=rho * weight)
            self.add_joint(own, point.name, parent=root, child=own, mimic=(name, 1.0, 0.0))

    def _asked(self, item: str, value: Any, call: Callable[[], Any]) -> tuple[bool, Any]:
        """Return whether a call succeeded and what it returned; its error is a fault of an argument."""
        try:
            return True, call()
        except MbkitError as error:
            self._read.faults.append(f"{item}: {error}")
        except Exception:
            # Any: objects may bring conversions of their own.
            self._read.faults.append(f"{item}: expected numbers or expressions, got {shown(value)}")
        return False, None

    def _matrix(self, name: str, value: Any) -> Array:
        """Return a 6 by 6 matrix of a matrix, its diagonal or one number for all of it."""
        good, size = self._asked(name, value, lambda: np.ndim(value))
        if not good:
            return np.zeros((6, 6))
        if size == 2:
            rows = list(value)
            if len(rows) == 6:
                matrix = [self._read.quantities(f"{name}[{i}]", row, 6) for i, row in enumerate(rows)]
                return np.array(matrix, dtype=object if any(x.dtype == object for x in matrix) else float)
            self._read.faults.append(f"{name}: expected a number, shape (6,) or (6, 6), got {np.shape(value)}")
            return np.zeros((6, 6))
        diagonal = self._read.quantities(name, value, 6, each=True)
        out: Array = np.zeros((6, 6), dtype=diagonal.dtype)
        out[range(6), range(6)] = diagonal
        return out

    def _formulas(
        self, item: str, parameters: Constants | None, *, given: Mapping[str, Any], **wanted: Any
    ) -> tuple[dict[str, Formula | None], dict[str, Any]]:
        """Read expressions with the numbers that they should have; return formulas, and their constants' fields."""
        formulas: dict[str, Formula | None] = dict.fromkeys(wanted)
        values: dict[str, Number] = {}
        named: Any = {} if parameters is None else parameters
        if not isinstance(named, Mapping):
            self._read.faults.append(f"{item}: parameters: expected a mapping of names to numbers, got {shown(named)}")
            named = {}
        for name, x in named.items():
            values[self._read.name(f"{item}: parameters", name)] = self._read.quantity(f"{item}: parameters: {name}", x)
        things: list[Expression] = []

        def read(what: str, parts: Any) -> None:
            formulas[what] = from_above("formulas").read_formula(parts, given[what], things)

        for what, parts in wanted.items():
            if all(x is None for x, _ in parts):
                continue
            label = {"formula": "force"}.get(what, what)
            self._asked(f"{item}: {label}", [x for x, _ in parts], partial(read, what, parts))
        used = {name for x in formulas.values() if x is not None for name in x.arguments}
        if idle := [n for n in values if n not in used]:
            self._read.faults.append(f"{item}: parameters: {idle[0]!r} is in no expression; leave it out")
        values |= {f"#{k + 1}": self._read.quantity(item, x) for k, x in enumerate(things)}
        return formulas, {"symbols": tuple(values), "numbers": np.array([*values.values()], dtype=object)}
