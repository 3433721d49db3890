"""Headquarters with mTLS: a site may write its own robots, by the name in its router's certificate."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.processes import find_free_port, until
from helpers.robots import RRBOT, SampleCollector

from zstate import StatePublisher, connect, discover
from zstate.errors import InvalidInput, ZStateError
from zstate.fleet.acl import AclRoles, access_control
from zstate.fleet.router_config import RouterConfig
from zstate.fleet.uplink import Uplink
from zstate.net.security.credentials import Credentials
from zstate.net.session import Session
from zstate.net.sites import SiteAnnouncement, discover_sites
from zstate.wire.messages import from_block

certificates = pytest.importorskip("zstate.fleet.certificates")

ROBOTS = {"plant1": ("r1",), "plant2": ("r2",)}


def test_a_rogue_site_cannot_write_the_robots_of_another_nor_pose_as_it(tmp_path: Path):
    """plant2 publishes r1 as well, at another position, and announces r2 as a robot of plant1."""
    certificates.issue_identities(tmp_path, ["hq", "desk", *ROBOTS])
    identity = {name: Credentials.from_folder(tmp_path, name) for name in ("hq", "desk", *ROBOTS)}
    headquarters = f"tls/127.0.0.1:{find_free_port()}"
    access = access_control(AclRoles(viewers=("desk",), sites=ROBOTS))
    with ExitStack() as opened:
        config = RouterConfig((headquarters,), credentials=identity["hq"], access_control=access)
        opened.enter_context(connect(config.settings()))
        local: dict[str, Session] = {}
        for site, robots in ROBOTS.items():
            endpoint = f"tcp/127.0.0.1:{find_free_port()}"
            link = Uplink(site, (headquarters,), {"joint_states": 20.0}, ("r1", "r2"))
            config = RouterConfig((endpoint,), credentials=identity[site], uplink=link)
            router = opened.enter_context(connect(config.settings()))
            for name in {site, "plant1"}:
                opened.enter_context(SiteAnnouncement(router, name, link.rates_hz, robots))
            local[site] = opened.enter_context(connect(mode="client", endpoints=endpoint))
        desk = connect(mode="client", endpoints=headquarters, credentials=identity["desk"])
        opened.enter_context(desk)
        arrived = {robot: SampleCollector(desk, f"zstate/{robot}/joint_states") for robot in ("r1", "r2")}
        rogue_arrived = SampleCollector(local["plant2"], "zstate/r1/joint_states")
        positions = {("plant1", "r1"): 0.25, ("plant2", "r2"): 0.5, ("plant2", "r1"): 1.0}
        publishers = {
            place: opened.enter_context(StatePublisher(local[place[0]], RRBOT, place[1], takeover=True))
            for place in positions
        }

        def publish_until_received() -> bool:
            for place, position in positions.items():
                publishers[place].publish([position, 0.0])
            return min(len(one.arrivals) for one in (*arrived.values(), rogue_arrived)) >= 20

        until(publish_until_received)
        for robot, position in (("r1", 0.25), ("r2", 0.5)):
            states = arrived[robot].joint_states(len(arrived[robot].arrivals))
            assert {from_block(state.positions)[0] for state in states} == {position}
        writers = {info.name: {writer for _, writer in info.writers} for info in discover(desk)}
        assert len(writers["r1"]) == 1
        until(lambda: len(discover_sites(desk).robots) == 2)
        assert discover_sites(desk).robots == {site: frozenset(robots) for site, robots in ROBOTS.items()}


def test_two_sites_with_one_robot_are_refused():
    with pytest.raises(InvalidInput, match="'r1' is given to the sites 'plant1' and 'plant2'"):
        AclRoles(sites={"plant1": ("r1",), "plant2": ("r1",)})


def test_a_site_whose_authority_headquarters_no_longer_accepts_is_refused(tmp_path: Path):
    """Each site has an authority of its own; Zenoh reads no revocation lists."""
    for name in ("hq", *ROBOTS):
        (tmp_path / name).mkdir()
        certificates.issue_identities(tmp_path / name, [name])
    headquarters = f"tls/127.0.0.1:{find_free_port()}"
    access = access_control(AclRoles(sites=ROBOTS))

    def identity(name: str, *authorities: str) -> Credentials:
        folder, bundle = tmp_path / name, tmp_path / name / "accepted.pem"
        bundle.write_text("".join((tmp_path / one / "ca.pem").read_text() for one in authorities))
        return Credentials(ca=bundle, certificate=folder / f"{name}.pem", key=folder / f"{name}.key")

    def joins(site: str) -> bool:
        try:
            with connect(mode="client", endpoints=headquarters, credentials=identity(site, "hq")):
                return True
        except ZStateError:
            return False

    for accepted in (("plant1", "plant2"), ("plant1",)):
        config = RouterConfig(
            (headquarters,), credentials=identity("hq", "hq", *accepted), access_control=access
        )
        with connect(config.settings()):
            assert {site: joins(site) for site in ROBOTS} == {site: site in accepted for site in ROBOTS}
