"""Checks of one robot: writers, model, driver, samples, joint limits, static edges and poses."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence, Set

from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.clock_checks import clocks_check, stamps_check
from zstate.cli.doctor.robot_probe import RobotProbe, StreamSamples, WriterSamples, has_frame
from zstate.cli.frame_checks import similar_frames, without_program_advice
from zstate.cli.output.console import count_text
from zstate.cli.output.wire_text import publish_command_for
from zstate.errors import InvalidInput, LookupFailed, ModelError, format_duration
from zstate.model.joint_limits import JointLimits
from zstate.model.representative_links import representative_links
from zstate.model.robot import RobotModel, coordinate_names
from zstate.model.urdf import parse_urdf
from zstate.net.session import Session
from zstate.net.topic_statistics import Window
from zstate.nodes.publisher_status import ARE_OUTSIDE
from zstate.stream_registry import is_named
from zstate.streams import JOINT_STREAMS, StreamName
from zstate.wire.identity import WriterId
from zstate.wire.keys import MODEL_WRITER, foreign_edge_problem, full_name
from zstate.wire.messages import Status

_MIN_RECEIVED = 0.8
"""The least ratio of received to sent samples."""

_MIN_RATE = 0.95
"""The least ratio of the achieved to the commanded rate."""

# Reasons of refused messages.
_VERSION_REASONS = ("newer version", "foreign")
_MODEL_REASONS = ("robot description", "no description")
_STATIC_PREFIX = "static edge of"
"""The texts of refused static edges start with this."""


def robot_checks(probe: RobotProbe, session: Session) -> Iterator[Check]:
    """The checks of the robot of ``probe``, which has collected data for a while."""
    yield _writers_check(probe)
    if place := probe.sites.text_of(probe.info.name):
        yield ok("site", place)
    if probe.is_silent and probe.info.writers:
        yield _silent_check(probe, session)
        return
    for reason in _VERSION_REASONS:
        if text := probe.refusals.get(reason):
            is_newer = reason == "newer version"
            advice = f"zstate ls  # shows the writers of {probe.info.name}"
            yield broken("version", text, "pip install -U zstate" if is_newer else advice)
            break
    yield from _waits_checks(probe)
    if probe.is_place:
        yield from probe.plugin_checks()
        yield statics_check(probe)
        return
    model, check = model_check(probe)
    yield check
    yield from probe.plugin_checks()
    if probe.info.named("partial_joint_states") and "joint_states" not in probe.streams:
        yield from _parts_checks(probe, model)
    elif not probe.has_only_transforms:
        yield _samples_check(probe)
    yield from named_writers_checks(probe, "transforms", probe.transforms, probe.info.named("transforms"))
    yield from measured_checks(probe)
    yield clocks_check(probe)
    yield stamps_check(probe)
    if model is not None:
        writers = (*probe.samples.writers.values(), *probe.parts.writers.values())
        yield from limits_check(probe, model, writers, f"zstate echo {probe.info.name}")
    yield statics_check(probe)
    yield poses_check(probe, model)


def _writers_check(probe: RobotProbe) -> Check:
    robot = probe.info.name
    for event in probe.events:
        if event.kind == "conflict" and event.stream == "tf_static":
            if _refused_static(probe) is None:  # statics_check reports that in more detail
                then = f"zstate tree {robot}  # shows the edge in use"
                return warning("writers", without_program_advice(event.text), then)
        elif event.kind == "conflict":
            then = f"zstate ls  # shows both; stop one of them, or start it with a --name other than {robot}"
            return warning("writers", event.text, then)
    for status in probe.statuses.values():
        if status.level == "error" or (status.level == "warn" and not _has_own_check(status)):
            text = f"{status.program}@{status.host} pid {status.pid} reports: {status.text}"
            return warning("writers", text, f"zstate monitor --robots --robot {robot}")
    return ok("writers", probe.writers_text())


def _has_own_check(status: Status) -> bool:
    """Whether another check covers a warning, or the writer was only late now and then."""
    if ARE_OUTSIDE in status.text:
        return True
    if "warning" in status.values:
        return False
    commanded = status.values.get("commanded", "").partition(" ")[0]
    return bool(commanded) and status.rate_hz >= _MIN_RATE * float(commanded)


def _silent_check(probe: RobotProbe, session: Session) -> Check:
    """Writers are announced, and none of their data arrives."""
    robot, writer = probe.info.name, probe.info.writers[0][1]
    if writer in probe.unresponsive:
        text = f"{writer} is announced but does not respond: it is stopped, frozen, or behind a dead link"
        return broken("writers", text, f"ps -o stat= -p {writer.pid}  # on {writer.host}; T: it is stopped")
    if session.zenoh.info.routers_zid():
        identity = "this identity" if session.probe is None else session.probe.identity
        text = (
            f"{robot!r} is announced, but none of its data arrives: the router denies zstate/{robot}/** to "
            f"{identity}; its access control lists the viewers that may read"
        )
        then = "zstate acl --viewer NAME  # for the router, which then needs a restart"
        return broken("access", text, then)
    text = f"{writer} is announced, but none of its data arrives"
    return broken("writers", text, f"zstate echo {robot}")


def _waits_checks(probe: RobotProbe) -> Iterator[Check]:
    """A finding for each program of the robot that waits for streams without a writer.

    The check of joint_states names those that wait for joints alone, and has better advice.
    """
    streams: dict[str, list[StreamName]] = {}
    for stream, reader in sorted(probe.waits.items()):
        streams.setdefault(str(reader), []).append(stream)
    for program, waited in streams.items():
        if JOINT_STREAMS.issuperset(waited):
            continue
        names, have = " and ".join(waited), "has" if len(waited) == 1 else "have"
        text = (
            f"{program} waits for {names} of {probe.info.name!r}, which {have} no writer: the program that "
            "writes has ended, or was not started"
        )
        yield broken("programs", text, f"zstate ls  # start what writes {names}")


def model_check(probe: RobotProbe) -> tuple[RobotModel | None, Check]:
    """The model of the robot if it can be used, and the check."""
    robot, writers = probe.info.name, probe.writers("robot_description")
    if probe.description is None:
        if writers:
            text = f"{writers[-1]} announces the model, which has not arrived"
            check = broken("model", text, f"zstate doctor {robot} --timeout 10")
        elif probe.followed == "tf":
            check = ok("model", "not published, and not needed: the poses are published on tf")
        elif probe.has_only_transforms:
            check = ok("model", "not published, and not needed: its moving edges are on transforms")
        else:
            text = f"the model of {robot!r} has no publisher"
            check = broken("model", text, publish_command_for("publish", robot))
        return None, check
    try:
        model = parse_urdf(probe.description.urdf, f"the URDF of {robot!r}")
    except ModelError as error:
        return None, broken("model", str(error), "zstate check FILE  # the file that its publisher loads")
    refused = probe.refusals.get("robot description")
    if refused:
        return None, broken("model", refused, f"zstate tree {robot}")
    size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joint_names), 'joint')}"
    text = f"{model.name!r}: {size}, root {model.root!r}"
    if model.findings:
        first = model.findings[0]
        text += f"; {count_text(len(model.findings), 'warning')}, such as line {first.line}: {first.message}"
        return model, warning("model", text, "zstate check FILE")
    return model, ok("model", text)


def _samples_check(probe: RobotProbe) -> Check:
    stream, robot, statistics = probe.followed, probe.info.name, probe.samples.statistics
    writers, window = probe.writers(stream), statistics.window()
    if window is None and (not writers or "joint_states" not in probe.streams):
        return _no_writer_check(probe)
    writer = str(writers[-1]) if writers else "an unannounced writer"
    if window is None and (thinning := probe.sites.thinning(robot, stream)) and not thinning.rate_hz:
        return ok(stream, f"{thinning}")
    if window is None:
        if (status := probe.statuses.get(writers[-1].session)) is not None:
            cause = f"it runs, but {status.text or 'publishes nothing'}"
        else:
            is_stuck = writers[-1] in probe.unresponsive
            cause = "it does not respond either: stopped, or frozen" if is_stuck else "it is slow"
        text = f"{writer} is announced, but no sample arrives: {cause}"
        return broken(stream, text, f"zstate echo {robot}")
    refused = refused_check(probe)
    if refused is not None:
        return refused
    if window.rate_hz is None:
        return warning(stream, f"one sample from {writer}; too few for a rate", f"zstate hz {robot}")
    return _rate_check(probe, writer, window, window.rate_hz)


def _rate_check(probe: RobotProbe, writer: str, window: Window, rate_hz: float) -> Check:
    stream, robot, statistics = probe.followed, probe.info.name, probe.samples.statistics
    silence, hz = format_duration(round(statistics.silent_s() * 1e9)), f"zstate hz {robot} --stream {stream}"
    if statistics.is_stale():
        return broken(stream, f"the samples of {writer} stopped {silence} ago", hz)
    text, stats = f"{rate_hz:.1f} Hz from {writer}", probe.stats
    status = probe.statuses.get(statistics.session)
    if probe.collector.has_overrun:
        return ok(stream, f"{text}, newest {silence} ago")
    lost, arrived = stats.missed + stats.dropped, statistics.count
    thinning = probe.sites.thinning(robot, stream) if lost else None  # none is lost at the site itself
    if thinning is not None and thinning.explains(window) and rate_hz >= _MIN_RECEIVED * thinning.rate_hz:
        return ok(stream, f"{text}, {thinning}, newest {silence} ago")
    if status is not None and rate_hz < _MIN_RECEIVED * status.rate_hz:
        text += f", which sends {status.rate_hz:.1f} Hz: the rest is lost or downsampled on the way"
        return warning(stream, text, hz)
    if arrived < _MIN_RECEIVED * (arrived + lost):
        text += f"; {stats.missed} were lost on the way and {stats.dropped} here"
        return warning(stream, text, f"zstate monitor --robots --robot {robot}")
    return ok(stream, f"{text}, newest {silence} ago")


def _parts_checks(probe: RobotProbe, model: RobotModel | None) -> Iterator[Check]:
    """Whether each driver of some joints publishes, and each joint has one."""
    stream, robot = "partial_joint_states", probe.info.name
    refused = refused_check(probe)
    if refused is not None:
        yield refused
    yield from named_writers_checks(probe, stream, probe.parts, probe.info.named("partial_joint_states"))
    written = {name for samples in probe.parts.writers.values() for name in samples.names}
    if model is not None and not written.issuperset(coordinate_names(model)):
        missing = [
            joint for joint in model.joint_names if written.isdisjoint(coordinate_names(model.part([joint])))
        ]
        text = (
            f"{', '.join(map(repr, missing))} of {robot!r} without a writer: what moves with it has no pose"
        )
        only = " ".join(f"--only {joint}" for joint in missing)
        yield broken(stream, text, f"{publish_command_for('joints', robot)} {only}  # until its driver runs")


def named_writers_checks(
    probe: RobotProbe,
    stream: StreamName,
    stream_samples: StreamSamples,
    names: Sequence[tuple[str, WriterId]],
) -> Iterator[Check]:
    """Whether each announced writer of a stream with names publishes."""
    samples = stream_samples.writers
    hz, what = f"zstate hz{probe.argument} --stream {stream}", stream.replace("_", " ")
    for name, writer in names:
        received, known_as = samples.get(writer.session), f"{writer}, as {name!r}" if name else str(writer)
        thinning = probe.sites.thinning(probe.info.name, stream)
        if received is None and thinning is not None and not thinning.rate_hz:
            yield ok(stream, f"{thinning}, of {known_as}")
            continue
        if received is None:
            stuck = ": it is stopped, or frozen" if writer in probe.unresponsive else ""
            text = f"{known_as}, is announced, but no sample arrives{stuck}"
            yield warning(stream, text, hz)
            continue
        silence = format_duration(round(received.statistics.silent_s() * 1e9))
        window = received.statistics.window()
        if received.statistics.is_stale():
            yield broken(stream, f"the {what} of {known_as}, stopped {silence} ago", hz)
        elif window is None or window.rate_hz is None:
            yield ok(stream, f"one sample from {known_as}, {silence} ago")
        else:
            yield ok(stream, f"{window.rate_hz:.1f} Hz from {known_as}, newest {silence} ago")


def measured_checks(probe: RobotProbe) -> Iterator[Check]:
    """Whether each writer of measurements and of odometry publishes, in a frame that the robot has."""
    info = probe.info
    for stream, samples in probe.measured.items():
        unnamed = [("", writer) for one, writer in info.writers if one == stream and not is_named(stream)]
        names = info.named(stream) or unnamed
        yield from named_writers_checks(probe, stream, samples, names)
        if has_frame(stream):
            yield from _sensor_frames_checks(probe, stream, samples, names)


def _sensor_frames_checks(
    probe: RobotProbe, stream: StreamName, samples: StreamSamples, names: Sequence[tuple[str, WriterId]]
) -> Iterator[Check]:
    """Findings for measurements in frames of the robot that it does not have: no reader can place them."""
    robot, writers = probe.info.name, samples.writers
    frames = {frame.name for frame in probe.frames}
    for sensor, writer in names:
        for frame in writers[writer.session].names if writer.session in writers else ():
            restart = f"start {writer} with another --frame"
            try:
                full = full_name(robot, frame)
            except InvalidInput as error:
                yield broken(stream, f"the {stream} of {sensor!r}: {error}", f"zstate ls  # {restart}")
                continue
            if full.startswith(f"{robot}/") and full not in frames:
                near = similar_frames(full, frames)
                hint = f"; {near[0]!r} is similar" if near else ""
                text = f"the {stream} of {sensor!r} is in {full!r}, which no writer places{hint}"
                yield broken(stream, text, f"zstate static TARGET {full} --xyz X Y Z  # or {restart}")


def _no_writer_check(probe: RobotProbe) -> Check:
    robot = probe.info.name
    waiting = [
        *probe.writers("tf"),
        *(reader for stream, reader in probe.waits.items() if stream == "joint_states"),
    ]
    then = f"{publish_command_for('joints', robot)}  # moves it, until the driver runs"
    if "robot_description" not in probe.streams and not waiting:
        text = f"{robot!r} has no writer of joint_states or tf: it does not move"
        return warning("joint_states", text, then)
    waits = f", which {waiting[-1]} waits for" if waiting else ""
    text = f"{robot!r} has no writer of joint_states{waits}: its driver is not running"
    for info in probe.neighbours:
        if {stream for stream, _ in info.writers} == {"joint_states"}:
            text += f", or it uses the name {info.name!r}, which has joint_states but no model"
            return broken("joint_states", text, publish_command_for("publish", info.name))
    return broken("joint_states", text, then)


def refused_check(probe: RobotProbe) -> Check | None:
    """Why samples that arrived cannot be used; None if all can."""
    refused, texts = probe.stats.refused, probe.refusals
    reasons = [
        reason
        for reason, text in texts.items()
        if reason not in (*_MODEL_REASONS, *_VERSION_REASONS) and not text.startswith(_STATIC_PREFIX)
    ]
    if not reasons:
        return None
    reason = max(reasons, key=lambda one: refused[one])
    text = f"{count_text(refused[reason], 'message')} cannot be used ({reason}): {texts[reason]}"
    if probe.stats.received:
        return warning(probe.followed, text, f"zstate monitor --robots --robot {probe.info.name}")
    return broken(probe.followed, text, f"zstate echo {probe.info.name} --once")


def limits_check(
    probe: RobotProbe, model: RobotModel, writers: Iterable[WriterSamples], echo: str
) -> Iterator[Check]:
    """Warnings if joint positions of ``model`` are outside its limits; the command ``echo`` prints them."""
    limits = JointLimits(model)
    found = [text for writer in writers if (text := limits.explanation(writer.positions(model)))]
    reported = [status.text for status in probe.statuses.values() if ARE_OUTSIDE in status.text]
    for text in found or reported[:1]:
        yield warning("limits", text, f"{echo} --once  # `zstate check FILE --joints` shows the limits")


def statics_check(probe: RobotProbe) -> Check:
    """Whether all static edges are used, and every announced writer of static edges has one."""
    robot = probe.info.name
    static = [frame for frame in probe.frames if frame.kind == "static"]
    refused = _refused_static(probe)
    if refused is None and probe.is_alone and not probe.nodes:  # ROS nodes share all frames
        robots = {info.name for info in probe.neighbours}
        for frame in static:
            # Listeners of all robots refuse the edge, although this listener of one robot does not.
            problem = foreign_edge_problem(robot, (frame.parent or "", frame.name), robots)
            if problem and refused is None:
                refused = f"{_STATIC_PREFIX} {frame.writer!r}: {problem}"
    if refused is not None:
        then = f"zstate tree {robot}  # the frames without that edge; stop its writer, or correct it"
        return warning("tf_static", without_program_advice(refused), then)
    writers = {frame.writer for frame in probe.all_frames if frame.kind == "static"}
    for name, writer in dict(probe.info.named("tf_static")).items():
        if name != MODEL_WRITER and name not in writers:
            text = f"{writer} announces static edges as {name!r}, but places no frame"
            return warning("tf_static", text, f"zstate tree {robot}")
    return ok("tf_static", f"{count_text(len(static), 'fixed edge')}")


def _refused_static(probe: RobotProbe) -> str | None:
    """Why a static edge is not used, with its writer."""
    texts = probe.refusals.values()
    refused = next((text for text in texts if text.startswith(_STATIC_PREFIX)), None)
    for name, writer in probe.info.named("tf_static"):
        if refused is not None and refused.startswith(f"{_STATIC_PREFIX} {name!r}:"):
            return refused.replace(f"{name!r}:", f"{name!r} ({writer}):", 1)
    return refused


def poses_check(probe: RobotProbe, model: RobotModel | None) -> Check:
    """Whether all frames are in one tree, and the pose of an outermost frame is known."""
    robot, frames = probe.info.name, probe.frames
    roots = sorted(frame.name for frame in frames if frame.parent is None)
    if len(roots) > 1:
        return _trees_check(probe, {frame.name for frame in frames}, roots)
    has_samples = bool(probe.sample_count)
    is_driven = not JOINT_STREAMS.isdisjoint(probe.streams) and model is not None
    if not (has_samples or is_driven or (model is not None and not model.joint_names)):
        return skipped("poses", "no joint positions")
    if not frames:
        return skipped("poses", "no frame is known")
    ends = representative_links(model, 1) if model is not None else ()
    placed = [frame.name for frame in frames if frame.parent is not None]
    target, source = roots[0], f"{robot}/{ends[0]}" if ends else (placed or roots)[-1]
    try:
        probe.buffer.lookup(target, source)
    except LookupFailed as error:
        if not has_samples:
            return skipped("poses", f"no joint positions: {error}")
        return broken("poses", str(error), f"zstate tf {target} {source}")
    return ok("poses", f"{count_text(len(frames), 'frame')} in one tree; {source} in {target} is known")


def _trees_check(probe: RobotProbe, frames: Set[str], roots: Sequence[str]) -> Check:
    text = f"{count_text(len(frames), 'frame')} in {len(roots)} trees, with the roots {', '.join(roots)}"
    for frame in static_roots(probe):
        root = frame.parent or ""
        near = similar_frames(root, frames - {root})
        if near:
            robot, _, bare = root.partition("/")
            text = f"{text}: {bare!r}, the parent of {frame.name!r}, is similar to {near[0]!r}"
            then = f"zstate tree {robot}  # if {near[0]!r} is meant, start {frame.writer} with that name"
            return warning("poses", text, then)
    return warning("poses", text, f"zstate static {roots[0]} {roots[1]} --xyz 0 0 0  # joins two of them")


def shared_roots_checks(tops: Iterable[FrameInfo]) -> Iterator[Check]:
    """Warnings if several robots each have a root of the same name, such as a/map and b/map.

    ``tops`` are the ``static_roots`` of all robots.
    """
    owners: dict[str, list[FrameInfo]] = {}
    for frame in tops:
        owners.setdefault((frame.parent or "").partition("/")[2], []).append(frame)
    for name, placed in owners.items():
        if len(placed) > 1:
            frames = " and ".join(repr(frame.parent) for frame in placed)
            text = f"{frames} are different frames; name one that robots share in full, such as fleet/{name}"
            then = f"zstate static fleet/{name} {placed[0].name} --xyz 0 0 0  # instead of {placed[0].parent}"
            yield warning("frames", text, then)


def static_roots(probe: RobotProbe) -> Iterator[FrameInfo]:
    """One child of each root of the robot whose children are all placed by static writers, not by a model."""
    writers = {name for name, _ in probe.info.named("tf_static") if name != MODEL_WRITER}
    for root in probe.frames:
        if root.parent is None and root.name.startswith(f"{probe.info.name}/"):
            children = [frame for frame in probe.all_frames if frame.parent == root.name]
            if children and all(frame.writer in writers for frame in children):
                yield children[0]
