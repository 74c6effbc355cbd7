"""The one continuous fit: contours of a body drawn to the edges of silhouettes, any unknowns.

`evidence`: the edges of silhouettes as points. `kernel`: contours compared with them, summed to a
12 x 12 matrix for each camera and node. `parameters`: everything that may be unknown, and how each
parameter moves the nodes. `unknowns`: which of it is, in each frame or in all of them alike.
`levenberg_marquardt`: the minimum inside limits, frames' own unknowns eliminated. Its users:
`contour_fit`, one frame's pose; `frames_fit`, any unknowns of several frames, with covariance;
`views_fit`, one frame whose scale is not known. `covariance`: how sure values are where parts,
masks and cameras err together.
"""
