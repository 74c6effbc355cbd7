"""Which frames, cameras or joints contradict the rest in a scene: read, found, told, written."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc

from drake_pose.arrays import Array, Picture
from drake_pose.body import ArticulatedModel, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import describe_camera, load_cameras
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, MaskError, SceneError, SettingsError
from drake_pose.files.folder import write_summary, writes_folder
from drake_pose.files.options import percent
from drake_pose.files.records import user_units
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.summary import mask_digests
from drake_pose.jobs.estimate.episode import say_left_out
from drake_pose.jobs.estimate.searches import make_tree
from drake_pose.jobs.registration.inputs import (
    EpisodeInputs,
    GivenFiles,
    Inputs,
    looks_at_pictures,
    read_episode,
)
from drake_pose.jobs.registration.positions import KnownPositions, read_known_positions
from drake_pose.jobs.registration.result import (
    describe_pictures,
    describe_pose,
    describe_run,
    say_drift,
    say_lost,
    say_reading,
    write_comparisons,
    write_overlays,
)
from drake_pose.jobs.registration.settings import AuditSettings
from drake_pose.registration.diagnosis import (
    DIAGNOSIS,
    Diagnosis,
    Finding,
    FrameDiagnosis,
    diagnose_frames,
)
from drake_pose.registration.online_registration import pose_difference, squared_distance
from drake_pose.registration.per_frame_fit import PerFrameFit
from drake_pose.registration.picture_registration import (
    Begun,
    PictureRegistration,
    Recording,
    fit_pictures,
    judge_pictures,
    register_pictures,
)
from drake_pose.registration.posed_frames import PosedFrame, SeenFrame, placed_points
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.silhouette.areas.scoring import require_visible
from drake_pose.silhouette.pictures.scene_checks import frame_ranges, read_scene
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.workers import working

OnFrame = Callable[[int], None]
"""Called with the number of frames that are done."""

# So many frames tell how large silhouettes are, and where the body is.
_SAMPLE = 20
# Sizes of errors that are told.
_SIZES = ("surface", "mask", "camera")
# In which shifts are told, and what they are multiplied by for that.
_UNITS = {
    "focal": ("percent", 100.0),
    "center": ("px", 1.0),
    "clock": ("ms", 1e3),
    "rate": ("percent", 100.0),
}
_LENGTH = ("mm", 1e3)
# Where most frames contradict, other poses of cameras are tried on so many of them, of so many
# pairs; they are named where so much of the contours fits, and less than this share of what does
# not as given does not.
_LOOKED_AT, _PAIRS, _FITS, _LEFT = 3, 10, 0.7, 0.5
# As many joints are named in words.
_NAMED = 3


@dataclass(frozen=True, eq=False)
class SceneAudit:
    """What contradicts the rest in a scene; summary: what summary.json holds."""

    audit: Diagnosis
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
    folder: Path | None


@writes_folder
def audit_scene(
    scene: Path | str,
    model: Path | str,
    joints: Path | str | None = None,
    out: Path | str | None = None,
    settings: AuditSettings | None = None,
    *,
    cameras: Path | str | None = None,
    overlay: bool = True,
    on_frame: OnFrame | None = None,
) -> SceneAudit:
    """Finds which frames, cameras or joints contradict the rest, in time linear in the frames.

    Args:
        scene: the folder with cameras.yaml and masks; or an episode of pictures, in which the
            robot, and masks of it, are found without the cameras that are audited.
        model: the robot's model file. It stands in the world as the file has it.
        joints: joint positions by frame, of an episode by time, too (CSV) [rad or m]. None: an
            episode's own.
        out: folder for the result, new or empty; None writes nothing.
        cameras: a camera file in place of the scene's or episode's own.
        on_frame: called after each frame.

    Raises:
        DrakePoseError: names the file, camera, frame or joint at fault.
    """
    settings, begin = settings or AuditSettings(), time.perf_counter()
    table, own, folder = (None if one is None else Path(one) for one in (joints, cameras, out))
    files = GivenFiles(Path(scene), Path(model), table, own)
    with working(settings.workers):
        if looks_at_pictures(files.scene, settings):
            look = _look(read_episode(files, settings), on_frame)
        else:
            look = _audit(*_read_inputs(files, settings), on_frame)
    inputs, found = look.inputs, look.found
    seconds = time.perf_counter() - begin
    warnings = [*inputs.warnings, *look.misplaced, *_doubts(look, files.camera_file)]
    summary = {
        "contradictions": _describe_contradictions(found),
        "frame_count": len(found.frames),
        "agreeing_count": len(found.frames) - len(found.contradicting),
        "frames": _describe_frames(inputs, found),
        "found_cameras": {} if look.episode is None else _describe_cameras(look.episode),
        "noticed_from": _noticed_from(found, inputs.model),
        "principal_point_px": found.center
        and dict(zip(("offset", "sd"), found.center, strict=True)),
        "error_sizes_px": {name: float(getattr(found.sizes, name)) for name in _SIZES},
        **describe_run(files, settings, warnings, seconds),
        "unseen": look.unseen,
    }
    if folder is not None:
        _write_result(folder, look, overlay, summary)
    return SceneAudit(found, summary, tuple(warnings), folder)


class _Look(NamedTuple):
    """What was audited, and found: frames of which no mask shows anything, cameras' mistakes.

    episode: of which it is; None: of a scene of masks.
    """

    inputs: Inputs
    found: Diagnosis
    unseen: list[str]
    misplaced: list[str]
    episode: EpisodeLook | None = None


def _look(episode: EpisodeInputs, on_frame: OnFrame | None) -> _Look:
    """An audit of an episode."""
    seen = look_at_episode(episode)
    look = _audit(seen.inputs, tuple(seen.names), on_frame)
    zeros = [one.name for one in look.found.common if one.kind == "joint"]
    if zeros:
        # Masks were found with these as they are, and lean on them.
        seen = look_at_episode(episode, seen, zeros)
        look = _audit(seen.inputs, tuple(seen.names), None)
    found = replace(look.found, common=(*seen.findings, *look.found.common))
    return look._replace(found=found, episode=seen)


def _describe_frames(inputs: Inputs, found: Diagnosis) -> dict[str, Any]:
    """How well frames fit, and of which masks that is told."""
    names = [camera.name for camera in inputs.held]
    return {
        one.frame: {
            "agrees": one.finding is None,
            "fits": dict(one.given),
            "fits_when_freed": dict(one.fitted),
            "pixels": one.pixels,
            "masks": mask_digests(inputs.scene, names, one.frame),
        }
        for one in found.frames
    }


def _describe_cameras(look: EpisodeLook) -> dict[str, Any]:
    """Where cameras were found in pictures, how sure that is, and their clocks."""
    return {
        name: describe_pictures(one)
        | describe_pose("X_WC", one.found.camera.X_WC, one.found)
        | {
            "camera": describe_camera(one.found.camera),
            "covariance": one.found.covariance.tolist(),
        }
        for name, one in look.pictures.items()
    }


def _noticed_from(found: Diagnosis, model: ArticulatedModel) -> dict[str, float | None]:
    """How far joints must be off to be named [deg or m]; None: never."""
    units = zip(model.position_names, user_units(model), strict=True)
    return {
        name: unit * least if math.isfinite(least) else None
        for name, unit in units
        if (least := found.noticed_from.get(name)) is not None
    }


def _read_inputs(files: GivenFiles, settings: AuditSettings) -> tuple[Inputs, tuple[str, ...]]:
    """What is audited, and its frames, checked."""
    path = files.scene
    if files.joints is None:
        raise SettingsError(f"{path}: an audit of masks needs joint positions: --joints FILE")
    given = None if files.cameras is None else load_cameras(files.cameras)
    scene, frames = read_scene(path, settings.cameras, settings.frames, given, every=settings.every)
    if scene.scale_unknown:
        raise SceneError(
            f"{path}: has no cameras.yaml; an audit needs to know where the cameras are: "
            "drake-pose register finds that"
        )
    chosen = tuple(scene.cameras.values())
    model = load_model(files.model, package_paths=settings.packages)
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    positions = read_known_positions(files.joints, TreeKinematics(tree))
    warnings = [*scene.warnings, *model.warnings, *positions.warnings]
    if positions.are_one_pose(positions.of(frame, chosen[0].name) for frame in frames):
        warnings.append(
            "all frames show the robot in one pose, to a degree: errors of a joint's zero and of a "
            "camera that are the same in all frames can hardly be told apart"
        )
    return Inputs(scene, model, tree, positions, chosen, tuple(warnings)), frames


def _audit(inputs: Inputs, frames: Sequence[str], on_frame: OnFrame | None) -> _Look:
    """What contradicts the rest in some frames."""
    body = RegistrationBody(inputs.tree, inputs.seen)
    picks = np.linspace(0, len(frames) - 1, min(len(frames), _SAMPLE)).round()
    sample = [inputs.read(frames[int(k)]) for k in picks]
    _require_seen(body, inputs, sample)
    fit = PerFrameFit(body.kinematics, (body.few, body.all), inputs.held, sample)
    fitted, unseen = [], []
    for done, frame in enumerate(frames, 1):
        seen = inputs.read(frame)
        if seen.masks:
            fitted.append(fit.fit(seen))
        else:
            unseen.append(frame)
        if on_frame is not None:
            on_frame(done)
    if not fitted:
        raise MaskError(f"{inputs.scene.path}: no mask shows the body; it must be white in them")
    found, misplaced = diagnose_frames(fit, fitted), list[str]()
    if 2 * len(found.contradicting) > len(found.frames):
        shown = [inputs.read(one) for one in found.contradicting[:_LOOKED_AT]]
        misplaced = _misplaced(body, inputs, shown)
    return _Look(inputs, found, unseen, misplaced)


def _misplaced(body: RegistrationBody, inputs: Inputs, frames: Sequence[SeenFrame]) -> list[str]:
    """What would put cameras right that explain few frames: exchanged ones, inverses."""

    def fits(cameras: Sequence[Camera]) -> float:
        fit = PerFrameFit(body.kinematics, (body.few, body.all), cameras, frames)
        ratios = [fit.fit(one).inlier_ratios[1] for one in frames]
        return float(np.mean([value for one in ratios for value in one.values()]))

    given, (held, names) = fits(inputs.held), (inputs.held, [one.name for one in inputs.held])
    trials = [("every X_WC seems to be the inverse of the camera's pose in the world",
               [one.with_pose(np.linalg.inv(one.X_WC)) for one in held])]  # fmt: skip
    for a, b in list(combinations(range(len(held)), 2))[:_PAIRS]:
        other = list(held)
        other[a], other[b] = held[a].with_pose(held[b].X_WC), held[b].with_pose(held[a].X_WC)
        trials.append((f"cameras '{names[a]}' and '{names[b]}' seem to be exchanged", other))
    best, text = max((fits(cameras), text) for text, cameras in trials)
    if best < _FITS or 1.0 - best > _LEFT * (1.0 - given):
        return []
    return [f"{text}; so {percent(best)} of the contours fit, as given {percent(given)}"]


def _require_seen(body: RegistrationBody, inputs: Inputs, frames: Sequence[SeenFrame]) -> None:
    """Refuses a camera that cannot show the robot in any of some frames that it has masks of.

    Raises CameraError: as an estimate does.
    """
    for camera in inputs.held:
        own, refused = [one for one in frames if camera.name in one.masks], list[CameraError]()
        for frame in own:
            try:
                require_visible(body.few, camera.X_CW @ body.kinematics.poses(frame.values), camera)
            except CameraError as error:
                refused.append(error)
        if own and len(refused) == len(own):
            raise refused[0]


def _doubts(look: _Look, cameras: Path) -> list[str]:
    """What a user should know of the frames, and of the file of cameras."""
    warnings, found = list[str](), look.found
    if found.center is not None:
        (x, y), (x_sd, y_sd) = found.center
        advice = (
            "does the file have a CameraInfo's numbers? Write pixel_centers: drake beside them"
            if x < 0.0
            else "does it say pixel_centers: drake of numbers that count pixel centres at integers?"
        )
        warnings.append(
            f"{cameras}: the principal points are off by ({x:.2f}, {y:.2f}) +- ({x_sd:.2f}, "
            f"{y_sd:.2f}) pixels, half a pixel: {advice}"
        )
    if look.unseen:
        named = frame_ranges(look.unseen, look.inputs.scene.frames)
        warnings.append(f"frame {named}: the masks show nothing: there is nothing to compare")
    count, agreeing = len(found.frames), len(found.frames) - len(found.contradicting)
    if 2 * agreeing < count:
        warnings.append(
            f"{agreeing} of {count} frames agree with each other: which of them are "
            "right is told by their being near to what is given, not by their number"
        )
    return warnings


def _write_result(path: Path, look: _Look, overlay: bool, summary: Mapping[str, Any]) -> None:
    """The summary, and the robot at its encoders' positions over what is at fault."""
    inputs, episode = look.inputs, look.episode
    named = look.found.contradicting if overlay else ()
    pictures = {} if episode is None else {frame: episode.picture(frame) for frame in named}
    for camera in inputs.held if named else ():
        name, titled = camera.name, []
        for one in map(inputs.read, named):
            if name in one.masks:
                fits = percent(summary["frames"][one.name]["fits"][name])
                title = f"{name}  frame {one.name}  CONTRADICTS the others  {fits} fits"
                titled.append((PosedFrame(one.name, one.values, one.masks[name]), title))
        write_overlays(path, inputs.tree, camera, titled, inputs.seen, pictures)
    if episode is not None and overlay:
        for given in episode.given:
            own = episode.pictures[given.name]
            write_comparisons(path, inputs, own.frames, given, own.found, own.pictures)
    write_summary(path, summary)


def _describe_contradictions(found: Diagnosis) -> list[dict[str, Any]]:
    """What contradicts the rest, worst first: joints, cameras and the base, then frames."""
    told = [
        (one, one.kind, one.name, f"{say_off(one, 'off')} in all frames that agree, {_pixels(one)}")
        for one in found.common
    ]
    told += [
        (one.finding, "frame", one.frame, f"frame '{one.frame}': {_say_frame(one, one.finding)}")
        for one in sorted(found.frames, key=lambda one: -one.pixels)
        if one.finding is not None
    ]
    return [
        {
            "what": what,
            "name": name,
            "text": text,
            "cause": one.kind,
            "cause_name": one.name,
            "angle_deg": float(np.degrees(one.angle)),
            "angle_sd_deg": float(np.degrees(one.angle_sd)),
            **_shift(one),
            "pixels": one.pixels,
            "chance": one.p_value,
            "rivals": list(one.rivals),
            "joints": dict(one.joints),
        }
        for one, what, name, text in told
    ]


def _shift(one: Finding) -> dict[str, float]:
    """By how much something is shifted, in its own unit."""
    unit, factor = _UNITS.get(one.kind, _LENGTH)
    return {f"shift_{unit}": factor * one.shift, f"shift_sd_{unit}": factor * one.shift_sd}


def _say_frame(one: FrameDiagnosis, found: Finding) -> str:
    """What contradicts the others in a frame, in words."""
    if found.kind == "unexplained":
        worst = min(one.fitted, key=lambda name: one.fitted[name])
        return (
            f"no positions near those given explain it: in camera '{worst}' "
            f"{percent(one.fitted[worst])} of the contours fit at best"
        )
    if found.kind == "joints":
        named = sorted(found.joints.items(), key=lambda item: -abs(item[1]))
        joints = ", ".join(name for name, _ in named[:_NAMED])
        more = f" ({joints} most)" if joints else ""
        return f"is of other positions: joints are off{more}, {_pixels(found)}"
    return f"{say_off(found, 'is off')}, {_pixels(found)}"


def say_off(one: Finding, verb: str) -> str:
    """What is off, and what explains it as well; by how much, with standard deviations.

    verb: `off` or `is off`, of what is neither too high nor too long.
    """
    if one.kind == "clock":
        word = "later" if one.shift > 0.0 else "earlier"
        return (
            f"camera '{one.name}': its pictures show the joints of {1e3 * abs(one.shift):.0f} +- "
            f"{1e3 * one.shift_sd:.0f} ms {word} by the joint log's clock"
        )
    if one.kind == "rate":
        return say_drift(one.name, one.shift, one.shift_sd)
    name = "the base" if one.kind == "base" else f"{one.kind} '{one.name}'"
    name = f"the {one.name}" if one.kind in _UNITS else name
    if one.rivals:
        name += f" (or {', '.join(one.rivals)}: the masks cannot tell)"
    angle, angle_sd = np.degrees([one.angle, one.angle_sd]).tolist()
    unit, factor = _UNITS.get(one.kind, _LENGTH)
    shift, shift_sd = factor * one.shift, factor * one.shift_sd
    if one.kind == "joint":
        reading = (angle, angle_sd, "deg") if one.angle_sd > 0.0 else (shift, shift_sd, unit)
        return f"{name} {say_reading(*reading)}"
    if one.kind == "focal":
        # As for readings, the shift is what must be added.
        word, many = "short" if shift > 0.0 else "long", one.name.startswith("focal lengths")
        verb = "are" if many else "is"
        return f"{name} {verb} {abs(shift):.1f} +- {shift_sd:.1f} {unit} too {word}"
    parts = []
    if one.angle_sd > 0.0:
        parts.append(f"{angle:.2f} +- {angle_sd:.2f} degrees")
    if one.shift_sd > 0.0:
        parts.append(f"{shift:.1f} +- {shift_sd:.1f} {unit}")
    return f"{name}{':' if verb == 'off' else ''} {verb} by {' and '.join(parts)}"


def _pixels(one: Finding) -> str:
    return f"outlines by {one.pixels:.1f} pixels"


# A camera is compared as it is given that shows the body nearer than this to where it is seen [root
# of the silhouettes' area].
_NEAR = 0.08
# Clocks are as good as right that are off by about so much [s].
_CLOCK_SD = 0.002


@dataclass(frozen=True, eq=False)
class EpisodeLook:
    """An episode as an audit takes it.

    Args:
        inputs: the frames with masks that were found; cameras near those that are given.
        findings: cameras that are far from where their pictures show them, and clocks.
        pictures: by camera what was found in them.
        recordings: of these cameras.
        names: by frame of the inputs, its camera and its name there.
        given: cameras that are far from where they were found, as they are given.
    """

    inputs: Inputs
    findings: tuple[Finding, ...]
    pictures: Mapping[str, PictureRegistration]
    recordings: Mapping[str, Recording]
    names: Mapping[str, tuple[str, str]]
    given: tuple[PinholeCamera, ...]

    def picture(self, frame: str) -> Picture:
        """The picture (H, W, 3) of a frame of the inputs."""
        camera, name = self.names[frame]
        return self.recordings[camera].picture(name)


def look_at_episode(
    episode: EpisodeInputs, before: EpisodeLook | None = None, zeros: Sequence[str] = ()
) -> EpisodeLook:
    """Finds each camera of an episode in its pictures, and masks in all of these.

    Args:
        before: a look that found the cameras about.
        zeros: joints whose zeros are not trusted.

    Raises:
        SceneError: nobody says where a camera stands.
        RegistrationError: no pose of a camera explains its pictures.
    """
    placed = [name for name in episode.cameras if name in episode.placed]
    if not placed:
        raise SceneError(
            f"{episode.path}: no camera has an X_WC that could be audited; give a camera file "
            "(--cameras FILE), or find out where they stand: drake-pose register"
        )
    warnings = say_left_out(episode.cameras, episode.placed)
    body = RegistrationBody(episode.tree, episode.seen)
    held, findings, pictures = list[Camera](), list[Finding](), dict[str, PictureRegistration]()
    names, frames = dict[str, tuple[str, str]](), list[SeenFrame]()
    for name in placed:
        given, recording = episode.cameras[name], episode.recordings[name]
        if before is None:
            one = register_pictures(body, given, recording, zeros=zeros)
        else:
            one = fit_pictures(body, Begun.of(before.pictures[name]), recording, zeros=zeros)
        pictures[name] = one
        values = np.array([frame.values + one.zeros for frame in one.frames])
        off = compare_camera(body, given, one.found, values, alone=len(placed) == 1)
        near = off.pixels < _NEAR * one.fit.fit.seen[0].size
        held.append(given if near else one.found.camera)
        findings += [] if near or off.p_value > DIAGNOSIS.significance else [off]
        findings += _clock(body, one, recording)
        seen, _, lost = judge_pictures(body, one, one.found)
        for frame in seen:
            known = frame.name if len(placed) == 1 else f"{name}-{frame.name}"
            names[known] = name, frame.name
            frames.append(SeenFrame(known, frame.values, {name: frame.mask}))
        if lost:
            warnings.append(say_lost(name, lost, recording.names))
    inputs = Inputs(
        Scene(episode.path, episode.cameras, tuple(names), {}), episode.model, episode.tree,
        KnownPositions(episode.path, body.kinematics, {}), tuple(held),
        (*episode.warnings, *warnings), tuple(frames), seen=episode.seen,
    )  # fmt: skip
    far = tuple(episode.cameras[one.name] for one in findings if one.kind == "camera")
    return EpisodeLook(inputs, tuple(findings), pictures, episode.recordings, names, far)


def compare_camera(
    body: RegistrationBody,
    given: PinholeCamera,
    found: RegisteredCamera,
    values: Array,
    alone: bool,
) -> Finding:
    """By how much a camera stands elsewhere than it was found.

    Args:
        values: (f, m) where the body is in some frames.
        alone: whether it is the only one, so that the base may have moved as well.
    """
    off = pose_difference(found.camera.X_WC, given.X_WC)
    p_value = float(chdtrc(len(off), squared_distance(off, found.covariance)))
    return Finding(
        "camera", given.name, float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])),
        found.rotation_sd, found.translation_sd,
        _picture_shift(body, (given, values), (found.camera, values)), p_value,
        ("base",) if alone else (),
    )  # fmt: skip


def _clock(body: RegistrationBody, one: PictureRegistration, recording: Recording) -> list[Finding]:
    """Whether a camera's clock is off the joint log's, or drifts.

    recording: as it is.
    """
    clock, camera = one.offset, one.found.camera
    if clock is None or not clock.determined:
        return []
    rows = [recording.names.index(frame.name) for frame in one.frames]
    given, found = recording.values_at(0.0)[rows], one.recording.values_at(clock.value)[rows]
    known = np.isfinite(given).all(axis=1)
    pixels = _picture_shift(body, (camera, given[known]), (camera, found[known]))
    if pixels < DIAGNOSIS.min_joint_pixels:
        return []
    told = [
        ("clock", clock.value, clock.deviation, _CLOCK_SD),
        ("rate", clock.drift, clock.drift_deviation, 0.0),
    ]
    several = [
        (kind, value, sd, float(chdtrc(1, value**2 / (sd**2 + least**2))))
        for kind, value, sd, least in told
    ]
    return [
        Finding(kind, camera.name, 0.0, value, 0.0, sd, pixels, p_value)
        for kind, value, sd, p_value in several
        if p_value < DIAGNOSIS.significance
    ]


def _picture_shift(
    body: RegistrationBody, one: tuple[PinholeCamera, Array], other: tuple[PinholeCamera, Array]
) -> float:
    """How far points of a body are from each other in two pictures, root mean square [pixel].

    one, other: the cameras, and values (f, m) of the body.
    """
    places = []
    for camera, values in (one, other):
        points = [placed_points(body.very_few, body.kinematics.poses(row)) for row in values]
        places.append(camera.project(np.concatenate(points))[0])
    return float(np.sqrt(np.nanmean(((places[0] - places[1]) ** 2).sum(axis=1))))
