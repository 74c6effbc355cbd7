"""Refinement on exact masks: it stays apart from `fit`, as masks drawn by pixels tell more to it.

Along each line of the raster a drawn border lies half way between two pixels, and a contour's
crossing is exact: from the same starts, on 20 silhouettes of experiment A's body, this leaves
E_total .17 % in the median where `fit`, which draws points to the nearest point of an edge, leaves
2.0 % in the same time. On photographs, whose masks are off by pixels, there is no such difference.
"""
