import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.wire.messages import to_block
from zstate.wire.ros2.cdr import CdrReader, CdrWriter

LITTLE, BIG = b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)
BLOCKS = st.lists(st.floats(), max_size=4).map(to_block)


def reader(payload: bytes) -> CdrReader:
    return CdrReader(payload, "test/msg/Thing")


def test_string_length_includes_its_nul_and_the_next_count_is_aligned_to_four():
    writer = CdrWriter()
    writer.text("ab")
    writer.count(9)
    assert writer.payload() == LITTLE + struct.pack("<I3sxI", 3, b"ab\0", 9)


def test_doubles_are_aligned_to_eight_from_the_fifth_byte():
    writer = CdrWriter()
    writer.sequence(to_block([0.5]))
    assert writer.payload() == LITTLE + struct.pack("<I4xd", 1, 0.5)


def test_an_empty_sequence_leaves_no_gap():
    writer = CdrWriter()
    writer.sequence(b"")
    writer.count(9)
    assert writer.payload() == LITTLE + struct.pack("<2I", 0, 9)


VALUES = st.one_of(
    st.tuples(st.just("text"), TEXTS),
    st.tuples(st.just("count"), st.integers(0, 2**32 - 1)),
    st.tuples(st.just("stamp"), st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)),
    st.tuples(st.just("sequence"), BLOCKS),
)


@given(st.lists(VALUES, max_size=8), st.binary(max_size=9))
def test_written_values_are_read_back_and_trailing_bytes_ignored(
    values: list[tuple[str, object]], trailing: bytes
):
    writer = CdrWriter()
    for kind, value in values:
        getattr(writer, kind)(value)
    payload = writer.payload()
    again = reader(payload + trailing)
    assert [getattr(again, kind)() for kind, _ in values] == [value for _, value in values]
    assert again.position == len(payload)


@given(st.lists(VALUES, max_size=8), st.data())
def test_a_message_cut_off_anywhere_is_truncated(values: list[tuple[str, object]], data: st.DataObject):
    writer = CdrWriter()
    for kind, value in values:
        getattr(writer, kind)(value)
    whole = writer.payload()
    cut = whole[: data.draw(st.integers(0, len(whole) - 1))]
    with pytest.raises(MessageError, match=f"Thing cut off after {len(cut)} bytes") as caught:
        read_all(cut, [kind for kind, _ in values])
    assert caught.value.reason == "truncated"


def read_all(payload: bytes, kinds: list[str]) -> None:
    again = reader(payload)
    for kind in kinds:
        getattr(again, kind)()


def test_big_endian_values_are_byte_swapped():
    # the count ends at 8 + 8 + 4 bytes, so four are skipped before the doubles
    body = struct.pack(">iII3sxI4x2d", -1, 5, 3, b"ab\0", 2, 0.5, -2.0)
    again = reader(BIG + body)
    assert again.stamp() == -(10**9) + 5
    assert again.text() == "ab"
    assert again.sequence() == to_block([0.5, -2.0])


@pytest.mark.parametrize("header", [b"", b"\x00", b"\x00\x01\x00"])
def test_less_than_a_header_is_truncated(header: bytes):
    with pytest.raises(MessageError) as caught:
        reader(header)
    assert caught.value.reason == "truncated"


@pytest.mark.parametrize("header", ["00 02", "00 03", "00 06", "01 00", "7b 22"])
def test_an_encapsulation_other_than_plain_cdr_is_malformed_and_shown(header: str):
    with pytest.raises(MessageError, match=header) as caught:
        reader(bytes.fromhex(header) + bytes(20))
    assert caught.value.reason == "malformed"


@pytest.mark.parametrize("options", [b"\x00\x03", b"\xff\xff"])
def test_the_options_of_the_header_do_not_matter(options: bytes):
    assert reader(LITTLE[:2] + options + struct.pack("<I", 7)).count() == 7


@pytest.mark.parametrize(
    "data",
    [b"", b"ab", b"a\0b\0", b"ab\0\0", b"\xff\xfe\0", b"\xed\xa0\x80\0"],
    ids=["no NUL", "no NUL behind text", "NUL in the midst", "two NULs", "not UTF-8", "a lone surrogate"],
)
def test_invalid_string_is_malformed(data: bytes):
    with pytest.raises(MessageError, match="string") as caught:
        reader(LITTLE + struct.pack("<I", len(data)) + data).text()
    assert caught.value.reason == "malformed"


@pytest.mark.parametrize("take", [CdrReader.text, CdrReader.sequence])
@pytest.mark.parametrize("count", [2, 2**31, 2**32 - 1])
def test_count_beyond_the_end_is_truncated_before_allocation(take, count: int):
    with pytest.raises(MessageError, match="more are expected") as caught:
        take(reader(LITTLE + struct.pack("<I", count)))
    assert caught.value.reason == "truncated"


@pytest.mark.parametrize("text", ["a\0b", "\0", "\ud800"])
def test_text_that_cdr_cannot_carry_is_refused(text: str):
    with pytest.raises(InvalidInput):
        CdrWriter().text(text)
