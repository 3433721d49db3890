"""Forward kinematics by Pinocchio, the one file that loads it.

Pinocchio gets numbers, never names or text: its model is built joint by joint from the RobotModel, depth
first as its algorithms expect. Placements are read from its memory, because reading them one by one from
Python costs more than ten times what computing them does.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from random import Random
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zstate.checks import Floats
from zstate.errors import LibraryMissing, ModelError
from zstate.extension import kernel
from zstate.model.joint_forms import JointTransform
from zstate.model.joint_transforms import JointTransforms
from zstate.model.robot import RobotModel

if TYPE_CHECKING or kernel == "c":
    from zstate import _kernel

Indices = NDArray[np.int64]

_TOLERANCE = 1e-9
"""The largest difference of Pinocchio and closed forms [m], or of numbers of a unit quaternion."""

_SUPPORTED = "pip install 'pin>=4.1,<5'"
_REINSTALL = "pip install --force-reinstall"
_COMMANDS = {
    "gomp": "apt-get install libgomp1",
    "urdfdom": f"{_REINSTALL} 'cmeel-urdfdom>=6,<7'",
    "tinyxml2": f"{_REINSTALL} 'cmeel-tinyxml2>=11,<12'",
    "console_bridge": f"{_REINSTALL} 'cmeel-console-bridge>=1.0.2,<2'",
}
"""What installs a library that Pinocchio's wheel links; pyproject.toml has the same bounds."""


class Engine(NamedTuple):
    """What computes a publisher's transforms: "Pinocchio 4.1.0", or "closed forms".

    For closed forms in place of Pinocchio ``reason`` describes why, and ``command`` mends it.
    """

    name: str
    reason: str = ""
    command: str = ""


def select_engine() -> Engine:
    """The engine of publishers on this machine. Loads Pinocchio."""
    try:
        return pinocchio_engine(load_pinocchio())
    except LibraryMissing as error:
        return closed_forms(error)


def pinocchio_engine(pinocchio: Any) -> Engine:
    """The engine of a loaded Pinocchio."""
    return Engine(f"Pinocchio {pinocchio.__version__}")


def closed_forms(error: LibraryMissing) -> Engine:
    """The engine without Pinocchio, because of ``error``."""
    return Engine("closed forms", str(error), error.command)


def load_pinocchio() -> Any:
    """Pinocchio's module. Raises LibraryMissing."""
    try:
        import pinocchio  # noqa: PLC0415  # pyright: ignore[reportMissingTypeStubs] - readers do not need it
    except ImportError as error:
        command = _install_command(error)
        text = f"Pinocchio cannot be loaded: {error}; `{command}` installs what is missing"
        raise LibraryMissing(text, command=command) from error
    return pinocchio


def _install_command(error: ImportError) -> str:
    """The command that installs the library that the loader did not find."""
    if isinstance(error, ModuleNotFoundError) and error.name == "pinocchio":
        return "pip install pin"
    missing = re.search(r"lib(gomp|urdfdom|tinyxml2|console_bridge)\w*\.so", str(error))
    return _COMMANDS[missing[1]] if missing else f"{_REINSTALL} pin"


class PinocchioSolver:
    """Pinocchio's model and workspace of one robot. Not thread-safe.

    Frame i + 1 of Pinocchio is link i, frame 0 its universe, which is the root link. Continuous joints
    are ordinary revolute joints here: Pinocchio computes cosine and sine of any angle itself. The memory
    grows with the cube of the joint count: 8 MB at 44, 0.5 GB at 200, which is why ``load_model`` refuses
    larger robots. Positions have quaternions of unit length. Raises LibraryMissing.
    """

    def __init__(self, model: RobotModel, forms: tuple[JointTransform, ...]) -> None:
        self._pin = load_pinocchio()
        self.engine = pinocchio_engine(self._pin)
        self._model: Any = self._pin.Model()
        joints, parents = self._add_links(model, forms)
        rows = [
            (form, self._model.idx_qs[joint], self._model.idx_vs[joint]) for form, joint in joints.items()
        ]
        self._data: Any = self._model.createData()
        single = [row for row in rows if row[0].kind in ("revolute", "prismatic")]
        self._q_rows = np.array([q_row for _, q_row, _ in single], dtype=np.intp)
        self._v_rows = np.array([v_row for _, _, v_row in single], dtype=np.intp)
        self._columns = np.array([form.column for form, _, _ in single], dtype=np.intp)
        self._velocity_columns = np.array([form.velocity_column for form, _, _ in single], dtype=np.intp)
        self._scale = np.array([form.scale for form, _, _ in single])
        self._shift = np.array([form.shift for form, _, _ in single])
        self._planar = [row for row in rows if row[0].kind == "planar"]
        self._floating = [row for row in rows if row[0].kind == "floating"]
        # A configuration in which all placements differ, for the check of the memory layout.
        moved = self._pin.integrate(self._model, self._pin.neutral(self._model), np.full(self._model.nv, 0.1))
        self._pin.framesForwardKinematics(self._model, self._data, moved)
        self._velocity_count = model.velocity_count
        links = len(model.links)
        self._links = self._read(self._data.oMf, np.arange(1, links + 1), [self._pin.SE3.Identity()] * links)
        moving = [form for form in forms if form.kind != "fixed"]
        joint_rows = np.array([joints[form] for form in moving], dtype=np.int64)
        self._edges = self._read(self._data.liMi, joint_rows, [parents[form].inverse() for form in moving])

    def link_poses(self, positions: Floats, out: Floats) -> Floats:
        """``root_from_link`` of every link: (L, 7), written into ``out``."""
        self._pin.framesForwardKinematics(self._model, self._data, self._configuration(positions))
        return self._links.poses(out)

    def moving_edges(self, positions: Floats) -> Floats:
        """``parent_from_child`` of the edges that joints move, in the order of the forms: (M, 7)."""
        self._pin.forwardKinematics(self._model, self._data, self._configuration(positions))
        return self._edges.poses(np.empty((len(self._edges.rows), 7)))

    def twist(self, link: int, reference: int, positions: Floats, velocities: Floats) -> Floats:
        q, v = self._configuration(positions), self._velocity(positions, velocities)
        self._pin.forwardKinematics(self._model, self._data, q, v)
        linear, angular, root_from_link = self._motion(link)
        reference_linear, reference_angular, root_from_reference = self._motion(reference)
        lever = root_from_link.translation - root_from_reference.translation
        linear = linear - reference_linear - np.cross(reference_angular, lever)
        rotation = root_from_reference.rotation.T
        return np.concatenate((rotation @ linear, rotation @ (angular - reference_angular)))

    def origins(self, links: Sequence[int], reference: int, positions: Floats) -> tuple[Floats, Floats]:
        """The origins of links in the reference (k, 3), and their derivatives by velocities (k, 3, n).

        ``d/dt R^T (p - p_r) = R^T (v - v_r + [p - p_r] w_r)``, with the reference's p_r, R, v_r and w_r.
        """
        self._pin.computeJointJacobians(self._model, self._data, self._configuration(positions))
        own_velocities = self._velocity_jacobian(positions)
        origin, of_reference = self._jacobian(reference)
        points, jacobians = np.empty((len(links), 3)), np.empty((len(links), 3, own_velocities.shape[1]))
        for row, link in enumerate(links):
            placement, of_link = self._jacobian(link)
            lever = placement.translation - origin.translation
            points[row] = origin.rotation.T @ lever
            turned = self._pin.skew(lever) @ of_reference[3:]
            moved = origin.rotation.T @ (of_link[:3] - of_reference[:3] + turned)
            np.matmul(moved, own_velocities, out=jacobians[row])
        return points, jacobians

    def _jacobian(self, link: int) -> tuple[Any, Floats]:
        """The pose of a link in the root, and its Jacobian in the root's axes: (6, nv), linear first."""
        pose = self._pin.updateFramePlacement(self._model, self._data, link + 1).copy()
        axes = self._pin.LOCAL_WORLD_ALIGNED
        jacobian = self._pin.getFrameJacobian(self._model, self._data, link + 1, axes)
        return pose, jacobian.reshape(6, self._model.nv)  # Pinocchio makes one column a vector

    def _velocity_jacobian(self, positions: Floats) -> Floats:
        """``_velocity(positions, v)`` is this matrix times v: (nv, n)."""
        matrix = np.zeros((self._model.nv, self._velocity_count))
        matrix[self._v_rows, self._velocity_columns] = self._scale
        for form, _, row in self._planar:
            cos, sin = np.cos(positions[form.column + 2]), np.sin(positions[form.column + 2])
            columns = slice(form.velocity_column, form.velocity_column + 3)
            matrix[row : row + 3, columns] = (cos, sin, 0.0), (-sin, cos, 0.0), (0.0, 0.0, 1.0)
        for form, _, row in self._floating:
            turn = self._pin.XYZQUATToSE3(positions[form.column : form.column + 7]).rotation.T
            for part in (0, 3):
                column = form.velocity_column + part
                matrix[row + part : row + part + 3, column : column + 3] = turn
        return matrix

    def _motion(self, link: int) -> tuple[Floats, Floats, Any]:
        """Linear velocity of a link's origin, its angular velocity and its pose, in the root."""
        pose = self._pin.updateFramePlacement(self._model, self._data, link + 1).copy()
        axes = self._pin.LOCAL_WORLD_ALIGNED
        motion = self._pin.getFrameVelocity(self._model, self._data, link + 1, axes)
        return motion.linear.copy(), motion.angular.copy(), pose

    def _configuration(self, positions: Floats) -> Floats:
        q = np.empty(self._model.nq)
        q[self._q_rows] = positions[self._columns] * self._scale + self._shift
        for form, row, _ in self._planar:
            x, y, yaw = positions[form.column : form.column + 3].tolist()
            q[row : row + 4] = x, y, np.cos(yaw), np.sin(yaw)
        for form, row, _ in self._floating:
            q[row : row + 7] = positions[form.column : form.column + 7]
        return q

    def _velocity(self, positions: Floats, velocities: Floats) -> Floats:
        """Pinocchio's velocities: those of planar and floating joints are in the axes of the child."""
        v = np.empty(self._model.nv)
        v[self._v_rows] = velocities[self._velocity_columns] * self._scale
        for form, _, row in self._planar:
            x, y, yaw_rate = velocities[form.velocity_column : form.velocity_column + 3]
            yaw = positions[form.column + 2]
            cos, sin = np.cos(yaw), np.sin(yaw)
            v[row : row + 3] = cos * x + sin * y, cos * y - sin * x, yaw_rate
        for form, _, row in self._floating:
            pose = self._pin.XYZQUATToSE3(positions[form.column : form.column + 7])
            rates = velocities[form.velocity_column : form.velocity_column + 6]
            v[row : row + 6] = (rates.reshape(2, 3) @ pose.rotation).ravel()
        return v

    def _add_links(
        self, model: RobotModel, forms: tuple[JointTransform, ...]
    ) -> tuple[dict[JointTransform, int], dict[JointTransform, Any]]:
        """Add all joints and links to Pinocchio's model.

        Returns the ids of the joints that move, and the pose of each edge's parent in the joint that
        carries it.
        """
        pin, joint_ids, parents = self._pin, dict[JointTransform, int](), dict[JointTransform, Any]()
        below: defaultdict[str, list[JointTransform]] = defaultdict(list)
        for form in forms:
            below[form.parent].append(form)
        # For each link Pinocchio's joint that carries it, and the link's pose in that joint.
        placed: dict[str, tuple[int, Any]] = {model.root: (0, pin.SE3.Identity())}
        waiting = below[model.root].copy()
        while waiting:
            form = waiting.pop()
            waiting += below[form.child]
            joint_id, parents[form] = placed[form.parent]
            placement = parents[form] * pin.XYZQUATToSE3(np.array(form.origin))
            if form.kind != "fixed":
                if form.kind == "revolute":
                    joint = pin.JointModelRevoluteUnaligned(np.array(form.axis))
                elif form.kind == "prismatic":
                    joint = pin.JointModelPrismaticUnaligned(np.array(form.axis))
                else:
                    joint = pin.JointModelPlanar() if form.kind == "planar" else pin.JointModelFreeFlyer()
                joint_id = self._model.addJoint(joint_id, joint, placement, f"j{len(joint_ids)}")
                joint_ids[form], placement = joint_id, pin.SE3.Identity()
            placed[form.child] = joint_id, placement
        for row, link in enumerate(model.links):
            joint_id, placement = placed[link]
            self._model.addFrame(pin.Frame(f"l{row}", joint_id, 0, placement, pin.FrameType.BODY))
        return joint_ids, parents

    def _read(self, placements: Any, rows: Indices, parents: Sequence[Any]) -> _Placements:
        """A reader of ``parents * placements[rows]``. Raises LibraryMissing for another memory layout."""
        memory = np.lib.stride_tricks.as_strided(placements[0].rotation, (len(placements), 12), (96, 8))
        last = placements[len(placements) - 1]
        if not np.array_equal(memory[-1], _numbers(last)):
            raise LibraryMissing(
                f"{self.engine.name} has another memory layout than the releases that zstate reads; "
                f"`{_SUPPORTED}` installs one of these",
                command=_SUPPORTED,
            )
        return _Placements(memory, rows, np.array([_numbers(parent) for parent in parents]).reshape(-1, 12))


def compare_with_closed_forms(model: RobotModel, table: JointTransforms, solver: PinocchioSolver) -> None:
    """Compare the poses of both at the neutral and three random configurations.

    Raises ModelError, which names the joint, if they differ by more than 1e-9.
    """
    draw = Random(model.digest)
    rows = np.flatnonzero([form.kind != "fixed" for form in table.forms])
    for drawn in (model.neutral, *(_random_positions(model, draw) for _ in range(3))):
        positions = table.normalised(drawn)
        expected, poses = table.poses(positions).take(rows, axis=0), solver.moving_edges(positions)
        signs = np.sign(np.einsum("ij,ij->i", expected[:, 3:], poses[:, 3:]))
        poses[:, 3:] *= signs[:, None]
        differences = np.abs(poses - expected).max(axis=1, initial=0.0)
        if not (differences <= _TOLERANCE).all():
            row = int(differences.argmax())
            joint = model.joints[int(rows[row])].name
            raise ModelError(
                model.name,
                message=f"{solver.engine.name} and zstate's closed forms differ by {differences[row]:.3g} "
                f"at joint {joint!r} of {model.name!r}: {poses[row].tolist()} and "
                f"{expected[row].tolist()}; `{_SUPPORTED}` installs a release that zstate is tested with",
            )


def _random_positions(model: RobotModel, draw: Random) -> Floats:
    positions = np.array([draw.uniform(-3.0, 3.0) for _ in range(model.position_count)])
    for joint in model.driven_joints:
        if joint.type == "floating":
            start = model.columns[joint.name] + 3
            positions[start : start + 4] /= np.linalg.norm(positions[start : start + 4])
    return positions


class _Placements(NamedTuple):
    """Some of Pinocchio's placements, each multiplied by a constant parent.

    ``memory`` (n, 12) is a view of all placements, which are contiguous: the rotation by columns, then the
    translation. It keeps the workspace alive.
    """

    memory: Floats
    rows: Indices
    parents: Floats

    def poses(self, out: Floats) -> Floats:
        """``parents * placements`` of the rows as poses, written into ``out``."""
        if kernel == "c" and out.flags.c_contiguous:
            _kernel.placement_poses(self.memory, self.rows, self.parents, out)
            return out
        # Each row is a column of the rotation, the last one the translation: v^T R^T = (R v)^T.
        parents = self.parents.reshape(-1, 4, 3)
        moved = self.memory.take(self.rows, axis=0).reshape(-1, 4, 3) @ parents[:, :3]
        np.add(moved[:, 3], parents[:, 3], out=out[:, :3])
        _quaternions(moved[:, :3].reshape(-1, 9), out[:, 3:])
        return out


def _numbers(placement: Any) -> Floats:
    """The twelve numbers of a placement, as in memory."""
    return np.concatenate((placement.rotation.ravel("F"), placement.translation))


def _quaternion_products() -> tuple[Floats, Floats]:
    """``rotation @ matrix + offset`` is 4 q q^T for a rotation given as nine numbers by columns."""
    matrix = np.zeros((3, 3, 4, 4))
    offset = np.eye(4)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        matrix[i, i, range(4), range(4)] = -1.0
        matrix[i, i, (i, 3), (i, 3)] = 1.0
        matrix[i, j, (i, j), (j, i)] = matrix[j, i, (i, j), (j, i)] = 1.0
        matrix[i, j, k, 3] = matrix[i, j, 3, k] = 1.0
        matrix[j, i, k, 3] = matrix[j, i, 3, k] = -1.0
    return matrix.reshape(9, 16), offset.reshape(16)


_PRODUCTS, _PRODUCTS_OFFSET = _quaternion_products()


def _quaternions(rotations: Floats, out: Floats) -> None:
    """Write unit quaternions x y z w of rotations given as (n, 9), by columns.

    Each row of 4 q q^T is a multiple of q; the row of q's largest component is never near zero.
    """
    products: Floats = rotations @ _PRODUCTS
    products += _PRODUCTS_OFFSET
    largest: Indices = np.arange(0, 4 * len(products), 4) + products[:, ::5].argmax(axis=1)
    rows: Floats = products.reshape(-1, 4).take(largest, axis=0)
    lengths: Floats = np.sqrt(np.vecdot(rows, rows))
    np.divide(rows, lengths[:, None], out=out)
