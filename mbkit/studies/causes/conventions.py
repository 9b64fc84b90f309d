"""Usual misunderstandings about how an engine is asked and how it answers.

Each is a way to ask the first engine as if it were the second: its answers are what the second
would say if the two differed in that convention alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from mbkit import spatial
from mbkit._check import Array
from mbkit.model import Model
from mbkit.studies.causes.terms import States, Values

__all__ = ["Convention", "conventions"]

_SWAPS = 400


@dataclass(frozen=True)
class Convention:
    """A misunderstanding.

    Attributes
    ----------
    kind, says : str
    ask : callable
        The states at which the first engine is asked instead.
    answer : callable
        (its values there, the states asked for) -> what the second would say.
    """

    kind: str
    says: str
    ask: Callable[[States], States]
    answer: Callable[[Values, States], Values]


def conventions(model: Model) -> Iterator[Convention]:
    """Yield the misunderstandings that this model's joints allow, the likely ones first."""
    if any(j.kind == "free" for j in model.independent_joints):
        yield from _velocity_frames(model)
    if model.quaternions:
        for back, says in (
            (1, "reads quaternions w first, which are written w last"),
            (-1, "reads quaternions w last, which are written w first"),
        ):
            yield Convention("quaternion order", says, _shuffled(model, back), _same)
    if model.gravity.any():
        yield Convention("gravity", "has the gravity forces with the other sign", lambda at: at, _with(gravity=-1.0))
        yield Convention("gravity", "leaves gravity out of nle", lambda at: at, _with(left_out=True))
    if model.needs.damping or model.needs.springs:
        yield Convention("passive forces", "has springs and dampers in nle", lambda at: at, _with(passive=-1.0))
        yield Convention("passive forces", "has passive forces with the other sign", lambda at: at, _with(signed=True))
    yield from _orders(model)


def _same(values: Values, _at: States) -> Values:
    return values


def _with(
    *, gravity: float = 1.0, left_out: bool = False, passive: float = 0.0, signed: bool = False
) -> Callable[[Values, States], Values]:
    def answer(values: Values, _at: States) -> Values:
        out = dict(values)
        if "g" in values and "nle" in values:
            out["g"] = gravity * values["g"]
            out["nle"] = values["nle"] + (gravity - 1.0 - left_out) * values["g"]
        if "passive" in values and "nle" in values:
            out["nle"] = out["nle"] + passive * values["passive"]
            out["passive"] = -values["passive"] if signed else values["passive"]
        return out

    return answer


def _shuffled(model: Model, places: int) -> Callable[[States], States]:
    def ask(at: States) -> States:
        q = at.q.copy()
        for start, _ in model.quaternions:
            q[:, start : start + 4] = np.roll(at.q[:, start : start + 4], -places, axis=1)
        return States(q, at.v)

    return ask


def _velocity_frames(model: Model) -> Iterator[Convention]:
    """Yield velocities of free joints in other axes or in the other order."""
    free = [(model.layout.q[j.name], model.layout.v[j.name]) for j in model.independent_joints if j.kind == "free"]

    def turns(at: States, *, linear: bool, angular: bool) -> Array:
        T = np.tile(np.eye(model.nv), (len(at.q), 1, 1))
        for q, v in free:
            R = np.swapaxes(spatial.matrix_from_quaternion(at.q[:, q.stop - 4 : q.stop]), 1, 2)
            if linear:
                T[:, v.start : v.start + 3, v.start : v.start + 3] = R
            if angular:
                T[:, v.start + 3 : v.stop, v.start + 3 : v.stop] = R
        return T

    def slip(v: Array) -> Array:
        """Return -ω × v in the linear rows: how a velocity that stays changes in the body's axes."""
        out = np.zeros_like(v)
        for _, part in free:
            linear, angular = v[:, part.start : part.start + 3], v[:, part.start + 3 : part.stop]
            out[:, part.start : part.start + 3] = -np.cross(angular, linear)
        return out

    def unturned(values: Values, at: States) -> Values:
        if "nle" not in values or "M" not in values:
            return values
        return values | {"nle": values["nle"] + np.einsum("nij,nj->ni", values["M"], slip(at.v))}

    says = "turns accelerations of free joints out of the world's axes without ω × v"
    yield Convention("velocity frame", says, lambda at: at, unturned)
    for which, says in (
        ({"linear": True, "angular": False}, "has the linear velocity of free joints in the world's axes"),
        ({"linear": False, "angular": True}, "has the angular velocity of free joints in the world's axes"),
        ({"linear": True, "angular": True}, "has the velocity of free joints in the world's axes"),
    ):
        for whole in (True, False):

            def ask(at: States, which: dict[str, bool] = which) -> States:
                return States(at.q, np.einsum("nij,nj->ni", turns(at, **which), at.v))

            def answer(values: Values, at: States, which: dict[str, bool] = which, whole: bool = whole) -> Values:
                T = turns(at, **which)
                out = {k: _pulled(T, x) for k, x in values.items()}
                if whole and which["linear"] and "nle" in values:
                    # v = T w, so that v̇ = T ẇ + Ṫ w: the linear part turns away under the body.
                    v = np.einsum("nij,nj->ni", T, at.v)
                    out["nle"] = out["nle"] + _pulled(T, np.einsum("nij,nj->ni", values["M"], slip(v)))
                return out

            told = says if whole else f"{says}, turned without the term of the turning axes"
            yield Convention("velocity frame", told, ask, answer)
    order = np.arange(model.nv)
    for _, v in free:
        order[v] = np.r_[v.start + 3 : v.stop, v.start : v.start + 3]
    same = np.arange(model.nq)
    yield _permuted("velocity frame", "has the angular velocity of free joints before the linear one", same, order)


def _pulled(T: Array, x: Array) -> Array:
    """Return Tᵀ x or Tᵀ x T."""
    if x.ndim == 3:
        return np.asarray(np.swapaxes(T, 1, 2) @ x @ T)
    return np.asarray(np.einsum("nji,nj->ni", T, x))


def _permuted(kind: str, says: str, q_order: np.ndarray, v_order: np.ndarray) -> Convention:
    """Return the convention in which entry i of a vector is entry ``order[i]`` of ours."""

    def ask(at: States) -> States:
        q, v = np.empty_like(at.q), np.empty_like(at.v)
        q[:, q_order], v[:, v_order] = at.q, at.v
        return States(q, v)

    def answer(values: Values, _at: States) -> Values:
        return {k: x[:, v_order][:, :, v_order] if x.ndim == 3 else x[:, v_order] for k, x in values.items()}

    return Convention(kind, says, ask, answer)


def _orders(model: Model) -> Iterator[Convention]:
    names = list(model.joint_names)
    tried = [tuple(names)]
    deep = [j.name for j in model.tree if j.name in names]
    for says, order in (
        ("has the joints in the order of their names", sorted(names)),
        ("has the joints in the order of their names", sorted(names, key=str.lower)),
        ("has the joints depth first", deep),
        ("has the joints generation by generation", _wide(model, names)),
        ("has the joints from last to first", names[::-1]),
    ):
        if tuple(order) not in tried:
            tried.append(tuple(order))
            yield _ordered(model, order, says)
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    for i, j in pairs[:_SWAPS]:
        order = list(names)
        order[i], order[j] = order[j], order[i]
        if tuple(order) not in tried:
            yield _ordered(model, order, f"has joints {names[i]!r} and {names[j]!r} in each other's place")


def _wide(model: Model, names: list[str]) -> list[str]:
    depth = {"world": 0}
    for joint in model.tree:
        depth[joint.child] = depth[joint.parent] + 1
    level = {j.name: depth[j.child] for j in model.joints}
    return sorted(names, key=level.__getitem__)


def _ordered(model: Model, order: list[str], says: str) -> Convention:
    q, v = (
        np.concatenate([np.arange(ranges[n].start, ranges[n].stop) for n in order])
        for ranges in (model.layout.q, model.layout.v)
    )
    return _permuted("joint order", says, q, v)
