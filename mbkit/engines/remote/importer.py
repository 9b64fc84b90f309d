"""What an engine in an environment of its own reads from a file by its own importer, described as it is."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from functools import partial
from types import SimpleNamespace
from typing import Any, Final, NamedTuple

import numpy as np

from mbkit._check import Array
from mbkit.engines.imported import Imported, Parts, checked, written
from mbkit.engines.remote.dynamics import VersionDynamics
from mbkit.engines.remote.packages import PACKAGES, EngineVersion
from mbkit.engines.remote.process import Answer, Held
from mbkit.model import Coupler, Model

#: The file in `remote` of engines that take MuJoCo's model.
_MUJOCO: Final = "mujoco_importer"


def importers() -> tuple[str, ...]:
    """Return the engines whose importers are judged in an environment of their own."""
    return tuple(name for name, package in PACKAGES.items() if package.importer)


def read(version: EngineVersion, text: str, format_: str, floating_base: bool, files: Mapping[str, bytes]) -> Imported:
    """Return an importer's reading of a text; an MJCF says by itself that its base floats.

    Raises `UnsupportedError` where it refuses the text, and `EngineProcessError` where it ends its process or takes
    longer than `version.seconds`.
    """
    file = _File(text, format_, floating_base, files)
    if version.package.importer == _MUJOCO:
        return _OfMujoco(version, file, changes={}).imported()
    return _Read(version, file).imported()


class _File(NamedTuple):
    text: str
    format: str
    floating_base: bool
    files: Mapping[str, bytes]

    def read(self, module: str, more: Mapping[str, Any], ask: Callable[..., Answer]) -> dict[str, Any]:
        """Return what a module of the process says of it."""
        with written(self.text, self.files) as path:
            file = {"path": str(path), "format_": self.format, "floating": self.floating_base}
            return ask("import", module=module, **file, **more)[0]


class _Read(VersionDynamics):
    """An engine on its own reading of a file."""

    def __init__(self, version: EngineVersion, file: _File, **more: Any) -> None:
        self._file, self._more = file, more
        held = Held(version, partial(file.read, version.package.importer, more))
        self.said = held.head
        super().__init__(checked(version.name, self._described(version.engine)), version, held)

    def _described(self, engine: str) -> Model:
        return _model(engine, self.said)

    def imported(self) -> Imported:
        """Return the reading."""
        said = self.said
        notes = [*said["notes"]]
        if said["loops"]:
            notes.append(f"joints that close a loop, in none of the terms: {', '.join(said['loops'])}")
        held = tuple(Coupler(*x) for x in said["mimics"])
        return Imported(self.model, self.terms, tuple(notes), (), held, holds_mimics=said["holds"] * bool(held))

    def terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        """Return M, g, nle and passive at a batch of states, without some of what acts beside bodies and joints."""
        if without:
            return self._less(without).terms(q, v)
        out = {"M": self._mass_matrix(q), "g": self._gravity(q), "nle": self._nle(q, v), "passive": self._passive(q, v)}
        return {name: np.asarray(x, float) for name, x in out.items()}

    def _less(self, without: tuple[str, ...]) -> _Read:
        raise NotImplementedError


class _OfMujoco(_Read):
    """The same of MuJoCo's model as `put_model` holds it; `changes` are numbers to set in the model before."""

    def _described(self, engine: str) -> Model:
        # The import loads MuJoCo.
        from mbkit.engines.mujoco import importer

        self._held_model = _HeldModel(self.said)
        self._reading = importer.Described(engine, self._held_model)
        return self._reading.model

    def imported(self) -> Imported:
        return self._reading.imported(self.terms, self.said["notes"])

    def _less(self, without: tuple[str, ...]) -> _Read:
        m = copy.deepcopy(self._held_model)
        for key in without:
            self._reading.removals[key](m)
        before = vars(self._held_model)
        changes = {k: x.tolist() for k, x in vars(m).items() if isinstance(x, np.ndarray) and (x != before[k]).any()}
        was = vars(self._held_model.opt)
        changes |= {k: x for k, x in vars(m.opt).items() if np.any(np.asarray(x) != was[k])}
        return type(self)(self.version, self._file, changes={**self._more["changes"], **changes})


class _HeldModel:
    """The numbers and names of a compiled model, as `mujoco.MjModel` has them."""

    def __init__(self, said: Mapping[str, Any]) -> None:
        vars(self).update({name: np.array(x) if isinstance(x, list) else x for name, x in said["fields"].items()})
        self.opt = SimpleNamespace(**{k: np.array(x) if isinstance(x, list) else x for k, x in said["opt"].items()})
        for kind, names in said["labels"].items():
            setattr(self, kind, [SimpleNamespace(name=x) for x in names].__getitem__)


def _model(name: str, said: Mapping[str, Any]) -> Model:
    """Return the description that an importer's file in `remote` sent as plain data."""
    parts = Parts()
    for body, mass, com, inertia in said["bodies"]:
        parts.body(body, mass, np.array(com), np.array(inertia))
    for (joint, kind, parent, child, R, p), numbers in said["joints"]:
        values = {name: np.array(x) for name, x in numbers.items()}
        if kind == "revolute" and np.isinf(values["lower"]).all() and np.isinf(values["upper"]).all():
            kind = "continuous"
        parts.joint(joint, kind, parent, child, np.array(R), np.array(p), **values)
    return parts.model(name, np.array(said["gravity"]))
