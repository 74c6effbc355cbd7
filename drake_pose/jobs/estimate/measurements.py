"""Measured joint positions and joint centres by frame, from tables and from logs of episodes."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import compress
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.body import ParsedModel, PoseTree
from drake_pose.body.parsed_model import mimic_warnings
from drake_pose.body.plant_source import Coupling
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import load_camera_file
from drake_pose.camera.episode import Episode, JointLog, Stream
from drake_pose.camera.episode_files import (
    add_calibration,
    open_episode,
    read_joint_table,
    recorded_intrinsics,
    recording_format,
)
from drake_pose.camera.joint_map import map_joints, read_joint_map
from drake_pose.camera.models import intrinsics_warnings
from drake_pose.camera.picture_files import frame_key
from drake_pose.camera.servo_readings import Column, Servos, read_motors
from drake_pose.camera.sources import TIME_STAMPS
from drake_pose.errors import SceneError, require_at_least, require_known
from drake_pose.files.records import BASE_COLUMNS, FIT_COLUMNS
from drake_pose.files.settings import EpisodeSettings
from drake_pose.input_files import read_csv, read_number
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, Scene, select_frames

LARGEST = 1e6
"""Largest absolute value of a joint position in a table [rad or m]."""


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
    require_known("joint", (joint,), sorted({row[1] for _, row in rows}), str(path))
    known: dict[int | str, Array] = {}
    for line, row in rows:
        if row[1] != joint:
            continue
        if frame_key(row[0]) in known:
            raise SceneError(f"{path}: line {line}: frame '{row[0]}' is given twice")
        try:
            known[frame_key(row[0])] = np.array([read_number(cell) for cell in row[2:]])
        except ValueError:
            raise SceneError(f"{path}: line {line} holds something that is not a number") from None
        if not np.isfinite(known[frame_key(row[0])]).all():
            raise SceneError(f"{path}: line {line} holds a number that is not finite")
    for frame in frames:
        if frame_key(frame) not in known:
            raise SceneError(
                f"{path}: has no row of joint '{joint}' in frame '{frame}'; leave that frame out "
                "(--frame), or choose a joint that is known there"
            )
    return {frame: known[frame_key(frame)] for frame in frames}


def read_measured_positions(path: Path, model: ParsedModel) -> JointLog:
    """Read joint positions from a table with the column ``frame`` and one a position of a model.

    Some positions may have no column. Frames are compared as numbers if they are numbers: frame 3
    is ``0003.png``. Positions are in rad and m, unless the limits tell other units; those of an
    estimate (poses.csv) always are, and its rows without a pose are skipped.

    Raises SceneError: the table cannot be used; UnknownNameError: the model does not have the
    position of a column.
    """
    log, warnings = read_joint_table(path)
    if not log.frames:
        raise SceneError(f"{path}: the first line must be frame and the names of positions")
    is_estimate, names, numbers, frames = False, log.names, log.positions, log.frames
    if names[-len(FIT_COLUMNS) :] == FIT_COLUMNS:
        is_estimate, has_pose = True, np.isfinite(numbers[:, names.index(FIT_COLUMNS[0])])
        names, numbers = names[: -len(FIT_COLUMNS)], numbers[has_pose, : -len(FIT_COLUMNS)]
        frames = tuple(compress(frames, has_pose))
    wrong = np.argwhere(~(np.abs(numbers) < LARGEST))
    if len(wrong):
        row, column = wrong[0]
        raise SceneError(
            f"{path}: column '{names[column]}', frame {frames[row]}: {numbers[row, column]:g} is "
            "no joint position; give it in rad or m"
        )
    bases = None
    if is_estimate and names[-len(BASE_COLUMNS) :] == BASE_COLUMNS:
        bases = numbers[:, -len(BASE_COLUMNS) :]
        names, numbers = names[: -len(BASE_COLUMNS)], numbers[:, : -len(BASE_COLUMNS)]
    free = model.is_unlimited_angle
    mapped = map_joints(
        JointLog(names, None, numbers, frames), model.position_names,
        np.where(free, -np.inf, model.lower), np.where(free, np.inf, model.upper),
        np.array([kind == "angle" for kind in model.position_kinds]),
        followers=[model.position_names[one.follower] for one in model.couplings], path=path,
    )  # fmt: skip
    joint_of = {column.name: joint for joint, column in mapped.columns.items()}
    found = tuple(joint_of[column] for column in names)
    positions = mapped.positions[:, [mapped.names.index(name) for name in found]]
    texts = (*warnings, *(f"{path}: {text}" for text in mapped.warnings))
    return JointLog(
        found, None, positions, frames, columns=mapped.columns, warnings=texts,
        is_estimate=is_estimate, bases=bases,
    )  # fmt: skip


def with_leaders(
    model: ParsedModel, followers: Sequence[Coupling], names: Sequence[str], positions: Array
) -> tuple[Array, dict[str, Coupling], list[str]]:
    """Return positions with those of joints whose followers alone are known (<mimic>).

    Args:
        model: the model.
        followers: how positions follow others, of the model or of a pose tree.
        names: (k,) names of the known positions.
        positions: (n, k) the positions [rad or m].

    Returns:
        positions (n, nq) of the model, nan where unknown; by name of a joint that follows from its
        follower, how this follows it; and warnings of these, and of followers that do not follow.
    """
    couplings, warnings = dict[str, Coupling](), list[str]()
    q = np.full((len(positions), len(model.position_names)), np.nan)
    q[:, [model.position_index(name) for name in names]] = positions
    for one in followers:
        follower, leader = (model.position_names[k] for k in (one.follower, one.leader))
        if follower in names and leader not in {*names, *couplings}:
            q[:, one.leader] = (q[:, one.follower] - one.offset) / one.multiplier
            couplings[leader] = one
            if one.follower in (coupling.follower for coupling in model.couplings):
                warnings.append(
                    f"joint '{leader}' is not logged: it follows from '{follower}', which is "
                    f"{one.multiplier:g} x '{leader}' {one.offset:+g} in the model (<mimic>)"
                )
    spans = model.upper - model.lower
    warnings += mimic_warnings(model.position_names, followers, q, spans)
    return q, couplings, warnings


def timed_positions(
    path: Path, pictures: Scene, tree: PoseTree, settings: EpisodeSettings
) -> tuple[JointLog, dict[str, Array], tuple[str, ...]]:
    """Return the positions of a table with a column `time` at the times of a scene's frames.

    With a column `frame`, too, they are those of the frames' rows.

    Args:
        path: the table, see `read_joint_table`.
        pictures: the scene, whose times may be unknown.
        tree: the pose tree, with its held values.
        settings: joint map and units.

    Returns:
        As `logged_positions`.

    Raises DrakePoseError: the message names the table, and columns, joints or units at fault; or
    the times are needed and none is known.
    """
    log, warnings = read_joint_table(path)
    times, frames = pictures.times, pictures.frames
    times = times if len(times) else np.full(len(frames), np.nan)
    if log.frames:
        log = replace(log, times=None)
    elif np.isnan(times).all():
        raise SceneError(
            f"{path}: has times, but those of the pictures are not known: give a column 'frame', "
            f"or the pictures' times ({TIME_STAMPS}, or frame_rate_hz in scene.yaml)"
        )
    scene = Scene(path, {}, frames, {}, times=times, joints=log)
    found, starts, more = logged_positions(scene, tree, settings)
    assert found is not None
    return found, starts, (*warnings, *more)


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
) -> tuple[list[Stream], frozenset[str], tuple[str, ...]]:
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
        return chosen, frozenset(k.name for k in chosen if k.is_posed and k.link is None), ()
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


def map_log(path: Path, joints: JointLog, tree: PoseTree, settings: EpisodeSettings) -> JointLog:
    """Return a joint log in the values of a pose tree that are not held [rad or m].

    Values that are not logged are the model's defaults; `not_logged` names them.

    Args:
        path: the episode, for messages.
        joints: the joint log.
        tree: the pose tree.
        settings: joint map and units; None: inferred.

    Raises DrakePoseError: the message names columns, joints or units at fault.
    """
    kinematics, model = TreeKinematics(tree), tree.model
    held = {model.position_names[index] for index in tree.held}
    asked = np.array([k for k, name in enumerate(kinematics.names) if name not in held], np.intp)
    following = [one.follower for one in tree.followers]
    names = tuple(kinematics.names[k] for k in asked)
    followers = tuple(model.position_names[k] for k in following)
    table, servos = None, joints.servos or Servos()
    if settings.joint_map is not None:
        given = read_motors(settings.joint_map, servos.robot)
        joints = joints if given is None else replace(joints, servos=given)
        table = read_joint_map(settings.joint_map) if given is None else None
    mapped = map_joints(
        joints, (*names, *followers),
        np.append(kinematics.lower[asked], model.lower[following]),
        np.append(kinematics.upper[asked], model.upper[following]),
        np.append(
            kinematics.is_angle[asked], [model.position_kinds[k] == "angle" for k in following]
        ),
        followers=followers, units=settings.units, table=table,
    )  # fmt: skip
    columns, logged = dict(mapped.columns), [one in mapped.columns for one in mapped.names]
    known = [name for name in mapped.names if name in columns]
    q, couplings, texts = with_leaders(model, tree.followers, known, mapped.positions[:, logged])
    for name, (follower, _, multiplier, offset) in couplings.items():
        one = mapped.columns[model.position_names[follower]]
        columns[name] = Column(one.name, one.scale / multiplier, (one.offset - offset) / multiplier)
    warnings = [*mapped.warnings, *texts]
    missing = [name for name in names if name not in columns]
    if missing:
        warnings.append(
            f"joints that are not logged: {', '.join(missing)}; hold them (--hold) or map columns "
            "to them (joint map)"
        )
    clipped = int(np.count_nonzero(mapped.clipped is not None and mapped.clipped.any(axis=1)))
    if clipped:
        # Most joints are there: an arm rests against its stops.
        warnings.append(
            f"in {clipped} of {len(q)} rows a reading is at an end of its range: the joint may be "
            "beyond it"
        )
    default = kinematics.flatten(tree.default_values())[asked]
    places = [model.position_index(name) for name in names]
    positions = np.where([name in missing for name in names], default, q[:, places])
    log = replace(
        mapped, names=names, positions=positions, warnings=tuple(warnings),
        columns={name: columns[name] for name in names if name in columns},
    )  # fmt: skip
    if not posed_nodes(tree, log):
        raise SceneError(
            f"{path}: every part of {model.path.name} is moved by a joint that is not logged; give "
            "a joint map (--joint-map FILE), or hold these joints (--hold NAME=VALUE)"
        )
    return log


def posed_nodes(tree: PoseTree, log: JointLog) -> tuple[str, ...]:
    """Return the names of a tree's nodes that only logged or held joints move."""
    is_posed: list[bool] = []
    for k, node in enumerate(tree.nodes):
        own = tree.nodes[tree.source(k)].value_names
        above = node.parent < 0 or is_posed[node.parent]
        is_posed.append(above and set(own).isdisjoint(log.not_logged))
    return tuple(node.name for node, known in zip(tree.nodes, is_posed, strict=True) if known)


def rows_of(log: JointLog, camera: Stream, kept: Indices, later: Array) -> Array:
    """Return a log's positions (k, m) at pictures of a camera, by time or name; nan: no value.

    ``kept``: (k,) indices of pictures. ``later``: () or (k,) time offset added to their times [s].
    """
    if is_timed(log, camera):
        return log.at(camera.times[kept] + later)
    every = camera.names
    return log.of_frames([every[k] for k in kept])


def is_timed(log: JointLog, camera: Stream) -> bool:
    """Return whether rows of the log belong to pictures by time; else by name."""
    return log.times is not None and bool(np.isfinite(camera.times).any())


def kept_pictures(camera: Stream, settings: EpisodeSettings) -> Indices:
    """Return the indices of a camera's pictures that are chosen by ``frames`` and ``every``.

    Raises SettingsError: ``every`` is below 1; UnknownNameError: a frame does not exist.
    """
    require_at_least(1, every=settings.every)
    every = camera.names
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
    kept, names = kept_pictures(first, settings), first.names
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


def _read_frame(camera: Stream, numbers: Mapping[str, int], frame: str) -> Picture:
    """Return a camera's picture (H, W, 3) of a frame; ``numbers`` are picture indices by frame."""
    return camera.read(numbers[frame])


def _synchronised_pictures(
    first: Stream, kept: Indices, other: Stream, tolerance: float = 0.5
) -> dict[int, int]:
    """Return the index of another camera's synchronised picture by index into ``kept``.

    Pictures without a synchronised one have no entry. Without times pictures of the same name are
    synchronised.

    ``first``: the first camera. ``kept``: (k,) indices of its pictures. ``other``: the other
    camera. ``tolerance``: maximum difference of times, as a fraction of the first camera's period.
    """
    if np.isnan(first.times).any() or np.isnan(other.times).any():
        own = {frame_key(name): k for k, name in enumerate(other.names)}
        names = [frame_key(first.names[k]) for k in kept]
        return {k: own[name] for k, name in enumerate(names) if name in own}
    near = tolerance * float(np.median(np.diff(first.times))) if len(first.times) > 1 else np.inf
    off = np.abs(other.times - first.times[kept][:, None])
    nearest = off.argmin(axis=1)
    return {k: int(n) for k, n in enumerate(nearest) if off[k, n] <= near}


def logged_positions(
    scene: Scene, tree: PoseTree, settings: EpisodeSettings
) -> tuple[JointLog | None, dict[str, Array], tuple[str, ...]]:
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
    log, times = map_log(scene.path, scene.joints, tree, settings), scene.times
    kinematics = TreeKinematics(tree)
    values = np.tile(kinematics.flatten(tree.default_values()), (len(scene.frames), 1))
    by_frame = log.times is None or np.isnan(times).all()
    asked = [kinematics.names.index(name) for name in log.names]
    values[:, asked] = log.of_frames(scene.frames) if by_frame else log.at(times)
    starts = {
        frame: tree.positions_from(kinematics.split(row))[0]
        for frame, row in zip(scene.frames, values, strict=True)
        if np.isfinite(row).all()
    }
    names = tuple(name for name in log.names if name in log.columns)
    places = [tree.model.position_index(name) for name in names]
    known = np.array([q[places] for q in starts.values()]).reshape(-1, len(names))
    return JointLog(names, None, known, tuple(starts)), starts, log.warnings
