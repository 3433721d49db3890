import asyncio
import logging
import threading

import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, put, wait_for_reader

from zstate.model.load import load_model
from zstate.net.session import Session
from zstate.net.streams import KeyPublisher
from zstate.nodes.publisher import StatePublisher
from zstate.sources import JointStateListener
from zstate.wire.messages import JointState, order_digest, to_block
from zstate.wire.native import encode, encoding_of

KEY = "zstate/r1/joint_states"
NAN = float("nan")
FLOATING = load_model(
    '<robot name="drone"><link name="map"/><link name="body"/>'
    '<joint name="free" type="floating"><parent link="map"/><child link="body"/></joint></robot>'
)


def put_sample(session: Session, payload: bytes, encoding: str = encoding_of(JointState)) -> None:
    wait_for_reader(session, KEY)
    with KeyPublisher(session, KEY, encoding) as stream:
        stream.put(payload)


def joint_state(*blocks: list[float], model=RRBOT) -> bytes:
    return encode(JointState(7, 0, 1, order_digest(model.joint_names), *map(to_block, blocks)))


def test_every_sample_is_read_in_order_with_its_stamp(sessions):
    writer, reader = sessions
    with JointStateListener(reader, "r1", RRBOT) as source, StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, KEY)
        for number in range(5):
            publisher.publish([number, -number], [1.0, 2.0], [3.0, 4.0], stamp=number)
        readings = [reading for _, reading in zip(range(5), source, strict=False)]
    assert [reading.stamp for reading in readings] == [0, 1, 2, 3, 4]
    assert [reading.positions.tolist() for reading in readings] == [[n, -n] for n in range(5)]
    assert all(reading.velocities.tolist() == [1.0, 2.0] for reading in readings)
    assert all(reading.efforts.tolist() == [3.0, 4.0] for reading in readings)


def test_read_returns_the_newest_once(sessions):
    writer, reader = sessions
    with JointStateListener(reader, "r1", RRBOT) as source, StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, KEY)
        assert source.read(0) is None
        publisher.publish([1.0, 2.0], stamp=1)
        publisher.publish([3.0, 4.0], stamp=2)
        seen = []
        until(
            lambda: (
                (reading := source.read(0)) is not None
                and seen.append(reading) is None
                and reading.stamp == 2
            )
        )
        assert seen[-1].positions.tolist() == [3.0, 4.0]
        assert seen[-1].velocities is None
        assert source.read(0) is None


def test_the_model_is_by_default_that_of_the_description(sessions):
    writer, reader = sessions
    with JointStateListener(reader, "r1") as joints:
        assert joints.model is None
        put_sample(writer, joint_state([1.0, 2.0]))  # arrives before the description
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            until(lambda: joints.model is not None)
            publisher.publish([3.0, 4.0], stamp=8)
            readings = [reading for _, reading in zip(range(2), joints, strict=False)]
    assert [reading.stamp for reading in readings] == [7, 8]
    assert joints.model.joint_names == RRBOT.joint_names


def test_callback_gets_every_sample(sessions):
    writer, reader = sessions
    stamps: list[int | None] = []
    with (
        JointStateListener(reader, "r1", RRBOT, on_reading=lambda reading: stamps.append(reading.stamp)),
        StatePublisher(writer, RRBOT, "r1") as publisher,
    ):
        wait_for_reader(writer, KEY)
        for number in range(5):
            publisher.publish([0.0, 0.0], stamp=number)
        until(lambda: stamps == [0, 1, 2, 3, 4])


def test_tasks_read_samples_and_end_with_the_listener(sessions):
    writer, reader = sessions
    joints = JointStateListener(reader, "r1", RRBOT)

    async def read() -> list[int | None]:
        async def collect() -> None:
            async for reading in joints:
                stamps.append(reading.stamp)
                arrived.set()

        stamps: list[int | None] = []
        arrived = asyncio.Event()
        task = asyncio.create_task(collect())
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            await asyncio.to_thread(wait_for_reader, writer, KEY)
            for number in range(3):
                arrived.clear()
                publisher.publish([0.0, 0.0], stamp=number)
                await asyncio.wait_for(arrived.wait(), DEADLINE_S)
        await asyncio.to_thread(joints.close)
        await asyncio.wait_for(task, DEADLINE_S)
        return stamps

    assert asyncio.run(read()) == [0, 1, 2]


@pytest.mark.parametrize(
    ("payload", "encoding", "reason"),
    [
        (b"\x98", encoding_of(JointState), "truncated"),
        (joint_state([1, 2])[:-3], encoding_of(JointState), "truncated"),
        (b"\x00\xff\xfe", encoding_of(JointState), "malformed"),
        (joint_state([1, 2]), "zstate/JointState;v=2", "newer version"),
        (joint_state([1, 2]), "text/plain", "foreign"),
        (joint_state([1, 2, 3]), encoding_of(JointState), "bad numbers"),
        (joint_state([1, NAN]), encoding_of(JointState), "bad numbers"),
        (joint_state([1, 2], [1, NAN]), encoding_of(JointState), "bad numbers"),
        (joint_state([1, 2], [1]), encoding_of(JointState), "bad numbers"),
        (joint_state([1, 2], [1, 2], [float("inf"), 2]), encoding_of(JointState), "bad numbers"),
    ],
    ids=lambda value: value if isinstance(value, str) else value[:9].hex(),
)
def test_unusable_samples_are_counted_and_logged_once_and_the_next_is_read(
    sessions, caplog, payload: bytes, encoding: str, reason: str
):
    writer, reader = sessions
    with caplog.at_level(logging.WARNING), JointStateListener(reader, "r1", RRBOT) as source:
        put_sample(writer, payload, encoding)
        put_sample(writer, payload, encoding)
        until(lambda: source.refused == {reason: 2})
        put_sample(writer, joint_state([1.0, 2.0]))
        assert next(iter(source)).stamp == 7
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert reason in caplog.text


def test_samples_that_wait_for_the_model_are_bounded_in_bytes(sessions):
    writer, reader = sessions
    size = 200_000
    large = joint_state([0.0] * (size // 8))
    with JointStateListener(reader, "r1") as source:
        wait_for_reader(writer, KEY)
        for payload in (*[large] * (2 * 2**22 // size), joint_state([1.0, 2.0])):
            put(writer, KEY, payload, encoding_of(JointState))

        def last_is_waiting() -> bool:
            with source._lock:
                return any(len(one.message.positions) == 16 for one in source._undescribed)

        until(last_is_waiting)
        with StatePublisher(writer, RRBOT, "r1", streams=["robot_description"]):
            assert next(iter(source)).positions.tolist() == [1.0, 2.0]
        assert 0 < source.refused["bad numbers"] <= 2**22 // size


def test_the_newest_1024_readings_wait_for_their_reader(sessions):
    writer, reader = sessions
    block, order = to_block([1.0, 2.0]), order_digest(RRBOT.joint_names)
    with JointStateListener(reader, "r1", RRBOT) as source:
        wait_for_reader(writer, KEY)
        with KeyPublisher(writer, KEY, encoding_of(JointState)) as stream:
            for batch in range(11):  # each ends with a message whose refusal shows that it was received
                for seq in range(100 * batch, 100 * batch + 100):
                    stream.put(encode(JointState(seq, seq, 1, order, block)))
                stream.put(b"end of a batch")
                until(lambda batch=batch: source.refused["malformed"] == batch + 1)
        source.close()
        assert [reading.stamp for reading in source] == list(range(1100 - 1024, 1100))


def test_a_floating_joint_without_a_unit_quaternion_is_refused_before_republishing(sessions):
    writer, reader = sessions
    with JointStateListener(reader, "r1", FLOATING) as source:
        put_sample(writer, joint_state([0, 0, 0, 0, 0, 0, 0.5], model=FLOATING))
        until(lambda: source.refused == {"bad numbers": 1})


def test_close_ends_an_iteration_that_waits(sessions):
    source = JointStateListener(sessions[1], "r1", RRBOT)
    readings: list[object] = []
    thread = threading.Thread(target=lambda: readings.extend(source))
    thread.start()
    source.close()
    source.close()
    thread.join(1.0)
    assert not thread.is_alive()
    assert readings == []


def test_a_publisher_runs_on_what_another_publishes(sessions):
    writer, reader = sessions
    with (
        JointStateListener(reader, "r1", RRBOT) as source,
        StatePublisher(writer, RRBOT, "r1", streams=["joint_states"]) as driver,
        StatePublisher(reader, RRBOT, "r2") as echo,
        JointStateListener(writer, "r2", RRBOT) as echoed,
    ):
        wait_for_reader(writer, KEY)
        wait_for_reader(reader, "zstate/r2/joint_states")
        runner = threading.Thread(target=echo.run, args=(source, 200.0))
        runner.start()
        driver.publish([0.25, 0.5], stamp=11)
        reading = next(iter(echoed))
        assert (reading.stamp, reading.positions.tolist()) == (11, [0.25, 0.5])
        echo.close()
        runner.join(1.0)
        assert not runner.is_alive()
