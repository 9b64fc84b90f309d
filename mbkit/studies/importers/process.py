"""Every importer in a process of its own, so that none of them can end, hang or fill the user's.

The processes are kept from one comparison to the next: libraries take longer to load than files.
"""

from __future__ import annotations

import atexit
import os
import shutil
import signal
import tempfile
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NoReturn

from mbkit._check import Array
from mbkit._serving import opened
from mbkit.engines.imported import IMPORTERS, Beside, Imported, Importer, reader
from mbkit.errors import MbkitError
from mbkit.model import Model
from mbkit.studies._processes import MOST, Child, EndedError, OverdueError

__all__ = [
    "Answer",
    "Ask",
    "Hello",
    "ImporterError",
    "Made",
    "Read",
    "Reading",
    "Refused",
    "Request",
    "one_at_a_time",
    "serve",
]


# What a comparison of importers and their processes say to each other.


@dataclass(frozen=True)
class Read:
    """Read a text with the importer; answered by `Made` or `Refused`.

    Attributes
    ----------
    module, text, format : str
    floating_base : bool
    files : dict
        The meshes that the text names: name -> content.
    seconds : float
        After which the process ends itself, should nobody be there to end it.
    """

    module: str
    text: str
    format: str
    floating_base: bool
    files: dict[str, bytes]
    seconds: float


@dataclass(frozen=True)
class Ask:
    """Evaluate the terms of what was read last; answered by a dict of arrays or `Refused`.

    Attributes
    ----------
    q, v : (N, nq) and (N, nv) arrays
    without : tuple of str
        Keys of what is left out; see `mbkit.engines.imported.Imported`.
    seconds : float
    """

    q: Array
    v: Array
    without: tuple[str, ...]
    seconds: float


@dataclass(frozen=True)
class Hello:
    """A process is ready."""


@dataclass(frozen=True)
class Made:
    """What an importer made of a text; see `mbkit.engines.imported.Imported`."""

    model: Model
    notes: tuple[str, ...]
    beside: tuple[Beside, ...]


@dataclass(frozen=True)
class Refused:
    """Why a process that goes on living has no better answer."""

    why: str


Request = Read | Ask
Answer = Made | dict[str, Array] | Refused


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
            self.child = Child("mbkit.studies.importers.process", 0, self.folder, os.environ)
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


# What an importer's process does: it reads one text after the other, until nobody asks any more.

#: Seconds after which a process that nobody asks gives its memory back.
_IDLE: Final = 900.0


def serve(handle: int, memory: int) -> None:
    """Answer requests from a connection.

    Parameters
    ----------
    handle : int
        File descriptor.
    memory : int
        Bytes that the process may take; 0 for no bound.
    """
    # It outlives the thread that started it: the next comparison may be another one's.
    channel = opened(handle, memory, follow=False)
    channel.send(Hello())
    server = Server()
    while True:
        try:
            request = channel.recv() if channel.poll(_IDLE) else None
        except EOFError:
            request = None
        if request is None:
            # Nothing is left to tidy; destructors of loaded libraries could only fail.
            os._exit(0)
        # An importer that hangs hears nothing, not even that who asked is gone; the kernel ends it then.
        signal.setitimer(signal.ITIMER_REAL, request.seconds)
        answer = server.answer(request)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        channel.send(answer)


class Server:
    """Answers requests, and holds what was read last."""

    def __init__(self) -> None:
        self._held: Imported | None = None

    def answer(self, request: Request) -> Answer:
        """Return the answer to one request; whatever goes wrong is one, too."""
        try:
            return self._read(request) if isinstance(request, Read) else self._terms(request)
        except MbkitError as error:
            return Refused(str(error))
        except (Exception, SystemExit) as error:  # importers raise errors of all kinds
            return Refused(" ".join(f"{type(error).__name__}: {error}".split()))

    def _read(self, request: Read) -> Made:
        # What was held can be as large.
        self._held = None
        self._held = made = reader(request.module)(request.text, request.format, request.floating_base, request.files)
        return Made(made.model, made.notes, made.beside)

    def _terms(self, request: Ask) -> dict[str, Any]:
        assert self._held is not None
        return self._held.terms(request.q, request.v, request.without)
