"""Kameda's experiments B and C: real silhouettes, one view each, the root's place known."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from rich.table import Table

from drake_pose.body.files.packages import bundled_model
from drake_pose.jobs.demo import demo_settings, stored_scene
from drake_pose.jobs.estimate.scene import SceneEstimate, estimate_scene
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import FrameRecord
from drake_pose.silhouette.pictures.scenes import load_scene

Method = Literal["paper", "beam"]
METHODS: Mapping[Method, str] = {"paper": "the paper's method", "beam": "multi-start search"}
"""What is compared, and what tables call it."""


@dataclass(frozen=True)
class RealPictures:
    """What one of the experiments is made of.

    Args:
        title: what is seen, and how much of it is known.
        scene: name of the stored scene.
        model: name of the bundled model, which is of another person than the pictures.
        settings: root and sampling, given the scene's folder.
        paper_images: how many the paper has.
        paper_E_total: the paper's mean.
    """

    title: str
    scene: str
    model: str
    settings: Callable[[Path], EstimateSettings]
    paper_images: int
    paper_E_total: float


def _hand_settings(scene: Path) -> EstimateSettings:
    """The forearm points up in the pictures, by 30 degrees; the hand may show either side."""
    return EstimateSettings(
        root="forearm",
        root_position=(scene / "root_position.csv", "wrist"),
        root_rotation={"y": (-180.0, 180.0), "x": (-30.0, 30.0), "z": (-30.0, 30.0)},
    )


REAL_EXPERIMENTS: Mapping[str, RealPictures] = {
    "B": RealPictures(
        "a person, the right foot's position known", "experiment_b", "man", demo_settings, 6, 0.223
    ),
    "C": RealPictures(
        "a hand, the forearm's position known", "experiment_c", "hand", _hand_settings, 3, 0.172
    ),
}


@dataclass(frozen=True)
class RealResult:
    """What one method came to.

    Args:
        experiment: "B" or "C".
        method: "paper" or "beam".
        records: what the search said about each picture, by its name.
        cpu_seconds: of the processor, for all pictures.
        warnings: what the user should know.
    """

    experiment: str
    method: Method
    records: Mapping[str, FrameRecord]
    cpu_seconds: float
    warnings: tuple[str, ...]

    def as_json(self) -> dict[str, Any]:
        """The figures; mean E_total is over the pictures in which a pose was found."""
        found = {name: one.E_total for name, one in self.records.items() if one.E_total is not None}
        return {
            "experiment": self.experiment,
            "method": self.method,
            "images": len(self.records),
            "not_found": len(self.records) - len(found),
            "mean_e_total": sum(found.values()) / len(found) if found else math.nan,
            "e_total": {name: found.get(name, math.nan) for name in self.records},
            "seconds_an_image": self.cpu_seconds / len(self.records),
            "paper_images": REAL_EXPERIMENTS[self.experiment].paper_images,
            "paper_mean_e_total": REAL_EXPERIMENTS[self.experiment].paper_E_total,
            "warnings": list(self.warnings),
        }


def picture_names(experiment: str) -> tuple[str, ...]:
    """The names of an experiment's pictures."""
    return load_scene(stored_scene(REAL_EXPERIMENTS[experiment].scene)).frames


def run_real_experiment(
    experiment: str,
    method: Method,
    frames: tuple[str, ...] = (),
    out: Path | None = None,
    progress: Callable[[int], None] | None = None,
) -> RealResult:
    """Search the poses in stored pictures, each for itself.

    Args:
        experiment: "B" or "C".
        method: "paper", samples every 10 degrees; or "beam", the multi-start search, whose angles
            are continuous.
        frames: names of the pictures; all where empty.
        out: folder for the poses and overlays; None writes nothing.
        progress: called with the number of pictures done after each.

    Raises:
        OutputError: the folder is not empty or cannot be written.
    """
    pictures = REAL_EXPERIMENTS[experiment]
    scene = stored_scene(pictures.scene)
    settings = replace(pictures.settings(scene), frames=frames, method=method)

    def on_frame(done: int, _total: int, _frame: str, _record: FrameRecord | None) -> None:
        if progress is not None:
            progress(done)

    begin = time.process_time()
    estimate: SceneEstimate = estimate_scene(
        scene, bundled_model(pictures.model), out, settings, on_frame=on_frame
    )
    seconds = time.process_time() - begin
    return RealResult(experiment, method, estimate.records, seconds, estimate.warnings)


def real_table(results: list[RealResult]) -> Table:
    """The paper's figures and those of each method, side by side; E_total of every picture."""
    pictures = REAL_EXPERIMENTS[results[0].experiment]
    table = Table(title=f"Kameda, experiment {results[0].experiment}: {pictures.title}")
    table.add_column("figure")
    for heading in ("paper", *(METHODS[result.method] for result in results)):
        table.add_column(heading, justify="right")
    figures = [result.as_json() for result in results]
    table.add_row("silhouettes", str(pictures.paper_images), *(str(f["images"]) for f in figures))
    table.add_row("  no pose found", "-", *(str(f["not_found"]) for f in figures))
    mean = [pictures.paper_E_total, *(f["mean_e_total"] for f in figures)]
    table.add_row("mean E_total of the others", *(f"{one:.1%}" for one in mean))
    for name in results[0].records:
        table.add_row(f"  {name}", "-", *(f"{f['e_total'][name]:.1%}" for f in figures))
    seconds = (f"{f['seconds_an_image']:.1f}" for f in figures)
    table.add_row("processor seconds an image", "-", *seconds)
    return table
