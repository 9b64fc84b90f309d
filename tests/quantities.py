"""What the contract of engines goes over: models of every kind at a state, and each quantity as one array."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import mbkit as mb
from mbkit.engines import QUANTITIES
from mbkit.engines.frames_and_momenta import AXES, CLASSICAL, SPATIAL
from mbkit.model import KINDS, Model, kind_of
from mbkit.model.loops import LOOP_KINDS
from mbkit.model.parts import Loop, Prescribed
from mbkit.model.quantities import of_groups
from tests.joint_of_ones_own import OWN
from tests.random_trees import ALL, IN_MUJOCO, SOUND, coupled, random_tree, rotation

DERIVATIVES = ("inverse_dynamics_derivatives", "forward_dynamics_derivatives")
#: What an engine may have, but functions, which no other engine returns.
TERMS = tuple(x for x in (*QUANTITIES, *DERIVATIVES) if x not in ("function", "reduced_inertia"))
#: What there is of a tree whether or not constraints hold it, and need not be asked for again.
OF_TREES = {*of_groups("frame", "whole", "regressor"), "gravity", "passive", "coriolis_matrix"}
OF_TREES |= {"coriolis_force", "kinetic_energy", "potential_energy", "mass_matrix_inverse", "generalized_force"}
#: What the forces of constraints enter.
OF_FORCES = {
    "forward_dynamics",
    "generalized_constraint_force",
    "constraint_forces",
    "loop_wrenches",
    "actuator_forces",
}
OF_FORCES |= {"joint_wrenches", "newton_euler_residual"}
#: What an equation is solved for, and has the condition of its matrix.
SOLVED = {*OF_FORCES, "forward_dynamics_derivatives", "mass_matrix_inverse"}
BUILT_IN = tuple(name for name, joint_type in KINDS.items() if joint_type.built_in and joint_type.nv)
NOTHING = {"springs": False, "damping": False, "armature": False}
WRENCH = np.array([1.0, -2.0, 3.0, 0.5, 0.1, -0.4])
#: Time at which motions in time are taken, s.
T0 = 0.7


def of_joint(kind: str) -> Model:
    """Return two bodies with a joint of this type each, all features that it can have, and a hinge between."""
    joint_type, rng = kind_of(kind), np.random.default_rng(5)
    b = mb.ModelBuilder(kind, gravity=(1.0, -2.0, -9.0))
    options: dict[str, Any] = {
        f"axis{k or ''}": x for k, x in ((0, (0.6, 0.0, 0.8)), (2, (0.0, 1.0, 0.0)))[: joint_type.n_axes]
    }
    options["damping"] = 0.4
    if joint_type.pitched:
        options["pitch"] = 0.3
    if joint_type.coordinate_velocities and not joint_type.pitched:
        options |= {"stiffness": 2.0, "rest": 0.1}
    if joint_type.nv == 1:
        options["armature"] = 0.2
    parent = "world"
    for k, (name, more) in enumerate(((kind, options), ("revolute", {"axis": (0, 0, 1)}), (kind, options))):
        inertia = np.diag(rng.uniform(0.4, 0.6, 3))
        b.add_body(f"b{k}", mass=1.0 + k, com=rng.uniform(-0.2, 0.2, 3), inertia=inertia)
        place = {"translation": rng.uniform(-0.3, 0.3, 3), "rpy": rng.uniform(-1, 1, 3)}
        b.add_joint(f"j{k}", name, parent=parent, child=f"b{k}", **place, **more)
        parent = f"b{k}"
    return b.build()


def closed(tree: Model, seed: int, kind: str, *, drive: bool = False) -> tuple[Model, np.ndarray]:
    """Return a tree with a loop of a kind between two bodies that move against each other, and a q that closes it."""
    rng = np.random.default_rng(seed)
    q, _ = tree.random_state(rng)
    names, poses = [b.name for b in tree.bodies], mb.dynamics(tree, "lagrangian", compile=False).body_poses(q)
    carried = {j.child: j.name for j in tree.joints}

    def freedoms(a: int, b: int) -> int:
        way = tree.chains[carried[names[a]]] ^ tree.chains[carried[names[b]]]
        return sum(j.type.nv for j in tree.independent_joints if j.name in way)

    pairs = [(a, b) for a in range(len(names)) for b in range(a) if freedoms(a, b) > LOOP_KINDS[kind] + drive]
    a, b = pairs[rng.integers(len(pairs))]
    own, length = np.eye(4), 0.0
    own[:3, :3], own[:3, 3] = rotation(rng), 0.3 * rng.standard_normal(3)
    there = poses[a] @ own
    # Where the other end stands: what the joint of the loop may do.
    if kind == "distance":
        length = 0.7
        there[:3, 3] += length * rotation(rng)[0]
    if kind == "universal":
        there[:3, :3] = there[:3, :3] @ Rotation.from_euler("xz", [np.pi / 2, 0.4]).as_matrix()
    if kind in ("cylindrical", "prismatic"):
        there[:3, 3] += 0.3 * there[:3, 2]
    if kind in ("cylindrical", "revolute"):
        there[:3, :3] = there[:3, :3] @ Rotation.from_euler("z", 0.6).as_matrix()
    other = np.linalg.inv(poses[b]) @ there
    ends = names[a], own[:3, :3], own[:3, 3], names[b], other[:3, :3], other[:3, 3]
    model = replace(tree, loops=(Loop("loop", kind, *ends, length),))
    if drive:
        joint = next(j for j in tree.independent_joints if j.type.nv == 1)
        x = Prescribed(joint.name, 0.0, 0.5, 0.3, 2.0, 0.0)
        offset = float(q[tree.layout.q[joint.name].start]) - x.rate * T0 - x.amplitude * np.sin(x.frequency * T0)
        model = replace(model, prescribed=(replace(x, offset=offset),)).with_parameters(t=T0)
    return model, q


def _closed_tree(kind: str) -> tuple[Model, np.ndarray]:
    k = list(LOOP_KINDS).index(kind)
    # MuJoCo and Drake have these two as well; the way of one goes over a free joint.
    if kind == "frame":
        return closed(random_tree(7, 4, ("free", "ball", "revolute", "planar"), nearest=2), 7, kind)
    kinds = tuple(x for x in SOUND if x != "fixed" and (kind != "point" or x != "helical"))
    return closed(random_tree(k, 7 if kind == "prismatic" else 5, kinds, nearest=2), k, kind, drive=k % 3 == 2)


#: Trees and mechanisms, each with a configuration that closes it where one drawn would be another.
MODELS: dict[str, Callable[[], tuple[Model, np.ndarray | None]]] = {
    **{kind: partial(lambda kind: (of_joint(kind), None), kind) for kind in (*BUILT_IN, *OWN)},
    "all joint types": lambda: (random_tree(11, 11, ALL, mimic=True), None),
    "fixed to the world": lambda: (random_tree(14, 8, ("fixed", "revolute", "prismatic"), nearest=6), None),
    "floating": lambda: (random_tree(3, 8, ("free", "ball", "revolute", "fixed", "planar"), nearest=3), None),
    "without springs": lambda: (random_tree(4, 7, IN_MUJOCO, springs=False, damping=False, nearest=4), None),
    "sound": lambda: (random_tree(5, 8, [k for k in SOUND if k != "helical"], **NOTHING, mimic=True), None),
    "solo12": lambda: (mb.load("solo12", floating_base=True), None),
    **{f"loop.{kind}": partial(_closed_tree, kind) for kind in LOOP_KINDS},
    "couplers": lambda: (coupled(random_tree(2, 6, ("revolute", "prismatic", "ball")), 2), None),
    **{
        name: partial(lambda name: (mb.catalog.get(name)(), None), name)
        for name in ("four_bar", "bricard", "flyball_governor", "planar_3rrr", "parallel_gripper", "rolling_disc")
    },
}


@dataclass(frozen=True)
class Scene:
    """A model, three of its states, the oracle, and how many times its rounding engines may be off.

    Where constraints hold it, `a` is the acceleration under `tau`.
    """

    model: Model
    at: dict[str, np.ndarray]
    oracle: mb.Dynamics
    condition: float

    def row(self, k: int) -> dict[str, np.ndarray]:
        """One of the states."""
        return {name: x[k] for name, x in self.at.items()}

    def opened(self, k: int) -> dict[str, np.ndarray]:
        """One of the states, away from what constraints ask for."""
        at = self.row(k)
        return at | {"q": self.model.integrate(at["q"], 0.1 * at["tau"]), "v": at["v"] + at["tau"]}


@cache
def scene(name: str) -> Scene:
    """Return a model with its states, made once."""
    model, q = MODELS[name]()
    oracle, rng = mb.dynamics(model, "oracle"), np.random.default_rng(8)
    qs, v = model.random_state(rng, 3)
    if q is not None:
        qs, v = (np.tile(x, (3, 1)) for x in mb.dynamics(model, "lagrangian", compile=False).project(q, v[0]))
    a, tau = rng.standard_normal((2, 3, model.nv))
    loses = float(np.linalg.cond(oracle.mass_matrix(qs)).max())
    if model.constrained:
        a = oracle.forward_dynamics(qs, v, tau)
        loses = max(condition(oracle, x) for x in qs)
    return Scene(model, {"q": qs, "v": v, "a": a, "tau": tau}, oracle, loses)


def condition(dyn: mb.Dynamics, q: np.ndarray) -> float:
    """Return the condition of the equation of v̇ and λ, with unit masses and rows; of redundant rows what they add."""
    M, J = dyn.mass_matrix(q), dyn.constraint_jacobian(q)
    across = 1 / np.sqrt(np.diag(M))
    J = J * across
    J = J / np.linalg.norm(J, axis=1)[:, None]
    K = np.block([[across[:, None] * M * across, J.T], [J, np.zeros((len(J),) * 2)]])
    s = np.linalg.svd(K, compute_uv=False)
    return float(s[0] / s[s > 1e-10 * s[0]][-1])


def value(dyn: mb.Dynamics, quantity: str, at: dict[str, np.ndarray], axes: tuple[str, ...] = AXES) -> np.ndarray:
    """Return a quantity of the last body in these axes and of all kinds, on a last axis."""
    method, frame, held = getattr(dyn, quantity), dyn.model.bodies[-1].name, dyn.model.constrained
    takes = inspect.signature(method).parameters
    more = {"frame": frame} if "frame" in takes else {}
    # The forces of constraints follow the forces on the tree, which a scene's accelerations know.
    free = held and "wrenches" in takes and takes["wrenches"].default is None
    more |= {"wrenches": {frame: WRENCH}} if "wrenches" in takes and not free else {}
    options: list[dict[str, Any]] = [{"axes": x} for x in axes] if "axes" in takes and not free else [{}]
    options = [x | {"kind": kind} for x in options for kind in (SPATIAL, CLASSICAL)] if "kind" in takes else options
    # Loads take a or τ; of a tree they take a, under constraints both.
    needed = (k for k, x in takes.items() if x.default is x.empty or k == "a" or (held and k == "tau"))
    given = {k: at[k] for k in needed if k in at}
    lead, out = at["q"].shape[:-1], []
    for x in options:
        got = method(**given, **more, **x)
        parts = [np.asarray(y) for y in (got if isinstance(got, tuple) else ())]
        flat = [y.reshape(*lead, y[(0,) * len(lead)].size if 0 not in lead else 0) for y in parts]
        out.append(np.concatenate(flat, axis=-1) if parts else np.asarray(got))
    return np.stack(out, axis=-1)
