import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import MessageError
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, order_digest, to_block

OURS = ("shoulder", "elbow", "wrist")


def state(names: tuple[str, ...], *blocks: list[float] | None, with_names: bool = True) -> JointState:
    numbers = [None if block is None else to_block(block) for block in blocks]
    return JointState(0, 0, 0, order_digest(names), *numbers, names=names if with_names else None)


def lists(numbers) -> list[list[float] | None]:
    return [None if block is None else block.tolist() for block in numbers]


def test_numbers_in_the_readers_order_are_not_copied():
    message = state(OURS, [1, 2, 3], None, [4, 5, 6], with_names=False)
    numbers = JointOrder(OURS).read(message)
    assert lists(numbers) == [[1, 2, 3], None, [4, 5, 6]]
    assert np.shares_memory(numbers.positions, np.frombuffer(message.positions))


@given(st.permutations([*OURS, "finger", "lid"]))
def test_a_writer_without_a_model_may_have_any_order_and_joints_of_its_own(names: list[str]):
    tenfold = {name: float(number) for number, name in enumerate(names)}
    numbers = JointOrder(OURS).read(state(tuple(names), *[list(tenfold.values())] * 3))
    assert lists(numbers) == [[tenfold[name] for name in OURS]] * 3


def test_a_missing_joint_is_named():
    with pytest.raises(MessageError, match="without 'elbow', 'wrist'") as caught:
        JointOrder(OURS).read(state(("shoulder", "lid"), [1, 2]))
    assert caught.value.reason == "missing joints"


def test_another_order_without_names_cannot_be_read():
    with pytest.raises(MessageError, match="the same URDF") as caught:
        JointOrder(OURS).read(state(OURS[::-1], [1, 2, 3], with_names=False))
    assert caught.value.reason == "other joint order"


def test_writers_of_several_orders_are_read_in_turn():
    order = JointOrder(OURS)
    for names in (OURS[::-1], OURS, (*OURS[1:], OURS[0]), OURS[::-1]):
        values = [float(OURS.index(name)) for name in names]
        assert lists(order.read(state(names, values)))[0] == [0, 1, 2]


FLOATING = ("base", "hinge")
PARTS = (*(f"base.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw")), "hinge")
SLOTS = (0, 1, 2, 3, 4, 5, 7)


def test_a_joint_of_several_numbers_is_read_by_the_names_of_its_parts():
    order = JointOrder(FLOATING, PARTS, SLOTS)
    names = (*PARTS[::-1], "lid")
    rates = [float("nan") if name == "base.qw" else float(len(name)) for name in names]
    numbers = order.read(state(names, [10.0 * n for n in range(9)], rates, rates))
    expected = [10.0 * names.index(name) for name in PARTS]
    rates_of = [float(len(PARTS[slot])) for slot in SLOTS]
    assert lists(numbers) == [expected, rates_of, rates_of]


def test_its_own_order_without_names_has_as_many_velocities_as_the_robot_moves():
    state_of = JointState(0, 0, 0, order_digest(FLOATING), to_block(range(8)), to_block(range(7)))
    assert lists(JointOrder(FLOATING, PARTS, SLOTS).read(state_of)) == [[*range(8)], [*range(7)], None]


def test_a_joint_whose_parts_are_not_all_there_is_missing():
    with pytest.raises(MessageError, match=r"without 'base\.qw'$"):
        names = tuple(name for name in PARTS if name != "base.qw")
        JointOrder(FLOATING, PARTS, SLOTS).read(state(names, [0.0] * 7))


@pytest.mark.parametrize("names", [OURS, OURS[::-1], ("lid", *OURS)])
def test_velocities_and_efforts_with_nan_for_a_model_joint_are_none(names):
    nan = float("nan")
    unknown = [nan if name == "wrist" else 1.0 for name in names]
    numbers = JointOrder(OURS).read(state(names, [1.0] * len(names), unknown, [1.0] * len(names)))
    assert lists(numbers) == [[1.0] * 3, None, [1.0] * 3]
    numbers = JointOrder(OURS).read(state(names, [1.0] * len(names), [1.0] * len(names), unknown))
    assert lists(numbers) == [[1.0] * 3, [1.0] * 3, None]


def test_nan_of_other_joints_is_ignored():
    names = ("lid", *OURS)
    rates = [float("nan"), 1.0, 2.0, 3.0]
    assert lists(JointOrder(OURS).read(state(names, [0.0] * 4, rates)))[1] == [1.0, 2.0, 3.0]


def test_nan_in_positions_or_without_names_is_kept():
    nan = float("nan")
    named = JointOrder(OURS).read(state(OURS, [nan, 1.0, 2.0]))
    assert np.isnan(named.positions).tolist() == [True, False, False]
    bare = JointOrder(OURS).read(state(OURS, [0.0, 1.0, 2.0], [nan, 1.0, 2.0], with_names=False))
    assert bare.velocities is not None
    assert np.isnan(bare.velocities).tolist() == [True, False, False]
