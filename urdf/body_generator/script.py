"""What the scripts beside the bundled bodies share: their command line."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from body_generator.measures import Build, Measures
from body_generator.model import write_body
from body_generator.skin import body_bands, write_skin


def run(
    folder: Path,
    measures: Mapping[str, float],
    mass: float,
    *,
    skin: bool = False,
    **build: Any,
) -> None:
    """Read the command line and write a body.

    Args:
        folder: the script's own folder, where the body is written unless told otherwise.
        measures: the published measures [m].
        mass: the whole mass at the published stature [kg].
        skin: whether bands of skin are written, too.
        build: the other fields of ``Build``.
    """
    parser = argparse.ArgumentParser(description=f"Write {build['name']}.urdf and its meshes.")
    parser.add_argument("--stature", type=float, default=measures["stature"], help="in metres")
    parser.add_argument("--out", type=Path, default=folder, help="folder to write into")
    options = parser.parse_args()
    published = Measures(**measures)
    scaled_mass = mass * (options.stature / published.stature) ** 3
    scaled, scaled_build = published.scaled_to(options.stature), Build(mass=scaled_mass, **build)
    write_body(options.out, scaled, scaled_build)
    if skin:
        bands = body_bands(scaled, scaled_build)
        write_skin(options.out, scaled_build.name, f"make_{scaled_build.name}.py", bands)
