"""Why two descriptions, importers or engines differ."""

from mbkit.methods.simulation_settings import Servo, Settings
from mbkit.studies.explain.controlled_runs import Motion
from mbkit.studies.explain.motion_result import CauseMotion, MotionComparison, RecordComparison
from mbkit.studies.explain.records import record_of
from mbkit.studies.explain.result import Cause, Explanation
from mbkit.studies.explain.study import explain
from mbkit.studies.explain.worlds import file_settings

__all__ = [
    "Cause",
    "CauseMotion",
    "Explanation",
    "Motion",
    "MotionComparison",
    "RecordComparison",
    "Servo",
    "Settings",
    "explain",
    "file_settings",
    "record_of",
]
