"""Virtual environments that hold one version of an engine and NumPy, made once and kept.

They are below the user's cache folder, or below ``MBKIT_ENVIRONMENTS``. One is built under another name and renamed
when its engine has been imported in it, so that what stands under its own name is whole; a file lock keeps two
processes from building the same one, and the next builder removes what another left half made.
"""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from packaging.version import InvalidVersion, Version
from platformdirs import user_cache_path

from mbkit._child_process import START_SECONDS
from mbkit.errors import OutputError, UnknownNameError, UnsupportedError

#: Words of pip where a version does not exist, or where it reached no index.
_VERSIONS: Final = re.compile(r"from versions: ([^)]*)\)")
_NO_VERSION: Final = "there is no version of"
_AVAILABLE: Final = re.compile(r"^Available versions: (.+)$", re.MULTILINE)
#: A shared library that the system does not find.
_LIBRARY: Final = re.compile(r"(lib[\w+-]+)\.so[.\d]*: cannot open shared object")
_OLD_NUMPY: Final = "numpy<2"
#: Bounds on dependencies that are tried, one after the other.
_MAX_DEPENDENCY_BOUNDS: Final = 12

Report = Callable[[str], object]


def _print(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def folder() -> Path:
    """Return the folder of the environments."""
    chosen = os.environ.get("MBKIT_ENVIRONMENTS")
    try:
        return Path(chosen).absolute() if chosen else user_cache_path("mbkit") / "environments"
    except RuntimeError:
        # platformdirs, of a user without a home.
        raise OutputError("no home folder for environments; set MBKIT_ENVIRONMENTS to a folder") from None


def place(distribution: str, version: str) -> Path:
    """Return where the environment of a version is, whether it exists or not."""
    return folder() / f"{distribution}-{version}-cp{sys.version_info[0]}{sys.version_info[1]}"


def python_of(environment: Path) -> Path:
    """Return an environment's interpreter."""
    return environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def is_version(text: str) -> bool:
    """Return whether a text is a version."""
    with contextlib.suppress(InvalidVersion):
        return bool(Version(text))
    return False


def exists(distribution: str, version: str) -> bool:
    """Return whether the environment is there."""
    return python_of(place(distribution, version)).exists()


def interpreter(distribution: str, version: str, module: str, report: Report = _print, extra: str = "") -> Path:
    """Return the interpreter of a version's environment, which is made where there is none.

    Parameters
    ----------
    distribution, version : str
        As pip installs them.
    module : str
        That can be imported then.
    report : callable
        Gets a line when an environment is begun, and one when it is there.
    extra : str
        Of the distribution, such as ``"[sim]"``.

    Raises
    ------
    UnknownNameError
        No such version; with those that there are.
    UnsupportedError
        It cannot be installed, with pip's reason.
    OutputError
        The folder cannot be written.
    """
    path = place(distribution, version)
    if python_of(path).exists():
        return python_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _lock(path.parent / f".{path.name}.lock"):
            # Another process may have made it in the meantime.
            if not python_of(path).exists():
                _make(path, distribution, version, module, report, extra)
    except OSError as error:
        raise OutputError(
            f"cannot make an environment in {path.parent}: {error.strerror or error}; set MBKIT_ENVIRONMENTS to a "
            "folder that can be written"
        ) from None
    return python_of(path)


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    # Where there is no such lock, two processes that build at once both succeed: the second rename is refused.
    with path.open("w") as file:
        with contextlib.suppress(ImportError):
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _make(path: Path, distribution: str, version: str, module: str, report: Report, extra: str) -> None:
    half = path.with_name(f".{path.name}.part")
    shutil.rmtree(half, ignore_errors=True)
    name, start = f"{distribution} {version}", time.perf_counter()
    report(f"mbkit: making an environment of {name} in {path}")
    try:
        pip, limits = _empty(half), ["numpy"]
        _install(pip, distribution, version, limits, extra)
        # Old versions do not say how new their dependencies may be.
        while reason := _import_failure(half, module):
            if not (limit := _limit(half, reason, limits)):
                raise UnsupportedError(f"{name}: installed, but {module} cannot be imported: {reason}")
            limits.append(limit)
            _install(pip, distribution, version, limits, extra)
        os.replace(half, path)
    finally:
        shutil.rmtree(half, ignore_errors=True)
    report(f"mbkit: {name} is there, {size(path) / 1e6:.0f} MB, after {time.perf_counter() - start:.0f} s")


def size(path: Path) -> int:
    """Return the bytes that the files of a folder take."""
    return sum(f.lstat().st_size for f in path.rglob("*") if not f.is_dir())


def _empty(path: Path) -> list[str]:
    """Make an environment without packages, and return the command that installs into it."""
    python = str(python_of(path))
    if uv := shutil.which("uv"):
        _run([uv, "venv", "--quiet", "--python", sys.executable, str(path)], "uv")
        return [uv, "pip", "install", "--quiet", "--python", python]
    own = [] if find_spec("pip") else ["pip"]
    _run([sys.executable, "-m", "venv", *([] if own else ["--without-pip"]), str(path)], "venv")
    return [*([python, "-m", "pip"] if own else [sys.executable, "-m", "pip", "--python", python]), "install", "-q"]


def _limit(path: Path, reason: str, limits: Sequence[str]) -> str:
    """Return a bound on a dependency that may mend an import; empty where there is none left.

    A library of another soname than the one that is wanted belongs to a package that is too new. Else the engine may be
    compiled against an older interface of NumPy.
    """
    missing = _LIBRARY.search(reason)
    if missing is None:
        return "" if _OLD_NUMPY in limits else _OLD_NUMPY
    if len(limits) > _MAX_DEPENDENCY_BOUNDS:
        return ""
    for record in path.rglob("*.dist-info/RECORD"):
        if re.search(rf"/{re.escape(missing[1])}\.so[.,]", record.read_text(encoding="utf-8")):
            head = (record.parent / "METADATA").read_text(encoding="utf-8", errors="replace")
            name, version = (re.search(rf"^{key}: (.+)$", head, re.MULTILINE) for key in ("Name", "Version"))
            if name and version:
                return f"{name[1].strip()}<{version[1].strip()}"
    return ""


def _install(pip: Sequence[str], distribution: str, version: str, limits: Sequence[str], extra: str) -> None:
    wanted = f"{distribution}{extra}=={version}"
    # A compiler would take long, and versions without a wheel are rarely built by one.
    done = _finished([*pip, "--only-binary=:all:", wanted, *limits], 1800.0)
    if done.returncode == 0:
        return
    name = f"{distribution} {version}"
    found = _VERSIONS.search(done.stderr)
    known = [] if found is None else [x for x in map(str.strip, found[1].split(",")) if x and x != "none"]
    if _NO_VERSION in " ".join(done.stderr.split()):
        # uv does not say which there are.
        with contextlib.suppress(UnsupportedError):
            known = list(available(distribution))
    if known and version not in known:
        raise UnknownNameError(f"version of {distribution}", version, reversed(known), every=True)
    raise UnsupportedError(f"{name}: no environment of it can be made here; {_reason(done.stderr)}")


def available(distribution: str) -> tuple[str, ...]:
    """Return the versions that pip can install here, oldest first, without pre-releases.

    Raises `UnsupportedError` with pip's reason where it cannot tell.
    """
    if not find_spec("pip"):
        raise UnsupportedError(f"the versions of {distribution} are not known without pip; name them one by one")
    done = _finished([sys.executable, "-m", "pip", "index", "versions", distribution], START_SECONDS)
    found = _AVAILABLE.search(done.stdout)
    if found is None:
        raise UnsupportedError(f"the versions of {distribution} are not known; {_reason(done.stderr)}")
    return tuple(reversed([x.strip() for x in found[1].split(",")]))


def _reason(said: str) -> str:
    """Return what pip gave as the cause, in a line: a connection that failed, the cause that uv gives, or an error."""
    lines = [" ".join(line.split()) for line in said.splitlines() if line.strip()]
    broken = [x for x in lines if "connection" in x.lower() or "resolve" in x.lower()]
    causes, errors = ([x for x in lines if x.lower().startswith(word)] for word in ("cause: ", "error"))
    line = (broken[-1:] or causes[:1] or errors[:1] or lines[-1:] or ["it says nothing"])[0]
    return f"pip: {line[:400]}"


def _import_failure(path: Path, module: str) -> str:
    """Return why the interpreter of an environment cannot import a module; empty where it can."""
    done = _finished([str(python_of(path)), "-E", "-s", "-c", f"import numpy, {module}"], START_SECONDS)
    lines = [line for line in done.stderr.splitlines() if line.strip()]
    return "" if done.returncode == 0 else (lines or [f"status {done.returncode}"])[-1]


def _run(command: list[str], what: str) -> None:
    done = _finished(command, START_SECONDS)
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())
        raise UnsupportedError(f"no environment can be made here; {what}: {said[:400]}")


def _finished(command: Sequence[str], seconds: float) -> subprocess.CompletedProcess[str]:
    try:
        return subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=seconds, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(command, 1, "", f"ERROR: stopped after {seconds:.0f} s")
