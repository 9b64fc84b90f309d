"""Where engines and methods break: sweeps of one number over decades, each run in a process of its own."""

from mbkit._callable import make_callable
from mbkit.studies.stress.case import Case, Problem, Truth
from mbkit.studies.stress.measurements import BreakingPoint, CaseResult, Measurement, Row
from mbkit.studies.stress.measurements import BreakingPoint as Break
from mbkit.studies.stress.measurements import Measurement as Cell
from mbkit.studies.stress.result import Breaking, SilentFailure, StressResult
from mbkit.studies.stress.result import SilentFailure as Silent
from mbkit.studies.stress.study import stress

__all__ = [
    "Break",
    "Breaking",
    "BreakingPoint",
    "Case",
    "CaseResult",
    "Cell",
    "Measurement",
    "Problem",
    "Row",
    "Silent",
    "SilentFailure",
    "StressResult",
    "Truth",
    "stress",
]

make_callable(__name__, stress)
