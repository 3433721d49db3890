import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from math import cos, pi, sin
from pathlib import Path

import numpy as np
import pytest
from matrix_kinematics import MatrixKinematics, matrices

from zstate.errors import InvalidInput
from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel
from zstate.model.urdf import parse_urdf

TOLERANCE = 1e-12
UNUSABLE = {"ur3.urdf", "alex_psyonic_hands.urdf"}  # no links; mimics of joints that do not exist

# Every joint type, siblings out of alphabetical order, mimics before their masters, and names that
# Pinocchio or an XML writer would trip over.
EVERY_JOINT = """<robot name="every joint">
  <link name="universe"/> <link name="root_joint"/> <link name="a &lt;b&gt; &quot;c&quot;"/>
  <link name="sole"/> <link name="knee"/> <link name="shin"/> <link name="heel"/> <link name="toe"/>
  <link name="nail"/>
  <joint name="zz body" type="floating"><parent link="universe"/><child link="root_joint"/>
    <origin xyz="0.1 0.2 0.3" rpy="0.4 -0.5 0.6"/></joint>
  <joint name="toe" type="revolute"><parent link="knee"/><child link="toe"/>
    <origin xyz="0.2 0 -0.1" rpy="1 0.2 0"/><axis xyz="0 0.6 0.8"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/>
    <mimic joint="nail" multiplier="0.5" offset="0.1"/></joint>
  <joint name="nail" type="continuous"><parent link="toe"/><child link="nail"/>
    <origin xyz="0.1 0 0"/><axis xyz="0 0 1"/><mimic joint="shin" multiplier="-1.5" offset="0.2"/></joint>
  <joint name="universe" type="revolute"><parent link="root_joint"/><child link="a &lt;b&gt; &quot;c&quot;"/>
    <origin xyz="0 0.3 0" rpy="0 0 1.2"/><axis xyz="0.6 0 -0.8"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
  <joint name="sole" type="planar"><parent link="root_joint"/><child link="sole"/>
    <origin xyz="0 0 -1" rpy="0.3 0.2 0.1"/><axis xyz="0 0 1"/></joint>
  <joint name="knee" type="continuous"><parent link="sole"/><child link="knee"/>
    <origin xyz="0 0.1 0" rpy="0 1 0"/><axis xyz="0 1 0"/></joint>
  <joint name="shin" type="prismatic"><parent link="knee"/><child link="shin"/>
    <origin xyz="0.5 0 0" rpy="0 0 0.7"/><axis xyz="0 0.8 0.6"/>
    <limit lower="-9" upper="9" effort="1" velocity="1"/></joint>
  <joint name="heel" type="fixed"><parent link="shin"/><child link="heel"/>
    <origin xyz="0 0 0.25" rpy="0.1 0.2 0.3"/></joint>
</robot>"""


def every_joint() -> Kinematics:
    return Kinematics(parse_urdf(EVERY_JOINT, "every_joint.urdf"))


def own(name: str) -> Kinematics:
    path = Path(__file__).parents[2] / "models" / f"{name}.urdf"
    return Kinematics(parse_urdf(path.read_text(), path.name))


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
    return parse_urdf(path.read_bytes(), name)


def random_positions(model: RobotModel, seed: int, spread: float = 20.0) -> np.ndarray:
    """Three turns either way and then some, with unit quaternions where a joint floats."""
    positions = np.random.default_rng(seed).uniform(-spread, spread, model.position_count)
    for start in floating_columns(model):
        positions[start + 3 : start + 7] /= np.linalg.norm(positions[start + 3 : start + 7])
    return positions


def floating_columns(model: RobotModel) -> Iterator[int]:
    return (model.columns[joint.name] for joint in model.driven_joints if joint.type == "floating")


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
@pytest.mark.parametrize("path", example_urdfs(), ids=lambda path: path.stem)
def test_poses_agree_with_pinocchios_plain_api(path: Path) -> None:
    model = parse_urdf(path.read_bytes(), path.name)
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
def test_our_own_robots_agree_with_matrices_multiplied_from_the_xml(name: str) -> None:
    assert_agrees_with_matrices(own(name).model)


def after(model: RobotModel, positions: np.ndarray, velocities: np.ndarray, seconds: float) -> np.ndarray:
    """Positions a moment later: numbers move by their rates, quaternions turn in the zero frame."""
    moved = positions.copy()
    for joint in model.driven_joints:
        start, rate = model.columns[joint.name], model.velocity_columns[joint.name]
        if joint.type != "floating":
            count = 3 if joint.type == "planar" else 1
            moved[start : start + count] += seconds * velocities[rate : rate + count]
            continue
        moved[start : start + 3] += seconds * velocities[rate : rate + 3]
        turned = seconds * velocities[rate + 3 : rate + 6]
        half = np.linalg.norm(turned) / 2
        dx, dy, dz, dw = *(turned / 2 * np.sinc(half / pi)), cos(half)
        x, y, z, w = positions[start + 3 : start + 7]
        moved[start + 3 : start + 7] = (
            dw * x + dx * w + dy * z - dz * y,
            dw * y + dy * w + dz * x - dx * z,
            dw * z + dz * w + dx * y - dy * x,
            dw * w - dx * x - dy * y - dz * z,
        )
    return moved


def slope(kinematics: Kinematics, link: str, reference: str, q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The twist by central difference of ``reference_from_link``."""
    model, step_s = kinematics.model, 1e-6

    def reference_from_link(seconds: float) -> np.ndarray:
        poses = matrices(kinematics.link_poses(after(model, q, v, seconds)))
        return np.linalg.inv(poses[model.links.index(reference)]) @ poses[model.links.index(link)]

    rate = (reference_from_link(step_s) - reference_from_link(-step_s)) / (2 * step_s)
    spin = rate[:3, :3] @ reference_from_link(0.0)[:3, :3].T
    return np.array([*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]])


@pytest.mark.parametrize("reference", ["universe", "sole", "nail"])
def test_a_twist_is_the_slope_of_the_pose(reference: str) -> None:
    kinematics = every_joint()
    model = kinematics.model
    positions = random_positions(model, 2, spread=2.0)
    velocities = np.random.default_rng(3).uniform(-1.0, 1.0, model.velocity_count)
    for link in model.links:
        twist = kinematics.twist(link, positions, velocities, reference)
        expected = slope(kinematics, link, reference, positions, velocities)
        # The difference of two poses a microsecond apart is good for eight digits.
        assert np.allclose(twist, expected, rtol=1e-7, atol=1e-7), link


def test_a_twist_is_seen_from_the_root_unless_a_reference_is_named() -> None:
    kinematics = every_joint()
    positions = random_positions(kinematics.model, 4)
    velocities = np.arange(1.0, kinematics.model.velocity_count + 1)
    seen = kinematics.twist("nail", positions, velocities)
    assert np.array_equal(seen, kinematics.twist("nail", positions, velocities, "universe"))


def test_the_twist_of_a_swinging_arm_is_that_of_the_textbook() -> None:
    kinematics = own("rrbot")
    shoulder, elbow, shoulder_rate, elbow_rate = 0.4, -1.1, 0.7, 0.2
    twist = kinematics.twist("tool", [shoulder, elbow], [shoulder_rate, elbow_rate])
    total, total_rate = shoulder + elbow, shoulder_rate + elbow_rate
    # x = 0.7 sin a + 0.6 sin(a + b), z = 1.05 + 0.7 cos a + 0.6 cos(a + b)
    x_rate = 0.7 * cos(shoulder) * shoulder_rate + 0.6 * cos(total) * total_rate
    z_rate = -0.7 * sin(shoulder) * shoulder_rate - 0.6 * sin(total) * total_rate
    assert np.allclose(twist, [x_rate, 0.0, z_rate, 0.0, total_rate, 0.0], atol=1e-14)


def test_velocities_of_a_floating_joint_are_in_the_axes_of_its_zero_frame() -> None:
    urdf = """<robot name="drone"><link name="map"/><link name="drone"/>
      <joint name="air" type="floating"><parent link="map"/><child link="drone"/></joint></robot>"""
    kinematics = Kinematics(parse_urdf(urdf, "drone"))
    half_turn_about_z = [5.0, 6.0, 7.0, 0.0, 0.0, 1.0, 0.0]
    velocities = [1.0, 2.0, 3.0, 0.1, 0.2, 0.3]
    assert np.allclose(kinematics.twist("drone", half_turn_about_z, velocities), velocities, atol=1e-15)


@pytest.mark.parametrize("link", ["root_joint", "nail"])
def test_a_link_stands_still_as_seen_from_itself(link: str) -> None:
    kinematics = every_joint()
    velocities = np.ones(kinematics.model.velocity_count)
    twist = kinematics.twist(link, random_positions(kinematics.model, 5), velocities, link)
    assert np.allclose(twist, np.zeros(6), atol=1e-14)


def test_a_thousand_turns_are_where_none_is() -> None:
    kinematics = own("diffbot")
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


def test_wrong_positions_are_refused_with_what_is_wanted() -> None:
    kinematics = own("rrbot")
    for answer in (kinematics.edge_poses, kinematics.link_poses):
        with pytest.raises(InvalidInput, match="takes 2 positions"):
            answer([0.0])
        with pytest.raises(InvalidInput, match="'elbow' \\(nan\\)"):
            answer([0.0, float("nan")])
    with pytest.raises(InvalidInput, match="takes 2 velocities"):
        kinematics.twist("tool", [0.0, 0.0], [1.0])


def test_an_unknown_link_is_refused_with_a_near_miss() -> None:
    with pytest.raises(InvalidInput, match="no link 'camera_lnk', did you mean 'camera_link'"):
        own("rrbot").twist("camera_lnk", [0.0, 0.0], [0.0, 0.0])
    with pytest.raises(InvalidInput, match="no link 'map'"):
        own("rrbot").twist("tool", [0.0, 0.0], [0.0, 0.0], "map")


def test_poses_are_written_into_out_which_must_fit() -> None:
    kinematics = own("rrbot")
    for answer, rows in ((kinematics.edge_poses, 6), (kinematics.link_poses, 7)):
        out = np.empty((rows, 7))
        assert answer([0.1, 0.2], out) is out
        assert np.array_equal(out, answer([0.1, 0.2]))
        for wrong in (np.empty((rows + 1, 7)), np.empty((2, rows, 7)), np.empty((rows, 7), np.float32)):
            with pytest.raises(InvalidInput, match=f"float64 of shape \\({rows}, 7\\)"):
                answer([0.1, 0.2], wrong)


def test_an_answer_is_the_callers_own() -> None:
    kinematics = own("rrbot")
    first = kinematics.link_poses([0.1, 0.2])
    kept = first.copy()
    kinematics.link_poses([1.1, -1.2])
    assert np.array_equal(first, kept)
    assert first.flags.c_contiguous


def test_threads_that_share_a_kinematics_get_their_own_answers() -> None:
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
    urdf = own("rrbot").model.urdf
    assert subprocess.run([sys.executable, "-c", program], input=urdf, text=True, check=False).returncode == 0
