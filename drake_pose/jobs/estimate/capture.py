"""Capture of one person by several cameras: an estimate with the bundled person."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from drake_pose.body.files.packages import bundled_model
from drake_pose.jobs.estimate.result import SceneEstimate
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.results.settings import EstimateSettings

PERSON = "person_shape.urdf"


def bundled_person() -> Path:
    """The bundled person whose lengths are found with the pose."""
    return bundled_model("person").with_name(PERSON)


def capture_scene(
    scene: Path | str,
    out: Path | str | None = None,
    model: Path | str | None = None,
    *,
    replay: bool = True,
    overlay: bool = True,
    packages: Mapping[str, Path] | None = None,
) -> SceneEstimate:
    """Captures the person in a scene with two calibrated cameras or more; see `estimate_scene`.

    Args:
        scene: the scene's folder.
        out: the result's folder, empty or not there; None writes nothing.
        model: a person with landmarks.yaml beside it; None: the bundled one with shape joints.
        replay: whether replay.html is written.
        overlay: whether overlays are written.
        packages: folders of packages that the model's ``package://`` names mean, by name.

    Raises:
        SceneError: fewer than two cameras, or uncalibrated ones.
        ModelError: the model is no person with landmarks.
        OutputError: the result cannot be written.
    """
    settings = EstimateSettings(method="person", packages=packages or {})
    return estimate_scene(
        scene, model or bundled_person(), out, settings, replay=replay, overlay=overlay
    )
