from __future__ import annotations

import json
import re
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import zenoh
from helpers.processes import find_free_port, until
from helpers.robots import RRBOT, SampleCollector, wait_for_reader

from zstate import StatePublisher, connect
from zstate.errors import ConfigError, InvalidInput
from zstate.fleet.acl import ALL_KEYS, AclRoles, access_control, read_access_control
from zstate.fleet.downsampling import Downsampling
from zstate.fleet.router_config import RouterConfig, access_text
from zstate.fleet.uplink import Uplink
from zstate.net.config import default_config
from zstate.net.security.credentials import Credentials
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.stream_registry import all_streams
from zstate.transform import Transform
from zstate.wire import keys as wire_keys
from zstate.wire.keys import MODEL_WRITER, stream_key

FILES = Credentials(ca="/certs/ca.pem", certificate="/certs/r1.pem", key="/certs/r1.key")
CONFIGURATIONS = {
    "plain": RouterConfig(),
    "ros2": RouterConfig(ros2=True),
    "whole": RouterConfig(
        listen=("tls/[::]:7447", "tcp/127.0.0.1:7447"),
        connect=("tls/fleet.example.com:7447", "tls/spare.example.com:7447"),
        credentials=FILES,
        downsampling=Downsampling({"joint_states": 10.0, "tf": 2.5}, ("r1", "r2"), ("wwan0",)),
        access_control=access_control(AclRoles(("r1",), ("desk",))),
    ),
    "site": RouterConfig(
        listen=("tcp/127.0.0.1:7447",),
        credentials=FILES,
        uplink=Uplink("plant1", ("tls/hq.example.com:7447",), {"joint_states": 5.0, "tf": 0.0}, ("r1", "r2")),
    ),
    "users": RouterConfig(credentials=Credentials(user="r1", password="secret", users="/etc/users")),
}


def parsed(text: str) -> dict[str, Any]:
    return json.loads(str(zenoh.Config.from_json5(text)))


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_text_is_the_configuration_that_is_run(name: str):
    """Zenoh refuses names that it does not know, so all of them are its own."""
    config = CONFIGURATIONS[name]
    assert parsed(config.text()) == parsed(json.dumps(config.settings()))


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_every_section_has_a_comment(name: str):
    lines = CONFIGURATIONS[name].text().splitlines()
    sections = [number for number, line in enumerate(lines) if line.startswith("  ") and line[2].isalpha()]
    unsaid = [lines[n].split(":")[0].strip() for n in sections if not lines[n - 1].startswith("  //")]
    assert set(unsaid) <= {"mode", "transport", "routing"}


def test_settings_equal_those_of_a_session_in_router_mode():
    made = parsed(CONFIGURATIONS["plain"].text())
    opened = json.loads(str(default_config("router", (), ("tcp/127.0.0.1:7447",))))
    for ours in (made, opened):
        for of_others in ("connect", "scouting"):
            del ours[of_others]
    assert made == opened


def test_router_retries_other_routers_and_serves_clients_in_between():
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    config = RouterConfig((endpoint,), (f"tcp/127.0.0.1:{find_free_port()}",))
    with connect(config.settings()), connect(mode="client", endpoints=endpoint) as client:
        assert client.zenoh.info.routers_zid()


def test_loopback_endpoints_need_no_encryption():
    RouterConfig(("tcp/127.0.0.1:7447", "tls/[::]:7447"), credentials=FILES)
    with pytest.raises(ConfigError, match="is not encrypted"):
        RouterConfig(("tcp/0.0.0.0:7447",), credentials=FILES)
    with pytest.raises(ConfigError, match="is not encrypted"):
        RouterConfig(connect=("tcp/fleet.example.com:7447",), credentials=FILES)


def test_access_control_without_names_is_refused():
    access = access_control(AclRoles(("r1",)))
    with pytest.raises(ConfigError, match="access control without certificates or users"):
        RouterConfig(access_control=access)
    with pytest.raises(ConfigError, match="access control without certificates or users"):
        RouterConfig(credentials=Credentials(ca="/certs/ca.pem"), access_control=access)
    RouterConfig(credentials=Credentials(users="/etc/users"), access_control=access)


def test_access_control_is_read_from_a_file_as_it_was_written(tmp_path: Path):
    fleet = AclRoles(("r1", "r2"), ("desk",))
    file = tmp_path / "acl.json5"
    file.write_text(access_text(fleet))
    assert read_access_control(file) == access_control(fleet)


@pytest.mark.parametrize("text", ["{}", "{ access_control: { enabled: false } }"])
def test_a_file_without_access_control_is_refused(tmp_path: Path, text: str):
    file = tmp_path / "acl.json5"
    file.write_text(text)
    with pytest.raises(ConfigError, match="has no access_control that is enabled"):
        read_access_control(file)


def test_each_robot_is_downsampled_separately_and_latched_values_never():
    """For one rule of both, Zenoh would let through as much of them together as of one."""
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    limits = Downsampling({"joint_states": 20.0}, ("r1", "r2"))
    with (
        connect(RouterConfig((endpoint,), downsampling=limits).settings()),
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
    ):
        taps = [SampleCollector(reader, f"zstate/{robot}/joint_states") for robot in ("r1", "r2")]
        statics = SampleCollector(reader, "zstate/*/tf_static/*")
        for robot in ("r1", "r2"):  # static edges are sent once, as the publisher opens
            wait_for_reader(writer, f"zstate/{robot}/tf_static/{MODEL_WRITER}")
        with (
            StatePublisher(writer, RRBOT, "r1") as one,
            StatePublisher(writer, RRBOT, "r2") as other,
        ):
            published = 0

            def each_has_ten() -> bool:
                nonlocal published
                for publisher in (one, other):
                    publisher.publish([0.1, 0.2])
                published += 1
                return min(len(tap.arrivals) for tap in taps) >= 10

            until(each_has_ten)
            received = [len(tap.arrivals) for tap in taps]
            assert max(received) < published / 2  # a few hundred a second are put
            assert max(received) - min(received) <= 3
            until(lambda: len(statics.arrivals) == 2)


def test_transforms_of_a_robot_are_downsampled_together():
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    limits = Downsampling({"transforms": 20.0}, ("r1",))
    with (
        connect(RouterConfig((endpoint,), downsampling=limits).settings()),
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
        closing(SampleCollector(reader, "zstate/r1/transforms/*")) as tap,
        TransformPublisher(writer, "r1", "odometry") as odometry,
    ):
        published = 0

        def has_ten() -> bool:
            nonlocal published
            odometry.publish([Transform("odom", "base", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))])
            published += 1
            return len(tap.arrivals) >= 10

        until(has_ten)
        assert len(tap.arrivals) < published / 2  # a few hundred a second are put


def test_other_interfaces_are_not_downsampled():
    endpoint = f"tcp/127.0.0.1:{find_free_port()}"
    limits = Downsampling({"joint_states": 0.01}, ("r1",), ("no-such-interface",))
    with (
        connect(RouterConfig((endpoint,), downsampling=limits).settings()),
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
    ):
        tap = SampleCollector(reader, "zstate/r1/joint_states")
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            until(lambda: (publisher.publish([0.1, 0.2]), len(tap.arrivals) >= 10)[1])


@pytest.mark.parametrize(
    ("rates_hz", "robots", "text"),
    [
        ({"tf_static": 1.0}, ("r1",), "cannot be downsampled"),
        ({"joint_commands": 1.0}, ("r1",), "cannot be downsampled"),
        ({"tf": 0.0}, ("r1",), "positive number"),
        ({"tf": float("nan")}, ("r1",), "positive number"),
        ({"tf": 1.0}, (), "names of the robots"),
        ({}, ("r1",), "needs streams"),
    ],
)
def test_downsampling_without_rates_or_robots_is_refused(rates_hz, robots, text: str):
    with pytest.raises(InvalidInput, match=text):
        Downsampling(rates_hz, robots)


def test_namespace_prefixes_downsampled_keys():
    (section,) = Downsampling({"tf": 1.0}, ("r1",), namespace="hall/east").settings()
    assert section["rules"] == [{"key_expr": "hall/east/zstate/r1/tf", "freq": 1.0}]


def uplink(rates_hz: dict[str, float], robots: tuple[str, ...] = ("r1", "r2"), **options: Any) -> Uplink:
    return Uplink("plant1", ("tls/hq.example.com:7447",), rates_hz, robots, **options)


def leaving(link: Uplink) -> list[zenoh.KeyExpr]:
    """The keys whose samples and values leave."""
    section: Any = link.settings((), {})["access_control"]
    (rule,) = [one for one in section["rules"] if one["id"] == "leaves"]
    assert rule["flows"] == ["egress"]
    return [zenoh.KeyExpr(key) for key in rule["key_exprs"]]


def test_of_samples_only_those_of_named_robots_and_streams_leave():
    """By access control, which allows what one rule includes; of two rules that thin, Zenoh takes either."""
    link = uplink({"joint_states": 5.0, "tf": 0.0})
    keys = leaving(link)
    for row in all_streams():
        for robot in ("r1", "other"):
            key = stream_key(robot, row.name, "name" if row.named else "")
            passes = not row.is_sampled or (row.name == "joint_states" and robot == "r1")
            assert any(one.includes(key) for one in keys) == passes, key
    assert not any(one.includes("zstate/r1/of_another_package/name") for one in keys)
    (item,) = link.settings((), {})["downsampling"]
    assert {rule["key_expr"] for rule in item["rules"]} == {f"zstate/{r}/joint_states" for r in ("r1", "r2")}


def test_within_the_site_all_keys_are_allowed():
    keys = [zenoh.KeyExpr(key) for key in ALL_KEYS]
    forms = [one.form for one in vars(wire_keys).values() if isinstance(one, wire_keys.Key)]
    others = (
        "0/chatter/dds/hash",
        "zstate/r1/tf_static/m/@adv/pub/zid/1/_",
        "@/zid/router/linkstate/routers",
        "@ros2_lv/0/zid/0/0/NN/%/%/node",
        "@/zid/@ros2_lv/MP/tf/type/qos",
    )
    for key in (*(re.sub("<[a-z]+>", "name", form) for form in forms), *others):
        assert any(one.includes(key) for one in keys), key


def test_a_sample_that_comes_a_little_early_passes_too():
    """At 5 of 50 Hz every tenth sample passes if it comes up to 8 ms early, and no ninth does."""
    rules = uplink({"joint_states": 5.0}).settings((), {})["downsampling"][0]["rules"]
    least_s = 1.0 / rules[0]["freq"]
    assert 9 / 50 < least_s == pytest.approx(10 / 50 - 0.008)


def test_the_uplink_is_told_by_protocol_or_by_interface():
    assert uplink({}).settings(("tcp/127.0.0.1:7447",), {})["qos/network"][0]["link_protocols"] == ["tls"]
    with pytest.raises(ConfigError, match=r"cannot be distinguished from 'tls/\[::\]:7447'.*--wan"):
        uplink({}).settings(("tls/[::]:7447",), {})
    item = uplink({}, interfaces=("wwan0",)).settings(("tls/[::]:7447",), {})["qos/network"][0]
    assert item["interfaces"] == ["wwan0"]
    assert "link_protocols" not in item


@pytest.mark.parametrize(
    ("rates_hz", "robots", "text"),
    [
        ({"map": 0.0}, ("r1",), "cannot be downsampled"),
        ({"tf": -1.0}, ("r1",), "0 for none"),
        ({"tf": float("inf")}, ("r1",), "0 for none"),
        ({"tf": 1.0}, (), "names no robots"),
        ({"tf": 1.0}, ("*",), "robot name"),
    ],
)
def test_an_uplink_without_usable_rates_and_robots_is_refused(rates_hz, robots, text: str):
    with pytest.raises(InvalidInput, match=text):
        uplink(rates_hz, robots)


def test_a_router_with_an_uplink_downsamples_to_no_other_neighbour():
    with pytest.raises(InvalidInput, match="not both"):
        RouterConfig(downsampling=Downsampling({"tf": 1.0}, ("r1",)), uplink=uplink({}))
