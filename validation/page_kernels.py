"""Kernels of the book's pages: forks of one process that has imported what most pages import.

A kernel that imports for itself takes some two seconds longer to its first result. `conf.py` calls `use`; then Jupyter
starts ``python -m validation.page_kernels FILE``, which asks the one process for a fork and ends with it.
"""

from __future__ import annotations

import atexit
import importlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

#: The socket of the process that forks.
_SOCKET: Final = "MBKIT_PAGE_KERNELS"
_IMPORTED: Final = (
    *("IPython.display", "ipykernel.kernelapp", "matplotlib.pyplot", "matplotlib_inline.backend_inline", "sympy"),
    *("mujoco", "pinocchio", "mbkit.identify", "mbkit.report", "mbkit.studies", "mbkit.codegen.compiled_calls"),
    *("mbkit.engines.mujoco", "mbkit.engines.pinocchio", "mbkit.lagrangian.system"),
)


def use() -> None:
    """Start the process, and make its forks the kernels of pages; on Linux alone, elsewhere forks are not safe.

    Sockets are files: two kernels that start at once may draw one port.
    """
    if sys.platform != "linux":
        return
    import jupyter_client
    from traitlets import default

    folder = tempfile.TemporaryDirectory(prefix="mbkit-kernels-")
    atexit.register(folder.cleanup)

    class Kernels(jupyter_client.AsyncKernelManager):
        @default("transport")
        def _default_transport(self) -> str:
            return "ipc"

        @default("ip")
        def _default_ip(self) -> str:
            return str(Path(folder.name, uuid4().hex))

    # What nbclient takes unless it is told, and no page's reader tells it.
    jupyter_client.AsyncKernelManager = Kernels
    spec = Path(folder.name, "kernels", "python3", "kernel.json")
    spec.parent.mkdir(parents=True)
    command = [sys.executable, "-m", "validation.page_kernels"]
    told = {"argv": [*command, "{connection_file}"], "display_name": "Python 3", "language": "python"}
    spec.write_text(json.dumps(told), encoding="utf-8")
    address = str(Path(folder.name, "socket"))
    os.environ.update({"JUPYTER_PATH": folder.name, _SOCKET: address})
    # It ends when this end of its input closes, however this process ends.
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=os.environ["MBKIT_TOP"])
    atexit.register(process.kill)
    assert process.stdout is not None
    if not process.stdout.readline():
        raise RuntimeError("the process that kernels of pages are forked from has ended: see its message above")


def _serve() -> None:
    for name in _IMPORTED:
        importlib.import_module(name)
    server = socket.socket(socket.AF_UNIX)
    server.bind(os.environ[_SOCKET])
    server.listen()
    threading.Thread(target=lambda: (os.read(0, 1), os._exit(0)), daemon=True).start()
    print("ready", flush=True)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    while True:
        connection, _ = server.accept()
        parent = os.getpid()
        if not os.fork():
            server.close()
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            # Nobody reads the pipe of the first line.
            os.dup2(2, 1)
            _become_kernel(connection, parent)
        connection.close()


def _become_kernel(connection: socket.socket, parent: int) -> None:
    told: dict[str, Any] = json.loads(connection.makefile().readline())
    connection.sendall(f"{os.getpid()}\n".encode())
    threading.Thread(target=lambda: (connection.recv(1), os._exit(1)), daemon=True).start()
    os.chdir(told["folder"])
    os.environ.clear()
    os.environ.update(told["environment"])
    from ipykernel.kernelapp import launch_new_instance

    launch_new_instance(argv=["-f", *told["arguments"], f"--IPKernelApp.parent_handle={parent}"])
    sys.exit()


def _ask(arguments: list[str]) -> None:
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(os.environ[_SOCKET])
    told = {"folder": os.getcwd(), "environment": dict(os.environ), "arguments": arguments}
    connection.sendall(json.dumps(told).encode() + b"\n")
    replies = connection.makefile()
    kernel = int(replies.readline())
    signal.signal(signal.SIGINT, lambda *_: os.kill(kernel, signal.SIGINT))
    # It writes no more, and the end of this line is its own.
    replies.readline()


if __name__ == "__main__":
    _ask(sys.argv[1:]) if sys.argv[1:] else _serve()
