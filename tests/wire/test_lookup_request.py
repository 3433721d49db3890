"""Lookups asked for by name."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import Disconnected, InFuture, InvalidInput, NetworkError, UnknownFrame, Unreachable
from zstate.wire.lookup_request import LookupRequest, error_from_json, error_to_json


def test_request_is_parsed_from_its_own_parameters():
    for asked in (LookupRequest("map", "r1/tool"), LookupRequest("a", "b", -5)):
        pairs = dict(part.split("=") for part in asked.parameters().split(";"))
        assert LookupRequest.parse(pairs) == asked
        assert LookupRequest.parse({**pairs, "_anyke": ""}) == asked  # Zenoh's, for replies on any key


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({}, "needs the parameter 'target'"),
        ({"target": "a"}, "needs the parameter 'source'"),
        ({"target": "a", "source": ""}, "needs the parameter 'source'"),
        ({"target": "a", "source": "b", "time": "1"}, "no parameter 'time'"),
        ({"target": "a", "source": "b", "at": "now"}, "'at' is 'now'"),
        ({"target": "a", "source": "b", "at": ""}, "'at' is ''"),
        ({"target": "a", "source": "b", "at": "1.5"}, "'at' is '1.5'"),
        ({"target": "a", "source": "b", "at": "9" * 19}, "stamp"),
        ({"target": "a", "source": "b", "at": "9" * 30}, "'at' is '999"),
    ],
)
def test_a_bad_parameter_is_named(parameters: dict[str, str], text: str):
    with pytest.raises(InvalidInput, match=text):
        LookupRequest.parse(parameters)


@pytest.mark.parametrize("frame", ["", "a;b"])
def test_frame_that_cannot_be_in_a_selector_is_refused(frame: str):
    with pytest.raises(InvalidInput, match="cannot be looked up"):
        LookupRequest("a", frame).parameters()


FUTURE = InFuture("a", "b", edge=("a", "b"), requested=7, oldest=1, newest=3, rate_hz=100.0, writer="arm")
GONE = Disconnected("a", "b", roots=("map", "base"))
GONE.edge, GONE.writer, GONE.gone_s = ("map", "base"), "odom", 40.9


@pytest.mark.parametrize(
    "error",
    [
        FUTURE,
        GONE,
        UnknownFrame("a", "hnad", name="hnad", near_misses=("hand",), frame_count=3),
        InvalidInput("too few"),
        Unreachable("no answer", endpoints=("tcp/1.2.3.4:7447",)),
    ],
)
def test_an_error_keeps_its_class_its_text_and_its_facts(error):
    back = error_from_json(error_to_json(error))
    assert type(back) is type(error)
    assert str(back) == str(error)
    assert vars(back) == vars(error)


def test_missing_facts_of_an_older_version_give_a_network_error():
    facts = json.loads(error_to_json(GONE))
    del facts["gone_s"]
    back = error_from_json(json.dumps(facts).encode())
    assert isinstance(back, Disconnected)
    assert back.gone_s is None
    assert "taken away" not in str(back)


def test_an_error_in_json_names_its_class_its_text_and_its_facts():
    facts = json.loads(error_to_json(FUTURE))
    assert (facts["error"], facts["message"]) == ("InFuture", str(FUTURE))
    assert (facts["edge"], facts["requested"], facts["newest"]) == (["a", "b"], 7, 3)


@pytest.mark.parametrize(
    "text",
    [
        b"Timeout",
        b"[]",
        b'{"error": "InFuture", "message": "late"}',
        b'{"error": "LookupFailed", "message": "late"}',
        b'{"error": "duration_text", "message": "late"}',
        b'{"error": "SystemExit", "message": "late"}',
    ],
)
def test_any_other_reply_is_a_network_error_with_its_text(text: bytes):
    error = error_from_json(text)
    assert type(error) is NetworkError
    assert ("late" if b"late" in text else repr(text)) in str(error)


@given(st.binary(max_size=100))
def test_no_bytes_crash_the_reader_of_errors(text: bytes):
    assert str(error_from_json(text))
