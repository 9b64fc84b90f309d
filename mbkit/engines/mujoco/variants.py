"""The same MuJoCo model with things switched on that mbkit leaves out, to measure them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import mujoco
import numpy as np

from mbkit._check import Array
from mbkit.engines.mujoco.engine import MujocoDynamics
from mbkit.engines.mujoco.model import build


class Variant:
    """MuJoCo with some features on.

    Parameters
    ----------
    dyn : MujocoDynamics
    enable : iterable of str
        Names of MuJoCo's disable bits to clear, such as ``"CONTACT"``.
    spheres : bool
        Whether every body carries a sphere of 1 µm at its centre of mass: a stand-in
        for its geometry that costs what geometry costs and touches nothing.
    """

    def __init__(self, dyn: MujocoDynamics, enable: Iterable[str] = (), *, spheres: bool = False) -> None:
        maps = build(dyn.model, spheres=spheres)
        self._m = maps.model
        flags = int(self._m.opt.disableflags)
        for name in enable:
            flags &= ~int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
        self._m.opt.disableflags = flags
        self._d = mujoco.MjData(self._m)
        self._index = maps.q_index, maps.v_index
        self._layout = dyn.model.layout

    def set(self, q: Array, v: Array) -> None:
        """Put a state in; the velocities' frame does not matter for what is measured."""
        self._d.qpos[:] = self._layout.expand_q(q)[self._index[0]]
        self._d.qvel[:] = self._layout.expand_v(v)[self._index[1]]

    def forward(self) -> Any:
        """Run the forward dynamics once."""
        mujoco.mj_forward(self._m, self._d)

    def accelerations(self, q: Array, v: Array) -> Array:
        """Return MuJoCo's qacc at a state."""
        self.set(q, v)
        self.forward()
        return np.array(self._d.qacc)
