"""The MuJoCo model that mbkit builds, as MJCF with every digit, and read back by MuJoCo's own parser.

MuJoCo's writer keeps six digits. Here numbers are the shortest decimals that give the same doubles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

import mujoco
import numpy as np

from mbkit._check import Array
from mbkit._escape import xml_attribute, xml_comment
from mbkit.engines.mujoco.constraints import OF_JOINTS, OF_TENDON, Softness
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.mujoco.model import INERTIA, MUJOCO, OF_COUPLING, Placed, by_mbkit, heard_warnings, mapped, specified
from mbkit.errors import MbkitError, UnsupportedError
from mbkit.load.mjcf import JOINT_NUMBERS
from mbkit.load.mjcf_reader import KINDS
from mbkit.methods.simulation_settings import Servo, Settings
from mbkit.model import Joint, Model
from mbkit.model.elements.kinds import AS_LIMITS, EFFECTS
from mbkit.model.elements.paths import Path

_TYPES: Final = tuple(KINDS)
#: Largest number that MuJoCo takes.
_UNBOUNDED: Final = float(mujoco.mjMAXVAL)


def _numbers_not_held(model: Model) -> Iterator[str]:
    yield from MUJOCO.also(model)
    for joint in model.joints:
        parts = [joint.damping] if joint.kind == "ball" else np.split(joint.damping, 2) if joint.kind == "free" else []
        if any(np.ptp(x) > 0 for x in parts):
            yield f"joint {joint.name!r} is damped differently along its body axes"
        elif joint.kind == "free" and joint.parent == "world" and np.ptp(joint.damping) > 0:
            yield f"joint {joint.name!r} is damped differently in turning and in moving"
    for coupling in model.couplings:
        if coupling.rotors and model.branched(coupling):
            yield f"coupling {coupling.name!r} has {INERTIA} between branches, which MuJoCo leaves out of M"
    yield from (f"{force}, which is no spring and no weight of MuJoCo's" for force in by_mbkit(model))
    yield from (f"body {name!r}: {why}" for name, why in model.nonphysical)


def _notes(model: Model) -> Iterator[str]:
    efforts = ((j, j.effort_limit[np.isfinite(j.effort_limit)]) for j in model.joints)
    if lost := [j.name for j, x in efforts if len(x) and (j.type.nv > 1 or not x.all())]:
        yield f"MJCF has no effort limits of zero or of several velocities at once: {', '.join(lost)}"
    moments = {b.name: np.linalg.eigvalsh(b.inertia) for b in model.bodies if b.mass}
    if lifted := [repr(n) for n, (low, middle, high) in moments.items() if low < 1e-15 or low + middle < high]:
        yield f"principal moments of points and plates were lifted to what MuJoCo takes: {', '.join(lifted)}"


_SOFT_LIMITS: Final = "MuJoCo acts on joint limits, softly, which mbkit's terms leave out"
MJCF: Final = Path(
    "mjcf",
    "MJCF cannot say of",
    MUJOCO.carries - {"joint.stiction", "force.joint", "force.frame", "force.of_time"},
    MUJOCO.why,
    {
        "mimic": "mimic joints are free joints with equality constraints, which MuJoCo keeps softly",
        "row": "loops are equality constraints, which MuJoCo keeps softly",
        "joint.limit": lambda model: "" if model.needs.stops else _SOFT_LIMITS,
        "joint.stop": AS_LIMITS,
        "joint.friction": f"MuJoCo's {EFFECTS['jump']} is soft; mbkit's holds exactly at rest",
        "joint.velocity_limit": "MJCF has no velocity limits",
    },
    also=_numbers_not_held,
    beside=_notes,
)


def mjcf_text(model: Model, comment: str, settings: Settings | None = None) -> str:
    """Return a description as MJCF, or raise `UnsupportedError` with all that MJCF cannot hold of it.

    With settings of a simulation the text has them too: options and actuators.
    """
    MJCF.admit(model)
    held: Any = (settings.limit_softness if settings else None) or ()
    spec, placed, _ = specified(model, limits={joint: Softness(*numbers) for joint, *numbers in held})
    lines = [
        f"<mujoco model={xml_attribute(model.name)}>",
        f"  <!-- {xml_comment(comment)} -->",
        '  <compiler angle="radian" autolimits="false" inertiafromgeom="false" balanceinertia="false"/>',
        *_options(model, settings or Settings()),
        "  <worldbody>",
    ]
    owners = {name: joint for joint in model.joints for name in placed.joints[joint.name]}
    lines += [*_body(spec.worldbody, owners, placed, model, "    "), "  </worldbody>"]
    servos = _actuators((settings.servos if settings else None) or (), placed)
    return "\n".join([*lines, *_tendons(spec, model), *_equalities(spec, model), *servos, "</mujoco>", ""])


def _options(model: Model, settings: Settings) -> Iterator[str]:
    own: dict[str, Any] = {"timestep": settings.time_step, "tolerance": settings.tolerance}
    if settings.integrator:
        name = settings.integrator.removeprefix("mujoco_")
        own["integrator"] = {"euler": "Euler", "rk4": "RK4"}.get(name, name)
    if settings.solver:
        own["solver"] = {"newton": "Newton"}.get(settings.solver, settings.solver.upper())
    if settings.iterations is not None:
        own["iterations"] = str(settings.iterations)
    flags = {"eulerdamp": settings.implicit_damping, "limit": settings.limits}
    off = {name: "disable" for name, on in flags.items() if on is False}
    yield f"  <option{_attributes(gravity=model.gravity, **own)}{'>' if off else '/>'}"
    if off:
        yield f"    <flag{_attributes(**off)}/>"
        yield "  </option>"


def _actuators(servos: Sequence[Servo], placed: Placed) -> Iterator[str]:
    if servos:
        yield "  <actuator>"
    for x in servos:
        (joint,) = placed.joints[x.joint]
        gain = {"position": x.kp, "velocity": x.kv}.get(x.kind, 1.0)
        own: dict[str, Any] = {"name": x.joint, "joint": joint, "gear": x.gear, "gainprm": gain}
        own |= {} if x.kind == "motor" else {"biastype": "affine", "biasprm": (0.0, -x.kp, -x.kv)}
        for name, limited, bounds in (
            ("ctrlrange", "ctrllimited", x.control_range),
            ("forcerange", "forcelimited", x.force_range),
        ):
            # A bound on one side alone is MuJoCo's largest number on the other.
            own |= (
                {limited: "true", name: np.clip(bounds, -_UNBOUNDED, _UNBOUNDED)} if np.isfinite(bounds).any() else {}
            )
        yield f"    <general{_attributes(**own)}/>"
    if servos:
        yield "  </actuator>"


def read_back(model: Model, text: str) -> MujocoDynamics:
    """Return the model that MuJoCo's parser reads from a text of `mjcf_text`, in the description's coordinates."""
    _, placed, _ = specified(model)
    with heard_warnings():
        try:
            compiled = mujoco.MjModel.from_xml_string(text)
        except ValueError as error:
            reason = " ".join(str(error).split())
            raise UnsupportedError(f"mujoco: refuses what was written of {model.name}: {reason}") from None
    held = compiled.body_gravcomp
    if lost := [name for name, body in placed.bodies.items() if held[compiled.body(name).id] != body.gravcomp]:
        raise MbkitError(f"mujoco: gravity compensation of {lost[0]!r} reads back otherwise; please report this model")
    return MujocoDynamics.holding(model, mapped(compiled, model, placed.joints, placed.bodies, placed.absorbed))


def _attributes(**values: Any) -> str:
    out = []
    for name, value in values.items():
        if isinstance(value, str):
            out.append(f" {name}={xml_attribute(value)}")
        elif value is not None:
            out.append(f' {name}="{" ".join(repr(float(x)) for x in np.ravel(value))}"')
    return "".join(out)


def _body(body: Any, owners: dict[str, Joint], placed: Placed, model: Model, indent: str) -> Iterator[str]:
    name = body.name
    if name != "world":
        moments = placed.degenerate.get(name, np.array(body.inertia))
        if body.mass > 0 or moments.any():
            at = _attributes(pos=body.ipos, quat=body.iquat, mass=body.mass, diaginertia=_allowed(moments))
            yield f"{indent}<inertial{at}/>"
    for joint in body.joints:
        yield f"{indent}<joint{_joint(joint, owners[joint.name])}/>"
    for site in body.sites:
        turned = None if np.array_equal(site.quat, [1.0, 0.0, 0.0, 0.0]) else site.quat
        yield f"{indent}<site{_attributes(name=site.name, pos=site.pos, quat=turned)}/>"
    for f in model.frames:
        if f.body == name:
            yield f"{indent}<site{_attributes(name=f.name, pos=f.translation, xyaxes=f.rotation.T[:2])}/>"
    for child in body.bodies:
        simple = None if child.simple else "false"
        placing = _attributes(name=child.name, pos=child.pos, quat=child.quat, gravcomp=child.gravcomp or None)
        yield f"{indent}<body{placing}{_attributes(simple=simple)}>"
        yield from _body(child, owners, placed, model, indent + "  ")
        yield f"{indent}</body>"


def _allowed(moments: Array) -> Array:
    """Return principal moments that MuJoCo takes: a point's are lifted off zero, a plate's last digit lowered."""
    out: Array = np.maximum(moments, 2 * mujoco.mjMINVAL)
    low, middle, high = np.argsort(out)
    if out[low] + out[middle] < out[high]:
        # Half of the missing amount on each side; a thin plate misses a rounding.
        out[low] += out[high] - out[low] - out[middle]
    while out[low] + out[middle] < out[high]:
        out[low] = np.nextafter(out[low], np.inf)
    return out


def _joint(joint: Any, owner: Joint) -> str:
    kind = _TYPES[int(joint.type)]
    attributes: dict[str, Any] = {"name": joint.name, "type": kind}
    if kind in ("hinge", "slide"):
        attributes |= {"pos": joint.pos, "axis": joint.axis, **_numbers(joint, *JOINT_NUMBERS.values())}
        attributes["springref"] = joint.springref if attributes["stiffness"] else None
        # 2 is MuJoCo's "as the range says".
        if int(joint.limited) == 1:
            attributes |= {"limited": "true", "range": joint.range}
            if Softness(tuple(joint.solref_limit), tuple(joint.solimp_limit)) != Softness():
                attributes |= {"solreflimit": joint.solref_limit, "solimplimit": joint.solimp_limit}
        if owner.type.nv == 1 and 0 < owner.effort_limit[0] < np.inf:
            effort = owner.effort_limit[0]
            attributes |= {"actuatorfrclimited": "true", "actuatorfrcrange": (-effort, effort)}
    else:
        attributes |= {"pos": joint.pos} if kind == "ball" else {}
        fields = Joint.adding_to("loss") + Joint.adding_to("T")
        attributes |= {JOINT_NUMBERS[x]: getattr(owner, x)[-1] or None for x in fields}
        attributes |= _numbers(joint, "stiffness")
    attributes["actuatorgravcomp"] = "true" if joint.actgravcomp else None
    return _attributes(**attributes)


def _numbers(element: Any, *names: str) -> dict[str, float | None]:
    """Return the first of each of these numbers, None for a zero."""
    return {name: np.ravel(getattr(element, name))[0] or None for name in names}


def _tendons(spec: Any, model: Model) -> Iterator[str]:
    if spec.tendons:
        yield "  <tendon>"
    for k, tendon in enumerate(spec.tendons):
        between_points = k < len(model.springs)
        tag, names = ("spatial", ("stiffness", "damping")) if between_points else ("fixed", OF_COUPLING)
        numbers = _numbers(tendon, *names)
        rest = tendon.springlength[0] if between_points or numbers["stiffness"] else None
        yield f"    <{tag}{_attributes(name=tendon.name, springlength=rest, **numbers)}>"
        for wrap in tendon.path:
            part = {"site": wrap.target.name} if between_points else {"joint": wrap.target.name, "coef": wrap.coef}
            yield f"      <{'site' if between_points else 'joint'}{_attributes(**part)}/>"
        yield f"    </{tag}>"
    if spec.tendons:
        yield "  </tendon>"


def _equalities(spec: Any, model: Model) -> Iterator[str]:
    mimics = [(j.name, j.mimic) for j in model.joints if j.mimic is not None]
    if mimics or spec.equalities:
        yield "  <equality>"
        for loop in spec.equalities:
            if loop.type == OF_JOINTS:
                ends = {"joint1": loop.name1, "joint2": loop.name2, "polycoef": loop.data[:5]}
                yield f"    <joint{_attributes(name=loop.name, **ends)}/>"
                continue
            if loop.type == OF_TENDON:
                ends = {"tendon1": loop.name1, "polycoef": loop.data[:5]}
                yield f"    <tendon{_attributes(name=loop.name, **ends)}/>"
                continue
            tag = "connect" if loop.type == mujoco.mjtEq.mjEQ_CONNECT else "weld"
            yield f"    <{tag}{_attributes(name=loop.name, site1=loop.name1, site2=loop.name2)}/>"
        for name, m in mimics:
            shape = (m.offset, m.ratio, 0.0, 0.0, 0.0)
            yield f"    <joint{_attributes(joint1=name, joint2=m.joint, polycoef=shape)}/>"
        yield "  </equality>"
