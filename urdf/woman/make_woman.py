"""Writes woman.urdf and its meshes; see --help."""

import sys
from pathlib import Path


def main() -> None:
    """Read the command line and write the model."""
    here = Path(__file__).resolve().parent
    sys.path.insert(0, str(here.parent))
    from body_generator.persons import WOMAN
    from body_generator.script import run

    run(here, WOMAN, skin=True)


if __name__ == "__main__":
    main()
