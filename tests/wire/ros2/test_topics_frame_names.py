import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from zstate.errors import InvalidInput
from zstate.wire.keys import full_name
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.topics import FrameNames

ROBOT = "r1"
PREFIXES = st.sampled_from(["", "r1/", "*/", "left_", "fleet/r1/", "*_"])
BARE = st.text("abr1_", min_size=1, max_size=8)
FULL = st.builds("/".join, st.lists(BARE, min_size=2, max_size=3))


def names(prefix: str = "", robot: str = ROBOT) -> FrameNames:
    return FrameNames(Ros2Options(frame_prefix=prefix), robot)


@pytest.mark.parametrize(
    ("prefix", "zstate", "ros"),
    [
        ("", "hand", "hand"),
        ("r1/", "hand", "r1/hand"),
        ("*_", "hand", "r1_hand"),
        ("", "fleet/map", "fleet/map"),
        ("r1/", "fleet/map", "fleet/map"),
        ("r1/", "ros/map", "map"),
        ("r1/", "r1/arm/hand", "r1/arm/hand"),
        ("left_", "r1/arm/hand", "left_arm/hand"),
    ],
)
def test_a_frame_has_one_name_on_each_side(prefix: str, zstate: str, ros: str):
    assert names(prefix).to_ros(zstate) == ros
    assert names(prefix).to_zstate(ros) == zstate


def test_a_full_name_of_the_robots_own_is_written_as_its_bare_name():
    assert names("left_").to_ros("r1/hand") == names("left_").to_ros("hand") == "left_hand"
    assert names().to_ros("r1/hand") == "hand"


def test_without_a_prefix_a_bare_name_is_the_robots_own():
    assert names().to_zstate("map") == "map"
    assert names().to_ros("ros/map") == "map"


@pytest.mark.parametrize("prefix", ["", "r1/", "left_"])
def test_leading_slash_of_a_frame_is_dropped_once_as_in_tf2(prefix: str):
    for ros in ("hand", "r1/hand", "left_hand", "fleet/map"):
        assert names(prefix).to_zstate(f"/{ros}") == names(prefix).to_zstate(ros)
    for no_name in ("/", "//hand"):
        with pytest.raises(InvalidInput, match="has a slash at its end"):
            full_name(ROBOT, names(prefix).to_zstate(no_name))


def test_root_namespace_robot_keeps_its_frames_separate_from_unowned_ones():
    shared = names("x_", robot="ros")
    assert shared.to_ros("hand") == "x_hand"
    assert shared.to_ros("ros/map") == "map"
    assert shared.to_zstate("map") == "ros/map"


@pytest.mark.parametrize("namespace", ["r1", "*"])
def test_the_shared_tf_of_robots_in_namespaces_keeps_their_prefixes(namespace: str):
    shared = FrameNames(Ros2Options(namespace=namespace, frame_prefix="r1/"), "ros")
    assert shared.to_zstate("r1/world") == "r1/world"
    assert shared.to_zstate("world") == "world"


def test_robots_with_namespaces_of_their_own_have_prefixes_of_their_own():
    each = FrameNames(Ros2Options(namespace="*"), "r1")
    assert (each.to_ros("hand"), each.to_zstate("r1/hand"), each.to_zstate("map")) == (
        "r1/hand",
        "hand",
        "ros/map",
    )
    apart = FrameNames(Ros2Options(namespace="*", tf="namespace"), "r1")
    assert (apart.to_ros("hand"), apart.to_zstate("hand")) == ("hand", "hand")


def test_a_name_that_is_only_the_prefix_names_no_frame_of_the_robot():
    assert names("left_").to_zstate("left_") == "ros/left_"
    assert names("r1/").to_zstate("r1/") == "r1/"


@given(prefix=PREFIXES, name=BARE | FULL)
def test_written_name_is_read_as_the_same_frame(prefix: str, name: str):
    both = names(prefix)
    own_prefix = prefix.replace("*", ROBOT)
    owner, slash, rest = name.partition("/")
    own = not slash or owner == ROBOT
    if own:
        assume(own_prefix or "/" not in rest)
    else:
        assume(not own_prefix or not name.startswith(own_prefix))
    assert full_name(ROBOT, both.to_zstate(both.to_ros(name))) == full_name(ROBOT, name)


@given(prefix=PREFIXES, name=BARE | FULL)
def test_read_name_is_written_as_the_same_name(prefix: str, name: str):
    both = names(prefix)
    own_prefix = prefix.replace("*", ROBOT)
    is_prefixed = bool(own_prefix) and name.startswith(own_prefix)
    assume(is_prefixed or name.partition("/")[0] != ROBOT or "/" not in name)
    assert both.to_ros(both.to_zstate(name)) == name


def test_edges_are_renamed_at_both_ends_and_cached():
    both = names("r1/")
    own = (("base", "arm"), ("fleet/map", "base"))
    written = (("r1/base", "r1/arm"), ("fleet/map", "r1/base"))
    assert both.edges_to_ros(own) == written
    assert both.edges_to_zstate(written) == own
    again = tuple((parent, child) for parent, child in own)
    assert both.edges_to_ros(again) is both.edges_to_ros(own)


def test_cache_of_edge_orders_is_limited():
    both = names("r1/")
    first = both.edges_to_ros((("base", "0"),))
    for number in range(1000):
        both.edges_to_ros((("base", str(number)),))
    assert both.edges_to_ros((("base", "0"),)) == first
    assert both.edges_to_ros((("base", "0"),)) is not first
