"""Options that several commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from drake_pose.files.options import within

SPREAD = Parameter("*")
"""The fields of a settings class are options."""

Model = Annotated[
    Path, Parameter(["--model", "-m"], help="The body: URDF, SDFormat, MJCF or .dmd.yaml.")
]
Out = Annotated[Path, Parameter(["--out", "-o"], help="Folder for the result; new or empty.")]
Pictures = Annotated[
    Path | None, Parameter(["--out", "-o"], help="Folder for pictures. Default: none are written.")
]
Resume = Annotated[bool, Parameter(help="Continue an interrupted result in --out.")]
Replay = Annotated[bool, Parameter(negative="--no-replay", help="Write replay.html.")]
Overlay = Annotated[
    bool, Parameter(negative="--no-overlay", help="Write overlay/<camera>/<frame>.png.")
]
Browser = Annotated[bool, Parameter(negative="--no-browser", help="Open the page in the browser.")]
Json = Annotated[bool, Parameter(help="Print the result as JSON.")]
Truth = Annotated[
    Path | None,
    Parameter(
        help="Measured joint positions [rad or m] to compare with: a CSV file with the column "
        "frame and one for each joint. Default: SCENE/joint_angles.csv, if it exists."
    ),
]
Seed = Annotated[int, within(0), Parameter(help="Seed of the random numbers.")]
