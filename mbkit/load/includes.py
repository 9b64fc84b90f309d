"""MJCF written over several files: every <include> replaced by what it names, as MuJoCo does.

A name is looked for in the folder of the file that was asked for, then in that of the file which
names it; what stands inside the root element there takes the <include>'s place; no file is taken
twice. Unlike MuJoCo, only names relative to those folders are followed, so that a description
means the same wherever its folder is.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Final, NoReturn

from mbkit.errors import LoadError
from mbkit.load import xml
from mbkit.load.xml import MOST_BYTES, MOST_LEVELS, Element

__all__ = ["expanded"]

_TAG: Final = "include"


def expanded(mujoco: Element, path: Path) -> Element:
    """Return a <mujoco> element with the files that it includes.

    Parameters
    ----------
    mujoco : Element
        Of the file that was asked for; left as it is.
    path : pathlib.Path
        That file.

    Raises
    ------
    LoadError
        A file is missing, is no XML, is named by an absolute path, or is included twice.
    """
    if all(e.tag != _TAG for e in mujoco.walk()):
        return mujoco
    main = _Main(path)
    return replace(mujoco, children=main.inside(mujoco, path.parent, 1))


class _Main:
    """The file that was asked for, and what was taken into it so far."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.taken = {_identity(path)}
        self.bytes = 0

    def inside(self, element: Element, folder: Path, level: int) -> list[Element]:
        """Return the children of an element of a file in `folder`, `level` deep in the whole."""
        if level > MOST_LEVELS:
            self._refuse(element, f"elements are nested more than {MOST_LEVELS} deep, with what is included")
        out: list[Element] = []
        for child in element.children:
            if child.tag == _TAG:
                out += self._included(child, folder, level)
            else:
                out.append(replace(child, children=self.inside(child, folder, level + 1)))
        return out

    def _included(self, include: Element, folder: Path, level: int) -> list[Element]:
        name = include.attributes.get("file", "")
        if not name.strip():
            self._refuse(include, 'no file; write <include file="..."/>')
        if include.children:
            self._refuse(include, "has elements of its own; move them into the file, or beside the <include>")
        found = self._found(include, name, folder)
        identity = _identity(found)
        if identity in self.taken:
            self._refuse(include, "was included before, or includes itself; a file is taken once at most")
        self.taken.add(identity)
        root = self._read(include, found)
        if not root.children:
            self._refuse(include, f"<{root.tag[:60]}> in it is empty; expected elements inside")
        # A file counts as a level, so that a chain of them ends too.
        return self.inside(root, found.parent, level + 1)

    def _found(self, include: Element, name: str, folder: Path) -> Path:
        """Return the file that a name means."""
        # Written on Windows, and read so by MuJoCo everywhere.
        relative = PurePosixPath(name.replace("\\", "/"))
        if relative.is_absolute() or PureWindowsPath(name).drive:
            self._refuse(
                include, f"an absolute path is not followed; write it as seen from {self.path.parent}, or move it there"
            )
        folders = list(dict.fromkeys((self.path.parent, folder)))
        for place in folders:
            try:
                if (place / relative).exists():
                    return place / relative
            except OSError as error:
                self._refuse(include, f"cannot be read ({error.strerror})")
        return self._refuse(include, f"no such file in {' or '.join(str(f) for f in folders)}")

    def _read(self, include: Element, path: Path) -> Element:
        try:
            root = xml.read(path)
            self.bytes += path.stat().st_size
        except (LoadError, OSError) as error:
            self._refuse(include, str(error))
        if self.bytes > MOST_BYTES:
            self._refuse(include, f"up to {MOST_BYTES} bytes of included files were expected")
        told = _told(path, self.path.parent)
        for element in root.walk():
            element.file = told
            element.included_at = include.included_at or include.line
        return root

    def _refuse(self, element: Element, why: str) -> NoReturn:
        named = f' file="{element.attributes["file"][:200]}"' if element.attributes.get("file") else ""
        raise LoadError(f"{self.path}: {element.place}: <{element.tag}{named}>: {why}")


def _identity(path: Path) -> Path:
    # However it is spelt, and through whatever links.
    return path.resolve()


def _told(path: Path, folder: Path) -> str:
    try:
        return str(path.relative_to(folder))
    except ValueError:
        return str(path)
