"""Where engines and methods break: sweeps of one number over decades, each run in a process of its own."""

from mbkit._imports import make_callable
from mbkit.studies.measurement import Measurement, Problem, Truth
from mbkit.studies.stress.case import Case
from mbkit.studies.stress.measurements import Breaking, CaseResult, Row
from mbkit.studies.stress.result import SilentFailure, StressResult
from mbkit.studies.stress.study import stress

__all__ = [
    "Breaking",
    "Case",
    "CaseResult",
    "Measurement",
    "Problem",
    "Row",
    "SilentFailure",
    "StressResult",
    "Truth",
    "stress",
]

make_callable(__name__, stress)
