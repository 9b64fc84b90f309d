"""Where engines and methods break: sweeps of one number over decades, each run in a process of its own."""

from mbkit._callable import make_callable
from mbkit.studies.stress.case import Case, Problem, Truth
from mbkit.studies.stress.result import Break, Breaking, CaseResult, Cell, Row, Silent, StressResult
from mbkit.studies.stress.study import stress

__all__ = [
    "Break",
    "Breaking",
    "Case",
    "CaseResult",
    "Cell",
    "Problem",
    "Row",
    "Silent",
    "StressResult",
    "Truth",
    "stress",
]

make_callable(__name__, stress)
