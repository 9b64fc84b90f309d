"""A file as an engine's own parser in another version reads it: terms of the tree, joint by joint by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mbkit._check import Array
from mbkit.engines.remote.packages import EngineVersion
from mbkit.engines.remote.process import Held, RemoteError
from mbkit.errors import UnsupportedError
from mbkit.model import Model

#: The file beside an engine that reads a text.
SERVED = Path(__file__).with_name("served_parsers.py")


class OwnParser:
    """What a version of an engine makes of a text, in the coordinates of a description of the same file.

    Parameters
    ----------
    version : EngineVersion
    text : str
        URDF or MJCF, without references to other files.
    format_ : {"urdf", "mjcf"}
    model : Model
        The description, whose joints have one coordinate each and are found by name.

    Raises
    ------
    UnsupportedError
        The parser refuses the text, or reads other joints.
    """

    def __init__(self, version: EngineVersion, text: str, format_: str, model: Model) -> None:
        file = {"module": str(SERVED), "text": text, "format_": format_}
        self.version, self._held = version, Held(version, lambda ask: ask("import", **file)[0])
        joints = self._held.head["joints"]
        moving = [j for j in model.layout.joints if j.type.nv]
        if any(j.type.nv > 1 for j in moving):
            raise UnsupportedError(f"{version}: a file is compared where each joint has one coordinate")
        missing = [j.name for j in moving if j.name not in joints]
        size = sum(len(v) for _, v in joints.values())
        if missing or size != len(moving):
            lost = f"; without {', '.join(map(repr, missing[:3]))}" if missing else ""
            raise UnsupportedError(f"{version}: reads {size} velocities where the file has {len(moving)}{lost}")
        self._at_q = [joints[j.name][0] for j in moving]
        self._at_v = np.array([joints[j.name][1][0] for j in moving], int)
        self._nq = sum(len(q) for q, _ in joints.values())

    def term(self, quantity: str, q: Array, v: Array) -> Array:
        """Return the mass matrix, gravity or nle at a batch of states."""
        out = []
        for one, rate in zip(q, v, strict=True):
            x, u = np.empty(self._nq), np.empty(len(rate))
            for at, angle in zip(self._at_q, one, strict=True):
                # A continuous joint may be a cosine and a sine.
                x[at] = angle if len(at) == 1 else (np.cos(angle), np.sin(angle))
            u[self._at_v] = rate
            try:
                value = self._held.ask(quantity, x, *([u] if quantity == "nle" else []))[0]
            except RemoteError as error:
                raise UnsupportedError(f"{self.version}: {error}") from None
            own = value[np.ix_(self._at_v, self._at_v)] if value.ndim == 2 else value[self._at_v]
            out.append(own)
        return np.array(out)
