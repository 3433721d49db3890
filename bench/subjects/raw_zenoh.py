"""The floor: eclipse-zenoh alone, with payloads as long as zstate's joint states and no processing."""

from __future__ import annotations

import sys
from importlib.metadata import version

from bench.subjects.subject import Roles, Subject
from bench.subjects.zstate_chain import router_row

PAYLOAD = (
    "the payload is as long as zstate's message, with the stamp in its first eight bytes; the reader's "
    "callback unpacks that stamp and counts it as an answer: no model, no buffer, no lookup"
)


def _versions() -> dict[str, str]:
    return {"eclipse-zenoh": version("eclipse-zenoh")}


def _load_peers() -> Roles:
    from bench.subjects import raw_zenoh_roles  # noqa: PLC0415 - imported late, as the protocol requires

    return raw_zenoh_roles.roles(raw_zenoh_roles.as_peer)


def _load_clients() -> Roles:
    from bench.subjects import raw_zenoh_roles  # noqa: PLC0415 - as above

    return raw_zenoh_roles.roles(raw_zenoh_roles.through_router)


SUBJECTS = (
    Subject(
        "raw_zenoh",
        "raw Zenoh (floor)",
        (
            "eclipse-zenoh from Python, peer to peer over TCP on loopback, otherwise with default settings",
            PAYLOAD,
        ),
        ("pip install eclipse-zenoh",),
        python=lambda: sys.executable,
        versions=_versions,
        load=_load_peers,
        floor=True,
    ),
    Subject(
        "raw_zenoh_router",
        "raw Zenoh, router (floor)",
        ("two clients of the routers that zstate uses, over TCP on loopback", PAYLOAD),
        ("pip install eclipse-zenoh",),
        python=lambda: sys.executable,
        versions=_versions,
        load=_load_clients,
        services=router_row,
        fleet=True,
        floor=True,
    ),
)
