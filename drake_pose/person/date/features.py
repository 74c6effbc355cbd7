"""Features of a person in one frame's pictures (Date et al., sections 3 and 5).

Skin-coloured blobs give the positions of head, hands and feet (3.1); eigenspace templates give the
direction of the face (3.2; Murase and Nayar 1995); contours are compared with the registered pose,
whose recognition corrects a lost track (5).
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
from drake_pose.errors import SceneError, SettingsError
from drake_pose.input_files import read_csv
from drake_pose.person.date.skeleton import Skeleton, registered_positions
from drake_pose.person.views import meeting_points, triangulate

FACE_SIZE = (80, 130)
"""Width and height to which a face is scaled, 80 x 130 in section 3.2.2 [pixel]."""

DIRECTIONS = 72
"""Number of directions in which a contour is measured."""

Contour = tuple[Array, Array]
"""Outer contour of a person who is whole in one picture.

(DIRECTIONS,) distances of the farthest contour points from the region's centroid, counterclockwise
from the right, over the square root of the area; and (2,) middle of the bounding box [pixel].
"""


SKIN = (30.0, 133.0, 77.0), (255.0, 173.0, 127.0)
"""Lowest and highest brightness Y and chroma Cr, Cb of skin, 0 to 255; a chroma of 128 is grey.

The box in the chroma plane is Chai and Ngan's (1999), found on faces of many origins: shading
matters little. In the dark, chroma is unreliable."""


@dataclass(frozen=True, eq=False)
class Blobs:
    """Skin-coloured blobs of one picture, the largest first."""

    centroids: Array  # (n, 2) [pixel].
    areas: Indices  # (n,) [pixel^2].
    boxes: Indices  # (n, 4) left, top, width, height [pixel].
    mask: Mask  # (H, W) pixels of the blobs.


def skin_blobs(picture: Picture, region: Mask, min_area: int = 12, max_count: int = 12) -> Blobs:
    """Find skin-coloured blobs of a picture (H, W, 3) in the person's region (H, W) (3.1.1).

    ``min_area``: least area of a blob [pixel^2]. ``max_count``: the largest blobs are kept.
    """
    # The bounding box of an empty region is empty; one pixel keeps OpenCV's functions working.
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(region).view(np.uint8))
    part = slice(top, top + max(height, 1)), slice(left, left + max(width, 1))
    chroma = cv2.cvtColor(np.ascontiguousarray(picture[part]), cv2.COLOR_RGB2YCrCb)
    inner = (cv2.inRange(chroma, *SKIN) > 0) & region[part]
    joined = cv2.morphologyEx(inner.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8))
    count, labels, statistics, middles = cv2.connectedComponentsWithStats(joined, connectivity=8)
    order = np.argsort(-statistics[1:, cv2.CC_STAT_AREA], kind="stable")[:max_count] + 1
    order = order[statistics[order, cv2.CC_STAT_AREA] >= min_area] if count > 1 else order[:0]
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
    """One camera's region of the person (H, W), skin in it, and contour of a whole person."""

    region: Mask
    blobs: Blobs
    contour: Contour | None


def see_person(picture: Picture, region: Mask) -> PersonView:
    """Find skin and contour of the person's region (H, W) in one camera's picture (H, W, 3).

    Raises SettingsError: the region has another size than the picture.
    """
    if region.shape != picture.shape[:2]:
        raise SettingsError(f"the region is {region.shape}, but the picture {picture.shape}")
    return PersonView(region, skin_blobs(picture, region), measure_contour(region))


def measure_contour(region: Mask) -> Contour | None:
    """Return the contour of a region (H, W); None if it is empty or touches the picture's edge."""
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
    offsets = points - [moments["m10"] / area, moments["m01"] / area]
    angle = np.arctan2(-offsets[:, 1], offsets[:, 0])
    sector = np.floor(angle / (2.0 * np.pi) * DIRECTIONS).astype(np.int64) % DIRECTIONS
    radii = np.zeros(DIRECTIONS)
    np.maximum.at(radii, sector, np.linalg.norm(offsets, axis=1))
    middle = corner + 0.5 * (points.min(axis=0) + points.max(axis=0))
    # Directions without a contour point are interpolated.
    known = np.flatnonzero(radii)
    filled = np.interp(np.arange(DIRECTIONS), known, radii[known], period=DIRECTIONS)
    return filled / np.sqrt(area), middle


def similarity(first: Array, second: Array) -> float:
    """Return the similarity of two contour shapes (DIRECTIONS,): 0 to 1, nan if one is nan.

    It is 1 - the sum of absolute differences over the sum of the larger distances; 1: equal.
    """
    return float(1.0 - np.abs(first - second).sum() / np.maximum(first, second).sum())


@dataclass(frozen=True, eq=False)
class Features:
    """Positions of the features in a frame."""

    positions: Array  # (k, 3) positions [m]; the last frame's where nothing was measured.
    support: Indices  # (k,) number of 3-D points that each is the mean of; 0: not measured.
    points: Array  # (m, 3) all 3-D points inside every silhouette [m].
    owners: Indices  # (m,) index of the feature that each point belongs to.


def find_features(
    cameras: Sequence[Camera],
    views: Sequence[PersonView],
    last: Array,
    *,
    ray_distance: float = 0.05,
    dense_radius: float = 0.08,
    margin: int = 2,
) -> Features:
    """Measure the features' positions in a frame (3.1.2).

    The rays of two blobs that nearly meet give a 3-D point. Points outside a silhouette are
    dropped, except in cameras whose region is empty or whose picture does not contain the point.
    Each point belongs to the nearest of the last frame's features; a feature's position is the mean
    of its densest points.

    Args:
        cameras, views: the cameras, and the person as each of them sees it.
        last: (k, 3) the last frame's features [m].
        ray_distance: largest distance of two rays of the same skin [m].
        dense_radius: radius of the densest part of a feature's points [m].
        margin: largest distance of a point from a silhouette, along rows or columns [pixel].
    """
    points = meeting_points(cameras, [view.blobs.centroids for view in views], ray_distance)
    kept = np.ones(len(points), dtype=bool)
    # Shifts of up to `margin` pixels to either side, and none.
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
        is_near = region[np.clip(row + beside, 0, len(region) - 1), column].any(axis=0)
        is_near |= region[row, np.clip(column + beside, 0, region.shape[1] - 1)].any(axis=0)
        kept[visible] &= is_near
    points = points[kept]
    owners = np.linalg.norm(points[:, None] - last[None], axis=2).argmin(axis=1)
    positions, support = np.array(last, dtype=np.float64), np.zeros(len(last), dtype=np.int64)
    for k in range(len(last)):
        owned = points[owners == k]
        if len(owned):
            # The densest part is around the point with most neighbours; ties go to the densest.
            distances = np.linalg.norm(owned[:, None] - owned[None], axis=2)
            around = distances <= dense_radius
            spread = np.where(around, distances, 0.0).sum(axis=1)
            part = owned[around[np.lexsort((spread, -around.sum(axis=1)))[0]]]
            positions[k], support[k] = part.mean(axis=0), len(part)
    return Features(positions, support, points, owners)


@dataclass(frozen=True, eq=False)
class RegisteredPose:
    """Contour templates of the registered pose, for all cameras and headings (5)."""

    q: Array  # (nq,) positions of the registered pose where the templates were made [rad, m].
    heading_position: int  # Index in q of the head's angle about the vertical.
    headings: Array  # (n,) headings of the templates [rad].
    # (n, DIRECTIONS) contour shapes by camera; nan where the person is not whole.
    shapes: Mapping[str, Array]
    middles: Mapping[str, Array]  # (n, 2) middles of the bounding boxes by camera [pixel], or nan.


def place_registered(
    skeleton: Skeleton, cameras: Sequence[Camera], middles: Sequence[Array]
) -> Array:
    """Return q (nq,) [rad, m] of the registered pose at the place where cameras see the person.

    `middles` are the middles (2,) of the person's bounding box in each camera's picture [pixel].
    """
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
    """Make the templates of a pose at its place, in all headings.

    Args:
        skeleton: of the person; the head's first angle is the heading.
        q: (nq,) the pose [rad, m].
        cameras: that get templates.
        draw: returns the mask (H, W) of the person in a camera's picture, for positions (nq,).
        heading_count: number of headings, evenly spread.
    """
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
    threshold: float,
) -> tuple[Array, float] | None:
    """Recognise the registered pose in all cameras' contours (5).

    Args:
        skeleton: of the person.
        registered: templates; cameras without any are ignored.
        contours: of each camera; None where the person is not whole. Two are needed.
        threshold: least similarity of a template, in the mean of the cameras.

    Returns (nq,) positions, at the place and heading that the cameras see, and the mean similarity,
    0 to 1; None if the pose is not recognised.
    """
    scores, used, middles = [], [], []
    for camera, contour in zip(cameras, contours, strict=True):
        if contour is not None and camera.name in registered.shapes:
            templates = registered.shapes[camera.name]
            scores.append([similarity(contour[0], template) for template in templates])
            used.append(camera)
            middles.append(contour[1])
    if len(used) < 2:
        return None
    means = np.nan_to_num(np.array(scores)).mean(axis=0)
    best = int(np.argmax(means))
    if means[best] < threshold:
        return None
    q = np.array(registered.q)
    # The heading at the vertex of the parabola through the best template and its neighbours.
    before, here, after = means[best - 1], means[best], means[(best + 1) % len(means)]
    curvature = before - 2.0 * here + after
    shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    heading = registered.headings[best] + shift * (2.0 * np.pi / len(means))
    q[registered.heading_position] = math.remainder(heading, 2.0 * math.pi)
    templates_middles = [registered.middles[camera.name][best] for camera in used]
    q[skeleton.head_positions] += triangulate(used, middles) - triangulate(used, templates_middles)
    return skeleton.clip(q), float(means[best])


@dataclass(frozen=True, eq=False)
class FaceTemplates:
    """Faces of known directions in their eigenspace (3.2.2)."""

    mean: NDArray[np.float32]  # (d,) mean face, d = 80 x 130 x 3.
    basis: NDArray[np.float32]  # (k, d) leading eigenvectors, orthonormal.
    coordinates: NDArray[np.float32]  # (n, k) the templates in the eigenspace.
    # (n, 2) turn to the person's left and nod down, from facing the camera [rad].
    directions: Array


def cut_face(picture: Picture, blobs: Blobs) -> Picture | None:
    """Return the largest skin blob of a picture (H, W, 3), scaled to (130, 80, 3).

    Other pixels of its box are black. None where there is no blob, or its box touches the picture's
    edge.
    """
    if not len(blobs.areas):
        return None
    left, top, width, height = (int(side) for side in blobs.boxes[0])
    full_height, full_width = picture.shape[:2]
    if left == 0 or top == 0 or left + width == full_width or top + height == full_height:
        return None
    cut = picture[top : top + height, left : left + width].copy()
    # Pixels behind the head are blackened.
    cut[~blobs.mask[top : top + height, left : left + width]] = 0
    # Larger pictures are averaged, so that noise does not depend on the distance.
    interpolation = cv2.INTER_AREA if height >= FACE_SIZE[1] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(cut, FACE_SIZE, interpolation=interpolation))


def learn_faces(faces: Sequence[Picture], directions: Array, dimensions: int = 60) -> FaceTemplates:
    """Return the eigenspace of n faces of known directions.

    ``faces``: (130, 80, 3) pictures, as of `cut_face`. ``directions``: (n, 2) turn and nod of each,
    as in FaceTemplates [rad]. ``dimensions``: largest number of eigenvectors; 60 in section 3.2.2.
    Raises SettingsError: fewer than three faces, or not one direction for each.
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
    # The eigenvectors of d x d pixels follow from those of n x n faces (Murakami and Kumar).
    values, vectors = np.linalg.eigh((data @ data.T).astype(np.float64))
    order = np.argsort(-values)[: min(dimensions, len(faces) - 1)]
    order = order[values[order] > 1e-6 * values.max()]
    basis = (vectors[:, order] / np.sqrt(values[order])).T.astype(np.float32) @ data
    return FaceTemplates(mean, basis, data @ basis.T, known)


def head_angles(direction: Array, head: Array, camera: Camera) -> Array:
    """Return the head's turn, 0 along x, and nod in the world (2,) [rad] by a face's direction.

    ``direction``: (2,) turn to the person's left and nod down, from facing the camera [rad].
    ``head``: (3,) position of the head in the world [m].
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
    """Return the index of the template nearest to a face (130, 80, 3), and the face's residual.

    Faces are compared in the templates' eigenspace. The residual is the RMS distance of the face
    from the eigenspace [grey levels]; a picture with a large one shows no face.
    """
    distances = face.reshape(-1).astype(np.float32) - templates.mean
    coordinates = templates.basis @ distances
    nearest = int(np.argmin(np.linalg.norm(templates.coordinates - coordinates, axis=1)))
    residual = max(0.0, float(distances @ distances) - float(coordinates @ coordinates))
    return nearest, math.sqrt(residual / len(distances))


def find_face(
    picture: Picture, blobs: Blobs, templates: FaceTemplates, max_residual: float
) -> Array:
    """Return the direction (2,) of the face in a picture [rad]; nan where there is none.

    Args:
        picture: (H, W, 3) of the face camera.
        blobs: skin-coloured blobs of the picture; the largest one may be the face.
        templates: faces of known directions; the direction of the nearest one is returned.
        max_residual: a picture with a larger residual shows no face [grey levels].
    """
    face = cut_face(picture, blobs)
    if face is not None:
        nearest, residual = nearest_template(face, templates)
        if residual <= max_residual:
            return templates.directions[nearest].copy()
    return np.full(2, np.nan)


def learn_recorded_faces(folder: Path) -> FaceTemplates:
    """Return the eigenspace of faces that a camera recorded.

    `directions.csv` in the folder has the header `picture,turn,nod`: the name of a picture beside
    it (.png or .jpg), and where the face looks relative to the camera [deg]: turn to the person's
    left, nod downwards. The largest skin-coloured blob of a picture is the face.

    Raises:
        SceneError: a file, line or picture is wrong; the message names it.
        SettingsError: there are fewer than three pictures.
    """
    path = folder / "directions.csv"
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
    faces = []
    for name in table:
        picture = read_picture(folder / name)
        region = np.ones(picture.shape[:2], dtype=np.bool_)
        face = cut_face(picture, skin_blobs(picture, region))
        if face is None:
            raise SceneError(
                f"{folder / name}: no face: nothing in it has the colour of skin, or the largest "
                "patch touches the picture's edge; take the picture out of directions.csv"
            )
        faces.append(face)
    return learn_faces(faces, np.radians(list(table.values())).reshape(-1, 2))
