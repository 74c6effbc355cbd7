"""Settings of estimates, captures, registrations, audits, episodes and masks.

Each field of a settings class is a command line option (cyclopts), a key of a batch's job file and
an argument in Python. Its entry in the class's docstring is the option's help text. The parsers of
option texts raise SettingsError for a text of another form.
"""

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from cyclopts import Group, Parameter, Token

from drake_pose.errors import SettingsError, for_caller, require_at_least, require_positive

_Settings = TypeVar("_Settings", bound=type)
_Value = TypeVar("_Value")
Axis = Literal["x", "y", "z"]
RootTurns = Literal["fixed", "free"] | Mapping[Axis, tuple[float, float]]
RootPosition = tuple[float, float, float] | tuple[Path, str] | Literal["unknown"]

GONE = {
    "masks --box": "take the masks of a segmentation network, or paint them",
    "masks --model": "take the masks of a segmentation network, or paint them",
    "undistort": "use cv2.undistort, as tutorials/commands.md shows",
    "walk": "use the system Walker in a diagram, as tutorials/people.md shows",
    "capture --shape": "leave it out; lengths and radii are fitted to the first frames",
    "--suggest": "the warning of several poses names the joint that tells them apart best",
    "--keep-out": "the warning of several poses names the joint that tells them apart best",
    "capture --start": "give masks of every frame, from which a person is captured",
    "reproduce all": "run reproduce kameda, shimada and date; tutorials/figures.md has the results",
    "reproduce --seeds": "run the command with several --seed",
    "reproduce --outside-limit": "use drake_pose.search.PaperSearch in Python",
    "reproduce --candidates": "use drake_pose.search.PaperSearch in Python",
    "reproduce --interval": "use drake_pose.search.PaperSearch in Python",
    "reproduce --observed": "the lines of the paper are observed, or silhouettes with --pictures",
    "reproduce --noise": "the noise is the one that tutorials/figures.md reports",
    "reproduce --acceleration": "the filter is the one that tutorials/figures.md reports",
    "--time-limit": "leave it out; every search ends by itself",
    "--fit-shape": "leave it out; the shape is fitted if the model has joints for it",
    "--no-fit-shape": "give a --model without joints for its shape",
    "batch --chunk": "set chunk in the job file",
    "--export rerun": "log what drake_pose.load_cameras reads by rerun's own package",
    "capture --tolerance": "correct the time stamps; pictures half a period apart are of one time",
}
"""What to use instead of commands, their options ("--name", "command --name") and values ("--name
value") that are gone.

The keys of job files are those of the options."""


def say_gone(names: Iterable[str]) -> str | None:
    """Return what to use instead of the first of the names that is in GONE; None if none is."""
    return next((f"{one} is gone: {GONE[one]}" for one in names if one in GONE), None)


@dataclass(frozen=True)
class FromText:
    """Converter of an option for cyclopts.

    ``parse``: returns the value of the option's text; raises a SettingsError. ``repeated``: whether
    the option may be repeated: ``parse`` gets the list of its texts.
    """

    parse: Callable[[Any], Any]
    repeated: bool = False

    def __call__(self, hint: object, tokens: Sequence[Token]) -> Any:
        """Return the value of an option's tokens; the type hint of the option is not used.

        Raises:
            SettingsError: a text cannot be parsed; the message begins with the option's name.
        """
        texts = [token.value for token in tokens]
        try:
            return self.parse(texts if self.repeated else texts[0])
        except SettingsError as error:
            raise SettingsError(f"{tokens[0].keyword}: {error}") from None


def from_text(
    parse: Callable[[Any], Any], metavar: str, *, name: str | None = None, repeated: bool = False
) -> Parameter:
    """Return the cyclopts parameter of an option whose text ``parse`` converts.

    ``parse``, ``repeated``: as in `FromText`. ``metavar``: form of the text, for the help.
    ``name``: the option's name; None: that of the settings field.
    """
    return Parameter(
        name, converter=FromText(parse, repeated), metavar=metavar, accepts_keys=False,
        allow_leading_hyphen=True, n_tokens=-1 if repeated else 1,
    )  # fmt: skip


def within(low: float, high: float = math.inf) -> Parameter:
    """Return the cyclopts parameter of an option that is None or a finite number in [low, high]."""

    def check(hint: object, value: float | None) -> None:
        """Raise a ValueError if the value is out of range; the type hint is not used."""
        if value is not None and not (math.isfinite(value) and low <= value <= high):
            wanted = f"{low:g} or more" if high == math.inf else f"{low:g} to {high:g}"
            raise ValueError(f"It must be {wanted}.")

    return Parameter(validator=check)


def parse_number(text: str) -> float:
    """Return the finite number of a text."""
    try:
        number = float(text)
    except ValueError:
        raise SettingsError(f"'{text}' is not a number") from None
    if not math.isfinite(number):
        raise SettingsError(f"'{text}' is not a finite number")
    return number


def parse_folder(text: str) -> Path:
    """Return the absolute path of a folder that exists."""
    if not Path(text).is_dir():
        raise SettingsError(f"there is no folder {text}")
    return Path(text).absolute()


def _by_name(
    pairs: Iterable[tuple[str, str, str]], form: str, parse: Callable[[str], _Value]
) -> dict[str, _Value]:
    """Return parsed values by name; ``pairs``: name, "=" and text; ``form``: for the message."""
    values: dict[str, _Value] = {}
    for name, equals, text in pairs:
        if not (name and equals and text):
            raise SettingsError(f"'{name}{equals}{text}' must have the form {form}")
        if name in values:
            raise SettingsError(f"'{name}' is given twice")
        values[name] = parse(text)
    return values


def parse_assignments(texts: Iterable[str]) -> dict[str, float]:
    """Return the numbers of ``NAME=NUMBER`` texts by name."""
    return _by_name((text.rpartition("=") for text in texts), "NAME=NUMBER", parse_number)


def parse_packages(texts: Iterable[str]) -> dict[str, Path]:
    """Return the absolute folders of ``NAME=FOLDER`` texts by package name."""
    return _by_name((text.partition("=") for text in texts), "NAME=FOLDER", parse_folder)


def parse_root_position(text: str) -> RootPosition:
    """Return a position ``X,Y,Z`` [m], the file and joint of ``FILE.csv:JOINT``, or ``unknown``."""
    if text == "unknown":
        return "unknown"
    if text.count(",") == 2:
        x, y, z = map(parse_number, text.split(","))
        return x, y, z
    file, colon, joint = text.rpartition(":")
    if not (colon and file and joint):
        raise SettingsError(
            f"'{text}' must be X,Y,Z in metres, FILE.csv:JOINT (one position a frame) or unknown"
        )
    return Path(file), joint


def parse_root_rotation(text: str) -> RootTurns:
    """Return "fixed", "free", or limits [deg] by axis of a text like ``y=-180:180,z=-10:10``."""
    if text == "fixed":
        return "fixed"
    if text == "free":
        return "free"
    limits: dict[Axis, tuple[float, float]] = {}
    axes: tuple[Axis, ...] = get_args(Axis)
    for part in text.split(","):
        letter, equals, span = part.strip().partition("=")
        lower_text, colon, upper_text = span.partition(":")
        axis = next((axis for axis in axes if axis == letter), None)
        if axis is None or axis in limits or not (equals and colon):
            raise SettingsError(
                f"'{text}' must be fixed, free, or limits in degrees about the axes x, y, z in "
                "the order of rotation, like y=-180:180,z=-10:10"
            )
        lower, upper = parse_number(lower_text), parse_number(upper_text)
        if lower > upper:
            raise SettingsError(f"{axis}: the lower limit {lower:g} exceeds the upper {upper:g}")
        limits[axis] = (lower, upper)
    return limits


def percent(fraction: float | None) -> str:
    """Return a fraction in percent with two decimals; "unknown" for None or nan."""
    return "unknown" if fraction is None or math.isnan(fraction) else f"{100.0 * fraction:.2f} %"


def documented(cls: _Settings) -> _Settings:
    """Decorate a settings dataclass for ``help()`` and Sphinx.

    The Args of its docstring get the inherited fields, and its signature has plain types.
    """
    made: Any = cls
    own, _, _ = inspect.cleandoc(cls.__doc__ or "").partition("\n\nArgs:\n")
    entries: dict[str, str] = {}
    for one in cls.__mro__:
        args = inspect.cleandoc(one.__doc__ or "").partition("\nArgs:\n")[2]
        for entry in re.split(r"\n(?=    \w)", args):
            entries.setdefault(entry.partition(":")[0].strip(), entry)
    listed = "\n".join(entries[one.name] for one in fields(made))
    made.__doc__ = f"{own}\n\nArgs:\n{listed}\n"
    made.__init__.__annotations__ = get_type_hints(cls)
    return cls


def check_choices(settings: Any) -> None:
    """Check names in settings; a single name, such as "elbow", becomes a tuple where it may.

    Raises:
        SettingsError: a field of names holds something else, or a name is not among its choices.
    """
    for name, hint in get_type_hints(type(settings)).items():
        value, kind = getattr(settings, name), hint
        if get_origin(hint) is tuple and get_args(hint)[1:] == (...,):
            kind = get_args(hint)[0]
            is_many = isinstance(value, Iterable) and not isinstance(value, Mapping | str)
            value = tuple(value) if is_many else (value,)
            if not all(isinstance(one, str) for one in value):
                raise SettingsError(
                    f"{name} must be names like ('a', 'b'), not {getattr(settings, name)!r}"
                )
            object.__setattr__(settings, name, value)
        for one in value if isinstance(value, tuple) else (value,):
            if get_origin(kind) is Literal and one not in get_args(kind):
                known = ", ".join(get_args(kind))
                raise SettingsError(f"there is no {name.rstrip('s')} '{one}'; there is: {known}")


def in_group(title: str) -> Parameter:
    """Return the cyclopts parameter of an option that the help shows in the group of this title."""
    return Parameter(group=Group.create_ordered(title))


SELECTION = in_group("Cameras and frames")
BODY = in_group("Body")
EPISODE = in_group("Recorded episodes")
LIVE = in_group("Live capture")
RUNNING = in_group("Running and output")

Names = Annotated[tuple[str, ...], Parameter(metavar="NAME")]
Links = Annotated[tuple[str, ...], Parameter(metavar="LINK")]
Positions = Annotated[
    Mapping[str, float], from_text(parse_assignments, "NAME=VALUE", repeated=True)
]
Packages = Annotated[
    Mapping[str, Path], from_text(parse_packages, "NAME=FOLDER", name="--package", repeated=True)
]


@dataclass(frozen=True, kw_only=True)
class SceneSettings:
    """Cameras and frames of a scene to use, and the folders of the model's packages.

    Args:
        cameras: Use this camera; repeat for several. Default: all, used together.
        frames: Use this frame, or frames FIRST:LAST; repeat for several. Default: all.
        every: Use only every Nth frame, starting with the first.
        packages: Folder of the package of package://NAME/... files; repeat for several. Others are
            searched for above the model's file and in ROS_PACKAGE_PATH.
    """

    cameras: Annotated[Names, Parameter("--camera"), SELECTION] = ()
    frames: Annotated[Names, Parameter("--frame"), SELECTION] = ()
    every: Annotated[int, Parameter(metavar="N"), SELECTION] = 1
    packages: Annotated[Packages, BODY] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_choices(self)

    def as_json(self) -> dict[str, Any]:
        """Return the settings that affect the result as plain JSON values."""
        return {
            one.name: plain(getattr(self, one.name))
            for one in fields(self)
            if one.name != "workers"
        }


@documented
@dataclass(frozen=True, kw_only=True)
class CaptureSettings(SceneSettings):
    """Settings that estimates and the capture of a person share.

    Args:
        track: Track the body through a sequence, and search only in the first frame and after a
            loss (default); --no-track: search in every frame.
    """

    track: Annotated[bool, Parameter(negative="--no-track"), SELECTION] = True


CaptureMethod = Literal["person", "paper"]
"""person: a fit to all silhouettes at once; paper: the stages of Date et al. as published."""


@documented
@dataclass(frozen=True, kw_only=True)
class LiveSettings:
    """Settings of a live capture.

    Raises SettingsError: the time is not positive, or an option lacks the one that it needs.

    Args:
        seconds: Stop after this time [s]. Default: at the end of the recordings, or by Ctrl-C.
        face_camera: With --method paper: the camera before the face, for the direction of the head;
            needs --faces.
        faces: With --method paper: folder with pictures of the person's face and directions.csv,
            which has the columns picture, turn and nod [deg].
    """

    seconds: Annotated[float | None, within(0.01), LIVE] = None
    face_camera: Annotated[str | None, Parameter(metavar="NAME"), LIVE] = None
    faces: Annotated[Path | None, Parameter(metavar="FOLDER"), LIVE] = None

    def __post_init__(self) -> None:
        require_positive(seconds=self.seconds)
        if (self.face_camera is None) != (self.faces is None):
            raise SettingsError("--face-camera and --faces need each other")


@dataclass(frozen=True, kw_only=True)
class EpisodeSettings(SceneSettings):
    """Settings for reading a robot's recorded episode.

    Args:
        episode: Number of the episode in a LeRobot data set. Default: the only one.
        joint_map: YAML file that assigns columns of the joint log to joints, with their units; or
            the calibration file of a LeRobot robot (JSON).
        intrinsics: Camera file with intrinsics, if --cameras has poses alone, as those of
            easy_handeye and DROID. Default: the recording's own.
        units: Unit of the angles in the joint log: rad, deg, normalised (LeRobot's -100 to 100 of a
            motor's range) or steps (of its encoder). Default: inferred from the readings and the
            joints' limits.
        workers: Number of threads; the result does not depend on it. Default: one for each core.
    """

    episode: Annotated[int | None, Parameter(metavar="N"), EPISODE] = None
    joint_map: Annotated[Path | None, EPISODE] = None
    intrinsics: Annotated[Path | None, EPISODE] = None
    units: Annotated[Literal["rad", "deg", "normalised", "steps"] | None, EPISODE] = None
    workers: Annotated[int | None, Parameter(metavar="N"), RUNNING] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require_at_least(1, workers=self.workers)


@documented
@dataclass(frozen=True, kw_only=True)
class EstimateSettings(CaptureSettings, EpisodeSettings):
    """Settings of the estimate of a scene.

    Raises SettingsError: the method does not exist or lacks an option, or a number is out of range.

    Args:
        method: beam: beam search and continuous fit; paper: the search of Kameda, Minoh and Ikeda
            as published; person: fit one person to all cameras' silhouettes at once; auto: person
            if model, cameras and options allow it, else beam.
        start: Joint positions in the first frame of a sequence [rad or m]: CSV file with the column
            frame, or time [s], and one for each joint. Other rows are used after a loss.
        hold: Hold this joint at a known position [deg or m]; repeat for several.
        unseen: This link is missing in the pictures, such as the forearm of a hand cut off at the
            wrist; repeat for several. Its joints are held. URDF models only.
        root: Link at which the search starts; any link. Default: the model's root.
        root_position: Position of the root's origin in the world: X,Y,Z [m]; or FILE.csv:JOINT, a
            CSV file with the columns frame,joint,x,y,z and a row of that joint for each frame; or
            unknown, to search it (the default if the scene has no cameras.yaml).
        root_rotation: Rotation of the root: fixed, free, or limits [deg] about its axes in the
            order of rotation, like y=-180:180,z=-10:10; zero is the rotation at the model's default
            positions. Default: the model's own root moves as its joints allow, another is free.
    """

    method: Literal["auto", "beam", "paper", "person"] = "auto"
    start: Path | None = None
    hold: Annotated[Positions, BODY] = field(default_factory=dict)
    unseen: Annotated[Links, BODY] = ()
    root: Annotated[str | None, Parameter(metavar="LINK"), BODY] = None
    root_position: Annotated[RootPosition | None, from_text(parse_root_position, "POINT"), BODY] = (
        None
    )
    root_rotation: Annotated[RootTurns | None, from_text(parse_root_rotation, "ROTATION"), BODY] = (
        None
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.method == "person" and self.search_settings:
            raise SettingsError(
                f"the method person does not search poses; leave {self.search_settings[0]} out"
            )

    @property
    def search_settings(self) -> tuple[str, ...]:
        """Names of the search's options that are not at their defaults."""
        own = set(EstimateSettings.__annotations__) - {"method"}
        return tuple(name for name in changed(self) if name in own)

    def as_json(self) -> dict[str, Any]:
        """Return the settings that affect the result as plain JSON values."""
        values, turns = super().as_json(), self.root_rotation
        if isinstance(turns, Mapping):
            values["root_rotation"] = [[axis, *limits] for axis, limits in turns.items()]
        return values


@documented
@dataclass(frozen=True, kw_only=True)
class MaskSettings:
    """Settings for making masks; without a background the source holds masks.

    Raises SettingsError: classes of annotations are given with a background.

    Args:
        background: Picture of the empty room, or folder with <camera>.png or <camera>/<frame>.png;
            median: each pixel's median over the pictures, in which the body must move. Default:
            SOURCE/background, if it exists.
        classes: Class of the object in a COCO file, by name or number; repeat for several; all:
            every class. Default: the only class.
        largest: Keep only the largest connected region of each mask.
        cameras: Camera file for the scene. Default: SOURCE/cameras.yaml, if it exists.
        episode: Number of the episode in a LeRobot data set. Default: the only one.
    """

    background: Annotated[str | Path | None, Parameter(metavar="PICTURE")] = None
    classes: Annotated[Names, Parameter("--class")] = ()
    largest: bool = False
    cameras: Path | None = None
    episode: Annotated[int | None, Parameter(metavar="N")] = None

    def __post_init__(self) -> None:
        check_choices(self)
        if self.classes and self.background is not None:
            raise SettingsError(for_caller("--class needs a COCO file and excludes --background"))

    def as_json(self) -> Mapping[str, Any]:
        """Return the settings that are not at their defaults as plain JSON values."""
        return {name: plain(getattr(self, name)) for name in changed(self)}


def changed(settings: Any) -> tuple[str, ...]:
    """Return the names of the settings that are not at their defaults."""
    return tuple(
        one.name
        for one in fields(settings)
        if getattr(settings, one.name) != ({} if one.default is MISSING else one.default)
    )


def plain(value: Any) -> Any:
    """Return a setting as a plain JSON value: paths become strings, tuples lists."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    return [plain(one) for one in value] if isinstance(value, tuple | list) else value


ALL = "all"
"""Stands for the names of all joints, or of all links."""

Export = Literal["ros", "mujoco", "drake", "lerobot"]
"""Programs for which cameras are exported; LeRobot gets the joints, too."""


@documented
@dataclass(frozen=True, kw_only=True)
class AuditSettings(EpisodeSettings):
    """Settings of an audit.

    Args:
        hold: Hold this joint at a known position [deg or m]; repeat for several.
        without: Leave this link and all links that it carries out of drawings and comparisons, such
            as a gripper that is not the model's; repeat for several.
        pictures: Use the scene's pictures and joint log, even if it has masks.
    """

    hold: Annotated[Positions, BODY] = field(default_factory=dict)
    without: Annotated[Links, BODY] = ()
    pictures: Annotated[bool, EPISODE] = False


@documented
@dataclass(frozen=True, kw_only=True)
class RegistrationSettings(AuditSettings):
    """Settings of a registration.

    Args:
        cameras: Register this camera, and ignore its X_WC if it has one; repeat for several.
            Default: all cameras of an episode; of a scene of masks those without X_WC.
        on: The cameras are mounted on this link (eye in hand). Their pose X_LC in the link's frame
            is estimated from an episode's pictures of things that stand still, from masks of the
            robot's static base, or from masks or pictures of a --target.
        target: With --on: model file of a rigid calibration target anywhere in the world, which the
            masks or pictures show; its pose is estimated, too.
        zeros: Estimate the offset of this joint, too: a constant to be added to its positions in
            all frames [deg or m]. "all": of every joint; repeat for several. For a URDF model, a
            URDF with the significant offsets is written.
        lengths: Estimate the scale of this link, too: a factor of the distances from its own joint
            to the joints that it carries. "all": of every link; repeat for several. URDF models
            only: a URDF with the significant scales is written.
        focal: Estimate the cameras' focal lengths, too.
        exports: Export the cameras for this program, too; repeat for several. ros: camera_info and
            static transforms; mujoco: <camera> elements; drake: CameraConfigs; lerobot, for a
            LeRobot data set: joint map, motors' calibration corrected by --zeros, and a copy of
            meta with the cameras.
    """

    cameras: Annotated[Names, Parameter("--camera"), SELECTION] = ()
    on: Annotated[str | None, Parameter(metavar="LINK")] = None
    target: Path | None = None
    zeros: Names = ()
    lengths: Links = ()
    focal: bool = False
    exports: Annotated[tuple[Export, ...], Parameter("--export")] = ()
