"""Find and correct large errors of a scene, and diagnose all frames with the corrections."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drake_pose.arrays import Array
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, MaskError, RegistrationError
from drake_pose.files.settings import percent
from drake_pose.jobs.registration.diagnosis import (
    base_motion,
    compare_camera,
    lack_of_evidence,
    last_before_change,
    require_seen_by,
)
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.readings import (
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
    # Corrections of what is given, in the order in which they are applied; () for none.
    corrections: tuple[Correction, ...]
    fit: PerFrameFit  # Fits single frames with `cameras`.
    at: Array  # (p,) the fit's corrections at which the frames were fitted.
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
        """Return a frame of the given scene with all corrections applied but those of lengths."""
        frame = apply_corrections(self.corrections, frame)
        return replace(frame, values=self.fit.values_at(frame.values, self.at))

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
        sample = map(inputs.read, evenly_spaced(inputs.audited_frames, sample_size))
        self._sample = [frame for frame in sample if frame.masks]

    def run(self) -> SceneFit:
        """Return the scene's final fit and diagnosis.

        At most three large errors are corrected, one after another.

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
            return self._finish(self._correct(unseen, 2))
        given = self._compare(inputs.known_cameras, ())
        now = self._correct(given, 3)
        if now.is_doubtful:
            # Corrections that leave most frames unexplained are dropped.
            placed = None if inputs.recordings else self._compare_registered(given.cameras)
            now = given if placed is None else self._correct(placed, 3)
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
            finding = Finding("reading", correction.name)
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
        """Return the fit with up to `most` more corrections, each fitted to its end."""
        for _ in range(most):
            correction = self._find_correction(now)
            if correction is None:
                break
            at = now.at.copy()
            rows = [now.fit.names.index(name) for name in correction.fitted]
            at[rows] += correction.amount / now.fit.deviations[rows]
            if correction.kind in ("sign", "log"):
                # An offset was added before the sign was changed, and is part of other positions.
                at[now.fit.names.index(correction.name)] *= (
                    -1.0 if correction.kind == "sign" else 0.0
                )
            # Corrections of cameras are sought before others only.
            cameras = now.cameras if rows or at.any() else correction.cameras
            corrections = now.corrections if rows else (*now.corrections, correction)
            again = self._settle(self._compare(cameras, corrections, at))
            if again.inlier_ratio <= now.inlier_ratio:
                break
            if not now.is_doubtful:
                before = now.joint_inlier_ratios[correction.name]
                after = again.joint_inlier_ratios[correction.name]
                if LARGE.outlier_reduction * (1.0 - after) > 1.0 - before:
                    break
            now = self._record(now, again, correction)
        return self._settle(now)

    def _settle(self, now: SceneFit, least: float = 0.1) -> SceneFit:
        """Return the fit at the corrections that it found: what is wrong is not linear.

        least: how far outlines move at least [pixel]; frames are fitted again eight times at most.
        """
        for _ in range(8):
            if now.found.remaining < least:
                break
            again = self._compare(now.cameras, now.corrections, now.found.corrections)
            if again.is_doubtful and again.inlier_ratio <= now.inlier_ratio:
                break
            now = replace(again, findings=now.findings, warnings=now.warnings)
        return now

    def _finish(self, now: SceneFit) -> SceneFit:
        """Return the fit with warnings of masks, and with all findings in its diagnosis.

        To the diagnosis are added the corrections, links with another shape, and moved cameras or
        bases.
        """
        found = now.found
        findings = [*now.findings]
        # A joint searched in each frame is known only to the search's step: drop its fitted offset.
        by_search = {("joint", finding.name) for finding in findings if finding.kind == "log"}
        common = tuple(one for one in found.common if (one.kind, one.name) not in by_search)
        found = replace(found, common=common)
        known = {finding.link for finding in findings if finding.link}
        for k, ratio in () if now.is_doubtful else mismatched_links(now.fits):
            node = self.body.tree.nodes[k].name
            if node not in known:
                text = (
                    f"{percent(ratio)} of its outline fit in all frames, and other positions of "
                    "its joint do not improve that: is its shape the model's?"
                )
                findings.append(Finding("link", node, link=node, text=text))
        moved, found = self._find_moved(now, found)
        wrong = next((finding for finding in findings if finding.kind in ("sign", "log")), None)
        if wrong is not None:
            # With a wrong column of the log, every frame is an outlier as given.
            frames = [one if one.finding else replace(one, finding=wrong) for one in found.frames]
            found = replace(found, frames=tuple(frames))
        common = (*findings, *moved, *found.common)
        warnings = (*now.warnings, *self._mask_warnings(now))
        return replace(now, found=replace(found, common=common), findings=(), warnings=warnings)

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
            again = diagnose_frames(now.fit, [now.fits[k] for k in rows], now.at, moved=True)
            motions, names = list(again.common), [*{frame.frame for frame in again.frames}]
            if again.outliers or any(motion.kind not in ("camera", "base") for motion in motions):
                frames = [now.corrected(self._inputs.read(found.frames[k].frame)) for k in rows]
                given = [one for one in now.fit.cameras_at(now.at) if one.name in cameras]
                placed = self._register(frames, given)
                motions = [off for _, off in placed.values()]
                base = base_motion([(k, placed[k.name][0]) for k in given if k.name in placed])
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
        self, frames: Sequence[MultiViewFrame], cameras: Sequence[Camera]
    ) -> dict[str, tuple[RegisteredCamera, Finding]]:
        """Register cameras from frames, and return the cameras that differ from their given poses.

        ``frames``: with masks of the cameras. ``cameras``: at their given poses; those with
        fewer than three frames are left out. Returns by name the registered camera, and a finding
        of its difference from the given pose.
        """
        search, placed = CameraSearch(self.body), dict[str, tuple[RegisteredCamera, Finding]]()
        for camera in cameras:
            posed = [frame.of(camera.name) for frame in frames if camera.name in frame.masks]
            posed = evenly_spaced(posed, LARGE.frame_count)
            if not isinstance(camera, PinholeCamera) or len(posed) < 3:
                continue
            try:
                found = search.register(camera, posed)
            except RegistrationError:
                continue
            inliers = len(found.frames) - len(found.outliers)
            if lack_of_evidence(search, found, posed) is not None or 2 * inliers <= len(posed):
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

    def _compare(
        self,
        cameras: Sequence[Camera],
        corrections: tuple[Correction, ...],
        at: Array | None = None,
    ) -> SceneFit:
        """Return all frames fitted and diagnosed with corrections.

        cameras: the corrected cameras. at: (p,) corrections of the fit; None: 0.

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
        at = np.zeros(len(fit.names)) if at is None else at
        placed = fit.cameras_at(at)
        for done, name in enumerate(inputs.audited_frames, 1):
            frame = inputs.read(name)
            if frame.masks:
                frame = apply_corrections(corrections, frame)
                fitted.append(fit.fit(frame, at))
                values = fit.values_at(frame.values, at)
                for camera in placed:
                    mask = frame.masks.get(camera.name)
                    if mask is None and (camera.name, name) in inputs.scene.masks:
                        mask = np.zeros((camera.height, camera.width), bool)
                    if mask is not None:
                        own = mask_excess_and_lack(body, camera, values, mask, fit.size)
                        mask_areas[camera.name, name] = own if mask.any() else (np.nan, own[1])
            else:
                empty.append(name)
            if self._on_frame is not None and not corrections and not at.any():
                self._on_frame(done)
        found = diagnose_frames(fit, fitted, at)
        return SceneFit(
            tuple(cameras), corrections, fit, at, tuple(fitted), mask_areas, tuple(empty), found
        )

    def _find_correction(self, now: SceneFit) -> Correction | None:
        """Return one more correction for a fit; None: nothing is doubtful, or none is found."""
        sample = [now.corrected(frame) for frame in self._sample]
        cameras, joints = now.fit.cameras_at(now.at), now.fit.joints
        if now.is_doubtful:
            of_scene = not now.corrections and not now.at.any()
            return self._search(cameras, joints, LARGE.max_remaining, sample, of_scene)
        ratios = now.joint_inlier_ratios.items()
        doubted = [name for name, ratio in ratios if ratio < LARGE.min_joint_inlier_ratio]
        if not doubted:
            return None
        return self._search(cameras, doubted, LARGE.max_remaining_of_joint, sample, False)

    def _search(
        self,
        cameras: Sequence[Camera],
        joints: Sequence[str],
        left: float = LARGE.max_remaining,
        sample: Sequence[MultiViewFrame] | None = None,
        scene: bool = True,
    ) -> Correction | None:
        """Return the correction found by ``LargeErrorSearch.find``, or None.

        Args:
            cameras: the cameras as corrected so far.
            joints, left: `joints` and `max_remaining` of that function.
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
        return search.find(corrections, joints, left)

    def _record(self, before: SceneFit, now: SceneFit, correction: Correction) -> SceneFit:
        """Return the fit `now` with its last correction recorded as a finding, or as a warning.

        before: the fit without the correction. correction: offsets and focal lengths are among the
            fit's findings.
        """
        kind, name, warnings = correction.kind, correction.name, before.warnings
        findings = before.findings
        if not correction.fitted:
            finding = Finding(kind, name, 0.0, 0.0, 0.0, 0.0, self._pixels(before, now), 0.0)
            if kind in ("sign", "log"):
                finding = self._differing(finding, before, correction)
            else:
                ratio, given = percent(now.inlier_ratio), percent(before.inlier_ratio)
                warnings = (*warnings, f"{name}; so {ratio} of the contours fit, as given {given}")
            findings = (*findings, finding)
        return replace(now, findings=findings, warnings=warnings)

    def _differing(self, off: Finding, before: SceneFit, correction: Correction) -> Finding:
        """Return a finding with a joint's largest difference from its log, as number and in words.

        ``off``: the finding, without a size. ``before``: the fit without the correction.
        ``correction``: of kind "sign" or "log".
        """
        j = self.body.kinematics.names.index(correction.name)
        frames = [before.corrected(frame) for frame in self._sample]
        logged = np.array([frame.values[j] for frame in frames])
        by = np.array([correction.apply(frame).values[j] for frame in frames]) - logged
        turns = bool(self.body.kinematics.is_angle[j])
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
            placed = (one.fit.cameras_at(one.at) for one in (before, now))
            for one, other in zip(*placed, strict=True):
                places = [
                    camera.project(placed_points(self.body.coarse, X_WN))[0]
                    for camera, X_WN in zip((one, other), X, strict=True)
                ]
                squared = ((places[0] - places[1]) ** 2).sum(axis=1)
                squares.append(np.minimum(squared, one.width**2 + one.height**2))
        moved = np.concatenate(squares)
        moved = moved[moved > 0.01]
        return float(np.sqrt(moved.mean())) if len(moved) else 0.0
