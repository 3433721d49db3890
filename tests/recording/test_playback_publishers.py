"""Playback of a stream with an active writer is refused, with or without a model."""

from __future__ import annotations

import math
import threading
from pathlib import Path

import pytest
from helpers.processes import until
from helpers.recording_builder import MS, START, RecordingBuilder, pose
from helpers.robots import RRBOT

from zstate.errors import SecondWriter
from zstate.net.presence import current_tokens
from zstate.net.session import connect
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.recording.player import Player
from zstate.transform import Transform

COUNT = 20
CAMERA = Transform("cart/base", "cart/camera", [1, 0, 0], [0, 0, 0, 1])


@pytest.fixture
def cart(tmp_path: Path) -> Path:
    """A cart without a model, on which two writers have put the same camera."""
    path = tmp_path / "cart.mcap"
    with RecordingBuilder(path, "cart") as builder:
        for writer in ("mount", "gripper"):
            builder.statics("cart", START, {("cart/base", "cart/camera"): pose(z=0.1)}, writer=writer)
        for n in range(COUNT):
            builder.edges("cart", START + n * 10 * MS, {("odom", "base"): pose(n)})
    return path


def replay(session, path: Path, **options: object) -> int:
    with Player(session, path, rate=math.inf, **options) as replayer:
        return replayer.run().samples


def test_samples_of_an_active_writer_are_played_only_with_takeover(sessions, cart: Path):
    with StatePublisher(sessions[0], RRBOT, "cart", streams=["tf"], program="driver"):
        until(lambda: current_tokens(sessions[1], "zstate/cart/@writer/tf/*", 1.0))
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], cart)
        assert (raised.value.stream, raised.value.first.program) == ("tf", "driver")
        assert replay(sessions[1], cart, takeover=True) == COUNT
    assert replay(sessions[1], cart) == COUNT


@pytest.mark.parametrize(("name", "edge"), [("mount", None), ("room", ("cart/base", "cart/camera"))])
def test_static_edges_of_an_active_writer_are_played_only_with_takeover(
    sessions, cart: Path, name: str, edge: tuple[str, str] | None
):
    with StaticPublisher(sessions[0], "cart", name, program="calibration") as live:
        live.set(CAMERA)
        with pytest.raises(SecondWriter) as raised:
            replay(sessions[1], cart)
        assert (raised.value.edge, raised.value.first.program) == (edge, "calibration")
        assert replay(sessions[1], cart, takeover=True) == COUNT


def test_playback_excludes_other_writers_of_its_streams(sessions, cart: Path):
    with Player(sessions[0], cart, rate=0.01) as replayer:
        thread = threading.Thread(target=replayer.run)
        thread.start()
        until(lambda: current_tokens(sessions[1], "zstate/cart/@writer/tf/*", 1.0))
        with pytest.raises(SecondWriter):
            StatePublisher(sessions[1], RRBOT, "cart", streams=["tf"])
        replayer.close()
        thread.join()


def test_passes_of_a_loop_do_not_conflict(sessions, cart: Path):
    with Player(sessions[0], cart, rate=math.inf, loop=True) as replayer:
        thread = threading.Thread(target=replayer.run)
        thread.start()
        until(lambda: replayer.report().passes >= 5)
        replayer.close()
        thread.join()
    assert not replayer.report().refused


def test_ownership_is_the_same_behind_a_router(cart: Path, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as ours,
        connect(mode="client", endpoints=endpoint) as theirs,
        StatePublisher(theirs, RRBOT, "cart", streams=["tf"]),
    ):
        until(lambda: current_tokens(ours, "zstate/cart/@writer/tf/*", 1.0))
        with pytest.raises(SecondWriter):
            replay(ours, cart)
