"""Find and correct large errors of a scene, and diagnose all frames with the corrections."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, MaskError, RegistrationError
from drake_pose.files.settings import percent
from drake_pose.jobs.registration.diagnosis import (
    base_motion,
    compare_camera,
    explain_misfit,
    last_before_change,
    require_seen_by,
)
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.readings import (
    focal_correction,
    joint_exchanges,
    scene_corrections,
    shift_correction,
)
from drake_pose.registration.diagnosis import DIAGNOSIS, diagnose_frames
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.registration.large_errors import (
    LARGE,
    Correction,
    LargeErrorSearch,
    apply_corrections,
    joint_inlier_ratios,
    mask_excess_and_lack,
    mismatched_links,
)
from drake_pose.registration.per_frame_fit import FrameFit, PerFrameFit
from drake_pose.registration.posed_frames import MultiViewFrame, placed_points
from drake_pose.registration.register import (
    CameraSearch,
    RegisteredCamera,
    RegistrationBody,
    evenly_spaced,
)
from drake_pose.silhouette.pictures.scene_checks import frame_ranges


@dataclass(frozen=True, eq=False)
class SceneFit:
    """All frames fitted with the given scene, or with a corrected one."""

    cameras: tuple[Camera, ...]  # The corrected cameras.
    # The corrections, in the order in which they are applied; () for none.
    corrections: tuple[Correction, ...]
    fit: PerFrameFit  # Fits single frames with `cameras`.
    fits: tuple[FrameFit, ...]  # The fitted frames: all frames with a mask that is not empty.
    # By camera and frame name, excess and lack of the mask over its area, see
    # ``mask_excess_and_lack``; the excess of a black mask is NaN.
    mask_areas: Mapping[tuple[str, str], tuple[float, float]]
    empty_frames: tuple[str, ...]  # Names of frames whose masks are all empty.
    found: Diagnosis  # The diagnosis of the fitted frames.
    # The corrections as findings; () in a final result, where `found` includes them.
    findings: tuple[Finding, ...] = ()
    warnings: tuple[str, ...] = ()  # For the user.

    def corrected(self, frame: MultiViewFrame) -> MultiViewFrame:
        """Return a frame of the given scene with all corrections applied."""
        return apply_corrections(self.corrections, frame)

    def joint_off(self, name: str) -> Finding | None:
        """Return the finding of a large offset of a joint, by name; None: it has no large offset.

        Fits are linear: they should restart from a large offset.
        """
        offsets = [one for one in self.found.common if (one.kind, one.name) == ("joint", name)]
        return next(
            (one for one in offsets if abs(one.angle) > np.radians(LARGE.restart_angle)), None
        )

    @property
    def focal_off(self) -> Finding | None:
        """The finding of a large error of a focal length; None: none is large."""
        findings = [finding for finding in self.found.common if finding.kind == "focal"]
        return next((one for one in findings if abs(one.shift) > LARGE.restart_focal), None)

    @property
    def joint_inlier_ratios(self) -> dict[str, float]:
        """By joint, the inlier ratio of the outlines of all links that the joint moves."""
        return joint_inlier_ratios(self.fits, self.fit.joints)

    @property
    def is_doubtful(self) -> bool:
        """Whether half of the frames or more are outliers."""
        return 2 * len(self.found.outliers) >= len(self.found.frames)

    @property
    def inlier_ratio(self) -> float:
        """Mean inlier ratio of all masks, each frame fitted by itself."""
        return float(np.mean([v for fit in self.fits for v in fit.inlier_ratios[1].values()]))


class SceneComparison:
    """Compares a scene with its masks, corrects large errors, and compares again.

    Args:
        inputs: the scene.
        on_frame: called with the number of frames that are done in the first comparison; None: not.
        sample_size: maximum number of frames, evenly spaced, that give the silhouettes' size, and
            in which errors are searched.
    """

    def __init__(
        self,
        inputs: RegistrationInputs,
        on_frame: Callable[[int], None] | None = None,
        sample_size: int = 20,
    ) -> None:
        self._inputs, self._on_frame = inputs, on_frame
        self.body = RegistrationBody(inputs.tree, inputs.visible_nodes)
        names = evenly_spaced(inputs.audited_frames, sample_size)
        sample = [inputs.read(name) for name in names]
        self._sample = [frame for frame in sample if frame.masks]

    def run(self, most: int = 3) -> SceneFit:
        """Return the scene's final fit and diagnosis.

        most: maximum number of large errors that are corrected, one after another.

        Raises CameraError: a camera cannot show the robot from its given pose; MaskError: no mask
        shows the body.
        """
        inputs = self._inputs
        try:
            require_seen_by(self.body, inputs.known_cameras, self._sample)
        except CameraError as error:
            unseen = None if inputs.recordings else self._search_unseen(str(error))
            if unseen is None:
                raise
            return self._finish(self._correct(unseen, most - 1))
        given = self._compare(inputs.known_cameras, ())
        now = self._correct(given, most)
        if now.is_doubtful:
            # Corrections that leave most frames unexplained are dropped.
            placed = None if inputs.recordings else self._compare_registered(given.cameras)
            now = given if placed is None else self._correct(placed, most)
        if now.is_doubtful and not inputs.recordings:
            shift = shift_correction(self.body, given.cameras, self._sample)
            if shift is not None:
                now = self._record(given, self._compare(shift.cameras, (shift,)), shift)
        return self._finish(given if now.is_doubtful else now)

    def _search_unseen(self, why: str) -> SceneFit | None:
        """Return the fit of a scene in which a given camera cannot show the robot, or None.

        Another reading of the cameras' poses is tried, then cameras are registered. None: neither
        explains most frames.

        why: why the camera cannot show the robot, in words.
        """
        given = self._inputs.known_cameras
        if (correction := self._search(given, [])) is not None:
            finding = Finding("reading", correction.name, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            reread = self._compare(correction.cameras, (correction,))
            if not reread.is_doubtful:
                return replace(reread, findings=(finding,), warnings=(f"as given, {why}",))
        now = self._compare_registered(given)
        if now is None or now.is_doubtful:
            return None
        return replace(now, warnings=(f"as given, {why}",))

    def _compare_registered(self, given: Sequence[Camera]) -> SceneFit | None:
        """Return the fit with cameras registered where they differ from their given poses.

        The differences are its findings. None: no camera differs.
        """
        placed = self._register(self._sample, given)
        if not placed:
            return None
        cameras = [placed[one.name][0].camera if one.name in placed else one for one in given]
        return replace(self._compare(cameras, ()), findings=tuple(k for _, k in placed.values()))

    def _correct(self, now: SceneFit, most: int) -> SceneFit:
        """Return the fit with up to `most` more corrections, which its findings record."""
        for _ in range(most):
            correction = self._find_correction(now)
            if correction is None:
                break
            again = self._compare(correction.cameras, (*now.corrections, correction))
            fitted = now.joint_off(correction.name) if correction.kind == "offset" else None
            if correction.kind == "focal":
                fitted = now.focal_off
            if fitted is not None and (fitted.angle + fitted.shift) * correction.amount > 0.0:
                now = self._record(now, again, correction, fitted)
                continue
            if again.inlier_ratio <= now.inlier_ratio:
                break
            if not now.is_doubtful:
                before, after = (
                    now.joint_inlier_ratios[correction.name],
                    again.joint_inlier_ratios[correction.name],
                )
                if LARGE.outlier_reduction * (1.0 - after) > 1.0 - before:
                    break
            now = self._record(now, again, correction)
        return now

    def _finish(self, now: SceneFit) -> SceneFit:
        """Return the fit with warnings of masks, and with all findings in its diagnosis.

        To the diagnosis are added the corrections, links with another shape, and moved cameras or
        bases.
        """
        found = now.found
        remaining = {(finding.kind, finding.name): finding for finding in found.common}
        findings = [
            _add_remaining(one, remaining.pop((one.kind, one.name), None)) for one in now.findings
        ]
        # A joint searched in each frame is known only to the search's step: drop its fitted offset.
        by_search = {("joint", finding.name) for finding in now.findings if finding.kind == "log"}
        common = tuple(one for key, one in remaining.items() if key not in by_search)
        found = replace(found, common=common)
        known = {finding.link for finding in findings if finding.link}
        for k, ratio in () if now.is_doubtful else mismatched_links(now.fits):
            node = self.body.tree.nodes[k].name
            if node not in known:
                text = (
                    f"{percent(ratio)} of its outline fit in all frames, and other positions of "
                    "its joint do not improve that: is its shape the model's?"
                )
                shape = Finding("link", node, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, link=node, text=text)
                findings.append(shape)
        moved, found = self._find_moved(now, found)
        wrong = next((finding for finding in findings if finding.kind in ("sign", "log")), None)
        if wrong is not None:
            # With a wrong column of the log, every frame is an outlier as given.
            frames = [one if one.finding else replace(one, finding=wrong) for one in found.frames]
            found = replace(found, frames=tuple(frames))
        common = (*findings, *moved, *found.common)
        warnings = (*now.warnings, *self._mask_warnings(now))
        # The minimum detectable offset is unknown where too little of the outlines fits.
        ratios = now.joint_inlier_ratios
        enough = LARGE.min_joint_inlier_ratio * max(ratios.values(), default=0.0)
        detectable = {
            name: least if ratios.get(name, 0.0) >= enough else np.inf
            for name, least in found.minimum_detectable.items()
        }
        found = replace(found, common=common, minimum_detectable=detectable)
        return replace(now, found=found, findings=(), warnings=warnings)

    def _find_moved(self, now: SceneFit, found: Diagnosis) -> tuple[list[Finding], Diagnosis]:
        """Find cameras or a base that moved between two frames.

        A motion is found if the first or the last of the frames with the same cameras are outliers
        that agree with each other at another pose of a camera or of the base.

        ``now``: the scene's fit. ``found``: its diagnosis, with the findings that are known so far.
        Returns the motions, of kind "moved"; and the diagnosis with them as the outliers' findings.
        """
        moved, explained = list[Finding](), dict[str, Finding]()
        for cameras in dict.fromkeys(tuple(frame.given_ratios) for frame in found.frames):
            group = [k for k, one in enumerate(found.frames) if {*one.given_ratios} == {*cameras}]
            wrong = [found.frames[k].finding is not None for k in group]
            before = last_before_change(wrong)
            if before is None:
                continue
            rows = [group[k] for k in np.flatnonzero(wrong)]
            last = found.frames[group[before]].frame
            again = diagnose_frames(now.fit, [now.fits[k] for k in rows], moved=True)
            motions, names = list(again.common), [*{frame.frame for frame in again.frames}]
            if again.outliers or any(motion.kind not in ("camera", "base") for motion in motions):
                frames = [now.corrected(self._inputs.read(found.frames[k].frame)) for k in rows]
                given = [camera for camera in now.cameras if camera.name in cameras]
                placed = self._register(frames, given)
                motions = [off for _, off in placed.values()]
                base = base_motion(
                    {camera.name: camera for camera in given},
                    {k: one for k, (one, _) in placed.items()},
                )
                if base is not None and len(placed) == len(cameras):
                    motions = [replace(base, pixels=motions[0].pixels)]
            when = "since then" if found.frames[-1].finding is not None else "until then"
            for motion in motions:
                finding = replace(
                    motion, kind="moved", text=f"after frame '{last}'; {when}", link=motion.kind
                )
                moved.append(finding)
                explained.update(dict.fromkeys(names, finding))
        updated = [
            replace(frame, finding=explained[frame.frame]) if frame.frame in explained else frame
            for frame in found.frames
        ]
        return moved, replace(found, frames=tuple(updated))

    def _register(
        self, frames: Sequence[MultiViewFrame], cameras: Sequence[Camera], least: int = 3
    ) -> dict[str, tuple[RegisteredCamera, Finding]]:
        """Register cameras from frames, and return the cameras that differ from their given poses.

        ``frames``: with masks of the cameras. ``cameras``: at their given poses. ``least``: minimum
        number of frames of each camera; others are left out. Returns by name the registered camera,
        and a finding of its difference from the given pose.
        """
        search, placed = CameraSearch(self.body), dict[str, tuple[RegisteredCamera, Finding]]()
        for camera in cameras:
            posed = [frame.of(camera.name) for frame in frames if camera.name in frame.masks]
            posed = evenly_spaced(posed, LARGE.frame_count)
            if not isinstance(camera, PinholeCamera) or len(posed) < least:
                continue
            try:
                found = search.register(camera, posed)
            except RegistrationError:
                continue
            inliers = len(found.frames) - len(found.outliers)
            if explain_misfit(found) is not None or 2 * inliers <= len(posed):
                continue
            values = np.array([one.values for one in posed])
            shift = compare_camera(self.body, camera, found, values, len(cameras) == 1)
            if shift.p_value <= DIAGNOSIS.significance and shift.pixels >= DIAGNOSIS.min_pixels:
                placed[camera.name] = found, shift
        return placed

    def _mask_warnings(
        self, now: SceneFit, more: float = 0.08, more_in_one: float = 0.15, less: float = 0.25
    ) -> list[str]:
        """Return warnings of masks that show more or less than the robot in inlier frames.

        Args:
            now: the scene's fit.
            more, more_in_one, less: minimum excess in half of the frames or more, minimum excess in
                fewer frames, and minimum lack [the mask's area]. Excess counts only if it is more
                than three times the lack, and the reverse. Real masks of arms have less than 0.02
                excess, and 0.15 lack at most.
        """
        texts, names, wrong = list[str](), self._inputs.scene.frames, now.found.outliers
        for camera in (camera.name for camera in now.cameras):
            areas = {frame: two for (name, frame), two in now.mask_areas.items() if name == camera}
            is_black = {frame: bool(np.isnan(extra)) for frame, (extra, _) in areas.items()}
            black = [frame for frame, (_, lack) in areas.items() if is_black[frame] and lack > less]
            shown = {k: two for k, two in areas.items() if not is_black[k] and k not in wrong}
            # A misplaced robot causes excess and lack alike: its frames are left out.
            wider = [k for k, (extra, lack) in shown.items() if extra >= more and 3 * lack < extra]
            if 2 * len(wider) < len(shown):
                wider = [k for k in wider if shown[k][0] >= more_in_one]
            lacking = [k for k, (extra, lack) in shown.items() if lack >= less and 3 * extra < lack]
            for frames, which, what in (
                (wider, 0, "show {} more than the robot: is it a shadow, another robot, or a part "
                 "that the model lacks?"),
                (lacking, 1, "lack {} of the robot: is something before it, or a link missing?"),
                (black, None, "are black, although the robot is in view"),
            ):  # fmt: skip
                if frames:
                    values = [] if which is None else [areas[k][which] for k in frames]
                    area = percent(float(np.median(values))) if values else ""
                    named = frame_ranges(frames, names)
                    said = f"the masks of frames {named} {what.format(area)}"
                    texts.append(f"camera '{camera}': {said}")
        return texts

    def _compare(self, cameras: Sequence[Camera], corrections: tuple[Correction, ...]) -> SceneFit:
        """Return all frames fitted and diagnosed with corrections.

        cameras: the corrected cameras.

        Raises MaskError: no mask shows the body.
        """
        inputs, fitted, empty = self._inputs, list[FrameFit](), list[str]()
        if not self._sample:
            raise MaskError(
                f"{inputs.scene.path}: no mask shows the body; it must be white in them"
            )
        body, sample = self.body, [apply_corrections(corrections, frame) for frame in self._sample]
        mask_areas = dict[tuple[str, str], tuple[float, float]]()
        fit = PerFrameFit(body.kinematics, (body.medium, body.full), cameras, sample)
        for done, name in enumerate(inputs.audited_frames, 1):
            frame = inputs.read(name)
            if frame.masks:
                frame = apply_corrections(corrections, frame)
                fitted.append(fit.fit(frame))
                for camera in cameras:
                    mask = frame.masks.get(camera.name)
                    if mask is None and (camera.name, name) in inputs.scene.masks:
                        mask = np.zeros((camera.height, camera.width), bool)
                    if mask is not None:
                        own = mask_excess_and_lack(body, camera, frame.values, mask, fit.size)
                        mask_areas[camera.name, name] = own if mask.any() else (np.nan, own[1])
            else:
                empty.append(name)
            if self._on_frame is not None and not corrections:
                self._on_frame(done)
        requested = [(_KINDS[one.kind], one.name) for one in corrections if one.kind in _KINDS]
        found = diagnose_frames(fit, fitted, requested)
        return SceneFit(
            tuple(cameras), corrections, fit, tuple(fitted), mask_areas, tuple(empty), found
        )

    def _find_correction(self, now: SceneFit) -> Correction | None:
        """Return one more correction for a fit; None: nothing is doubtful, or none is found."""
        sample = [now.corrected(frame) for frame in self._sample]
        if now.is_doubtful:
            of_scene = not now.corrections
            return self._search(now.cameras, now.fit.joints, LARGE.max_remaining, sample, of_scene)
        large = [name for name in now.fit.joints if now.joint_off(name) is not None]
        ratios = now.joint_inlier_ratios.items()
        doubted = [
            name for name, ratio in ratios if ratio < LARGE.min_joint_inlier_ratio or name in large
        ]
        if doubted:
            correction = self._search(
                now.cameras, doubted, LARGE.max_remaining_of_joint, sample, False, large
            )
            if correction is not None:
                return correction
        # Fits are linear: they restart from a large offset or focal length that they estimated.
        if large:
            size = next(finding.angle for finding in now.found.common if finding.name == large[0])
            search = LargeErrorSearch(self.body, now.cameras, sample)
            return search.joint_correction("offset", large[0], 1.0, size, 0.0)
        lens = now.focal_off
        if lens is None or any(correction.kind == "focal" for correction in now.corrections):
            return None
        group = [camera.name for camera in now.cameras if f"'{camera.name}'" in lens.name]
        return focal_correction(now.cameras, group, lens.name, 1.0 + lens.shift)

    def _search(
        self,
        cameras: Sequence[Camera],
        joints: Sequence[str],
        left: float = LARGE.max_remaining,
        sample: Sequence[MultiViewFrame] | None = None,
        scene: bool = True,
        likely: Collection[str] = (),
    ) -> Correction | None:
        """Return the correction found by ``LargeErrorSearch.find``, or None.

        Args:
            cameras: the cameras as corrected so far.
            joints, left, likely: `joints`, `max_remaining` and `likely` of that function.
            sample: frames as corrected so far; None: as given.
            scene: whether ``scene_corrections`` are tried, too; with pictures they never are.
        """
        inputs = self._inputs
        corrections = list[Correction]()
        if scene and not inputs.recordings:
            values = [inputs.read(name).values for name in inputs.audited_frames]
            corrections = list(scene_corrections(cameras, values, inputs.audited_frames))
            known = self.body.kinematics.names
            corrections += joint_exchanges(cameras, joints, [known.index(one) for one in joints])
        search = LargeErrorSearch(self.body, cameras, sample or self._sample)
        return search.find(corrections, joints, left, likely)

    def _record(
        self, before: SceneFit, now: SceneFit, correction: Correction, fitted: Finding | None = None
    ) -> SceneFit:
        """Return the fit `now` with its last correction recorded as a finding, or as a warning.

        Args:
            before: the fit without the correction.
            now: the fit with the correction.
            correction: the correction.
            fitted: the finding of `before` whose estimate is the correction; None: the correction
                was searched.
        """
        kind, name = _KINDS.get(correction.kind, correction.kind), correction.name
        warnings = before.warnings
        finding = Finding(kind, name, 0.0, 0.0, 0.0, 0.0, self._pixels(before, now), 0.0)
        if correction.kind in _KINDS:
            size, of_focal = correction.amount, correction.kind == "focal"
            if not of_focal and self._turns(name):
                finding = replace(finding, angle=size, angle_sd=float(np.radians(LARGE.fine_step)))
                if fitted is not None and abs(size - fitted.angle) < 1e-9:
                    finding = fitted
            else:
                step = LARGE.reach_focal if of_focal else LARGE.reach_shift
                finding = replace(finding, shift=size, shift_sd=step)
                if fitted is not None and abs(size - fitted.shift) < 1e-9:
                    finding = fitted
        elif kind in ("sign", "log"):
            finding = self._differing(finding, before, correction)
        else:
            ratio, given = percent(now.inlier_ratio), percent(before.inlier_ratio)
            warnings = (*warnings, f"{name}; so {ratio} of the contours fit, as given {given}")
        findings = list(before.findings)
        earlier = [
            one for one in findings if (one.kind, one.name) == (kind, name) == ("joint", name)
        ]
        if earlier:
            findings.remove(earlier[0])
            finding = replace(
                finding,
                angle=finding.angle + earlier[0].angle,
                alternatives=earlier[0].alternatives,
            )
        return replace(now, findings=(*findings, finding), warnings=warnings)

    def _turns(self, joint: str) -> bool:
        """Return whether the positions of a joint, given by name, are angles."""
        kinematics = self.body.kinematics
        return bool(kinematics.is_angle[kinematics.names.index(joint)])

    def _differing(self, off: Finding, before: SceneFit, correction: Correction) -> Finding:
        """Return a finding with a joint's largest difference from its log, as number and in words.

        ``off``: the finding, without a size. ``before``: the fit without the correction.
        ``correction``: of kind "sign" or "log".
        """
        j = self.body.kinematics.names.index(correction.name)
        frames = [before.corrected(frame) for frame in self._sample]
        logged = np.array([frame.values[j] for frame in frames])
        by = np.array([correction.apply(frame).values[j] for frame in frames]) - logged
        turns = self._turns(correction.name)
        unit, factor = ("degrees", 180.0 / np.pi) if turns else ("mm", 1e3)
        sizes = np.abs((by + np.pi) % (2.0 * np.pi) - np.pi if turns else by)
        text = f"it is {factor * sizes.min():.0f} to {factor * sizes.max():.0f} {unit} off"
        if correction.kind == "log":
            text += ", and neither a constant offset nor another sign explains that"
            if np.ptp(logged) < 1e-6:
                text += f"; the log has {logged[0]:.4g} in all frames"
        elif abs(correction.amount) > 1e-9:
            text += f"; to the reversed column add {factor * correction.amount:.0f} {unit}"
        angle, shift = (float(sizes.max()), 0.0) if turns else (0.0, float(sizes.max()))
        link = self.body.tree.nodes[self.body.kinematics.value_nodes[j]].name
        return replace(off, link=link, text=text, angle=angle, shift=shift)

    def _pixels(self, before: SceneFit, now: SceneFit) -> float:
        """Return the root mean square motion between two fits [pixel]; 0: nothing moves.

        Only points of the body that move by more than 0.1 pixels in a camera count.
        """
        squares, kinematics = list[Array](), self.body.kinematics
        for frame in self._sample:
            X = [kinematics.poses(one.corrected(frame).values) for one in (before, now)]
            for one, other in zip(before.cameras, now.cameras, strict=True):
                places = [
                    camera.project(placed_points(self.body.coarse, X_WN))[0]
                    for camera, X_WN in zip((one, other), X, strict=True)
                ]
                squared = ((places[0] - places[1]) ** 2).sum(axis=1)
                squares.append(np.minimum(squared, one.width**2 + one.height**2))
        moved = np.concatenate(squares)
        moved = moved[moved > 0.01]
        return float(np.sqrt(moved.mean())) if len(moved) else 0.0


def _add_remaining(finding: Finding, rest: Finding | None) -> Finding:
    """Return a correction's finding, to which the error that remained with it is added.

    Angles and shifts are added, factors of focal lengths multiplied. Standard deviations are those
    of the remaining error.

    finding: the correction's. rest: of the same kind and name; None: no error remained.
    """
    if rest is None:
        return finding
    shift = finding.shift + rest.shift
    if finding.kind == "focal":
        shift = (1.0 + finding.shift) * (1.0 + rest.shift) - 1.0
    angle = finding.angle + rest.angle
    total = replace(rest, angle=angle, shift=shift, pixels=finding.pixels)
    return replace(total, p_value=finding.p_value, alternatives=finding.alternatives)


_KINDS = {"offset": "joint", "focal": "focal"}
