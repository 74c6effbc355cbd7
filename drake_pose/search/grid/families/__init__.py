"""What silhouettes leave open on the grid: families of poses that look alike."""
