"""Texts of msgspec's errors that the reasons of ours depend on: it has one exception for several faults.

A release of msgspec that changes one fails here, and not as a wrong reason in a listener's counts.
"""

from __future__ import annotations

import msgspec
import pytest


class Numbers(msgspec.Struct, array_like=True):
    stamp: int
    block: bytes


WHOLE = msgspec.msgpack.encode(Numbers(7, bytes(16)))
DECODER = msgspec.msgpack.Decoder(Numbers)


@pytest.mark.parametrize("size", range(len(WHOLE)))
def test_message_that_is_cut_off_is_truncated_and_of_the_base_exception(size: int) -> None:
    with pytest.raises(msgspec.DecodeError) as caught:
        DECODER.decode(WHOLE[:size])
    assert type(caught.value) is msgspec.DecodeError
    assert "truncated" in str(caught.value)


@pytest.mark.parametrize(
    "payload",
    [WHOLE + b"\0", b"\xc1", msgspec.msgpack.encode(["truncated", b""]), msgspec.msgpack.encode([7, "text"])],
    ids=["longer", "no type", "another type", "a text for bytes"],
)
def test_other_faults_are_not_truncated(payload: bytes) -> None:
    with pytest.raises(msgspec.DecodeError) as caught:
        DECODER.decode(payload)
    assert type(caught.value) is not msgspec.DecodeError or "truncated" not in str(caught.value)
