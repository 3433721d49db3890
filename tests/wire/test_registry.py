"""Wires by the names that users give them."""

import pytest

from zstate.errors import InvalidInput
from zstate.wire.native import NativeWire
from zstate.wire.registry import get_wire
from zstate.wire.ros2.options import Ros2Options
from zstate.wire.ros2.wire import Ros2DdsWire, Ros2Wire


@pytest.fixture(autouse=True)
def no_domain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)


def options(name: str) -> Ros2Options:
    wire = get_wire(name)
    assert isinstance(wire, Ros2Wire)
    return wire.options


@pytest.mark.parametrize(
    ("name", "kind"), [("native", NativeWire), ("ros2", Ros2Wire), ("ros2dds", Ros2DdsWire)]
)
def test_get_wire_returns_a_new_instance_by_name(name: str, kind: type):
    one, other = get_wire(name), get_wire(name)
    assert type(one) is type(other) is kind
    assert one is not other
    assert one.name == name


def test_options_follow_a_colon():
    expected = Ros2Options(domain=5, namespace="r1", frame_prefix="r1/")
    assert options("ros2:domain=5,namespace=r1,frame_prefix=r1/") == expected
    assert options("ros2dds:namespace=r1") == Ros2Options(namespace="r1")
    assert options("ros2:") == options("ros2") == Ros2Options()


@pytest.mark.parametrize(
    ("name", "variable", "domain"),
    [
        ("ros2", "42", 42),
        ("ros2:namespace=r1", "42", 42),
        ("ros2:domain=7", "42", 7),
        ("ros2: domain = 7", "42", 7),
        ("ros2:namespace=r1,domain=0", "42", 0),
        ("ros2", "", 0),
        ("ros2:domain=7", "many", 7),
        ("native", "many", None),
    ],
)
def test_the_domain_is_that_of_the_environment_unless_given(monkeypatch, name, variable, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", variable)
    wire = get_wire(name)
    assert getattr(getattr(wire, "options", None), "domain", None) == domain


@pytest.mark.parametrize("variable", ["many", "233", "-1", "1.5", "5,namespace=r1"])
def test_invalid_domain_in_the_environment_names_the_variable(monkeypatch, variable: str):
    monkeypatch.setenv("ROS_DOMAIN_ID", variable)
    with pytest.raises(InvalidInput, match="ROS_DOMAIN_ID"):
        get_wire("ros2")


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("dds", "no wire 'dds'; known: 'native', 'ros2', 'ros2dds'"),
        ("", "no wire ''"),
        ("ROS2", "no wire 'ROS2'"),
        ("ros2 ", "no wire 'ros2 '"),
        ("native:domain=5", "no options"),
        ("native:", "no options"),
        ("ros2:domian=5", "did you mean 'domain'"),
        ("ros2:domain", "key=value"),
    ],
)
def test_unknown_wire_error_lists_known_wires(name: str, text: str):
    with pytest.raises(InvalidInput, match=text):
        get_wire(name)
