"""The wires: a JointState of 30 joints from arrays to bytes passed to Zenoh, and back.

A write follows a pause, as in a control loop; it is compared with the put of the same bytes on a plain Zenoh
publisher, with a reader on loopback. Reading is measured without a network: from payload and attachment to a
message, and on into a listener's buffer.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np

from bench.micro.form import Call, Row, call_times_us, chain_urdf, compared
from zstate import RobotModel, StatePublisher, TransformBuffer, connect, load_model
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.model.robot import coordinate_names, velocity_columns_by_position
from zstate.net.presence import local_writer
from zstate.net.session import Session
from zstate.net.writer import WireWriter
from zstate.wire.joint_order import SampleLayout
from zstate.wire.messages import JointState, RobotDescription, Sample, order_digest, to_block
from zstate.wire.protocol import SerializedSample, WriterNode
from zstate.wire.registry import get_wire

JOINTS = 30
CALLS = 100
PAUSE_S = 0.0005
STAMP = 1_700_000_000_123_456_789


def measure(rounds: int = 31) -> Iterator[Row]:
    """Rows of both wires."""
    model = load_model(chain_urdf(JOINTS))
    with connect() as session, connect() as other:
        reader = other.zenoh.declare_subscriber("**", lambda _: None)
        for wire in ("ros2", "native"):
            writing = call_times_us(write_cases(wire, session, model), rounds, CALLS, pause_s=PAUSE_S)
            yield from compared(f"{wire}, writing", "us", writing)
            reading = call_times_us(read_cases(wire, model, (rounds + 1) * CALLS), rounds, CALLS)
            yield from compared(f"{wire}, reading", "us", reading)
        reader.undeclare()


def write_cases(wire: str, session: Session, model: RobotModel) -> dict[str, Call]:
    """The cases of publishing one sample of positions and velocities; the session closes what they open."""
    numbers, state = np.linspace(-1.0, 1.0, JOINTS), sample(model, STAMP)
    publisher = StatePublisher(session, model, "whole", (wire,), streams=["joint_states"])
    wire_writer = WireWriter(session, get_wire(wire), "alone", local_writer(1), sample_names(model))
    writer = wire_writer.open_stream("joint_states")
    payload, attachment = writer.encoder.encode(state), bytes(33)
    bare = session.zenoh.declare_publisher(f"bench/{wire}")
    return {
        "raw put": lambda: bare.put(payload),
        "raw put, attachment": lambda: bare.put(payload, attachment=attachment),
        "SampleWriter: encode, write": lambda: writer.write(writer.encoder.encode(state)),
        "StatePublisher.publish": lambda: publisher.publish(numbers, numbers, stamp=STAMP),
    }


def read_cases(wire: str, model: RobotModel, calls: int) -> dict[str, Call]:
    """The cases of decoding ``calls`` consecutive samples, and of inserting them into a buffer."""
    wire_format = get_wire(wire)
    node = WriterNode("r1", local_writer(1), "1", 0, sample_names(model))
    encoder = wire_format.stream_encoder(node, "joint_states", number=1)
    stamps = count(STAMP, 10_000_000)

    def arrivals() -> list[SerializedSample]:
        payloads = [encoder.encode(sample(model, next(stamps))) for _ in range(calls)]
        attachment = encoder.attachment and encoder.attachment(STAMP)
        return [SerializedSample(encoder.key, one, encoder.encoding, attachment) for one in payloads]

    ingest = JointStateIngest("r1", FrameOwnership(TransformBuffer(), Counters()))
    ingest.describe(RobotDescription(1, model.urdf, model.digest, model.joint_names, ()))
    plain, whole = iter(arrivals()), iter(arrivals())

    def into_buffer() -> None:
        for message in wire_format.decode("joint_states", next(whole), "r1"):
            assert isinstance(message, Sample)
            ingest.insert_sample(message, overflowed=False)

    return {
        "decode": lambda: wire_format.decode("joint_states", next(plain), "r1"),
        "decode, into a buffer": into_buffer,
    }


def sample_names(model: RobotModel) -> SampleLayout:
    """The names of a sample's numbers."""
    return SampleLayout(coordinate_names(model), velocity_columns_by_position(model))


def sample(model: RobotModel, stamp: int) -> JointState:
    """Positions and velocities, in the model's order."""
    block = to_block(np.linspace(-1.0, 1.0, model.position_count))
    return JointState(stamp, 0, 1, order_digest(model.joint_names), block, block)
