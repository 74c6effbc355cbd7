"""The options of `drake-pose estimate`, one type a name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_MATCHED = "What is matched"
_ROOT = "Where the search begins"
_SEARCH = "How finely and how long it searches"
RESULT_PANEL = "The result"

SceneArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with cameras.yaml and masks/<camera>/<frame>.png; or with masks/<frame>.png "
        "alone, of a camera that nobody knows."
    ),
]
ModelOption = Annotated[
    Path,
    typer.Option(
        "--model", "-m", metavar="FILE", help="The body: URDF, SDFormat, MJCF or .dmd.yaml."
    ),
]
PackageOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=FOLDER",
        help="Where the package of the model's package://NAME/... files lies; repeat for several. "
        "Others are looked for on the way up from the model's file and in ROS_PACKAGE_PATH.",
    ),
]
OutOption = Annotated[
    Path,
    typer.Option("--out", "-o", metavar="DIR", help="Folder for the result; new or empty."),
]
CameraOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Use this camera; repeat for several. Default: all, matched together.",
        rich_help_panel=_MATCHED,
    ),
]
FrameOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME",
        help="Estimate this frame, or frames FIRST:LAST; repeat for several. Default: all.",
        rich_help_panel=_MATCHED,
    ),
]
HoldOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=DEG",
        help=r"A joint whose position is known \[deg or m]; repeat for several.",
        rich_help_panel=_MATCHED,
    ),
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=r"Measured joint angles \[rad] to compare with, columns frame and joints. "
        "Default: SCENE/joint_angles.csv, if it is there.",
        rich_help_panel=_MATCHED,
    ),
]
RootOption = Annotated[
    str | None,
    typer.Option(
        metavar="LINK",
        help="The link placed first; any link. Default: the model's own.",
        rich_help_panel=_ROOT,
    ),
]
RootPositionOption = Annotated[
    str | None,
    typer.Option(
        metavar="POINT",
        help=r"Where its origin is in the world: X,Y,Z \[m], or FILE.csv:JOINT for the rows "
        "frame,joint,x,y,z of that joint, one a frame; or unknown: it is searched, as it is where "
        "the scene has no cameras.yaml.",
        rich_help_panel=_ROOT,
    ),
]
RootRotationOption = Annotated[
    str | None,
    typer.Option(
        metavar="TURN",
        help=r"fixed, free, or limits \[deg] about its axes in the order of rotation, like "
        "y=-180:180,z=-10:10; zero is how the model's file has it stand. Default: the model's own "
        "root stays as its file and joints say, any other link is free.",
        rich_help_panel=_ROOT,
    ),
]
IntervalOption = Annotated[
    float,
    typer.Option(metavar="DEG", help="Sampling interval of angles.", rich_help_panel=_SEARCH),
]
LengthIntervalOption = Annotated[
    float,
    typer.Option(
        metavar="M", help="Sampling interval of prismatic joints.", rich_help_panel=_SEARCH
    ),
]
JointIntervalOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=DEG",
        help=r"Sampling interval of one joint \[deg or m]; repeat for several.",
        rich_help_panel=_SEARCH,
    ),
]
OutsideLimitOption = Annotated[
    float | None,
    typer.Option(
        metavar="R",
        help=r"How much of a segment may lie outside the silhouette \[pixel]. Default: as "
        "little as is possible, found by doubling. Method paper only.",
        rich_help_panel=_SEARCH,
    ),
]
CandidatesOption = Annotated[
    int,
    typer.Option(
        metavar="K",
        help="How many candidates a segment keeps; method paper.",
        rich_help_panel=_SEARCH,
    ),
]
RunLimitOption = Annotated[
    int,
    typer.Option(
        metavar="N",
        help="Stop a frame's search after placing so many segments; method paper.",
        rich_help_panel=_SEARCH,
    ),
]
TimeLimitOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        min=0.0,
        help="Answer with the best pose so far after this time a frame; method wide.",
        rich_help_panel=_SEARCH,
    ),
]
MethodOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="wide: many hypotheses side by side; paper: as published; person: one person followed "
        "by several cameras at once; auto: person where model, cameras and options allow it, else "
        "wide.",
        rich_help_panel=_SEARCH,
    ),
]
AnglesOption = Annotated[
    str,
    typer.Option(
        metavar="KIND",
        help="continuous: refined to whatever fits; grid: multiples of the interval only. "
        "Method wide only.",
        rich_help_panel=_SEARCH,
    ),
]
TrackOption = Annotated[
    bool,
    typer.Option(
        "--track/--no-track",
        help="Whether the frames of a scene that is a sequence are tracked: matched first, and "
        "after a loss. Otherwise every frame is matched on its own.",
        rich_help_panel=_SEARCH,
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option(
        "--resume", help="Go on with an interrupted result in --out.", rich_help_panel=RESULT_PANEL
    ),
]
ReplayOption = Annotated[
    bool,
    typer.Option(
        "--replay/--no-replay", help="Whether to write replay.html.", rich_help_panel=RESULT_PANEL
    ),
]
OverlayOption = Annotated[
    bool,
    typer.Option(
        "--overlay/--no-overlay",
        help="Whether to write overlay/<camera>/<frame>.png.",
        rich_help_panel=RESULT_PANEL,
    ),
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print JSON for a program to read.", rich_help_panel=RESULT_PANEL),
]
