"""What a scene does not need: what was off, what that saved, and that nothing changed."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.engines import Dynamics
from mbkit.engines.registry import DERIVED, MUJOCO
from mbkit.model import Model
from mbkit.studies.compare.errors import interleaved
from mbkit.studies.compare.result import Omission
from mbkit.studies.study_runs import state_within_limits

# Accelerations of the same model with one more feature compiled in differ by the
# order of a few sums, amplified by the conditioning that both share.
_UNCHANGED: Final = 1e-9

#: need -> (field of Needs, MuJoCo's bit, what was off)
_FLAGS: Final = (
    ("limits", "limits", ("LIMIT", "CONSTRAINT"), "joint limits kept as data; no limit rows, no constraint solver"),
    ("dry friction", "friction", ("FRICTIONLOSS", "CONSTRAINT"), "dry friction kept as data; no constraint solver"),
    ("damping", "damping", ("DAMPER",), "dampers"),
    ("springs", "springs", ("SPRING",), "springs"),
    ("gravity", "gravity", ("GRAVITY",), "gravity"),
    ("loops", "loops", ("EQUALITY", "CONSTRAINT"), "loop closures and equality rows"),
)


def omissions(model: Model, engines: Mapping[str, Dynamics], seed: int) -> tuple[Omission, ...]:
    """Return one row per need, measured on the engines at hand."""
    # Well within the limits, where none of them acts.
    q, v = state_within_limits(model, np.random.default_rng([seed, 2]))
    rows: list[Omission] = []
    mujoco = engines.get(MUJOCO)
    if mujoco is not None:
        rows += _in_mujoco(model, mujoco, q, v)
    if DERIVED in engines:
        rows.append(_coriolis(model, q, v))
    return tuple(rows)


def _in_mujoco(model: Model, dyn: Any, q: Array, v: Array) -> list[Omission]:
    from mbkit.engines.mujoco.variants import Variant

    lean = Variant(dyn)
    variants: dict[str, Variant] = {
        "geometry": Variant(dyn, spheres=True),
        "contacts": Variant(dyn, ("CONTACT", "CONSTRAINT"), spheres=True),
    }
    words = {
        "geometry": "meshes and shapes never opened (measured with one small sphere per body)",
        "contacts": "collision detection and contact forces (measured on those spheres)",
    }
    kept: dict[str, str] = {}
    needs = model.needs.as_dict()
    for need, flag, bits, what in _FLAGS:
        words[need] = what
        if need in ("damping", "springs", "gravity") and needs[flag]:
            kept[need] = "needed, so it is on"
            continue
        variants[need] = Variant(dyn, bits)
    calls: dict[str, Any] = {"lean": lean.forward}
    reference = lean.accelerations(q, v)
    # Where nothing accelerates, what turning at v would ask for is the measure.
    scale = max(float(np.abs(reference).max(initial=0.0)), float(v @ v))
    changes: dict[str, float] = {}
    for need, variant in variants.items():
        a = variant.accelerations(q, v)
        changes[need] = float(np.abs(a - reference).max(initial=0.0)) / scale
        calls[need] = variant.forward
    times = interleaved(calls, rounds=15)
    rows = []
    for need in ("contacts", "geometry", "limits", "dry friction", "damping", "springs", "gravity", "loops"):
        flag = next((f for n, f, _, _ in _FLAGS if n == need), "")
        present = bool(flag) and needs[flag]
        if need in kept:
            rows.append(Omission(need, True, kept[need], math.nan, math.nan, math.nan, math.nan, True))
            continue
        saved = times[need][0] - times["lean"][0]
        spread = math.hypot(times[need][1], times["lean"][1])
        # Dry friction that is there would act: leaving it out is a choice, said aloud.
        chosen = need == "dry friction" and present
        note = "it is off in every engine, so that the smooth terms compare" if chosen else ""
        unchanged = chosen or changes[need] <= _UNCHANGED
        rows.append(Omission(need, present, words[need], saved, spread, math.nan, changes[need], unchanged, note))
    return rows


def _coriolis(model: Model, q: Array, v: Array) -> Omission:
    """Measure the Coriolis matrix, derived only when somebody asks for it."""
    from mbkit.codegen.interpreter import Machine
    from mbkit.derivation import equations_of

    equations = equations_of(model)
    nle = Machine(equations.function("coriolis_force"))
    start = time.perf_counter()
    matrix = Machine(equations.function("coriolis_matrix"))
    setup = time.perf_counter() - start
    times = interleaved({"matrix": lambda: matrix(q, v), "nle": lambda: nle(q, v)})
    force, M = nle(q, v)[0][:, 0], Machine(equations.function("mass_matrix"))(q)[0]
    scale = max(float(np.linalg.norm(force)), float(np.linalg.norm(M, 2) * (v @ v)))
    change = float(np.linalg.norm(matrix(q, v)[0] @ v - force)) / scale
    return Omission(
        "Coriolis matrix",
        False,
        "C(q, v) is derived only on demand; C v comes without it",
        times["matrix"][0] - times["nle"][0],
        math.hypot(times["matrix"][1], times["nle"][1]),
        setup,
        change,
        change <= _UNCHANGED,
    )
