"""A robot's recorded episode as a sequence that is followed from where its joint log begins."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices, Picture
from drake_pose.body import PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import load_camera_file
from drake_pose.camera.episode import Episode, EpisodeCamera, JointLog
from drake_pose.camera.episode_files import open_episode, with_intrinsics
from drake_pose.camera.joint_map import map_joints, read_joint_map
from drake_pose.camera.picture_files import frame_key
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.files.settings import EpisodeSettings
from drake_pose.jobs.estimate.measurements import TrueAngles
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, Scene, select_frames

# What tells an episode from a scene of masks.
_OF_EPISODES = ("videos", "images", "meta/info.json", "trajectory.h5", "metadata.yaml")
_BAGS = ("*.mcap", "*.bag", "*.db3")
# Pictures of several cameras are of one moment that are nearer than this share of a period.
_NEAR = 0.5


class PlacedCameras(NamedTuple):
    """Cameras of an episode that are looked at, and the names of those whose pose somebody says."""

    cameras: list[EpisodeCamera]
    placed: frozenset[str]


class MappedJoints(NamedTuple):
    """A joint log in a pose tree's terms.

    log: of the values ``asked`` of the tree; names: of all that are logged; unseen: nodes that
    joints move which are not logged, seen: the others.
    """

    log: JointLog
    asked: Indices
    names: tuple[str, ...]
    seen: tuple[str, ...]
    unseen: tuple[str, ...]
    warnings: list[str]


def is_episode(path: Path, settings: EpisodeSettings) -> bool:
    """Whether a path is one of pictures and joints, and no scene of masks."""
    if path.is_file() or settings.episode is not None:
        return True
    if (path / "masks").is_dir():
        return False
    return any((path / one).exists() for one in _OF_EPISODES) or any(
        found for pattern in _BAGS for found in path.glob(pattern)
    )


def cameras_of(
    episode: Episode, camera_path: Path | None, settings: EpisodeSettings
) -> PlacedCameras:
    """The cameras that are asked for, or all, as their file has them.

    Args:
        camera_path: in place of the episode's own.

    Raises:
        UnknownNameError: there is no such camera.
        CameraError: the file cannot be used, or is of other pictures.
    """
    for name in settings.cameras:
        if name not in episode.cameras:
            raise UnknownNameError("camera", name, episode.cameras, str(episode.path))
    wanted = settings.cameras or tuple(episode.cameras)
    chosen = [one for one in episode.cameras.values() if one.name in wanted]
    file = camera_path or episode.path / CAMERA_FILE
    if camera_path is None and not file.is_file():
        return PlacedCameras(chosen, frozenset())
    given = load_camera_file(file, distorted=True)
    chosen = [with_intrinsics(one, given, file) for one in chosen]
    return PlacedCameras(chosen, frozenset(given.cameras) - {*given.unplaced, *given.links})


def say_left_out(names: Iterable[str], placed: Collection[str]) -> list[str]:
    """That cameras are not used whose pose nobody says."""
    return [f"camera '{name}' has no X_WC: it is left out" for name in names if name not in placed]


def map_log(
    path: Path, joints: JointLog, tree: PoseTree, settings: EpisodeSettings
) -> MappedJoints:
    """The joint log in the tree's terms: which of its values it has, and the nodes that it tells.

    Values that nobody logged are the model's defaults.

    Raises DrakePoseError: names columns, joints or units at fault.
    """
    kinematics = TreeKinematics(tree)
    held = {tree.model.position_names[index] for index in tree.held}
    asked = np.array([k for k, name in enumerate(kinematics.names) if name not in held], np.intp)
    names = [kinematics.names[k] for k in asked]
    table = None if settings.joint_map is None else read_joint_map(settings.joint_map)
    mapped = map_joints(
        joints, names, kinematics.lower[asked], kinematics.upper[asked],
        kinematics.is_angle[asked], units=settings.units, table=table,
    )  # fmt: skip
    seen, unseen = _told_nodes(tree, mapped.not_logged)
    warnings, positions = list(mapped.warnings), mapped.log.positions
    if not seen:
        raise SceneError(
            f"{path}: no part of {tree.model.path.name} is moved by joints that are logged alone; "
            "give a joint map (--joint-map FILE), or hold the others (--hold NAME=VALUE)"
        )
    clipped = int(mapped.clipped.any(axis=1).sum())
    if clipped:
        # There, or beyond.
        positions = np.where(mapped.clipped, np.nan, positions)
        warnings.append(
            f"{clipped} of {len(positions)} rows have a reading at an end of its range, where a "
            "joint may be beyond it: they are not used"
        )
    default = kinematics.flatten(tree.default_values())[asked]
    missing = np.array([name in mapped.not_logged for name in names])
    log = replace(mapped.log, positions=np.where(missing, default, positions))
    logged = tuple(name for name in names if name not in mapped.not_logged)
    return MappedJoints(log, asked, logged, seen, unseen, warnings)


def _told_nodes(
    tree: PoseTree, not_logged: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The nodes that only logged joints move, and the others."""
    told: list[bool] = []
    for k, node in enumerate(tree.nodes):
        above = node.parent < 0 or told[node.parent]
        own = tree.nodes[tree.source(k)].value_names
        told.append(above and set(own).isdisjoint(not_logged))
    names = [(node.name, yes) for node, yes in zip(tree.nodes, told, strict=True)]
    return tuple(name for name, yes in names if yes), tuple(name for name, yes in names if not yes)


def frames_of(camera: EpisodeCamera) -> tuple[str, ...]:
    """The names of a camera's pictures: their own, or their numbers."""
    return camera.frames or tuple(f"{k:06d}" for k in range(len(camera.times)))


def rows_of(log: JointLog, camera: EpisodeCamera, kept: Indices, later: Array) -> Array:
    """(k, m) a log's positions so much later [s] than some of a camera's pictures, by time or name.

    Args:
        later: () or (k,); nothing where only names tell.
    """
    if is_timed(log, camera):
        return log.at(camera.times[kept] + later)
    every = frames_of(camera)
    return log.of_frames([every[k] for k in kept])


def is_timed(log: JointLog, camera: EpisodeCamera) -> bool:
    """Whether times tell which rows are of which pictures."""
    return log.times is not None and bool(np.isfinite(camera.times).any())


def kept_pictures(camera: EpisodeCamera, settings: EpisodeSettings) -> Indices:
    """Which of a camera's pictures are asked for; UnknownNameError: there is no such."""
    if settings.every < 1:
        raise SettingsError(f"every must be 1 or more, not {settings.every}")
    every = frames_of(camera)
    names = select_frames(every, settings.frames, f"camera '{camera.name}'")[:: settings.every]
    return np.array([every.index(name) for name in names], np.intp)


def read_episode_scene(
    path: Path, settings: EpisodeSettings, joints: Path | None, cameras: Path | None
) -> Scene:
    """An episode's pictures of cameras whose pose is known: a sequence without masks.

    Its frames are some of the first camera's pictures.

    Args:
        joints: a table of joint positions, in place of the episode's own.
        cameras: a camera file, in place of the episode's own.

    Raises DrakePoseError: names the file, camera or frame at fault; nobody says where a camera is.
    """
    episode = open_episode(path, joints=joints, episode=settings.episode)
    chosen, placed = cameras_of(episode, cameras, settings)
    if not placed.intersection(one.name for one in chosen):
        raise SceneError(
            f"{path}: nobody says where a camera stands; find out (drake-pose register), and give "
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
        numbers = _same_moments(first, kept, camera)
        images |= {(name, frames[k]): path for k in numbers}
        readers[name] = _reader(camera, {frames[k]: number for k, number in numbers.items()})
    return Scene(
        path, {name: one.camera for name, one in known.items() if one.camera is not None}, frames,
        {}, True, rate, images=images, readers=readers, times=times, joints=episode.joints,
        warnings=(*episode.warnings, *say_left_out([one.name for one in chosen], placed)),
    )  # fmt: skip


def _reader(camera: EpisodeCamera, numbers: Mapping[str, int]) -> Callable[[str], Picture]:
    """What gives a camera's picture (H, W, 3) of a frame."""
    return lambda frame: camera.read(numbers[frame])


def _same_moments(first: EpisodeCamera, kept: Indices, other: EpisodeCamera) -> dict[int, int]:
    """By how manieth of a camera's pictures another's of the same moment, where it has one."""
    if np.isnan(first.times).any() or np.isnan(other.times).any():
        own = {frame_key(name): k for k, name in enumerate(frames_of(other))}
        names = [frame_key(frames_of(first)[k]) for k in kept]
        return {k: own[name] for k, name in enumerate(names) if name in own}
    near = _NEAR * float(np.median(np.diff(first.times))) if len(first.times) > 1 else np.inf
    off = np.abs(other.times - first.times[kept][:, None])
    nearest = off.argmin(axis=1)
    return {k: int(n) for k, n in enumerate(nearest) if off[k, n] <= near}


def logged_positions(
    scene: Scene, tree: PoseTree, settings: EpisodeSettings
) -> tuple[TrueAngles | None, dict[str, Array], tuple[str, ...]]:
    """What a scene's joint log says: where joints are in frames, and the plant's positions (nq,).

    None and nothing where it has no log; then what a user should know.

    Raises DrakePoseError: names columns, joints or units at fault.
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
    return TrueAngles(scene.path, mapped.names, known), starts, tuple(mapped.warnings)
