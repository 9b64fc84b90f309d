"""Options that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import click

from mbkit.errors import InputError, UnknownNameError

__all__ = ["check_engines", "in_options", "load_options", "model_options", "split"]

# Keyword arguments of `mbkit.load` that messages name, as options of the command line.
_OPTIONS: Final = {
    'nonphysical="warn"': "--nonphysical warn",
    "mimic='free'": "--mimic free",
    "floating_base=True": "--floating-base",
}


def split(_ctx: click.Context, _parameter: click.Parameter, value: str) -> tuple[str, ...]:
    """Return names that a comma parts."""
    return tuple(name.strip() for name in value.split(",") if name.strip())


def model_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add the options that say how a file or robot is read; `load_options` gathers them."""
    for option in (
        click.option(
            "--nonphysical", type=click.Choice(["error", "warn"]), help="Refuse impossible bodies, or take them."
        ),
        click.option(
            "--mimic", type=click.Choice(["reduce", "free"]), help="What mimic joints become.  [default: reduce]"
        ),
        click.option("--floating-base", is_flag=True, help="Let the base of a file or robot move freely."),
    ):
        command = option(command)
    return command


def load_options(floating_base: bool, mimic: str | None, nonphysical: str | None) -> dict[str, Any]:
    """Return what was asked for as keyword arguments of `mbkit.load`."""
    asked = {"floating_base": floating_base or None, "mimic": mimic, "nonphysical": nonphysical}
    return {k: v for k, v in asked.items() if v is not None}


def in_options(message: str) -> str:
    """Return a message of `mbkit.load` in the words of the command line."""
    for keyword, option in _OPTIONS.items():
        message = message.replace(keyword, option)
    return message


def check_engines(names: tuple[str, ...], least: int) -> None:
    """Raise for names that are no engine's, before anything is read, loaded or computed."""
    from mbkit.engines import ENGINES

    comparable = [name for name in ENGINES if name != "oracle"]
    for name in names:
        if name == "oracle":
            raise InputError("--engines: the oracle is what every engine is measured by; leave it out")
        if name not in comparable:
            raise UnknownNameError("engine", name, comparable)
    if len(set(names)) < least:
        told, count = ", ".join(comparable), {1: "one", 2: "two"}.get(least, str(least))
        raise InputError(f"--engines: expected at least {count} of {told}, got {', '.join(names) or 'none'}")
