"""What a registration or an audit of a scene is made with: options, and arguments in Python."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from cyclopts import Parameter

from drake_pose.errors import SettingsError, for_caller
from drake_pose.files.settings import (
    Corner,
    EpisodeSettings,
    Names,
    Positions,
    from_text,
    parse_boxes,
    readable,
)

ALL = "all"
"""In place of names: of every joint, or of every link."""

Export = Literal["ros", "mujoco", "drake", "rerun"]
"""Programs that cameras are written for."""


@readable
@dataclass(frozen=True, kw_only=True)
class AuditSettings(EpisodeSettings):
    """How a scene is audited."""

    hold: Positions = field(default_factory=dict)
    """Hold this joint at a known position [deg or m]; repeat for several."""
    pictures: Annotated[bool, Parameter(negative="")] = False
    """Look at pictures and the joint log beside them, even where there are masks."""


@readable
@dataclass(frozen=True, kw_only=True)
class RegistrationSettings(AuditSettings):
    """How cameras are registered."""

    cameras: Annotated[Names, Parameter("--camera")] = ()
    """Find this camera, and do not use its X_WC if it has one; repeat for several. Default: all
    without X_WC."""
    on: Annotated[str | None, Parameter(metavar="LINK")] = None
    """The cameras to be found ride on this link (eye in hand): their pose X_LC in its frame is
    found, from masks of the robot's base, which is what no joint moves, or from masks or pictures
    of a --target."""
    target: Path | None = None
    """With --on: the masks, or the pictures of an episode, show another, rigid object (URDF,
    SDFormat, MJCF), which stands anywhere in the world; where is found, too."""
    zeros: Names = ()
    """Find the zero of this joint, too, a constant that is added to its positions in all frames;
    all: of every joint; repeat for several. A URDF with the zeros is written."""
    lengths: Annotated[tuple[str, ...], Parameter(metavar="LINK")] = ()
    """Find how long this link is, too: a factor, the same in all frames, of the distances of the
    joints that it carries from its own; all: of every link; repeat for several. A URDF with the
    lengths is written."""
    focal: bool = False
    """Find the cameras' focal lengths, too."""
    suggest: bool = False
    """Where several poses of a camera fit equally well: joint positions inside the limits that
    would tell them apart."""
    keep_out: Annotated[
        tuple[tuple[Corner, Corner], ...],
        from_text(parse_boxes, "X,Y,Z:X,Y,Z", repeated=True),
    ] = ()
    """With --suggest: the corners of a box in the world that the robot must not touch [m]; repeat
    for several."""
    exports: Annotated[tuple[Export, ...], Parameter("--export")] = ()
    """Write the cameras for this program, too; repeat for several. ros: camera_info and static
    transforms; mujoco: <camera> elements; drake: CameraConfigs; rerun: a recording for its viewer,
    with robot, pictures and masks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in self.exports:
            if name not in (known := get_args(Export)):
                raise SettingsError(f"there is no export '{name}'; there is: {', '.join(known)}")
        if self.keep_out and not self.suggest:
            raise SettingsError(
                for_caller("--keep-out is for --suggest; give both, or leave it out")
            )

    def as_json(self) -> dict[str, Any]:
        """Returns the settings as plain JSON values."""
        boxes = [{"low": low, "high": high} for low, high in self.keep_out]
        return super().as_json() | {"keep_out": boxes}
