"""The floors of zstate: imports look down, each library has one home, the pure rooms stay pure.

Read from the import statements, so that nothing needs to run; laziness is seen in a fresh interpreter.
"""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import chain
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S

from zstate.extension import kernel
from zstate.plugins import built_in_plugins

PACKAGE = Path(__file__).parent.parent / "zstate"

# The plugins that stand on others; below the rest is only the core.
_ABOVE = {"archive", "recording", "bridges", "metrics", "foxglove", "view"}
_PLUGINS = {plugin.name for plugin in built_in_plugins()}

# From the ground up. Rooms of one floor do not know each other, but for the neighbours below.
FLOORS = (
    {"_util", "_kernel"},
    {"errors"},
    {"checks", "extension", "web_access"},
    {"clock", "message"},
    {"streams"},
    {"se3", "rate", "plugins"},
    {"covariance", "other_plugins"},
    {"stream_registry"},
    {"transform"},
    {"model", "buffer", "wire"},
    {"ingest"},
    {"net"},
    {"sources"},
    {"nodes"},
    _PLUGINS - _ABOVE,
    {"bridges", "recording"},
    {"archive"},
    {"zstate"},
    {"metrics", "foxglove"},
    {"view", "cli"},
    {f"{plugin}.cli" for plugin in _PLUGINS if any(PACKAGE.glob(f"{plugin}/cli*"))},
    {"__main__"},
)
NEIGHBOURS = {
    ("buffer", "model"),  # joint tracks are kept as positions, and become poses in a lookup
    ("cli", "odometry.cli"),  # `zstate demo rover`
    ("odometry.cli", "driving.cli"),  # the wheels of that are a driver
    ("odometry.cli", "recording.cli"),  # `zstate odometry --replay FILE --plot`
}

# The modules of the buffer that other packages may import.
BUFFER_MODULES = {
    *("buffer", "edge_rules", "feed", "frame_tree", "joint_samples", "projection", "snapshot"),
    *("stored_samples", "tracks"),
}

HOMES = {
    "pinocchio": "model",
    "xacro": "model",
    "xacrodoc": "model",
    "msgspec": "wire",
    "zenoh": "net",
    "cryptography": "fleet",
    "xxhash": "wire",
    "mcap": "recording",
    "pyarrow": "recording",  # `zstate export`
    "duckdb": "archive",
    "lz4": "recording",
    "zstandard": "recording",
    "rospy": "bridges",
    "geometry_msgs": "bridges",
    "rosgraph_msgs": "bridges",
    "sensor_msgs": "bridges",
    "std_msgs": "bridges",
    "tf2_msgs": "bridges",
    "prometheus_client": "metrics",
    "pygeomag": "odometry",
    "av": "cameras",
    "simplejpeg": "cameras",
    "viser": "view",
    "websockets": "foxglove",
    "trimesh": "view",
    "collada": "view",
    "PIL": "view",
    "click": "cli",
    "matplotlib": "cli",  # `zstate plot`
    "rich": "cli",
    "tomli_w": "cli",  # `zstate snapshot save`
    "tomllib": "cli",
    "yaml": "recording",
}
EVERYWHERE = {"numpy"}
GUESTS = {
    ("message.py", "msgspec"),  # the base classes of messages
    *((f"{plugin}/messages.py", "msgspec") for plugin in _PLUGINS),  # their classes
    # `zstate up FILE.toml`: a file is read into frozen types as a message is
    ("recording/cli/snapshot_file.py", "msgspec"),
    ("odometry/cli/settings_file.py", "msgspec"),
    ("cli/up/cell.py", "msgspec"),
    ("cli/up/command_table.py", "msgspec"),
    ("driving/cli/drive.py", "msgspec"),  # so is --param, into the types that a driver annotates
    ("archive/storage.py", "pyarrow"),
    ("clouds/compression.py", "lz4"),
    ("clouds/compression.py", "zstandard"),
    ("cameras/simulated_camera.py", "PIL"),
    ("scans/map_files.py", "PIL"),
    ("transform.py", "pinocchio"),  # `Transform.se3`, when it is read
    ("view/browser_messages.py", "msgspec"),  # what viser's page sends
    ("view/server.py", "websockets"),  # what viser's server is made of
    ("web_access.py", "websockets"),  # the end of both servers
    # each reads one kind of file in YAML
    ("cli/up/static_edges.py", "yaml"),
    ("scans/map_metadata.py", "yaml"),
    ("cameras/calibration_file.py", "yaml"),
}

# Not in what the two nodes load when they are imported: a reader of "joint positions in, poses out" passes
# them by. Plugins, security, and what observes readers and writers.
PLUGINS = _PLUGINS | {"cli"}
OBSERVERS = {
    "ingest.deadline",
    "ingest.events",
    "ingest.stamp_checks",
    "net.clock_offset",
    "net.connection_monitor",
    "net.graph",
    "net.router_losses",
    "net.status_monitor",
    "net.topic_statistics",
    "nodes.listener_diagnostics",
}

# What some programs use, and is loaded then: not by publishing, nor by listening and looking up.
ON_USE = {
    "_util.html",
    "_util.other_names",
    "buffer.covariance_path",
    "buffer.joint_samples",
    "buffer.message_filter",
    "buffer.plan",
    "buffer.projection",
    "buffer.snapshot",
    "buffer.watch",
    "covariance",
    "model.joint_history",
    "net.dead_links",
    "net.discovery",
    "net.edge_ownership",
    "net.environment",
    "net.large_value",
    "net.other_tf",
    "net.request_queryable",
    "net.stream_inbox",
    "net.user_config",
    "nodes.measurement_publisher",
    "other_plugins",
}
WITHOUT_EXTENSION = {
    "_util.reference_fields",
    "buffer.reference_history",
    "model.reference_transforms",
    "net.reference_ring",
}

EVERYDAY = """
import time
import zstate
model = zstate.load_model({urdf!r})
with (
    zstate.connect(listen="tcp/127.0.0.1:0") as session,
    zstate.StatePublisher(session, model, "r1") as publisher,
    zstate.TransformListener(session, "r1") as by_joints,
    zstate.TransformListener(session, "r1", follow="tf") as by_tf,
):
    deadline = time.monotonic() + {deadline_s}
    for listener in (by_joints, by_tf):
        while not (listener.stats.received and listener.buffer.can_lookup("base", "arm")):
            assert time.monotonic() < deadline
            publisher.publish([0.0])
    assert publisher.stats.sent
"""
_URDF = (
    '<robot name="r"><link name="base"/><link name="arm"/><joint name="j" type="continuous">'
    '<parent link="base"/><child link="arm"/></joint></robot>'
)

# Distributions, for the names of imports that differ.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "collada": "pycollada",
    "pinocchio": "pin",
    "yaml": "pyyaml",
    "zenoh": "eclipse-zenoh",
}
OF_ROS = {"rospy", "geometry_msgs", "rosgraph_msgs", "sensor_msgs", "std_msgs", "tf2_msgs"}
NOT_FOR_USERS = {"docs", "test", "lint", "mujoco"}
# Libraries that pin's wheel links, and files with robots.
WITHOUT_IMPORTS = {"cmeel-urdfdom", "cmeel-tinyxml2", "cmeel-console-bridge", "example-robot-data"}

PURE = {"model", "buffer", "wire"}
# The loader, the catalog and the search for meshes read files; xacro is expanded in a process of its own.
READS_FILES = {"model/load.py", "model/xacro_expansion.py", "model/catalog.py", "model/mesh_paths.py"}
READS_ENVIRONMENT = {"wire/registry.py"}  # ROS_DOMAIN_ID
IMPURE_MODULES = {
    "io",
    "logging",
    "multiprocessing",
    "os",
    "shutil",
    "socket",
    "subprocess",
    "sys",
    "tempfile",
}
IMPURE_CALLS = {"input", "open", "print", "read_bytes", "read_text", "write_bytes", "write_text"}
PURE_PARTS = {
    "threading": {"Condition", "Event", "Lock", "RLock", "TIMEOUT_MAX"},  # locking and waiting, no threads
    "time": {"monotonic"},  # how long a wait has lasted; never what time it is
}


@lru_cache(1)  # the trees of all files together are a million objects, which Python searches for garbage
def nodes_of(text: str) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(text)))


def called(call: ast.Call) -> str:
    """The last name of what is called; empty for one without a name."""
    return getattr(call.func, "attr", None) or getattr(call.func, "id", "")


@dataclass(frozen=True)
class Source:
    """A file of zstate, by its path in the package."""

    path: str
    text: str

    @property
    def room(self) -> str:
        return _room(self.path.removesuffix(".py").split("/"))

    def nodes(self) -> Iterator[ast.AST]:
        return iter(nodes_of(self.text))

    def imports(self) -> Iterator[tuple[str, ...]]:
        """Each import's dotted name, taken apart; ``from a.b import c`` counts as a.b.c."""
        for node in self.nodes():
            if isinstance(node, ast.Import):
                yield from (tuple(alias.name.split(".")) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.path}: a relative import hides which floor it leads to"
                yield from ((*(node.module or "").split("."), alias.name) for alias in node.names)
            elif isinstance(node, ast.Call) and called(node) == "import_module":
                yield from (tuple(a.value.split(".")) for a in node.args if isinstance(a, ast.Constant))


def _room(parts: Sequence[str]) -> str:
    """The room of ``zstate.PARTS``; the commands of a plugin are one of their own."""
    top, second = (*parts, "", "")[:2]
    if top == "__init__" or not top:
        return "zstate"
    return f"{top}.cli" if second == "cli" else top


def floor(room: str) -> int:
    heights = [height for height, rooms in enumerate(FLOORS) if room in rooms]
    assert heights, f"the room {room!r} stands on no floor: give it one in FLOORS"
    return heights[0]


def may_know(room: str, other: str) -> bool:
    return room == other or (room, other) in NEIGHBOURS or floor(other) < floor(room)


def imports_that_look_up(source: Source) -> Iterator[str]:
    rooms = set().union(*FLOORS)
    for top, *rest in source.imports():
        # ``from zstate import connect`` goes through the front door, ``from zstate import se3`` does not.
        room = _room(rest) if rest and rest[0] in rooms else "zstate"
        if top == "zstate" and not may_know(source.room, room):
            yield f"{source.path} imports {room!r}"


def libraries_out_of_place(source: Source) -> Iterator[str]:
    for top, *_ in source.imports():
        is_foreign = top not in sys.stdlib_module_names | EVERYWHERE | {"zstate"}
        room = "cli" if source.room.endswith(".cli") else source.room
        is_at_home = HOMES.get(top) == room or (source.path, top) in GUESTS
        if (is_foreign or top in HOMES) and not is_at_home:
            yield f"{source.path} imports {top!r}, at home in {HOMES.get(top, 'no room yet')!r}"


def impurities(source: Source) -> Iterator[str]:
    if source.room not in PURE:
        return
    impure = set() if source.path in READS_FILES | READS_ENVIRONMENT else IMPURE_MODULES | IMPURE_CALLS
    for top, *rest in source.imports():
        if top in impure | {"logging"} or (rest and top in PURE_PARTS):
            yield f"{source.path} imports {'.'.join([top, *rest])!r}"
    for node in source.nodes():
        if isinstance(node, ast.Call):
            name = called(node)
            if name in impure | {"print"}:
                yield f"{source.path}:{node.lineno} calls {name!r}"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module, part = node.value.id, node.attr
            if part not in PURE_PARTS.get(module, {part}):
                yield f"{source.path}:{node.lineno} uses {module}.{part}"


def buffer_internals(source: Source) -> Iterator[str]:
    """Histories, paths and interpolators are private to the buffer; others use its methods and its feed."""
    for top, *rest in source.imports():
        is_outside = top == "zstate" and rest[:1] == ["buffer"] and source.room != "buffer"
        if is_outside and rest[1] not in BUFFER_MODULES:
            yield f"{source.path} imports {'.'.join([top, *rest])!r}"


RULES = (imports_that_look_up, libraries_out_of_place, impurities, buffer_internals)


def test_every_file_keeps_all_rules():
    files = sorted(PACKAGE.rglob("*.py"))
    sources = [Source(path.relative_to(PACKAGE).as_posix(), path.read_text()) for path in files]
    assert sources
    assert [offence for source in sources for rule in RULES for offence in rule(source)] == []


@pytest.mark.parametrize(
    ("rule", "path", "text"),
    [
        (imports_that_look_up, "errors.py", "from zstate.clock import Clock"),
        (imports_that_look_up, "wire/native.py", "def f():\n    from zstate.model import robot"),
        (imports_that_look_up, "model/robot.py", "from zstate.buffer.buffer import TransformBuffer"),
        (imports_that_look_up, "net/session.py", "from zstate import connect"),
        (imports_that_look_up, "transform.py", "import zstate.cli.main"),
        (imports_that_look_up, "scans/listener.py", "from zstate.scans.cli import map"),
        (imports_that_look_up, "cli/commands/ls.py", "import zstate.scans.cli.scan"),
        (libraries_out_of_place, "nodes/publisher.py", "import zenoh"),
        (libraries_out_of_place, "buffer/plan.py", "from pinocchio import SE3"),
        (libraries_out_of_place, "model/xml.py", "import lxml.etree"),
        (libraries_out_of_place, "buffer/plan.py", "import_module('msgspec')"),
        (buffer_internals, "view/world.py", "from zstate.buffer.history import HistoryView"),
        (impurities, "buffer/buffer.py", "threading.Thread(target=f)"),
        (impurities, "buffer/buffer.py", "from threading import Lock"),
        (impurities, "buffer/buffer.py", "now = time.time_ns()"),
        (impurities, "model/urdf.py", "path.read_text()"),
        (impurities, "model/catalog.py", "print('found')"),
        (impurities, "wire/native.py", "import logging"),
    ],
)
def test_a_file_that_breaks_the_rule_is_seen(rule, path: str, text: str):
    assert list(rule(Source(path, text)))


def modules_after(code: str) -> set[str]:
    """The modules that a fresh interpreter has loaded after ``code``."""
    ask = f"{code}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def page_rows(title: str) -> list[list[str]]:
    """The cells of the first table below ``title`` in the page on the architecture, without its head."""
    page = (PACKAGE.parent / "docs" / "architecture.md").read_text()
    lines = page.split(f"## {title}\n")[1].split("\n## ")[0].splitlines()
    rows = [line.strip("|").split("|") for line in lines if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in rows[2:]]


def test_the_page_shows_the_floors():
    floors = [set(rooms) - {"_kernel"} for rooms in reversed(FLOORS)]
    for layer, packages in page_rows("Layers"):
        shown = {
            _room(name.removesuffix("/").removesuffix(".py").removeprefix("zstate/").split("/"))
            for name in re.findall(r"`([^`]+)`", packages)
        }
        while shown and floors and floors[0] <= shown:
            shown -= floors.pop(0)
        assert shown == set(), layer
    assert floors == []


def test_the_page_shows_what_plugins_bring_and_need():
    shown = {row[0].strip("`/"): row for row in page_rows("Plugins")}
    assert list(shown) == [plugin.name for plugin in built_in_plugins()]
    for plugin in built_in_plugins():
        _, brings, needs, _ = shown[plugin.name]
        names = ", ".join(row.name for row in plugin.streams)
        commands = " ".join(f"`{name}`" for name in plugin.commands)
        if names or commands:
            assert brings == "; ".join(filter(None, (names, commands)))
        assert needs == (", ".join(plugin.needs) or "-")


def loaded_by(code: str) -> set[str]:
    """Which of the libraries with a home a fresh interpreter has loaded after ``code``."""
    return modules_after(code) & set(HOMES)


def outside_of_the_core(loaded: set[str]) -> set[str]:
    """Which of the modules ``loaded`` are of a plugin, of security, or an observer."""
    own = {name.removeprefix("zstate.") for name in loaded if name.startswith("zstate.")}
    apart = {*OBSERVERS, "net.security"}
    return {
        name
        for name in own
        if name.split(".")[0] in PLUGINS or any(f"{name}.".startswith(f"{one}.") for one in apart)
    }


def test_the_two_nodes_load_no_plugin_no_security_and_no_observer():
    loaded = modules_after("import zstate.nodes.publisher, zstate.nodes.listener")
    assert "zstate.nodes.state_reader" in loaded
    assert outside_of_the_core(loaded) == set()


def test_a_session_without_credentials_loads_no_security():
    code = "import zstate\nzstate.connect(listen='tcp/127.0.0.1:0').close()"
    assert outside_of_the_core(modules_after(code)) == set()


def test_publishing_and_looking_up_load_nothing_of_what_some_programs_use():
    loaded = modules_after(EVERYDAY.format(urdf=_URDF, deadline_s=DEADLINE_S))
    assert {"zstate.buffer.path", "zstate.model.urdf", "zstate.nodes.publisher"} <= loaded
    apart = ON_USE | (WITHOUT_EXTENSION if kernel == "c" else set())
    assert loaded & {f"zstate.{name}" for name in apart} == set()


def test_modules_outside_of_the_core_exist_and_are_seen():
    names = {"net.security", "fleet.acl", "scans.listener", *OBSERVERS}
    assert {f"zstate.{name}" for name in names | ON_USE | WITHOUT_EXTENSION} <= modules().keys()
    assert outside_of_the_core({"json", "zstate.net.open", *(f"zstate.{name}" for name in names)}) == names


def test_importing_zstate_loads_no_library():
    assert loaded_by("import zstate") == set()


def test_a_buffer_loads_no_library():
    assert loaded_by("from zstate import Transform, TransformBuffer\nTransformBuffer()") == set()


def test_scans_and_maps_load_no_library_for_files():
    assert loaded_by("from zstate.scans import ScanListener, load_map") == {"msgspec", "zenoh"}


def test_following_transforms_loads_no_kinematics():
    code = "from zstate import TransformListener, connect\nTransformListener, connect"
    assert loaded_by(code) == {"msgspec", "zenoh"}


def test_each_imported_library_is_declared_and_each_declared_one_imported():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    users = {name: requirements for name, requirements in extras.items() if name not in NOT_FOR_USERS}
    requirements = [*project["dependencies"], *chain.from_iterable(users.values())]
    declared = {re.match(r"[\w-]+", requirement)[0].lower() for requirement in requirements} - {"zstate"}
    imported = {top for source in modules().values() for top, *_ in source.imports()} - OF_ROS
    foreign = imported - sys.stdlib_module_names - {"zstate"}
    assert {DISTRIBUTIONS.get(name, name.replace("_", "-")) for name in foreign} == declared - WITHOUT_IMPORTS


@cache
def modules() -> dict[str, Source]:
    """Every module of the package by its dotted name; a package's name stands for its ``__init__``."""
    found: dict[str, Source] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = Source(path.relative_to(PACKAGE).as_posix(), path.read_text())
    return found


@cache
def importers() -> dict[str, set[str]]:
    """Which modules import each module: at the top, in a function, for types only, or lazily by its name.

    ``from a.b import c`` is an import of a.b.c if that is a module, else of a.b. A string constant that is
    a module's whole dotted name is an import: the front door and click load by such names.
    """
    found: dict[str, set[str]] = {name: set() for name in modules()}
    for name, source in modules().items():
        # The extension is a module of its own, which ``zstate/__init__.py`` does not load.
        imported = (".".join(parts) for parts in source.imports() if "_kernel" not in parts)
        names = {one if one in found else one.rpartition(".")[0] for one in imported}
        names.update(text for text in strings(source) if text.startswith("zstate."))
        for target in (names & set(found)) - {name}:
            found[target].add(name)
    return found


def strings(source: Source) -> Iterator[str]:
    """String literals, docstrings included; of an f-string only its text."""
    for node in source.nodes():
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_no_module_imports_itself_through_others():
    """That a module loads its packages does not count."""
    above = importers()

    def reached(name: str) -> set[str]:
        found: set[str] = set()
        ahead = list(above[name])
        while ahead:
            if (one := ahead.pop()) not in found:
                found.add(one)
                ahead.extend(above[one])
        return found

    assert {name for name in above if name in reached(name)} == set()
