"""Kameda's experiment A: random poses of the female body, matched by their silhouettes.

In a diagram: positions -> plant -> RgbdSensor (Drake's VTK renderer) -> SilhouetteMatcher.
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import Camera, ParallelCamera
from drake_pose.papers.tables import Count, require_counts, uncounted
from drake_pose.search import (
    BeamSearch,
    BeamSearchSettings,
    ContinuousSearch,
    ExaminationSettings,
    PaperSearch,
    PaperSearchSettings,
    PoseEstimate,
    PoseSearch,
    SampledTree,
    View,
    examine,
    renderer_tolerance,
)
from drake_pose.silhouette.areas.outline import Outline
from drake_pose.silhouette.areas.scoring import draw_labels, draw_mask
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.systems.bodies import held_positions
from drake_pose.systems.diagrams import build_simulated_matching
from drake_pose.systems.ports import camera_port

Renderer = Literal["drake", "own"]
"""Who draws the silhouettes: Drake's VTK renderer, or the code that scores them."""

PAPER_IMAGES = 219
WIDTH_MISMATCH, OFFSET_MISMATCH = 0.08, 0.03
"""How far widths and joints' offsets of another body differ from the model's."""

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
# So few pixels of a segment, or of a difference, are not seen.
_UNSEEN = 20


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
class Trial:
    """One pose of the experiment.

    Args:
        true_values: the values drawn, one array for each node [rad or m].
        inside: whether the whole body is inside the picture.
        seconds: of the processor for the search.
        more_seconds: of the processor for proof and families, or for intervals.
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
class ExperimentResult:
    """All poses of the experiment, and how they were made; see run_experiment."""

    trials: tuple[Trial, ...]
    cameras: tuple[ParallelCamera, ...]
    search: PoseSearch
    seed: int
    mismatch: bool
    renderer: Renderer

    def view(self, trial: Trial) -> View:
        """The silhouette that the first camera sees of the true pose."""
        if self.renderer == "own":
            return _draw_views(self.search, self.cameras[:1], trial.true_values)[0]
        tree, camera = self.search.tree, self.cameras[0]
        pose = tree.positions_from(trial.true_values)
        return View(camera, LabelRenderer(tree.model, camera).mask(*pose))


def experiment_camera(angle: float = 0.0, body_scale: float = 1.0) -> ParallelCamera:
    """The paper's camera: 700 x 700, parallel, 2.26 pixels a centimetre, the head right above.

    The angle [rad] turns the camera about the body's upright axis, to the body's left. A body of
    another scale is seen by a camera of that scale.
    """
    turn, X_WC = np.eye(4), np.eye(4)
    turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    X_WC[:3, :3] = _R_WC
    X_WC[:3, 3] = [_DISTANCE, 0.0, 0.0]
    name = f"turned_{round(math.degrees(angle))}"
    scale = body_scale * _PIXELS_PER_METRE
    return ParallelCamera(name, _SIDE, _SIDE, scale, *_ROOT_PIXEL, turn @ X_WC)


def experiment_search(
    outside_limit: float = 200.0,
    candidate_limit: int = 5,
    interval_deg: float = 20.0,
    outside_weight: float = 0.0,
) -> PaperSearch:
    """The paper's search for its female body: root = head, r [pixel], K and the interval [deg].

    An outside weight of 0 is what the paper writes; with 10 most of its figures are met.
    """
    settings = PaperSearchSettings(
        interval=math.radians(interval_deg),
        outside_limit=outside_limit,
        candidate_limit=candidate_limit,
        outside_weight=outside_weight,
    )
    return PaperSearch(_tree(), settings)


def beam_experiment_search(interval_deg: float = 20.0, renderer: Renderer = "drake") -> BeamSearch:
    """The beam search for the same body, which needs no threshold r."""
    tolerance = None if renderer == "drake" else 0.0
    settings = BeamSearchSettings(interval=math.radians(interval_deg), tolerance=tolerance)
    return BeamSearch(_tree(), settings)


def continuous_search() -> ContinuousSearch:
    """The search for the same body with angles between the samples."""
    return ContinuousSearch(_tree())


def _tree() -> PoseTree:
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
    images: int = PAPER_IMAGES,
    seed: int = 0,
    count: Count = uncounted,
    views: int = 1,
    mismatch: bool = False,
    renderer: Renderer = "drake",
    body_scale: float = 1.0,
) -> ExperimentResult:
    """Draw poses, on the grid as the paper's or for a continuous search between, and match them.

    Args:
        search: of ``experiment_search``, ``beam_experiment_search`` or ``continuous_search``.
        images: how many poses.
        seed: of the random angles; with a mismatch, too, the angles are those of this seed.
        views: how many cameras see each pose, 180 degrees / views apart: a silhouette from behind
            is the mirror image of that from before and says nothing new.
        mismatch: whether the body in the pictures has other widths and joints than the model; such
            a body is drawn by the code that scores it.
        renderer: who draws the silhouettes.
        body_scale: of the body; with 0.84 its segments have the mean area of the paper's.

    Raises:
        SettingsError: if ``images`` or ``views`` is below 1.
    """
    require_counts(images=images, views=views)
    cameras = tuple(experiment_camera(math.pi * k / views, body_scale) for k in range(views))
    angles = "continuous" if isinstance(search, ContinuousSearch) else "grid"
    generator, other_generator = np.random.default_rng(seed), np.random.default_rng([seed, 1])
    name = "paper" if isinstance(search, PaperSearch) else angles
    advance = count(f"silhouettes, {name}{', another body' if mismatch else ''}", images)
    renderer = "own" if mismatch else renderer
    drawn = [draw_values(search, angles, generator) for _ in range(images)]
    wide = replace(
        cameras[0],
        width=3 * _SIDE,
        height=3 * _SIDE,
        center_x=cameras[0].center_x + _SIDE,
        center_y=cameras[0].center_y + _SIDE,
    )
    timed = _TimedSearch(search)
    simulated = _simulate(timed, cameras, drawn) if renderer == "drake" else None
    trials = []
    for values in drawn:
        changed = other_generator if mismatch else None
        drawn_for = (wide,) if simulated else (*cameras, wide)
        *seen, whole = _draw_views(search, drawn_for, values, changed)
        if simulated is None:
            tolerance, answer = 0.0, timed.match(seen)
        else:
            seen, answer = next(simulated)
            tolerance = renderer_tolerance(seen)
        lost = np.count_nonzero(whole.mask) - np.count_nonzero(seen[0].mask)
        trials.append(
            _judge(timed, seen, tuple(values), answer, bool(lost <= tolerance), tolerance)
        )
        advance(len(trials))
    return ExperimentResult(tuple(trials), cameras, search, seed, mismatch, renderer)


class _TimedSearch:
    """A search that keeps how long its last match took; of the processor [s]."""

    def __init__(self, search: PoseSearch) -> None:
        self.search, self.tree, self.sampled, self.seconds = (
            search,
            search.tree,
            search.sampled,
            0.0,
        )

    def match(self, views: Sequence[View], root_position: np.ndarray | None = None) -> PoseEstimate:
        """As the search's own."""
        start = time.process_time()
        result = self.search.match(views, root_position)
        self.seconds = time.process_time() - start
        return result


def _draw_views(
    search: PoseSearch,
    cameras: Sequence[Camera],
    values: Sequence[np.ndarray],
    mismatch: np.random.Generator | None = None,
) -> list[View]:
    """What the code that scores draws of a pose, the values of each node; of a changed body."""
    X_WN, outlines = search.tree.node_poses(values), search.sampled.surfaces.at(values)
    if mismatch is not None:
        X_WN, outlines = change_body(search.tree, X_WN, outlines, mismatch)
    return [View(one, draw_mask(outlines, one.X_CW @ X_WN, one)) for one in cameras]


def _simulate(
    search: PoseSearch, cameras: Sequence[Camera], drawn: Sequence[Sequence[np.ndarray]]
) -> Iterator[tuple[list[View], PoseEstimate]]:
    """What Drake's sensors see of poses, one a second, and what the matcher answers."""
    q = np.array([search.tree.positions_from(values)[0] for values in drawn])
    simulated = build_simulated_matching(search, cameras, held_positions(q, 1.0), period=1.0)
    simulator = Simulator(simulated.diagram)
    matcher = simulated.matcher
    ports = [matcher.GetInputPort(camera_port("label_image", one, cameras)) for one in cameras]
    for k in range(len(q)):
        simulator.AdvanceTo(float(k))
        # The images of this time, which the next update uses.
        context = matcher.GetMyContextFromRoot(simulator.get_context())
        views = [
            View(camera, label_image_to_mask(port.Eval(context)))
            for camera, port in zip(cameras, ports, strict=True)
        ]
        simulator.AdvanceTo(k + 0.25)
        answer = simulated.estimate(simulator.get_context())
        assert answer is not None, "the head is in every picture"
        yield views, answer


def _judge(
    timed: _TimedSearch,
    views: Sequence[View],
    values: tuple[np.ndarray, ...],
    result: PoseEstimate,
    inside: bool,
    tolerance: float,
) -> Trial:
    search, seconds = timed.search, timed.seconds
    if isinstance(search, ContinuousSearch):
        more = result.statistics.interval_seconds
        more *= seconds / max(result.seconds + more, 1e-9)
        return Trial(values, inside, result, seconds - more, more, tolerance)
    more, causes = 0.0, None
    if isinstance(search, BeamSearch):
        start = time.process_time()
        result = examine(search.body, views, result, _EXAMINATION)
        more = time.process_time() - start
    if result.found and result.J <= tolerance:
        pairs = zip(result.node_values, values, strict=True)
        if not all(np.allclose(one, true, atol=math.radians(0.01)) for one, true in pairs):
            found = result.node_values
            causes = causes_of_wrong_angles(search.sampled, views[0].camera, values, found)
    return Trial(values, inside, result, seconds, more, tolerance, causes)


def causes_of_wrong_angles(
    sampled: SampledTree,
    camera: Camera,
    true_values: Sequence[np.ndarray],
    found_values: Sequence[np.ndarray],
) -> Causes:
    """Why a pose is not told from another that has the same silhouette, by its nodes' values."""
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
    hidden = bool((seen[wrong] < _UNSEEN).any())
    return Causes(hidden, bool((images[0] != images[1]).sum() >= _UNSEEN))


def change_body(
    tree: PoseTree, X_WN: np.ndarray, outlines: list[Outline], generator: np.random.Generator
) -> tuple[np.ndarray, list[Outline]]:
    """The poses (nodes, 4, 4) and surfaces of a body of other measures in the same pose X_WN.

    Widths across the longest axis vary by WIDTH_MISMATCH, joints' offsets by OFFSET_MISMATCH.
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
