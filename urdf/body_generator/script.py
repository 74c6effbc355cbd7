"""What the scripts beside the bundled bodies share: their command line."""

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from body_generator.measures import Build, Measures
from body_generator.model import write_body


def run(
    folder: Path,
    measures: Mapping[str, float],
    mass: float,
    **build: Any,
) -> None:
    """Read the command line and write a body.

    Args:
        folder: the script's own folder, where the body is written unless told otherwise.
        measures: the published measures [m].
        mass: the whole mass at the published stature [kg].
        build: the other fields of ``Build``.
    """
    parser = argparse.ArgumentParser(description=f"Write {build['name']}.urdf and its meshes.")
    parser.add_argument("--stature", type=float, default=measures["stature"], help="in metres")
    parser.add_argument("--out", type=Path, default=folder, help="folder to write into")
    options = parser.parse_args()
    published = Measures(**measures)
    scaled_mass = mass * (options.stature / published.stature) ** 3
    write_body(options.out, published.scaled_to(options.stature), Build(mass=scaled_mass, **build))
