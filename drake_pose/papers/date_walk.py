"""Application of Date et al. (section 6.2, figure 8): a walk through a virtual place by gestures.

`save_pictures` draws the pictures of both experiments, as the paper's figures 2 to 4, 7 and 8.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from pydrake.geometry import RenderEngineVtkParams
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, TrajectorySource
from rich.table import Table

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.papers.date import SHOWN_CAMERA, TITLES, DateResult, MotionSample
from drake_pose.papers.date_capture import PERIOD, PaperTrack, Studio, one_core
from drake_pose.papers.tables import (
    Count,
    draw_panels,
    figure_table,
    save_figure,
    save_picture,
    uncounted,
)
from drake_pose.person.date.skeleton import FEATURES
from drake_pose.person.date.walking import COMMANDS, make_gestures
from drake_pose.person.views import viewing_rays
from drake_pose.systems.bodies import add_posed_plant, held_positions
from drake_pose.systems.cameras import add_sensors
from drake_pose.systems.images import colour_image_to_picture, picture_to_colour_image
from drake_pose.systems.walk import Walker, add_garden, view_from_behind, walker_transform


class WalkThrough(NamedTuple):
    """Commands and walk by captured gestures, compared with those by the true poses."""

    figures: dict[str, Any]  # Results by key.
    # Of each command's middle frame, the shown camera's input and the virtual place.
    pictures: Mapping[str, tuple[Picture, Picture]]

    def table(self) -> Table:
        """Tabulate the time for which each command was active."""
        columns = {
            key: {name: one[f"{key}_s"] for name, one in self.figures["commands"].items()}
            for key in ("true", "captured", "wrongly")
        }
        end = "{same_command:.1%} of frames equal, final error {place_error_m:.2f} m"
        title = f"Walking through [s]: {end.format(**self.figures)}"
        return figure_table(title, {k: (k, "{:.2f}") for k in COMMANDS}, columns, "command")

    def save(self, folder: Path) -> Path:
        """Draw figure 8: the input, and the walk through the place."""
        columns = list(self.pictures.values())
        figure = draw_panels(columns, list(self.pictures), ("input", "virtual walk"))
        return save_figure(figure, folder / "figure_08.png")


def run_walk_through(
    cameras: int = 9, seed: int = 0, count: Count = uncounted, size: tuple[int, int] = (640, 480)
) -> WalkThrough:
    """Capture table 1's gestures by the paper's method, and walk by them.

    Args:
        cameras: number of cameras, including the face camera.
        seed: of the pictures' noise.
        count: reports progress.
        size: width and height of the pictures [pixel].
    """
    with one_core():
        studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        motion = make_gestures(studio.skeleton)
        names, model = np.array(motion.names), studio.model
        track = PaperTrack.build(studio.prepare(motion.q[0]))
        advance, q, pictures_shown = count("frames", len(names)), np.empty_like(motion.q), []
        for k, true_q in enumerate(motion.q):
            seen = studio.pictures(true_q)
            q[k] = track.step({name: picture_to_colour_image(one) for name, one in seen.items()})
            pictures_shown.append(seen[SHOWN_CAMERA])
            advance(k + 1)
    commands, poses, _ = walk_by(model, motion.q)
    found_commands, found_poses, rests = walk_by(model, q)
    seconds = {}
    for name, true_frames in active_frames(commands).items():
        captured = active_frames(found_commands)[name]
        counts = {
            "true": true_frames.sum(),
            "captured": captured.sum(),
            "wrongly": captured[~true_frames].sum(),
        }
        seconds[name] = {f"{key}_s": PERIOD * float(number) for key, number in counts.items()}
    error = found_poses[-1] - poses[-1]
    figures = {
        "same_command": float((commands == found_commands).all(axis=1).mean()),
        "commands": seconds,
        "place_error_m": float(np.linalg.norm(error[:2])),
        "heading_error_deg": abs(math.degrees(math.remainder(error[2], 2.0 * math.pi))),
        "frames": len(names), "cameras": cameras, "seed": seed, "method": "paper",
    }  # fmt: skip
    middles = {name: int(np.median(np.flatnonzero(names == name))) for name in COMMANDS}
    pictures = {
        name: (pictures_shown[k], draw_walk(model, q[k], found_poses[k], rests[k]))
        for name, k in middles.items()
    }
    return WalkThrough(figures, pictures)


def active_frames(commands: Array) -> dict[str, Mask]:
    """Return by name of COMMANDS in which rows (n, 2) of `recognise_command` it is active."""
    turn, walk = commands.T
    return dict(zip(COMMANDS, (turn > 0, turn < 0, walk > 0, walk < 0), strict=True))


def walk_by(model: ArticulatedModel, q: Array) -> tuple[Array, Array, Array]:
    """Simulate a Walker on positions q (n, nq), one frame per PERIOD, walking on the spot.

    Returns (n, 2) commands, as of `recognise_command`; (n, 3) the walker's poses, x, y [m] and
    heading [rad]; and (n, 5) rest stances, as of `stance_of`.
    """
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(held_positions(q, PERIOD)))
    walker = builder.AddSystem(Walker(model, q[0], PERIOD, on_spot=True))
    builder.Connect(source.get_output_port(), walker.GetInputPort("positions"))
    ports = [walker.GetOutputPort(name) for name in ("command", "walker_pose", "rest")]
    logs = [LogVectorOutput(port, builder, PERIOD) for port in ports]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(PERIOD * len(q))
    # A value logged at a time is the one before the update at that time.
    commands, poses, rests = (log.FindLog(simulator.get_context()).data()[:, 1:].T for log in logs)
    return commands, poses, rests


def draw_walk(model: ArticulatedModel, q: Array, pose: Array, rest: Array) -> Picture:
    """Render the virtual place from behind the avatar; return the picture (360, 480, 3).

    ``model``: of the avatar. ``q``: (nq,) its positions [rad, m]. ``pose``, ``rest``: (3,) pose of
    the walker and (5,) rest stance, as of `walk_by`.
    """
    X_RP = walker_transform(pose, rest).inverse()
    builder = DiagramBuilder()
    scene_graph = add_garden(builder, X_RP)
    positions = builder.AddSystem(ConstantVectorSource(q)).get_output_port()
    add_posed_plant(builder, scene_graph, model, positions, "geometry_pose")
    X_RC = X_RP.GetAsMatrix4() @ look_at(*view_from_behind(pose))
    camera = PinholeCamera("view", 480, 360, 384.0, 384.0, 240.0, 180.0, X_RC)
    sky = RenderEngineVtkParams(default_clear_color=np.array([0.65, 0.78, 0.94]))
    sensor = add_sensors(builder, scene_graph, {"view": camera}, {"view": (0.1, 60.0)}, sky)["view"]
    context = builder.Build().CreateDefaultContext()
    image = sensor.color_image_output_port().Eval(sensor.GetMyContextFromRoot(context))
    return colour_image_to_picture(image)


def save_pictures(result: DateResult, folder: Path) -> list[Path]:
    """Write PNG files of each motion's figures 2, 3, 4, 7 and of all errors; return the paths."""
    files = []
    for motion, sample in result.samples.items():
        files.append(save_picture(sample.compared, folder / f"figure_07_{motion}.png"))
    for motion, sample in result.samples.items():
        files.append(save_picture(_draw_skin(sample), folder / f"figure_02_{motion}.png"))
        files.append(save_figure(_draw_points(result, sample), folder / f"figure_03_{motion}.png"))
    faces = {name: one.faces for name, one in result.samples.items() if one.faces}
    if faces:
        columns = list(zip(*faces.values(), strict=True))
        figure = draw_panels(columns, ("input", "template", "avatar"), list(faces))
        files.append(save_figure(figure, folder / "figure_04.png"))
    return [*files, save_figure(_draw_errors(result), folder / "errors.png")]


def _draw_skin(sample: MotionSample) -> Picture:
    """Draw figure 2: the input with outlines and centroids of its skin-coloured blobs."""
    picture, pink = np.ascontiguousarray(sample.picture), (255, 0, 160)
    blobs = sample.views[SHOWN_CAMERA].blobs
    outlines, _ = cv2.findContours(
        blobs.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, outlines, -1, pink, 1)
    for u, v in np.rint(blobs.centroids).astype(int):
        cv2.drawMarker(picture, (int(u), int(v)), pink, cv2.MARKER_CROSS, 9, 1)
    return picture


def _draw_points(result: DateResult, sample: MotionSample) -> Figure:
    """Draw figure 3: 3-D points of skin by the feature they belong to, features, and blobs' rays.

    Args:
        result: experiment that the sample is from, for its cameras.
        sample: middle frame of a motion.
    """
    found = sample.found
    figure = Figure(figsize=(6.0, 6.0))
    axes = figure.add_subplot(projection="3d")
    for name, view in sample.views.items():
        origins, directions = viewing_rays(result.studio.cameras[name], view.blobs.centroids)
        for origin, direction in zip(origins, directions, strict=True):
            # Draw rays from 0.1 m before the features to 0.1 m behind them.
            along = (found.positions - origin) @ direction
            ends = origin + np.outer([along.min() - 0.1, along.max() + 0.1], direction)
            axes.plot(*ends.T, color="0.85", linewidth=0.5, zorder=0)
    colours = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple")
    for k, (name, colour) in enumerate(zip(FEATURES, colours, strict=True)):
        points = found.points[found.owners == k]
        axes.plot(*points.T, ".", color=colour, markersize=3)
        label = f"{name.replace('_', ' ')}: {found.support[k]} of {len(points)}"
        axes.plot(*found.positions[k : k + 1].T, "x", color=colour, markersize=9, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    axes.legend(title="points in the dense part, of all", fontsize="small")
    return figure


def _draw_errors(result: DateResult) -> Figure:
    """Draw the joint centres' mean errors over time, by method."""
    figure = Figure(figsize=(9.0, 3.5))
    axes = figure.add_subplot()
    for method, errors in result.errors.items():
        axes.semilogy(np.mean(errors, axis=1), label=TITLES[method])
    for k, name in enumerate(result.names):
        if k == 0 or name != result.names[k - 1]:
            axes.axvline(k, color="0.8", zorder=0)
            axes.text(k, 1.0, f" {name}", transform=axes.get_xaxis_transform(), va="bottom")
    axes.set(xlabel="frame", ylabel="joint centres' mean error [mm]")
    axes.legend()
    return figure
