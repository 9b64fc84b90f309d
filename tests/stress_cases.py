"""Cases that end badly in every way there is, for tests; workers import this module."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace

import numpy as np

import mbkit as mb
from mbkit.errors import MbkitWarning, UnsupportedError
from mbkit.studies.stress import Case, Problem
from mbkit.studies.stress import measurements as runs

SIMULATE = runs.simulate


def swing(value: float) -> Problem:
    """A pendulum that swings a little, for as long as said; its exact motion is that of the linear one."""
    square = 9.81
    return Problem(
        mb.catalog.pendulum(),
        np.array([1e-9]),
        np.zeros(1),
        duration=value,
        exact=lambda t: 1e-9 * np.cos(np.sqrt(square) * t)[:, None],
        floor=1e-20,
        source="small swings",
        scale=1e-9,
        facts={"swings": value},
    )


# What becomes of a run, by method


def _abort(*_: object, **__: object) -> None:
    os.abort()


def _endless(*_: object, **__: object) -> None:
    # As C++ does, it holds Python's lock and looks for no signal.
    sum(range(1 << 60))


def _hog(*_: object, **__: object) -> None:
    # Twice what the tests allow a worker.
    np.empty(1 << 28)


def _nan(*args: object, **more: object) -> object:
    run = SIMULATE(*args, **more)
    return replace(run, q=run.q * np.nan)


def _wrong(*args: object, **more: object) -> object:
    run = SIMULATE(*args, **more)
    # At rest, which keeps the energy too.
    return replace(run, q=0 * run.q, v=0 * run.v)


def _doubtful(*args: object, **more: object) -> object:
    warnings.warn("this is\n wrong", MbkitWarning, stacklevel=2)
    return _wrong(*args, **more)


def _refuse(*_: object, **__: object) -> None:
    raise UnsupportedError("pinocchio: not this one")


def _foreign(*_: object, **__: object) -> None:
    raise RuntimeError("from C++")


#: Method -> what becomes of it from the value 2 on.
ENDS = {
    "semi_implicit_euler": _abort,
    "gauss4": _endless,
    "gauss6": _hog,
    "rk853": _nan,
    "dop853": _wrong,
    "radau": _doubtful,
    "bdf": _refuse,
    "lsoda": _foreign,
}


def _ending(dyn: object, q: object, v: object, duration: float, method: str, **more: object) -> object:
    return ENDS.get(method, SIMULATE)(dyn, q, v, duration, method, **more)


def ends(value: float) -> Problem:
    """A pendulum whose methods end as `ENDS` says, except at 1."""
    runs.simulate = SIMULATE if value == 1 else _ending
    return swing(0.25)


def faulty(value: float) -> Problem:
    """A problem that cannot be made at 2 to 4, and has a bad truth at 5 and a false one at 6."""
    runs.simulate = SIMULATE
    fine = swing(0.25)
    if value == 2:
        os.abort()
    if value == 3:
        raise ZeroDivisionError("no such problem")
    if value == 4:
        return None
    if value == 5:
        # Known to half of the motion only.
        return replace(fine, floor=0.5e-9)
    if value == 6:
        return replace(fine, exact=lambda t: np.ones((len(t), 1)))
    return fine


def sprung(stiffness: float) -> Problem:
    """A double pendulum with a spring in its second joint, let go from rest: stiff, and it rings."""
    b = mb.ModelBuilder("sprung", gravity=(0, 0, -9.81))
    for k, (parent, z, spring) in enumerate([("world", 0, 0.0), ("link1", -1, stiffness)], start=1):
        link, place = f"link{k}", (0, 0, z)
        b.add_body(link, mass=1.0, com=(0, 0, -0.5), inertia=(0.1, 0.1, 0.1))
        joint = {"parent": parent, "child": link, "translation": place, "axis": (0, 1, 0)}
        b.add_joint(f"joint{k}", "revolute", stiffness=spring, **joint)
    return Problem(b.build(), np.array([0.5, 0.1]), np.zeros(2), duration=0.5)


def masses(ratio: float) -> Problem:
    """A double pendulum with a light tip: terms at two states."""
    rng = np.random.default_rng(0)
    model = mb.catalog.double_pendulum(mass2=ratio)
    return Problem(model, rng.uniform(-1, 1, (2, 2)), rng.standard_normal((2, 2)), tau=np.ones(2))


def gliding(value: float) -> Problem:
    """A double pendulum, judged by its energy alone, with steps as prescribed."""
    runs.simulate = SIMULATE
    return Problem(mb.catalog.double_pendulum(), np.array([0.3, 0.2]), np.zeros(2), duration=100 * value, dt=value)


ENDING = Case("ending", "Ends in all ways.", "stiffness", "badness", "", (1, 2, 3), (), ends)
FAULTY = Case(
    "faulty",
    "Cannot be made.",
    "large",
    "badness",
    "m",
    (1, 2, 3, 4, 5, 6),
    (1,),
    faulty,
    methods=("rk4", "dop853", "semi_implicit_euler"),
)
MASSES = Case("masses", "A light tip.", "mass ratio", "mass", "kg", (1.0, 1e-20), (), masses, measure="terms")
GLIDING = Case(
    "gliding", "Steps.", "step", "dt", "s", (1e-3, 1e-2), (), gliding, measure="energy", bar=1e-11, methods=("rk4",)
)
