"""What runs in a child process: the loop that answers its parent, and the messages of arrays of an engine's version.

The loop answers any `mbkit._child_process.Child`. A message of arrays is a line of JSON, with their shapes, and the
bytes of their numbers: no pickles, and from any version of NumPy. An engine's process is started as
``python serve.py HANDLE FILE FOLDER``, with an inherited socket, in a folder of its own.
"""

from __future__ import annotations

import ctypes
import faulthandler
import importlib
import json
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

#: SIGUSR1, which Linux sends when the parent is gone. Its handler is alarm(2), which takes the signal's number as
#: seconds: time to remove the folder, after which the kernel ends even a process that hangs in a library.
_PARENT_GONE = 10


def attend(
    handle: int,
    folder: str,
    prepare: Callable[[Connection], Callable[[bytes], bytes]],
    memory: int = 0,
    idle: float | None = None,
) -> None:
    """Answer messages until the parent is gone, then remove the folder; or until it has asked nothing for so long.

    `prepare` returns what answers. The process may take `memory` bytes (Linux; 0: no limit).
    """
    import fcntl
    import resource

    # Ctrl-C is the parent's.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The parent never writes there, and who reads shall not wait.
    line = os.dup(0)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    if sys.platform == "linux":
        libc = ctypes.CDLL(None)
        libc.signal(_PARENT_GONE, libc.alarm)
        for key, value in ((fcntl.F_SETSIG, _PARENT_GONE), (fcntl.F_SETOWN, os.getpid()), (fcntl.F_SETFL, os.O_ASYNC)):
            fcntl.fcntl(line, key, value)
    ending = threading.Thread(target=_end_after_parent, args=(os.path.abspath(folder), line), daemon=True)
    ending.start()
    faulthandler.enable()
    # A crash leaves no core file behind. What counts is the memory written to, not what LLVM and heyoka only reserve.
    for kind, most in ((resource.RLIMIT_CORE, 0), *([(resource.RLIMIT_DATA, memory)] if memory else [])):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))
    channel = Connection(handle)
    answer = prepare(channel)
    try:
        channel.send_bytes(b"ready")
        while idle is None or channel.poll(idle):
            channel.send_bytes(answer(channel.recv_bytes()))
    except (EOFError, OSError):
        ending.join()
    # Destructors of loaded libraries could only fail.
    os._exit(0)


def _end_after_parent(folder: str, line: int) -> None:
    """Wait until the parent is gone, even if it was killed; remove the folder, end this process and what it started."""
    os.read(line, 1)
    shutil.rmtree(folder, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)


def packed(head: dict[str, Any], arrays: Sequence[Any] = ()) -> bytes:
    """Return a message."""
    every = [np.asarray(x, dtype="<f8") for x in arrays]
    text = json.dumps(dict(head, shapes=[x.shape for x in every])).encode()
    return b"".join([text, b"\n", *(x.tobytes() for x in every)])


def unpacked(message: bytes) -> tuple[dict[str, Any], list[Any]]:
    """Return the head and the arrays of a message."""
    at = message.index(b"\n") + 1
    head, arrays = json.loads(message[:at]), []
    for shape in head.pop("shapes"):
        arrays.append(np.ndarray(shape, "<f8", message, at).copy())
        at += arrays[-1].nbytes
    return head, arrays


def _module(name: str) -> Any:
    """Return a module by its name, or by the path of its file."""
    place, file = os.path.split(name.removesuffix(".py"))
    sys.path[:0] = [place] if place else []
    return importlib.import_module(file)


def _answer(adapter: Any, held: dict[int, Any], head: dict[str, Any], arrays: list[Any]) -> bytes:
    """Return what a call gives: of the adapter's class, or a quantity of a model that the process holds."""
    name, key = head["call"], head.get("model", 0)
    if name in ("build", "import"):
        if name == "build":
            held[key] = adapter.Engine(adapter.built(head["with"]))
            said = {"places": held[key].joints()}
        else:
            held[key], said = _module(head["with"].pop("module")).imported(adapter, **head["with"])
        return packed({**said, "gives": [x for x in dir(adapter.Engine) if x[0] != "_"]})
    if name == "forget":
        held.pop(key, None)
        return packed({})
    return packed({}, _called(held[key], name, arrays, head["with"], head.get("stacked", False)))


def _called(engine: Any, name: str, arrays: list[Any], plain: dict[str, Any], stacked: bool) -> list[Any]:
    """Return a quantity at one state, or at each of a stack; an engine with ``STACKED = True`` takes stacks alone."""

    def values(*states: Any) -> list[Any]:
        out = getattr(engine, name)(*states, **plain)
        return [*out] if isinstance(out, (list, tuple)) else [out]

    together = getattr(engine, "STACKED", False)
    if together == stacked:
        return values(*arrays)
    if together:
        return [x[0] for x in values(*(np.asarray(x)[None] for x in arrays))]
    return [np.array(column) for column in zip(*(values(*row) for row in zip(*arrays, strict=True)), strict=True)]


def serve(handle: int, file: str, folder: str) -> None:
    """Answer calls of an engine, by its name, whose file is beside this one, or by the path of a file."""

    def prepare(_: Connection) -> Callable[[bytes], bytes]:
        adapter = _module(file if file.endswith(".py") else "on_" + file)
        held: dict[int, Any] = {}

        def answer(message: bytes) -> bytes:
            try:
                return _answer(adapter, held, *unpacked(message))
            except (Exception, SystemExit) as error:  # a library may raise anything
                return packed({"error": " ".join(str(error).split()) or type(error).__name__})

        return answer

    attend(handle, folder, prepare)


if __name__ == "__main__":
    serve(int(sys.argv[1]), *sys.argv[2:4])
