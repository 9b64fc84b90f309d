"""Equations of motion that can be trusted: one description, several engines, a judgement.

The equation, everywhere in this library::

    M(q) v̇ + C(q, v) v + g(q) = τ + τ_passive(q, v),      q̇ = D(q) v

SI units and radians; notebooks/reference/conventions.md has the conventions. Heavy parts load when they are first used.
"""

from __future__ import annotations

import importlib

from mbkit._imports import hand_down
from mbkit._version import __version__ as __version__

# The module typing is no light one, and the command listens to Ctrl-C only after this.
TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import Any

    from mbkit import catalog as catalog
    from mbkit import engines as engines
    from mbkit import errors as errors
    from mbkit import lagrangian as lagrangian
    from mbkit import model as model
    from mbkit import spatial as spatial
    from mbkit import studies as studies
    from mbkit import testing as testing
    from mbkit.engines import Dynamics as Dynamics
    from mbkit.engines import dynamics as dynamics
    from mbkit.engines import engine as engine
    from mbkit.engines.applications.impacts import Impact as Impact
    from mbkit.engines.applications.impacts import impact as impact
    from mbkit.engines.applications.operational_space import OperationalSpace as OperationalSpace
    from mbkit.engines.applications.operational_space import operational_space as operational_space
    from mbkit.engines.applications.variants import variants as variants
    from mbkit.errors import MbkitError as MbkitError
    from mbkit.identify import excitation as excitation
    from mbkit.identify import identify as identify
    from mbkit.lagrangian.statics.equilibrium import equilibrium as equilibrium
    from mbkit.lagrangian.statics.steady_motion import SteadyMotion as SteadyMotion
    from mbkit.lagrangian.statics.steady_motion import steady_motion as steady_motion
    from mbkit.load import load as load
    from mbkit.load import robots as robots
    from mbkit.model import Mimic as Mimic
    from mbkit.model import Model as Model
    from mbkit.model import ModelBuilder as ModelBuilder
    from mbkit.model import Parameter as Parameter
    from mbkit.model.changes.freeing import scale as scale
    from mbkit.model.changes.joining import join as join
    from mbkit.show import show as show
    from mbkit.simulate import Trajectory as Trajectory
    from mbkit.simulate import sensitivities as sensitivities
    from mbkit.simulate import simulate as simulate
    from mbkit.studies import baseline as baseline
    from mbkit.studies.compare.study import compare as compare
    from mbkit.studies.convert import convert as convert
    from mbkit.studies.explain import explain as explain
    from mbkit.studies.importers import compare_parsers as compare_parsers
    from mbkit.studies.lint import lint as lint
    from mbkit.studies.soft_stops import soft_stops as soft_stops
    from mbkit.studies.stress.study import stress as stress
    from mbkit.studies.work_precision.study import work_precision as work_precision


#: Names by the modules that hold them.
_NAMES = {
    "engines": "Dynamics dynamics engine",
    "engines.applications.impacts": "Impact impact",
    "engines.applications.operational_space": "OperationalSpace operational_space",
    "engines.applications.variants": "variants",
    "errors": "MbkitError",
    "identify": "excitation identify",
    "lagrangian.statics.equilibrium": "equilibrium",
    "lagrangian.statics.steady_motion": "SteadyMotion steady_motion",
    "load": "load robots",
    "model": "Mimic Model ModelBuilder Parameter",
    "model.changes.freeing": "scale",
    "model.changes.joining": "join",
    "simulate": "Trajectory sensitivities",
    "studies": "compare stress work_precision",
    "studies.convert": "convert",
    "studies.explain": "explain",
    "studies.importers": "compare_parsers",
    "studies.lint": "lint",
    "studies.soft_stops": "soft_stops",
}
_HOME = {name: f"mbkit.{module}" for module, names in _NAMES.items() for name in names.split()}
# `show` and `simulate` are called too; methods and events are in the second.
_OWN = "catalog engines errors lagrangian model show simulate spatial studies testing"
_MODULES = {name: f"mbkit.{name}" for name in _OWN.split()} | {"baseline": "mbkit.studies.baseline"}

#: Modules that rooms below use.
_HANDED_DOWN = {
    "consistent_states": "mbkit.engines.applications.random_states",
    "constraint_manifold": "mbkit.engines.constraint_manifold",
    "fixed_step": "mbkit.simulate.solvers.fixed_step",
    "formulas": "mbkit.lagrangian.formulas",
    "freeing": "mbkit.model.changes.freeing",
    "step_in_phases": "mbkit.simulate.solvers.in_phases.runs",
    "locking": "mbkit.model.changes.locking",
    "sdf": "mbkit.engines.imported",
    "segments": "mbkit.model.changes.segments",
}
hand_down(_HANDED_DOWN)

__all__ = sorted([*_HOME, *_MODULES, "__version__"])


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    if name in _MODULES:
        return importlib.import_module(_MODULES[name])
    raise AttributeError(f"module 'mbkit' has no attribute {name!r}; it has: {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
