"""Independent kinematics for comparison: numpy and XML, without zstate."""

from math import cos, sin
from xml.etree import ElementTree

import numpy as np


def matrices(poses: np.ndarray) -> np.ndarray:
    cross = np.zeros((len(poses), 3, 3))
    x, y, z, w = poses[:, 3:].T
    cross[:, 2, 1], cross[:, 0, 2], cross[:, 1, 0] = x, y, z
    cross -= cross.transpose(0, 2, 1)
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[:, :3, :3] += 2 * (w[:, None, None] * cross + cross @ cross)
    result[:, :3, 3] = poses[:, :3]
    return result


def rotation_matrix(axis: np.ndarray, angle: float) -> np.ndarray:
    """The rotation about a unit axis as a 4 x 4 matrix, by Rodrigues' formula."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += sin(angle) * cross + (1 - cos(angle)) * cross @ cross
    return matrix


def translation_matrix(vector: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = vector
    return matrix


class MatrixKinematics:
    """Poses of links: 4 x 4 matrices from the XML, one link at a time."""

    def __init__(self, urdf: str) -> None:
        self.joints = {
            joint.get("name", ""): joint for joint in ElementTree.fromstring(urdf).findall("joint")
        }
        self.above = {joint.find("child").get("link"): joint for joint in self.joints.values()}

    def root_from(self, link: str, positions: dict[str, np.ndarray]) -> np.ndarray:
        joint = self.above.get(link)
        if joint is None:
            return np.eye(4)
        root_from_parent = self.root_from(joint.find("parent").get("link"), positions)
        return root_from_parent @ self.origin(joint) @ self.motion(joint, positions)

    def origin(self, joint: ElementTree.Element) -> np.ndarray:
        roll, pitch, yaw = self.vector(joint, "origin", "rpy", "0 0 0")
        x, y, z = np.eye(3)
        place = translation_matrix(self.vector(joint, "origin", "xyz", "0 0 0"))
        return place @ rotation_matrix(z, yaw) @ rotation_matrix(y, pitch) @ rotation_matrix(x, roll)

    def motion(self, joint: ElementTree.Element, positions: dict[str, np.ndarray]) -> np.ndarray:
        kind = joint.get("type")
        if kind == "fixed":
            return np.eye(4)
        numbers = self.numbers(joint, positions)
        if kind == "floating":
            return matrices(numbers[None])[0]
        if kind == "planar":
            return translation_matrix(np.array([*numbers[:2], 0.0])) @ rotation_matrix(
                np.array([0.0, 0.0, 1.0]), numbers[2]
            )
        axis = self.vector(joint, "axis", "xyz", "1 0 0")
        axis /= np.linalg.norm(axis)
        return (
            translation_matrix(axis * numbers[0])
            if kind == "prismatic"
            else rotation_matrix(axis, numbers[0])
        )

    def numbers(self, joint: ElementTree.Element, positions: dict[str, np.ndarray]) -> np.ndarray:
        mimic = joint.find("mimic")
        if mimic is None:
            return positions[joint.get("name")]
        master = self.numbers(self.joints[mimic.get("joint")], positions)
        return float(mimic.get("multiplier", "1")) * master + float(mimic.get("offset", "0"))

    @staticmethod
    def vector(joint: ElementTree.Element, tag: str, attribute: str, default: str) -> np.ndarray:
        element = joint.find(tag)
        text = default if element is None else element.get(attribute, default)
        return np.array([float(number) for number in text.split()])
