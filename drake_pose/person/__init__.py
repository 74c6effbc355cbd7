"""One person before many cameras: by all silhouettes at once, and (`date`) as Date et al. did."""
