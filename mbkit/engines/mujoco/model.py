"""A MuJoCo model built from a description with `MjSpec`, everything off that it does not need.

MuJoCo puts several joints into one body, first to last: a universal joint is two hinges, a spherical-ZYX joint three, a
planar joint two slides and a hinge, and a free joint that does not hang directly in the world three slides and a ball
(the same velocities: linear in the parent's axes, angular in the body's). So does a body without mass between two.

Sites and shapes on the bodies of a MuJoCo specification: neither has mass, and nothing collides.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

import mujoco
import numpy as np

from mbkit._check import Array, by_key
from mbkit.engines.base import BESIDE, OF_ANY_ENGINE, OF_COUPLINGS, OF_TREES, SOLVED, STACKS
from mbkit.engines.mujoco.constraints import EQUALITIES, OF_JOINTS, OF_TENDON, Softness, wxyz
from mbkit.errors import MbkitError, UnsupportedError
from mbkit.load.mjcf import JOINT_NUMBERS
from mbkit.load.mjcf_attributes import matrix_of
from mbkit.load.xml_reader import reserved, unused
from mbkit.model import Body, Bushing, GravityCompensation, Joint, Model
from mbkit.model.elements.kinds import EFFECTS, joint_types
from mbkit.model.elements.paths import Path
from mbkit.model.parts import JointCoupling, rules_of
from mbkit.model.validation import static_bodies
from mbkit.show import Shape

if TYPE_CHECKING:
    from mbkit.show import Shape


# What is global in MuJoCo. 4.0, the lower bound, is the first whose Runge–Kutta on rotations is of fourth order.


def _leave_no_log() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the working folder, unless somebody has named another file."""
    config = mujoco.MjLogConfig.get()
    if config.logto_file and config.logfile == "MUJOCO_LOG.TXT":
        config.logto_file = False
        config.set()


_leave_no_log()


def full_mass_matrix(model: Any, data: Any) -> Array:
    """Return the dense mass matrix of the last `mj_makeM`."""
    out = np.zeros((model.nv, model.nv))
    if model.nv:
        mujoco.mj_fullM(model, data, out)
    return out


@contextlib.contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, instead of prints."""
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        yield heard
    finally:
        mujoco.set_mju_user_warning(before)


_HINGE, _SLIDE = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
_BALL, _FREE = mujoco.mjtJoint.mjJNT_BALL, mujoco.mjtJoint.mjJNT_FREE
_X, _Y, _Z = np.eye(3)
# A ball joint can only be the last of a stack: its quaternion is in the body's own axes.
_STACKABLE: Final = tuple(STACKS)
#: The softness of each joint whose limits act.
Limits = Mapping[str, Softness] | None
#: Numbers of a coupling that a tendon has by the same name, its inertia among them.
OF_COUPLING: Final = tuple(name for name, rule in rules_of(JointCoupling).items() if rule.does)
(INERTIA,) = JointCoupling.adding_to("T")


@dataclass
class MujocoModel:
    """The compiled model and the maps between its coordinates and the description's."""

    model: Any
    #: MuJoCo's entry i is full coordinate q_index[i], quaternions included.
    q_index: np.ndarray
    v_index: np.ndarray
    #: Starts in qpos and qvel of every free joint, also of one that is a stack.
    free: tuple[tuple[int, int], ...]
    bodies: dict[str, int]
    #: Massless bodies that became part of a stack of joints.
    absorbed: frozenset[str]
    #: Features that are off.
    disabled: tuple[str, ...]


def build(
    description: Model,
    *,
    softness: Softness | None = None,
    soft_friction: bool = False,
    limits: Limits = None,
    spheres: bool = False,
    shapes: Sequence[Shape] | None = None,
) -> MujocoModel:
    """Compile the description, with shapes to draw and sites of its frames where shapes are given, if only none.

    `soft_friction` leaves MuJoCo's friction loss on, `limits` its joint limits, each as soft as it says. `spheres`
    gives every body a sphere of 1 µm, to measure the cost of geometry. Raises `UnsupportedError` for a body that MuJoCo
    refuses, and names it.
    """
    spec, placed, disabled = specified(description, softness, soft_friction, limits)
    if spheres:
        for name, body in placed.bodies.items():
            if name != "world":
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-6, 0, 0], pos=body.ipos, mass=0.0)
    if shapes is not None:
        # Imported late: few scripts draw.

        add_shapes(spec, placed.bodies, description, shapes)
    # A singular M at the zero configuration is an error only where it is solved with.
    with heard_warnings(), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            model = spec.compile()
        except ValueError as error:
            raise UnsupportedError(f"mujoco: {_refusal(description, str(error))}") from None
        _set_constants(model, description, placed)
    _verify(model, description, placed)
    return mapped(model, description, placed.joints, placed.bodies, placed.absorbed, disabled)


@dataclass
class Placed:
    """Where the parts of a description are in a specification."""

    bodies: dict[str, Any]
    #: Principal moments of the bodies that have a placeholder instead.
    degenerate: dict[str, Array]
    #: Names of MuJoCo's joints.
    joints: dict[str, list[str]]
    absorbed: set[str]
    #: Bodies that are fixed to the world.
    static: set[str]


def specified(
    description: Model, softness: Softness | None = None, soft_friction: bool = False, limits: Limits = None
) -> tuple[Any, Placed, tuple[str, ...]]:
    """Return the specification, not compiled yet, the places of the parts in it, and the features that are off."""
    spec = mujoco.MjSpec()
    spec.modelname = description.name
    compiler = spec.compiler
    compiler.degree, compiler.autolimits = False, False
    compiler.balanceinertia, compiler.fusestatic, compiler.inertiafromgeom = False, False, 0
    compiler.boundmass = compiler.boundinertia = 0.0
    compiler.alignfree = False
    disabled = _switch_off(spec, description, soft_friction, limits is not None)
    placed = _add_tree(spec, description)
    for name, spring in turning_springs(description).items():
        spec.joint(name).stiffness[0] = spring.stiffness[5, 5]
        if description.joint(name).kind == "free":
            # MuJoCo's spring of a free joint rests where the body is drawn.
            placed.bodies[spring.body_b].pos = np.array(spring.translation_a)
            placed.bodies[spring.body_b].quat = wxyz(spring.rotation_a)
    for force in _held(description):
        # A body without mass, within a stack, has no weight.
        if force.body in placed.bodies:
            placed.bodies[force.body].gravcomp = force.fraction
        for name in (x for joint in force.without for x in placed.joints[joint]):
            # It would be an actuator's, and there are none.
            spec.joint(name).actgravcomp = True
    _add_springs(spec, description, placed)
    _add_couplings(spec, description, placed)
    _add_loops(spec, description, placed, softness or Softness())
    if soft_friction:
        for name in (x for joint in description.joints if joint.friction.any() for x in placed.joints[joint.name]):
            spec.joint(name).solref_friction = (softness or Softness()).solref
            spec.joint(name).solimp_friction = (softness or Softness()).solimp
    for joint, held in (limits or {}).items():
        for name in placed.joints[joint]:
            spec.joint(name).solref_limit, spec.joint(name).solimp_limit = held.solref, held.solimp
    used = [softness or Softness()] if soft_friction or description.needs.loops else []
    if used := [*used, *(limits or {}).values()]:
        _solve_to_rounding(spec, used)
    return spec, placed, disabled


#: Features that no smooth term needs, with their disable bits, and those that some models need.
_OFF: Final = {
    "contacts": "CONTACT",
    "joint limits": "LIMIT",
    EFFECTS["jump"]: "FRICTIONLOSS",
    "equality constraints": "EQUALITY",
    "constraint solver": "CONSTRAINT",
    "actuators": "ACTUATION",
    "sensors": "SENSOR",
    "implicit damping in Euler": "EULERDAMP",
    "restart after divergence": "AUTORESET",
    "warm start": "WARMSTART",
    "islands": "ISLAND",
}
_OFF_WITHOUT: Final = {
    "gravity": ("gravity", "GRAVITY"),
    "springs": ("springs", "SPRING"),
    "damping": ("dampers", "DAMPER"),
}


def _held(description: Model) -> list[GravityCompensation]:
    held = [f for f in description.forces if isinstance(f, GravityCompensation)]
    # MuJoCo 4.0 applies them where one at least is above zero.
    return held if any(f.fraction > 0 for f in held) else []


def turning_springs(description: Model) -> dict[str, Bushing]:
    """Return the bushings that are MuJoCo's own springs of ball and free joints, by joint: alike about all axes."""
    joints = {(j.parent, j.child): j for j in description.joints if j.kind in ("ball", "free")}
    out: dict[str, Bushing] = {}
    for f in description.forces:
        if not isinstance(f, Bushing) or f.formulas or f.damping.any() or (f.body_a, f.body_b) not in joints:
            continue
        joint = joints[f.body_a, f.body_b]
        free, still = joint.kind == "free", np.eye(3)
        turned = (
            [f.translation_b, joint.translation, joint.rotation - still] if free else [f.rotation_a - joint.rotation]
        )
        zeros = [f.stiffness - f.stiffness[5, 5] * np.diag([free] * 3 + [1] * 3), f.rotation_b - still, *turned]
        if (joint.parent == "world" or not free) and not any(x.any() for x in zeros):
            out.setdefault(joint.name, f)
    return out


def _numbers_not_held(description: Model) -> Iterator[str]:
    for joint in description.joints:
        if joint.kind == "free" and np.ptp(joint.damping[:3]) > 0:
            why = "MuJoCo damps a free joint along world axes"
            yield f"free joint {joint.name!r} is damped differently along its body axes; {why}"
    held = _held(description)
    for force in held:
        for name in force.without:
            if other := next((f for f in held if name not in f.without and name in description.moving(f.body)), None):
                yield f"{force}, and that of {other.body!r} does; MuJoCo has one answer for each joint"


def by_mbkit(description: Model) -> list[Any]:
    """Return the forces that MuJoCo does not have, which are mbkit's beside its terms."""
    own = [*_held(description), *turning_springs(description).values()]
    return [f for f in description.forces if f not in own]


def _switch_off(spec: Any, description: Model, soft_friction: bool, limits: bool) -> tuple[str, ...]:
    rows = {"EQUALITY": description.needs.loops, "FRICTIONLOSS": soft_friction, "LIMIT": limits}
    needed = {bit for bit, there in (rows | {"CONSTRAINT": any(rows.values())}).items() if there}
    bits = {need: bit for need, bit in _OFF.items() if bit not in needed}
    bits |= dict(pair for need, pair in _OFF_WITHOUT.items() if not getattr(description.needs, need))
    if len(by_mbkit(description)) < len(description.forces):
        # Without springs and dampers MuJoCo leaves out gravity compensation too.
        bits.pop("springs", None)
    spec.option.disableflags = sum(int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{bit}", 0)) for bit in bits.values())
    spec.option.gravity = np.array(description.gravity)
    # 4.0.0 can give wrong accelerations with sparse Jacobians.
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return tuple(bits)


def _add_tree(spec: Any, description: Model) -> Placed:
    placed = Placed({"world": spec.worldbody}, {}, {}, set(), static_bodies(description.joints))
    children = by_key((joint.parent, joint) for joint in description.joints)
    sprung = {b for s in description.springs for b in (s.body_a, s.body_b)}
    sprung |= {b for loop in description.loops for b in (loop.body_a, loop.body_b)}
    # (MuJoCo parent, R, p) of the frame in which a joint stands, and the joints stacked on the way there, each with its
    # frame in the same parent.
    at: dict[str, tuple[str, Array, Array, list[tuple[Joint, Array, Array]]]] = {
        "world": ("world", np.eye(3), np.zeros(3), [])
    }
    for joint in description.tree:
        owner, R, p, stack = at[joint.parent]
        R, p = R @ joint.rotation, p + R @ joint.translation
        stack = [*stack, (joint, R, p)]
        body = description.body(joint.child)
        below = children.get(body.name, [])
        massless = body.mass == 0 and not body.inertia.any()
        if (
            massless
            and joint.kind in _STACKABLE
            and len(below) == 1
            and below[0].kind in (*_STACKABLE, "ball")
            and body.name not in sprung
        ):
            at[body.name] = (owner, R, p, stack)
            placed.absorbed.add(body.name)
            continue
        new = placed.bodies[owner].add_body(name=body.name, pos=p, quat=wxyz(R))
        placed.bodies[body.name] = new
        _give_inertia(new, body, description, placed)
        if len(stack) > 1 and any(stacked.kind == "prismatic" for stacked, _, _ in stack):
            # MuJoCo 4.0.0 takes M of several slides of a "simple" body for diagonal, even where they are parallel.
            new.simple = 0
        at_origin = owner == "world" and np.array_equal(R, np.eye(3)) and not p.any()
        for stacked, R_PJ, p_PJ in stack:
            _add_joint(new, stacked, R.T @ R_PJ, R.T @ (p_PJ - p), placed, at_origin)
        if owner == "world" and joint.kind == "fixed":
            # MuJoCo forms inertias about the centre of mass of a body's whole tree, and rounds accordingly. What hangs
            # on a body fixed to the world starts a tree of its own, so that one leg is not measured from the other's.
            at[body.name] = ("world", R, p, [])
        else:
            at[body.name] = (body.name, np.eye(3), np.zeros(3), [])
    return placed


def _give_inertia(new: Any, body: Body, description: Model, placed: Placed) -> None:
    inertia = np.array(body.inertia)
    if np.array_equal(inertia, np.diag(np.diag(inertia))):
        moments, axes = np.diag(inertia).copy(), np.eye(3)
    else:
        moments, axes = np.linalg.eigh(inertia)
        axes = axes * np.sign(np.linalg.det(axes))
    new.explicitinertial = True
    new.mass, new.ipos, new.iquat = body.mass, np.array(body.com), wxyz(axes)
    new.inertia = moments
    listed = {name for name, _ in description.nonphysical}
    low, middle, high = np.sort(moments)
    harmless = body.name in placed.static or (body.mass > 0 and body.name not in listed)
    if harmless and (low < mujoco.mjMINVAL or low + middle < high):
        # A point mass, a thin rod or a plate is a fair idealization, and a body fixed to the world may have any
        # inertia. The compiler refuses them: they are compiled with a placeholder and get their own moments afterwards.
        placed.degenerate[body.name] = moments
        new.inertia = np.ones(3)


_OWN_STACKS: Final[dict[str, list[tuple[Any, Array, str]]]] = {
    "fixed": [],
    "ball": [(_BALL, _Z, "")],
    "free": [(_SLIDE, _X, ".x"), (_SLIDE, _Y, ".y"), (_SLIDE, _Z, ".z"), (_BALL, _Z, ".ball")],
}
_NO_STIFFNESS: Final = "MuJoCo's equality of it leaves J̇ v out, which no stiffness makes up for"
MUJOCO: Final = Path(
    "mujoco",
    "",
    joint_types(*STACKS, *_OWN_STACKS)
    | OF_TREES.union(OF_COUPLINGS, ["coupler", "coupler.several"], (f"loop.{x}" for x in EQUALITIES)),
    why={
        "loop.distance": _NO_STIFFNESS,
        "coupler.curve": _NO_STIFFNESS,
        "speed": "MuJoCo's equalities hold positions alone",
        "row": "MuJoCo has no such equality",
    },
    apart=(("row", "mimic", "MuJoCo's own equations would hold both softly; mimic='free' loads independent joints"),),
    also=_numbers_not_held,
    instead=SOLVED,
)
FRICTION_LOSS: Final = replace(
    MUJOCO,
    name="mujoco friction loss",
    words="soft_friction: MuJoCo's friction loss does not hold the dry friction of",
    carries=MUJOCO.carries - {"joint.stiction", "joint.stop"},
    why={"joint.stiction": "MuJoCo has no static friction and no Stribeck curve", **MUJOCO.why},
    apart=(
        *MUJOCO.apart,
        ("mimic", "jump", "a mimic joint is held softly by MuJoCo, and friction of its own would act on that"),
        ("row", "jump", "its solver would answer for loops and friction at once"),
    ),
    instead="leave soft_friction out for mbkit's exact law",
)
CONSTRAINT_LAW: Final = replace(
    MUJOCO,
    name="constraint law",
    words="constraint_law: not known of",
    asks=(frozenset({"row"}), "it has no loops, and dry friction is soft with soft_friction=True alone"),
)
MUJOCO_RUNS: Final = Path(
    "mujoco runs",
    "mujoco: its own integrators do not hold all of",
    MUJOCO.carries
    - (BESIDE - {"body.rotor", "force.bushing", "force.compensation", "force.compensation.partial"} | {"mimic"}),
    {"mimic": "MuJoCo would hold it softly; load with mimic='free'"},
    also=lambda model: map(str, by_mbkit(model)),
    instead=OF_ANY_ENGINE,
)


def _stack(joint: Joint, at_origin: bool) -> list[tuple[Any, Array, str]]:
    """Return MuJoCo's type, axis and name suffix of each joint of a stack."""
    if joint.kind == "free" and at_origin:
        # A true free joint's qpos is the pose in the world, ours too then.
        return [(_FREE, _Z, "")]
    if joint.kind in _OWN_STACKS:
        return _OWN_STACKS[joint.kind]
    types = {"revolute": _HINGE, "prismatic": _SLIDE}
    suffixes = [f".{suffix}" if suffix else "" for suffix in joint.type.suffixes]
    return [(types[kind], axis, x) for (kind, axis), x in zip(STACKS[joint.kind](joint), suffixes, strict=True)]


def _add_joint(new: Any, joint: Joint, R: Array, p: Array, placed: Placed, at_origin: bool) -> None:
    """Add the joint, whose fixed frame at q = 0 is (R, p) in the body."""
    names = placed.joints[joint.name] = []
    for k, (type_, axis, suffix) in enumerate(_stack(joint, at_origin)):
        names.append(joint.name + suffix)
        j = new.add_joint(name=names[-1], type=type_, axis=R @ axis, pos=p)
        if type_ in (_HINGE, _SLIDE):
            for field, name in JOINT_NUMBERS.items():
                _set(j, name, getattr(joint, field)[k])
            low, high = float(joint.lower[k]), float(joint.upper[k])
            if np.isfinite([low, high]).any() and low < high:
                # MuJoCo has no open end; this one is never reached.
                j.limited, j.range = 1, [max(low, -1e10), min(high, 1e10)]


def _set(element: Any, name: str, number: float) -> None:
    """Set a number of an element, the first where its attribute is a polynomial."""
    if np.ndim(held := getattr(element, name)):
        held[0] = number
    else:
        setattr(element, name, number)


def _add_springs(spec: Any, description: Model, placed: Placed) -> None:
    for k, spring in enumerate(description.springs):
        tendon = spec.add_tendon(name=spring.name)
        for end, body, point in (("a", spring.body_a, spring.point_a), ("b", spring.body_b, spring.point_b)):
            site = f"spring{k}.{end}"
            placed.bodies[body].add_site(name=site, pos=np.array(point))
            tendon.wrap_site(site)
        tendon.stiffness[0], tendon.damping[0] = spring.stiffness, spring.damping
        tendon.springlength = [spring.rest_length, spring.rest_length]


def _add_couplings(spec: Any, description: Model, placed: Placed) -> None:
    names = {spring.name for spring in description.springs}
    for coupling in description.couplings:
        # Springs between points are tendons too.
        tendon = spec.add_tendon(name=unused(coupling.name, names))
        # A rest length of -1 would mean the length where the joints' springs rest; with all signs turned it is 1.
        sign = -1.0 if coupling.rest_length == -1.0 else 1.0
        for joint, factor in zip(coupling.joints, coupling.factors, strict=True):
            tendon.wrap_joint(placed.joints[joint][0], sign * float(factor))
        tendon.springlength = [sign * coupling.rest_length] * 2
        for name in OF_COUPLING:
            _set(tendon, name, getattr(coupling, name))


def _add_loops(spec: Any, description: Model, placed: Placed, softness: Softness) -> None:
    for k, loop in enumerate(description.loops):
        ends = (
            ("a", loop.body_a, loop.translation_a, loop.rotation_a),
            ("b", loop.body_b, loop.translation_b, loop.rotation_b),
        )
        names = []
        for end, body, point, R in ends:
            names.append(f"loop{k}.{end}")
            placed.bodies[body].add_site(name=names[-1], pos=np.array(point), quat=wxyz(R))
        equality = spec.add_equality(name=loop.name, type=EQUALITIES[loop.kind], objtype=mujoco.mjtObj.mjOBJ_SITE)
        equality.name1, equality.name2 = names
        equality.solref, equality.solimp = softness.solref, softness.solimp
    for coupler in description.couplers:
        first, *others = (placed.joints[name][0] for name in (coupler.joint, *coupler.leaders))
        if len(others) == 1:
            equality = spec.add_equality(name=coupler.name, type=OF_JOINTS, objtype=mujoco.mjtObj.mjOBJ_JOINT)
            equality.name1, equality.name2 = first, *others
        else:
            tendon = spec.add_tendon(name=unused(coupler.name, {x.name for x in spec.tendons}))
            for joint, factor in zip((first, *others), (1.0, *(0.0 - coupler.ratios)), strict=True):
                tendon.wrap_joint(joint, float(factor))
            equality = spec.add_equality(name=coupler.name, type=OF_TENDON, objtype=mujoco.mjtObj.mjOBJ_TENDON)
            equality.name1 = tendon.name
        equality.data[:5] = [coupler.offset, coupler.ratio if len(others) == 1 else 1.0, 0.0, 0.0, 0.0]
        equality.solref, equality.solimp = softness.solref, softness.solimp


def _solve_to_rounding(spec: Any, used: Sequence[Softness]) -> None:
    # Newton's solver ends at rounding: equalities are linear equations, friction loss and limits are linear in pieces.
    spec.option.solver, spec.option.tolerance = mujoco.mjtSolver.mjSOL_NEWTON, 0.0
    # MuJoCo raises a time constant to two steps; without steps there is none to raise it for.
    spec.option.timestep = min([spec.option.timestep, *(x.solref[0] / 2 for x in used if x.solref[0] > 0)])


def _refusal(description: Model, error: str) -> str:
    """Return MuJoCo's complaint in one line, with the body it names."""
    lines = [line.strip() for line in error.splitlines() if line.strip()] or ["compile failed"]
    reason = lines[0].removeprefix("Error: ")
    named = next((x for x in lines if x.startswith("Element name")), "")
    if "'" not in named:
        return f"the compiler refuses {description.name}: {reason}"
    name = named.split("'")[1]
    mass = "".join(f" (mass {b.mass:.4g} kg)" for b in description.bodies if b.name == name)
    why = "".join(f"; {why}" for body, why in description.nonphysical if body == name)
    return f"the compiler refuses body {name!r}{mass}: {reason}{why}"


def _set_constants(model: Any, description: Model, placed: Placed) -> None:
    for name, moments in placed.degenerate.items():
        model.body_inertia[model.body(name).id] = moments
    for joint in description.joints:
        if joint.kind in ("ball", "free"):
            adr = _addresses(model, placed.joints[joint.name])[1]
            for field in Joint.adding_to("loss") + Joint.adding_to("T"):
                getattr(model, f"dof_{JOINT_NUMBERS[field]}")[adr] = getattr(joint, field)
    mujoco.mj_setConst(model, mujoco.MjData(model))


def _verify(model: Any, description: Model, placed: Placed) -> None:
    """Raise unless every body arrived with its mass, centre of mass and inertia."""
    for body in description.bodies:
        if body.name in placed.absorbed:
            continue
        own = model.body(body.name)
        R = matrix_of(own.iquat)
        inertia = R @ np.diag(own.inertia) @ R.T
        triples = (
            ("mass", own.mass, body.mass),
            ("centre of mass", own.ipos, body.com),
            ("inertia", inertia, body.inertia),
        )
        for what, result, expected in triples:
            off = np.abs(np.asarray(result) - expected).max()
            if off > 1e-13 * np.abs(expected).max():
                raise MbkitError(
                    f"mujoco: {what} of body {body.name!r} changed by {off:.2e} on the way into MuJoCo "
                    f"{mujoco.__version__}: expected {expected}, got {result}; please report this model"
                )


def _addresses(model: Any, joints: Iterable[str | int]) -> tuple[list[int], list[int]]:
    q: list[int] = []
    v: list[int] = []
    for j in map(model.joint, joints):
        q += range(int(j.qposadr[0]), int(j.qposadr[0]) + len(j.qpos0))
        v += range(int(j.dofadr[0]), int(j.dofadr[0]) + len(j.damping))
    return q, v


def mapped(
    model: Any,
    description: Model,
    joints: Mapping[str, Sequence[str | int]],
    bodies: Iterable[str] = (),
    absorbed: Iterable[str] = (),
    disabled: tuple[str, ...] = (),
) -> MujocoModel:
    """Return a compiled model with the maps between its coordinates and the description's.

    `joints` has MuJoCo's joints, by name or number, of each joint of the description.
    """
    layout = description.layout
    q_index, v_index = np.zeros(model.nq, int), np.zeros(model.nv, int)
    free = []
    for joint in description.joints:
        if not joint.type.nv:
            continue
        q, v = _addresses(model, joints[joint.name])
        own_q, own_v = layout.full_q[joint.name], layout.full_v[joint.name]
        order = list(range(own_q.start, own_q.stop))
        if joint.type.quaternion is not None:
            # x, y, z, w here; w, x, y, z there.
            k = joint.type.quaternion
            order[k:] = [order[-1], *order[k:-1]]
        q_index[q], v_index[v] = order, range(own_v.start, own_v.stop)
        if joint.kind == "free":
            free.append((q[0], v[0]))
    ids = {name: model.body(name).id for name in bodies if name != "world"} | {"world": 0}
    return MujocoModel(model, q_index, v_index, tuple(free), ids, frozenset(absorbed), disabled)


def add_shapes(spec: Any, bodies: Mapping[str, Any], description: Model, shapes: Sequence[Shape]) -> None:
    """Add a site for each frame and geoms for the shapes; those on bodies that MuJoCo does not have are left out."""
    taken = {site.name for site in spec.sites}
    for frame in description.frames:
        if frame.body in bodies:
            name = reserved(frame.name, taken)
            bodies[frame.body].add_site(name=name, pos=frame.translation, quat=wxyz(frame.rotation))
    meshes: dict[int, str] = {}
    names: set[str] = set()
    for shape in shapes:
        if shape.body not in bodies:
            continue
        look: dict[str, Any] = {"pos": shape.translation, "quat": wxyz(shape.rotation), "group": 2}
        look |= {"mass": 0.0, "contype": 0, "conaffinity": 0}
        body = bodies[shape.body]
        look["type"] = getattr(mujoco.mjtGeom, f"mjGEOM_{shape.kind.upper()}")
        if shape.kind != "mesh":
            size = [*shape.size, 0.0, 0.0][:3]
            body.add_geom(name=reserved(shape.name, names), size=size, rgba=shape.color, **look)
            continue
        for surface in shape.meshes:
            if id(surface) not in meshes:
                meshes[id(surface)] = f"mesh{len(meshes)}"
                mesh = spec.add_mesh(name=meshes[id(surface)])
                mesh.uservert, mesh.userface = surface.vertices.ravel(), surface.triangles.ravel()
                # Surfaces with holes have no volume.
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
            name, rgba = reserved(shape.name, names), surface.color or shape.color
            body.add_geom(name=name, meshname=meshes[id(surface)], rgba=rgba, **look)
