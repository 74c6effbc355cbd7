"""Settings of a live capture: command line options and Python arguments."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from drake_pose.errors import SettingsError, require_positive
from drake_pose.files.settings import within

CaptureMethod = Literal["person", "paper"]
"""person: a fit to all silhouettes at once; paper: the stages of Date et al. as published."""

_OF_PYTHON = Parameter(parse=False)


@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """Settings of a live capture.

    Args:
        replay: whether replay.html is written.
        packages: folders of the packages in the model's ``package://`` addresses, by name.

    Raises:
        SettingsError: a time is not positive, or an option lacks the other one that it needs.
    """

    seconds: Annotated[float | None, within(0.01)] = None
    """Stop after this time [s]. Live capture (sources.yaml) only."""
    shape: Annotated[Path | None, Parameter(metavar="RESULT")] = None
    """Use the link lengths and radius scales of this earlier result of capture with the same
    person. Live capture (sources.yaml) only."""
    fit_shape: Annotated[bool, Parameter(negative="--no-fit-shape")] = True
    """--fit-shape: fit link lengths and radius scales to the first frames. --no-fit-shape: keep the
    model's. Live capture only."""
    tolerance: Annotated[float | None, within(0.0), Parameter(metavar="SECONDS")] = None
    """Maximum difference of the time stamps of synchronised pictures [s]. Default: half the time
    between two pictures of a camera, or 0.9 of it for live cameras."""
    face_camera: Annotated[str | None, Parameter(metavar="NAME")] = None
    """With --method paper: the camera before the face, for the direction of the head; needs
    --faces."""
    faces: Annotated[Path | None, Parameter(metavar="FOLDER")] = None
    """With --method paper: folder with pictures of the person's face and directions.csv, which has
    the columns picture, turn and nod [deg]."""
    replay: Annotated[bool, _OF_PYTHON] = True
    packages: Annotated[Mapping[str, Path], _OF_PYTHON] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_positive(seconds=self.seconds)
        if (self.face_camera is None) != (self.faces is None):
            raise SettingsError("--face-camera and --faces need each other")
