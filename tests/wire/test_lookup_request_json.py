"""Transforms as JSON."""

from __future__ import annotations

import json

from zstate import Transform
from zstate.wire.lookup_request import to_json

HALF = 0.5**0.5


def test_a_transform_survives_json_with_every_nanosecond() -> None:
    transform = Transform(
        "world", "hand", (0.1, -2.0, 3e-9), (0.0, 0.0, HALF, HALF), stamp=1_790_000_000_123_456_789
    )
    copy = Transform.from_dict(json.loads(to_json(transform)))
    assert copy == transform
    assert copy.kind == "exact"
    assert copy.covariance is None
    covariance = [[float(row == column) for column in range(6)] for row in range(6)]
    known = Transform.from_dict(json.loads(to_json(transform.with_covariance(covariance)))).covariance
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
