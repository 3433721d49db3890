import pytest
from helpers.cdr_fuzz import NEW, Fuzz, decode_outcome, long_lived
from helpers.manual_cdr import cdr, joint_state, tf_message
from hypothesis import given
from hypothesis import strategies as st

POSE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
WHOLE = [
    cdr(joint_state(5, "base", ["a", "bcd", "ef"], [1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [])),
    cdr(joint_state(5, "base", ["a", "bcd", "ef"], [1.0, 2.0, 3.0], [], []), ">"),
    cdr(tf_message([5, 6], [("map", "a"), ("a", "bcd")], [POSE, POSE])),
    cdr(iter([("s", "some text")])),
    cdr(iter([("i", 5), ("I", 6)])),
]
OLD = long_lived()


def agree(data: bytes) -> None:
    for kind, old in OLD.items():
        assert decode_outcome(NEW[kind](), data) == decode_outcome(old, data)


def test_fuzzed_bytes_raise_only_message_errors_and_reach_every_outcome():
    old = long_lived()
    outcomes = sum((Fuzz(seed, old).run(150) for seed in range(20)), start=Fuzz(0, old).run(0))
    assert {"read", "truncated", "malformed", "no positions"} == {key.split(" ", 1)[1] for key in outcomes}
    assert {f"{kind} {outcome}" for kind in NEW for outcome in ("read", "truncated", "malformed")} <= {
        *outcomes
    }


@given(st.binary(max_size=200), st.sampled_from([b"", b"\x00\x01\x00\x00", b"\x00\x00\x00\x00"]))
def test_arbitrary_bytes_raise_only_message_error(data: bytes, head: bytes):
    agree(head + data)


@given(st.sampled_from(WHOLE), st.integers(0, 10_000), st.binary(min_size=1, max_size=8))
def test_changed_bytes_raise_only_message_error(whole: bytes, at: int, change: bytes):
    at %= len(whole)
    agree(whole[:at] + change + whole[at + len(change) :])


@given(st.sampled_from(WHOLE), st.integers(0, 10_000), st.binary(max_size=12))
def test_truncated_or_longer_bytes_raise_only_message_error(whole: bytes, end: int, more: bytes):
    agree(whole[: end % (len(whole) + 1)] + more)


@pytest.mark.parametrize("whole", WHOLE)
def test_whole_messages_are_read_by_their_own_decoder(whole: bytes):
    assert "read" in {decode_outcome(old, whole)[0] for old in OLD.values()}
