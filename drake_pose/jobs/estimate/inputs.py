"""The pose tree and the search for it that settings ask for."""

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
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.episode_files import JOINT_TABLE, read_sequence
from drake_pose.camera.models import Camera
from drake_pose.errors import ModelError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.records import FrameRecord, base_cells, user_units
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import Drawn
from drake_pose.filtering.contour_tracker import TrackingSettings
from drake_pose.jobs.estimate.measurements import (
    TrueAngles,
    check_units,
    is_episode,
    logged_positions,
    read_episode_scene,
    read_joint_centres,
    read_true_angles,
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
    hub,
    turns_freely,
)
from drake_pose.silhouette.outline import Outline
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import (
    check_upright,
    leave_out_unreadable,
    read_scene,
)
from drake_pose.silhouette.pictures.scenes import SCENE_FILE, Scene
from drake_pose.silhouette.scoring import draw_labels, require_visible


def make_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    interval_deg: float = 10.0,
) -> PoseSearch:
    """The search for a root at its own place, or at a position (3,) in the world [m].

    ``interval_deg``: sampling interval of the paper's search [deg].
    """
    tree = make_tree(model, settings, position)
    if settings.method == "paper":
        return PaperSearch(tree, PaperSearchSettings(math.radians(interval_deg)))
    return MultiStartSearch(tree, settings.time_limit)


def make_placement_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    scale_unknown: bool,
    interval_deg: float = 10.0,
    free_interval_deg: float = 30.0,
) -> RootPlacementSearch:
    """The search for a root that can be anywhere.

    Where joints turn the root freely, the tree begins at the node of most neighbours.

    Args:
        interval_deg: sampling interval of all angles [deg].
        free_interval_deg: that of a root that can be turned in all ways [deg].

    Raises SettingsError: the method is the paper's.
    """
    if settings.method == "paper":
        raise SettingsError(
            "the paper's search must know where the root is and how large it looks; where the "
            "scene has no cameras.yaml or the root position is unknown, use --method beam"
        )
    first = np.zeros(3) if position is None else position
    tree = make_tree(model, settings, None if settings.root is None else first)
    if settings.root is None and settings.root_rotation is None and turns_freely(tree):
        rotation = RootRotation.free(interval_deg=free_interval_deg)
        held = _in_plant_units(model, settings.hold)
        tree = model.pose_tree(hub(tree), root_position=first, root_rotation=rotation, held=held)
    sampling = BeamSearchSettings(math.radians(interval_deg), time_limit=settings.time_limit)
    return RootPlacementSearch(tree, sampling, scale_unknown)


def make_tree(
    model: ArticulatedModel, settings: EstimateSettings, position: np.ndarray | None = None
) -> PoseTree:
    """The pose tree, its root placed as the settings say."""
    held = _in_plant_units(model, settings.hold)
    root, turns = settings.root, settings.root_rotation
    own = model.pose_tree(root_position=position, held=held)
    if turns is None:
        return own if root is None else model.pose_tree(root, root_position=position, held=held)
    root = root or own.root
    if root == "world":
        raise SettingsError(
            f"{model.path}: its own joints hold it in the world; a root rotation needs the name of "
            f"a root; links that can be one: {', '.join(model.link_meshes)}"
        )
    # From how it stands in the world at the model's defaults.
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
    """The model without the links that are not in the pictures, their joints held.

    Raises:
        ModelError: the model is no URDF, or nothing would be seen.
        UnknownNameError: there is no such link.
    """
    centre = model.pose_tree(
        hub(model.pose_tree()), root_position=np.zeros(3), root_rotation=RootRotation.free()
    )
    # What a link that is seen follows is not held.
    led = {
        centre.source(i) for i, one in enumerate(centre.nodes) if one.name not in settings.unseen
    }
    unseen = [
        one for i, one in enumerate(centre.nodes) if one.name in settings.unseen and i not in led
    ]
    names = [name for node in unseen for name in node.value_names]
    usual = user_units(model) * model.default_positions
    held = {name: float(usual[model.position_index(name)]) for name in names}
    return model.without(settings.unseen), replace(settings, hold={**held, **settings.hold})


def _in_plant_units(model: ArticulatedModel, values: Mapping[str, float]) -> dict[str, float]:
    """Degrees become radians; lengths stay metres. Names that are no positions are angles."""
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    is_angle = {name: kinds.get(name, "angle") == "angle" for name in values}
    return {name: math.radians(one) if is_angle[name] else one for name, one in values.items()}


@dataclass(frozen=True)
class EstimateInputs:
    """What is estimated, from what, and how.

    Args:
        scene: what those cameras see that are matched together.
        frames: those that are asked for.
        tracked: whether they follow each other, and the body is followed.
        search: made for the body's pose tree; None where a person is followed by all silhouettes.
        truth: measured joint positions, where there are some.
        root_positions: the root's position (3,) by frame [m], where it differs.
        starts: the plant's positions (nq,) by frame where it is known where the body is.
        known: answers of the first frames that are known before the search is asked, by frame.
    """

    scene: Scene
    model: ArticulatedModel
    frames: tuple[str, ...]
    tracked: bool
    search: PoseSearch | None
    truth: TrueAngles | None
    warnings: tuple[str, ...] = ()
    root_positions: Mapping[str, np.ndarray] | None = None
    starts: Mapping[str, np.ndarray] = field(default_factory=dict)
    known: Mapping[str, PoseEstimate] = field(default_factory=dict)

    def joint_errors(self, frame: str, q: np.ndarray) -> dict[str, float]:
        """Estimate q (nq,) minus truth by position [deg or m], where the truth is known."""
        if self.truth is None or (values := self.truth.of(frame)) is None:
            return {}
        places = [self.model.position_index(name) for name in self.truth.names]
        errors = q[places] - values
        turned = np.remainder(errors + np.pi, 2.0 * np.pi) - np.pi
        errors = np.where(self.model.periodic[places], turned, errors)
        errors *= user_units(self.model)[places]
        return dict(zip(self.truth.names, errors.tolist(), strict=True))

    def pictures(self, frame: str) -> dict[str, np.ndarray]:
        """The pictures (H, W, 3) of a frame by camera."""
        names = [name for name in self.scene.cameras if (name, frame) in self.scene.images]
        return {name: self.scene.read_image(name, frame) for name in names}

    def finish(
        self,
        frame: str,
        pose: PoseEstimate,
        masks: Mapping[str, np.ndarray],
        parts: Mapping[str, np.ndarray],
        shown: Mapping[str, np.ndarray],
        **more: Any,
    ) -> tuple[FrameRecord, Drawn]:
        """A frame as written, its masks compared with the body.

        Args:
            pose: one without a J is judged by the masks.
            masks: by camera, of those that the pose was found by.
            parts: by camera (H, W), which part of the body is seen, -1 where none is; none where
                no pose was found.
            shown: the masks and pictures over which the body is drawn.
            more: fields of FrameRecord.
        """
        q, base, E_total = np.full(len(pose.q), np.nan), None, None
        if pose.found:
            q, base = pose.q, base_cells(pose.X_WB) if self.base_moves else None
            agreement = compare_masks(masks, {name: parts[name] >= 0 for name in masks})
            error = pose.E_total if math.isfinite(pose.J) else agreement.E_total
            if math.isfinite(error):
                E_total, more["ious"] = error, agreement.ious
                more["joint_errors"] = self.joint_errors(frame, pose.q)
        record = FrameRecord(
            frame, q, base, E_total, pose.seconds, stopped_by=pose.stopped_by, **more
        )
        return record, {name: (seen, parts.get(name)) for name, seen in shown.items()}

    def tracking(self, rest_time: float = 1.0) -> TrackingSettings | None:
        """How the body is tracked; None where every frame is matched on its own.

        A searched root position or scale is tracked, too.

        ``rest_time``: of the tracker where a single parallel view, which is the same for poses
        mirrored in depth, is all there is [s].
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
        """Whether the root's rotation or position moves the plant's whole world in the scene's."""
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
    """Read and check everything; without a truth path the scene's own joint_angles.csv is taken.

    Args:
        camera_path: a camera file in place of the scene's own.

    Raises DrakePoseError naming the file, camera, frame, link or joint at fault.
    """
    model = load_model(model_path, package_paths=settings.packages)
    # A sequence of pictures alone begins at a mask or a start, or where its joint log says.
    has_log = settings.start is None and (truth_path or scene_path / JOINT_TABLE).is_file()
    if is_episode(scene_path, settings) and (
        has_log or not read_sequence(scene_path / SCENE_FILE)[0]
    ):
        scene = read_episode_scene(scene_path, settings, truth_path, camera_path)
        frames = scene.frames
        if settings.unseen:
            model, settings = leave_out_links(model, settings)
        truth, starts, of_truth = logged_positions(scene, make_tree(model, settings), settings)
    else:
        # Who is captured moves.
        is_person = settings.method == "person"
        scene, frames = read_scene(
            scene_path, settings.cameras, settings.frames,
            cameras=None if camera_path is None else load_cameras(camera_path),
            sequence=is_person, every=settings.every,
        )  # fmt: skip
        if settings.unseen:
            model, settings = leave_out_links(model, settings)
        truth, of_truth = _read_truth(scene_path, truth_path, model, frames)
        starts = {}
    starts = _read_starts(settings.start, frames, model) or starts
    tracked = scene.sequence and settings.track
    _check_start(scene, frames, starts, settings.track)
    if (scene.images or not starts) and follows_person(scene, model, settings):
        upright = check_upright(scene.cameras.values())
        warnings = (*scene.warnings, *of_truth, *upright, *model.warnings)
        return EstimateInputs(scene, model, frames, tracked, None, truth, warnings, None, starts)
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
        search = make_search(model, settings, position)
        X_WN = search.tree.node_poses(search.tree.default_values())
        for camera in scene.cameras.values():
            require_visible(search.sampled.outlines, camera.X_CW @ X_WN, camera)
    of_model = model_warnings(model, search.tree, settings.hold)
    warnings = (*scene_as_used.warnings, *of_truth, *of_model)
    return EstimateInputs(
        scene_as_used, model, frames, tracked, search, truth, warnings, centres, starts
    )


def draw_parts(
    outlines: Sequence[Outline], X_WN: np.ndarray, cameras: Iterable[Camera]
) -> dict[str, np.ndarray]:
    """By camera (H, W), which of a body's parts at X_WN (parts, 4, 4) is seen, -1 where none is."""
    labels = range(1, 1 + len(outlines))
    return {one.name: draw_labels(outlines, labels, one.X_CW @ X_WN, one) - 1 for one in cameras}


def _read_truth(
    scene: Path, given: Path | None, model: ArticulatedModel, frames: Sequence[str]
) -> tuple[TrueAngles | None, tuple[str, ...]]:
    """Measured positions, and what the user should know of them."""
    path = given or scene / JOINT_TABLE
    if given is None and not os.path.lexists(path):
        return None, ()
    try:
        truth = read_true_angles(path, model.position_names)
    except UnknownNameError:
        if given is not None:
            raise
        # The scene's truth is that of another model: nothing to compare with.
        return None, ()
    warnings = check_units(path, model, truth.names, truth.values)
    if all(truth.of(frame) is None for frame in frames):
        warnings += (f"{path}: has no row of any frame that is estimated: nothing is compared",)
    return truth, warnings


def _read_starts(
    file: Path | None, frames: Sequence[str], model: ArticulatedModel
) -> dict[str, np.ndarray]:
    """The plant's positions (nq,) by frame, of ``settings.start``."""
    if file is None:
        return {}
    known = read_true_angles(file, model.position_names)
    check_units(file, model, known.names, known.values)
    places = [model.position_index(name) for name in known.names]
    starts = {}
    for frame in frames:
        values = known.of(frame)
        if values is not None:
            starts[frame] = model.default_positions.copy()
            starts[frame][places] = values
    if frames[0] not in starts:
        raise SceneError(
            f"{file}: has no row of the first frame, '{frames[0]}', in which the track is to begin"
        )
    return starts


def _check_start(
    scene: Scene, frames: Sequence[str], starts: Mapping[str, np.ndarray], track: bool
) -> None:
    """Refuses a track without a beginning, a start where nothing is tracked, and bad pictures."""
    if starts and not (scene.sequence and track):
        raise SettingsError(
            f"{scene.path}: --start is where a track begins, but the frames are not tracked: "
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
            f"{scene.path}: nothing says where the body is in the first frame, '{first}': add its "
            f"mask {where} (drake-pose masks makes one), or its joint positions (--start FILE.csv)"
        )
    wanted = set(frames)
    for name, frame in scene.images:
        if frame in wanted:
            scene.read_image(name, frame)


def bundled_person() -> Path:
    """The bundled person whose lengths are found with the pose."""
    return bundled_model("person").with_name("person_shape.urdf")


def follows_person(scene: Scene, model: ArticulatedModel, settings: EstimateSettings) -> bool:
    """Whether the method is ``person``, by name or because ``auto`` chooses it.

    Raises SceneError, ModelError: the method is asked for, but scene or model does not allow it.
    """
    wanted = settings.method == "person"
    if not wanted and (settings.method != "auto" or settings.search_settings):
        return False
    if len(scene.cameras) < 2 or scene.scale_unknown:
        if wanted:
            unknown_folders = ", ".join(scene.unknown_folders)
            raise SceneError(
                f"{scene.path}: a person is captured by two calibrated cameras or more, but masks "
                f"are there of {', '.join(scene.cameras)} alone"
                + (f"; cameras.yaml lacks {unknown_folders}" if unknown_folders else "")
            )
        return False
    missing = missing_for_person(model)
    if missing and wanted:
        raise ModelError(f"{model.path}: a person is captured with a model that has {missing}")
    return not missing


def missing_for_person(model: ArticulatedModel) -> str:
    """What a model lacks to be a person who can be anywhere; "" where nothing."""
    names = set(load_landmarks(model.path)) if landmarks_file(model.path).is_file() else set()
    if absent := sorted(set(PERSON_LANDMARKS) - names):
        return f"the landmarks {', '.join(absent)} in {landmarks_file(model.path).name} beside it"
    nodes = model.pose_tree().nodes
    roots = [node for node in nodes if node.parent < 0]
    kinds = [model.position_kinds[position] for node in roots for position in node.positions]
    by_joints = all(node.value_names == node.position_names for node in nodes)
    if len(roots) != 1 or kinds.count("length") < 3 or not by_joints:
        return "one root that joints of its own move to any place"
    return ""
