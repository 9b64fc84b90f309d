"""Baselines: what engines said of a robot, kept in a file, and held against it later.

`record` writes, `check` holds a model and the engines against it, and `diff` reads two.
"""

from mbkit.studies.baseline.description import Change
from mbkit.studies.baseline.file import Baseline, read
from mbkit.studies.baseline.result import BaselineResult, ChangedNumber, VersionChange
from mbkit.studies.baseline.study import check, diff, record

__all__ = [
    "Baseline",
    "BaselineResult",
    "Change",
    "ChangedNumber",
    "VersionChange",
    "check",
    "diff",
    "read",
    "record",
]
