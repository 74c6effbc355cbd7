"""What pictures measure of a pose: contours and axes of segments."""
