"""How well the recorded robot arm is estimated; run as a program, it prints the figures.

python -m tests.jobs.arm_figures ../shared/data/arm_two_views
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drake_pose.jobs.estimate.inputs import Inputs, read_inputs
from drake_pose.results.settings import EstimateSettings
from drake_pose.search.estimates import View
from drake_pose.search.scoring import Scoring

BASE, WRIST = slice(0, 4), slice(4, 7)


@dataclass(frozen=True)
class ArmFigures:
    """One frame of the arm, of seven joints in one chain.

    Args:
        frame: its name.
        errors: (7,) from the encoders' angles, or from a flip of them, whichever is nearer [deg].
        excess: E_total in each view above that at the encoders' angles.
        held: (7,) which joints' intervals hold the encoders' angles, of the family that holds most.
        determined: (7,) whether the joint is said to be.
        families: how many there are.
        seconds: CPU time of the match [s].
    """

    frame: str
    errors: np.ndarray
    excess: np.ndarray
    held: np.ndarray
    determined: tuple[bool, ...]
    families: int
    seconds: float

    def __str__(self) -> str:
        known = "".join("D" if one else "F" for one in self.determined)
        return (
            f"{self.frame}: errors {np.round(self.errors, 1)} deg, E_total above the encoders' "
            f"{np.round(self.excess, 3)}, {self.families} families, joints {known}, "
            f"encoders inside of {self.held.sum()} joints' intervals, {self.seconds:.1f} s"
        )


def measure_arm(scene: Path) -> Iterator[ArmFigures]:
    """Estimate each frame with the default options."""
    inputs = read_inputs(scene, scene / "med7" / "med7.urdf", EstimateSettings(), None)
    for frame in inputs.frames:
        yield _measure(inputs, frame)


def _measure(inputs: Inputs, frame: str) -> ArmFigures:
    views = [
        View(camera, inputs.scene.read(camera.name, frame))
        for camera in inputs.cameras
        if (camera.name, frame) in inputs.scene.masks
    ]
    assert inputs.truth is not None
    truth = inputs.truth.of(frame)
    assert truth is not None
    start = time.process_time()
    result = inputs.search.match(views)
    seconds = time.process_time() - start
    found = np.concatenate(result.node_values)
    turns = [(one - truth + np.pi) % (2.0 * np.pi) - np.pi for one in flipped_arms(found)]
    best = min(turns, key=lambda turn: (np.abs(turn[BASE]).sum(), np.abs(turn).sum()))
    answer = result.pose_set
    assert answer is not None
    held = [
        [joint.holds(float(value)) for joint, value in zip(family.joints, truth, strict=True)]
        for family in answer.families
    ]
    return ArmFigures(
        frame=frame,
        errors=np.degrees(np.abs(best)),
        excess=_errors(inputs, views, found) - _errors(inputs, views, truth),
        held=np.array(max(held, key=sum)),
        determined=answer.determined,
        families=answer.family_count,
        seconds=seconds,
    )


def flipped_arms(values: np.ndarray) -> Iterator[np.ndarray]:
    """The same arm's other angles: A1 + 180, -A2, A3 + 180, and so on up the chain."""
    for chosen in itertools.product((False, True), repeat=3):
        flipped = values.copy()
        for k in np.flatnonzero(chosen):
            flipped[2 * k] += np.pi
            flipped[2 * k + 1] *= -1.0
            flipped[2 * k + 2] += np.pi
        yield flipped


def _by_node(inputs: Inputs, values: np.ndarray) -> list[np.ndarray]:
    counts = [len(node.value_names) for node in inputs.search.tree.nodes]
    return np.split(values, np.cumsum(counts)[:-1])


def _errors(inputs: Inputs, views: list[View], values: np.ndarray) -> np.ndarray:
    """E_total in each view alone."""
    X_WN = inputs.search.tree.node_poses(_by_node(inputs, values))[None]
    return np.array(
        [Scoring(inputs.search.sampled, [view]).J(X_WN)[0] / view.mask.sum() for view in views]
    )


def main() -> None:
    """Print all figures and their summary."""
    figures = []
    for one in measure_arm(Path(sys.argv[1])):
        figures.append(one)
        print(one, flush=True)
    base = np.array([one.errors[BASE] for one in figures])
    print(
        f"found {sum((one.excess <= 0.03).all() for one in figures)} of {len(figures)}, "
        f"A1-A4 {np.median(base):.2f} deg in the median, {base.max():.1f} at most, encoders inside "
        f"{np.mean([one.held for one in figures]):.0%} of intervals, "
        f"{np.median([one.seconds for one in figures]):.1f} s"
    )


if __name__ == "__main__":
    main()
