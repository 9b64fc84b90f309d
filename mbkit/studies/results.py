"""What all results of studies share: plain data, JSON, CSV, Markdown and HTML."""

from __future__ import annotations

import contextlib
import csv
import io
import itertools
import json
import math
import os
import platform
import re
import tempfile
import time
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, reduce
from importlib import metadata
from operator import attrgetter, getitem
from pathlib import Path
from typing import Any, ClassVar, Final, Self

import numpy as np

from mbkit._escape import csv_text, one_line
from mbkit._version import __version__
from mbkit.engines.registry import ENGINES
from mbkit.errors import InputError, writing
from mbkit.model import Model
from mbkit.studies.document import Document, to_html, to_markdown

#: An infinite limit in JSON, where null stands for an unknown one.
NO_LIMIT: Final = "no limit"


@dataclass(frozen=True)
class Refusal:
    """Something that an engine could not do, with its reason; `term` is empty for all of it."""

    engine: str
    term: str
    reason: str

    @property
    def name(self) -> str:
        """Engine and term."""
        return f"{self.engine} {self.term}".strip()

    @classmethod
    def of(cls, engine: str, error: Exception, term: str = "") -> Refusal:
        """Return an error as a refusal, whose reason does not name the engine again."""
        return cls(engine, term, str(error).removeprefix(f"{engine}: "))


# Plain data, and back.


def _data(value: Any) -> Any:
    """Return dataclasses as dictionaries of their fields and derived properties, and tuples as lists."""
    if isinstance(value, ResultTable):
        return value.to_dict()
    if is_dataclass(value):
        return {name: _data(getattr(value, name)) for name in _names(value)}
    if isinstance(value, dict):
        return {k: _data(x) for k, x in value.items()}
    return [_data(x) for x in value] if isinstance(value, (list, tuple)) else value


#: Of a field that plain data leaves out.
NOT_PLAIN: Final = types.MappingProxyType({"plain": False})


def _names(value: Any) -> list[str]:
    return [*(f.name for f in fields(value) if f.metadata.get("plain", True)), *getattr(value, "_derived", ())]


def to_plain(value: Any) -> Any:
    """Return data as JSON can hold it: tuples and arrays as lists, and None for a number that is not finite."""
    if isinstance(value, dict):
        return {k: to_plain(x) for k, x in value.items()}
    if isinstance(value, (list, tuple)):
        return [to_plain(x) for x in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return to_plain(value.tolist())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _infinities(value: Any, path: tuple[str | int, ...] = ()) -> Iterator[dict[str, Any]]:
    """Yield where data is infinite, which JSON's numbers cannot say: the keys that lead there, and the value."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, (dict, list, tuple)):
        for key, x in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _infinities(x, (*path, key))
    elif isinstance(value, float) and math.isinf(value):
        yield {"at": list(path), "value": "Infinity" if value > 0 else "-Infinity"}


def from_plain(kind: Any, value: Any) -> Any:
    """Return plain data as a type: dataclasses, tuples, NaN for null in a number. Unknown entries are left out."""
    if is_dataclass(kind):
        hints = _type_hints(kind)
        names = [f.name for f in fields(kind) if f.name in value]
        return typing.cast(Any, kind)(**{name: from_plain(hints[name], value[name]) for name in names})
    if kind is float:
        return math.nan if value is None else math.inf if value == NO_LIMIT else value
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        kinds = itertools.repeat(args[0]) if args[-1] is Ellipsis else args
        return tuple(from_plain(k, x) for k, x in zip(kinds, value, strict=False))
    if origin is dict:
        return {k: from_plain(args[1], x) for k, x in value.items()}
    if origin in (types.UnionType, typing.Union) and value is not None:
        return from_plain(args[0], value)
    return value


#: Type hints of a class: they resolve every annotation, and a result has hundreds of rows of one class.
_type_hints: Final[Callable[[Any], dict[str, Any]]] = cache(typing.get_type_hints)


# Columns of CSV files: head -> value of a row.

Columns = Mapping[str, Callable[[Any], Any]]


def columns_of(kind: type) -> Columns:
    """Return a column for each field of a dataclass that is a text, a number or a truth value."""
    return {f.name: attrgetter(f.name) for f in fields(kind) if f.type in ("str", "int", "float", "bool")}


def columns(part: int, *names: str) -> Columns:
    """Return a column for each attribute of one part of a row."""

    def value(name: str) -> Callable[[Any], Any]:
        return lambda row: getattr(row[part], name)

    return {name: value(name) for name in names}


def counted(n: int, noun: str) -> str:
    """Return how many there are of something."""
    return f"{n} {noun}{'s' * (n != 1)}"


class ResultTable:
    """Base of the results of studies: a `document` for people, `_csv_columns` of `_csv_rows` for programs."""

    #: The attribute by which a repr calls the result, and the one with a row for each line of CSV.
    _called: ClassVar[str] = "model"
    _listed: ClassVar[str] = "rows"
    #: Properties that stand in the plain data beside the fields.
    _derived: ClassVar[Sequence[str]] = ()
    _csv_columns: ClassVar[Columns] = {}

    def document(self) -> Document:
        """Return all that a terminal, a page, Markdown and a notebook show of the result."""
        raise NotImplementedError

    def _csv_rows(self) -> Iterable[Any]:
        rows: Iterable[Any] = getattr(self, self._listed)
        return rows

    def __repr__(self) -> str:
        result: Any = self
        return f"<{type(self).__name__} of {getattr(self, self._called)!r}: {one_line(result.verdict)}>"

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {name: _data(getattr(self, name)) for name in _names(self)}

    def to_json(self, path: str | Path | None = None) -> str:
        """Return the result as JSON; with `path`, write it there too.

        Infinity and NaN become null; an entry ``infinite`` then lists which are infinite.
        """
        data = self.to_dict()
        infinite = list(_infinities(data))
        text = json.dumps(to_plain(data | ({"infinite": infinite} if infinite else {})), indent=1, allow_nan=False)
        if path is not None:
            write(path, text + "\n")
        return text

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the result that `to_json` wrote; null is NaN where ``infinite`` does not list it.

        Raises
        ------
        InputError
            The text is no such result.
        """
        try:
            data = json.loads(text)
            for entry in data.get("infinite", ()):
                *path, last = entry["at"]
                reduce(getitem, path, data)[last] = float(entry["value"])
            result: Self = from_plain(cls, data)
        except (ValueError, TypeError, LookupError, AttributeError, RecursionError) as error:
            raise InputError(
                f"text: expected the JSON of a {cls.__name__}, such as Path(...).read_text() of a file "
                f"that to_json wrote; it has no such content ({type(error).__name__}: {error})"
            ) from None
        return result

    def to_csv(self, path: str | Path | None = None) -> str:
        """Return one line a row, with all digits; with `path`, write it there too."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(self._csv_columns)
        for row in self._csv_rows():
            writer.writerow(_csv_cell(value(row)) for value in self._csv_columns.values())
        if path is not None:
            write(path, stream.getvalue())
        return stream.getvalue()

    def to_markdown(self) -> str:
        """Return the result for people, in Markdown."""
        return to_markdown(self.document())

    def _repr_html_(self) -> str:
        return to_html(self.document())


def _csv_cell(value: Any) -> Any:
    """Return a number with all its digits, empty for NaN and None, and text that is no formula."""
    if isinstance(value, str):
        return csv_text(value)
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(value)
    return int(value) if isinstance(value, bool) else value


def write_whole(path: Path, content: bytes, claim: Callable[[str], None] | None = None) -> None:
    """Write a file as a whole or not at all: under a temporary name, which `claim` may refuse, then renamed."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=".mbkit-")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            # A name must not stand for content that a crash can still take.
            file.flush()
            os.fsync(file.fileno())
        # A temporary file is private; the file gets the usual permissions.
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(temporary, 0o666 & ~mask)
        if claim is not None:
            claim(temporary)
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)


def write(path: str | Path, text: str) -> None:
    """Write a text to a file, or raise `OutputError`."""
    with writing(path, "choose a folder that exists (the result itself is kept)"):
        Path(path).write_text(text, encoding="utf-8")


# The model, versions and processor, for every report.


def model_info(model: Model) -> dict[str, Any]:
    """Return size, mass, digest, needs, joints, notes and inconsistent inertias of a model, as plain data."""
    return {
        "nq": model.nq,
        "nv": model.nv,
        # Energies do not tell it.
        **({} if not model.has_bodies else {"mass": model.mass}),
        "digest": model.digest,
        "needs": model.needs.as_dict(),
        "joints": list(model.joint_names),
        "notes": list(model.notes),
        "nonphysical": [f"{name}: {why}" for name, why in model.nonphysical],
    }


#: Packages that compute beside the engines.
_BESIDE: Final = ("numpy", "scipy", "llvmlite", "heyoka", "example-robot-data")


def versions() -> dict[str, str]:
    """Return the versions of everything that computes."""
    engines = (info.distribution for info in ENGINES.values() if info.distribution)
    return dict(_versions(tuple(dict.fromkeys([*engines, *_BESIDE]))))


@cache
def _versions(packages: tuple[str, ...]) -> dict[str, str]:
    # Searching the installed packages takes some 10 ms.
    out = {"mbkit": __version__, "python": platform.python_version()}
    for package in packages:
        try:
            out.setdefault(package, metadata.version(package))
        except metadata.PackageNotFoundError:
            out[package] = "not installed"
    return out


def provenance(begun: float) -> dict[str, Any]:
    """Return what ends a result: versions, processor, and the seconds since a time of `time.perf_counter`."""
    return {"versions": versions(), "processor": processor(), "seconds": time.perf_counter() - begun}


def processor() -> str:
    """Return the processor's model name and the system."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError):
        line = re.search(r"^model name.*?:(.*)", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE)
        name = line[1].strip() if line else name
    return f"{name}, {platform.system()} {platform.machine()}"
