"""Worker processes: results and exceptions come back, and a crash, a hang and a want of memory have a name."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import pytest

from mbkit._child_process import OUT_OF_MEMORY, WorkerClosedError, WorkerDiedError, WorkerTimeoutError
from mbkit.errors import InputError
from mbkit.studies.worker import CallError, RemoteError, Worker, in_worker, report_stage, run


class StubbornError(Exception):
    """Cannot be sent: it needs two arguments."""

    def __init__(self, one: str, other: str) -> None:
        super().__init__(f"{one} and {other}")


def stubborn() -> None:
    raise StubbornError("this", "that")


def refuse() -> None:
    raise InputError("not this one")


def hang(stage: str = "") -> None:
    if stage:
        report_stage(stage)
    while True:
        pass


def wait_for_ever() -> None:
    threading.Event().wait()


@pytest.fixture(scope="module")
def worker():
    worker = Worker(memory=2**30)
    yield worker
    worker.end()


def test_results_and_exceptions_come_back_from_one_process(worker):
    first = worker.call(os.getpid)
    assert first != os.getpid()
    assert worker.call(in_worker)
    assert not in_worker()
    with pytest.raises(InputError, match="not this one"):
        worker.call(refuse)
    with pytest.raises(RemoteError, match="StubbornError: this and that"):
        worker.call(stubborn)
    with pytest.raises(RemoteError, match="SystemExit: 3"):
        worker.call(partial(exec, "raise SystemExit(3)"))
    assert worker.call(os.getpid) == first
    # And each has its own folder.
    assert worker.call(os.getcwd) != os.getcwd()


def test_a_crash_is_named_and_the_next_call_has_a_new_process(worker):
    first = worker.call(os.getpid)
    with pytest.raises(WorkerDiedError, match="SIGABRT") as caught:
        worker.call(partial(exec, "import os; print('the last words', flush=True); os.abort()"))
    assert (caught.value.signal, caught.value.last) == ("SIGABRT", "the last words")
    with pytest.raises(WorkerDiedError, match="status 7"):
        worker.call(os._exit, 7)
    with pytest.raises(MemoryError):
        worker.call(bytearray, 2**31)
    with pytest.raises(WorkerDiedError, match=OUT_OF_MEMORY):
        worker.call(partial(exec, "import os; os.write(2, b'std::bad_alloc'); os.abort()"))
    assert worker.call(os.getpid) != first


@pytest.mark.thorough("hang")
@pytest.mark.parametrize("function", [hang, wait_for_ever])
def test_what_computes_too_long_or_not_at_all_is_ended(worker, function):
    with pytest.raises(WorkerTimeoutError, match="stopped after"):
        worker.call(function, cpu_seconds=0.1)
    assert worker.call(abs, -1) == 1


def test_a_stage_has_a_limit_of_its_own(worker):
    with pytest.raises(WorkerTimeoutError):
        worker.call(hang, "endless", stage_seconds={"endless": 0.1})
    assert worker.stage == "endless"


def test_a_function_that_the_process_cannot_import_is_the_callers_mistake(worker):
    class Here:
        pass

    Here.__qualname__, Here.__module__ = "Nowhere", "tests.test_worker"
    globals()["Nowhere"] = Here
    with pytest.raises(CallError, match="Nowhere"):
        worker.call(Here)


def test_another_thread_can_close_it():
    worker = Worker()
    worker.call(abs, 1)
    with ThreadPoolExecutor(1) as thread:
        call = thread.submit(worker.call, wait_for_ever)
        while worker._busy is False:
            pass
        worker.close()
        with pytest.raises(WorkerClosedError):
            call.result()
    with pytest.raises(WorkerClosedError):
        worker.call(abs, 1)


_PARENT = """
import os, sys, threading
from pathlib import Path
from mbkit.studies.worker import Worker

hang, *home = sys.argv[1:]
worker = Worker(*map(Path, home))
print(worker.call(os.getpid), worker.call(os.getcwd), flush=True)
if hang:
    worker.begin(exec, hang)
    print("begun", flush=True)
threading.Event().wait()
"""


#: Does not let other threads run.
_IN_A_LIBRARY = "import re; re.match('(a+)+$', 'a' * 99 + 'b')"


@pytest.mark.thorough("-False", "import re; re.match('(a+)+$', 'a' * 99 + 'b')-False")
@pytest.mark.parametrize(("hang", "own_home"), [("", False), ("while True: pass", True), (_IN_A_LIBRARY, False)])
def test_a_worker_whose_parent_is_killed_ends_and_removes_its_folder(hang, own_home, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    command = [sys.executable, "-c", _PARENT, hang, *([str(home)] if own_home else [])]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        pid, folder = parent.stdout.readline().split(maxsplit=1)
        if hang:
            assert parent.stdout.readline() == "begun\n"
        parent.send_signal(signal.SIGKILL)
    gone = home if own_home else Path(folder.strip())
    # No thread removes the folder of what hangs in a library; the kernel ends it.
    while _runs(int(pid)) or (gone.exists() and hang != _IN_A_LIBRARY):
        time.sleep(0.01)
    if gone.exists():
        shutil.rmtree(gone)


def _runs(pid: int) -> bool:
    """Return whether a process runs; one that ended and that no parent has read the status of does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_no_calls_take_no_workers():
    assert list(run({})) == []
