"""Branch and bound: every pose of the grid below a limit, and the proof that none is better."""
