"""What the paper's stages see of a person in a moment's pictures (Date et al., 3 and 5).

Skin-coloured blobs give head, hands and feet in space (3.1), eigenspace templates the direction of
the face (3.2; Murase and Nayar 1995), contours the registered pose, which mends a lost track (5).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Indices, Mask, Picture
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import SUFFIXES, read_picture
from drake_pose.csv_files import read_csv
from drake_pose.errors import SceneError, SettingsError
from drake_pose.person.date.skeleton import Skeleton, registered_positions
from drake_pose.person.views import meeting_points, triangulate
from drake_pose.silhouette.segmentation import learn_background, person_region

FACE_SIZE = (80, 130)
"""Width and height that a face is scaled to [pixel]."""

DIRECTIONS = 72
"""In how many directions a contour is measured."""

Contour = tuple[Array, Array]
"""The outer contour of a person seen whole, of one picture.

(DIRECTIONS,) distance of the farthest contour point in each direction from the region's middle,
counterclockwise from the right, over the square root of the area; and (2,) the middle of the
bounding box [pixel].
"""


@dataclass(frozen=True)
class SkinColour:
    """Which colours are skin: a box in the chroma plane, so that shade matters little.

    The defaults are those of Chai and Ngan (1999), found on faces of many origins.

    Args:
        red, blue: lowest and highest chroma Cr and Cb (0 to 255, 128 is grey).
        darkest: lowest brightness Y: chroma means nothing in the dark.
    """

    red: tuple[float, float] = (133.0, 173.0)
    blue: tuple[float, float] = (77.0, 127.0)
    darkest: float = 30.0


@dataclass(frozen=True, eq=False)
class Blobs:
    """Patches of skin in one picture, the largest first.

    Centroids (n, 2), areas (n,), boxes (n, 4) of left, top, width, height [pixel]; mask (H, W).
    """

    centroids: Array
    areas: Indices
    boxes: Indices
    mask: Mask


def skin_blobs(
    picture: Picture, region: Mask, colour: SkinColour, smallest: int = 12, most: int = 12
) -> Blobs:
    """The largest `most` skin blobs of a picture (H, W, 3) in the person's region (H, W).

    None has an area of less than `smallest` pixels.
    """
    # Of an empty region one pixel is looked at.
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(region).view(np.uint8))
    part = slice(top, top + max(height, 1)), slice(left, left + max(width, 1))
    chroma = cv2.cvtColor(np.ascontiguousarray(picture[part]), cv2.COLOR_RGB2YCrCb)
    low = (colour.darkest, colour.red[0], colour.blue[0])
    inner = (cv2.inRange(chroma, low, (255.0, colour.red[1], colour.blue[1])) > 0) & region[part]
    joined = cv2.morphologyEx(inner.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, statistics, middles = cv2.connectedComponentsWithStats(joined, connectivity=8)
    order = np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")[:most] + 1
    order = order[statistics[order, cv2.CC_STAT_AREA] >= smallest] if count > 1 else order[:0]
    mask = np.zeros(region.shape, dtype=bool)
    kept = np.zeros(count, dtype=bool)
    kept[order] = True
    mask[part] = kept[labels]
    boxes = statistics[order, :4].astype(np.int64)
    boxes[:, :2] += [left, top]
    return Blobs(
        centroids=middles[order] + [left, top],
        areas=statistics[order, cv2.CC_STAT_AREA].astype(np.int64),
        boxes=boxes,
        mask=mask,
    )


@dataclass(frozen=True, eq=False)
class PersonView:
    """What one camera sees: region (H, W), skin in it, and the contour of a person seen whole."""

    region: Mask
    blobs: Blobs
    contour: Contour | None


def see_person(picture: Picture, region: Mask, skin: SkinColour) -> PersonView:
    """One camera's share: skin in the person's region (H, W) of a picture (H, W, 3), and contour.

    Raises SettingsError for a region of another size than the picture's.
    """
    if region.shape != picture.shape[:2]:
        raise SettingsError(f"the region is {region.shape}, but the picture {picture.shape}")
    return PersonView(region, skin_blobs(picture, region, skin), measure_contour(region))


def measure_contour(region: Mask) -> Contour | None:
    """The contour of a region (H, W); None where it is empty, or touches the edge."""
    edges = (region[0], region[-1], region[:, 0], region[:, -1])
    if not region.any() or any(edge.any() for edge in edges):
        return None
    rows, columns = np.flatnonzero(region.any(axis=1)), np.flatnonzero(region.any(axis=0))
    corner = np.array([columns[0], rows[0]], dtype=np.float64)
    picture = region[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].astype(np.uint8)
    moments = cv2.moments(picture, binaryImage=True)
    area = moments["m00"]
    contours, _ = cv2.findContours(picture, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    points = np.concatenate([contour.reshape(-1, 2) for contour in contours]).astype(np.float64)
    off = points - [moments["m10"] / area, moments["m01"] / area]
    angle = np.arctan2(-off[:, 1], off[:, 0])
    place = np.floor(angle / (2.0 * np.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    reach = np.zeros(DIRECTIONS)
    np.maximum.at(reach, place, np.linalg.norm(off, axis=1))
    middle = corner + 0.5 * (points.min(axis=0) + points.max(axis=0))
    # A contour thinner than a direction leaves gaps.
    known = np.flatnonzero(reach)
    filled = np.interp(np.arange(DIRECTIONS), known, reach[known], period=DIRECTIONS)
    return filled / np.sqrt(area), middle


def similarity(first: Array, second: Array) -> float:
    """How alike two contour shapes (DIRECTIONS,) are: 1 for equal ones, 0 for nothing in common."""
    return float(1.0 - np.abs(first - second).sum() / np.maximum(first, second).sum())


@dataclass(frozen=True, eq=False)
class Features:
    """The features of a frame.

    Args:
        places: (k, 3) [m]; the last frame's where nothing was measured.
        support: (k,) how many 3-D points the place was taken from; 0: not measured.
        points, owners: (m, 3) all inside every silhouette [m], and each's feature (m,).
    """

    places: Array
    support: Indices
    points: Array
    owners: Indices


def find_features(
    cameras: Sequence[Camera],
    views: Sequence[PersonView],
    last: Array,
    *,
    threshold: float = 0.05,
    dense: float = 0.08,
    margin: int = 2,
) -> Features:
    """The features' places in a frame: of the points nearest to a last place, the dense part.

    Points are where two rays meet that every camera sees in its silhouette. A camera has no say
    about points outside its picture, nor where its region is empty.

    Args:
        views: what each camera sees.
        last: (k, 3) the last frame's features [m].
        threshold: two rays show the same skin where they pass each other by less [m].
        dense: the radius of the dense part of a feature's points [m].
        margin: how far outside a silhouette a point may be seen [pixel].
    """
    points = meeting_points(cameras, [view.blobs.centroids for view in views], threshold)
    kept = np.ones(len(points), dtype=bool)
    # To all sides along or across, and not at all.
    aside = np.arange(1, margin + 1)
    beside = np.concatenate([[0], aside, -aside])[:, None]
    for camera, region in zip(cameras, (view.region for view in views), strict=True):
        if not region.any():
            continue
        uv, depth = camera.project(points)
        with np.errstate(invalid="ignore"):
            pixels = np.rint(uv)
            visible = (depth > 0.0) & (pixels >= 0).all(axis=1)
            visible &= (pixels < [camera.width, camera.height]).all(axis=1)
        column, row = pixels[visible].astype(np.int64).T
        near = region[np.clip(row + beside, 0, len(region) - 1), column].any(axis=0)
        near |= region[row, np.clip(column + beside, 0, region.shape[1] - 1)].any(axis=0)
        kept[visible] &= near
    points = points[kept]
    owners = np.linalg.norm(points[:, None] - last[None], axis=2).argmin(axis=1)
    places, support = np.array(last, dtype=np.float64), np.zeros(len(last), dtype=np.int64)
    for k in range(len(last)):
        mine = points[owners == k]
        if len(mine):
            # Those about the one with most others, of several the one to which they are nearest.
            distances = np.linalg.norm(mine[:, None] - mine[None], axis=2)
            around = distances <= dense
            spread = np.where(around, distances, 0.0).sum(axis=1)
            part = mine[around[np.lexsort((spread, -around.sum(axis=1)))[0]]]
            places[k], support[k] = part.mean(axis=0), len(part)
    return Features(places, support, points, owners)


@dataclass(frozen=True, eq=False)
class RegisteredPose:
    """The pose that is recognised, as every camera sees it.

    Args:
        q: (nq,) positions of the registered pose where the person was for the templates.
        heading_position: where the head's turn about the vertical stands in q.
        headings: (n,) the headings of the templates [rad].
        shapes, middles: by camera: (n, DIRECTIONS) contour shapes, and (n, 2) middles of the
            bounding box [pixel]; nan where the camera saw none whole.
    """

    q: Array
    heading_position: int
    headings: Array
    shapes: Mapping[str, Array]
    middles: Mapping[str, Array]


def stand_registered(
    skeleton: Skeleton, cameras: Sequence[Camera], middles: Sequence[Array]
) -> Array:
    """Positions (nq,) of the registered pose, below boxes' middles (2,) [pixel] in cameras."""
    q = registered_positions(skeleton)
    head, _, _, left_foot, right_foot = skeleton.features(q)
    middle = 0.5 * head + 0.25 * (left_foot + right_foot)
    q[skeleton.head_positions] += triangulate(cameras, middles) - middle
    return q


def register_pose(
    skeleton: Skeleton,
    q: Array,
    cameras: Sequence[Camera],
    draw: Callable[[Camera, Array], Mask],
    heading_count: int = 36,
) -> RegisteredPose:
    """Makes the templates of a pose q (nq,), about where it is shown; `draw` gives masks."""
    index = int(skeleton.head_angles[0])
    turns = np.arange(heading_count) * 2.0 * np.pi / heading_count
    headings = np.array([math.remainder(turn, 2.0 * math.pi) for turn in turns])
    shapes = {one.name: np.full((heading_count, DIRECTIONS), np.nan) for one in cameras}
    middles = {one.name: np.full((heading_count, 2), np.nan) for one in cameras}
    for camera in cameras:
        for k, heading in enumerate(headings):
            turned = np.array(q)
            turned[index] = heading
            contour = measure_contour(draw(camera, turned))
            if contour is not None:
                shapes[camera.name][k], middles[camera.name][k] = contour
    return RegisteredPose(np.array(q), index, headings, shapes, middles)


def recognise(
    skeleton: Skeleton,
    registered: RegisteredPose,
    cameras: Sequence[Camera],
    contours: Sequence[Contour | None],
    threshold: float = 0.9,
) -> tuple[Array, float] | None:
    """Whether the person stands in the registered pose now; None: not so.

    Args:
        registered: from register_pose, for these cameras.
        contours: in each camera's picture; None where it is not seen whole; two are needed.
        threshold: mean similarity that is needed.

    Returns:
        (nq,) positions, and the cameras' mean similarity, 0 to 1.
    """
    scores, seers, middles = [], [], []
    for camera, contour in zip(cameras, contours, strict=True):
        if contour is not None and camera.name in registered.shapes:
            templates = registered.shapes[camera.name]
            scores.append([similarity(contour[0], template) for template in templates])
            seers.append(camera)
            middles.append(contour[1])
    if len(seers) < 2:
        return None
    means = np.nan_to_num(np.array(scores)).mean(axis=0)
    best = int(np.argmax(means))
    if means[best] < threshold:
        return None
    q = np.array(registered.q)
    # The heading at the top of the parabola through the best template and its neighbours.
    before, here, after = means[best - 1], means[best], means[(best + 1) % len(means)]
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    heading = registered.headings[best] + shift * (2.0 * np.pi / len(means))
    q[registered.heading_position] = math.remainder(heading, 2.0 * math.pi)
    templates_middles = [registered.middles[camera.name][best] for camera in seers]
    q[skeleton.head_positions] += triangulate(seers, middles) - triangulate(
        seers, templates_middles
    )
    return skeleton.clip(q), float(means[best])


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
    how = cv2.INTER_AREA if height >= FACE_SIZE[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, FACE_SIZE, interpolation=how))


def learn_faces(faces: Sequence[Picture], directions: Array, dimensions: int = 60) -> FaceTemplates:
    """The eigenspace of faces (130, 80, 3) of known directions (n, 2) [rad], see FaceTemplates.

    `dimensions` eigenvectors span it at most.

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


def nearest_template(face: Picture, templates: FaceTemplates) -> tuple[int, float]:
    """The template nearest to a face (130, 80, 3), and how far this is from the eigenspace.

    The distance is in grey levels; where it is large the picture is no face.
    """
    off = face.reshape(-1).astype(np.float32) - templates.mean
    place = templates.basis @ off
    nearest = int(np.argmin(np.linalg.norm(templates.coordinates - place, axis=1)))
    left = max(0.0, float(off @ off) - float(place @ place))
    return nearest, math.sqrt(left / len(off))


def find_face(picture: Picture, blobs: Blobs, templates: FaceTemplates, farthest: float) -> Array:
    """The direction (2,) of the face in a picture (H, W, 3) [rad]; nan where no face is seen.

    No face is farther from the eigenspace than `farthest` [grey levels].
    """
    face = cut_face(picture, blobs)
    if face is not None:
        nearest, outside = nearest_template(face, templates)
        if outside <= farthest:
            return templates.directions[nearest].copy()
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
    path, background, empty = folder / "directions.csv", None, folder / "empty"
    header, rows = read_csv(path, SceneError)
    if header != ["picture", "turn", "nod"]:
        raise SceneError(f"{path}: the first line must be picture,turn,nod")
    # Turn and nod [deg] by picture.
    table: dict[str, tuple[float, float]] = {}
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
        table[name] = turn, nod
    if empty.is_dir():
        files = sorted(path for path in empty.iterdir() if path.suffix.lower() in SUFFIXES)
        if not files:
            raise SceneError(f"{empty}: holds no picture; remove the folder, or fill it")
        pictures = [read_picture(file, SceneError) for file in files]
        for file, picture in zip(files, pictures, strict=True):
            if picture.shape != pictures[0].shape:
                raise SceneError(f"{file}: is not as large as {files[0].name}")
        background = learn_background(pictures)
    faces = []
    for name in table:
        picture = read_picture(folder / name, SceneError)
        region = np.ones(picture.shape[:2], dtype=np.bool_)
        if background is not None:
            if background.mean.shape != picture.shape:
                raise SceneError(f"{folder / name}: is not as large as the pictures in 'empty'")
            region = person_region(picture, background)
        face = cut_face(picture, skin_blobs(picture, region, skin or SkinColour()))
        if face is None:
            raise SceneError(
                f"{folder / name}: no face: nothing in it has the colour of skin, or the largest "
                "patch touches the picture's edge; take the picture out of directions.csv, or name "
                "another skin colour"
            )
        faces.append(face)
    return learn_faces(faces, np.radians(list(table.values())).reshape(-1, 2))
