"""Studies of several engines: compare, stress, work-precision, baselines, explain."""

from mbkit.studies import stress
from mbkit.studies.compare.result import Comparison
from mbkit.studies.compare.study import compare
from mbkit.studies.compare.terms import Finding, Omission, RolloutRow, Row
from mbkit.studies.reference_motions import Reference
from mbkit.studies.results import Refusal
from mbkit.studies.stress.result import StressResult
from mbkit.studies.study_runs import InterruptedSweepError
from mbkit.studies.work_precision.result import WorkPrecision
from mbkit.studies.work_precision.study import work_precision
from mbkit.studies.work_precision.sweep import Curve

__all__ = [
    "Comparison",
    "Curve",
    "Finding",
    "InterruptedSweepError",
    "Omission",
    "Reference",
    "Refusal",
    "RolloutRow",
    "Row",
    "StressResult",
    "WorkPrecision",
    "compare",
    "stress",
    "work_precision",
]
