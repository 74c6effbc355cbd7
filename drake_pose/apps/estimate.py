"""A scene in, a pose a frame out: one call that runs the matching diagram."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from drake_pose.apps.estimate_inputs import Inputs, read_inputs
from drake_pose.apps.estimate_sequence import sequence_tracking
from drake_pose.apps.joint_tables import family_table, joint_table, record_pose_set
from drake_pose.apps.measurements import angle_difference
from drake_pose.apps.overlay import draw_overlay, encode_png
from drake_pose.apps.replay import make_replay
from drake_pose.apps.result_folder import (
    FAMILIES,
    JOINTS,
    OVERLAY,
    REPLAY,
    PoseRow,
    ResultFolder,
    read_summary,
    require_empty,
    without_nan,
)
from drake_pose.apps.settings import EstimateSettings
from drake_pose.apps.summary import FrameRecord, check_same_job, describe_job, summarize
from drake_pose.camera import Camera, ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.filtering import TrackingSettings
from drake_pose.matching import MatchResult
from drake_pose.matching.root_placement import scale_camera
from drake_pose.matching.root_placement_search import PlacedMatch
from drake_pose.silhouette import LabelRenderer, Scene
from drake_pose.systems.diagrams import build_recorded_matching
from drake_pose.systems.mask_player import DEFAULT_FRAME_RATE_HZ

# Whatever ends the job writes the summary; this is for a job that is killed [s].
_SUMMARY_PERIOD = 2.0

OnFrame = Callable[[int, int, str, "FrameRecord | None"], None]
"""Called with the number of finished frames, that of all frames, and a finished frame's name and
record; once with "" and None before the first frame."""


@dataclass(frozen=True)
class SceneEstimate:
    """The estimate of a scene.

    Args:
        position_names: the plant's positions, in its order.
        position_kinds: "angle" [rad], "length" [m] or "quaternion" for each position.
        rows: the pose of each frame.
        records: what the search said about each frame, by name.
        summary: what summary.json holds.
        folder: the result folder, if one was written.
    """

    position_names: tuple[str, ...]
    position_kinds: tuple[str, ...]
    rows: tuple[PoseRow, ...]
    records: Mapping[str, FrameRecord]
    summary: Mapping[str, Any]
    folder: Path | None

    @property
    def found_count(self) -> int:
        """In how many frames a pose was found."""
        return sum(record.found for record in self.records.values())


def estimate_scene(
    scene: Path | str,
    model: Path | str,
    out: Path | str | None = None,
    settings: EstimateSettings | None = None,
    *,
    truth: Path | str | None = None,
    resume: bool = False,
    replay: bool = True,
    on_frame: OnFrame | None = None,
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
        on_frame: hears of every finished frame.

    Returns:
        The estimate. Interrupted (KeyboardInterrupt), the finished frames are in ``out``.

    Raises:
        DrakePoseError: names the file, camera, frame, link or joint at fault.
    """
    settings = settings or EstimateSettings()
    folder_path = None if out is None else Path(out)
    recorded = None
    if folder_path is not None:
        if resume:
            recorded = read_summary(folder_path)
        else:
            require_empty(folder_path)
    elif resume:
        raise SettingsError("resume needs the folder of the result that is to be resumed")
    inputs = read_inputs(Path(scene), Path(model), settings, None if truth is None else Path(truth))
    job = describe_job(Path(scene), Path(model), settings)
    if recorded is not None and folder_path is not None:
        check_same_job(job, recorded, folder_path)
    tracking = sequence_tracking(inputs.scene, inputs.search, settings.track)
    run = _Run(inputs, job, folder_path, recorded, tracking)
    run.estimate(on_frame)
    if replay:
        run.write_replay()
    return run.result()


class _Run:
    """One estimate under way."""

    def __init__(
        self,
        inputs: Inputs,
        job: Mapping[str, Any],
        path: Path | None,
        recorded: Mapping[str, Any] | None,
        tracking: TrackingSettings | None,
    ) -> None:
        self._inputs = inputs
        self._tracking = tracking
        self._job = job
        self._with_base = _base_moves(inputs)
        self._folder = None
        self._rows: dict[str, PoseRow] = {}
        self._records: dict[str, FrameRecord] = {}
        self._complete = False
        self._summary_time = 0.0
        self._renderers: dict[str, LabelRenderer] = {}
        if path is not None:
            names = inputs.model.position_names
            self._folder = ResultFolder(path, names, self._with_base, recorded is not None)
            self._rows = {row.frame: row for row in self._folder.rows}
        if recorded is not None:
            known = recorded.get("frames", {})
            for frame, row in self._rows.items():
                plain = {
                    "found": row.found,
                    "E_total": row.error if row.found else None,
                    "seconds": row.seconds,
                }
                self._records[frame] = FrameRecord.from_json(known.get(frame, plain))

    def estimate(self, on_frame: OnFrame | None) -> None:
        """Run the diagram over the frames that are missing; every frame is written at once."""
        missing = [frame for frame in self._inputs.frames if frame not in self._rows]
        finished, total = len(self._inputs.frames) - len(missing), len(self._inputs.frames)
        if self._folder is not None:
            self._folder.open()
        try:
            self._write_summary()
            if on_frame is not None:
                on_frame(finished, total, "", None)
            if missing:
                self._run_diagram(missing, finished, total, on_frame)
            if self._folder is not None:
                self._folder.sort(self._inputs.scene.frames)
            self._complete = True
        finally:
            self._write_summary()
            if self._folder is not None:
                self._folder.close()

    def _run_diagram(
        self, frames: list[str], finished: int, total: int, on_frame: OnFrame | None
    ) -> None:
        inputs = self._inputs
        matching = build_recorded_matching(
            inputs.scene,
            inputs.search,
            inputs.cameras,
            frames,
            inputs.root_positions,
            tracking=self._tracking,
        )
        period = _period(inputs.scene)
        simulator = Simulator(matching.diagram)
        for index, frame in enumerate(frames):
            # The frame is matched at index periods; half a period later the answer surely stands.
            simulator.AdvanceTo((index + 0.5) * period)
            self._finish_frame(frame, matching.matcher.last_result)
            if on_frame is not None:
                on_frame(finished + index + 1, total, frame, self._records[frame])

    def _finish_frame(self, frame: str, result: MatchResult | None) -> None:
        if result is None:
            raise SettingsError(f"frame '{frame}': the matcher got no picture")
        base = None
        if self._with_base and result.found:
            base = _base_cells(result.X_WB)
        row = PoseRow(frame, result.q, base, result.E_total, result.seconds)
        joints, families = record_pose_set(result.pose_set, self._position_kinds())
        record = FrameRecord(
            found=result.found,
            E_total=result.E_total if result.found else None,
            seconds=result.seconds,
            first_E_total=result.first_E_total if result.found else None,
            runs=result.runs,
            stopped_by=result.stopped_by,
            outside_limit=result.outside_limit,
            joint_errors=self._joint_errors(frame, result),
            camera_scale=self._camera_scale(frame, result),
            explained=result.explained,
            joints=joints,
            families=families,
            family_count=None if result.pose_set is None else result.pose_set.family_count,
        )
        # Finished is what has its row in poses.csv; all else of a frame comes before it.
        if self._folder is not None:
            self._write_overlays(self._folder, row, result)
            self._folder.add(row)
        self._rows[frame], self._records[frame] = row, record
        if time.monotonic() - self._summary_time > _SUMMARY_PERIOD:
            self._write_summary()

    def _position_kinds(self) -> dict[str, str]:
        model = self._inputs.model
        return dict(zip(model.position_names, model.position_kinds, strict=True))

    def _joint_errors(self, frame: str, result: MatchResult) -> dict[str, float]:
        """Estimate minus truth by position [deg or m]."""
        truth = self._inputs.truth
        true_values = None if truth is None else truth.of(frame)
        if truth is None or true_values is None or not result.found:
            return {}
        model = self._inputs.model
        errors = {}
        for name, true_value in zip(truth.names, true_values, strict=True):
            index = model.position_index(name)
            if model.position_kinds[index] == "angle":
                errors[name] = float(np.degrees(angle_difference(result.q[index], true_value)))
            else:
                errors[name] = float(result.q[index] - true_value)
        return errors

    def _write_overlays(self, folder: ResultFolder, row: PoseRow, result: MatchResult) -> None:
        scene = self._inputs.scene
        for camera in self._inputs.cameras:
            if (camera.name, row.frame) not in scene.masks:
                continue
            mask = scene.read(camera.name, row.frame)
            body, segments = np.zeros_like(mask), None
            error = "no pose found"
            if result.found:
                segments = self._renderer(camera, result).segments(result.q, result.X_WB)
                body = segments >= 0
                error = f"E_total {100.0 * result.E_total:.1f} %"
            title = [f"{camera.name}  frame {row.frame}  {error}"]
            picture = draw_overlay(mask, body, segments, title)
            folder.write(f"{OVERLAY}/{camera.name}/{row.frame}.png", encode_png(picture))

    def _renderer(self, camera: Camera, result: MatchResult) -> LabelRenderer:
        """Draws the body in a camera, whose scale may have been found."""
        scale = result.scale if isinstance(result, PlacedMatch) else 1.0
        if scale != 1.0 and isinstance(camera, ParallelCamera):
            return LabelRenderer(self._inputs.model, scale_camera(camera, scale))
        if camera.name not in self._renderers:
            self._renderers[camera.name] = LabelRenderer(self._inputs.model, camera)
        return self._renderers[camera.name]

    def _camera_scale(self, frame: str, result: MatchResult) -> float | None:
        """Pixels a metre of the frame's camera, where they were not known."""
        scene = self._inputs.scene
        if not (scene.scale_unknown and isinstance(result, PlacedMatch) and result.found):
            return None
        camera = scene.cameras[scene.cameras_of(frame)[0]]
        if not isinstance(camera, ParallelCamera):
            return None
        return result.scale * camera.pixels_per_metre

    def write_replay(self) -> None:
        """Write replay.html of the frames in which a pose was found."""
        rows = [row for row in self._ordered_rows() if row.found]
        if self._folder is None or not rows:
            return
        inputs = self._inputs
        period = _period(inputs.scene) if inputs.scene.sequence else 1.0
        page = make_replay(
            inputs.model,
            np.array([row.q for row in rows]),
            [_base_pose(row) for row in rows],
            inputs.cameras,
            period,
        )
        self._folder.write(REPLAY, page.encode())

    def result(self) -> SceneEstimate:
        """What came out."""
        model = self._inputs.model
        return SceneEstimate(
            position_names=model.position_names,
            position_kinds=model.position_kinds,
            rows=self._ordered_rows(),
            records={row.frame: self._records[row.frame] for row in self._ordered_rows()},
            summary=self._summary(),
            folder=None if self._folder is None else self._folder.path,
        )

    def _ordered_rows(self) -> tuple[PoseRow, ...]:
        """The rows in the scene's order, those of an earlier job among them."""
        return tuple(
            self._rows[frame] for frame in self._inputs.scene.frames if frame in self._rows
        )

    def _summary(self) -> dict[str, Any]:
        records = {row.frame: self._records[row.frame] for row in self._ordered_rows()}
        return without_nan(summarize(self._job, records, self._complete))

    def _write_summary(self) -> None:
        if self._folder is None:
            return
        self._folder.write_summary(self._summary())
        records = {row.frame: self._records[row.frame] for row in self._ordered_rows()}
        if any(record.joints for record in records.values()):
            self._folder.write(JOINTS, joint_table(records).encode())
            self._folder.write(FAMILIES, family_table(records).encode())
        self._summary_time = time.monotonic()


def _base_cells(X_WB: np.ndarray) -> np.ndarray:
    """Position and unit quaternion (7,) of a pose (4, 4)."""
    rotation = RotationMatrix.ProjectToRotationMatrix(X_WB[:3, :3])
    return np.concatenate([X_WB[:3, 3], rotation.ToQuaternion().wxyz()])


def _base_pose(row: PoseRow) -> RigidTransform:
    if row.base is None:
        return RigidTransform()
    # The quaternion was rounded when it was written.
    rotation = RotationMatrix(Quaternion(row.base[3:] / np.linalg.norm(row.base[3:])))
    return RigidTransform(rotation, row.base[:3])


def _base_moves(inputs: Inputs) -> bool:
    """Whether the root's rotation or position moves the plant's whole world in the scene's."""
    tree, grids = inputs.search.tree, inputs.search.sampled.values
    for pick in (0, -1):
        _, X_WB = tree.positions_from([values[pick] for values in grids])
        if not np.allclose(X_WB, np.eye(4), atol=1e-12):
            return True
    return False


def _period(scene: Scene) -> float:
    """Time between two frames in the diagram [s]."""
    return 1.0 / (scene.frame_rate_hz or DEFAULT_FRAME_RATE_HZ)
