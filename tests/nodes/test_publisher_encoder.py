"""RobotEncoder: the payload of the extension is that of the reference, byte for byte."""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np
import pytest
from helpers.model_samples import every_joint, random_positions
from helpers.robots import RRBOT
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput
from zstate.extension import kernel
from zstate.model.load import load_model
from zstate.model.robot import RobotModel
from zstate.nodes.publisher import RobotEncoder
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import decode_joint_state, encode

SESSIONS = st.one_of(st.integers(0, 2**32 - 1), st.sampled_from((2**32, 2**64 - 1)))
STAMPS = st.one_of(
    st.integers(-(2**63), 2**63 - 1),
    st.integers(-(2**17), 2**17),
    st.sampled_from(
        [sign * 2**bits + one for bits in (5, 7, 8, 15, 16, 31, 32) for sign in (1, -1) for one in (-1, 0)]
    ),
)
SEQS = st.one_of(st.integers(0, 2**63 - 1), st.integers(0, 2**17), st.integers(2**32 - 2, 2**32 + 1))
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
EVERY_JOINT = every_joint().model

pytestmark = pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")


def both(model: RobotModel, *arguments: Any, session: int = 7) -> tuple[bytes, bytes]:
    """The payload by the extension alone, and by the reference alone."""
    encoder, reference = RobotEncoder(model, "r1", session), RobotEncoder(model, "r1", session)
    reference.compiled = None
    assert encoder.compiled is not None
    return encoder.compiled.encode(*arguments), reference.encode(*arguments)


@given(
    st.tuples(NUMBERS, NUMBERS),
    st.none() | st.tuples(NUMBERS, NUMBERS),
    st.none() | st.tuples(NUMBERS, NUMBERS),
    st.tuples(STAMPS, SEQS, SESSIONS),
)
def test_the_extension_and_the_reference_encode_the_same_bytes(positions, velocities, efforts, head):
    stamp, seq, session = head
    blocks = [None if one is None else np.array(one) for one in (positions, velocities, efforts)]
    compiled, reference = both(RRBOT, *blocks, stamp, seq, session=session)
    digest = order_digest(RRBOT.joint_names)
    sent = [None if one is None else to_block(one) for one in blocks]
    assert compiled == reference == encode(JointState(stamp, seq, session, digest, sent[0] or b"", *sent[1:]))


@pytest.mark.parametrize("count", [0, 1, 31, 32, 40])
def test_short_and_long_blocks_have_the_same_bytes(count: int):
    joints = "".join(
        f'<link name="l{n + 1}"/><joint name="j{n}" type="continuous"><parent link="l0"/>'
        f'<child link="l{n + 1}"/></joint>'
        for n in range(count)
    )
    model = load_model(f'<robot name="many"><link name="l0"/>{joints}</robot>')
    numbers = np.linspace(-1.0, 1.0, model.position_count)
    compiled, reference = both(model, numbers, numbers, numbers, 1, 2)
    assert compiled == reference


@pytest.mark.parametrize("seed", range(5))
def test_every_joint_type_has_the_same_bytes(seed: int):
    positions = random_positions(EVERY_JOINT, seed)
    rates = np.arange(float(EVERY_JOINT.velocity_count))
    compiled, reference = both(EVERY_JOINT, positions, rates, None, 5, 6)
    assert compiled == reference
    assert np.frombuffer(decode_joint_state(compiled).positions).tolist() == positions.tolist()


def column(row: np.ndarray) -> np.ndarray:
    """The numbers as a column of a matrix."""
    return np.column_stack((row, row + 1.0))[:, 0]


def unaligned(row: np.ndarray) -> np.ndarray:
    """The numbers as a field of packed records."""
    records = np.zeros(len(row), dtype=[("flag", "u1"), ("number", "f8")])
    records["number"] = row
    return records["number"]


FORMS = [np.array, memoryview, lambda row: array("d", row), list, tuple, column, np.ndarray.tolist]


@pytest.mark.parametrize("form", FORMS)
def test_usual_forms_of_numbers_are_encoded_by_the_extension(form):
    row = np.array([0.25, -0.5])
    assert form(row) is not row
    compiled, reference = both(RRBOT, form(row), form(row), None, 1, 2)
    assert compiled == reference


@given(st.lists(st.one_of(NUMBERS, st.integers(-(2**70), 2**70)), min_size=2, max_size=2))
def test_lists_of_integers_and_floats_have_the_bytes_of_the_reference(numbers: list[float]):
    encoder = RobotEncoder(RRBOT, "r1", 7).compiled
    assert encoder is not None
    payload = encoder.encode(numbers, None, None, 1, 2)
    assert payload is not None
    positions = np.frombuffer(decode_joint_state(payload).positions)
    assert positions.tolist() == [float(number) for number in numbers]


@pytest.mark.parametrize(
    "arguments",
    [
        ([True, 1.0], None, None, 1, 2),
        (np.array([0, 1]), None, None, 1, 2),
        (np.float32([0, 1]), None, None, 1, 2),
        ({"shoulder": 0.0, "elbow": 1.0}, None, None, 1, 2),
        (np.zeros(2), range(2), None, 1, 2),
        (np.zeros(2), None, np.zeros(2).astype(">f8"), 1, 2),
        (unaligned(np.zeros(2)), None, None, 1, 2),
    ],
)
def test_other_forms_are_left_to_the_reference(arguments: tuple[Any, ...]):
    compiled, reference = both(RRBOT, *arguments)
    assert compiled is None
    assert RobotEncoder(RRBOT, "r1", 7).encode(*arguments) == reference


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ((np.array([0.0, np.nan]), None, None), r"'elbow' \(nan\)"),
        ((np.array([-np.inf, 0.0]), None, None), r"'shoulder' \(-inf\)"),
        ((np.zeros(3), None, None), "takes 2 positions"),
        (([0.0, 1.0, 2.0], None, None), "takes 2 positions"),
        (([0.0, math.nan], None, None), r"'elbow' \(nan\)"),
        (([0.0, "1.0"], None, None), "real numbers, not text"),
        (([0.0, 1j], None, None), "real numbers, not complex"),
        ((np.zeros((1, 2)), None, None), "takes 2 positions"),
        ((np.ma.masked_equal(np.array([0.0, 1.0]), 1.0), None, None), "plain array"),
        ((np.zeros(2), np.zeros(1), None), "takes 2 velocities"),
        ((np.zeros(2), None, np.full(2, np.nan)), "efforts .* must be finite"),
    ],
)
def test_refused_arrays_raise_the_error_of_the_reference(arguments: tuple[Any, ...], text: str):
    encoder, reference = RobotEncoder(RRBOT, "r1", 7), RobotEncoder(RRBOT, "r1", 7)
    reference.compiled = None
    for one in (encoder, reference):
        with pytest.raises(InvalidInput, match=text):
            one.encode(*arguments, 1, 2)


@pytest.mark.parametrize("excess", [0.4, 0.9, 1.1, 3.0])
def test_quaternions_near_and_far_from_unit_length_are_decided_by_the_reference(excess: float):
    positions = random_positions(EVERY_JOINT, 3)
    start = EVERY_JOINT.columns["zz body"] + 3
    positions[start : start + 4] *= 1.0 + excess * 1e-3
    encoder = RobotEncoder(EVERY_JOINT, "r1", 7)
    if excess > 1.0:
        with pytest.raises(InvalidInput, match=r"'zz body' .*quaternion of length"):
            encoder.encode(positions, None, None, 1, 2)
    else:
        state = decode_joint_state(encoder.encode(positions, None, None, 1, 2))
        assert state.positions == to_block(positions)
