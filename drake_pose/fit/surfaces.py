"""Simplify surfaces to few triangles, which suffice for a fit, and store them for later processes.

They are stored beside the compiled kernels. A file's name is a digest of everything the surface
depends on. The file starts with a digest of its content; a truncated or modified file is replaced.
If no folder is writable, nothing is stored.
"""

import hashlib
import io
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import chain
from pathlib import Path
from threading import Lock

import fast_simplification
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array
from drake_pose.body import TriangleMesh
from drake_pose.compiled import file_digest, kernel_folder
from drake_pose.silhouette.outline import (
    Outline,
    TreeSurfaces,
    outline_from_mesh,
    outline_of_triangles,
)
from drake_pose.version import VERSION

MANY, FEW, VERY_FEW = 2500, 400, 80
"""Triangles per node: for pixel accuracy, for a single frame, and for a person in real time."""

# The simplifier keeps its surface in globals and releases the GIL: it is not thread-safe.
_SIMPLIFIER = Lock()


def simplify_rigid_parts(surfaces: TreeSurfaces, count: int) -> TreeSurfaces:
    """Return surfaces whose rigid parts have at most about ``count`` triangles; skin bands bend."""
    return surfaces.with_rigid([_simplify(rigid, count) for rigid in surfaces.rigid])


def simplify_surfaces(surfaces: TreeSurfaces, count: int = FEW) -> tuple[Outline, ...]:
    """Return each node's surface, skin at rest, with at most about ``count`` triangles."""
    outlines = []
    for node, rigid in enumerate(surfaces.rigid):
        bending = surfaces.bending[node]
        outlines.append(_simplify(rigid if bending is None else bending.rest, count))
    return tuple(outlines)


def simplify_outlines(outlines: Sequence[Outline], count: int = 160) -> tuple[Outline, ...]:
    """Simplify simplified surfaces to about ``count`` triangles, faster than the originals."""
    return tuple(_simplify(outline, count) for outline in outlines)


def reduce_meshes(
    meshes: Sequence[TriangleMesh], total: int, rounds: int = 4
) -> list[TriangleMesh]:
    """Return meshes with about ``total`` triangles in all, at least 100 each.

    Args:
        meshes: the meshes; each keeps its fraction of the triangles.
        total: number of triangles; meshes with up to 1.2 times as many in all stay.
        rounds: maximum number of simplifications; meshes with holes and slivers keep several times
            as many triangles in a single one.
    """
    reduced = list(meshes)
    for _ in range(rounds):
        given = sum(len(mesh.triangles) for mesh in reduced)
        if given <= 1.2 * total:
            break
        for k, mesh in enumerate(reduced):
            count = max(100, round(total * len(mesh.triangles) / given))
            if len(mesh.triangles) > count:
                few = _simplify(outline_from_mesh(mesh), count)
                reduced[k] = TriangleMesh(few.vertices, few.triangles)
    return reduced


def simplify_or_hull(
    outlines: Sequence[Outline], count: int, limit: float = 3.0
) -> tuple[Outline, ...]:
    """Return surfaces with about ``count`` triangles each.

    A surface with fewer stays. One that keeps more than ``limit * count`` triangles is replaced by
    its convex hull, which is simplified likewise.
    """
    found = []
    for outline in outlines:
        few = _simplify(outline, count)
        if len(few.triangles) > limit * count:
            import trimesh  # Slow to import, and needed for few models.

            hull = trimesh.convex.convex_hull(few.vertices)
            mesh = TriangleMesh(np.array(hull.vertices), np.array(hull.faces))
            few = _simplify(outline_from_mesh(mesh), count)
        found.append(few)
    return tuple(found)


def with_radius_scales(outlines: Sequence[Outline], radius_scales: Array) -> tuple[Outline, ...]:
    """Return the nodes' surfaces, with x and z multiplied by radius scales (nodes,)."""
    scaled = []
    for outline, radius_scale in zip(outlines, radius_scales, strict=True):
        vertices = outline.vertices * [radius_scale, 1.0, radius_scale]
        scaled.append(outline_from_mesh(TriangleMesh(vertices, outline.triangles)))
    return tuple(scaled)


def _simplify(outline: Outline, count: int) -> Outline:
    """Return a surface with at most about ``count`` triangles; one with fewer stays.

    In each pass the simplifier allows larger errors, in absolute units, until there are few enough
    triangles. It never merges slivers: with many of them it folds the rest of the surface or leaves
    many triangles. Such a surface is also simplified in another way, see _simplify_uncached.
    """
    if len(outline.triangles) <= count:
        return outline
    if count < FEW and len(outline.triangles) > 4000:
        # Simplifying in two steps is as accurate and takes a sixth of the time.
        few = _simplify(outline, FEW)
        outline = few if len(few.triangles) <= 1.1 * FEW else outline
    vertices = np.ascontiguousarray(outline.vertices, np.float64)
    triangles = np.ascontiguousarray(outline.triangles, np.int32)
    return _simplify_cached(vertices.tobytes(), triangles.tobytes(), count)


@lru_cache(maxsize=256)
def _simplify_cached(vertices: bytes, triangles: bytes, count: int) -> Outline:
    """Return the simplified surface, cached in the process and on disk.

    The bytes are of (v, 3) float64 vertices [m] and (t, 3) int32 triangles.
    """
    # The simplification does not need the edges.
    outline = Outline(
        np.frombuffer(vertices, np.float64).reshape(-1, 3),
        np.frombuffer(triangles, np.int32).reshape(-1, 3).copy(),
        np.zeros((0, 5), np.int32),
    )
    method = f"{fast_simplification.__version__} {VERSION} {file_digest(__file__)} {count}".encode()
    return load_or_make((method, vertices, triangles), lambda: _simplify_uncached(outline, count))


def _simplify_uncached(outline: Outline, count: int) -> Outline:
    """Return a surface with about ``count`` triangles, in one of two ways.

    First edges are collapsed. If more than 3 count triangles remain, or the root mean square
    distance exceeds 2 / count of the bounding box's diagonal, the surface is also simplified in
    another unit, with close vertices merged. That result is returned if its distance is less than
    3/4 of the first one's, or if it is within the limit and the first one has too many triangles.
    """
    simplified = collapse_edges(outline, count)
    size = float(np.linalg.norm(np.ptp(outline.vertices, axis=0)))
    # The distance of a simplified smooth surface is 0.4 to 1.4 times size / count, on all parts of
    # the bundled bodies, with 80 to 400 triangles.
    too_far = 2.0 / count * size
    distance = surface_distance(outline, simplified)
    too_many = len(simplified.triangles) > 3.0 * count
    if distance <= too_far and not too_many:
        return simplified
    # A surface with slivers: use a unit in which the simplifier's largest error, a few hundred
    # units, is small. Close vertices are merged before each further attempt.
    unit = size / (25.0 * count)
    merged = collapse_edges(outline, count, unit)
    for grid in (10.0, 20.0, 40.0):
        if len(merged.triangles) <= 1.1 * count:
            break
        places = np.round(merged.vertices / (grid * unit)) * (grid * unit)
        merged = outline_from_mesh(TriangleMesh(places, merged.triangles))
        merged = collapse_edges(merged, count, unit)
    merged_distance = surface_distance(outline, merged)
    if merged_distance < 0.75 * distance or (too_many and merged_distance <= too_far):
        return merged
    return simplified


def collapse_edges(outline: Outline, count: int, unit: float = 1.0) -> Outline:
    """Return a surface simplified by edge collapses (quadric error metric, Garland and Heckbert).

    It stays if it has at most ``count`` triangles; slivers and holes may leave more. ``unit``: unit
    of length in which the simplifier works [m].
    """
    if len(outline.triangles) <= count:
        return outline
    with _SIMPLIFIER:
        points, triangles = fast_simplification.simplify(
            outline.vertices / unit, outline.triangles, target_count=count
        )
    return outline_from_mesh(TriangleMesh(np.asarray(points, np.float64) * unit, triangles))


def surface_distance(one: Outline, other: Outline) -> float:
    """Return the root mean square distance of two surfaces [m]; infinite if one has no triangles.

    Distances are measured from points spread evenly over each surface to the nearest point of the
    other one.
    """
    if len(one.triangles) == 0 or len(other.triangles) == 0:
        return np.inf
    squares = _squared_distances(one, other), _squared_distances(other, one)
    return float(np.sqrt(0.5 * (squares[0].mean() + squares[1].mean())))


def _squared_distances(one: Outline, other: Outline) -> Array:
    """Return (300,) squared distances of points spread over a surface to another one [m^2]."""
    # Slow to import, and not needed where surfaces are stored.
    import trimesh
    from scipy.spatial import cKDTree

    points, corners = _sample_surface(one), other.vertices[other.triangles]
    centers = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    first = trimesh.triangles.closest_point(corners[cKDTree(centers).query(points)[1]], points)
    distances = np.linalg.norm(first - points, axis=1)
    nearest = np.fmin(cKDTree(other.vertices).query(points)[0], distances)
    pairs: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
    # Group triangles by size: large ones would otherwise widen the search for all small ones.
    sizes = float(radii.max()) * 0.25 ** np.arange(6)
    for least, most in zip((*sizes[1:], -1.0), sizes, strict=True):
        own = np.flatnonzero((radii > least) & (radii <= most))
        if not len(own):
            continue
        # Only triangles whose bounding ball comes closer than the best distance are candidates.
        candidates = cKDTree(centers[own]).query_ball_point(points, nearest + most)
        counts = [len(one) for one in candidates]
        owners_of_pairs = np.repeat(np.arange(len(points)), counts)
        pair_triangles = own[np.fromiter(chain.from_iterable(candidates), np.intp, sum(counts))]
        distances = np.linalg.norm(centers[pair_triangles] - points[owners_of_pairs], axis=1)
        near = distances <= nearest[owners_of_pairs] + radii[pair_triangles]
        pairs.append((owners_of_pairs[near], pair_triangles[near]))
    owners, triangles = (np.concatenate(one) for one in zip(*pairs, strict=True))
    closest = trimesh.triangles.closest_point(corners[triangles], points[owners])
    squares = nearest**2
    np.fmin.at(squares, owners, ((closest - points[owners]) ** 2).sum(axis=1))
    return squares


def _sample_surface(outline: Outline, count: int = 300) -> Array:
    """Return points (count, 3) spread evenly over a surface's area [m], the same in every call."""
    generator = np.random.default_rng(0)
    areas = np.cumsum(np.linalg.norm(outline.planes[:, :3], axis=1))
    where = np.searchsorted(areas, areas[-1] * (np.arange(count) + 0.5) / count)
    a, b, c = outline.vertices[outline.triangles[where]].transpose(1, 0, 2)
    across, along = generator.uniform(size=(2, count, 1))
    return a + np.sqrt(across) * ((b - a) + along * (c - b))


def load_or_make(
    made_of: tuple[bytes, ...], make: Callable[[], Outline], most_files: int = 500
) -> Outline:
    """Return a surface from its file, or make and store it.

    Args:
        made_of: everything the surface depends on, including versions of the code that makes it;
            its digest is the file's name.
        make: makes the surface; it is called if there is no valid file.
        most_files: maximum number of files (60 kB for 2500 triangles); the least recently used ones
            are removed.
    """
    kernels = kernel_folder()
    if kernels is None:
        return make()
    digest = hashlib.sha256()
    for part in made_of:
        digest.update(len(part).to_bytes(8, "little") + part)
    path = kernels / "surfaces" / f"{digest.hexdigest()}.surface"
    outline = _read(path)
    if outline is None:
        outline = make()
        with suppress(OSError):  # The disk is full or the folder is not writable.
            buffer = io.BytesIO()
            np.savez(buffer, vertices=outline.vertices, triangles=outline.triangles)
            payload = buffer.getvalue()
            path.parent.mkdir(exist_ok=True)
            # Processes that store the same surface do not interfere.
            part_file = path.with_suffix(f".{os.getpid()}.{time.monotonic_ns()}.part")
            try:
                part_file.write_bytes(hashlib.sha256(payload).digest() + payload)
                part_file.replace(path)
            except OSError:
                with suppress(OSError):
                    part_file.unlink()
                raise
            ages = sorted(
                (one.stat().st_mtime, one) for one in path.parent.iterdir() if one.is_file()
            )
            for _, one in ages[: max(0, len(ages) - most_files)]:
                with suppress(OSError):
                    one.unlink()
    return outline


def _read(path: Path) -> Outline | None:
    """Return a stored surface; None if there is no file, or its content was altered."""
    try:
        with path.open("rb") as file:
            digest, content = file.read(32), file.read()
        if hashlib.sha256(content).digest() != digest:
            return None
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            outline = outline_of_triangles(arrays["vertices"], arrays["triangles"])
    except (OSError, ValueError, KeyError):
        return None
    with suppress(OSError):
        os.utime(path)
    return outline
