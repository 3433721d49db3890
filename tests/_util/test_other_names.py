"""Names of tf2, and of other folders, in the errors of attributes that do not exist."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable
from pkgutil import resolve_name

import pytest

import zstate
from zstate._util.other_names import TF2_CLASSES
from zstate._util.tf2_methods import TF2_METHODS


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("Buffer", "tf2's Buffer is zstate.TransformBuffer here"),
        ("TransformBroadcaster", "tf2's TransformBroadcaster is zstate.TransformPublisher here"),
        ("TransformException", "tf2's TransformException is zstate.LookupFailed here"),
        ("StaticTransformBroadcaster", "tf2's StaticTransformBroadcaster is zstate.StaticPublisher here"),
        ("LookupException", "tf2's LookupException is zstate.UnknownFrame here"),
        ("ExtrapolationException", "tf2's ExtrapolationException is zstate.InFuture or zstate.InPast here"),
        ("Commander", "it is zstate.driving.Commander"),
        ("DriverHost", "it is zstate.driving.DriverHost"),
        ("StampedMessage", "it is zstate.streams.StampedMessage"),
        ("JointSource", "it is zstate.sources.JointSource"),
        ("MessageError", "it is zstate.errors.MessageError"),
    ],
)
def test_error_of_a_missing_name_says_where_it_is(name: str, text: str) -> None:
    with pytest.raises(AttributeError) as caught:
        getattr(zstate, name)
    assert str(caught.value) == f"module 'zstate' has no attribute {name!r}; {text}"
    assert not hasattr(zstate, name)
    assert name not in dir(zstate)


@pytest.mark.parametrize("name", ["Bufer", "__wrapped__", "_private", "os"])
def test_other_missing_names_have_the_usual_error(name: str) -> None:
    with pytest.raises(AttributeError) as caught:
        getattr(zstate, name)
    assert str(caught.value) == f"module 'zstate' has no attribute {name!r}"


def test_importing_a_module_of_the_package_searches_for_no_name() -> None:
    code = "from zstate import extension, se3\nimport sys\nprint('zstate._util.other_names' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout == "False\n"


def test_python_suggests_the_most_similar_name() -> None:
    program = "import zstate; zstate.TransformListner"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "no attribute 'TransformListner'. Did you mean: 'TransformListener'?" in ended.stderr


def test_what_is_named_instead_exists() -> None:
    for instead in TF2_CLASSES.values():
        for name in instead.replace("zstate.", "").split(" or "):
            assert callable(resolve_name(f"zstate:{name}"))
    for instead in TF2_METHODS.values():
        assert callable(getattr(zstate.TransformBuffer, instead.partition("(")[0]))


def test_error_of_tf2s_methods_names_those_of_the_buffer() -> None:
    buffer = zstate.TransformBuffer()
    for name, text in (
        ("lookup_transform", "lookup(target, source, at)"),
        ("lookupTransform", "lookup(target, source, at)"),
        ("can_transform", "can_lookup("),
        ("set_transform", "insert("),
    ):
        with pytest.raises(AttributeError, match=f"no attribute {name!r}; tf2's {name} is ") as caught:
            getattr(buffer, name)
        assert text in str(caught.value)
        assert "integer nanoseconds" in str(caught.value)
        assert not hasattr(buffer, name)
        assert name not in dir(buffer)
    assert not hasattr(buffer, "lookup_tranform")


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_buffer_refuses_copies_with_its_own_reason(duplicate: Callable[[object], object]) -> None:
    with pytest.raises(TypeError, match="not copied or pickled"):
        duplicate(zstate.TransformBuffer())


def test_error_of_a_listener_names_the_methods_of_its_buffer(sessions) -> None:
    with zstate.TransformListener(sessions[0]) as listener:
        for name, text in (
            ("can_lookup", "it is buffer.can_lookup"),
            ("lookupTransform", "tf2's lookupTransform is buffer.lookup(target, source, at) here, with "),
        ):
            with pytest.raises(AttributeError, match="'TransformListener' object has no attribute") as caught:
                getattr(listener, name)
            assert f"{name!r}; {text}" in str(caught.value)
        assert not hasattr(listener, "bufer")
