"""A frame's pose the paper's way, from features, face and silhouettes (Date et al., section 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.camera.models import Camera
from drake_pose.person.date.inverse_kinematics import aim_trunk, move_limb, upper_body
from drake_pose.person.date.limb_search import (
    FEATURE_ERROR,
    Search,
    limb_angles,
    search_limb,
)
from drake_pose.person.date.skeleton import LIMBS, Limb, Skeleton, rotation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Waist:
    """The constants of the waist formula (4.2). They are a person's; the defaults are the paper's.

    Args:
        head_share: the head's share in the waist's height.
        ahead: how far the waist of a person standing upright is ahead of the head's middle [m].
        in_reach: whether the waist, which lifting a foot raises, is lowered until both feet are in
            the legs' reach; else no circle may be left to search on.
    """

    head_share: float = 0.55
    ahead: float = 0.0
    in_reach: bool = False

    def place(self, features: Array, heading: float) -> Array:
        """The waist (3,) [m] below the head, of features (5, 3) [m] and the heading [rad]."""
        head, _, _, left_foot, right_foot = features
        feet = 0.5 * (right_foot[2] + left_foot[2])
        height = self.head_share * head[2] + (1.0 - self.head_share) * feet
        forward = self.ahead * np.array([np.cos(heading), np.sin(heading)])
        return np.array([*(head[:2] + forward), height])


def waist_of(skeleton: Skeleton) -> Waist:
    """The constants for this person standing upright, both feet in reach; centimetres matter."""
    q = np.zeros(len(skeleton.lower))
    head, _, _, left_foot, right_foot = skeleton.features(q)
    hips = np.mean([skeleton.limb_points(q, name)[0] for name in LIMBS[2:]], axis=0)
    feet = 0.5 * (left_foot[2] + right_foot[2])
    return Waist(float((hips[2] - feet) / (head[2] - feet)), float(hips[0] - head[0]), True)


@dataclass(frozen=True, eq=False)
class PaperPose:
    """A pose estimated the paper's way.

    Args:
        q: (nq,) positions inside their limits.
        limbs: by name, (3, 3) shoulder, elbow and hand, or hip, knee and foot, as found [m].
        waist: (3,) half-way between the hips, by the waist formula [m].
    """

    q: Array
    limbs: Mapping[str, Array]
    waist: Array


def estimate_pose(
    skeleton: Skeleton,
    last: Array,
    features: Array,
    head_angles: Array | None,
    cameras: Sequence[Camera],
    regions: Sequence[Mask],
    *,
    search: Search = "surfaces",
    waist: Waist | None = None,
) -> PaperPose:
    """Estimates a frame's pose.

    Args:
        last: (nq,) the last frame's positions.
        features: (5, 3) head, hands and feet in the order of FEATURES [m].
        head_angles: (2,) [rad] where the face was seen; None: the last frame's, free to move.
        cameras, regions: those on the circle, and (H, W) the person in each of their pictures.
        search: how elbows and knees are searched: "surfaces" by points of the limbs' surfaces, on
            the circles of all ends within what hands and feet are measured off; "rectangles" as in
            the paper, on one circle; "none": they stay where inverse kinematics puts them.
    """
    q = _head_and_arms(skeleton, last, features, head_angles)
    R_WT, neck = skeleton.trunk_pose(q)
    waist = waist or Waist()
    place = waist.place(features, float(q[skeleton.head_angles[0]]))
    if waist.in_reach:
        place = _lowered(skeleton, R_WT, place, features[3:])
    # The model's trunk is one piece: it cannot hold shoulders and waist found apart. For its
    # positions the waist counts; so the neck's base cannot wander off from frame to frame either.
    aimed = aim_trunk(skeleton, q, place)
    R_aimed, _ = skeleton.trunk_pose(aimed)
    limbs = {}
    for k, name in enumerate(LIMBS):
        limb, end = skeleton.limbs[name], features[1 + k]
        if name.endswith("arm"):
            R, root, outward = R_WT, neck + R_WT @ limb.root_T, R_WT @ limb.root_T
            found = np.array([root, _middle(limb, R_WT, root, q[limb.positions]), end])
        else:
            R, outward = R_aimed, R_aimed @ (limb.root_T - skeleton.waist_T)
            root = place + outward
            angles = move_limb(limb, R_aimed, root, q[limb.positions], end)
            found = np.array([root, _middle(limb, R_aimed, root, angles), end])
        if search != "none":
            last_angles = q[limb.positions]
            found[1], end = search_limb(
                limb, R, root, end, outward, found[1], last_angles, cameras, regions, search
            )
            found[2] = end
        own_root = neck + R_aimed @ limb.root_T
        angles = limb_angles(limb, R_aimed, own_root, found[1], end, q[limb.positions])
        # Where limits forbid that, the hand or foot counts more than the elbow or knee.
        aimed[limb.positions] = move_limb(limb, R_aimed, own_root, angles, end)
        limbs[name] = found
    return PaperPose(skeleton.clip(aimed), limbs, place)


def _lowered(skeleton: Skeleton, R_WT: Array, place: Array, feet: Array) -> Array:
    """The waist (3,), lowered until both legs reach their feet (2, 3) [m], within tolerance."""
    beyond = 0.0
    for name, foot in zip(LIMBS[2:], feet, strict=True):
        limb = skeleton.limbs[name]
        hip = place + R_WT @ (limb.root_T - skeleton.waist_T)
        across = float(np.linalg.norm(hip[:2] - foot[:2]))
        above = np.sqrt(max(0.0, sum(limb.lengths) ** 2 - across**2))
        beyond = max(beyond, float(hip[2] - foot[2] - above))
    lower = min(beyond, max(0.0, 2.0 * (beyond - FEATURE_ERROR)))
    return np.array([*place[:2], place[2] - lower])


def _head_and_arms(
    skeleton: Skeleton, last: Array, features: Array, head_angles: Array | None
) -> Array:
    """Positions (nq,) with head and hands where they were measured; legs as in the last frame."""
    q = np.array(last, dtype=np.float64)
    if head_angles is not None:
        index = skeleton.head_angles
        q[index] = np.clip(head_angles, skeleton.lower[index], skeleton.upper[index])
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    q = upper_body(skeleton, q, features, face_known=head_angles is not None)
    # Where the head's angles moved, its middle must still be where it was measured.
    q[skeleton.head_positions] = features[0] - skeleton.head_rotation(q) @ skeleton.face_H
    return q


def _middle(limb: Limb, R_WT: Array, root: Array, angles: Array) -> Array:
    """(3,) the middle joint of a limb at angles (4,) [m]."""
    return np.asarray(root + R_WT @ rotation(limb.axes[:3], angles[:3]) @ limb.middle_U)
