"""The floors of zstate: imports look down, each library has one home, the pure rooms stay pure.

Read from the import statements, so that nothing needs to run; laziness is seen in a fresh interpreter.
"""

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "zstate"

# From the ground up. Rooms of one floor do not know each other, but for the neighbours below.
FLOORS = (
    {"closing", "errors", "locks", "_kernel"},
    {"checks", "extension"},
    {"clock"},
    {"se3", "rate", "facts"},
    {"transform", "twist"},
    {"model", "buffer", "wire"},
    {"net", "record"},
    {"sources", "following", "moving_edges", "status", "lookup_service"},
    {
        "publisher",
        "statics",
        "listener",
        "recorder",
        "recording",
        "clock_publisher",
        "simulated_clock",
    },
    {"ros1", "bridge", "replaying"},
    {"replayer"},
    {"zstate"},
    {"metrics"},
    {"view", "cli"},
    {"__main__"},
)
NEIGHBOURS = {
    ("buffer", "model"),  # joint tracks are kept as positions, and become poses in a lookup
    ("cli", "view"),  # `zstate view` starts it
}

# Constructors that users look for on the class, and that are made elsewhere, loaded when they are called.
CONSTRUCTORS = {
    ("buffer/buffer.py", "following"),  # TransformBuffer.from_recording
    ("buffer/buffer.py", "record"),
}

HOMES = {
    "pinocchio": "model",
    "xacro": "model",
    "xacrodoc": "model",
    "msgspec": "wire",
    "zenoh": "net",
    "cryptography": "net",
    "xxhash": "wire",
    "mcap": "record",
    "lz4": "record",
    "zstandard": "record",
    "rospy": "ros1",
    "geometry_msgs": "ros1",
    "rosgraph_msgs": "ros1",
    "sensor_msgs": "ros1",
    "std_msgs": "ros1",
    "tf2_msgs": "ros1",
    "prometheus_client": "metrics",
    "viser": "view",
    "websockets": "view",  # what viser's server is made of
    "trimesh": "view",
    "collada": "view",
    "imageio": "view",  # comes with viser
    "PIL": "view",
    "click": "cli",
    "matplotlib": "cli",  # `zstate plot`
    "rich": "cli",
    "tomli": "cli",  # a part of Python from 3.11 on, as tomllib
    "tomli_w": "cli",  # `zstate snapshot save`
    "tomllib": "cli",
    "yaml": "cli",
}
EVERYWHERE = {"numpy"}
GUESTS = {
    # `zstate up FILE.toml`: a file is read into frozen types as a message is
    ("cli/snapshot.py", "msgspec"),
    ("cli/up/cell.py", "msgspec"),
    ("cli/up/schema.py", "msgspec"),
}

PURE = {"model", "buffer", "wire"}
# The catalog and the expander are where a model comes from: they look for files and read them.
READS_FILES = {"model/catalog.py", "model/known.py", "model/xacro.py"}
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


@dataclass(frozen=True)
class Source:
    """A file of zstate, by its path in the package."""

    path: str
    text: str

    @property
    def room(self) -> str:
        top = self.path.split("/")[0].removesuffix(".py")
        return "zstate" if top == "__init__" else top

    def nodes(self) -> Iterator[ast.AST]:
        return ast.walk(ast.parse(self.text))

    def imports(self) -> Iterator[tuple[str, ...]]:
        """Each import's dotted name, taken apart; ``from a.b import c`` counts as a.b.c."""
        for node in self.nodes():
            if isinstance(node, ast.Import):
                yield from (tuple(alias.name.split(".")) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{self.path}: a relative import hides which floor it leads to"
                yield from ((*(node.module or "").split("."), alias.name) for alias in node.names)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                yield from (tuple(a.value.split(".")) for a in node.args if isinstance(a, ast.Constant))


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
        room = rest[0] if rest and rest[0] in rooms else "zstate"
        is_known = may_know(source.room, room) or (source.path, room) in CONSTRUCTORS
        if top == "zstate" and not is_known:
            yield f"{source.path} imports {room!r}"


def libraries_out_of_place(source: Source) -> Iterator[str]:
    for top, *_ in source.imports():
        is_foreign = top not in sys.stdlib_module_names | EVERYWHERE | {"zstate"}
        is_at_home = HOMES.get(top) == source.room or (source.path, top) in GUESTS
        if (is_foreign or top in HOMES) and not is_at_home:
            yield f"{source.path} imports {top!r}, at home in {HOMES.get(top, 'no room yet')!r}"


def impurities(source: Source) -> Iterator[str]:
    if source.room not in PURE:
        return
    impure = set() if source.path in READS_FILES else IMPURE_MODULES | IMPURE_CALLS
    for top, *rest in source.imports():
        if top in impure | {"logging"} or (rest and top in PURE_PARTS):
            yield f"{source.path} imports {'.'.join([top, *rest])!r}"
    for node in source.nodes():
        if isinstance(node, ast.Call):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else ast.unparse(node.func)
            if name in impure | {"print"}:
                yield f"{source.path}:{node.lineno} calls {name!r}"
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module, part = node.value.id, node.attr
            if part not in PURE_PARTS.get(module, {part}):
                yield f"{source.path}:{node.lineno} uses {module}.{part}"


RULES = (imports_that_look_up, libraries_out_of_place, impurities)


@pytest.mark.parametrize("rule", RULES)
def test_every_file_keeps_the_rule(rule):
    files = sorted(PACKAGE.rglob("*.py"))
    sources = [Source(path.relative_to(PACKAGE).as_posix(), path.read_text()) for path in files]
    assert len(sources) > 20
    assert [offence for source in sources for offence in rule(source)] == []


@pytest.mark.parametrize(
    ("rule", "path", "text"),
    [
        (imports_that_look_up, "errors/base.py", "from zstate.clock import Clock"),
        (imports_that_look_up, "wire/native.py", "def f():\n    from zstate.model import robot"),
        (imports_that_look_up, "model/robot.py", "from zstate.buffer.buffer import TransformBuffer"),
        (imports_that_look_up, "net/session.py", "from zstate import connect"),
        (imports_that_look_up, "transform.py", "import zstate.cli.main"),
        (libraries_out_of_place, "publisher.py", "import zenoh"),
        (libraries_out_of_place, "buffer/plan.py", "from pinocchio import SE3"),
        (libraries_out_of_place, "model/xml.py", "import lxml.etree"),
        (libraries_out_of_place, "buffer/plan.py", "import_module('msgspec')"),
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


def loaded_by(code: str) -> set[str]:
    """Which of the libraries with a home a fresh interpreter has loaded after ``code``."""
    ask = f"{code}\nimport sys\nprint(*(set(sys.modules) & {set(HOMES)!r}))"
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_zstate_loads_no_library():
    assert loaded_by("import zstate") == set()


def test_a_buffer_loads_no_library():
    assert loaded_by("from zstate import Transform, TransformBuffer\nTransformBuffer()") == set()


def test_following_transforms_loads_no_kinematics():
    code = "from zstate import TransformListener, connect\nTransformListener, connect"
    assert loaded_by(code) == {"msgspec", "zenoh"}
