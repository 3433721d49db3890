import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import MessageError
from zstate.wire.ros2.graph import Attachment, pack_attachment, session_from_gid, unpack_attachment

GID = bytes(range(16))
INT64 = st.integers(-(2**63), 2**63 - 1)
SEQ = st.integers(0, 2**63 - 1)


def test_an_attachment_is_33_bytes_sequence_time_length_and_gid():
    packed = pack_attachment(1, 1_700_000_000_123_456_789, GID)
    number, stamp = ((value).to_bytes(8, "little") for value in (1, 1_700_000_000_123_456_789))
    assert packed == number + stamp + b"\x10" + GID
    assert len(packed) == 33


@given(seq=SEQ, source_time=INT64, gid=st.binary(min_size=16, max_size=16))
def test_attachment_is_unpacked_as_packed(seq: int, source_time: int, gid: bytes):
    assert unpack_attachment(pack_attachment(seq, source_time, gid)) == Attachment(seq, source_time, gid)


def test_missing_attachment_has_its_own_reason():
    with pytest.raises(MessageError, match="another program writes on this key") as caught:
        unpack_attachment(None)
    assert caught.value.reason == "no attachment"


def test_the_labels_of_an_old_rmw_zenoh_are_recognised():
    def text(value: str) -> bytes:
        return bytes([len(value)]) + value.encode()

    old = text("sequence_number") + struct.pack("<q", 1) + text("source_timestamp") + struct.pack("<q", 2)
    with pytest.raises(MessageError, match=r"before mid 2025: upgrade it to humble 0\.1\.2") as caught:
        unpack_attachment(old + text("source_gid") + b"\x10" + GID)
    assert caught.value.reason == "foreign"


@pytest.mark.parametrize(
    "wrong",
    [
        b"",
        b"\0" * 32,
        b"\0" * 34,
        b"\0" * 33,
        pack_attachment(1, 2, GID) + b"\0",
        pack_attachment(-1, 2, GID),
    ],
)
def test_bytes_of_another_shape_are_foreign(wrong: bytes):
    with pytest.raises(MessageError, match=f"an attachment of {len(wrong)} bytes") as caught:
        unpack_attachment(wrong)
    assert caught.value.reason == "foreign"


@given(data=st.binary(max_size=80))
def test_any_bytes_parse_or_raise_message_error(data: bytes):
    try:
        assert pack_attachment(*unpack_attachment(data)) == data
    except MessageError as error:
        assert error.reason == "foreign"


def test_the_session_is_the_first_half_of_the_gid():
    assert session_from_gid(GID) == sum(byte << (8 * place) for place, byte in enumerate(range(8)))
    assert session_from_gid(GID) == session_from_gid(GID[:8] + bytes(8))
