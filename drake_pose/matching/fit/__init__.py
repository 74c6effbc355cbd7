"""One continuous fit: contours of a body drawn to the edges of silhouettes, any unknowns.

`evidence`: the edges of silhouettes as points. `kernel`: contours compared with them, summed to a
12 x 12 matrix for each camera and node. `parameters`: everything that may be unknown, and how each
parameter moves the nodes. `unknowns`: which of it is, in each frame or in all of them alike.
`normal_equations`: the chain rule from nodes to unknowns. `levenberg_marquardt`: the minimum inside
limits. `covariance`: how sure it is.
"""
