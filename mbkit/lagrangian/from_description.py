"""A model as a `Lagrangian`: energies in SymPy, loops as constraints, prescribed coordinates as functions of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain, count
from typing import Final, cast

import sympy as sp

from mbkit.derivation.kinematics import dissipation, spring_energy
from mbkit.errors import InputError, MbkitWarning, UnsupportedError, warn
from mbkit.lagrangian.description_kinematics import INSTEAD_OF_WRITING, SymbolicKinematics, exact, written_rows
from mbkit.lagrangian.elements import acting, law
from mbkit.lagrangian.energies.charts import chart_names, chart_velocities
from mbkit.lagrangian.energy_model import EnergyModel
from mbkit.lagrangian.summary import in_symbols
from mbkit.lagrangian.system import Lagrangian, QuasiLagrangian
from mbkit.lagrangian.trig.shortest_form import number
from mbkit.lagrangian.trig.simplify import tidy
from mbkit.model import Joint, Model
from mbkit.model.changes.jumps import held_at_rest, jump_rates
from mbkit.model.elements.beams import BeamEnd
from mbkit.model.elements.motion_laws import MOTION_LAWS, motions_of
from mbkit.model.elements.paths import ALL, Path
from mbkit.model.elements.references import _OF_BODIES, KINDS_OF_PARTS, names_in
from mbkit.model.stops import StopLaw

#: Velocities up to which equations are written out: of a tree; with loops or motions in time, as a row of 40 four-bars
#: has 81; and of what rolls, as a bicycle's nine take half a minute and rows that nobody reads.
_MAX_VELOCITIES: Final = {"tree": 24, "loops": 100, "rolls": 7}


def from_model(
    model: Model,
    *,
    symbols: bool | None = None,
    coordinates: Sequence[str] | None = None,
    drives: bool = False,
    progress: Callable[[float, str], None] | None = None,
) -> Lagrangian:
    """Return a model as a `Lagrangian` to read and to run: T, V and Rayleigh's dissipation in its coordinates.

    The joints' formulas are evaluated on exact sums of cosines and sines. Numbers are the decimals of the description.
    Springs are in V, dampers in the dissipation, rotors in T. A force that jumps is -f sign(v), which is zero at rest,
    where that of the engines holds up to its bound. Limits are data, and those that act are stops on paper as well.
    Forces of functions at joints are written out, their potentials in V.

    Loop closures become holonomic constraints, in the order of `model.loops`, in the axes of the body that carries
    both ends, with the rows of `Dynamics.constraint_names`. A point closure has three, two in a plane, and its
    multipliers are the force on body a; frames that do not turn have one row of their angle where all axes in the loop
    are parallel (`mbkit.lagrangian.description_kinematics`).
    Blades and what rolls become velocity constraints, in world axes; the height of what rolls is a holonomic one.
    Prescribed coordinates become functions of the time, and T has terms of first and zeroth degree then.

    A ball or free joint has three angles in place of its quaternion: ``psi``, ``theta`` and ``phi``, yaw, pitch and
    roll about z, y and x in turn, with the joint's name as an index where several joints have such. Beside them stand
    the model's own velocities, ``omega1`` to ``omega3`` and ``v1`` to ``v3`` of the child's origin, in the child's
    axes, as quasi-velocities: the equations are Newton's and Euler's, M is that of the model and regular everywhere.
    Only q̇ = D(q) v is singular, at theta = ±π/2.

    Parameters
    ----------
    model : Model
    symbols : bool, optional
        Whether a catalog system is written in the textbooks' symbols, with the model's numbers as their values:
        cart_pole in m_c, m_p, l and g. By default, if the model has no named parameters of its own; of others the
        default writes g alone.
    coordinates : sequence of str, optional
        Names instead of the model's, such as ``["q1", "q2"]``, prescribed ones included; of a ball or free joint those
        of its position and its three angles.
    drives : bool
        Whether prescribed coordinates stay, each bound by a constraint behind those of the loops: its
        multiplier is the force (or torque) of the drive that moves it.
    progress : callable, optional
        Called with a fraction and a text.

    Raises
    ------
    UnsupportedError
        Ball or free joints beside loops or what rolls, forces by functions elsewhere than at joints, too many terms
        to read, or no coordinate that is left to move.
    InputError
        `symbols` of a model that is not in the catalog, names that do not fit, or a loop whose ends never meet or do
        not move against each other.

    Warns
    -----
    MbkitWarning
        No term of the equations holds a joint at rest that the engines hold.

    Notes
    -----
    A spatial loop with more rows than freedoms that it takes (Bricard's, Bennett's) is redundant: running it is
    refused with the rows by name.

    Examples
    --------
    >>> import mbkit as mb
    >>> lag = mb.lagrangian.from_model(mb.catalog.pendulum(mass=2.0))
    >>> lag.T, lag.V
    (l**2*m*thetadot**2/2, -g*l*m*cos(theta))
    >>> {s.name: x for s, x in lag.parameters.items()}
    {'g': 9.81, 'm': 2.0, 'l': 1.0}

    A slider-crank is two rods, a piston, and the pin that closes the loop.

    >>> for row in mb.lagrangian.from_model(mb.catalog.slider_crank()).constraints:
    ...     print(row)
    L1*cos(theta) - L1 + L2*cos(phi + theta) - L2 - x
    L1*sin(theta) + L2*sin(phi + theta)
    """
    if not isinstance(model, Model):
        raise InputError(f"model: expected a Model, got {type(model).__name__}; mbkit.load(...) gives one")
    if isinstance(model, EnergyModel):
        return cast("Lagrangian", model.form)
    for note in PAPER.admit(model):
        warn(f"{model.name}: {note}", MbkitWarning)
    q = _coordinates(model, coordinates)
    named = None
    if symbols or (symbols is None and not model.forces):
        named = in_symbols(model)
        if named is None and symbols:
            known = "it has named parameters already" if model.bindings else "it is no system of the catalog"
            raise InputError(f"symbols: {model.name}: {known}; leave symbols out to keep its numbers")
    source = _with_points(named or model)
    parameters = {name: sp.Symbol(name) for name in source.parameters if name != source.time_parameter}
    clash = [s.name for s in q if s.name in parameters]
    if clash:
        raise InputError(f"coordinates: {clash[0]!r} is a parameter of {model.name}; give coordinates=... other names")
    v = chart_velocities(model, q)
    kin = SymbolicKinematics(source, q, v, parameters, progress or (lambda *_: None))
    T, R = kin.kinetic_energy, tidy(dissipation(kin.written))
    plain = symbols is None and not source.parameters
    weight, g = _weight(kin, {s.name for s in (*q, *v)}) if plain else (kin.gravity_energy, {})
    V = weight + spring_energy(kin.written)
    t = _time({*parameters, *(s.name for s in (*q, *v))})
    moved = {model.layout.v[p.joint].start: law(kin, p, t) for p in motions_of(model)}
    written = [(x.name, *written_rows(kin, x)) for x in model.constraints if type(x) not in MOTION_LAWS]
    rows = [(name, row) for name, held, _ in written for row in held]
    moving = [row for *_, found in written for row in found]
    if drives:
        rows += [(q[i].name, q[i] - x) for i, x in moved.items()]
        moved = {}
    put = {q[i]: x for i, x in moved.items()} | {v[i]: sp.diff(x, t) for i, x in moved.items()}
    stored, pushed = acting(kin, t)
    for rate, size in jump_rates(kin.written, sp.exp):
        pushed = [x - size * sp.sign(rate) * sp.diff(rate, w) for x, w in zip(pushed, v, strict=True)]
    T, V, R, *constraints = (x.xreplace(put) for x in (T, V + stored, R, *(row for _, row in rows)))
    pushed, moving = ([x.xreplace(put) for x in found] for found in (pushed, moving))
    ends = StopLaw(model)
    where = sorted(ends.names, key=lambda at: at[::-1])
    bounds, rebounds = ([number(Fraction(repr(float(x[at])))) for at in where] for x in (ends.bounds, ends.restitution))
    if held := [ends.names[at][0] for at in where if at[1] in moved]:
        raise UnsupportedError(f"{model.name}: joint {held[0]!r} with stops is moved in time; drives=True keeps both")
    independent = [i for i in range(len(q)) if i not in moved]
    # Dampers on prescribed joints alone act on no coordinate that is left.
    R = R if R.free_symbols & {v[i] for i in independent} else sp.Integer(0)
    _check_kept(model, {q[i] for i in independent}, zip((name for name, _ in rows), constraints, strict=True))
    used = set().union(*(x.free_symbols for x in (T, V, R, *constraints, *moving, *pushed)))
    arguments = {
        "T": T,
        "V": V,
        "coordinates": [q[i] for i in independent],
        "velocities": [v[i] for i in independent],
        "time": t,
        "forces": {q[i]: pushed[i] for i in independent if pushed[i] != 0},
        "dissipation": R,
        "constraints": constraints,
        "velocity_constraints": moving,
        "stops": [(1 - 2 * side) * (q[i] - x) for (side, i), x in zip(where, bounds, strict=True)],
        "restitution": rebounds,
        # A number that only a frame needs is no part of the equation; a name of the user's own stays all the same.
        "parameters": {s: source.parameters[n] for n, s in parameters.items() if named is None or s in used} | g,
        "name": model.name,
    }
    quasi = kin.quasi_velocities(independent)
    return Lagrangian(**arguments) if quasi is None else QuasiLagrangian.of_energies(quasi, **arguments)


def _with_points(model: Model) -> Model:
    """Return the model with the ends of its beams as points, whose turns are no sums of cosines and sines."""
    joints = []
    for joint in model.joints:
        if isinstance(joint.type, BeamEnd):
            if turned := _turned(model, joint):
                raise UnsupportedError(
                    f"{model.name}: {turned} at the end of beam {joint.name!r} turns with it, and is not written out; "
                    f"{INSTEAD_OF_WRITING}"
                )
            joint = replace(joint, kind=joint.type.point.name)
        joints.append(joint)
    return replace(model, joints=tuple(joints)) if joints != [*model.joints] else model


def _turned(model: Model, end: Joint) -> str:
    """Return the parts at the end of a beam that are more than a mass; empty without any."""
    beyond = {end.child}
    for joint in model.tree:
        if joint.parent in beyond:
            if joint.type.nv or joint.translation.any():
                return f"joint {joint.name!r}"
            beyond.add(joint.child)
    bodies = [f"body {b.name!r}" for b in model.bodies if b.name in beyond and (b.com.any() or b.inertia.any())]
    acting = (x for kind in KINDS_OF_PARTS[3:] for x in getattr(model, kind))
    return [*bodies, *(repr(x.name) for x in acting if names_in(x, _OF_BODIES) & beyond), ""][0]


def _weight(kin: SymbolicKinematics, used: set[str]) -> tuple[sp.Expr, dict[sp.Symbol, float | None]]:
    """Return the potential of weights with g for a number that would be lost in products, and g's value."""
    V, model = kin.gravity_energy, kin.model
    numbers = [abs(float(x)) for x in model.gravity if x != 0]
    # A force that holds weights has the number too.
    if V == 0 or len(numbers) != 1 or "g" in used or model.forces:
        return V, {}
    g = sp.Symbol("g")
    return g * tidy(V / exact(numbers[0])), {g: numbers[0]}


def _too_much(model: Model) -> Iterator[str]:
    turning = [j.name for j in model.independent_joints if not j.type.coordinate_velocities]
    sections = dict.fromkeys(x.section for x in model.constraints if type(x) not in MOTION_LAWS)
    if turning and sections:
        yield (
            f"joint {turning[0]!r} has velocities that are no coordinate's rate, and is not written out beside "
            f"{' and '.join(sections)}; write it as three joints of one coordinate each, or as spherical_zyx"
        )
    if not model.nv:
        yield "no joint of it moves, so there is no equation"
    bound = "loops" if model.loops or motions_of(model) else "tree"
    most = _MAX_VELOCITIES["rolls" if model.holds_velocities else bound]
    if model.nv > most:
        yield f"expected at most {most} coordinates to be written out, got {model.nv} coordinates"


PAPER: Final = Path(
    "paper",
    "not written out:",
    ALL - {"force"} | {"force.joint"},
    {"force": "it is no force at a joint"},
    notes={"jump": held_at_rest},
    also=_too_much,
    instead=INSTEAD_OF_WRITING,
)


def _time(used: set[str]) -> sp.Symbol:
    names = chain(("t", "time"), (f"t_{k}" for k in count()))
    return sp.Symbol(next(name for name in names if name not in used))


def _check_kept(model: Model, names: set[sp.Symbol], rows: Iterable[tuple[str, sp.Expr]]) -> None:
    """Refuse what the prescribed motions leave nothing of."""
    if not names:
        raise UnsupportedError(
            f"{model.name}: every coordinate is prescribed, so there is no equation; drives=True keeps them, with the "
            "forces that move them as multipliers"
        )
    for name, row in rows:
        if not row.free_symbols & names:
            raise InputError(
                f"{model.name}: loop {name!r}: the prescribed motions alone move it, so that it is open or "
                f"says nothing: {row} = 0; leave out one of them"
            )


def _coordinates(model: Model, names: Sequence[str] | None) -> list[sp.Symbol]:
    chosen = list(chart_names(model) if names is None else names)
    if len(chosen) != model.nv or not all(isinstance(n, str) and n for n in chosen) or len(set(chosen)) != len(chosen):
        raise InputError(f"coordinates: expected {model.nv} different names, got {names!r}")
    return [sp.Symbol(n) for n in chosen]
