"""Bands of skin: a mesh for each band, and the skin file of the model."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .bands import BANDS, Band, band_shell
from .measures import Build, Measures
from .model import SEGMENTS, link_origin, link_shells
from .shapes import Shell
from .writing import write_meshes


@dataclass(frozen=True)
class LinkBand:
    """A band between two links.

    Attributes:
        parent, child: the links.
        file: name of its mesh, without suffix.
        band: its place on the left side, in the child's frame.
        shell: its surface on the left side.
        mirrored: whether the links are on the right side.
        colour: (3,) in 0..1.
    """

    parent: str
    child: str
    file: str
    band: Band
    shell: Shell
    mirrored: bool
    colour: tuple[float, float, float]

    def text(self) -> str:
        """Return the entry of the skin file."""
        axis = np.array(self.band.axis) * ([-1.0, 1.0, 1.0] if self.mirrored else 1.0) + 0.0
        return (
            f"- parent: {self.parent}\n"
            f"  child: {self.child}\n"
            f"  mesh: meshes/{self.file}.obj\n"
            f"  axis: [{', '.join(f'{x:g}' for x in axis)}]\n"
            f"  begin: {self.band.begin:.5f}\n"
            f"  end: {self.band.end:.5f}\n"
            f"  colour: [{', '.join(f'{x:g}' for x in self.colour)}]\n"
        )


def body_bands(measures: Measures, build: Build) -> list[LinkBand]:
    """Return the bands of a human body."""
    kinds: dict[str, tuple[Band, Shell]] = {}
    bands = []
    for link, (parent, kind, _) in SEGMENTS.items():
        if not parent:
            continue
        if kind not in kinds:
            band = BANDS[kind].scaled(measures.stature / 1.6285)
            left = link.replace("right_", "left_")
            kinds[kind] = band, _body_shell(left, band, measures, build)
        band, shell = kinds[kind]
        mirrored = link.startswith("right_")
        colour = build.colours[band.material]
        bands.append(LinkBand(parent, link, f"{link}_skin", band, shell, mirrored, colour))
    return bands


def _body_shell(link: str, band: Band, measures: Measures, build: Build) -> Shell:
    """Return the closed band between a link and its parent, in the link's frame."""
    parent = SEGMENTS[link][0]
    offset = link_origin(parent, measures) - link_origin(link, measures)
    shells = [shell.moved(offset) for shell in link_shells(parent, measures, build)]
    return band_shell(band, shells + link_shells(link, measures, build))


def write_skin(folder: Path, model: str, script: str, bands: Sequence[LinkBand]) -> None:
    """Write <model>.skin.yaml and the bands' meshes into the folder of a model.

    Args:
        folder: the model's folder.
        model: name of the URDF, without suffix.
        script: name of the script that writes them.
        bands: all bands of the model.
    """
    write_meshes(
        folder,
        {band.file: [band.shell.mirrored() if band.mirrored else band.shell] for band in bands},
    )
    text = f"# Written by {script}: do not edit.\nbands:\n"
    text += "".join(band.text() for band in bands)
    (folder / f"{model}.skin.yaml").write_text(text, encoding="ascii")
