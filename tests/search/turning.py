"""A crane whose joints make full turns, and label images of it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.search import View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.jobs.scenes import LINK, camera


def crane(folder: Path, luff: str = 'lower="-6.2831853" upper="6.2831853"') -> ArticulatedModel:
    """Return a boom with a continuous joint, and a jib with limits two turns apart, as in a UR5."""
    path = folder / "turning.urdf"
    path.write_text(
        '<robot name="crane"><link name="world"/>'
        + LINK.format(name="boom", z=0.25, size="0.1 0.16 0.5")
        + LINK.format(name="jib", z=0.2, size="0.1 0.08 0.4")
        + '<joint name="swing" type="continuous"><parent link="world"/><child link="boom"/>'
        '<origin xyz="0 0 0.3"/><axis xyz="1 0 0"/></joint>'
        '<joint name="luff" type="revolute"><parent link="boom"/><child link="jib"/>'
        '<origin xyz="0 0 0.5"/><axis xyz="1 0 0"/>'
        f'<limit {luff} effort="1" velocity="1"/></joint></robot>'
    )
    return load_model(path, check=False)


def views_of(model: ArticulatedModel, q: Sequence[float]) -> list[View]:
    """Return the view of Drake's renderer from the front at positions q [rad]."""
    front = camera("front")
    return [View(front, LabelRenderer(model, front).mask(np.asarray(q)))]
