"""What an audit finds: of all frames, and of each."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_pose.fit.covariance import ErrorSizes


@dataclass(frozen=True)
class Finding:
    """By how much something is off.

    Args:
        kind: "joint", "camera", "base", "focal", "center", "clock", "rate" of a clock, "joints"
            where several are off, or "unexplained" where nothing within reach explains a frame;
            of all frames "sign" or "log" of a joint, "link", "reading" of what is given, or
            "moved" after a frame.
        name: of the joint, or the camera: "" where it is all of them; what is read wrongly.
        angle, shift: what must be added [rad, m]; of joints the largest; of focal lengths the shift
            is relative, of principal points in pixels, of a camera's pose the way of the camera
            itself, of a camera's clock by how much later its
            pictures' joints are in the log [s], of its rate how much faster the log's runs [s/s].
        angle_sd, shift_sd: their standard deviations.
        pixels: how far it moves the outlines of the parts that it moves, root mean square.
        p_value: probability of a deviation this large where nothing is off.
        rivals: names of alternative causes that explain it as well.
        joints: by how much joints are off where several are [rad or m].
        at_body: how far a camera's error shifts the body [m].
        link: that is not where the log of a joint says.
        text: what happened, in words, where no number says it.
    """

    kind: str
    name: str
    angle: float
    shift: float
    angle_sd: float
    shift_sd: float
    pixels: float
    p_value: float
    alternatives: tuple[str, ...] = ()
    joints: Mapping[str, float] = field(default_factory=dict)
    at_body: float = 0.0
    link: str = ""
    text: str = ""


@dataclass(frozen=True)
class FrameDiagnosis:
    """What was found of one frame.

    Args:
        given, fitted: by camera, the inlier ratio with everything as given, and once fitted.
        pixels: how far the outlines are off from what all frames have in common.
        finding: what contradicts the other frames; None: it agrees.
    """

    frame: str
    given: Mapping[str, float]
    fitted: Mapping[str, float]
    pixels: float
    finding: Finding | None


@dataclass(frozen=True)
class Diagnosis:
    """What contradicts the rest.

    Args:
        frames: of each frame.
        common: what is off in all frames that agree.
        sizes: of contours' errors [pixel].
        center: all principal points are off by half a pixel along x and y: by how much, and
            standard deviations (2,) [pixel]; None: they are not.
        minimum_detectable: smallest offset of each joint that is not named that would be, in all
            frames [rad or m].
    """

    frames: tuple[FrameDiagnosis, ...]
    common: tuple[Finding, ...]
    sizes: ErrorSizes
    center: tuple[list[float], list[float]] | None = None
    minimum_detectable: Mapping[str, float] = field(default_factory=dict)

    @property
    def outliers(self) -> tuple[str, ...]:
        """The frames that contradict the others."""
        return tuple(one.frame for one in self.frames if one.finding is not None)
