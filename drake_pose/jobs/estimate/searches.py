"""The pose tree and the search for it that settings ask for."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from pydrake.multibody.tree import BodyIndex

from drake_pose.body import ArticulatedModel, PoseTree, RootRotation
from drake_pose.errors import SettingsError
from drake_pose.files.records import user_units
from drake_pose.files.settings import EstimateSettings, RootTurns
from drake_pose.search import (
    BeamSearchSettings,
    MultiStartSearch,
    PaperSearch,
    PaperSearchSettings,
    PoseSearch,
    RootPlacementSearch,
    hub,
    turns_freely,
)


def make_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    interval_deg: float = 10.0,
) -> PoseSearch:
    """The search for a root at its own place, or at a position (3,) in the world [m].

    ``interval_deg``: sampling interval of the paper's search [deg].
    """
    tree = make_tree(model, settings, position)
    if settings.method == "paper":
        return PaperSearch(tree, PaperSearchSettings(math.radians(interval_deg)))
    return MultiStartSearch(tree, settings.time_limit)


def make_placement_search(
    model: ArticulatedModel,
    settings: EstimateSettings,
    position: np.ndarray | None,
    scale_unknown: bool,
    interval_deg: float = 10.0,
    free_interval_deg: float = 30.0,
) -> RootPlacementSearch:
    """The search for a root that can be anywhere.

    Where joints turn the root freely, the tree begins at the node of most neighbours.

    Args:
        interval_deg: sampling interval of all angles [deg].
        free_interval_deg: that of a root that can be turned in all ways [deg].

    Raises SettingsError: the method is the paper's.
    """
    if settings.method == "paper":
        raise SettingsError(
            "the paper's search must know where the root is and how large it looks; where the "
            "scene has no cameras.yaml or the root position is unknown, use --method beam"
        )
    first = np.zeros(3) if position is None else position
    tree = make_tree(model, settings, None if settings.root is None else first)
    if settings.root is None and settings.root_rotation is None and turns_freely(tree):
        rotation = RootRotation.free(interval_deg=free_interval_deg)
        held = _in_plant_units(model, settings.hold)
        tree = model.pose_tree(hub(tree), root_position=first, root_rotation=rotation, held=held)
    sampling = BeamSearchSettings(math.radians(interval_deg), time_limit=settings.time_limit)
    return RootPlacementSearch(tree, sampling, scale_unknown)


def make_tree(
    model: ArticulatedModel, settings: EstimateSettings, position: np.ndarray | None = None
) -> PoseTree:
    """The pose tree, its root placed as the settings say."""
    held = _in_plant_units(model, settings.hold)
    root, turns = settings.root, settings.root_rotation
    own = model.pose_tree(root_position=position, held=held)
    if turns is None:
        return own if root is None else model.pose_tree(root, root_position=position, held=held)
    root = root or own.root
    if root == "world":
        raise SettingsError(
            f"{model.path}: its own joints hold it in the world; a root rotation needs the name of "
            f"a root; links that can be one: {', '.join(model.link_meshes)}"
        )
    rotation = _root_rotation(model, root, turns)
    return model.pose_tree(root, root_position=position, root_rotation=rotation, held=held)


def leave_out_links(
    model: ArticulatedModel, settings: EstimateSettings
) -> tuple[ArticulatedModel, EstimateSettings]:
    """The model without the links that are not in the pictures, their joints held.

    Raises:
        ModelError: the model is no URDF, or nothing would be seen.
        UnknownNameError: there is no such link.
    """
    centre = model.pose_tree(
        hub(model.pose_tree()), root_position=np.zeros(3), root_rotation=RootRotation.free()
    )
    # What a link that is seen follows is not held.
    led = {
        centre.source(i) for i, one in enumerate(centre.nodes) if one.name not in settings.unseen
    }
    unseen = [
        one for i, one in enumerate(centre.nodes) if one.name in settings.unseen and i not in led
    ]
    names = [name for node in unseen for name in node.value_names]
    usual = user_units(model) * model.default_positions
    held = {name: float(usual[model.position_index(name)]) for name in names}
    return model.without(settings.unseen), replace(settings, hold={**held, **settings.hold})


def _root_rotation(model: ArticulatedModel, root: str, turns: RootTurns) -> RootRotation:
    """How the root may be turned, from how it stands in the world at the model's defaults."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, model.default_positions)
    body = model.plant.get_body(BodyIndex(model.link_index(root)))
    R_WR = body.EvalPoseInWorld(context).rotation().matrix()
    if turns == "fixed":
        return RootRotation.fixed(R_WR)
    if turns == "free":
        return RootRotation.free(rotation=R_WR)
    ranges = [(axis, lower, upper) for axis, (lower, upper) in turns.items()]
    return RootRotation.limited(ranges, rotation=R_WR)


def _in_plant_units(model: ArticulatedModel, values: Mapping[str, float]) -> dict[str, float]:
    """Degrees become radians; lengths stay metres. Names that are no positions are angles."""
    kinds = dict(zip(model.position_names, model.position_kinds, strict=True))
    is_angle = {name: kinds.get(name, "angle") == "angle" for name in values}
    return {name: math.radians(one) if is_angle[name] else one for name, one in values.items()}
