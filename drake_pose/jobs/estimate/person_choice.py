"""The bundled person, and whether a scene is that of a person who is followed."""

from __future__ import annotations

from pathlib import Path

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.landmarks import landmarks_file, load_landmarks
from drake_pose.body.model import ArticulatedModel
from drake_pose.errors import ModelError, SceneError
from drake_pose.person.body_plan import PERSON_LANDMARKS
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.scenes import Scene


def bundled_person() -> Path:
    """The bundled person whose lengths are found with the pose."""
    return bundled_model("person").with_name("person_shape.urdf")


def follows_person(scene: Scene, model: ArticulatedModel, settings: EstimateSettings) -> bool:
    """Whether the method is ``person``, by name or because ``auto`` chooses it.

    Raises:
        SceneError, ModelError: the method is asked for, but scene or model does not allow it.
    """
    wanted = settings.method == "person"
    if not wanted and (settings.method != "auto" or settings.search_settings):
        return False
    if len(scene.cameras) < 2 or scene.scale_unknown:
        if wanted:
            strangers = ", ".join(scene.strangers)
            raise SceneError(
                f"{scene.path}: a person is captured by two calibrated cameras or more, but masks "
                f"are there of {', '.join(scene.cameras)} alone"
                + (f"; cameras.yaml lacks {strangers}" if strangers else "")
            )
        return False
    missing = missing_for_person(model)
    if missing and wanted:
        raise ModelError(f"{model.path}: a person is captured with a model that has {missing}")
    return not missing


def missing_for_person(model: ArticulatedModel) -> str:
    """What a model lacks to be a person who can be anywhere; "" where nothing."""
    names = set(load_landmarks(model.path)) if landmarks_file(model.path).is_file() else set()
    if absent := sorted(PERSON_LANDMARKS - names):
        return f"the landmarks {', '.join(absent)} in {landmarks_file(model.path).name} beside it"
    nodes = model.pose_tree().nodes
    roots = [node for node in nodes if node.parent < 0]
    kinds = [model.position_kinds[position] for node in roots for position in node.positions]
    by_joints = all(node.value_names == node.position_names for node in nodes)
    if len(roots) != 1 or kinds.count("length") < 3 or not by_joints:
        return "one root that joints of its own move to any place"
    return ""
