"""How masks are found; plain values only."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from drake_pose.errors import SettingsError
from drake_pose.silhouette.segmentation.mask_pictures import MEANINGS, PixelMeaning

MEDIAN = "median"

_COUNTS = {"box": 4, "network_size": 2, "network_mean": 3, "network_std": 3}
_WAYS = ("background", "box", "strokes", "draw", "model", "network")


@dataclass(frozen=True)
class MaskSettings:
    """How masks are found; where no way is given, the source holds masks of another tool.

    Args:
        pixels: what the pixels of such masks' pictures mean, see ``read_mask_picture``.
        classes: which of their classes, or of a network's, are the object: names or numbers;
            ``all``: each but the background.
        background: pictures of the empty room: a file, or a folder with ``<camera>.png`` or
            ``<camera>/<frame>.png``; ``median``: each pixel's median over the source's pictures.
        box: x, y, width and height of a box around the object in all pictures [pixel].
        strokes: a file of boxes and lines by camera and frame, see ``read_strokes``.
        draw: whether boxes and lines are drawn on a page in the browser.
        port: of that page; any free one where not given.
        model: the object's own model: pose and mask in turn, from ``start``.
        start: a table of rough joint positions of each frame [rad or m].
        start_error: standard deviation of its angles [deg].
        hold: joints of the model that are held, by name [deg or m].
        packages: folders of packages that the model's ``package://`` names mean, by name.
        network: an ONNX file of a network that segments pictures.
        network_size: width and height that it takes [pixel]; None: pictures stay as they are.
        network_mean, network_std: of red, green and blue, 0 to 1, by which they are normalised.
        network_bgr: whether it takes blue, green, red.
        largest: whether only the largest patch of each mask is kept.
        cameras: a camera file; that of the source where not given, if it has one.

    Raises:
        SettingsError: an unknown meaning, several ways at once, or options of another way.
    """

    pixels: PixelMeaning = "auto"
    classes: tuple[str, ...] = ()
    background: Path | str | None = None
    box: tuple[float, ...] | None = None
    strokes: Path | None = None
    draw: bool = False
    port: int | None = None
    model: Path | None = None
    start: Path | None = None
    start_error: float = 5.0
    hold: Mapping[str, float] = field(default_factory=dict)
    packages: Mapping[str, Path] = field(default_factory=dict)
    network: Path | None = None
    network_size: tuple[int, ...] | None = None
    network_mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    network_std: tuple[float, ...] = (1.0, 1.0, 1.0)
    network_bgr: bool = False
    largest: bool = False
    cameras: Path | None = None

    def __post_init__(self) -> None:
        if self.pixels not in MEANINGS:
            raise SettingsError(f"pixels must be {', '.join(MEANINGS)}, not '{self.pixels}'")
        for name, count in _COUNTS.items():
            values = getattr(self, name)
            if values is not None and (len(values) != count or not all(map(math.isfinite, values))):
                raise SettingsError(f"{name} must be {count} numbers, not {values}")
        ways = [name for name in _WAYS if getattr(self, name) not in (None, False)]
        if len(ways) > 1 and set(ways) != {"box", "strokes"}:
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
        if "network" not in ways and any(name.startswith("network") for name in self._own()):
            raise SettingsError("options of a network need --network FILE")

    def as_json(self) -> Mapping[str, Any]:
        """The settings that are not the default's, as plain JSON values."""
        values = asdict(self)
        values["packages"] = {name: str(folder) for name, folder in self.packages.items()}
        return {
            name: str(values[name]) if isinstance(values[name], Path) else values[name]
            for name in self._own()
        }

    def _own(self) -> list[str]:
        """The names of those that are not the default's."""
        default = {one.name: one.default for one in fields(self)} | {"hold": {}, "packages": {}}
        return [name for name, value in default.items() if getattr(self, name) != value]
