"""Kameda's experiments: a woman's random poses (A), and real silhouettes of a man (B), a hand (C).

In A Drake's renderer draws the silhouettes. Each is of one view; the root's place is known.
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
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import demo_settings, stored_scene
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.papers.tables import (
    Count,
    Figures,
    figure_table,
    require_counts,
    spread_over_seeds,
    uncounted,
)
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ExactSearchSettings,
    ExaminationSettings,
    GridPoseSet,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    PoseEstimate,
    PoseSearch,
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
"""The figures of experiment A, section 6.1. The paper states no seconds."""

METHODS: Mapping[Literal["paper", "beam"], str] = {
    "paper": "the paper's method",
    "beam": "multi-start search",
}
"""What experiments B and C compare, and what tables call it."""


class Causes(NamedTuple):
    """Why a silhouette does not tell a wrong pose from the true one (6.1); both may hold.

    Neither holds where a segment turns about its own axis.

    Attributes:
        hidden: a segment whose angles are wrong is hidden in both poses: the paper's occlusion.
        inner_edges: edges inside the silhouette differ.
    """

    hidden: bool
    inner_edges: bool


@dataclass(frozen=True)
class RandomPose:
    """One pose of experiment A, and what the search makes of its silhouettes.

    Args:
        true_values: the values drawn, one array for each node [rad or m].
        inside: whether the whole body is inside the picture.
        seconds: processor time of the search.
        more_seconds: processor time of proof and modes, or of intervals.
        tolerance: a silhouette is matched exactly that differs by no more [pixel].
        causes: on the grid, why angles are wrong though the silhouette is matched exactly.
    """

    true_values: tuple[np.ndarray, ...]
    inside: bool
    result: PoseEstimate
    seconds: float
    more_seconds: float = 0.0
    tolerance: float = 0.0
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
    """All poses of experiment A, and how they were made; see run_experiment."""

    trials: tuple[RandomPose, ...]
    cameras: tuple[ParallelCamera, ...]
    search: PoseSearch
    seed: int

    def view(self, trial: RandomPose) -> View:
        """The silhouette that the first camera sees of the true pose."""
        tree, camera = self.search.tree, self.cameras[0]
        pose = tree.positions_from(trial.true_values)
        return View(camera, LabelRenderer(tree.model, camera).mask(*pose))


def experiment_camera(angle: float = 0.0) -> ParallelCamera:
    """The paper's camera: 700 x 700, parallel, 2.26 pixels a centimetre, the head right above.

    The angle [rad] turns the camera about the body's upright axis, to the body's left.
    """
    turn, X_WC = np.eye(4), np.eye(4)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    # World x faces the camera (the way the body looks), y is the picture's right, z its up.
    X_WC[:3] = [[0.0, 0.0, -1.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]]
    name = f"turned_{round(math.degrees(angle))}"
    # Arms reach about as far above the head's joint as the legs reach below when the trunk leans:
    # with this principal point few bodies leave the picture.
    return ParallelCamera(name, 700, 700, 226.0, 349.5, 260.0, turn @ X_WC)


def experiment_search(
    outside_limit: float = 200.0, candidate_limit: int = 5, interval_deg: float = 20.0
) -> PaperSearch:
    """The paper's search for its female body: root = head, r [pixel], K and the interval [deg]."""
    settings = PaperSearchSettings(
        interval=math.radians(interval_deg),
        outside_limit=outside_limit,
        candidate_limit=candidate_limit,
    )
    return PaperSearch(experiment_tree(), settings)


def beam_experiment_search(interval_deg: float = 20.0) -> BeamSearch:
    """The beam search for the same body, which needs no threshold r."""
    settings = BeamSearchSettings(interval=math.radians(interval_deg))
    return BeamSearch(experiment_tree(), settings)


def experiment_tree() -> PoseTree:
    """The female body's pose tree; the head is the root, and stands in the world's origin."""
    return load_model(bundled_model("woman")).pose_tree(root_position=np.zeros(3))


def draw_values(
    search: PoseSearch, angles: str, generator: np.random.Generator
) -> list[np.ndarray]:
    """Draw every node's values [rad or m]: on the search's "grid" or "continuous" in its limits."""
    values = []
    tree = search.tree
    lower, upper = tree.model.lower, tree.model.upper
    for i, node in enumerate(tree.nodes):
        grid = search.sampled.values[i]
        drawn = grid[generator.integers(len(grid))].copy()
        if angles == "continuous":
            # A position with one grid value only is known, not searched.
            moving = np.ptp(grid, axis=0) > 0
            indices = np.array(node.positions, dtype=np.int64)
            uniform = generator.uniform(lower[indices], upper[indices])
            drawn[moving] = uniform[moving]
        values.append(drawn)
    return values


def run_experiment(
    search: PoseSearch,
    images: int = 219,
    seed: int = 0,
    count: Count = uncounted,
    views: int = 1,
) -> RandomPoses:
    """Draw poses, on the grid as the paper's or for a continuous search between, and match them.

    Args:
        search: of ``experiment_search``, ``beam_experiment_search``, or a ``MultiStartSearch``
            of ``experiment_tree``.
        images: how many poses; the paper has 219.
        seed: of the random angles.
        views: how many cameras see each pose, 180 degrees / views apart: a silhouette from behind
            is the mirror image of that from before and says nothing new.

    Raises:
        SettingsError: if ``images`` or ``views`` is below 1.
    """
    require_counts(images=images, views=views)
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
        seen = [
            View(camera, renderer.mask(*pose))
            for camera, renderer in zip(cameras, renderers, strict=True)
        ]
        tolerance = renderer_tolerance(seen)
        start = time.process_time()
        result = search.match(seen)
        seconds, more, causes = time.process_time() - start, 0.0, None
        if is_continuous:
            # The search tells its own times by the clock.
            more = result.interval_seconds
            more *= seconds / max(result.seconds, 1e-9)
            seconds -= more
        if isinstance(search, BeamSearch):
            # Tighter limits on time would make the figures those of one machine.
            limits = ExaminationSettings(
                proof_time_limit=60.0,
                mode_time_limit=60.0,
                proof_poses=1_000_000,
                mode_poses=100_000,
            )
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
    """Why a pose is not told from another that has the same silhouette, by its nodes' values.

    Fewer pixels than `unseen` of a segment, or of a difference, are not seen.
    """
    nodes = len(sampled.tree.nodes)
    images = [
        draw_labels(
            sampled.surfaces.at(values),
            range(1, 1 + nodes),
            camera.X_CW @ sampled.tree.node_poses(values),
            camera,
        )
        for values in (true_values, found_values)
    ]
    seen = np.max([np.bincount(one.ravel(), minlength=1 + nodes)[1:] for one in images], axis=0)
    pairs = zip(true_values, found_values, strict=True)
    wrong = [not np.allclose(true, found, atol=1e-4) for true, found in pairs]
    hidden = bool((seen[wrong] < unseen).any())
    return Causes(hidden, bool((images[0] != images[1]).sum() >= unseen))


def grid_figures(*runs: RandomPoses) -> dict[str, Any]:
    """The figures under the names of ``PAPER``; of runs with several seeds, the spread, too.

    E_total is over the silhouettes for which a pose was found; ``not_found`` counts the others.
    """
    every = [_grid_figures(run) for run in runs]
    if len(runs) == 1:
        return every[0]
    no_outcome = ("images", "seed", "total_seconds", "tolerance")
    return {**every[0], "spread": spread_over_seeds(every, no_outcome)}


def _grid_figures(result: RandomPoses) -> dict[str, Any]:
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
        "total_seconds": float(np.sum(seconds)),
        "not_found": len(trials) - len(E_total),
        "stopped_by_run_limit": sum(one.stopped_by == "run_limit" for one in found),
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
        # None can be told from one that is matched within what renderers differ by.
        "proved": sum(trial.exact or trial.result.proved_optimal for trial in trials),
        "exact_inside": sum(trial.exact for trial in trials if trial.inside),
        "truth_in_set": sum(named),
        "budget_spent": sum(one.budget_spent for one in found),
        "complete_sets": sum(one.complete for one in known),
        "several_modes": sum(one.mode_count > 1 for one in known),
        "free_joints": sum(not all(one.determined) for one in known),
        "examination_median_seconds": float(np.median([trial.more_seconds for trial in trials])),
    }


def grid_table(columns: Sequence[Sequence[RandomPoses]]) -> Table:
    """The paper's figures and those of some searches, for each its runs, one for each seed."""
    rows = {
        "images": ("silhouettes", "{}"),
        "tolerance": ("  equal within [pixel]", "{:.0f}"),
        "not_found": ("  no pose found", "{}"),
        "mean_e_total": ("mean E_total of the others", "{:.2%}"),
        "exact": ("matched within the tolerance", "{}"),
        "pose_equal": ("of these, every joint angle right", "{}"),
        "wrong_hidden": ("  else: a wrong segment is hidden", "{}"),
        "wrong_inner_edges": ("  else: edges inside differ", "{}"),
        "wrong_alike": ("  else: neither", "{}"),
        "improved": ("improved by re-estimation", "{}"),
        "mean_runs": ("runs of step 3, mean", "{:.1f}"),
        "mean_runs_without_worst_seven": ("  mean without the worst seven", "{:.1f}"),
        "min_runs": ("  minimum", "{}"),
        "median_seconds": ("processor seconds an image, median", "{:.3f}"),
        "p95_seconds": ("  95th percentile", "{:.3f}"),
        "leaving_the_picture": ("bodies that leave the picture", "{}"),
        "exact_inside": ("matched, of those that do not", "{}"),
        "proved": ("proved: so matched, or the best of the grid", "{}"),
        "budget_spent": ("proof or set ended by its time or memory", "{}"),
        "truth_in_set": ("true pose in the set of poses as good", "{}"),
        "complete_sets": ("sets that are complete", "{}"),
        "several_modes": ("silhouettes with several modes of poses", "{}"),
        "free_joints": ("silhouettes that leave a joint free", "{}"),
        "examination_median_seconds": ("seconds for proof and set, median", "{:.3f}"),
    }
    shown: dict[str, Any] = {"paper": PAPER}
    for runs in columns:
        figures = [_grid_figures(run) for run in runs]
        if figures[0]["method"] == "beam":
            # The runs of the beam search are other steps than the paper's.
            own = rows.keys() - {
                "improved", "mean_runs", "mean_runs_without_worst_seven", "min_runs"
            }  # fmt: skip
            shown["beam search"] = [{key: one[key] for key in own} for one in figures]
        else:
            shown["the paper's method"] = figures
    return figure_table("Kameda, experiment A: one silhouette of a female body", rows, shown)


def continuous_figures(result: RandomPoses) -> dict[str, Any]:
    """The figures: ratios as fractions, errors in degrees, seconds of the processor."""
    search = result.search
    assert isinstance(search, MultiStartSearch)
    # Positions that the experiment holds have next to no span [rad or m].
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
        "interval_confidence": ExactSearchSettings.confidence,
        "median_seconds": float(np.median([trial.seconds for trial in result.trials])),
        "mean_seconds": float(np.mean([trial.seconds for trial in result.trials])),
        "mean_interval_seconds": float(np.mean([trial.more_seconds for trial in result.trials])),
        "seed": result.seed,
        "angles": "continuous",
    }


def continuous_table(result: RandomPoses) -> Table:
    """The figures of ``continuous_figures``."""
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
    figures = {"continuous search": continuous_figures(result)}
    return figure_table("Kameda, experiment A with continuous angles", rows, figures)


class RealPictures(NamedTuple):
    """Experiment B or C: a stored scene, and the bundled model of another person."""

    title: str
    scene: str
    model: str
    paper_images: int
    paper_E_total: float

    def settings(self, scene: Path) -> EstimateSettings:
        """For a copy of the scene: where the body's root is, and how far it may turn."""
        if self.model == "man":
            return demo_settings(scene)
        # The forearm points up in the pictures, by 30 degrees; the hand may show either side.
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
    """Search the poses in stored pictures with each of METHODS, each picture for itself.

    The paper's method has samples every 10 degrees, the multi-start search continuous angles.

    Args:
        experiment: "B" or "C".
        images: how many, the first ones; None: all.
        out: folder for the poses and overlays of each method; None writes nothing.

    Returns:
        The figures by method; mean E_total is over the pictures in which a pose was found.

    Raises:
        OutputError: the folder is not empty or cannot be written.
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
    """The paper's figures and those of each method, side by side; E_total of every picture."""
    first = next(iter(figures.values()))
    rows = {
        "images": ("silhouettes", "{}"),
        "not_found": ("  no pose found", "{}"),
        "mean_e_total": ("mean E_total of the others", "{:.1%}"),
        **{name: (f"  {name}", "{:.1%}") for name in first["e_total"]},
        "seconds_an_image": ("processor seconds an image", "{:.1f}"),
    }
    paper = {"images": first["paper_images"], "mean_e_total": first["paper_mean_e_total"]}
    every = {name: figures[method] for method, name in METHODS.items()}
    columns = {name: {**one, **one["e_total"]} for name, one in every.items()}
    pictures = REAL_EXPERIMENTS[first["experiment"]]
    title = f"Kameda, experiment {first['experiment']}: {pictures.title}"
    return figure_table(title, rows, {"paper": paper, **columns})
