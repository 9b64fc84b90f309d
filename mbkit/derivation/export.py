"""Equations of motion as plain C99 that needs neither mbkit nor CasADi."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import casadi as ca

from mbkit import _interrupt
from mbkit._version import __version__
from mbkit.derivation.c_code import c_body, places, variables
from mbkit.derivation.c_header import CFunction, header, output_names, prototype
from mbkit.derivation.equations import FUNCTIONS, equations_of
from mbkit.derivation.program import program
from mbkit.errors import InputError, OutputError, UnknownNameError, UnsupportedError
from mbkit.model import Model

__all__ = ["DEFAULT", "CSource", "c_identifier", "export_c"]

_MARK: Final = "Written by mbkit"

#: What is exported where no quantity is named.
DEFAULT: Final = ("inverse_dynamics", "forward_dynamics")
_IDENTIFIER: Final = re.compile(r"[A-Za-z][A-Za-z0-9_]*")


@dataclass(frozen=True)
class CSource:
    """Two C files, not yet written.

    Attributes
    ----------
    name : str
        Stem of both files and prefix of every name in them.
    digest : str
        `Model.digest` of what they compute.
    functions : tuple of CFunction
    header, source : str
        Texts of ``<name>.h`` and ``<name>.c``; the same bytes for the same model and
        versions of mbkit and casadi.
    versions : dict of str to str
    """

    name: str
    digest: str
    functions: tuple[CFunction, ...]
    header: str
    source: str
    versions: dict[str, str]

    def write(self, folder: str | Path, *, force: bool = False) -> tuple[Path, Path]:
        """Write both files, and return their paths: header, then source.

        Parameters
        ----------
        folder : path
            Made if it is not there.
        force : bool
            Replace files that mbkit did not write. Those that it wrote are replaced
            in any case.

        Raises
        ------
        OutputError
            A file of other origin is in the way, or the folder cannot be written to.
        """
        with _interrupt.held:
            return self._write(Path(folder), force=force)

    def _write(self, folder: Path, *, force: bool) -> tuple[Path, Path]:
        texts = {folder / f"{self.name}.h": self.header, folder / f"{self.name}.c": self.source}
        header, source = texts
        try:
            # Both are looked at before either is written.
            for path in texts:
                if not force and path.exists() and not _ours(path):
                    raise OutputError(
                        f"{path} is there and mbkit did not write it; choose another folder or name, or force (--force)"
                    )
            folder.mkdir(parents=True, exist_ok=True)
            for path, text in texts.items():
                path.write_bytes(text.encode())
        except OutputError:
            raise
        except OSError as error:
            raise OutputError(f"cannot write to {folder}: {error.strerror or error}; choose another folder") from error
        return header, source


def export_c(model: Model, quantities: Iterable[str] = DEFAULT, *, name: str | None = None) -> CSource:
    """Return C99 code that computes quantities of a model.

    Each becomes one function without loops, heap or state, such as
    ``void panda_forward_dynamics(const double q[], const double v[], const double tau[],
    double a[])``; named parameters of the model are a last input. The header tells
    units, layouts, conventions and the order of the joints. Compilers take long for
    long functions: with ``gcc -O2`` about a second for Panda's forward dynamics (4,000
    operations), four for Talos' (18,000), over a minute for the two-armed Tiago's
    (72,000), which ``-O0`` compiles in two seconds.

    Parameters
    ----------
    model : Model
    quantities : iterable of str
        Keys of `mbkit.derivation.FUNCTIONS`.
    name : str, optional
        Prefix of every name in C, and stem of the files; the model's name in lower
        case letters, digits and underscores if not given.

    Returns
    -------
    CSource
        Its `write` writes the files.

    Raises
    ------
    UnknownNameError
        A quantity that there is not.
    InputError
        No quantity, or a `name` that is no identifier in C.
    UnsupportedError
        The model has loops or motions prescribed in time, or no joint that moves.

    Examples
    --------
    >>> import mbkit as mb
    >>> made = mb.lagrangian.export_c(mb.catalog.pendulum(), ["forward_dynamics"])
    >>> made.functions[0].name
    'pendulum_forward_dynamics'
    """
    wanted = _checked(quantities)
    for needed, told in (("loops", model.needs.loops), ("prescribed", model.needs.time)):
        if told:
            raise UnsupportedError(
                f"{model.name} has {needed!r}, which C code of its tree leaves out; mbkit.lagrangian.from_model(model)"
                f".model can be exported with them, and model.without({needed!r}) without them"
            )
    if not model.nv:
        raise UnsupportedError(f"{model.name} cannot be exported: no joint of it moves, and C has no empty arrays")
    prefix = c_identifier(model.name) if name is None else name
    if not _IDENTIFIER.fullmatch(prefix):
        raise InputError(f"name: expected letters, digits and _, a letter first, got {name!r}")
    equations = equations_of(model)
    made = [_function(prefix, model, quantity, equations.function(quantity)) for quantity in wanted]
    functions = tuple(function for function, _ in made)
    versions = {"mbkit": __version__, "casadi": str(ca.CasadiMeta.version())}
    written_by = f"{_MARK} {versions['mbkit']} with casadi {versions['casadi']}"
    bodies = [f"/* {written_by}; {prefix}.h tells the rest. */", f'#include "{prefix}.h"', "#include <math.h>"]
    return CSource(
        name=prefix,
        digest=model.digest,
        functions=functions,
        header=header(prefix, model, functions, f"{written_by}; made anew rather than edited."),
        source="\n\n".join([*bodies, *(body for _, body in made)]) + "\n",
        versions=versions,
    )


def _function(prefix: str, model: Model, quantity: str, function: ca.Function) -> tuple[CFunction, str]:
    written = program(function)
    inputs = tuple(zip(function.name_in(), written.inputs, strict=True))
    outputs = tuple(zip(output_names(quantity, function.name_out()), written.shapes, strict=True))
    described = CFunction(
        name=f"{prefix}_{quantity}",
        quantity=quantity,
        inputs=inputs,
        outputs=outputs,
        operations=written.arithmetic,
        stack=8 * variables(places(written)),
    )
    lines = c_body(written, [n for n, _ in inputs], [n for n, _ in outputs])
    body = "\n".join(f"    {line}" for line in lines)
    return described, f"{prototype(prefix, described, model)}\n{{\n{body}\n}}"


def _checked(quantities: Iterable[str]) -> list[str]:
    if isinstance(quantities, str):
        raise InputError(f"quantities: expected a list of names, got the text {quantities!r}; write [{quantities!r}]")
    # Each once, in the order asked for.
    wanted = list(dict.fromkeys(quantities))
    for quantity in wanted:
        if quantity not in FUNCTIONS:
            raise UnknownNameError("quantity", quantity, FUNCTIONS)
    if not wanted:
        raise InputError(f"quantities: expected at least one of {', '.join(FUNCTIONS)}, got none")
    return wanted


def c_identifier(name: str) -> str:
    """Return a name as a prefix of names in C: lower case letters, digits and underscores."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:100]
    return plain if plain[:1].isalpha() else f"model_{plain}".rstrip("_")


def _ours(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(64).startswith(f"/* {_MARK} ".encode())
