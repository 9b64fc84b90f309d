"""What differs between two loops or couplers: in words and numbers, and which is which.

Ends may be exchanged. Of a hinge's frames the axis counts alone, of welded ones their turn against each other, and a
slider's point may be anywhere along its axis.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np

from mbkit._check import Array
from mbkit.model.loops import CROSSED, HINGED, SLIDING, WELDED
from mbkit.model.parts import Coupler, Loop
from mbkit.studies.explain.merged_model import Tolerances, number_text
from mbkit.studies.explain.mistakes import turn_of

_OF_END: Final = ("body", "rotation", "translation")


def paired(some: Iterable[Any], left: list[Any], apart: Callable[[Any, Any], float]) -> tuple[list[Any], list[Any]]:
    """Pair parts with the nearest of `left`, which are taken out of it, and return those without a partner.

    `apart` is the distance of two, infinite where they are no pair.
    """
    waiting, pairs = list(some), []
    while near := [
        (far, i, k) for i, a in enumerate(waiting) for k, b in enumerate(left) if (far := apart(a, b)) < np.inf
    ]:
        _, i, k = min(near)
        pairs.append((waiting.pop(i), left.pop(k)))
    return pairs, waiting


def exchanged(loop: Loop) -> Loop:
    """Return a loop with its ends exchanged, which holds the same."""
    ends = {f"{name}_{side}": getattr(loop, f"{name}_{other}") for side, other in ("ab", "ba") for name in _OF_END}
    return replace(loop, **ends)


def follows(x: Coupler) -> str:
    """Return a coupler's equation."""
    terms = [f"{number_text(r)} {name}" for r, name in zip(x.ratios, x.leaders, strict=True)]
    terms += [number_text(x.offset)] if x.offset else []
    curve = f", with curve {number_text(x.curve)}" if x.curve.any() else ""
    return f"{x.joint} = {' + '.join(terms).replace('+ -', '- ')}{curve}"


def loop_differences(a: Loop, b: Loop, near: Tolerances) -> list[str]:
    """Return what `b` has otherwise than `a`, in sentences that begin with a verb; empty where they hold the same."""
    return min((list(_differences(a, x, near)) for x in (b, exchanged(b))), key=len)


def moved(a: Loop, b: Loop) -> tuple[float, float]:
    """Return by how much the ends of `b` are moved and turned against those of `a`, of one kind, in m and rad."""
    far = max(float(np.linalg.norm(x)) for x in _shifts(a, b).values())
    return far, _turn(a, b) if a.kind in WELDED else 0.0


def _differences(a: Loop, b: Loop, near: Tolerances) -> Iterator[str]:
    if a.kind != b.kind:
        yield f"closes it as {b.kind} for {a.kind}"
    shifts = _shifts(a, b)
    for side in "ab":
        body, own = getattr(b, f"body_{side}"), getattr(a, f"body_{side}")
        if body != own:
            yield f"ends it on {body!r} for {own!r}"
        elif not near.point(shifts[side], np.zeros(3)):
            there, own_place = (number_text(getattr(x, f"translation_{side}")) for x in (b, a))
            away = f"{np.linalg.norm(shifts[side]):.6g} m away, at {there} for {own_place}"
            yield f"has its point on {body!r} {away}"
    if not near.number(a.length, b.length):
        yield f"has a length of {b.length:.6g} m for {a.length:.6g} m"
    if a.kind == b.kind and (a.body_a, a.body_b) == (b.body_a, b.body_b):
        yield from _turned(a, b, near)


def _shifts(a: Loop, b: Loop) -> dict[str, Array]:
    """Return how far each end's point is moved, less what both ends may move together without a change."""
    out = {side: getattr(b, f"translation_{side}") - getattr(a, f"translation_{side}") for side in "ab"}
    axes = {side: getattr(a, f"rotation_{side}")[:, 2] for side in "ab"}
    if a.kind == b.kind == WELDED[0]:
        # Any point of two bodies that are welded may be called theirs.
        return {"a": out["a"] - b.rotation_a @ b.rotation_b.T @ out["b"], "b": np.zeros(3)}
    if a.kind == b.kind and a.kind in (*SLIDING, HINGED[0]):
        # A slider's ends move along the axis each by itself, a hinge's together.
        along = {side: axes[side] @ out[side] for side in "ab"}
        along["b"] = along["b"] if a.kind in SLIDING else along["a"]
        return {side: x - axes[side] * along[side] for side, x in out.items()}
    return out


def _turn(a: Loop, b: Loop) -> float:
    return float(np.linalg.norm(turn_of((a.rotation_a @ a.rotation_b.T).T @ b.rotation_a @ b.rotation_b.T)))


def _turned(a: Loop, b: Loop, near: Tolerances) -> Iterator[str]:
    if a.kind in WELDED and _turn(a, b) > near.relative:
        yield f"turns its ends by {_degrees(_turn(a, b))} against each other"
    if a.kind not in (*HINGED, *SLIDING, CROSSED):
        return
    own, other = ([getattr(x, f"rotation_{side}")[:, 2] for side in "ab"] for x in (a, b))
    # An axis has no direction; of a hinge's two both turn round together, of a cross each by itself.
    signs = [np.sign(x @ y) or 1.0 for x, y in zip(own, other, strict=True)]
    if a.kind in HINGED:
        signs = [signs[0], signs[0]]
    for side, x, y, sign in zip("ab", own, other, signs, strict=True):
        if not near.vector(x, sign * y):
            angle = np.arccos(np.clip(abs(x @ y), 0.0, 1.0))
            yield f"has its axis on {getattr(a, f'body_{side}')!r} turned by {_degrees(angle)}"


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.4g}°"
