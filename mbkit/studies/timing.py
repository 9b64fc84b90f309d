"""Timings of small calls: interleaved between engines, repeated, median and spread."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

__all__ = ["interleaved"]


def interleaved(
    calls: Mapping[str, Callable[[], Any]], *, rounds: int = 7, budget: float = 2e-4
) -> dict[str, tuple[float, float]]:
    """Return (median, half interquartile range) of each call's time in ns.

    Every round times each call once, over as many repetitions as fill `budget`
    seconds, so that a drift of the machine's speed meets all of them alike.
    """
    repetitions: dict[str, int] = {}
    for name, call in calls.items():
        call()
        start = time.perf_counter()
        call()
        once = max(time.perf_counter() - start, 1e-7)
        repetitions[name] = int(np.clip(budget / once, 1, 1000))
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            n = repetitions[name]
            start = time.perf_counter()
            for _ in range(n):
                call()
            times[name].append((time.perf_counter() - start) / n * 1e9)
    out = {}
    for name, samples in times.items():
        low, median, high = np.percentile(samples, [25, 50, 75])
        out[name] = float(median), float(high - low) / 2
    return out
