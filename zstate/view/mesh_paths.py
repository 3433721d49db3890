"""MeshPaths: the files that robots name as package://, file:// or plain paths. Never the network.

A description that was received may be anybody's, and what it names is shown to everybody who opens the
page. So it gets files in packages that the search path finds, and an answer that does not depend on any
other file. The description in a file that the user named gets every file, as its owner does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote, urlsplit

from zstate.model.catalog import package_folders

_DEEPEST = 4  # repositories hold packages in folders of folders
_NOT_PACKAGES = {"meshes", "urdf"}  # inside one, and large
_IN_PACKAGES = {"package", "model"}
_HOW = "put the folder of the package into ROS_PACKAGE_PATH"
_NAME = re.compile(rb"<name>([^<]*)</name>")
_MOST_OF_PACKAGE_XML = 65536
_ONLY_PACKAGES = (
    "a description that was received gets files in packages only: write package://NAME/PATH, or name the "
    "URDF file, as in `zstate view arm.urdf`"
)


@dataclass(frozen=True, slots=True)
class MissingFile:
    """A file that a robot names and that cannot be drawn: why, and where it was looked for."""

    uri: str
    reason: str
    looked: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """The reason, and where it was looked for."""
        return f"{self.reason}; looked in {', '.join(self.looked)}" if self.looked else self.reason

    def __str__(self) -> str:
        return f"{self.uri}: {self.why}"


class MeshPaths:
    """Finds files as they are named in a URDF.

    ``package://NAME/PATH`` and ``package:///NAME/PATH`` are looked for in, by turns: the folders around
    ``base``; ROS_PACKAGE_PATH; AMENT_PREFIX_PATH; and what example-robot-data and robot_descriptions have
    installed. ``base`` is the folder of a URDF file that the user named: relative paths start there, and
    every file can be found. With None, the description was received: files in packages only, and no ``..``
    or symbolic link leads out of one.
    """

    def __init__(self, base: Path | None = None) -> None:
        self._base = None if base is None else _absolute(base)

    def find(self, uri: str) -> Path | MissingFile:
        """The file of that name, or why there is none."""
        scheme, separator, rest = uri.partition("://")
        if not separator:
            return self._plain(uri, Path(uri))
        if scheme in _IN_PACKAGES:
            return self._in_package(uri, unquote(rest).lstrip("/"))
        if scheme == "file":
            return self._plain(uri, Path("/" + unquote(urlsplit(uri).path).lstrip("/")))
        return MissingFile(uri, f"{scheme}:// is not fetched; name it as package://NAME/PATH or file:///PATH")

    def _plain(self, uri: str, path: Path) -> Path | MissingFile:
        if self._base is None:
            return self._on_search_path(uri, path)
        found = self._base / path
        return found if _is_file(found) else MissingFile(uri, "there is no such file", (str(found.parent),))

    def _on_search_path(self, uri: str, path: Path) -> Path | MissingFile:
        """A path that a received description names: only what it could have named as package://."""
        if not path.is_absolute():
            reason = "a relative path means nothing without the folder of its URDF; write package://NAME/PATH"
            return MissingFile(uri, reason)
        for folder in (*self._shares, *self._forests):
            if folder in path.parents and _is_within(path, folder, path.parts[len(folder.parts)]):
                return (
                    path if _is_file(path) else MissingFile(uri, "there is no such file", (str(path.parent),))
                )
        return MissingFile(uri, _ONLY_PACKAGES)

    def _in_package(self, uri: str, path: str) -> Path | MissingFile:
        package, _, rest = path.partition("/")
        if package in ("", ".", ".."):
            return MissingFile(uri, f"{package!r} is no name of a package")
        folders = list(dict.fromkeys(self._packages(package)))
        allowed = [one for one in folders if self._base or _is_within(one / rest, one, package)]
        for folder in allowed:
            if _is_file(folder / rest):
                return folder / rest
        if allowed:
            return MissingFile(uri, f"the package {package!r} has no such file", tuple(map(str, allowed)))
        if folders:
            return MissingFile(uri, f"it leads out of the package {package!r}", tuple(map(str, folders)))
        looked = tuple(str(folder) for folder in (*self._around, *self._shares, *self._forests))
        return MissingFile(uri, f"there is no package {package!r}; {_HOW}", looked)

    def _packages(self, name: str) -> Iterator[Path]:
        for folder in self._around:
            if folder.name == name:
                yield folder
        for folder in (*self._around, *self._shares):
            if _is_folder(folder / name):
                yield folder / name
        yield from self._grown.get(name, ())

    @cached_property
    def _around(self) -> Sequence[Path]:
        return () if self._base is None else (self._base, *self._base.parents)

    @cached_property
    def _shares(self) -> Sequence[Path]:
        """Folders that have packages directly in them."""
        return [prefix / "share" for prefix in _listed("AMENT_PREFIX_PATH")]

    @cached_property
    def _forests(self) -> Sequence[Path]:
        """Folders that have packages somewhere below them, or are one."""
        return [*_listed("ROS_PACKAGE_PATH"), *package_folders()]

    @cached_property
    def _grown(self) -> dict[str, list[Path]]:
        """Every folder of the forests by its name, the shallow ones first."""
        found: dict[str, list[Path]] = {}
        for forest in self._forests:
            for folder in _walk(forest):
                found.setdefault(folder.name, []).append(folder)
        return found


def _walk(top: Path) -> Iterator[Path]:
    level = [top]
    for _ in range(_DEEPEST + 1):
        yield from level
        level = [below for folder in level for below in _folders_in(folder)]


def _folders_in(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return sorted(Path(one) for one in entries if _may_be_package(one))
    except OSError:
        return []


def _may_be_package(entry: os.DirEntry[str]) -> bool:
    return entry.name not in _NOT_PACKAGES and not entry.name.startswith(".") and entry.is_dir()


def _listed(variable: str) -> list[Path]:
    parts = os.environ.get(variable, "").split(os.pathsep)
    return [_absolute(Path(part)) for part in parts if part]


def _absolute(path: Path) -> Path:
    """A path with a name and with folders above it, which ``.`` has not."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() would follow links, which have names too


def _is_within(path: Path, folder: Path, package: str = "") -> bool:
    """Whether ``path``, which need not exist, is in ``folder`` once every link in it has been followed.

    ``colcon build --symlink-install`` installs links to the sources of a package, so a link may also lead
    to a folder whose package.xml names the same ``package``.
    """
    try:
        end, top = path.resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError):  # a loop of links, or a name that no file can have
        return False
    return end.is_relative_to(top) or (package != "" and any(_is_named(package, one) for one in end.parents))


def _is_named(package: str, folder: Path) -> bool:
    """Whether a folder holds the package of that name, by its package.xml."""
    try:
        with (folder / "package.xml").open("rb") as file:
            found = _NAME.search(file.read(_MOST_OF_PACKAGE_XML))
    except OSError:
        return False
    return found is not None and found[1].decode(errors="replace").strip() == package


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False
