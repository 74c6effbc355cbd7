"""Where cameras stand, told by silhouettes of a body whose joint positions are known."""
