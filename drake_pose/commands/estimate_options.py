"""The options of `drake-pose estimate`, one type a name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

_MATCHED = "Input"
_ROOT = "Root of the search"
_SEARCH = "Search"
RESULT_PANEL = "Output"

SceneArgument = Annotated[
    Path,
    typer.Argument(
        help="Folder with cameras.yaml and masks/<camera>/<frame>.png; or with masks/<frame>.png "
        "alone, of a camera without calibration. A sequence may have images/<camera>/<frame>.png "
        "or .jpg, or videos/<camera>.mp4, and a mask of the first frame only."
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
        help="Folder of the package of package://NAME/... files; repeat for several. Packages that "
        "are not given are searched for in the folders above the model's file and in "
        "ROS_PACKAGE_PATH.",
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
        help="Use this camera; repeat for several. Default: all, used together.",
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
        metavar="NAME=VALUE",
        help=r"Hold this joint at a known position \[deg or m]; repeat for several.",
        rich_help_panel=_MATCHED,
    ),
]
UnseenOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LINK",
        help="This link is not in the pictures, as the forearm of a hand cut off; repeat for "
        "several. Its joints are held. URDF models alone.",
        rich_help_panel=_MATCHED,
    ),
]
TruthOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help=r"Measured joint positions \[rad or m] to compare with: a CSV file with the column "
        "frame and one for each joint. Default: SCENE/joint_angles.csv, if it exists.",
        rich_help_panel=_MATCHED,
    ),
]
RootOption = Annotated[
    str | None,
    typer.Option(
        metavar="LINK",
        help="The link that is placed first; any link. Default: the model's own root.",
        rich_help_panel=_ROOT,
    ),
]
RootPositionOption = Annotated[
    str | None,
    typer.Option(
        metavar="POINT",
        help=r"Position of the root's origin in the world: X,Y,Z \[m]; or FILE.csv:JOINT, a CSV "
        "file with the columns frame,joint,x,y,z and a row of that joint for each frame; or "
        "unknown, and it is searched (default if the scene has no cameras.yaml).",
        rich_help_panel=_ROOT,
    ),
]
RootRotationOption = Annotated[
    str | None,
    typer.Option(
        metavar="ROTATION",
        help=r"Rotation of the root: fixed, free, or limits \[deg] about its axes in the order of "
        "rotation, like y=-180:180,z=-10:10; zero is as at the model's default positions. Default: "
        "the model's own root moves as its joints allow, any other link is free.",
        rich_help_panel=_ROOT,
    ),
]
IntervalOption = Annotated[
    float,
    typer.Option(metavar="DEG", help="Sampling interval of all angles.", rich_help_panel=_SEARCH),
]
LengthIntervalOption = Annotated[
    float,
    typer.Option(
        metavar="M", help="Sampling interval of all prismatic joints.", rich_help_panel=_SEARCH
    ),
]
JointIntervalOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE",
        help=r"Sampling interval of one joint \[deg or m]; repeat for several.",
        rich_help_panel=_SEARCH,
    ),
]
OutsideLimitOption = Annotated[
    float | None,
    typer.Option(
        metavar="R",
        help=r"The paper's r: area of a segment that may lie outside the silhouette \[pixel]. "
        "Default: the smallest that gives a pose, found by doubling. Method paper only.",
        rich_help_panel=_SEARCH,
    ),
]
CandidatesOption = Annotated[
    int,
    typer.Option(
        metavar="K",
        help="The paper's K: number of candidates kept for each segment. Method paper only.",
        rich_help_panel=_SEARCH,
    ),
]
RunLimitOption = Annotated[
    int,
    typer.Option(
        metavar="N",
        help="Stop the search of a frame after placing this many segments. Method paper only.",
        rich_help_panel=_SEARCH,
    ),
]
TimeLimitOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        min=0.0,
        help="Stop the search of a frame after this time and return the best pose so far. Method "
        "beam only.",
        rich_help_panel=_SEARCH,
    ),
]
MethodOption = Annotated[
    str,
    typer.Option(
        metavar="NAME",
        help="beam: beam search and continuous fit; paper: Kameda, Minoh and Ikeda's search as "
        "published; person: one person, fitted to all cameras' silhouettes at once; auto: "
        "person if model, cameras and options allow it, else beam.",
        rich_help_panel=_SEARCH,
    ),
]
AnglesOption = Annotated[
    str,
    typer.Option(
        metavar="KIND",
        help="continuous: poses are refined between the samples; grid: multiples of the sampling "
        "interval only. Method beam only.",
        rich_help_panel=_SEARCH,
    ),
]
TrackOption = Annotated[
    bool,
    typer.Option(
        "--track/--no-track",
        help="Track the body through the frames of a sequence, searching only in the first frame "
        "and after a loss; or search in every frame.",
        rich_help_panel=_SEARCH,
    ),
]
StartOption = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Joint positions in the first frame of a sequence: CSV with the columns frame and "
        "positions' names [rad or m]. Rows of other frames are used after a loss.",
        rich_help_panel=_MATCHED,
    ),
]
ResumeOption = Annotated[
    bool,
    typer.Option(
        "--resume", help="Continue an interrupted result in --out.", rich_help_panel=RESULT_PANEL
    ),
]
ReplayOption = Annotated[
    bool,
    typer.Option("--replay/--no-replay", help="Write replay.html.", rich_help_panel=RESULT_PANEL),
]
OverlayOption = Annotated[
    bool,
    typer.Option(
        "--overlay/--no-overlay",
        help="Write overlay/<camera>/<frame>.png.",
        rich_help_panel=RESULT_PANEL,
    ),
]
PicturesOption = Annotated[
    Path | None,
    typer.Option("--out", "-o", help="Folder for pictures. Default: none are written."),
]
JsonOption = Annotated[
    bool,
    typer.Option("--json", help="Print the result as JSON.", rich_help_panel=RESULT_PANEL),
]
