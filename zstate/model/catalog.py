"""Catalog of robots by name, such as "panda", with their URDF files. Never uses the network.

Collections, in this order: zstate's own models/, the example-robot-data package, and the existing clones
of robot_descriptions.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib import metadata, util
from pathlib import Path

from zstate._util.format import suggestion_text
from zstate.errors import UnknownModel
from zstate.model.findings import quoted

_HERE = Path(__file__).resolve()

# Common names of files that are called otherwise; paths in example-robot-data/robots.
_ALIASES = {
    "alexander": "alexander_description/urdf/alexander_v1.lowerBodyOnly.urdf",
    "allegro": "allegro_hand_description/urdf/allegro_right_hand.urdf",
    "anymal": "anymal_b_simple_description/robots/anymal.urdf",
    "anymal_b": "anymal_b_simple_description/robots/anymal.urdf",
    "anymal_c": "anymal_c_simple_description/urdf/anymal.urdf",
    "borinot": "borinot_description/urdf/borinot_flying_arm_2.urdf",
    "g1": "g1_description/urdf/g1_29dof_rev_1_0.urdf",
    "g1_with_hands": "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
    "hector": "hector_description/robots/quadrotor_base.urdf",
    "hextilt": "hextilt_description/urdf/hextilt_flying_arm_5.urdf",
    "hyq": "hyq_description/robots/hyq_no_sensors.urdf",
    "talos": "talos_data/robots/talos_reduced.urdf",
    "talos_arm": "talos_data/robots/talos_left_arm.urdf",
    "talos_full": "talos_data/robots/talos_full_v2.urdf",
    "ur3": "ur_description/urdf/ur3_robot.urdf",  # ur3.urdf there is a stub without links
}


@dataclass(frozen=True, slots=True)
class CatalogEntry:
    """A robot that ``load_model`` finds by name, its file, and the collection of the file."""

    name: str
    path: Path
    origin: str


def catalog() -> tuple[CatalogEntry, ...]:
    """Every robot, sorted by name; the first collection that has a name wins."""
    entries: dict[str, CatalogEntry] = {}
    for origin, collect in _COLLECTIONS.items():
        for name, path in collect().items():
            entries.setdefault(name, CatalogEntry(name, path, origin))
    return tuple(entries[name] for name in sorted(entries))


def find_entry(name: str) -> CatalogEntry:
    """The entry of that name, regardless of case, ``-`` for ``_``, and a final ``_description``.

    Raises UnknownModel with near misses, the searched collections, and what to install.
    """
    normal = _normal(name)
    for origin, collect in _COLLECTIONS.items():
        path = collect().get(normal)
        if path is not None:
            return CatalogEntry(normal, path, origin)
    entries = catalog()
    near = get_close_matches(normal[:100], [entry.name for entry in entries], n=3)
    parts = [f"no robot is called {quoted(name)}{suggestion_text(*near)}"]
    counts = {origin: sum(entry.origin == origin for entry in entries) for origin in _COLLECTIONS}
    searched = ", ".join(f"{origin} ({count} names)" for origin, count in counts.items())
    parts.append(f"looked in {searched}; a path to a file works as well")
    if not counts["example-robot-data"]:
        parts.append("for many more robots, pip install 'zstate[robots]'")
    raise UnknownModel(name, near, "; ".join(parts))


def example_name() -> str:
    """The robot for examples and advice: panda if it is installed, else rrbot."""
    return "panda" if any("panda" in collect() for collect in _COLLECTIONS.values()) else "rrbot"


def package_folders() -> tuple[Path, ...]:
    """The folders with the packages of the collections, which contain the meshes of their robots."""
    folders = [folder.parents[1] for folder in _example_folders()] + list(_example_folders())
    if util.find_spec("robot_descriptions") is not None:
        folders.append(_cloned())
    return tuple(folder for folder in folders if folder.is_dir())


def _bundled() -> dict[str, Path]:
    # Next to the modules when installed, next to the package in a checkout.
    for folder in (_HERE.parents[1] / "models", _HERE.parents[2] / "models"):
        if folder.is_dir():
            return _by_stem(folder.glob("*.urdf"))
    return {}


@cache
def _example_robot_data() -> dict[str, Path]:
    robots = next((folder for folder in _example_folders() if folder.is_dir()), None)
    if robots is None:
        return {}
    aliases = {name: robots / path for name, path in _ALIASES.items()}
    found = _by_stem(robots.glob("*/*/*.urdf"))
    return found | {name: path for name, path in aliases.items() if path.is_file()}


def _example_folders() -> Iterator[Path]:
    tail = Path("share", "example-robot-data", "robots")
    try:
        package = metadata.distribution("example-robot-data")
    except metadata.PackageNotFoundError:
        pass
    else:
        yield Path(str(package.locate_file("cmeel.prefix"))) / tail
    yield Path(sys.prefix) / tail


@cache
def _robot_descriptions() -> dict[str, Path]:
    # Its modules clone repositories when imported, so only its cache is read.
    if util.find_spec("robot_descriptions") is None:
        return {}
    return _by_stem(_cloned().rglob("*.urdf"))


def _cloned() -> Path:
    default = "~/.cache/robot_descriptions"
    return Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", default)).expanduser()


_COLLECTIONS: dict[str, Callable[[], dict[str, Path]]] = {
    "zstate": _bundled,
    "example-robot-data": _example_robot_data,
    "robot_descriptions": _robot_descriptions,
}


def _by_stem(paths: Iterable[Path]) -> dict[str, Path]:
    """Files by name; among files of one name, the one with the shortest path."""
    named: dict[str, Path] = {}
    for path in sorted(paths, key=lambda path: (len(str(path)), str(path))):
        named.setdefault(_normal(path.stem), path)
    return named


def _normal(name: str) -> str:
    return name.strip().lower().replace("-", "_").removesuffix("_description").removesuffix("_robot")
