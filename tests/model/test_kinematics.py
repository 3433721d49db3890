import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from helpers.matrix_kinematics import MatrixKinematics, matrices
from helpers.model_samples import every_joint, local_model, random_positions, six_of

from zstate.errors import InvalidInput, ModelError
from zstate.model.kinematics import Kinematics, MovingEdges
from zstate.model.pinocchio_solver import PinocchioSolver
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf

TOLERANCE = 1e-12
UNUSABLE = {"ur3.urdf", "alex_psyonic_hands.urdf"}  # no links; mimics of joints that do not exist


# Every joint type, siblings out of alphabetical order, mimics before their masters, and names that
# Pinocchio or an XML writer would trip over.
def example_urdfs() -> list[Path]:
    """All robots of example-robot-data; none where it is not installed."""
    try:
        files = metadata.distribution("example-robot-data").files or []
    except metadata.PackageNotFoundError:
        return []
    found = (Path(str(file.locate())) for file in files if file.suffix == ".urdf")
    return sorted(path for path in found if path.name not in UNUSABLE)


def example(name: str) -> RobotModel:
    (path,) = (path for path in example_urdfs() if path.name == name)
    return parse_urdf(path.read_text(), name)


def by_name(model: RobotModel, positions: np.ndarray) -> dict[str, np.ndarray]:
    starts = [*model.columns.values(), model.position_count]
    return {
        name: positions[start:end]
        for name, start, end in zip(model.joint_names, starts[:-1], starts[1:], strict=True)
    }


def assert_agrees_with_matrices(model: RobotModel) -> None:
    kinematics, independent = Kinematics(model), MatrixKinematics(model.urdf)
    for seed in range(3):
        positions = random_positions(model, seed)
        named = by_name(model, positions)
        expected = {link: independent.root_from(link, named) for link in model.links}
        poses = matrices(kinematics.link_poses(positions))
        edges = matrices(kinematics.edge_poses(positions))
        assert np.allclose(poses, [expected[link] for link in model.links], rtol=0, atol=TOLERANCE)
        for (parent, child), edge in zip(kinematics.edges, edges, strict=True):
            assert np.allclose(expected[parent] @ edge, expected[child], rtol=0, atol=TOLERANCE), child


def plain_pinocchio(model: RobotModel, positions: np.ndarray) -> dict[str, np.ndarray]:
    """Poses of all links by the documented way: parse the text, read frame after frame by name."""
    import pinocchio as pin

    robot = pin.buildModelFromXML(model.urdf.removeprefix("\ufeff").strip(), False)
    data, q = robot.createData(), pin.neutral(robot)
    for joint in model.joints:
        if joint.type == "fixed":
            continue
        master = model.mimic_of(joint)
        angle = master.multiplier * positions[model.columns[master.joint]] + master.offset
        row = robot.idx_qs[robot.getJointId(joint.name)]
        if joint.type == "continuous":
            q[row : row + 2] = cos(angle), sin(angle)
        else:
            q[row] = angle
    pin.framesForwardKinematics(robot, data, q)
    return {link: data.oMf[robot.getFrameId(link, pin.BODY)].homogeneous for link in model.links}


@pytest.mark.robots
@pytest.mark.parametrize("path", six_of(example_urdfs(), lambda path: path.stem))
def test_poses_agree_with_pinocchios_plain_api(path: Path) -> None:
    model = parse_urdf(path.read_text(), path.name)
    kinematics = Kinematics(model)
    positions = random_positions(model, 1)
    expected = plain_pinocchio(model, positions)
    poses = matrices(kinematics.link_poses(positions))
    assert np.allclose(poses, [expected[link] for link in model.links], rtol=0, atol=TOLERANCE)
    edges = matrices(kinematics.edge_poses(positions))
    for (parent, child), edge in zip(kinematics.edges, edges, strict=True):
        assert np.allclose(expected[parent] @ edge, expected[child], rtol=0, atol=TOLERANCE), child


@pytest.mark.robots
@pytest.mark.parametrize("name", ["panda.urdf", "talos_full_v2.urdf", "tiago_dual.urdf"])
def test_poses_agree_with_matrices_multiplied_from_the_xml(name: str) -> None:
    assert_agrees_with_matrices(example(name))


def test_every_joint_type_agrees_with_matrices_multiplied_from_the_xml() -> None:
    assert_agrees_with_matrices(every_joint().model)


@pytest.mark.parametrize("name", ["rrbot", "diffbot", "gripper"])
def test_repository_robots_agree_with_matrices_multiplied_from_the_xml(name: str) -> None:
    assert_agrees_with_matrices(local_model(name).model)


def test_origins_move_by_their_jacobians_as_twists_state() -> None:
    kinematics, draw = every_joint(), np.random.default_rng(5)
    model = kinematics.model
    positions = random_positions(model, 7)
    reference = model.links[2]
    points, jacobians = kinematics.origins(model.links, positions, reference)
    poses = matrices(kinematics.link_poses(positions))
    reference_from_root = np.linalg.inv(poses[2])
    np.testing.assert_allclose(points, (reference_from_root @ poses)[:, :3, 3], atol=TOLERANCE)
    for _ in range(3):
        velocities = draw.normal(size=model.velocity_count)
        twists = [kinematics.twist(link, positions, velocities, reference)[:3] for link in model.links]
        np.testing.assert_allclose(jacobians @ velocities, twists, atol=1e-9)


def test_origins_of_a_robot_with_one_joint_have_one_column() -> None:
    text = """<robot name="one"><link name="root"/><link name="arm"/><link name="tip"/>
      <joint name="turn" type="continuous"><parent link="root"/><child link="arm"/><axis xyz="0 0 1"/></joint>
      <joint name="end" type="fixed"><parent link="arm"/><child link="tip"/><origin xyz="2 0 0"/></joint>
      </robot>"""
    kinematics = Kinematics(parse_urdf(text, "one.urdf"))
    points, jacobians = kinematics.origins(["tip"], np.array([np.pi / 2]), "root")
    # 2 m from the axis, on y: it moves to -x.
    np.testing.assert_allclose(points, [[0.0, 2.0, 0.0]], atol=TOLERANCE)
    np.testing.assert_allclose(jacobians, [[[-2.0], [0.0], [0.0]]], atol=TOLERANCE)


def test_a_thousand_turns_give_the_same_pose_as_none() -> None:
    kinematics = local_model("diffbot")
    turned = kinematics.link_poses([0.3 + 2000 * pi, -0.4 - 2000 * pi])
    # 2000 pi is rounded to 1e-12 of itself.
    assert np.allclose(matrices(turned), matrices(kinematics.link_poses([0.3, -0.4])), atol=2e-12)


def test_a_slightly_long_quaternion_is_normalised_for_links_too() -> None:
    kinematics = every_joint()
    positions = random_positions(kinematics.model, 6)
    scaled = positions.copy()
    scaled[3:7] *= 1.0005
    assert np.allclose(kinematics.link_poses(scaled), kinematics.link_poses(positions), atol=1e-13)


def test_a_quaternion_far_from_unit_length_is_refused() -> None:
    kinematics = every_joint()
    zeros = np.zeros(kinematics.model.position_count)
    for answer in (kinematics.edge_poses, kinematics.link_poses):
        with pytest.raises(InvalidInput, match=r"'universe' -> 'root_joint' .* length 0;"):
            answer(zeros)


def test_wrong_positions_are_refused_with_the_expected_count() -> None:
    kinematics = local_model("rrbot")
    for answer in (kinematics.edge_poses, kinematics.link_poses):
        with pytest.raises(InvalidInput, match="takes 2 positions"):
            answer([0.0])
        with pytest.raises(InvalidInput, match="'elbow' \\(nan\\)"):
            answer([0.0, float("nan")])
    with pytest.raises(InvalidInput, match="takes 2 velocities"):
        kinematics.twist("tool", [0.0, 0.0], [1.0])


def test_an_unknown_link_is_refused_with_a_near_miss() -> None:
    with pytest.raises(InvalidInput, match="no link 'camera_lnk'; did you mean 'camera_link'"):
        local_model("rrbot").twist("camera_lnk", [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InvalidInput, match="no link 'map'"):
        local_model("rrbot").twist("tool", [0.0, 0.0], [0.0, 0.0], "map")


def test_poses_are_written_into_out_which_must_fit() -> None:
    kinematics = local_model("rrbot")
    for answer, rows in ((kinematics.edge_poses, 6), (kinematics.link_poses, 7)):
        out = np.empty((rows, 7))
        assert answer([0.1, 0.2], out) is out
        assert np.array_equal(out, answer([0.1, 0.2]))
        for wrong in (np.empty((rows + 1, 7)), np.empty((2, rows, 7)), np.empty((rows, 7), np.float32)):
            with pytest.raises(InvalidInput, match=f"float64 of shape \\({rows}, 7\\)"):
                answer([0.1, 0.2], wrong)


def test_returned_arrays_are_not_reused() -> None:
    kinematics = local_model("rrbot")
    first = kinematics.link_poses([0.1, 0.2])
    kept = first.copy()
    kinematics.link_poses([1.1, -1.2])
    assert np.array_equal(first, kept)
    assert first.flags.c_contiguous


def test_threads_that_share_a_kinematics_get_correct_poses() -> None:
    kinematics = every_joint()
    questions = [random_positions(kinematics.model, seed) for seed in range(8)]
    alone = [kinematics.link_poses(question) for question in questions]

    def ask(index: int) -> bool:
        return all(np.array_equal(kinematics.link_poses(questions[index]), alone[index]) for _ in range(200))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(ask, range(8)))


def test_a_robot_of_one_link_has_one_pose_and_no_edges() -> None:
    kinematics = Kinematics(parse_urdf('<robot name="rock"><link name="rock"/></robot>', "rock"))
    assert kinematics.edges == ()
    assert kinematics.edge_poses([]).shape == (0, 7)
    assert kinematics.link_poses([]).tolist() == [[0, 0, 0, 0, 0, 0, 1]]
    assert kinematics.twist("rock", [], []).tolist() == [0] * 6


def test_edge_poses_need_no_pinocchio() -> None:
    program = (
        "import sys; from zstate.model.kinematics import Kinematics\n"
        "from zstate.model.urdf import parse_urdf\n"
        "Kinematics(parse_urdf(sys.stdin.read(), 'stdin')).edge_poses([0.1, 0.2])\n"
        "sys.exit('pinocchio' in sys.modules)"
    )
    urdf = local_model("rrbot").model.urdf
    assert subprocess.run([sys.executable, "-c", program], input=urdf, text=True, check=False).returncode == 0


def moving_poses(model: RobotModel, positions: np.ndarray) -> np.ndarray:
    """The closed forms of the edges that joints move."""
    moves = [joint.type != "fixed" for joint in model.joints]
    return Kinematics(model).edge_poses(positions)[moves]


@pytest.mark.robots
@pytest.mark.parametrize("path", six_of(example_urdfs(), lambda path: path.stem))
def test_moving_edges_of_every_robot_agree_with_the_closed_forms(path: Path) -> None:
    model = parse_urdf(path.read_text(), path.name)
    edges = MovingEdges(model)
    assert edges.engine.name.startswith("Pinocchio")
    for seed in range(3):
        positions = random_positions(model, seed)
        expected = matrices(moving_poses(model, positions))
        assert np.allclose(matrices(edges.poses(positions)), expected, rtol=0, atol=1e-12)


def test_moving_edges_of_every_joint_type_agree_with_the_closed_forms() -> None:
    model = every_joint().model
    edges = MovingEdges(model)
    moved = [(joint.parent, joint.child) for joint in model.joints if joint.type != "fixed"]
    assert [(form.parent, form.child) for form in edges.forms] == moved
    for seed in range(5):
        positions = random_positions(model, seed)
        expected = matrices(moving_poses(model, positions))
        assert np.allclose(matrices(edges.poses(positions)), expected, rtol=0, atol=TOLERANCE)


def test_moving_edges_normalise_a_slightly_long_quaternion_and_refuse_another() -> None:
    edges = MovingEdges(every_joint().model)
    positions = random_positions(every_joint().model, 6)
    scaled = positions.copy()
    scaled[3:7] *= 1.0005
    assert np.allclose(edges.poses(scaled), edges.poses(positions), rtol=0, atol=1e-13)
    scaled[3:7] *= 2.0
    with pytest.raises(InvalidInput, match="of length 2"):
        edges.poses(scaled)


def test_a_robot_without_moving_edges_has_no_poses() -> None:
    rock = parse_urdf('<robot name="rock"><link name="rock"/></robot>', "rock")
    assert MovingEdges(rock).poses(np.empty(0)).shape == (0, 7)


def test_moving_edges_come_from_the_closed_forms_without_pinocchio(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    model = every_joint().model
    edges = MovingEdges(model)
    assert edges.engine.name == "closed forms"
    assert "`pip install pin`" in edges.engine.reason
    positions = random_positions(model, 1)
    assert np.array_equal(edges.poses(positions), moving_poses(model, positions))


def test_a_joint_that_pinocchio_places_otherwise_is_named_at_opening(monkeypatch: pytest.MonkeyPatch) -> None:
    compute = PinocchioSolver.moving_edges

    def shifted(self: PinocchioSolver, positions: np.ndarray) -> np.ndarray:
        poses = compute(self, positions)
        poses[1, 2] += 2e-9
        return poses

    monkeypatch.setattr(PinocchioSolver, "moving_edges", shifted)
    with pytest.raises(ModelError, match=r"differ by 2e-09 at joint 'elbow' of 'rrbot'"):
        MovingEdges(local_model("rrbot").model)


def test_threads_that_share_moving_edges_get_correct_poses() -> None:
    edges = MovingEdges(every_joint().model)
    questions = [random_positions(every_joint().model, seed) for seed in range(8)]
    alone = [edges.poses(question) for question in questions]

    def ask(index: int) -> bool:
        return all(np.array_equal(edges.poses(questions[index]), alone[index]) for _ in range(200))

    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(ask, range(8)))
