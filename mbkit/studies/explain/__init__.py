"""Why two descriptions, importers or engines differ."""

from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.study import explain

__all__ = ["Cause", "Explanation", "explain"]
