"""What an audit looks at in an episode: masks that its pictures give without the given cameras.

Each camera is found in its pictures as a registration finds it, and its clock. A given camera that
stands far from there is named; frames are then compared with the one that was found. One that
stands near is compared as a scene's is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from drake_pose.arrays import Array, Picture
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import SceneError
from drake_pose.jobs.estimate.episode import say_left_out
from drake_pose.jobs.registration.episodes import EpisodeInputs
from drake_pose.jobs.registration.inputs import Inputs
from drake_pose.jobs.registration.positions import KnownPositions
from drake_pose.jobs.registration.result import say_lost
from drake_pose.registration.contradictions import BASE, LEAST_OF_JOINTS, SIGNIFICANCE, Finding
from drake_pose.registration.online_registration import pose_difference, squared_distance
from drake_pose.registration.picture_frames import judge_pictures
from drake_pose.registration.picture_registration import (
    PictureRegistration,
    Recording,
    refit_pictures,
    register_pictures,
)
from drake_pose.registration.posed_frames import SeenFrame, placed_points
from drake_pose.registration.register import RegisteredCamera, RegistrationBody
from drake_pose.silhouette.pictures.scenes import Scene

# A camera is compared as it is given that shows the body nearer than this to where it is seen [root
# of the silhouettes' area].
_NEAR = 0.08
# Clocks are as good as right that are off by about so much [s].
_CLOCK_SD = 0.002


@dataclass(frozen=True, eq=False)
class EpisodeLook:
    """An episode as an audit takes it.

    Args:
        inputs: the frames with masks that were found; cameras near those that are given.
        findings: cameras that are far from where their pictures show them, and clocks.
        pictures: by camera what was found in them.
        recordings: of these cameras.
        names: by frame of the inputs, its camera and its name there.
        given: cameras that are far from where they were found, as they are given.
    """

    inputs: Inputs
    findings: tuple[Finding, ...]
    pictures: Mapping[str, PictureRegistration]
    recordings: Mapping[str, Recording]
    names: Mapping[str, tuple[str, str]]
    given: tuple[PinholeCamera, ...]

    def picture(self, frame: str) -> Picture:
        """The picture (H, W, 3) of a frame of the inputs."""
        camera, name = self.names[frame]
        return self.recordings[camera].picture(name)


def look_at_episode(
    episode: EpisodeInputs, before: EpisodeLook | None = None, zeros: Sequence[str] = ()
) -> EpisodeLook:
    """Finds each camera of an episode in its pictures, and masks in all of these.

    Args:
        before: a look that found the cameras about.
        zeros: joints whose zeros are not trusted.

    Raises:
        SceneError: nobody says where a camera stands.
        RegistrationError: no pose of a camera explains its pictures.
    """
    placed = [name for name in episode.cameras if name in episode.placed]
    if not placed:
        raise SceneError(
            f"{episode.path}: no camera has an X_WC that could be audited; give a camera file "
            "(--cameras FILE), or find out where they stand: drake-pose register"
        )
    warnings = say_left_out(episode.cameras, episode.placed)
    body = RegistrationBody(episode.tree, episode.seen)
    held, findings, pictures = list[Camera](), list[Finding](), dict[str, PictureRegistration]()
    names, frames = dict[str, tuple[str, str]](), list[SeenFrame]()
    for name in placed:
        given, recording = episode.cameras[name], episode.recordings[name]
        if before is None:
            one = register_pictures(body, given, recording, zeros=zeros)
        else:
            one = refit_pictures(body, before.pictures[name], recording, zeros=zeros)
        pictures[name] = one
        values = np.array([frame.values + one.zeros for frame in one.frames])
        off = compare_camera(body, given, one.found, values, alone=len(placed) == 1)
        near = off.pixels < _NEAR * one.fit.fit.seen[0].size
        held.append(given if near else one.found.camera)
        findings += [] if near or off.p_value > SIGNIFICANCE else [off]
        findings += _clock(body, one, recording)
        judged = judge_pictures(body, one, one.found)
        for frame in judged.frames:
            known = frame.name if len(placed) == 1 else f"{name}-{frame.name}"
            names[known] = name, frame.name
            frames.append(SeenFrame(known, frame.values, {name: frame.mask}))
        if judged.lost:
            warnings.append(say_lost(name, judged.lost, recording.names))
    inputs = Inputs(
        Scene(episode.path, episode.cameras, tuple(names), {}), episode.model, episode.tree,
        KnownPositions(episode.path, body.kinematics, {}), tuple(held),
        (*episode.warnings, *warnings), tuple(frames), seen=episode.seen,
    )  # fmt: skip
    far = tuple(episode.cameras[one.name] for one in findings if one.kind == "camera")
    return EpisodeLook(inputs, tuple(findings), pictures, episode.recordings, names, far)


def compare_camera(
    body: RegistrationBody,
    given: PinholeCamera,
    found: RegisteredCamera,
    values: Array,
    alone: bool,
) -> Finding:
    """By how much a camera stands elsewhere than it was found.

    Args:
        values: (f, m) where the body is in some frames.
        alone: whether it is the only one, so that the base may have moved as well.
    """
    off = pose_difference(found.camera.X_WC, given.X_WC)
    p_value = float(chdtrc(len(off), squared_distance(off, found.covariance)))
    return Finding(
        "camera", given.name, float(np.linalg.norm(off[:3])), float(np.linalg.norm(off[3:])),
        found.rotation_sd, found.translation_sd,
        _pixels(body, (given, values), (found.camera, values)), p_value, (BASE,) if alone else (),
    )  # fmt: skip


def _clock(body: RegistrationBody, one: PictureRegistration, recording: Recording) -> list[Finding]:
    """Whether a camera's clock is off the joint log's, or drifts.

    recording: as it is.
    """
    clock, camera = one.offset, one.found.camera
    if clock is None or not clock.determined:
        return []
    rows = [recording.names.index(frame.name) for frame in one.frames]
    given, found = recording.values_at(0.0)[rows], one.recording.values_at(clock.value)[rows]
    known = np.isfinite(given).all(axis=1)
    pixels = _pixels(body, (camera, given[known]), (camera, found[known]))
    if pixels < LEAST_OF_JOINTS:
        return []
    told = [
        ("clock", clock.value, clock.deviation, _CLOCK_SD),
        ("rate", clock.drift, clock.drift_deviation, 0.0),
    ]
    several = [
        (kind, value, sd, float(chdtrc(1, value**2 / (sd**2 + least**2))))
        for kind, value, sd, least in told
    ]
    return [
        Finding(kind, camera.name, 0.0, value, 0.0, sd, pixels, p_value)
        for kind, value, sd, p_value in several
        if p_value < SIGNIFICANCE
    ]


def _pixels(
    body: RegistrationBody, one: tuple[PinholeCamera, Array], other: tuple[PinholeCamera, Array]
) -> float:
    """How far points of a body are from each other in two pictures, root mean square [pixel].

    one, other: the cameras, and values (f, m) of the body.
    """
    places = []
    for camera, values in (one, other):
        points = [placed_points(body.very_few, body.kinematics.poses(row)) for row in values]
        places.append(camera.project(np.concatenate(points))[0])
    return float(np.sqrt(np.nanmean(((places[0] - places[1]) ** 2).sum(axis=1))))
