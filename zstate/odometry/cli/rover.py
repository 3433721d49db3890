"""The rover of `zstate demo rover`: its simulated hardware, in a room if maps can be read, with a camera."""

from __future__ import annotations

import math
import threading
import traceback
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from zstate.cli.options import load_robot
from zstate.cli.output.console import fail
from zstate.errors import Closed, LibraryMissing, ZStateError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from zstate.buffer.buffer import TransformBuffer
    from zstate.cameras import Camera, SimulatedCamera, StampedPicture
    from zstate.driving import DriverHost
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.odometry import ImuPublisher
    from zstate.odometry.simulated_rover import SimulatedRover, WheelRates
    from zstate.scans import Grid, Scan, ScanPublisher, SimulatedLaser
    from zstate.sources.square_drive import WheelPair
    from zstate.transform import Transform

ROVER = "rover"
ROVER_MODEL = "diffbot"
# The root of the model is the frame to place: base_link is fixed on it already.
ROVER_ODOM, ROVER_BASE = "odom", "base_footprint"
ROVER_WHEELS = 0.08, 0.32
"""Radius and track of diffbot's wheels [m]."""
ROVER_JOINTS = "left_wheel_joint", "right_wheel_joint"
ROVER_LASER, ROVER_IMU = "lidar_link", "imu_link"
ROVER_CAMERA, ROVER_LENS = "front", "front_optical"
"""The camera's name and its frame, which a static edge places: the model has none."""

_IMU_HZ = 200.0
_GYRO_BIAS, _ACCEL_BIAS = (0.002, -0.001, 0.003), (0.03, -0.02, 0.05)
_SLIP = 0.02
_ACCELERATION = 20.0
"""Limit of the wheels, of which the URDF has none [rad/s^2]."""

_SCAN_HZ, _RAY_COUNT, _RANGE_M, _RANGE_NOISE_M = 10.0, 720, 8.0, 0.005
_CAMERA_HZ, _CAMERA_SIZE, _FOCAL_PX, _DISTORTION = 10.0, (640, 480), 450.0, (-0.12, 0.02, 0.0, 0.0, 0.0)
_MAST, _MAST_XYZ, _MAST_PITCH = "base_link", (-0.2, 0.0, 0.34), math.radians(20.0)
_WORLD, _FLOOR, _WALLS = "world", "the floor", "the walls"
_OPTICAL_RPY = -math.pi / 2, 0.0, -math.pi / 2
"""Of the frame of a lens, z forward, in a frame with x forward."""

_REST_NS = 3_000_000_000
"""The rover rests so long after its first odometry, which begins where it stands."""


def _file(name: str) -> Path:
    """A file next to the models that come with zstate."""
    from zstate.model.catalog import find_entry

    return find_entry(ROVER_MODEL).path.with_name(name)


def room_file() -> Path:
    """The map of the room."""
    return _file("room.yaml")


def settings_file() -> Path:
    """The settings of the rover's odometry, with the noise of its IMU."""
    return _file("rover.toml")


def programs(robot: str, *, with_camera: bool = False) -> dict[str, tuple[str, ...]]:
    """The arguments of the `zstate` processes that publish the rover ``robot``, by name."""
    camera = ("--camera",) if with_camera else ()
    return {
        "wheels": ("demo", robot, "--program", "wheels", *camera),
        "odometry": ("odometry", robot, "--file", str(settings_file())),
    }


def load_room() -> Grid | None:
    """The room of the rover; None without the libraries that read maps."""
    from zstate.scans import load_map

    try:
        return load_map(room_file())
    except LibraryMissing:
        return None


def check_camera() -> None:
    """Raises LibraryMissing without a library of simulated cameras and their pictures."""
    import numpy as np

    from zstate.cameras import SimulatedCamera
    from zstate.cameras.codecs import to_jpeg

    to_jpeg(SimulatedCamera(_lens(), {}).picture({})[:8, :8].astype(np.uint8), 80)


def run_rover(session: Session, rate_hz: float, robot: str = ROVER, *, with_camera: bool = False) -> None:
    """Host the driver of the wheels of the rover ``robot``, publish its sensors, until a signal.

    A sensor that fails ends it, with the reason.
    """
    from zstate.driving import DriverHost, Limits
    from zstate.driving.cli.drive import run_host
    from zstate.nodes.listener import TransformListener
    from zstate.odometry import ImuPublisher
    from zstate.odometry.cli.settings_file import read_settings
    from zstate.odometry.simulated_rover import SimulatedRover, SimulatedWheels
    from zstate.sources.square_drive import WheelPair

    model, _ = load_robot(ROVER_MODEL, None)
    mounts, wheels = _mounts(model), WheelPair(*ROVER_WHEELS)
    rover = SimulatedRover(
        wheels,
        mounts[ROVER_IMU],
        read_settings(str(settings_file())).imu_noise,
        slip=_SLIP,
        gyro_bias=_GYRO_BIAS,
        accel_bias=_ACCEL_BIAS,
    )
    with ExitStack() as opened:
        stop = threading.Event()
        listener = opened.enter_context(TransformListener(session, robot, history_on_join=False))
        autopilot = _Autopilot(rover, wheels, robot, listener.buffer)
        driver = SimulatedWheels(rover, ROVER_JOINTS, autopilot.rates)
        limits = Limits.of(model, acceleration=_ACCELERATION)
        host = opened.enter_context(
            DriverHost(session, driver, model, robot, rate_hz=rate_hz, limits=limits, program="rover-wheels")
        )
        imu = opened.enter_context(ImuPublisher(session, robot, "imu", frame=ROVER_IMU, program="rover-imu"))
        opened.callback(stop.set)
        threads = _SensorThreads(host)
        threads.start("IMU", partial(_publish_imu, imu, rover, stop))
        room = load_room()
        if room is not None:
            mount = mounts[ROVER_LASER]
            opened.enter_context(_start_laser(session, robot, room, rover, mount, threads=threads))
        if with_camera:
            opened.enter_context(_start_camera(session, robot, room, rover, model, threads=threads))
        try:
            run_host(host, None)
        finally:
            threads.check()


class _SensorThreads:
    """The threads of the sensors. If one fails, ``host`` is closed, which ends its loop; ``check`` raises."""

    def __init__(self, host: DriverHost) -> None:
        self._host = host
        self._failure: tuple[str, BaseException] | None = None

    def start(self, sensor: str, work: partial[object]) -> None:
        """Call ``work`` in a thread."""

        def run() -> None:
            try:
                work()
            except Closed:
                pass  # the end of the program
            except BaseException as error:
                self._failure = self._failure or (sensor, error)
                self._host.close()

        threading.Thread(target=run, name=f"zstate rover {sensor}", daemon=True).start()

    def check(self) -> None:
        """Raises what has ended the first thread that failed: a ZStateError, or a ClickException with it."""
        if self._failure is None:
            return
        sensor, error = self._failure
        if isinstance(error, ZStateError):
            raise error
        place = traceback.extract_tb(error.__traceback__)[-1]
        fail(f"the {sensor} of the rover raised {error!r} ({place.filename}, line {place.lineno})")


def _mounts(model: RobotModel) -> dict[str, Transform]:
    """The pose of each link in the base, with the wheels at zero."""
    from zstate.model.kinematics import Kinematics
    from zstate.transform import Transform

    poses = Kinematics(model).link_poses(model.neutral)
    return {
        link: Transform.from_pose7(ROVER_BASE, link, pose)
        for link, pose in zip(model.links, poses, strict=True)
        if link != ROVER_BASE
    }


def _publish_imu(publisher: ImuPublisher, rover: SimulatedRover, stop: threading.Event) -> None:
    from zstate.clock import SystemClock
    from zstate.rate import Rate

    for stamp in Rate(_IMU_HZ, SystemClock(), stop):
        for reading in rover.imu(stamp):
            publisher.publish(reading.gyro, reading.accel, reading.stamp)


def _start_laser(
    session: Session,
    robot: str,
    room: Grid,
    rover: SimulatedRover,
    mount: Transform,
    *,
    threads: _SensorThreads,
) -> ScanPublisher:
    from zstate.scans import ScanPublisher, SimulatedLaser

    increment, ray_ns = math.tau / _RAY_COUNT, round(1e9 / (_SCAN_HZ * _RAY_COUNT))
    laser = SimulatedLaser(
        room,
        angle_min=-math.pi,
        angle_increment=increment,
        ray_count=_RAY_COUNT,
        ray_ns=ray_ns,
        range_max=_RANGE_M,
        frame=ROVER_LASER,
        noise_m=_RANGE_NOISE_M,
        seed=0,
    )
    publisher = ScanPublisher(
        session,
        robot,
        "laser",
        angle_min=-math.pi,
        angle_increment=increment,
        ray_ns=ray_ns,
        range_min=0.0,
        range_max=_RANGE_M,
        frame=ROVER_LASER,
        program="rover-laser",
    )
    threads.start("laser", partial(publisher.run, _RoverLaser(laser, rover, mount), _SCAN_HZ))
    return publisher


class _RoverLaser:
    """A RangeSource: each ray is cast from where the rover truly is at its instant, through the room."""

    def __init__(self, laser: SimulatedLaser, rover: SimulatedRover, mount: Transform) -> None:
        self._laser, self._rover = laser, rover
        self._x, self._y, _ = mount.translation.tolist()
        _, _, self._yaw = mount.rpy.tolist()

    def read(self, stamp: int) -> Scan | None:
        """The sweep that ends at ``stamp`` [ns]; None if it began before the rover, or before a pause."""
        import numpy as np

        first = self._rover.advance(stamp) - self._laser.sweep_ns
        if not self._rover.has_poses_since(first):
            return None
        x, y, yaw = self._rover.poses(self._laser.stamps(first)).T
        cosine, sine = np.cos(yaw), np.sin(yaw)
        ahead, left = cosine * self._x - sine * self._y, sine * self._x + cosine * self._y
        return self._laser.scan(first, x + ahead, y + left, yaw + self._yaw)


def _lens() -> Camera:
    from zstate.cameras import Camera

    width, height = _CAMERA_SIZE
    k = _FOCAL_PX, _FOCAL_PX, (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, k, _DISTORTION, frame=ROVER_LENS)


def _camera_mount() -> Transform:
    from zstate.transform import Transform

    mast = Transform.from_rpy(_MAST, "mast", _MAST_XYZ, (0.0, _MAST_PITCH, 0.0))
    return mast @ Transform.from_rpy("mast", ROVER_LENS, (0.0, 0.0, 0.0), _OPTICAL_RPY)


def _start_camera(
    session: Session,
    robot: str,
    room: Grid | None,
    rover: SimulatedRover,
    model: RobotModel,
    *,
    threads: _SensorThreads,
) -> ExitStack:
    """Publish the mount of the camera and its pictures, until the stack is closed."""
    from zstate.cameras import CameraPublisher, SimulatedCamera, floor_surface, robot_surfaces, wall_surface
    from zstate.nodes.static_publisher import StaticPublisher
    from zstate.scans.simulated_laser import OCCUPIED_FROM

    with ExitStack() as opening:
        statics = StaticPublisher(session, robot, "camera", program="rover-camera")
        opening.enter_context(statics).set(_camera_mount())
        lens = _lens()
        surfaces = robot_surfaces(model) | {_FLOOR: floor_surface((-5.0, 5.0), (-5.0, 5.0))}
        if room is not None:
            walls = wall_surface(room.cells >= OCCUPIED_FROM, room.resolution, room.planar_origin())
            surfaces[_WALLS] = walls
        source = RoverCamera(SimulatedCamera(lens, surfaces), rover, model)
        publisher = CameraPublisher(session, robot, ROVER_CAMERA, lens, program="rover-camera")
        opening.enter_context(publisher)
        threads.start("camera", partial(publisher.run, source, _CAMERA_HZ))
        return opening.pop_all()


class RoverCamera:
    """A PictureSource: what the camera sees from where the rover truly is."""

    def __init__(self, camera: SimulatedCamera, rover: SimulatedRover, model: RobotModel) -> None:
        from zstate.model.kinematics import Kinematics

        self._camera, self._rover, self._links = camera, rover, model.links
        self._kinematics = Kinematics(model)
        self._base_from_lens = _mounts(model)[_MAST] @ _camera_mount()

    def read(self, stamp: int) -> StampedPicture | None:
        """The picture at the last step before ``stamp`` [ns]; None right after a pause."""
        from zstate.cameras import StampedPicture
        from zstate.transform import Transform

        joints = self._rover.joints(stamp)
        assert joints.stamp is not None
        if not self._rover.has_poses_since(joints.stamp):
            return None
        ((x, y, yaw),) = self._rover.poses([joints.stamp]).tolist()
        rpy = (0.0, 0.0, math.remainder(yaw, math.tau))  # the rover counts its turns
        world_from_base = Transform.from_rpy(_WORLD, ROVER_BASE, (x, y, 0.0), rpy)
        lens_from_base = self._base_from_lens.inverse()
        poses: dict[str, NDArray[np.float64]] = {
            link: (lens_from_base @ Transform.from_pose7(ROVER_BASE, "link", pose)).pose7
            for link, pose in zip(self._links, self._kinematics.link_poses(joints.positions), strict=True)
        }
        poses[_FLOOR] = poses[_WALLS] = (lens_from_base @ world_from_base.inverse()).pose7
        return StampedPicture(joints.stamp, self._camera.picture(poses))


class _Autopilot:
    """Keeps the rover on a square, as soon as its odometry is in ``buffer``: where that begins."""

    def __init__(self, rover: SimulatedRover, wheels: WheelPair, robot: str, buffer: TransformBuffer) -> None:
        from zstate.sources.square_drive import SquareDrive

        self._rover, self._wheels, self._buffer = rover, wheels, buffer
        self._frames = f"{robot}/{ROVER_ODOM}", f"{robot}/{ROVER_BASE}"
        self._square = SquareDrive(wheels)
        self._start: int | None = None

    def rates(self, stamp: int) -> WheelRates:
        """The rates of the wheels at ``stamp`` [ns]."""
        from zstate.odometry.simulated_rover import tracking_twist

        if self._start is None:
            if not self._buffer.can_lookup(*self._frames):
                return 0.0, 0.0
            self._start = stamp + _REST_NS
        if stamp < self._start:
            return 0.0, 0.0
        return self._wheels.roll(*tracking_twist(self._square.state(stamp - self._start), self._rover.pose))
