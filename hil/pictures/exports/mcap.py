"""A flight as an MCAP file, for Foxglove and PlotJuggler: poses, frames and texts in Foxglove's types, the rest as numbers.

Foxglove's types (protobuf): `/truth/pose` (`/cameras/pose` of a real flight), `/estimate/pose` and `/goal/pose`
(PoseInFrame), `/tf` (the frames world, goal, body and estimate for its 3-D panel), `/text` (Log). All other columns of
the log are JSON with a schema that names units and frames: `/truth/twist`, `/estimate/twist`, `/flaps`, `/estimate/flaps`
(deviations from the hover angle), and one topic for each other prefix of the log (`/link`, `/battery`, `/estimator`, …).
MCAP's times cannot be negative, so they count from the start of the log; the file's metadata `flight` has the time of the
release. Foxglove's SDK comes with the extra `export`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from firmware_py.extras import install_command
from firmware_py.geometry import from_euler_zyx, yaw_quaternion
from hil.errors import LabError, unlinked
from hil.laboratory.files.recorder import load_events, load_log, release_of
from hil.laboratory.metrics import body, column, is_real, known

try:
    import foxglove
    from foxglove import channels, messages
except ImportError as error:
    raise LabError(f"no MCAP file without its package ({error}): {install_command('export')}") from None

FILE = "flight.mcap"
NS_PER_US = 1000
WORLD, GOAL, BODY, ESTIMATE = "world", "goal", "body", "estimate"
POSE_COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz", "roll", "pitch", "yaw")  # in the poses, not as numbers
TWIST_COLUMNS = ("vx", "vy", "vz", "p", "q", "r")

Place = tuple[tuple[float, ...], tuple[float, ...]]  # position [m], quaternion w x y z


def write_mcap(folder: Path) -> Path:
    """Write `flight.mcap` from the log and the texts of a run folder and return its path. Raises `LabError`."""
    log, events = load_log(folder), load_events(folder)
    path = unlinked(folder / FILE)
    context = foxglove.Context()
    with foxglove.open_mcap(path, allow_overwrite=True, context=context) as writer:
        writer.write_metadata("flight", _metadata(log))
        log_rows(log, context)
        log_texts(events, context)
    return path


def log_rows(log: pa.Table, context: foxglove.Context) -> None:
    """Log the poses and numbers of rows; may be called again with the next ones."""
    _write_poses(log, context)
    for topic, columns in topics_of(log.column_names).items():
        _write_numbers(log, topic, columns, context)


def log_texts(events: Iterable[Mapping[str, Any]], context: foxglove.Context) -> None:
    """Log texts: `t_us`, `source`, `text`."""
    texts = channels.LogChannel("/text", context=context)
    for event in events:
        us = event["t_us"]
        text = messages.Log(
            timestamp=_timestamp(us), level=messages.LogLevel.Info, message=event["text"], name=event["source"]
        )  # fmt: skip
        texts.log(text, log_time=NS_PER_US * us)


def topics_of(names: list[str]) -> dict[str, list[str]]:
    """Return the columns of a log in each topic of numbers."""
    topics: dict[str, list[str]] = {}
    for name in names:
        prefix, _, rest = name.partition(".")
        if name == "t" or (prefix in ("truth", "cameras", "estimate", "goal") and rest in POSE_COLUMNS):
            continue
        topic = f"/{prefix}"
        if rest in TWIST_COLUMNS:
            topic = f"/{prefix}/twist"
        elif rest.startswith("flap_"):
            topic = "/estimate/flaps" if prefix == "estimate" else "/flaps"
        topics.setdefault(topic, []).append(name)
    return topics


def _metadata(log: pa.Table) -> dict[str, str]:
    known = {key.decode(): value.decode() for key, value in (log.schema.metadata or {}).items()}
    release_us = release_of(log.schema.metadata)
    return known | {"release_us": str(release_us)}


def _write_poses(log: pa.Table, context: foxglove.Context) -> None:
    eyes = "cameras" if is_real(log) else "truth"
    estimated = "estimate.x" in log.column_names
    shown = {
        name: channels.PoseInFrameChannel(f"/{name}/pose", context=context)
        for name in (eyes, "goal", *(["estimate"] if estimated else []))
    }
    tf = channels.FrameTransformsChannel("/tf", context=context)
    for us, truth, goal, estimate in _places(log):
        time, log_time = _timestamp(us), NS_PER_US * us
        for name, frame, place in ((eyes, WORLD, truth), ("goal", WORLD, goal), ("estimate", GOAL, estimate)):
            if name not in shown:
                continue
            pose = messages.Pose(position=_vector(place), orientation=_turn(place))
            shown[name].log(
                messages.PoseInFrame(timestamp=time, frame_id=frame, pose=pose), log_time=log_time
            )
        frames = ((WORLD, BODY, truth), (WORLD, GOAL, goal), (GOAL, ESTIMATE, estimate))
        transforms = [
            messages.FrameTransform(
                timestamp=time, parent_frame_id=parent, child_frame_id=child,
                translation=_vector(place), rotation=_turn(place),
            )
            for parent, child, place in frames[: 2 + estimated]
        ]  # fmt: skip
        tf.log(messages.FrameTransforms(transforms=transforms), log_time=log_time)


def _places(log: pa.Table) -> Iterator[tuple[int, Place, Place, Place]]:
    """Yield time [us], true pose of B in W, goal in W and estimate in G of every row."""
    log = known(log)
    truth = body(log, "x", "y", "z", "qw", "qx", "qy", "qz").tolist()
    goal = column(log, "goal.x", "goal.y", "goal.z", "goal.yaw").tolist()
    names = [f"estimate.{name}" for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    estimate = column(log, *names).tolist() if names[0] in log.column_names else [[0.0] * 6] * log.num_rows
    for us, p, g, e in zip(log.column("t").to_pylist(), truth, goal, estimate, strict=True):
        yield us, (p[:3], p[3:]), (g[:3], yaw_quaternion(g[3])), (e[:3], from_euler_zyx(*e[3:]))


def _write_numbers(log: pa.Table, topic: str, names: list[str], context: foxglove.Context) -> None:
    keys = [name.replace(".", "_") for name in names]
    schema = {
        "type": "object",
        "title": "floaty." + "".join(word.capitalize() for word in topic.split("/")),
        "properties": {key: _property(log.schema.field(name)) for key, name in zip(keys, names, strict=True)},
    }
    channel = foxglove.Channel(topic, schema=schema, context=context)
    rows = zip(log.column("t").to_pylist(), *(log.column(name).to_pylist() for name in names), strict=True)
    for us, *values in rows:
        message = {
            key: value if math.isfinite(value) else None for key, value in zip(keys, values, strict=True)
        }
        channel.log(message, log_time=NS_PER_US * us)


def _property(field: pa.Field) -> Mapping[str, Any]:
    known = field.metadata or {}
    unit, frame = (known.get(key, b"").decode() for key in (b"unit", b"frame"))
    about = [unit or "no unit", f"frame {frame}" if frame else ""]
    if field.name.startswith("estimate.flap_"):
        about.append("from the hover angle")
    return {
        "type": "integer" if pa.types.is_integer(field.type) else ["number", "null"],
        "description": ", ".join(filter(None, about)),
    }


def _timestamp(us: int) -> messages.Timestamp:
    return messages.Timestamp(us // 1_000_000, us % 1_000_000 * NS_PER_US)


def _vector(place: Place) -> messages.Vector3:
    x, y, z = place[0]
    return messages.Vector3(x=x, y=y, z=z)


def _turn(place: Place) -> messages.Quaternion:
    w, x, y, z = place[1]
    return messages.Quaternion(x=x, y=y, z=z, w=w)
