"""The links of one robot: its writers, its model, its samples, its fixed edges, and the poses at the end."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

from zstate.buffer.frame_tree import FrameInfo
from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.clock_checks import clocks_check, stamps_check
from zstate.cli.doctor.ear import Ear
from zstate.cli.doctor.samples import Ranges
from zstate.cli.frame_checks import similar_frames, without_program_advice
from zstate.cli.output.console import count_text
from zstate.cli.output.wire_text import publish_command_for
from zstate.errors import LookupFailed, ModelError, format_duration
from zstate.model.joint_limits import JointLimits
from zstate.model.robot import RobotModel, representative_links
from zstate.model.urdf import parse_urdf
from zstate.net.presence import RobotInfo
from zstate.net.session import Session
from zstate.nodes.publisher_status import ARE_OUTSIDE
from zstate.wire.keys import MODEL_WRITER, foreign_edge_problem
from zstate.wire.messages import Status

_FEWER = 0.8
"""Of what is sent, at least so much is to arrive."""

_KEPT = 0.95
"""Of the rate it is to keep, so much is good enough."""

_OF_VERSIONS = ("newer version", "foreign")
_OF_THE_MODEL = ("robot description", "no description")
_OF_STATICS = "static edge of"
"""So begin the texts of refused ones."""


def robot_checks(ear: Ear, session: Session) -> Iterator[Check]:
    """Every link of the robot that ``ear`` has heard for a while."""
    yield _writers_check(ear)
    if ear.is_mute and ear.info.writers:
        yield _mute_check(ear, session)
        return
    versions = _version_check(ear)
    if versions is not None:
        yield versions
    model, check = model_check(ear)
    yield check
    yield _samples_check(ear)
    yield clocks_check(ear)
    yield stamps_check(ear, session)
    if model is not None:
        ranges = [writer.ranges for writer in ear.samples.writers.values()]
        yield from limits_check(ear, model, ranges, f"zstate echo {ear.info.name}")
    yield statics_check(ear)
    yield poses_check(ear, model)


def _writers_check(ear: Ear) -> Check:
    for event in ear.events:
        if event.kind == "conflict" and event.stream == "tf_static":
            if _refused_static(ear) is None:  # which says more
                return warning(
                    "writers",
                    without_program_advice(event.text),
                    f"zstate tree {ear.info.name}  # shows the edge that counts",
                )
        elif event.kind == "conflict":
            then = (
                f"zstate ls  # shows both; end one of them, or give it --name, another than {ear.info.name}"
            )
            return warning("writers", event.text, then)
    for status in ear.statuses.values():
        if status.level == "error" or (status.level == "warn" and not _is_elsewhere(status)):
            text = f"{status.program}@{status.host} pid {status.pid} says: {status.text}"
            return warning("writers", text, f"zstate monitor --robots --robot {ear.info.name}")
    streams: dict[str, list[str]] = {}
    for stream, writer in ear.info.writers:
        streams.setdefault(str(writer), []).append(stream)
    said = [f"{writer} ({', '.join(streams)})" for writer, streams in streams.items()]
    return ok("writers", "; ".join(said))


def _is_elsewhere(status: Status) -> bool:
    """Whether another check has what the status says, or it only was late now and then."""
    if ARE_OUTSIDE in status.text:
        return True
    commanded = status.values.get("commanded", "").partition(" ")[0]
    return bool(commanded) and status.rate_hz >= _KEPT * float(commanded)


def _mute_check(ear: Ear, session: Session) -> Check:
    """Writers are announced, and nothing that they say arrives."""
    robot, writer = ear.info.name, ear.info.writers[0][1]
    if writer in ear.stuck:
        text = f"{writer} is announced and answers nothing: it is stopped, frozen, or behind a dead link"
        return broken("writers", text, f"ps -o stat= -p {writer.pid}  # on {writer.host}; T: it is stopped")
    if session.zenoh.info.routers_zid():
        who = "to this identity" if session.probe is None else f"to {session.probe.identity}"
        text = (
            f"{robot!r} is alive, and nothing it says arrives: the router denies zstate/{robot}/** {who}; "
            "its access control lets those read whom it names as viewers"
        )
        return broken("access", text, "zstate acl --viewer NAME  # for the router; then it is started anew")
    text = f"{writer} is announced, and nothing it says arrives"
    return broken("writers", text, f"zstate echo {robot}")


def _version_check(ear: Ear) -> Check | None:
    for reason in _OF_VERSIONS:
        text = ear.listener.refusals.get(reason)
        if text:
            then = (
                "pip install -U zstate"
                if reason == "newer version"
                else f"zstate ls  # who is {ear.info.name}?"
            )
            return broken("version", text, then)
    return None


def model_check(ear: Ear) -> tuple[RobotModel | None, Check]:
    """What the robot says it is, where that can be used, and whether it can."""
    robot = ear.info.name
    if ear.description is None:
        return None, _no_model_check(ear)
    try:
        model = parse_urdf(ear.description.urdf, f"the URDF of {robot!r}")
    except ModelError as error:
        return None, broken("model", str(error), "zstate check FILE  # the file that its publisher was given")
    refused = ear.listener.refusals.get("robot description")
    if refused:
        return None, broken("model", refused, f"zstate tree {robot}")
    size = f"{count_text(len(model.links), 'link')}, {count_text(len(model.joint_names), 'joint')}"
    text = f"{model.name!r}: {size}, root {model.root!r}"
    if model.findings:
        first = model.findings[0]
        text += f"; {count_text(len(model.findings), 'warning')}, such as line {first.line}: {first.message}"
        return model, warning("model", text, "zstate check FILE")
    return model, ok("model", text)


def _no_model_check(ear: Ear) -> Check:
    robot = ear.info.name
    writers = ear.writers("robot_description")
    if writers:
        text = f"{writers[-1]} announces the model, which has not arrived"
        return broken("model", text, f"zstate doctor {robot} --timeout 10")
    if ear.followed == "tf":
        return ok("model", "nobody publishes one, and none is needed: poses come ready made on tf")
    return broken("model", f"nobody publishes the model of {robot!r}", publish_command_for("publish", robot))


def _samples_check(ear: Ear) -> Check:
    stream, robot, statistics = ear.followed, ear.info.name, ear.samples.statistics
    writers = ear.writers(stream)
    if not statistics.count and (not writers or "joint_states" not in ear.streams):
        return _nobody_check(ear)
    who = str(writers[-1]) if writers else "somebody unannounced"
    if not statistics.count:
        return broken(
            stream, f"{who} is there, but no sample comes: {_idle_text(ear)}", f"zstate echo {robot}"
        )
    refused = refused_check(ear)
    if refused is not None:
        return refused
    window = statistics.window()
    rate_hz = None if window is None else window.rate_hz
    if rate_hz is None:
        return warning(stream, f"one sample came from {who}; too few to tell a rate", f"zstate hz {robot}")
    if statistics.is_stale():
        text = f"samples of {who} came, and none for {_silence_text(ear)}"
        return broken(stream, text, f"zstate hz {robot} --stream {stream}")
    return _rate_check(ear, rate_hz, who)


def _silence_text(ear: Ear) -> str:
    return format_duration(round(ear.samples.statistics.silent_s() * 1e9))


def _nobody_check(ear: Ear) -> Check:
    robot, waiting = ear.info.name, ear.writers("tf")
    if "robot_description" not in ear.streams and not waiting:
        text = f"nobody writes joint_states of {robot!r}, nor tf: it stands still"
        return warning("joint_states", text, f"{publish_command_for('joints', robot)}  # moves it, for a try")
    waits = f", for which {waiting[-1]} waits" if waiting else ""
    text = f"nobody writes joint_states of {robot!r}{waits}: its driver is not running (any more)"
    others = [info.name for info in ear.neighbours if _streams(info) == {"joint_states"}]
    if others:
        text += f", or calls the robot {others[0]!r}, of which there are joint_states and no model"
        return broken("joint_states", text, publish_command_for("publish", others[0]))
    return broken(
        "joint_states", text, f"{publish_command_for('joints', robot)}  # moves it, until the driver runs"
    )


def _streams(info: RobotInfo) -> set[str]:
    return {stream for stream, _ in info.writers}


def _idle_text(ear: Ear) -> str:
    writer = ear.writers(ear.followed)[-1]
    status = ear.statuses.get(writer.session)
    if status is None:
        return "it says nothing else either: stopped, or frozen" if writer in ear.stuck else "it is slow"
    return f"it runs, but {status.text or 'publishes nothing'}"


def refused_check(ear: Ear) -> Check | None:
    """Why samples that came cannot be used; None where all can."""
    refused, texts = ear.listener.stats.refused, ear.listener.refusals
    reasons = [
        reason
        for reason, text in texts.items()
        if reason not in (*_OF_THE_MODEL, *_OF_VERSIONS) and not text.startswith(_OF_STATICS)
    ]
    if not reasons:
        return None
    reason = max(reasons, key=lambda one: refused[one])
    text = f"{count_text(refused[reason], 'message')} cannot be used ({reason}): {texts[reason]}"
    if ear.listener.stats.received:
        return warning(ear.followed, text, f"zstate monitor --robots --robot {ear.info.name}")
    return broken(ear.followed, text, f"zstate echo {ear.info.name} --once")


def _rate_check(ear: Ear, rate_hz: float, who: str) -> Check:
    stream, robot, stats = ear.followed, ear.info.name, ear.listener.stats
    text = f"{rate_hz:.1f} Hz from {who}"
    status = ear.statuses.get(ear.samples.statistics.session)
    if status is not None and rate_hz < _FEWER * status.rate_hz:
        text += f", which sends {status.rate_hz:.1f} Hz: the rest is lost, or thinned by a router, on the way"
        return warning(stream, text, f"zstate hz {robot} --stream {stream}")
    if stats.missed + stats.dropped > _FEWER * ear.samples.statistics.count:
        text += f"; {stats.missed} were lost on the way and {stats.dropped} here"
        return warning(stream, text, f"zstate monitor --robots --robot {robot}")
    return ok(stream, f"{text}, newest {_silence_text(ear)} ago")


def limits_check(ear: Ear, model: RobotModel, ranges: Iterable[Ranges], echo: str) -> Iterator[Check]:
    """Warnings where joint positions of ``model`` are outside its limits; ``echo`` prints them."""
    limits = JointLimits(model)
    found = [limits.explanation(of_writer.positions(model)) for of_writer in ranges]
    said = [status.text for status in ear.statuses.values() if ARE_OUTSIDE in status.text]
    for text in list(filter(None, found)) or said[:1]:
        yield warning("limits", text, f"{echo} --once  # `zstate check FILE --joints` shows the limits")


def statics_check(ear: Ear) -> Check:
    """Whether all who announce fixed edges place some."""
    frames = ear.listener.buffer.frames()
    owned = [frame for frame in frames if frame.kind == "static"]
    heard = {frame.writer for frame in owned}
    others = {name: writer for name, writer in ear.info.static_names if name != MODEL_WRITER}
    silent = [name for name in others if name not in heard]
    refused = _refused_static(ear) or _foreign_static(ear, owned)
    if refused is not None:
        then = f"zstate tree {ear.info.name}  # the frames without that edge; end its writer, or correct it"
        return warning("tf_static", without_program_advice(refused), then)
    if silent:
        text = f"{others[silent[0]]} announces static edges as {silent[0]!r}, and places no frame"
        return warning("tf_static", text, f"zstate tree {ear.info.name}")
    return ok("tf_static", f"{count_text(len(owned), 'fixed edge')}")


def _refused_static(ear: Ear) -> str | None:
    """Why a static edge is not used, and whose it is."""
    found = (text for text in ear.listener.refusals.values() if text.startswith(_OF_STATICS))
    refused = next(found, None)
    for name, writer in ear.info.static_names:
        if refused is not None and refused.startswith(f"{_OF_STATICS} {name!r}:"):
            return refused.replace(f"{name!r}:", f"{name!r} ({writer}):", 1)
    return refused


def _foreign_static(ear: Ear, owned: Iterable[FrameInfo]) -> str | None:
    """Which static edge of this robot is refused by readers of all robots."""
    robots = {info.name for info in ear.neighbours}
    for frame in owned:
        text = foreign_edge_problem(ear.info.name, (frame.parent or "", frame.name), robots)
        if text and not ear.nodes:  # in ROS all writers share all frames
            return f"{_OF_STATICS} {frame.writer!r}: {text}"
    return None


def poses_check(ear: Ear, model: RobotModel | None) -> Check:
    """Whether the frames hang together, and a pose of the outermost is known."""
    frames, robot = ear.listener.buffer.frames(), ear.info.name
    roots = sorted(frame.name for frame in frames if frame.parent is None)
    if len(roots) > 1:
        return _trees_check(ear, frames, roots)
    is_driven = "joint_states" in ear.streams and model is not None
    if not (ear.samples.statistics.count or is_driven or (model is not None and not model.joint_names)):
        return skipped("poses", "no joint positions")
    if not frames:
        return skipped("poses", "no frame is known")
    ends = representative_links(model, 1) if model is not None else ()
    target, source = roots[0], f"{robot}/{ends[0]}" if ends else frames[-1].name
    try:
        ear.listener.buffer.lookup(target, source)
    except LookupFailed as error:
        if not ear.samples.statistics.count:
            return skipped("poses", f"no joint positions: {error}")
        return broken("poses", str(error), f"zstate tf {target} {source}")
    return ok("poses", f"{count_text(len(frames), 'frame')} in one tree; {source} in {target} is known")


def _trees_check(ear: Ear, frames: Sequence[FrameInfo], roots: Sequence[str]) -> Check:
    """Frames that are not joined: by a name that is nearly right, or by an edge that is missing."""
    text = f"{count_text(len(frames), 'frame')} in {len(roots)} trees, with the roots {', '.join(roots)}"
    for frame in static_roots(ear):
        root = frame.parent or ""
        near = similar_frames(root, {frame.name for frame in frames} - {root})
        if near:
            robot, _, bare = root.partition("/")
            text = f"{text}: {bare!r} is near {near[0]!r}, and {frame.name!r} is on it"
            then = f"zstate tree {robot}  # if {near[0]!r} is meant, start {frame.writer} with that name"
            return warning("poses", text, then)
    return warning("poses", text, f"zstate static {roots[0]} {roots[1]} --xyz 0 0 0  # joins two of them")


def shared_roots_checks(tops: Iterable[FrameInfo]) -> Iterator[Check]:
    """Warnings where several robots each have a frame of the same name on top, such as a/map and b/map.

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


def static_roots(ear: Ear) -> Iterator[FrameInfo]:
    """For each root of its own that no model places anything on: one of the frames there."""
    frames = ear.listener.buffer.frames()
    writers = {name for name, _ in ear.info.static_names if name != MODEL_WRITER}
    for root in frames:
        on_it = [frame for frame in frames if frame.parent == root.name]
        is_own = root.parent is None and root.name.startswith(f"{ear.info.name}/")
        if is_own and on_it and all(frame.writer in writers for frame in on_it):
            yield on_it[0]
