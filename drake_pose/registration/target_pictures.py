"""The masks of an object that stands somewhere, in pictures of a camera that rides on a link.

What is behind the object changes with the camera, so nothing is compared from picture to picture.
Of the regions of each picture (``segmentation.regions``) any may be the object: those that it can
look like are kept, and which of them it is the hand's motions tell (``object_search``). Where the
object then is in each picture its colours there, and those beside it, say where its mask ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from drake_pose.arrays import Mask
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError
from drake_pose.fit.background import KnownBackground, Light
from drake_pose.registration.object_search import ObjectSearch
from drake_pose.registration.picture_search import SEARCHED, PosedPicture, see_picture
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.standing_object import StandingObject, require_turns
from drake_pose.silhouette.areas.scoring import draw_mask
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.segmentation.regions import find_regions

# So many regions of a picture are looked at.
_REGIONS = 15
# The object is a region in so many pictures at least, and in this share of them.
_LEAST, _SHARE = 4, 0.5
# Colours show it where their mask and the object overlap (IoU) by so much.
_SHOWN = 0.8


def find_in_pictures(
    standing: StandingObject, camera: PinholeCamera, pictures: Sequence[PosedPicture]
) -> list[PosedFrame]:
    """The pictures that show an object, with masks of it.

    Args:
        camera: its pose is not used.
        pictures: at values of the object's tree; the first ones carry the search.

    Raises RegistrationError: the link hardly turns, or no pose explains enough of the pictures.
    """
    choices = [
        [PosedFrame(one.name, one.values, region) for region in find_regions(one.picture, _REGIONS)]
        for one in pictures[:SEARCHED]
    ]
    require_turns(camera.name, standing, [own[0] for own in choices if own])
    search = ObjectSearch(standing)
    look, count = search.choose(camera, choices)
    require_seen(camera.name, count, len(choices))
    shown = []
    for one in pictures:
        covered = draw_mask(standing.alone.all, search.seen_from(look[None], one.values), camera)
        frame = _see(one, covered)
        if frame is not None and intersection_over_union(frame.mask, covered) > _SHOWN:
            shown.append(replace(frame, odds=None))
    return shown


def require_seen(camera: str, count: int, of: int) -> None:
    """Refuses (RegistrationError) a pose that explains too few of so many pictures."""
    if count < max(_LEAST, _SHARE * of):
        raise RegistrationError(
            f"camera '{camera}': no pose of the target explains its pictures: the best one does so "
            f"with {count} of {of}, and {_LEAST} and {_SHARE:.0%} at least are needed: is this the "
            "target's model, does it stand still and differ from what is behind it, are the joint "
            "positions those of these pictures, is it this link that the camera rides on, and is "
            "the focal length about right? Or give masks. Nothing was written"
        )


def _see(one: PosedPicture, covered: Mask) -> PosedFrame | None:
    """A picture with the mask that its own colours give, of an object that is about there."""
    light = Light(np.ones(3, np.float32), np.zeros(3, np.float32))
    shows = np.zeros((1, *covered.shape), np.bool_)
    known = KnownBackground.of([one.picture], [light], shows, covered[None])
    return see_picture(one, known, light, covered)
