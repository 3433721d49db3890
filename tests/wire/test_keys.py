from collections.abc import Callable
from contextlib import suppress

import pytest
import zenoh
from hypothesis import example, given
from hypothesis import strategies as st

from zstate.errors import InvalidInput
from zstate.net.sites import SITE_TOKEN
from zstate.wire import keys
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.native import NativeWire
from zstate.wire.ros2.wire import Ros2DdsWire, Ros2Wire

NUMBER = st.one_of(
    st.integers(-(2**70), 2**70).map(str), st.sampled_from(["1" * 5000, "9" * 20, "", "\u0661", "1_0", "nan"])
)
NAME = st.one_of(st.text(max_size=8), st.sampled_from(["*", "**", "@a", " ", "%", "%ff", "%2F", "a" * 9000]))
IDENTITY = st.builds(lambda *fields: ",".join(fields), NAME, NAME, NUMBER, NUMBER, NUMBER) | st.builds(
    lambda *fields: ",".join(fields), NAME, NAME, NUMBER, NUMBER, NUMBER, NAME
)
CHUNK = st.one_of(
    NAME,
    NUMBER,
    IDENTITY,
    st.sampled_from(
        [
            "zstate",
            "@writer",
            "@reader",
            "@clock",
            "@edge",
            "@site",
            "tf=5.0",
            "tf",
            "tf_static",
            "joint_states",
            "tf,tf_static",
        ]
    ),
    st.sampled_from(["@site", "tf=5.0", "tf=1e999", "none", "tf=x,imu=1.0"]),
    st.sampled_from(["@ros2_lv", "MP", "MS", "NN", "::,10:,:,:,,", f"::,{'1' * 5000}:,:,:,,", ":1:0:0,10"]),
)
FORMS = st.sampled_from(
    [
        *("zstate/{}/@writer/{}/{}", "zstate/@reader/{}/{}/{}", "zstate/{}/@clock/{}", "zstate/{}/status/{}"),
        "zstate/@site/{}/{}/{}",
        *(
            "zstate/{}/@edge/{}/{}/{}",
            "@ros2_lv/{}/{}/{}/{}/MP/{}/{}/{}/{}/{}/{}/{}",
            "@/{}/@ros2_lv/MP/{}/{}/{}",
        ),
    ]
)
TOKEN = st.builds(lambda form, chunks: form.format(*chunks), FORMS, st.lists(CHUNK, min_size=11, max_size=11))
PARSERS: tuple[Callable[[str], object], ...] = (
    keys.WRITER_TOKEN.parse,
    keys.READER_TOKEN.parse,
    keys.WRITER_CLOCK.parse,
    keys.EDGE_TOKEN.parse,
    SITE_TOKEN.parse,
    keys.robot_from_key,
    WriterId.parse,
    NativeWire().edge_writer_name,
)


@given(TOKEN | st.lists(CHUNK, max_size=8).map("/".join) | IDENTITY | st.text())
@example("zstate/evil/@writer/joint_states/p,h," + "1" * 5000 + ",1,1")
@example("zstate/evil/@writer/joint_states/p,h,1," + "1" * 30 + ",1")
@example("zstate/e vil/@writer/joint_states/p,h,1,1,1")
@example("zstate/*/joint_states")
def test_foreign_keys_raise_only_invalid_input(key: str):
    for parse in PARSERS:
        with suppress(InvalidInput):
            parse(key)
    for wire in (NativeWire(), Ros2Wire(), Ros2DdsWire()):
        for announced in wire.parse_token(key, "*"):
            assert keys.check_robot(announced.robot) == announced.robot
            assert 0 <= announced.writer.since < 2**63
            assert 0 <= announced.writer.session < 2**64


@given(TOKEN)
def test_announced_writer_has_valid_keys_of_its_own(key: str):
    found = NativeWire().parse_token(key, "*")
    if found:
        identity = max((one.identity for one in found), key=len)
        again = keys.WRITER_TOKEN.key(found[0].robot, [one.stream for one in found], identity)
        assert again == key
        assert Announcement.parse_all(*keys.WRITER_TOKEN.parse(again)) == found
    for announced in found:
        clock = keys.WRITER_CLOCK.key(announced.robot, announced.writer.identity)
        assert keys.WRITER_CLOCK.parse(clock) == (announced.robot, announced.writer.identity)


@pytest.mark.parametrize(
    "key",
    [
        *("zstate/*/joint_states", "zstate/r1*/tf", "zstate/r1/tf_static/*", "zstate/a b/tf", "zstate/@r/tf"),
        *("zstate/", f"zstate/{'a' * 256}/tf", f"zstate/r1/{'a' * 20_000}"),
    ],
)
def test_key_with_a_wildcard_or_invalid_robot_has_no_robot(key: str):
    with pytest.raises(InvalidInput) as caught:
        keys.robot_from_key(key)
    assert len(str(caught.value)) < 1000


def test_name_lengths_are_limited_as_in_file_systems():
    assert keys.check_robot("a" * 255) == "a" * 255
    with pytest.raises(InvalidInput, match="256 characters, more than 255"):
        keys.check_robot("a" * 256)
    assert keys.full_name("r1", "a" * 1024) == "r1/" + "a" * 1024
    with pytest.raises(InvalidInput, match="more than 1024"):
        keys.full_name("r1", "a" * 1025)


def test_keys_have_at_most_16384_characters():
    writer = "a" * (16_384 - len("zstate/r1/@edge/b/c/"))
    assert keys.EDGE_TOKEN.parse(f"zstate/r1/@edge/b/c/{writer}") == ("r1", "b", "c", writer)
    with pytest.raises(InvalidInput, match="@edge"):
        keys.EDGE_TOKEN.parse(f"zstate/r1/@edge/b/c/{writer}a")


def test_no_robot_has_the_name_of_the_clock_whose_key_would_be_below_its_own():
    with pytest.raises(InvalidInput, match="the robot name 'clock' is that of the simulated time"):
        keys.stream_key("clock", "joint_states")
    with pytest.raises(InvalidInput):
        keys.robot_from_key("zstate/clock/joint_states")
    assert keys.stream_key("r1", "map", "clock") == "zstate/r1/map/clock"


def test_every_key_of_a_robot_lies_under_its_own_prefix():
    assert keys.stream_key("panda", "joint_states") == "zstate/panda/joint_states"
    assert keys.stream_key("panda", "tf") == "zstate/panda/tf"
    assert keys.stream_key("panda", "tf_static", "mount") == "zstate/panda/tf_static/mount"
    assert keys.stream_key("panda", "robot_description") == "zstate/panda/robot_description"
    assert keys.stream_key("panda", "joint_commands") == "zstate/panda/joint_commands"
    assert keys.stream_key("panda", "joint_setpoints") == "zstate/panda/joint_setpoints"
    assert keys.stream_key("panda", "scan", "front") == "zstate/panda/scan/front"
    assert keys.stream_key("hall", "map", "map") == "zstate/hall/map/map"
    assert keys.stream_key("r1", "imu", "imu") == "zstate/r1/imu/imu"
    assert keys.stream_key("r1", "velocity", "wheels") == "zstate/r1/velocity/wheels"
    assert keys.STOP.key("r1", "x") == "zstate/r1/stop/x"
    assert keys.RELAX.key("r1", "x") == "zstate/r1/relax/x"
    assert keys.stream_key("r1", "pose", "mocap") == "zstate/r1/pose/mocap"
    assert keys.stream_key("r1", "fix", "gps") == "zstate/r1/fix/gps"
    assert keys.stream_key("r1", "pressure", "bmp") == "zstate/r1/pressure/bmp"
    assert keys.stream_key("r1", "datum", "map") == "zstate/r1/datum/map"
    assert keys.stream_key("r1", "magnetic_field", "mag") == "zstate/r1/magnetic_field/mag"
    assert keys.stream_key("r1", "odometry", "odometry") == "zstate/r1/odometry/odometry"
    assert keys.LOOKUP.key("panda") == "zstate/panda/lookup"
    assert keys.WRITER_TOKEN.key("panda", "tf", "x") == "zstate/panda/@writer/tf/x"
    token = keys.WRITER_TOKEN.key("panda", ["tf", "joint_states"], "x")
    assert token == "zstate/panda/@writer/joint_states,tf/x"
    assert keys.CLOCK_KEY == "zstate/clock"


def test_expression_matches_one_robot_or_all_and_every_static_writer():
    assert keys.stream_expression("panda", "joint_states") == "zstate/panda/joint_states"
    assert keys.stream_expression("*", "joint_states") == "zstate/*/joint_states"
    assert keys.stream_expression("*", "tf_static") == "zstate/*/tf_static/*"
    assert keys.stream_expression("panda", "scan") == "zstate/panda/scan/*"
    assert keys.stream_expression("*", "map") == "zstate/*/map/*"
    assert keys.WRITER_TOKEN.expression("panda") == "zstate/panda/@writer/*/*"
    assert keys.WRITER_TOKEN.expression("*") == "zstate/*/@writer/*/*"


@pytest.mark.parametrize("robot", ["panda", "*", "%2A", "a@b", "über"])
def test_reader_key_is_outside_of_robots_and_names_robot_and_stream(robot: str):
    key = keys.READER_TOKEN.key(robot, "joint_states", "x")
    assert key.startswith("zstate/@reader/")
    assert "*" not in key
    assert keys.READER_TOKEN.parse(key) == (robot, ("joint_states",), "x")


@pytest.mark.parametrize("streams", ["tf,joint_states", "tf,tf", "tf,", ",", "tf, tf_static", "tf,songs"])
def test_the_streams_of_a_token_have_one_canonical_form(streams: str):
    for key in (f"zstate/r1/@writer/{streams}/x", f"zstate/@reader/r1/{streams}/x"):
        parse = keys.WRITER_TOKEN.parse if "@writer" in key else keys.READER_TOKEN.parse
        with pytest.raises(InvalidInput, match="in the order joint_states"):
            parse(key)


@pytest.mark.parametrize(
    "key", ["zstate/panda/@writer/tf/x", "zstate/@reader/panda/x", "zstate/@reader/panda/tf/x/y"]
)
def test_other_keys_are_not_parsed_as_readers(key: str):
    with pytest.raises(InvalidInput, match="@reader"):
        keys.READER_TOKEN.parse(key)


@pytest.mark.parametrize("edge", [("r1/tool", "r1/camera"), ("map", "@a*$#? /b"), ("r1/tool", "röbi/hand")])
def test_an_edge_that_is_being_placed_is_found_by_its_child(edge: tuple[str, str]):
    parent, child = edge
    key = keys.EDGE_TOKEN.key("r1", child, parent, "x")
    assert keys.EDGE_TOKEN.parse(key) == ("r1", child, parent, "x")
    assert zenoh.KeyExpr(keys.EDGE_TOKEN.expression(child=child)).includes(zenoh.KeyExpr(key))
    assert not zenoh.KeyExpr(keys.EDGE_TOKEN.expression(child=child + "2")).intersects(zenoh.KeyExpr(key))


@pytest.mark.parametrize("key", ["zstate/r1/@edge/a/b", "zstate/r1/@writer/a/b/x", "r1/zstate/@edge/a/b/x"])
def test_other_keys_are_not_parsed_as_edges(key: str):
    with pytest.raises(InvalidInput, match="@edge"):
        keys.EDGE_TOKEN.parse(key)


@pytest.mark.parametrize(
    "name",
    [
        "",
        "a/b",
        "/a",
        "*",
        "a*",
        "$*",
        "a$b",
        "a?",
        "a#",
        "@a",
        "a b",
        "a\tb",
        "a\n",
        "a\x00",
        "a\u2028b",
        "\x7f",
    ],
)
def test_a_robot_or_writer_name_that_is_not_one_chunk_is_refused_by_name(name: str):
    for use in (
        keys.check_robot,
        keys.check_writer,
        keys.LOOKUP.key,
        lambda n: keys.stream_key(n, "tf"),
        lambda n: keys.stream_key("panda", "tf_static", n),
    ):
        with pytest.raises(InvalidInput) as caught:
            use(name)
        assert repr(name) in str(caught.value)
        assert "letters, digits" in str(caught.value)


@pytest.mark.parametrize("name", [None, 5, b"panda", ["panda"], 0.0])
def test_a_robot_or_writer_name_that_is_not_text_is_refused_with_its_type(name):
    with pytest.raises(InvalidInput, match=f"robot name is text; got .* of type {type(name).__name__}"):
        keys.stream_key(name, "tf")
    with pytest.raises(InvalidInput, match=f"writer name is text; got .* of type {type(name).__name__}"):
        keys.stream_key("panda", "tf_static", name)


@pytest.mark.parametrize("name", ["panda", "r1", "arm-2.left", "über", "a@b", "stop"])
def test_ordinary_names_are_unchanged(name: str):
    assert keys.check_robot(name) == name


def test_star_is_not_a_robot_for_writing():
    with pytest.raises(InvalidInput):
        keys.stream_key("*", "joint_states")


def test_the_robot_of_a_key_is_its_second_chunk():
    assert keys.robot_from_key("zstate/panda/tf_static/mount") == "panda"
    for stranger in ("zstate/clock", "ros/panda/tf", "zstate//tf", ""):
        with pytest.raises(InvalidInput, match="not of the form"):
            keys.robot_from_key(stranger)


def test_a_bare_frame_gets_its_robot_and_a_full_name_stays():
    assert keys.full_name("r1", "odom") == "r1/odom"
    assert keys.full_name("r1", "fleet/map") == "fleet/map"
    for bad in ("", "/odom", "odom/"):
        with pytest.raises(InvalidInput, match="'robot/frame'"):
            keys.full_name("r1", bad)


@pytest.mark.parametrize("frame", ["a\nb", "\x1b[2J", "rb/a\x9b", "a\u202eb"])
def test_a_frame_name_with_control_characters_is_refused(frame: str):
    with pytest.raises(InvalidInput, match="control characters"):
        keys.full_name("r", frame)


@given(
    NAME.filter(bool),
    st.dictionaries(st.sampled_from(["tf", "joint_states", "battery"]), st.floats(1e-3, 1e6)),
    st.lists(NAME, min_size=1, unique=True),
)
def test_the_token_of_a_site_has_its_rates_and_robots(
    site: str, rates_hz: dict[str, float], robots: list[str]
):
    try:
        for name in (site, *robots):
            keys.check_robot(name)
    except InvalidInput:
        return
    token = SITE_TOKEN.key(site, rates_hz, robots)
    assert SITE_TOKEN.parse(token) == (site, rates_hz, tuple(robots))


@pytest.mark.parametrize("rates", ["", "tf", "tf=0", "tf=nan", "tf=inf", "tf=-1.0", "=1.0", "a b=1.0"])
def test_a_token_of_a_site_with_unusable_rates_is_refused(rates: str):
    with pytest.raises(InvalidInput, match="list of rates"):
        SITE_TOKEN.parse(f"zstate/@site/plant1/{rates}/r1")
