"""Results of an audit: errors common to all frames, and errors of single frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from drake_pose.arrays import Array


@dataclass(frozen=True)
class Finding:
    """An error in what is given: joint positions, cameras, clocks or masks."""

    # What is wrong. "joint": an offset; "camera" or "base": its pose; "focal": focal lengths;
    # "center": principal points; "clock": a camera's time offset; "rate": its drift; "joints":
    # several joints; "unexplained": nothing within reach explains the frame; "refused": a camera
    # whose pictures no pose explains. In all frames also "sign" or "log": a joint's column in the
    # log; "length": the distances between a link's joints; "link": a link's shape; "reading": the
    # meaning of what is given; "moved": a pose that changed after a frame.
    kind: str
    name: str  # Of the joint or camera, "" for several; for a "reading" a sentence.
    # angle, shift: correction to be added [rad, m]. Of several joints, the largest. Focal lengths
    # and lengths [relative], principal points [pixel]; a camera's shift is that of its own centre.
    # Clock [s]: how much later the pictures' joint positions are logged. Rate [s/s]: how much
    # faster the log's clock runs.
    angle: float = 0.0
    shift: float = 0.0
    # angle_sd, shift_sd: their standard deviations; 0 for several joints.
    angle_sd: float = 0.0
    shift_sd: float = 0.0
    # Root mean square distance by which it moves the outlines it affects [pixel].
    pixels: float = 0.0
    p_value: float = 0.0  # Probability of an error at least as large if nothing is wrong.
    alternatives: tuple[str, ...] = ()  # Names of other causes that explain it equally well.
    # Significant corrections by joint, where several are wrong [rad or m].
    joints: Mapping[str, float] = field(default_factory=dict)
    at_body: float = 0.0  # How far a camera's error shifts the body [m]; 0 for other kinds.
    # Of a "link" finding the misplaced link; of a "moved" finding "camera" or "base", and "" for
    # one in pictures.
    link: str = ""
    text: str = ""  # Details in words; "" for none.


@dataclass(frozen=True)
class FrameDiagnosis:
    """The diagnosis of one frame."""

    frame: str  # Its name.
    # given_ratios, fitted_ratios: inlier ratios (the fraction of both contours that fits) by name
    # of each camera with a mask, at the given values and with the frame fitted.
    given_ratios: Mapping[str, float]
    fitted_ratios: Mapping[str, float]
    # Root mean square distance of the outlines from the pose common to all frames [pixel].
    pixels: float
    finding: Finding | None  # The error, for an outlier frame; None for an inlier.


@dataclass(frozen=True)
class Diagnosis:
    """The result of an audit.

    Args:
        frames: the diagnosis of each frame.
        common: errors common to all inlier frames.
        center: correction of all principal points and its standard deviation, (2,) each [pixel],
            where they are off by half a pixel along x and y; otherwise None.
        minimum_detectable: by joint without a finding, the smallest offset in all frames that
            would be detected [rad or m].
        corrections: (p,) the ``PerFrameFit``'s corrections that these findings state.
        remaining: by how much outlines move from those that the frames were fitted with [pixel].
    """

    frames: tuple[FrameDiagnosis, ...]
    common: tuple[Finding, ...]
    center: tuple[list[float], list[float]] | None = None
    minimum_detectable: Mapping[str, float] = field(default_factory=dict)
    corrections: Array = field(default_factory=lambda: np.zeros(0))
    remaining: float = 0.0

    @property
    def outliers(self) -> tuple[str, ...]:
        """Names of the outlier frames."""
        return tuple(one.frame for one in self.frames if one.finding is not None)
