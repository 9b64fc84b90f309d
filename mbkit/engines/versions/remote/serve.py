"""Messages of arrays, and the loop of a process that answers them.

A message is two lengths, a head in JSON and float64 arrays in NumPy's own file format, without pickles. It may come
from any version of NumPy. The process is started as ``python serve.py HANDLE ENGINE FOLDER``, with an
inherited socket, in a folder of its own.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import shutil
import signal
import socket
import struct
import sys

import numpy as np

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from typing import Any

_LENGTHS = struct.Struct("<QQ")


def packed(head: dict[str, Any], arrays: Sequence[Any] = ()) -> bytes:
    """Return a message."""
    body = io.BytesIO()
    for x in arrays:
        np.lib.format.write_array(body, np.asarray(x, dtype="<f8", order="C"), allow_pickle=False)
    text, data = json.dumps(dict(head, arrays=len(arrays))).encode(), body.getvalue()
    return _LENGTHS.pack(len(text), len(data)) + text + data


def unpacked(read: Callable[[int], bytes]) -> tuple[dict[str, Any], list[Any]]:
    """Return the head and the arrays of a message; `read` returns so many bytes, or raises `EOFError`."""
    text, data = _LENGTHS.unpack(read(_LENGTHS.size))
    head = json.loads(read(text).decode())
    body = io.BytesIO(read(data))
    return head, [np.lib.format.read_array(body, allow_pickle=False) for _ in range(head["arrays"])]


def reader(channel: socket.socket) -> Callable[[int], bytes]:
    """Return a function that reads exactly so many bytes."""

    def read(size: int) -> bytes:
        out = bytearray()
        while len(out) < size:
            part = channel.recv(min(size - len(out), 1 << 20))
            if not part:
                raise EOFError
            out += part
        return bytes(out)

    return read


def _answer(adapter: Any, held: dict[int, Any], head: dict[str, Any], arrays: list[Any]) -> bytes:
    """Return what a call gives: of the adapter's class, or a quantity of a model that the process holds."""
    name, key = head["call"], head.get("model", 0)
    if name == "build":
        held[key] = adapter.Engine(adapter.built(head["with"]))
        return packed({"joints": held[key].joints()})
    if name == "parse":
        held[key] = adapter.Engine(adapter.parsed(head["with"]["text"], head["with"]["format"]))
        return packed({"joints": held[key].joints()})
    if name == "forget":
        held.pop(key, None)
        return packed({})
    if name == "about":
        return packed({"version": adapter.VERSION, "gives": [x for x in dir(adapter.Engine) if x[0] != "_"]})
    out = getattr(held[key], name)(*arrays, **head["with"])
    return packed({}, out if isinstance(out, (list, tuple)) else [out])


def serve(handle: int, engine: str, folder: str) -> None:
    """Answer calls until the caller is gone; then remove the folder."""
    # Ctrl-C is the caller's.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    channel = socket.socket(fileno=handle)
    read = reader(channel)
    try:
        adapter = importlib.import_module("on_" + engine)
        held: dict[int, Any] = {}
        channel.sendall(packed({"ready": True}))
        while True:
            head, arrays = unpacked(read)
            # What hangs does not see that its caller is gone; the system ends it then.
            signal.setitimer(signal.ITIMER_REAL, head.get("alarm", 0.0))
            try:
                answer = _answer(adapter, held, head, arrays)
            except (Exception, SystemExit) as error:  # a library may raise anything
                answer = packed({"error": " ".join(str(error).split()) or type(error).__name__})
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            channel.sendall(answer)
    except (EOFError, OSError):
        pass
    shutil.rmtree(folder, ignore_errors=True)
    # Destructors of loaded libraries could only fail.
    os._exit(0)


if __name__ == "__main__":
    serve(int(sys.argv[1]), *sys.argv[2:4])
