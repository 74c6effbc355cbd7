"""A scene in, a pose a frame out: one call, one loop over frames."""

from __future__ import annotations

from pathlib import Path

from drake_pose.files.folder import SHAPES, writes_folder
from drake_pose.files.overlay import encode_png
from drake_pose.files.records import SceneEstimate, describe_job, open_job
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import OnFrame, OnStage, ResultWriter
from drake_pose.jobs.estimate.body_fit import fit_body
from drake_pose.jobs.estimate.inputs import read_inputs
from drake_pose.jobs.estimate.matching import check_track, compare_cameras, match_frames
from drake_pose.jobs.estimate.person import follow_person
from drake_pose.workers import working


@writes_folder
def estimate_scene(
    scene: Path | str,
    model: Path | str,
    out: Path | str | None = None,
    settings: EstimateSettings | None = None,
    *,
    truth: Path | str | None = None,
    cameras: Path | str | None = None,
    resume: bool = False,
    replay: bool = True,
    overlay: bool = True,
    on_frame: OnFrame | None = None,
    on_stage: OnStage | None = None,
) -> SceneEstimate:
    """Estimate the positions of a body in every frame of a scene.

    Args:
        scene: cameras.yaml and masks/<camera>/<frame>.png; or masks/<frame>.png alone, of a camera
            nobody calibrated; or an episode (``open_episode``), followed from where its log begins.
        out, resume: folder for the result, None writes nothing; to go on with an interrupted one.
        settings: which cameras and frames, the root, the sampling.
        truth: measured joint positions to compare with; None: joint_angles.csv, the episode's log.
        cameras: a camera file in place of the scene's own.
        replay, overlay: whether replay.html and overlays are written.
        on_frame, on_stage: called after each frame; with what is done before the first one.

    Returns the estimate. Interrupted (KeyboardInterrupt), the finished frames are in ``out``.

    Raises DrakePoseError: names the file, camera, frame, link or joint at fault.
    """
    settings, folder = settings or EstimateSettings(), None if out is None else Path(out)
    known, own = (None if one is None else Path(one) for one in (truth, cameras))
    job = describe_job(Path(scene), Path(model), settings, own)
    earlier = open_job(folder, job, resume)
    inputs = read_inputs(Path(scene), Path(model), settings, known, own)
    inputs, of_body, shapes = fit_body(inputs, settings, on_stage)
    result = ResultWriter(
        inputs.scene, inputs.model, job, folder, earlier=earlier, with_base=inputs.base_moves,
        frames=inputs.frames, warnings=inputs.warnings,
    )  # fmt: skip
    search, method = inputs.search, "paper" if settings.method == "paper" else "beam"
    result.more |= {"method": method if search else "person"} | of_body
    result.begin()
    try:
        if shapes is not None:
            result.write(SHAPES, encode_png(shapes))
        if search is None:
            inputs, frames = follow_person(inputs, result, overlay, on_stage)
        else:
            missing = [frame for frame in inputs.frames if frame not in result.records]
            frames = match_frames(inputs, search, overlay, missing)
        with working(settings.workers):
            result.add_all(frames, inputs.frames, on_frame)
            if search is not None:
                result.warnings += check_track(inputs, search, result.records)
                result.warnings += compare_cameras(inputs, search, result.records, on_stage)
        result.finish(replay)
    finally:
        result.write_summary()
    return result.result()
