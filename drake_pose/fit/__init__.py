"""The one continuous fit: contours of a body drawn to the edges of silhouettes, any unknowns.

`evidence`: what cameras see of a frame. `kernel`: contours compared with edges, summed to a 12 x 12
matrix for each camera and node; `colours` and `background`: the same of pictures; `raster_lines`:
the same of exact masks. `parameters` and `proportions`: what may be unknown of a body and of
cameras. `levenberg_marquardt`: the minimum. `contour_fit` fits one pose, `problem` several frames
with shared unknowns; `covariance`: how sure they are.
"""
