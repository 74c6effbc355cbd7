"""Register the cameras of a scene or an episode."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array, Picture
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import RegistrationError, noted_warnings
from drake_pose.files.folder import write_file, writes_folder
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.estimate.inputs import missing_for_person
from drake_pose.jobs.registration.diagnosis import (
    Search,
    check_focal_length,
    known_camera_warnings,
    mirrored_cameras,
    require_determined,
    require_explained,
)
from drake_pose.jobs.registration.inputs import RegistrationInputs, read_inputs
from drake_pose.jobs.registration.lerobot_files import lerobot_files, require_data_set
from drake_pose.jobs.registration.pages import compared_frames
from drake_pose.jobs.registration.positions import (
    corrected_urdf,
    joint_shifts,
    make_registration_tree,
    still_joints,
)
from drake_pose.jobs.registration.result import (
    describe_camera,
    describe_parameters,
    describe_run,
    export_texts,
    write_result,
)
from drake_pose.jobs.registration.tracks import (
    by_link,
    describe_given,
    describe_pictures,
    describe_tracks,
    draw_tracks,
    find_in_pictures,
    given_on_link,
    picture_warnings,
    register_on_link,
    register_recordings,
    say_refused,
    track_warnings,
    watch_cameras,
)
from drake_pose.jobs.registration.words import (
    common_outlier_warnings,
    few_frames_warning,
    fit_of_inliers,
    frames_of_other_rows,
    likely_offset_warnings,
    lost_frames_warning,
    mode_warnings,
    odd_link_warnings,
    outlier_warnings,
    parameter_warnings,
    target_warnings,
    zero_warnings,
)
from drake_pose.person.pose_tracker import shape_parts, shape_values
from drake_pose.registration.joint_offsets import calibrate_joints
from drake_pose.registration.per_frame_fit import adjust_bundle
from drake_pose.registration.picture_acceptance import PictureRegistration, evaluate_pictures
from drake_pose.registration.picture_registration import offsets_in_pictures
from drake_pose.registration.posed_frames import MultiViewFrame, PosedFrames
from drake_pose.registration.register import (
    CameraSearch,
    E_total,
    RegisteredCamera,
    RegistrationBody,
    TargetPose,
    intersection_over_union,
    overlap_areas,
)
from drake_pose.registration.standing_object import (
    CalibrationTarget,
    TargetSearch,
    require_detections,
)
from drake_pose.registration.track_registration import TrackRegistration
from drake_pose.workers import use_workers


@dataclass(frozen=True, eq=False)
class SceneRegistration:
    """The registered cameras of a scene.

    Args:
        cameras: all cameras of the scene with a known pose, by name, in the scene's order.
        registered: the registered cameras by name, with how well they fit.
        summary: contents of summary.json.
        warnings: for the user.
        folder: the result's folder; None: nothing was written.
        refused: by camera name, why no pose of the camera was accepted.
    """

    cameras: Mapping[str, Camera]
    registered: Mapping[str, RegisteredCamera]
    summary: Mapping[str, Any]
    warnings: tuple[str, ...]
    folder: Path | None
    refused: Mapping[str, str]


@writes_folder
def register_scene(
    scene: Path | str,
    model: Path | str,
    joints: Path | str | None = None,
    out: Path | str | None = None,
    settings: RegistrationSettings | None = None,
    *,
    cameras: Path | str | None = None,
    overlay: bool = True,
    on_camera: Callable[[int], None] = lambda _: None,
) -> SceneRegistration:
    """Estimate the poses of a scene's or an episode's cameras, without an initial guess.

    Args:
        scene: a folder with masks and cameras.yaml, in which X_WC may be missing; or an episode of
            pictures, see ``open_episode``.
        model: the robot's model file, with the robot placed in the world as in the file.
        joints: joint positions by frame, or by time for an episode (CSV) [rad or m]. None: the
            recording's own. If a scene has none, they are estimated from the cameras with known
            X_WC, and fitted together with the registered ones.
        out: folder for the result, new or empty; None: nothing is written.
        settings: what is registered, and how.
        cameras: a camera file in place of the scene's or episode's own.
        overlay: whether overlays are drawn.
        on_camera: called after each camera, with the number of cameras that are done.

    Raises:
        RegistrationError: no pose of any camera explains its masks or pictures. Nothing is written
            then; if only some cameras are refused, the others are written.
        DrakePoseError: names the wrong file, camera, frame or joint.
    """
    settings = settings or RegistrationSettings()
    table, file, folder = (None if one is None else Path(one) for one in (joints, cameras, out))
    with use_workers(settings.workers), noted_warnings() as noted:
        inputs = read_inputs(Path(scene), Path(model), table, file, settings)
        if settings.on is None:
            inputs = watch_cameras(inputs)
        noted += (*inputs.warnings, *still_joints(inputs.mapped, inputs.model))
        # Refuse exports that could not be written before any work.
        every: list[Camera] = [*inputs.known_cameras, *inputs.searched_cameras]
        export_texts(settings.exports, every, "world", {})
        if "lerobot" in settings.exports:
            require_data_set(inputs)
        refused, works, groups = {**inputs.riding}, list[_Registration](), by_link(inputs, settings)
        for part, its_settings in groups:
            work = _Registration(part, its_settings, on_camera)
            try:
                work.run(folder)
            except RegistrationError as error:
                if len(groups) == 1 and not refused:
                    raise
                refused |= {one.name: error for one in part.searched_cameras} | work.refused
            else:
                works.append(work)
        if not works:
            raise next(iter(refused.values()))
        works[0].refused |= refused
    work, files = works[0], dict[str, bytes | str]()
    registered = {name: one for own in works for name, one in own.registered.items()}
    reasons = {name: say_refused(why) for own in works for name, why in own.refused.items()}
    warnings = [*dict.fromkeys(sum((own.warnings for own in works), [*inputs.warnings]))]
    warnings += [f"left out: {why}" for why in reasons.values()]
    placed = {
        name: registered[name].camera if name in registered else camera
        for name, camera in inputs.scene.cameras.items()
        if name in registered or name not in {*work.inputs.left_out, *reasons}
    }
    links = {name: own.link for own in works for name in own.registered if own.link is not None}
    if "lerobot" in settings.exports:
        asked = replace(inputs, left_out=(*work.inputs.left_out, *reasons))
        zeros = work.parameters["zeros"]
        files, texts = lerobot_files(asked, placed.values(), links, zeros)
        warnings += texts
    described = {name: one for own in works for name, one in own.described.items()}
    seconds = sum(entry["seconds"] for entry in described.values())
    summary = {
        # A single camera's part is also at the top level.
        **(next(iter(described.values())) if len(described) == 1 and not reasons else {}),
        **describe_run(inputs, settings, warnings, seconds),
        "cameras": described,
        "refused": reasons,
    }
    if folder is not None:
        for name, content in files.items():
            write_file(folder, name, content)
        for own in works if overlay else ():
            for name, result in own.tracks.items():
                draw_tracks(folder, result, given_on_link(own.inputs, name, own.link))
        shown = work.target_pictures | {k: one.pictures for k, one in work.pictures.items()}
        write_result(folder, work.inputs, placed, registered, summary, overlay, work.urdf, shown)
    return SceneRegistration(placed, registered, summary, tuple(warnings), folder, reasons)


class _Registration:
    """State of a registration.

    Attributes:
        inputs, body: the inputs and the robot's surfaces; updated after each step.
        warnings: for the user.
        registered, seconds: by camera the result, and the duration [s].
        parameters: the summary's part on joint offsets and link scales.
        pictures: registrations from pictures, by camera; empty for masks, and for a target.
        target_pictures: by camera and frame, pictures in which the target was found.
        tracks: registrations of cameras on a link from a standing scene, by camera.
        refused: by camera the reason why it has no pose.
        link: the link that carries the cameras, if any.
        described: by camera its part of summary.json, after `run`.
        urdf: text of the robot with corrected constants, after `run`; None: nothing is corrected.
    """

    def __init__(
        self,
        inputs: RegistrationInputs,
        settings: RegistrationSettings,
        on_camera: Callable[[int], None],
    ) -> None:
        self.inputs, self._settings, self._on_camera = inputs, settings, on_camera
        self.body = RegistrationBody(
            inputs.tree, inputs.visible_nodes, radius_scales=inputs.positions.radius_scales
        )
        self._known_cameras = [k for k in inputs.known_cameras if isinstance(k, PinholeCamera)]
        self.warnings = list(inputs.warnings)
        self.registered = dict[str, RegisteredCamera]()
        self.seconds = dict[str, float]()
        self.parameters: dict[str, Any] = {"zeros": {}, "lengths": {}}
        self.pictures = dict[str, PictureRegistration]()
        self.target_pictures = dict[str, dict[str, Picture]]()
        self.tracks = dict[str, TrackRegistration]()
        self.refused = dict[str, RegistrationError]()
        self.link, self.described = settings.on, dict[str, dict[str, Any]]()
        self.urdf: bytes | None = None
        self._joint_offsets = np.zeros(len(self.body.kinematics.names))

    @property
    def has_constants(self) -> bool:
        """Whether constants common to all frames are to be fitted."""
        settings = self._settings
        # Cameras that see the target are first registered each by itself, then with one pose of it.
        several = self.inputs.target is not None and len(self.registered) > 1
        focal = settings.focal and not self.pictures
        return bool(settings.zeros or settings.lengths or focal or several)

    def run(self, folder: Path | None) -> None:
        """Register and evaluate the cameras; folder: of the result, see `fit_constants`.

        Raises RegistrationError: see `find` and `evaluate`.
        """
        self.find()
        start = time.perf_counter()
        if self.inputs.positions.is_estimate:
            self.refit_poses()
        self.urdf = self.fit_constants(folder) if self.has_constants else None
        self.check_focal_lengths()
        self.evaluate()
        more = (time.perf_counter() - start) / len(self.registered)
        for name, camera in self.registered.items():
            how = describe_pictures(self.pictures.get(name), name in self.target_pictures)
            if name in self.tracks:
                how = describe_tracks(self.tracks[name], self.body.kinematics)
            own = describe_camera(camera, self.seconds[name] + more, self.link)
            self.described[name] = self.parameters | own | how

    def find(self) -> None:
        """Register each camera by itself, from masks or from pictures.

        Raises:
            CameraError: a camera's focal length is unknown.
            RegistrationError: no pose of any camera explains its masks or pictures.
        """
        inputs = self.inputs
        if not inputs.recordings:
            for camera in self._known_cameras:
                self.warnings += known_camera_warnings(self.body, camera, inputs.of(camera.name))
            self._find_each()
        elif inputs.target is not None:
            self._find_target(inputs.target)
        elif (link := self._settings.on) is not None:
            # From things that stand still in the pictures.
            for camera in inputs.searched_cameras:
                name, start = camera.name, time.perf_counter()
                with self._refusing(name):
                    found = register_on_link(inputs, self._settings, camera)
                    self.tracks[name] = found
                    self.warnings += track_warnings(found, name in inputs.assumed_focal)
                    given = given_on_link(inputs, name, link)
                    self.warnings += [] if given is None else [describe_given(found, given)]
                    self._note(found.found, start)
        else:
            frames, start = list[MultiViewFrame](), time.perf_counter()
            focal = [*inputs.recordings] if self._settings.focal else []
            for result in register_recordings(
                self.body, inputs, inputs.searched_cameras, self.refused, focal,
                inputs.offset_joints,
            ):  # fmt: skip
                name = result.found.camera.name
                frames += [MultiViewFrame.alone(name, frame) for frame in result.frames]
                self.pictures[name] = result
                self.warnings += picture_warnings(result, name in inputs.assumed_focal)
                self._note(result.found, start)
                start = time.perf_counter()
            self.inputs = replace(inputs, frames=tuple(frames))
        self._require_registered()

    @contextmanager
    def _refusing(self, name: str) -> Iterator[None]:
        """Refuse a camera, by name, if a RegistrationError is raised in this context."""
        try:
            yield
        except RegistrationError as error:
            self._refuse({name: error})

    def _refuse(self, errors: Mapping[str, RegistrationError]) -> None:
        """Refuse cameras by name."""
        self.refused |= errors
        for name in errors:
            for results in (self.registered, self.pictures, self.target_pictures, self.tracks):
                results.pop(name, None)

    def _require_registered(self) -> None:
        """Leave refused cameras out of the inputs; raise their first error if no camera is left."""
        if not self.registered:
            raise next(iter(self.refused.values()))
        if self.refused:
            self.inputs = self.inputs.without(self.refused)

    def _find_each(self) -> None:
        """Register each camera from its masks.

        The pose of a calibration target is estimated with the first camera, and then known.
        """
        inputs, target, target_pose = self.inputs, self.inputs.target, None
        search: Search = CameraSearch(self.body) if target is None else TargetSearch(target)
        tried = dict[str, RegisteredCamera]()
        for camera in (one for one in inputs.searched_cameras if one.name not in self.refused):
            start, frames, found = time.perf_counter(), inputs.of(camera.name), None
            with self._refusing(camera.name):
                found = tried[camera.name] = search.register(camera, frames)
                if not inputs.positions.is_estimate:
                    require_explained(search, found, frames)
            if found is None or camera.name in self.refused:
                continue
            if found.evidence is None or not found.evidence.holds:
                self.warnings.append(few_frames_warning(found))
            if target is not None:
                if found.target is not None:
                    target_pose, self.body = found.target, target.body(found.target.X_WT)
                    search = CameraSearch(self.body)
                    self.warnings += target_warnings(target_pose)
                found = replace(found, target=target_pose)
            self._note(found, start)
        if target is None and not inputs.positions.is_estimate:
            by_name = {name: inputs.of(name) for name in tried}
            self._refuse(mirrored_cameras(CameraSearch(self.body), tried, by_name))
        self.inputs = replace(inputs, tree=self.body.tree)

    def _note(self, found: RegisteredCamera, start: float) -> None:
        """Store a registered camera; start: when its search began, by time.perf_counter()."""
        name = found.camera.name
        self.registered[name] = found
        self.seconds[name] = time.perf_counter() - start
        self._on_camera(len(self.registered))

    def _find_target(self, target: CalibrationTarget) -> None:
        """Find the target in some pictures of each camera, and register the cameras from them.

        Raises CameraError: a camera's focal length is unknown.
        """
        inputs, frames, start = self.inputs, list[MultiViewFrame](), time.perf_counter()
        for camera in inputs.searched_cameras:
            name = camera.name
            with self._refusing(name):
                segmented, lost = find_in_pictures(target, inputs, camera)
                names = [frame.name for frame in segmented]
                recording = inputs.recordings[name]
                self.target_pictures[name] = {k: recording.picture(k) for k in names}
                frames += [MultiViewFrame.alone(name, frame) for frame in segmented]
                self.warnings += lost
        self.inputs = replace(inputs, frames=tuple(frames))
        seconds = time.perf_counter() - start
        self._find_each()
        for name, found in list(self.registered.items()):
            inlier_count = len(found.frames) - len(found.outliers)
            self.seconds[name] += seconds / len(self.registered)
            with self._refusing(name):
                require_detections(name, inlier_count, len(self.target_pictures[name]))

    def check_focal_lengths(self) -> None:
        """Compare given focal lengths and joint zeros with the masks, and warn of errors.

        A camera whose focal length is clearly wrong gets the estimated focal length, and the pose
        with it.
        """
        inputs, body = self.inputs, self.body.with_tree(self.inputs.tree)
        if inputs.positions.is_estimate or self.tracks:
            return
        for name, found in self.registered.items():
            picture, posed, fitted = self.pictures.get(name), inputs.of(name), found
            if picture is not None:
                fitted = replace(found, frames=picture.found.frames)
                posed = [replace(k, values=k.values + self._joint_offsets) for k in picture.frames]
            inliers = fit_of_inliers(body, fitted, posed)
            if inliers is not None and not self._settings.zeros:
                self.warnings += likely_offset_warnings(body, name, inliers)
            if inliers is not None and inputs.target is None:
                self.warnings += odd_link_warnings(body, name, inliers, self._settings.without)
            if self._settings.focal or (picture is not None and picture.focal_deviation):
                continue
            checked, deviation, texts = check_focal_length(body, fitted, posed)
            self.warnings += texts
            self.registered[name] = replace(
                found, camera=checked.camera, covariance=checked.covariance,
                frames=checked.frames if deviation else found.frames,
            )  # fmt: skip
            if picture is not None and deviation:
                corrected = replace(picture.found, camera=checked.camera)
                self.pictures[name] = replace(picture, found=corrected, focal_deviation=deviation)

    def evaluate(self, shown: int = 20) -> None:
        """Evaluate all frames with the final cameras, and warn of what looks wrong.

        shown: maximum number of outlier pictures of each camera that are kept.

        A camera is refused if its frames do not determine its pose on its link, or half of its
        masks or more are outliers.

        Raises RegistrationError: no camera is left, or a refused camera was fitted with others.
        """
        inputs, body, frames = self.inputs, self.body.with_tree(self.inputs.tree), []
        # Cameras were registered from some of their pictures: here all pictures are compared.
        for name, result in self.pictures.items():
            recording, found = result.recording, self.registered[name]
            offsets = self._joint_offsets
            segmented, misfits, lost = evaluate_pictures(
                body, replace(result, joint_offsets=offsets), found
            )
            frames += [
                MultiViewFrame(k.name, k.values + offsets, {name: k.mask}) for k in segmented
            ]
            found = self.registered[name] = replace(found, frames=misfits)
            errors = {k.frame: k.E_total for k in misfits}
            wanted = (*found.outliers[:shown], *compared_frames(errors))
            pictures = {k: recording.picture(k) for k in wanted}
            self.pictures[name] = replace(result, pictures={**result.pictures, **pictures})
            if lost:
                self.warnings.append(lost_frames_warning(name, lost, recording.names))
        if frames:
            inputs = self.inputs = replace(inputs, frames=tuple(frames))
        misplaced = dict[str, list[str]]()
        before, joint = len(self.refused), self.has_constants or inputs.positions.is_estimate
        for name, found in list(self.registered.items()):
            from_pictures = name in {**self.pictures, **self.target_pictures, **self.tracks}
            with self._refusing(name):
                if inputs.target is not None:
                    require_determined(found)
                own = inputs.of(name) if name not in self.tracks else []
                misplaced[name] = frames_of_other_rows(body, found, own)
                self.warnings += outlier_warnings(found, from_pictures, misplaced[name])
                self.warnings += mode_warnings(body, found, inputs.of(name))
                if not inputs.offset_joints and self._settings.on is None:
                    self.warnings += zero_warnings(body, found, inputs.of(name))
        if joint and len(self.refused) > before:
            raise list(self.refused.values())[before]
        self._require_registered()
        self.warnings += common_outlier_warnings(
            self.registered.values(),
            from_pictures=bool(self.pictures),
            misplaced={frame for own in misplaced.values() for frame in own},
        )

    def refit_poses(self) -> None:
        """Fit cameras, estimated positions and the body's shape together (bundle adjustment).

        Cameras registered with estimated positions have these positions' errors, too. Masks of a
        camera's outlier frames are left out. A person's shape is fitted.

        Raises RegistrationError: no pose of a camera explains its masks.
        """
        inputs = self.inputs
        kinematics, agreeing = self.body.kinematics, list[MultiViewFrame]()
        wrong = {name: found.outliers for name, found in self.registered.items()}
        for frame in inputs.frames:
            masks = {c: m for c, m in frame.masks.items() if frame.name not in wrong.get(c, ())}
            agreeing.append(replace(frame, masks=masks))
        cameras = [*self._known_cameras, *(found.camera for found in self.registered.values())]
        shape: tuple[Any, ...] = (np.zeros(len(kinematics.names), np.bool_),)
        if not missing_for_person(inputs.model):
            shape = (shape_values(self.body.tree), *shape_parts(self.body.tree))
        adjusted, covariances, values, radius_scales = adjust_bundle(
            kinematics, self.body.medium, cameras, self.registered, agreeing, *shape
        )
        self.inputs = replace(inputs, frames=inputs.with_values(values))
        known = inputs.positions.radius_scales
        radius_scales = radius_scales * (1.0 if known is None else known)
        self.body = RegistrationBody(inputs.tree, inputs.visible_nodes, radius_scales=radius_scales)
        for camera, covariance in zip(adjusted, covariances, strict=True):
            self._update(self.body.kinematics, camera, covariance)
            found = self.registered[camera.name]
            require_explained(CameraSearch(self.body), found, self.inputs.of(camera.name))

    def fit_constants(self, folder: Path | None) -> bytes | None:
        """Fit joint offsets, link scales and focal lengths together with the cameras.

        folder: the result folder, which the URDF's mesh paths will be relative to.

        Returns:
            the text of a URDF with the significant parameters; None if there are none, no folder,
            or the model is no URDF.

        Raises:
            RegistrationError: there are fewer frames than parameters, or the fit lost the robot.
        """
        inputs, names, cameras = self.inputs, self.body.kinematics.names, self.registered
        if self.tracks:
            (result, *_) = self.tracks.values()
            self.parameters = describe_parameters(result.offsets, (), self.body.kinematics)
            significant = {k.name: k.value for k in result.offsets if k.significant}
            return corrected_urdf(inputs.model, folder, significant, {})
        start, static, turned = offsets_in_pictures(self.body, self.pictures, inputs.offset_joints)
        own = [replace(one, camera=turned.get(name, one.camera)) for name, one in cameras.items()]
        found = calibrate_joints(
            self.body, own, [inputs.of(name) for name in cameras], inputs.offset_joints,
            self._settings.focal, links=inputs.scaled_links, start=start, static=static,
        )  # fmt: skip
        self.parameters = describe_parameters(
            found.offsets, found.link_scales, self.body.kinematics
        )
        self.warnings += parameter_warnings(found)
        offsets = {offset.name: offset.value for offset in found.offsets}
        self._joint_offsets = np.array([offsets.get(name, 0.0) for name in names])
        model, tree, target = inputs.model, inputs.tree, inputs.target
        target_pose = next(iter(cameras.values())).target
        shifts = joint_shifts(tree, found.link_scales)
        # The URDF gets significant parameters only; the cameras were fitted with all.
        offsets_in_file = {one.name: one.value for one in found.offsets if one.significant}
        shifts_in_file = joint_shifts(tree, [one for one in found.link_scales if one.significant])
        if shifts:
            model = model.reshaped(joint_shifts=shifts)
        if target is not None and target_pose is not None:
            target = target.with_robot(model)
            by, by_covariance = found.object_values, found.object_covariance
            target_pose = target.moved_pose(target_pose, by, by_covariance)
            tree = target.tree(target_pose.X_WT)
        elif shifts:
            tree, _ = make_registration_tree(model, self._settings)
        values = [frame.values + self._joint_offsets for frame in inputs.frames]
        self.inputs = replace(inputs, model=model, tree=tree, frames=inputs.with_values(values))
        kinematics = TreeKinematics(tree)
        evaluated = found.cameras, found.covariances, found.inlier_ratios, found.is_inlier
        for camera, covariance, ratios, is_inlier in zip(*evaluated, strict=True):
            before = self.registered[camera.name]
            rows = zip(before.frames, ratios.tolist(), is_inlier.tolist(), strict=True)
            again = [replace(one, inlier_ratio=ratio, is_inlier=own) for one, ratio, own in rows]
            self.registered[camera.name] = replace(before, frames=tuple(again))
            self._update(kinematics, camera, covariance, target_pose)
        return corrected_urdf(inputs.model, folder, offsets_in_file, shifts_in_file)

    def _update(
        self,
        kinematics: TreeKinematics,
        camera: PinholeCamera,
        covariance: Array,
        target_pose: TargetPose | None = None,
    ) -> None:
        """Store a registered camera's new pose, and its frames' areas; inliers stay as they are.

        Args:
            kinematics: of the corrected pose tree.
            camera: the camera at its new pose.
            covariance: (6, 6) of this pose.
            target_pose: the calibration target's new pose; None: there is no target.
        """
        before = self.registered[camera.name]
        frames = PosedFrames(kinematics, self.body.full, camera, self.inputs.of(camera.name))
        areas = overlap_areas(frames, camera.X_CW[None], np.inf)[0]
        misfits = zip(before.frames, E_total(areas), intersection_over_union(areas), strict=True)
        again = [replace(one, E_total=float(off), iou=float(iou)) for one, off, iou in misfits]
        self.registered[camera.name] = replace(
            before, camera=camera, covariance=covariance, frames=tuple(again), target=target_pose
        )
