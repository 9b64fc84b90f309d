"""One adapter a file behind one protocol; an engine is imported when first asked for."""

from __future__ import annotations

import importlib
import inspect
from typing import Any, Final

from mbkit.engines.base import QUANTITIES, Dynamics
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.model import Model
from mbkit.model.builder import expect_model

__all__ = ["ENGINES", "QUANTITIES", "Dynamics", "dynamics"]

#: Engine name -> (module, class, package to install).
ENGINES: Final = {
    "pinocchio": ("mbkit.engines.pinocchio.engine", "PinocchioDynamics", "pin"),
    "lagrangian": ("mbkit.engines.lagrangian", "LagrangianDynamics", "casadi"),
    "mujoco": ("mbkit.engines.mujoco.engine", "MujocoDynamics", "mujoco"),
    "drake": ("mbkit.engines.drake.engine", "DrakeDynamics", "mbkit[drake]"),
    "oracle": ("mbkit.engines.oracle", "OracleDynamics", "mpmath"),
}


def dynamics(model: Model, engine: str = "pinocchio", **options: Any) -> Dynamics:
    """Return the model's dynamics as one engine computes them.

    Parameters
    ----------
    model : Model
    engine : {"pinocchio", "lagrangian", "mujoco", "drake", "oracle"}
        Rigid-body algorithms of Pinocchio, mbkit's own derivation from energies,
        MuJoCo, Drake (``pip install mbkit[drake]``), or the own derivation at 34 digits, for
        measuring the others.

    **options
        The lagrangian engine's ``compile=`` (True or False) and ``threads=``; other
        engines have none.

    Returns
    -------
    Dynamics

    Raises
    ------
    UnknownNameError
        No engine of this name.
    UnsupportedError
        The engine is not installed, or cannot hold this model; with the reason.
    """
    expect_model(model)
    if engine not in ENGINES:
        raise UnknownNameError("engine", str(engine), ENGINES)
    module, name, package = ENGINES[engine]
    try:
        adapter = getattr(importlib.import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("mbkit"):
            raise
        raise UnsupportedError(f"{engine} is not installed ({error}); pip install {package}") from error
    known = [name for name in inspect.signature(adapter).parameters if name != "model"]
    for name in options:
        if name not in known:
            told = f"it takes {', '.join(known)}" if known else "it takes none"
            raise InputError(f"{name}: {engine} has no such option; {told}")
    made: Dynamics = adapter(model, **options)
    return made
