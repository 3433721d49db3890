import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import MessageError
from zstate.wire.joint_order import JointOrder
from zstate.wire.messages import JointState, order_digest, to_block

OURS = ("shoulder", "elbow", "wrist")


def state(names: tuple[str, ...], *blocks: list[float] | None, said: bool = True) -> JointState:
    numbers = [None if block is None else to_block(block) for block in blocks]
    return JointState(0, 0, 0, order_digest(names), *numbers, names=names if said else None)


def lists(numbers) -> list[list[float] | None]:
    return [None if block is None else block.tolist() for block in numbers]


def test_numbers_in_our_order_are_read_as_they_are_without_a_copy():
    message = state(OURS, [1, 2, 3], None, [4, 5, 6], said=False)
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
        JointOrder(OURS).read(state(OURS[::-1], [1, 2, 3], said=False))
    assert caught.value.reason == "other joint order"


def test_writers_of_several_orders_are_read_in_turn():
    order = JointOrder(OURS)
    for names in (OURS[::-1], OURS, (*OURS[1:], OURS[0]), OURS[::-1]):
        values = [float(OURS.index(name)) for name in names]
        assert lists(order.read(state(names, values)))[0] == [0, 1, 2]
