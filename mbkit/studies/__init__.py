"""Questions asked of several engines at once."""

from mbkit.studies.compare import compare
from mbkit.studies.result import Comparison, CostPoint, Omission, Refusal, RolloutRow, Row

__all__ = ["Comparison", "CostPoint", "Omission", "Refusal", "RolloutRow", "Row", "compare"]
