"""How the frames of a sequence are estimated: matched first, then tracked."""

from __future__ import annotations

import math
from dataclasses import replace

from drake_pose.filtering.tracking.contour_tracker import TrackingSettings
from drake_pose.search.continuous.root_placement_search import RootPlacementSearch
from drake_pose.search.scoring import PoseSearch
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.estimators.mask_player import DEFAULT_FRAME_RATE_HZ

_USUAL_FRAME_RATE_HZ = 30.0
_REST_TIME = 1.0


def sequence_tracking(
    scene: Scene, search: PoseSearch, track: bool = True
) -> TrackingSettings | None:
    """How the body of a scene is tracked; None where every frame is matched on its own.

    A sequence without a frame rate is taken as a video of 30 frames a second.

    Args:
        scene: the scene; one with ``sequence: true`` is tracked.
        search: what matches the first frame; where it finds the root's position or the camera's
            scale, the track does.
        track: whether frames that follow one another are tracked at all.
    """
    if not track or not scene.sequence:
        return None
    tracking = TrackingSettings(
        root_moves=isinstance(search, RootPlacementSearch),
        scale_unknown=scene.scale_unknown,
        # A single parallel view is the same for poses mirrored in depth.
        rest_time=_REST_TIME if scene.scale_unknown else None,
    )
    if scene.frame_rate_hz is not None:
        return tracking
    # The diagram's frames are further apart than the video's were: the motion is slower as much.
    slower = _USUAL_FRAME_RATE_HZ / DEFAULT_FRAME_RATE_HZ
    return replace(
        tracking,
        angle_acceleration=tracking.angle_acceleration / math.pow(slower, 2),
        length_acceleration=tracking.length_acceleration / math.pow(slower, 2),
        growth_acceleration=tracking.growth_acceleration / math.pow(slower, 2),
        memory=tracking.memory * slower,
    )
