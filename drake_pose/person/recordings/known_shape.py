"""A person whose lengths and girths were found before."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.errors import UnknownNameError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.surfaces import with_girths
from drake_pose.person.recordings.person_capture import PersonCaptureSettings
from drake_pose.person.shape import (
    PersonShape,
    shape_noise,
    shape_parts,
    shape_values,
)
from drake_pose.person.silhouette_tracker import SilhouetteTracker
from drake_pose.silhouette.areas.outline import Outline

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KnownShape:
    """A person's lengths and girths.

    Args:
        lengths: by shape joint [m]; those that are missing are the model's.
        girths: by part, sides alike: how wide, 1 as the model.
    """

    lengths: Mapping[str, float]
    girths: Mapping[str, float]

    @staticmethod
    def of_fit(tree: PoseTree, shape: PersonShape) -> KnownShape:
        """The lengths and girths of a shape that was fitted."""
        names = [name for node in tree.nodes for name in node.value_names]
        chosen = zip(names, shape.values, shape.is_shape, strict=True)
        lengths = {name: float(value) for name, value, wanted in chosen if wanted}
        return KnownShape(lengths, dict(shape.girths))


def tracker_of_person(tree: PoseTree, shape: KnownShape | None) -> SilhouetteTracker:
    """What follows a person of a known shape, or of the model's own; lengths stay as they are.

    Args:
        tree: of a model with the landmarks of a person.
        shape: the person's; None: the model's.

    Raises:
        ModelError: the model has no landmarks of trunk, arms and legs.
        UnknownNameError: the shape has a length or a part that the model has not.
    """
    shape = shape or KnownShape({}, {})
    fit = ContourFit(tree, noise=shape_noise())
    held = shape_values(tree)
    rest = fit.kinematics.flatten(tree.default_values())
    names = list(fit.kinematics.names)
    for name, length in shape.lengths.items():
        known = [one for one, wanted in zip(names, held, strict=True) if wanted]
        if name not in known:
            raise UnknownNameError("length", name, known, str(tree.model.path))
        rest[names.index(name)] = length
    if shape.girths:
        fit = ContourFit(tree, _as_wide(fit, shape.girths), shape_noise())
    return SilhouetteTracker(fit, PersonCaptureSettings().tracker, held, rest)


def _as_wide(fit: ContourFit, girths: Mapping[str, float]) -> tuple[Outline, ...]:
    """The fit's surfaces with the given girths by part."""
    parts, groups = shape_parts(fit.tree)
    for part in girths:
        if part not in parts:
            raise UnknownNameError("part", part, parts, str(fit.tree.model.path))
    widths = np.array([girths.get(part, 1.0) for part in parts])
    return with_girths(fit.outlines, widths[groups])
