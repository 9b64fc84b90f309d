"""The history of a description in git: which commits touched its files, and these files as a commit has them."""

from __future__ import annotations

import os
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Final

from mbkit.errors import UnsupportedError
from mbkit.load import xml_reader

#: Seconds that one call of git may take.
_LIMIT: Final = 120.0
#: Set by git in its hooks, where they would name another repository than the file's.
_HOOKS: Final = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_PREFIX")
_FORMAT: Final = "--format=%H%x1f%P%x1f%cI%x1f%s%x1e"
_SHORT: Final = 10
#: No line of git's before a content is longer.
_HEAD: Final = 200


@dataclass(frozen=True)
class Commit:
    """A commit: its hash, its parents' hashes, when it was made (ISO 8601), and the first line of its message."""

    hash: str
    parents: tuple[str, ...]
    date: str
    subject: str

    def __str__(self) -> str:
        return self.hash[:_SHORT]


class History:
    """Commits that touched the files that a description is read from.

    Of a URDF that is the file; of an MJCF everything in the folders of the file and of those that it includes. Files
    such as one of loops are named beside it.

    Raises
    ------
    UnsupportedError
        There is no git, or the description is in no repository of it.
    """

    def __init__(self, description: Path, beside: Sequence[Path] = ()) -> None:
        self._file = Path(os.path.realpath(description))
        self._top = self._file.parent
        self._top = Path(os.fsdecode(self._git("rev-parse", "--show-toplevel").rstrip(b"\r\n")))
        root = xml_reader.read(self._file)
        parts = [self._file]
        if root.tag != "robot":
            parts = list({file.parent for file in xml_reader.included_files(root, self._file)})
        self._parts = [x for part in [*parts, *beside] if (x := self._inside(part)) is not None]

    def _git(self, *words: str, stdin: bytes = b"") -> bytes:
        """Return what git prints on a repository that may be anybody's; raise `UnsupportedError` with its reason."""
        command = ["git", "-C", str(self._top), "--literal-pathspecs", "-c", "log.showSignature=false", *words]
        environment = {k: x for k, x in os.environ.items() if k not in _HOOKS} | {"LC_ALL": "C"}
        try:
            done = subprocess.run(command, input=stdin, capture_output=True, timeout=_LIMIT, env=environment)
        except FileNotFoundError:
            raise UnsupportedError(
                f"git is not installed, so no earlier version of {self._file.name} is known"
            ) from None
        except subprocess.TimeoutExpired:
            raise UnsupportedError(f"git {words[0]} was stopped after {_LIMIT:.0f} s in {self._top}") from None
        if done.returncode:
            said = " ".join(done.stderr.decode("utf-8", "replace").split())
            if "not a git repository" in said:
                raise UnsupportedError(f"{self._file} is in no git repository, so no earlier version of it is known")
            raise UnsupportedError(f"git {words[0]} in {self._top}: {said[:400]}")
        return done.stdout

    def _inside(self, path: Path) -> str | None:
        """Return a path as git names it; None outside of the repository."""
        real = Path(os.path.realpath(path))
        return real.relative_to(self._top).as_posix() if real.is_relative_to(self._top) else None

    @property
    def shallow(self) -> bool:
        """Whether the clone has the last commits alone."""
        return self._git("rev-parse", "--is-shallow-repository").strip() == b"true"

    def _log(self, *words: str, parts: Sequence[str]) -> list[Commit]:
        text = self._git("log", "--first-parent", _FORMAT, *words, "--", *parts).decode("utf-8", "replace")
        fields = [line.strip("\n").split("\x1f") for line in text.split("\x1e") if line.strip("\n")]
        return [Commit(sha, tuple(parents.split()), date, subject) for sha, parents, date, subject in reversed(fields)]

    def commits(self, since: Commit | None = None) -> list[Commit]:
        """Return the commits of this branch that touched the description, oldest first: those after a commit, or all.

        What came with a merge is that merge.
        """
        return self._log(f"{since.hash}..HEAD" if since else "HEAD", parts=self._parts)

    def merged_by(self, merge: Commit) -> list[Commit]:
        """Return the commits that touched the description and came with a merge, oldest first."""
        first, *others = merge.parents
        return self._log(f"^{first}", *others, parts=self._parts) if others else []

    def last_of(self, path: Path) -> Commit | None:
        """Return the last commit that touched a file; None for a file that is not committed."""
        name = self._inside(path)
        return None if name is None else next(iter(self._log("-1", "HEAD", parts=[name])), None)

    @contextmanager
    def files_at(self, commit: Commit | None) -> Iterator[Path]:
        """Give the folder that stands for the repository's at a commit, with the description's files; None is now."""
        if commit is None:
            yield self._top
            return
        with tempfile.TemporaryDirectory(prefix="mbkit-") as folder:
            self._write(commit, Path(folder))
            yield Path(folder)

    def within(self, folder: Path, path: Path) -> Path:
        """Return where a file is, in a folder of `files_at`; one of no repository stays where it is."""
        name = self._inside(path)
        return path if name is None else folder / name

    def _write(self, commit: Commit, folder: Path) -> None:
        listed = self._git("ls-tree", "-r", "-z", "--full-tree", commit.hash, "--", *self._parts)
        files: list[tuple[PurePosixPath, bytes]] = []
        for entry in listed.split(b"\0")[:-1]:
            head, _, name = entry.partition(b"\t")
            mode, _, blob = head.split()
            path = PurePosixPath(os.fsdecode(name))
            # Plain files alone: no links, no other repositories, and nothing outside of the folder.
            if mode.startswith(b"100") and not path.is_absolute() and ".." not in path.parts:
                files.append((path, blob))
        content = memoryview(self._git("cat-file", "--batch", stdin=b"".join(blob + b"\n" for _, blob in files)))
        for path, blob in files:
            # A line of hash, kind and size; the content; an end of line.
            head, _, _ = bytes(content[:_HEAD]).partition(b"\n")
            if not head.startswith(blob) or b" blob " not in head:
                raise UnsupportedError(f"git has no content of {path} at {commit}")
            size = int(head.split()[-1])
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(content[len(head) + 1 :][:size])
            content = content[len(head) + size + 2 :]
