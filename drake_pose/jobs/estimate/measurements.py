"""Measured joint positions and joint centres by frame, from tables and from logs of episodes."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.body import ParsedModel, PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import load_camera_file
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog
from drake_pose.camera.episode_files import (
    add_calibration,
    open_episode,
    picture_times,
    read_joint_table,
    recorded_intrinsics,
    recording_format,
)
from drake_pose.camera.joint_map import (
    MappedJoints,
    follower_warnings,
    map_joints,
    read_joint_map,
    without_followers,
)
from drake_pose.camera.models import intrinsics_warnings
from drake_pose.camera.picture_files import VIDEOS, frame_key
from drake_pose.camera.servo_readings import Column, Servos, read_motors
from drake_pose.camera.sources import TIME_STAMPS
from drake_pose.errors import SceneError, require_at_least, require_known
from drake_pose.files.records import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.files.settings import EpisodeSettings
from drake_pose.input_files import read_csv, read_number
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, SCENE_FILE, Scene, select_frames


@dataclass(frozen=True)
class MeasuredPositions:
    """Joint positions of a table."""

    path: Path  # The table.
    names: tuple[str, ...]  # Names of the positions.
    # (len(names),) positions [rad or m] by frame, see `frame_key`.
    values: Mapping[int | str, np.ndarray]
    # (7,) BASE_COLUMNS by frame, from an estimate whose base moved; otherwise empty.
    bases: Mapping[int | str, np.ndarray] = field(default_factory=dict)
    is_estimate: bool = False  # Whether the table is the poses.csv of an estimate.

    def of(self, frame: str) -> np.ndarray | None:
        """Return the values (len(names),) of a frame; None if it has no row."""
        return self.values.get(frame_key(frame))


def read_joint_centres(path: Path, joint: str, frames: Sequence[str]) -> dict[str, np.ndarray]:
    """Return a joint's position (3,) [m] by frame, from a table ``frame,joint,x,y,z``.

    Each name in ``frames`` must have a row. Frames are compared as numbers: frame 3 is
    ``0003.png``.

    Raises SceneError: the table cannot be read, or a frame has no row; UnknownNameError: the table
    does not have the joint.
    """
    header, rows = read_csv(path, SceneError)
    if header != ["frame", "joint", "x", "y", "z"]:
        raise SceneError(f"{path}: the first line must be frame,joint,x,y,z")
    joints = sorted({row[1] for _, row in rows})
    require_known("joint", (joint,), joints, str(path))
    known: dict[int | str, np.ndarray] = {}
    for line, row in rows:
        if row[1] == joint:
            if frame_key(row[0]) in known:
                raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
            known[frame_key(row[0])] = _numbers(row[2:], path, line)
    for frame in frames:
        if frame_key(frame) not in known:
            raise SceneError(
                f"{path}: has no row of joint '{joint}' in frame '{frame}'; leave that frame out "
                "(--frame), or choose a joint that is known there"
            )
    return {frame: known[frame_key(frame)] for frame in frames}


def read_measured_positions(path: Path, position_names: Sequence[str]) -> MeasuredPositions:
    """Read joint positions [rad or m] from a table with the column ``frame`` and one a position.

    ``position_names`` are those of the model, of which some may have no column. Frames are compared
    as numbers if they are numbers: frame 3 is ``0003.png``. Rows of poses.csv without a pose are
    skipped.

    Raises SceneError: the table cannot be read, or has a column or frame twice; UnknownNameError:
    the model does not have the position of a column.
    """
    header, rows = read_csv(path, SceneError)
    if len(header) < 2 or header[0] != "frame":
        raise SceneError(f"{path}: the first line must be frame and the names of positions")
    is_estimate = tuple(header[-2:]) == FIT_COLUMNS
    last = len(header) - len(FIT_COLUMNS) if is_estimate else len(header)
    with_base = is_estimate and tuple(header[last - len(BASE_COLUMNS) : last]) == BASE_COLUMNS
    end = last - len(BASE_COLUMNS) if with_base else last
    where = f"{path} has an unknown column; the model"
    require_known("position", header[1:end], position_names, where)
    for name in header[1:end]:
        if header.count(name) > 1:
            raise SceneError(f"{path}: has the column '{name}' twice")
    values: dict[int | str, np.ndarray] = {}
    bases: dict[int | str, np.ndarray] = {}
    for line, row in rows:
        frame = frame_key(row[0])
        if frame in values:
            raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
        if is_estimate and row[last] in ("", "nan"):
            continue
        values[frame] = _numbers(row[1:end], path, line)
        if with_base:
            bases[frame] = _numbers(row[end:last], path, line)
    return MeasuredPositions(path, tuple(header[1:end]), values, bases, is_estimate)


def has_times(path: Path) -> bool:
    """Return whether a CSV table has a column `time`; SceneError: it is unreadable."""
    return "time" in read_csv(path, SceneError)[0]


def frame_times(scene: Scene) -> dict[str, float]:
    """Return the time [s] of each frame of a scene, by name; nan where unknown.

    They are the scene's own, or those of the first camera's pictures.

    Raises SceneError: a file is unreadable.
    """
    if len(scene.times) or not scene.images:
        times = scene.times if len(scene.times) else np.full(len(scene.frames), np.nan)
        return dict(zip(scene.frames, times.tolist(), strict=True))
    camera = next(iter(scene.images))[0]
    files = {frame: path for (name, frame), path in scene.images.items() if name == camera}
    first = next(iter(files.values()))
    is_video = first.suffix.lower() in VIDEOS
    found = picture_times(first if is_video else files, scene.path / SCENE_FILE)
    of_key = {frame_key(frame): time for frame, time in found.items()}
    return {frame: of_key.get(frame_key(frame), math.nan) for frame in scene.frames}


def timed_positions(
    path: Path, times: Mapping[str, float], tree: PoseTree, settings: EpisodeSettings
) -> tuple[MeasuredPositions, dict[str, Array], tuple[str, ...]]:
    """Return the positions of a table with a column `time` at the times [s] of frames.

    With a column `frame`, too, they are those of the frames' rows.

    Args:
        path: the table, see `read_joint_table`.
        times: time [s] of each frame, by name; nan: unknown.
        tree: the pose tree, with its held values.
        settings: joint map and units.

    Returns:
        As `logged_positions`.

    Raises DrakePoseError: the message names the table, and columns, joints or units at fault; or
    the times are needed and none is known.
    """
    log, warnings = read_joint_table(path)
    own = np.array([*times.values()], dtype=np.float64)
    if log.frames:
        log = replace(log, times=None)
    elif np.isnan(own).all():
        raise SceneError(
            f"{path}: has times, but those of the pictures are not known: give a column 'frame', "
            f"or the pictures' times ({TIME_STAMPS}, or frame_rate_hz in scene.yaml)"
        )
    scene = Scene(path, {}, tuple(times), {}, times=own, joints=log)
    found, starts, more = logged_positions(scene, tree, settings)
    assert found is not None
    return found, starts, (*warnings, *more)


def check_units(
    path: Path,
    model: ParsedModel,
    names: Sequence[str],
    known: Mapping[int | str, np.ndarray],
    slack: float = 0.1,
    millimetres_from: float = 20.0,
    largest: float = 1e6,
) -> tuple[str, ...]:
    """Return warnings of measured positions outside their limits.

    Args:
        path: the table.
        model: the model with the limits.
        names: names of the positions.
        known: (len(names),) values by frame [rad or m].
        slack: tolerance beyond the limits, of an angle [rad], of a length as a fraction of its
            range.
        millimetres_from: multiple of its limits beyond which a length may be in millimetres; an
            angle may be in degrees if it is more than a full turn beyond its limits.
        largest: largest absolute value of any position [rad or m].

    Raises SceneError: values are in degrees or millimetres, or too large for positions.
    """
    warnings = []
    for frame, row in known.items():
        for name, value in zip(names, row, strict=True):
            if abs(value) > largest:
                raise SceneError(
                    f"{path}: column '{name}', frame {frame}: {value:g} is too large for a "
                    "joint position; give it in rad or m"
                )
    for k, name in enumerate(names if known else ()):
        place = model.position_index(name)
        lower, upper = model.lower[place], model.upper[place]
        if not np.isfinite([lower, upper]).all():
            continue
        values = np.array([row[k] for row in known.values()])
        what, unit, other, scale = "length", "m", "metres", 1e-3
        allowed = slack * (upper - lower)
        most = millimetres_from * max(abs(lower), abs(upper))
        if is_angle := model.position_kinds[place] == "angle":
            what, unit, other, scale = "angle", "rad", "radians", math.pi / 180.0
            allowed = slack
            most = max(abs(lower), abs(upper)) + 2.0 * math.pi + allowed
        off = np.maximum(lower - values, values - upper)
        worst = int(np.argmax(off))
        if off[worst] <= allowed:
            continue
        text = (
            f"{path}: column '{name}', frame {list(known)[worst]}: {values[worst]:g} {unit} "
            f"lies outside the joint's limits, {lower:.4g} to {upper:.4g} {unit}"
        )
        scaled = scale * values
        inside = (lower - allowed <= scaled) & (scaled <= upper + allowed)
        if np.abs(values).max() > most and inside.all():
            wrong = "degrees" if unit == "rad" else "millimetres"
            raise SceneError(
                f"{text}, but not in {wrong}: the column seems to be in {wrong}; write every "
                f"{what} in {other}"
            )
        why = "; check the column's joint, its offset, sign and unit"
        turn = math.copysign(2.0 * math.pi, values[worst])
        if is_angle and lower - allowed <= values[worst] - turn <= upper + allowed:
            why = (
                f"; a full turn off, {values[worst] - turn:.4g} rad, it would not; check whether "
                "the encoder counts a turn too many, or whether the angles are in degrees"
            )
        warnings.append(f"{text}{why}")
    return tuple(warnings)


def _numbers(cells: Sequence[str], path: Path, line: int) -> np.ndarray:
    """Return the finite numbers (n,) in cells of a table's line.

    Raises SceneError: a cell is no finite number; the message names ``path`` and ``line``.
    """
    try:
        numbers = np.array([read_number(cell) for cell in cells])
    except ValueError:
        raise SceneError(f"{path}: line {line} holds something that is not a number") from None
    if not np.isfinite(numbers).all():
        raise SceneError(f"{path}: line {line} holds a number that is not finite")
    return numbers


class TreeLog(NamedTuple):
    """A joint log in the values of a pose tree."""

    # Positions (rows, asked) of the tree's values ``asked`` [rad or m]; nan for readings that are
    # not used, the model's defaults for values that are not logged.
    log: JointLog
    asked: Indices  # (asked,) indices of the tree's values that are not held.
    names: tuple[str, ...]  # Names of the logged values.
    posed: tuple[str, ...]  # Nodes that only logged or held joints move.
    unposed: tuple[str, ...]  # All other nodes.
    warnings: list[str]  # Messages for the user.
    mapped: MappedJoints  # How the columns were mapped.


def is_episode(path: Path, settings: EpisodeSettings) -> bool:
    """Return whether a path is an episode (pictures and joint log), not a scene of masks.

    It is one if it is a file, the settings have the number of an episode, or it has no folder masks
    and the format of a recording.
    """
    if path.is_file() or settings.episode is not None:
        return True
    return not (path / "masks").is_dir() and recording_format(path) != ""


def cameras_of(
    episode: Episode, camera_path: Path | None, settings: EpisodeSettings
) -> tuple[list[EpisodeCamera], frozenset[str], tuple[str, ...]]:
    """Return the chosen cameras of an episode with the calibration of their camera file.

    Also return the names of all cameras with a known, static pose X_WC, and how the camera file was
    read where it does not say so itself.

    ``episode``: the episode. ``camera_path``: camera file; None: the episode's cameras.yaml.
    Without either, cameras have the poses that were recorded with the episode. ``settings``: names
    of the cameras; all if none are given.

    Raises UnknownNameError: a camera does not exist; CameraError: the file cannot be used, or is
    for pictures of another size.
    """
    require_known("camera", settings.cameras, episode.cameras, str(episode.path))
    wanted = settings.cameras or tuple(episode.cameras)
    chosen = [one for one in episode.cameras.values() if one.name in wanted]
    file = camera_path or episode.path / CAMERA_FILE
    if camera_path is None and not file.is_file():
        return chosen, frozenset(one.name for one in chosen if one.is_posed), ()
    given = load_camera_file(
        file,
        distorted=True,
        known=partial(recorded_intrinsics, chosen, episode.path, settings.intrinsics),
        recording=episode.path,
    )
    chosen = [add_calibration(one, given, file) for one in chosen]
    placed = frozenset(given.cameras) - {*given.unplaced, *given.links}
    of_lenses = intrinsics_warnings(one.pinhole() for one in chosen)
    return chosen, placed, (*given.warnings, *of_lenses)


def left_out_warnings(names: Iterable[str], placed: Collection[str]) -> list[str]:
    """Return a warning for each camera of ``names`` without a pose: those that ``placed`` lacks."""
    return [
        f"camera '{name}' has no X_WC and is left out; drake-pose register finds its pose"
        for name in names
        if name not in placed
    ]


def map_log(path: Path, joints: JointLog, tree: PoseTree, settings: EpisodeSettings) -> TreeLog:
    """Return a joint log in the values of a pose tree; values not logged are the model's defaults.

    Args:
        path: the episode, for messages.
        joints: the joint log.
        tree: the pose tree, whose held values are left out.
        settings: joint map and units; None: inferred.

    Raises DrakePoseError: the message names columns, joints or units at fault.
    """
    kinematics = TreeKinematics(tree)
    held = {tree.model.position_names[index] for index in tree.held}
    asked = np.array([k for k, name in enumerate(kinematics.names) if name not in held], np.intp)
    names = [kinematics.names[k] for k in asked]
    table, servos = None, joints.servos or Servos()
    if settings.joint_map is not None:
        given = read_motors(settings.joint_map, servos.robot)
        joints = joints if given is None else replace(joints, servos=given)
        table = read_joint_map(settings.joint_map) if given is None else None
    followers, in_map = followers_of(tree), [one.name for one in (table or {}).values()]
    alone = without_followers(joints, followers, in_map)
    mapped = map_joints(
        alone, names, kinematics.lower[asked], kinematics.upper[asked],
        kinematics.is_angle[asked], units=settings.units, table=table,
    )  # fmt: skip
    # A node is posed if its parent is, and its own joints are logged or held.
    is_posed: list[bool] = []
    for k, node in enumerate(tree.nodes):
        above = node.parent < 0 or is_posed[node.parent]
        own = tree.nodes[tree.source(k)].value_names
        is_posed.append(above and set(own).isdisjoint(mapped.not_logged))
    nodes = list(zip(tree.nodes, is_posed, strict=True))
    posed = tuple(node.name for node, known in nodes if known)
    unposed = tuple(node.name for node, known in nodes if not known)
    warnings, positions = list(mapped.warnings), mapped.log.positions
    ranges = dict(zip(kinematics.names, kinematics.upper - kinematics.lower, strict=True))
    warnings += follower_warnings(joints, mapped.columns, followers, ranges)
    if not posed:
        raise SceneError(
            f"{path}: every part of {tree.model.path.name} is moved by a joint that is not logged; "
            "give a joint map (--joint-map FILE), or hold these joints (--hold NAME=VALUE)"
        )
    clipped = int(mapped.clipped.any(axis=1).sum())
    if clipped:
        # Most joints are there: an arm rests against its stops.
        warnings.append(
            f"in {clipped} of {len(positions)} rows a reading is at an end of its range: the joint "
            "may be beyond it"
        )
    default = kinematics.flatten(tree.default_values())[asked]
    missing = np.array([name in mapped.not_logged for name in names])
    log = replace(mapped.log, positions=np.where(missing, default, positions))
    logged = tuple(name for name in names if name not in mapped.not_logged)
    return TreeLog(log, asked, logged, posed, unposed, warnings, mapped)


def followers_of(tree: PoseTree) -> dict[str, Column]:
    """Return by name of each position that follows another one (<mimic>) the map from the other."""
    names = tree.model.position_names
    return {names[a]: Column(names[b], scale, offset) for a, b, scale, offset in tree.followers}


def frames_of(camera: EpisodeCamera) -> tuple[str, ...]:
    """Return the names of a camera's pictures, six-digit numbers if they have none."""
    return camera.frames or tuple(f"{k:06d}" for k in range(len(camera.times)))


def rows_of(log: JointLog, camera: EpisodeCamera, kept: Indices, later: Array) -> Array:
    """Return a log's positions (k, m) at pictures of a camera, by time or name; nan: no value.

    ``kept``: (k,) indices of pictures. ``later``: () or (k,) time offset added to their times [s].
    """
    if is_timed(log, camera):
        return log.at(camera.times[kept] + later)
    every = frames_of(camera)
    return log.of_frames([every[k] for k in kept])


def is_timed(log: JointLog, camera: EpisodeCamera) -> bool:
    """Return whether rows of the log belong to pictures by time; else by name."""
    return log.times is not None and bool(np.isfinite(camera.times).any())


def kept_pictures(camera: EpisodeCamera, settings: EpisodeSettings) -> Indices:
    """Return the indices of a camera's pictures that are chosen by ``frames`` and ``every``.

    Raises SettingsError: ``every`` is below 1; UnknownNameError: a frame does not exist.
    """
    require_at_least(1, every=settings.every)
    every = frames_of(camera)
    names = select_frames(every, settings.frames, f"camera '{camera.name}'")[:: settings.every]
    return np.array([every.index(name) for name in names], np.intp)


def read_episode_scene(
    path: Path, settings: EpisodeSettings, joints: Path | None, cameras: Path | None
) -> Scene:
    """Return an episode's cameras with known poses as a scene: a sequence without masks.

    The frames are the chosen pictures of the first camera; other cameras are synchronised with it.

    Args:
        path: the episode.
        settings: cameras, frames and joint log.
        joints: table of joint positions; None: the episode's own.
        cameras: camera file; None: the episode's own.

    Raises DrakePoseError: the message names the file, camera or frame at fault; or no camera's pose
    is known.
    """
    episode = open_episode(path, joints=joints, episode=settings.episode)
    chosen, placed, read = cameras_of(episode, cameras, settings)
    if not placed.intersection(one.name for one in chosen):
        raise SceneError(
            f"{path}: no camera has a pose X_WC; find the poses (drake-pose register), and give "
            "the cameras.yaml that it writes (--cameras FILE)"
        )
    known = {one.name: one for one in chosen if one.name in placed and one.camera is not None}
    first = next(iter(known.values()))
    kept, names = kept_pictures(first, settings), frames_of(first)
    frames, times = tuple(names[k] for k in kept), first.times[kept]
    steps = np.diff(times)
    rate = None if not len(steps) or np.isnan(steps).any() else 1.0 / float(np.median(steps))
    images, readers = dict[tuple[str, str], Path](), dict[str, Callable[[str], Picture]]()
    for name, camera in known.items():
        numbers = _synchronised_pictures(first, kept, camera)
        images |= {(name, frames[k]): path for k in numbers}
        of_frame = {frames[k]: number for k, number in numbers.items()}
        readers[name] = partial(_read_frame, camera, of_frame)
    return Scene(
        path, {name: one.camera for name, one in known.items() if one.camera is not None}, frames,
        {}, True, rate, images=images, readers=readers, times=times, joints=episode.joints,
        warnings=(
            *episode.warnings, *read, *left_out_warnings([one.name for one in chosen], placed)
        ),
    )  # fmt: skip


def _read_frame(camera: EpisodeCamera, numbers: Mapping[str, int], frame: str) -> Picture:
    """Return a camera's picture (H, W, 3) of a frame; ``numbers`` are picture indices by frame."""
    return camera.read(numbers[frame])


def _synchronised_pictures(
    first: EpisodeCamera, kept: Indices, other: EpisodeCamera, tolerance: float = 0.5
) -> dict[int, int]:
    """Return the index of another camera's synchronised picture by index into ``kept``.

    Pictures without a synchronised one have no entry. Without times pictures of the same name are
    synchronised.

    ``first``: the first camera. ``kept``: (k,) indices of its pictures. ``other``: the other
    camera. ``tolerance``: maximum difference of times, as a fraction of the first camera's period.
    """
    if np.isnan(first.times).any() or np.isnan(other.times).any():
        own = {frame_key(name): k for k, name in enumerate(frames_of(other))}
        names = [frame_key(frames_of(first)[k]) for k in kept]
        return {k: own[name] for k, name in enumerate(names) if name in own}
    near = tolerance * float(np.median(np.diff(first.times))) if len(first.times) > 1 else np.inf
    off = np.abs(other.times - first.times[kept][:, None])
    nearest = off.argmin(axis=1)
    return {k: int(n) for k, n in enumerate(nearest) if off[k, n] <= near}


def logged_positions(
    scene: Scene, tree: PoseTree, settings: EpisodeSettings
) -> tuple[MeasuredPositions | None, dict[str, Array], tuple[str, ...]]:
    """Return a scene's logged positions, the plant's positions (nq,) by frame, and warnings.

    The plant's positions [rad or m] have the model's defaults for joints that are not logged.
    Frames at which the log has no value are left out. Without a log (``scene.joints``) the result
    is (None, {}, ()).

    ``scene``: scene of `read_episode_scene`. ``tree``: the pose tree, with its held values.
    ``settings``: joint map and units. Raises DrakePoseError: the message names columns, joints or
    units at fault.
    """
    if scene.joints is None:
        return None, {}, ()
    mapped = map_log(scene.path, scene.joints, tree, settings)
    kinematics = TreeKinematics(tree)
    values = np.tile(kinematics.flatten(tree.default_values()), (len(scene.frames), 1))
    log, times = mapped.log, scene.times
    by_frame = log.times is None or np.isnan(times).all()
    values[:, mapped.asked] = log.of_frames(scene.frames) if by_frame else log.at(times)
    starts = {
        frame: tree.positions_from(kinematics.split(row))[0]
        for frame, row in zip(scene.frames, values, strict=True)
        if np.isfinite(row).all()
    }
    places = [tree.model.position_index(name) for name in mapped.names]
    known = {frame_key(frame): q[places] for frame, q in starts.items()}
    return MeasuredPositions(scene.path, mapped.names, known), starts, tuple(mapped.warnings)
