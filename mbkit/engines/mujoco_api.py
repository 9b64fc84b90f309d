"""The differences between MuJoCo versions, detected once."""

from __future__ import annotations

from typing import Any, Final

import mujoco
import numpy as np

from mbkit._check import Array

__all__ = ["full_mass_matrix", "make_mass_matrix"]

# 3.10 put the data in front of the destination; before, the matrix itself was given.
_FULL_TAKES_DATA: Final = "d: mujoco._structs.MjData" in (mujoco.mj_fullM.__doc__ or "")

# 4.0 made one entry that also sums tendon armature; before, it was mj_crb.
make_mass_matrix: Final[Any] = getattr(mujoco, "mj_makeM", None) or mujoco.mj_crb


def full_mass_matrix(model: Any, data: Any) -> Array:
    """Return the dense mass matrix of the last `make_mass_matrix`."""
    out = np.zeros((model.nv, model.nv))
    if not model.nv:
        return out
    if _FULL_TAKES_DATA:
        mujoco.mj_fullM(model, data, out)
    else:
        mujoco.mj_fullM(model, out, data.qM)
    return out
