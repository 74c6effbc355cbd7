"""Pose and shape of one person seen by several cameras; `date` is the method of Date et al."""
