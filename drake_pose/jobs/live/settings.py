"""What a live capture is made with: options, and arguments in Python."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from drake_pose.errors import SettingsError
from drake_pose.files.settings import within

CaptureMethod = Literal["person", "paper"]
"""By all silhouettes at once, or by the stages of Date et al. as they print them."""

Seconds = Annotated[float | None, within(0.01)]
Shape = Annotated[
    Path | None,
    Parameter(
        metavar="RESULT",
        help="Take lengths and radius scales from this result of capture with the same person. "
        "Live capture (sources.yaml) only.",
    ),
]
_OF_PYTHON = Parameter(parse=False)


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """How a live capture is made.

    Args:
        replay: whether replay.html is written.
        packages: folders of packages that the model's ``package://`` names mean, by name.

    Raises:
        SettingsError: a time that cannot be, or options that go together are given apart.
    """

    seconds: Seconds = None
    """Stop after this time [s]. Live capture (sources.yaml) only."""
    shape: Shape = None
    fit_shape: Annotated[bool, Parameter(negative="--no-fit-shape")] = True
    """Fit lengths and radius scales to the first frames; or keep the model's. Live capture only."""
    tolerance: Annotated[float | None, within(0.0), Parameter(metavar="SECONDS")] = None
    """Largest difference of time stamps of simultaneous pictures. Default: half the time between
    two pictures of a camera, or 0.9 of it if cameras are live."""
    face_camera: Annotated[str | None, Parameter(metavar="NAME")] = None
    """With --method paper: the camera before the face, which tells where the person looks; needs
    --faces."""
    faces: Annotated[Path | None, Parameter(metavar="FOLDER")] = None
    """With --method paper: pictures of the person's face, and directions.csv: picture,turn,nod
    [deg]."""
    replay: Annotated[bool, _OF_PYTHON] = True
    packages: Annotated[Mapping[str, Path], _OF_PYTHON] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.seconds is not None and not 0.0 < self.seconds < math.inf:
            raise SettingsError(f"the capture's length must be positive, not {self.seconds} s")
        if (self.face_camera is None) != (self.faces is None):
            raise SettingsError("--face-camera and --faces go together")
