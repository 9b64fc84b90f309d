"""Identification: inertial parameters from measured motions, and motions that show them."""

from mbkit._imports import make_callable
from mbkit.identify.fourier_series import Excitation, excitation
from mbkit.identify.measurements import FilteredMotion, filtered_motion
from mbkit.identify.result import Identification, IdentifiedParameter, Residual, Undetermined
from mbkit.identify.study import identify

__all__ = [
    "Excitation",
    "FilteredMotion",
    "Identification",
    "IdentifiedParameter",
    "Residual",
    "Undetermined",
    "excitation",
    "filtered_motion",
    "identify",
]

make_callable(__name__, identify)
