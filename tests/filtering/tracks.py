"""Motions, pictures and searches of a small body that is tracked."""

import math

import numpy as np

from drake_pose.filtering.contour_tracker import Tracker
from drake_pose.search import PaperSearch, PaperSearchSettings, PoseEstimate
from tests.search.bodies import front_camera

PERIOD = 1 / 30
CAMERA = front_camera(200, shift=0.2)
ORANGE, GREEN = np.array([230, 130, 40]), np.array([60, 140, 60])


def swings(frames, centre, amplitude, generator):
    """Return a smooth motion (frames, n) about a centre, with a period of about 1.3 s."""
    t = np.arange(frames)[:, None] / 40
    rate = generator.uniform(0.6, 1.4, len(centre))
    phase = generator.uniform(0, 2 * np.pi, len(centre))
    return centre + amplitude * np.sin(2 * np.pi * rate * t + phase)


def make_background(generator, side=480):
    """Return a background (side, side, 3) of patches in all colours except orange."""
    patches = generator.integers(0, 256, (side // 20, side // 20, 3))
    patches[..., 2] = np.maximum(patches[..., 2], 90)
    return patches.repeat(20, axis=0).repeat(20, axis=1)


def painted(mask, background, generator):
    """Return a picture of an orange body before a background, with noise."""
    noise = generator.normal(0.0, 6.0, (*mask.shape, 3))
    return np.clip(np.where(mask[..., None], ORANGE, background) + noise, 0, 255).astype(np.uint8)


def lit(mask, colour=ORANGE):
    """Return a picture of a body in one colour before green."""
    return np.where(mask[..., None], colour, GREEN).astype(np.uint8)


class KnownPoses:
    """A search that returns the known pose of the current frame, and counts its calls."""

    def __init__(self, tree, answers=(), J=20.0):
        self.tree, self.answers, self.J, self.frame, self.calls = tree, answers, J, 0, 0

    def match(self, views, root_position=None):
        self.calls += 1
        q, X_WB, scale, p_WR = self.answers[self.frame]
        values = tuple(self.tree.values_from_positions(q, X_WB))
        found = True, q, X_WB, values, self.J, 100.0, "end"
        return PoseEstimate(*found, root_position=p_WR, scale=scale)


def paper_search(model, outside_limit=60.0) -> PaperSearch:
    settings = PaperSearchSettings(interval=math.radians(20), outside_limit=outside_limit)
    return PaperSearch(model.pose_tree(), settings)


def tracker_of(search) -> Tracker:
    return Tracker(search.tree, [CAMERA], PERIOD, search=search)
