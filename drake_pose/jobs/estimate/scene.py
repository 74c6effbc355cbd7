"""Estimate of a scene: the pose in each frame, and checks of cameras and track at the end."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_pose.body import nearest_turn
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError, listed, weighted
from drake_pose.files.folder import OVERLAY_MODES, SHAPES, writes_folder
from drake_pose.files.overlay import draw_modes, encode_png
from drake_pose.files.records import (
    BADLY_EXPLAINED,
    FrameRecord,
    SceneEstimate,
    describe_job,
    read_earlier_summary,
    record_deviations,
    record_pose_set,
)
from drake_pose.files.settings import EstimateSettings, percent
from drake_pose.files.writer import Drawn, OnFrame, OnStage, ResultWriter
from drake_pose.jobs.estimate.body_fit import fit_body
from drake_pose.jobs.estimate.inputs import EstimateInputs, draw_parts, read_inputs
from drake_pose.jobs.estimate.person import follow_person
from drake_pose.search import (
    TRACKED,
    BeamSearch,
    MultiStartSearch,
    PoseEstimate,
    PoseMode,
    PoseSearch,
    View,
    scale_camera,
)
from drake_pose.silhouette.outline import TreeSurfaces
from drake_pose.silhouette.pictures.scenes import USUAL_RATE_HZ, Scene
from drake_pose.systems.diagrams import build_recorded_matching
from drake_pose.workers import use_workers


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
    on_frame: OnFrame = lambda *_: None,
    on_stage: OnStage = lambda *_: None,
) -> SceneEstimate:
    """Estimate the positions of a body in every frame of a scene.

    If interrupted (KeyboardInterrupt), the finished frames are kept in ``out``.

    Args:
        scene: folder with cameras.yaml and masks/<camera>/<frame>.png, or with masks/<frame>.png of
            an uncalibrated camera; or an episode (``open_episode``), tracked from its first pose.
        model: the model file.
        out: folder for the result; None writes nothing.
        settings: cameras, frames, root and method; None: defaults.
        truth: measured joint positions to compare with; None: joint_angles.csv or joint log.
        cameras: camera file; None: the scene's own.
        resume: continue the interrupted result in ``out``.
        replay, overlay: whether replay.html and overlays are written.
        on_frame: called before the first and after each frame.
        on_stage: called with the progress of stages before and after the frames.

    Raises:
        DrakePoseError: the message names the file, camera, frame, link or joint at fault.
    """
    settings, folder = settings or EstimateSettings(), None if out is None else Path(out)
    known, own = (None if one is None else Path(one) for one in (truth, cameras))
    job = describe_job(Path(scene), Path(model), settings, own)
    earlier = read_earlier_summary(folder, job, resume)
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
        with use_workers(settings.workers):
            result.add_all(frames, inputs.frames, on_frame)
            if search is not None:
                result.warnings += check_track(inputs, search, result.records)
                result.warnings += compare_cameras(inputs, search, result.records, on_stage)
        result.finish(replay)
    finally:
        result.end()
    return result.result()


def estimate_frames(
    inputs: EstimateInputs, search: PoseSearch, missing: Sequence[str]
) -> Iterator[tuple[str, PoseEstimate]]:
    """Yield name and pose of each missing frame: known estimates, then those of a Drake diagram.

    Poses of a MultiStartSearch have intervals of their joints.

    ``inputs``: the inputs. ``search``: the search, with which the diagram matches or tracks the
    body. ``missing``: names of the frames to be estimated, in the order of ``inputs.frames``.
    Raises SettingsError: a frame has no picture.
    """
    track_start: PoseEstimate | None = None
    for frame, track_start in inputs.known.items():
        if frame in missing:
            yield frame, track_start
    left = [frame for frame in missing if frame not in inputs.known]
    if not left:
        return
    # A track by colour, from a start, or from the last known frame depends on all frames before the
    # missing ones, which are therefore played again.
    follows = bool(inputs.scene.images or inputs.starts or inputs.known)
    played = inputs.frames[max(len(inputs.known) - 1, 0) :] if follows else left
    rate_hz = inputs.scene.frame_rate_hz or USUAL_RATE_HZ
    diagram, matcher = build_recorded_matching(
        replace(inputs.scene, frame_rate_hz=rate_hz), search, tuple(inputs.scene.cameras.values()),
        played, inputs.root_positions, tracking=inputs.tracking(), starts=inputs.starts,
    )  # fmt: skip
    simulator = Simulator(diagram)
    context = matcher.GetMyContextFromRoot(simulator.get_context())
    for index, frame in enumerate(played):
        # The frame is matched at index / rate_hz; half a period later its output is up to date.
        simulator.AdvanceTo((index + 0.5) / rate_hz)
        if frame in left:
            pose = matcher.belief(context).estimate
            if pose is None:
                raise SettingsError(f"frame '{frame}': the matcher got no picture")
            was_tracked = matcher.belief(context).was_tracked
            if pose.found and pose.pose_set is None and isinstance(search, MultiStartSearch):
                before = track_start if was_tracked else None
                if views := _views(inputs.scene, frame):
                    place = (inputs.root_positions or {}).get(frame)
                    pose = search.with_intervals(pose, views, place, before)
                else:
                    # Without masks, the intervals come from the fitted contours.
                    own = matcher.with_intervals(context) if was_tracked else pose
                    pose = own.widened(before)
            track_start = track_start if was_tracked else pose
            yield frame, pose


def _views(scene: Scene, frame: str) -> list[View]:
    """Return a view, camera and mask, of each camera with a mask of the frame."""
    return [View(scene.cameras[name], scene.read(name, frame)) for name in scene.cameras_of(frame)]


def match_frames(
    inputs: EstimateInputs, search: PoseSearch, overlay: bool, missing: Sequence[str]
) -> Iterator[tuple[FrameRecord, Drawn]]:
    """Yield record and overlays of each missing frame; the arguments are as in `estimate_frames`.

    ``overlay``: whether there are overlays; otherwise their mapping is empty.
    """
    scene, model = inputs.scene, inputs.model
    tree = model.pose_tree()
    surfaces = TreeSurfaces(tree)
    for frame, pose in estimate_frames(inputs, search, missing):
        masks = {name: scene.read(name, frame) for name in scene.cameras_of(frame)}
        shown: dict[str, np.ndarray] = {**inputs.pictures(frame), **masks} if overlay else {}
        parts, more = dict[str, np.ndarray](), dict[str, Any]()
        if pose.found:
            cameras = [scene.cameras[name] for name in {**masks, **shown}]
            for k, camera in enumerate(cameras):
                if isinstance(camera, ParallelCamera):
                    cameras[k] = scaled = scale_camera(camera, pose.scale)
                    if scene.scale_unknown and camera.name in masks:
                        more["camera_scale"] = scaled.pixels_per_metre
            values = tree.values_from_positions(pose.q)
            parts = draw_parts(surfaces.at(values), pose.X_WB @ tree.node_poses(values), cameras)
            more["first_E_total"] = pose.first_E_total
        # Without a pose set no joint has an interval.
        nothing = np.full(len(pose.q), np.nan)
        known = record_pose_set(pose.pose_set, search.tree) or {
            "joints": record_deviations(model, pose.q, nothing)
        }
        record, drawn = inputs.record_frame(
            frame, pose, masks, parts, shown, **more, **known, runs=pose.runs,
            outside_limit=pose.outside_limit, explained=pose.explained,
        )  # fmt: skip
        if shown and pose.found and pose.stopped_by != TRACKED:
            poses: list[PoseMode | PoseEstimate] = [pose]
            if pose.pose_set is not None and pose.pose_set.modes:
                poses = [*pose.pose_set.modes[:3]]
            bodies = []
            for one in poses:
                values = tree.values_from_positions(one.q)
                bodies.append((surfaces.at(values), one.X_WB @ tree.node_poses(values)))
            # Parts with determined joints are blue.
            sure = {name for name, joint in record.joints.items() if joint["determined"]}
            is_sure = np.array([sure.issuperset(node.value_names) for node in tree.nodes])
            picture = draw_modes(bodies, cameras[0], is_sure)
            drawn = {**drawn, f"{OVERLAY_MODES}/{frame}.png": picture}
        yield record, drawn


def compare_cameras(
    inputs: EstimateInputs,
    search: PoseSearch,
    records: Mapping[str, FrameRecord],
    on_stage: OnStage,
    doubtful: float = 0.12,
) -> list[str]:
    """Return a warning of cameras that are exchanged or inconsistent, if the poses fit badly.

    The result is [] if there is no such camera. Two frames are searched again with exchanged masks
    of the three worst cameras, without each of them, and with single cameras. What halves E_total
    is the cause.

    Args:
        inputs: the inputs.
        search: the search.
        records: estimates by frame.
        on_stage: called before the comparison.
        doubtful: median E_total from which two cameras are compared. Three or more are compared
            only from BADLY_EXPLAINED on: a real person before four cameras has an E_total of 15 to
            18 %, and a single inconsistent camera is detected by its IoU.
    """
    scene, cameras = inputs.scene, inputs.scene.cameras
    known = {f: one.E_total for f, one in records.items() if one.E_total is not None}
    usual = float(np.median(list(known.values()))) if known else 0.0
    least = doubtful if len(cameras) == 2 else BADLY_EXPLAINED
    if scene.images or len(cameras) < 2 or usual < least:
        return []
    whole = [f for f in known if all((name, f) in scene.masks for name in cameras)]
    # Frames near the median error: the worst may have other faults as well.
    chosen = sorted(whole, key=lambda frame: abs(known[frame] - usual))[:2]
    if not chosen:
        return []
    on_stage("comparing the cameras", 0, None)
    masks = {frame: {name: scene.read(name, frame) for name in cameras} for frame in chosen}

    def error(owners: Mapping[str, str]) -> float:
        """Return the mean E_total if each camera has the mask of the camera ``owners[name]``."""
        errors = []
        for frame, own in masks.items():
            views = [View(cameras[name], own[other]) for name, other in owners.items()]
            found = _match_again(inputs, search, frame, views)
            errors.append(found.E_total if found.found else math.inf)
        return float(np.mean(errors))

    together = float(np.mean([known[frame] for frame in chosen]))
    ious = {n: np.mean([records[f].ious.get(n, 0.0) for f in chosen]) for n in cameras}
    worst = sorted(cameras, key=lambda name: ious[name])[:3]
    sizes = {name: (camera.width, camera.height) for name, camera in cameras.items()}
    for one, other in combinations(worst, 2):
        if sizes[one] != sizes[other]:
            continue
        after = error({n: {one: other, other: one}.get(n, n) for n in cameras})
        if after < 0.5 * together:
            text = (
                f"cameras '{one}' and '{other}' seem to be exchanged: E_total is "
                f"{percent(together)}, but {percent(after)} with each other's masks; exchange "
                "their folders of masks, or their names in cameras.yaml"
            )
            return [weighted(text, "wrong")]
    without = {one: error({n: n for n in cameras if n != one}) for one in worst}
    bad = [name for name in worst if without[name] < 0.5 * together]
    if len(cameras) > 2:
        bad = sorted(bad, key=lambda name: without[name])[:1]
        if not bad and np.mean([error({name: name}) for name in cameras]) < 0.5 * together:
            bad = list(cameras)
    if not bad:
        return []
    names = " and ".join(f"'{name}'" for name in bad)
    what = f"cameras {names} are inconsistent"
    if len(bad) == 1:
        others = "the others" if len(cameras) > 2 else "the other one"
        what = f"camera {names} is inconsistent with {others}"
    each = ", ".join(f"{percent(left)} without '{name}'" for name, left in without.items())
    text = (
        f"{what}: E_total is {percent(together)} together, {each}; check whether a camera "
        "has moved since its calibration, whether masks belong to another camera or time, and "
        "whether X_WC is the camera's pose in the world, in metres"
    )
    return [weighted(text, "wrong")]


def _match_again(
    inputs: EstimateInputs, search: PoseSearch, frame: str, views: Sequence[View]
) -> PoseEstimate:
    """Return the pose searched from these views of a frame, without alternative poses."""
    if isinstance(search, (BeamSearch, MultiStartSearch)):
        search = search.without_alternatives()
    return search.match(views, (inputs.root_positions or {}).get(frame))


def check_track(
    inputs: EstimateInputs, search: PoseSearch, records: Mapping[str, FrameRecord]
) -> list[str]:
    """Return a warning if the track follows a wrong pose, otherwise [].

    If the worst tracked frame fits clearly worse than the best searched frame, it is searched as
    well; there is a warning if the search fits clearly better than the track.

    ``inputs``: the inputs. ``search``: the search. ``records``: estimates by frame.
    """
    searched, tracked = list[float](), dict[str, float]()
    for frame, one in records.items():
        if one.E_total is None or not inputs.scene.cameras_of(frame):
            continue
        if one.stopped_by == TRACKED:
            tracked[frame] = one.E_total
        else:
            searched.append(one.E_total)
    if not searched or not tracked:
        return []
    worst = max(tracked, key=lambda frame: tracked[frame])
    if not _is_worse(tracked[worst], min(searched)):
        return []
    found = _match_again(inputs, search, worst, _views(inputs.scene, worst))
    if not found.found or not _is_worse(tracked[worst], found.E_total):
        return []
    model, q = inputs.model, records[worst].q
    off = nearest_turn(found.q, q, model.periodic) - q
    far = np.flatnonzero(np.abs(off) > 0.5 * np.abs(off).max())
    where = f", with other positions of {listed([model.position_names[k] for k in far])}"
    text = (
        f"frame '{worst}': E_total is {percent(tracked[worst])} by tracking, but "
        f"{percent(found.E_total)} by a search{where}: its pose is wrong, and those of other "
        "frames may be; search every frame (--no-track) and compare"
    )
    return [weighted(text, "wrong")]


def _is_worse(error: float, other: float) -> bool:
    """Return whether an E_total is clearly larger than another: by a fifth, and by 0.01."""
    return error > max(1.2 * other, other + 0.01)
