"""Kameda's experiment A: random poses of the female body, matched by one silhouette each."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SettingsError
from drake_pose.papers.kameda.causes import Causes, causes_of_wrong_angles
from drake_pose.search.estimates import PoseEstimate, View
from drake_pose.search.grid.beam.search import BeamSearch
from drake_pose.search.grid.families.examination import ExaminationSettings, examine
from drake_pose.search.grid.families.search import GridPoseSet
from drake_pose.search.grid.settings import BeamSearchSettings
from drake_pose.search.kameda.search import PaperSearch
from drake_pose.search.scoring import PoseSearch
from drake_pose.search.settings import PaperSearchSettings
from drake_pose.silhouette.areas.scoring import draw_mask

PAPER_IMAGES = 219
PAPER: dict[str, float | int | str] = {
    "images": PAPER_IMAGES,
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
"""The figures of section 6.1. The paper states no seconds."""

# World x faces the camera (the way the body looks), y is the picture's right, z its up.
_R_WC = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_SIDE = 700
_PIXELS_PER_METRE = 226.0
# Where the head's joint is seen: arms reach about as far above it as the legs reach below when
# the trunk leans, so that few bodies leave the picture.
_ROOT_PIXEL = (349.5, 260.0)
_DISTANCE = 5.0
# Tighter limits on time would make the figures those of one machine.
_EXAMINATION = ExaminationSettings(
    proof_time_limit=60.0, family_time_limit=60.0, proof_poses=1_000_000, family_poses=100_000
)


@dataclass(frozen=True)
class Trial:
    """One image of the experiment.

    Args:
        true_values: the angles drawn, one array for each node [rad].
        inside: whether the whole body is inside the picture.
        result: what the search found.
        pose_equal: whether the silhouette is matched exactly and every angle is the true one.
        seconds: of the processor for the search.
        examination_seconds: of the processor for proof and families; 0 if there were none.
        truth_in_set: whether the true pose is one of those that the answer names; None if the
            answer is one pose.
        causes: why angles are wrong where the silhouette is matched exactly; else None.
    """

    true_values: tuple[np.ndarray, ...]
    inside: bool
    result: PoseEstimate
    pose_equal: bool
    seconds: float
    examination_seconds: float = 0.0
    truth_in_set: bool | None = None
    causes: Causes | None = None

    @property
    def E_total(self) -> float:
        """E_total (9); nan where no pose was found."""
        return self.result.E_total if self.result.found else math.nan

    @property
    def exact(self) -> bool:
        """Whether J = 0."""
        return self.result.found and self.result.J == 0


@dataclass(frozen=True)
class ExperimentResult:
    """All images of the experiment, and how they were made."""

    trials: tuple[Trial, ...]
    camera: ParallelCamera
    search: PoseSearch
    seed: int

    def as_json(self) -> dict[str, float | int | str]:
        """The figures under the names of ``PAPER``, counts and fractions as there.

        E_total is over the silhouettes for which a pose was found; ``not_found`` counts the others.
        """
        E_total = [trial.E_total for trial in self.trials if trial.result.found]
        runs = np.sort([trial.result.statistics.runs for trial in self.trials])
        seconds = [trial.seconds for trial in self.trials]
        improved = [
            t.result.found and t.result.E_total < t.result.first_E_total for t in self.trials
        ]
        causes = [trial.causes for trial in self.trials if trial.causes is not None]
        figures: dict[str, float | int | str] = {
            "images": len(self.trials),
            "mean_e_total": float(np.mean(E_total)) if E_total else math.nan,
            "exact": sum(trial.exact for trial in self.trials),
            "pose_equal": sum(trial.pose_equal for trial in self.trials),
            "wrong_hidden": sum(one.hidden for one in causes),
            "wrong_inner_edges": sum(one.inner_edges for one in causes),
            "wrong_alike": sum(not (one.hidden or one.inner_edges) for one in causes),
            "improved": int(sum(improved)),
            "mean_runs": float(np.mean(runs)),
            "mean_runs_without_worst_seven": float(np.mean(runs[:-7] if len(runs) > 7 else runs)),
            "min_runs": int(runs[0]),
            "median_seconds": float(np.median(seconds)),
            "p95_seconds": float(np.quantile(seconds, 0.95)),
            "total_seconds": float(np.sum(seconds)),
            "not_found": sum(not trial.result.found for trial in self.trials),
            "stopped_by_run_limit": sum(t.result.stopped_by == "run_limit" for t in self.trials),
            "leaving_the_picture": sum(not trial.inside for trial in self.trials),
            "seed": self.seed,
            "angles": "grid",
            "method": "beam",
        }
        if isinstance(self.search, PaperSearch):
            figures["method"] = "paper"
            figures["outside_weight"] = self.search.settings.outside_weight
        return figures | self._set_figures()

    def _set_figures(self) -> dict[str, float | int | str]:
        """Figures of the answers' proofs and sets; none where the answers are single poses."""
        sets = [one.result.pose_set for one in self.trials if one.result.pose_set is not None]
        if not sets:
            return {}
        inside = [trial for trial in self.trials if trial.inside]
        seconds = [trial.examination_seconds for trial in self.trials]
        return {
            "proved": sum(trial.result.proved_optimal for trial in self.trials),
            "exact_inside": sum(trial.exact for trial in inside),
            "truth_in_set": sum(bool(trial.truth_in_set) for trial in self.trials),
            "budget_spent": sum(trial.result.budget_spent for trial in self.trials),
            "complete_sets": sum(answer.complete for answer in sets),
            "several_families": sum(answer.family_count > 1 for answer in sets),
            "free_joints": sum(not all(answer.determined) for answer in sets),
            "examination_median_seconds": float(np.median(seconds)),
        }


def experiment_camera() -> ParallelCamera:
    """The paper's camera: 700 x 700, parallel, 2.26 pixels a centimetre.

    The world's origin, where the head's joint is, lies right above the picture's middle.
    """
    X_WC = np.eye(4)
    X_WC[:3, :3] = _R_WC
    X_WC[:3, 3] = [_DISTANCE, 0.0, 0.0]
    return ParallelCamera(
        name="front",
        width=_SIDE,
        height=_SIDE,
        pixels_per_metre=_PIXELS_PER_METRE,
        center_x=_ROOT_PIXEL[0],
        center_y=_ROOT_PIXEL[1],
        X_WC=X_WC,
    )


def side_camera() -> ParallelCamera:
    """The same camera where it sees the body's left side, for pictures."""
    camera = experiment_camera()
    turn = np.eye(4)
    turn[:2, :2] = [[0.0, -1.0], [1.0, 0.0]]
    return replace(camera, name="side", X_WC=turn @ camera.X_WC)


def experiment_search(
    outside_limit: float = 200.0,
    candidate_limit: int = 5,
    interval_deg: float = 20.0,
    outside_weight: float = 0.0,
) -> PaperSearch:
    """The paper's search for its female body: root = head, r = 200 pixels, K = 5, 20 degrees.

    Args:
        outside_limit: r [pixel].
        candidate_limit: K.
        interval_deg: of all angles [deg].
        outside_weight: 0 is what the paper writes; with 10 most of its figures are met.
    """
    settings = PaperSearchSettings(
        interval=math.radians(interval_deg),
        outside_limit=outside_limit,
        candidate_limit=candidate_limit,
        outside_weight=outside_weight,
    )
    return PaperSearch(_experiment_tree(), settings)


def beam_experiment_search(interval_deg: float = 20.0) -> BeamSearch:
    """The beam search for the same body, which needs no threshold r."""
    settings = BeamSearchSettings(interval=math.radians(interval_deg))
    return BeamSearch(_experiment_tree(), settings)


def _experiment_tree() -> PoseTree:
    return load_model(bundled_model("woman")).pose_tree(root_position=np.zeros(3))


def draw_values(
    search: PoseSearch, angles: str, generator: np.random.Generator
) -> list[np.ndarray]:
    """Draw every node's angles at random.

    Args:
        search: gives the pose tree and its sampling grid.
        angles: "grid": from the grid, as the paper; "continuous": anywhere inside the limits.
        generator: the source of chance.

    Returns:
        One array of values for each node [rad or m].
    """
    values = []
    tree = search.tree
    lower, upper = tree.model.lower, tree.model.upper
    for i, node in enumerate(tree.nodes):
        grid = search.sampled.values[i]
        drawn = grid[generator.integers(len(grid))].copy()
        if angles == "continuous":
            # A position with one grid value only is known, not searched.
            moving = np.ptp(grid, axis=0) > 0
            indices = np.array(node.positions)
            uniform = generator.uniform(lower[indices], upper[indices])
            drawn[moving] = uniform[moving]
        values.append(drawn)
    return values


def run_experiment(
    search: PoseSearch,
    images: int = PAPER_IMAGES,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> ExperimentResult:
    """Draw silhouettes of poses of the grid, as the paper's experiment A does, and match them.

    Args:
        search: the search, of ``experiment_search`` or ``beam_experiment_search``.
        images: how many; the paper's 219 if not given.
        seed: of the random angles.
        progress: called with the number of images done after each.

    Raises:
        SettingsError: if ``images`` is below 1.
    """
    if images < 1:
        raise SettingsError(f"images must be 1 or more, not {images}")
    camera = experiment_camera()
    generator = np.random.default_rng(seed)
    trials = []
    for done in range(1, images + 1):
        values = draw_values(search, "grid", generator)
        trials.append(_match_one(search, camera, values))
        if progress is not None:
            progress(done)
    return ExperimentResult(tuple(trials), camera, search, seed)


def _match_one(search: PoseSearch, camera: ParallelCamera, values: list[np.ndarray]) -> Trial:
    X_CN = camera.X_CW @ search.tree.node_poses(values)
    outlines = search.sampled.surfaces.at(values)
    mask = draw_mask(outlines, X_CN, camera)
    wide = ParallelCamera(
        name="wide",
        width=3 * _SIDE,
        height=3 * _SIDE,
        pixels_per_metre=_PIXELS_PER_METRE,
        center_x=camera.center_x + _SIDE,
        center_y=camera.center_y + _SIDE,
        X_WC=camera.X_WC,
    )
    inside = int(draw_mask(outlines, X_CN, wide).sum()) == int(mask.sum())
    view = View(camera, mask)
    start = time.process_time()
    result = search.match([view])
    seconds = time.process_time() - start
    equal = result.found and result.J == 0
    equal = equal and all(
        np.allclose(found, true, atol=math.radians(0.01))
        for found, true in zip(result.node_values, values, strict=True)
    )
    causes = None
    if result.found and result.J == 0 and not equal:
        causes = causes_of_wrong_angles(search.sampled, camera, values, result.node_values)
    trial = Trial(tuple(values), inside, result, bool(equal), seconds, causes=causes)
    return _examined(trial, search, view) if isinstance(search, BeamSearch) else trial


def _examined(trial: Trial, search: BeamSearch, view: View) -> Trial:
    """The trial with proof and families, which the seconds of the search leave out."""
    start = time.process_time()
    result = examine(search.body, [view], trial.result, _EXAMINATION)
    seconds = time.process_time() - start
    answer = result.pose_set
    held = answer.contains(trial.true_values) if isinstance(answer, GridPoseSet) else None
    return replace(trial, result=result, examination_seconds=seconds, truth_in_set=held)
