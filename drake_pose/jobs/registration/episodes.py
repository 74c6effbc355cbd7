"""What a registration needs of an episode: pictures and joints by time, cameras, a body."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.body.model import OBJECT, ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.episodes.episode import EpisodeCamera
from drake_pose.camera.episodes.open import open_episode
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SceneError, SettingsError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.episode import (
    MappedJoints,
    cameras_of,
    frames_of,
    is_episode,
    is_timed,
    kept_pictures,
    map_log,
    rows_of,
)
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.registration.settings import AuditSettings, RegistrationSettings
from drake_pose.registration.picture_registration import Recording
from drake_pose.registration.standing_object import StandingObject
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE

# A camera of which nobody knows a focal length is taken to have this one [picture widths].
_USUAL_FOCAL = 0.95
# Some dozens of pictures are looked at, again and again.
_REMEMBERED = 64


class GivenFiles(NamedTuple):
    """The files of a registration or an audit.

    joints: a table of joint positions; None: an episode's own, or they are estimated. cameras: a
    camera file in place of the scene's or episode's own; None: that.
    """

    scene: Path
    model: Path
    joints: Path | None = None
    cameras: Path | None = None

    @property
    def camera_file(self) -> Path:
        """What says what is known of the cameras."""
        return self.cameras or self.scene / CAMERA_FILE


@dataclass(frozen=True)
class EpisodeInputs:
    """Pictures of a robot, and its joints, by camera.

    Args:
        tree: the robot's pose tree in the world.
        seen: the nodes whose place the joints tell; None: all.
        cameras: what is known of them; those in ``assumed`` have a usual focal length.
        recordings: of the same cameras.
        placed: the names of those whose pose somebody says.
        standing: the object that cameras on a link see, in whose tree values are; None: they see
            the robot.
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
    standing: StandingObject | None = None


def looks_at_pictures(path: Path, settings: AuditSettings) -> bool:
    """Whether a scene is looked at as an episode: it is one, or is said to be."""
    return settings.pictures or is_episode(path, settings)


def read_episode(files: GivenFiles, settings: AuditSettings) -> EpisodeInputs:
    """Reads and checks what an episode holds; pictures are read when they are asked for.

    Raises DrakePoseError: names the file, camera, column or joint at fault.
    """
    path = files.scene
    episode = open_episode(path, joints=files.joints, episode=settings.episode)
    if episode.joints is None:
        raise SceneError(
            f"{path}: holds no joint positions, and none are given (--joints FILE): pictures alone "
            "do not tell where a robot stands"
        )
    model = load_model(files.model, package_paths=settings.packages)
    standing = read_target(model, settings) if isinstance(settings, RegistrationSettings) else None
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    if standing is not None:
        tree = standing.tree(np.eye(4))
    mapped = map_log(path, episode.joints, tree, settings)
    warnings = [*episode.warnings, *model.warnings, *mapped.warnings]
    seen = (OBJECT,) if standing else mapped.seen if mapped.unseen else None
    if mapped.unseen:
        warnings.append(
            "parts that joints move which are not logged are not looked at: "
            f"{', '.join(mapped.unseen)}; where these joints stand still say so: --hold NAME=VALUE "
            "[deg or m]"
        )
    chosen, placed = cameras_of(episode, files.cameras, settings)
    cameras, assumed = _known_cameras(chosen)
    default = TreeKinematics(tree).flatten(tree.default_values())
    recordings = {one.name: _recording(one, mapped, default, settings) for one in chosen}
    return EpisodeInputs(
        path, model, tree, seen, cameras, assumed, recordings, tuple(warnings), placed, standing
    )


def read_target(model: ArticulatedModel, settings: RegistrationSettings) -> StandingObject | None:
    """The object that cameras on a link see, before the robot; None: they see the robot."""
    if settings.target is None:
        return None
    if settings.on is None:
        raise SettingsError(
            f"{settings.target} stands still, as a camera does that rides on no link, so its masks "
            "tell nothing of the robot's world: name the link that the camera rides on (--on LINK)"
        )
    other = load_model(settings.target, package_paths=settings.packages)
    held = make_tree(model, EstimateSettings(hold=settings.hold)).held
    named = {model.position_names[index]: value for index, value in held.items()}
    return StandingObject(model, settings.on, named, make_tree(other, EstimateSettings()))


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
    camera: EpisodeCamera, mapped: MappedJoints, default: Array, settings: AuditSettings
) -> Recording:
    """A camera's pictures beside the joints; pictures of frames that are not asked for are out."""
    kept = kept_pictures(camera, settings)

    def values_at(offset: float | Array) -> Array:
        values = np.tile(default, (len(kept), 1))
        values[:, mapped.asked] = rows_of(mapped.log, camera, kept, np.asarray(offset))
        return values

    @lru_cache(_REMEMBERED)
    def read(k: int) -> Picture:
        return camera.read(int(kept[k]))

    names = tuple(frames_of(camera)[k] for k in kept)
    times = camera.times[kept] if is_timed(mapped.log, camera) else None
    return Recording(names, values_at, read, times)
