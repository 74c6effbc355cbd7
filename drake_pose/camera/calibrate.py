"""Calibration of one camera or several from pictures of a board, and what spoils it."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.board import BoardDetections, Detection, Picture
from drake_pose.camera.models import PinholeCamera, inverse_pose
from drake_pose.camera.rig import (
    FREE_COEFFICIENTS,
    Lens,
    Rig,
    adjust_rig,
    chain_rig,
    own_rig,
    pair_pose,
    require_shared_pictures,
)
from drake_pose.errors import CameraError, UnknownNameError

# A picture is spoilt whose error is above this many pixels, and times its camera's median.
_SPOILT_PIXELS, _SPOILT_MEDIANS = 0.5, 4.0
_LARGEST_FOCAL_DEVIATION = 0.05
# Mirrored pictures agree with the other cameras this much better once they are turned.
_BETTER = 0.25


@dataclass(frozen=True)
class CalibrationSettings:
    """How to calibrate; CameraError when a setting is out of its range.

    Args:
        world: "board:FRAME", the board's frame at that instant (on the floor: z is up);
            "camera:NAME", that camera's frame; "" for the first camera's.
        lens: "none" (no distortion), "standard" (k1, k2, p1, p2) or "full" (k3 too).
        drop_spoilt: go on without the pictures that spoil the calibration instead of refusing.
        leave_out: cameras ("left"), or pictures ("left/0007"), not to be used.
        largest_error: a calibration whose camera has a larger error is refused [pixel].
    """

    world: str = ""
    lens: str = "standard"
    drop_spoilt: bool = False
    leave_out: Collection[str] = field(default=())
    largest_error: float = 2.0

    def __post_init__(self) -> None:
        if self.lens not in FREE_COEFFICIENTS:
            raise CameraError(
                f"lens must be one of {', '.join(FREE_COEFFICIENTS)}, not '{self.lens}'"
            )
        kind, _, name = self.world.partition(":")
        if self.world and (kind not in ("board", "camera") or not name):
            raise CameraError(f"world must be board:FRAME or camera:NAME, not '{self.world}'")
        if not 0.0 < self.largest_error < np.inf:
            raise CameraError(f"largest_error must be positive, not {self.largest_error}")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Calibrated cameras.

    Args:
        cameras: free of distortion, in the shared world; of pictures that `lenses` undistorted.
        X_WB: (4, 4) by frame: where the board was [m].
        errors: by (camera, frame): root mean square distance of the corners [pixel].
        camera_errors: the same over all of a camera's corners.
        left_out: pictures left out, with the reason.
        world: board:FRAME or camera:NAME.
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

    Raises:
        CameraError: names the camera, and the picture that spoils the calibration: too few
            pictures, a camera that shares none with the others, a spoilt picture, a mirrored or
            moved camera, pictures too much alike.
        UnknownNameError: when the settings name a camera or frame that is not there.
    """
    settings = settings or CalibrationSettings()
    seen, left_out = _chosen(seen, settings)
    _check_board(seen)
    own = {}
    for name in seen.detections:
        own[name], seen, spoilt = _own_rig(name, seen, settings)
        left_out |= spoilt
    rig, seen, spoilt = _agreed_rig(seen, own, settings)
    left_out |= spoilt
    errors = rig.errors(seen)
    camera_errors = {}
    for name, frames in seen.detections.items():
        counts = [len(detection.corners) for detection in frames.values()]
        squares = [errors[name, frame] ** 2 for frame in frames]
        camera_errors[name] = float(np.sqrt(np.average(squares, weights=counts)))
    worst = max(camera_errors, key=lambda name: camera_errors[name])
    if camera_errors[worst] > settings.largest_error:
        raise CameraError(
            f"camera '{worst}': its corners are {camera_errors[worst]:.2f} pixel off, more than "
            f"{settings.largest_error:g}: is the board flat, still, and as its file says? Has the "
            "camera or its lens (focus, zoom) moved? Leave it out, or allow a larger error"
        )
    world = settings.world or f"camera:{next(iter(rig.X_RC))}"
    kind, _, name = world.partition(":")
    poses = rig.X_RB if kind == "board" else rig.X_RC
    if name not in poses:
        what = "picture of the board" if kind == "board" else "camera"
        raise UnknownNameError(what, name, poses, "the calibration")
    X_WR = inverse_pose(poses[name])
    cameras = {n: rig.lenses[n].camera(n, X_WR @ X_RC) for n, X_RC in rig.X_RC.items()}
    X_WB = {frame: X_WR @ X for frame, X in rig.X_RB.items()}
    return Calibration(cameras, rig.lenses, X_WB, errors, camera_errors, left_out, world)


def _chosen(
    seen: BoardDetections, settings: CalibrationSettings
) -> tuple[BoardDetections, dict[Picture, str]]:
    """What is seen in the pictures to use, and what was left out on request."""
    unwanted = set(settings.leave_out)
    pictures = [(camera, frame) for camera, frames in seen.detections.items() for frame in frames]
    known = {*seen.detections, *("/".join(picture) for picture in (*pictures, *seen.not_found))}
    for name in sorted(unwanted - known):
        raise UnknownNameError("camera or picture", name, sorted(known), "the calibration")
    left_out = {
        (camera, frame): "the camera was left out" if camera in unwanted else "left out on request"
        for camera, frame in pictures
        if {camera, f"{camera}/{frame}"} & unwanted
    }
    kept = {name: dict(seen.detections[name]) for name in seen.detections if name not in unwanted}
    if not kept:
        raise CameraError("no camera is left to be calibrated")
    chosen = replace(seen, detections=kept)
    return _without(chosen, [(name, frame) for name, frame in left_out if name in kept]), left_out


def _without(seen: BoardDetections, pictures: Collection[Picture]) -> BoardDetections:
    """The same without some pictures."""
    kept = {
        camera: {frame: one for frame, one in frames.items() if (camera, frame) not in pictures}
        for camera, frames in seen.detections.items()
    }
    return replace(seen, detections=kept)


def _check_board(seen: BoardDetections) -> None:
    for camera in seen.mirrored:
        if camera in seen.detections:
            raise CameraError(
                f"camera '{camera}': its pictures are mirrored: the board is found in them only "
                "when left and right are exchanged; switch mirroring off"
            )
    if len(seen.detections) > 1 and seen.board.looks_the_same_turned:
        raise CameraError(
            f"a checkerboard of {seen.board.columns} x {seen.board.rows} squares looks the same "
            "when it is turned by 180 degrees, so several cameras cannot agree on its corners: "
            "take one of an odd number of squares one way and an even number the other, or ChArUco"
        )


def _own_rig(
    name: str, seen: BoardDetections, settings: CalibrationSettings
) -> tuple[Rig, BoardDetections, dict[Picture, str]]:
    """A camera's lens by itself, what is seen without its spoilt pictures, and these."""
    spoilt: dict[Picture, str] = {}
    while True:
        own, focal_deviation = own_rig(name, seen, settings.lens)
        errors = {frame: own.error(seen, name, frame, X_CB) for frame, X_CB in own.X_RB.items()}
        worst = max(errors, key=lambda frame: errors[frame])
        # One spoilt picture also harms the others' errors: the worst goes first, then look again.
        if errors[worst] <= _limit(errors.values()):
            break
        reason = f"its corners are {errors[worst]:.2f} pixel off the camera's own lens"
        spoilt[name, worst] = reason
        seen = _without(seen, [(name, worst)])
    _refuse(spoilt, settings)
    if not focal_deviation < _LARGEST_FOCAL_DEVIATION:
        raise CameraError(
            f"camera '{name}': its pictures are too much alike to tell the focal length (known to "
            f"{100.0 * focal_deviation:.0f} % only): tilt the board, fill the picture"
        )
    return own, seen, spoilt


def _agreed_rig(
    seen: BoardDetections, own: Mapping[str, Rig], settings: CalibrationSettings
) -> tuple[Rig, BoardDetections, dict[Picture, str]]:
    """Everything at once, what is seen without the pictures that contradict others, and these."""
    rig, every = chain_rig(seen, own), seen
    spoilt: dict[Picture, str] = {}
    while len(own) > 1:
        rig = adjust_rig(seen, rig, settings.lens, robust=True)
        worst = _disagreeing(rig.errors(seen))
        if not worst:
            break
        spoilt |= worst
        _require_true_cameras(every, spoilt, own)
        seen = _without(seen, worst)
        left = {frame for frames in seen.detections.values() for frame in frames}
        rig = replace(rig, X_RB={frame: X for frame, X in rig.X_RB.items() if frame in left})
    _refuse(spoilt, settings)
    require_shared_pictures(seen.detections)
    return adjust_rig(seen, rig, settings.lens, robust=False), seen, spoilt


def _disagreeing(errors: Mapping[Picture, float]) -> dict[Picture, str]:
    """At each instant the picture (of two cameras: both) that contradicts the others most."""
    limit = _limit(errors.values())
    spoilt: dict[Picture, str] = {}
    for frame in {frame for _, frame in errors}:
        seers = [camera for camera, one in errors if one == frame]
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
    seen: BoardDetections, spoilt: Collection[Picture], own: Mapping[str, Rig]
) -> None:
    """Refuses a camera most of whose shared pictures contradict the others, and says why."""
    counts = Counter(camera for camera, _ in spoilt)
    for name in own:
        others = {frame for other in own if other != name for frame in own[other].X_RB}
        shared = [frame for frame in own[name].X_RB if frame in others]
        bad = sum((name, frame) in spoilt for frame in shared)
        blamed_more = any(count > bad for other, count in counts.items() if other != name)
        if 2 * bad <= len(shared) or blamed_more:
            continue
        # Of two cameras nobody can say which is wrong.
        who = " or ".join(f"camera '{n}'" for n in (own if len(own) == 2 else [name]))
        if _is_mirrored(seen, own, name):
            raise CameraError(
                f"{who}: its pictures are mirrored: they agree with the other cameras only when "
                "left and right are exchanged; switch mirroring off"
            )
        raise CameraError(
            f"{who} contradicts the others in {bad} of {len(shared)} pictures: was it "
            "moved meanwhile, or are its pictures of other instants? Leave it out "
            "or take its pictures again"
        )


def _is_mirrored(seen: BoardDetections, own: Mapping[str, Rig], name: str) -> bool:
    """Whether a camera agrees with the others once its pictures are turned left to right."""
    # The colours of a board of an even number of columns fit only where rows are exchanged, with
    # an odd number columns; squares are one more than corners.
    numbers = np.arange(len(seen.board.points)).reshape(seen.board.rows - 1, -1)
    numbers = numbers[::-1] if len(numbers) % 2 == 0 else numbers[:, ::-1]
    turned = {}
    for frame, one in seen.detections[name].items():
        corners = numbers.ravel()[one.corners]
        order = np.argsort(corners)
        uv = [seen.sizes[name][0] - 1.0, 0.0] + one.uv * [-1.0, 1.0]
        turned[frame] = Detection(corners[order], uv[order])
    try:
        other_way, _ = own_rig(name, replace(seen, detections={name: turned}))
    except CameraError:
        return False
    others = [own[n] for n in own if n != name and set(own[n].X_RB) & set(own[name].X_RB)]
    as_seen = np.median([pair_pose(seen, other, own[name])[1] for other in others])
    as_turned = np.median([pair_pose(seen, other, other_way)[1] for other in others])
    return bool(as_turned < _BETTER * as_seen)


def _limit(errors: Iterable[float]) -> float:
    """Above which error a picture is spoilt [pixel]."""
    return max(_SPOILT_PIXELS, _SPOILT_MEDIANS * float(np.median([*errors])))


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
