from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import InvalidInput
from zstate.model.joint_forms import edge_forms
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import DeclaredLimits, Joint, JointType, Mimic, RobotModel

Pose = tuple[float, float, float, float, float, float, float]
QUARTER = sin(pi / 4)
AT_REST: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
TURNED_ABOUT_Z: Pose = (1.0, 2.0, 3.0, 0.0, 0.0, QUARTER, QUARTER)


def joint(
    name: str,
    kind: JointType,
    parent: str,
    *,
    origin: Pose = TURNED_ABOUT_Z,
    axis: tuple[float, float, float] = (1.0, 0.0, 0.0),
    mimic: Mimic | None = None,
) -> Joint:
    return Joint(name, kind, parent, f"{name}_link", origin, axis, DeclaredLimits(), mimic)


def robot(*joints: Joint) -> RobotModel:
    return RobotModel("made", "root", ("root", *(j.child for j in joints)), joints, "")


def everything() -> RobotModel:
    slanted = tuple(np.array([1.0, -2.0, 0.5]) / np.sqrt(5.25))
    tilted: Pose = (0.1, -0.2, 0.3, 0.5, -0.5, 0.5, 0.5)
    return robot(
        joint("bolt", "fixed", "root"),
        joint("body", "floating", "bolt_link", origin=tilted),
        joint("hip", "revolute", "body_link", origin=tilted, axis=slanted),
        joint("sole", "planar", "hip_link", origin=tilted),
        joint("knee", "continuous", "hip_link", axis=slanted),
        joint("shin", "prismatic", "knee_link", origin=tilted, axis=slanted),
        joint("heel", "prismatic", "knee_link", axis=slanted, mimic=Mimic("shin", -2.0, 0.5)),
        joint("toe", "revolute", "knee_link", axis=slanted, mimic=Mimic("hip", 0.5, 0.1)),
    )


def random_positions(model: RobotModel, count: int, spread: float) -> np.ndarray:
    positions = np.random.default_rng(7).uniform(-spread, spread, (count, model.position_count))
    for one in model.driven_joints:
        if one.type == "floating":
            start = model.columns[one.name]
            quaternions = positions[:, start + 3 : start + 7]
            quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return positions


def matrix_of(pose: np.ndarray) -> np.ndarray:
    x, y, z, w = pose[3:]
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * (w * cross + cross @ cross)
    matrix[:3, 3] = pose[:3]
    return matrix


def only_pose(model: RobotModel, *positions: float) -> np.ndarray:
    (pose,) = JointTransforms(model).poses(np.array(positions, dtype=np.float64))
    return pose


def test_a_revolute_joint_turns_about_its_axis_in_the_frame_of_its_origin() -> None:
    # x of the joint is y of the parent: turning by a about x takes z of the child towards -y of the
    # joint, which is +x of the parent.
    pose = only_pose(robot(joint("hip", "revolute", "root")), 0.3)
    z_of_child = matrix_of(pose)[:3, 2]
    assert np.allclose(z_of_child, [sin(0.3), 0.0, cos(0.3)], atol=1e-15)
    assert pose[:3].tolist() == [1.0, 2.0, 3.0]


def test_a_prismatic_joint_moves_along_its_axis_in_the_frame_of_its_origin_without_rotation() -> None:
    pose = only_pose(robot(joint("shin", "prismatic", "root")), 0.25)
    assert np.allclose(pose, [1.0, 2.25, 3.0, 0.0, 0.0, QUARTER, QUARTER], atol=1e-15)


def test_a_planar_joint_moves_in_its_plane_first_and_then_turns() -> None:
    # Turned by 90 degrees about z: x of the joint is y of the parent, y is -x.
    pose = only_pose(robot(joint("sole", "planar", "root")), 0.5, 0.25, pi / 3)
    half = (pi / 2 + pi / 3) / 2
    assert np.allclose(pose, [0.75, 2.5, 3.0, 0.0, 0.0, sin(half), cos(half)], atol=1e-15)


def test_a_planar_joint_moves_in_the_x_y_plane_regardless_of_its_axis() -> None:
    (form,) = edge_forms(robot(joint("sole", "planar", "root", axis=(1.0, 0.0, 0.0))))
    assert form.axis == (0.0, 0.0, 1.0)


def test_a_floating_joint_is_its_origin_times_the_given_pose() -> None:
    given_pose = np.array([0.4, -0.3, 0.2, 0.5, 0.5, -0.5, 0.5])
    pose = only_pose(robot(joint("body", "floating", "root")), *given_pose)
    expected = matrix_of(np.array(TURNED_ABOUT_Z)) @ matrix_of(given_pose)
    assert np.allclose(matrix_of(pose), expected, atol=1e-15)


def test_a_floating_quaternion_that_is_nearly_of_unit_length_is_normalised() -> None:
    length = 1.0009
    pose = only_pose(robot(joint("body", "floating", "root", origin=AT_REST)), 0, 0, 0, 0, 0, 0, length)
    assert pose.tolist() == list(AT_REST)


@pytest.mark.parametrize("length", [0.0, 0.9, 1.0011, -2.0])
def test_a_floating_quaternion_far_from_unit_length_is_refused_by_name(length: float) -> None:
    model = robot(joint("bolt", "fixed", "root"), joint("body", "floating", "bolt_link"))
    table = JointTransforms(model)
    positions = np.array([[0, 0, 0, 0, 0, 0, 1.0], [0, 0, 0, 0, 0, 0, length]])
    with pytest.raises(InvalidInput, match=f"'bolt_link' -> 'body_link' .* length {abs(length):.6g};"):
        table.poses(positions)


def test_a_chain_of_mimics_is_multiplied_out() -> None:
    model = robot(
        joint("tip", "revolute", "root", mimic=Mimic("middle", -2.0, 0.25)),
        joint("middle", "prismatic", "root", mimic=Mimic("drive", 3.0, 0.5)),
        joint("drive", "revolute", "root"),
    )
    tip, middle, drive = edge_forms(model)
    # -2 (3 x + 0.5) + 0.25 = -6 x - 0.75
    assert (tip.scale, tip.shift, tip.column) == (-6.0, -0.75, 0)
    assert (middle.scale, middle.shift, middle.column) == (3.0, 0.5, 0)
    assert (drive.scale, drive.shift, drive.column) == (1.0, 0.0, 0)
    poses = JointTransforms(model).poses(np.array([0.1]))
    assert np.allclose(poses[0], only_pose(robot(joint("hip", "revolute", "root")), -1.35), atol=1e-15)
    assert np.allclose(poses[1], only_pose(robot(joint("shin", "prismatic", "root")), 0.8), atol=1e-15)


def test_forms_have_the_order_of_the_joints_and_their_columns() -> None:
    model = everything()
    forms = edge_forms(model)
    assert [(f.parent, f.child) for f in forms] == [(j.parent, j.child) for j in model.joints]
    # bolt none, body 7 (6 velocities), hip 1, sole 3, knee 1, shin 1; heel follows shin and toe hip.
    assert [f.column for f in forms] == [-1, 0, 7, 8, 11, 12, 12, 7]
    assert [f.velocity_column for f in forms] == [-1, 0, 6, 7, 10, 11, 11, 6]


def test_one_form_evaluated_by_its_formula_is_the_row_of_the_table() -> None:
    model = everything()
    (positions,) = random_positions(model, 1, 3.0)
    poses = JointTransforms(model).poses(positions)
    for form, pose in zip(edge_forms(model), poses, strict=True):
        if form.kind not in ("revolute", "prismatic"):
            continue
        x = form.scale * positions[form.column] + form.shift
        half = x / 2 if form.kind == "revolute" else 0.0
        rotation = np.array(form.q_cos) * cos(half) + np.array(form.q_sin) * sin(half)
        assert np.allclose(pose, [*(np.array(form.t0) + np.array(form.t1) * x), *rotation], atol=1e-15)


@given(st.floats(-1e6, 1e6))
def test_quaternions_are_of_unit_length_at_any_number_of_turns(angle: float) -> None:
    model = everything()
    positions = random_positions(model, 1, 1.0)[0]
    positions[7:] = angle
    poses = JointTransforms(model).poses(positions)
    assert np.abs(np.linalg.norm(poses[:, 3:], axis=1) - 1.0).max() < 1e-15


def test_a_batch_is_its_rows_one_by_one() -> None:
    model = everything()
    table = JointTransforms(model)
    positions = random_positions(model, 5, 4.0)
    batch = table.poses(positions)
    assert batch.shape == (5, 8, 7)
    assert np.allclose(batch, [table.poses(row) for row in positions], rtol=0.0, atol=1e-15)
    assert table.poses(positions[:0]).shape == (0, 8, 7)


def test_poses_are_written_into_out_and_positions_are_unchanged() -> None:
    model = everything()
    table = JointTransforms(model)
    (positions,) = random_positions(model, 1, 4.0)
    before = positions.copy()
    out = np.full((8, 7), np.nan)
    assert table.poses(positions, out) is out
    assert np.array_equal(out, table.poses(before))
    assert np.array_equal(positions, before)


def test_a_robot_that_cannot_move_has_its_fixed_edges_and_takes_no_numbers() -> None:
    pose = only_pose(robot(joint("bolt", "fixed", "root")))
    assert np.allclose(pose, TURNED_ABOUT_Z, rtol=0.0, atol=1e-15)
    assert JointTransforms(robot()).poses(np.empty(0)).shape == (0, 7)


@pytest.mark.parametrize("count", [0, 1, 50])
def test_the_extension_and_numpy_agree(count: int) -> None:
    model = everything()
    compiled, in_numpy = JointTransforms(model), JointTransforms(model)
    in_numpy._compiled = None
    positions = random_positions(model, count, 20.0)
    np.testing.assert_allclose(compiled.poses(positions), in_numpy.poses(positions), rtol=0.0, atol=3e-14)
    out = np.empty((len(model.joints), 14))[:, ::2]
    one = random_positions(model, 1, 3.0)[0]
    np.testing.assert_allclose(compiled.poses(one, out), in_numpy.poses(one), rtol=0.0, atol=3e-14)
