"""Kameda's experiments B and C: real silhouettes, one view each, the root's place known."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.table import Table

from drake_pose.body.formats.packages import bundled_model
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import demo_settings, stored_scene
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.papers.tables import Count, Figures, figure_table, uncounted
from drake_pose.silhouette.pictures.scenes import load_scene

Method = Literal["paper", "beam"]
METHODS: Mapping[Method, str] = {"paper": "the paper's method", "beam": "multi-start search"}
"""What is compared, and what tables call it."""


class RealPictures(NamedTuple):
    """One of the experiments: stored scene, another person's bundled model, settings by folder."""

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


REAL_EXPERIMENTS = {
    "B": RealPictures(
        "a person, the right foot's position known", "experiment_b", "man", demo_settings, 6, 0.223
    ),
    "C": RealPictures(
        "a hand, the forearm's position known", "experiment_c", "hand", _hand_settings, 3, 0.172
    ),
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
    title = f"Kameda, experiment {first['experiment']}"
    pictures = REAL_EXPERIMENTS[first["experiment"]]
    return figure_table(f"{title}: {pictures.title}", rows, {"paper": paper, **columns})
