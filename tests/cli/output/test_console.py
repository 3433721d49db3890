"""Texts of sizes; and names and texts from the network cannot steer the terminal that prints them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from helpers.cli_runner import RRBOT, run_cli
from helpers.processes import repeated

from zstate import StatePublisher, connect, load_model
from zstate.cli.output.console import size_text
from zstate.cli.output.logs import without_controls
from zstate.net.latched import LatchedPublisher
from zstate.net.presence import announce
from zstate.net.streams import KeyPublisher
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import READER_TOKEN, STATUS, WRITER_TOKEN, stream_key
from zstate.wire.messages import StaticTransforms, Status, to_block
from zstate.wire.native import encode, encoding_of

FAKE = "\x1b]0;owned\x07\x1b[2J\x9b31m\nok       robots        all is well\u202e"

EVIL = WriterId(f"driver{FAKE}", f"host{FAKE}", 1, 5, 77)


@pytest.fixture
def stranger() -> Iterator[None]:
    """Every name that a program can choose, with escapes and line ends, next to a healthy robot."""
    pose = to_block([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    status = Status(time.time_ns(), 77, "error", EVIL.program, EVIL.host, 1, 1.0, 1, 0, FAKE)
    with ExitStack() as opened:
        session = opened.enter_context(connect())
        publisher = opened.enter_context(StatePublisher(session, load_model(RRBOT), robot="rrbot"))
        publisher.publish([0.0, 0.0])
        statics = Announcement("rrbot", "tf_static", EVIL, f"mount{FAKE}")
        for token in (
            WRITER_TOKEN.key("rrbot", "joint_commands", EVIL.identity),
            WRITER_TOKEN.key("rrbot", "tf_static", statics.identity),
            READER_TOKEN.key("rrbot", "joint_states", EVIL.identity),
        ):
            opened.enter_context(announce(session, token))
        mount = LatchedPublisher(
            session, stream_key("rrbot", "tf_static", "mount"), encoding_of(StaticTransforms)
        )
        opened.enter_context(mount)
        for frame in ("gauge", f"cam{FAKE}"):
            mount.set(encode(StaticTransforms(77, (("tool", frame),), pose)))
        status_publisher = KeyPublisher(session, STATUS.key("rrbot", EVIL.identity), encoding_of(Status))
        opened.enter_context(status_publisher)
        opened.enter_context(repeated(lambda: status_publisher.put(encode(status))))
        yield


@pytest.mark.parametrize("command", [("ls",), ("tree",), ("graph",), ("doctor",), ("doctor", "rrbot")])
def test_a_command_prints_foreign_names_without_acting_on_them(stranger: None, command: tuple[str, ...]):
    ended = run_cli(*command)
    printed = ended.stdout + ended.stderr
    assert "rrbot" in printed
    assert [letter for letter in printed if letter != "\n" and not letter.isprintable()] == []
    assert not any(line.startswith("ok       robots        all is well") for line in printed.splitlines())


def test_escapes_are_shown_as_text_and_own_colours_are_kept():
    assert without_controls("plain \t text\n") == "plain \t text\n"
    assert without_controls("\x1b[31mred\x1b[0m") == r"\x1b[31mred\x1b[0m"
    assert without_controls("\x1b[31mred\x1b[0m\x1b[2J", colors=True) == "\x1b[31mred\x1b[0m" + r"\x1b[2J"
    assert without_controls("\x9b2J\x7f\u202e") == r"\x9b2J\x7f\u202e"


@pytest.mark.parametrize(
    ("size", "text"),
    [
        (0, "0 B"),
        (999, "999 B"),
        (999.7, "1 kB"),
        (1_234, "1.23 kB"),
        (999_400, "999 kB"),
        (999_600, "1 MB"),
        (1_500_000_000, "1.50 GB"),
    ],
)
def test_a_size_has_three_digits_and_the_unit_that_it_is_rounded_to(size: float, text: str):
    assert size_text(size) == text
