"""Child processes of mbkit: started with one channel in a folder of their own, and ended with all that they started."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path


def start_child(
    command: Sequence[str], folder: Path, channel: socket.socket, environment: Mapping[str, str] | None
) -> subprocess.Popen[bytes]:
    """Start a process in a folder, where its output goes to a file; raise `OSError` where it cannot be.

    Parameters
    ----------
    command : sequence of str
        Which names the channel's number.
    folder : Path
        An empty one, which the caller removes.
    channel : socket
        The child's end, which is closed here.
    environment : dict of str to str or None
        None is that of this process.
    """
    with channel, (folder / "output").open("wb") as output:
        return subprocess.Popen(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            pass_fds=[channel.fileno()],
            env=environment,
            # Ctrl-C is for its parent, and what it starts ends with it.
            start_new_session=True,
        )


def kill_child(process: subprocess.Popen[bytes] | None) -> None:
    """Kill a process and all that it started, if it is still there."""
    if process is not None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
