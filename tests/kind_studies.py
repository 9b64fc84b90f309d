"""Columns of the matrix for files, other environments and studies; `tests.kind_paths` has the others, and the rules."""

# ruff: noqa: ARG001, ARG005  # all paths are called alike
from __future__ import annotations

import ctypes
import html
import os
import re
import subprocess
import tempfile
from dataclasses import fields, replace
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from textwrap import dedent
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import scipy.optimize
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.cli import cli
from mbkit.codegen.c_source import export_c
from mbkit.engines.imported import reader
from mbkit.engines.oracle import OracleDynamics
from mbkit.engines.remote import environment
from mbkit.engines.remote.packages import PACKAGES
from mbkit.errors import UnsupportedError
from mbkit.lagrangian import from_model
from mbkit.lagrangian.summary import SystemSummary, python_code
from mbkit.model import Model
from mbkit.model.elements.kinds import PART_KINDS
from mbkit.model.elements.paths import PATHS as GATES
from mbkit.pytest_plugin import MbkitBaseline
from mbkit.report.page import render
from mbkit.studies._targets import with_values
from mbkit.studies.baseline.file import Rollout
from mbkit.studies.compare import figure
from mbkit.studies.compare.study import Judge
from mbkit.studies.compare.terms import TERMS, states
from mbkit.studies.importers.study import Written, between_joints, compared
from mbkit.studies.measurement import Problem
from mbkit.studies.stress.case import Case as StressCase
from mbkit.studies.stress.measurements import Limits, measure, prepare
from mbkit.testing import assert_same_dynamics
from tests import kind_examples
from tests.fake_cuda import fake_gpu
from tests.kind_examples import Example, size_of
from tests.kind_paths import (
    CLOSE,
    COLUMNS,
    DURATION,
    QUATERNIONS,
    ROWS,
    STEP,
    NotAskedError,
    Told,
    aligned,
    cell,
    column,
    derived,
    dynamics,
    engine,
    flow,
    kept,
    lacks_stops,
    more_inputs,
    named,
    off,
    on_paper,
    program_of,
    registered,
    resting,
    without_part,
)
from tests.plain_mechanics import Case, Part, derivative, rotation
from tests.test_engine_versions import present
from tests.written_math import assigned, lines_of_latex, lines_of_text, number, plain
from validation.gpu import on_device

__all__ = ["ABSENT", "COLUMNS", "ROWS", "cell", "registered"]

#: Why the terms of an engine are not asked for.
ABSENT = "its gate takes it, and its environment is not here"

# Engines in environments of their own


@cache
def _elsewhere(engine: str) -> Any:
    """Return an engine of the installed version: its own environment, or the present interpreter as one."""
    os.environ.setdefault("MBKIT_ENVIRONMENTS", tempfile.mkdtemp())
    if find_spec(PACKAGES[engine].module.partition(".")[0]) is None:
        raise NotAskedError(f"{engine} is not installed")
    package = PACKAGES[engine].distribution
    if environment.exists(package, version(package)):
        return mb.engine(f"{engine}=={version(package)}")
    return present(engine, version(package))


def _sent(x: Example, which: str) -> mb.Dynamics:
    dyn = mb.dynamics(x.model, which if PACKAGES[which].tested else _elsewhere(which))
    return dyn.at(**{x.model.time_parameter: x.t}) if x.model.time_parameter else dyn


def _remote(x: Example, folder: Path, which: str) -> Told:
    dyn, a, c = _sent(x, which), 0.3 * x.v + 0.1, x.plain
    inverse = off(dyn.inverse_dynamics(x.q, x.v, a), x.force(a))
    M = off(dyn.mass_matrix(x.q), x.mass_matrix(c.q))
    kinetic = off(dyn.kinetic_energy(x.q, x.v), c.v @ c.mass_matrix(c.q) @ c.v / 2)
    other = x.position(0.5 * c.q)
    one = dyn.potential_energy(x.q) - dyn.potential_energy(other)
    potential = off(one, c.potential(c.q) - c.potential(0.5 * c.q))
    return max(off(dyn.forward_dynamics(x.q, x.v, x.tau), x.accelerated()), M, inverse, kinetic, potential)


column("other environments", "sent as data (Pinocchio)", "sent", which="pinocchio")(_remote)
column("other environments", "sent as data (Drake)", "sent to drake", which="drake")(_remote)
# A helical joint that could be sent is refused by the MJCF.
column("other environments", "sent as MJCF (MuJoCo)", which="mujoco")(_remote)


@column("other environments", "own run there (MuJoCo)", "mjcf", "sent", "remote runs", close=1e-8)
def _remote_run(x: Example, folder: Path) -> Told:
    q, v = _sent(x, "mujoco").rollout(x.q, x.v, STEP, round(DURATION / STEP))
    wanted = x.state(x.flow([DURATION], lambda t, q, v: 0 * v)[-1])
    return max(off(aligned(q[-1], x, wanted[0]), wanted[0]), off(v[-1], wanted[1]))


class _TakenError(Exception):
    """A model passed the gate of an engine whose environment is not here."""


def _trained(x: Example, folder: Path, which: str) -> Told:
    """The terms where the engine's environment is; else its gate alone, before a process is asked for."""
    package = PACKAGES[which]
    if environment.exists(package.distribution, package.tested[-1]):
        return _remote(x, folder, which)

    def interpreter(*_: Any, **__: Any) -> Path:
        raise _TakenError

    with patch.object(environment, "interpreter", interpreter):
        try:
            mb.dynamics(x.model, which)
        except _TakenError:
            lost = package.path.refuses(x.model)
            if lost:
                raise AssertionError(f"not asked: {lost}") from None
            raise NotAskedError(ABSENT) from None
    raise AssertionError("no process was asked for")


column("other environments", "Newton", "newton", close=1e-4, which="newton")(_trained)
column("other environments", "MuJoCo Warp", close=1e-4, which="mujoco-warp")(_trained)
column("other environments", "MJX", which="mjx")(_trained)

# Files in the engines' own importers


def _written(model: Model, folder: Path, to: str, name: str = "case") -> tuple[Path, tuple[str, ...]]:
    made = mb.convert(model, to)
    return made.write(folder / f"{name}.{'xml' if to == 'mjcf' else 'urdf'}"), tuple(map(str, made.notes))


def _in_steps(x: Example, of_model: np.ndarray, of_plain: np.ndarray, quaternions: bool = False) -> np.ndarray:
    """Return numbers of joints in MuJoCo's order: those of a ball are the model's, all others the plain case's."""
    out, at = [], 0
    for _, type_, k in x.joints:
        slides = 3 if type_ == "free" else 0
        size = QUATERNIONS.get(type_, (1, -1))[0] if quaternions else size_of(type_)
        ball = of_model[at + slides : at + size]
        turned = [ball[3:], ball[:3]] if quaternions else [ball]
        if type_ in ("ball", "free"):
            out += [of_plain[k : k + slides], *turned]
        else:
            out += [of_plain[k : k + size]]
        at += size
    return np.concatenate(out)


@column("files", "MJCF in MuJoCo alone", "mjcf", close=1e-8)
def _in_mujoco(x: Example, folder: Path) -> Told:
    """MuJoCo's own importer and solver, with hinges, slides and balls as its joints.

    Accelerations without its soft constraints, the space of its rows, and the numbers of friction and limits.
    """
    path, notes = _written(x.model, folder, "mjcf")
    m = mujoco.MjModel.from_xml_path(str(path))
    d, c, E = mujoco.MjData(m), x.plain, x.rates(x.plain.q)
    free = [p for p in c.parts if not p.rows] if "friction" not in x.name else []
    bare = replace(x, plain=replace(c, parts=free))
    acceleration = bare.plain.acceleration(x.t, c.q, c.v, E.T @ x.tau)
    turning = np.imag(x.rates(c.q + 1e-30j * c.v)) / 1e-30
    q, v = _in_steps(x, x.q, c.q, quaternions=True), _in_steps(x, x.v, c.v)
    a, tau = _in_steps(x, E @ acceleration + turning @ c.v, acceleration), _in_steps(x, x.tau, E.T @ x.tau)
    J = c.held(x.t, c.q)
    if x.name == "mimic":
        # It keeps the joint, as one that an equality holds.
        q, v, a, tau = c.G @ q + c.c, c.G @ v, c.G @ a, np.append(tau, 0.0)
        J = np.array([[0.7, 0.0, 0.0, -1.0]])
    d.qpos, d.qvel, d.qfrc_applied = q, v, tau
    mujoco.mj_forward(m, d)
    held = d.efc_J.reshape(-1, m.nv)[: d.ne]
    rows = off(*(np.linalg.pinv(z, rcond=1e-9) @ z for z in (held, J))) if len(J) or len(held) else 0.0
    loss = np.zeros(m.nv)
    if "friction" in x.name:
        loss[3:] = 0.2
    limits = x.model.joints[-1] if x.name.startswith("joint.limit") else None
    bounds = 0.0 if limits is None else off(m.jnt_range[3:], np.stack([limits.lower, limits.upper], 1))
    left = np.inf if "velocity_limit" in x.name else 0.0
    if "effort_limit" in x.name:
        left = off(m.jnt_actfrcrange[3:], [[-3.0, 3.0]] * (m.njnt - 3))
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    mujoco.mj_forward(m, d)
    if x.name == "mimic":
        # Its row is held by the multiplier of the exact one.
        M = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, M)
        lam = (J @ d.qacc) / (J @ np.linalg.solve(M, J.T))
        d.qacc -= np.linalg.solve(M, J.T) @ lam[0]
    return max(off(d.qacc, a), rows, off(m.dof_frictionloss, loss), bounds, left), notes


@column("files", "URDF in Pinocchio alone", "urdf")
def _in_pinocchio(x: Example, folder: Path) -> Told:
    """Pinocchio's own importer and algorithms, in its joints, and its numbers of losses and limits.

    Its inverse dynamics know no losses; its planar joints move along the body's axes, and turns without limits are
    cosine and sine.
    """
    path, notes = _written(x.model, folder, "urdf")
    m = pin.buildModelFromUrdf(str(path), mimic=True)
    m.gravity.linear = x.model.gravity
    n, a = x.model.nv, 0.3 * x.v + 0.1
    T, turned, q = np.zeros((m.nv, n)), np.zeros(m.nv), pin.neutral(m)
    for j in x.model.independent_joints:
        if not j.type.nv:
            continue
        own, at, there = m.joints[m.getJointId(j.name)], x.model.layout.v[j.name], x.q[x.model.layout.q[j.name]]
        to = slice(own.idx_v, own.idx_v + own.nv)
        angle, cut = there[-1], own.nq > own.nv and j.kind != "free"
        q[own.idx_q : own.idx_q + own.nq] = [*there[:-1], np.cos(angle), np.sin(angle)] if cut else there
        T[to, at] = np.eye(own.nv)
        if j.kind == "planar":
            T[to, at][:2, :2] = rotation(np.eye(3)[2], angle)[:2, :2].T
            rate, along = x.v[at][2], T[to, at][:2, :2] @ x.v[at][:2]
            turned[to][:2] = rate * np.array([along[1], -along[0]])
    force = T.T @ pin.rnea(m, m.createData(), q, T @ x.v, T @ a + turned)
    worst = off(force, x.force(a, bodies=True))
    M = np.triu(pin.crba(m, m.createData(), q))
    worst = max(worst, off(T.T @ (M + np.triu(M, 1).T) @ T, x.mass_matrix(x.plain.q)))
    for j in (j for j in kind_examples.example(x.name).model.independent_joints if j.type.nv == 1):
        own = m.joints[m.getJointId(j.name)]
        k = own.idx_v
        loss = [*m.damping[[k]], *m.upperDryFrictionLimit[[k]], *m.upperVelocityLimit[[k]], *m.upperEffortLimit[[k]]]
        given = [*j.damping, *j.friction, *j.velocity_limit, *j.effort_limit]
        bounds = [m.lowerPositionLimit[own.idx_q], m.upperPositionLimit[own.idx_q]] if own.nq == 1 else []
        given += [*j.lower, *j.upper][: len(bounds)]
        # Limits that are none would set the scale by which all are compared.
        two = (np.where(np.abs(z) > 1e8, 10 * np.sign(z), z) for z in (np.array([*loss, *bounds]), np.array(given)))
        worst = max(worst, off(*two))
    return worst, notes


@column("files", "engines' own importers")
def _importers(x: Example, folder: Path) -> Told:
    """MuJoCo's reading of the file is ours, and that of a file without the part is not."""
    path, notes = _written(x.model, folder, "mjcf")
    back = mb.load(path)
    loops = Written(*[between_joints(back, back.constraints)] * 2)
    read = reader("mbkit.engines.mujoco.importer")
    asked = {"samples": 2, "seed": 0, "tolerance": CLOSE}
    tree = replace(back, loops=(), couplers=())

    def differing(text: str) -> list[Any]:
        found = compared("mujoco", read(text, "mjcf", False, {}), tree, loops, asked)
        assert found.explanation is not None
        return [s for s in found.stages if s.same is False] + list(found.explanation.causes)

    assert not (bad := differing(path.read_text())), bad
    less = without_part(x)
    if less is not None and not differing(_written(less, folder, "mjcf", "less")[0].read_text()):
        return np.inf, notes
    return 0.0


# Texts


@column("texts", "C: its header", "c")
def _header(x: Example, folder: Path) -> Told:
    """It names what the code holds, and what it leaves out."""
    with derived(x):
        text = export_c(x.model, ["forward_dynamics"], name="case").header
    k = PART_KINDS.get(x.name)
    if not k or not k.features:
        raise NotAskedError("it is no part that can be taken out")
    holds = text.partition("Holds")[2].partition("Functions")[0]
    if any(n.replace("_", " ") in holds for n in k.features):
        return 0.0
    return np.inf, (text.partition("Conventions")[2].partition("Calls")[0],)


@column("texts", "program text and LaTeX, read", "program", close=1e-4)
def _read_program(x: Example, folder: Path) -> Told:
    """Both have six digits."""
    text = program_of(x.name)
    given = zip(text.inputs, (x.q, x.v, x.tau, *more_inputs(x)), strict=True)
    values = {str(s): float(z) for (_, symbols), y in given for s, z in zip(symbols, y, strict=True)}
    worst = 0.0
    for lines in (lines_of_text(str(text)), lines_of_latex(text.latex())):
        out = assigned(lines, values)
        worst = max(worst, off([y for n, y in out.items() if n.startswith("forward")], x.accelerated()))
    return worst, lacks_stops(x, str(text))


@column("texts", "program text in C", "program")
def _program_in_c(x: Example, folder: Path) -> Told:
    code = program_of(x.name).c()
    if not set(re.findall(r"[a-z]\w*(?=\()|\?", code)) - {"forward_dynamics", "sin", "cos", "pow"} - {"gravity"}:
        raise NotAskedError("it has no other functions than gravity's equations")
    (folder / "p.c").write_text(code, encoding="utf-8")
    subprocess.run(["cc", "-O0", "-shared", "-fPIC", "p.c", "-o", "p.so", "-lm"], check=True, cwd=folder)
    out = np.full(len(x.v), np.nan)
    given = (x.q, x.v, x.tau, *more_inputs(x), out)
    ctypes.CDLL(str(folder / "p.so")).forward_dynamics(*(y.ctypes.data_as(ctypes.c_void_p) for y in given))
    return off(out, x.accelerated())


@column("texts", "Python module of equations", "paper", "python module")
def _module(x: Example, folder: Path) -> Told:
    """A model with bodies comes there as its energies."""
    if x.model.has_bodies:
        GATES["paper"].admit(x.model)
        GATES["python module"].admit(x.model)
    if x.model.nv > 4:
        raise NotAskedError("more than four joints take long to write")
    x, lag = on_paper(x.name, flat=len(x.plain.kinds) > 2) if x.model.has_bodies else (x, x.model.form)
    names: dict[str, Any] = {}
    exec(python_code(lag), names)
    given = {"t": x.t} if x.model.time_parameter else {}
    return off(names["forward_dynamics"](x.plain.q, x.v, x.tau, **given), x.accelerated())


@column("texts", "equations of motion and LaTeX, read", "paper", close=1e-8)
def _read_equations(x: Example, folder: Path) -> Told:
    """Every equation holds at the true acceleration without a force, for some multipliers."""
    k = PART_KINDS.get(x.name)
    wide = x.name in ("joint_type.ball", "joint_type.spherical_zyx", "joint_type.universal")
    if wide or len(x.plain.kinds) > 4 or (k and k.does == {"bound"}) or x.name.endswith(".several"):
        raise NotAskedError("its equations are those of others, or fill pages")
    if not x.model.has_bodies:
        raise NotAskedError("it is written as energies")
    x, lag = on_paper(x.name, flat=len(x.plain.kinds) > 2)
    e, c = lag.equations(), x.plain
    a = x.acceleration(x.t, c.q, c.v, 0 * x.tau)
    coordinates = c.q if len(e.coordinates) == c.n else x.q
    forces = (*e.multipliers, *lag.stop_multipliers)
    symbols = (*e.coordinates, *e.velocities, *e.accelerations, *forces, *([lag.time] if lag.time else []))
    given = [*coordinates, *x.v, *a, *(0.0 for _ in forces), *([x.t] if lag.time else [])]
    if len(given) != len(symbols):
        raise AssertionError(f"{symbols}")
    values = {plain(str(s)): float(y) for s, y in zip(symbols, given, strict=True)}
    values |= {str(s): float(y) for s, y in lag.parameters.items() if y is not None}
    shown = SystemSummary(lag).text()
    lines = lines_of_text(dedent(shown.partition("of motion:\n")[2].partition("\n\n")[0]))
    letters = [x.removeprefix("with ") for x in shown.splitlines() if x.startswith("with ")]
    count, worst = len(e.coordinates) + len(e.constraints), 0.0
    latex = lines_of_latex(e.latex())
    for some, roots in ((lines, letters), (latex, latex[count:])):
        rows, known = [line.partition("=") for line in some[:count]], assigned(roots, values)

        def rest(more: dict[str, float], rows: Any = rows, known: dict[str, float] = known) -> np.ndarray:
            here = known | more
            return np.array([number(left, here) - number(right, here) for left, _, right in rows])

        r = rest({})
        if forces:
            columns = np.stack([rest({plain(str(s)): 1.0}) - r for s in forces], axis=1)
            r = r - columns @ np.linalg.lstsq(columns, r, rcond=None)[0]
        worst = max(worst, float(np.abs(r).max()))
    return worst


# Quantities


def _place(x: Example, q: np.ndarray) -> np.ndarray:
    """Return coordinates of the plain case from the model's."""
    out, at = np.zeros(x.plain.n), 0
    for _, type_, k in x.joints:
        size, four = QUATERNIONS.get(type_, (1, -1))
        slides = max(four, 0)
        out[k : k + slides] = q[at : at + slides]
        if four < 0:
            out[k : k + size] = q[at : at + size]
        else:
            turn = Rotation.from_quat(q[at + four : at + size])
            out[k + slides : k + slides + 3] = turn.as_euler("ZYX")
        at += size
    return out


@column("quantities", "second derivatives", close=1e-5)
def _second(x: Example, folder: Path) -> Told:
    """Second differences of the true torque along a line."""
    k = PART_KINDS.get(x.name)
    if k and {*k.does} & {"row", "speed", "bound"}:
        raise NotAskedError("no torque of a motion is its own")
    by = engine(x.name).inverse_dynamics_second_derivatives(x.q, x.v, 0.1 - 0.3 * x.v)
    dq, dv, da = np.random.default_rng(8).uniform(-1, 1, (3, len(x.v)))

    def torque(s: float) -> np.ndarray:
        c = x.plain
        q = _place(x, x.model.integrate(x.q, s * dq))
        u = np.linalg.solve(x.rates(q), x.v + s * dv)
        return replace(x, plain=replace(c, q=q, v=u)).force(0.1 - 0.3 * x.v + s * da)

    h = 1e-2
    ends = [torque(s * h) for s in (-2, -1, 0, 1, 2)]
    wanted = np.array([-1, 16, -30, 16, -1]) @ np.array(ends) / (12 * h**2)
    terms = ((by.qq, dq, dq, 1), (by.qv, dq, dv, 2), (by.vv, dv, dv, 1), (by.qa, dq, da, 2))
    return off(sum(f * np.einsum("ijk,j,k", A, d, e) for A, d, e, f in terms), wanted)


def _data(c: Case) -> dict[str, Any]:
    return {f.name: getattr(c, f.name) for f in fields(c) if f.init}


class _Cut(Case):
    """A case whose last body is also moved along and about the world's axes, by six coordinates behind the others."""

    @classmethod
    def of(cls, c: Case) -> _Cut:
        still = np.zeros(6)
        wide = np.hstack([c.G, np.zeros((len(c.G), 6))])
        return cls(**_data(c) | {"q": np.append(c.q, still), "v": np.append(c.v, still), "G": wide})

    def split(self, q: np.ndarray) -> tuple[Case, np.ndarray, np.ndarray, np.ndarray]:
        """Return the case, its coordinates, and of the others R and the axes of its three turns."""
        n = self.n - 6
        base = Case(**_data(self) | {"q": self.q[:n], "v": self.v[:n], "G": self.G[:, :n]})
        turns, axes = np.eye(3), []
        for axis, angle in zip(np.eye(3), q[n + 3 :], strict=True):
            axes.append(turns @ axis)
            turns = turns @ rotation(axis, angle)
        return base, q[:n], turns, np.stack(axes, axis=1)

    def poses(self, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        base, x, turn, _ = self.split(q)
        *out, (R, p) = base.poses(x)
        return [*out, (turn @ R, p + q[len(x) : len(x) + 3])]

    def turning(self, k: int, q: np.ndarray) -> np.ndarray:
        base, x, turn, axes = self.split(q)
        last = k == len(self.kinds) - 1
        more = np.hstack([np.zeros((3, 3)), axes]) if last else np.zeros((3, 6))
        return np.hstack([(turn if last else np.eye(3)) @ base.turning(k, x), more])

    def moving(self, k: int, at: Any, q: np.ndarray) -> np.ndarray:
        base, x, _, _ = self.split(q)
        if k != len(self.kinds) - 1:
            return np.hstack([base.moving(k, at, x), np.zeros((3, 6))])
        origin = np.hstack([base.moving(k, (0, 0, 0), x), np.eye(3), np.zeros((3, 3))])
        arm = self.poses(q)[k][0] @ np.asarray(at)
        return origin + np.stack([np.cross(w, arm) for w in self.turning(k, q).T], axis=1)


@column("quantities", "load of the last joint")
def _load(x: Example, folder: Path) -> Told:
    """The force and moment that keep the last body where its joint has it, by virtual displacements in all six ways."""
    if not x.links:
        raise NotAskedError("no bodies of its own")
    c, n, still = x.plain, x.plain.n, np.zeros(6)
    a = c.acceleration(x.t, c.q, c.v, x.rates(c.q).T @ x.tau)
    cut = _Cut.of(c)
    dM, q, v = derivative(cut.mass_matrix, cut.q), cut.q, cut.v
    h = np.einsum("ijk,j,k->i", dM, v, v) - np.einsum("jki,j,k->i", dM, v, v) / 2
    f = cut.mass_matrix(q) @ np.append(a, still) + h + derivative(cut.potential, q) - cut.loads(x.t, q, v)
    J = cut.held(x.t, q)
    rest = f[:n] - x.rates(c.q).T @ x.tau
    f = f - J.T @ np.linalg.lstsq(J[:, :n].T, rest, rcond=None)[0]
    R, _ = c.poses(c.q)[x.links[x.tip]]
    joint = [j.name for j in x.model.joints if j.child == x.tip] or None
    motion = (None, None, "local", joint, x.tau) if x.model.constrained else (x.accelerated(), None, "local", joint)
    own = engine(x.name).joint_wrenches(x.q, x.v, *motion)[0]
    return off(own, [*(R.T @ f[n : n + 3]), *(R.T @ f[n + 3 :])])


@column("quantities", "variants", close=CLOSE)
def _variants(x: Example, folder: Path) -> Told:
    """Bodies of other masses, all in one call, and each alone."""
    if x.model.has_bodies and not x.links:
        raise NotAskedError("no bodies of its own")
    body, k = next(iter(x.links.items())) if x.links else ("x", 0)
    k = 0 if body == "b0" and len(x.plain.mass) == 1 else k
    many = mb.variants(x.model, {f"{body}.mass": 0.2}, size=2)
    dyn = many.dynamics(compile=False)
    dyn = dyn.at(**{x.model.time_parameter: x.t}) if x.model.time_parameter else dyn
    got, worst = dyn.forward_dynamics(x.q, x.v, x.tau), 0.0
    for i, value in enumerate(many.values[f"{body}.mass"]):
        mass = x.plain.mass.copy()
        mass[k] = value
        wanted = replace(x, plain=replace(x.plain, mass=mass)).accelerated()
        worst = max(worst, off(got[i], wanted))
        worst = max(worst, off(dynamics(x, many[i]).forward_dynamics(x.q, x.v, x.tau), wanted))
    return worst


@column("use of runs", "film", "picture")
def _film(x: Example, folder: Path) -> Told:
    """Bodies stand where NumPy has them, with the vertical upwards."""
    scene = kept(x.name).animate(folder / "film.html", shapes="sticks").scene
    if not x.links:
        raise NotAskedError("no bodies")
    y = flow(x.name)[: x.plain.n]
    g = x.plain.weight
    up = np.eye(3) if not g.any() else scene.rotations[0, 0]
    worst = 0.0
    for body, k in x.links.items():
        R, p = x.plain.poses(y)[k]
        at = scene.bodies.index(body)
        worst = max(worst, off(scene.rotations[-1, at], up @ R), off(scene.translations[-1, at], up @ p))
    return max(worst, off(up @ g, [0, 0, -np.linalg.norm(g)]) if g.any() else 0.0)


@column("quantities", "rows of constraints", "constraint rows")
def _rows(x: Example, folder: Path) -> Told:
    """The rows hold at the state, and for the acceleration that they leave."""
    if not (x.rows or x.links):
        raise NotAskedError("no bodies and no rows")
    dyn = engine(x.name)
    left = dyn.constraint_jacobian(x.q) @ x.accelerated() + dyn.constraint_bias(x.q, x.v)
    return max(off(y, 0 * y) for y in (dyn.constraint_residual(x.q), dyn.constraint_rate(x.q, x.v), left))


@column("quantities", "GPU: arrays that lie there", "gpu under force")
def _on_a_gpu(x: Example, folder: Path) -> Told:
    """At rest dry friction is another one, which holds a part in its place."""
    with fake_gpu():
        dyn, worst = dynamics(x, x.model, compile=True, device="cuda"), 0.0
        for v in (x.v, *([] if x.model.constrained else [0 * x.v])):
            wanted = engine(x.name).forward_dynamics(x.q, v, x.tau) if v is not x.v else x.accelerated()
            out = dyn.forward_dynamics(*(on_device(np.stack([y, y]), major=False) for y in (x.q, v, x.tau)))
            worst = max(worst, off(out.numpy() if hasattr(out, "numpy") else out, [wanted] * 2))
    return worst


@column("engine mujoco", "mujoco: law of constraints", "constraint law")
def _law(x: Example, folder: Path) -> Told:
    return off(engine(x.name, "mujoco").constraint_law(x.q, x.v, x.tau).rigid, x.accelerated())


@column("changes", "independent coordinates", "embedded", close=1e-8)
def _embedded(x: Example, folder: Path) -> Told:
    if not x.rows:
        raise NotAskedError("no rows")
    if x.model.has_bodies:
        GATES["paper"].admit(x.model)
        GATES["embedded"].admit(x.model)
    if x.model.nv > 4:
        raise NotAskedError("more than four joints take long to write")
    lag = from_model(x.model, drives=bool(x.model.prescribed)) if x.model.has_bodies else x.model.form
    end = x.t + DURATION
    run = mb.simulate(lag.embedded(), x.plain.q, x.v, DURATION, "rk853", torque=x.tau, t0=x.t, save=[end])
    return off(run.v[-1], x.state(flow(x.name))[1])


@column("studies", "excitation", "excitation", close=1e-3)
def _excited(x: Example, folder: Path) -> Told:
    """The motion is one: velocities are the rates of its coordinates, and keep the rows."""
    motion = mb.excitation(x.model, duration=2.0, harmonics=2, rate=200.0, iterations=1)
    two = ((motion.v, motion.q), (motion.a, motion.v))
    worst = max(off(rate[1:-1], (y[2:] - y[:-2]) / (2 * motion.t[1])) for rate, y in two)
    rest = engine(x.name).constraint_rate(motion.q[1], motion.v[1]) if x.model.constrained else np.zeros(1)
    return max(worst, 1e6 * off(rest, 0 * rest))


# Studies


@column("studies", "identification", "identification", close=1e-7)
def _identified(x: Example, folder: Path) -> Told:
    """Torques in NumPy of a heavier last body, and of a joint with numbers that the model lacks, are told."""
    if not x.links:
        x.model.base_parameters()
        raise NotAskedError("no bodies of its own")
    rng, c = np.random.default_rng(7), x.plain
    mass = c.mass.copy()
    mass[x.links[x.tip]] *= 1.3
    heavy = replace(x, plain=replace(c, mass=mass))

    def sample() -> tuple[Any, ...]:
        q, u, a = rng.uniform(-1, 1, (3, c.n))
        y = replace(heavy, plain=replace(heavy.plain, q=q, v=u))
        return y.q, y.v, a, y.force(a)

    data = [np.array(z) for z in zip(*(sample() for _ in range(24)), strict=True)]
    *states, tau = (z[:16] for z in data)
    sought = x.name.rpartition(".several")[0] or x.name
    more = {"friction": sought in ("joint.damping", "joint.friction"), "armature": x.name == "joint.armature"}
    elsewhere = [z[16:] for z in data[:3]]
    # What the model has is known to it, and acts beside what is sought.
    known = mb.identify(x.model, *states, tau, rest=0.0)
    worst = off(dynamics(x, known.model).inverse_dynamics(*elsewhere), data[3][16:])
    if any(more.values()):
        # Numbers that are zero but for rounding, some of them negative, make no model.
        less = without_part(x)
        found = mb.identify(less, *states, tau, rest=0.0, **more)
        Y = dynamics(x, less).regressor(*elsewhere, "base", **more)
        worst = max(worst, off(Y @ [p.value for p in found.parameters], data[3][16:]))
    return worst


def _told(x: Example, text: str) -> float:
    if not named(x.name, x, text):
        raise AssertionError(f"not by name: {' '.join(text.split())[:300]}")
    return 0.0


@column("studies", "assert_same_dynamics")
def _same(x: Example, folder: Path) -> Told:
    assert_same_dynamics(x.model, x.model, samples=1)
    if (less := without_part(x)) is None:
        raise NotAskedError("it is no part that can be taken out")
    if PART_KINDS[x.name].does == {"bound"}:
        assert_same_dynamics(x.model, less, samples=1)
        return 0.0
    try:
        assert_same_dynamics(x.model, less, samples=1)
    except AssertionError as error:
        return _told(x, str(error))
    return np.inf


@column("studies", "mbkit diff of files")
def _diff(x: Example, folder: Path) -> Told:
    path, notes = _written(x.model, folder, "mjcf")
    run = CliRunner().invoke(cli, ["diff", str(path), str(path)])
    if run.exit_code:
        raise AssertionError(run.output)
    if (less := without_part(x)) is None:
        raise NotAskedError("it is no part that can be taken out")
    run = CliRunner().invoke(cli, ["diff", str(path), str(_written(less, folder, "mjcf", "less")[0])])
    if run.exit_code == 0:
        return np.inf, notes
    return _told(x, run.output)


@column("studies", "check")
def _check(x: Example, folder: Path) -> Told:
    """Two engines agree with 34 digits; one that lacks the part does not, and the page has each refusal."""
    untimed = patch("mbkit.studies.compare.study.interleaved", lambda calls: dict.fromkeys(calls, (1.0, 0.0)))
    undrawn = patch.multiple(figure, digits=lambda *_: "", term_costs=lambda *_: "")
    with untimed, undrawn:
        result = mb.compare(x.model, ("lagrangian", "pinocchio"), 1, terms_only=True)
        if bad := [r.reason for r in result.rows if not r.passed and "known defect" not in r.reason]:
            raise AssertionError(str(bad))
        page = html.unescape(render(result.document()))
        if missing := [r.reason for r in result.refusals if not r.term and r.reason[:60] not in page]:
            raise AssertionError(f"not on the page: {missing}")
        if (less := without_part(x)) is None or PART_KINDS[x.name].does == {"bound"}:
            return 0.0
        model, less = with_values(x.model), less if less.time_parameter else with_values(less)
        exact = engine(x.name, "oracle") if model is x.model else OracleDynamics(model)
        study = Judge(model, {"less": dynamics(x, less)}, exact, states(model, 1, 0), 1e-12)
        study.terms = TERMS
        rows, _ = study.rows(lambda *_: None)
    return np.inf if all(r.passed for r in rows) else 0.0


@column("studies", "pytest plugin")
def _plugin(x: Example, folder: Path) -> Told:
    """Its fixture records the model, and fails a test of one without the part."""
    node = SimpleNamespace(name="test", nodeid="test", user_properties=[])
    config = SimpleNamespace(getoption=lambda _: True, rootpath=folder)
    fixture = MbkitBaseline(SimpleNamespace(path=folder / "test_x.py", node=node, config=config))  # type: ignore[arg-type]
    with patch("mbkit.studies.baseline.study._ROLLOUT", Rollout(STEP, 4)):
        try:
            fixture(x.model, "x", engines=["lagrangian"], samples=1)
        except pytest.fail.Exception as error:
            raise UnsupportedError(str(error)) from None
    config.getoption = lambda _: False
    if (less := without_part(x)) is None:
        fixture(x.model, "x")
        return 0.0
    try:
        MbkitBaseline(fixture._request)(less, "x")
    except pytest.fail.Exception as error:
        return _told(x, str(error))
    return np.inf


def _from_zero(x: Example) -> Example:
    """Return the example at the time zero, which studies begin at, where it depends on the time."""
    c = x.plain
    y = x.flow(np.array([-x.t]))[-1] if x.model.time_parameter else np.concatenate([c.q, c.v])
    q, u = np.split(y, 2)
    return replace(x, plain=replace(c, q=q, v=u, t=0.0 if x.model.time_parameter else x.t))


@column("studies", "stress")
def _stress(x: Example, folder: Path) -> Told:
    """A case of the user's own, whose number is nothing; its exact motion is NumPy's."""
    start = _from_zero(x)
    truth = lambda times: start.motion(np.maximum(times, 1e-12))[0]  # noqa: E731
    problem = Problem(x.model, start.q, start.v, x.tau, DURATION, truth, dt=STEP)
    case = StressCase(x.name, "", "step", "nothing", "", (1.0,), (1.0,), lambda _: problem)
    known = prepare(case, 1.0, 1e-6, 60.0)
    if known.truth is None:
        raise AssertionError(known.how)
    out = measure(case, 1.0, "lagrangian", "rk4", Limits(60.0, STEP, 1e-8), known.truth)
    return out.error if out.end == "finished" else np.inf


@column("studies", "work_precision", close=1e-9)
def _work_precision(x: Example, folder: Path) -> Told:
    """Errors against the exact motion from the time zero on, which the study begins at."""
    start = _from_zero(x)
    if np.abs(start.accelerated()).max() + np.abs(start.v).max() < 1e-9:
        raise NotAskedError("nothing moves")
    times = np.linspace(0.0, DURATION, 11)
    motion = dict(zip(times.tolist(), map(x.state, start.flow(times)), strict=True))
    out = mb.work_precision(
        x.model, ["lagrangian"], ["rk4"], duration=DURATION, steps=[STEP], repeats=1, torque=x.tau,
        reference=lambda t: motion[t],
    )  # fmt: skip
    notes = *out.facts["notes"], *(r.reason for r in out.refusals)
    return min((p.error for c in out.curves for p in c.points), default=np.inf), notes


@column("studies", "steady motion", close=1e-8)
def _steady(x: Example, folder: Path) -> Told:
    """Where the first hinge turns steadily and all else rests, nothing accelerates."""
    if not x.model.has_bodies or len(x.plain.kinds) > 4 or x.name.endswith("several"):
        raise NotAskedError("it is written as energies, or its equations fill pages")
    x, lag = on_paper(x.name, flat=len(x.plain.kinds) > 2)
    cyclic = [str(q) for q in lag.cyclic_coordinates()]
    if lag.time is None and not cyclic:
        raise NotAskedError("no coordinate is cyclic")
    out = mb.steady_motion(lag, rates=dict.fromkeys(cyclic, 2.0))
    return off(x.acceleration(x.t, out.q, out.v, 0 * out.v), 0 * out.v)


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


@column("use of runs", "at rest under dry friction", close=1e-8)
def _sticking(x: Example, folder: Path) -> Told:
    """Joint x stays at rest while the others move: the force that holds it is below its limit, in NumPy."""
    if not x.model.needs.friction:
        raise NotAskedError("no dry friction")
    other = resting(x)
    tau = other.tau
    q1, v1 = other.state(other.flow([DURATION])[-1])
    worst = 0.0
    for method in ("rk4", "rk853", "auto", "gauss4", "dop853"):
        run = mb.simulate(
            engine(x.name),
            x.q,
            other.v,
            DURATION,
            method,
            STEP if method in ("rk4", "gauss4") else None,
            torque=tau,
            t0=x.t,
            save=None,
        )
        worst = max(worst, off(run.q[-1], q1), off(run.v[-1], v1))
    # And it comes to rest within a run, and stays.
    sliding, end = stopping(x, DURATION)
    run = mb.simulate(engine(x.name), sliding.q, sliding.v, DURATION, "rk4", STEP, torque=sliding.tau, t0=x.t)
    q1, v1 = x.state(end)
    return max(worst, off(run.q[-1], q1), off(run.v[-1], v1))


@column("use of runs", "impact on a stop", close=1e-8)
def _impact_on_a_stop(x: Example, folder: Path) -> Told:
    """Joint x comes to its stop within a run, whose impulse turns its velocity around and jerks the others."""
    c = x.plain
    if "joint.stop" not in x.model.acts:
        raise NotAskedError("no stops")
    (row,), e = c.touched(c.q, c.v), 0.3
    bare = replace(c, parts=[replace(p, stops=()) for p in c.parts])
    start = replace(x, plain=replace(bare, q=c.q + 1e-3 * row, v=c.v - 0.2 * row))
    at = scipy.optimize.brentq(lambda t: row @ (start.flow([t])[-1][: c.n] - c.q), 1e-4, DURATION, xtol=1e-15)
    q, v = np.split(start.flow([at])[-1], 2)
    jerk = np.linalg.solve(c.mass_matrix(q), row)
    after = replace(bare, q=q, v=v - (1 + e) * (row @ v) / (row @ jerk) * jerk, t=c.t + at)
    q1, v1 = x.state(replace(x, plain=after).flow([DURATION - at])[-1])
    worst = 0.0
    for method in ("rk4", "rk853", "auto", "gauss4", "dop853", "taylor", "implicit_midpoint"):
        # The midpoint's error falls with the square of its step.
        step = {"rk4": STEP, "gauss4": STEP, "implicit_midpoint": STEP / 64}.get(method)
        given = DURATION, method, step
        run = mb.simulate(engine(x.name), start.q, start.v, *given, torque=x.tau, t0=x.t, save=None)
        (hit,) = run.events
        if hit.name != "x hits its lower stop":
            raise AssertionError(hit.name)
        worst = max(worst, off(run.q[-1], q1), off(run.v[-1], v1), off(hit.t, c.t + at))
    return worst
