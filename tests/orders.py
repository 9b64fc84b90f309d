"""The order of a method, seen from runs with shorter and shorter steps beside a tight DOP853."""

from __future__ import annotations

from typing import Any

import numpy as np

import mbkit as mb
from mbkit import catalog
from mbkit.model import Model
from tests.random_trees import random_tree


def cases() -> dict[str, tuple[Model, np.ndarray, np.ndarray, float]]:
    """Return models, starts and durations."""
    rng = np.random.default_rng(5)
    tree = random_tree(11, n=4, kinds=("free", "ball", "revolute", "prismatic"))
    top, box = catalog.heavy_top(), catalog.free_body()
    return {
        "double pendulum": (catalog.double_pendulum(), np.array([0.6, 0.3]), np.array([0.5, -0.5]), 1.0),
        "heavy top": (top, top.random_state(rng)[0], np.array([1.0, 20.0, -4.0]), 0.5),
        "Dzhanibekov box": (box, box.random_state(rng)[0], np.array([1.0, 2.0, 3.0, 0.1, 5.0, 0.1]), 1.0),
        # With springs, damping and armature; the torque pushes it too.
        "random tree": (tree, *tree.random_state(rng), 0.5),
    }


def torque_on(model: Model) -> np.ndarray:
    return np.linspace(-1.0, 1.0, model.nv) if model.name.startswith("tree") else np.zeros(model.nv)


def observed(case: Any, method: str, counts: tuple[int, ...], engine: str = "pinocchio", torque: Any = None) -> float:
    """Return the slope of the errors at the end over the steps, of a case or the name of one."""
    model, q, v, duration = cases()[case] if isinstance(case, str) else case
    force = torque_on(model) if torque is None else torque
    exact = {"rtol": 3e-14, "save": [0.0, duration], "torque": force}
    truth = mb.simulate(mb.dynamics(model), q, v, duration, "dop853", **exact)
    dyn, errors = mb.dynamics(model, engine), []
    for n in counts:
        run = mb.simulate(dyn, q, v, duration, method, dt=duration / n, torque=force)
        apart = [model.difference(truth.q[-1], run.q[-1]), run.v[-1] - truth.v[-1]]
        errors.append(float(np.linalg.norm(np.concatenate(apart))))
    return -float(np.polyfit(np.log(counts), np.log(errors), 1)[0])
