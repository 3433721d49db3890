"""Hostile bytes for the decoders of ROS 2 messages.

    python tests/helpers/cdr_fuzz.py [SECONDS]

The inputs are messages that are complete, truncated, changed in a few bytes or counts or spliced from two,
and noise. Each goes to every decoder twice: to a new one, which decodes value by value, and to one that has
decoded all earlier inputs. Stops with an AssertionError that has the bytes if a decoder raises anything but
MessageError, or if the two results differ.
"""

from __future__ import annotations

import random
import struct
import sys
import time
from collections import Counter
from collections.abc import Callable
from itertools import pairwise

from helpers import manual_cdr

from zstate.errors import MessageError
from zstate.wire.ros2.cdr import decode_clock, decode_string
from zstate.wire.ros2.decoder import JointStateDecoder, TfMessageDecoder

REASONS = {"truncated", "malformed", "no positions"}
COUNTS = (0, 1, 2, 3, 4, 5, 255, 256, 10**9, 2**31 - 1, 2**31, 2**32 - 8, 2**32 - 1)
NEW: dict[str, Callable[[], Callable[[bytes], object]]] = {
    "JointState": lambda: JointStateDecoder().decode,
    "TFMessage": lambda: TfMessageDecoder().decode,
    "String": lambda: decode_string,
    "Clock": lambda: decode_clock,
}


class Fuzz:
    """The inputs of one seed, made from a few messages, and the outcomes of decoding them."""

    def __init__(self, seed: int, old: dict[str, Callable[[bytes], object]]) -> None:
        self.random = random.Random(seed)
        self.old = old
        self.messages = [self.message() for _ in range(6)]

    def pick(self, *choices: Callable[[], bytes]) -> bytes:
        return self.random.choice(choices)()

    def message(self) -> bytes:
        """A valid ROS 2 message, with any bytes in its padding and after its end."""
        values = self.random.choice([self.joint_state, self.joint_state, self.tf_message, self.plain])()
        fill = self.random.choice([self.random.randbytes, manual_cdr.zeros])
        order = self.random.choice("<<<>")
        return manual_cdr.cdr(values, order, fill) + self.random.choice([b"", b"", self.random.randbytes(5)])

    def names(self, count: int) -> list[str]:
        return [f"{'abcdefgh'[: self.random.randrange(1, 9)]}{number}" for number in range(count)]

    def stamp(self) -> int:
        return self.random.randrange(-(2**31) * 10**9, 2**31 * 10**9)

    def joint_state(self):
        names = self.names(self.random.randrange(6))
        rows = [[self.random.random() for _ in names] for _ in range(3)]
        rows = [
            row if self.random.random() < chance else []
            for chance, row in zip((0.9, 0.5, 0.5), rows, strict=True)
        ]
        return manual_cdr.joint_state(self.stamp(), "base"[: self.random.randrange(5)], names, *rows)

    def tf_message(self):
        edges = list(pairwise(self.names(1 + self.random.randrange(4))))
        stamps = [self.stamp()] * len(edges)
        if edges and self.random.random() < 0.3:
            stamps[-1] = self.stamp()
        return manual_cdr.tf_message(stamps, edges, [[self.random.random() for _ in range(7)] for _ in edges])

    def plain(self):
        text = "".join(self.names(self.random.randrange(3)))
        return self.random.choice([iter([("s", text)]), manual_cdr.time(self.stamp())])

    def known(self) -> bytes:
        return self.random.choice(self.messages)

    def place(self, data: bytes) -> int:
        return self.random.randrange(len(data) + 1)

    def cut(self) -> bytes:
        data = self.known()
        return data[: self.place(data)]

    def longer(self) -> bytes:
        return self.known() + self.random.randbytes(self.random.randrange(20))

    def flipped(self) -> bytes:
        data = bytearray(self.known())
        for _ in range(self.random.randrange(1, 5)):
            data[self.random.randrange(len(data))] = self.random.choice((0, 255, self.random.randrange(256)))
        return bytes(data)

    def counted(self) -> bytes:
        """Another number in one of the words, which may be a count or a length."""
        data = bytearray(self.known())
        at = 4 * self.random.randrange(len(data) // 4)
        struct.pack_into(self.random.choice("<>") + "I", data, at, self.random.choice(COUNTS))
        return bytes(data)

    def renumbered(self) -> bytes:
        """Another word, mostly in a time or a number: the message stays valid, with a known layout."""
        data = bytearray(self.known())
        at = 4 * self.random.randrange(1, len(data) // 4)
        data[at : at + 4] = self.random.randbytes(4)
        return bytes(data)

    def spliced(self) -> bytes:
        one, other = self.known(), self.known()
        return one[: self.place(one)] + other[self.place(other) :]

    def noise(self) -> bytes:
        head = self.random.choice((b"", b"\x00\x01\x00\x00", b"\x00\x00\x00\x00", b"\x00\x02\x00\x00"))
        return head + self.random.randbytes(self.random.randrange(80))

    def run(self, inputs: int) -> Counter[str]:
        outcomes: Counter[str] = Counter()
        for _ in range(inputs):
            changed = (self.cut, self.flipped, self.flipped, self.counted, self.renumbered, self.spliced)
            data = self.pick(self.known, self.longer, self.noise, *changed)
            for kind, old in self.old.items():
                outcomes[f"{kind} {self.outcome(kind, old, data)}"] += 1
        return outcomes

    def outcome(self, kind: str, old: Callable[[bytes], object], data: bytes) -> str:
        """The outcome of decoding: "read", or the reason of the error."""
        try:
            new, known = decode_outcome(NEW[kind](), data), decode_outcome(old, data)
        except Exception as error:
            raise AssertionError(f"{type(error).__name__} from {kind} on {data.hex()}") from error
        assert new == known, f"{kind}: a new decoder returns {new}, a used one {known}: {data.hex()}"
        return new[0]


def decode_outcome(decode: Callable[[bytes], object], data: bytes) -> tuple[str, object]:
    try:
        return "read", decode(data)
    except MessageError as error:
        assert error.reason in REASONS, f"reason {error.reason!r}"
        return error.reason, str(error)


def long_lived() -> dict[str, Callable[[bytes], object]]:
    """Decoders for a whole run."""
    return {kind: make() for kind, make in NEW.items()}


def main() -> int:
    """Fuzzes for the given number of seconds."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    outcomes: Counter[str] = Counter()
    old, start, inputs, seed = long_lived(), time.monotonic(), 0, 0
    while time.monotonic() < start + seconds:
        outcomes += Fuzz(seed, old).run(500)
        inputs, seed = inputs + 500, seed + 1
    print(f"{inputs} inputs from {seed} seeds in {time.monotonic() - start:.0f} s, each to every decoder")
    for outcome, count in sorted(outcomes.items()):
        print(f"{outcome:<26}{count:>10}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
