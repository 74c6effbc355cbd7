"""The one continuous fit: contours of a body drawn to the edges of silhouettes, any unknowns.

`evidence`: the edges of silhouettes as points. `kernel`: contours compared with them, summed to a
12 x 12 matrix for each camera and node. `parameters`: everything that may be unknown, `unknowns`:
which of it is. `levenberg_marquardt`: the minimum. `contour_fit`, one frame; `frames_fit`, several.
"""
