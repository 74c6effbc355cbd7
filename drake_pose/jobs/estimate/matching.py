"""The frames of a scene matched or tracked by the matching diagram, one after the other."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.filtering.tracking.contour_tracker import TrackingSettings
from drake_pose.jobs.estimate.fit_checks import find_contradiction
from drake_pose.jobs.estimate.inputs import Inputs
from drake_pose.jobs.estimate.result import Drawn, FinishedFrame, OnStage, ResultWriter
from drake_pose.results.folder import PoseRow, base_cells
from drake_pose.results.joint_tables import record_pose_set
from drake_pose.results.summary import FrameRecord
from drake_pose.search.continuous.multi_start import MultiStartSearch
from drake_pose.search.continuous.root_placement_search import RootPlacementSearch
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.grid.beam.search import BeamSearch
from drake_pose.search.scoring import PoseSearch
from drake_pose.search.starts.root_placement import scale_camera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.mask_agreement import compare_masks
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.estimators.diagrams import build_recorded_matching
from drake_pose.systems.estimators.mask_player import DEFAULT_FRAME_RATE_HZ

_USUAL_FRAME_RATE_HZ = 30.0
_REST_TIME = 1.0


def sequence_tracking(
    scene: Scene, search: PoseSearch, track: bool = True
) -> TrackingSettings | None:
    """How the body of a scene is tracked; None where every frame is matched on its own.

    No frame rate means 30 frames a second; a searched root position or scale is tracked, too.
    """
    if not track or not scene.sequence:
        return None
    tracking = TrackingSettings(
        root_moves=isinstance(search, RootPlacementSearch),
        scale_unknown=scene.scale_unknown,
        # A single parallel view is the same for poses mirrored in depth.
        rest_time=_REST_TIME if scene.scale_unknown else None,
    )
    if scene.frame_rate_hz is not None:
        return tracking
    # The diagram's frames are further apart than the video's were: the motion is slower as much.
    slower = _USUAL_FRAME_RATE_HZ / DEFAULT_FRAME_RATE_HZ
    return replace(
        tracking,
        angle_acceleration=tracking.angle_acceleration / math.pow(slower, 2),
        length_acceleration=tracking.length_acceleration / math.pow(slower, 2),
        growth_acceleration=tracking.growth_acceleration / math.pow(slower, 2),
        memory=tracking.memory * slower,
    )


def estimate_frames(
    inputs: Inputs, search: PoseSearch, track: bool, missing: Sequence[str]
) -> Iterator[tuple[str, PoseEstimate]]:
    """The missing frames' poses: those that are known, then those of the matching diagram.

    Raises SettingsError where a frame has no picture.
    """
    yield from ((frame, pose) for frame, pose in inputs.known.items() if frame in missing)
    left = [frame for frame in missing if frame not in inputs.known]
    if not left:
        return
    # What colours and starts say of a frame depends on those before: they are followed again. So
    # is a track from the last frame that is known.
    follows = bool(inputs.scene.images or inputs.starts or inputs.known)
    played = inputs.frames[max(len(inputs.known) - 1, 0) :] if follows else left
    matching = build_recorded_matching(
        inputs.scene,
        search,
        inputs.cameras,
        played,
        inputs.root_positions,
        tracking=sequence_tracking(inputs.scene, search, track),
        starts=inputs.starts,
    )
    period = 1.0 / (inputs.scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)
    simulator = Simulator(matching.diagram)
    for index, frame in enumerate(played):
        # The frame is matched at index periods; half a period later the answer surely stands.
        simulator.AdvanceTo((index + 0.5) * period)
        if frame in left:
            pose = matching.estimate(simulator.get_context())
            if pose is None:
                raise SettingsError(f"frame '{frame}': the matcher got no picture")
            yield frame, pose


def match_frames(
    result: ResultWriter, search: PoseSearch, track: bool, overlay: bool
) -> Iterator[FinishedFrame]:
    """The missing frames of a result, matched or tracked, compared with their masks and drawn."""
    inputs, renderers = result.inputs, _Renderers(result.inputs)
    model, scene = inputs.model, inputs.scene
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    for frame, pose in estimate_frames(inputs, search, track, result.missing):
        base = base_cells(pose.X_WB) if result.with_base and pose.found else None
        drawn: dict[str, Drawn] = {}
        for camera in inputs.cameras:
            key = camera.name, frame
            if key in scene.masks or (overlay and key in scene.images):
                seen = scene.read(*key) if key in scene.masks else scene.read_image(*key)
                drawn[camera.name] = renderers.draw(camera, seen, pose)
        of_masks = {name: one for name, one in drawn.items() if (name, frame) in scene.masks}
        agreement = compare_masks(
            {name: one.seen for name, one in of_masks.items()},
            {name: one.body for name, one in of_masks.items()},
        )
        joints, families = record_pose_set(pose.pose_set, kinds)
        search_said = pose.statistics
        record = FrameRecord(
            found=pose.found,
            E_total=pose.E_total if pose.found else None,
            seconds=pose.seconds,
            first_E_total=pose.first_E_total if pose.found else None,
            runs=search_said.runs,
            stopped_by=pose.stopped_by,
            outside_limit=search_said.outside_limit,
            joint_errors=result.joint_errors(frame, pose.q, pose.found),
            camera_scale=_camera_scale(scene, frame, pose),
            explained=pose.explained,
            joints=joints,
            families=families,
            family_count=None if pose.pose_set is None else pose.pose_set.family_count,
            ious=dict(agreement.ious) if pose.found else {},
        )
        row = PoseRow(frame, pose.q, base, pose.E_total, pose.seconds)
        yield FinishedFrame(row, record, drawn if overlay else {})


class _Renderers:
    """Draw the body in the cameras of a scene, whose scale may have been found."""

    def __init__(self, inputs: Inputs) -> None:
        self._model = inputs.model
        self._renderers: dict[str, LabelRenderer] = {}

    def draw(self, camera: Camera, seen: np.ndarray, pose: PoseEstimate) -> Drawn:
        """The body beside what the camera saw."""
        if not pose.found:
            return Drawn(seen, np.zeros(seen.shape[:2], dtype=np.bool_), None)
        if camera.name not in self._renderers:
            self._renderers[camera.name] = LabelRenderer(self._model, camera)
        renderer = self._renderers[camera.name]
        if isinstance(camera, ParallelCamera):
            renderer.camera = scale_camera(camera, pose.scale)
        segments = renderer.segments(pose.q, pose.X_WB)
        return Drawn(seen, segments >= 0, segments)


def _camera_scale(scene: Scene, frame: str, pose: PoseEstimate) -> float | None:
    """Pixels a metre of the frame's camera, where they were not known."""
    if not (scene.scale_unknown and pose.found):
        return None
    camera = scene.cameras[scene.cameras_of(frame)[0]]
    return pose.scale * camera.pixels_per_metre if isinstance(camera, ParallelCamera) else None


def compare_cameras(result: ResultWriter, search: PoseSearch, on_stage: OnStage | None) -> None:
    """Warn of cameras that contradict each other; few frames are matched again for it."""
    inputs = result.inputs
    if inputs.scene.images:
        return
    if isinstance(search, (BeamSearch, MultiStartSearch)):
        search = search.without_alternatives()

    def match(frame: str, views: Sequence[View]) -> float:
        if on_stage is not None:
            on_stage("comparing the cameras", 0, None)
        found = search.match(views, (inputs.root_positions or {}).get(frame))
        return found.E_total if found.found else math.inf

    contradiction = find_contradiction(
        match, inputs.cameras, inputs.scene.read, inputs.scene.masks, result.records
    )
    if contradiction is not None:
        result.warn([contradiction.text])
