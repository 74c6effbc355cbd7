"""How masks are found: options, and arguments in Python."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from drake_pose.errors import SettingsError
from drake_pose.files.options import from_text, parse_numbers, parse_size
from drake_pose.files.settings import Packages, Positions, changed, plain, require_choices

MEDIAN = "median"

_COUNTS = {"box": 4, "network_size": 2, "network_mean": 3, "network_std": 3}
_WAYS = ("background", "box", "model", "network")
_Colour = Annotated[tuple[float, ...], from_text(partial(parse_numbers, count=3), "R,G,B")]


@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """How masks are found; where no way is given, the source holds masks of another tool.

    Raises SettingsError: an unknown meaning, several ways at once, or options of another way.
    """

    cameras: Path | None = None
    """Camera file that the scene gets. Default: SOURCE/cameras.yaml, if it exists."""
    classes: Annotated[tuple[str, ...], Parameter("--class", metavar="NAME")] = ()
    """Class that is the object, by name or number; repeat for several; all: each but the
    background. Default: the only one. Of masks of other tools, and of networks."""
    pixels: Literal["auto", "classes", "alpha", "probability"] = "auto"
    """What pixels of other tools' masks mean: classes, alpha, probability (from one half on); auto:
    as the file tells."""
    background: str | Path | None = None
    """Empty room: a picture, or a folder with <camera>.png or <camera>/<frame>.png; median: of the
    pictures themselves, in which the body moves. Default: SOURCE/background, if it exists."""
    box: Annotated[
        tuple[float, ...] | None, from_text(partial(parse_numbers, count=4), "X,Y,W,H")
    ] = None
    """Box around the object in all pictures: left, top, width, height [pixel]."""
    model: Annotated[Path | None, Parameter(alias="-m")] = None
    """The object: URDF, SDFormat, MJCF or .dmd.yaml; pose and mask are found in turn."""
    start: Path | None = None
    """Rough joint positions of every frame [rad or m]: a CSV file with the column frame and one for
    each joint."""
    start_error: Annotated[float, Parameter(metavar="DEG")] = 5.0
    """How far off their angles are: standard deviation [deg]."""
    hold: Positions = field(default_factory=dict)
    """Hold this joint at a known position [deg or m]; repeat for several."""
    packages: Packages = field(default_factory=dict)
    network: Path | None = None
    """ONNX file of a segmentation network; --class NUMBER is the object."""
    network_size: Annotated[tuple[int, ...] | None, from_text(parse_size, "W,H")] = None
    """Size that the network takes [pixel]. Default: the pictures'."""
    network_mean: _Colour = (0.0, 0.0, 0.0)
    """It takes (colour / 255 - mean) / std."""
    network_std: _Colour = (1.0, 1.0, 1.0)
    """See --network-mean."""
    network_bgr: bool = False
    """It takes blue, green, red."""
    largest: bool = False
    """Keep only the largest patch of each mask."""

    def __post_init__(self) -> None:
        require_choices(self)
        for name, count in _COUNTS.items():
            values = getattr(self, name)
            if values is not None and (len(values) != count or not all(map(math.isfinite, values))):
                raise SettingsError(f"{name} must be {count} numbers, not {values}")
        ways = [name for name in _WAYS if getattr(self, name) is not None]
        if len(ways) > 1:
            raise SettingsError(f"--{ways[0]} and --{ways[1]} are two ways to find masks: give one")
        if ways and self.pixels != "auto":
            raise SettingsError(f"--pixels is for masks of other tools, not for --{ways[0]}")
        if self.classes and ways and ways != ["network"]:
            raise SettingsError(
                f"--class is for masks of other tools and networks, not for --{ways[0]}"
            )
        if (self.model is None) != (self.start is None):
            raise SettingsError("--model and --start need each other: rough joint positions")
        if not (math.isfinite(self.start_error) and self.start_error > 0.0):
            raise SettingsError("--start-error must be a positive number of degrees")
        if "network" not in ways and any(name.startswith("network") for name in changed(self)):
            raise SettingsError("options of a network need --network FILE")

    def as_json(self) -> Mapping[str, Any]:
        """The settings that are not the default's, as plain JSON values."""
        return {name: plain(getattr(self, name)) for name in changed(self)}
