"""What a registration needs of an episode: pictures and joints by time, cameras, a body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import load_camera_file
from drake_pose.camera.episodes.episode import Episode, EpisodeCamera, JointLog
from drake_pose.camera.episodes.folder import with_intrinsics
from drake_pose.camera.episodes.joint_map import map_joints, read_joint_map
from drake_pose.camera.episodes.open import open_episode
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.registration.picture_registration import Recording
from drake_pose.silhouette.pictures.scene_files import select_frames
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE

Array = NDArray[np.float64]

# What tells an episode from a scene of masks.
_OF_EPISODES = ("videos", "images", "meta/info.json", "trajectory.h5", "metadata.yaml")
_BAGS = ("*.mcap", "*.bag", "*.db3")
# A camera of which nobody knows a focal length is taken to have this one [picture widths].
_USUAL_FOCAL = 0.95
# Some dozens of pictures are looked at, again and again.
_REMEMBERED = 64


@dataclass(frozen=True)
class EpisodeInputs:
    """Pictures of a robot, and its joints, by camera.

    Args:
        tree: the robot's pose tree in the world.
        seen: the nodes whose place the joints tell; None: all.
        cameras: what is known of them; those in ``assumed`` have a usual focal length.
        recordings: of the same cameras.
        placed: the names of those whose pose somebody says.
    """

    path: Path
    model: ArticulatedModel
    tree: PoseTree
    seen: tuple[str, ...] | None
    cameras: Mapping[str, PinholeCamera]
    assumed: frozenset[str]
    recordings: Mapping[str, Recording]
    warnings: tuple[str, ...]
    placed: frozenset[str]


def is_episode(path: Path, settings: AuditSettings) -> bool:
    """Whether a path is one of pictures and joints, and no scene of masks."""
    if path.is_file() or settings.pictures or settings.episode is not None:
        return True
    if (path / "masks").is_dir():
        return False
    return any((path / one).exists() for one in _OF_EPISODES) or any(
        found for pattern in _BAGS for found in path.glob(pattern)
    )


def read_episode(
    path: Path,
    model_path: Path,
    joints_path: Path | None,
    camera_path: Path | None,
    settings: AuditSettings,
) -> EpisodeInputs:
    """Reads and checks what an episode holds; pictures are read when they are asked for.

    Args:
        joints_path: a table of joint positions, in place of the episode's own.
        camera_path: a camera file, in place of the episode's own.

    Raises:
        DrakePoseError: names the file, camera, column or joint at fault.
    """
    episode = open_episode(path, joints=joints_path, episode=settings.episode)
    if episode.joints is None:
        raise SceneError(
            f"{path}: holds no joint positions, and none are given (--joints FILE): pictures alone "
            "do not tell where a robot stands"
        )
    model = load_model(model_path, package_paths=settings.packages)
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    log, asked, seen, warnings = _joints(path, episode.joints, tree, settings)
    chosen = _chosen_cameras(episode, settings)
    placed = frozenset[str]()
    file = camera_path or path / CAMERA_FILE
    if camera_path is not None or file.is_file():
        given = load_camera_file(file)
        chosen = [with_intrinsics(one, given, file) for one in chosen]
        placed = frozenset(given.cameras) - {*given.unplaced, *given.links}
    cameras, assumed = _known_cameras(chosen)
    default = TreeKinematics(tree).flatten(tree.default_values())
    recordings = {one.name: _recording(one, log, asked, default, settings) for one in chosen}
    said = (*episode.warnings, *model.warnings, *warnings)
    return EpisodeInputs(path, model, tree, seen, cameras, assumed, recordings, said, placed)


def _joints(
    path: Path, joints: JointLog, tree: PoseTree, settings: AuditSettings
) -> tuple[JointLog, NDArray[np.intp], tuple[str, ...] | None, list[str]]:
    """The joint log in the tree's terms: which of its values it has, and the nodes that it tells.

    Values that nobody logged are the model's defaults, and the nodes that they move not told; None:
    all are.
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
    if unseen:
        warnings.append(
            f"parts that joints move which are not logged are not looked at: {', '.join(unseen)}; "
            "where these joints stand still say so: --hold NAME=VALUE [deg or m]"
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
    return log, asked, seen if unseen else None, warnings


def _told_nodes(
    tree: PoseTree, not_logged: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The nodes that only logged joints move, and the others."""
    told: list[bool] = []
    for k, node in enumerate(tree.nodes):
        above = node.parent < 0 or told[node.parent]
        own = tree.nodes[tree.source(k)].value_names
        told.append(above and set(own).isdisjoint(not_logged))
    names = [node.name for node in tree.nodes]
    return (
        tuple(name for name, yes in zip(names, told, strict=True) if yes),
        tuple(name for name, yes in zip(names, told, strict=True) if not yes),
    )


def _chosen_cameras(episode: Episode, settings: AuditSettings) -> list[EpisodeCamera]:
    """The cameras that are asked for, or all."""
    for name in settings.cameras:
        if name not in episode.cameras:
            raise UnknownNameError("camera", name, episode.cameras, str(episode.path))
    wanted = settings.cameras or tuple(episode.cameras)
    return [one for one in episode.cameras.values() if one.name in wanted]


def _known_cameras(
    chosen: Sequence[EpisodeCamera],
) -> tuple[dict[str, PinholeCamera], frozenset[str]]:
    """What is known of cameras, and which have a focal length that is only usual."""
    cameras, assumed = dict[str, PinholeCamera](), set[str]()
    for one in chosen:
        camera = one.camera
        if camera is None:
            focal = _USUAL_FOCAL * one.width
            centre = 0.5 * (one.width - 1), 0.5 * (one.height - 1)
            camera = PinholeCamera(
                one.name, one.width, one.height, focal, focal, *centre, np.eye(4)
            )
            assumed.add(one.name)
        cameras[one.name] = replace(camera, name=one.name)
    return cameras, frozenset(assumed)


def _recording(
    camera: EpisodeCamera, log: JointLog, asked: NDArray[np.intp], default: Array,
    settings: AuditSettings,
) -> Recording:  # fmt: skip
    """A camera's pictures beside the joints; pictures of frames that are not asked for are out."""
    timed = log.times is not None and bool(np.isfinite(camera.times).any())
    every = camera.frames or tuple(f"{k:06d}" for k in range(len(camera.times)))
    if settings.every < 1:
        raise SettingsError(f"every must be 1 or more, not {settings.every}")
    names = select_frames(every, settings.frames, f"camera '{camera.name}'")[:: settings.every]
    kept = np.array([every.index(name) for name in names])

    def values_at(offset: float) -> Array:
        rows = log.at(camera.times[kept] + offset) if timed else log.of_frames(names)
        values = np.tile(default, (len(names), 1))
        values[:, asked] = rows
        return values

    @lru_cache(_REMEMBERED)
    def read(k: int) -> NDArray[np.uint8]:
        return camera.read(int(kept[k]))

    return Recording(names, values_at, read, timed)
