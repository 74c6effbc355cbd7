"""What an estimate of a scene is made with; plain values only."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Literal

from drake_pose.errors import SettingsError
from drake_pose.results.options import Axis

METHODS = ("auto", "beam", "paper", "person")
ANGLES = ("continuous", "grid")
# What a search for the pose heeds, and one who is followed by all silhouettes at once does not.
_OF_THE_SEARCH = (
    "root", "root_position", "root_rotation", "interval", "length_interval", "joint_intervals",
    "outside_limit", "candidates", "run_limit", "time_limit", "hold", "unseen", "angles",
)  # fmt: skip
RootTurns = Literal["fixed", "free"] | Mapping[Axis, tuple[float, float]]


@dataclass(frozen=True)
class EstimateSettings:
    """Settings of an estimate.

    Args:
        cameras: names of the cameras to match together; all where empty.
        frames: the frames: names, or ranges ``FIRST:LAST``; all where empty.
        root: the link the pose tree begins at; the model's own root where None.
        root_position: where the root's origin is in the world [m], or the file of joint centres
            and the joint in it that is the root in each frame; ``unknown``: searched; the model's
            own where None, but searched where the cameras are not known.
        root_rotation: ``fixed``, ``free``, or limits of the angles about the root's axes by name,
            in the order of rotation [deg]. At angles of zero the root stands in the world as it
            does at the model's default positions. None: the model's own joints tell, or free.
        interval: sampling interval of every angle [deg]; the paper took 10 for real pictures.
        length_interval: sampling interval of every length [m].
        joint_intervals: sampling intervals of single positions by name [deg or m].
        outside_limit: the paper's r, the area of a segment that may lie outside the silhouette
            [pixel]; None: found automatically. Of the method ``paper`` alone.
        candidates: the paper's K, how many candidates of a segment are kept; ``paper`` alone.
        run_limit: after this many runs of step 3 the search of a frame returns its best pose;
            ``paper`` alone.
        time_limit: after this time [s] the search of a frame returns its best pose; None: no
            limit. Of the method ``beam`` alone.
        hold: positions that are known, by name [deg or m].
        unseen: links that are not in the pictures, such as the forearm of a hand cut off at the
            wrist; their joints are held.
        method: ``beam``: many hypotheses side by side; ``paper``: the search as it was published;
            ``person``: one person is followed by the silhouettes of several cameras at once;
            ``auto``: ``person`` where model and scene allow it and no setting concerns a search,
            else ``beam``.
        angles: ``continuous``: refined between the samples; ``grid``: multiples of the interval
            alone, as always with the method ``paper``. Of the method ``beam`` alone.
        track: whether frames of a sequence are tracked; else every one is matched on its own.
        start: a file of the joint positions in the first frame of a sequence, in the columns
            `frame` and positions' names; rows of other frames say where the body is after a loss.
        packages: folders of packages that the model's ``package://`` names mean, by name.

    Raises:
        SettingsError: if there is no such method, an option belongs to the other one, or a count
            is below 1.
    """

    cameras: tuple[str, ...] = ()
    frames: tuple[str, ...] = ()
    root: str | None = None
    root_position: tuple[float, float, float] | tuple[Path, str] | Literal["unknown"] | None = None
    root_rotation: RootTurns | None = None
    interval: float = 10.0
    length_interval: float = 0.05
    joint_intervals: Mapping[str, float] = field(default_factory=dict)
    outside_limit: float | None = None
    candidates: int = 5
    run_limit: int = 10_000
    time_limit: float | None = None
    hold: Mapping[str, float] = field(default_factory=dict)
    unseen: Sequence[str] = ()
    method: str = "auto"
    angles: str = "continuous"
    track: bool = True
    start: Path | None = None
    packages: Mapping[str, Path] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SettingsError(
                f"there is no method '{self.method}'; there is: {', '.join(METHODS)}"
            )
        if self.angles not in ANGLES:
            raise SettingsError(f"angles must be {' or '.join(ANGLES)}, not '{self.angles}'")
        for name in ("candidates", "run_limit"):
            if getattr(self, name) < 1:
                raise SettingsError(f"{name} must be 1 or more, not {getattr(self, name)}")
        if self.method in ("auto", "beam") and self.outside_limit is not None:
            raise SettingsError("the beam search has no outside limit r; leave it out")
        if self.method == "person" and self.search_settings:
            raise SettingsError(
                f"the method person follows a person and searches no pose; leave "
                f"{self.search_settings[0]} out"
            )
        if self.method == "paper" and self.time_limit is not None:
            raise SettingsError("the paper's search has no time limit; give a run limit instead")

    @property
    def search_settings(self) -> tuple[str, ...]:
        """The names of those that only a search heeds and that are not at their defaults."""
        return tuple(
            one.name
            for one in fields(self)
            if one.name in _OF_THE_SEARCH
            and getattr(self, one.name) != ({} if one.default is MISSING else one.default)
        )

    def as_json(self) -> dict[str, Any]:
        """Returns the settings as plain JSON values."""
        values = asdict(self)
        if isinstance(self.root_position, tuple):
            values["root_position"] = [
                str(part) if isinstance(part, Path) else part for part in self.root_position
            ]
        if isinstance(self.root_rotation, Mapping):
            values["root_rotation"] = [
                [axis, lower, upper] for axis, (lower, upper) in self.root_rotation.items()
            ]
        values["start"] = None if self.start is None else str(self.start)
        values["packages"] = {name: str(folder) for name, folder in self.packages.items()}
        lists = {name: list(getattr(self, name)) for name in ("cameras", "frames", "unseen")}
        return values | lists
