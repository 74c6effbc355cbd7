"""Surfaces of few triangles: what a fit needs of a body shows with them."""

from collections.abc import Sequence
from functools import lru_cache
from itertools import chain
from threading import Lock

import fast_simplification
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_pose.arrays import Array
from drake_pose.body import TriangleMesh
from drake_pose.compiled import file_digest
from drake_pose.fit.surface_store import stored
from drake_pose.silhouette.outline import Outline, TreeSurfaces, outline_from_mesh
from drake_pose.version import VERSION

MANY, FEW, VERY_FEW = 2500, 400, 80
"""Triangles of a node: where a pixel counts, for a still, and for a person in real time."""

# The simplifier keeps its surface in globals, and lets other threads run: two at once mix theirs.
_SIMPLIFIER = Lock()


def simplify_rigid_parts(surfaces: TreeSurfaces, count: int) -> TreeSurfaces:
    """The surfaces with few triangles in each rigid part; bands of skin stay and bend."""
    return surfaces.with_rigid([_simplified(rigid, count) for rigid in surfaces.rigid])


def simplify_surfaces(surfaces: TreeSurfaces, count: int = FEW) -> tuple[Outline, ...]:
    """The nodes' surfaces, skin at rest, with few triangles (Garland and Heckbert's metric)."""
    outlines = []
    for node, rigid in enumerate(surfaces.rigid):
        bending = surfaces.bending[node]
        outlines.append(_simplified(rigid if bending is None else bending.rest, count))
    return tuple(outlines)


def simplify_outlines(outlines: Sequence[Outline], count: int = 160) -> tuple[Outline, ...]:
    """Surfaces of few triangles with fewer still, which takes a fraction of what the first took."""
    return tuple(_simplified(outline, count) for outline in outlines)


def reduce_meshes(
    meshes: Sequence[TriangleMesh], total: int, rounds: int = 4
) -> list[TriangleMesh]:
    """Meshes with about so many triangles in all; each keeps its share, or 100 at least.

    ``rounds``: how often they are simplified at most: what has holes and slivers keeps several
    times as many at once.
    """
    light = list(meshes)
    for _ in range(rounds):
        given = sum(len(mesh.triangles) for mesh in light)
        if given <= 1.2 * total:
            break
        for k, mesh in enumerate(light):
            count = max(100, round(total * len(mesh.triangles) / given))
            if len(mesh.triangles) > count:
                few = _simplified(outline_from_mesh(mesh), count)
                light[k] = TriangleMesh(few.vertices, few.triangles)
    return light


def simplify_or_hull(
    outlines: Sequence[Outline], count: int, limit: float = 3.0
) -> tuple[Outline, ...]:
    """Surfaces with few triangles each.

    A surface that will not simplify below `limit` times as many becomes its convex hull.
    """
    found = []
    for outline in outlines:
        few = _simplified(outline, count)
        if len(few.triangles) > limit * count:
            hull = trimesh.convex.convex_hull(few.vertices)
            mesh = TriangleMesh(np.array(hull.vertices), np.array(hull.faces))
            few = _simplified(outline_from_mesh(mesh), count)
        found.append(few)
    return tuple(found)


def with_radius_scales(outlines: Sequence[Outline], radius_scales: Array) -> tuple[Outline, ...]:
    """Surfaces, each as many times as wide across its y axis as radius scales (nodes,) say."""
    wider = []
    for outline, radius_scale in zip(outlines, radius_scales, strict=True):
        vertices = outline.vertices * [radius_scale, 1.0, radius_scale]
        wider.append(outline_from_mesh(TriangleMesh(vertices, outline.triangles)))
    return tuple(wider)


def _simplified(outline: Outline, count: int) -> Outline:
    """A surface with about that number of triangles at most.

    From pass to pass the simplifier allows larger errors, which are lengths and no shares of the
    surface's, until triangles are few enough. Slivers it never merges, so with many of those it
    folds everything else, and may have many triangles left. Such a surface is simplified another
    way, which is kept where it is nearer to what was given.
    """
    if len(outline.triangles) <= count:
        return outline
    if count < FEW and len(outline.triangles) > 4000:
        # Very few triangles made out of few ones are as near, in a sixth of the time.
        few = _simplified(outline, FEW)
        outline = few if len(few.triangles) <= 1.1 * FEW else outline
    vertices = np.ascontiguousarray(outline.vertices, np.float64)
    triangles = np.ascontiguousarray(outline.triangles, np.int32)
    return _simplify(vertices.tobytes(), triangles.tobytes(), count)


@lru_cache(maxsize=256)
def _simplify(vertices: bytes, triangles: bytes, count: int) -> Outline:
    """A surface of more triangles, by its vertices and triangles.

    A process that estimates or audits many scenes of a body simplifies its surfaces once; the next
    process finds what took long on disk.
    """
    # Nothing here needs the edges.
    outline = Outline(
        np.frombuffer(vertices, np.float64).reshape(-1, 3),
        np.frombuffer(triangles, np.int32).reshape(-1, 3).copy(),
        np.zeros((0, 5), np.int32),
    )
    way = f"{fast_simplification.__version__} {VERSION} {file_digest(__file__)} {count}".encode()
    return stored((way, vertices, triangles), lambda: _make_simple(outline, count))


def _make_simple(outline: Outline, count: int) -> Outline:
    """A surface with about that number of triangles, in the way that is nearer to it."""
    simplified = collapse_edges(outline, count)
    size = float(np.linalg.norm(np.ptp(outline.vertices, axis=0)))
    # The distance of a smooth surface falls with the triangles: it is 0.4 to 1.4 times size / count
    # on all parts of the bundled bodies, from 80 triangles to 400.
    too_far = 2.0 / count * size
    distance = surface_distance(outline, simplified)
    too_many = len(simplified.triangles) > 3.0 * count
    if distance <= too_far and not too_many:
        return simplified
    # A surface with slivers: the simplifier gets it in a unit in which its largest errors, a few
    # hundred units, are small. Vertices that are close together are merged before the next time.
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
    """A surface whose edges are collapsed till triangles are few, in a unit of length [m].

    By Garland and Heckbert's quadric error metric.
    """
    if len(outline.triangles) <= count:
        return outline
    with _SIMPLIFIER:
        points, triangles = fast_simplification.simplify(
            outline.vertices / unit, outline.triangles, target_count=count
        )
    return outline_from_mesh(TriangleMesh(np.asarray(points, np.float64) * unit, triangles))


def surface_distance(one: Outline, other: Outline) -> float:
    """The root mean square distance of two surfaces [m]; infinite where one has no triangles.

    From points spread evenly over each to the nearest point of the other: what one lacks counts as
    much as what it has too much.
    """
    if len(one.triangles) == 0 or len(other.triangles) == 0:
        return np.inf
    squares = _squared_distances(one, other), _squared_distances(other, one)
    return float(np.sqrt(0.5 * (squares[0].mean() + squares[1].mean())))


def _squared_distances(one: Outline, other: Outline) -> Array:
    """(n,) of points spread over a surface to another one's triangles."""
    points, corners = _spread(one), other.vertices[other.triangles]
    centers = corners.mean(axis=1)
    radii = np.linalg.norm(corners - centers[:, None], axis=2).max(axis=1)
    first = trimesh.triangles.closest_point(corners[cKDTree(centers).query(points)[1]], points)
    apart = np.linalg.norm(first - points, axis=1)
    nearest = np.fmin(cKDTree(other.vertices).query(points)[0], apart)
    pairs: list[tuple[NDArray[np.intp], NDArray[np.intp]]] = []
    # Small triangles first: a few large ones would call for all the small ones around them.
    sizes = float(radii.max()) * 0.25 ** np.arange(6)
    for least, most in zip((*sizes[1:], -1.0), sizes, strict=True):
        own = np.flatnonzero((radii > least) & (radii <= most))
        if not len(own):
            continue
        # Nothing in the ball around a triangle is nearer than what was found.
        about = cKDTree(centers[own]).query_ball_point(points, nearest + most)
        counts = [len(one) for one in about]
        who = np.repeat(np.arange(len(points)), counts)
        which = own[np.fromiter(chain.from_iterable(about), np.intp, sum(counts))]
        apart = np.linalg.norm(centers[which] - points[who], axis=1)
        near = apart <= nearest[who] + radii[which]
        pairs.append((who[near], which[near]))
    owners, triangles = (np.concatenate(one) for one in zip(*pairs, strict=True))
    closest = trimesh.triangles.closest_point(corners[triangles], points[owners])
    squares = nearest**2
    np.fmin.at(squares, owners, ((closest - points[owners]) ** 2).sum(axis=1))
    return squares


def _spread(outline: Outline, count: int = 300) -> Array:
    """Points (count, 3) of a surface, as many in equal areas."""
    generator = np.random.default_rng(0)
    areas = np.cumsum(np.linalg.norm(outline.planes[:, :3], axis=1))
    where = np.searchsorted(areas, areas[-1] * (np.arange(count) + 0.5) / count)
    a, b, c = outline.vertices[outline.triangles[where]].transpose(1, 0, 2)
    across, along = generator.uniform(size=(2, count, 1))
    return a + np.sqrt(across) * ((b - a) + along * (c - b))
