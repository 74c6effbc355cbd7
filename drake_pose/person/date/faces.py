"""Where the face looks: eigenspace templates (Date et al., 3.2; Murase and Nayar 1995).

The nearest of 300 templates, in the space of their 60 leading eigenvectors, is the answer.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import SUFFIXES, read_picture
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError, SettingsError
from drake_pose.person.date.features import Blobs, SkinColour, skin_blobs
from drake_pose.silhouette.segmentation.background import (
    Background,
    learn_background,
    person_region,
)

FACE_WIDTH, FACE_HEIGHT = 80, 130
"""What a face is scaled to [pixel]."""

DIMENSIONS = 60
"""How many eigenvectors span the space of faces."""

DIRECTIONS = "directions.csv"
"""The file of a folder of recorded faces that says where each picture's face looks."""
_COLUMNS, _EMPTY = ["picture", "turn", "nod"], "empty"


@dataclass(frozen=True, eq=False)
class FaceTemplates:
    """Faces of known directions in their eigenspace.

    Args:
        mean: (d,) the mean face, d = 80 x 130 x 3.
        basis: (k, d) the leading eigenvectors, orthonormal.
        coordinates: (n, k) the templates in the eigenspace.
        directions: (n, 2) turn to the person's left and nod down from facing the camera [rad].
    """

    mean: NDArray[np.float32]
    basis: NDArray[np.float32]
    coordinates: NDArray[np.float32]
    directions: Array


@dataclass(frozen=True, eq=False)
class FaceDirection:
    """The direction (2,) of a face, as of FaceTemplates [rad].

    Args:
        template: which template is nearest.
        outside: how far the picture is from the eigenspace [grey levels]; large: it is no face.
    """

    direction: Array
    template: int
    outside: float


def cut_face(picture: Picture, blobs: Blobs) -> Picture | None:
    """The largest skin blob of a picture (H, W, 3), scaled to (130, 80, 3); None: none is whole."""
    if not len(blobs.areas):
        return None
    left, top, width, height = (int(side) for side in blobs.boxes[0])
    full_height, full_width = picture.shape[:2]
    if left == 0 or top == 0 or left + width == full_width or top + height == full_height:
        return None
    cut = picture[top : top + height, left : left + width].copy()
    # What is behind the head must not matter.
    cut[~blobs.mask[top : top + height, left : left + width]] = 0
    # Averaged where the picture is larger: so the noise does not depend on the distance.
    how = cv2.INTER_AREA if height >= FACE_HEIGHT else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, (FACE_WIDTH, FACE_HEIGHT), interpolation=how))


def learn_faces(
    faces: Sequence[Picture], directions: Array, dimensions: int = DIMENSIONS
) -> FaceTemplates:
    """The eigenspace of faces (130, 80, 3) of known directions (n, 2) [rad], see FaceTemplates.

    Raises SettingsError for fewer than three faces, or not one direction for each.
    """
    known = np.asarray(directions, dtype=np.float64).reshape(-1, 2)
    if len(faces) < 3 or len(known) != len(faces):
        raise SettingsError(
            f"an eigenspace needs three faces or more, and a direction of each, not {len(faces)} "
            f"faces and {len(known)} directions"
        )
    data = np.stack([face.reshape(-1) for face in faces]).astype(np.float32)
    mean = data.mean(axis=0)
    data -= mean
    # The eigenvectors of d x d pixels from those of n x n faces (Murakami and Kumar's trick).
    values, vectors = np.linalg.eigh((data @ data.T).astype(np.float64))
    order = np.argsort(-values)[: min(dimensions, len(faces) - 1)]
    order = order[values[order] > 1e-6 * values.max()]
    basis = (vectors[:, order] / np.sqrt(values[order])).T.astype(np.float32) @ data
    return FaceTemplates(mean, basis, data @ basis.T, known)


def head_angles(direction: Array, head: Array, camera: Camera) -> Array:
    """The head's turn and nod in the world (2,) [rad] of a face's direction (2,) seen by a camera.

    Turn is 0 where the face of a head at (3,) [m] looks along the world's x; nod is downwards.
    """
    towards = camera.X_WC[:3, 3] - head
    level = math.hypot(towards[0], towards[1])
    azimuth, elevation = math.atan2(towards[1], towards[0]), math.atan2(towards[2], level)
    turn, nod = direction
    # The face's direction where the camera stands straight ahead, then tilted up to the camera.
    ahead = np.array([math.cos(nod) * math.cos(turn), math.cos(nod) * math.sin(turn)])
    up = -math.sin(nod)
    c, s = math.cos(elevation), math.sin(elevation)
    x, y, z = c * ahead[0] - s * up, ahead[1], s * ahead[0] + c * up
    heading = math.remainder(azimuth + math.atan2(y, x), 2.0 * math.pi)
    return np.array([heading, -math.asin(min(1.0, max(-1.0, z)))])


def face_direction(face: Picture, templates: FaceTemplates) -> FaceDirection:
    """The direction of a face (130, 80, 3) by the nearest template."""
    off = face.reshape(-1).astype(np.float32) - templates.mean
    place = templates.basis @ off
    nearest = int(np.argmin(np.linalg.norm(templates.coordinates - place, axis=1)))
    left = max(0.0, float(off @ off) - float(place @ place))
    return FaceDirection(templates.directions[nearest].copy(), nearest, math.sqrt(left / len(off)))


def find_face(picture: Picture, blobs: Blobs, templates: FaceTemplates, farthest: float) -> Array:
    """The direction (2,) of the face in a picture (H, W, 3) [rad]; nan where no face is seen.

    No face is farther from the eigenspace than `farthest` [grey levels].
    """
    face = cut_face(picture, blobs)
    if face is not None:
        found = face_direction(face, templates)
        if found.outside <= farthest:
            return found.direction
    return np.full(2, np.nan)


def learn_recorded_faces(folder: Path, skin: SkinColour | None = None) -> FaceTemplates:
    """The eigenspace of faces that a camera recorded.

    The folder holds `directions.csv`, whose first line is `picture,turn,nod`: a picture's file
    beside it (.png or .jpg), and where the face looks in it, away from facing the camera [deg]:
    the turn to the person's left and the nod downwards. Of each whole picture the largest
    skin-coloured patch is the face. A folder `empty` of pictures without the person is needed where
    other things have skin's colour.

    Raises:
        SceneError: names the file, line or picture at fault.
        SettingsError: fewer than three pictures.
    """
    table = _read_directions(folder / DIRECTIONS)
    background = _read_background(folder / _EMPTY)
    faces = [_read_face(folder / name, background, skin or SkinColour()) for name, _, _ in table]
    directions = np.radians([[turn, nod] for _, turn, nod in table]).reshape(-1, 2)
    return learn_faces(faces, directions)


def _read_directions(path: Path) -> list[tuple[str, float, float]]:
    """Picture, turn and nod [deg] of each line."""
    header, rows = read_csv(path, SceneError)
    if header != _COLUMNS:
        raise SceneError(f"{path}: the first line must be {','.join(_COLUMNS)}")
    table: dict[str, tuple[str, float, float]] = {}
    for number, (name, *cells) in rows:
        where = f"{path}, line {number}"
        try:
            turn, nod = (float(cell) for cell in cells)
        except ValueError as error:
            raise SceneError(f"{where}: expected a picture and two angles [deg]: {error}") from None
        if Path(name).name != name or Path(name).suffix.lower() not in SUFFIXES:
            known = " or ".join(SUFFIXES)
            raise SceneError(f"{where}: '{name}' is no picture {known} in the folder")
        if not (abs(turn) <= 180.0 and abs(nod) <= 180.0):
            raise SceneError(
                f"{where}: turn and nod must be -180 to 180 degrees, not {turn} and {nod}"
            )
        if name in table:
            raise SceneError(f"{where}: '{name}' has a line already")
        table[name] = name, turn, nod
    return list(table.values())


def _read_background(folder: Path) -> Background | None:
    """What is behind the face; None: nothing that matters."""
    if not folder.is_dir():
        return None
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not files:
        raise SceneError(f"{folder}: holds no picture; remove the folder, or fill it")
    pictures = [read_picture(file, SceneError) for file in files]
    for file, picture in zip(files, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise SceneError(f"{file}: is not as large as {files[0].name}")
    return learn_background(pictures)


def _read_face(path: Path, background: Background | None, skin: SkinColour) -> Picture:
    """The face (130, 80, 3) in a picture."""
    picture = read_picture(path, SceneError)
    region = np.ones(picture.shape[:2], dtype=np.bool_)
    if background is not None:
        if background.mean.shape != picture.shape:
            raise SceneError(f"{path}: is not as large as the pictures in '{_EMPTY}'")
        region = person_region(picture, background)
    face = cut_face(picture, skin_blobs(picture, region, skin))
    if face is None:
        raise SceneError(
            f"{path}: no face: nothing in it has the colour of skin, or the largest patch touches "
            f"the picture's edge; take the picture out of {DIRECTIONS}, or name another skin colour"
        )
    return face
