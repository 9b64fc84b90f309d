"""The file of a baseline: whole or not there, guarded by a checksum, and no other robot's."""

from __future__ import annotations

import hashlib
import os
import re
import tempfile
import tomllib
from pathlib import Path
from typing import Final

from mbkit import _interrupt
from mbkit.errors import BaselineError, InputError, OutputError
from mbkit.studies.baseline import toml
from mbkit.studies.baseline.content import Baseline
from mbkit.studies.baseline.table import FORMAT, from_table, to_table

__all__ = ["check_replaceable", "is_baseline", "path_of", "read", "store", "text_of"]

_HEAD: Final = "# mbkit baseline: "
_NOTE: Final = (
    f"{_HEAD}what engines said of one robot. Written by mbkit and guarded by the checksum in its last line:\n"
    "# do not edit it, record it anew. A line below [section] is the whole name of a number or row; a row has a\n"
    "# number for each of the states; a row of M is what stands before the diagonal, from its first that is not zero,\n"
    "# and the diagonal.\n"
)
_SUM: Final = "# sha256 "
_FORMAT: Final = re.compile(r"^format = (\d+)$", re.MULTILINE)
_MODEL: Final = re.compile(r"^model = (\".*\")$", re.MULTILINE)
_CONFLICT: Final = re.compile(r"^(<<<<<<<|>>>>>>>)", re.MULTILINE)


def path_of(path: object) -> Path:
    """Return a path that may be a baseline's."""
    if not isinstance(path, (str, os.PathLike)) or not os.fspath(path):
        raise InputError(f"path: expected a file such as 'baselines/panda.toml', got {path!r}")
    out = Path(os.fsdecode(path))
    if out.is_dir():
        raise InputError(f"path: {out} is a folder; name a file in it, such as {out / 'panda.toml'}")
    return out


def is_baseline(path: Path) -> bool:
    """Return whether a file says that it is a baseline, damaged or not."""
    try:
        with path.open("rb") as file:
            return file.read(len(_HEAD)) == _HEAD.encode()
    except OSError:
        return False


def text_of(baseline: Baseline) -> str:
    """Return a baseline as the text of its file; the same baseline is the same text."""
    body = f"{_NOTE}\n{toml.dumps(to_table(baseline))}\n"
    return f"{body}{_SUM}{_checksum(body)}\n"


def read(path: str | os.PathLike[str]) -> Baseline:
    """Read a baseline.

    Raises
    ------
    BaselineError
        There is no such file, or it is none, cut short, edited, or of another format.

    Examples
    --------
    >>> import tempfile, mbkit as mb
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = mb.baseline.record(mb.catalog.pendulum(), folder + "/a.toml", engines=["lagrangian"])
    ...     mb.baseline.read(folder + "/a.toml")
    <Baseline of 'pendulum': lagrangian; 10 terms at 3 states>
    """
    where = path_of(path)
    try:
        raw = where.read_bytes()
    except FileNotFoundError:
        raise BaselineError(f"{where}: there is no baseline; record one, and keep it with the robot's files") from None
    except OSError as error:
        raise BaselineError(f"{where}: cannot be read: {error.strerror or error}") from None
    return parsed(raw, where)


def parsed(raw: bytes, where: Path) -> Baseline:
    """Return the baseline in a file's bytes; `where` is for messages."""
    try:
        # Version control may have changed the ends of lines.
        text = raw.decode("utf-8").replace("\r\n", "\n")
    except UnicodeDecodeError as error:
        raise BaselineError(f"{where}: no text from byte {error.start} on; {_REMEDY}") from None
    if not text.startswith(_HEAD):
        raise BaselineError(f"{where}: no baseline of mbkit's; its first line would begin with {_HEAD.strip()!r}")
    if _CONFLICT.search(text):
        raise BaselineError(f"{where}: a merge has left conflict marks in it; take either side, or record it anew")
    _check_format(text, where)
    body, mark, told = text.rpartition(_SUM)
    if not mark or len(told.strip()) != 64 or not body.endswith("\n"):
        lines = text.count("\n")
        raise BaselineError(f"{where}: cut short after line {lines}: its last line, the checksum, is lost; {_REMEDY}")
    if told.strip() != _checksum(body):
        raise BaselineError(f"{where}: edited or damaged: its checksum belongs to other content; {_REMEDY}")
    try:
        return from_table(tomllib.loads(body))
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError) as error:
        raise BaselineError(f"{where}: sound by its checksum, yet not readable ({error}); {_REMEDY}") from None


_REMEDY: Final = "restore it from version control, or record it anew"


def _check_format(text: str, where: Path) -> None:
    number = _format(text)
    if number is None or number == FORMAT:
        # Without the line it is damaged, which the checksum tells.
        return
    if number > FORMAT:
        told = f"of format {number}, by a newer mbkit; this one reads format {FORMAT}: update mbkit, or record it anew"
    else:
        told = f"of format {number}, by an older mbkit; this one reads format {FORMAT}: record it anew"
    raise BaselineError(f"{where}: {told}")


def _format(text: str) -> int | None:
    """Return the number of the format; of a number that no format has, its first nine digits."""
    found = _FORMAT.search(text)
    return int(found[1][:9]) if found else None


def _checksum(body: str) -> str:
    return hashlib.sha256(body.encode("utf-8")).hexdigest()


# Writing.


def check_replaceable(path: Path, model: str) -> None:
    """Raise `OutputError` where a file is that recording this model's baseline must not replace.

    A baseline of the same model may be, whole or damaged; anything else may be dear.
    """
    if not os.path.lexists(path):
        return
    if not is_baseline(path):
        raise OutputError(f"{path}: there is a file that is no baseline; name another, or replace it with force")
    text = path.read_bytes().decode("utf-8", "replace").replace("\r\n", "\n")
    number = _format(text)
    if number is not None and number > FORMAT:
        raise OutputError(
            f"{path}: a newer mbkit's baseline, of format {number}; update mbkit, or replace it with force"
        )
    named = _MODEL.search(text)
    if named and named[1] != toml.value(model):
        raise OutputError(
            f"{path}: the baseline of {named[1]}, not of {model!r}; name another file, or replace it with force"
        )


def store(path: Path, text: str, model: str, *, force: bool) -> None:
    """Write a baseline as a whole or not at all; what was there stays until then.

    Raises
    ------
    OutputError
        It cannot be written; or, unless `force` is given, another process has put another
        robot's baseline there in the meantime.
    """
    with _interrupt.held:
        # Where a link leads, so that it stays one.
        _store(Path(os.path.realpath(path)), text, model, force=force)


def _store(path: Path, text: str, model: str, *, force: bool) -> None:
    temporary = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}-")
        with os.fdopen(handle, "wb") as file:
            file.write(text.encode("utf-8"))
            # A name must not stand for content that a crash can still take.
            file.flush()
            os.fsync(file.fileno())
        os.chmod(temporary, 0o666 & ~_umask())
        if not force:
            _claim(temporary, path, model)
        os.replace(temporary, path)
    except UnicodeEncodeError as error:
        raise InputError(
            f"{model}: the name {error.object[error.start : error.end]!r} is no text that a file holds"
        ) from None
    except OutputError:
        raise
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}; what was there is unchanged") from error
    finally:
        if temporary is not None and os.path.lexists(temporary):
            os.unlink(temporary)


def _claim(temporary: str, path: Path, model: str) -> None:
    """Take the name if it is free, in one step that two processes cannot both take; else look who has it."""
    try:
        os.link(temporary, path)
    except OSError:
        # It is taken, or the file system has no links.
        check_replaceable(path, model)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
