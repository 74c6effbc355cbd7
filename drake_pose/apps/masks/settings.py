"""How masks are found; plain values only."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from drake_pose.errors import SettingsError
from drake_pose.silhouette.segmentation.mask_pictures import MEANINGS, PixelMeaning


@dataclass(frozen=True)
class MaskSettings:
    """How masks are found; where nothing is said, the source holds masks of another tool.

    Args:
        pixels: what the pixels of such masks' pictures mean, see ``read_mask_picture``.
        classes: which of their classes, or of a network's, are the object: names or numbers;
            ``all``: each but the background.
        largest: whether only the largest patch of each mask is kept.
        cameras: a camera file; that of the source where not given, if it has one.

    Raises:
        SettingsError: an unknown meaning.
    """

    pixels: PixelMeaning = "auto"
    classes: tuple[str, ...] = ()
    largest: bool = False
    cameras: Path | None = None

    def __post_init__(self) -> None:
        if self.pixels not in MEANINGS:
            raise SettingsError(f"pixels must be {', '.join(MEANINGS)}, not '{self.pixels}'")

    def as_json(self) -> Mapping[str, Any]:
        """The settings that are not the default's, as plain JSON values."""
        values = asdict(self)
        own = {field.name for field in fields(self) if values[field.name] != field.default}
        return {
            name: str(value) if isinstance(value, Path) else value
            for name, value in values.items()
            if name in own
        }
