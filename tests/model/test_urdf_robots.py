"""The robots of example-robot-data, read by us, by the bare standard library and by Pinocchio."""

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from helpers.model_samples import six_of

from zstate.errors import ModelError
from zstate.model.load import catalog, load_model

pytestmark = pytest.mark.robots

REFUSED = {"ur3.urdf", "alex_psyonic_hands.urdf"}


def files() -> list[Path]:
    panda = next((entry.path for entry in catalog() if entry.name == "panda"), None)
    return [] if panda is None else sorted(panda.parents[2].glob("**/*.urdf"))


def loads(path: Path) -> bool:
    try:
        return load_model(path).links != ()
    except ModelError:
        return False


FILES = files()


@pytest.fixture(autouse=True)
def _robots_installed() -> None:
    if not FILES:
        pytest.skip("example-robot-data is not installed")


def test_67_of_the_69_robots_load():
    assert (len(FILES), {path.name for path in FILES if not loads(path)}) == (69, REFUSED)


def test_each_refused_robot_has_the_expected_finding():
    named = {path.name: path for path in FILES}
    with pytest.raises(ModelError, match="the robot has no <link>"):
        load_model(named["ur3.urdf"])
    with pytest.raises(ModelError, match="'Left_index_q2' mimics 'index_q1', which does not exist"):
        load_model(named["alex_psyonic_hands.urdf"])


@pytest.mark.parametrize(
    "path", six_of([path for path in FILES if path.name not in REFUSED], lambda path: path.stem)
)
def test_an_independent_reading_finds_the_same_links_joints_and_velocities(path: Path):
    import pinocchio

    model = load_model(path)
    root = ET.parse(path).getroot()
    joints = [(joint, joint.find("parent"), joint.find("child")) for joint in root.findall("joint")]
    assert model.links == tuple(link.get("name") for link in root.findall("link"))
    assert [(joint.name, joint.type, joint.parent, joint.child) for joint in model.joints] == [
        (joint.get("name"), joint.get("type"), parent.get("link"), child.get("link"))
        for joint, parent, child in joints
        if parent is not None and child is not None
    ]
    moving = [joint for joint, _, _ in joints if joint.get("type") != "fixed"]
    mimics = [joint for joint in moving if joint.find("mimic") is not None]
    assert model.joint_names == tuple(joint.get("name") for joint in moving if joint not in mimics)
    oracle = pinocchio.buildModelFromXML(path.read_text(), mimic=False)
    assert model.velocity_count + len(mimics) == oracle.nv
