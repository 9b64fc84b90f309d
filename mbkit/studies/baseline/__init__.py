"""Baselines: what engines said of a robot, kept in a file, and held against it later.

`record` writes, `check` holds a model and the installed engines against it, `diff` reads two.
"""

from mbkit.studies.baseline.description import Change
from mbkit.studies.baseline.file import Baseline, read
from mbkit.studies.baseline.result import BaselineResult, ChangedNumber, VersionChange
from mbkit.studies.baseline.study import check, diff, record

#: An earlier name, kept for scripts.
Moved = ChangedNumber

__all__ = [
    "Baseline",
    "BaselineResult",
    "Change",
    "ChangedNumber",
    "Moved",
    "VersionChange",
    "check",
    "diff",
    "read",
    "record",
]
