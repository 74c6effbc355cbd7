"""Hand-eye registration: a camera on a robot's link and a rigid calibration target in the world.

The target's pose X_CT in the camera is searched in single frames. Triples of frames give starts
for X_LC and X_WT (`hand_eye`), which are then fitted to all silhouettes together.
"""

import copy
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import (
    TARGET,
    TARGET_POSITIONS,
    ArticulatedModel,
    PoseTree,
    RootRotation,
    TriangleMesh,
    inverse_transforms,
    join_meshes,
)
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera, pose_matrix
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.fit.background import KnownBackground
from drake_pose.fit.judge import paired_evidence
from drake_pose.fit.surfaces import FEW, simplify_surfaces, surface_distance
from drake_pose.registration.hand_eye import hand_eye_starts, rotation_spread
from drake_pose.registration.picture_search import PosedPicture, segment_picture
from drake_pose.registration.posed_frames import LAST_SPACING, PosedFrame, PosedFrames
from drake_pose.registration.pyramid_level import PICTURES
from drake_pose.registration.register import (
    SEARCH,
    CameraSearch,
    E_total,
    RegisteredCamera,
    RegistrationBody,
    TargetPose,
    evenly_spaced,
    fit_to_inliers,
    keep_distinct,
    overlap_areas,
    select_best,
)
from drake_pose.registration.shared_fit import SHARED, SharedFit, SharedValues
from drake_pose.silhouette.outline import TreeSurfaces, outline_from_mesh
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.silhouette.segmentation import find_regions


class CalibrationTarget:
    """A rigid target at an unknown pose in the world, seen by a camera on a robot's link.

    Its frame T is the world frame of its own model file; in a URDF the frame of its root link.

    Its pose tree leads from link L over the robot's joints and the world to the target. The tree's
    values are positions of these joints and TARGET_POSITIONS.

    Attributes:
        in_own_frame: its surfaces, with T as the world.
        middle: (3,) centre of its bounding box in frame T [m].
        radius: of the ball about its middle that contains it [m].

    Args:
        robot: the robot.
        link: the robot's link L that carries the camera.
        held: joint positions of the robot that do not change, by name [rad or m].
        tree: the target's own pose tree, with frame T as the world.

    Raises:
        SettingsError: a joint of the target is free, or no joint moves the link.
    """

    def __init__(
        self, robot: ArticulatedModel, link: str, held: Mapping[str, float], tree: PoseTree
    ) -> None:
        path, kinematics = tree.model.path, TreeKinematics(tree)
        moving = np.flatnonzero(kinematics.lower < kinematics.upper)
        if len(moving):
            raise SettingsError(
                f"{path}: joint '{kinematics.names[moving[0]]}' moves, but what a camera on a link "
                "sees must be rigid: make the joint fixed at its value, or use another target"
            )
        self._robot, self._link, self._held = robot, link, dict(held)
        # With few triangles, a target of several pieces loses its shape.
        self.in_own_frame = RegistrationBody(tree, coarse_triangles=FEW)
        X_TN = kinematics.poses(kinematics.lower)
        placed = zip(tree.nodes, X_TN, strict=True)
        self._mesh = join_meshes([node.mesh.transformed(X) for node, X in placed])
        vertices = self._mesh.vertices
        self.middle = np.asarray(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        self.radius = float(np.linalg.norm(vertices - self.middle, axis=1).max())
        self._X_TO = np.eye(4)
        self._X_TO[:3, 3] = self.middle
        self._bodies = RegistrationBody(self.tree(np.eye(4)), (TARGET,), FEW)

    def with_robot(self, robot: ArticulatedModel) -> "CalibrationTarget":
        """Return a copy for the same robot with corrected joint origins."""
        other = copy.copy(self)
        other._robot = robot
        return other

    def tree(self, X_WT: Array) -> PoseTree:
        """Return the tree from link to target, 0 at X_WT (4, 4); SettingsError: no joint."""
        mesh = self._mesh.transformed(inverse_transforms(self._X_TO))
        model = self._robot.with_target(self._link, mesh, X_WT @ self._X_TO)
        tree = model.pose_tree(
            self._link,
            root_position=np.zeros(3),
            root_rotation=RootRotation.fixed(),
            held={**self._held, **dict.fromkeys(TARGET_POSITIONS, 0.0)},
        )
        if len(tree.nodes) < 3:
            raise fixed_link_error(self._robot, self._link)
        return tree

    def body(self, X_WT: Array) -> RegistrationBody:
        """Return the target's surfaces in the pose tree for X_WT (4, 4)."""
        return self._bodies.with_tree(self.tree(X_WT))

    def link_poses(self, values: Array) -> Array:
        """Return the link's poses X_WL (frames, 4, 4) at values (frames, m) of `tree`."""
        kinematics, world = self._bodies.kinematics, self._bodies.tree.model.link_names[0]
        node = self._bodies.tree.node_index(world)
        return inverse_transforms(np.array([kinematics.poses(one)[node] for one in values]))

    def moved(self, X_WT: Array, by: Array) -> Array:
        """Return the target's pose (4, 4) at TARGET_POSITIONS `by` (6,), which are 0 at X_WT."""
        X = pose_matrix(Rotation.from_euler("XYZ", by[3:]).as_matrix(), by[:3])
        return np.asarray(X_WT @ self._X_TO @ X @ inverse_transforms(self._X_TO))

    def pose_covariance(self, X_WT: Array, covariance: Array) -> Array:
        """Return the (6, 6) covariance of the pose's error, see ``TargetPose``.

        Args:
            X_WT: (4, 4) the target's pose.
            covariance: (6, 6) covariance of TARGET_POSITIONS, which are 0 at X_WT.
        """
        R = X_WT[:3, :3]
        covariance = covariance.copy()
        for axis in self.symmetry[1]:
            # The rotation about a symmetry axis is uniform over a full turn.
            covariance[3:, 3:] += np.pi**2 / 3.0 * np.outer(axis, axis)
        J = np.zeros((6, 6))
        J[:3, 3:] = J[3:, :3] = R
        # TARGET_POSITIONS rotate about the target's middle, not about its frame's origin.
        J[3:, 3:] = np.cross(R.T, -R @ self.middle).T
        return J @ covariance @ J.T

    def moved_pose(self, pose: TargetPose, by: Array, covariance: Array) -> TargetPose:
        """Return pose and alternatives moved by TARGET_POSITIONS (6,) of a covariance (6, 6)."""
        X_WT = self.moved(pose.X_WT, by)
        others = X_WT @ np.linalg.inv(pose.X_WT) @ pose.alternatives
        covariance = self.pose_covariance(X_WT, covariance)
        return replace(pose, X_WT=X_WT, covariance=covariance, alternatives=others)

    @cached_property
    def symmetry(self) -> tuple[Array, Array]:
        """The target's symmetries in frame T, searched about the principal axes of its surface.

        Returns (n, 4, 4) motions that leave its shape unchanged, the identity first, in steps of 15
        degrees about a rotational symmetry axis; (k, 3) the rotational symmetry axes.
        """
        simplified = simplify_surfaces(TreeSurfaces(self._bodies.tree), FEW)
        outline = simplified[self._bodies.tree.node_index(TARGET)]
        corners = outline.vertices[outline.triangles]
        weights = np.linalg.norm(outline.planes[:, :3], axis=1)
        moments = np.einsum("t,tci,tcj->ij", weights, corners, corners)
        middles = corners.mean(axis=1)
        moments += 9.0 * np.einsum("t,ti,tj->ij", weights, middles, middles)

        def turn(by: Array) -> Array:
            return Rotation.from_rotvec(by).as_matrix()

        def alike(R: Array) -> bool:
            """Return whether the rotation R (3, 3) leaves the surface unchanged."""
            turned = TriangleMesh(outline.vertices @ R.T, outline.triangles)
            off = surface_distance(outline, outline_from_mesh(turned))
            return off <= 0.005 * self.radius

        rotations, axes = [np.eye(3)], []
        for axis in np.linalg.eigh(moments)[1].T:
            # One radian is no fraction of a full turn: only a round target passes.
            if alike(turn(axis)):
                axes.append(axis)
                found = [24]
            else:
                found = [n for n in (2, 3, 4, 5, 6, 8) if alike(turn(2.0 * np.pi / n * axis))]
            own = [turn(2.0 * np.pi * k / n * axis) for n in found for k in range(1, n)]
            products = [*rotations, *(one @ R for R in rotations for one in own)]
            rotations = keep_distinct(
                products, lambda R, other: bool(np.trace(R.T @ other) < 2.999)
            )
        turns = np.tile(np.eye(4), (len(rotations), 1, 1))
        turns[:, :3, :3] = rotations
        return self._X_TO @ turns @ inverse_transforms(self._X_TO), np.array(axes).reshape(-1, 3)


def distinct_motions(turns: Array, axes: Array) -> Array:
    """Return those of motions (t, 4, 4) that differ by more than a rotation about axes (k, 3)."""
    if not len(axes):
        return turns
    points = axes @ np.swapaxes(turns[:, :3, :3], 1, 2)
    # A rotation about its own axis leaves each axis where it is.
    pointing = keep_distinct(
        range(len(turns)), lambda i, j: bool(np.abs(points[i] - points[j]).max() > 0.1)
    )
    return turns[pointing]


def fixed_link_error(robot: ArticulatedModel, link: str) -> SettingsError:
    """Return the error for a link that no joint moves."""
    return SettingsError(
        f"{robot.path}: no joint moves link '{link}', so a camera on it stands still: leave "
        "--on out"
    )


def require_rotation(
    camera: str,
    target: CalibrationTarget,
    frames: Sequence[PosedFrame],
    which: str = "",
    min_turn: float = 4.0,
) -> None:
    """Refuse frames in which the link rotates too little to observe the camera's pose on it.

    Args:
        camera: its name.
        target: gives the link's poses.
        frames: with values of the target's tree.
        which: words after the number of frames in the message.
        min_turn: minimum rotation of the link about a second axis [deg].

    Raises RegistrationError: it rotates less, or there are fewer than three frames.
    """
    what, values = "are too few", np.array([one.values for one in frames])
    if len(frames) >= 3:
        turns = np.degrees(rotation_spread(target.link_poses(values)[:, :3, :3]))
        if turns[1] >= min_turn:
            return
        what = (
            f"turn the camera's link by {turns[0]:.0f} degrees about one axis, and by "
            f"{turns[1]:.1f} about others"
        )
    raise RegistrationError(
        f"camera '{camera}': its {len(frames)} frames {which}{what}: they do not determine the "
        "poses of camera and target; give at least three frames, better five, between which the "
        "link turns by 20 degrees or more about at least two axes. Nothing was written"
    )


SinglePoses = tuple[list[PosedFrame], Array]
"""The likely masks of a picture, best first, and the target's poses X_CT (n, 4, 4) in them."""

HandEye = Array
"""(2, 4, 4): the camera's pose X_LC on the link and the target's pose X_WT in the world."""


class TargetSearch:
    """Finds the poses of a camera on a robot's link and of the calibration target it sees.

    Args:
        target: the target.
        single_search: finds the target's pose in a single frame; None: a thorough search.
    """

    def __init__(
        self, target: CalibrationTarget, single_search: CameraSearch | None = None
    ) -> None:
        self._target, self._single_search = (
            target,
            single_search or CameraSearch(target.in_own_frame),
        )

    @property
    def kinematics(self) -> TreeKinematics:
        """Kinematics of the pose tree from the link to the target."""
        return TreeKinematics(self._target.tree(np.eye(4)))

    def rough(self) -> "TargetSearch":
        """Return a faster, less reliable search."""
        return TargetSearch(self._target, self._single_search.rough())

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Return the camera at its pose X_LC on the link, with the target's pose in the world.

        ``camera``: its pose is not used. ``frames``: with values of the target's tree. Raises
        MaskError: a mask is empty, or its size differs from the camera's; RegistrationError: the
        link rotates about one axis only in all frames, or in those that agree.
        """
        require_rotation(camera.name, self._target, frames)
        single = self._single_poses(camera, [[one] for one in evenly_spaced(frames)])
        poses, evidence = list[HandEye](), None
        with suppress(RegistrationError):
            gains = np.zeros((len(single), len(single)))
            for k in range(2):
                poses += (own := self._starts(camera, single[k::2]))
                gains[1 - k :: 2] = self._gains(camera, single, own[0])[1 - k :: 2]
            rows = np.array([own[0].values for own, _ in single])
            evidence = paired_evidence(gains, rows)
        poses = poses if evidence else self._starts(camera, single)
        for rounds, spacing, surfaces in (
            (SEARCH.fine, SEARCH.fine_spacing, "medium"),
            (SHARED.stages_with_constants, LAST_SPACING, "full"),
        ):
            fits = [self.fit_from(camera, frames, pose, spacing, surfaces) for pose in poses]
            fitted = [
                self.fitted(fit, fit.fit(rounds), pose)
                for fit, pose in zip(fits, poses, strict=True)
            ]
            poses = self.distinct(fitted, frames)
        last = []
        for k, pose in enumerate(poses):
            fit = self.fit_from(camera, frames, pose)
            now = fit_to_inliers(fit)
            # Restart there, so that the shared unknowns are 0 and covariances refer to the result.
            poses[k] = self.fitted(fit, now, pose)
            at = now._replace(shared=0.0 * now.shared)
            last.append((self.fit_from(camera, frames, poses[k]), at))
        found, covariance, as_good = select_best(last)
        X_LC, X_WT = poses[as_good[0]]
        others = [X_WT @ turn for turn in distinct_motions(*self._target.symmetry)[1:]]
        # Solutions with another camera pose are alternatives of the camera, not of the target.
        as_well = [poses[k] for k in as_good[1:]]
        others += [one[1] for one in as_well if not self._differ(one[:1], X_LC[None])]
        apart = [X[0] for X in self._apart([X[None] for X in (X_WT, *others)], np.eye(4)[None])]
        target_pose = TargetPose(
            X_WT,
            self._target.pose_covariance(X_WT, covariance[6:, 6:]),
            np.array(apart[1:]).reshape(-1, 4, 4),
            self._target.symmetry[1],
        )
        inliers = [one for one, fit in zip(frames, found.frames, strict=True) if fit.is_inlier]
        require_rotation(camera.name, self._target, inliers, "that agree ")
        return replace(found, target=target_pose, evidence=evidence)

    def choose(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        explained: float = 0.15,
    ) -> tuple[HandEye, int]:
        """Estimate both poses roughly from image regions, some of which show the target.

        Args:
            camera: its pose is not used.
            choices: for each picture the masks of regions that may be the target; may be empty.
            explained: maximum E_total of a region that is taken for the target.

        Returns the poses, and the number of pictures in which they explain a region.

        Raises RegistrationError: no three frames have regions that rotate as the link does.
        """
        poses = self._starts(camera, self._single_poses(camera, choices, explained))[0]
        seen = [own for own in choices if own]
        off = [self.misfits(camera, [own], poses[None], SEARCH.refined_side)[0] for own in seen]
        return poses, int(np.count_nonzero(np.array(off) < explained))

    def _single_poses(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        explained: float = np.inf,
        *,
        single_poses: int = 8,
        regions: int = 3,
    ) -> list[SinglePoses]:
        """Return the likely masks of each picture that has any, with the target's poses in them.

        Args:
            camera: its pose is not used.
            choices: for each picture the masks that may be the target's; may be empty.
            explained: maximum E_total of a mask, where a picture has several.
            single_poses, regions: maximum numbers of target poses of a mask, and of masks of a
                picture.
        """
        body, found = self._target.in_own_frame, list[SinglePoses]()
        for own in choices:
            likely = []
            for one in own:
                alone = [PosedFrame(one.name, np.zeros(0), one.mask)]
                poses = self._single_search.search(camera, alone, kept=single_poses)
                posed = PosedFrames(body.kinematics, body.coarse, camera, alone)
                off = float(
                    E_total(overlap_areas(posed, np.array(poses), SEARCH.refined_side)).min()
                )
                # A frame's only mask is known to be the target's.
                if len(own) == 1 or off < explained:
                    likely.append((off, one, poses))
            likely = sorted(likely, key=lambda each: each[0])[:regions]
            if likely:
                turns = self._target.symmetry[0]
                alike = [self._apart([X[None] for X in poses], turns) for *_, poses in likely]
                X_CT = np.concatenate([X for poses in alike for X in poses])
                found.append(([one for _, one, _ in likely], X_CT))
        return found

    def _starts(
        self, camera: PinholeCamera, single: Sequence[SinglePoses], starts: int = 12, kept: int = 4
    ) -> list[HandEye]:
        """Return up to `kept` hypotheses of both poses, best first; `starts` of them are fitted.

        Raises RegistrationError: no three pictures agree with the link's rotation.
        """
        likely_masks, some = [own for own, _ in single], [own[0] for own, _ in single]
        hypotheses = np.zeros((0, 2, 4, 4))
        if len(some) >= 3:
            X_WL = self._target.link_poses(np.array([one.values for one in some]))
            X_CT = [X for _, X in single]
            hypotheses = hand_eye_starts(X_WL, X_CT, self._target.symmetry[0])
        if not len(hypotheses):
            raise RegistrationError(
                f"camera '{camera.name}': in no three of its frames does the target rotate in the "
                "camera as the link does: are these masks of this target, did it stand still, are "
                "the joint positions those of these frames, and does the camera ride on this link? "
                "Nothing was written"
            )
        misfits = self.misfits(camera, likely_masks, hypotheses, SEARCH.start_side)
        order = np.argsort(misfits, kind="stable")
        fitted = []
        for pose in self.distinct(hypotheses[order[: 10 * starts]], some)[:starts]:
            # The mask of each frame that the hypothesis explains best.
            by = [
                [self.misfits(camera, [[one]], pose[None])[0] for one in own]
                for own in likely_masks
            ]
            chosen = [own[int(np.argmin(each))] for own, each in zip(likely_masks, by, strict=True)]
            fit = self.fit_from(camera, chosen, pose, SEARCH.coarse_spacing, "coarse")
            fitted.append(self.fitted(fit, fit.fit(SEARCH.coarse), pose))
        misfits = self.misfits(camera, likely_masks, np.array(fitted), SEARCH.refined_side)
        # Much worse hypotheses are dropped.
        limit = 0.02 + 2.0 * float(misfits.min())
        order = np.argsort(misfits, kind="stable")
        best = [fitted[k] for k in order if misfits[k] <= limit]
        return self.distinct(best, some)[:kept]

    def _gains(self, camera: PinholeCamera, single: Sequence[SinglePoses], pose: HandEye) -> Array:
        """Return the gains (n, n) of n pictures' best masks with the rows of all pictures."""
        rows = np.array([own[0].values for own, _ in single])
        X_CT = np.concatenate([self.poses_in_camera(pose[None], row) for row in rows])
        return np.array([1.0 - self._misfit(camera, own[0], X_CT) for own, _ in single])

    def misfits(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        poses: Array,
        side: float = SEARCH.refined_side,
    ) -> Array:
        """Return the mean E_total (n,) of ``HandEye`` poses (n, 2, 4, 4), by the best masks.

        ``side``: square root of the mask's area in the downscaled picture [pixel].
        """
        off = [
            np.min([self._misfit(camera, one, X, side) for one in own], axis=0)
            for own in choices
            for X in [self.poses_in_camera(poses, own[0].values)]
        ]
        return np.asarray(np.mean(off, axis=0))

    def _misfit(
        self, camera: PinholeCamera, one: PosedFrame, X_CT: Array, side: float = SEARCH.refined_side
    ) -> Array:
        """Return E_total (n,) of the target at poses X_CT (n, 4, 4) in one mask, clipped at 1.

        side: square root of the mask's area in the downscaled picture [pixel].
        """
        body = self._target.in_own_frame
        alone = PosedFrame(one.name, np.zeros(0), one.mask)
        posed = PosedFrames(body.kinematics, body.coarse, camera, [alone])
        return np.minimum(E_total(overlap_areas(posed, X_CT, side))[:, 0], 1.0)

    def poses_in_camera(self, poses: Array, values: Array) -> Array:
        """Return X_CT (n, 4, 4) at the tree's values (m,), for ``HandEye`` poses (n, 2, 4, 4)."""
        X_WL = self._target.link_poses(values[None])[0]
        return np.asarray(inverse_transforms(X_WL @ poses[:, 0]) @ poses[:, 1])

    def fit_from(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedFrame],
        start: HandEye,
        spacing: float = LAST_SPACING,
        surfaces: str = "full",
    ) -> SharedFit:
        """Return a fit of both poses, not solved here, whose unknowns are 0 at a start.

        ``spacing``: see ``PosedFrames``. ``surfaces``: see ``RegistrationBody``.
        """
        body = self._target.body(start[1])
        posed = PosedFrames(body.kinematics, getattr(body, surfaces), camera, frames, spacing)
        return SharedFit([posed], [inverse_transforms(start[0])], TARGET_POSITIONS)

    def fitted(self, fit: SharedFit, found: SharedValues, start: HandEye) -> HandEye:
        """Return both poses at the values that a fit found from a start."""
        moved = self._target.moved(start[1], found.shared[fit.per_camera :])
        return np.array([fit.cameras(found)[0].X_WC, moved])

    def distinct(
        self, poses: Sequence[HandEye] | Array, frames: Sequence[PosedFrame]
    ) -> list[HandEye]:
        """Return poses that show the target, in frames, unlike earlier ones, up to symmetries."""
        X_WL = self._target.link_poses(np.array([one.values for one in frames]))
        X_CT = [inverse_transforms(X_WL @ X_LC) @ X_WT for X_LC, X_WT in poses]
        kept = self._apart(X_CT, self._target.symmetry[0])
        return [pose for pose, X in zip(poses, X_CT, strict=True) if any(X is one for one in kept)]

    def _apart(self, poses: Sequence[Array], turns: Array) -> list[Array]:
        """Return items (n, 4, 4) that differ from all kept before, up to symmetries (t, 4, 4)."""
        return keep_distinct(
            poses, lambda X, other: all(self._differ(X, other @ turn) for turn in turns)
        )

    def _differ(self, X: Array, others: Array) -> bool:
        """Return whether target poses X and others (n, 4, 4) differ by over 0.15 of its radius.

        The difference is the root mean square distance of the target's points over the n pairs.
        """
        by = np.asarray(X - others)[:, :3]
        shift = by[:, :, :3] @ self._target.middle + by[:, :, 3]
        turn = (by[:, :, :3] ** 2).sum(axis=(1, 2)) / 3.0 * self._target.radius**2
        off = np.sqrt(((shift**2).sum(axis=1) + turn).mean())
        return bool(off > 0.15 * self._target.radius)


def find_target_frames(
    target: CalibrationTarget,
    camera: PinholeCamera,
    pictures: Sequence[PosedPicture],
    most: int = 15,
    min_iou: float = 0.8,
) -> list[PosedFrame]:
    """Find the calibration target in pictures, and its mask in each.

    Args:
        target: the target.
        camera: its pose is not used.
        pictures: with values of the target's tree; the first PICTURES.search_frames are searched.
        most: maximum number of regions of a picture that may be the target.
        min_iou: minimum intersection over union of a mask by colours and the target as found.

    Returns the frames that show the target, with masks and values; without log-odds.

    Raises RegistrationError: the link hardly rotates, or no pose explains enough pictures.
    """
    choices = [
        [PosedFrame(one.name, one.values, region) for region in find_regions(one.picture, most)]
        for one in pictures[: PICTURES.search_frames]
    ]
    require_rotation(camera.name, target, [own[0] for own in choices if own])
    search = TargetSearch(target)
    pose, count = search.choose(camera, choices)
    require_detections(camera.name, count, len(choices))
    gains = np.eye(3, 4, dtype=np.float32)
    shows, shown = np.zeros((camera.height, camera.width), np.bool_), []
    for one in pictures:
        X_CT = search.poses_in_camera(pose[None], one.values)
        covered = draw_mask(target.in_own_frame.full, X_CT, camera)
        # The picture's own colours, in the target and beside it, refine the mask's boundary.
        known = KnownBackground.estimate([one.picture], [gains], shows[None], covered[None])
        frame = segment_picture(one, known, gains, covered)
        if frame is not None and intersection_over_union(frame.mask, covered) > min_iou:
            shown.append(replace(frame, foreground=None))
    return shown


def require_detections(
    camera: str, count: int, of: int, least: int = 4, fraction: float = 0.5
) -> None:
    """Refuse a target pose that explains `count` of `of` pictures, if these are too few.

    camera: its name.

    Raises RegistrationError: `count` is below `least`, or below this fraction of `of`.
    """
    if count < max(least, fraction * of):
        raise RegistrationError(
            f"camera '{camera}': no pose of the target explains its pictures: the best one "
            f"explains {count} of {of}; at least {least} and {fraction:.0%} are needed. Is this "
            "the target's model, does the target stand still and differ from the background, are "
            "the joint positions those of these pictures, does the camera ride on this link, and "
            "is the focal length about right? Or give masks. Nothing was written"
        )
