"""The commands `drake-pose estimate`, `demo`, `batch`, `capture` and `empty-room`."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from drake_pose.commands.common import (
    SPREAD,
    Cameras,
    Json,
    Model,
    Out,
    Overlay,
    Replay,
    Resume,
    Truth,
    UsageError,
    count_progress,
    frame_progress,
    print_json,
    print_line,
    print_next,
    print_result,
    print_table,
    progress_bar,
    say,
    warn,
    within,
)
from drake_pose.errors import SceneError, listed
from drake_pose.files.settings import (
    CaptureMethod,
    CaptureSettings,
    EstimateSettings,
    LiveSettings,
    changed,
    percent,
)

if TYPE_CHECKING:
    from drake_pose.files.records import SceneEstimate
    from drake_pose.jobs.batch import Batch


def estimate(
    scene: Path,
    /,
    *,
    model: Model,
    out: Out,
    cameras: Cameras = None,
    truth: Truth = None,
    settings: Annotated[EstimateSettings | None, SPREAD] = None,
    resume: Resume = False,
    overlay: Overlay = True,
    replay: Replay = True,
    json: Json = False,
) -> None:
    r"""Estimate the joint angles in every frame of a scene.

    The body is placed link by link and fitted to the contours of the silhouettes, of all cameras
    together. If scene.yaml has sequence: true, the pose is searched in the first frame and tracked
    in the others. A person with landmarks.yaml before two or more cameras is fitted to all
    silhouettes at once, link lengths and radius scales included.

        drake-pose estimate ../shared/data/arm_two_views --out results/arm \
          --model ../shared/data/arm_two_views/med7/med7.urdf

    Files in the output folder: report.html (start here); poses.csv (joint positions [rad or m] and
    E_total in each frame); joints.csv (95 % intervals, and whether the silhouettes determine a
    joint); modes.csv (other poses that fit equally well); summary.json; overlay/; replay.html.
    E_total is the area where body and silhouettes differ, divided by the silhouettes' area. Ctrl-C
    keeps the finished frames.

    Args:
        scene: Folder with cameras.yaml and masks/<camera>/<frame>.png; or with masks/<frame>.png
            alone, of one camera without calibration. A sequence may have images/ or videos/ and a
            mask of the first frame only. Or a robot's recorded episode (pictures with a joint log,
            LeRobot, DROID, ROS bag), tracked by colour from the first logged joint positions.
    """
    from drake_pose.jobs.estimate.compile_ahead import compiling_ahead
    from drake_pose.jobs.estimate.scene import estimate_scene

    with compiling_ahead(), frame_progress() as (on_frame, on_stage):
        result = estimate_scene(
            scene, model, out, settings, truth=truth, cameras=cameras, resume=resume,
            replay=replay, overlay=overlay, on_frame=on_frame, on_stage=on_stage,
        )  # fmt: skip
    print_result(result, json, _print_estimate)
    if result.found_count == 0:
        raise SceneError("no pose was found in any frame")


def demo(
    *, out: Annotated[Path, Parameter(alias="-o")] = Path("results/demo"), json: Json = False
) -> None:
    """Estimate a man's pose from one silhouette that comes with the program.

    The man balances on a beam before one camera. Only the position of his right ankle is known: the
    search starts at that foot and finds all other joint angles, as in the experiment of Kameda,
    Minoh and Ikeda with real people. The model has average proportions, not those of this man.

        drake-pose demo --out results/demo

    Args:
        out: Folder for the result.
    """
    from drake_pose.jobs.demo import run_demo
    from drake_pose.jobs.estimate.compile_ahead import compiling_ahead

    with compiling_ahead(), frame_progress() as (on_frame, _):
        result = run_demo(out, on_frame=on_frame)
    print_result(result, json, _print_demo)
    if result.found_count == 0:
        raise SceneError("no pose was found")


def _print_estimate(result: SceneEstimate) -> None:
    """Print the answer, and joint errors if positions were measured."""
    from drake_pose.files.page import estimate_answer

    print_line(estimate_answer(result)[0])
    kinds = dict(zip(result.position_names, result.position_kinds, strict=True))
    rows = []
    for name, errors in result.summary["joint_errors"].items():
        unit, digits = ("deg", 1) if kinds[name] == "angle" else ("m", 3)
        ends = (f"{errors[key]:.{digits}f} {unit}" for key in ("mean", "largest"))
        rows.append((name, *ends))
    print_table(("joint", "mean", "largest"), rows, "Joint errors")


def _print_demo(result: SceneEstimate) -> None:
    """Print the joint angles and error of the only frame, and where the overlay is."""
    from drake_pose.files.folder import OVERLAY
    from drake_pose.files.page import estimate_answer

    (record,) = result.records.values()
    rows = []
    for name, kind, value in zip(
        result.position_names, result.position_kinds, record.q, strict=True
    ):
        angle = f"{math.degrees(value):.1f} deg"
        rows.append((name, angle if kind == "angle" else f"{value:.3f} m"))
    print_table(("joint", "value"), rows, "Joint angles of the man in the picture")
    print_line(
        f"{estimate_answer(result)[0]} Kameda, Minoh and Ikeda report 22.3 % for six pictures of a "
        "woman, with a model of her."
    )
    for path in result.folder.glob(f"{OVERLAY}/*/*.png") if result.folder else ():
        print_line(
            f"overlay              {path}: body and silhouette agree (light grey), silhouette "
            "only (blue), body only (orange)"
        )


def capture(
    scene: Path,
    /,
    *,
    out: Out,
    model: Path | None = None,
    method: CaptureMethod = "person",
    truth: Truth = None,
    live: Annotated[LiveSettings | None, SPREAD] = None,
    settings: Annotated[CaptureSettings | None, SPREAD] = None,
    resume: Resume = False,
    overlay: Overlay = True,
    replay: Replay = True,
    json: Json = False,
) -> None:
    """Capture the motion of one person with several calibrated cameras, from masks or live.

    No measurement of the person is needed: link lengths and radius scales are fitted to the first
    frames. The command is estimate with the bundled person as the model; frames are a sequence
    unless scene.yaml has sequence: false. If the folder has sources.yaml beside cameras.yaml,
    frames are captured as they arrive, from live cameras in real time, until Ctrl-C.

        drake-pose capture STUDIO --out results/person --seconds 60

    Args:
        scene: Folder with cameras.yaml and masks, or with a sources.yaml.
        model: Model of a person with landmarks.yaml beside it. Default: the bundled person.
        method: person: fit the person to all silhouettes at once; paper: detect skin in colour
            pictures and search for elbows and knees, as published by Date et al.
    """
    settings, live = settings or CaptureSettings(), live or LiveSettings()
    is_person, of_masks = method == "person", "--camera, --frame, --every, --truth, --no-track, "
    # Not SOURCES of camera.sources: importing that module would slow the start of every command.
    has_sources = (scene / "sources.yaml").is_file()
    if truth or resume or set(changed(settings)) - {"packages"}:
        if not is_person:
            raise UsageError(f"{of_masks}--resume need --method person")
        if has_sources:
            raise UsageError(f"{of_masks}--resume need masks, but {scene} has a sources.yaml")
    if is_person and live.faces is not None:
        raise UsageError("--face-camera and --faces need --method paper")
    if is_person and not has_sources and live != LiveSettings():
        raise UsageError(f"{scene} has no sources.yaml, which options of live capture need")
    if is_person and not has_sources:
        from drake_pose.jobs.estimate.inputs import bundled_person

        given = {one.name: getattr(settings, one.name) for one in fields(settings)}
        estimate(
            scene, model=model or bundled_person(), out=out,
            settings=EstimateSettings(method="person", **given),
            truth=truth, resume=resume, overlay=overlay, replay=replay, json=json,
        )  # fmt: skip
        return
    from drake_pose.jobs.live import capture_live, hush_opencv, load_live_scene

    hush_opencv()
    studio = load_live_scene(scene)
    if not is_person and any(one.live for one in studio.specifications.values()):
        say("drake-pose: stand upright in view of the cameras, both arms spread to the sides")
    with count_progress("frames", None) as advance:
        found, interrupted, unreported = capture_live(
            studio, out, model, live, method, packages=settings.packages, replay=replay,
            on_report=warn, on_frame=lambda count, _: advance(count),
        )  # fmt: skip
    warn(*unreported)
    if interrupted:
        say("drake-pose: stopped by Ctrl-C; all frames are kept")
    if json:
        print_json(found.summary)
    elif found.records:
        _print_estimate(found)
        # Use of each camera's pictures, and the times at which it stopped and returned.
        rows = []
        for name, source in found.summary["sources"].items():
            changes = [
                f"{one['what']} at {one['time']:.2f} s" if one["time"] is not None else "gave none"
                for one in source["changes"]
            ]
            numbers = [str(source[what]) for what in ("used", "dropped", "late")]
            rows.append((name, *numbers, ", ".join(changes)))
        head = ("camera", "pictures used", "unusable", "too late", "stopped and returned")
        print_table(head, rows)
        print_next(found.folder, found.summary)
    if not found.records:
        raise SceneError("no camera gave a picture")
    if not found.found_count:
        raise SceneError("no person was found in any frame")


def empty_room(folder: Path, /, *, pictures: Annotated[int, within(1)] = 30) -> None:
    """Take background pictures of the empty room with the cameras of a sources.yaml.

    Live capture segments the person as the region that differs from these pictures. Leave the room
    first, and take new ones after the light changes or a camera moves.

        drake-pose empty-room STUDIO

    Args:
        folder: Folder with cameras.yaml and sources.yaml.
        pictures: Number of pictures of each camera.
    """
    from drake_pose.jobs.live import hush_opencv, take_empty_room

    hush_opencv()
    for camera, place in take_empty_room(folder, pictures).items():
        say(f"drake-pose: {camera}: {pictures} pictures of the empty room in {place}")


def batch(
    jobs: Path,
    /,
    *,
    out: Out,
    workers: Annotated[int | None, within(0)] = None,
    scheduler: Annotated[str | None, Parameter(metavar="ADDRESS")] = None,
    resume: Resume = False,
    json: Json = False,
) -> None:
    """Estimate or audit many scenes in worker processes; long scenes are cut into chunks of frames.

    Each scene gets the result folder that estimate or audit would write. A scene that fails is
    named and does not stop the others. Ctrl-C keeps the finished chunks. The workers of a Dask
    scheduler must have the same version of drake_pose, and find scenes, models and the output
    folder at the same paths.

    The job file holds settings of estimate by their names in Python (EstimateSettings):

        chunk: 100
        defaults: {replay: false}
        scenes:
          monday: {scene: recordings/monday, model: arm.urdf, every: 2}
          walker: {scene: recordings/walker}
          robot: {scene: recordings/robot, model: arm.urdf, audit: recordings/robot/joints.csv}

    A scene with the key audit is audited; all errors are listed in findings.csv. Of episodes in one
    data set or folder the first is searched, and the others start at its cameras; episodes.csv and
    report.html tell which episodes share a camera's pose, and when a camera moved.

        drake-pose batch jobs.yaml --out results/all --workers 2

    Args:
        jobs: The job file (YAML).
        workers: Number of worker processes on this machine; 0: this process does the work. Default:
            one for each core, or 0 if the extra cluster is not installed.
        scheduler: Address of a Dask scheduler whose workers are used instead, such as
            tcp://10.0.0.7:8786.
    """
    from drake_pose.jobs.batch import run_batch
    from drake_pose.jobs.batch_tasks import read_job
    from drake_pose.jobs.cluster import has_dask, open_cluster, require_fit_workers

    read = read_job(jobs)
    if workers and scheduler is not None:
        raise UsageError("give --workers or --scheduler, not both")
    if workers is None and scheduler is None and not has_dask():
        warn('one process does all the work; to use all cores: pip install "drake_pose[cluster]"')
        workers = 0
    with ExitStack() as opened:
        client = None
        if workers != 0 or scheduler is not None:
            client = opened.enter_context(open_cluster(workers, scheduler))
        if client is not None and scheduler is not None:
            require_fit_workers(client, out.absolute().parent)
        bar = opened.enter_context(progress_bar())
        task = bar.add_task("reading", total=None)

        def show(done: int, total: int, message: str) -> None:
            bar.update(task, description="frames", completed=done, total=total)
            if message:
                warn(message)

        result = run_batch(read, out, client, resume, show)
    if json:
        print_json(result.as_json())
    else:
        _print_batch(result)
    for name in result.failed:
        for error in result.scenes[name].errors:
            say(f"drake-pose: error: scene '{name}': {error}")
    if result.failed:
        raise SceneError(f"{len(result.failed)} of {len(result.scenes)} scenes failed")


def _print_batch(result: Batch) -> None:
    """Print a row for each scene, with some errors of audited ones, and the folder."""
    estimates, audits = [], []
    for name, state in result.scenes.items():
        totals, seconds = state.totals, f"{state.seconds:.1f}"
        count = "found_count" if state.job.audit is None else "agreeing_count"
        row = (name, state.state, f"{totals.get(count)} of {state.frame_count}" if totals else "")
        if state.job.audit is None:
            chunks = f"{len(state.done)} of {len(state.tasks)}"
            estimates.append((*row, percent(totals.get("mean_E_total")), chunks, seconds))
        else:
            named = [f"{one['what']} {one['name']}" for one in totals.get("findings", ())]
            audits.append((*row, listed(named), seconds))
    print_table(("scene", "state", "found", "E_total", "chunks", "seconds"), estimates, "Batch")
    print_table(("scene", "state", "consistent", "errors", "seconds"), audits, "Audits")
    frames = sum(state.frames_done for state in result.scenes.values())
    for text in (*result.moves, f"{frames} frames in {result.seconds:.1f} s"):
        print_line(text)
    print_next(result.out, {})
