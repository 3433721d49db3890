import struct
import tracemalloc
import zlib

import msgspec
import numpy as np
import pytest
from helpers.message_types import MESSAGE_TYPES
from hypothesis import given
from hypothesis import strategies as st

from zstate.cameras.messages import CameraInfo, CompressedImage
from zstate.clouds.messages import PointCloud, PointField
from zstate.driving.messages import (
    DriverState,
    JointCommand,
    JointTrajectory,
    MotionCancel,
    MotionOutcome,
    MotionReply,
    Release,
    Stop,
)
from zstate.errors import MessageError
from zstate.odometry.messages import (
    Fix,
    Imu,
    MagneticField,
    MapDatum,
    Odometry,
    Pose,
    Pressure,
    Velocity,
)
from zstate.scans.messages import LaserScan, OccupancyGrid
from zstate.stream_registry import all_streams
from zstate.streams import LATCHED_BYTES, StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.measurements import to_float32_block
from zstate.wire.messages import (
    ClockMessage,
    HistoryPage,
    JointState,
    Message,
    RobotDescription,
    StaticTransforms,
    Status,
    TransformSample,
    WriterTransforms,
    order_digest,
    to_block,
)
from zstate.wire.native import (
    NativeWire,
    decode,
    decode_joint_state,
    encode,
    encoding_of,
    joint_positions,
)
from zstate.wire.protocol import GraphNode, SerializedSample, StreamEncoder, Wire

WRITER = WriterId("arm", "jetson", 412, 5, 7)
NAMES = ("j1", "j2")
ORDER = order_digest(NAMES)
EDGES = (("b", "a"), ("a", "h"))
STAMP = 1_700_000_000_123_456_789

PACKET = b"\x00\x00\x01\x65\x88"  # of H.264: a start code, and the begin of a key frame

# MessagePack, by its specification: 0x90|n fixarray, 0xcf uint64, 0xcd uint16, 0xc4 n bin8,
# 0xa0|n fixstr, 0xc0 nil, 0x00..0x7f positive fixint; integers are big-endian.
UINT64 = b"\xcf"
UINT16 = b"\xcd"
NIL = b"\xc0"


def bin8(data: bytes) -> bytes:
    return b"\xc4" + bytes([len(data)]) + data


def fixstr(text: str) -> bytes:
    return bytes([0xA0 | len(text)]) + text.encode()


def pairs(*edges: tuple[str, str]) -> bytes:
    """Each edge an array of two strings."""
    return b"".join(b"\x92" + fixstr(parent) + fixstr(child) for parent, child in edges)


def header(fields: int) -> bytes:
    stamp = UINT64 + struct.pack(">Q", STAMP)
    seq = UINT16 + struct.pack(">H", 300)
    session = UINT64 + struct.pack(">Q", 2**63 + 5)
    return bytes([0x90 | fields]) + stamp + seq + session + bin8(ORDER)


GOLDEN: dict[str, tuple[Message, bytes]] = {
    "joint state": (
        JointState(STAMP, 300, 2**63 + 5, ORDER, to_block([0.5, -1.0])),
        header(8) + bin8(struct.pack("<2d", 0.5, -1.0)) + NIL * 3,
    ),
    "joint state without a model": (
        JointState(STAMP, 300, 2**63 + 5, ORDER, to_block([0, 1]), to_block([2, 3]), to_block([4, 5]), NAMES),
        header(8)
        + b"".join(bin8(struct.pack("<2d", *pair)) for pair in ((0, 1), (2, 3), (4, 5)))
        + b"\x92"
        + fixstr("j1")
        + fixstr("j2"),
    ),
    "transforms": (
        TransformSample(STAMP, 300, 2**63 + 5, ORDER, to_block([1, 2, 3, 0, 0, 0, 1])),
        header(6) + bin8(struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1)) + NIL,
    ),
    "transforms of a writer": (
        WriterTransforms(
            STAMP,
            300,
            2**63 + 5,
            order_digest(EDGES),
            to_block([1, 2, 3, 0, 0, 0, 1] * 2),
            EDGES,
            to_block([0.5] * 42),
        ),
        header(7)[:-8]
        + order_digest(EDGES)
        + bin8(struct.pack("<14d", *[1, 2, 3, 0, 0, 0, 1] * 2))
        + b"\x92"
        + pairs(*EDGES)
        + b"\xc5\x01\x50"
        + struct.pack("<42d", *[0.5] * 42),
    ),
    "command": (
        JointCommand(
            *(STAMP, 300, 2**63 + 5, order_digest(("j1",))),
            to_block([0.25]),
            names=("j1",),
            ttl=100,
            echo=(7, 9),
        ),
        header(11)[:-8]
        + order_digest(("j1",))
        + bin8(struct.pack("<d", 0.25))
        + NIL * 2
        + b"\x91"
        + fixstr("j1")
        + b"\x64"
        + NIL
        + b"\x92\x07\x09",
    ),
    "stop": (
        Stop(STAMP, 300, 2**63 + 5, "hold", "door open"),
        header(5)[: -len(bin8(ORDER))] + fixstr("hold") + fixstr("door open"),
    ),
    "release": (
        Release(STAMP, 300, 2**63 + 5, ((1, 2), (3, 4))),
        header(4)[: -len(bin8(ORDER))] + b"\x92\x92\x01\x02\x92\x03\x04",
    ),
    "driver state": (
        DriverState(
            *(5, 7, "host", "active", "", NAMES, 100, "teleop", 6, ("j2",), 0.5, 4, 3, 2, {"old": 1}, "late"),
            *(((8, 9),), (7, 3), 0.25, (MotionOutcome(7, 2, "reached", "in time"),), ("effort", "velocity")),
            *(11, (7, 4), 12),
        ),
        b"\xdc\x00\x18\x05\x07"
        + fixstr("host")
        + fixstr("active")
        + fixstr("")
        + b"\x92"
        + fixstr("j1")
        + fixstr("j2")
        + b"\x64"
        + fixstr("teleop")
        + b"\x06\x91"
        + fixstr("j2")
        + b"\xcb"
        + struct.pack(">d", 0.5)
        + b"\x04\x03\x02\x81"
        + fixstr("old")
        + b"\x01"
        + fixstr("late")
        + b"\x91\x92\x08\x09"
        + b"\x92\x07\x03\xcb"
        + struct.pack(">d", 0.25)
        + b"\x91\x94\x07\x02"
        + fixstr("reached")
        + fixstr("in time")
        + b"\x92"
        + fixstr("effort")
        + fixstr("velocity")
        + b"\x0b\x92\x07\x04\x0c",
    ),
    "statics": (
        StaticTransforms(7, (("b", "c"),), to_block([0, 0, 1, 0, 0, 0, 1])),
        b"\x93\x07\x91" + pairs(("b", "c")) + bin8(struct.pack("<7d", 0, 0, 1, 0, 0, 0, 1)),
    ),
    "description": (
        RobotDescription(7, "<robot/>", "00ff", NAMES, EDGES),
        b"\x96\x07"
        + fixstr("<robot/>")
        + fixstr("00ff")
        + b"\x92"
        + fixstr("j1")
        + fixstr("j2")
        + b"\x92"
        + pairs(*EDGES)
        + fixstr("system"),
    ),
    "cloud": (
        PointCloud(
            *(STAMP, 300, 2**63 + 5, "lidar", 1, 2, (PointField("x", 0, 7, 1),)),
            *(False, 4, 8, to_float32_block([0.5, 1]), True, "", 0.0),
        ),
        header(14)[:-10]
        + fixstr("lidar")
        + b"\x01\x02\x91\x94"
        + fixstr("x")
        + b"\x00\x07\x01\xc2\x04\x08"
        + bin8(struct.pack("<2f", 0.5, 1))
        + b"\xc3"
        + fixstr("")
        + b"\xcb"
        + struct.pack(">d", 0.0),
    ),
    "scan": (
        LaserScan(
            *(STAMP, 300, 2**63 + 5, "laser", -0.5, 0.25, 5, 7, 0.125, 8.0),
            to_float32_block([0.5, np.inf]),
            to_float32_block([1, 2]),
        ),
        header(12)[:-10]
        + fixstr("laser")
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (-0.5, 0.25))
        + b"\x05\x07"
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (0.125, 8.0))
        + bin8(struct.pack("<2f", 0.5, np.inf))
        + bin8(struct.pack("<2f", 1, 2)),
    ),
    "image": (
        CompressedImage(STAMP, 300, 2**63 + 5, "wrist", "h264", PACKET),
        header(6)[:-10] + fixstr("wrist") + fixstr("h264") + bin8(PACKET),
    ),
    "camera_info": (
        CameraInfo(
            *(STAMP, 300, 2**63 + 5, "wrist", 100, 50, "equidistant"),
            *(to_block([80, 81, 49.5, 24.5]), to_block([0.5, 0, 0, 0]), 7),
        ),
        header(12)[:-10]
        + fixstr("wrist")
        + b"\x64\x32"
        + fixstr("equidistant")
        + bin8(struct.pack("<4d", 80, 81, 49.5, 24.5))
        + bin8(struct.pack("<4d", 0.5, 0, 0, 0))
        + b"\x07\xc0\xc0",
    ),
    "imu": (
        Imu(
            *(STAMP, 300, 2**63 + 5, "imu", to_block([1, 2, 3]), to_block([0, 0, 9.81])),
            *(to_block([0, 0, 0, 1]), None, to_block(range(6)), to_block(range(6))),
        ),
        header(10)[:-10]
        + fixstr("imu")
        + bin8(struct.pack("<3d", 1, 2, 3))
        + bin8(struct.pack("<3d", 0, 0, 9.81))
        + bin8(struct.pack("<4d", 0, 0, 0, 1))
        + NIL
        + bin8(struct.pack("<6d", *range(6))) * 2,
    ),
    "velocity": (
        Velocity(STAMP, 300, 2**63 + 5, "base", to_block([1, 2, 3]), None, to_block(range(6))),
        header(7)[:-10]
        + fixstr("base")
        + bin8(struct.pack("<3d", 1, 2, 3))
        + NIL
        + bin8(struct.pack("<6d", *range(6))),
    ),
    "pose": (
        Pose(STAMP, 300, 2**63 + 5, "map", "base", to_block([1, 2, 3, 0, 0, 0, 1]), to_block(range(21))),
        header(7)[:-10]
        + fixstr("map")
        + fixstr("base")
        + bin8(struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1))
        + bin8(struct.pack("<21d", *range(21))),
    ),
    "fix": (
        Fix(STAMP, 300, 2**63 + 5, "gps", 47.5, -8.25, None, 1, 9, to_block(range(6)), 2),
        header(11)[:-10]
        + fixstr("gps")
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (47.5, -8.25))
        + NIL
        + b"\x01\x09"
        + bin8(struct.pack("<6d", *range(6)))
        + b"\x02",
    ),
    "fix without a position": (
        Fix(STAMP, 300, 2**63 + 5, "gps", None, None, status=-1),
        header(11)[:-10] + fixstr("gps") + NIL * 3 + b"\xff\x00" + NIL + b"\x00",
    ),
    "pressure": (
        Pressure(STAMP, 300, 2**63 + 5, "bmp", 101325.0, 2.25),
        header(6)[:-10]
        + fixstr("bmp")
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (101325.0, 2.25)),
    ),
    "datum": (
        MapDatum(STAMP, 300, 2**63 + 5, "fleet/map", 47.5, -8.25, 450.0),
        header(7)[:-10]
        + fixstr("fleet/map")
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (47.5, -8.25, 450.0)),
    ),
    "magnetic_field": (
        MagneticField(STAMP, 300, 2**63 + 5, "mag", to_block([0.5, 0.25, -1.0]), to_block(range(6))),
        header(6)[:-10]
        + fixstr("mag")
        + bin8(struct.pack("<3d", 0.5, 0.25, -1.0))
        + bin8(struct.pack("<6d", *range(6))),
    ),
    "odometry": (
        Odometry(
            *(STAMP, 300, 2**63 + 5, order_digest(EDGES[:1]), to_block([1, 2, 3, 0, 0, 0, 1]), EDGES[:1]),
            *(None, to_block(range(6)), to_block(range(21))),
        ),
        header(9)[:-8]
        + order_digest(EDGES[:1])
        + bin8(struct.pack("<7d", 1, 2, 3, 0, 0, 0, 1))
        + b"\x91"
        + pairs(*EDGES[:1])
        + NIL
        + bin8(struct.pack("<6d", *range(6)))
        + bin8(struct.pack("<21d", *range(21))),
    ),
    "grid": (
        OccupancyGrid(7, 6, "map", 0.5, 2, 1, to_block([1, 2, 0, 0, 0, 0, 1]), b"\xff\x64"),
        b"\x98\x07\x06"
        + fixstr("map")
        + b"\xcb"
        + struct.pack(">d", 0.5)
        + b"\x02\x01"
        + bin8(struct.pack("<7d", 1, 2, 0, 0, 0, 0, 1))
        + bin8(b"\xff\x64"),
    ),
    "clock": (ClockMessage(0, 1, 2), b"\x93\x00\x01\x02"),
    "status": (
        Status(1, 2, "warn", "driver", "nuc", 3, 0.5, 4, 5, "slow", {"refused": "6"}),
        b"\x9b\x01\x02"
        + b"".join(map(fixstr, ("warn", "driver", "nuc")))
        + b"\x03\xcb"
        + struct.pack(">d", 0.5)
        + b"\x04\x05"
        + fixstr("slow")
        + b"\x81"
        + fixstr("refused")
        + fixstr("6"),
    ),
    "past": (
        HistoryPage("e", (b"ab", b""), 5),
        b"\x93" + fixstr("e") + b"\x92" + b"\xc4\x02ab" + b"\xc4\x00" + b"\x05",
    ),
    "trajectory": (
        JointTrajectory(
            *(STAMP, 300, 2**63 + 5, ("j1",), to_block([0.5, 1.0]), to_block([0.25, 0.75])),
            *(None, None, 5, True, 0.2, 0.1, 3.0, (7, 9)),
        ),
        header(14)[:-10]
        + b"\x91"
        + fixstr("j1")
        + bin8(struct.pack("<2d", 0.5, 1.0))
        + bin8(struct.pack("<2d", 0.25, 0.75))
        + NIL * 2
        + b"\x05\xc3"
        + b"".join(b"\xcb" + struct.pack(">d", number) for number in (0.2, 0.1, 3.0))
        + b"\x92\x07\x09",
    ),
    "cancel": (MotionCancel(STAMP, 300, 2**63 + 5, 7), header(4)[:-10] + b"\x07"),
    "motion reply": (
        MotionReply(7, 100, ("too fast",)),
        b"\x93\x07\x64\x91" + fixstr("too fast"),
    ),
}
MESSAGES = [message for message, _ in GOLDEN.values()]


@pytest.mark.parametrize(("message", "golden"), GOLDEN.values(), ids=GOLDEN.keys())
def test_the_bytes_are_those_of_the_messagepack_specification(message: Message, golden: bytes):
    assert encode(message) == golden
    assert decode(golden, encoding_of(type(message)), type(message)) == message


def test_the_encoding_names_type_and_version():
    assert encoding_of(JointState) == "zstate/JointState;v=1"
    assert encoding_of(RobotDescription) == "zstate/RobotDescription;v=1"


@pytest.mark.parametrize("count", [0, 1, 7, 29, 31, 32, 200])
def test_a_sample_takes_at_most_54_bytes_plus_8_per_number_in_the_worst_case(count: int):
    worst = (2**63 - 1, 2**40, 2**64 - 1, ORDER)
    block = to_block(np.zeros(count))
    assert len(encode(JointState(*worst, block))) <= 54 + 8 * count
    assert len(encode(JointState(*worst, block, block, block))) <= 54 + 8 * 3 * count
    assert len(encode(JointCommand(*worst, block, block, block))) <= 54 + 8 * 3 * count
    assert len(encode(TransformSample(*worst, block * 7))) <= 54 + 8 * 7 * count


def test_seven_positions_take_at_most_110_bytes():
    assert len(encode(JointState(2**63 - 1, 2**40, 2**64 - 1, ORDER, to_block(np.zeros(7))))) <= 110


def reason(payload: bytes, encoding: str, kind: type[Message] = JointState) -> str:
    with pytest.raises(MessageError) as caught:
        decode(payload, encoding, kind)
    return caught.value.reason


@pytest.mark.parametrize("message", MESSAGES, ids=GOLDEN.keys())
def test_a_message_cut_off_anywhere_is_truncated(message: Message):
    whole = encode(message)
    kind = type(message)
    reasons = {reason(whole[:length], encoding_of(kind), kind) for length in range(len(whole))}
    assert reasons == {"truncated"}


@pytest.mark.parametrize(
    "encoding",
    ["", "zenoh/bytes", "text/plain", "zstate/Clock;v=1", "zstate/JointState", "zstate/JointState;v=0"],
)
def test_a_message_under_another_encoding_is_foreign_and_the_encoding_is_named(encoding: str):
    with pytest.raises(MessageError, match="another program") as caught:
        decode(encode(MESSAGES[0]), encoding, JointState)
    assert caught.value.reason == "foreign"
    assert repr(encoding) in str(caught.value)


def test_newer_version_has_its_own_reason():
    assert reason(b"whatever", "zstate/JointState;v=2") == "newer version"
    assert reason(b"whatever", "zstate/Clock;v=2") == "foreign"


def test_appended_fields_of_a_later_version_are_ignored():
    fields = msgspec.msgpack.decode(encode(MESSAGES[0]))
    assert (
        decode(msgspec.msgpack.encode([*fields, "more"]), encoding_of(JointState), JointState) == MESSAGES[0]
    )


GOOD = [0, 0, 1, ORDER, b"12345678"]


@pytest.mark.parametrize(
    "fields",
    [
        [0.5, *GOOD[1:]],
        [2**63, *GOOD[1:]],
        [0, -1, *GOOD[2:]],
        [0, 0, "1", *GOOD[3:]],
        [0, 0, 1, b"short", b""],
        [*GOOD[:4], b"1234567"],
        [*GOOD[:4], [1.0]],
        [*GOOD, b"1"],
        [*GOOD, None, None, ["wrong"]],
        GOOD[:3],
        "text",
        None,
        {"stamp": 0},
    ],
)
def test_wrong_types_ranges_and_lengths_are_malformed(fields: object):
    assert reason(msgspec.msgpack.encode(fields), encoding_of(JointState)) == "malformed"


def test_bytes_after_the_message_are_malformed():
    assert reason(encode(MESSAGES[0]) + b"\x00", encoding_of(JointState)) == "malformed"


def test_text_that_is_not_utf8_is_malformed():
    description = encode(MESSAGES[5]).replace(b"<robot/>", b"\xff\xfe12345.")
    assert reason(description, encoding_of(RobotDescription), RobotDescription) == "malformed"


def test_arrays_nested_without_end_are_malformed():
    bomb = b"\x99" + encode(MESSAGES[0])[1:] + b"\x91" * 1_000_000 + b"\xc0"
    assert reason(bomb, encoding_of(JointState)) == "malformed"


def test_a_further_element_of_100_nested_arrays_is_ignored():
    message = MESSAGES[0]
    nested = b"\x99" + encode(message)[1:] + b"\x91" * 100 + b"\xc0"
    assert decode(nested, encoding_of(JointState), JointState) == message


def large_grid(side: int) -> OccupancyGrid:
    cells = np.random.default_rng(1).integers(-1, 101, side * side, np.int8).tobytes()
    return OccupancyGrid(1, 2, "map", 0.05, side, side, to_block([0, 0, 0, 0, 0, 0, 1]), cells)


@pytest.mark.parametrize("side", [250, 300, 4000])
def test_a_grid_is_deflated_above_64_kb_and_read_again(side: int):
    grid = large_grid(side)
    payload = encode(grid)
    plain = msgspec.msgpack.encode(grid)
    assert payload == plain if side == 250 else zlib.decompress(payload) == plain
    arrival = SerializedSample("zstate/hall/map/map", payload, encoding_of(OccupancyGrid))
    assert NativeWire().decode("map", arrival, "hall") == (grid,)


def test_a_deflated_grid_cut_off_anywhere_is_truncated():
    payload = encode(
        OccupancyGrid(1, 2, "m", 0.05, 70_000, 1, to_block([0, 0, 0, 0, 0, 0, 1]), bytes(70_000))
    )
    assert len(payload) < 1000
    lengths = range(1, len(payload))
    assert {reason(payload[:n], encoding_of(OccupancyGrid), OccupancyGrid) for n in lengths} == {"truncated"}


@pytest.mark.long
def test_a_grid_that_inflates_beyond_the_limit_is_refused_without_inflating_it():
    bomb = zlib.compress(bytes(2**28), 9)
    assert len(bomb) < 300_000
    tracemalloc.start()
    try:
        assert reason(bomb, encoding_of(OccupancyGrid), OccupancyGrid) == "too large"
        assert tracemalloc.get_traced_memory()[1] < 3 * LATCHED_BYTES
    finally:
        tracemalloc.stop()


def test_bytes_after_a_deflated_grid_and_wrong_checksums_are_malformed():
    payload = encode(large_grid(300))
    for wrong in (payload + b"\0", payload[:-1] + bytes([payload[-1] ^ 1]), b"\x78" + bytes(9)):
        assert reason(wrong, encoding_of(OccupancyGrid), OccupancyGrid) == "malformed"


def test_the_wire_does_not_check_for_infinite_numbers():
    state = JointState(0, 0, 1, ORDER, to_block([np.nan, np.inf]))
    assert decode(encode(state), encoding_of(JointState), JointState) == state


@given(st.binary(max_size=200), st.sampled_from(MESSAGE_TYPES))
def test_arbitrary_bytes_raise_only_message_error(payload: bytes, kind: type[Message]):
    try:
        decode(payload, encoding_of(kind), kind)
    except MessageError as error:
        assert error.reason in {"truncated", "malformed"}


@given(st.sampled_from(MESSAGES), st.integers(0, 10_000), st.integers(0, 255))
def test_one_changed_byte_raises_only_message_error(message: Message, at: int, value: int):
    payload = bytearray(encode(message))
    payload[at % len(payload)] = value
    try:
        decode(bytes(payload), encoding_of(type(message)), type(message))
    except MessageError as error:
        of_another_format = {"foreign"} if isinstance(message, CompressedImage) else set[str]()
        assert error.reason in {"truncated", "malformed"} | of_another_format


def encoder_of(stream: StreamName, name: str = "") -> StreamEncoder:
    return NativeWire().stream_encoder(GraphNode("r1", WRITER, "z1", 0), stream, number=0, name=name)


def test_native_wire_implements_the_protocol_for_every_stream():
    wire: Wire = NativeWire()
    by_type = {type(message): message for message in MESSAGES}
    for stream, kind in ((row.name, row.type) for row in all_streams()):
        message, encoder = by_type[kind], encoder_of(stream, "w")
        assert encoder.encoding == encoding_of(kind)
        assert encoder.key.startswith(wire.expression("r1", stream).rstrip("*"))
        arrival = SerializedSample(encoder.key, encoder.encode(message), encoder.encoding, encoder.attachment)
        assert wire.decode(stream, arrival, "r1") == (message,)


def test_native_token_announces_writer_and_stream():
    wire = NativeWire()
    encoder = encoder_of("tf")
    assert encoder.token is not None
    assert wire.parse_token(encoder.token, "r1") == (Announcement("r1", "tf", WRITER),)
    assert wire.parse_token("zstate/r1/@writer/tf/nonsense", "r1") == ()


def test_one_token_announces_all_streams_of_a_writer_and_the_name_of_its_static_edges():
    streams: tuple[StreamName, ...] = ("robot_description", "tf_static", "tf", "joint_states")
    tokens = [token for stream in streams if (token := encoder_of(stream, "mount").token)]
    (joined,) = NativeWire().joined_tokens(tokens)
    assert joined == f"zstate/r1/@writer/joint_states,tf,tf_static,robot_description/{WRITER.identity},mount"
    announced = {NativeWire().parse_token(token, "r1")[0] for token in tokens}
    assert set(NativeWire().parse_token(joined, "r1")) == announced
    assert {one.name for one in announced if one.stream == "tf_static"} == {"mount"}
    assert NativeWire().joined_tokens([]) == []


def test_streams_of_different_names_keep_tokens_of_their_own():
    tokens = [token for name in ("mount", "camera") if (token := encoder_of("tf_static", name).token)]
    assert NativeWire().joined_tokens(tokens) == tokens


@pytest.mark.parametrize("rates", [None, b"", bytes(8)])
def test_joint_positions_are_those_of_the_decoded_message(rates: bytes | None):
    for numbers in (0, 1, 7, 40, 9000):
        positions = np.arange(float(numbers)).tobytes()
        payload = encode(JointState(-(2**40), 70_000, 2**32 - 1, bytes(8), positions, rates, rates))
        assert bytes(joint_positions(payload)) == positions == decode_joint_state(payload).positions
