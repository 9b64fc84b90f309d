"""Baselines: what engines said of a robot, kept in a file, and held against it later.

`record` writes, `check` holds a model and the installed engines against it, `bisect` finds where a failure began, and
`diff` reads two.
"""

from mbkit.studies.baseline.bisection import bisect
from mbkit.studies.baseline.description import Change
from mbkit.studies.baseline.file import Baseline, read
from mbkit.studies.baseline.result import BaselineResult, BisectResult, ChangedNumber, Examined, Onset, VersionChange
from mbkit.studies.baseline.study import check, diff, record

#: An earlier name, kept for scripts.
Moved = ChangedNumber

__all__ = [
    "Baseline",
    "BaselineResult",
    "BisectResult",
    "Change",
    "ChangedNumber",
    "Examined",
    "Moved",
    "Onset",
    "VersionChange",
    "bisect",
    "check",
    "diff",
    "read",
    "record",
]
