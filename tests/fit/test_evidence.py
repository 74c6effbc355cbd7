"""Edge points of drawn silhouettes."""

import numpy as np
import pytest

from drake_pose.fit.evidence import NO_EDGE, find_edge_points, offset_edges, pack_evidence


@pytest.fixture
def ring():
    v, u = np.mgrid[:240, :320]
    distance = np.hypot(u - 150.3, v - 110.7)
    return (distance < 80.0) & (distance > 40.0)


def test_points_lie_on_the_circles_and_normals_point_outwards(ring):
    edge = find_edge_points(ring, 4.0)
    off = edge.uv - [150.3, 110.7]
    radius = np.linalg.norm(off, axis=1)
    outer = radius > 60.0
    along = (off / radius[:, None] * edge.normals).sum(axis=1)
    for own, size, cosine in ((outer, 80.0, along), (~outer, 40.0, -along)):
        np.testing.assert_allclose(radius[own], size, atol=1.0)
        assert cosine[own].min() > 0.9
        assert edge.lengths[own].sum() == pytest.approx(2 * np.pi * size, rel=0.03)
    np.testing.assert_allclose(edge.middle, [150.3, 110.7], atol=0.1)
    # Edges moved along their normals stay sorted; those of other cameras stay.
    moved = offset_edges(pack_evidence([edge, NO_EDGE, edge]), np.array([3.0, 1.0, 0.0]))
    count = len(edge.uv)
    np.testing.assert_array_equal(moved.starts, [0, count, count, 2 * count])
    np.testing.assert_array_equal(moved.uv[count:], edge.uv)
    radius = np.linalg.norm(moved.uv[:count] - [150.3, 110.7], axis=1)
    np.testing.assert_allclose(np.sort(radius)[[0, -1]], [37.0, 83.0], atol=1.0)
    for uv in (edge.uv, moved.uv[:count]):
        assert (np.diff(uv[:, 1]) >= 0.0).all()
    wide = moved.lengths[:count][radius > 60.0]
    np.testing.assert_allclose(wide.sum(), edge.lengths[outer].sum())


def test_borders_of_images_and_empty_masks_have_no_edge():
    mask = np.zeros((60, 80), dtype=bool)
    assert len(find_edge_points(mask, 2.0).uv) == 0
    assert np.isnan(find_edge_points(mask, 2.0).middle).all()
    mask[20:, 30:50] = True
    assert find_edge_points(mask, 2.0).uv[:, 1].max() < 59.0


@pytest.mark.parametrize("degrees", [0.0, 10.0, 26.0, 45.0, 63.0, 80.0])
def test_points_are_on_the_edge_on_average(degrees):
    """Of a half plane, rasterised by pixel centres, with many offsets of its edge."""
    n = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    v, u = np.mgrid[:200, :200]
    off = []
    for offset in np.linspace(0.0, 1.0, 21)[:-1] + 140.0:
        edge = find_edge_points(n[0] * u + n[1] * v < offset, 1.0)
        off.append((edge.uv @ n - offset).mean())
    assert abs(np.mean(off)) < 0.03
