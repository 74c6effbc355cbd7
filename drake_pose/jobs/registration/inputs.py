"""Read and check all inputs of a registration or an audit before any work begins."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.body import ArticulatedModel, PoseTree, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import CameraFile, intrinsics_of, load_camera_file, load_cameras
from drake_pose.camera.episode import JointLog, Stream
from drake_pose.camera.episode_files import JOINT_TABLE, open_episode, require_recording
from drake_pose.camera.models import Camera, Lens, PinholeCamera
from drake_pose.errors import (
    CameraError,
    MaskError,
    RegistrationError,
    SceneError,
    SettingsError,
    require_known,
)
from drake_pose.files.settings import ALL, AuditSettings, EstimateSettings, RegistrationSettings
from drake_pose.jobs.estimate.inputs import make_tree, missing_for_person
from drake_pose.jobs.estimate.measurements import (
    cameras_of,
    is_episode,
    is_timed,
    kept_pictures,
    map_log,
    posed_nodes,
    read_measured_positions,
    rows_of,
)
from drake_pose.jobs.registration.positions import (
    KnownPositions,
    estimate_positions,
    make_registration_tree,
    own_joints,
    put_on_base,
    read_known_positions,
    read_target,
    still_links,
)
from drake_pose.registration.camera_motion import PictureMotion
from drake_pose.registration.joint_offsets import (
    require_frame_count,
    require_parameters,
    scalable_links,
)
from drake_pose.registration.posed_frames import MultiViewFrame, PosedFrame
from drake_pose.registration.recording import Recording
from drake_pose.registration.standing_object import CalibrationTarget, require_rotation
from drake_pose.silhouette.pictures.scene_checks import check_scene, read_mask_of, read_scene
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, Scene, load_scene, select_frames


@dataclass(frozen=True)
class RegistrationInputs:
    """Inputs of a registration or an audit: a robot at known joint positions, cameras, and masks.

    Args:
        scene: the recorded scene, or an episode's cameras and frames; cameras without X_WC are at
            the world's origin.
        model: the robot.
        tree: its pose tree in the world, or in the frame of the link that carries the cameras.
        positions: joint positions in each frame; none for an episode, whose log is in `recordings`.
        joints, cameras: the joint table and the camera file that were given; None: none.
        warnings: for the user.
        known_cameras: cameras whose poses are held, or audited.
        searched_cameras: cameras to be registered; all cameras of an episode.
        given_cameras: the searched cameras that have an X_WC, at that pose.
        links: link of each searched camera of an episode that rides on one, by the camera's name;
            for those in `given_on_links` by name, else as its pictures show (``watch_cameras``).
        given_on_links: the searched cameras that have an X_LC, at that pose on their link.
        riding: by name of a camera that moves with the robot, why it is not registered.
        assumed_focal: names of cameras without a given focal length, which have a usual one.
        left_out: names of cameras without X_WC that are not to be registered.
        recordings: an episode's pictures with the joint log, by camera; empty for masks.
        motions: how an episode's cameras moved that should stand still, by camera.
        audited_frames: names of the frames to be audited.
        frames: frames that have been read, with the masks of searched and known cameras.
        visible_nodes: names of the tree's nodes that masks show; None: all.
        target: the calibration target of cameras on a link; at the world's origin in the tree until
            its pose is estimated. None: the masks show the robot.
        offset_joints, scaled_links: names of joints whose offsets are estimated, and of links whose
            scales are.
        mapped: an episode's joint log, mapped to the model's joints; None: a scene of masks.
        lenses: of an episode's cameras, by name.
    """

    scene: Scene
    model: ArticulatedModel
    tree: PoseTree
    positions: KnownPositions
    joints: Path | None
    cameras: Path | None
    warnings: tuple[str, ...]
    known_cameras: tuple[Camera, ...] = ()
    searched_cameras: tuple[PinholeCamera, ...] = ()
    given_cameras: tuple[PinholeCamera, ...] = ()
    links: Mapping[str, str] = field(default_factory=dict)
    given_on_links: tuple[PinholeCamera, ...] = ()
    riding: Mapping[str, RegistrationError] = field(default_factory=dict)
    assumed_focal: frozenset[str] = frozenset()
    left_out: tuple[str, ...] = ()
    recordings: Mapping[str, Recording] = field(default_factory=dict)
    motions: Mapping[str, PictureMotion] = field(default_factory=dict)
    audited_frames: tuple[str, ...] = ()
    frames: tuple[MultiViewFrame, ...] = ()
    visible_nodes: tuple[str, ...] | None = None
    target: CalibrationTarget | None = None
    offset_joints: tuple[str, ...] = ()
    scaled_links: tuple[str, ...] = ()
    mapped: JointLog | None = None
    lenses: Mapping[str, Lens] = field(default_factory=dict)

    @property
    def camera_file(self) -> Path:
        """The given camera file, or the scene's own."""
        return self.cameras or self.scene.path / CAMERA_FILE

    def read(self, frame: str) -> MultiViewFrame:
        """Return a frame, by its name, with the masks of the known cameras.

        Empty masks are left out. A frame of `frames` is returned as it is.

        Raises MaskError: a mask cannot be read; SceneError: the frame has no joint positions.
        """
        if frame in self._known:
            return self._known[frame]
        names = [one.name for one in self.known_cameras if (one.name, frame) in self.scene.masks]
        masks = {name: read_mask_of(self.scene, name, frame, may_be_empty=True) for name in names}
        visible = {name: mask for name, mask in masks.items() if mask.any()}
        return MultiViewFrame(frame, self.positions.of(frame, next(iter(masks), "")), visible)

    @cached_property
    def _known(self) -> dict[str, MultiViewFrame]:
        """Frames that have been read, by name."""
        return {frame.name: frame for frame in self.frames}

    def of(self, camera: str) -> list[PosedFrame]:
        """Return the frames of `frames` in which the camera named `camera` has a mask."""
        return [frame.of(camera) for frame in self.frames if camera in frame.masks]

    def without(self, cameras: Collection[str]) -> "RegistrationInputs":
        """Return the inputs without the masks of `cameras`, names, which join `left_out`."""
        frames = [
            replace(frame, masks={k: mask for k, mask in frame.masks.items() if k not in cameras})
            for frame in self.frames
        ]
        left_out = tuple(dict.fromkeys((*self.left_out, *cameras)))
        return replace(self, frames=tuple(k for k in frames if k.masks), left_out=left_out)

    def of_cameras(self, cameras: Collection[str]) -> "RegistrationInputs":
        """Return an episode's inputs with some of its searched cameras alone, by name."""
        searched = tuple(one for one in self.searched_cameras if one.name in cameras)
        return replace(
            self,
            scene=replace(self.scene, cameras={one.name: one for one in searched}),
            searched_cameras=searched,
            given_cameras=tuple(one for one in self.given_cameras if one.name in cameras),
            recordings={name: one for name, one in self.recordings.items() if name in cameras},
        )

    def with_values(self, values: Iterable[Array]) -> tuple[MultiViewFrame, ...]:
        """Return `frames` at other values (m,) of the tree, one array for each frame."""
        frames = zip(self.frames, values, strict=True)
        return tuple(replace(frame, values=row) for frame, row in frames)


def read_robot(path: Path, settings: AuditSettings) -> ArticulatedModel:
    """Return the robot of a model file, without links that the settings leave out.

    Raises ModelError: the file cannot be used, or no link with a surface is left; UnknownNameError:
    a link that is to be left out does not exist.
    """
    robot = load_model(path, package_paths=settings.packages)
    left_out = dict.fromkeys(one for name in settings.without for one in robot.carried_by(name))
    return robot.without(tuple(left_out)) if left_out else robot


def uses_pictures(path: Path, settings: AuditSettings) -> bool:
    """Return whether a scene is used as an episode: it has the form of one, or settings say so."""
    return settings.pictures or is_episode(path, settings)


def read_inputs(
    scene: Path, model: Path, joints: Path | None, cameras: Path | None, settings: AuditSettings
) -> RegistrationInputs:
    """Read and check all inputs.

    Args:
        scene: folder of a scene of masks, or path of an episode, whose pictures are read later.
        model: the robot's model file.
        joints: a table of joint positions; None: the recording's own. If a scene of masks has none,
            a registration estimates the positions from the known cameras.
        cameras: a camera file in place of the scene's or episode's own.
        settings: of a registration or of an audit.

    Raises DrakePoseError: names the wrong file, camera, frame, column or joint.
    """
    if uses_pictures(scene, settings):
        return _read_episode(scene, model, joints, cameras, settings)
    if not scene.is_dir():
        raise SceneError(f"{scene}: no such folder; a scene has {CAMERA_FILE} and masks")
    require_recording(scene)
    robot = read_robot(model, settings)
    own = scene / JOINT_TABLE
    if isinstance(settings, RegistrationSettings):
        joints = joints or own_joints(scene, robot, settings)
        inputs = _read_masks(scene, robot, joints, cameras, settings)
        if joints is None and own.is_file():
            text = (
                f"{own} is not used, as it lacks a column for a joint of {model.name}, or has one "
                "for none; joint positions are estimated (--joints names the columns at fault)"
            )
            inputs = replace(inputs, warnings=(text, *inputs.warnings))
        return inputs
    joints = joints or (own if own.is_file() else None)
    if joints is None:
        raise SettingsError(
            f"{scene}: an audit of masks needs the positions of all joints of {model.name} that "
            f"are not held: {JOINT_TABLE} in the folder, or --joints FILE"
        )
    intrinsics = intrinsics_of(scene / CAMERA_FILE, settings.intrinsics, settings.cameras)
    texts = list[str]()
    given = None if cameras is None else load_cameras(cameras, intrinsics, scene, texts)
    data, frames = read_scene(scene, settings.cameras, settings.frames, given, every=settings.every)
    if data.scale_unknown:
        raise SceneError(
            f"{scene}: has no cameras.yaml; an audit needs the poses of the cameras: drake-pose "
            "register estimates them"
        )
    known = tuple(data.cameras.values())
    tree = make_tree(robot, EstimateSettings(hold=settings.hold))
    positions = read_known_positions(joints, TreeKinematics(tree), bool(settings.without))
    warnings = [*texts, *data.warnings, *robot.warnings, *positions.warnings]
    if positions.are_one_pose(positions.of(frame, known[0].name) for frame in frames):
        warnings.append(
            "all frames show the robot in one pose, to a degree: common errors of joints and of "
            "cameras can hardly be distinguished; add frames with other joint positions"
        )
    return RegistrationInputs(
        data, robot, tree, positions, joints, cameras, tuple(warnings), known, audited_frames=frames
    )


def on_link(
    inputs: RegistrationInputs, camera: str, settings: AuditSettings
) -> tuple[RegistrationInputs, RegistrationSettings]:
    """Return inputs and settings of a camera of an episode that rides on a link, see `links`.

    Raises DrakePoseError: as `read_inputs`.
    """
    common = {one.name: getattr(settings, one.name) for one in fields(AuditSettings)}
    focal = isinstance(settings, RegistrationSettings) and settings.focal
    own = RegistrationSettings(
        **{**common, "cameras": (camera,)}, on=inputs.links[camera], focal=focal
    )
    path, model = inputs.scene.path, inputs.model.path
    return read_inputs(path, model, inputs.joints, inputs.cameras, own), own


def _read_episode(
    path: Path, model: Path, joints: Path | None, cameras: Path | None, settings: AuditSettings
) -> RegistrationInputs:
    """Return the inputs of an episode, see `read_inputs`; its pictures are read later."""
    episode = open_episode(path, joints=joints, episode=settings.episode)
    if episode.joints is None:
        raise SceneError(
            f"{path}: holds no joint positions, and none are given (--joints FILE): pictures alone "
            f"do not determine a robot's pose. {episode.warnings[-1]}"
        )
    robot, target, standing = read_robot(model, settings), None, None
    if isinstance(settings, RegistrationSettings):
        target = read_target(robot, settings)
        tree, standing = make_registration_tree(robot, settings, target)
    else:
        tree = make_tree(robot, EstimateSettings(hold=settings.hold))
    mapped = map_log(path, episode.joints, tree, settings)
    warnings = [*episode.warnings, *robot.warnings, *mapped.warnings]
    posed = posed_nodes(tree, mapped)
    unposed = [node.name for node in tree.nodes if node.name not in posed]
    if unposed:
        warnings.append(
            "these parts are not used, as a joint that moves them is not logged: "
            f"{', '.join(unposed)}; hold joints that do not move (--hold NAME=VALUE, [deg "
            "or m])"
        )
    chosen, placed, read = cameras_of(episode, cameras, settings)
    known = {camera.name: camera.pinhole() for camera in chosen}
    links = {one.name: one.link for one in chosen if one.link in robot.link_names}
    recorded = {one.name for one in chosen if one.is_posed and one.camera is not None}
    world = make_tree(robot, EstimateSettings(hold=settings.hold)) if links else None
    for name, X_WL in still_links(world, links) if world else ():
        del links[name]
        if name in recorded:
            known[name], placed = known[name].with_pose(X_WL @ known[name].X_WC), placed | {name}
    kinematics = TreeKinematics(tree)
    inputs = RegistrationInputs(
        Scene(path, known, (), {}), robot, tree, KnownPositions(path, kinematics, {}),
        joints, cameras, (*warnings, *read), searched_cameras=tuple(known.values()),
        given_cameras=tuple(one for name, one in known.items() if name in placed),
        links=links, given_on_links=tuple(known[name] for name in links if name in recorded),
        assumed_focal=frozenset(camera.name for camera in chosen if camera.camera is None),
        recordings={one.name: _recording(one, mapped, kinematics, settings) for one in chosen},
        visible_nodes=standing or (posed if unposed else None),
        target=target, mapped=mapped,
        lenses={camera.name: camera.lens for camera in chosen if camera.lens is not None},
    )  # fmt: skip
    if not isinstance(settings, RegistrationSettings):
        return inputs
    scene_alone = settings.on is not None and target is None
    if scene_alone and settings.lengths:
        raise SettingsError(
            f"--lengths needs masks, but {path} has pictures: make masks of them "
            "(drake-pose masks), or leave it out"
        )
    if scene_alone and settings.zeros and len(chosen) > 1:
        raise SettingsError(
            f"--zeros with --on takes one camera, but {path} has {', '.join(known)}: name the one "
            f"on link '{settings.on}' (--camera NAME)"
        )
    if scene_alone and standing is not None and not {*standing} <= {*posed}:
        raise SceneError(
            f"{path}: joints between the base and link '{settings.on}' are not logged, so its pose "
            "is not known: give a joint map (--joint-map FILE), or hold those that do not move "
            "(--hold NAME=VALUE)"
        )
    joint_names, link_names = _select_parameters(robot, kinematics, settings)
    return replace(inputs, offset_joints=joint_names, scaled_links=link_names)


def _recording(
    camera: Stream, mapped: JointLog, kinematics: TreeKinematics, settings: AuditSettings
) -> Recording:
    """Return the pictures of a camera's selected frames, with the joint log.

    Args:
        camera: the episode's camera.
        mapped: the joint log, in values of the tree.
        kinematics: of the tree, with the default values of those that the log lacks.
        settings: select the frames.
    """
    kept = kept_pictures(camera, settings)
    default = kinematics.flatten(kinematics.tree.default_values())
    asked = [kinematics.names.index(name) for name in mapped.names]

    def values_at(offset: float | Array) -> Array:
        """Return the tree's values (n, m) at a time offset [s], see ``Recording``."""
        values = np.tile(default, (len(kept), 1))
        values[:, asked] = rows_of(mapped, camera, kept, np.asarray(offset))
        return values

    # A search reads the same few dozen pictures repeatedly.
    @lru_cache(64)
    def read(k: int) -> Picture:
        return camera.read(int(kept[k]))

    names = tuple(camera.names[k] for k in kept)
    times = camera.times[kept] if is_timed(mapped, camera) else None
    return Recording(names, values_at, read, times)


def _read_masks(
    path: Path,
    robot: ArticulatedModel,
    joints: Path | None,
    cameras: Path | None,
    settings: RegistrationSettings,
) -> RegistrationInputs:
    """Return the inputs of a scene of masks, see `read_inputs`.

    joints: the joint table; None: positions are estimated.
    """
    if cameras is None and not (path / CAMERA_FILE).exists():
        raise SceneError(
            f"{path}: has no {CAMERA_FILE}; a registration needs a camera file with picture size "
            "and focal length (--cameras FILE)"
        )
    known = intrinsics_of(path / CAMERA_FILE, settings.intrinsics, settings.cameras)
    file = load_camera_file(cameras or path / CAMERA_FILE, known=known, recording=path)
    scene = check_scene(load_scene(path, file.cameras))
    scene, frames = scene.every(settings.every, settings.frames)
    searched, held = _select_cameras(scene, file, settings)
    table, target = None, read_target(robot, settings)
    if joints is not None and target is None:
        table = read_measured_positions(joints, robot)
    if joints is None or (table is not None and table.is_estimate):
        # Estimated positions would absorb these parameters.
        for name in ("zeros", "lengths", "focal", "on"):
            if getattr(settings, name):
                raise SettingsError(
                    f"--{name} needs measured joint positions (--joints FILE): estimated ones "
                    "would absorb what it asks for"
                )
    if table is not None and table.bases is not None and len(table.bases):
        robot, table = put_on_base(robot, table)
    tree, visible = make_registration_tree(robot, settings, target)
    kinematics = TreeKinematics(tree)
    joint_names, link_names = _select_parameters(robot, kinematics, settings)
    if joints is None:
        asked = EstimateSettings(
            frames=frames, every=settings.every, hold=settings.hold, packages=settings.packages
        )
        positions = estimate_positions(path, robot, kinematics, held, asked)
    else:
        unobserved = settings.on is not None or bool(settings.without)
        positions = read_known_positions(joints, kinematics, unobserved, table)
    found, unplaced = [camera.name for camera in searched], (*file.unplaced, *file.links)
    left_out = tuple(name for name in unplaced if name not in found)
    warnings = [*file.warnings, *scene.warnings, *robot.warnings, *positions.warnings]
    warnings += [
        f"camera '{name}' has no X_WC and is not to be registered, or has no masks in "
        f"masks/{name}: it is left out of the written camera file; add its masks, or name it "
        "(--camera)"
        for name in left_out
    ]
    inputs = RegistrationInputs(
        scene, robot, tree, positions, joints, cameras, (), held, searched,
        tuple(one for one in searched if one.name not in unplaced and settings.on is None),
        left_out=left_out, visible_nodes=visible, target=target, offset_joints=joint_names,
        scaled_links=link_names,
    )  # fmt: skip
    inputs = replace(inputs, frames=_read_frames(inputs, frames))
    if joint_names or link_names or settings.focal:
        count = sum(len(inputs.of(name)) for name in found)
        require_frame_count(count, len(joint_names), len(link_names))
    return replace(inputs, warnings=(*warnings, *_pose_warnings(inputs)))


def _select_cameras(
    scene: Scene, file: CameraFile, settings: RegistrationSettings
) -> tuple[tuple[PinholeCamera, ...], tuple[PinholeCamera, ...]]:
    """Return the cameras to be registered, and the other cameras that have an X_WC.

    The settings name the cameras to be registered. If they name none, cameras with masks but
    without X_WC are registered. With cameras on a link, no other camera's pose is known.
    """
    path, wanted = scene.path / CAMERA_FILE, settings.cameras
    unplaced = {*file.unplaced, *file.links}
    for name, link in file.links.items():
        if link != settings.on:
            raise SceneError(
                f"{path}: camera '{name}' rides on link '{link}': register it with --on {link}, or "
                "take it out of the file"
            )
    require_known("camera", wanted, file.cameras, str(scene.path))
    if not wanted and not unplaced:
        raise SceneError(
            f"{path}: every camera has an X_WC; name those that are to be registered anew: "
            f"--camera {next(iter(file.cameras))}"
        )
    with_masks = {name for name, _ in scene.masks}
    searched, held = [], []
    for name, camera in file.cameras.items():
        is_wanted = name in wanted if wanted else name in unplaced and name in with_masks
        if not isinstance(camera, PinholeCamera):
            if is_wanted:
                raise CameraError(
                    f"{path}: camera '{name}' is a parallel camera, whose distance is not "
                    "observable; a registration needs a focal length (projection: pinhole)"
                )
        elif is_wanted:
            for focal, side in ((camera.focal_x, camera.width), (camera.focal_y, camera.height)):
                angle = math.degrees(2.0 * math.atan(0.5 * side / focal))
                if not 1.0 < angle < 170.0:
                    raise CameraError(
                        f"{path}: camera '{name}': with a focal length of {focal:g} pixels a "
                        f"picture of {side} pixels shows {angle:.3g} degrees; 1 to 170 are "
                        "expected: give the focal length in pixels, of pictures of this size"
                    )
            searched.append(camera)
        elif name not in unplaced and settings.on is None:
            held.append(camera)
    return tuple(searched), tuple(held)


def _select_parameters(
    model: ArticulatedModel, kinematics: TreeKinematics, settings: RegistrationSettings
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the joints whose offsets, and of the links whose scales are estimated."""
    joints, links = settings.zeros, settings.lengths
    if ALL in joints:
        free = np.flatnonzero(kinematics.lower < kinematics.upper)
        joints = tuple(kinematics.names[k] for k in free)
    if ALL in links:
        links = scalable_links(kinematics.tree)
    require_parameters(kinematics.tree, joints, links)
    if settings.lengths and not model.changes_shape:
        raise SettingsError(
            f"{model.path}: link lengths are estimated of URDF models only; convert the model, or "
            "leave --lengths out"
        )
    return joints, links


def _read_frames(inputs: RegistrationInputs, wanted: Sequence[str]) -> tuple[MultiViewFrame, ...]:
    """Return the searched cameras' frames, with the known cameras' masks of the same frames.

    With estimated positions at most twelve frames are used: the model's errors are common to all
    frames, so more frames add little. Empty masks are left out.

    wanted: names of the frames to read; empty: all.

    Raises DrakePoseError: a searched camera's mask is bad, or no usable frame shows the body.
    """
    scene, positions = inputs.scene, inputs.positions
    names, estimated = [camera.name for camera in inputs.searched_cameras], positions.is_estimate
    if estimated:
        candidates = select_frames(scene.frames, wanted, str(scene.path))
        known = [frame for frame in candidates if positions.has(frame)]
        for name in names:
            if not any((name, frame) in scene.masks for frame in known):
                raise SceneError(
                    f"{scene.path}: camera '{name}' has no mask of a frame in which the cameras "
                    "with an X_WC determine the body's pose; give synchronised masks"
                )
        usable = [frame for frame in known if any((name, frame) in scene.masks for name in names)]
        chosen = np.linspace(0, len(usable) - 1, 12).round().astype(int)
        wanted = tuple(dict.fromkeys(usable[k] for k in chosen))
    shown = {name: scene.of_cameras([name]).frames_with_files(wanted) for name in names}
    views = []
    for frame in select_frames(scene.frames, wanted, str(scene.path)):
        masks = {}
        for camera in (name for name, frames in shown.items() if frame in frames):
            positions.of(frame, camera)
            try:
                masks[camera] = read_mask_of(scene, camera, frame, may_be_empty=estimated)
            except MaskError as error:
                raise MaskError(
                    f"{error} (camera '{camera}', frame '{frame}'); correct it, or leave the frame "
                    "out (--frame)"
                ) from error
        masks = {camera: mask for camera, mask in masks.items() if mask.any()}
        if positions.has(frame):
            masks |= inputs.read(frame).masks
        if masks:
            views.append(MultiViewFrame(frame, positions.of(frame, next(iter(masks))), masks))
    for camera in names:
        if not any(camera in one.masks for one in views):
            raise MaskError(
                f"camera '{camera}': no mask shows the body in the frames in which its pose was "
                f"estimated: {', '.join(wanted)}"
            )
    if estimated and not any(c.name in one.masks for c in inputs.known_cameras for one in views):
        raise SceneError(
            f"{scene.path}: the joint positions were estimated, so they are fitted together with "
            "the cameras, but no camera with an X_WC has a mask of those frames: keep the X_WC of "
            "the cameras by which they were estimated in the camera file"
        )
    return tuple(views)


def _pose_warnings(inputs: RegistrationInputs) -> list[str]:
    """Return warnings about the body's surface and its motion.

    Raises RegistrationError: the link that carries the cameras rotates too little.
    """
    texts, estimated = list[str](), inputs.positions.is_estimate
    if estimated and not missing_for_person(inputs.model):
        texts.append(
            "a person's clothes and hair are missing in the model, which turns a camera about the "
            "person: on a real recording cameras were off by up to three standard deviations"
        )
    for camera in inputs.searched_cameras:
        frames = inputs.of(camera.name)
        if inputs.target is not None:
            require_rotation(camera.name, inputs.target, frames)
        # Estimated positions scatter more than measured ones.
        rows, times = (frame.values for frame in frames), 5.0 if estimated else 1.0
        if not inputs.positions.are_one_pose(rows, times):
            continue
        what = f"all {len(frames)} frames show the robot in one pose, to a degree"
        if len(frames) == 1:
            what = f"there is one frame, '{frames[0].name}'"
        elif estimated:
            what = f"the body stands still in all {len(frames)} frames"
        why = (
            "errors of the model's surface shift the camera unnoticed, above all about the body, "
            "and outlier frames cannot be found; take frames in which the body turns, moves its "
            "limbs and walks about"
            if estimated
            else "errors of the mask and of joint offsets cannot be distinguished from another "
            "camera pose, outlier frames cannot be found, and a mirrored pose may look the same; "
            "take five or more poses that differ much"
        )
        texts.append(f"camera '{camera.name}': {what}: {why}")
    return texts
