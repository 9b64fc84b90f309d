"""The engines by name, and the registry for engines of one's own."""

from __future__ import annotations

import importlib
import inspect
import pickle
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from functools import cache
from importlib.metadata import entry_points
from typing import Any, Final

from mbkit.engines.base import Dynamics
from mbkit.engines.frames_and_momenta import Composed
from mbkit.engines.remote.packages import EngineVersion, names_version, remote_engines
from mbkit.engines.remote.packages import engine as named_version
from mbkit.errors import InputError, UnknownNameError, UnsupportedError
from mbkit.model import Model
from mbkit.model.builder import expect_model
from mbkit.model.quantities import QUANTITIES

#: Group of the entry points that name an `EngineInfo`, or a module that calls `register_engine`.
ENTRY_POINTS: Final = "mbkit.engines"


@dataclass(frozen=True)
class EngineInfo:
    """What mbkit knows of an engine before it is imported.

    Attributes
    ----------
    name : str
        As in ``mbkit.dynamics(model, name)``, in tables and in figures.
    adapter : type
        The subclass of `Dynamics`, whose attribute ``engine`` is the name; or None where `module` and `class_name` say
        where it is: the engine is imported at its first use.
    module, class_name : str
    package : str
        To install, with pip.
    distribution : str
        Whose version decides the engine's numbers, for `importlib.metadata`; empty of an engine without a library.
    standard : bool
        Whether studies take it where no engines are named.
    reference : bool
        Whether others are measured by it; it cannot be compared then.
    derived : bool
        Whether it evaluates mbkit's own derivation in double precision.
    brief : mapping
        Options for a few evaluations.
    rk4 : str
        The engine's own Runge–Kutta method of fourth order, or mbkit's.
    shown, quick : tuple of str
        Methods that `mbkit.compare` and a quick `mbkit.stress` run on it.
    """

    name: str
    adapter: type[Dynamics] | None = None
    module: str = ""
    class_name: str = ""
    package: str = ""
    distribution: str = ""
    standard: bool = False
    reference: bool = False
    derived: bool = False
    brief: Mapping[str, Any] = field(default_factory=dict)
    rk4: str = "rk4"
    shown: tuple[str, ...] = ("rk4",)
    quick: tuple[str, ...] = ("auto", "rk4")

    @property
    def built_in(self) -> bool:
        """Whether the adapter is mbkit's own."""
        return self.name in _OWN

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process may not have registered the engine.
        return _registered, tuple(getattr(self, f.name) for f in fields(self))

    def load(self) -> type[Dynamics]:
        """Return the adapter.

        Raises
        ------
        UnsupportedError
            The engine is not installed; with the package to install.
        """
        if self.adapter is not None:
            return self.adapter
        try:
            adapter: type[Dynamics] = getattr(importlib.import_module(self.module), self.class_name)
        except ModuleNotFoundError as error:
            if error.name and error.name.startswith("mbkit"):
                raise
            raise UnsupportedError(f"{self.name} is not installed ({error}); pip install {self.package}") from error
        return adapter


#: The engines that a study of one engine's own features names.
PINOCCHIO: Final = "pinocchio"
MUJOCO: Final = "mujoco"


def _own(name: str, class_name: str, distribution: str, package: str = "", **facts: Any) -> EngineInfo:
    folder = f"mbkit.engines.{name}"
    module = folder if facts.get("derived") or facts.get("reference") else f"{folder}.engine"
    return EngineInfo(name, None, module, class_name, package or distribution, distribution, **facts)


_OWN_ENGINES: Final = (
    _own(
        PINOCCHIO,
        "PinocchioDynamics",
        "pin",
        standard=True,
        shown=("rk4", "semi_implicit_euler", "dop853"),
        quick=("auto", "rk4", "semi_implicit_euler", "radau"),
    ),
    # Where nothing is compiled, CasADi evaluates the expressions.
    _own(
        "lagrangian",
        "LagrangianDynamics",
        "casadi",
        standard=True,
        derived=True,
        brief={"compile": False},
        shown=("rk853", "rk4"),
        quick=("auto", "rk4", "implicit_midpoint", "rk853", "rodas5"),
    ),
    _own(
        MUJOCO,
        "MujocoDynamics",
        "mujoco",
        standard=True,
        rk4="mujoco_rk4",
        shown=("mujoco_euler", "mujoco_implicitfast", "mujoco_rk4"),
        quick=("mujoco_rk4", "mujoco_euler", "mujoco_implicitfast", "mujoco_discrete"),
    ),
    _own("drake", "DrakeDynamics", "drake", "mbkit[drake]", shown=(), quick=()),
    _own("oracle", "OracleDynamics", "mpmath", reference=True, shown=(), quick=()),
)
#: Engine by name: mbkit's own adapters, then those of `register_engine`.
ENGINES: Final[dict[str, EngineInfo]] = {info.name: info for info in _OWN_ENGINES}
_OWN: Final = frozenset(ENGINES)

#: Engines that a study takes where none are named.
STANDARD: Final = tuple(info.name for info in ENGINES.values() if info.standard)
#: mbkit's own derivation, and what others are measured by.
(DERIVED,) = (info.name for info in ENGINES.values() if info.derived)
(REFERENCE,) = (info.name for info in ENGINES.values() if info.reference)
#: The standard engines that do not evaluate mbkit's own derivation.
INDEPENDENT: Final = tuple(info.name for info in ENGINES.values() if info.standard and not info.derived)


def register_engine(info: EngineInfo) -> EngineInfo:
    """Make an engine known, so that `mbkit.dynamics`, simulation, studies, tests and reports take its name.

    The command and worker processes import nothing of a script: they know engines whose package names them in the
    entry point group ``"mbkit.engines"``, by an `EngineInfo` or by a module that calls this function.

    Returns `info`. Raises `InputError` for attributes of a wrong type, an adapter that is no subclass of `Dynamics` or
    names another engine, or a name that another engine has.

    Examples
    --------
    >>> from mbkit.engines import EngineInfo, register_engine
    >>> from mbkit.engines.lagrangian import LagrangianDynamics
    >>> class Mine(LagrangianDynamics):
    ...     engine = "doc_engine"
    >>> register_engine(EngineInfo("doc_engine", Mine)).name
    'doc_engine'
    >>> _ = ENGINES.pop("doc_engine")  # a script keeps it
    """
    if not isinstance(info, EngineInfo):
        raise InputError(f"info: expected an EngineInfo, got {type(info).__name__}")
    name, adapter = info.name, info.adapter
    if not isinstance(name, str) or not name.isidentifier():
        raise InputError(f"name: expected a word of letters, digits and underscores, got {name!r}")
    if adapter is None and not (info.module and info.class_name):
        raise InputError(f"engine {name!r}: expected an adapter, or a module and a class_name; got none")
    if adapter is not None:
        if not isinstance(adapter, type) or not issubclass(adapter, Dynamics):
            raise InputError(f"engine {name!r}: expected a subclass of Dynamics as adapter, got {adapter!r}")
        if getattr(adapter, "engine", None) != name:
            got = getattr(adapter, "engine", None)
            raise InputError(f"engine {name!r}: {adapter.__name__}.engine is {got!r}; expected the same name")
    known = ENGINES.get(name)
    if name in _OWN or (known is not None and _place(known) != _place(info)):
        raise InputError(f"engine {name!r}: the name is in use; choose another one")
    if info.reference or info.derived:
        raise InputError(f"engine {name!r}: reference and derived are for mbkit's own derivation; leave them False")
    ENGINES[name] = info
    return info


def registered_engines() -> tuple[EngineInfo, ...]:
    """Return the engines of one's own that another process can import; unpickling registers them there."""
    out = []
    for info in ENGINES.values():
        if not info.built_in:
            with suppress(Exception):  # pickle raises errors of several kinds
                pickle.dumps(info)
                out.append(info)
    return tuple(out)


def composes(adapter: type[Dynamics], quantity: str) -> bool:
    """Return whether an engine's adapter takes a quantity from a formula of the protocol, of its other quantities.

    `quantity` is the name of a method that the adapter has, or of inverse or forward dynamics ``"..._with_wrenches"``.
    """
    if quantity in QUANTITIES and QUANTITIES[quantity].follows:
        return True
    if quantity.removesuffix("_with_wrenches") in adapter._takes_wrenches:
        return False
    return next(x for x in adapter.__mro__ if f"_{quantity}" in vars(x)) in (Composed, *Dynamics.__mro__)


def _place(info: EngineInfo) -> tuple[str, str]:
    """Return where the adapter is defined; a cell of a notebook that runs again defines it again."""
    adapter = info.adapter
    return (info.module, info.class_name) if adapter is None else (adapter.__module__, adapter.__qualname__)


def _registered(name: str, *values: Any) -> EngineInfo:
    return ENGINES[name] if name in ENGINES else register_engine(EngineInfo(name, *values))


@cache
def load_entry_points() -> None:
    """Register the engines that installed packages name, once."""
    for point in entry_points(group=ENTRY_POINTS):
        loaded = point.load()
        if isinstance(loaded, EngineInfo) and loaded.name not in ENGINES:
            register_engine(loaded)


def find_engine(name: str) -> EngineInfo:
    """Return an engine's `EngineInfo`, of another version too; `UnknownNameError` for an unknown name."""
    _load_unknown(name)
    if names_version(name):
        own = "mbkit.engines.remote.dynamics", "VersionDynamics"
        return EngineInfo(named_version(name).name, None, *own, shown=())
    if name not in ENGINES:
        raise UnknownNameError("engine", str(name), (*ENGINES, *remote_engines()))
    return ENGINES[name]


def _load_unknown(name: object) -> None:
    """Register the engines that installed packages name, where a name is not known yet."""
    if name not in ENGINES and not names_version(name):
        load_entry_points()


def compared() -> tuple[str, ...]:
    """Return the engines that can be compared and measured: all but the reference."""
    load_entry_points()
    return tuple(info.name for info in ENGINES.values() if not info.reference)


def dynamics(model: Model, engine: str | EngineVersion = PINOCCHIO, **options: Any) -> Dynamics:
    """Return the model's dynamics as one engine computes them.

    Parameters
    ----------
    model : Model
    engine : {"pinocchio", "lagrangian", "mujoco", "drake", "oracle"}
        Rigid-body algorithms of Pinocchio, mbkit's own derivation from energies,
        MuJoCo, Drake (``pip install mbkit[drake]``), or the own derivation at 34 digits, for
        measuring the others; or an engine of `register_engine`; or one in an environment of its own, from
        `mbkit.engine` or by its name: another version, such as ``"mujoco==3.12.0"``, or ``"newton"``,
        ``"mujoco-warp"``, ``"mjx"`` and ``"mjx-single"``.
    **options
        The lagrangian engine's ``compile=`` (True or False), ``threads=`` and ``device=`` ("cuda" for batches on an
        NVIDIA GPU); MuJoCo's ``solref=`` and ``solimp=`` of the soft constraints that hold loops, its
        ``soft_friction=True``, and ``limits="soft"`` with ``limit_solref=`` for joint limits of its own; Drake's
        ``limits="soft"``; other engines have none.

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
    if isinstance(engine, str):
        _load_unknown(engine)
    if isinstance(engine, str) and names_version(engine):
        engine = named_version(engine)
    if isinstance(engine, EngineVersion):
        # The import is for few.
        from mbkit.engines.remote.dynamics import VersionDynamics

        if options:
            raise InputError(f"{', '.join(options)}: {engine} has no options")
        return VersionDynamics(model, engine)
    if not isinstance(engine, str):
        raise UnknownNameError("engine", str(engine), ENGINES)
    adapter = find_engine(engine).load()
    known = [name for name in inspect.signature(adapter).parameters if name != "model"]
    for name in options:
        if name not in known:
            takes = f"it takes {', '.join(known)}" if known else "it takes none"
            raise InputError(f"{name}: {engine} has no such option; {takes}")
    return adapter(model, **options)
