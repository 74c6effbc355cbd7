"""Experiments of Kameda, Minoh and Ikeda (section 6): one silhouette each, root position known.

A: random poses of a female body, whose silhouettes Drake renders (6.1). B and C: stored real
silhouettes of a man and of a hand (6.2). J is equation (1), E_total = J / area(S) equation (9).
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.table import Table

from drake_pose.body import PoseTree, bundled_model, load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import require_at_least
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import demo_settings, stored_scene
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.papers.tables import Count, Figures, figure_table, uncounted
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExaminationSettings,
    GridPoseSet,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    PoseEstimate,
    PoseSearch,
    RobustSettings,
    SampledTree,
    View,
    examine,
    renderer_tolerance,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.silhouette.scoring import draw_labels, draw_mask

PAPER = {
    "images": 219,
    "mean_e_total": 0.0227,
    "exact": 135,
    "pose_equal": 101,
    "wrong_hidden": 14,
    "wrong_inner_edges": 22,
    "improved": 75,
    "mean_runs": 26.2,
    "mean_runs_without_worst_seven": 20.1,
    "min_runs": 15,
}
"""Printed figures of experiment A (6.1). The paper states no processing times."""

METHODS: Mapping[Literal["paper", "beam"], str] = {
    "paper": "the paper's method",
    "beam": "multi-start search",
}
"""Names in tables of the methods that experiments B and C compare."""


class Causes(NamedTuple):
    """Why a wrong pose has the true pose's silhouette (6.1). Both causes may hold.

    Neither holds where a segment only turns about its own axis.
    """

    hidden: bool  # A segment with wrong angles is hidden in both poses: the paper's occlusion.
    inner_edges: bool  # Edges inside the silhouette differ.


@dataclass(frozen=True)
class RandomPose:
    """One pose of experiment A, and the result of the search."""

    true_values: tuple[np.ndarray, ...]  # The drawn values (k_i,) of each node [rad or m].
    inside: bool  # Whether the whole body is inside the picture.
    result: PoseEstimate  # The pose that the search found.
    seconds: float  # Processor time of the search [s].
    more_seconds: float = 0.0  # Processor time of proof and modes, or of intervals [s].
    tolerance: float = 0.0  # Silhouettes that differ by at most this are equal [pixel].
    # Why angles are wrong although the silhouette is matched; None: they are right, the silhouette
    # is not matched, or angles are continuous.
    causes: Causes | None = None

    @property
    def exact(self) -> bool:
        """Whether J is within the tolerance."""
        return self.result.found and self.result.J <= self.tolerance

    @property
    def pose_equal(self) -> bool:
        """Whether the silhouette is matched exactly and every angle is the true one."""
        return self.exact and self.causes is None

    @property
    def improved(self) -> bool:
        """Whether re-estimation lowered E_total (9)."""
        return self.result.found and self.result.E_total < self.result.first_E_total


@dataclass(frozen=True)
class RandomPoses:
    """All poses of experiment A, with the cameras, the search and the seed; see run_experiment."""

    trials: tuple[RandomPose, ...]
    cameras: tuple[ParallelCamera, ...]
    search: PoseSearch
    seed: int

    def view(self, trial: RandomPose) -> View:
        """Return the first camera and its silhouette of a trial's true pose."""
        tree, camera = self.search.tree, self.cameras[0]
        pose = tree.positions_from(trial.true_values)
        return View(camera, LabelRenderer(tree.model, camera).mask(*pose))


def experiment_camera(angle: float = 0.0) -> ParallelCamera:
    """Return the paper's camera: 700 x 700 pixels, parallel, 2.26 pixels per centimetre.

    The head's joint is above the picture's middle. `angle` [rad] turns the camera about the body's
    vertical axis, to the body's left.
    """
    turn, X_WC = np.eye(4), np.eye(4)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    # World x, the way the body looks, points to the camera; y is the picture's right, z its up.
    X_WC[:3] = [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    name = f"turned_{round(math.degrees(angle))}"
    # Arms reach about as far above the head's joint as the legs of a leaning body reach below it:
    # with this principal point few bodies leave the picture.
    return ParallelCamera(name, 700, 700, 226.0, 349.5, 260.0, turn @ X_WC)


def experiment_search() -> PaperSearch:
    """Return the paper's search of its female body (section 5), with its threshold r [pixel]."""
    return PaperSearch(experiment_tree(), PaperSearchSettings(outside_limit=200.0))


def beam_experiment_search() -> BeamSearch:
    """Return the beam search of the same body and samples; it needs no threshold r."""
    return BeamSearch(experiment_tree(), BeamSearchSettings())


def experiment_tree() -> PoseTree:
    """Return the female body's pose tree, its root the head, at the world's origin."""
    return load_model(bundled_model("woman")).pose_tree(root_position=np.zeros(3))


def draw_values(
    search: PoseSearch, angles: str, generator: np.random.Generator
) -> list[np.ndarray]:
    """Draw the values (k_i,) of each node of a search's tree [rad, m].

    ``search``: whose grid and limits are used. ``angles``: "grid": samples of the search's grid;
    "continuous": uniformly between the limits, where the grid has several samples. ``generator``:
    draws them.
    """
    values = []
    tree = search.tree
    lower, upper = tree.model.lower, tree.model.upper
    for i, node in enumerate(tree.nodes):
        grid = search.sampled.values[i]
        drawn = grid[generator.integers(len(grid))].copy()
        if angles == "continuous":
            # A position with a single grid value is known, not searched.
            moving = np.ptp(grid, axis=0) > 0
            indices = np.array(node.positions, dtype=np.int64)
            uniform = generator.uniform(lower[indices], upper[indices])
            drawn[moving] = uniform[moving]
        values.append(drawn)
    return values


def run_experiment(
    search: PoseSearch, images: int, seed: int, count: Count = uncounted, views: int = 1
) -> RandomPoses:
    """Draw random poses and search them in their silhouettes.

    Poses are drawn on the grid, as in the paper, or between its samples for a continuous search.

    Args:
        search: from ``experiment_search`` or ``beam_experiment_search``, or a ``MultiStartSearch``
            of ``experiment_tree``.
        images: number of poses; 219 in the paper.
        seed: of the random angles.
        count: reports progress.
        views: number of cameras, 180 degrees / views apart: a silhouette from behind is the mirror
            image of that from the front.

    Raises SettingsError: if ``images`` or ``views`` is below 1.
    """
    require_at_least(1, images=images, views=views)
    cameras = tuple(experiment_camera(math.pi * k / views) for k in range(views))
    tree, sampled, is_continuous = search.tree, search.sampled, isinstance(search, MultiStartSearch)
    angles = "continuous" if is_continuous else "grid"
    generator = np.random.default_rng(seed)
    name = "paper" if isinstance(search, PaperSearch) else angles
    advance = count(f"silhouettes, {name}", images)
    first = cameras[0]
    wide = replace(
        first,
        width=3 * first.width,
        height=3 * first.height,
        center_x=first.center_x + first.width,
        center_y=first.center_y + first.height,
    )
    renderers = [LabelRenderer(tree.model, camera) for camera in cameras]
    drawn = [tuple(draw_values(search, angles, generator)) for _ in range(images)]
    trials = []
    for values in drawn:
        pose = tree.positions_from(values)
        seers = zip(cameras, renderers, strict=True)
        seen = [View(camera, renderer.mask(*pose)) for camera, renderer in seers]
        tolerance = renderer_tolerance(seen)
        start = time.process_time()
        result = search.match(seen)
        seconds, more, causes = time.process_time() - start, 0.0, None
        if is_continuous:
            # The search states its times by the wall clock.
            more = result.interval_seconds
            more *= seconds / max(result.seconds, 1e-9)
            seconds -= more
        if isinstance(search, BeamSearch):
            # With tighter time limits the figures would depend on the machine.
            limits = ExaminationSettings(proof_poses=1_000_000, mode_poses=100_000, time_limit=60.0)
            start = time.process_time()
            result = examine(search.body, seen, result, limits)
            more = time.process_time() - start
        if not is_continuous and result.found and result.J <= tolerance:
            pairs = zip(result.node_values, values, strict=True)
            if not all(np.allclose(one, true, atol=math.radians(0.01)) for one, true in pairs):
                causes = causes_of_wrong_angles(sampled, first, values, result.node_values)
        whole = draw_mask(sampled.surfaces.at(values), wide.X_CW @ tree.node_poses(values), wide)
        lost = np.count_nonzero(whole) - np.count_nonzero(seen[0].mask)
        inside = bool(lost <= tolerance)
        trials.append(RandomPose(values, inside, result, seconds, more, tolerance, causes))
        advance(len(trials))
    return RandomPoses(tuple(trials), cameras, search, seed)


def causes_of_wrong_angles(
    sampled: SampledTree,
    camera: ParallelCamera,
    true_values: Sequence[np.ndarray],
    found_values: Sequence[np.ndarray],
    unseen: int = 20,
) -> Causes:
    """Return why two different poses have the same silhouette.

    Args:
        sampled: the body.
        camera: that sees the silhouette.
        true_values, found_values: values (k_i,) of each node in both poses [rad, m].
        unseen: segments that show fewer pixels in both poses are hidden, and inner edges are equal
            if the segments of fewer pixels differ.
    """
    tree, surfaces = sampled.tree, sampled.surfaces
    nodes = len(tree.nodes)
    labels = range(1, 1 + nodes)
    images = [
        draw_labels(surfaces.at(values), labels, camera.X_CW @ tree.node_poses(values), camera)
        for values in (true_values, found_values)
    ]
    seen = np.max([np.bincount(one.ravel(), minlength=1 + nodes)[1:] for one in images], axis=0)
    pairs = zip(true_values, found_values, strict=True)
    wrong = [not np.allclose(true, found, atol=1e-4) for true, found in pairs]
    hidden = bool((seen[wrong] < unseen).any())
    return Causes(hidden, bool((images[0] != images[1]).sum() >= unseen))


def grid_figures(result: RandomPoses) -> dict[str, Any]:
    """Return the figures of a run of experiment A, by the keys of ``PAPER`` and others.

    E_total is over the silhouettes for which a pose was found; ``not_found`` counts the others.
    """
    trials = result.trials
    found = [trial.result for trial in trials]
    E_total = [one.E_total for one in found if one.found]
    runs = np.sort([one.runs for one in found])
    seconds = [trial.seconds for trial in trials]
    causes = [trial.causes for trial in trials if trial.causes is not None]
    figures = {
        "images": len(trials),
        "mean_e_total": float(np.mean(E_total)) if E_total else math.nan,
        "exact": sum(trial.exact for trial in trials),
        "pose_equal": sum(trial.pose_equal for trial in trials),
        "wrong_hidden": sum(one.hidden for one in causes),
        "wrong_inner_edges": sum(one.inner_edges for one in causes),
        "wrong_alike": sum(not any(one) for one in causes),
        "improved": sum(trial.improved for trial in trials),
        "mean_runs": float(np.mean(runs)),
        "mean_runs_without_worst_seven": float(np.mean(runs[:-7] if len(runs) > 7 else runs)),
        "min_runs": int(runs[0]),
        "median_seconds": float(np.median(seconds)),
        "p95_seconds": float(np.quantile(seconds, 0.95)),
        "not_found": len(trials) - len(E_total),
        "leaving_the_picture": sum(not trial.inside for trial in trials),
        "seed": result.seed,
        "angles": "grid",
        "tolerance": max(trial.tolerance for trial in trials),
    }
    if isinstance(result.search, PaperSearch):
        return {**figures, "method": "paper"}
    sets = [(trial, trial.result.pose_set) for trial in trials]
    known = [one for _, one in sets if one is not None]
    named = [one.contains(trial.true_values) for trial, one in sets if isinstance(one, GridPoseSet)]
    return {
        **figures,
        "method": "beam",
        # A match within the renderers' difference cannot be told from the optimum.
        "proved": sum(trial.exact or trial.result.proved_optimal for trial in trials),
        "exact_inside": sum(trial.exact for trial in trials if trial.inside),
        "truth_in_set": sum(named),
        "budget_spent": sum(one.budget_spent for one in found),
        "complete_sets": sum(one.complete for one in known),
        "several_modes": sum(one.mode_count > 1 for one in known),
        "free_joints": sum(not all(one.determined) for one in known),
        "examination_median_seconds": float(np.median([trial.more_seconds for trial in trials])),
    }


def grid_table(results: Sequence[RandomPoses]) -> Table:
    """Tabulate the paper's printed figures beside those of runs with different searches."""
    rows = {
        "images": ("silhouettes", "{}"),
        "tolerance": ("  equal within [pixel]", "{:.0f}"),
        "not_found": ("  no pose found", "{}"),
        "mean_e_total": ("mean E_total where a pose was found", "{:.2%}"),
        "exact": ("matched within the tolerance", "{}"),
        "pose_equal": ("  with every joint angle right", "{}"),
        "wrong_hidden": ("  else: a wrong segment is hidden", "{}"),
        "wrong_inner_edges": ("  else: edges inside differ", "{}"),
        "wrong_alike": ("  else: neither", "{}"),
        "improved": ("improved by re-estimation", "{}"),
        "mean_runs": ("runs of step 3, mean", "{:.1f}"),
        "mean_runs_without_worst_seven": ("  mean without the worst seven", "{:.1f}"),
        "min_runs": ("  minimum", "{}"),
        "median_seconds": ("processor seconds an image, median", "{:.3f}"),
        "p95_seconds": ("  95th percentile", "{:.3f}"),
        "leaving_the_picture": ("bodies partly outside the picture", "{}"),
        "exact_inside": ("matched, of bodies inside the picture", "{}"),
        "proved": ("proved: matched, or the optimum of the grid", "{}"),
        "budget_spent": ("proof or set stopped by time or memory", "{}"),
        "truth_in_set": ("true pose in the set of equally good poses", "{}"),
        "complete_sets": ("complete sets", "{}"),
        "several_modes": ("silhouettes with several modes of poses", "{}"),
        "free_joints": ("silhouettes with an undetermined joint", "{}"),
        "examination_median_seconds": ("seconds for proof and set, median", "{:.3f}"),
    }
    # Runs of the beam search are other steps than the paper's, and not comparable.
    own = {"improved", "mean_runs", "mean_runs_without_worst_seven", "min_runs"}
    shown: dict[str, Figures] = {"paper": PAPER}
    for result in results:
        figures = grid_figures(result)
        if figures["method"] == "beam":
            shown["beam search"] = {key: one for key, one in figures.items() if key not in own}
        else:
            shown["the paper's method"] = figures
    return figure_table("Kameda, experiment A: one silhouette of a female body", rows, shown)


def continuous_figures(result: RandomPoses) -> dict[str, Any]:
    """Return the figures of a run with continuous angles: ratios 0 to 1, errors [deg], times [s].

    Errors and coverage of determined joints are None if there are none.
    """
    search = result.search
    assert isinstance(search, MultiStartSearch)
    # Positions that the experiment holds have a span of about 0.
    searched = np.concatenate([np.ptp(grid, axis=0) > 1e-9 for grid in search.sampled.values])
    errors, known, held = [], [], []
    for trial in result.trials:
        true, pose_set = np.concatenate(trial.true_values), trial.result.pose_set
        off = np.abs(np.degrees(np.concatenate(trial.result.node_values) - true))
        errors += off[searched].tolist()
        joints = () if pose_set is None else pose_set.joints
        for joint, value, error, asked in zip(joints, true, off, searched, strict=bool(joints)):
            if asked and joint.determined:
                known.append(error)
                held.append(joint.holds(float(value)))
    E_total = [trial.result.E_total for trial in result.trials]
    return {
        "images": len(result.trials),
        "views": len(result.cameras),
        "median_e_total": float(np.median(E_total)),
        "mean_e_total": float(np.mean(E_total)),
        "median_error_deg": float(np.median(errors)),
        "determined": len(known) / len(errors),
        "median_determined_error_deg": float(np.median(known)) if known else None,
        "interval_coverage": float(np.mean(held)) if held else None,
        "interval_confidence": RobustSettings().confidence,
        "median_seconds": float(np.median([trial.seconds for trial in result.trials])),
        "mean_seconds": float(np.mean([trial.seconds for trial in result.trials])),
        "mean_interval_seconds": float(np.mean([trial.more_seconds for trial in result.trials])),
        "seed": result.seed,
        "angles": "continuous",
    }


def continuous_table(result: RandomPoses) -> Table:
    """Tabulate the figures of a run, as of ``continuous_figures``."""
    rows = {
        "images": ("poses", "{}"),
        "views": ("cameras", "{}"),
        "median_e_total": ("E_total, median", "{:.2%}"),
        "mean_e_total": ("  mean", "{:.2%}"),
        "median_determined_error_deg": ("error of determined joints, median [deg]", "{:.2f}"),
        "median_error_deg": ("  of all joints", "{:.2f}"),
        "determined": ("joints that are determined", "{:.0%}"),
        "interval_coverage": ("true angles inside their intervals", "{:.1%}"),
        "interval_confidence": ("  nominal", "{:.1%}"),
        "median_seconds": ("processor seconds a pose, median", "{:.2f}"),
        "mean_interval_seconds": ("  for its intervals", "{:.2f}"),
    }
    figures = {"continuous search": continuous_figures(result)}
    return figure_table("Kameda, experiment A with continuous angles", rows, figures)


class RealPictures(NamedTuple):
    """Experiment B or C: a stored scene, and the bundled model of another individual.

    Attributes:
        title: of its table.
        scene, model: names of the stored scene and of the bundled model.
        paper_images, paper_E_total: number of pictures and mean E_total that the paper prints.
    """

    title: str
    scene: str
    model: str
    paper_images: int
    paper_E_total: float

    def settings(self, scene: Path) -> EstimateSettings:
        """Return settings with the root's position and rotation's range for a stored scene."""
        if self.model == "man":
            return demo_settings(scene)
        # The forearm points up in the pictures, within 30 degrees; the hand may show either side.
        return EstimateSettings(
            root="forearm",
            root_position=(scene / "root_position.csv", "wrist"),
            root_rotation={"y": (-180.0, 180.0), "x": (-30.0, 30.0), "z": (-30.0, 30.0)},
        )


REAL_EXPERIMENTS = {
    "B": RealPictures("a person, the right foot's position known", "experiment_b", "man", 6, 0.223),
    "C": RealPictures("a hand, the forearm's position known", "experiment_c", "hand", 3, 0.172),
}


def run_real_experiment(
    experiment: str, images: int | None = None, out: Path | None = None, count: Count = uncounted
) -> dict[str, dict[str, Any]]:
    """Search the poses in stored pictures with each of METHODS, each picture by itself.

    The paper's method samples every 10 degrees; the multi-start search has continuous angles.

    Args:
        experiment: "B" or "C".
        images: number of pictures, from the first; None: all.
        out: folder for the poses and overlays of each method; None: write nothing.
        count: reports progress.

    Returns the figures by method. Mean E_total is over the pictures in which a pose was found.

    Raises OutputError: the folder is not empty or cannot be written.
    """
    pictures = REAL_EXPERIMENTS[experiment]
    scene, model = stored_scene(pictures.scene), bundled_model(pictures.model)
    frames = load_scene(scene).frames[:images]
    figures: dict[str, dict[str, Any]] = {}
    for method, name in METHODS.items():
        settings = replace(pictures.settings(scene), frames=frames, method=method)
        advance = count(f"pictures, {name}", len(frames))
        begin = time.process_time()
        estimate = estimate_scene(
            scene,
            model,
            None if out is None else out / method,
            settings,
            on_frame=lambda done, *_, advance=advance: advance(done),
        )
        seconds = time.process_time() - begin
        E_total = {frame: one.E_total for frame, one in estimate.records.items()}
        found = [one for one in E_total.values() if one is not None]
        figures[method] = {
            "experiment": experiment,
            "method": method,
            "images": len(E_total),
            "not_found": len(E_total) - len(found),
            "mean_e_total": sum(found) / len(found) if found else math.nan,
            "e_total": E_total,
            "seconds_an_image": seconds / len(E_total),
            "paper_images": pictures.paper_images,
            "paper_mean_e_total": pictures.paper_E_total,
            "warnings": list(estimate.warnings),
        }
    return figures


def real_table(figures: Mapping[str, Figures]) -> Table:
    """Tabulate the paper's figures beside those of `run_real_experiment`, with every E_total."""
    first = next(iter(figures.values()))
    rows = {
        "images": ("silhouettes", "{}"),
        "not_found": ("  no pose found", "{}"),
        "mean_e_total": ("mean E_total where a pose was found", "{:.1%}"),
        **{name: (f"  {name}", "{:.1%}") for name in first["e_total"]},
        "seconds_an_image": ("processor seconds an image", "{:.1f}"),
    }
    paper = {"images": first["paper_images"], "mean_e_total": first["paper_mean_e_total"]}
    every = {name: figures[method] for method, name in METHODS.items()}
    columns = {name: {**one, **one["e_total"]} for name, one in every.items()}
    pictures = REAL_EXPERIMENTS[first["experiment"]]
    title = f"Kameda, experiment {first['experiment']}: {pictures.title}"
    return figure_table(title, rows, {"paper": paper, **columns})
