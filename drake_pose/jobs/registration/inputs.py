"""What a registration or an audit needs, read and checked before any work begins."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.body import OBJECT, ArticulatedModel, PoseTree, RootRotation, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import CameraFile, load_camera_file
from drake_pose.camera.episode import EpisodeCamera
from drake_pose.camera.episode_files import open_episode
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, MaskError, SceneError, SettingsError, UnknownNameError
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
from drake_pose.jobs.estimate.inputs import missing_for_person
from drake_pose.jobs.estimate.measurements import read_true_angles
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.registration.positions import (
    KnownPositions,
    estimate_positions,
    put_on_base,
    read_known_positions,
)
from drake_pose.jobs.registration.settings import ALL, AuditSettings, RegistrationSettings
from drake_pose.registration.joint_zeros import links_with_length, require_enough, require_known
from drake_pose.registration.picture_registration import Recording
from drake_pose.registration.posed_frames import PosedFrame, SeenFrame
from drake_pose.registration.standing_object import StandingObject, require_turns, stands_still
from drake_pose.silhouette.pictures.scene_checks import check_scene
from drake_pose.silhouette.pictures.scene_files import select_frames
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, Scene, load_scene

# With positions that were estimated cameras are found from so many frames: what the model lacks is
# the same in all of them, so more tell little.
_MOST_FRAMES = 12
# And estimated poses differ that do so by more times what measured ones do.
_ESTIMATES_DIFFER = 5.0
# A picture shows so many degrees along its sides, at least and at most.
_VIEWS = (1.0, 170.0)
_OF_A_PERSON = (
    "a person's clothes and hair are not the model's surface, which turns a camera about the "
    "person: on a real recording cameras were off by up to three of their standard deviations"
)


@dataclass(frozen=True)
class Inputs:
    """What is registered or audited, from what: a scene of a robot at known joint positions.

    Args:
        scene: the recorded scene; cameras whose X_WC is missing stand at the world's origin.
        tree: the robot's pose tree in the world, or in the frame of the link on which cameras ride.
        positions: of the joints in each frame.
        held: the cameras whose place is known.
        frames: what the cameras see, where it was read already.
        searched: the cameras that are to be found.
        seen: the tree's nodes that the masks show; None: all.
        standing: the object that the cameras see from their link, if it is not the robot. Until it
            is found it is at the world's origin in the tree.
        zeros, lengths: the joints and links whose zeros and lengths are to be found.
        left_out: cameras without X_WC that are not to be found.
        given: of the cameras that are to be found those whose X_WC is given, as they are given.
    """

    scene: Scene
    model: ArticulatedModel
    tree: PoseTree
    positions: KnownPositions
    held: tuple[Camera, ...]
    warnings: tuple[str, ...]
    frames: tuple[SeenFrame, ...] = ()
    searched: tuple[PinholeCamera, ...] = ()
    seen: tuple[str, ...] | None = None
    standing: StandingObject | None = None
    zeros: tuple[str, ...] = ()
    lengths: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    given: tuple[PinholeCamera, ...] = ()

    def read(self, frame: str) -> SeenFrame:
        """A frame's positions, and the held cameras' masks but for those that show nothing."""
        if frame in self._known:
            return self._known[frame]
        names = [one.name for one in self.held if (one.name, frame) in self.scene.masks]
        masks = {name: self.scene.read(name, frame, may_be_empty=True) for name in names}
        seen = {name: mask for name, mask in masks.items() if mask.any()}
        return SeenFrame(frame, self.positions.of(frame, next(iter(masks), "")), seen)

    @cached_property
    def _known(self) -> dict[str, SeenFrame]:
        return {one.name: one for one in self.frames}

    def of(self, camera: str) -> list[PosedFrame]:
        """What a camera sees."""
        return [one.of(camera) for one in self.frames if camera in one.masks]

    def moved(self, values: Iterable[Array]) -> tuple[SeenFrame, ...]:
        """The frames at other values (m,) of the tree."""
        frames = zip(self.frames, values, strict=True)
        return tuple(replace(one, values=own) for one, own in frames)


def inputs_of_episode(episode: EpisodeInputs, settings: RegistrationSettings) -> Inputs:
    """What a registration needs of an episode, whose frames are seen while cameras are found.

    Raises:
        SettingsError: an option that needs masks.
        UnknownNameError: a joint or link that is not there.
    """
    for name in ("suggest",) if settings.target else ("on", "suggest"):
        if getattr(settings, name):
            raise SettingsError(
                f"--{name} needs masks, but {episode.path} has pictures: make masks of them "
                "(drake-pose masks), or leave it out"
                + ("; with --target FILE pictures are enough" if name == "on" else "")
            )
    kinematics = TreeKinematics(episode.tree)
    zeros, lengths = _select_parameters(episode.model, kinematics, settings)
    scene = Scene(episode.path, episode.cameras, (), {})
    positions = KnownPositions(episode.path, kinematics, {})
    return Inputs(
        scene, episode.model, episode.tree, positions, (), episode.warnings,
        searched=tuple(episode.cameras.values()), seen=episode.seen, standing=episode.standing,
        zeros=zeros, lengths=lengths,
        given=tuple(one for name, one in episode.cameras.items() if name in episode.placed),
    )  # fmt: skip


def read_inputs(files: GivenFiles, settings: RegistrationSettings) -> Inputs:
    """Reads and checks everything; joints that no table tells are estimated from known cameras.

    Raises DrakePoseError: names the file, camera, frame or joint at fault.
    """
    path = files.scene
    if not path.is_dir():
        raise SceneError(f"{path}: no such folder; a scene has {CAMERA_FILE} and masks")
    file = load_camera_file(files.camera_file)
    scene = check_scene(load_scene(path, file.cameras))
    scene, frames = scene.every(settings.every, settings.frames)
    searched, held = _select_cameras(scene, file, settings)
    model = load_model(files.model, package_paths=settings.packages)
    table, standing = None, read_target(model, settings)
    if files.joints is not None and standing is None:
        table = read_true_angles(files.joints, model.position_names)
    if files.joints is None or (table is not None and table.is_estimate):
        # Only measured joint positions tell these.
        for name in ("zeros", "lengths", "focal", "on", "suggest"):
            if getattr(settings, name):
                raise SettingsError(
                    f"--{name} needs measured joint positions (--joints FILE): those that are "
                    "estimated follow what it asks for"
                )
    if table is not None and table.bases:
        model, table = put_on_base(model, table)
    tree, seen = make_registration_tree(model, settings, standing)
    kinematics = TreeKinematics(tree)
    zeros, lengths = _select_parameters(model, kinematics, settings)
    if files.joints is None:
        asked = EstimateSettings(
            frames=frames, every=settings.every, hold=settings.hold, packages=settings.packages
        )
        positions = estimate_positions(path, model, kinematics, held, asked)
    else:
        on_link = settings.on is not None
        positions = read_known_positions(files.joints, kinematics, on_link, table)
    found, unknown = [camera.name for camera in searched], {*file.unplaced, *file.links}
    inputs = Inputs(
        scene, model, tree, positions, held,
        (*scene.warnings, *model.warnings, *positions.warnings), (), searched, seen, standing,
        zeros, lengths, tuple(k for k in (*file.unplaced, *file.links) if k not in found),
        tuple(one for one in searched if one.name not in unknown and settings.on is None),
    )  # fmt: skip
    inputs = replace(inputs, frames=_read_frames(inputs, frames))
    if zeros or lengths or settings.focal:
        require_enough(sum(len(inputs.of(name)) for name in found), len(zeros), len(lengths))
    return replace(inputs, warnings=(*inputs.warnings, *_look_at(inputs)))


def _select_cameras(
    scene: Scene, file: CameraFile, settings: RegistrationSettings
) -> tuple[tuple[PinholeCamera, ...], tuple[PinholeCamera, ...]]:
    """The cameras that are to be found, and the others whose place is known."""
    path, wanted = scene.path / CAMERA_FILE, settings.cameras
    unplaced = {*file.unplaced, *file.links}
    for name, link in file.links.items():
        if link != settings.on:
            raise SceneError(
                f"{path}: camera '{name}' rides on link '{link}': find it with --on {link}, or "
                "take it out of the file"
            )
    for name in wanted:
        if name not in file.cameras:
            raise UnknownNameError("camera", name, file.cameras, str(scene.path))
    if not wanted and not unplaced:
        raise SceneError(
            f"{path}: every camera has an X_WC; name those that are to be found anew: --camera "
            f"{next(iter(file.cameras))}"
        )
    with_masks = {name for name, _ in scene.masks}
    searched, held = [], []
    for name, camera in file.cameras.items():
        is_wanted = name in wanted if wanted else name in unplaced and name in with_masks
        if not isinstance(camera, PinholeCamera):
            if is_wanted:
                raise CameraError(
                    f"{path}: camera '{name}' is a parallel camera, whose distance no picture "
                    "tells; a camera that is to be found needs a focal length (projection: pinhole)"
                )
        elif is_wanted:
            _require_angle_of_view(camera, path)
            searched.append(camera)
        elif name not in unplaced and settings.on is None:
            held.append(camera)
    return tuple(searched), tuple(held)


def _require_angle_of_view(camera: PinholeCamera, path: Path) -> None:
    """Refuses (CameraError) a focal length with which no robot is seen near enough to be found."""
    for focal, side in ((camera.focal_x, camera.width), (camera.focal_y, camera.height)):
        angle = math.degrees(2.0 * math.atan(0.5 * side / focal))
        if not _VIEWS[0] < angle < _VIEWS[1]:
            raise CameraError(
                f"{path}: camera '{camera.name}': with a focal length of {focal:g} pixels a "
                f"picture of {side} pixels shows {angle:.3g} degrees; {_VIEWS[0]:g} to "
                f"{_VIEWS[1]:g} are expected: give the focal length in pixels, of pictures of "
                "this size"
            )


def make_registration_tree(
    model: ArticulatedModel,
    settings: RegistrationSettings,
    standing: StandingObject | None = None,
) -> tuple[PoseTree, tuple[str, ...] | None]:
    """The pose tree, and which of its nodes the masks show; None: all.

    From a link on which a camera rides, the masks show what no joint moves.
    """
    if standing is not None:
        return standing.tree(np.eye(4)), (OBJECT,)
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    link = settings.on
    if link is None:
        return tree, None
    base = [node.name for node in tree.nodes if node.parent < 0 and not node.value_names]
    if not base:
        raise SettingsError(
            f"{model.path}: no link that is seen stands still, so a camera on link '{link}' sees "
            "nothing that tells where it is; the robot's base needs visual geometry"
        )
    held = {model.position_names[index]: value for index, value in tree.held.items()}
    moved = model.pose_tree(
        link, root_position=np.zeros(3), root_rotation=RootRotation.fixed(), held=held
    )
    if not {node.name for node in moved.nodes[1:]} & set(base):
        raise stands_still(model, link)
    return moved, tuple(base)


def _select_parameters(
    model: ArticulatedModel, kinematics: TreeKinematics, settings: RegistrationSettings
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The joints and links whose zeros and lengths are to be found."""
    zeros, lengths = settings.zeros, settings.lengths
    if ALL in zeros:
        free = np.flatnonzero(kinematics.lower < kinematics.upper)
        zeros = tuple(kinematics.names[k] for k in free)
    if ALL in lengths:
        lengths = links_with_length(kinematics.tree)
    require_known(kinematics.tree, zeros, lengths)
    if settings.lengths and not model.changes_shape:
        raise SettingsError(
            f"{model.path}: lengths of links are found of URDF models alone, whose joints' origins "
            "they move; convert the model, or leave --lengths out"
        )
    return zeros, lengths


def _read_frames(inputs: Inputs, wanted: Sequence[str]) -> tuple[SeenFrame, ...]:
    """What cameras see; a bad mask of one that is to be found is refused.

    Of cameras that are held there is what can be compared with them.
    """
    scene, positions, searched = inputs.scene, inputs.positions, inputs.searched
    estimated = positions.is_estimate
    if estimated:
        wanted = _spread_frames(inputs, select_frames(scene.frames, wanted, str(scene.path)))
    asked = {one.name: scene.of_cameras([one.name]).seen_frames(wanted) for one in searched}
    found = []
    for frame in select_frames(scene.frames, wanted, str(scene.path)):
        masks = {}
        for camera in (name for name, frames in asked.items() if frame in frames):
            positions.of(frame, camera)
            try:
                masks[camera] = scene.read(camera, frame, may_be_empty=estimated)
            except MaskError as error:
                raise MaskError(
                    f"{error} (camera '{camera}', frame '{frame}'); mend it, or leave the frame "
                    "out (--frame)"
                ) from error
        masks = {camera: mask for camera, mask in masks.items() if mask.any()}
        if positions.has(frame):
            masks |= inputs.read(frame).masks
        if masks:
            found.append(SeenFrame(frame, positions.of(frame, next(iter(masks))), masks))
    for camera in asked:
        if not any(camera in one.masks for one in found):
            raise MaskError(
                f"camera '{camera}': no mask shows the body in the frames in which its pose was "
                f"estimated: {', '.join(wanted)}"
            )
    if estimated and not any(c.name in one.masks for c in inputs.held for one in found):
        raise SceneError(
            f"{scene.path}: the joint positions were estimated, so they are fitted together with "
            "the cameras, but no camera with an X_WC has a mask of those frames: leave X_WC of the "
            "cameras by which they were estimated in the camera file"
        )
    return tuple(found)


def _spread_frames(inputs: Inputs, asked: Sequence[str]) -> tuple[str, ...]:
    """Frames with positions which the cameras see, as many as tell more than the first ones do."""
    scene, names = inputs.scene, [camera.name for camera in inputs.searched]
    known = [frame for frame in asked if inputs.positions.has(frame)]
    for name in names:
        if not any((name, frame) in scene.masks for frame in known):
            raise SceneError(
                f"{scene.path}: camera '{name}' has no mask of a frame in which the cameras "
                "whose X_WC is known tell the body's pose; give masks of the same moments"
            )
    seen = [frame for frame in known if any((name, frame) in scene.masks for name in names)]
    chosen = np.linspace(0, len(seen) - 1, _MOST_FRAMES).round().astype(int)
    return tuple(dict.fromkeys(seen[k] for k in chosen))


def _look_at(inputs: Inputs) -> list[str]:
    """What of the cameras, the body, and how it moves, a user should know.

    Raises RegistrationError: the link before an object does not turn enough.
    """
    texts = [
        f"camera '{name}' has no X_WC and is not to be found, or has no masks in masks/{name}: it "
        "is left out of the camera file that is written"
        for name in inputs.left_out
    ]
    estimated = inputs.positions.is_estimate
    if estimated and not missing_for_person(inputs.model):
        texts.append(_OF_A_PERSON)
    for camera in inputs.searched:
        frames = inputs.of(camera.name)
        if inputs.standing is not None:
            require_turns(camera.name, inputs.standing, frames)
        rows, times = (one.values for one in frames), _ESTIMATES_DIFFER if estimated else 1.0
        if not inputs.positions.are_one_pose(rows, times):
            continue
        what = f"all {len(frames)} frames show the robot in one pose, to a degree"
        if len(frames) == 1:
            what = f"there is one frame, '{frames[0].name}'"
        elif estimated:
            what = f"the body stands still in all {len(frames)} frames"
        why = (
            "what its surface lacks pulls the camera to one side unnoticed, about the body above "
            "all, and no frame can be found to contradict the others; take frames in which it "
            "turns, moves its limbs and walks about"
            if estimated
            else "errors of that mask and of the joints' zeros cannot be told from a camera "
            "elsewhere, no frame can be found to contradict the others, and a mirrored pose may "
            "look alike; take five or more poses that differ much"
        )
        texts.append(f"camera '{camera.name}': {what}: {why}")
    return texts


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
