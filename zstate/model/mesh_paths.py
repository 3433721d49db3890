"""Files that a URDF names as package://, file:// or plain paths; nothing is fetched from the network.

A received description may come from anybody, and its files are shown to every user of the page. So it
gets only files in packages on the search path, and errors that do not depend on the existence of any other
file. The URDF file that the user named gets every file that the user can read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from urllib.parse import unquote, urlsplit

from zstate.model.catalog import package_folders

_MAX_DEPTH = 4  # repositories hold packages in folders of folders
_NOT_PACKAGES = {"meshes", "urdf"}  # inside a package, and large
_PACKAGE_SCHEMES = {"package", "model"}
_NAME = re.compile(rb"<name>([^<]*)</name>")
_MAX_PACKAGE_XML_BYTES = 65536
_NO_FILE = "there is no such file"
_ONLY_PACKAGES = (
    "a description that was received gets files in packages only: write package://NAME/PATH, or name the "
    "URDF file, as in `zstate view arm.urdf`"
)


@dataclass(frozen=True, slots=True)
class MissingFile:
    """A file of a robot that cannot be drawn, with the reason and the folders that were searched."""

    uri: str
    reason: str
    searched: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """The reason, and the folders that were searched."""
        return f"{self.reason}; searched in {', '.join(self.searched)}" if self.searched else self.reason


class MeshPaths:
    """Finds the files that a URDF names.

    ``package://NAME/PATH`` and ``package:///NAME/PATH`` are searched in this order: the folders around
    ``base``; ROS_PACKAGE_PATH; AMENT_PREFIX_PATH; and the installed files of example-robot-data and
    robot_descriptions. ``base`` is the folder of a URDF file that the user named: relative paths start
    there, and every file can be found. With None, the description was received: only files in packages are
    found, and no ``..`` or symbolic link leads out of one. A package is then a folder with a package.xml, as
    in ROS, or a folder in share/ or in one of the collections.
    """

    def __init__(self, base: Path | None = None) -> None:
        self._base = None if base is None else _absolute(base)
        self._ancestors = () if self._base is None else (self._base, *self._base.parents)
        # Folders with packages directly in them.
        self._shares = [prefix / "share" for prefix in _path_list("AMENT_PREFIX_PATH")]
        # Folders that are a package, or have packages somewhere below them.
        # In a collection every folder counts as one.
        self._collections = package_folders()
        self._search_roots = [*_path_list("ROS_PACKAGE_PATH"), *self._collections]

    def find(self, uri: str) -> Path | MissingFile:
        """The file of that name, or why there is none."""
        scheme, separator, rest = uri.partition("://")
        if not separator:
            return self._find_path(uri, Path(uri))
        if scheme in _PACKAGE_SCHEMES:
            return self._find_in_package(uri, unquote(rest).lstrip("/"))
        if scheme == "file":
            return self._find_path(uri, Path("/" + unquote(urlsplit(uri).path).lstrip("/")))
        return MissingFile(uri, f"{scheme}:// is not fetched; name it as package://NAME/PATH or file:///PATH")

    def _find_path(self, uri: str, path: Path) -> Path | MissingFile:
        """A plain path; from a received description only if it could be written as package://."""
        if self._base is not None:
            found = self._base / path
            return found if _succeeds(found.is_file) else MissingFile(uri, _NO_FILE, (str(found.parent),))
        if not path.is_absolute():
            reason = "a relative path means nothing without the folder of its URDF; write package://NAME/PATH"
            return MissingFile(uri, reason)
        for root in (*self._shares, *self._search_roots):
            if root not in path.parents or ".." in path.parts:
                continue
            above = path.parents[: len(path.parts) - len(root.parts)]
            if any(self._is_package(one, root) and _is_within(path, one, one.name) for one in above):
                return path if _succeeds(path.is_file) else MissingFile(uri, _NO_FILE, (str(path.parent),))
        return MissingFile(uri, _ONLY_PACKAGES)

    def _find_in_package(self, uri: str, path: str) -> Path | MissingFile:
        package, _, rest = path.partition("/")
        if package in ("", ".", ".."):
            return MissingFile(uri, f"{package!r} is not a package name")
        found = [folder for folder in self._ancestors if folder.name == package]
        inside = [(folder, folder / package) for folder in (*self._ancestors, *self._shares)]
        found += [one for root, one in inside if _succeeds(one.is_dir) and self._is_package(one, root)]
        folders = list(dict.fromkeys(found + self._folders_by_name.get(package, [])))
        allowed = [one for one in folders if self._base or _is_within(one / rest, one, package)]
        for folder in allowed:
            if _succeeds((folder / rest).is_file):
                return folder / rest
        if allowed:
            return MissingFile(uri, f"the package {package!r} has no such file", tuple(map(str, allowed)))
        if folders:
            return MissingFile(uri, f"it leads out of the package {package!r}", tuple(map(str, folders)))
        return MissingFile(
            uri,
            f"there is no package {package!r}; put its folder, with a package.xml, into ROS_PACKAGE_PATH",
            tuple(str(folder) for folder in (*self._ancestors, *self._shares, *self._search_roots)),
        )

    def _is_package(self, folder: Path, root: Path) -> bool:
        """Whether a folder at or below ``root`` is a package; for a URDF that the user named each one is."""
        if self._base is not None or _succeeds((folder / "package.xml").is_file):
            return True
        is_shared = root in self._shares and folder.parent == root
        return (is_shared or (root in self._collections and folder != root)) and _is_within(folder, root, "")

    @cached_property
    def _folders_by_name(self) -> dict[str, list[Path]]:
        """Every package of the search roots by the name of its folder, breadth first."""
        found: dict[str, list[Path]] = {}
        for root in self._search_roots:
            level = [root]
            for _ in range(_MAX_DEPTH + 1):
                for folder in level:
                    if self._is_package(folder, root):
                        found.setdefault(folder.name, []).append(folder)
                level = [below for folder in level for below in _package_candidates(folder)]
        return found


def _package_candidates(folder: Path) -> list[Path]:
    """The folders in a folder that may be packages or hold some."""
    try:
        with os.scandir(folder) as entries:
            names = (one for one in entries if one.name not in _NOT_PACKAGES and one.name[0] != ".")
            return sorted(Path(one) for one in names if one.is_dir())
    except OSError:
        return []


def _path_list(variable: str) -> list[Path]:
    parts = os.environ.get(variable, "").split(os.pathsep)
    return [_absolute(Path(part)) for part in parts if part]


def _absolute(path: Path) -> Path:
    """A path with a name and with folders above it, which ``.`` does not have."""
    return Path(os.path.abspath(path))  # noqa: PTH100 - resolve() would follow links, which have names too


def _is_within(path: Path, folder: Path, package: str) -> bool:
    """Whether ``path``, which need not exist, is in ``folder`` after all links are resolved.

    ``colcon build --symlink-install`` installs links to the sources of a package, so a link may also lead
    to a folder whose package.xml names the same ``package``.
    """
    try:
        end, top = path.resolve(), folder.resolve()
    except (OSError, ValueError, RuntimeError):  # a loop of links, or an invalid name
        return False
    return end.is_relative_to(top) or (
        package != "" and any(_package_name(above) == package for above in end.parents)
    )


def _package_name(folder: Path) -> str | None:
    """The name of the package in a folder, by its package.xml."""
    try:
        with (folder / "package.xml").open("rb") as file:
            found = _NAME.search(file.read(_MAX_PACKAGE_XML_BYTES))
    except OSError:
        return None
    return None if found is None else found[1].decode(errors="replace").strip()


def _succeeds(check: Callable[[], bool]) -> bool:
    """Whether a check of a path is true; False if the path is invalid or cannot be reached."""
    try:
        return check()
    except (OSError, ValueError):
        return False
