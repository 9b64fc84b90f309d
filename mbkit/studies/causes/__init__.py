"""Why two descriptions, importers or engines differ."""

from mbkit.studies.causes.explaining import explain
from mbkit.studies.causes.result import Cause, Explanation

__all__ = ["Cause", "Explanation", "explain"]
