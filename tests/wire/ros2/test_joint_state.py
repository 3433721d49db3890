import itertools
import random
import struct
import tracemalloc

import pytest
from helpers.manual_cdr import STORE, cdr, joint_state, rosbags_joint_state
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput, MessageError
from zstate.wire.messages import to_block
from zstate.wire.ros2.decoder import JointStateDecoder, RosJointState
from zstate.wire.ros2.encoder import JointStateEncoder

STAMP = 1_700_000_000_123_456_789
STAMPS = st.integers(-(2**31) * 10**9, 2**31 * 10**9 - 1)
TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=12)
PRESENT = list(itertools.product((False, True), repeat=2))


def names_of(count: int, longer: int = 0) -> tuple[str, ...]:
    """Names whose lengths go through all remainders of 8."""
    return tuple(f"j{number}".ljust(3 + (number + longer) % 8, "x") for number in range(count))


def numbers(count: int, start: float) -> list[float]:
    return [start + 0.25 * number for number in range(count)]


def blocks(*sequences: list[float]) -> list[bytes | None]:
    return [to_block(sequence) if sequence else None for sequence in sequences]


def sequences(count: int, has_velocities: bool, has_efforts: bool) -> list[list[float]]:
    present = (True, has_velocities, has_efforts)
    return [numbers(count, 100.0 * row) if one else [] for row, one in enumerate(present)]


def reason(payload: bytes) -> str:
    with pytest.raises(MessageError) as caught:
        JointStateDecoder().decode(payload)
    return caught.value.reason


# Two joints, velocities but no efforts, by the specification; the offsets count from the fifth byte.
GOLDEN = b"\x00\x01\x00\x00" + struct.pack(
    "<iI I2s2x I I2s2x I3sx I 2d I4x 2d I",
    *(1_700_000_000, 123_456_789),
    *(2, b"w\0"),  # ends at 16 with its gap
    2,
    *(2, b"a\0"),  # at 28
    *(3, b"bb\0"),  # at 36
    2,  # the positions' count ends at 40, a multiple of 8
    *(0.5, -1.0),
    2,  # at 60: four to skip
    *(2.0, 3.0),
    0,
)


def test_a_small_message_has_the_bytes_of_the_specification():
    velocities = to_block([2.0, 3.0])
    encoder = JointStateEncoder(["a", "bb"], "w")
    assert encoder.encode(STAMP, to_block([0.5, -1.0]), velocities) == GOLDEN
    assert JointStateDecoder().decode(GOLDEN) == RosJointState(
        STAMP, "w", ("a", "bb"), to_block([0.5, -1.0]), velocities, None
    )


@pytest.mark.parametrize(("has_velocities", "has_efforts"), PRESENT)
@pytest.mark.parametrize("count", [0, 1, 2, 7, 30])
def test_the_bytes_are_those_of_rosbags(count: int, has_velocities: bool, has_efforts: bool):
    for longer in range(8):
        names = names_of(count, longer)
        frame_id = "base_link"[: longer + 1]
        rows = sequences(count, has_velocities, has_efforts)
        theirs = rosbags_joint_state(STAMP, frame_id, names, *rows)
        given = [to_block(rows[0]), *blocks(*rows[1:])]
        assert JointStateEncoder(names, frame_id).encode(STAMP, *given) == theirs  # type: ignore[arg-type]
        decoder = JointStateDecoder()
        for _ in range(2):  # value by value, then at once
            assert decoder.decode(theirs) == RosJointState(STAMP, frame_id, names, *given)  # type: ignore[arg-type]


@given(
    STAMPS,
    TEXTS,
    st.lists(TEXTS, unique=True, max_size=6),
    st.sampled_from(PRESENT),
    st.randoms(use_true_random=False),
)
def test_joint_state_round_trips_and_equals_the_reading_of_rosbags(
    stamp: int, frame_id: str, names: list[str], present: tuple[bool, bool], dice: random.Random
):
    rows = [[dice.uniform(-1e3, 1e3) for _ in names] for _ in range(3)]
    rows[1:] = [row if one else [] for row, one in zip(rows[1:], present, strict=True)]
    positions, velocities, efforts = to_block(rows[0]), *blocks(*rows[1:])
    payload = JointStateEncoder(names, frame_id).encode(stamp, positions, velocities, efforts)
    assert JointStateDecoder().decode(payload) == (
        stamp,
        frame_id,
        tuple(names),
        positions,
        velocities,
        efforts,
    )
    theirs = STORE.deserialize_cdr(payload, "sensor_msgs/msg/JointState")
    assert (theirs.header.stamp.sec, theirs.header.stamp.nanosec) == divmod(stamp, 10**9)
    assert (theirs.header.frame_id, theirs.name) == (frame_id, names)
    assert [list(row) for row in (theirs.position, theirs.velocity, theirs.effort)] == rows


@pytest.mark.parametrize(("has_velocities", "has_efforts"), PRESENT)
def test_big_endian_messages_are_read_alike(has_velocities: bool, has_efforts: bool):
    rows = sequences(7, has_velocities, has_efforts)
    theirs = rosbags_joint_state(-1, "base", names_of(7), *rows, little_endian=False)
    assert theirs == cdr(joint_state(-1, "base", names_of(7), *rows), ">")
    decoder = JointStateDecoder()
    for _ in range(2):
        assert decoder.decode(theirs) == (-1, "base", names_of(7), *blocks(*rows))


def test_padding_and_trailing_bytes_change_neither_result_nor_template():
    dice = random.Random(1)
    decoder = JointStateDecoder()
    names = names_of(9)
    for has_velocities, has_efforts in PRESENT:
        rows = sequences(9, has_velocities, has_efforts)
        first = None
        for stamp in range(20):
            values = joint_state(stamp, "base", names, *rows)
            state = decoder.decode(cdr(values, fill=dice.randbytes) + dice.randbytes(3))
            assert state == (stamp, "base", names, *blocks(*rows))
            first = first or state
            assert state.names is first.names


def test_a_message_seen_before_is_read_with_new_numbers_and_the_same_names():
    encoder, decoder = JointStateEncoder(names_of(30)), JointStateDecoder()
    first = decoder.decode(encoder.encode(1, *[to_block(numbers(30, 0.0))] * 3))
    row = [to_block(numbers(30, start)) for start in (1.0, 2.0, 3.0)]
    second = decoder.decode(encoder.encode(2, *row))
    assert second == (2, "", names_of(30), *row)
    assert second.names is first.names


def test_numbers_that_are_not_finite_pass_bit_by_bit():
    row = struct.pack("<4Q", 0x7FF0_0000_0000_0001, 0xFFF8_0000_0000_0002, 0x7FF0 << 48, 0x8000 << 48)
    payload = JointStateEncoder(names_of(4)).encode(0, row)
    assert [JointStateDecoder().decode(payload).positions for _ in range(2)] == [row, row]


def test_templates_of_many_alternating_writers_are_cached():
    decoder = JointStateDecoder()
    prefixes = [f"robot{number}/" for number in range(60)]
    encoders = [JointStateEncoder([prefix + name for name in names_of(7)]) for prefix in prefixes]
    rounds = [
        [decoder.decode(encoder.encode(stamp, bytes(56))).names for encoder in encoders] for stamp in range(3)
    ]
    assert all(now is before for one in rounds[1:] for now, before in zip(one, rounds[0], strict=True))


def test_payloads_of_equal_length_with_other_name_lengths_differ():
    decoder = JointStateDecoder()
    for _ in range(3):
        for lengths in itertools.permutations((1, 5, 9, 13)):
            names = tuple("abcd"[place] * length for place, length in enumerate(lengths))
            payload = JointStateEncoder(names).encode(5, to_block([1, 2, 3, 4]))
            assert decoder.decode(payload) == (5, "", names, to_block([1, 2, 3, 4]), None, None)


@pytest.mark.long
def test_changing_names_do_not_fill_the_memory():
    decoder = JointStateDecoder()
    of_each_length = [
        cdr(joint_state(0, "", [f"joint0000_{'x' * length}", "other"], [1.0, 2.0], [], []))
        for length in range(7)
    ]
    tracemalloc.start()
    try:
        for number in range(5000):
            named = of_each_length[number % 7].replace(b"joint0000", f"joint{number:04}".encode())
            assert decoder.decode(named).names[0].startswith(f"joint{number:04}_")
        held, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < 8 * 2**20


def test_state_without_joints_is_empty():
    payload = JointStateEncoder([]).encode(3, b"", b"", b"")
    assert JointStateDecoder().decode(payload) == (3, "", (), b"", None, None)


@pytest.mark.parametrize(
    "counts", [(3, 2, 0, 0), (2, 3, 0, 0), (2, 2, 1, 0), (2, 2, 2, 3), (0, 1, 0, 0), (0, 0, 1, 0)]
)
def test_different_counts_are_malformed_and_in_the_error(counts: tuple[int, int, int, int]):
    names, *rest = counts
    payload = cdr(joint_state(0, "", names_of(names), *[numbers(count, 0.0) for count in rest]))
    expected = "{} names, {} positions, {} velocities, {} efforts".format(*counts)
    with pytest.raises(MessageError, match=expected) as caught:
        JointStateDecoder().decode(payload)
    assert caught.value.reason == "malformed"


def test_joints_without_positions_have_a_reason_of_their_own():
    payload = cdr(joint_state(0, "", ["left", "right"], [], [1.0, 2.0], []))
    assert reason(payload) == "no positions"
    with pytest.raises(MessageError, match="without positions of 'left', 'right': velocities alone place"):
        JointStateDecoder().decode(payload)


def test_duplicate_joint_is_malformed_and_named():
    with pytest.raises(MessageError, match="'a' comes 2 times among 3 names") as caught:
        JointStateDecoder().decode(cdr(joint_state(0, "", ["a", "b", "a"], numbers(3, 0.0), [], [])))
    assert caught.value.reason == "malformed"
    assert reason(cdr(joint_state(0, "", ["", ""], numbers(2, 0.0), [], []))) == "malformed"


@pytest.mark.parametrize("change", ["count", "nanoseconds", "name"])
def test_message_of_a_cached_template_is_still_checked(change: str):
    decoder = JointStateDecoder()
    decoder.decode(GOLDEN)
    broken = bytearray(GOLDEN)
    at, value = {"count": (4 + 56, 1), "nanoseconds": (8, 10**9), "name": (4 + 24, 0xFF00FF)}[change]
    struct.pack_into("<I", broken, at, value)
    for one in (decoder, JointStateDecoder()):
        with pytest.raises(MessageError) as caught:
            one.decode(bytes(broken))
        assert caught.value.reason == "malformed"


@pytest.mark.parametrize("fresh", [True, False])
def test_a_message_cut_off_anywhere_is_truncated(fresh: bool):
    decoder = JointStateDecoder()
    decoder.decode(GOLDEN)
    for length in range(len(GOLDEN)):
        with pytest.raises(MessageError) as caught:
            (JointStateDecoder() if fresh else decoder).decode(GOLDEN[:length])
        assert caught.value.reason == "truncated"


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("size", [0, 8, 15, 24])
def test_block_without_one_number_per_name_is_refused(place: int, size: int):
    given = [bytes(16)] * 3
    given[place] = bytes(size)
    with pytest.raises(InvalidInput, match=f"2 names need blocks of 16 bytes.*{size} bytes"):
        JointStateEncoder(["a", "b"]).encode(0, *given)


def test_names_and_stamps_that_ros_2_cannot_represent_are_refused():
    with pytest.raises(InvalidInput, match="'a' comes 2 times"):
        JointStateEncoder(["a", "b", "a"])
    with pytest.raises(InvalidInput, match="NUL"):
        JointStateEncoder(["a\0"])
    with pytest.raises(InvalidInput, match=f"{2**62}"):
        JointStateEncoder(["a"]).encode(2**62, bytes(8))


@pytest.mark.parametrize(("has_velocities", "has_efforts"), PRESENT)
@pytest.mark.parametrize("count", [0, 1, 7, 30])
def test_many_messages_of_the_same_joints_are_read_together(
    count: int, has_velocities: bool, has_efforts: bool
):
    dice, names = random.Random(2), names_of(count)
    payloads: list[bytes] = []
    stamps = [-(2**31) * 10**9, -1, 0, STAMP, 2**31 * 10**9 - 1]
    for row, stamp in enumerate(stamps):
        values = joint_state(stamp, "base", names, *sequences_of(row, count, has_velocities, has_efforts))
        payloads.append(cdr(values, fill=dice.randbytes) + dice.randbytes(3))
    states = JointStateDecoder().decode_many(payloads)
    assert states is not None
    assert (states.stamps.tolist(), states.names) == (stamps, names)
    one_by_one = [JointStateDecoder().decode(payload) for payload in payloads]
    assert [block.tobytes() for block in states.positions] == [state.positions for state in one_by_one]
    for block, has_block, name in (
        (states.velocities, has_velocities and count, "velocities"),
        (states.efforts, has_efforts and count, "efforts"),
    ):
        assert (block is not None) == bool(has_block)
        if block is not None:
            assert [row.tobytes() for row in block] == [getattr(state, name) for state in one_by_one]


def sequences_of(row: int, count: int, has_velocities: bool, has_efforts: bool) -> list[list[float]]:
    return [[row + number for number in block] for block in sequences(count, has_velocities, has_efforts)]


def test_messages_that_differ_in_more_than_numbers_are_not_read_together():
    first = cdr(joint_state(STAMP, "base", ("a", "b"), [1.0, 2.0]))
    swapped = cdr(joint_state(STAMP, "base", ("b", "a"), [1.0, 2.0]))
    wrong_time = first[:8] + struct.pack("<I", 10**9) + first[12:]
    assert len(first) == len(swapped) == len(wrong_time)
    assert JointStateDecoder().decode_many([first, swapped]) is None
    assert JointStateDecoder().decode_many([first, wrong_time]) is None
    assert JointStateDecoder().decode_many([first[:20], first[:20]]) is None
