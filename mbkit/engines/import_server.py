"""What an importer's process does: it reads one text after the other, until nobody asks any more."""

from __future__ import annotations

import os
import signal
from typing import Any, Final

from mbkit._serving import opened
from mbkit.engines.import_messages import Answer, Ask, Hello, Made, Read, Refused, Request
from mbkit.engines.imported import Imported, reader
from mbkit.errors import MbkitError

__all__ = ["serve"]

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
