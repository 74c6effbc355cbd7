"""What the paper's stages see in a frame, drawn as its figures 2 to 4: skin, rays, faces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.date.capture import PersonView
from drake_pose.person.date.faces import FACE_HEIGHT, FACE_WIDTH, FaceTemplates
from drake_pose.person.date.features import Features
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.rays import viewing_rays

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

_COLOURS = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple")
_SKIN = (255, 0, 160)


@dataclass(frozen=True, eq=False)
class FaceTriple:
    """A row of figure 4.

    Args:
        face: (130, 80, 3) as cut from the face camera's picture.
        template: (130, 80, 3) the nearest one, as far as the eigenspace holds it.
        avatar: (130, 80, 3) the model's head in the direction found.
    """

    face: Picture
    template: Picture
    avatar: Picture


@dataclass(frozen=True, eq=False)
class StagesShown:
    """What the stages saw in a frame.

    Args:
        picture: (H, W, 3) of one camera on the circle.
        camera: its name.
        views: by camera on the circle: region and skin.
        found: 3-D points of skin, and the features made of them.
        faces: None where the face camera saw no face.
    """

    picture: Picture
    camera: str
    views: Mapping[str, PersonView]
    found: Features
    faces: FaceTriple | None


def template_picture(templates: FaceTemplates, index: int) -> Picture:
    """A template (130, 80, 3), put together again from its coordinates in the eigenspace."""
    flat = templates.mean + templates.coordinates[index] @ templates.basis
    return np.clip(flat, 0, 255).astype(np.uint8).reshape(FACE_HEIGHT, FACE_WIDTH, 3)


def draw_skin(shown: StagesShown) -> Picture:
    """Figure 2: the input, with the skin that was found in it outlined and its centroids."""
    picture = np.ascontiguousarray(shown.picture)
    blobs = shown.views[shown.camera].blobs
    outlines, _ = cv2.findContours(
        blobs.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, outlines, -1, _SKIN, 1)
    for u, v in np.rint(blobs.centroids).astype(int):
        cv2.drawMarker(picture, (int(u), int(v)), _SKIN, cv2.MARKER_CROSS, 9, 1)
    return picture


def draw_points(shown: StagesShown, cameras: Mapping[str, Camera]) -> Figure:
    """Figure 3: where rays of skin meet, by the feature they were given to, and the features."""
    found = shown.found
    figure = Figure(figsize=(6.0, 6.0), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    for name, view in shown.views.items():
        origins, directions = viewing_rays(cameras[name], view.blobs.centroids)
        for origin, direction in zip(origins, directions, strict=True):
            # As far as the person: from a little before the features to a little behind them.
            along = (found.places - origin) @ direction
            ends = origin + np.outer([along.min() - 0.1, along.max() + 0.1], direction)
            axes.plot(*ends.T, color="0.85", linewidth=0.5, zorder=0)
    for k, (name, colour) in enumerate(zip(FEATURES, _COLOURS, strict=True)):
        points = found.points[found.owners == k]
        axes.plot(*points.T, ".", color=colour, markersize=3)
        label = f"{name.replace('_', ' ')}: {found.support[k]} of {len(points)}"
        axes.plot(*found.places[k : k + 1].T, "x", color=colour, markersize=9, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    axes.legend(title="points in the dense part, of all", fontsize="small")
    return figure


def draw_faces(shown: Mapping[str, StagesShown]) -> Figure | None:
    """Figure 4: by motion the face, the nearest template, the avatar; None where no face was seen.

    Args:
        shown: by motion.
    """
    rows = {motion: one.faces for motion, one in shown.items() if one.faces is not None}
    if not rows:
        return None
    figure = Figure(figsize=(4.0, 2.1 * len(rows)), layout="constrained")
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for line, (motion, faces) in zip(panels, rows.items(), strict=True):
        for axes, picture in zip(line, (faces.face, faces.template, faces.avatar), strict=True):
            axes.imshow(picture)
            axes.set(xticks=[], yticks=[])
        line[0].set_ylabel(motion)
    for axes, title in zip(panels[0], ("input", "template", "avatar"), strict=True):
        axes.set_title(title)
    return figure
