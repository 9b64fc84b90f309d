"""Machine code kept on disk between processes.

The folder belongs to the user alone (0700). An entry is written under another name and then renamed, so that any number
of processes may write at once. It is used only if its SHA-256, its key and its owner are right, and else counts as
absent. ``MBKIT_CACHE_DIR`` moves the folder; set to the empty string it switches this off. A folder that is open to
others and holds other files belongs to the user: its mode stays, and nothing is kept there. Only entries are deleted.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
import tempfile
from collections.abc import Callable, Iterator, MutableMapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any, Final, TypeVar

from platformdirs import user_cache_path

T = TypeVar("T")
_MAGIC: Final = b"mbkit machine code 1\n"
#: The oldest entries go when the folder holds more than this, bytes.
_MAX_CACHE_BYTES: Final = 512 * 2**20
#: Bytes that this process may write into a folder before it looks through it again.
_left: Final[dict[Path, int]] = {}
#: Names of entries, and of those being written.
_ENTRY: Final = re.compile(r"[0-9a-f]{64}|\.new-.+")
#: Entries compiled within a block of `force_recompile`; None outside of one.
_RECOMPILED: Final[ContextVar[set[str] | None]] = ContextVar("_RECOMPILED", default=None)


def key_of(*parts: str) -> str:
    """Return the name of an entry: the SHA-256 of all that its content depends on."""
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()


def folder() -> Path | None:
    """Return the folder, created if necessary, or None without a safe one."""
    chosen = os.environ.get("MBKIT_CACHE_DIR")
    if chosen == "":
        return None
    try:
        path = Path(chosen) if chosen else user_cache_path("mbkit") / "machine-code"
        path.mkdir(parents=True, exist_ok=True, mode=0o700)
        status = path.stat()
        if hasattr(os, "getuid"):
            if status.st_uid != os.getuid():
                return None
            if stat.S_IMODE(status.st_mode) != 0o700:
                if not all(_ENTRY.fullmatch(name) for name in os.listdir(path)):
                    return None
                path.chmod(0o700)
    except (OSError, RuntimeError):
        # platformdirs raises a RuntimeError where the user has no home.
        return None
    return path


@contextmanager
def force_recompile() -> Iterator[None]:
    """Compile each entry again within the block, once, in this thread: a first run can be measured at any time."""
    token = _RECOMPILED.set(set())
    try:
        yield
    finally:
        _RECOMPILED.reset(token)


def is_bypassed(key: str) -> bool:
    """Return whether a kept entry, on disk or in memory, must be compiled again: see `force_recompile`."""
    fresh = _RECOMPILED.get()
    return fresh is not None and key not in fresh


def mark_made(key: str) -> None:
    """Count an entry as compiled again, within a block of `force_recompile`."""
    if (fresh := _RECOMPILED.get()) is not None:
        fresh.add(key)


def read(key: str) -> tuple[dict[str, Any], bytes] | None:
    """Return the description and code of an entry, or None without a valid one."""
    at = folder()
    if at is None or is_bypassed(key):
        return None
    path = at / key
    try:
        # Not through a link, which may lead out of the folder; and a pipe would be waited for.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0))
        with os.fdopen(handle, "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode) or (hasattr(os, "getuid") and status.st_uid != os.getuid()):
                return None
            content = file.read()
        with suppress(OSError):
            os.utime(path)
    except OSError:
        return None
    start = len(_MAGIC) + 65
    checksum, rest = content[len(_MAGIC) : start - 1].decode("ascii", "replace"), content[start:]
    if not content.startswith(_MAGIC) or hashlib.sha256(rest).hexdigest() != checksum:
        return None
    text, _, code = rest.partition(b"\n")
    about: dict[str, Any] = json.loads(text)
    return (about, code) if about.get("key") == key else None


def write(key: str, about: dict[str, Any], code: bytes) -> None:
    """Write an entry; failures are ignored."""
    mark_made(key)
    if (at := folder()) is None:
        return
    rest = json.dumps({**about, "key": key}).encode() + b"\n" + code
    content = _MAGIC + hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest
    try:
        handle, temporary = tempfile.mkstemp(dir=at, prefix=".new-")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
            os.replace(temporary, at / key)
        except OSError:
            with suppress(OSError):
                os.unlink(temporary)
            return
        _make_room(at, len(content))
    except OSError:
        return


def cached(
    key: str,
    in_memory: MutableMapping[str, T],
    restore: Callable[[dict[str, Any], bytes], T],
    make: Callable[[], tuple[dict[str, Any], bytes]],
) -> T:
    """Return compiled code: held in this process, from disk, or compiled by `make` now and written."""
    code = None if is_bypassed(key) else in_memory.get(key)
    # An intact entry of another form is compiled again.
    with suppress(KeyError, TypeError, ValueError):
        if code is None and (entry := read(key)):
            code = restore(*entry)
    if code is None:
        new = make()
        write(key, *new)
        code = restore(*new)
    in_memory[key] = code
    return code


def _make_room(at: Path, written: int) -> None:
    """Delete the oldest entries of a folder that is full; it is looked through only when it may be."""
    left = _left.get(at, 0) - written
    if left > 0:
        _left[at] = left
        return
    entries = []
    with os.scandir(at) as files:
        for entry in files:
            with suppress(OSError):
                if _ENTRY.fullmatch(entry.name):
                    status = entry.stat()
                    entries.append((status.st_mtime, status.st_size, entry.path))
    size = sum(entry[1] for entry in entries)
    for _, bytes_, path in sorted(entries):
        if size <= _MAX_CACHE_BYTES:
            break
        with suppress(OSError):
            os.unlink(path)
            size -= bytes_
    # Others write too.
    _left[at] = (_MAX_CACHE_BYTES - size) // 4
