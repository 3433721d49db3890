import pytest

from zstate.errors import InvalidInput
from zstate.wire.ros2.options import Ros2Options


def test_an_empty_text_gives_the_defaults_of_ros():
    for text in ("", "  "):
        assert Ros2Options.parse(text) == Ros2Options()
    defaults = Ros2Options()
    assert (defaults.domain, defaults.namespace, defaults.frame_prefix) == (0, "", "")
    assert (defaults.tf, defaults.hash, defaults.node) == ("global", "iron", "")


def test_every_option_can_be_written():
    text = "domain=5, namespace=/fleet/r1,frame_prefix=r1/,tf=namespace,hash=humble,node=arm_state"
    assert Ros2Options.parse(text) == Ros2Options(
        domain=5,
        namespace="fleet/r1",
        frame_prefix="r1/",
        tf="namespace",
        hash="humble",
        node="arm_state",
    )


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("namepsace=r1", "has no option 'namepsace'; did you mean 'namespace'? known: domain, namespace,"),
        ("colour=red", "has no option 'colour'; known: domain, namespace, frame_prefix, tf, hash, node"),
        ("domain", "'domain' is not written as key=value"),
        ("tf=global,tf=global", "'tf' is given twice"),
        ("domain=233", "domain is 233; allowed are whole numbers from 0 to 232"),
        ("domain=-1", "domain is '-1'; allowed are whole numbers from 0 to 232"),
        ("domain=", "domain is ''; allowed are whole numbers from 0 to 232"),
        ("domain=1.5", "domain is '1.5'"),
        ("tf=local", "tf is 'local'; allowed are 'global' and 'namespace'"),
        ("hash=jazzy", "hash is 'jazzy'; allowed are 'iron' and 'humble'"),
        ("node=my-node", "the node 'my-node' contains '-'"),
        ("frame_prefix=/r1/", "the frame_prefix '/r1/' begins with a slash"),
        ("frame_prefix=r 1/", "contains ' '"),
        ("frame_prefix=r1//", "contains '//'"),
    ],
)
def test_invalid_option_error_lists_allowed_values(text: str, problem: str):
    with pytest.raises(InvalidInput) as caught:
        Ros2Options.parse(text)
    assert problem in str(caught.value)


@pytest.mark.parametrize(
    ("namespace", "problem", "instead"),
    [
        ("arm-2.left", "'arm-2.left' contains '-' and '.'", "'arm_2_left'"),
        ("fleet/2nd", "'2nd' in 'fleet/2nd' begins with a digit", "'_2nd'"),
        ("fleet//r1", "'' in 'fleet//r1' is empty", "'r1'"),
        ("über", "'über' contains 'ü'", "'_ber'"),
        ("fleet/*", "'fleet/*' has a '*' within", "'*' alone"),
    ],
)
def test_invalid_namespace_error_suggests_a_valid_one(namespace: str, problem: str, instead: str):
    with pytest.raises(InvalidInput) as caught:
        Ros2Options(namespace=namespace)
    assert problem in str(caught.value)
    assert instead in str(caught.value)


@pytest.mark.parametrize("written", ["fleet/r1", "/fleet/r1", "/fleet/r1/"])
def test_a_namespace_is_one_with_and_without_outer_slashes(written: str):
    assert Ros2Options(namespace=written).robot_namespace("panda") == "fleet/r1"


def test_the_root_namespace_can_be_written_as_ros_does():
    assert Ros2Options(namespace="/") == Ros2Options()


def test_a_star_is_a_namespace_of_the_robots_own_name():
    options = Ros2Options(namespace="*")
    assert options.robot_namespace("panda") == "panda"
    with pytest.raises(InvalidInput) as caught:
        options.robot_namespace("arm-2")
    assert "the robot 'arm-2'" in str(caught.value)
    assert "contains '-'" in str(caught.value)
    assert "'arm_2'" in str(caught.value)


def test_a_star_in_the_frame_prefix_is_the_robots_name():
    assert Ros2Options(frame_prefix="*/").robot_frame_prefix("arm-2") == "arm-2/"
    assert Ros2Options(frame_prefix="left_").robot_frame_prefix("arm-2") == "left_"
    assert Ros2Options().robot_frame_prefix("arm-2") == ""


def test_a_name_that_no_robot_can_have_has_no_namespace_and_no_prefix():
    for options in (Ros2Options(), Ros2Options(namespace="*", frame_prefix="*/")):
        for name in ("*", "a/b", ""):
            with pytest.raises(InvalidInput, match="robot name"):
                options.robot_namespace(name)
            with pytest.raises(InvalidInput, match="robot name"):
                options.robot_frame_prefix(name)
