"""A scene in, a pose a frame out: one call that runs the matching diagram."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.body_fit import fit_body
from drake_pose.jobs.estimate.fit_checks import find_contradiction
from drake_pose.jobs.estimate.inputs import Inputs, read_inputs
from drake_pose.jobs.estimate.person import follow_person
from drake_pose.jobs.estimate.result import OnFrame, OnStage, ResultWriter, SceneEstimate
from drake_pose.jobs.estimate.sequence import sequence_tracking
from drake_pose.results.folder import SHAPES, PoseRow, base_cells, read_summary, require_empty
from drake_pose.results.joint_tables import record_pose_set
from drake_pose.results.overlay import encode_png
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import FrameRecord, check_same_job, describe_job
from drake_pose.search.continuous.multi_start import MultiStartSearch
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.scoring import PoseSearch
from drake_pose.search.starts.root_placement import scale_camera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.mask_agreement import compare_masks
from drake_pose.systems.estimators.diagrams import build_recorded_matching
from drake_pose.systems.estimators.mask_player import DEFAULT_FRAME_RATE_HZ


def estimate_scene(
    scene: Path | str,
    model: Path | str,
    out: Path | str | None = None,
    settings: EstimateSettings | None = None,
    *,
    truth: Path | str | None = None,
    resume: bool = False,
    replay: bool = True,
    overlay: bool = True,
    on_frame: OnFrame | None = None,
    on_stage: OnStage | None = None,
) -> SceneEstimate:
    """Estimate the positions of a body in every frame of a scene.

    Args:
        scene: the scene's folder: cameras.yaml, masks/<camera>/<frame>.png; or masks/<frame>.png
            alone, of a camera that nobody knows.
        model: the body's model file.
        out: folder for the result; None writes nothing.
        settings: which cameras and frames, the root, the sampling.
        truth: measured joint positions to compare with; the scene's own joint_angles.csv, if it
            has one, where None.
        resume: go on with an interrupted result in ``out``.
        replay: whether replay.html is made.
        overlay: whether overlays are written.
        on_frame: hears of every finished frame.
        on_stage: hears of what is done before the first frame is finished.

    Returns:
        The estimate. Interrupted (KeyboardInterrupt), the finished frames are in ``out``; a person
        who is followed is followed again from the beginning when that is resumed.

    Raises:
        DrakePoseError: names the file, camera, frame, link or joint at fault.
    """
    settings, folder_path = settings or EstimateSettings(), None if out is None else Path(out)
    recorded = _recorded_summary(folder_path, resume)
    inputs = read_inputs(Path(scene), Path(model), settings, None if truth is None else Path(truth))
    job = describe_job(Path(scene), Path(model), settings)
    if recorded is not None and folder_path is not None:
        check_same_job(job, recorded, folder_path)
    inputs, of_body, shapes = fit_body(inputs, settings, on_stage)
    search = inputs.search
    with_base = search is not None and _base_moves(search)
    result = ResultWriter(inputs, job, folder_path, recorded, with_base)
    by_search = "paper" if settings.method == "paper" else "beam"
    result.more |= {"method": "person" if search is None else by_search} | of_body
    _open_result(result, shapes)
    try:
        if search is not None:
            matching = _Matching(inputs, search, result, settings.track, overlay)
            matching.run(on_frame)
            matching.compare_cameras(on_stage)
        elif result.missing:
            follow_person(result, settings.track, overlay, on_frame, on_stage)
        result.finish(replay)
    finally:
        result.close()
    return result.result()


def _open_result(result: ResultWriter, shapes: np.ndarray | None) -> None:
    """Begin the result, with the picture (h, w, 3) of a body's corrected shape if there is one."""
    result.open()
    if shapes is not None:
        result.write(SHAPES, encode_png(shapes))


def _recorded_summary(folder: Path | None, resume: bool) -> Mapping[str, Any] | None:
    """The summary of the job that is resumed; None where it is a new one, for an empty folder."""
    if folder is None:
        if resume:
            raise SettingsError("resume needs the folder of the result that is to be resumed")
        return None
    if resume:
        return read_summary(folder)
    require_empty(folder)
    return None


class _Matching:
    """Frames that are matched, one after the other, by the matching diagram."""

    def __init__(
        self, inputs: Inputs, search: PoseSearch, result: ResultWriter, track: bool, overlay: bool
    ) -> None:
        self._inputs, self._search, self._result = inputs, search, result
        self._tracking = sequence_tracking(inputs.scene, search, track)
        self._overlay = overlay
        self._renderers: dict[str, LabelRenderer] = {}

    def run(self, on_frame: OnFrame | None) -> None:
        """Run the diagram over the frames that are missing; every frame is written at once."""
        frames, total = self._result.missing, len(self._inputs.frames)
        finished = total - len(frames)
        if on_frame is not None:
            on_frame(finished, total, "", None)
        if not frames:
            return
        inputs = self._inputs
        for frame, match in inputs.known.items():
            if frame in frames:
                self._finish_frame(frame, match)
                finished += 1
                if on_frame is not None:
                    on_frame(finished, total, frame, self._result.records[frame])
        frames = self._result.missing
        if not frames:
            return
        # What colours and starts say of a frame depends on those before: they are followed again.
        follows = bool(inputs.scene.images or inputs.starts)
        played = inputs.frames if follows else tuple(frames)
        if inputs.known:
            # The track begins in the last frame that is known.
            played = inputs.frames[len(inputs.known) - 1 :]
        matching = build_recorded_matching(
            inputs.scene,
            self._search,
            inputs.cameras,
            played,
            inputs.root_positions,
            tracking=self._tracking,
            starts=inputs.starts,
        )
        period = 1.0 / (inputs.scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)
        simulator = Simulator(matching.diagram)
        for index, frame in enumerate(played):
            # The frame is matched at index periods; half a period later the answer surely stands.
            simulator.AdvanceTo((index + 0.5) * period)
            if frame not in self._result.records:
                self._finish_frame(frame, matching.estimate(simulator.get_context()))
                finished += 1
                if on_frame is not None:
                    on_frame(finished, total, frame, self._result.records[frame])

    def compare_cameras(self, on_stage: OnStage | None) -> None:
        """Warn of cameras that contradict each other; few frames are matched again for it."""
        scene, root_positions = self._inputs.scene, self._inputs.root_positions or {}
        if scene.images:
            return
        search = self._search
        if isinstance(search, MultiStartSearch):
            search = search.without_alternatives()

        def match(frame: str, views: Sequence[View]) -> float:
            if on_stage is not None:
                on_stage("comparing the cameras", 0, None)
            found = search.match(views, root_positions.get(frame))
            return found.E_total if found.found else math.inf

        contradiction = find_contradiction(
            match, self._inputs.cameras, scene.read, scene.masks, self._result.records
        )
        if contradiction is not None:
            self._result.warn([contradiction.text])

    def _finish_frame(self, frame: str, match: PoseEstimate | None) -> None:
        if match is None:
            raise SettingsError(f"frame '{frame}': the matcher got no picture")
        base = None
        if self._result.with_base and match.found:
            base = base_cells(match.X_WB)
        row = PoseRow(frame, match.q, base, match.E_total, match.seconds)
        model = self._inputs.model
        kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
        joints, families = record_pose_set(match.pose_set, kinds)
        record = FrameRecord(
            found=match.found,
            E_total=match.E_total if match.found else None,
            seconds=match.seconds,
            first_E_total=match.first_E_total if match.found else None,
            runs=match.statistics.runs,
            stopped_by=match.stopped_by,
            outside_limit=match.statistics.outside_limit,
            joint_errors=self._result.joint_errors(frame, match.q, match.found),
            camera_scale=self._camera_scale(frame, match),
            explained=match.explained,
            joints=joints,
            families=families,
            family_count=None if match.pose_set is None else match.pose_set.family_count,
            ious=self._compare(row, match),
        )
        self._result.finish_frame(row, record)

    def _compare(self, row: PoseRow, match: PoseEstimate) -> dict[str, float]:
        """Draws the body beside masks and over pictures; the masks' IoU by camera."""
        scene = self._inputs.scene
        masks, bodies = {}, {}
        for camera in self._inputs.cameras:
            key = camera.name, row.frame
            if key not in scene.masks and not (self._overlay and key in scene.images):
                continue
            seen = scene.read(*key) if key in scene.masks else scene.read_image(*key)
            body, segments = np.zeros(seen.shape[:2], dtype=np.bool_), None
            if match.found:
                segments = self._renderer(camera, match).segments(match.q, match.X_WB)
                body = segments >= 0
            if key in scene.masks:
                masks[camera.name], bodies[camera.name] = seen, body
            if self._overlay:
                self._result.write_overlay(camera.name, row, seen, body, segments)
        return dict(compare_masks(masks, bodies).ious) if match.found else {}

    def _renderer(self, camera: Camera, match: PoseEstimate) -> LabelRenderer:
        """Draws the body in a camera, whose scale may have been found."""
        if camera.name not in self._renderers:
            self._renderers[camera.name] = LabelRenderer(self._inputs.model, camera)
        renderer = self._renderers[camera.name]
        if isinstance(camera, ParallelCamera):
            renderer.camera = scale_camera(camera, match.scale)
        return renderer

    def _camera_scale(self, frame: str, match: PoseEstimate) -> float | None:
        """Pixels a metre of the frame's camera, where they were not known."""
        scene = self._inputs.scene
        if not (scene.scale_unknown and match.found):
            return None
        camera = scene.cameras[scene.cameras_of(frame)[0]]
        if not isinstance(camera, ParallelCamera):
            return None
        return match.scale * camera.pixels_per_metre


def _base_moves(search: PoseSearch) -> bool:
    """Whether the root's rotation or position moves the plant's whole world in the scene's."""
    tree, grids = search.tree, search.sampled.values
    for pick in (0, -1):
        _, X_WB = tree.positions_from([values[pick] for values in grids])
        if not np.allclose(X_WB, np.eye(4), atol=1e-12):
            return True
    return False
