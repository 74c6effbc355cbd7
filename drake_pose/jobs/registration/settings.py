"""Settings of a registration or an audit: options of the commands, and arguments in Python."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, get_args

from cyclopts import Parameter

from drake_pose.errors import SettingsError
from drake_pose.files.settings import (
    EpisodeSettings,
    Names,
    Positions,
    readable,
)

ALL = "all"
"""Stands for the names of all joints, or of all links."""

Export = Literal["ros", "mujoco", "drake", "lerobot"]
"""Programs for which cameras are exported; LeRobot gets the joints, too."""


@readable
@dataclass(frozen=True, kw_only=True)
class AuditSettings(EpisodeSettings):
    """Settings of an audit."""

    hold: Positions = field(default_factory=dict)
    """Hold this joint at a known position [deg or m]; repeat for several."""
    without: Annotated[tuple[str, ...], Parameter(metavar="LINK")] = ()
    """Leave this link and all links that it carries out of drawings and comparisons, such as a
    gripper that is not the model's; repeat for several."""
    pictures: Annotated[bool, Parameter(negative="")] = False
    """Use the scene's pictures and joint log, even if it has masks."""


@readable
@dataclass(frozen=True, kw_only=True)
class RegistrationSettings(AuditSettings):
    """Settings of a registration."""

    cameras: Annotated[Names, Parameter("--camera")] = ()
    """Register this camera, and ignore its X_WC if it has one; repeat for several. Default: all
    cameras of an episode; of a scene of masks those without X_WC."""
    on: Annotated[str | None, Parameter(metavar="LINK")] = None
    """The cameras are mounted on this link (eye in hand). Their pose X_LC in the link's frame is
    estimated from an episode's pictures of things that stand still, from masks of the robot's
    static base, or from masks or pictures of a --target."""
    target: Path | None = None
    """With --on: model file (URDF, SDFormat, MJCF) of a rigid calibration target anywhere in the
    world, which the masks or pictures show; its pose is estimated, too."""
    zeros: Names = ()
    """Estimate the offset of this joint, too: a constant to be added to its positions in all
    frames. "all": of every joint; repeat for several. For a URDF model, a URDF with the significant
    offsets is written."""
    lengths: Annotated[tuple[str, ...], Parameter(metavar="LINK")] = ()
    """Estimate the scale of this link, too: a factor of the distances from its own joint to the
    joints that it carries. "all": of every link; repeat for several. URDF models only: a URDF with
    the significant scales is written."""
    focal: bool = False
    """Estimate the cameras' focal lengths, too."""
    exports: Annotated[tuple[Export, ...], Parameter("--export")] = ()
    """Export the cameras for this program, too; repeat for several. ros: camera_info and static
    transforms; mujoco: <camera> elements; drake: CameraConfigs; lerobot, for a LeRobot data set: a
    joint map and the motors' calibration file, corrected by the offsets of --zeros, and a copy of
    meta with the cameras."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.exports:
            if name not in (known := get_args(Export)):
                raise SettingsError(f"there is no export '{name}'; there is: {', '.join(known)}")
