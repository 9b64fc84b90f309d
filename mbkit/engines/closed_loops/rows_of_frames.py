"""Quantities of constraints whose rows are formed in numbers, from the motion of frames."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING

import numpy as np

from mbkit._check import Array
from mbkit.model import Model

if TYPE_CHECKING:
    from mbkit.derivation.constraints import RowChoice
    from mbkit.engines.closed_loops.frame_rows import Rows


class RowsOfFrames:
    """What the protocol asks of rows, for an engine whose rows come from `frame_rows`."""

    model: Model
    _row_choice: RowChoice

    @abstractmethod
    def _every_row(self, q: Array, v: Array) -> Rows:
        """Return all rows at one state, those that say nothing among them."""

    def _rows(self, q: Array, v: Array | None = None) -> Rows:
        return self._every_row(q, np.zeros(self.model.nv) if v is None else v)[list(self._row_choice.kept)]

    def _every_jacobian(self, q: Array) -> Array:
        return self._every_row(q, np.zeros(self.model.nv)).J

    def _constraint_residual(self, q: Array) -> Array:
        return self._rows(q).f[: self._row_choice.positions]

    def _constraint_jacobian(self, q: Array) -> Array:
        return self._rows(q).J

    def _constraint_rate(self, q: Array, v: Array) -> Array:
        return self._rows(q, v).rate

    def _constraint_bias(self, q: Array, v: Array) -> Array:
        return self._rows(q, v).gamma
