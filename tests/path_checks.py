"""Checks of texts, quantities and runs on each kind's example: a refusal of the path's own, or the truth in NumPy."""

# ruff: noqa: ARG001, ARG005  # all checks, and all parts, are called alike
from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg
import scipy.optimize

import mbkit as mb
from mbkit.codegen.c_source import C_CODE, export_c
from mbkit.engines.registry import find_engine
from mbkit.errors import NumericalError
from mbkit.lagrangian import from_model, program
from mbkit.lagrangian.printing.summary import python_code
from mbkit.model.elements.paths import PATHS
from tests import kind_examples
from tests.fake_cuda import fake_gpu
from tests.kind_examples import EXAMPLES, TYPES, Example
from tests.plain_mechanics import Part
from validation.gpu import on_device

Check = Callable[[mb.Model, Path], None]


class NotAskedError(Exception):
    """A path asks for something that an example does not have, such as a loop."""


#: Steps of a short run, and their number.
_STEP, _STEPS = 1e-3, 5


@cache
def _names() -> dict[str, str]:
    return {kind_examples.example(name).model.name: name for name in EXAMPLES | TYPES}


def case(model: mb.Model) -> tuple[Example, Any]:
    """Return the example of a model, and the model's dynamics at its time."""
    x, dyn = kind_examples.example(_names()[model.name]), mb.dynamics(model, "lagrangian", compile=False)
    return x, dyn.at(**{model.time_parameter: x.t}) if model.time_parameter else dyn


def close(got: Any, wanted: Any, most: float = 1e-9) -> None:
    got, wanted = np.asarray(got), np.asarray(wanted)
    assert got.shape == wanted.shape
    assert np.abs(got - wanted).max(initial=0.0) < most * max(1.0, np.abs(wanted).max(initial=0.0))


def resting(x: Example) -> Example:
    """Return an example with dry friction whose joint x rests, held by a force below its limit, while others move."""
    c, k = x.plain, x.plain.n - (3 if x.name.endswith("several") else 1)
    at, level = np.arange(k, c.n), 0.3 if x.name == "joint.stiction" else 0.1
    rows = np.eye(c.n)[at]
    held = replace(
        c, v=np.where(np.arange(c.n) < k, 0.05 * c.v, 0.0), parts=[Part("held", (), speeds=lambda c, q: rows)]
    )
    out, tau = replace(x, plain=held, tau=0.05 * x.tau), 0.05 * x.tau
    needed = replace(out, plain=replace(held, parts=[])).force(out.accelerated()) - tau
    tau[at] += needed[at] - level
    return replace(out, tau=tau)


def stopping(x: Example, end: float) -> tuple[Example, np.ndarray]:
    """Return the same, whose joint x slides to a stop within some seconds, and x and its rate at their end."""
    rest = resting(x)
    c, k = rest.plain, len(rest.plain.parts[0].speeds(rest.plain, rest.plain.q))
    at = c.n - k
    (own,) = x.plain.parts

    def sliding(c: Any, t: float, q: np.ndarray, u: np.ndarray) -> Any:
        # Of one side, so that nothing jumps.
        return own.force(
            c, t, q, np.where(np.arange(c.n) == at, np.maximum(u, 1e-12), np.where(np.arange(c.n) > at, 0.0, u))
        )

    parts = [Part("sliding", (), force=sliding)]
    parts += [Part("held", (), speeds=lambda c, q: np.eye(c.n)[at + 1 :])] if k > 1 else []
    start = replace(rest, plain=replace(c, v=c.v + 0.04 * end * np.eye(c.n)[at], parts=parts))
    t = scipy.optimize.brentq(lambda t: start.flow([t])[-1][c.n + at], 1e-3 * end, end, xtol=1e-14)
    q, v = np.split(start.flow([t])[-1], 2)
    stopped = replace(c, q=q, v=np.where(np.arange(c.n) < at, v, 0.0), t=c.t + t)
    return start, replace(rest, plain=stopped).flow([end - t])[-1]


# Texts


@cache
def _library(folder: Path) -> Any:
    """Return one library of all examples in C, as a compiler's start takes longer than they do."""
    texts = []
    for name in EXAMPLES:
        model = kind_examples.example(name).model
        if not C_CODE.refuses(model):
            made = export_c(model, ["forward_dynamics"], name=name.replace(".", "_"))
            _, source = made.write(folder)
            texts.append(f'#include "{source}"')
    (folder / "all.c").write_text("\n".join(texts), encoding="utf-8")
    command = ["cc", "-w", "-O0", "-shared", "-fPIC", f"-I{folder}", "all.c", "-o", "all.so", "-lm"]
    subprocess.run(command, check=True, cwd=folder)
    return ctypes.CDLL(str(folder / "all.so"))


def in_c(model: mb.Model, folder: Path) -> None:
    export_c(model, ["forward_dynamics"])
    x, name = case(model)[0], _names()[model.name].replace(".", "_")
    call, out = getattr(_library(folder.parent), f"{name}_forward_dynamics"), np.full(x.model.nv, np.nan)
    call.restype = None
    numbers = [x.t if n == model.time_parameter else value for n, value in model.parameters.items()]
    given = [np.array(y, dtype=float) for y in (x.q, x.v, x.tau, numbers)[: 3 + bool(numbers)]]
    call(*(y.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for y in (*given, out)))
    close(out, x.accelerated())


def by_program(model: mb.Model, folder: Path) -> None:
    text, names = program(model, "forward_dynamics"), dict[str, Any]()
    x = case(model)[0]
    exec(text.python(), names)
    numbers = [np.array([x.t if n == model.time_parameter else value for n, value in model.parameters.items()])]
    out = names["forward_dynamics"](x.q, x.v, x.tau, *numbers[: len(text.inputs) - 3])
    close(np.ravel(out), x.accelerated())


def on_paper(model: mb.Model, folder: Path) -> None:
    if model.nv > 4:
        raise NotAskedError("equations of a ball or a plane behind three hinges take up to half a minute")
    written = from_model(model, drives=bool(model.prescribed)).model
    x = case(model)[0]
    dyn = mb.dynamics(written, "lagrangian", compile=False)
    dyn = dyn.at(**{written.time_parameter: x.t}) if written.time_parameter else dyn
    # A quaternion is three angles there.
    close(dyn.forward_dynamics(x.plain.q, x.v, x.tau), x.accelerated())


# Quantities


def by_loads(model: mb.Model, folder: Path) -> None:
    """Every body's balance of forces and moments, with the loads of joints; a hinge's moment is its torque."""
    x, dyn = case(model)
    under = (None, None, "local", None, x.tau) if model.constrained else (x.accelerated(),)
    loads = dyn.joint_wrenches(x.q, x.v, *under)
    assert len(loads) == sum(j.type.nv > 0 for j in model.joints)
    # Springs and losses of joints are in their loads, and what a gear or a drive adds there is not known here.
    inside = x.name.startswith(("joint.", "coupling."))
    if not x.name.startswith(("coupler", "motion", "mimic")):
        torques = x.force(x.accelerated(), bodies=True) if inside else x.tau
        for k, joint in enumerate(j for j in model.joints if j.type.nv):
            if joint.kind in ("revolute", "prismatic"):
                force, moment = np.split(loads[k], 2)
                own = joint.axes[0] @ (moment if joint.kind == "revolute" else force)
                close(own, torques[model.layout.v[joint.name].start])
    close(dyn.newton_euler_residual(x.q, x.v, x.accelerated(), x.tau), np.zeros((len(model.bodies), 6)))


def by_loop_loads(model: mb.Model, folder: Path) -> None:
    x, dyn = case(model)
    assert dyn.loop_wrenches(x.q, x.v, x.tau).shape == (len(model.loops), 6)
    assert model.loops
    by_loads(model, folder)


def by_rows(model: mb.Model, folder: Path) -> None:
    """The rows hold at the state, and for the acceleration that they leave."""
    x, dyn = case(model)
    J, zero = dyn.constraint_jacobian(x.q), np.zeros(len(dyn.constraint_names))
    close(dyn.constraint_residual(x.q), zero[: len(zero) - len(dyn.velocity_constraint_names)])
    close(dyn.constraint_rate(x.q, x.v), zero)
    close(J @ x.accelerated() + dyn.constraint_bias(x.q, x.v), zero)


def by_actuators(model: mb.Model, folder: Path) -> None:
    x, dyn = case(model)
    tau, _ = dyn.actuator_forces(x.q, x.v, x.accelerated())
    close(x.acceleration(x.t, x.plain.q, x.plain.v, tau), x.accelerated())


def by_reduced_inertia(model: mb.Model, folder: Path) -> None:
    """Half of it times squared rates is the energy of a motion that the rows allow, and it changes along that."""
    x, dyn = case(model)
    h = 1e-5
    degrees, energy = dyn.mobility(x.q).degrees_of_freedom, 0.5 * x.v @ x.mass_matrix(x.plain.q) @ x.v
    for names in combinations(range(model.nv), degrees):
        of, rates = [model.velocity_names[k] for k in names], x.v[list(names)]
        try:
            J, slopes, _ = dyn.reduced_inertia(x.q, of)
        except NumericalError:
            continue
        close(0.5 * rates @ J @ rates, energy)
        ahead, back = (dyn.reduced_inertia(model.integrate(x.q, s * x.v), of).inertia for s in (h, -h))
        close(slopes @ rates, (ahead - back) / (2 * h), 1e-6)
        return
    raise AssertionError("no coordinates determine the others")


def by_operational_space(model: mb.Model, folder: Path) -> None:
    x, dyn = case(model)
    space = mb.operational_space(dyn, x.q, "b2", rows=[0])
    J = x.jacobian(x.plain.q, "b2")[0]
    # The frame's answer to a force on it, whatever else holds it.
    close(space.inertia, [[1 / (J @ (x.moved(0 * J, x.v, x.tau + J) - x.accelerated()))]])


def by_linearizing(model: mb.Model, folder: Path) -> None:
    """Against differences of the truth, along changes that keep the constraints."""
    x, dyn = case(model)
    n, h = model.nv, 1e-5
    A, B, f, _ = dyn.linearize(x.q, x.v, x.tau)
    changes = np.eye(2 * n)
    if model.constrained:
        J, G = dyn.constraint_jacobian(x.q), dyn.constraint_rate_gradient(x.q, x.v)
        held = len(J) - len(dyn.velocity_constraint_names)
        changes = scipy.linalg.null_space(np.block([[J[:held], np.zeros((held, n))], [G, J]]))
    for z in changes.T:
        ahead, back = (x.moved(s * z[:n], x.v + s * z[n:], x.tau) for s in (h, -h))
        close(A[n:] @ z, (ahead - back) / (2 * h), 1e-6)
    push = np.eye(n)
    wanted = [x.moved(np.zeros(n), x.v, x.tau + e) - x.accelerated() for e in push]
    if "jump" not in {word for name in model.acts for word in mb.model.elements.kinds.kind(name).does}:
        close(B[n:], np.array(wanted).T.reshape(n, n))
    close(f[n:], x.accelerated())


def by_step_derivative(model: mb.Model, folder: Path) -> None:
    """At a state where all moves, and at one that dry friction stops within the step."""
    x, dyn = case(model)
    n, h, dt = model.nv, 1e-5, 0.01
    for v in (x.v, 1e-3 * x.v, *([resting(x).v] if model.needs.friction else [])):
        A, B, _ = dyn.discretize(x.q, v, x.tau, dt)

        def after(z: np.ndarray, v: np.ndarray = v) -> tuple[np.ndarray, np.ndarray]:
            return dyn.step(model.integrate(x.q, z[:n]), v + z[n : 2 * n], x.tau + z[2 * n :], dt)

        for z, column in zip(np.eye(3 * n), np.hstack([A, B]).T, strict=True):
            (q1, v1), (q0, v0) = after(h * z), after(-h * z)
            close(column, np.concatenate([model.difference(q0, q1), v1 - v0]) / (2 * h), 1e-6)


def on_a_gpu(model: mb.Model, folder: Path) -> None:
    x = case(model)[0]
    with fake_gpu():
        dyn = mb.dynamics(model, "lagrangian", compile=True, device="cuda")
        dyn = dyn.at(**{model.time_parameter: x.t}) if model.time_parameter else dyn
        here = case(model)[1]
        # At rest dry friction is another one, which holds a part in its place.
        for v, wanted in ((x.v, x.accelerated()), (0 * x.v, None)):
            if wanted is None and model.constrained:
                continue
            wanted = here.forward_dynamics(x.q, v, x.tau) if wanted is None else wanted
            out = dyn.forward_dynamics(*(on_device(np.stack([y, y]), major=False) for y in (x.q, v, x.tau)))
            close(np.asarray(out.numpy() if hasattr(out, "numpy") else out), [wanted] * 2)


# Pictures, and what is written on paper


def by_showing(model: mb.Model, folder: Path) -> None:
    """The bodies stand where NumPy has them, but for a turn of the scene."""
    scene = mb.show(model, kind_examples.example(_names()[model.name]).q, folder / "x.html").scene
    x = case(model)[0]
    R, p = x.plain.poses(x.plain.q)[x.links[x.tip]]
    up, at = scene.rotations[0, 0], scene.bodies.index(x.tip)
    close(scene.rotations[0, at], up @ R)
    close(scene.translations[0, at], up @ p)


def by_constraint_law(model: mb.Model, folder: Path) -> None:
    x = case(model)[0]
    close(mb.dynamics(model, "mujoco").constraint_law(x.q, x.v, x.tau).rigid, x.accelerated())


def as_a_module(model: mb.Model, folder: Path) -> None:
    """A model that was written as energies, or is; bodies with rows come there as energies with rows."""
    gate = PATHS["python module"]
    if model.has_bodies and gate.refuses(model):
        gate.admit(model)
    if model.nv > 4:
        raise NotAskedError("more than four joints take long to write")
    x, names = case(model)[0], dict[str, Any]()
    exec(python_code(model.form if not model.has_bodies else from_model(model)), names)
    given = {"t": x.t} if model.time_parameter else {}
    close(names["forward_dynamics"](x.plain.q, x.v, x.tau, **given), x.accelerated())


def by_embedding(model: mb.Model, folder: Path) -> None:
    if model.has_bodies:
        PATHS["paper"].admit(model)
        PATHS["embedded"].admit(model)
    if model.nv > 4:
        raise NotAskedError("more than four joints take long to write")
    x = case(model)[0]
    lag = model.form if not model.has_bodies else from_model(model, drives=bool(model.prescribed))
    run = mb.simulate(lag.embedded(), x.plain.q, x.v, 5e-3, "rk853", torque=x.tau, t0=x.t, save=[x.t + 5e-3])
    close(run.v[-1], x.motion(np.array([0.0, 5e-3]))[1][-1], 1e-8)


# Runs


def by_running(method: str, most: float, engine: str = "lagrangian", **setting: Any) -> Check:
    def check(model: mb.Model, folder: Path) -> None:
        x, _ = case(model)
        duration = _STEPS * setting.get("dt", _STEP)
        one(x, duration, x.flow([duration])[-1])
        if model.needs.friction:
            one(resting(x), duration, resting(x).flow([duration])[-1])
            one(stopping(x, duration)[0], duration, stopping(x, duration)[1])

    def one(x: Example, duration: float, end: np.ndarray) -> None:
        brief = find_engine(engine).brief
        dyn, (q, v) = mb.dynamics(x.model, engine, **brief), x.state(end)
        save = None if "dt" in setting else np.array([x.t, x.t + duration])
        run = mb.simulate(dyn, x.q, x.v, duration, method, torque=x.tau, t0=x.t, save=save, **setting)
        close(x.model.difference(q, run.q[-1]), np.zeros(x.model.nv), most)
        close(run.v[-1], v, most)

    return check


def by_mujocos_steps(model: mb.Model, folder: Path) -> None:
    x, _ = case(model)
    # What it refuses it refuses before any step.
    mb.simulate(mb.dynamics(x.model, "mujoco"), x.q, x.v, _STEP, "mujoco_rk4", _STEP, torque=x.tau, t0=x.t)
    if model.constrained:
        raise NotAskedError("MuJoCo's own steps hold it softly")
    by_running("mujoco_rk4", 1e-6, "mujoco", dt=_STEP)(model, folder)


def by_phases_and_moreau(model: mb.Model, folder: Path) -> None:
    by_running("rk4", 1e-9, dt=_STEP)(model, folder)
    by_running("moreau", 1e-6, dt=1e-6)(model, folder)


def by_phases_beside_soft_constraints(model: mb.Model, folder: Path) -> None:
    PATHS["friction beside soft constraints"].admit(model)
    if not model.needs.friction:
        raise NotAskedError("nothing jumps")
    by_running("rk4", 1e-9, "mujoco", dt=_STEP)(model, folder)


def by_exciting(model: mb.Model, folder: Path) -> None:
    """The motion is one: velocities are the rates of its coordinates."""
    motion = mb.excitation(model, duration=2.0, harmonics=2, rate=200.0, iterations=1)
    dt = motion.t[1]
    close(motion.v[1:-1], (motion.q[2:] - motion.q[:-2]) / (2 * dt), 1e-3)
    close(motion.a[1:-1], (motion.v[2:] - motion.v[:-2]) / (2 * dt), 1e-3)
    if model.constrained:
        dyn = case(model)[1]
        close(dyn.constraint_rate(motion.q[1], motion.v[1]), np.zeros(len(dyn.constraint_names)))


CHECKS: dict[str, Check] = {
    "c": in_c,
    "program": by_program,
    "paper": on_paper,
    "loads": by_loads,
    "loads of loops": by_loop_loads,
    "constraint rows": by_rows,
    "actuator forces": by_actuators,
    "reduced inertia": by_reduced_inertia,
    "operational space": by_operational_space,
    "picture": by_showing,
    "constraint law": by_constraint_law,
    "python module": as_a_module,
    "embedded": by_embedding,
    "linearize": by_linearizing,
    "derivative of a step": by_step_derivative,
    "gpu under force": on_a_gpu,
    "symplectic runs": by_running("implicit_midpoint", 1e-6, dt=_STEP),
    "runs": by_phases_and_moreau,
    "friction beside soft constraints": by_phases_beside_soft_constraints,
    "runs without phases": by_mujocos_steps,
    "excitation": by_exciting,
}
