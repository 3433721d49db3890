"""TreeLayout: unconnected robots are drawn next to each other, with labels that mark them."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, handles, is_visible, snapshot, tree  # noqa: E402

from zstate.view.scene.scene import Scene  # noqa: E402

NAMES = [f"bot{k}" for k in range(1, 12)]
BOTS = tree(
    {
        f"{name}/{link}": f"{name}/base" if link == "tool" else None
        for name in NAMES
        for link in ("base", "tool")
    }
)
REACH = {f"{name}/tool": at(0.3 * k, 0.0, 0.5) for k, name in enumerate(NAMES)}


@pytest.fixture
def scene(server) -> Scene:
    return Scene(server)


def labels(server) -> set[str]:
    return {
        label.text for path, label in handles(server, viser.LabelHandle).items() if is_visible(server, path)
    }


def middles(placed) -> dict[str, np.ndarray]:
    return {name: placed[BOTS.index[f"{name}/base"], :3] for name in NAMES}


def test_unconnected_robots_are_drawn_out_of_reach_of_each_other(scene, server):
    shown = snapshot(BOTS, REACH)
    placed = scene.show(shown, "bot1/base")
    assert np.isfinite(placed).all()
    reach = {name: float(np.linalg.norm(REACH[f"{name}/tool"][:3])) for name in NAMES}
    found = middles(placed)
    assert found["bot1"] == pytest.approx((0, 0, 0))
    for one in NAMES:
        for other in NAMES[: NAMES.index(one)]:
            apart = np.abs(found[one] - found[other])[:2].max()
            assert apart > reach[one] + reach[other]
    expected = {f"{name} (position unknown)" for name in NAMES[1:]} | {"bot1"}
    assert labels(server) == expected
    # The snapshot is unchanged: their relative poses stay unknown.
    assert np.isnan(shown.poses_in("bot1/base")[2:]).all()


def test_trees_are_ordered_by_the_numbers_in_their_names(scene):
    found = middles(scene.show(snapshot(BOTS, REACH), "bot1/base"))
    places = [(-round(x, 6), round(y, 6)) for x, y, _ in found.values()]
    assert places == sorted(places)


def test_trees_keep_their_places_while_robots_move_and_samples_are_missing(scene):
    before = middles(scene.show(snapshot(BOTS, REACH), "bot1/base"))
    version = scene.layout.version
    moved = REACH | {"bot7/tool": at(9.0)}
    for shown in (
        snapshot(BOTS, moved),
        snapshot(BOTS, REACH, unknown=["bot5/tool"]),
        snapshot(
            tree(
                {
                    name: BOTS.names[p] if p >= 0 else None
                    for name, p in zip(BOTS.names, BOTS.parents, strict=True)
                }
            ),
            REACH,
        ),
    ):
        after = middles(scene.show(shown, "bot1/base"))
        assert {name: place.tolist() for name, place in after.items()} == {
            name: place.tolist() for name, place in before.items()
        }
    assert scene.layout.version == version


def test_every_tree_is_drawn_on_the_floor_of_the_fixed_frame(scene):
    """A walker with its root at the hip next to an arm with its root at the floor."""
    two = tree({"arm/base": None, "arm/tip": "arm/base", "walker/hip": None, "walker/foot": "walker/hip"})
    shown = snapshot(two, {"arm/tip": at(z=1.0), "walker/foot": at(z=-0.9)})
    assert scene.show(shown, "arm/base")[3, 2] == pytest.approx(0.0)
    assert scene.show(shown, "walker/hip")[0, 2] == pytest.approx(-0.9)


def test_trees_are_placed_for_a_moving_fixed_frame(scene):
    two = tree({"a/base": None, "a/tool": "a/base", "b/base": None})
    at_base = scene.show(snapshot(two, {}), "a/base")[2, :3]
    seen = scene.show(snapshot(two, {"a/tool": at(1.0, 0.0, 0.0, np.pi / 2)}), "a/tool")[2, :3]
    x, y, z = at_base
    assert seen == pytest.approx((y, -(x - 1.0), z))


def test_connected_robot_is_at_its_pose_without_a_label(scene, server):
    apart = tree({"a/base": None, "b/base": None})
    scene.show(snapshot(apart, {}), "a/base")
    assert labels(server) == {"a", "b (position unknown)"}
    joined = tree({"a/base": None, "b/base": "a/base"})
    placed = scene.show(snapshot(joined, {"b/base": at(4.0)}), "a/base")
    assert placed[1, :3] == pytest.approx((4, 0, 0))
    assert labels(server) == set()
