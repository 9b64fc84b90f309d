"""What differs between versions of MuJoCo and what is global in it, in one place.

4.0 is the first whose Runge–Kutta on rotations is of fourth order, and the lower
bound. `mj_fullM` took the matrix itself before 3.10, and takes the data since.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mbkit._check import Array

__all__ = ["full_mass_matrix", "heard_warnings"]


def _leave_no_log() -> None:
    """Keep MuJoCo from writing MUJOCO_LOG.TXT into the working folder, unless somebody has named another file."""
    config = mujoco.MjLogConfig.get()
    if config.logto_file and config.logfile == "MUJOCO_LOG.TXT":
        config.logto_file = False
        config.set()


_leave_no_log()


def full_mass_matrix(model: Any, data: Any) -> Array:
    """Return the dense mass matrix of the last `mj_makeM`."""
    out = np.zeros((model.nv, model.nv))
    if model.nv:
        mujoco.mj_fullM(model, data, out)
    return out


@contextlib.contextmanager
def heard_warnings() -> Iterator[list[str]]:
    """Collect MuJoCo's warnings, instead of prints."""
    heard: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(heard.append)
    try:
        yield heard
    finally:
        mujoco.set_mju_user_warning(before)
