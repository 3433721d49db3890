"""Names that other programs and users depend on, pinned: a rename in the code must leave them as they are.

The expected values are in ``golden/pins.json``: an intended change edits that file and CHANGELOG.md.
Names are obtained through public doors: the network, the command line, a scrape, the import of ``zstate``.
"""

from __future__ import annotations

import ast
import json
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import click
import pytest
import zenoh
from helpers.processes import Child, repeated, until
from helpers.robots import wait_for_reader

import zstate.errors
from zstate import (
    StatePublisher,
    StaticPublisher,
    Transform,
    TransformListener,
    TransformPublisher,
    connect,
    load_model,
)
from zstate.cli.main import group
from zstate.extension import REVISION
from zstate.net.session import Session
from zstate.nodes.clock import ClockPublisher
from zstate.odometry import ImuPublisher, OdometryPublisher, PosePublisher, VelocityPublisher
from zstate.wire.native import ENCODINGS

PACKAGE = Path(__file__).parent.parent / "zstate"
GOLDEN = Path(__file__).parent / "golden" / "pins.json"
RRBOT = str(Path(__file__).parent.parent / "models" / "rrbot.urdf")
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
EVERYTHING = ("joint_states", "tf", "tf_static", "robot_description")


def pinned(name: str) -> Any:
    return json.loads(GOLDEN.read_text())[name]


def check_pin(name: str, found: Any) -> None:
    """Compare ``found`` with the pin; the failure shows both, one entry a line."""
    expected = pinned(name)
    assert json.loads(json.dumps(found)) == expected, name


# The wire


def test_encodings_of_all_message_classes():
    check_pin("native_encodings", sorted(ENCODINGS.values()))


class Sniffer:
    """Every key and encoding that a raw Zenoh session receives, and every liveliness token it sees."""

    def __init__(self, session: zenoh.Session, expression: str, tokens: str) -> None:
        self.samples: set[tuple[str, str]] = set()
        self.tokens: set[str] = set()
        self._subscriber = session.declare_subscriber(
            expression, lambda sample: self.samples.add((masked(str(sample.key_expr)), str(sample.encoding)))
        )
        self._tokens = session.liveliness().declare_subscriber(
            tokens, lambda sample: self.tokens.add(masked(str(sample.key_expr))), history=True
        )

    def close(self) -> None:
        self._subscriber.undeclare()
        self._tokens.undeclare()


def masked(key: str) -> str:
    """``key`` with the parts that differ between runs (host, process, time, session) replaced."""
    key = re.sub(r"driver,[^,/]+,\d+,\d+,\d+", "driver,HOST,PID,SINCE,SESSION", key)
    return re.sub(r"(@ros2_lv/\d+)/[0-9a-f]+/\d+/\d+/", r"\1/ZID/NODE/ENTITY/", key)


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """Writers and readers that are given no program's name use that of the script."""
    monkeypatch.setattr(sys, "argv", ["driver"])


@contextmanager
def sniffed(session: Session, expression: str, *token_expressions: str) -> Iterator[list[Sniffer]]:
    sniffers = [Sniffer(session.zenoh, expression, tokens) for tokens in token_expressions]
    try:
        yield sniffers
    finally:
        for sniffer in sniffers:
            sniffer.close()


def facts_of(sniffers: list[Sniffer]) -> dict[str, list[Any]]:
    return {
        "samples": sorted(map(list, set().union(*(one.samples for one in sniffers)))),
        "tokens": sorted(set().union(*(one.tokens for one in sniffers))),
    }


@contextmanager
def talking(writer: Session, reader: Session, wire: str) -> Iterator[None]:
    """Every stream of robot r1, its static edges, its clock and a reader of it, on ``wire``."""
    model = load_model(RRBOT)
    wait_for_reader(writer, "zstate/r1/any")  # the sniffers: the description is published once
    with (
        StatePublisher(writer, model, "r1", (wire,), streams=EVERYTHING, program="driver") as publisher,
        StaticPublisher(writer, "r1", "camera", (wire,), program="driver") as statics,
        ClockPublisher(writer, (wire,)) as clock,
        TransformListener(reader, "r1", wire=wire, history_on_join=False),
        ExitStack() as opened,
    ):
        statics.set(Transform("tool", "lens", (0.0, 0.0, 0.1), UPRIGHT))
        if wire == "native":
            odometry = opened.enter_context(TransformPublisher(writer, "r1", "odometry", program="driver"))
            odometry.publish([Transform("odom", "world", (1.0, 0.0, 0.0), UPRIGHT)])
        wheels, imu, flow, mocap = (
            opened.enter_context(kind(writer, "r1", name, (wire,), program="driver"))
            for kind, name in (
                (OdometryPublisher, "odom"),
                (ImuPublisher, "chest"),
                (VelocityPublisher, "flow"),
                (PosePublisher, "mocap"),
            )
        )

        def publish() -> None:
            publisher.publish([0.0, 0.0])
            clock.publish(1)
            wheels.publish(Transform("start", "odom", (1.0, 0.0, 0.0), UPRIGHT), [0, 0, 0], [0, 0, 0])
            imu.publish([0, 0, 0], [0, 0, 9.81])
            flow.publish([0, 0, 0])
            mocap.publish(Transform("map", "odom", (1.0, 0.0, 0.0), UPRIGHT))

        with repeated(publish):
            yield


@pytest.mark.usefixtures("driver")
def test_native_keys_encodings_and_tokens(sessions: tuple[Session, Session]):
    writer, reader = sessions
    expressions = ("zstate/*/@writer/**", "zstate/@reader/**", "zstate/*/@edge/**")
    expected = pinned("native_network")
    with sniffed(reader, "zstate/**", *expressions) as sniffers, talking(writer, reader, "native"):
        until(lambda: all_in(expected, facts_of(sniffers)))
        check_pin("native_network", facts_of(sniffers))
        replies = {
            name: sorted(
                {
                    (masked(str(one.ok.key_expr)), str(one.ok.encoding))
                    for one in reader.zenoh.get(selector, timeout=5.0)
                    if one.ok
                }
            )
            for name, selector in (("history", "zstate/r1/joint_states"), ("clock", "zstate/r1/@clock/*"))
        }
    check_pin("native_replies", replies)


def all_in(expected: dict[str, list[Any]], found: dict[str, list[Any]]) -> bool:
    return all(one in found[part] for part, ones in expected.items() for one in ones)


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("wire", ["ros2", "ros2dds"])
def test_ros_keys_types_hashes_and_tokens(sessions: tuple[Session, Session], wire: str):
    writer, reader = sessions
    expected = pinned(wire)
    with sniffed(reader, "**", "@ros2_lv/**") as sniffers, talking(writer, reader, f"{wire}:namespace=r1"):
        until(lambda: all_in(expected, facts_of(sniffers)))
        check_pin(wire, facts_of(sniffers))


# The command line


def test_commands_with_their_arguments_options_and_variables():
    context = click.Context(group)
    check_pin("commands", dict(commands_of(group, context, "ZSTATE")))


def commands_of(group: click.Group, context: click.Context, prefix: str) -> Iterator[tuple[str, Any]]:
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command
        variables = f"{prefix}_{name.upper()}"
        # Hidden options are for processes that a command starts itself.
        offered = (one for one in command.params if not getattr(one, "hidden", False))
        yield name, sorted(parameter_text(one, variables) for one in offered)
        if isinstance(command, click.Group):
            for inner, parameters in commands_of(command, context, variables):
                yield f"{name} {inner}", parameters


def parameter_text(parameter: click.Parameter, prefix: str) -> str:
    """Its spellings and the variable that click reads for it; for an argument how the help calls it."""
    if isinstance(parameter, click.Argument):
        return f"{parameter.human_readable_name} nargs={parameter.nargs}"
    spelled = " ".join([*parameter.opts, *parameter.secondary_opts])
    given = parameter.envvar or f"{prefix}_{(parameter.name or '').upper()}"
    return f"{spelled} ${given}"


def zstate_json(*arguments: str) -> Any:
    command = [sys.executable, "-m", "zstate", *arguments]
    ended = subprocess.run(command, capture_output=True, timeout=30.0, check=False)
    assert ended.returncode in (0, 1), (arguments, ended.returncode, ended.stderr)  # 1: there are findings
    return json.loads(ended.stdout)


DYNAMIC = re.compile(r"(shoulder|elbow|/|native|rrbot)")


def key_paths(value: Any, path: str = "") -> set[str]:
    """The keys of a JSON document, as dotted paths; names of joints and topics are ``*``, elements ``[]``."""
    if isinstance(value, dict):
        found: set[str] = set()
        for key, inner in value.items():
            where = f"{path}.{'*' if DYNAMIC.search(key) else key}".lstrip(".")
            found |= {where} | key_paths(inner, where)
        return found
    if isinstance(value, list):
        return {f"{path}[]"}.union(*(key_paths(inner, f"{path}[]") for inner in value))
    return set()


@contextmanager
def standing_robot(wire: str = "native") -> Iterator[None]:
    with (
        connect() as session,
        StatePublisher(
            session, load_model(RRBOT), "rrbot", (wire,), streams=EVERYTHING, program="driver"
        ) as publisher,
        StaticPublisher(session, "rrbot", "camera", (wire,), program="driver") as statics,
        repeated(lambda: publisher.publish([0.5, -0.2], [0.1, 0.2], [1.0, 2.0])),
    ):
        statics.set(Transform("tool", "lens", (0.0, 0.0, 0.1), UPRIGHT))
        yield


@pytest.mark.processes
def test_keys_of_every_json_output(tmp_path: Path):
    recording, broken = str(tmp_path / "run.mcap"), tmp_path / "broken.urdf"
    broken.write_text("<robot name='b'><link name='a'/><link name='b'/></robot>")
    with standing_robot():
        subprocess.run(
            [sys.executable, "-m", "zstate", "record", recording, "--seconds", "1"],
            check=True, capture_output=True, timeout=30.0,
        )  # fmt: skip
        documents = {" ".join(words): zstate_json(*words, "--json") for words in JSON_COMMANDS}
        documents["check"] = zstate_json("check", RRBOT, "--json")
        documents["check, with findings"] = zstate_json("check", str(broken), "--json")
        documents["info"] = zstate_json("info", recording, "--json")
        documents["snapshot"] = saved_snapshot(tmp_path / "cell.json")
    found = {name: sorted(key_paths(document)) for name, document in documents.items()}
    check_pin("json", found)


JSON_COMMANDS = (
    ("config",),
    ("robots", "rrbot"),
    ("ls",),
    ("tree",),
    ("graph",),
    ("tf", "world", "tool", "--once"),
    ("tf", "world", "tool", "--once", "--twist"),
    ("monitor", "world", "lens", "--once"),
    ("echo", "rrbot", "--once"),
    ("hz", "rrbot", "--once"),
    ("hz", "rrbot", "--stream", "tf", "--once"),
    ("wait", "robot", "rrbot"),
    ("doctor", "rrbot"),
    ("doctor", "missing", "--timeout", "0.5"),
)


def saved_snapshot(path: Path) -> Any:
    command = [sys.executable, "-m", "zstate", "snapshot", "save", str(path)]
    subprocess.run(command, check=True, capture_output=True, timeout=30.0)
    return json.loads(path.read_text())


def started(spawn: Any, *arguments: str) -> Child:
    return spawn("from zstate.cli.main import main; main()", *arguments)


@pytest.mark.processes
def test_keys_of_the_json_lines_of_monitored_robots(spawn: Any):
    with standing_robot():
        command = started(spawn, "monitor", "--robots", "--robot", "rrbot", "--json")
        line = json.loads(command.line())
        command.process.send_signal(signal.SIGINT)
        command.wait()
    # A slow machine has late ticks among the faults.
    check_pin("json_monitored_robots", sorted(key_paths({**line, "faults": []})))


@pytest.mark.processes
def test_keys_of_the_json_output_for_ros(spawn: Any, free_port: int, monkeypatch: pytest.MonkeyPatch):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--ros2", "--listen", endpoint).line()
    monkeypatch.setenv("ZSTATE_CONNECT", endpoint)
    monkeypatch.setenv("ZSTATE_WIRE", "ros2")
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    started(spawn, "publish", RRBOT, "--source", "sine").line()
    until(lambda: zstate_json("ls", "--json")["topics"])
    found = {name: sorted(key_paths(zstate_json(name, "--json"))) for name in ("ls", "graph", "doctor")}
    check_pin("json_ros2", found)


@pytest.mark.processes
def test_keys_of_the_json_log(spawn: Any):
    command = started(spawn, "publish", RRBOT, "--source", "sine", "--log-format", "json", "--metrics", "0")
    until(lambda: '"event"' in command.stderr)
    lines = [json.loads(line) for line in command.stderr.splitlines() if line.startswith("{")]
    check_pin("json_log", sorted(set().union(*map(key_paths, lines))))


# Files


ALL_OF_UP = """
include = ["network.toml"]
[parameters]
rate = 100.0
[router]
listen = ["tcp/0.0.0.0:7447"]
connect = ["tcp/127.0.0.1:7440"]
ros2 = true
acl = "acl.json5"
certs = "fleet"
identity = "site"
user = "site"
password_file = "password"
users = "users"
metrics = 9000
restart = "never"
[[robot]]
model = "MODEL"
xacro_args = {}
names = "left right"
source = "sine"
rate = "${rate}"
wires = ["native", "ros2"]
clock = "system"
takeover = false
metrics = 9100
identity = "${name}"
after = ["router"]
restart = "on-failure"
[[robot]]
model = "MODEL"
count = 2
name = "arm${number}"
when = "true"
identity = "left"
[[program]]
run = "python driver.py"
name = "driver"
ready = "driver runs"
environment = {SITE = "lab"}
identity = "left"
after = ["left", "static"]
restart = "always"
[[static]]
robot = "l*"
target = "tool"
source = "lens"
xyz = [0.0, 0.0, 0.1]
rpy_deg = [0.0, 90.0, 0.0]
wires = ["native"]
[[static]]
robot = ["left"]
target = "tool"
source = "flash"
rpy = [0.0, 0.0, 0.1]
[[static]]
robot = "left"
target = "tool"
source = "mark"
quat_xyzw = [0.0, 0.0, 0.0, 1.0]
[[static]]
robot = "right"
file = "edge.json"
[[map]]
file = "hall.yaml"
name = "hall"
frame = "map"
writer = "map"
wires = ["native", "ros2"]
identity = "left"
after = ["router"]
restart = "on-failure"
[[scan]]
robot = "left"
frame = "laser"
simulate = "hall.yaml"
dummy = false
map_frame = "hall/map"
rate = "${rate}"
sensor = "front"
wires = ["native"]
metrics = 9200
identity = "left"
after = ["left"]
restart = "always"
"""
NETWORK_OF_UP = """
[network]
mode = "client"
connect = ["tcp/127.0.0.1:7447"]
listen = []
config = "zenoh.json5"
certs = "fleet"
identity = "left"
user = "left"
password_file = "password"
"""
EDGE = {
    "header": {"frame_id": "tool"},
    "child_frame_id": "light",
    "transform": {
        "translation": {"x": 0.0, "y": 0.0, "z": 0.1},
        "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
    },
}


def test_up_reads_every_key_of_its_tables(tmp_path: Path):
    cell = import_module("zstate.cli.up.cell")
    (tmp_path / "cell.toml").write_text(ALL_OF_UP.replace("MODEL", RRBOT))
    (tmp_path / "network.toml").write_text(NETWORK_OF_UP)
    (tmp_path / "edge.json").write_text(json.dumps(EDGE))
    assert cell.read_cell(str(tmp_path / "cell.toml"), {})


@pytest.mark.processes
def test_keys_of_a_snapshot_in_toml(tmp_path: Path):
    path = tmp_path / "cell.toml"
    with standing_robot():
        command = [sys.executable, "-m", "zstate", "snapshot", "save", str(path)]
        subprocess.run(command, check=True, capture_output=True, timeout=30.0)
    check_pin("toml_snapshot", sorted(key_paths(tomllib.loads(path.read_text()))))


@pytest.mark.processes
def test_keys_of_an_access_control_file(tmp_path: Path):
    names = ("--robot", "r1", "--viewer", "desk", "--operator", "o", "--timekeeper", "t", "--placer", "site")
    command = [sys.executable, "-m", "zstate", "acl", *names]
    printed = subprocess.run(command, check=True, capture_output=True, timeout=30.0)
    path = tmp_path / "acl.json5"
    path.write_bytes(printed.stdout)
    document = json.loads(zenoh.Config.from_file(str(path)).get_json("access_control"))
    rules = [{key: rule[key] for key in rule if key != "id"} for rule in document["rules"]]
    keys = {section: sorted(set().union(*document[section])) for section in ("rules", "subjects", "policies")}
    check_pin("acl", {"default": document["default_permission"], "keys": keys, "rules": rules})


# Metrics, variables, threads, loggers, errors, the extension


@pytest.mark.processes
def test_names_of_metrics_and_their_labels(spawn: Any, tmp_path: Path, free_port: int):
    pytest.importorskip("prometheus_client", reason="pip install 'zstate[metrics]'")
    endpoint = f"tcp/127.0.0.1:{free_port}"
    expected = pinned("metrics")
    # The bridge needs a router for ROS; a publisher connects to it for the rows of its connections.
    router = started(spawn, "router", "--ros2", "--listen", endpoint, "--metrics", "0")
    router.line()
    commands = {
        "router": router,
        "publish": started(spawn, "publish", RRBOT, "--source", "sine", "--metrics", "0"),
        "monitor": started(spawn, "monitor", "--robots", "--robot", "rrbot", "--metrics", "0"),
        "record": started(spawn, "record", str(tmp_path / "run.mcap"), "rrbot", "--metrics", "0"),
        "bridge": started(spawn, "bridge", "rrbot", "--ros", endpoint, "--metrics", "0"),
    }
    with connect(mode="client", endpoints=endpoint) as far, StatePublisher(far, load_model(RRBOT), "far"):
        for name, command in commands.items():
            until(lambda: "metrics at " in command.stderr)  # noqa: B023 - called in this round
            url = re.findall(r"metrics at (http:\S+)", command.stderr)[0]
            until(lambda: set(expected[name]) <= set(metric_rows(url)))  # noqa: B023 - as above
            assert metric_rows(url) == expected[name], name


def metric_rows(url: str) -> list[str]:
    """Each metric of zstate that is served, with the names of its labels."""
    parser = import_module("prometheus_client.parser")
    with urlopen(url, timeout=5.0) as reply:
        families = list(parser.text_string_to_metric_families(reply.read().decode()))
    samples = (sample for family in families for sample in family.samples)
    return sorted(
        {
            f"{sample.name}{{{','.join(sorted(sample.labels))}}}"
            for sample in samples
            if sample.name.startswith("zstate")
        }
    )


def constants() -> Iterator[str]:
    """Every string constant of the package, docstrings included."""
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                yield node.value


def test_variables_of_the_environment():
    found = {text for text in constants() if re.fullmatch(r"_?ZSTATE_[A-Z_]+", text)}
    check_pin("variables", sorted(found))


def test_thread_names_that_tests_and_users_look_for():
    assert set(pinned("threads")) <= set(constants())


def test_logger_names():
    calls = {
        node.args[0].value
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("getLogger") and node.args
        if isinstance(node.args[0], ast.Constant)
    }
    check_pin("loggers", sorted(calls))


def test_exceptions_with_their_bases():
    found = {
        name: [base.__name__ for base in kind.__mro__[1:-1] if not base.__name__.startswith("_")]
        for name in dir(zstate.errors)
        if not name.startswith("_")
        and isinstance(kind := getattr(zstate.errors, name), type)
        and issubclass(kind, zstate.errors.ZStateError)
    }
    check_pin("exceptions", found)


def test_names_of_the_extension_with_its_revision():
    kernel = pytest.importorskip("zstate._kernel")
    names = sorted(name for name in dir(kernel) if not name.startswith("__"))
    members = {
        name: sorted(member for member in dir(getattr(kernel, name)) if not member.startswith("__"))
        for name in names
        if isinstance(getattr(kernel, name), type)
    }
    check_pin("extension", {"revision": REVISION, "names": names, "members": members})
