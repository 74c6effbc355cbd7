"""Command line of the scripts that write the bundled bodies."""

import argparse
from pathlib import Path

from body_generator.measures import Build, Measures
from body_generator.model import write_body
from body_generator.persons import Person
from body_generator.skin import body_bands, write_skin


def run(folder: Path, person: Person, *, skin: bool = False) -> None:
    """Read the command line and write a body.

    Args:
        folder: the script's folder, where the body is written by default.
        person: the body.
        skin: whether to write bands of skin, too.
    """
    name = person.build["name"]
    parser = argparse.ArgumentParser(description=f"Write {name}.urdf and its meshes.")
    parser.add_argument(
        "--stature", type=float, default=person.measures["stature"], help="in metres"
    )
    parser.add_argument("--out", type=Path, default=folder, help="folder to write into")
    options = parser.parse_args()
    published = Measures(**person.measures)
    scaled = published.scaled_to(options.stature)
    mass = person.mass * (options.stature / published.stature) ** 3
    build = Build(mass=mass, mass_fractions=person.mass_fractions, **person.build)
    write_body(options.out, scaled, build)
    if skin:
        write_skin(options.out, name, f"make_{name}.py", body_bands(scaled, build))
