"""Golden vectors of the native wire, and the tables of docs/wire.md, against the code.

The expected bytes are built here, by the types in the tables of the page and the MessagePack specification.
"""

import json
import re
import struct
from collections.abc import Callable
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.matrix_kinematics import MatrixKinematics, matrices
from helpers.message_types import MESSAGE_TYPES

from zstate.buffer.buffer import TransformBuffer
from zstate.clouds.messages import PointField
from zstate.driving.messages import MotionOutcome
from zstate.errors import InvalidInput, MessageError
from zstate.model.urdf import parse_urdf
from zstate.net.sample_history import MAX_PAGE_BYTES
from zstate.net.sites import SITE_TOKEN
from zstate.stream_registry import all_streams, is_named, latched_streams, own_streams
from zstate.streams import StreamName
from zstate.wire import keys
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import STOP_STREAMS
from zstate.wire.messages import HistoryPage, Message, order_digest
from zstate.wire.native import NativeWire, decode, encode, encoding_of
from zstate.wire.protocol import SerializedSample

Json = dict[str, Any]

GOLDEN = Path(__file__).parent / "golden"
PAGE = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()

KINDS: dict[str, type[Message]] = {
    kind.__name__: kind for kind in (*MESSAGE_TYPES, *(row.type for row in all_streams()))
}
FORMATS = {"f64[]": "d", "f32[]": "f", "i8[]": "b"}
INTEGERS = ("stamp", "session", "uint", "int", "ns")


def rows_of(text: str) -> list[list[str]]:
    """The cells of the tables in ``text``."""
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in text.splitlines() if line[:1] == "|"]


def section(title: str) -> str:
    """The text below the heading ``title`` until the next heading."""
    return re.split(r"^#+ ", PAGE.partition(f"# {title}\n")[2], maxsplit=1, flags=re.MULTILINE)[0]


def table(title: str) -> dict[str, tuple[str, str]]:
    """Type and default of each field in the table of a message."""
    rows = [row for row in rows_of(section(title)) if row[0].isdigit()]
    assert [row[0] for row in rows] == [str(number) for number in range(len(rows))]
    return {row[1].strip("`"): (row[2].strip("`"), row[4].strip("`")) for row in rows}


TABLES = {title: table(title) for title in (*KINDS, "MotionOutcome")}


def vectors(file: str) -> list[Json]:
    return json.loads((GOLDEN / file).read_text())


MESSAGES, REFUSALS = vectors("messages.json"), vectors("refusals.json")
CANONICAL = [vector for vector in MESSAGES if vector["canonical"]]


# Bytes from fields, by the MessagePack specification.


def sized(size: int, small: int, largest_small: int, codes: bytes) -> bytes:
    """The header of a value of ``size``: one byte up to ``largest_small``, else the shortest of ``codes``."""
    if size <= largest_small:
        return bytes([small | size])
    widths = (1, 2, 4)[-len(codes) :]
    code, width = next((code, width) for code, width in zip(codes, widths, strict=True) if size < 256**width)
    return bytes([code]) + size.to_bytes(width, "big")


def pack_int(number: int) -> bytes:
    if -32 <= number < 128:
        return struct.pack("b", number)
    forms = ((0xD0, "b"), (0xD1, "h"), (0xD2, "i"), (0xD3, "q")) if number < 0 else ()
    for code, form in forms or ((0xCC, "B"), (0xCD, "H"), (0xCE, "I"), (0xCF, "Q")):
        try:
            return bytes([code]) + struct.pack(f">{form}", number)
        except struct.error:
            continue
    raise AssertionError(number)


def pack_str(text: str) -> bytes:
    data = text.encode()
    return sized(len(data), 0xA0, 31, b"\xd9\xda\xdb") + data


def pack_bin(data: bytes) -> bytes:
    return sized(len(data), 0, -1, b"\xc4\xc5\xc6") + data


def pack_array(items: list[bytes]) -> bytes:
    return sized(len(items), 0x90, 15, b"\xdc\xdd") + b"".join(items)


def pack_map(values: Json, pack: Callable[[Any], bytes]) -> bytes:
    return sized(len(values), 0x80, 15, b"\xde\xdf") + b"".join(
        pack_str(key) + pack(value) for key, value in values.items()
    )


PACK: dict[str, Callable[[Any], bytes]] = {
    **dict.fromkeys(INTEGERS, lambda value: pack_int(int(value))),
    "float": lambda value: b"\xcb" + struct.pack(">d", float(value)),
    "bool": lambda value: b"\xc3" if value else b"\xc2",
    "str": pack_str,
    "bin": lambda value: pack_bin(bytes.fromhex(value)),
    "order": lambda value: pack_bin(bytes.fromhex(value)),
    "str[]": lambda value: pack_array([pack_str(text) for text in value]),
    "fields": lambda value: pack_array(
        [pack_array([pack_str(one[0]), *(pack_int(number) for number in one[1:])]) for one in value]
    ),
    "edges": lambda value: pack_array([pack_array([pack_str(a), pack_str(b)]) for a, b in value]),
    "id": lambda value: pack_array([pack_int(int(number)) for number in value]),
    "id[]": lambda value: pack_array([PACK["id"](one) for one in value]),
    "bin[]": lambda value: pack_array([pack_bin(bytes.fromhex(one)) for one in value]),
    "map[str]": lambda value: pack_map(value, pack_str),
    "map[uint]": lambda value: pack_map(value, lambda number: pack_int(int(number))),
    "MotionOutcome[]": lambda value: pack_array(
        [pack_fields("MotionOutcome", dict(zip(TABLES["MotionOutcome"], one, strict=True))) for one in value]
    ),
}


def pack_value(kind: str, value: Any) -> bytes:
    if value is None:
        assert kind.endswith("?"), kind
        return b"\xc0"
    kind = kind.removesuffix("?")
    if kind in FORMATS:
        return pack_bin(
            struct.pack(f"<{len(value)}{FORMATS[kind]}", *map(float, value) if kind != "i8[]" else value)
        )
    return PACK[kind](value)


def pack_fields(title: str, fields: Json) -> bytes:
    """The payload of a message with these fields, as in the vectors, by the table of the page."""
    assert list(fields) == list(TABLES[title])
    return pack_array([pack_value(kind, fields[name]) for name, (kind, _) in TABLES[title].items()])


# Fields, as in the vectors, from a message of the code.


def shown_float(number: float) -> float | str:
    return (
        number if np.isfinite(number) else {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}[str(number)]
    )


SHOW: dict[type, Callable[[str, Any], Any]] = {
    int: lambda _, value: str(value),
    float: lambda _, value: shown_float(value),
    bytes: lambda _, value: value.hex(),
    tuple: lambda kind, value: [shown(kind.removesuffix("[]"), one) for one in value],
    dict: lambda kind, value: {key: shown(kind[4:-1], one) for key, one in value.items()},
    MotionOutcome: lambda _, value: list(shown_fields(value).values()),
    PointField: lambda _, value: list(value),
}


def shown(kind: str, value: Any) -> Any:
    """A value of the type ``kind`` as in the vectors."""
    kind = kind.removesuffix("?")
    if value is not None and kind in FORMATS:
        return [shown_float(one) for (one,) in struct.iter_unpack(f"<{FORMATS[kind]}", value)]
    return SHOW[type(value)](kind, value) if type(value) in SHOW else value


def shown_fields(message: Message) -> Json:
    kinds = TABLES[type(message).__name__]
    return {name: shown(kinds[name][0], getattr(message, name)) for name in message.__struct_fields__}


def stream_of(key: str) -> StreamName:
    """The stream of a key. Raises InvalidInput for other keys."""
    return "clock" if key == keys.CLOCK_KEY else keys.stream_from_key(key)


def decoded(vector: Json) -> Message:
    """The message of a vector, read as a subscriber to its key reads it, or as a reply."""
    payload, encoding = bytes.fromhex(vector["hex"]), vector["encoding"]
    try:
        stream = stream_of(vector["key"])
    except InvalidInput:  # a reply, a status or a release
        return decode(payload, encoding, KINDS[vector["type"]])
    if vector["type"] == "HistoryPage":
        return decode(payload, encoding, HistoryPage)
    (message,) = NativeWire().decode(stream, SerializedSample(vector["key"], payload, encoding), "r1")
    return message


def is_accepted(title: str, payload: bytes) -> bool:
    try:
        decode(payload, encoding_of(KINDS[title]), KINDS[title])
    except MessageError as error:
        assert error.reason == "malformed", error
        return False
    return True


@pytest.mark.parametrize("vector", CANONICAL, ids=lambda vector: vector["name"])
def test_the_tables_of_the_page_give_the_bytes_of_a_vector(vector: Json):
    assert pack_fields(vector["type"], vector["fields"]).hex() == vector["hex"]


@pytest.mark.parametrize("vector", MESSAGES, ids=lambda vector: vector["name"])
def test_a_vector_is_decoded_to_its_fields_and_encoded_to_its_bytes(vector: Json):
    message = decoded(vector)
    assert type(message) is KINDS[vector["type"]]
    assert vector["encoding"] == encoding_of(type(message))
    assert shown_fields(message) == vector["fields"]
    assert (encode(message).hex() == vector["hex"]) is vector["canonical"]


@pytest.mark.parametrize("vector", REFUSALS, ids=lambda vector: vector["name"])
def test_a_reader_refuses_a_vector_for_its_reason(vector: Json):
    with pytest.raises(MessageError) as caught:
        decoded(vector)
    assert caught.value.reason == vector["reason"]


def test_every_message_has_a_section_a_table_of_its_fields_and_a_vector():
    titles = re.findall(
        r"^### (\w+)\n", PAGE.partition("\n## Messages\n")[2].partition("\n## ")[0], re.MULTILINE
    )
    assert sorted(titles) == sorted(TABLES)
    for title, kind in {**KINDS, "MotionOutcome": MotionOutcome}.items():
        assert tuple(TABLES[title]) == kind.__struct_fields__
    for title, kind in KINDS.items():
        assert section(title).startswith(f"\nEncoding `{encoding_of(kind)}`. ")
    assert {vector["type"] for vector in CANONICAL} == set(KINDS)
    assert len({vector["name"] for vector in (*MESSAGES, *REFUSALS)}) == len(MESSAGES) + len(REFUSALS)


@pytest.mark.parametrize("title", KINDS)
def test_missing_fields_have_the_defaults_of_the_page_and_nil_is_accepted_where_it_says_so(title: str):
    kind, fields = KINDS[title], list(TABLES[title].items())
    parts = [
        [pack_value(TABLES[title][name][0], value) for name, value in vector["fields"].items()]
        for vector in CANONICAL
        if vector["type"] == title
    ]
    for number, (name, (form, _)) in enumerate(fields):
        has_defaults = all(default != "-" for _, (_, default) in fields[number:])
        shorter = [pack_array(values[:number]) for values in parts]
        accepted = [payload for payload in shorter if is_accepted(title, payload)]
        assert bool(accepted) is has_defaults, name
        for payload in accepted:
            message = shown_fields(decode(payload, encoding_of(kind), kind))
            for later, (form_of, default) in fields[number:]:
                value = json.loads(default.replace("nil", "null"))
                assert message[later] == (str(value) if form_of in INTEGERS else value), later
        nils = [pack_array([*values[:number], b"\xc0", *values[number + 1 :]]) for values in parts]
        assert any(is_accepted(title, payload) for payload in nils) is form.endswith("?"), name


LARGEST = {"uint": 2**63 - 1, "session": 2**64 - 1, "ns": 2**63 - 1, "stamp": 2**63 - 1}
NARROWER = {
    "LaserScan": ("stamp", "ray_ns", "scan_ns"),
    "OccupancyGrid": ("width", "height"),
    "PointCloud": ("height", "width", "point_step", "row_step"),
    "CameraInfo": ("width", "height", "line_time_ns"),
}
"""Fields with limits that depend on others."""


def packed_with(kind: str, form: str, number: int) -> bytes | None:
    """A value of the type ``kind`` with ``number`` as its integer of the type ``form``; None without one."""
    values = {form: pack_int(number)}
    if form in ("session", "uint"):
        pair = pack_array([pack_int(number if form == part else 0) for part in ("session", "uint")])
        values |= {"id": pair, "id[]": pack_array([pair])}
    if form == "uint":
        values["map[uint]"] = pack_map({"old": number}, pack_int)
    return values.get(kind.removesuffix("?"))


@pytest.mark.parametrize("title", KINDS)
@pytest.mark.parametrize("form", LARGEST)
def test_integers_are_accepted_in_the_range_of_the_page_only(title: str, form: str):
    lowest, largest = -(2**63) if form == "stamp" else 0, LARGEST[form]
    numbers = {-(2**63), -1, 0, largest, min(largest + 1, 2**64 - 1), 2**64 - 1}
    for vector in (vector for vector in CANONICAL if vector["type"] == title):
        kinds = [TABLES[title][name][0] for name in vector["fields"]]
        parts = [
            pack_value(kind, value) for kind, value in zip(kinds, vector["fields"].values(), strict=True)
        ]
        for place, (name, kind) in enumerate(zip(vector["fields"], kinds, strict=True)):
            for number in numbers:
                if (packed := packed_with(kind, form, number)) is not None:
                    accepted = is_accepted(title, pack_array([*parts[:place], packed, *parts[place + 1 :]]))
                    is_allowed = lowest <= number <= largest
                    assert accepted <= is_allowed, (name, number)
                    assert accepted or not is_allowed or name in NARROWER.get(title, ()), (name, number)


def test_the_page_lists_every_stream_with_its_key_its_message_and_how_it_is_delivered():
    rows = {row[0].strip("`"): row for row in rows_of(section("Keys"))}
    for stream, kind in ((row.name, row.type) for row in all_streams()):
        ends = [f"/{stream}", *(f"/{stream}/<{name}>" for name in ("writer", "sensor", "identity"))]
        (row,) = (row for key, row in rows.items() if any(key.endswith(end) for end in ends))
        assert row[1].partition(" ")[0] == kind.__name__
        assert row[0].endswith(">`") is (is_named(stream))
        assert (row[2] == "latched") is (stream in {*latched_streams(), "driver", *STOP_STREAMS})
    assert f"\n{','.join(row.name for row in all_streams())}\n" in section("Liveliness tokens")


def test_the_digest_in_the_page_is_that_of_its_names():
    form = r"digest of `(.*?)` is that of the bytes `(.*?)`: `(.*?)`"
    names, payload, digest = re.findall(form, section("Framing").replace("\n", " "))[0]
    assert pack_value("str[]", json.loads(names)).hex(" ") == payload
    assert (
        order_digest(json.loads(names)).hex()
        == digest
        == blake2b(bytes.fromhex(payload), digest_size=8).hexdigest()
    )


def test_the_keys_of_the_page_are_those_of_the_code():
    rows = (*vars(keys).values(), SITE_TOKEN)
    forms = {one.form for one in rows if isinstance(one, keys.Key)} | {keys.CLOCK_KEY}
    streams = [row for row in own_streams() if row.name not in ("clock", *STOP_STREAMS)]
    forms |= {f"zstate/<robot>/{row.name}" + "/<writer>" * row.named for row in streams}
    page = [row[0].strip("`").replace("<sensor>", "<writer>") for row in rows_of(section("Keys"))[2:]]
    assert len(page) == len(set(page))
    assert set(page) == forms


def test_the_size_limits_of_the_page_are_those_of_the_code():
    limits: dict[str, int] = {}
    for names, limit in rows_of(section("Size limits"))[2:]:
        limits |= {name.strip("`"): int(limit) for name in names.split(", ")}
    single = {kind.__name__: kind.max_bytes for kind in MESSAGE_TYPES if kind.max_bytes}
    for stream, kind in ((row.name, row.type) for row in all_streams()):
        assert single.pop(kind.__name__, limits[stream]) == limits[stream]
    assert single[HistoryPage.__name__] > MAX_PAGE_BYTES  # the page is checked before it is decoded
    assert limits == {
        **{row.name: row.max_bytes for row in all_streams()},
        **single,
        HistoryPage.__name__: MAX_PAGE_BYTES,
    }


def parsed_key(key: str) -> Json | None:
    """The parts of a key as in the vectors; None if it is none of zstate."""

    def writer(robot: str, streams: tuple[StreamName, ...], identity: str) -> Json:
        announced = Announcement.parse_all(robot, streams, identity)
        names = [one.name for one in announced if one.name]
        return {"robot": robot, "streams": list(streams), "id": parts(announced[0].writer, *names[:1])}

    def parts(one: WriterId, name: str = "") -> Json:
        numbers = {"pid": str(one.pid), "since": str(one.since), "session": str(one.session)}
        return {"program": one.program, "host": one.host, **numbers, **({"name": name} if name else {})}

    def edge(robot: str, child: str, parent: str, identity: str) -> Json:
        one = Announcement.parse(robot, "transforms", identity)
        return {"robot": robot, "parent": parent, "child": child, "id": parts(one.writer, one.name)}

    forms: dict[str, Callable[[], Json]] = {
        "writer": lambda: writer(*keys.WRITER_TOKEN.parse(key)),
        "reader": lambda: writer(*keys.READER_TOKEN.parse(key)),
        "edge": lambda: edge(*keys.EDGE_TOKEN.parse(key)),
        "clock": lambda: owned(*keys.WRITER_CLOCK.parse(key)),
        "status": lambda: owned(*keys.STATUS.parse(key)),
        "release": lambda: owned(*keys.RELEASE.parse(key)),
        "motion": lambda: of_robot(*keys.MOTION.parse(key)),
        "lookup": lambda: of_robot(*keys.LOOKUP.parse(key)),
        "stream": lambda: stream(stream_of(key)),
    }

    def of_robot(robot: str) -> Json:
        return {"robot": robot}

    def owned(robot: str, identity: str) -> Json:
        return {"robot": robot, "id": parts(WriterId.parse(identity))}

    def stream(name: StreamName) -> Json:
        found: Json = {"stream": name}
        if name != "clock":
            found["robot"] = keys.robot_from_key(key)
        if is_named(name) and name not in STOP_STREAMS:
            found["name"] = NativeWire().edge_writer_name(key)
        return found

    for kind, parse in forms.items():
        try:
            return {"key": key, "kind": kind, **parse()}
        except InvalidInput:
            continue
    return None


@pytest.mark.parametrize("vector", vectors("keys.json"), ids=lambda vector: vector["key"])
def test_a_key_has_the_parts_of_its_vector_or_is_ignored(vector: Json):
    assert parsed_key(vector["key"]) == (vector if vector["kind"] else None)


POSES = json.loads((GOLDEN / "poses.json").read_text())


def test_joint_positions_give_the_poses_of_the_vectors_also_between_samples():
    model, truth = parse_urdf(POSES["urdf"], "poses.json"), MatrixKinematics(POSES["urdf"])
    columns = {joint: (model.columns[joint], len(names)) for joint, names in POSES["joints"].items()}
    assert list(POSES["joints"]) == list(model.joint_names)
    buffer = TransformBuffer(100.0)
    track = buffer.add_robot(model)
    for sample in POSES["samples"]:
        buffer.insert_joints(track, int(sample["stamp"]), sample["positions"])
    for case in POSES["cases"]:
        by_joint = {
            joint: np.array(case["positions"][first : first + count])
            for joint, (first, count) in columns.items()
        }
        for link, pose in case["poses"].items():
            expected = truth.root_from(link, by_joint)
            np.testing.assert_allclose(matrices(np.array([pose]))[0], expected, atol=1e-12)
            found = buffer.lookup(model.root, link, int(case["at"])).matrix
            np.testing.assert_allclose(found, expected, atol=1e-9)


def angle(positions: np.ndarray) -> float:
    """Of the floating joint of the vectors, whose rotations are all about z and below half a turn."""
    z, w = positions[-2:] * np.sign(positions[-1])
    return 2.0 * np.arctan2(z, w)


def turned(radians: float) -> tuple[float, float, float, float]:
    return 0.0, 0.0, np.sin(radians / 2), np.cos(radians / 2)


def test_positions_between_two_samples_follow_the_rules_of_the_page():
    first, second = (np.array(sample["positions"]) for sample in POSES["samples"])
    for case in POSES["cases"]:
        start, end = (int(sample["stamp"]) for sample in POSES["samples"])
        ratio = (int(case["at"]) - start) / (end - start)
        change = second - first
        wraps = [row for row, name in enumerate(POSES["coordinates"]) if name in ("wheel", "slide.yaw")]
        for row in wraps:
            if abs(change[row]) > np.pi and max(abs(first[row]), abs(second[row])) <= np.pi:
                change[row] -= np.copysign(2 * np.pi, change[row])
        expected = first + ratio * change
        expected[-4:] = turned(ratio * (angle(second) - angle(first)) + angle(first))
        np.testing.assert_allclose(case["positions"], expected, atol=1e-12)
