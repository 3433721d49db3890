"""zstate camera: publisher of the pictures of a camera, a video file, or a simulated camera."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import click

from zstate.cli import options
from zstate.cli.output.console import fail, print_status, print_wrapped
from zstate.cli.output.wire_text import messages_for
from zstate.cli.session import SessionOptions, open_session

if TYPE_CHECKING:
    from zstate.buffer.buffer import TransformBuffer
    from zstate.cameras import Camera, CameraPublisher
    from zstate.cameras.cli.video_source import VideoFile, Webcam
    from zstate.net.session import Session


_RATE_HZ = 10.0
_WORLD = "map"
_SIMULATED_SIZE = 640, 480
_SIMULATED_FOCAL_PX = 500.0

_SINGLE_PICTURE_NS = 100_000_000
"""How long a video of one picture is, with --loop."""


class _CameraCommand(click.Command):
    """Wrong usage is refused before the command runs: a file of `zstate up` is checked in full."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        rest = super().parse_args(ctx, args)
        given = [ctx.params["device"] is not None, ctx.params["file"] is not None, ctx.params["simulate"]]
        if sum(given) != 1 and not ctx.resilient_parsing:
            raise click.UsageError("give --device /dev/videoN, a video FILE or --simulate, one of them", ctx)
        given_for = {
            "world_frame": ("simulate",),
            "size": ("device",),
            "rate": ("simulate", "device"),
            "loop": ("file",),
        }
        for option, sources in given_for.items():
            if ctx.params[option] and not any(ctx.params[source] for source in sources):
                wanted = " or ".join("FILE" if source == "file" else f"--{source}" for source in sources)
                raise click.UsageError(f"--{option.replace('_', '-')} is for {wanted}", ctx)
        return rest


@click.command("camera", cls=_CameraCommand)
@click.argument("robot")
@click.argument("file", type=options.EXISTING_FILE, required=False)
@click.option("--device", metavar="/dev/videoN", help="A camera of this computer (v4l2).")
@click.option("--simulate", is_flag=True, help="Draw what the camera would see of the robot and a floor.")
@click.option(
    "--name",
    default="camera",
    show_default=True,
    metavar="NAME",
    help="The camera's name; in ROS the namespace of its topics.",
)
@click.option(
    "--frame",
    metavar="FRAME",
    help="The frame of its lens: z forward, x right, y down; default: a frame of the camera's name.",
)
@click.option(
    "--info",
    type=options.EXISTING_FILE,
    metavar="FILE.yaml",
    help="Its calibration, as camera_calibration of ROS writes it.",
)
@click.option(
    "--world-frame",
    metavar="FRAME",
    help="With --simulate: the frame in which the floor lies, if the robot has that frame, else the root of "
    "the robot; default: map.",
)
@click.option(
    "--size",
    type=click.IntRange(min=1),
    nargs=2,
    metavar="WIDTH HEIGHT",
    help="With --device: the size of its pictures [px]; default: what its driver has set.",
)
@click.option(
    "--rate",
    type=options.RATE,
    help="Pictures a second; default: with --device what its driver has set, with --simulate 10.",
)
@click.option("--loop", is_flag=True, help="Begin FILE again at its end.")
@options.seconds_option
@options.wires_option
@options.session_options
def camera_command(
    *,
    robot: str,
    file: str | None,
    device: str | None,
    simulate: bool,
    name: str,
    frame: str | None,
    info: str | None,
    world_frame: str | None,
    size: tuple[int, int] | None,
    rate: float | None,
    loop: bool,
    seconds: float | None,
    wires: tuple[str, ...],
    network: SessionOptions,
) -> None:
    """Publish the pictures of a camera of this computer, or of a video FILE, as image/NAME of ROBOT.

    The JPEGs of a camera, or of a file of them, are sent as they are; other pictures are encoded as JPEG. A
    picture of a camera has the stamp of its driver, those of a file follow each other as in the file.
    Needs pip install 'zstate[cameras]'.

    A simulated camera sees the links of ROBOT, by its transforms on the network, and a checkered floor. It
    has 640 x 480 pixels and sees 65 degrees, or the calibration of --info FILE.yaml. Its meshes need
    pip install 'zstate[view]'.

    \b
    zstate camera r1 --device /dev/video0 --name wrist --frame wrist_optical
    zstate camera r1 --device /dev/video0 --info wrist.yaml --size 1280 720 --rate 30
    zstate camera r1 walk.mp4 --loop
    zstate camera r1 --simulate --frame wrist_optical
    zstate camera r1 walk.mp4 --wire ros2    # /camera/image_raw/compressed, /camera/camera_info
    """
    from zstate.cameras import CameraPublisher, load_camera
    from zstate.cameras.cli.video_source import VideoFile, Webcam
    from zstate.errors import InvalidInput
    from zstate.wire.keys import check_robot

    check_robot(robot)
    camera = None if info is None else load_camera(info, name if frame is None else frame)
    if device is not None:
        source = Webcam(device, size, rate)
    elif file is not None:
        source = VideoFile(file)
    else:
        camera = camera or _simulated_lens(name if frame is None else frame)
        with open_session(network, wires) as session:
            _simulate(
                session,
                robot,
                camera,
                name=name,
                wires=wires,
                world_frame=world_frame or _WORLD,
                rate=rate or _RATE_HZ,
                seconds=seconds,
            )
        return
    with source, open_session(network, wires) as session:
        width, height = source.size
        if camera is not None and source.size != (camera.width, camera.height):
            raise InvalidInput(
                f"{source.path} has pictures of {width} x {height}, {info} is for {camera.width} x "
                f"{camera.height}: calibrate the camera at the size that it sends"
            )
        with CameraPublisher(session, robot, name, camera, wires, frame=frame) as publisher:
            form = "JPEG as it comes" if source.codec == "mjpeg" else f"{source.codec}, encoded as JPEG"
            print_wrapped(
                f"{robot}: {width} x {height} of {source.path}, {form}, in {publisher.frame}, on "
                f"{_places(robot, name, wires)}"
            )
            try:
                if isinstance(source, Webcam):
                    _publish_webcam(source, publisher, seconds)
                else:
                    _publish_file(source, publisher, loop=loop, seconds=seconds)
            finally:
                stats = publisher.stats
                refused = f", {stats.refused} refused: {stats.last_refusal}" if stats.refused else ""
                print_status(f"{stats.sent} pictures published{refused}")


def _places(robot: str, name: str, wires: tuple[str, ...]) -> str:
    """Where the pictures of the camera ``name`` are, on each wire."""
    places = [messages_for(wire).topics(robot, ("image",)) for wire in wires]
    return " and on ".join(f"{one}/{name}" if one.startswith("zstate/") else one for one in places)


def _simulated_lens(frame: str) -> Camera:
    from zstate.cameras import Camera

    width, height = _SIMULATED_SIZE
    center = (width - 1) / 2, (height - 1) / 2
    return Camera(width, height, (_SIMULATED_FOCAL_PX, _SIMULATED_FOCAL_PX, *center), frame=frame)


def _simulate(
    session: Session,
    robot: str,
    camera: Camera,
    *,
    name: str,
    wires: tuple[str, ...],
    world_frame: str,
    rate: float,
    seconds: float | None,
) -> None:
    """Publish what ``camera`` sees of ``robot``, as soon as its pose is known."""
    from contextlib import ExitStack

    from zstate.cameras import CameraPublisher
    from zstate.cameras.cli.mesh_files import MeshFiles
    from zstate.cameras.simulated_camera import MountedCamera
    from zstate.cameras.surfaces import robot_surfaces
    from zstate.cli.commands.publish import run_publisher
    from zstate.cli.mounted_sensor import Words, mounted_on_robot

    meshes = MeshFiles()

    def mount(buffer: TransformBuffer, frame: str, world_frame: str) -> MountedCamera:
        owner = messages_for(wires[0]).robot or robot
        return MountedCamera(
            camera, buffer, owner, (frame, world_frame), lambda model: robot_surfaces(model, meshes.read)
        )

    with ExitStack() as opened:
        source, _ = mounted_on_robot(
            mount,
            session,
            robot,
            frames=(camera.frame, world_frame),
            wire=wires[0],
            seconds=seconds,
            opened=opened,
            words=Words("camera", "picture", "the floor"),
        )
        publisher = opened.enter_context(CameraPublisher(session, robot, name, camera, wires))
        print_wrapped(
            f"{robot}: {camera.width} x {camera.height}, simulated, in {publisher.frame}, {rate:g} Hz, on "
            f"{_places(robot, name, wires)}"
        )
        run_publisher(publisher, source, rate, seconds)


def _publish_webcam(webcam: Webcam, publisher: CameraPublisher, seconds: float | None) -> None:
    """Publish the pictures of ``webcam`` for ``seconds``; fail if it sends no more."""
    from contextlib import suppress

    from zstate.clock import SystemClock
    from zstate.errors import InvalidInput

    end = None if seconds is None else SystemClock().now() + round(seconds * 1e9)
    try:
        for stamp, picture in webcam.pictures():
            if end is not None and stamp >= end:
                return
            with suppress(InvalidInput):  # a broken picture; the publisher counts it
                publisher.publish(picture, stamp)
    except OSError as error:
        fail(str(error))


def _publish_file(file: VideoFile, publisher: CameraPublisher, *, loop: bool, seconds: float | None) -> None:
    """Publish the pictures of ``file`` at their times, for ``seconds`` or to its end."""
    from contextlib import suppress

    from zstate.clock import SystemClock, wait_interruptible
    from zstate.errors import InvalidInput

    clock, never = SystemClock(), threading.Event()
    start = clock.now()
    end = None if seconds is None else start + round(seconds * 1e9)
    while True:
        stamp = before = None
        for at_s, picture in file.pictures():
            now = clock.now()
            before, stamp = stamp, start + round(at_s * 1e9)
            if end is not None and max(stamp, now) >= end:
                return
            wait_interruptible(never, max(stamp - now, 0) * 1e-9)
            with suppress(InvalidInput):  # a broken picture; the publisher counts it
                publisher.publish(picture, stamp)
        if stamp is None:
            fail(f"there is no picture in {file.path}")
        if not loop:
            return
        file.rewind()
        start = stamp + (_SINGLE_PICTURE_NS if before is None else stamp - before)
