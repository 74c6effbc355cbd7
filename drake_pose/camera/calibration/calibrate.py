"""Calibration of one camera or several from pictures of a board.

Each camera's lens by Zhang's method; poses in one shared world from instants at which several
cameras saw the board: pairs, chained, then everything adjusted at once.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.calibration.board import Detection
from drake_pose.camera.calibration.bundle_adjustment import Rig, adjust_rig
from drake_pose.camera.calibration.initial_poses import (
    board_poses,
    chain_cameras,
    require_shared_pictures,
)
from drake_pose.camera.calibration.intrinsics import (
    LENS_MODELS,
    LensEstimate,
    estimate_lens,
    inverse_pose,
)
from drake_pose.camera.calibration.lens import Lens
from drake_pose.camera.calibration.mirrored_pictures import find_mirrored
from drake_pose.camera.calibration.pictures import BoardDetections, Picture
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, UnknownNameError

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CalibrationSettings:
    """How to calibrate.

    Args:
        world: "board:FRAME", the world is the board's frame at that instant (lay it on the floor:
            z is up); "camera:NAME", that camera's frame; "" for the first camera's.
        lens: "none" (no distortion), "standard" (k1, k2, p1, p2) or "full" (k3 too).
        drop_spoilt: go on without the pictures that spoil the calibration instead of refusing.
        leave_out: cameras ("left"), or pictures ("left/0007"), not to be used.
        spoilt_factor: a picture is spoilt whose error is this many times its camera's median, ...
        spoilt_pixels: ... and above this [pixel].
        largest_error: a calibration whose camera has a larger error is refused [pixel].

    Raises:
        CameraError: when a setting is out of its range.
    """

    world: str = ""
    lens: str = "standard"
    drop_spoilt: bool = False
    leave_out: Collection[str] = field(default=())
    spoilt_factor: float = 4.0
    spoilt_pixels: float = 0.5
    largest_error: float = 2.0

    def __post_init__(self) -> None:
        if self.lens not in LENS_MODELS:
            raise CameraError(f"lens must be one of {', '.join(LENS_MODELS)}, not '{self.lens}'")
        kind, _, name = self.world.partition(":")
        if self.world and (kind not in ("board", "camera") or not name):
            raise CameraError(f"world must be board:FRAME or camera:NAME, not '{self.world}'")
        for name in ("spoilt_factor", "spoilt_pixels", "largest_error"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise CameraError(f"{name} must be positive, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras.

    Args:
        cameras: free of distortion, in the shared world; of pictures that `lenses` undistorted.
        lenses: how each camera's pictures are distorted.
        X_WB: (4, 4) by frame: where the board was [m].
        errors: by (camera, frame): root mean square distance of the corners [pixel].
        camera_errors: the same over all of a camera's corners.
        left_out: pictures left out, with the reason.
        world: what the world is: board:FRAME or camera:NAME.
    """

    cameras: Mapping[str, PinholeCamera]
    lenses: Mapping[str, Lens]
    X_WB: Mapping[str, Array]
    errors: Mapping[Picture, float]
    camera_errors: Mapping[str, float]
    left_out: Mapping[Picture, str]
    world: str


def calibrate(seen: BoardDetections, settings: CalibrationSettings | None = None) -> Calibration:
    """Calibrates the cameras that saw a board.

    Args:
        seen: where the board's corners are, from find_boards.
        settings: how; the defaults where not given.

    Raises:
        CameraError: names the camera, and the picture that spoils the calibration: too few
            pictures, a camera that shares none with the others, a spoilt picture, a mirrored or
            moved camera, pictures too much alike.
        UnknownNameError: when the settings name a camera or frame that is not there.
    """
    settings = settings or CalibrationSettings()
    detections, left_out = _chosen(seen, settings)
    _check_board(seen, detections)
    points = seen.board.points
    lenses = {}
    for name in detections:
        lenses[name], spoilt = _lens_without_spoilt(name, points, detections, seen, settings)
        left_out |= spoilt
    rig, spoilt = _adjusted_rig(points, detections, lenses, settings)
    left_out |= spoilt
    errors = rig.errors(points, detections)
    camera_errors = _camera_errors(errors, detections)
    worst = max(camera_errors, key=lambda name: camera_errors[name])
    if camera_errors[worst] > settings.largest_error:
        raise CameraError(
            f"camera '{worst}': its corners are {camera_errors[worst]:.2f} pixel off, more than "
            f"{settings.largest_error:g}: is the board flat, still, and as its file says? Has the "
            "camera or its lens (focus, zoom) moved? Leave it out, or allow a larger error"
        )
    X_WR, world = _world(rig, settings.world)
    cameras = {n: rig.lenses[n].camera(n, X_WR @ rig.X_RC[n]) for n in detections}
    X_WB = {frame: X_WR @ X for frame, X in rig.X_RB.items()}
    return Calibration(cameras, rig.lenses, X_WB, errors, camera_errors, left_out, world)


def _chosen(
    seen: BoardDetections, settings: CalibrationSettings
) -> tuple[dict[str, dict[str, Detection]], dict[Picture, str]]:
    """The detections to use, in dictionaries of our own, and what was left out on request."""
    unwanted = set(settings.leave_out)
    known = {*seen.detections} | {
        f"{camera}/{frame}" for camera, frames in seen.detections.items() for frame in frames
    }
    known |= {f"{camera}/{frame}" for camera, frame in seen.not_found}
    for name in sorted(unwanted - known):
        raise UnknownNameError("camera or picture", name, sorted(known), "the calibration")
    left_out: dict[Picture, str] = {}
    detections: dict[str, dict[str, Detection]] = {}
    for camera, frames in seen.detections.items():
        if camera in unwanted:
            left_out |= {(camera, frame): "the camera was left out" for frame in frames}
            continue
        detections[camera] = {f: s for f, s in frames.items() if f"{camera}/{f}" not in unwanted}
        asked = {f for f in frames if f not in detections[camera]}
        left_out |= {(camera, frame): "left out on request" for frame in sorted(asked)}
    if not detections:
        raise CameraError("no camera is left to be calibrated")
    return detections, left_out


def _check_board(seen: BoardDetections, detections: Mapping[str, Mapping[str, Detection]]) -> None:
    for camera in seen.mirrored:
        if camera in detections:
            raise CameraError(
                f"camera '{camera}': its pictures are mirrored: the board is found in them only "
                "when left and right are exchanged; switch mirroring off"
            )
    if len(detections) > 1 and seen.board.looks_the_same_turned:
        raise CameraError(
            f"a checkerboard of {seen.board.columns} x {seen.board.rows} squares looks the same "
            "when it is turned by 180 degrees, so several cameras cannot agree on its corners: "
            "take one of an odd number of squares one way and an even number the other, or ChArUco"
        )


def _lens_without_spoilt(
    name: str,
    points: Array,
    detections: dict[str, dict[str, Detection]],
    seen: BoardDetections,
    settings: CalibrationSettings,
) -> tuple[LensEstimate, dict[Picture, str]]:
    """A camera's lens; spoilt pictures are taken out of `detections` or refused."""
    spoilt: dict[Picture, str] = {}
    while True:
        estimate = estimate_lens(name, points, detections[name], seen.sizes[name], settings.lens)
        worst = max(estimate.errors, key=lambda frame: estimate.errors[frame])
        # One spoilt picture also harms the others' errors: the worst goes first, then look again.
        if estimate.errors[worst] <= _limit(list(estimate.errors.values()), settings):
            break
        reason = f"its corners are {estimate.errors[worst]:.2f} pixel off the camera's own lens"
        spoilt[name, worst] = reason
        del detections[name][worst]
    _refuse(spoilt, settings)
    if not estimate.focal_deviation < _LARGEST_FOCAL_DEVIATION:
        raise CameraError(
            f"camera '{name}': its pictures are too much alike to tell the focal length (known to "
            f"{100.0 * estimate.focal_deviation:.0f} % only): tilt the board, fill the picture"
        )
    return estimate, spoilt


_LARGEST_FOCAL_DEVIATION = 0.05


def _adjusted_rig(
    points: Array,
    detections: dict[str, dict[str, Detection]],
    lenses: Mapping[str, LensEstimate],
    settings: CalibrationSettings,
) -> tuple[Rig, dict[Picture, str]]:
    """Everything at once; spoilt pictures are taken out of `detections` or refused."""
    X_RC = chain_cameras(points, detections, lenses)
    start = Rig(
        {name: estimate.lens for name, estimate in lenses.items()},
        X_RC,
        board_poses(points, detections, lenses, X_RC),
    )
    original = {name: dict(frames) for name, frames in detections.items()}
    spoilt: dict[Picture, str] = {}
    while len(detections) > 1:
        start = adjust_rig(points, detections, start, settings.lens, robust=True)
        worst = _disagreeing(start.errors(points, detections), detections, settings)
        if not worst:
            break
        spoilt |= worst
        _require_true_cameras(points, spoilt, original, lenses)
        for camera, frame in worst:
            del detections[camera][frame]
        frames = {frame for frames in detections.values() for frame in frames}
        start = Rig(start.lenses, start.X_RC, {f: X for f, X in start.X_RB.items() if f in frames})
    _refuse(spoilt, settings)
    require_shared_pictures(detections)
    return adjust_rig(points, detections, start, settings.lens, robust=False), spoilt


def _disagreeing(
    errors: Mapping[Picture, float],
    detections: Mapping[str, Mapping[str, Detection]],
    settings: CalibrationSettings,
) -> dict[Picture, str]:
    """At each instant the picture that contradicts the other cameras' most, if one does.

    One at a time: it has drawn the board away from where the others saw it. Of two cameras that
    disagree both pictures are in doubt.
    """
    limit = _limit(list(errors.values()), settings)
    spoilt: dict[Picture, str] = {}
    for frame in {frame for _, frame in errors}:
        seers = [name for name in detections if frame in detections[name]]
        worst = max(seers, key=lambda name: errors[name, frame])
        if errors[worst, frame] <= limit:
            continue
        if len(seers) == 2:
            reason = (
                f"cameras '{seers[0]}' and '{seers[1]}' disagree about the board at this instant, "
                "and no third camera tells which is right"
            )
            spoilt |= {(name, frame): reason for name in seers}
        else:
            spoilt[worst, frame] = (
                f"{errors[worst, frame]:.2f} pixel off what the other cameras saw: were the "
                "pictures taken at the same instant?"
            )
    return dict(sorted(spoilt.items()))


def _require_true_cameras(
    points: Array,
    spoilt: Mapping[Picture, str],
    detections: Mapping[str, Mapping[str, Detection]],
    lenses: Mapping[str, LensEstimate],
) -> None:
    """Refuses a camera most of whose shared pictures contradict the others, and says why."""
    for name, frames in detections.items():
        shared = [
            frame
            for frame in frames
            if any(frame in others for camera, others in detections.items() if camera != name)
        ]
        bad = sum((name, frame) in spoilt for frame in shared)
        if 2 * bad <= len(shared) or _blamed_more(name, bad, spoilt):
            continue
        # Of two cameras nobody can say which is wrong.
        who = " or ".join(f"camera '{n}'" for n in (detections if len(detections) == 2 else [name]))
        if find_mirrored(points, detections, lenses, name):
            raise CameraError(
                f"{who}: its pictures are mirrored: they agree with the other cameras only when "
                "left and right are exchanged; switch mirroring off"
            )
        raise CameraError(
            f"{who} contradicts the others in {bad} of {len(shared)} pictures: was it "
            "moved meanwhile, or are its pictures of other instants? Leave it out "
            "or take its pictures again"
        )


def _blamed_more(name: str, bad: int, spoilt: Mapping[Picture, str]) -> bool:
    """Whether another camera has more spoilt pictures than this one."""
    counts: dict[str, int] = {}
    for camera, _ in spoilt:
        counts[camera] = counts.get(camera, 0) + 1
    return any(count > bad for camera, count in counts.items() if camera != name)


def _limit(errors: list[float], settings: CalibrationSettings) -> float:
    """Above which error a picture is spoilt [pixel]."""
    return max(settings.spoilt_pixels, settings.spoilt_factor * float(np.median(errors)))


def _refuse(spoilt: Mapping[Picture, str], settings: CalibrationSettings) -> None:
    if not spoilt or settings.drop_spoilt:
        return
    listing = "; ".join(f"camera '{c}', picture '{f}': {why}" for (c, f), why in spoilt.items())
    names = ", ".join(f"{camera}/{frame}" for camera, frame in spoilt)
    instants = {frame for _, frame in spoilt}
    always = [c for c in {c for c, _ in spoilt} if all((c, frame) in spoilt for frame in instants)]
    moved = ""
    if len(instants) > 1 and len(always) == 1:
        moved = f" Camera '{always[0]}' takes part in all of these: was it moved?"
    raise CameraError(
        f"{listing}. This spoils the calibration: leave out {names}, or drop spoilt pictures."
        f"{moved}"
    )


def _camera_errors(
    errors: Mapping[Picture, float], detections: Mapping[str, Mapping[str, Detection]]
) -> dict[str, float]:
    """Root mean square distance over all corners of each camera [pixel]."""
    found = {}
    for name, frames in detections.items():
        counts = np.array([len(detection.corners) for detection in frames.values()])
        squares = np.array([errors[name, frame] ** 2 for frame in frames])
        found[name] = float(np.sqrt(np.sum(counts * squares) / np.sum(counts)))
    return found


def _world(rig: Rig, world: str) -> tuple[Array, str]:
    """The rig's pose (4, 4) in the world, and what the world is."""
    world = world or f"camera:{next(iter(rig.X_RC))}"
    kind, _, name = world.partition(":")
    poses = rig.X_RB if kind == "board" else rig.X_RC
    if name not in poses:
        what = "picture of the board" if kind == "board" else "camera"
        raise UnknownNameError(what, name, poses, "the calibration")
    return inverse_pose(poses[name]), world
