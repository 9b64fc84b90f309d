"""Which methods are asked of which engines."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from mbkit.engines import ENGINES
from mbkit.engines.oracle import OracleDynamics
from mbkit.errors import InputError, UnknownNameError
from mbkit.simulate.methods import METHODS, method_of

__all__ = ["MEASURED", "names_of", "pairs"]

#: Engines that can be measured.
MEASURED: Final = tuple(name for name in ENGINES if name != OracleDynamics.engine)


def pairs(
    engines: Sequence[str], methods: Sequence[str] | Mapping[str, Sequence[str]] | None
) -> dict[str, tuple[str, ...]]:
    """Return the methods of each engine, checked.

    Parameters
    ----------
    engines : sequence of str
    methods : sequence of str, or mapping of str to sequence of str, or None
        For all engines that have them, or for each; None for all methods.

    Raises
    ------
    InputError, UnknownNameError
        What no engine is, or no method of it.
    """
    names = names_of("engines", engines)
    for name in names:
        if name == OracleDynamics.engine:
            raise InputError("engines: the oracle is what the others are measured by; leave it out")
        if name not in MEASURED:
            raise UnknownNameError("engine", name, MEASURED)
    if isinstance(methods, Mapping):
        for engine in methods:
            if engine not in names:
                raise InputError(f"methods: {engine!r} is not among the engines {list(names)}")
        asked = {engine: names_of(f"methods[{engine!r}]", methods[engine]) for engine in names if engine in methods}
        if not asked:
            raise InputError("methods: expected the methods of at least one engine, got none")
        for engine, own in asked.items():
            for method in map(method_of, own):
                if method.engines and engine not in method.engines:
                    raise InputError(
                        f"methods[{engine!r}]: {method.name} is not on {engine}; it is on {', '.join(method.engines)}"
                    )
    else:
        given = tuple(METHODS) if methods is None else names_of("methods", methods)
        asked = dict.fromkeys(names, given)
    out = {e: tuple(m for m in ms if not method_of(m).engines or e in METHODS[m].engines) for e, ms in asked.items()}
    # A method that none of the engines has was asked for in error.
    for name in dict.fromkeys(m for ms in asked.values() for m in ms):
        if methods is not None and not any(name in ms for ms in out.values()):
            raise InputError(
                f"methods: {name} is not on {' or '.join(asked)}; it is on {', '.join(METHODS[name].engines)}"
            )
    return out


def names_of(what: str, given: object) -> tuple[str, ...]:
    """Return names as a tuple, each once; `what` they are is for the message."""
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"{what}: expected several names, got {given!r}; write ({given!r},)")
    names = tuple(dict.fromkeys(given))
    if not names:
        raise InputError(f"{what}: expected at least one name, got none")
    for name in names:
        if not isinstance(name, str):
            raise InputError(f"{what}: expected names, got {name!r}")
    return names
