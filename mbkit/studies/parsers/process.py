"""Every importer in a process of its own, so that none of them can end, hang or fill the user's.

The processes are kept from one comparison to the next: libraries take longer to load than files.
"""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
import threading
from pathlib import Path
from typing import Any, Final, NoReturn

from mbkit._check import Array
from mbkit.engines.import_messages import Ask, Read, Refused, Request
from mbkit.engines.imported import IMPORTERS, Imported, Importer
from mbkit.studies.child import MOST, Child, EndedError, OverdueError

__all__ = ["ImporterError", "Reading", "one_at_a_time"]

#: Seconds until a process is there.
_START: Final = 60.0
#: Seconds more than a request may take at most, after which a process ends that nobody waits for any more.
_GRACE: Final = 30.0
#: Far beyond anybody's patience, and what the system's calls still take.
_MOST_SECONDS: Final = 1e6

_kept: Final[dict[Importer, _Kept]] = {}
_lock = threading.Lock()


class ImporterError(Exception):
    """An importer refuses a text, ended its process over it, or took too long; never leaves `mbkit.studies`."""


class _Kept:
    """An importer's process and its folder."""

    def __init__(self) -> None:
        # MuJoCo writes its log into the working folder.
        self.folder = Path(tempfile.mkdtemp(prefix="mbkit-"))
        try:
            self.child = Child("mbkit.engines.import_server", 0, self.folder, os.environ)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        #: Whether it said that it is there, and whether it still owes an answer.
        self.greeted = self.owes = False

    def end(self) -> None:
        self.child.end()
        shutil.rmtree(self.folder, ignore_errors=True)


def one_at_a_time() -> threading.Lock:
    """Return what a comparison holds while it asks: a process has one file in its hands."""
    return _lock


class Reading:
    """A text that an engine's importer reads, begun at once.

    Parameters
    ----------
    engine : str
    text, format_ : str
    floating_base : bool
    files : dict
        The meshes that the text names: name -> content.
    seconds : float
        What it may take, of the processor's time.

    Raises
    ------
    ImporterError
        Its process cannot be started.
    """

    def __init__(
        self, engine: str, text: str, format_: str, floating_base: bool, files: dict[str, bytes], seconds: float
    ) -> None:
        self._engine, self._seconds = engine, min(seconds, _MOST_SECONDS)
        self._key = IMPORTERS[engine]
        patience = MOST * self._seconds + _GRACE
        self._request = Read(self._key.module, text, format_, floating_base, files, patience)
        kept = _kept.get(self._key)
        # One that was interrupted would answer what nobody asks any more.
        if kept is not None and (kept.owes or not kept.child.alive):
            self._end()
            kept = None
        if kept is None:
            try:
                _kept[self._key] = _Kept()
            except OSError as error:
                raise ImporterError(f"a process for its importer cannot be started ({error})") from None

    def send(self) -> None:
        """Begin."""
        self._send(self._request)

    def made(self) -> Imported:
        """Wait for what the importer makes of the text.

        Raises
        ------
        ImporterError
        """
        made = self._receive()
        return Imported(made.model, self._terms, made.notes, made.beside)

    def _terms(self, q: Array, v: Array, without: tuple[str, ...] = ()) -> dict[str, Array]:
        self._send(Ask(q, v, without, self._request.seconds))
        out: dict[str, Array] = self._receive()
        return out

    def _send(self, request: Request) -> None:
        kept = self._process
        kept.owes = True
        try:
            kept.child.send(request)
        except EndedError as error:
            self._lost(error)

    @property
    def _process(self) -> _Kept:
        kept = _kept.get(self._key)
        if kept is None:
            raise ImporterError("its process is gone")
        return kept

    def _receive(self) -> Any:
        kept = self._process
        try:
            if not kept.greeted:
                kept.child.receive(_START)
                kept.greeted = True
            answer = kept.child.receive(self._seconds)
            kept.owes = False
        except EndedError as error:
            self._lost(error)
        except OverdueError as error:
            self._end()
            raise ImporterError(f"its importer was stopped after {error.seconds:.2g} s, without an answer") from None
        if isinstance(answer, Refused):
            raise ImporterError(answer.why.removeprefix(f"{self._engine}: "))
        return answer

    def _lost(self, error: EndedError) -> NoReturn:
        self._end()
        if error.signal == "SIGALRM":
            # It was waited for while another one was, and ended itself.
            raise ImporterError("its importer was stopped, without an answer") from None
        what = f"its importer ended the process with {error.signal}" if error.signal else f"its importer: {error.how}"
        raise ImporterError(f"{what}{f' ({error.last})' if error.signal and error.last else ''}")

    def _end(self) -> None:
        kept = _kept.pop(self._key, None)
        if kept is not None:
            kept.end()


@atexit.register
def _end_all() -> None:
    while _kept:
        _kept.popitem()[1].end()


def _forget() -> None:
    """Let go of another process's helpers: this one is a copy of it."""
    global _lock
    _lock = threading.Lock()
    while _kept:
        _kept.popitem()[1].child.leave()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
