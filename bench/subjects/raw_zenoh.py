"""The floor: eclipse-zenoh alone, with payloads as long as zstate's joint states and no processing."""

from __future__ import annotations

import sys
from importlib.metadata import version

from bench.subjects.subject import Roles, Subject


def _load() -> Roles:
    from bench.subjects import raw_zenoh_roles as roles  # noqa: PLC0415 - imported late, as the protocol requires

    return roles.Writer, roles.Reader


SUBJECT = Subject(
    name="raw_zenoh",
    title="raw Zenoh (floor)",
    settings=(
        "eclipse-zenoh from Python, peer to peer over TCP on loopback, with its default settings otherwise",
        "the payload is as long as zstate's message, with the stamp in its first eight bytes; the reader's "
        "callback unpacks that stamp and counts it as an answer: no model, no buffer, no lookup",
    ),
    install=("pip install eclipse-zenoh",),
    python=lambda: sys.executable,
    versions=lambda: {"eclipse-zenoh": version("eclipse-zenoh")},
    load=_load,
    floor=True,
)
