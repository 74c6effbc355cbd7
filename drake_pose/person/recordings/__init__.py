"""Whole recordings of a person, in spite of others in view, bad calibrations and moved cameras."""
