"""Two routers on loopback: a site's, whose uplink is thinned, and that of headquarters."""

from __future__ import annotations

import json
import re
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh
from helpers.cli_runner import run_cli
from helpers.fault_programs import ShiftedClock
from helpers.processes import find_free_port, until
from helpers.robots import RRBOT, UPRIGHT, SampleCollector
from helpers.slow_relay import SlowRelay

from zstate import StatePublisher, StaticPublisher, Transform, TransformListener, connect
from zstate.errors import (
    ClockMismatch,
    Disconnected,
    InFuture,
    InPast,
    NoData,
    Stale,
    UnknownFrame,
    Unreachable,
)
from zstate.fleet.router_config import RouterConfig
from zstate.fleet.uplink import Uplink
from zstate.ingest.diagnostics import WriterEvent
from zstate.net.session import Session
from zstate.net.sites import SiteAnnouncement, Thinning, discover_sites
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.odometry import ImuPublisher

RATE_HZ = 50.0
THIN_HZ = 5.0
SLOW_LINK = {"bytes_per_s": 250_000.0, "delay_s": 0.08, "stalls": 0.01}
"""2 Mbit/s, 80 ms each way; one chunk of a hundred stalls."""


class Site(NamedTuple):
    """Sessions at a site and at headquarters, and the endpoints of both routers."""

    local: Session
    far: Session
    site_endpoint: str
    headquarters: str


@contextmanager
def running_site(
    robots: tuple[str, ...], rates_hz: dict[str, float], relay: dict[str, float] | None = None, **options: Any
) -> Iterator[Site]:
    """The programs of a site use a socket file, so the uplink is distinguished from it by its protocol.

    With ``relay``, the options of one, the uplink is as slow as that.
    """
    headquarters = f"tcp/127.0.0.1:{find_free_port()}"
    with ExitStack() as opened:
        folder = opened.enter_context(tempfile.TemporaryDirectory())
        site = f"unixsock-stream/{Path(folder) / 'site.sock'}"
        opened.enter_context(connect(RouterConfig((headquarters,)).settings()))
        uplink = headquarters
        if relay is not None:
            port = int(headquarters.rpartition(":")[2])
            uplink = opened.enter_context(SlowRelay(port, **relay)).endpoint
        link = Uplink("plant1", (uplink,), rates_hz, robots, **options)
        router = opened.enter_context(connect(RouterConfig((site,), uplink=link).settings()))
        opened.enter_context(SiteAnnouncement(router, link.site, link.rates_hz, robots))
        local = opened.enter_context(connect(mode="client", endpoints=site))
        far = opened.enter_context(connect(mode="client", endpoints=headquarters))
        yield Site(local, far, site, headquarters)


@contextmanager
def published(
    session: Session, robots: tuple[str, ...], rate_hz: float = RATE_HZ, **options: Any
) -> Iterator[None]:
    """rrbot under each name, moved at ``rate_hz`` by one thread."""
    stop = threading.Event()
    with ExitStack() as opened:
        publishers = [
            opened.enter_context(StatePublisher(session, RRBOT, name, **options)) for name in robots
        ]

        def run() -> None:
            begin, tick = time.monotonic(), 0
            while not stop.wait(max(0.0, begin + tick / rate_hz - time.monotonic())):
                for number, publisher in enumerate(publishers):
                    # Far from a straight line between two samples of 5 Hz.
                    publisher.publish([0.3 * ((tick * 7919 + number) % 11), 0.1 * (tick % 5)])
                tick += 1

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield
        finally:
            stop.set()
            thread.join()


def test_headquarters_receives_each_robot_at_the_named_rate_and_the_site_everything():
    robots = ("r1", "r2")
    with running_site(robots, {"joint_states": THIN_HZ}) as site, published(site.local, robots):
        far, near = (
            {name: SampleCollector(session, f"zstate/{name}/joint_states") for name in robots}
            for session in (site.far, site.local)
        )
        until(lambda: min(len(one.arrivals) for one in far.values()) >= 10, timeout_s=30.0)
        for name in robots:
            passed, sent = len(far[name].arrivals), len(near[name].arrivals)
            # One tick in ten; on a busy machine ticks are late together, and more of them pass.
            assert sent / passed == pytest.approx(RATE_HZ / THIN_HZ, rel=0.3)


@pytest.mark.parametrize("interfaces", [(), ("lo",)])
def test_no_sample_leaves_of_a_robot_that_is_not_named(interfaces: tuple[str, ...]):
    """All links of headquarters are on "lo" here, and the programs of the site use a socket file."""
    robots = ("r1", "r2")
    with (
        running_site(("r1",), {"joint_states": THIN_HZ}, interfaces=interfaces) as site,
        published(site.local, robots),
    ):
        far, near = (
            {name: SampleCollector(session, f"zstate/{name}/joint_states") for name in robots}
            for session in (site.far, site.local)
        )
        until(lambda: len(far["r1"].arrivals) >= 5 and len(near["r2"].arrivals) >= 50, timeout_s=30.0)
        assert not far["r2"].arrivals
        with TransformListener(site.far, "*", history_on_join=False) as listener:
            until(lambda: listener.buffer.can_lookup("r1/base", "r1/lower"))


def lengths(session: Session, key: str) -> set[int]:
    """Of the replies to a query."""
    replies = session.zenoh.get(key, consolidation=zenoh.ConsolidationMode.NONE, timeout=5.0)
    return {len(one.ok.payload.to_bytes()) for one in replies if one.ok is not None}


def test_nothing_that_is_larger_than_the_limit_leaves_but_models_do():
    """Samples, values and replies to late joiners alike."""
    limit = 1000
    sizes = (limit + 1, limit)
    keys = ("zstate/r1/image/camera", "zstate/r1/map/floor", "zstate/r1/robot_description")
    with running_site(("r1",), {"image": 10_000.0}, largest_bytes=limit) as site:
        taps = {key: SampleCollector(site.far, key) for key in keys}

        def put_all() -> bool:
            for key in keys:
                for size in sizes:
                    site.local.zenoh.put(key, bytes(size))
            return min(len(one.arrivals) for one in taps.values()) >= 5

        until(put_all)
        found = {key: {len(payload) for payload in tap.payloads(5)} for key, tap in taps.items()}
        assert found == {keys[0]: {limit}, keys[1]: {limit}, keys[2]: set(sizes)}

        def reply(query: zenoh.Query) -> None:
            for size in sizes:
                query.reply(query.key_expr, bytes(size))

        with site.local.zenoh.declare_queryable("zstate/r1/map/a", reply):
            until(lambda: lengths(site.far, "zstate/r1/map/a") == {limit})
            assert lengths(site.local, "zstate/r1/map/a") == set(sizes)


def test_of_other_streams_no_sample_passes_while_values_and_queries_do():
    pose = Transform("odom", "base", (0.0, 0.0, 0.0), UPRIGHT)
    with (
        running_site(("r1",), {"joint_states": THIN_HZ, "scan": 0.0}) as site,
        TransformPublisher(site.local, "r1", "odometry") as odometry,
        StaticPublisher(site.local, "r1", "mount") as mount,
        TransformListener(site.far, "r1", follow="tf", history_on_join=False) as listener,
        closing(SampleCollector(site.far, "zstate/r1/transforms/*")) as far,
        closing(SampleCollector(site.local, "zstate/r1/transforms/*")) as near,
    ):
        mount.set(Transform("base", "camera", (0.0, 0.0, 1.0), UPRIGHT))
        until(lambda: (odometry.publish([pose]), len(near.arrivals) >= 50)[1])
        assert listener.buffer.wait("base", "camera", timeout_s=10.0).kind == "static"
        assert not far.arrivals
        # A reader that joins asks the writer itself.
        with TransformListener(site.far, "r1", follow="tf") as joined:
            assert joined.buffer.wait("odom", "base", timeout_s=10.0).kind == "exact"


def test_a_lookup_at_headquarters_is_exact_on_demand():
    """The joints move so that a straight line between samples of 5 Hz is far from them.

    One process publishes several robots.
    """
    robots = ("r1", "r2", "r3")
    with (
        running_site(robots, {"joint_states": THIN_HZ}) as site,
        published(site.local, robots),
        TransformListener(site.local, "r1") as near,
        TransformListener(site.far, "r1", history_on_join=False) as far,
    ):
        until(lambda: far.stats.received >= 4)
        at = far.buffer.latest("base", "lower") - 133_000_000
        there = near.buffer.wait("base", "lower", at)
        assert far.lookup("base", "lower", at).translation != pytest.approx(there.translation, abs=1e-3)
        assert far.lookup("base", "lower", at, exact=True) == there
        assert far.buffer.lookup("base", "lower", at) == there
        # An instant that has not come yet is waited for.
        soon = near.buffer.latest("base", "lower") + 250_000_000
        assert far.lookup("base", "lower", soon, exact=True, timeout_s=10.0) == near.buffer.wait(
            "base", "lower", soon
        )
        early = near.buffer.latest("base", "lower") - 9_000_000_000
        with pytest.raises(InPast, match="all that its writer keeps"):
            far.lookup("base", "lower", early, exact=True)


@pytest.mark.long
def test_over_a_slow_link_that_stalls_lookups_go_on_and_exact_ones_equal_those_of_the_site():
    robots = ("r1", "r2")
    with (
        running_site(robots, {"joint_states": THIN_HZ}, SLOW_LINK) as site,
        published(site.local, robots, cache_s=30.0),
        TransformListener(site.local, "r1") as near,
        TransformListener(site.far, "r1", history_on_join=False) as far,
    ):
        until(lambda: far.stats.received >= 4, timeout_s=30.0)
        for _ in range(15):
            newest = far.buffer.latest("base", "lower")
            far.buffer.wait("base", "lower", newest + 1, timeout_s=10.0)
            at = far.buffer.latest("base", "lower") - 133_000_000
            there = near.buffer.wait("base", "lower", at, timeout_s=10.0)
            assert far.lookup("base", "lower", at, exact=True, timeout_s=10.0) == there
        assert far.stats.refused == {}


def test_a_writer_without_a_cache_is_named_by_an_exact_lookup():
    with (
        running_site(("r1",), {"joint_states": THIN_HZ}) as site,
        StatePublisher(site.local, RRBOT, "r1", cache_s=0.0) as publisher,
        TransformListener(site.far, "r1") as far,
    ):
        until(lambda: (publisher.publish([0.1, 0.2]), far.buffer.can_lookup("base", "lower"))[1])
        with pytest.raises(Unreachable, match=r"which places 'r1/upper', has not sent its samples"):
            far.lookup("base", "lower", exact=True, timeout_s=0.3)


def test_lookups_across_sites_are_refused_by_name_if_a_clock_is_off():
    """r1 is 2 s ahead; both stand in one map. Within one robot lookups go on, and ages are corrected."""
    ahead = ShiftedClock()
    ahead.shift_ns = 2_000_000_000
    with (
        running_site(("r1", "r2"), {"joint_states": THIN_HZ, "transforms": THIN_HZ}) as site,
        StatePublisher(site.local, RRBOT, "r1", clock=ahead) as off,
        StatePublisher(site.local, RRBOT, "r2") as right,
        StaticPublisher(site.local, "r1", "place") as place,
        StaticPublisher(site.local, "r2", "place") as other_place,
        TransformListener(site.far) as far,
    ):
        place.set(Transform("fleet/map", "r1/world", (0.0, 0.0, 0.0), UPRIGHT))
        other_place.set(Transform("fleet/map", "r2/world", (5.0, 0.0, 0.0), UPRIGHT))

        def mismatch() -> ClockMismatch | None:
            for publisher in (off, right):
                publisher.publish([0.1, 0.2])
            with suppress(UnknownFrame, Disconnected, NoData, Stale, InPast, InFuture):
                try:
                    far.buffer.lookup("r1/lower", "r2/lower")
                except ClockMismatch as error:
                    return error
            return None

        until(lambda: mismatch() is not None, timeout_s=30.0)
        error = mismatch()
        assert error is not None
        assert re.search(r"robot 'r1' is stamped in 'site plant1 \(\+2\.0 s\)' time", str(error))
        until(lambda: (off.publish([0.1, 0.2]), far.buffer.can_lookup("fleet/map", "r1/lower"))[1])
        with pytest.raises(Stale) as stale:
            far.buffer.lookup("fleet/map", "r1/lower", max_age_s=0.0)
        assert 0.0 < stale.value.age_s < 2.0


def test_a_site_is_announced_with_its_robots_and_rates():
    many = tuple(f"robot_{number:04}" for number in range(1000))
    with connect() as session:
        with SiteAnnouncement(session, "plant1", {"joint_states": 5.0, "tf": 0.0}, many):
            sites = discover_sites(session)
            assert sites.robots == {"plant1": frozenset(many)}
            assert sites.thinning("robot_0999", "joint_states") == Thinning("plant1", 5.0)
            assert str(sites.thinning("robot_0000", "tf")) == "held back on purpose by site 'plant1'"
            assert sites.thinning("robot_0000", "robot_description") is None
            assert sites.thinning("other", "joint_states") is None
        assert discover_sites(session).robots == {}


def test_a_silent_link_is_noticed_by_the_period_that_the_site_announces():
    events: list[WriterEvent] = []
    with (
        running_site(("r1",), {"joint_states": THIN_HZ}) as site,
        TransformListener(site.far, "r1", on_event=events.append) as far,
        TransformListener(site.local, "r1") as near,
        StatePublisher(site.local, RRBOT, "r1") as publisher,
    ):
        until(lambda: (publisher.publish([0.1, 0.2]), far.stats.received >= 3)[1], timeout_s=30.0)
        assert near.stats.received > far.stats.received
        until(lambda: any(one.kind == "stale" for one in events))
        assert "or the link of its site is down" in next(one for one in events if one.kind == "stale").text


def test_tools_at_headquarters_call_no_sample_lost_that_the_site_holds_back():
    with (
        running_site(("r1",), {"joint_states": THIN_HZ}) as site,
        published(site.local, ("r1",)),
        ImuPublisher(site.local, "r1", "torso", frame="lower") as imu,
    ):
        imu.publish((0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        far, near = ("--connect", site.headquarters), ("--connect", site.site_endpoint)
        assert "thinned to 5 Hz on purpose by site 'plant1'" in run_cli("hz", "r1", "--once", *far).stdout
        there = run_cli("hz", "r1", "--once", *near).stdout
        assert "missed" not in there
        assert "plant1" not in there
        monitored = run_cli("monitor", "--robots", "--robot", "r1", "--seconds", "1.5", *far).stdout
        assert re.search(r"held back on purpose [1-9]", monitored)
        assert "missed" not in monitored
        (listed,) = json.loads(run_cli("ls", "--json", *far).stdout)
        assert listed["site"] == "plant1"
        thinned = {one["stream"]: one["thinned_hz"] for one in listed["writers"]}
        assert thinned == {
            **dict.fromkeys(("tf", "imu"), 0.0),
            **dict.fromkeys(("tf_static", "robot_description")),
            "joint_states": 5.0,
        }
        text = run_cli("ls", *far).stdout
        assert "'plant1', from which joint_states at 5 Hz leave" in text
        assert re.search(r"imu/torso +held back", text)
        graph = json.loads(run_cli("graph", "--json", *far).stdout)["streams"]
        rates = {one["stream"]: one["thinned_hz"] for one in graph if one["writers"]}
        assert (rates["joint_states"], rates["imu/torso"]) == (5.0, 0.0)


@pytest.mark.long
def test_doctor_at_headquarters_names_the_site_and_finds_nothing_wrong():
    with (
        running_site(("r1",), {"joint_states": THIN_HZ}) as site,
        published(site.local, ("r1",)),
        ImuPublisher(site.local, "r1", "torso", frame="lower") as imu,
    ):
        imu.publish((0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        ended = run_cli("doctor", "r1", "--json", "--connect", site.headquarters)
        checks = {one["name"]: one for one in json.loads(ended.stdout)["checks"]}
        assert ended.code == 0, ended
        assert checks["site"]["text"] == "'plant1', from which joint_states at 5 Hz leave"
        assert "thinned to 5 Hz on purpose by site 'plant1'" in checks["joint_states"]["text"]
        assert "held back on purpose by site 'plant1'" in checks["imu"]["text"]


def test_tf_exact_asks_the_robot_itself():
    with running_site(("r1",), {"joint_states": THIN_HZ}) as site, published(site.local, ("r1",)):
        with TransformListener(site.local, "r1") as near:
            until(lambda: near.stats.received > 50)
            at = near.buffer.latest("base", "lower") - 133_000_000
            there = near.buffer.lookup("base", "lower", at).to_dict()
        far = ("--at", str(at), "--json", "--connect", site.headquarters)
        found = json.loads(run_cli("tf", "base", "lower", "--exact", *far).stdout)
        assert {name: found[name] for name in there} == there
    ended = run_cli("tf", "base", "lower", "--exact")
    assert ended.code == 2
    assert "--exact asks for one pose" in ended.stderr
