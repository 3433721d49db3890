"""Lookups asked for by name."""

from __future__ import annotations

import json

import pytest

from zstate.errors import InFuture, InvalidInput
from zstate.wire.lookup_request import LookupRequest, error_to_json


def test_request_is_parsed_from_its_own_parameters():
    for asked in (LookupRequest("map", "r1/tool"), LookupRequest("a", "b", -5)):
        pairs = {"target": asked.target, "source": asked.source}
        pairs |= {} if asked.at is None else {"at": str(asked.at)}
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


FUTURE = InFuture("a", "b", edge=("a", "b"), requested=7, oldest=1, newest=3, rate_hz=100.0, writer="arm")


def test_an_error_in_json_names_its_class_its_text_and_its_facts():
    facts = json.loads(error_to_json(FUTURE))
    assert (facts["error"], facts["message"]) == ("InFuture", str(FUTURE))
    assert (facts["edge"], facts["requested"], facts["newest"]) == (["a", "b"], 7, 3)
