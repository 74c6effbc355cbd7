"""Everything an estimate needs, read and checked before the first frame is searched."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.report import model_warnings
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.body.tree.root import RootRotation
from drake_pose.camera.files import load_camera_file
from drake_pose.camera.models import Camera
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.jobs.estimate.measurements import (
    TrueAngles,
    read_joint_centres,
    read_starts,
    read_true_angles,
)
from drake_pose.jobs.estimate.person_choice import follows_person
from drake_pose.jobs.estimate.scene_checks import (
    CheckedScene,
    check_scene,
    check_upright,
    leave_out_unreadable,
)
from drake_pose.results.options import select_frames
from drake_pose.results.settings import EstimateSettings, RootTurns
from drake_pose.search.continuous.multi_start import MultiStartSearch, MultiStartSettings
from drake_pose.search.continuous.root_placement_search import RootPlacementSearch
from drake_pose.search.estimates import PoseEstimate
from drake_pose.search.grid.beam.search import BeamSearch
from drake_pose.search.grid.families.examination import ExaminationSettings
from drake_pose.search.kameda import PaperSearch
from drake_pose.search.scoring import PoseSearch
from drake_pose.search.settings import BeamSearchSettings, PaperSearchSettings
from drake_pose.search.starts.root_placement import hub, turns_freely
from drake_pose.silhouette.areas.visibility import require_visible
from drake_pose.silhouette.pictures.scenes import Scene, load_scene

# Sampling interval of a root that can be turned in all ways, where its position is searched [deg].
_FREE_ROOT_INTERVAL = 30.0
TRUTH_FILE, CAMERA_FILE = "joint_angles.csv", "cameras.yaml"


@dataclass(frozen=True)
class Inputs:
    """What is estimated, from what, and how.

    Args:
        cameras: those that are matched together.
        search: made for the body's pose tree; None where a person is followed by all silhouettes.
        root_positions: the root's position (3,) by frame [m], where it differs.
        truth: measured joint positions, where there are some.
        starts: the plant's positions (nq,) by frame where it is known where the body is.
        known: answers of the first frames that are known before the search is asked, by frame.
    """

    scene: Scene
    model: ArticulatedModel
    cameras: tuple[Camera, ...]
    frames: tuple[str, ...]
    search: PoseSearch | None
    root_positions: Mapping[str, np.ndarray] | None
    truth: TrueAngles | None
    warnings: tuple[str, ...] = ()
    starts: Mapping[str, np.ndarray] = field(default_factory=dict)
    known: Mapping[str, PoseEstimate] = field(default_factory=dict)


def read_inputs(
    scene_path: Path, model_path: Path, settings: EstimateSettings, truth_path: Path | None
) -> Inputs:
    """Read and check everything; without a truth path the scene's own joint_angles.csv is taken.

    Raises DrakePoseError naming the file, camera, frame, link or joint at fault.
    """
    scene = load_scene(scene_path, _named_cameras(scene_path, settings.cameras))
    # Of pictures with few masks it is no fault that masks are missing.
    checked = CheckedScene(scene, ()) if scene.images else check_scene(scene)
    scene = checked.scene
    cameras = select_cameras(scene, settings.cameras)
    frames = select_seen_frames(scene, cameras, settings.frames)
    model = load_model(model_path, package_paths=settings.packages)
    if settings.unseen:
        model, settings = leave_out_links(model, settings)
    truth = _read_truth(scene_path, truth_path, model)
    starts = read_starts(scene, cameras, frames, model, settings)
    if (scene.images or not starts) and follows_person(scene, cameras, model, settings):
        texts = (*checked.warnings, *check_upright(cameras), *model.warnings)
        return Inputs(scene, model, cameras, frames, None, None, truth, texts, starts)
    root_positions: Mapping[str, np.ndarray] | None = None
    position: np.ndarray | None = None
    root = settings.root_position
    if isinstance(root, tuple) and len(root) == 2:
        root_positions = read_joint_centres(*root, frames)
        position = root_positions[frames[0]]
    elif isinstance(root, tuple):
        position = np.array(root)
    search: PoseSearch
    if root == "unknown" or scene.scale_unknown:
        search = make_placement_search(model, settings, position, scene.scale_unknown)
    else:
        search = _make_search(make_tree(model, settings, position), settings, model)
    read = _check_pictures(scene, cameras, frames, search)
    of_model = model_warnings(model, search.tree, settings.hold)
    texts = (*checked.warnings, *read.warnings, *of_model)
    return Inputs(read.scene, model, cameras, frames, search, root_positions, truth, texts, starts)


def _named_cameras(scene_path: Path, wanted: Sequence[str]) -> Mapping[str, Camera] | None:
    """The scene's cameras where all that are named are placed, though others are not; else None."""
    path = scene_path / CAMERA_FILE
    if not wanted or not os.path.lexists(path):
        return None
    file = load_camera_file(path)
    unplaced = {*file.unplaced, *file.links}
    return file.cameras if unplaced and not unplaced.intersection(wanted) else None


def leave_out_links(
    model: ArticulatedModel, settings: EstimateSettings
) -> tuple[ArticulatedModel, EstimateSettings]:
    """The model without the links that are not in the pictures, their joints held.

    Raises:
        ModelError: the model is no URDF, or nothing would be seen.
        UnknownNameError: there is no such link.
    """
    whole = model.pose_tree()
    centre = model.pose_tree(
        hub(whole), root_position=np.zeros(3), root_rotation=RootRotation.free()
    )
    names = [
        name for node in centre.nodes if node.name in settings.unseen for name in node.value_names
    ]
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    held = {
        name: math.degrees(value) if kinds[name] == "angle" else value
        for name in names
        for value in [float(model.default_positions[model.position_index(name)])]
    }
    return model.without(settings.unseen), replace(settings, hold={**held, **settings.hold})


def select_cameras(scene: Scene, wanted: Sequence[str]) -> tuple[Camera, ...]:
    """The wanted cameras in the scene's order; all that have masks where none is named.

    Raises UnknownNameError where there is no such camera.
    """
    for name in wanted:
        if name not in scene.cameras:
            raise UnknownNameError("camera", name, scene.cameras, str(scene.path))
    used = set(wanted) or {name for name, _ in (*scene.masks, *scene.images)}
    names = [name for name in scene.cameras if name in used]
    return tuple(scene.cameras[name] for name in names)


def select_seen_frames(
    scene: Scene, cameras: Sequence[Camera], wanted: Sequence[str]
) -> tuple[str, ...]:
    """The wanted frames that at least one of the cameras has seen.

    Raises:
        SceneError: if there is none.
        UnknownNameError: if there is no such frame.
    """
    names = [camera.name for camera in cameras]
    seen = (scene.masks, scene.images)
    frames = [
        frame
        for frame in select_frames(scene.frames, wanted, str(scene.path))
        if any((name, frame) in pictures for name in names for pictures in seen)
    ]
    if not frames:
        raise SceneError(f"{scene.path}: no mask of camera {', '.join(names)} in those frames")
    return tuple(frames)


def _read_truth(
    scene_path: Path, truth_path: Path | None, model: ArticulatedModel
) -> TrueAngles | None:
    if truth_path is not None:
        return read_true_angles(truth_path, model.position_names)
    path = scene_path / TRUTH_FILE
    if not os.path.lexists(path):
        return None
    try:
        return read_true_angles(path, model.position_names)
    except UnknownNameError:
        # The scene's truth is that of another model: nothing to compare with.
        return None


def make_tree(
    model: ArticulatedModel, settings: EstimateSettings, position: np.ndarray | None
) -> PoseTree:
    """The pose tree, its root placed as the settings say.

    A model without a joint in the world stays in place unless a root or rotation is asked for.
    """
    held = _in_plant_units(model, settings.hold)
    root, turns = settings.root, settings.root_rotation
    own = model.pose_tree(root_position=position, held=held)
    floats = any(node.value_names != node.position_names for node in own.nodes)
    if turns is None and floats and root in (None, own.root):
        turns = "fixed"
    if turns is None:
        return own if root is None else model.pose_tree(root, root_position=position, held=held)
    root = root or own.root
    if root == "world":
        raise SettingsError(
            f"{model.path}: its own joints hold it in the world; a root rotation needs the name of "
            f"a root; links that can be one: {', '.join(model.link_meshes)}"
        )
    rotation = _root_rotation(model, root, turns)
    return model.pose_tree(root, root_position=position, root_rotation=rotation, held=held)


def _root_rotation(model: ArticulatedModel, root: str, turns: RootTurns) -> RootRotation:
    """How the root may be turned, from how it stands in the world at the model's defaults."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, model.default_positions)
    body = model.plant.get_body(BodyIndex(model.link_index(root)))
    R_WR = body.EvalPoseInWorld(context).rotation().matrix()
    if turns == "fixed":
        return RootRotation.fixed(R_WR)
    if turns == "free":
        return RootRotation.free(rotation=R_WR)
    ranges = [(axis, lower, upper) for axis, (lower, upper) in turns.items()]
    return RootRotation.limited(ranges, rotation=R_WR)


def _in_plant_units(model: ArticulatedModel, values: Mapping[str, float]) -> dict[str, float]:
    """Degrees become radians; lengths stay metres. Names that are no positions are angles."""
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    return {
        name: math.radians(value) if kinds.get(name, "angle") == "angle" else value
        for name, value in values.items()
    }


def _sampling(model: ArticulatedModel, settings: EstimateSettings) -> dict[str, Any]:
    """The sampling intervals that all searches take."""
    return {
        "interval": math.radians(settings.interval),
        "length_interval": settings.length_interval,
        "intervals": _in_plant_units(model, settings.joint_intervals),
    }


def _make_search(tree: PoseTree, settings: EstimateSettings, model: ArticulatedModel) -> PoseSearch:
    if settings.method != "paper":
        beam = BeamSearchSettings(**_sampling(model, settings), time_limit=settings.time_limit)
        if settings.angles == "grid":
            return BeamSearch(tree, beam, ExaminationSettings())
        # It samples as coarsely as it likes; but intervals of joints that are none are refused.
        tree.grid(0, beam.interval, beam.intervals, beam.length_interval)
        return MultiStartSearch(tree, MultiStartSettings(beam))
    paper = PaperSearchSettings(
        **_sampling(model, settings),
        outside_limit=settings.outside_limit,
        candidate_limit=settings.candidates,
        run_limit=settings.run_limit,
    )
    return PaperSearch(tree, paper)


def make_placement_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    scale_unknown: bool,
) -> RootPlacementSearch:
    """The search for a root that can be anywhere.

    Where joints turn the root freely, the tree begins at the node of most neighbours, coarsely.

    Raises:
        SettingsError: if the method is the paper's, or angles on the grid are wanted.
    """
    if settings.method == "paper":
        raise SettingsError(
            "the paper's search must know where the root is and how large it looks; where the "
            "scene has no cameras.yaml or the root position is unknown, use --method beam"
        )
    if settings.angles == "grid":
        raise SettingsError(
            "angles on the grid need a known root; where the scene has no cameras.yaml or the root "
            "position is unknown, angles are continuous"
        )
    first = np.zeros(3) if position is None else position
    tree = make_tree(model, settings, None if settings.root is None else first)
    if settings.root is None and settings.root_rotation is None and turns_freely(tree):
        held = _in_plant_units(model, settings.hold)
        rotation = RootRotation.free(interval_deg=_FREE_ROOT_INTERVAL)
        tree = model.pose_tree(hub(tree), root_position=first, root_rotation=rotation, held=held)
    beam = BeamSearchSettings(**_sampling(model, settings), time_limit=settings.time_limit)
    return RootPlacementSearch(tree, beam, scale_unknown)


def _check_pictures(
    scene: Scene, cameras: Sequence[Camera], frames: Sequence[str], search: PoseSearch
) -> CheckedScene:
    """Reads every mask once, and looks whether every camera can see the body in a first pose."""
    readable = leave_out_unreadable(scene, [camera.name for camera in cameras], frames)
    if isinstance(search, RootPlacementSearch):
        return readable
    X_WN = search.tree.node_poses(search.tree.default_values())
    for camera in cameras:
        require_visible(search.sampled.outlines, camera.X_CW @ X_WN, camera)
    return readable
