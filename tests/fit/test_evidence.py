"""Edge points lie on the edge of what was drawn, whichever way it runs."""

import numpy as np
import pytest

from drake_pose.fit.evidence import find_edge_points


class TestFindEdgePoints:
    @pytest.mark.parametrize("degrees", [0.0, 10.0, 26.0, 45.0, 63.0, 80.0])
    def test_points_are_on_the_edge_in_the_mean(self, degrees: float) -> None:
        # Half a plane, of which a pixel belongs to it whose centre does; many offsets of its edge.
        n = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
        v, u = np.mgrid[:200, :200]
        off = []
        for offset in np.linspace(0.0, 1.0, 21)[:-1] + 140.0:
            edge = find_edge_points(n[0] * u + n[1] * v < offset, 1.0)
            off.append((edge.uv @ n - offset).mean())
        assert abs(np.mean(off)) < 0.03
