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

#: Need, field of Needs, MuJoCo's bits, what was off.
_NEEDS: Final = (
    ("contacts", "", ("CONTACT", "CONSTRAINT"), "collision detection and contact forces (measured on those spheres)"),
    ("geometry", "", (), "meshes and shapes never opened (measured with one small sphere per body)"),
    ("limits", "limits", ("LIMIT", "CONSTRAINT"), "joint limits kept as data; no limit rows, no constraint solver"),
    ("dry friction", "friction", ("FRICTIONLOSS", "CONSTRAINT"), "dry friction kept as data; no constraint solver"),
    ("damping", "damping", ("DAMPER",), "dampers"),
    ("springs", "springs", ("SPRING",), "springs"),
    ("gravity", "gravity", ("GRAVITY",), "gravity"),
    ("loops", "loops", ("EQUALITY", "CONSTRAINT"), "loop closures and equality rows"),
)
#: What is on where the description has it.
_KEPT: Final = ("damping", "springs", "gravity")


def omissions(model: Model, engines: Mapping[str, Dynamics], seed: int) -> tuple[Omission, ...]:
    """Return one row per need, measured on the engines at hand."""
    # Well within the limits, where none of them acts.
    q, v = state_within_limits(model, np.random.default_rng([seed, 2]))
    rows = _in_mujoco(model, engines[MUJOCO], q, v) if MUJOCO in engines else []
    return (*rows, *([_coriolis(model, q, v)] if DERIVED in engines else []))


def _in_mujoco(model: Model, dyn: Any, q: Array, v: Array) -> list[Omission]:
    from mbkit.engines.mujoco.variants import Variant

    needs = model.needs.as_dict()
    variants = {
        need: Variant(dyn, bits, spheres=not field)
        for need, field, bits, _ in _NEEDS
        if not (need in _KEPT and needs[field])
    }
    lean = Variant(dyn)
    reference = lean.accelerations(q, v)
    # Where nothing accelerates, what turning at v would ask for is the measure.
    scale = max(float(np.abs(reference).max(initial=0.0)), float(v @ v))
    changes = {
        need: float(np.abs(variant.accelerations(q, v) - reference).max(initial=0.0)) / scale
        for need, variant in variants.items()
    }
    times = interleaved({"lean": lean.forward} | {n: x.forward for n, x in variants.items()}, rounds=15)
    rows = []
    for need, field, _, what in _NEEDS:
        if need not in variants:
            unmeasured = (math.nan,) * 4
            rows.append(Omission(need, True, "needed, so it is on", *unmeasured, unchanged=True))
            continue
        present = bool(field) and needs[field]
        saved = times[need][0] - times["lean"][0]
        spread = math.hypot(times[need][1], times["lean"][1])
        # Dry friction that is there would act: leaving it out is a choice, said aloud.
        chosen = need == "dry friction" and present
        note = "it is off in every engine, so that the smooth terms compare" if chosen else ""
        unchanged = chosen or changes[need] <= _UNCHANGED
        rows.append(Omission(need, present, what, saved, spread, math.nan, changes[need], unchanged, note))
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
