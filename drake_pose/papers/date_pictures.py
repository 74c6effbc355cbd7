"""Pictures of Date's experiment in the manner of the paper's figures 2, 3, 4 and 7."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from drake_pose.papers.date import SHOWN_CAMERA, TITLES, DateResult, Moment
from drake_pose.papers.tables import draw_panels, save_figure, save_picture
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.rays import viewing_rays

Picture = NDArray[np.uint8]

_COLOURS = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple")
_SKIN = (255, 0, 160)


def save_pictures(result: DateResult, folder: Path) -> list[Path]:
    """Draw a moment of each motion (figures 7, 2 to 4), and errors over time; returns PNG files."""
    files = []
    for motion, moment in result.moments.items():
        files.append(save_picture(moment.compared, folder / f"figure_07_{motion}.png"))
    for motion, moment in result.moments.items():
        files.append(save_picture(_draw_skin(moment), folder / f"figure_02_{motion}.png"))
        files.append(save_figure(_draw_points(result, moment), folder / f"figure_03_{motion}.png"))
    faces = {name: one.faces for name, one in result.moments.items() if one.faces}
    if faces:
        columns = list(zip(*faces.values(), strict=True))
        figure = draw_panels(columns, ("input", "template", "avatar"), list(faces))
        files.append(save_figure(figure, folder / "figure_04.png"))
    return [*files, save_figure(_draw_errors(result), folder / "errors.png")]


def _draw_skin(moment: Moment) -> Picture:
    """Figure 2: the input, with the skin that was found in it outlined and its centroids."""
    picture = np.ascontiguousarray(moment.picture)
    blobs = moment.seen.views[SHOWN_CAMERA].blobs
    outlines, _ = cv2.findContours(
        blobs.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, outlines, -1, _SKIN, 1)
    for u, v in np.rint(blobs.centroids).astype(int):
        cv2.drawMarker(picture, (int(u), int(v)), _SKIN, cv2.MARKER_CROSS, 9, 1)
    return picture


def _draw_points(result: DateResult, moment: Moment) -> Figure:
    """Figure 3: where rays of skin meet, by the feature they were given to, and the features."""
    found = moment.seen.found
    figure = Figure(figsize=(6.0, 6.0))
    axes = figure.add_subplot(projection="3d")
    for name, view in moment.seen.views.items():
        origins, directions = viewing_rays(result.studio.cameras[name], view.blobs.centroids)
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


def _draw_errors(result: DateResult) -> Figure:
    """The joint centres' mean errors over time, by way of capturing."""
    figure = Figure(figsize=(9.0, 3.5))
    axes = figure.add_subplot()
    for way, errors in result.errors.items():
        axes.semilogy(np.mean(errors, axis=1), label=TITLES[way])
    for k, name in enumerate(result.names):
        if k == 0 or name != result.names[k - 1]:
            axes.axvline(k, color="0.8", zorder=0)
            axes.text(k, 1.0, f" {name}", transform=axes.get_xaxis_transform(), va="bottom")
    axes.set(xlabel="frame", ylabel="joint centres' mean error [mm]")
    axes.legend()
    return figure
