"""A file that says the same in other words has the same dynamics, whoever reads it."""

from __future__ import annotations

import numpy as np
import pytest

import mbkit as mb
from tests.test_engine_versions import environments, present
from validation.arms import JOINTS, arms, joint, link, scales, tensor, urdf, written
from validation.own_parser import OwnParser

__all__ = ["environments"]

ENGINES = ("pinocchio", "mujoco", "drake")
ANGLES, RATES = np.random.default_rng(1).standard_normal((2, len(JOINTS)))


def terms(engine: str, name: str, elements: list[str], folder) -> dict[str, np.ndarray]:
    """Return terms of the arm as the engine's own parser reads it, in the units of the arm as written."""
    path = folder / f"{name}.urdf"
    path.write_text(urdf(name, elements), encoding="utf-8")
    model, (faster, factors) = mb.load(path), scales(name)
    order = [model.joint_names.index(x) for x in JOINTS]
    q, v = np.empty((2, 1, len(order)))
    q[0, order], v[0, order] = ANGLES, faster * RATES
    read = OwnParser(present(engine, "0"), path.read_text(encoding="utf-8"), "urdf", model)
    out = {}
    for term, factor in factors.items():
        value = read.term(term, q, v)[0] / factor
        out[term] = value[np.ix_(order, order)] if value.ndim == 2 else value[order]
    return out


def apart(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> float:
    return max(float(np.abs(one[x] - other[x]).max() / np.abs(other[x]).max()) for x in other)


@pytest.mark.thorough("mujoco", "drake")
@pytest.mark.parametrize("engine", ENGINES)
def test_every_parser_reads_all_ways_alike(engine, tmp_path):
    (first, elements), *rest = arms().items()
    plain = terms(engine, first, elements, tmp_path)
    for name, other in rest:
        assert apart(terms(engine, name, other, tmp_path), plain) < 1e-13, name


@pytest.mark.thorough("mujoco", "drake")
@pytest.mark.parametrize("engine", ENGINES)
def test_what_is_not_scaled_is_seen(engine, tmp_path):
    ways = arms()
    plain = terms(engine, "arm_as_written", ways["arm_as_written"], tmp_path)
    parent, child, xyz, *of = JOINTS["wing"]
    unscaled = joint("wing", "revolute", parent, child, xyz, *of)
    elements = [unscaled if 'name="wing"' in x else x for x in ways["arm_units_scaled"]]
    assert apart(terms(engine, "arm_units_scaled", elements, tmp_path), plain) > 1e-3
    # A tensor that is turned with no frame.
    turned = [link("side", 1.0, (-0.1, 0.0, 0.2), tensor((0.08, 0.1, 0.09, 0.01, 0.01, -0.02)))]
    elements = [*(x for x in ways["arm_as_written"] if 'name="side"' not in x), *turned]
    assert apart(terms(engine, "arm_as_written", elements, tmp_path), plain) > 1e-3


def test_mbkit_reads_all_ways_alike(tmp_path):
    assert [model.name for model in written(tmp_path)] == list(arms())
