"""RobotMeshes and InstancedMeshes: identical robots are instances, drawn where single robots would be."""

from __future__ import annotations

import numpy as np
import pytest

viser = pytest.importorskip("viser")

from helpers.scene_drawing import at, drawn, handles, is_visible, pose_in_fixed, sent_messages, snapshot, tree  # noqa: E402

from zstate import se3  # noqa: E402
from zstate.model.geometry import Box, MeshFile, Shape, Sphere  # noqa: E402
from zstate.model.urdf import parse_urdf  # noqa: E402
from zstate.view.scene.scene import Scene  # noqa: E402

CART = parse_urdf('<robot name="cart"><link name="base"/></robot>', "cart.urdf")
ORIGIN = (0.1, 0.2, 0.3, *se3.quaternion_from_rpy(0.4, 0.5, 0.6))
SHAPES = (Shape("base", "visual", ORIGIN, Box((1, 2, 3))), Shape("base", "collision", ORIGIN, Sphere(1.0)))
NAMES = [f"r{k}" for k in range(5)]
TREE = tree({"map": None} | {f"{name}/base": "map" for name in NAMES})
POSES = {f"{name}/base": at(k, -k, 0, 0.3 * k) for k, name in enumerate(NAMES)}


def scene_with(server, names, shapes=SHAPES, base=None) -> Scene:
    scene = Scene(server)
    for name in names:
        scene.set_robot(name, CART, shapes, base)
    drawn(scene, snapshot(TREE, POSES))
    return scene


def nodes(server) -> list:
    return [handle for handle in handles(server, viser.BatchedGlbHandle).values() if handle.visible]


def seen(server) -> set[tuple[float, ...]]:
    """The corner (1, 1, 1) of every visible instance in the fixed frame, as the browser computes it."""
    corners: set[tuple[float, ...]] = set()
    for node in nodes(server):
        poses = zip(node.batched_positions, node.batched_wxyzs, node.batched_scales, strict=True)
        for position, (qw, qx, qy, qz), scale in poses:
            if scale.any():
                turned = se3.rotate((qx, qy, qz, qw), tuple(scale.tolist()))
                corner = np.array(node.scale) * (position + turned)
                corners.add(tuple(np.round(corner, 4).tolist()))
    return corners


def corners_of(names, scale=(1, 1, 1)) -> set[tuple[float, ...]]:
    """The same corners by the definition of the poses."""
    places = [se3.compose(POSES[f"{name}/base"], ORIGIN) for name in names]
    corners = [se3.compose(place, (*scale, 0, 0, 0, 1))[:3] for place in places]
    return {tuple(np.round(corner, 4).tolist()) for corner in corners}


def test_few_identical_robots_are_drawn_one_by_one(server):
    scene_with(server, NAMES[:3])
    assert nodes(server) == []
    assert len(handles(server, viser.GlbHandle)) == 3


def test_many_identical_robots_share_one_node_for_each_shape(server):
    scene_with(server, NAMES)
    assert len(nodes(server)) == 1
    assert handles(server, viser.GlbHandle) == {}
    assert seen(server) == corners_of(NAMES)


def test_robots_with_different_shapes_are_not_instanced(server):
    scene = scene_with(server, NAMES[:3])
    scene.set_robot("r3", CART, SHAPES[:1])
    drawn(scene, snapshot(TREE, POSES))
    assert nodes(server) == []


def test_mirrored_mesh_is_mirrored_in_its_instances(server, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box().export(tmp_path / "box.stl")
    scale = (1.0, -2.0, 0.5)
    mesh = Shape("base", "visual", ORIGIN, MeshFile("box.stl", scale))
    scene_with(server, NAMES, (mesh,), tmp_path)
    assert seen(server) == corners_of(NAMES, scale)


def test_one_message_moves_a_shape_of_all_robots(server):
    scene = scene_with(server, NAMES)
    scene.axes = False
    scene.show(snapshot(TREE, POSES), "map")
    with sent_messages(server) as messages:
        scene.show(snapshot(TREE, POSES), "map")
        assert messages == []
        scene.show(snapshot(TREE, POSES | {f"{name}/base": at(5, 5, 5, 1) for name in NAMES}), "map")
    assert len(messages) == 1


def test_instances_are_added_and_removed_with_their_robots(server):
    scene = scene_with(server, NAMES[:4])
    scene.set_robot("r4", CART, SHAPES)
    drawn(scene, snapshot(TREE, POSES))
    assert seen(server) == corners_of(NAMES)
    for name in NAMES[:4]:
        scene.remove_robot(name)
    drawn(scene, snapshot(TREE, POSES))
    assert seen(server) == corners_of(["r4"])
    scene.remove_robot("r4")
    scene.show(snapshot(TREE, POSES), "map")
    assert nodes(server) == []


def test_stale_instance_is_drawn_in_grey(server):
    scene = scene_with(server, NAMES)
    (own,) = nodes(server)
    scene.set_stale("r2", "silent for 3 s")
    drawn(scene, snapshot(TREE, POSES))
    assert np.count_nonzero(own.batched_scales.any(axis=1)) == 4
    assert seen(server) == corners_of(NAMES)
    assert [label.text for label in handles(server, viser.LabelHandle).values()] == ["r2: silent for 3 s"]
    scene.set_stale("r2", None)
    scene.show(snapshot(TREE, POSES), "map")
    assert np.count_nonzero(own.batched_scales.any(axis=1)) == 5


def test_instance_without_a_pose_is_hidden(server):
    scene = scene_with(server, NAMES)
    scene.show(snapshot(TREE, POSES, unknown=["r1/base"]), "map")
    assert seen(server) == corners_of([name for name in NAMES if name != "r1"])


def test_instance_without_frames_is_hidden(server):
    scene = scene_with(server, NAMES)
    few = tree({"map": None, "r0/base": "map"})
    scene.show(snapshot(few, POSES), "map")
    assert seen(server) == corners_of(["r0"])
    scene.show(snapshot(TREE, POSES), "map")
    assert seen(server) == corners_of(NAMES)


def test_collisions_of_instances_are_drawn_on_request(server):
    scene = scene_with(server, NAMES)
    scene.visuals, scene.collisions = False, True
    drawn(scene, snapshot(TREE, POSES))
    assert len(nodes(server)) == 2
    assert seen(server) == corners_of(NAMES)
    scene.collisions = False
    scene.show(snapshot(TREE, POSES), "map")
    assert seen(server) == set()


def test_missing_files_are_listed_for_each_instance(server):
    lost = (*SHAPES, Shape("base", "visual", ORIGIN, MeshFile("package://nowhere/a.stl")))
    scene = scene_with(server, NAMES, lost)
    for name in NAMES:
        ((uri, why),) = scene.missing_meshes(name)
        assert uri == "package://nowhere/a.stl"
        assert "no package 'nowhere'" in why


def test_sixth_instance_uses_the_capacity_of_five(server):
    """Five instances have capacity for eight: the nodes stay."""
    names = [f"r{k}" for k in range(6)]
    grown = tree({"map": None} | {f"{name}/base": "map" for name in names})
    scene = scene_with(server, NAMES)
    scene.set_robot("r5", CART, SHAPES)
    drawn(scene, snapshot(grown, POSES | {"r5/base": at(9, 9)}))
    place = se3.compose(se3.compose(at(9, 9), ORIGIN), (1, 1, 1, 0, 0, 0, 1))[:3]
    assert seen(server) == corners_of(NAMES) | {tuple(np.round(place, 4).tolist())}


def test_instances_are_kept_for_a_new_tree_of_the_same_frames(server):
    """As after a restart of a publisher, or an update of a static edge."""
    scene = scene_with(server, NAMES)
    again = tree({"map": None} | {f"{name}/base": "map" for name in NAMES})
    scene.show(snapshot(again, POSES), "map")
    assert seen(server) == corners_of(NAMES)


KINDS = [SHAPES, (*SHAPES, Shape("base", "visual", at(2), Box((1, 1, 1)))), SHAPES[:1], ()]
ROBOTS = [f"r{k}" for k in range(9)]


class RandomChanges:
    """Random changes of the robots in a scene, and the expected pose of each shape."""

    def __init__(self, server, seed: int) -> None:
        self.random = np.random.default_rng(seed)
        self.server = server
        self.scene = Scene(server)
        self.kinds: dict[str, tuple[Shape, ...]] = {}
        self.parents: dict[str, str | None] = dict.fromkeys(ROBOTS, "map")
        self.poses = {f"{name}/base": at(k, -k, 0, 0.3 * k) for k, name in enumerate(ROBOTS)}
        self.poses["dock"] = at(0, 0, 7, 1.0)
        self.absent: set[str] = set()
        self.unknown: set[str] = set()
        self.tree = self._tree()

    def step(self) -> None:
        """Apply one random change, and draw."""
        name = ROBOTS[self.random.integers(len(ROBOTS))]
        actions = [
            self._add_robot,
            self._add_robot,
            self._remove_robot,
            self._renew_tree,
            self._move,
            self._change_parent,
        ]
        actions += [
            self._toggle_frames,
            self._toggle_samples,
            self._set_stale,
            self._set_options,
            self._set_trail,
        ]
        actions[self.random.integers(len(actions))](name)
        drawn(self.scene, self.snapshot())
        self.placed = self.scene.show(self.snapshot(), "map")

    def snapshot(self):
        stamp = int(self.random.integers(3)) * 400_000_000
        return snapshot(self.tree, self.poses, stamp, [f"{name}/base" for name in self.unknown])

    def expected(self) -> list[tuple[float, ...]]:
        """The pose of every visual, by the definition of the poses."""
        places: list[tuple[float, ...]] = []
        for name, shapes in self.kinds.items():
            unknown = name in self.unknown and self.parents[name] is not None
            if not self.scene.visuals or name in self.absent or unknown:
                continue
            base = self.poses[f"{name}/base"]
            if self.parents[name] is None:
                base = tuple(self.placed[self.tree.index[f"{name}/base"]].tolist())
            base = se3.compose(self.poses["dock"], base) if self.parents[name] == "dock" else base
            places += [se3.compose(base, shape.origin) for shape in shapes if shape.role == "visual"]
        return sorted(corner_of(place) for place in places)

    def found(self) -> list[tuple[float, ...]]:
        """The pose of every visual that was sent to the browser."""
        alone = [
            pose_in_fixed(self.server, path)
            for path in handles(self.server, viser.GlbHandle)
            if not path.rpartition("/")[2].startswith("c") and is_visible(self.server, path)
        ]
        batches = handles(self.server, viser.BatchedGlbHandle).items()
        for node in [node for path, node in batches if not path.rpartition("/")[2].startswith("c")]:
            poses = zip(node.batched_positions, node.batched_wxyzs, node.batched_scales, strict=True)
            alone += [(*xyz, *wxyz[1:], wxyz[0]) for xyz, wxyz, scale in poses if scale.any()]
        return sorted(corner_of(place) for place in alone)

    def _tree(self):
        frames = {"map": None, "dock": "map"}
        frames |= {f"{one}/base": self.parents[one] for one in ROBOTS if one not in self.absent}
        return tree(frames)

    def _add_robot(self, name: str) -> None:
        self.kinds[name] = KINDS[min(self.random.geometric(0.6), len(KINDS)) - 1]
        self.scene.set_robot(name, CART, self.kinds[name])
        self.absent.discard(name)
        self.tree = self._tree()

    def _remove_robot(self, name: str) -> None:
        self.kinds.pop(name, None)
        self.scene.remove_robot(name)

    def _renew_tree(self, _: str) -> None:
        self.tree = self._tree()

    def _move(self, name: str) -> None:
        self.poses[f"{name}/base"] = at(*self.random.normal(size=4))

    def _change_parent(self, name: str) -> None:
        self.parents[name] = (None, "map", "dock")[self.random.integers(3)]
        self.tree = self._tree()

    def _toggle_frames(self, name: str) -> None:
        self.absent ^= {name}
        self.tree = self._tree()

    def _toggle_samples(self, name: str) -> None:
        self.unknown ^= {name}

    def _set_stale(self, name: str) -> None:
        self.scene.set_stale(name, "silent" if self.random.random() < 0.5 else None)

    def _set_options(self, _: str) -> None:
        for what in ("visuals", "collisions", "axes", "names", "parent_lines"):
            setattr(self.scene, what, bool(self.random.random() < 0.7))

    def _set_trail(self, name: str) -> None:
        self.scene.set_trail(f"{name}/base", bool(self.random.random() < 0.5))


def corner_of(pose) -> tuple[float, ...]:
    """The point (1, 1, 1) of a pose: the same for both signs of a quaternion."""
    corner = se3.compose(tuple(map(float, pose)), (1, 1, 1, 0, 0, 0, 1))[:3]
    return tuple((np.round(corner, 3) + 0.0).tolist())


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.soak) for seed in range(2, 8))]
)
@pytest.mark.long
def test_each_robot_is_drawn_once_at_its_pose_after_random_changes(server, seed: int):
    changes = RandomChanges(server, seed)
    for step in range(150):
        changes.step()
        np.testing.assert_allclose(changes.found(), changes.expected(), atol=2e-3, err_msg=f"step {step}")
