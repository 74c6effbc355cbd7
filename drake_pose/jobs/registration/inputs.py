"""What a registration needs, read and checked before the search begins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.model import OBJECT, ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.root import RootRotation
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.files import CameraFile, load_camera_file
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import (
    CameraError,
    MaskError,
    SceneError,
    SettingsError,
    UnknownNameError,
)
from drake_pose.jobs.estimate.inputs import make_tree, select_seen_frames
from drake_pose.jobs.estimate.measurements import read_true_angles
from drake_pose.jobs.estimate.person_choice import missing_for_person
from drake_pose.jobs.estimate.scene_checks import check_scene
from drake_pose.jobs.registration.positions import (
    KnownPositions,
    estimate_positions,
    put_on_base,
    read_known_positions,
)
from drake_pose.jobs.registration.settings import ALL, RegistrationSettings
from drake_pose.registration.joint_zeros import links_with_length, require_known
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.standing_object import StandingObject, require_turns
from drake_pose.results.options import select_frames
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.scenes import Scene, load_scene

Array = NDArray[np.float64]

_CAMERAS = "cameras.yaml"
# With positions that were estimated cameras are found from so many frames: what the model lacks is
# the same in all of them, so more tell little.
_MOST_FRAMES = 12
# And estimated poses differ that do so by more times what measured ones do.
_ESTIMATES_DIFFER = 5.0
_OF_A_PERSON = (
    "a person's clothes and hair are not the model's surface, which turns a camera about the "
    "person: on a real recording cameras were off by up to three of their standard deviations"
)


@dataclass(frozen=True)
class RegistrationInputs:
    """What is registered, from what.

    Args:
        scene: the recorded scene; cameras whose X_WC is missing stand at the world's origin.
        model: the robot.
        tree: its pose tree in the world, or in the frame of the link on which the cameras ride.
        seen: the tree's nodes that the masks show; None: all.
        standing: the object that the cameras see from their link, if it is not the robot. Until it
            is found it is at the world's origin in the tree.
        searched, held: the cameras that are to be found, and the others that have an X_WC.
        frames: what each of these cameras sees, by name.
        zeros, lengths: the joints and links whose zeros and lengths are to be found.
        left_out: cameras without X_WC that are not to be found.
        is_estimate: whether the positions were estimated, so that they are off.
        girths: (nodes,) how many times as wide as the model's the nodes are; None: as the model's.
    """

    scene: Scene
    model: ArticulatedModel
    tree: PoseTree
    seen: tuple[str, ...] | None
    standing: StandingObject | None
    searched: tuple[PinholeCamera, ...]
    held: tuple[PinholeCamera, ...]
    frames: Mapping[str, tuple[PosedFrame, ...]]
    zeros: tuple[str, ...]
    lengths: tuple[str, ...]
    left_out: tuple[str, ...]
    warnings: tuple[str, ...]
    is_estimate: bool = False
    girths: Array | None = None


def read_inputs(
    scene_path: Path, model_path: Path, joints_path: Path | None, settings: RegistrationSettings
) -> RegistrationInputs:
    """Reads and checks everything.

    Args:
        joints_path: the table of joint positions; None: they are estimated from the cameras
            whose place is known.

    Raises:
        DrakePoseError: names the file, camera, frame or joint at fault.
    """
    if not scene_path.is_dir():
        raise SceneError(f"{scene_path}: no such folder; a scene has {_CAMERAS} and masks")
    file = load_camera_file(scene_path / _CAMERAS)
    _check_links(scene_path, file.links, settings)
    unplaced = (*file.unplaced, *file.links)
    searched = _select_searched(scene_path, file.cameras, unplaced, settings.cameras)
    checked = check_scene(load_scene(scene_path, file.cameras))
    scene = checked.scene
    unseen = [name for name in unplaced if not any(owner == name for owner, _ in scene.masks)]
    if not settings.cameras:
        searched = [name for name in searched if name not in unseen]
    model = load_model(model_path, package_paths=settings.packages)
    table, standing = None, _read_target(model, settings)
    if joints_path is not None and standing is None:
        table = read_true_angles(joints_path, model.position_names)
    if joints_path is None or (table is not None and table.is_estimate):
        _check_estimable(settings)
    if table is not None and table.bases:
        model, table = put_on_base(model, table)
    tree, seen = make_registration_tree(model, settings, standing)
    kinematics = TreeKinematics(tree)
    zeros, lengths = _select_parameters(model, kinematics, settings)
    pinholes = [_require_pinhole(scene_path, file.cameras[name]) for name in searched]
    held = _select_held(file, searched, settings)
    if joints_path is None:
        asked = EstimateSettings(
            frames=settings.frames, hold=settings.hold, packages=settings.packages
        )
        positions = estimate_positions(scene_path, model, kinematics, held, asked)
    else:
        on_link = settings.on is not None
        positions = read_known_positions(joints_path, kinematics, on_link, table)
    wanted = settings.frames
    if positions.is_estimate:
        wanted = _spread_frames(scene, pinholes, positions, wanted)
    frames = {camera.name: _read_frames(scene, camera, positions, wanted) for camera in pinholes}
    for camera in held:
        frames[camera.name] = _frames_of_held(scene, camera, positions, wanted)
    if positions.is_estimate:
        _require_held(scene_path, held, frames)
    left_out = [name for name in unplaced if name not in searched]
    warnings = [*checked.warnings, *model.warnings, *positions.warnings]
    warnings += [_say_left_out(name) for name in left_out]
    warnings += _say_of_body(model, pinholes, frames, positions, standing)
    return RegistrationInputs(
        scene, model, tree, seen, standing, tuple(pinholes), tuple(held), frames, zeros, lengths,
        tuple(left_out), tuple(warnings), positions.is_estimate, positions.girths,
    )  # fmt: skip


def _select_held(
    file: CameraFile, searched: Sequence[str], settings: RegistrationSettings
) -> list[PinholeCamera]:
    """The cameras whose place is known and not to be found."""
    if settings.on is not None:
        return []
    others = {*searched, *file.unplaced, *file.links}
    return [
        camera
        for name, camera in file.cameras.items()
        if name not in others and isinstance(camera, PinholeCamera)
    ]


def _require_held(
    path: Path,
    held: Sequence[PinholeCamera],
    frames: Mapping[str, Sequence[PosedFrame]],
) -> None:
    """Refuses estimated positions that no camera whose place is known can hold in the world."""
    if not any(frames[camera.name] for camera in held):
        raise SceneError(
            f"{path}: the joint positions were estimated, so they are fitted together with the "
            "cameras, but no camera with an X_WC has a mask of those frames: leave X_WC of the "
            "cameras by which they were estimated in the camera file"
        )


def _check_estimable(settings: RegistrationSettings) -> None:
    """Refuses what only measured joint positions tell."""
    asked = {
        "--zeros": settings.zeros, "--lengths": settings.lengths, "--focal": settings.focal,
        "--on": settings.on, "--suggest": settings.suggest,
    }  # fmt: skip
    for name, value in asked.items():
        if value:
            raise SettingsError(
                f"{name} needs measured joint positions (--joints FILE): those that are estimated "
                "follow what it asks for"
            )


def _spread_frames(
    scene: Scene,
    cameras: Sequence[PinholeCamera],
    positions: KnownPositions,
    wanted: Sequence[str],
) -> tuple[str, ...]:
    """Frames with positions which the cameras see, as many as tell more than the first ones do."""
    asked = select_frames(scene.frames, wanted, str(scene.path))
    known = [frame for frame in asked if positions.has(frame)]
    for camera in cameras:
        if not any((camera.name, frame) in scene.masks for frame in known):
            raise SceneError(
                f"{scene.path}: camera '{camera.name}' has no mask of a frame in which the cameras "
                "whose X_WC is known tell the body's pose; give masks of the same moments"
            )
    seen = [frame for frame in known if any((one.name, frame) in scene.masks for one in cameras)]
    return tuple(
        dict.fromkeys(
            seen[k] for k in np.linspace(0, len(seen) - 1, _MOST_FRAMES).round().astype(int)
        )
    )


def _check_links(path: Path, links: Mapping[str, str], settings: RegistrationSettings) -> None:
    """Refuses a camera that rides on another link than those that are to be found."""
    for name, link in links.items():
        if link != settings.on:
            raise SceneError(
                f"{path / _CAMERAS}: camera '{name}' rides on link '{link}': find it with "
                f"--on {link}, or take it out of the file"
            )


def _read_target(model: ArticulatedModel, settings: RegistrationSettings) -> StandingObject | None:
    """The object that cameras on a link see, before the robot; None: they see the robot."""
    if settings.target is None:
        return None
    if settings.on is None:
        raise SettingsError(
            f"{settings.target} stands still, as a camera does that rides on no link, so its masks "
            "tell nothing of the robot's world: name the link that the camera rides on (--on LINK)"
        )
    other = load_model(settings.target, package_paths=settings.packages)
    held = make_tree(model, EstimateSettings(hold=settings.hold), None).held
    named = {model.position_names[index]: value for index, value in held.items()}
    return StandingObject(model, settings.on, named, make_tree(other, EstimateSettings(), None))


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
    tree = make_tree(model, EstimateSettings(hold=settings.hold), None)
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
        raise SettingsError(
            f"{model.path}: no joint moves link '{link}', so a camera on it stands still: leave "
            "--on out"
        )
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


def _select_searched(
    path: Path, cameras: Mapping[str, Camera], unplaced: Sequence[str], wanted: Sequence[str]
) -> list[str]:
    """The names of the cameras that are to be found, in the file's order."""
    for name in wanted:
        if name not in cameras:
            raise UnknownNameError("camera", name, cameras, str(path))
    if not wanted and not unplaced:
        raise SceneError(
            f"{path / _CAMERAS}: every camera has an X_WC; name those that are to be found anew: "
            f"--camera {next(iter(cameras))}"
        )
    return [name for name in cameras if name in (wanted or unplaced)]


def _require_pinhole(path: Path, camera: Camera) -> PinholeCamera:
    if not isinstance(camera, PinholeCamera):
        raise CameraError(
            f"{path / _CAMERAS}: camera '{camera.name}' is a parallel camera, whose distance no "
            "picture tells; a camera that is to be found needs a focal length (projection: pinhole)"
        )
    return camera


def _read_frames(
    scene: Scene, camera: PinholeCamera, positions: KnownPositions, wanted: Sequence[str]
) -> tuple[PosedFrame, ...]:
    """All frames of a camera that is to be found; a bad one is refused."""
    found = []
    for frame in select_seen_frames(scene, [camera], wanted):
        values = positions.of(frame, camera.name)
        try:
            mask = scene.read(camera.name, frame, may_be_empty=positions.is_estimate)
        except MaskError as error:
            raise MaskError(
                f"{error} (camera '{camera.name}', frame '{frame}'); mend it, or leave the frame "
                "out (--frame)"
            ) from error
        if mask.any():
            found.append(PosedFrame(frame, values, mask))
    if not found:
        raise MaskError(
            f"camera '{camera.name}': no mask shows the body in the frames in which its pose was "
            f"estimated: {', '.join(wanted)}"
        )
    return tuple(found)


def _frames_of_held(
    scene: Scene, camera: PinholeCamera, positions: KnownPositions, wanted: Sequence[str]
) -> tuple[PosedFrame, ...]:
    """Those frames of a camera that is held which can be compared with it."""
    found = []
    for frame in select_frames(scene.frames, wanted, str(scene.path)):
        if (camera.name, frame) in scene.masks and positions.table.of(frame) is not None:
            mask = scene.read(camera.name, frame, may_be_empty=True)
            if mask.any():
                found.append(PosedFrame(frame, positions.of(frame, camera.name), mask))
    return tuple(found)


def _check_poses(
    camera: PinholeCamera,
    frames: Sequence[PosedFrame],
    positions: KnownPositions,
    standing: StandingObject | None,
) -> list[str]:
    """Says so where all frames show one pose of the robot; before an object it is refused."""
    if standing is not None:
        require_turns(camera.name, standing, frames)
    rows, estimated = (frame.values for frame in frames), positions.is_estimate
    if not positions.are_one_pose(rows, _ESTIMATES_DIFFER if estimated else 1.0):
        return []
    if len(frames) == 1:
        what = f"there is one frame, '{frames[0].name}'"
    elif estimated:
        what = f"the body stands still in all {len(frames)} frames"
    else:
        what = f"all {len(frames)} frames show the robot in one pose, to a degree"
    why = (
        "what its surface lacks pulls the camera to one side unnoticed, about the body above all, "
        "and no frame can be found to contradict the others; take frames in which it turns, moves "
        "its limbs and walks about"
        if estimated
        else "errors of that mask and of the joints' zeros cannot be told from a camera elsewhere, "
        "no frame can be found to contradict the others, and a mirrored pose may look alike; take "
        "five or more poses that differ much"
    )
    return [f"camera '{camera.name}': {what}: {why}"]


def _say_of_body(
    model: ArticulatedModel,
    cameras: Sequence[PinholeCamera],
    frames: Mapping[str, Sequence[PosedFrame]],
    positions: KnownPositions,
    standing: StandingObject | None,
) -> list[str]:
    """What about the body, and how it moves, makes cameras less sure than they seem."""
    is_person = positions.is_estimate and not missing_for_person(model)
    return [
        *([_OF_A_PERSON] if is_person else []),
        *(
            text
            for camera in cameras
            for text in _check_poses(camera, frames[camera.name], positions, standing)
        ),
    ]


def _say_left_out(name: str) -> str:
    return (
        f"camera '{name}' has no X_WC and is not to be found, or has no masks in masks/{name}: it "
        "is left out of the camera file that is written"
    )
