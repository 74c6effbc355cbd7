"""Experiment A with angles anywhere inside their limits, and one or several cameras."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from rich.table import Table

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.papers.kameda.experiment import draw_values, experiment_camera
from drake_pose.search.continuous.search import ContinuousSearch, PoseEstimate
from drake_pose.search.estimates import View
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_mask

WIDTH_MISMATCH = 0.08
OFFSET_MISMATCH = 0.03
IMAGES = 100

# Positions that the experiment holds have a span of this or less [rad or m].
_HELD = 1e-9


@dataclass(frozen=True)
class ContinuousTrial:
    """One pose of the experiment.

    Args:
        true_values: (m,) the values drawn, node after node [rad or m].
        searched: (m,) which of them were searched for.
        result: what the search found.
        seconds: of the processor, for the pose and for the intervals.
    """

    true_values: np.ndarray
    searched: np.ndarray
    result: PoseEstimate
    seconds: tuple[float, float]

    @property
    def errors(self) -> np.ndarray:
        """(m,) how far the values found are from the true ones [deg]."""
        found = np.concatenate(self.result.node_values)
        return np.abs(np.degrees(found - self.true_values))

    @property
    def determined(self) -> np.ndarray:
        """(m,) which values were searched for and are reported as determined."""
        pose_set = self.result.pose_set
        known = pose_set.determined if pose_set is not None else False
        return self.searched & np.array(known)

    @property
    def held(self) -> np.ndarray:
        """(m,) which true values lie in the intervals reported."""
        pose_set = self.result.pose_set
        joints = () if pose_set is None else pose_set.joints
        pairs = zip(joints, self.true_values, strict=True)
        return np.array([joint.holds(float(value)) for joint, value in pairs], dtype=np.bool_)


@dataclass(frozen=True)
class ContinuousResult:
    """All poses of the experiment, and how they were made."""

    trials: tuple[ContinuousTrial, ...]
    views: int
    seed: int
    mismatch: bool
    confidence: float

    def as_json(self) -> dict[str, float | int | str | bool | None]:
        """The figures: shares as fractions, errors in degrees, seconds of the processor."""
        E_total = [trial.result.E_total for trial in self.trials]
        errors = np.concatenate([trial.errors[trial.searched] for trial in self.trials])
        known = np.concatenate([trial.errors[trial.determined] for trial in self.trials])
        held = np.concatenate([trial.held[trial.determined] for trial in self.trials])
        seconds = np.array([trial.seconds for trial in self.trials])
        return {
            "images": len(self.trials),
            "views": self.views,
            "median_e_total": float(np.median(E_total)),
            "mean_e_total": float(np.mean(E_total)),
            "median_error_deg": float(np.median(errors)),
            "determined": len(known) / len(errors),
            "median_determined_error_deg": float(np.median(known)) if len(known) else None,
            "interval_coverage": float(np.mean(held)) if len(held) else None,
            "interval_confidence": self.confidence,
            "median_seconds": float(np.median(seconds[:, 0])),
            "mean_seconds": float(np.mean(seconds[:, 0])),
            "mean_interval_seconds": float(np.mean(seconds[:, 1])),
            "seed": self.seed,
            "angles": "continuous",
            "mismatch": self.mismatch,
        }


def continuous_table(results: Mapping[str, ContinuousResult]) -> Table:
    """The figures, one run a column, by what the column is called."""
    table = Table(title="Kameda, experiment A with continuous angles")
    table.add_column("figure")
    for heading in results:
        table.add_column(heading, justify="right")
    rows = {
        "images": ("poses", "{}"),
        "views": ("cameras", "{}"),
        "median_e_total": ("E_total, median", "{:.2%}"),
        "mean_e_total": ("  mean", "{:.2%}"),
        "median_determined_error_deg": ("error of determined joints, median [deg]", "{:.2f}"),
        "median_error_deg": ("  of all joints", "{:.2f}"),
        "determined": ("joints that are determined", "{:.0%}"),
        "interval_coverage": ("truth inside their intervals", "{:.1%}"),
        "interval_confidence": ("  as the intervals claim", "{:.1%}"),
        "median_seconds": ("processor seconds a pose, median", "{:.2f}"),
        "mean_interval_seconds": ("  for its intervals", "{:.2f}"),
    }
    figures = [result.as_json() for result in results.values()]
    for key, (label, form) in rows.items():
        cells = ["-" if column[key] is None else form.format(column[key]) for column in figures]
        table.add_row(label, *cells)
    return table


def continuous_search() -> ContinuousSearch:
    """The continuous search for experiment A's body, its root known."""
    model = load_model(bundled_model("woman"))
    return ContinuousSearch(model.pose_tree(root_position=np.zeros(3)))


def experiment_cameras(views: int) -> list[ParallelCamera]:
    """Experiment A's camera and copies of it about the body, 180 degrees / views apart.

    A silhouette from behind is the mirror image of that from before and says nothing new.

    Args:
        views: how many.

    Raises:
        SettingsError: if there is none.
    """
    if views < 1:
        raise SettingsError(f"views must be 1 or more, not {views}")
    first = experiment_camera()
    cameras = []
    for k in range(views):
        angle = math.pi * k / views
        turn = np.eye(4)
        turn[:2, :2] = [
            [math.cos(angle), -math.sin(angle)],
            [math.sin(angle), math.cos(angle)],
        ]
        cameras.append(
            ParallelCamera(
                name=f"turned_{round(math.degrees(angle))}",
                width=first.width,
                height=first.height,
                pixels_per_metre=first.pixels_per_metre,
                center_x=first.center_x,
                center_y=first.center_y,
                X_WC=turn @ first.X_WC,
            )
        )
    return cameras


def run_continuous_experiment(
    search: ContinuousSearch,
    images: int = IMAGES,
    seed: int = 0,
    views: int = 1,
    mismatch: bool = False,
    progress: Callable[[int], None] | None = None,
) -> ContinuousResult:
    """Draw poses inside the limits and match their silhouettes.

    Args:
        search: of ``continuous_search``.
        images: how many poses.
        seed: of the random angles; with a mismatch, too, the angles are those of this seed.
        views: how many cameras see each pose.
        mismatch: whether the body in the pictures has other widths and joints than the model.
        progress: called with the number of poses done after each.

    Raises:
        SettingsError: if ``images`` or ``views`` is below 1.
    """
    if images < 1:
        raise SettingsError(f"images must be 1 or more, not {images}")
    cameras = experiment_cameras(views)
    generator, other_generator = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    spans = [np.ptp(grid, axis=0) > _HELD for grid in search.sampled.values]
    trials = []
    for done in range(1, images + 1):
        values = draw_values(search, "continuous", generator)
        X_WN = search.tree.node_poses(values)
        outlines = search.sampled.surfaces.at(values)
        if mismatch:
            X_WN, outlines = change_body(search.tree, X_WN, outlines, other_generator)
        pictures = [
            View(camera, draw_mask(outlines, camera.X_CW @ X_WN, camera)) for camera in cameras
        ]
        start = time.process_time()
        result = search.match(pictures)
        seconds = time.process_time() - start
        interval_seconds = result.statistics.interval_seconds
        share = interval_seconds / max(result.seconds + interval_seconds, 1e-9)
        trials.append(
            ContinuousTrial(
                np.concatenate(values),
                np.concatenate(spans),
                result,
                (seconds * (1.0 - share), seconds * share),
            )
        )
        if progress is not None:
            progress(done)
    intervals = search.settings.refinement.intervals
    confidence = math.nan if intervals is None else intervals.confidence
    return ContinuousResult(tuple(trials), views, seed, mismatch, confidence)


def change_body(
    tree: PoseTree,
    X_WN: np.ndarray,
    outlines: list[Outline],
    generator: np.random.Generator,
) -> tuple[np.ndarray, list[Outline]]:
    """A body of other measures in the same pose.

    Every segment is 8 % wider or narrower at most, across its longest axis, and every joint's
    offset from the joint before it is 3 % longer or shorter at most.

    Args:
        tree: the body's pose tree.
        X_WN: (nodes, 4, 4) its pose.
        outlines: the nodes' surfaces.
        generator: the source of chance.

    Returns:
        The poses (nodes, 4, 4) and surfaces of the other body.
    """
    moved = X_WN.copy()
    surfaces = []
    for i, node in enumerate(tree.nodes):
        width, length = 1.0 + generator.uniform(-1.0, 1.0, 2) * (WIDTH_MISMATCH, OFFSET_MISMATCH)
        if node.parent >= 0:
            offset = X_WN[i, :3, 3] - X_WN[node.parent, :3, 3]
            moved[i, :3, 3] = moved[node.parent, :3, 3] + length * offset
        outline = outlines[i]
        middle = 0.5 * (outline.vertices.min(axis=0) + outline.vertices.max(axis=0))
        _, _, axes = np.linalg.svd(outline.vertices - middle, full_matrices=False)
        across = np.eye(3) - np.outer(axes[0], axes[0])
        grown = outline.vertices + (width - 1.0) * (outline.vertices - middle) @ across
        surfaces.append(Outline(grown, outline.triangles, outline.edges))
    return moved, surfaces
