"""A rigid object that stands somewhere in a robot's world, and how its look repeats."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import combinations

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
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.fit.background import KnownBackground
from drake_pose.fit.surfaces import FEW, simplify_surfaces, surface_distance
from drake_pose.registration.picture_search import PICTURES, PosedPicture, see_picture
from drake_pose.registration.posed_frames import LAST_SPACING, PosedFrame, PosedFrames
from drake_pose.registration.register import (
    SEARCH,
    CameraSearch,
    E_total,
    ObjectPose,
    RegisteredCamera,
    RegistrationBody,
    apart_from_before,
    areas,
    describe_fitted,
    spread,
    with_widths,
)
from drake_pose.registration.shared_fit import SHARED, Shared, SharedFit
from drake_pose.silhouette.outline import TreeSurfaces, outline_from_mesh
from drake_pose.silhouette.pictures.masks import intersection_over_union
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.silhouette.segmentation import find_regions


class StandingObject:
    """An object that stands in the world, where it is not known, before a link of a robot.

    Its frame T is the world of its own model file: of a URDF the frame of its root link.

    Attributes:
        alone: its surfaces, T being the world.
        middle: (3,) of its surface in frame T [m].
        radius: of a ball about its middle [m].

    Args:
        link: of the robot, whose frame L is the world of poses with it.
        held: positions of the robot that are held [rad or m].

    Raises:
        SettingsError: the object has joints that are not held, or no joint moves the link.
    """

    def __init__(
        self, robot: ArticulatedModel, link: str, held: Mapping[str, float], tree: PoseTree
    ) -> None:
        path, kinematics = tree.model.path, TreeKinematics(tree)
        moving = np.flatnonzero(kinematics.lower < kinematics.upper)
        if len(moving):
            raise SettingsError(
                f"{path}: joint '{kinematics.names[moving[0]]}' moves, but what a camera on a link "
                "sees must be rigid: make the joint fixed at its value, or take another object"
            )
        self._robot, self._link, self._held = robot, link, dict(held)
        # An object in several pieces is not itself any more with very few triangles.
        self.alone = RegistrationBody(tree, fewest=FEW)
        X_TN = kinematics.poses(kinematics.lower)
        placed = zip(tree.nodes, X_TN, strict=True)
        self._mesh = join_meshes([node.mesh.transformed(X) for node, X in placed])
        vertices = self._mesh.vertices
        self.middle = np.asarray(0.5 * (vertices.min(axis=0) + vertices.max(axis=0)))
        self.radius = float(np.linalg.norm(vertices - self.middle, axis=1).max())
        self._X_TO = np.eye(4)
        self._X_TO[:3, 3] = self.middle
        self._bodies = RegistrationBody(self.tree(np.eye(4)), (TARGET,), FEW)

    def before(self, robot: ArticulatedModel) -> "StandingObject":
        """The same before the same robot whose joints may stand elsewhere on their links."""
        other = copy.copy(self)
        other._robot = robot
        return other

    def tree(self, X_WT: Array) -> PoseTree:
        """The tree from the link to the object, which stands at a pose (4, 4) in the world.

        Raises SettingsError: no joint moves the link.
        """
        mesh = self._mesh.transformed(inverse_transforms(self._X_TO))
        model = self._robot.with_target(self._link, mesh, X_WT @ self._X_TO)
        tree = model.pose_tree(
            self._link,
            root_position=np.zeros(3),
            root_rotation=RootRotation.fixed(),
            held={**self._held, **dict.fromkeys(TARGET_POSITIONS, 0.0)},
        )
        if len(tree.nodes) < 3:
            raise stands_still(self._robot, self._link)
        return tree

    def body(self, X_WT: Array) -> RegistrationBody:
        """The object's surfaces in the tree in which it stands at a pose (4, 4) in the world."""
        return self._bodies.with_tree(self.tree(X_WT))

    def hand_poses(self, values: Array) -> Array:
        """(frames, 4, 4) X_WL at values (frames, m) of the tree."""
        kinematics, world = self._bodies.kinematics, self._bodies.tree.model.link_names[0]
        node = self._bodies.tree.node_index(world)
        return inverse_transforms(np.array([kinematics.poses(one)[node] for one in values]))

    def moved(self, X_WT: Array, by: Array) -> Array:
        """The object's pose (4, 4) at TARGET_POSITIONS (6,), which are 0 at X_WT (4, 4)."""
        X = np.eye(4)
        X[:3, 3] = by[:3]
        X[:3, :3] = Rotation.from_euler("XYZ", by[3:]).as_matrix()
        return np.asarray(X_WT @ self._X_TO @ X @ inverse_transforms(self._X_TO))

    def pose_covariance(self, X_WT: Array, covariance: Array) -> Array:
        """(6, 6) of the pose's error in the world: a rotation vector [rad] and a shift [m].

        Args:
            covariance: (6, 6) of TARGET_POSITIONS.
        """
        R = X_WT[:3, :3]
        covariance = covariance.copy()
        for axis in self.symmetry[1]:
            # Nothing says how a round object is turned.
            covariance[3:, 3:] += np.pi**2 / 3.0 * np.outer(axis, axis)
        J = np.zeros((6, 6))
        J[:3, 3:] = J[3:, :3] = R
        # The object turns about its middle, which is not its frame's origin.
        J[3:, 3:] = np.cross(R.T, -R @ self.middle).T
        return J @ covariance @ J.T

    def moved_pose(self, seen: ObjectPose, by: Array, covariance: Array) -> ObjectPose:
        """A pose with its alternatives after TARGET_POSITIONS (6,), given their covariance."""
        X_WT = self.moved(seen.X_WT, by)
        others = X_WT @ np.linalg.inv(seen.X_WT) @ seen.alternatives
        covariance = self.pose_covariance(X_WT, covariance)
        return replace(seen, X_WT=X_WT, covariance=covariance, alternatives=others)

    @cached_property
    def symmetry(self) -> tuple[Array, Array]:
        """Motions after which it looks alike, and axes about which it is round, in frame T.

        Main axes of its surface are tried.

        Returns:
            (n, 4, 4) the motions, the identity first; about an axis of a round object every 15
            degrees. (k, 3) the axes.
        """
        few = simplify_surfaces(TreeSurfaces(self._bodies.tree), FEW)
        outline = few[self._bodies.tree.node_index(TARGET)]
        corners = outline.vertices[outline.triangles]
        weights = np.linalg.norm(outline.planes[:, :3], axis=1)
        spread = np.einsum("t,tci,tcj->ij", weights, corners, corners)
        middles = corners.mean(axis=1)
        spread += 9.0 * np.einsum("t,ti,tj->ij", weights, middles, middles)

        def turn(by: Array) -> Array:
            return Rotation.from_rotvec(by).as_matrix()

        def alike(R: Array) -> bool:
            turned = TriangleMesh(outline.vertices @ R.T, outline.triangles)
            off = surface_distance(outline, outline_from_mesh(turned))
            return off <= 0.005 * self.radius

        rotations, axes = [np.eye(3)], []
        for axis in np.linalg.eigh(spread)[1].T:
            # A radian is no part of a turn.
            if alike(turn(axis)):
                axes.append(axis)
                found = [24]
            else:
                found = [n for n in (2, 3, 4, 5, 6, 8) if alike(turn(2.0 * np.pi / n * axis))]
            own = [turn(2.0 * np.pi * k / n * axis) for n in found for k in range(1, n)]
            products = [*rotations, *(one @ R for R in rotations for one in own)]
            rotations = apart_from_before(
                products, lambda R, other: bool(np.trace(R.T @ other) < 2.999)
            )
        turns = np.tile(np.eye(4), (len(rotations), 1, 1))
        turns[:, :3, :3] = rotations
        return self._X_TO @ turns @ inverse_transforms(self._X_TO), np.array(axes).reshape(-1, 3)


def distinct_turns(turns: Array, axes: Array) -> Array:
    """(n, 4, 4) those of some motions that differ in more than a turn about axes (k, 3)."""
    if not len(axes):
        return turns
    points = axes @ np.swapaxes(turns[:, :3, :3], 1, 2)
    # Where the axes point is all that is seen of a round object's turn.
    pointing = apart_from_before(
        range(len(turns)), lambda i, j: bool(np.abs(points[i] - points[j]).max() > 0.1)
    )
    return turns[pointing]


def stands_still(robot: ArticulatedModel, link: str) -> SettingsError:
    """What is said of a link that no joint moves."""
    return SettingsError(
        f"{robot.path}: no joint moves link '{link}', so a camera on it stands still: leave "
        "--on out"
    )


def turns_between(R_WL: Array) -> Array:
    """(3,) how far a hand turns about its three main axes, from picture to picture [rad].

    Root mean squares of the turns between all pairs of its rotations R_WL (n, 3, 3), the largest
    first. Where the second one is 0 the hand turns about one axis alone.
    """
    pairs = list(combinations(range(len(R_WL)), 2))
    if not pairs:
        return np.zeros(3)
    i, j = np.array(pairs).T
    turns = Rotation.from_matrix(np.swapaxes(R_WL[i], 1, 2) @ R_WL[j]).as_rotvec()
    spread = np.sqrt(np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1].clip(min=0.0))
    return np.asarray(spread)


def require_turns(
    camera: str,
    standing: StandingObject,
    frames: Sequence[PosedFrame],
    which: str = "",
    min_turn: float = 4.0,
) -> None:
    """Refuses frames from which a camera on a link cannot be told, whatever they show.

    min_turn: by how much the link must turn about a second axis [deg].

    Raises RegistrationError: says about what the link must turn.
    """
    what, values = "are too few", np.array([one.values for one in frames])
    if len(frames) >= 3:
        turns = np.degrees(turns_between(standing.hand_poses(values)[:, :3, :3]))
        if turns[1] >= min_turn:
            return
        what = (
            f"turn the link that it rides on by {turns[0]:.0f} degrees about one axis, and by "
            f"{turns[1]:.1f} about others"
        )
    raise RegistrationError(
        f"camera '{camera}': its {len(frames)} frames {which}{what}: where it is on the link, and "
        "where the object stands, is not determined by them; take three or more, five better, "
        "between which the link turns by 20 degrees and more about at least two axes. Nothing was "
        "written"
    )


Look = Array
"""(2, 4, 4): the camera's pose X_LC in the hand's frame, and the object's, X_WT."""


class ObjectSearch:
    """Finds where a camera is on a link of the robot, and where the object stands that it sees.

    standing: the object, and the robot before which it stands; alone: finds it in one picture.
    """

    def __init__(self, standing: StandingObject, alone: CameraSearch | None = None) -> None:
        self._standing, self._alone = standing, alone or CameraSearch(standing.alone)

    def rough(self) -> "ObjectSearch":
        """A search that is faster, and less sure."""
        return ObjectSearch(self._standing, self._alone.rough())

    def register(self, camera: PinholeCamera, frames: Sequence[PosedFrame]) -> RegisteredCamera:
        """Finds the camera's pose in the link's frame, and the object's in the world.

        Args:
            camera: its pose is not used.
            frames: at values of the object's tree.

        Raises:
            MaskError: a mask of another size than the camera's picture, or an empty one.
            RegistrationError: the frames that agree, or all, turn the link about one axis alone.
        """
        require_turns(camera.name, self._standing, frames)
        looks = self._search(camera, [[one] for one in spread(frames)])
        for rounds, spacing, surfaces in (
            (SEARCH.fine, SEARCH.fine_spacing, "few"),
            (SHARED.rounds_with_constants, LAST_SPACING, "all"),
        ):
            fits = [self._fit(camera, frames, look, spacing, surfaces) for look in looks]
            fitted = [
                self._look(fit, fit.fit(rounds), look)
                for fit, look in zip(fits, looks, strict=True)
            ]
            looks = self._distinct(fitted, frames)
        last = []
        for k, look in enumerate(looks):
            fit = self._fit(camera, frames, look)
            now = with_widths(fit)
            # Where it stands now is where a last fit finds it.
            looks[k] = self._look(fit, now, look)
            at = now._replace(shared=0.0 * now.shared)
            last.append((self._fit(camera, frames, looks[k]), at))
        found, covariance, as_good = describe_fitted(last)
        X_LC, X_WT = looks[as_good[0]]
        others = [X_WT @ turn for turn in distinct_turns(*self._standing.symmetry)[1:]]
        # Alternatives with another camera pose are listed with the camera.
        as_well = [looks[k] for k in as_good[1:]]
        others += [one[1] for one in as_well if not self._differ(one[:1], X_LC[None])]
        apart = [X[0] for X in self._apart([X[None] for X in (X_WT, *others)], np.eye(4)[None])]
        seen = ObjectPose(
            X_WT,
            self._standing.pose_covariance(X_WT, covariance[6:, 6:]),
            np.array(apart[1:]).reshape(-1, 4, 4),
            self._standing.symmetry[1],
        )
        agreeing = [one for one, fit in zip(frames, found.frames, strict=True) if fit.agrees]
        require_turns(camera.name, self._standing, agreeing, "that agree ")
        return replace(found, seen_object=seen)

    def choose(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        explained: float = 0.15,
    ) -> tuple[Look, int]:
        """Where camera and object are about, and of how many pictures this explains a region.

        Args:
            choices: of each picture regions any of which may be the object.
            explained: a region may be the object if its E_total is less.

        Raises RegistrationError: in no three pictures one of them turns as the link does.
        """
        look = self._search(camera, choices, explained)[0]
        seen = [own for own in choices if own]
        off = [self._misfits(camera, [own], look[None], SEARCH.second_side)[0] for own in seen]
        return look, int(np.count_nonzero(np.array(off) < explained))

    def _search(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        explained: float = 0.15,
        *,
        poses: int = 8,
        regions: int = 3,
        starts: int = 12,
        looks: int = 4,
    ) -> list[Look]:
        """Where the best one may be near, best first.

        Args:
            choices: of each picture masks, one of which may be the object's.
            explained: largest E_total of one of several masks that may be.
            poses, regions: numbers of the object's poses, and of masks, that are kept of a picture.
            starts, looks: numbers of looks that are fitted roughly, and that are kept.
        """
        turns = self._standing.symmetry[0]
        kept, X_CT = list[list[PosedFrame]](), list[Array]()
        body = self._standing.alone
        for own in choices:
            likely = []
            for one in own:
                alone = [PosedFrame(one.name, np.zeros(0), one.mask)]
                found = self._alone.search(camera, alone, poses)
                posed = PosedFrames(body.kinematics, body.very_few, camera, alone)
                off = float(E_total(areas(posed, np.array(found), SEARCH.second_side)).min())
                # A single one is known to be the object's.
                if len(own) == 1 or off < explained:
                    likely.append((off, one, found))
            likely = sorted(likely, key=lambda each: each[0])[:regions]
            if likely:
                kept.append([one for _, one, _ in likely])
                alike = [self._apart([X[None] for X in found], turns) for *_, found in likely]
                X_CT.append(np.concatenate([X for found in alike for X in found]))
        some = [own[0] for own in kept]
        X_WL = self._standing.hand_poses(np.array([one.values for one in some]))
        begun = hand_eye_starts(X_WL, X_CT, turns)
        if not len(begun):
            raise RegistrationError(
                f"camera '{camera.name}': in no three of its frames the object turns before the "
                "camera as the link does: are these masks of this object, did it stand still, are "
                "the joint positions those of these frames, and is it this link that the camera "
                "rides on? Nothing was written"
            )
        order = np.argsort(self._misfits(camera, kept, begun, SEARCH.first_side), kind="stable")
        fitted = []
        for look in self._distinct(begun[order[: 10 * starts]], some)[:starts]:
            # Of each picture's masks that which the look explains best.
            by = [[self._misfit(camera, one, look[None])[0] for one in own] for own in kept]
            chosen = [own[int(np.argmin(each))] for own, each in zip(kept, by, strict=True)]
            fit = self._fit(camera, chosen, look, SEARCH.coarse_spacing, "very_few")
            fitted.append(self._look(fit, fit.fit(SEARCH.coarse), look))
        misfits = self._misfits(camera, kept, np.array(fitted), SEARCH.second_side)
        # Those are none that are much worse.
        limit = 0.02 + 2.0 * float(misfits.min())
        order = np.argsort(misfits, kind="stable")
        best = [fitted[k] for k in order if misfits[k] <= limit]
        return self._distinct(best, some)[:looks]

    def _misfits(
        self,
        camera: PinholeCamera,
        choices: Sequence[Sequence[PosedFrame]],
        looks: Array,
        side: float,
    ) -> Array:
        """(n,) E_total of looks (n, 2, 4, 4) in the mean of pictures, each by its best mask."""
        off = [
            np.min([self._misfit(camera, one, looks, side) for one in own], axis=0)
            for own in choices
        ]
        return np.asarray(np.mean(off, axis=0))

    def _misfit(
        self, camera: PinholeCamera, one: PosedFrame, looks: Array, side: float = SEARCH.second_side
    ) -> Array:
        """(n,) E_total of looks (n, 2, 4, 4) in a frame, one at most."""
        body = self._standing.alone
        alone = PosedFrame(one.name, np.zeros(0), one.mask)
        posed = PosedFrames(body.kinematics, body.very_few, camera, [alone])
        X_CT = self.seen_from(looks, one.values)
        return np.minimum(E_total(areas(posed, X_CT, side))[:, 0], 1.0)

    def seen_from(self, looks: Array, values: Array) -> Array:
        """(n, 4, 4) the object's poses X_CT in a camera at values (m,), of looks (n, 2, 4, 4)."""
        X_WL = self._standing.hand_poses(values[None])[0]
        return np.asarray(inverse_transforms(X_WL @ looks[:, 0]) @ looks[:, 1])

    def _fit(
        self,
        camera: PinholeCamera,
        frames: Sequence[PosedFrame],
        look: Look,
        spacing: float = LAST_SPACING,
        surfaces: str = "all",
    ) -> SharedFit:
        """A fit of camera and object that begins where a look has them."""
        body = self._standing.body(look[1])
        seen = PosedFrames(body.kinematics, getattr(body, surfaces), camera, frames, spacing)
        return SharedFit([seen], [inverse_transforms(look[0])], TARGET_POSITIONS)

    def _look(self, fit: SharedFit, found: Shared, look: Look) -> Look:
        """What was found from where a look has camera and object."""
        moved = self._standing.moved(look[1], found.shared[fit.per_camera :])
        return np.array([fit.cameras(found)[0].X_WC, moved])

    def _distinct(self, looks: Sequence[Look] | Array, frames: Sequence[PosedFrame]) -> list[Look]:
        """Those of some looks that see the object otherwise than all before them.

        An object that looks alike after a turn is the same.
        """
        X_WL = self._standing.hand_poses(np.array([one.values for one in frames]))
        X_CT = [inverse_transforms(X_WL @ X_LC) @ X_WT for X_LC, X_WT in looks]
        kept = self._apart(X_CT, self._standing.symmetry[0])
        return [look for look, X in zip(looks, X_CT, strict=True) if any(X is one for one in kept)]

    def _apart(self, poses: Sequence[Array], turns: Array) -> list[Array]:
        """Those of some poses (n, 4, 4) of the object that are apart from all before them.

        turns: (t, 4, 4) after which they are the same.
        """
        return apart_from_before(
            poses, lambda X, other: all(self._differ(X, other @ turn) for turn in turns)
        )

    def _differ(self, X: Array, others: Array) -> bool:
        """Whether poses (n, 4, 4) put the object's ball elsewhere, by .15 of its radius."""
        by = np.asarray(X - others)[:, :3]
        shift = by[:, :, :3] @ self._standing.middle + by[:, :, 3]
        turn = (by[:, :, :3] ** 2).sum(axis=(1, 2)) / 3.0 * self._standing.radius**2
        off = np.sqrt(((shift**2).sum(axis=1) + turn).mean())
        return bool(off > 0.15 * self._standing.radius)


def hand_eye_starts(X_WL: Array, X_CT: Sequence[Array], turns: Array, triples: int = 24) -> Array:
    """(n, 2, 4, 4) looks that three pictures each say, those that turn the hand most first.

    Args:
        X_WL: (frames, 4, 4) the hand's poses.
        X_CT: for each frame (k, 4, 4) poses of the object in the camera, one of them about right.
        turns: (t, 4, 4) motions in the object's frame after which it looks alike.
        triples: number of sets of three pictures.
    """
    threes = list(combinations(range(len(X_WL)), 3))
    if len(threes) > triples:
        drawn = np.random.default_rng(0).permutation(len(threes))
        # Triples without rotation are drawn too often otherwise.
        threes = [threes[k] for k in drawn[: 4 * triples]]
    told = [turns_between(X_WL[list(three), :3, :3])[1] for three in threes]
    chosen = [threes[k] for k in np.argsort(told)[::-1][:triples]]
    turned = [(one[:, None] @ turns).reshape(-1, 4, 4) for one in X_CT]
    # The object's frame is as it is in the first one, however it looks.
    found = [_of_three(X_WL[[i, j, k]], (X_CT[i], turned[j], turned[k])) for i, j, k in chosen]
    return np.concatenate(found)


def _of_three(
    X_WL: Array, X_CT: Sequence[Array], most: int = 500, angle: float = float(np.radians(20.0))
) -> Array:
    """What three pictures say: for those of the object's poses that turn as the hand does.

    most: maximum number; angle: by which motions of hand and object may differ [rad].
    """
    pairs = ((0, 1), (0, 2), (1, 2))
    A = np.array([np.linalg.inv(X_WL[j]) @ X_WL[i] for i, j in pairs])
    a = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    offs = []
    for (i, j), turned in zip(pairs, np.linalg.norm(a, axis=1), strict=True):
        traces = np.einsum("nij,mij->nm", X_CT[i][:, :3, :3], X_CT[j][:, :3, :3])
        offs.append(np.abs(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)) - turned))
    off = np.maximum(np.maximum(offs[0][:, :, None], offs[1][:, None]), offs[2][None])
    kept = np.argsort(off, axis=None)[: min(most, np.count_nonzero(off <= angle))]
    rows = np.unravel_index(kept, off.shape)
    poses = np.stack([one[row] for one, row in zip(X_CT, rows, strict=True)], axis=1)
    B = np.stack([poses[:, j] @ inverse_transforms(poses[:, i]) for i, j in pairs], axis=1)
    b = Rotation.from_matrix(B[:, :, :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(-1, 3, 3)
    # Rotations R with a = R b in least squares.
    R_LC = _nearest_rotations(np.einsum("pi,npj->nij", a, b))
    M = np.broadcast_to((A[:, :3, :3] - np.eye(3)).reshape(9, 3), (len(kept), 9, 3))
    t = (np.einsum("nij,npj->npi", R_LC, B[:, :, :3, 3]) - A[:, :3, 3]).reshape(-1, 9)
    X_LC = np.tile(np.eye(4), (len(kept), 1, 1))
    X_LC[:, :3, :3] = R_LC
    X_LC[:, :3, 3] = np.einsum("nij,nj->ni", np.linalg.pinv(M, rcond=1e-3), t)
    X_WT = (X_WL @ X_LC[:, None] @ poses).mean(axis=1)
    X_WT[:, :3, :3] = _nearest_rotations(X_WT[:, :3, :3])
    return np.stack([X_LC, X_WT], axis=1)


def _nearest_rotations(M: Array) -> Array:
    """(n, 3, 3) the rotations nearest to matrices (n, 3, 3)."""
    U, _, V = np.linalg.svd(M)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ V))[:, None]
    return np.asarray(U @ V)


def find_in_pictures(
    standing: StandingObject,
    camera: PinholeCamera,
    pictures: Sequence[PosedPicture],
    most: int = 15,
    min_iou: float = 0.8,
) -> list[PosedFrame]:
    """The pictures that show an object, with masks of it.

    Args:
        camera: its pose is not used.
        pictures: at values of the object's tree; the first ones carry the search.
        most: regions of a picture that may be the object.
        min_iou: least overlap of a mask by colours with the object where it was found.

    Raises RegistrationError: the link hardly turns, or no pose explains enough of the pictures.
    """
    choices = [
        [PosedFrame(one.name, one.values, region) for region in find_regions(one.picture, most)]
        for one in pictures[: PICTURES.searched]
    ]
    require_turns(camera.name, standing, [own[0] for own in choices if own])
    search = ObjectSearch(standing)
    look, count = search.choose(camera, choices)
    require_seen(camera.name, count, len(choices))
    light = np.eye(3, 4, dtype=np.float32)
    shows, shown = np.zeros((camera.height, camera.width), np.bool_), []
    for one in pictures:
        covered = draw_mask(standing.alone.all, search.seen_from(look[None], one.values), camera)
        # Its own colours there, and those beside it, say where its mask ends.
        known = KnownBackground.of([one.picture], [light], shows[None], covered[None])
        frame = see_picture(one, known, light, covered)
        if frame is not None and intersection_over_union(frame.mask, covered) > min_iou:
            shown.append(replace(frame, foreground=None))
    return shown


def require_seen(camera: str, count: int, of: int, least: int = 4, share: float = 0.5) -> None:
    """Refuses (RegistrationError) a pose that explains too few of a number of pictures."""
    if count < max(least, share * of):
        raise RegistrationError(
            f"camera '{camera}': no pose of the target explains its pictures: the best one does so "
            f"with {count} of {of}, and {least} and {share:.0%} at least are needed: is this the "
            "target's model, does it stand still and differ from what is behind it, are the joint "
            "positions those of these pictures, is it this link that the camera rides on, and is "
            "the focal length about right? Or give masks. Nothing was written"
        )
