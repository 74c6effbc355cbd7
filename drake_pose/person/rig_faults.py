"""Detection of faults that concern all cameras: mirrored or exchanged pictures, a wrong scale.

The visual hull of a consistent rig fills all silhouettes (silhouette coherence, Hernandez, Schmitt
and Cipolla 2007). A rig is at fault if mirroring or exchanging pictures makes the hull fill them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np

from drake_pose.arrays import Array, Indices, Mask
from drake_pose.camera.models import Camera
from drake_pose.errors import CameraError, MaskError, SettingsError
from drake_pose.person.figures import PersonRecording, find_figures, pixels_per_metre
from drake_pose.person.views import triangulate


def require_person(recording: PersonRecording, count: int) -> PersonRecording:
    """Return a recording of `count` frames if it shows a person; raise otherwise.

    A visible part of a person is 0.1 to 3 m tall, and fills the whole picture in at most half of
    the masks.

    Raises:
        SettingsError: two cameras see a person in no frame.
        MaskError: the masks show the background.
        CameraError: the person is smaller or taller than people are.
    """
    if not recording.seen:
        raise SettingsError(
            f"two cameras see no person in any of {count} frames: give masks that show one"
        )
    if recording.covering > 0.5:
        raise MaskError(
            f"in {100.0 * recording.covering:.0f} % of the masks the largest figure reaches all "
            "four sides of the picture: the person must be white before a black background"
        )
    if not 0.1 < recording.height < 3.0:
        raise CameraError(
            f"a person {recording.height:.3g} m tall by the cameras' calibration: X_WC must be in "
            "metres and the camera's pose in the world, not its inverse; focal lengths in pixels"
        )
    return recording


@dataclass(frozen=True)
class RigFault:
    """A disagreement of all silhouettes with the calibration.

    In a ring of four cameras, exchanging opposite ones is the same as mirroring all; the latter is
    reported.
    """

    mirrored: tuple[str, ...]  # Cameras whose pictures are mirrored, left for right.
    exchanged: tuple[str, ...]  # Two cameras whose pictures are exchanged.
    # Fraction of the silhouettes that a visual hull fills, by camera, before the change.
    filled: Mapping[str, float]

    @property
    def is_identified(self) -> bool:
        """Whether the fault was identified, so that `undo` mends it."""
        return bool(self.mirrored or self.exchanged)

    def undo(self, masks: Mapping[str, Mask]) -> dict[str, Mask]:
        """Return a frame's masks (H, W) by camera, mirrored and exchanged back."""
        partner = dict(zip(self.exchanged, reversed(self.exchanged), strict=True))
        found = {}
        for name, mask in masks.items():
            turned = np.ascontiguousarray(mask[:, ::-1]) if name in self.mirrored else mask
            found[partner.get(name, name)] = turned
        return found


def find_rig_fault(
    cameras: Mapping[str, Camera],
    frames: Sequence[Mapping[str, Mask]],
    *,
    sound_below: float = 0.01,
    remaining_below: float = 0.03,
    remaining_fraction: float = 0.35,
    faulty_above: float = 0.3,
) -> RigFault | None:
    """Find what is wrong with a rig as a whole, from one person's masks in some frames.

    The visual hull of a sound rig fills all silhouettes. If it does not, pictures are mirrored (all
    or one) or exchanged (two of equal size), and the change that leaves least unfilled is taken.

    Args:
        cameras: by name.
        frames: masks (H, W) of each frame by camera; frames with fewer than two are ignored.
        sound_below: the rig is sound if less than this fraction of the silhouettes is unfilled.
        remaining_below, remaining_fraction: a change is accepted if less than `remaining_below` of
            the silhouettes and less than `remaining_fraction` of the unfilled part stay unfilled.
        faulty_above: above this unfilled fraction a rig is at fault, even if no change helps.

    Returns the fault, without `mirrored` and `exchanged` if no change explains it; None if the rig
    is sound, or no change explains an unfilled fraction of at most `faulty_above`.
    """
    frames = [masks for masks in frames if len(masks) >= 2]
    if not frames:
        return None
    first: dict[tuple[str, tuple[int, ...]], Indices] = {}
    filled = _filled_fractions(cameras, frames, RigFault((), (), {}), first)
    unfilled = 1.0 - float(np.mean(list(filled.values())))
    if unfilled < sound_below:
        return None
    best, least = RigFault((), (), filled), unfilled
    sizes = {name: (cameras[name].width, cameras[name].height) for name in filled}
    pairs = [pair for pair in combinations(filled, 2) if sizes[pair[0]] == sizes[pair[1]]]
    mirrored = [tuple(filled), *((name,) for name in filled)]
    for guess in (
        *(RigFault(names, (), filled) for names in mirrored),
        *(RigFault((), pair, filled) for pair in pairs),
    ):
        filled_so = _filled_fractions(cameras, frames, guess, first)
        remains = 1.0 - float(np.mean(list(filled_so.values())))
        if remains < least:
            best, least = guess, remains
    if least < min(remaining_below, remaining_fraction * unfilled):
        return best
    return RigFault((), (), filled) if unfilled > faulty_above else None


def _filled_fractions(
    cameras: Mapping[str, Camera],
    frames: Sequence[Mapping[str, Mask]],
    guess: RigFault,
    first: dict[tuple[str, tuple[int, ...]], Indices],
    *,
    spacing: float = 0.04,
    side: float = 1.1,
    height: float = 1.3,
    lattice: float = 0.25,
) -> dict[str, float]:
    """Return the mean fraction of the silhouettes that a visual hull fills, by camera.

    Args:
        cameras, frames: as of `find_rig_fault`.
        guess: change that is undone first.
        first: cache of `_cell_indices` of each frame's first camera, by name and the grid's place
            in the lattice; added to.
        spacing: of the hull's grid of points [m].
        side, height: half the grid's horizontal and vertical extent [m].
        lattice: spacing of the places where grids are put, so that frames can share them [m].
    """
    shares: dict[str, list[float]] = {}
    for frame in frames:
        masks = {name: mask for name, mask in guess.undo(frame).items() if mask.any()}
        used = [cameras[name] for name in masks]
        middles = [find_figures(mask)[0].middle for mask in masks.values()]
        cell = tuple(int(k) for k in np.rint(triangulate(used, middles) / lattice))
        ends = (np.arange(-end, end, spacing) for end in (side, side, height))
        grid = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)
        points = grid + lattice * np.array(cell, dtype=np.float64)
        # Masks are reduced to cells as large as the grid's spacing at the person.
        middle = points.mean(axis=0)
        sizes = [max(1.0, spacing * pixels_per_metre(camera, middle)) for camera in used]
        touched: list[Mask] = []
        for mask, size in zip(masks.values(), sizes, strict=True):
            h, w = (int(np.ceil(side / size)) for side in mask.shape)
            padded = np.zeros((int(np.ceil(h * size)), int(np.ceil(w * size))), np.float32)
            padded[: mask.shape[0], : mask.shape[1]] = mask
            touched.append(cv2.resize(padded, (w, h), interpolation=cv2.INTER_AREA) > 0.25)
        # A grid point stays if it is seen in or beside a touched cell, or outside the picture. Each
        # camera examines only the points that the cameras before it left.
        cells: list[Indices] = []
        for camera, size, own in zip(used, sizes, touched, strict=True):
            key = camera.name, cell
            known = None if cells else first.get(key)
            seen = _cell_indices(camera, points, size, own.shape) if known is None else known
            if not cells:
                first[key] = seen
            inside = (seen < 0) | _dilated(own).ravel()[seen]
            points, cells = points[inside], [one[inside] for one in (*cells, seen)]
        for name, chosen, own in zip(masks, cells, touched, strict=True):
            hull = np.zeros(own.size, dtype=np.bool_)
            hull[chosen[chosen >= 0]] = True
            fills = _dilated(hull.reshape(own.shape)) & own
            shares.setdefault(name, []).append(fills.sum() / own.sum() if own.any() else 1.0)
    return {name: float(np.mean(own)) for name, own in shares.items()}


def _cell_indices(camera: Camera, points: Array, size: float, shape: tuple[int, ...]) -> Indices:
    """Return the index (n,) of the picture's cell that shows each point (n, 3); -1: outside.

    ``size``: side of a cell [pixel]. ``shape``: rows and columns of cells, counted by rows.
    """
    uv, depth = camera.project(points)
    with np.errstate(invalid="ignore"):
        column, row = np.floor((uv.T + 0.5) / size)
        seen = (depth > 0.0) & (column >= 0) & (column < shape[1])
        seen &= (row >= 0) & (row < shape[0])
    return np.where(seen, row * shape[1] + column, -1.0).astype(np.int64)


def _dilated(cells: Mask) -> Mask:
    """Return cells (rows, columns) grown by one to all eight sides."""
    return np.asarray(cv2.dilate(cells.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)
