"""Live capture of a person, frame by frame as pictures arrive."""
