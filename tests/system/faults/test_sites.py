"""Three sites and headquarters: hosts of their own, links of 2 Mbit/s, mTLS and access control."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.fault_processes import RECOVERED_WITHIN_S
from helpers.network_namespaces import NamespaceHosts
from helpers.processes import Child, until
from helpers.site_programs import CODE, RATE_HZ

from zstate.fleet.acl import AclRoles
from zstate.fleet.router_config import access_text

certificates = pytest.importorskip("zstate.fleet.certificates")

pytestmark = [pytest.mark.processes, pytest.mark.netns]

SITES = ("plant1", "plant2", "plant3")
THIN_HZ = 5.0
RETURN_OF_A_ROBOT_S = 0.04
"""Its tokens, queryables and values cross the link of 2 Mbit/s again, before or between samples."""
FULL_CUT_S = 20.0
LOCAL = "tcp/127.0.0.1:7447"
SHIFT_S = 2.0
Spawn = Callable[..., Child]


class Host:
    """The processes of one host, with queries."""

    def __init__(self, spawn: Spawn, hosts: NamespaceHosts, name: str, router: tuple[str, ...]) -> None:
        self._spawn, self._namespace, self._router_arguments = spawn, hosts.namespace(name), router
        self.name = name
        self.router = self.start_router()

    def start_router(self) -> Child:
        self.router = self._spawn(CODE, "router", self._namespace, *self._router_arguments)
        assert " listens at " in self.router.line()
        return self.router

    def start(self, role: str, *arguments: str) -> None:
        self._program = self._spawn(CODE, role, self._namespace, *arguments)
        assert self._program.line(60.0) == "ready", self._program.stderr

    def send(self, *query: Any) -> None:
        self._program.send_line(json.dumps(query))

    def receive(self) -> Any:
        return json.loads(self._program.line(60.0))

    def query(self, *query: Any) -> Any:
        self.send(*query)
        return self.receive()


@pytest.fixture
def hosts() -> Iterator[NamespaceHosts]:
    with NamespaceHosts("hq", *SITES) as hosts:
        for name in SITES:
            limit = ("tbf", "rate", "2mbit", "burst", "16kb", "latency", "200ms")
            inside = ("ip", "netns", "exec", hosts.namespace(name))
            subprocess.run([*inside, "tc", "qdisc", "add", "dev", "cable", "root", *limit], check=True)
        yield hosts


def names_of(site: str, count: int) -> list[str]:
    return [f"{site}_{number}" for number in range(count)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("count", "cut_s"),
    [(4, 4.0), pytest.param(100, 30.0, marks=[pytest.mark.soak, pytest.mark.timeout(600)])],
)
def test_headquarters_of_three_sites_through_cuts_and_a_killed_router(
    spawn: Spawn, hosts: NamespaceHosts, tmp_path: Path, count: int, cut_s: float
):
    certificates.issue_identities(tmp_path, ["hq", "desk", *SITES], hosts=[hosts.address("hq")])
    robots = {site: names_of(site, count) for site in SITES}
    everyone = [robot for names in robots.values() for robot in names]
    acl = tmp_path / "acl.json5"
    acl.write_text(access_text(AclRoles(viewers=("desk",), sites={s: tuple(r) for s, r in robots.items()})))
    uplink = f"tls/{hosts.address('hq')}:7447"
    identity = ("--certs", str(tmp_path), "--identity")
    hq = Host(spawn, hosts, "hq", ("--listen", "tls/0.0.0.0:7447", *identity, "hq", "--acl", str(acl)))
    sites: dict[str, Host] = {}
    for site, names in robots.items():
        (tmp_path / site).write_text("\n".join(names))
        thin = ("--thin", f"joint_states={THIN_HZ:g},tf=0", "--robot-file", str(tmp_path / site))
        options = ("--site", site, "--uplink", uplink, *thin, *identity, site)
        sites[site] = Host(spawn, hosts, site, options)
        shift_s = SHIFT_S if site == "plant3" else 0.0
        sites[site].start("robots", LOCAL, ",".join(names), str(shift_s))
    hq.start("headquarters", uplink, str(tmp_path), ",".join(everyone))

    assert hq.query("when", everyone, 30.0) is not None
    until(lambda: hq.query("sites") == {site: sorted(names) for site, names in robots.items()})
    rates = hq.query("rates", 3.0)
    print(f"rates at headquarters: {min(rates.values()):.2f} to {max(rates.values()):.2f} Hz")
    assert THIN_HZ * 0.7 < min(rates.values()) <= max(rates.values()) < THIN_HZ * 1.2
    at = sites["plant1"].query("latest") - 133_000_000
    there, here = sites["plant1"].query("pose", at), hq.query("exact", robots["plant1"][0], at)
    assert here["translation"] == there["translation"]
    assert here["rotation"] == there["rotation"]

    # The clocks of one site are two seconds ahead, and are measured through its router.
    offsets = hq.query("offsets")
    for site, names in robots.items():
        ahead_s = SHIFT_S if site == "plant3" else 0.0
        assert offsets[names[0]] == pytest.approx(ahead_s, abs=0.5), site
    assert hq.query("refused") == {}

    # The link of one site is cut: it goes on, headquarters notices by the age of samples.
    others = [robot for robot in everyone if robot not in robots["plant1"]]
    before = sites["plant1"].query("received")
    hosts.drop_packets("plant1")
    stale_s = hq.query("when", others, 10.0)
    until(lambda: sites["plant1"].query("received")[0] > before[0] + cut_s * RATE_HZ * 0.8, timeout_s=60.0)
    hosts.pass_packets("plant1")
    back_s = hq.query("when", everyone, 30.0)
    print(f"cut of {cut_s:g} s: stale after {stale_s:.2f} s, complete {back_s:.2f} s after the return")
    assert sites["plant1"].query("received")[1] == before[1], "samples were lost within the site"
    assert stale_s < RECOVERED_WITHIN_S
    assert back_s < RECOVERED_WITHIN_S + RETURN_OF_A_ROBOT_S * count

    # The router of a site is killed: nothing of it arrives until it runs again.
    sites["plant2"].router.kill()
    others = [robot for robot in everyone if robot not in robots["plant2"]]
    assert hq.query("when", others, 10.0) is not None
    sites["plant2"].start_router()
    restarted_s = hq.query("when", everyone, 30.0)
    print(f"router killed: complete {restarted_s:.2f} s after its start")
    assert restarted_s < RECOVERED_WITHIN_S + RETURN_OF_A_ROBOT_S * count


@pytest.mark.long
def test_nothing_within_a_site_waits_for_a_full_uplink(spawn: Spawn, hosts: NamespaceHosts):
    """Its publishers wait for room, as those of latched values do; without the rule they are 2.8 s late."""
    hq = Host(spawn, hosts, "hq", ("--listen", "tcp/0.0.0.0:7447"))
    hq.start("counter", "tcp/127.0.0.1:7447")
    uplink = f"tcp/{hosts.address('hq')}:7447"
    site = Host(
        spawn, hosts, "plant1", ("--site", "plant1", "--uplink", uplink, "--robot", "r1", "--wan", "cable")
    )
    site.start("flood", LOCAL)
    site.query("run", 1.0)  # until headquarters has subscribed
    until(lambda: hq.query("arrived") > 0)
    found = site.query("run", 4.0)
    arrived = hq.query("arrived")
    print(
        f"{found['sent']} sent, oldest {found['oldest_s']:.3f} s within the site; {arrived} at headquarters"
    )
    assert arrived < 0.7 * found["sent"], "the uplink was not full"
    assert found["oldest_s"] < 1.0


@pytest.mark.long
def test_a_site_whose_uplink_was_full_when_it_was_cut_is_back_soon(
    spawn: Spawn, hosts: NamespaceHosts, tmp_path: Path
):
    """A full socket of TLS; without a limit on it the return takes up to as long again as the cut."""
    certificates.issue_identities(tmp_path, ["hq", "desk", "plant1"], hosts=[hosts.address("hq")])
    identity = ("--certs", str(tmp_path), "--identity")
    uplink = f"tls/{hosts.address('hq')}:7447"
    hq = Host(spawn, hosts, "hq", ("--listen", "tls/0.0.0.0:7447", *identity, "hq"))
    hq.start("counter", uplink, str(tmp_path))
    options = ("--site", "plant1", "--uplink", uplink, "--robot", "r1", *identity, "plant1")
    site = Host(spawn, hosts, "plant1", options)
    site.start("flood", LOCAL)
    site.send("run", 2.0 * FULL_CUT_S + 60.0)
    until(lambda: hq.query("arrived") > 0, timeout_s=60.0)
    began = time.monotonic()
    hosts.drop_packets("plant1")
    until(lambda: time.monotonic() > began + FULL_CUT_S, timeout_s=2.0 * FULL_CUT_S)
    arrived = hq.query("arrived")
    hosts.pass_packets("plant1")
    healed = time.monotonic()
    until(lambda: hq.query("arrived") > arrived, timeout_s=2.0 * FULL_CUT_S)
    back_s = time.monotonic() - healed
    print(f"full uplink, cut of {FULL_CUT_S:g} s: back after {back_s:.2f} s")
    assert back_s < RECOVERED_WITHIN_S
