"""A scene in, a pose a frame out: one call, one loop over frames."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.body_fit import fit_body
from drake_pose.jobs.estimate.inputs import read_inputs
from drake_pose.jobs.estimate.matching import compare_cameras, match_frames
from drake_pose.jobs.estimate.person import follow_person
from drake_pose.jobs.estimate.result import OnFrame, OnStage, ResultWriter, SceneEstimate
from drake_pose.results.folder import SHAPES, read_summary, require_empty
from drake_pose.results.overlay import encode_png
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import check_same_job, describe_job
from drake_pose.search.scoring import PoseSearch


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
            alone, of an uncalibrated camera.
        out: folder for the result; None writes nothing.
        settings: which cameras and frames, the root, the sampling.
        truth: measured joint positions to compare with; None: the scene's own joint_angles.csv.
        resume: go on with an interrupted result in ``out``.
        replay, overlay: whether replay.html is made, and overlays are written.
        on_frame: called after each frame.
        on_stage: called with what is done before the first frame is finished.

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
    result.more |= {"method": by_search if search is not None else "person"} | of_body
    result.open()
    try:
        if shapes is not None:
            result.write(SHAPES, encode_png(shapes))
        if search is not None:
            result.add_all(match_frames(result, search, settings.track, overlay), on_frame)
            compare_cameras(result, search, on_stage)
        elif result.missing:
            result.add_all(follow_person(result, settings.track, overlay, on_stage), on_frame)
        result.finish(replay)
    finally:
        result.close()
    return result.result()


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


def _base_moves(search: PoseSearch) -> bool:
    """Whether the root's rotation or position moves the plant's whole world in the scene's."""
    tree, grids = search.tree, search.sampled.values
    for pick in (0, -1):
        _, X_WB = tree.positions_from([values[pick] for values in grids])
        if not np.allclose(X_WB, np.eye(4), atol=1e-12):
            return True
    return False
