"""Live capture of a person, frame by frame as pictures arrive, and the walk through a garden."""
