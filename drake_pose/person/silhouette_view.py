"""What one camera's picture says of a person."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.fit.camera_sums import EdgeKeeper
from drake_pose.fit.evidence import EdgePoints, find_edge_points

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class KeptEdge:
    """Who keeps a view's edge elsewhere. camera: its name; time: the picture's stamp [s]."""

    keeper: EdgeKeeper
    camera: str
    time: float


@dataclass(frozen=True, eq=False)
class SilhouetteView:
    """What one camera says.

    Args:
        region: (H, W) the person.
        edge: points of the region's edge.
        kept: who else has the edge and can compare contours with it; None: nobody.
    """

    region: Mask
    edge: EdgePoints
    kept: KeptEdge | None = None

    @property
    def height(self) -> int:
        """Of the picture [pixel]."""
        return len(self.region)

    @property
    def edge_length(self) -> float:
        """Of the region's edge [pixel]."""
        return float(self.edge.lengths.sum())


def see_silhouette(region: Mask, spacing: float) -> SilhouetteView:
    """One camera's share: the edge of the person's region, points this many pixels apart."""
    return SilhouetteView(region, find_edge_points(region, spacing))
