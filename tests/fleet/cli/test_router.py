from __future__ import annotations

import json
import re
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from helpers.cli_runner import (
    Command,
    Spawn,
    failure,
    interrupted,
    published_robot,
    run_cli,
    run_until,
    run_watched,
    started,
)
from helpers.processes import until
from helpers.programs import router
from helpers.robots import RRBOT, SampleCollector

from zstate import StatePublisher, TransformListener, connect
from zstate.net.security.credentials import Credentials
from zstate.net.session import Session
from zstate.net.sites import discover_sites


@pytest.mark.processes
def test_clients_communicate_through_the_router(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = started(spawn, "router", "--listen", endpoint)
    assert child.line().endswith(f" listens at {endpoint}")
    with (
        published_robot(router=endpoint),
        connect(mode="client", endpoints=endpoint) as session,
        TransformListener(session, "rrbot") as listener,
    ):
        assert listener.buffer.wait("base", "lower", timeout_s=10.0).kind == "exact"
    interrupted(child)


def test_busy_port_is_reported_at_once(free_port: int):
    with router(f"tcp/127.0.0.1:{free_port}") as endpoint:
        assert f"another program listens at '{endpoint}'" in failure("router", "--listen", endpoint)


def ros_node(port: int) -> zenoh.Session:
    """A session as rmw_zenoh_cpp opens it."""
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "connect/endpoints": [f"tcp/localhost:{port}"],
        "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
        "timestamping/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def test_ros_nodes_and_clients_communicate_through_the_router(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    received: set[tuple[str, str]] = set()

    def communicate(command: Command) -> None:
        assert command.line().endswith(f" listens at {endpoint}")
        with ExitStack() as opened:
            sessions = {name: opened.enter_context(ros_node(free_port)) for name in ("node", "other")}
            sessions["client"] = opened.enter_context(connect(mode="client", endpoints=endpoint)).zenoh
            for name, session in sessions.items():

                def on_sample(sample: zenoh.Sample, reader: str = name) -> None:
                    received.add((str(sample.key_expr), reader))

                session.declare_subscriber("from/**", on_sample)

            def all_received_all() -> bool:
                for name, session in sessions.items():
                    session.put(f"from/{name}", b"something")
                return len(received) == len(sessions) ** 2

            until(all_received_all)

    run_watched(communicate, "router", "--ros2", "--listen", endpoint)


def test_its_settings_for_ros_and_a_file_exclude_each_other(tmp_path):
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    assert "--config" in failure("router", "--ros2", "--config", str(file), code=2)


def test_router_runs_its_printed_configuration(free_port: int, tmp_path: Path):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    printed = run_cli("router", "--listen", endpoint, "--print")
    file = tmp_path / "router.json5"
    file.write_text(printed.stdout)

    def routers() -> list[zenoh.ZenohId]:
        with connect(mode="client", endpoints=endpoint) as session:
            return list(session.zenoh.info.routers_zid())

    ended, found = run_until(routers, "router", "--config", str(file))
    assert ended.stdout.endswith(f"listens at the endpoints in '{file}'\n")
    assert found


def test_router_downsamples_streams_to_neighbours(free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    options = ("--downsample", "joint_states=5", "--robot", "rrbot", "--wan", "lo")

    def listen(command: Command) -> None:
        command.line()
        with (
            published_robot(router=endpoint),
            connect(mode="client", endpoints=endpoint) as session,
            TransformListener(session, "rrbot") as listener,
        ):
            until(lambda: listener.stats.received >= 5)
            # A hundred a second are written; what was left out on the way is counted.
            assert listener.stats.missed > 10 * listener.stats.received

    run_watched(listen, "router", "--listen", endpoint, *options)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (("--downsample", "tf"), "write STREAM=HZ"),
        (("--downsample", "tf=fast"), "write STREAM=HZ"),
        (("--wan", "wwan0"), "--downsample"),
    ],
)
def test_half_of_a_downsampling_is_wrong_usage(options: tuple[str, ...], text: str):
    assert text in failure("router", *options, code=2)


def test_a_file_is_the_whole_configuration(tmp_path):
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    for option in (("--print",), ("--downsample", "tf=1", "--robot", "r1"), ("--acl", str(file))):
        message = failure("router", "--config", str(file), *option, code=2)
        assert option[0] in message
        assert "exclude each other" in message


def test_router_with_access_control_does_not_connect_peers_to_each_other(free_port: int, tmp_path: Path):
    """Over a direct link a robot could write another robot's keys."""
    pytest.importorskip("cryptography", reason="needs cryptography: pip install 'zstate[certs]'")
    certs, acl, endpoint = str(tmp_path / "pki"), tmp_path / "acl.json5", f"tls/127.0.0.1:{free_port}"
    run_cli(
        "certs", certs, "--identity", "router", "--identity", "ra", "--identity", "rb", "--identity", "desk"
    )
    acl.write_text(run_cli("acl", "--robot", "ra", "--robot", "rb", "--viewer", "desk").stdout)
    options = ("--listen", endpoint, "--certs", certs, "--identity", "router", "--acl", str(acl))

    def join(mode: str, name: str) -> Session:
        return connect(mode=mode, endpoints=endpoint, credentials=Credentials.from_folder(certs, name))

    def join_all(command: Command) -> None:
        command.line()
        with (
            join("peer", "rb") as victim,
            join("peer", "ra") as intruder,
            join("client", "rb") as own,
            join("client", "desk") as viewer,
        ):
            direct = SampleCollector(victim, "zstate/rb/joint_commands")
            routed = SampleCollector(viewer, "zstate/*/tf_static/*")

            def is_routed() -> bool:
                intruder.zenoh.put("zstate/rb/joint_commands", b"go")
                own.zenoh.put("zstate/rb/tf_static/model", b"from rb")
                return len(routed.arrivals) >= 100

            until(is_routed)
            assert direct.arrivals == []
            assert list(victim.zenoh.info.peers_zid()) == []

    run_watched(join_all, "router", *options)


def test_password_is_in_the_output_file_but_masked_in_print(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("ZSTATE_PASSWORD", "open sesame")
    users, file = tmp_path / "users", tmp_path / "router.json5"
    users.touch(0o600)
    users.write_text("r1:open sesame\n")
    options = ("router", "--user", "r1", "--users", str(users))
    printed = run_cli(*options, "--print").stdout
    assert 'user: "r1"' in printed
    assert "sesame" not in printed
    assert run_cli(*options, "--output", str(file)).stdout == ""
    assert 'password: "open sesame"' in file.read_text()
    assert file.read_text() == printed.replace("********", "open sesame")
    assert file.stat().st_mode & 0o777 == 0o600
    assert f"'{file}' cannot be written: File exists" in failure(*options, "--output", str(file))


def test_a_site_prints_what_passes_and_runs_it(free_port: int, tmp_path: Path):
    """Its own programs are distinguished from headquarters by the protocol: a socket file here."""
    headquarters = f"tcp/127.0.0.1:{free_port}"
    local = f"unixsock-stream/{tmp_path / 'site.sock'}"
    (tmp_path / "robots.txt").write_text("# plant 1\nr1\nr2  # the second\n")
    site = ("--site", "plant1", "--uplink", headquarters, "--thin", "joint_states=5,tf=0", "--listen", local)
    arguments = ("router", *site, "--robot-file", str(tmp_path / "robots.txt"))

    def run(command: Command) -> None:
        assert command.line().endswith(f" listens at {local}")
        sentence = f"site 'plant1': joint_states at 5 Hz of 2 robots leave for {headquarters}"
        assert command.line() == sentence
        with connect(mode="client", endpoints=headquarters) as far:
            until(lambda: discover_sites(far).robots == {"plant1": frozenset({"r1", "r2"})})
            with connect(mode="client", endpoints=local) as near, StatePublisher(near, RRBOT, "r3"):
                until(lambda: "'r3' is not named" in command.stderr)

    with router(headquarters):
        run_watched(run, *arguments)
    printed = json.loads(str(zenoh.Config.from_json5(run_cli(*arguments, "--print").stdout)))
    rules = printed["downsampling"][0]["rules"]
    assert [one["key_expr"] for one in rules] == [f"zstate/r{n}/joint_states" for n in (1, 2)]
    limited = run_cli(*arguments, "--largest", "64", "--print").stdout
    assert "size_limit: 64000" in limited
    (tmp_path / "router.json5").write_text(limited)
    shown = run_cli("config", "--config", str(tmp_path / "router.json5")).stdout
    assert re.search(r"^site +plant1 ", shown, re.MULTILINE)
    assert re.search(r"^uplink +tcp ", shown, re.MULTILINE)
    assert re.search(
        r"^passing +joint_states at most 5.21 Hz of 2 robots, nothing larger than 64000 B ",
        shown,
        re.MULTILINE,
    )


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--uplink", "tls/hq:7447"), "--largest need --site"),
        (("--largest", "0"), "at least one byte"),
        (("--site", "plant1", "--robot", "r1"), "has no uplink"),
        (("--site", "plant1", "--uplink", "tls/hq:7447"), "names no robots"),
        (("--site", "plant1", "--uplink", "tls/hq:7447", "--downsample", "tf=1"), "exclude each other"),
        (("--site", "plant1", "--uplink", "tls/hq:7447", "--ros2"), "exclude each other"),
        (("--site", "plant1", "--uplink", "tcp/hq:7447", "--robot", "r1"), "cannot be distinguished from"),
        (
            ("--site", "plant1", "--uplink", "tls/hq:7447", "--robot", "r1", "--thin", "joints=5"),
            "'joints' cannot",
        ),
    ],
)
def test_options_of_a_site_that_do_not_fit_are_refused(arguments: tuple[str, ...], text: str):
    ended = run_cli("router", *arguments, "--print")
    assert ended.code in {1, 2}
    assert text in ended.stderr
