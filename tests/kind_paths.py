"""Paths of a model as columns of the matrix: each returns how far a kind's example is from its truth in NumPy.

A cell is "right" to an error, "refused" by the part's name, or "left out" with a note that has it; "silent", "unnamed"
and "crash" are faults. `tests.test_matrix` runs some of the cells, and with ``--thorough`` all of them.
"""

# ruff: noqa: ARG001, ARG005  # all paths are called alike
from __future__ import annotations

import ctypes
import pickle
import subprocess
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from importlib import import_module
from itertools import chain, combinations
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import scipy.linalg
import sympy as sp

import mbkit as mb
from mbkit.codegen.c_source import WITHOUT_STOPS, export_c
from mbkit.errors import MbkitError, MbkitWarning, UnsupportedError
from mbkit.lagrangian import from_model, program
from mbkit.methods.registry import METHODS
from mbkit.model import Model
from mbkit.model.elements.kinds import PART_KINDS, kind
from mbkit.model.elements.paths import PATHS as GATES
from mbkit.simulate import Event
from mbkit.studies.baseline.file import Rollout
from mbkit.studies.explain import Motion
from tests import kind_examples
from tests.fake_cuda import fake_gpu
from tests.kind_examples import EXAMPLES, TYPES, Arm, Example, example
from tests.plain_mechanics import Part


class NotAskedError(Exception):
    """A path asks for something that an example does not have, such as a loop."""


#: A cell's error, and the notes that say what was left out.
Told = float | tuple[float, tuple[str, ...]]
#: Sums of a few hundred rounded terms, and second differences of rows.
CLOSE = 1e-9
DURATION, STEP = 0.01, 1.25e-3
STEP_OF_SLOPES = 0.01


@dataclass(frozen=True)
class Column:
    """A path of a model, the gates that it passes, and its check."""

    group: str
    name: str
    check: Callable[[Example, Path], Told]
    close: float = CLOSE
    gates: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cell:
    """What came of a kind on a path."""

    outcome: str
    error: float | None = None
    text: str = ""


COLUMNS: dict[str, Column] = {}


def column(group: str, name: str, *gates: str, close: float = CLOSE, **more: Any) -> Callable[[Any], Any]:
    """Register a check as a column."""

    def add(check: Any) -> Any:
        COLUMNS[name] = Column(group, name, partial(check, **more), close, gates)
        return check

    return add


@cache
def _imported() -> None:
    """Import every module that has a gate."""
    top = Path(mb.__file__).parent
    for file in sorted(top.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "elements.paths import" in text or "elements import paths" in text:
            import_module(".".join(file.relative_to(top.parent).with_suffix("").parts))


def registered() -> dict[str, Any]:
    """Return all gates."""
    _imported()
    return GATES


def cell(name: str, path: str, folder: Path) -> Cell:
    """Return what comes of an example on a path."""
    out, gates = told(name, path, folder), [GATES[g] for g in COLUMNS[path].gates if g in GATES]
    lost = any(g.refuses(example(name).model) for g in gates)
    # A native run refuses a force on a free joint by its value, and loads are refused at rest: no gate knows of these.
    by_value = ("free joint" in out.text and "world axes" in out.text) or "at rest, whose share" in out.text
    if (
        gates
        and not by_value
        and out.outcome in ("right", "refused", "left out")
        and lost != (out.outcome == "refused")
    ):
        return Cell("silent", out.error, f"its gate {'refuses' if lost else 'admits'} it; {out.text}")
    return out


def told(name: str, path: str, folder: Path) -> Cell:
    """Return what comes of an example on a path, whatever its gates."""
    x, col = example(name), COLUMNS[path]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", MbkitWarning)
        try:
            out = col.check(x, folder)
        except NotAskedError as error:
            return Cell("not asked", text=str(error))
        except MbkitError as error:
            text = " ".join(str(error).split())
            if not (
                isinstance(error, UnsupportedError) or path in ("lock", "its number as a parameter", "steady motion")
            ):
                return Cell("crash", text=text)
            # A path that asks for a kind names that where a model has none.
            missing = [GATES[g].asks[1] for g in col.gates if g in GATES and GATES[g].asks[1]]
            return Cell("refused" if named(name, x, text) or any(m in text for m in missing) else "unnamed", text=text)
        except Exception as error:
            return Cell("crash", text=f"{type(error).__name__}: {' '.join(str(error).split())}")
    error, notes = out if isinstance(out, tuple) else (out, ())
    if error <= col.close:
        return Cell("right", float(error))
    texts = [str(w.message) for w in told if issubclass(w.category, MbkitWarning)]
    fitting = (" ".join(note.split()) for note in (*notes, *texts) if named(name, x, note))
    text = next(fitting, "")
    return Cell("left out" if text else "silent", float(error), text)


def named(name: str, x: Example, text: str) -> bool:
    """Return whether a text has the words of one of the kinds that act, or of the example."""
    words = [*x.words]
    for k in map(kind, x.model.acts):
        words += [k.words.format(p=p) for p in k.parts(x.model)]
    low = text.lower()
    # A joint of several motions is several joints of a file.
    if any(w.lower() in low for w in words) or "'x'" in text or "'x." in text:
        return True
    return any(_called(k, x, low) for k in ([name] if name in PART_KINDS or name in TYPES else x.model.acts))


def _called(name: str, x: Example, low: str) -> bool:
    general = {"loop": "loop", "coupler": "coupler", "motion": "is moved", "no_slip": "slip", "mimic": "mimic"}
    more = (
        name.split(".")[1].replace("_", " ") if "limit" in name else "",
        general.get(name.partition(".")[0], ""),
        name.split(".")[-1].replace("_", "-"),
        name.split(".")[-1],
        "dry friction" if "tion" in name.partition(".")[2] else "",
        # It is told by its body.
        "of its weight" if "compensation" in name else "",
    )
    constraint = x.rows and "constraint" in low
    return constraint or any(w and w in low for w in more)


def off(got: Any, wanted: Any) -> float:
    """Return the largest difference, relative to the largest number; infinity for other shapes."""
    got, wanted = np.asarray(got, dtype=float), np.asarray(wanted, dtype=float)
    if got.shape != wanted.shape or not np.isfinite(got).all():
        return np.inf
    return float(np.abs(got - wanted).max(initial=0.0) / max(1.0, np.abs(wanted).max(initial=0.0)))


@cache
def engine(name: str, which: str = "lagrangian", **options: Any) -> mb.Dynamics:
    """Return an engine on an example, at its time."""
    x = example(name)
    return dynamics(x, x.model, which, **options)


def dynamics(x: Example, model: Model, which: str = "lagrangian", **options: Any) -> mb.Dynamics:
    options = {"compile": False} | options if which == "lagrangian" else options
    dyn = mb.dynamics(model, which, **options)
    return dyn.at(**{model.time_parameter: x.t}) if model.time_parameter else dyn


#: Of joint types their coordinates, and where a quaternion begins.
QUATERNIONS = {"ball": (4, 0), "free": (7, 3), "universal": (2, -1), "planar": (3, -1), "spherical_zyx": (3, -1)}


def aligned(q: np.ndarray, x: Example, like: np.ndarray) -> np.ndarray:
    """Return q with the signs of quaternions as those of another one."""
    q, at = np.array(q, dtype=float), 0
    if q.shape != like.shape:
        return q
    for _, type_, _ in x.joints:
        size, four = QUATERNIONS.get(type_, (1, -1))
        if four >= 0 and q[at + four : at + four + 4] @ like[at + four : at + four + 4] < 0:
            q[at + four : at + four + 4] *= -1
        at += size
    return q


# Engines


def _forward(x: Example, folder: Path, which: str) -> Told:
    dyn = engine(x.name, which)
    a = dyn.forward_dynamics(x.q, x.v, x.tau)
    wanted = x.accelerated()
    if dyn._soft_constraints and x.rows:
        # MuJoCo's constraints are soft; its law, which its solver reaches, becomes the rigid one.
        law = dyn.constraint_law(x.q, x.v, x.tau)
        return max(off(a, law.acceleration), off(law.rigid, wanted))
    return off(a, wanted)


def _inverse(x: Example, folder: Path, which: str) -> Told:
    dyn, a = engine(x.name, which), 0.3 * x.v + 0.1
    M = off(dyn.mass_matrix(x.q), x.mass_matrix(x.plain.q))
    return max(M, off(dyn.inverse_dynamics(x.q, x.v, a), x.force(a)))


def _energies(x: Example, folder: Path, which: str) -> Told:
    dyn, c = engine(x.name, which), x.plain
    other = 0.5 * c.q
    one = dyn.potential_energy(x.q) - dyn.potential_energy(x.position(other))
    kinetic = c.v @ c.mass_matrix(c.q) @ c.v / 2
    return max(off(one, c.potential(c.q) - c.potential(other)), off(dyn.kinetic_energy(x.q, x.v), kinetic))


def _frames(x: Example, folder: Path, which: str) -> Told:
    if not x.links:
        raise NotAskedError("no bodies")
    dyn, J = engine(x.name, which), x.jacobian(x.plain.q)
    return max(off(dyn.jacobian(x.q, x.tip), J), off(dyn.velocity(x.q, x.v, x.tip), J @ x.v))


def _derivatives(x: Example, folder: Path, which: str) -> Told:
    """Differences of the truth, along directions that rows allow."""
    dyn = engine(x.name, which)
    by_q, by_v, by_tau = dyn.forward_dynamics_derivatives(x.q, x.v, x.tau)
    return max(_along(x, by_q, by_v), _by_force(x, by_tau))


def _by_force(x: Example, by_tau: np.ndarray) -> float:
    d = np.linspace(0.3, -0.4, len(x.tau))
    two = (x.acceleration(x.t, x.plain.q, x.plain.v, x.tau + s * d) for s in (1, -1))
    plus, minus = two
    return off(by_tau @ d, (plus - minus) / 2)


def differences(f: Callable[[float], np.ndarray], h: float = 1e-3) -> np.ndarray:
    return np.asarray((8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h))


def _along(x: Example, by_q: np.ndarray, by_v: np.ndarray) -> float:
    return max(off(by_q @ dq + by_v @ dv, wanted) for dq, dv, wanted in _slopes(x.name))


@cache
def _slopes(name: str) -> list[tuple[np.ndarray, ...]]:
    """Return changes of the state that the rows allow, and of the acceleration, by differences of the truth."""
    x, rng = example(name), np.random.default_rng(3)
    c, out = x.plain, []
    for _ in range(2):
        along, bent = rng.uniform(-1, 1, (2, c.n))

        def path(s: float, along: np.ndarray = along, bent: np.ndarray = bent) -> Example:
            return x.beside(along, bent, s)

        ways = (lambda s: path(s).plain.q), (lambda s: path(s).v), (lambda s: path(s).accelerated())
        dx, dv, wanted = (differences(f, 3e-4) for f in ways)
        out.append((x.rates(c.q) @ dx, dv, wanted))
    return out


_GATES = {"pinocchio": "pinocchio", "mujoco": "mujoco", "drake": "drake", "oracle": "derivation"}
for _engine in ("lagrangian", "pinocchio", "mujoco", "drake", "oracle"):
    for _what, _check, _close in (
        ("accelerations", _forward, CLOSE),
        ("M and inverse dynamics", _inverse, CLOSE),
        ("energies", _energies, CLOSE),
        ("frames", _frames, CLOSE),
        ("derivatives", _derivatives, 1e-6),
    ):
        if _engine in ("lagrangian", "pinocchio", "oracle") or _what != "derivatives":
            _asks = _what == "M and inverse dynamics" or (_engine == "mujoco" and _what == "accelerations")
            _gates = [_GATES[_engine]] if _engine in _GATES and _asks else []
            if _what == "derivatives" and _engine == "pinocchio":
                _gates = ["pinocchio", "pinocchio derivatives", "pinocchio forward derivatives"]
            column(f"engine {_engine}", f"{_engine}: {_what}", *_gates, close=_close, which=_engine)(_check)


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


@column("engine mujoco", "mujoco: friction loss", "mujoco friction loss")
def _friction_loss(x: Example, folder: Path) -> Told:
    """Its friction is that of sliding where it is rigid."""
    soft = dynamics(x, x.model, "mujoco", soft_friction=True)
    held = x.model.constrained or x.model.needs.friction
    a = soft.constraint_law(x.q, x.v, x.tau).rigid if held else soft.forward_dynamics(x.q, x.v, x.tau)
    worst = max(off(soft.mass_matrix(x.q), x.mass_matrix(x.plain.q)), off(a, x.accelerated()))
    if not x.model.needs.friction:
        return worst
    rest = resting(x)
    # It creeps where it holds.
    free = replace(rest, plain=replace(rest.plain, parts=[])).accelerated()
    if abs(soft.forward_dynamics(rest.q, rest.v, rest.tau)[-1]) > 0.2 * abs(free[-1]):
        raise AssertionError("it does not hold")
    return max(worst, off(soft.constraint_law(rest.q, rest.v, rest.tau).rigid, rest.accelerated()))


# Quantities of the own derivation


@column("quantities", "linearize", "linearize", close=1e-6)
def _linearize(x: Example, folder: Path) -> Told:
    out, n = engine(x.name).linearize(x.q, x.v, x.tau), len(x.v)
    return max(off(out.f, [*x.v, *x.accelerated()]), _along(x, out.A[n:, :n], out.A[n:, n:]), _by_force(x, out.B[n:]))


@column("quantities", "derivative of a step", "derivative of a step", close=1e-6)
def _step_derivative(x: Example, folder: Path) -> Told:
    """And against own steps where dry friction stops a joint within one."""
    out = engine(x.name).discretize(x.q, x.v, x.tau, STEP_OF_SLOPES)
    move, wanted = _slope(x.name)
    return max(off(out.A @ move, wanted), _stopped_slope(x) if x.model.needs.friction else 0.0)


def _stopped_slope(x: Example) -> float:
    dyn, n, h, dt = engine(x.name), len(x.v), 1e-5, 0.01
    v = resting(x).v
    A, B, _ = dyn.discretize(x.q, v, x.tau, dt)

    def after(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return dyn.step(x.model.integrate(x.q, z[:n]), v + z[n : 2 * n], x.tau + z[2 * n :], dt)

    worst = 0.0
    for z, wanted in zip(np.eye(3 * n), np.hstack([A, B]).T, strict=True):
        (q1, v1), (q0, v0) = after(h * z), after(-h * z)
        worst = max(worst, off(wanted, np.concatenate([x.model.difference(q0, q1), v1 - v0]) / (2 * h)))
    return worst


@column("quantities", "sensitivities", close=1e-6)
def _sensitivities(x: Example, folder: Path) -> Told:
    out = mb.sensitivities(engine(x.name), x.q, x.v, STEP_OF_SLOPES, STEP_OF_SLOPES / 2, torque=x.tau)
    move, wanted = _slope(x.name)
    return off(out.state[-1] @ move, wanted)


@cache
def _slope(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return a change of the first state, (2n,), and what it makes of the end of a short motion."""
    x = example(name)
    c, (along, bent) = x.plain, np.random.default_rng(4).uniform(-1, 1, (2, x.plain.n))

    def end(s: float) -> np.ndarray:
        return x.beside(along, bent, s).flow([STEP_OF_SLOPES])[-1]

    dq, dv = x.rates(c.q) @ along, differences(lambda s: x.beside(along, bent, s).v)
    y, slope = end(0.0), differences(end, 1e-2)
    moved = x.rates(y[: c.n]) @ slope[: c.n]
    turned = differences(lambda s: x.state(y + s * slope)[1])
    return np.concatenate([dq, dv]), np.concatenate([moved, turned])


@column("quantities", "mass as a parameter", "free numbers")
def _mass(x: Example, folder: Path) -> Told:
    if not x.links:
        raise NotAskedError("no bodies")
    body, k = next(iter(x.links.items()))
    k = 0 if body == "b0" and len(x.plain.mass) == 1 else k
    model = x.model.with_free(f"{body}.mass")
    dyn = dynamics(x, model).at(**{f"{body}.mass": 1.5 * x.plain.mass[k]})
    mass = x.plain.mass.copy()
    mass[k] *= 1.5
    other = replace(x, plain=replace(x.plain, mass=mass))
    return off(dyn.forward_dynamics(x.q, x.v, x.tau), other.accelerated())


def _changed(x: Example, name: str) -> list[tuple[str, Model]]:
    """Return models with one number of the part changed each, by the field's name, of those that a kind has."""
    out = []
    k = kind(name) if name in PART_KINDS or name[11:] in mb.model.KINDS else None
    if k is None or not k.section:
        return [("gravity", replace(x.model, gravity=1.1 * x.model.gravity))] if name == "gravity" else []
    part = k.parts(x.model)[0]
    for f in fields(part):
        value = getattr(part, f.name)
        if f.name == "velocity_limit" or isinstance(value, (str, bool)) or "rotation" in f.name or "axis" in f.name:
            continue
        if not (isinstance(value, (float, np.ndarray)) and np.size(value)):
            continue
        # A spline's pieces no longer fit, and a plane lies out of reach.
        if (
            f.name in ("axes", "coefficients", "knots", "translation_b")
            or not np.isfinite(value).all()
            or not np.any(value)
        ):
            continue
        changed = replace(part, **{f.name: 1.1 * value})
        parts = tuple(changed if p is part else p for p in getattr(x.model, k.section))
        out.append((f.name, replace(x.model, **{k.section: parts})))
    return out


@column("quantities", "its number as a parameter")
def _number(x: Example, folder: Path) -> Told:
    """The model with the number typed is evaluated beside the one at another value."""
    k = PART_KINDS.get(x.name)
    numbers = k.numbers - {"lower", "upper", "velocity_limit", "effort_limit"} if k else frozenset()
    if not numbers or not k.section:
        raise NotAskedError("it has no numbers that act")
    worst, part = 0.0, k.parts(x.model)[0]
    if k.section == "bodies":
        numbers = numbers - {"inertia"}
    for name in sorted(numbers):
        value = getattr(part, name)
        if value is None or not np.any(value):
            continue
        free = x.model.with_free(f"{part.name}.{name}")
        new = {p: 1.1 * float(v) for p, v in free.parameters.items() if p not in x.model.parameters and p != "t"}
        typed = next(m for n, m in _changed(x, x.name) if n == name)
        got = dynamics(x, free).at(**new).forward_dynamics(x.q, x.v, x.tau)
        worst = max(worst, off(got, dynamics(x, typed).forward_dynamics(x.q, x.v, x.tau)))
    return worst


@column("quantities", "regressor")
def _regressor(x: Example, folder: Path) -> Told:
    if not x.links or x.name == "joint_type.beam":
        raise NotAskedError("no rigid bodies of its own")
    dyn, a = engine(x.name), 0.3 * x.v + 0.1
    Y = dyn.regressor(x.q, x.v, a)
    pi = []
    for body in x.model.bodies:
        m, c = body.mass, np.asarray(body.com)
        I = np.asarray(body.inertia) + m * (c @ c * np.eye(3) - np.outer(c, c))
        pi += [m, *(m * c), I[0, 0], I[0, 1], I[0, 2], I[1, 1], I[1, 2], I[2, 2]]
    columns = x.model.regressor_columns()
    order = ("m", "hx", "hy", "hz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
    named = dict(zip((f"{b.name}.{s}" for b in x.model.bodies for s in order), pi, strict=True))
    if not set(columns) <= set(named):
        raise AssertionError(str(columns[:12]))
    bare = x.force(a, bodies=True)
    if x.name == "body.rotor":
        # Its mass is a body's, with a weight.
        bare = engine(x.name).mass_matrix(x.q) @ a + engine(x.name, "oracle").nle(x.q, x.v)
    return off(Y @ [named[c] for c in columns], bare)


@column("quantities", "base parameters", "base parameters")
def _base_parameters(x: Example, folder: Path) -> Told:
    base = x.model.base_parameters()
    if x.name == "joint_type.beam":
        raise NotAskedError("points of a beam")
    a = 0.3 * x.v + 0.1
    bare = x.force(a, bodies=True)
    if x.name == "body.rotor":
        bare = engine(x.name).mass_matrix(x.q) @ a + engine(x.name, "oracle").nle(x.q, x.v)
    # At the latest where little else moves.
    for m in (x.model, *([x.model.lock({x.model.joint_names[0]: 0.3})] if x.model.constrained else [])):
        if _told_apart(m) != m.base_parameters().count:
            raise AssertionError("motions do not tell all of them apart")
    return off(engine(x.name).regressor(x.q, x.v, a, "base") @ base.values, bare)


def _told_apart(model: Model) -> int:
    """Return how many base parameters random motions tell by the torques that rows let act."""
    dyn, out = mb.dynamics(model, "lagrangian", compile=False), []
    for q, v in (model.random_state(k) for k in range(12)):
        N = scipy.linalg.null_space(dyn.constraint_jacobian(q)) if model.constrained else np.eye(model.nv)
        out.append(N.T @ dyn.regressor(q, v, np.cos(np.arange(model.nv) + 3 * q.sum()), "base"))
    return int(np.linalg.matrix_rank(np.vstack(out)))


@column("quantities", "impact")
def _impact(x: Example, folder: Path) -> Told:
    M, J = x.mass_matrix(x.plain.q), x.held()
    S, m, n = 0.3 * np.cos(np.arange(len(x.v))), len(J), len(x.v)
    kkt = np.block([[M, -J.T], [J, np.zeros((m, m))]])
    wanted = x.v + np.linalg.solve(kkt, [*S, *np.zeros(m)])[:n]
    return off(mb.impact(engine(x.name), x.q, x.v, S).v, wanted)


@column("quantities", "equilibrium", "equilibrium")
def _equilibrium(x: Example, folder: Path) -> Told:
    if x.model.time_parameter:
        raise NotAskedError("it moves in time")
    tau = np.asarray(mb.equilibrium(engine(x.name), holding=x.q).tau)
    still = replace(x, plain=replace(x.plain, v=0 * x.plain.v))
    return off(still.acceleration(x.t, x.plain.q, 0 * x.plain.v, tau), 0 * tau)


@column("quantities", "operational space", "operational space")
def _operational(x: Example, folder: Path) -> Told:
    if not x.links:
        raise NotAskedError("no bodies")
    J = x.jacobian(x.plain.q)
    row = int(np.argmax(np.linalg.norm(J, axis=1)))
    # The frame's answer to a force on it, whatever else holds it.
    more = x.moved(0 * x.v, x.v, x.tau + J[row]) - x.moved(0 * x.v, x.v, x.tau)
    return off(mb.operational_space(engine(x.name), x.q, x.tip, rows=[row]).inertia, [[1 / (J[row] @ more)]])


@column("quantities", "loads of joints", "loads")
def _loads(x: Example, folder: Path) -> Told:
    """Every body's balance of forces and moments; the load along a joint is its torque, with its springs and losses."""
    dyn, joints = engine(x.name), [j for j in x.model.joints if j.type.nv]
    rest = dyn.newton_euler_residual(x.q, x.v, x.accelerated(), x.tau)
    under = (None, None, "local", None, x.tau) if x.model.constrained else (x.accelerated(),)
    loads, worst = dyn.joint_wrenches(x.q, x.v, *under), off(rest, 0 * rest)
    if len(loads) != len(joints):
        raise AssertionError("not one load for each joint")
    # What a gear or a drive adds there is not known here, nor that of rows beside numbers of joints.
    acts = {name.partition(".")[0] for name in x.model.acts}
    inside = bool(acts & {"joint", "coupling"})
    if not acts & {"coupler", "motion", "mimic"} and not (inside and x.model.constrained):
        torques = x.force(x.accelerated(), bodies=True) if inside else x.tau
        for load, joint in zip(loads, joints, strict=True):
            if joint.kind in ("revolute", "prismatic"):
                along = joint.axes[0] @ load[slice(3, 6) if joint.kind == "revolute" else slice(3)]
                worst = max(worst, off(along, torques[x.model.layout.v[joint.name].start]))
    return worst


@column("quantities", "loads of loops", "loads of loops")
def _loop_loads(x: Example, folder: Path) -> Told:
    wrenches = engine(x.name).loop_wrenches(x.q, x.v, x.tau)
    if sum(bool(p.rows or p.speeds) for p in x.plain.parts) > 1:
        raise NotAskedError("other rows beside the loop")
    (wrench,), (loop,) = wrenches, x.model.loops
    F, T = loop.rotation_a @ wrench[:3], loop.rotation_a @ wrench[3:]
    k = x.links[loop.body_b]
    R, p = x.plain.poses(x.plain.q)[k]
    lever = R.T @ (loop.translation_a - p)
    own = -(x.plain.moving(k, lever, x.plain.q).T @ F + x.plain.turning(k, x.plain.q).T @ T)
    return off(np.linalg.solve(x.rates(x.plain.q).T, own), x.force(x.accelerated()) - x.tau)


@column("quantities", "forces of actuators", "actuator forces")
def _actuators(x: Example, folder: Path) -> Told:
    if not (x.rows or x.links):
        raise NotAskedError("no bodies and no rows")
    a = x.accelerated()
    tau = engine(x.name).actuator_forces(x.q, x.v, a).tau
    return off(x.acceleration(x.t, x.plain.q, x.plain.v, tau), a)


@column("quantities", "reduced inertia", "reduced inertia")
def _reduced(x: Example, folder: Path) -> Told:
    J = x.held()
    if not len(J) or len(J.T) - len(J) != 1:
        raise NotAskedError("no mechanism of one degree of freedom")
    N = np.linalg.svd(J)[2][-1]
    k = int(np.argmax(abs(N)))
    N = N / N[k]
    own = engine(x.name).reduced_inertia(x.q, x.model.coordinate_names[k]).inertia
    return off(own, N @ x.mass_matrix(x.plain.q) @ N)


@column("quantities", "mobility")
def _mobility(x: Example, folder: Path) -> Told:
    return off(engine(x.name).mobility().degrees_of_freedom, x.plain.n - len(x.held()))


@column("quantities", "GPU (its driver replaced)", "gpu", close=1e-8)
def _gpu(x: Example, folder: Path) -> Told:
    with fake_gpu():
        dyn = dynamics(x, x.model, compile=True, device="cuda")
        return off(dyn.forward_dynamics(x.q[None], x.v[None], x.tau[None])[0], x.accelerated())


# Runs

_METHODS = {"lagrangian": [n for n, m in METHODS.items() if not m.engines or "lagrangian" in m.engines]}
_METHODS["mujoco"] = [n for n, m in METHODS.items() if "mujoco" in m.engines]
_METHODS["drake"] = [n for n, m in METHODS.items() if "drake" in m.engines]


@cache
def flow(name: str) -> np.ndarray:
    return example(name).flow([DURATION])[-1]


@cache
def _truth(name: str) -> tuple[np.ndarray, np.ndarray]:
    return example(name).state(flow(name))


def _ended(run: mb.Trajectory) -> None:
    if run.stats.ended != "finished":
        raise RuntimeError(f"{run.stats.ended}: {run.stats.message}")


def _run(x: Example, folder: Path, which: str, method: str) -> Told:
    """The end of a run; of a fixed step that which steps of half the length lead to, by the method's order."""
    dyn, told = engine(x.name, which), METHODS[method]
    if dyn._soft_constraints and x.rows:
        raise NotAskedError("its constraints are soft")
    q, v = _truth(x.name)

    def end(**more: Any) -> tuple[np.ndarray, np.ndarray]:
        run = mb.simulate(dyn, x.q, x.v, DURATION, method, torque=x.tau, t0=x.t, doubt=False, **more)
        _ended(run)
        return aligned(run.q[-1], x, q), run.v[-1]

    if method == "taylor" and len(x.plain.kinds) > 4:
        raise NotAskedError("more than four joints take long to compile")
    if told.kind == "adaptive":
        return max(map(off, end(save=[x.t + DURATION]), (q, v)))
    once, twice = end(dt=STEP), end(dt=STEP / 2)
    f = 2 ** float(told.order or 1)
    return max(off((f * b - a) / (f - 1), w) for a, b, w in zip(once, twice, (q, v), strict=True))


def _close_of(method: str) -> float:
    """Return what is close: steps of the first order leave an error of the second, and a tolerance is one of a step."""
    told = METHODS[method]
    return 1e-7 if told.order != 1 else 1e-5 if told.kind == "adaptive" else 1e-4


#: Gates of runs, each by one of the methods that go through it.
_OF_RUNS = {
    "rk4": ["runs"],
    "implicit_midpoint": ["symplectic runs"],
    "mujoco_rk4": ["mujoco", "mujoco runs", "runs without phases"],
    "drake_runge_kutta5": ["drake", "drake runs"],
    "drake_sap": ["drake sap"],
}

for _which, _names in _METHODS.items():
    for _method in _names:
        _gates = _OF_RUNS.get(_method, [])
        column(
            "runs" if _which == "lagrangian" else f"runs of {_which}",
            *(_method, *_gates),
            close=_close_of(_method), which=_which, method=_method,
        )(_run)  # fmt: skip


@column("use of runs", "step", close=1e-8)
def _steps(x: Example, folder: Path) -> Told:
    dyn, (q, v) = engine(x.name), (x.q, x.v)
    for k in range(round(DURATION / STEP)):
        q, v = dyn.step(q, v, x.tau, STEP, t=x.t + k * STEP)
    wanted = _truth(x.name)
    return max(off(aligned(q, x, wanted[0]), wanted[0]), off(v, wanted[1]))


@column("use of runs", "sampled control", close=1e-8)
def _hold(x: Example, folder: Path) -> Told:
    held, y, now = DURATION / 4, np.concatenate([x.plain.q, x.plain.v]), x
    for _ in range(4):
        sample = x.tau - 0.5 * now.v
        y = now.flow([held], lambda t, q, v, sample=sample: sample)[-1]
        q, u = np.split(y, 2)
        now = replace(now, plain=replace(now.plain, q=q, v=u, t=now.t + held))
    run = mb.simulate(
        engine(x.name), x.q, x.v, DURATION, "rk4", STEP, torque=lambda t, q, v: x.tau - 0.5 * v, hold=held, t0=x.t
    )
    _ended(run)
    wanted = x.state(y)
    return max(off(aligned(run.q[-1], x, wanted[0]), wanted[0]), off(run.v[-1], wanted[1]))


@cache
def kept(name: str) -> mb.Trajectory:
    x = example(name)
    return mb.simulate(engine(name), x.q, x.v, DURATION, "rk4", STEP, torque=x.tau, t0=x.t, doubt=False)


@column("use of runs", "batch", close=1e-8)
def _batch(x: Example, folder: Path) -> Told:
    run = mb.simulate(
        engine(x.name), np.stack([x.q] * 2), np.stack([x.v] * 2), DURATION, "rk4", STEP, torque=x.tau, t0=x.t,
        save=[x.t + DURATION],
    )  # fmt: skip
    q, v = _truth(x.name)
    return max(max(off(aligned(run.q[k, -1], x, q), q), off(run.v[k, -1], v)) for k in range(2))


@column("use of runs", "state feedback", close=1e-8)
def _feedback(x: Example, folder: Path) -> Told:
    """One state's is data, which machine code evaluates; that of a batch is a policy."""
    n, m = len(x.q), len(x.v)
    gain = np.hstack([0.2 * np.ones((m, n)) if n == m else np.zeros((m, n)), 0.5 * np.eye(m)])

    def force(t: float, q: np.ndarray, v: np.ndarray, members: Any = None) -> np.ndarray:
        return x.tau - np.concatenate([q, v], axis=-1) @ gain.T

    wanted, worst = x.state(x.flow([DURATION], force)[-1]), 0.0
    in_machine_code = dynamics(x, x.model, compile=True)
    for dyn, torque, start in (
        (in_machine_code, mb.simulate.StateFeedback(gain, torque=x.tau), (x.q, x.v)),
        (engine(x.name), mb.simulate.Policy(force), (np.stack([x.q] * 2), np.stack([x.v] * 2))),
    ):
        run = mb.simulate(dyn, *start, DURATION, "rk4", STEP, torque=torque, t0=x.t, save=[x.t + DURATION], doubt=False)
        q, v = (y if y.ndim == 2 else y[-1] for y in (run.q, run.v))
        worst = max(worst, off(aligned(q[-1], x, wanted[0]), wanted[0]), off(v[-1], wanted[1]))
    return worst


@column("use of runs", "events", close=1e-7)
def _events(x: Example, folder: Path) -> Told:
    """A velocity's value in the middle of the truth is crossed there."""
    middle = x.state(x.flow([0.6 * DURATION])[-1])[1]
    row = x.accelerated()
    if np.abs(row).max() < 1e-6:
        raise NotAskedError("nothing accelerates")
    row = row / np.linalg.norm(row)
    event = Event(lambda t, q, v: float(row @ (v - middle)), "there")
    run = mb.simulate(engine(x.name), x.q, x.v, DURATION, "rk853", torque=x.tau, t0=x.t, events=event, doubt=False)
    return abs(run.t[-1] - x.t - 0.6 * DURATION) / DURATION


@column("use of runs", "save and load", close=1e-8)
def _saved(x: Example, folder: Path) -> Told:
    run = kept(x.name)
    run.save(folder / "run.npz")
    back = mb.Trajectory.load(folder / "run.npz", x.model)
    wanted = _truth(x.name)
    same = max(off(back.energy(), run.energy()), off(back.work(), run.work()))
    return max(same, off(aligned(back.q[-1], x, wanted[0]), wanted[0]), off(back.v[-1], wanted[1]))


@column("use of runs", "energy and power balance", close=1e-7)
def _power(x: Example, folder: Path) -> Told:
    run, c = kept(x.name), x.plain
    y = flow(x.name)
    end = c.energy(*np.split(y, 2)) - c.energy(c.q, c.v)
    scale = max(1.0, np.abs(run.energy()).max(), np.abs(run.work()).max())
    return max(off(run.energy()[-1] - run.energy()[0], end), np.abs(run.power_balance()).max() / scale)


@column("use of runs", "wrenches", close=1e-8)
def _wrenches(x: Example, folder: Path) -> Told:
    if not x.links:
        raise NotAskedError("no bodies")
    w = np.array([0.5, -0.3, 0.2, 0.1, 0.2, -0.1])

    # The force follows the body, whose Jacobian is that of the plain coordinates.
    def flow() -> np.ndarray:
        part = Part("w", (), force=lambda c, t, q, u: (x.jacobian(q) @ x.rates(q)).T @ w)
        return replace(x, plain=replace(x.plain, parts=[*x.plain.parts, part])).flow([DURATION])[-1]

    q, v = x.state(flow())
    run = mb.simulate(
        engine(x.name), x.q, x.v, DURATION, "rk4", STEP, torque=x.tau, t0=x.t, wrenches={x.tip: w},
        wrench_axes="local_world_aligned", doubt=False,
    )  # fmt: skip
    _ended(run)
    return max(off(aligned(run.q[-1], x, q), q), off(run.v[-1], v), off(run.wrenches()[x.tip][-1], w))


@column("use of runs", "picture")
def _picture(x: Example, folder: Path) -> Told:
    kept(x.name).picture()
    import matplotlib.pyplot as plt

    plt.close("all")
    return 0.0


# Texts


def more_inputs(x: Example) -> list[np.ndarray]:
    """Return the inputs beside q, v and τ: the time, or the values of parameters."""
    values = {n: v for n, v in x.model.parameters.items() if n != x.model.time_parameter}
    time = [x.t] if x.model.time_parameter else []
    return [np.array([*map(float, values.values()), *time])] if values or time else []


@contextmanager
def derived(x: Example) -> Iterator[None]:
    """Let texts take the equations that the engine on an example has: it derives them as they do."""
    with ExitStack() as stack:
        for module in ("codegen.c_source", "lagrangian.program_text"):
            stack.enter_context(patch(f"mbkit.{module}.equations_of", lambda _: engine(x.name).equations))
        yield


@column("texts", "function (CasADi)")
def _casadi(x: Example, folder: Path) -> Told:
    function = engine(x.name).function("forward_dynamics")
    return off(function(x.q, x.v, x.tau, *more_inputs(x)).full()[:, 0], x.accelerated())


@column("texts", "C")
def _c(x: Example, folder: Path) -> Told:
    with derived(x):
        made = export_c(x.model, ["forward_dynamics"], name="case")
    _, source = made.write(folder)
    library = folder / f"{abs(hash(x.name))}.so"
    subprocess.run(["cc", "-O0", "-shared", "-fPIC", str(source), "-o", str(library), "-lm"], check=True)
    described = made.functions[0]
    arguments = [x.q, x.v, x.tau, *more_inputs(x)]
    assert len(arguments) == len(described.inputs)
    out = np.full(len(x.v), np.nan)
    call = getattr(ctypes.CDLL(str(library)), described.name)
    call.restype = None
    call(*(np.ascontiguousarray(y).ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for y in (*arguments, out)))
    return off(out, x.accelerated()), lacks_stops(x, made.header)


def lacks_stops(x: Example, text: str) -> tuple[str, ...]:
    """Return the note of a text that has no stops; there are others, which hide nothing."""
    return (
        (WITHOUT_STOPS,)
        if "stop" in x.model.effects and WITHOUT_STOPS in " ".join(text.replace(" * ", " ").split())
        else ()
    )


@cache
def program_of(name: str) -> Any:
    x = example(name)
    with derived(x):
        return program(x.model, "forward_dynamics")


@column("texts", "program text")
def _program(x: Example, folder: Path) -> Told:
    names: dict[str, Any] = {}
    exec(program_of(x.name).python(), names)
    out = np.atleast_1d(names["forward_dynamics"](x.q, x.v, x.tau, *more_inputs(x)))
    return off(out, x.accelerated()), lacks_stops(x, program_of(x.name).python())


class _Short(Arm):
    """An arm whose third joint is fixed where a fourth one follows."""

    def add(self, joint: str, type_: str, *names: str, **numbers: Any) -> None:
        type_ = "fixed" if joint == "j2" and self.name.startswith("joint.") else type_
        super().add(joint, type_, *names, **numbers)


class _Flat(_Short):
    """And whose hinges lie in a plane: its equations are short."""

    def add(self, joint: str, type_: str, *names: str, **numbers: Any) -> None:
        axes = ((0, 1, 0), (1, 0, 0))
        super().add(joint, type_, *names, **numbers | ({"axes": axes} if "axes" in numbers else {}))


@cache
def on_paper(name: str, flat: bool = False) -> tuple[Example, Any]:
    """Return an example whose equations are short, and them."""
    x = example(name)
    if name in EXAMPLES:
        with patch.object(kind_examples, "Arm", _Flat if flat else _Short):
            y = EXAMPLES[name](name)
        # Without the part where the example is.
        gone = name in PART_KINDS and name not in x.model.acts
        x = replace(y, model=PART_KINDS[name].removed(y.model)) if gone else y
    return x, from_model(x.model, **({"drives": True} if x.model.prescribed else {}))


def _held_by_stops(x: Example, lag: Any) -> np.ndarray:
    """Return v̇ of the equations with those stops in contact that push, λ > 0, while the others let go, g̈ >= 0."""
    e, put = lag.equations(), dict(lag.parameters) | ({lag.time: x.t} if lag.time else {})
    put |= dict(zip((*lag.coordinates, *lag.velocities), (*x.q, *x.v), strict=True))
    left = [row.lhs - row.rhs - y for row, y in zip(e.equations(), x.tau, strict=False)]
    rows = [*left, *(e.constraint_jacobian * sp.Matrix(e.accelerations) + e.constraint_acceleration)]
    touched = [s for s in e.stops if abs(s.gap.subs(put)) < CLOSE and abs(s.rate.subs(put)) < CLOSE]
    for pushing in chain(*(combinations(touched, k) for k in range(len(touched) + 1))):
        idle = [s.multiplier for s in e.stops if s not in pushing]
        whole = sp.Matrix([*rows, *(s.acceleration for s in pushing), *idle]).subs(put)
        unknown = (*e.accelerations, *e.multipliers, *lag.stop_multipliers)
        found = whole.jacobian(unknown).LUsolve(-whole.subs(dict.fromkeys(unknown, 0)))
        solved = dict(zip(unknown, found, strict=True))
        least = [*(solved[s.multiplier] for s in pushing), *(s.acceleration.subs(put).subs(solved) for s in touched)]
        if all(y > -CLOSE for y in least):
            return np.array([solved[a] for a in e.accelerations], dtype=float)
    raise AssertionError("no stops that push and let go")


@column("texts", "equations on paper")
def _paper(x: Example, folder: Path) -> Told:
    if len(x.plain.kinds) > 4:
        raise NotAskedError("more than four joints take minutes; the suite has random chains with every loop")
    x, lag = on_paper(x.name)
    if lag.stops:
        return off(_held_by_stops(x, lag), x.accelerated())
    dyn = lag.dynamics(options={"compile": False})
    dyn = dyn.at(**{dyn.model.time_parameter: x.t}) if dyn.model.time_parameter else dyn
    if dyn.model.nq != x.model.nq:
        # Paper has angles in the place of a quaternion, as the plain case, and the velocities of the model.
        return off(dyn.forward_dynamics(x.plain.q, x.v, x.tau), x.accelerated())
    return off(dyn.forward_dynamics(x.q, x.v, x.tau), x.accelerated())


# Files


def _by_name(x: Example) -> tuple[dict[str, float], dict[str, tuple[float, ...]]]:
    """Return coordinates, and v, τ and v̇, by name; of a free joint also as three slides and a ball, and of mimics."""
    c, tau, a = x.plain, x.tau, x.accelerated()
    forces = x.rates(c.q).T @ tau
    plain = c.acceleration(x.t, c.q, c.v, forces)
    q = dict(zip(x.model.coordinate_names, x.q, strict=True))
    motion = dict(zip(x.model.velocity_names, zip(x.v, tau, a, strict=True), strict=True))
    for joint, type_, k in x.joints:
        if type_ == "free":
            q |= {f"{joint}.ball.{n}": q[f"{joint}.{n}"] for n in ("qx", "qy", "qz", "qw")}
            motion |= {f"{joint}.{n}": (c.v[k + i], forces[k + i], plain[k + i]) for i, n in enumerate("xyz")}
            motion |= {f"{joint}.ball.{n}": motion[f"{joint}.{n}"] for n in ("wx", "wy", "wz")}
    for joint in (j for j in x.model.joints if j.mimic and j.child in x.links):
        row = c.G[x.links[joint.child]]
        q[joint.name] = row @ c.q + c.c[x.links[joint.child]]
        motion[joint.name] = row @ c.v, 0.0, row @ plain
    return q, motion


def _file(x: Example, folder: Path, to: str) -> Told:
    made = mb.convert(x.model, to)
    path = made.write(folder / f"case.{'xml' if to == 'mjcf' else 'urdf'}")
    stops = {"stops": True} if x.model.needs.stops else {}
    back = mb.load(path, **stops, **({"gravity": x.model.gravity} if to == "urdf" else {}))
    coordinates, motion = _by_name(x)
    q = np.array([coordinates[n] for n in back.coordinate_names])
    v, tau, a = (np.array(y) for y in zip(*(motion[n] for n in back.velocity_names), strict=True))
    there = {(k, name.partition(".")[0]) for k, names in back.acts.items() for name in names}
    lost = [
        k
        for k, names in x.model.acts.items()
        if ("limit" in k or "stop" in k) and "several" not in k and not {(k, n) for n in names} <= there
    ]
    error = off(dynamics(x, back).forward_dynamics(q, v, tau), a)
    notes = tuple(str(n) for n in getattr(made, "notes", ()))
    if stops:
        # They come back where they are asked for, and are told to be left out otherwise.
        lost += ["joint.stop"] * (not mb.load(path).needs.stops)
    # Limits are data alone; each that is lost is told.
    said = all(any(k.split(".")[1].replace("_", " ") in note for note in notes) for k in lost)
    return (np.inf, notes if said else ()) if lost and error <= CLOSE else error


column("files", "URDF and back", "urdf", to="urdf")(_file)
column("files", "MJCF and back", "mjcf", to="mjcf")(_file)


@column("files", "pickle and digest")
def _pickle(x: Example, folder: Path) -> Told:
    back = pickle.loads(pickle.dumps(x.model))
    if back.digest != x.model.digest or back != x.model:
        return np.inf
    same = [name for name, other in _changed(x, x.name) if other.digest == x.model.digest]
    if same:
        raise AssertionError(f"the digest does not see {same}")
    return off(dynamics(x, back).forward_dynamics(x.q, x.v, x.tau), x.accelerated())


@column("files", "baseline")
def _baseline(x: Example, folder: Path) -> Told:
    """The model passes, and does not without the part."""
    path = folder / "b.toml"
    with patch("mbkit.studies.baseline.study._ROLLOUT", Rollout(STEP, 4)):
        mb.baseline.record(x.model, path, ["lagrangian"], samples=1, force=True)
    if not mb.baseline.check(x.model, path).passed:
        return np.inf
    if (less := without_part(x)) is not None and mb.baseline.check(less, path).passed:
        raise AssertionError(f"passes without {x.name}")
    return 0.0


# Changes of a model


def without_part(x: Example) -> Model | None:
    k = PART_KINDS.get(x.name)
    return x.model.without(x.name) if k and k.features else None


def bare(x: Example) -> Example:
    """The example without its part."""
    parts = [] if x.name != "gravity" else x.plain.parts
    weight = 0 * x.plain.weight if x.name == "gravity" else x.plain.weight
    return replace(x, plain=replace(x.plain, parts=parts, weight=weight))


@column("changes", "without")
def _taken_out(x: Example, folder: Path) -> Told:
    less = without_part(x)
    if less is None:
        raise NotAskedError("it is no part that can be taken out")
    own = mb.dynamics(less, "lagrangian", compile=False)
    return off(own.forward_dynamics(x.q, x.v, x.tau), bare(x).accelerated())


@column("changes", "lock", "lock")
def _lock(x: Example, folder: Path) -> Told:
    """A locked joint is one whose velocity and acceleration stay zero."""
    name = next((j for j in ("j1", "j0") if j in x.model.coordinate_names), "")
    k = next((i for j, _, i in x.joints if j == name), 0)
    if not name or len(x.plain.q) - len(x.held()) < 2:
        raise NotAskedError("nothing else moves")
    held = Part("held", (), speeds=lambda c, q: np.eye(c.n)[k][None])
    c = replace(x.plain, parts=[*x.plain.parts, held])
    now = replace(x, plain=replace(c, v=c.allowed(c.t, c.q, c.v)))
    position = x.q[list(x.model.coordinate_names).index(name)]
    locked = x.model.lock({name: position})
    at = [n in locked.velocity_names for n in x.model.velocity_names]
    there = [n in locked.coordinate_names for n in x.model.coordinate_names]
    got = dynamics(x, locked).forward_dynamics(x.q[there], now.v[at], x.tau[at])
    return off(got, now.accelerated()[at])


@column("changes", "join", "join")
def _join(x: Example, folder: Path) -> Told:
    """Beside a pendulum that nothing touches, the model moves as alone."""
    b = mb.ModelBuilder("clock", gravity=x.model.gravity)
    b.add_body("bob", mass=1.0, com=(0, 0, -1), inertia=(0.1, 0.1, 0.1))
    b.add_joint("pivot", "revolute", parent="world", child="bob", axis=(0, 1, 0))
    worst = 0.0
    for model in (mb.join(b.build(), x.model, at="world"), mb.join(x.model, b.build(), at="world")):
        at = [model.velocity_names.index(n) for n in x.model.velocity_names]
        there = [model.coordinate_names.index(n) for n in x.model.coordinate_names]
        q, v, tau = np.zeros(model.nq), np.zeros(model.nv), np.zeros(model.nv)
        q[there], v[at], tau[at] = x.q, x.v, x.tau
        worst = max(worst, off(dynamics(x, model).forward_dynamics(q, v, tau)[at], x.accelerated()))
    return worst


@column("changes", "built anew", "editing")
def _of(x: Example, folder: Path) -> Told:
    back = mb.ModelBuilder.of(x.model).build()
    return off(dynamics(x, back).forward_dynamics(x.q, x.v, x.tau), x.accelerated())


@column("changes", "segments", "segmented")
def _segments(x: Example, folder: Path) -> Told:
    """Beams alone become others; a hinge that moves as a whole body has their inertia."""
    model = x.model.segmented(3)
    if x.name == "joint_type.beam":
        raise NotAskedError("a chain comes near with many segments; the page of numbers on beams has how near")
    return off(dynamics(x, model).forward_dynamics(x.q, x.v, x.tau), x.accelerated())


# Studies


@column("studies", "explain: taken out", "explain")
def _explained(x: Example, folder: Path) -> Told:
    if (less := without_part(x)) is None:
        raise NotAskedError("it is no part that can be taken out")
    out = mb.explain(x.model, less, samples=1)
    if out.agree and PART_KINDS[x.name].does != {"bound"}:
        return np.inf
    text = " ".join(f"{c.kind} {c.says}" for c in out.causes)
    if not named(x.name, x, text):
        raise AssertionError(f"not by name: {text}")
    return 0.0


@column("studies", "motions of causes", "motions", close=1e-6)
def _moved(x: Example, folder: Path) -> Told:
    """The motion with the part and without it, passive, beside both by SciPy."""
    if (less := without_part(x)) is None:
        raise NotAskedError("it is no part that can be taken out")
    motion = Motion(controller="passive", q=x.q, v=x.v, times=(DURATION,))
    one, other = (replace(m, time=x.t) for m in (x.model, less))
    out = mb.explain(one, other, samples=1, motion=motion).motion
    assert out is not None
    alone = [e.largest for e in out.effects]
    if out.whole[0] > 1e-9 and not alone:
        raise AssertionError("no cause of a difference")
    ends = [y.flow([DURATION], lambda t, q, v: 0 * v)[-1] for y in (x, bare(x))]
    apart = np.abs(x.model.difference(*(y.state(end)[0] for y, end in zip((x, bare(x)), ends, strict=True)))).max()
    soft = [n for n in out.notes if "soft" in n]
    return max(abs(out.whole[0] - apart), out.unexplained[0]), soft


@column("studies", "explain: each number")
def _each_number(x: Example, folder: Path) -> Told:
    changed = _changed(x, x.name)
    if not changed:
        raise NotAskedError("it has no numbers")
    unseen = []
    for name, other in changed:
        moved = dynamics(x, other).forward_dynamics(x.q, x.v, x.tau)
        acts = off(moved, x.accelerated()) > 1e-7
        if acts and mb.explain(x.model, other, samples=1).agree:
            unseen.append(name)
    if unseen:
        raise AssertionError(f"not seen: {unseen}")
    return 0.0


@column("studies", "lint", "lint")
def _lint(x: Example, folder: Path) -> Told:
    out = mb.lint(x.model)
    return 0.0 if out.links and out.joints == sum(j.type.nv > 0 for j in x.model.joints) else np.inf


#: Rows and columns of the matrix.
ROWS = (*EXAMPLES, *TYPES)
