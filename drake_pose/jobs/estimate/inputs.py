"""Inputs of an estimate: scene, model, pose tree, search and measured positions."""

import math
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drake_pose.body import (
    ArticulatedModel,
    PoseTree,
    RootRotation,
    bundled_model,
    landmarks_file,
    load_landmarks,
    load_model,
    model_warnings,
)
from drake_pose.camera.camera_files import intrinsics_of, load_cameras
from drake_pose.camera.episode import JointLog
from drake_pose.camera.episode_files import JOINT_TABLE, read_sequence
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import frame_key
from drake_pose.errors import ModelError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import OVERLAY
from drake_pose.files.overlay import draw_overlay
from drake_pose.files.records import FrameRecord, base_cells, user_units
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import Drawn
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.input_files import read_csv
from drake_pose.jobs.estimate.measurements import (
    is_episode,
    logged_positions,
    read_episode_scene,
    read_joint_centres,
    read_measured_positions,
    timed_positions,
    with_leaders,
)
from drake_pose.person.search import PERSON_LANDMARKS
from drake_pose.search import (
    BeamSearchSettings,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    PoseEstimate,
    PoseSearch,
    RootPlacementSearch,
    most_connected_node,
    root_rotates_freely,
)
from drake_pose.silhouette.outline import Outline
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import (
    check_upright,
    frame_ranges,
    leave_out_unreadable,
    read_scene,
)
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE, SCENE_FILE, Scene
from drake_pose.silhouette.scoring import draw_labels, draw_mask, require_visible

INTERVAL = math.radians(10.0)
"""Sampling interval of joint angles [rad]."""

FREE_ROOT = RootRotation.free(interval_deg=30.0)
"""Of a body whose position is searched as well."""


def make_placement_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    scale_unknown: bool,
) -> RootPlacementSearch:
    """Return the search for a body with an unknown root position.

    If joints turn the model's root freely, and the settings have no root and root rotation, the
    pose tree starts at the node with most neighbours.

    Args:
        model: the body's model.
        settings: method, root, root rotation and held positions.
        position: (3,) start of the root position in the world [m]; None: the origin.
        scale_unknown: whether the scale of a parallel camera is searched as well.

    Raises SettingsError: the method is "paper".
    """
    if settings.method == "paper":
        raise SettingsError(
            "the method paper needs a known root position and calibrated cameras; without "
            "cameras.yaml or with an unknown root position use --method beam"
        )
    first = np.zeros(3) if position is None else position
    tree = make_tree(model, settings, None if settings.root is None else first)
    if settings.root is None and settings.root_rotation is None and root_rotates_freely(tree):
        held = _in_plant_units(model, settings.hold)
        tree = model.pose_tree(
            most_connected_node(tree), root_position=first, root_rotation=FREE_ROOT, held=held
        )
    return RootPlacementSearch(tree, BeamSearchSettings(INTERVAL), scale_unknown)


def make_tree(
    model: ArticulatedModel, settings: EstimateSettings, position: np.ndarray | None = None
) -> PoseTree:
    """Return a model's pose tree with root, root rotation and held positions of the settings.

    ``position``: (3,) position of the root in the world [m]; None: as the model has it.

    Raises SettingsError: the root cannot be rotated.
    """
    held = _in_plant_units(model, settings.hold)
    root, turns = settings.root, settings.root_rotation
    own = model.pose_tree(root_position=position, held=held)
    if turns is None:
        return own if root is None else model.pose_tree(root, root_position=position, held=held)
    root = root or own.root
    if root == "world":
        raise SettingsError(
            f"{model.path}: is held in the world by its joints; a root rotation needs a root "
            f"(--root); links that can be the root: {', '.join(model.link_meshes)}"
        )
    # The rotation is relative to the root's rotation at the model's default positions.
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, model.default_positions)
    body = model.plant.get_body(BodyIndex(model.link_index(root)))
    R_WR = body.EvalPoseInWorld(context).rotation().matrix()
    if turns == "fixed":
        rotation = RootRotation.fixed(R_WR)
    elif turns == "free":
        rotation = RootRotation.free(rotation=R_WR)
    else:
        ranges = [(axis, lower, upper) for axis, (lower, upper) in turns.items()]
        rotation = RootRotation.limited(ranges, rotation=R_WR)
    return model.pose_tree(root, root_position=position, root_rotation=rotation, held=held)


def leave_out_links(
    model: ArticulatedModel, settings: EstimateSettings
) -> tuple[ArticulatedModel, EstimateSettings]:
    """Return model and settings without ``settings.unseen``; the joints of these links are held.

    Raises ModelError: the model is not a URDF, or no link would be left; UnknownNameError: a link
    does not exist.
    """
    centre = model.pose_tree(
        most_connected_node(model.pose_tree()),
        root_position=np.zeros(3),
        root_rotation=RootRotation.free(),
    )
    # A joint that a remaining link mimics is not held; the centre's own values are no joints.
    led = {
        centre.source(i) for i, one in enumerate(centre.nodes) if one.name not in settings.unseen
    }
    usual = user_units(model) * model.default_positions
    held = {
        name: float(usual[model.position_index(name)])
        for i, one in enumerate(centre.nodes)
        if one.name in settings.unseen and i not in led and one.parent >= 0
        for name in one.value_names
    }
    return model.without(settings.unseen), replace(settings, hold={**held, **settings.hold})


def _in_plant_units(model: ArticulatedModel, values: Mapping[str, float]) -> dict[str, float]:
    """Return values by position name [deg or m] in [rad or m]; unknown names count as angles."""
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    is_angle = {name: kinds.get(name, "angle") == "angle" for name in values}
    return {name: math.radians(one) if is_angle[name] else one for name, one in values.items()}


@dataclass(frozen=True)
class EstimateInputs:
    """Inputs of an estimate."""

    scene: Scene  # The scene with the cameras that are used.
    model: ArticulatedModel  # The body's model.
    frames: tuple[str, ...]  # Names of the frames to be estimated.
    tracked: bool  # Whether the body is tracked from frame to frame.
    search: PoseSearch | None  # Search for the body's pose; None for the method person.
    # Measured joint positions to compare with; None if there are none.
    truth: JointLog | None
    warnings: tuple[str, ...] = ()  # Messages for the user.
    # Position (3,) of the root by frame [m]; None if it is the same in all.
    root_positions: Mapping[str, np.ndarray] | None = None
    # Known positions (nq,) by frame, at which a track starts [rad or m]; may be empty.
    starts: Mapping[str, np.ndarray] = field(default_factory=dict)
    # Estimates by frame that were made before, of the first frames; may be empty.
    known: Mapping[str, PoseEstimate] = field(default_factory=dict)

    def joint_errors(self, frame: str, q: np.ndarray) -> dict[str, float]:
        """Return q (nq,) minus measured positions by name [deg or m]; empty if not measured."""
        if self.truth is None or (values := self.truth.by_frame.get(frame_key(frame))) is None:
            return {}
        places = [self.model.position_index(name) for name in self.truth.names]
        errors = q[places] - values
        turned = np.remainder(errors + np.pi, 2.0 * np.pi) - np.pi
        errors = np.where(self.model.periodic[places], turned, errors)
        errors *= user_units(self.model)[places]
        return dict(zip(self.truth.names, errors.tolist(), strict=True))

    def pictures(self, frame: str) -> dict[str, np.ndarray]:
        """Return a frame's pictures (H, W, 3) uint8 RGB by camera; {} in a scene of masks only."""
        names = [name for name in self.scene.cameras if (name, frame) in self.scene.images]
        return {name: self.scene.read_image(name, frame) for name in names}

    def record_frame(
        self,
        frame: str,
        pose: PoseEstimate,
        masks: Mapping[str, np.ndarray],
        parts: Mapping[str, np.ndarray],
        shown: Mapping[str, np.ndarray],
        **more: Any,
    ) -> tuple[FrameRecord, Drawn]:
        """Return the record and overlays of a frame, with its masks compared with the body.

        Args:
            frame: the frame's name.
            pose: the estimate; if its J is not finite, E_total is computed from the masks.
            masks: masks by camera, of the cameras used.
            parts: result of `draw_parts` for the cameras of ``masks`` and ``shown``; empty if no
                pose was found.
            shown: masks or pictures by camera over which the body is drawn.
            more: other fields of FrameRecord by name.

        Returns the record, without pose if none was found, and the overlays of ``shown``.
        """
        q, base, E_total = np.full(len(pose.q), np.nan), None, None
        if pose.found:
            q, base = pose.q, base_cells(pose.X_WB) if self.base_moves else None
            of_masks, ious = compare_masks(masks, {name: parts[name] >= 0 for name in masks})
            error = pose.E_total if math.isfinite(pose.J) else of_masks
            if math.isfinite(error):
                E_total, more["ious"] = error, ious
                more["joint_errors"] = self.joint_errors(frame, pose.q)
        record = FrameRecord(
            frame, q, base, E_total, pose.seconds, stopped_by=pose.stopped_by, **more
        )
        fit = "no pose found" if E_total is None else f"E_total {100.0 * E_total:.1f} %"
        drawn = {}
        for name, seen in shown.items():
            nodes = parts.get(name)
            body = np.zeros(seen.shape[:2], np.bool_) if nodes is None else nodes >= 0
            picture = draw_overlay(seen, body, nodes, f"{name}  frame {frame}  {fit}")
            drawn[f"{OVERLAY}/{name}/{frame}.png"] = picture
        return record, drawn

    def tracking(self, rest_time: float = 1.0) -> TrackingSettings | None:
        """Return the tracker's settings, also for a searched root or scale. None: no tracking.

        ``rest_time``: [s] for a single parallel camera, whose view does not distinguish poses
        mirrored in depth.
        """
        if not self.tracked:
            return None
        scale_unknown = self.scene.scale_unknown
        return TrackingSettings(
            root_moves=isinstance(self.search, RootPlacementSearch),
            scale_unknown=scale_unknown,
            rest_time=rest_time if scale_unknown else None,
        )

    @property
    def base_moves(self) -> bool:
        """Whether the estimate moves the plant's world in the scene's world (X_WB)."""
        if self.search is None:
            return False
        values, positions_from = self.search.sampled.values, self.search.tree.positions_from
        bases = [positions_from([value[pick] for value in values])[1] for pick in (0, -1)]
        return not np.allclose(bases, np.eye(4), atol=1e-12)


def read_inputs(
    scene_path: Path,
    model_path: Path,
    settings: EstimateSettings,
    truth_path: Path | None,
    camera_path: Path | None = None,
) -> EstimateInputs:
    """Read and check all inputs of an estimate.

    Args:
        scene_path: the scene's folder, or an episode.
        model_path: the model file.
        settings: the settings.
        truth_path: measured joint positions; None: the scene's joint_angles.csv, if it exists, or
            the episode's joint log.
        camera_path: camera file; None: the scene's own.

    Raises DrakePoseError: the message names the file, camera, frame, link or joint at fault.
    """
    model = load_model(model_path, package_paths=settings.packages)
    if settings.unseen:
        model, settings = leave_out_links(model, settings)
    # A sequence of pictures starts at a mask, at settings.start, or at its logged positions.
    has_log = settings.start is None and (truth_path or scene_path / JOINT_TABLE).is_file()
    if is_episode(scene_path, settings) and (
        has_log or not read_sequence(scene_path / SCENE_FILE)[0]
    ):
        scene = read_episode_scene(scene_path, settings, truth_path, camera_path)
        frames = scene.frames
        truth, starts, of_truth = logged_positions(scene, make_tree(model, settings), settings)
    else:
        # Frames of a captured person are a sequence.
        is_person = settings.method == "person"
        known = intrinsics_of(scene_path / CAMERA_FILE, settings.intrinsics, settings.cameras)
        scene, frames = read_scene(
            scene_path, settings.cameras, settings.frames,
            cameras=None if camera_path is None else load_cameras(camera_path, known, scene_path),
            sequence=is_person, every=settings.every,
        )  # fmt: skip
        truth, of_truth = _read_truth(scene_path, truth_path, model, frames)
        starts = {}
    tracked = scene.sequence and settings.track
    few = [frame for frame in frames if scene.images and len(scene.cameras_of(frame)) < 2]
    if few and follows_person(scene, model, replace(settings, start=None)):
        raise SceneError(
            f"{scene.path}: frame {frame_ranges(few, frames)} has pictures, but masks of fewer "
            "than two cameras, and a person is captured from masks: make them (drake-pose "
            "masks), or leave these frames out (--frame)"
        )
    if follows_person(scene, model, settings):
        upright = check_upright(scene.cameras.values())
        warnings = (*scene.warnings, *of_truth, *upright, *model.warnings)
        scene = replace(scene, images={})
        return EstimateInputs(scene, model, frames, tracked, None, truth, warnings)
    starts = _read_starts(settings, scene, frames, model) or starts
    _check_start(scene, frames, starts, settings.track)
    centres: Mapping[str, np.ndarray] | None = None
    position, root = None, settings.root_position
    if isinstance(root, tuple) and len(root) == 2:
        centres = read_joint_centres(*root, frames)
        position = centres[frames[0]]
    elif isinstance(root, tuple):
        position = np.array(root)
    scene_as_used = leave_out_unreadable(scene, frames)
    search: PoseSearch
    if root == "unknown" or scene.scale_unknown:
        search = make_placement_search(model, settings, position, scene.scale_unknown)
    else:
        tree, start = make_tree(model, settings, position), starts.get(frames[0])
        is_paper = settings.method == "paper"
        search = (
            PaperSearch(tree, PaperSearchSettings(INTERVAL)) if is_paper else MultiStartSearch(tree)
        )
        values = tree.default_values() if start is None else tree.values_from_positions(start)
        X_WN = tree.node_poses(values)
        for camera in scene.cameras.values():
            require_visible(search.sampled.outlines, camera.X_CW @ X_WN, camera)
    of_model = model_warnings(model, search.tree)
    warnings = (*scene_as_used.warnings, *of_truth, *of_model)
    return EstimateInputs(
        scene_as_used, model, frames, tracked, search, truth, warnings, centres, starts
    )


def draw_parts(
    outlines: Sequence[Outline], X_WN: np.ndarray, cameras: Iterable[Camera], by_part: bool = True
) -> dict[str, np.ndarray]:
    """Return the index (H, W) of the visible part at each pixel by camera, -1 outside the body.

    ``X_WN``: (parts, 4, 4). ``by_part``: whether each part has its index; if not, all have the
    index 0, which is drawn in a third of the time.
    """
    if not by_part:
        bodies = {one.name: draw_mask(outlines, one.X_CW @ X_WN, one) for one in cameras}
        return {name: body.view(np.int8) - 1 for name, body in bodies.items()}
    labels = range(1, 1 + len(outlines))
    return {one.name: draw_labels(outlines, labels, one.X_CW @ X_WN, one) - 1 for one in cameras}


def _read_truth(
    scene: Path, given: Path | None, model: ArticulatedModel, frames: Sequence[str]
) -> tuple[JointLog | None, tuple[str, ...]]:
    """Return the measured positions of a scene's folder, None if there are none, and warnings.

    ``given``: the table; None: joint_angles.csv, ignored if it belongs to another model. There is a
    warning if none of ``frames`` has a row.
    """
    path = given or scene / JOINT_TABLE
    if given is None and not os.path.lexists(path):
        return None, ()
    try:
        truth = read_measured_positions(path, model)
    except UnknownNameError:
        if given is not None:
            raise
        # The scene's table belongs to another model.
        return None, ()
    warnings = truth.warnings
    if not any(frame_key(frame) in truth.by_frame for frame in frames):
        warnings += (f"{path}: has no row of an estimated frame, so that nothing is compared",)
    return truth, warnings


def _read_starts(
    settings: EstimateSettings, scene: Scene, frames: Sequence[str], model: ArticulatedModel
) -> dict[str, np.ndarray]:
    """Return the positions (nq,) by frame of the table ``settings.start`` [rad or m]; {} for None.

    Of ``frames`` those without a row are left out; columns that are missing get the defaults. A
    table with a column `time` is read at the times of the scene's frames.

    Raises SceneError: the table cannot be read, or has no row of the first frame.
    """
    file = settings.start
    if file is None:
        return {}
    if "time" in read_csv(file, SceneError)[0]:
        starts = timed_positions(file, scene, make_tree(model, settings), settings)[1]
        starts = {frame: q for frame, q in starts.items() if frame in frames}
    else:
        known = read_measured_positions(file, model)
        q, _, _ = with_leaders(model, model.couplings, known.names, known.positions)
        of_key = dict(zip(known.by_frame, q, strict=True))
        own = {frame: of_key[key] for frame in frames if (key := frame_key(frame)) in of_key}
        default = model.default_positions
        starts = {frame: np.where(np.isnan(row), default, row) for frame, row in own.items()}
    if frames[0] not in starts:
        raise SceneError(
            f"{file}: has no row of the first frame, '{frames[0]}', at which the track starts"
        )
    return starts


def _check_start(
    scene: Scene, frames: Sequence[str], starts: Mapping[str, np.ndarray], track: bool
) -> None:
    """Check that a track has a start, that a start is tracked, and that pictures can be read.

    ``starts`` are the known positions by frame, ``track`` is that of the settings.

    Raises SettingsError, SceneError: a check fails.
    """
    if starts and not (scene.sequence and track):
        raise SettingsError(
            f"{scene.path}: --start is the start of a track, but the frames are not tracked; "
            "scene.yaml needs sequence: true"
        )
    bare = [frame for frame in frames if not scene.cameras_of(frame)]
    if not bare:
        return
    if not track:
        raise SettingsError(
            f"{scene.path}: frame '{bare[0]}' has pictures but no mask, which can only be tracked "
            "by colour: leave --no-track out, or make masks (drake-pose masks)"
        )
    first = frames[0]
    if first in bare and first not in starts:
        where = f"masks/{next(iter(scene.cameras))}/{first}.png"
        raise SceneError(
            f"{scene.path}: the pose in the first frame, '{first}', is unknown; add its mask "
            f"{where} (drake-pose masks makes one), or its joint positions (--start FILE.csv)"
        )
    scene.require_images(set(frames))


def bundled_person() -> Path:
    """Return the model file of the bundled person, whose link lengths are estimated."""
    return bundled_model("person").with_name("person_shape.urdf")


def follows_person(scene: Scene, model: ArticulatedModel, settings: EstimateSettings) -> bool:
    """Return whether the method is ``person``, by name or as the choice of ``auto``.

    Raises:
        SceneError, ModelError: the method is given by name, but scene or model does not allow it.
    """
    wanted = settings.method == "person"
    if not wanted and (settings.method != "auto" or settings.search_settings):
        return False
    if len(scene.cameras) < 2 or scene.scale_unknown:
        if wanted:
            unknown_folders = ", ".join(scene.unknown_folders)
            raise SceneError(
                f"{scene.path}: the method person needs two or more calibrated cameras, but masks "
                f"exist only for {', '.join(scene.cameras)}"
                + (f"; cameras.yaml lacks {unknown_folders}" if unknown_folders else "")
            )
        return False
    missing = missing_for_person(model)
    if missing and wanted:
        raise ModelError(f"{model.path}: the method person needs a model with {missing}")
    return not missing


def missing_for_person(model: ArticulatedModel) -> str:
    """Return what a model lacks for the method person; "" if nothing."""
    names = set(load_landmarks(model.path)) if landmarks_file(model.path).is_file() else set()
    if absent := sorted(set(PERSON_LANDMARKS) - names):
        return f"the landmarks {', '.join(absent)} in {landmarks_file(model.path).name} beside it"
    nodes = model.pose_tree().nodes
    roots = [node for node in nodes if node.parent < 0]
    kinds = [model.position_kinds[position] for node in roots for position in node.positions]
    by_joints = all(node.value_names == node.position_names for node in nodes)
    if len(roots) != 1 or kinds.count("length") < 3 or not by_joints:
        return "one root that its own joints can move to any position"
    return ""
