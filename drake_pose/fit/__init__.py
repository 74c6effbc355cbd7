"""Continuous least-squares fits of a body's contours to the edges of silhouettes.

`evidence`: edge points of the silhouettes of one frame. `kernel`: contour residuals, accumulated
in a 12 x 12 matrix per camera and node; `colours` and `background`: the same from colour images;
`raster_lines`: the same from exact masks. `parameters` and `proportions`: parameters of a body and
of cameras. `levenberg_marquardt`: the optimiser. `contour_fit` fits one pose, `problem` several
frames with shared unknowns; `covariance` estimates the uncertainty of the result.
"""
