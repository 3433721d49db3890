"""The keys, encodings, types, hashes and tokens on the network, as ``golden/network.json`` has them.

Programs of others depend on them: a rename in the code leaves them as they are, and an intended change edits
that file, docs/wire.md and CHANGELOG.md.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from helpers.message_types import MESSAGE_TYPES
from helpers.processes import repeated, until
from helpers.robots import wait_for_reader

from zstate import (
    ClockPublisher,
    StatePublisher,
    StaticPublisher,
    Transform,
    TransformListener,
    TransformPublisher,
    load_model,
)
from zstate.net.session import Session
from zstate.odometry import (
    Datum,
    DatumPublisher,
    FixPublisher,
    ImuPublisher,
    MagneticFieldPublisher,
    OdometryPublisher,
    PosePublisher,
    PressurePublisher,
    VelocityPublisher,
)
from zstate.wire.native import encoding_of

NETWORK = json.loads(Path(__file__).with_name("golden").joinpath("network.json").read_text())
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
EVERYTHING = ("joint_states", "tf", "tf_static", "robot_description")


def test_encodings_of_all_message_classes():
    assert sorted(map(encoding_of, MESSAGE_TYPES)) == NETWORK["native_encodings"]


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
    model = load_model("rrbot")
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
            opened.enter_context(DatumPublisher(writer, "r1", program="driver")).set(Datum(47.5, 8.25))
        wheels, imu, flow, mocap, gps, barometer, mag = (
            opened.enter_context(kind(writer, "r1", name, (wire,), program="driver"))
            for kind, name in (
                (OdometryPublisher, "odom"),
                (ImuPublisher, "chest"),
                (VelocityPublisher, "flow"),
                (PosePublisher, "mocap"),
                (FixPublisher, "gps"),
                (PressurePublisher, "bmp"),
                (MagneticFieldPublisher, "mag"),
            )
        )

        def publish() -> None:
            publisher.publish([0.0, 0.0])
            clock.publish(1)
            wheels.publish(Transform("start", "odom", (1.0, 0.0, 0.0), UPRIGHT), [0, 0, 0], [0, 0, 0])
            imu.publish([0, 0, 0], [0, 0, 9.81])
            flow.publish([0, 0, 0])
            mocap.publish(Transform("map", "odom", (1.0, 0.0, 0.0), UPRIGHT))
            gps.publish(47.5, 8.25)
            barometer.publish(101325.0)
            mag.publish([2e-5, 0, -4e-5])

        with repeated(publish):
            yield


@pytest.mark.usefixtures("driver")
def test_native_keys_encodings_and_tokens(sessions: tuple[Session, Session]):
    writer, reader = sessions
    expressions = ("zstate/*/@writer/**", "zstate/@reader/**", "zstate/*/@edge/**")
    expected = NETWORK["native_network"]
    with sniffed(reader, "zstate/**", *expressions) as sniffers, talking(writer, reader, "native"):
        until(lambda: all_in(expected, facts_of(sniffers)))
        assert facts_of(sniffers) == NETWORK["native_network"]
        replies = {
            name: sorted(
                map(
                    list,
                    {
                        (masked(str(one.ok.key_expr)), str(one.ok.encoding))
                        for one in reader.zenoh.get(selector, timeout=5.0)
                        if one.ok
                    },
                )
            )
            for name, selector in (("history", "zstate/r1/joint_states"), ("clock", "zstate/r1/@clock/*"))
        }
    assert replies == NETWORK["native_replies"]


def all_in(expected: dict[str, list[Any]], found: dict[str, list[Any]]) -> bool:
    return all(one in found[part] for part, ones in expected.items() for one in ones)


@pytest.mark.usefixtures("driver")
@pytest.mark.parametrize("wire", ["ros2", "ros2dds"])
def test_ros_keys_types_hashes_and_tokens(sessions: tuple[Session, Session], wire: str):
    writer, reader = sessions
    expected = NETWORK[wire]
    with sniffed(reader, "**", "@ros2_lv/**") as sniffers, talking(writer, reader, f"{wire}:namespace=r1"):
        until(lambda: all_in(expected, facts_of(sniffers)))
        assert facts_of(sniffers) == NETWORK[wire]
