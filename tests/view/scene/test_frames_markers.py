"""Trails: lines through the recent positions of frames."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, handles, snapshot, tree  # noqa: E402

from zstate.view.scene.scene import Scene  # noqa: E402

TREE = tree({"map": None, "cart/base": "map", "cart/wheel": "cart/base"})


@pytest.fixture
def scene(server) -> Scene:
    return Scene(server)


def the_trail(server) -> list[list[float]]:
    """The positions along the trail."""
    (line,) = handles(server, viser.LineSegmentsHandle).values()
    begins, ends = line.points[:, 0], line.points[:, 1]
    long = np.linalg.norm(ends - begins, axis=1) > 0.0
    assert np.array_equal(begins[1:], ends[:-1])
    return [begins[long][0].tolist(), *ends[long].tolist()] if long.any() else []


def moved(x: float, seconds: float):
    return snapshot(TREE, {"cart/base": at(x, 0, 0)}, stamp=round(seconds * 1e9))


def test_trail_passes_through_the_positions_of_its_frame(scene, server):
    scene.set_trail("cart/base", True)
    for k in range(4):
        scene.show(moved(k, 0.1 * k), "map")
    assert the_trail(server) == [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]
    scene.set_trail("cart/base", False)
    assert handles(server, viser.LineSegmentsHandle) == {}


def test_trail_does_not_grow_while_its_frame_rests(scene, server):
    scene.set_trail("cart/base", True)
    for k in range(20):
        scene.show(moved(0.0, 0.1 * k), "map")
    assert the_trail(server) == []


@pytest.mark.parametrize("jump_s", [-5.0, 60.0])
def test_trail_restarts_when_time_jumps(scene, server, jump_s):
    scene.set_trail("cart/base", True)
    for k in range(4):
        scene.show(moved(k, 100.0 + 0.1 * k), "map")
    scene.show(moved(7.0, 100.0 + jump_s), "map")
    scene.show(moved(8.0, 100.1 + jump_s), "map")
    assert the_trail(server) == [[7, 0, 0], [8, 0, 0]]


def test_trail_restarts_with_another_fixed_frame(scene, server):
    scene.set_trail("cart/base", True)
    scene.show(moved(0.0, 0.0), "map")
    scene.show(moved(1.0, 0.1), "map")
    scene.show(moved(2.0, 0.2), "cart/wheel")
    assert the_trail(server) == []


def test_trail_of_an_unknown_frame_is_not_an_error(scene):
    scene.set_trail("ghost", True)
    scene.show(moved(0.0, 0.0), "map")
    scene.set_trail("ghost", False)
