"""Transforms as JSON."""

from __future__ import annotations

import json

import pytest

from zstate import Transform
from zstate.errors import InvalidInput, MessageError
from zstate.wire.lookup_request import from_json, to_json

HALF = 0.5**0.5


def test_a_transform_survives_json_with_every_nanosecond() -> None:
    transform = Transform(
        "world", "hand", (0.1, -2.0, 3e-9), (0.0, 0.0, HALF, HALF), stamp=1_790_000_000_123_456_789
    )
    copy = from_json(to_json(transform))
    assert copy == transform
    assert copy.kind == "exact"
    assert copy.covariance is None
    covariance = [[float(row == column) for column in range(6)] for row in range(6)]
    known = from_json(to_json(transform.with_covariance(covariance))).covariance
    assert known is not None
    assert known.tolist() == covariance


def test_the_fields_have_the_names_of_the_constructor() -> None:
    fields = json.loads(to_json(Transform("a", "b", (1, 2, 3), (0, 0, 0, 1))))
    assert fields == {
        "target": "a",
        "source": "b",
        "stamp": None,
        "kind": "static",
        "translation": [1.0, 2.0, 3.0],
        "rotation": [0.0, 0.0, 0.0, 1.0],
    }


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (b'{"target": "a", "source": "b", "translation": [0, 0], "rotation": [0, 0, 0, 1]}', "translation"),
        (b'{"target": 1, "source": "b", "translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}', "target"),
        (b'{"source": "b", "translation": [0, 0, 0], "rotation": [0, 0, 0, 1]}', "target"),
        (b'{"targt": "a"}', "target"),
        (b"{", "truncated"),
        (b"\xff", "JSON"),
    ],
)
def test_malformed_transform_is_refused_with_the_field(text: bytes, named: str) -> None:
    with pytest.raises(MessageError, match=named):
        from_json(text)


def test_members_of_later_versions_are_ignored() -> None:
    transform = Transform("a", "b", (1, 2, 3), (0, 0, 0, 1))
    assert from_json(json.dumps({**json.loads(to_json(transform)), "session": 7})) == transform


def test_invalid_pose_is_refused_as_by_the_constructor() -> None:
    with pytest.raises(InvalidInput, match="length 2"):
        from_json('{"target": "a", "source": "b", "translation": [0, 0, 0], "rotation": [0, 0, 0, 2]}')
