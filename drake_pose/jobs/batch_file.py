"""The job file of `drake-pose batch`: scenes to be estimated or audited, with their settings."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from cyclopts import Parameter

from drake_pose.errors import SettingsError
from drake_pose.files.records import describe_job, file_digest
from drake_pose.files.settings import EpisodeSettings, EstimateSettings, FromText, say_gone
from drake_pose.input_files import named_fields, read_yaml
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.registration.settings import AuditSettings


@dataclass(frozen=True)
class SceneJob:
    """One scene of a batch."""

    name: str  # Name of the scene and its result folder.
    scene: Path  # The scene's folder; of an audit also an episode, a folder or file.
    model: Path  # The model file.
    settings: EstimateSettings | AuditSettings  # Settings of the estimate or audit.
    # Measured joint positions to compare an estimate with; None: the scene's own, if any.
    truth: Path | None = None
    # overlay, replay: whether overlays and replay.html are written.
    overlay: bool = True
    replay: bool = True
    chunk: int = 100  # Number of frames in a chunk; recordings of a person and audits are not cut.
    # Table of joint positions to be audited; True: the episode's own joint log; None: the scene is
    # estimated.
    audit: Path | bool | None = None
    camera_file: Path | None = None  # Camera file of an audit; None: the scene's cameras.yaml.

    def describe(self) -> dict[str, Any]:
        """Return plain JSON values, equal only if a resumed job is unchanged."""
        truth = None if self.truth is None else str(self.truth)
        described = describe_job(self.scene, self.model, self.settings)
        described |= {"chunk": self.chunk, "truth": truth}
        if self.audit is not None:
            for name, file in (("audit", self.audit), ("camera_file", self.camera_file)):
                described[name] = file
                if isinstance(file, Path):
                    described[name] = {"file": str(file), "sha256": file_digest(file)}
        return described


def read_job(path: Path, chunk: int | None = None) -> tuple[SceneJob, ...]:
    """Return the scenes of a job file, in order. Its paths are relative to its folder.

    Args:
        path: YAML file with ``scenes`` (settings by name) and optionally ``defaults`` (settings of
            all scenes) and ``chunk``. A scene with ``episodes: "0:99"`` becomes one scene for each
            episode, NAME_000000 and so on.
        chunk: number of frames in a chunk; None: the file's, else 100.

    Raises SettingsError: the message names the file, scene and setting at fault.
    """
    known = ("chunk", "defaults", "scenes")
    content = named_fields(read_yaml(path, SettingsError), known, str(path), SettingsError)
    scenes = content.get("scenes")
    if not isinstance(scenes, dict) or not scenes:
        raise SettingsError(f"{path}: has no scenes; expected 'scenes:' with NAME: settings")
    length = content.get("chunk", SceneJob.chunk) if chunk is None else chunk
    if not isinstance(length, int) or isinstance(length, bool) or length < 1:
        raise SettingsError(f"{path}: chunk: must be a whole number, 1 or more, not {length!r:.60}")
    own = ("scene", "model", "truth", "overlay", "replay", "audit", "camera_file")
    # A batch can audit episodes, but not estimate them.
    of_estimates = [
        one.name
        for one in fields(EstimateSettings)
        if one.name not in EpisodeSettings.__annotations__
    ]
    of_audits = [one.name for one in fields(AuditSettings)]
    keys = tuple(dict.fromkeys((*own, *of_estimates, *of_audits, "episodes")))
    given = content.get("defaults") or {}
    defaults = _named_settings(given, keys, f"{path}: defaults")
    jobs = []
    for name, entry in scenes.items():
        where = f"{path}: scene '{str(name)[:60]}'"
        if not isinstance(name, str) or not name or name[0] == "." or {"/", "\\"} & set(name):
            raise SettingsError(
                f"{where}: its name becomes a folder's: a text without slashes that does not "
                "begin with a dot; put numbers in quotes"
            )
        values = {**defaults, **_named_settings(entry or {}, keys, where)}
        named = [(name, values)]
        if (numbers := values.pop("episodes", None)) is not None:
            first, _, last = str(numbers).partition(":")
            if not (first.isdecimal() and last.isdecimal() and int(first) <= int(last)):
                raise SettingsError(
                    f'{where}: episodes: a range like "0:99", with both ends, not {numbers!r:.60}'
                )
            numbered = range(int(first), int(last) + 1)
            named = [(f"{name}_{k:06d}", values | {"episode": k}) for k in numbered]
        for one, given in named:
            jobs.append(_scene_job(one, given, own, length, where, path.parent.absolute()))
    return tuple(jobs)


def _named_settings(value: Any, known: Collection[str], where: str) -> dict[str, Any]:
    """Return settings by name, as `named_fields`; the message names what replaces gone ones."""
    keys = value if isinstance(value, dict) else ()
    if gone := say_gone(f"--{key}".replace("_", "-") for key in keys):
        raise SettingsError(f"{where}: {gone}")
    return named_fields(value, known, where, SettingsError)


def _scene_job(
    name: str, values: Mapping[str, Any], own: tuple[str, ...], chunk: int, where: str, base: Path
) -> SceneJob:
    """Return the job of a scene from its entry, the defaults included.

    Args:
        name: name of the scene.
        values: the entry, whose keys are known; None means that the key is not given.
        own: keys that are fields of SceneJob.
        chunk: number of frames in a chunk.
        where: file and scene, for messages.
        base: folder of relative paths.

    Raises SettingsError: a key is missing or belongs to the other job, or a value cannot be used.
    """
    values = {key: value for key, value in values.items() if value is not None}
    is_audit = "audit" in values
    kind = AuditSettings if is_audit else EstimateSettings
    names = [one.name for one in fields(kind)]
    if not is_audit:
        names = [key for key in names if key not in EpisodeSettings.__annotations__]
    own = tuple(k for k in own if k not in (("truth",) if is_audit else ("audit", "camera_file")))
    if others := [key for key in values if key not in (*own, *names)]:
        raise SettingsError(
            f"{where}: an {'audit' if is_audit else 'estimate'} has no setting "
            f"{', '.join(others)}; it has: {', '.join((*own, *names))}"
        )
    if "scene" not in values:
        raise SettingsError(f"{where}: 'scene' is missing, the scene's folder")
    given, settings = (
        {
            key: _convert(values[key], hint, f"{where}: {key}", base)
            for key, hint in get_type_hints(known, include_extras=True).items()
            if key in keys and key in values
        }
        for known, keys in ((SceneJob, own), (kind, names))
    )
    try:
        checked = kind(**settings)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    return SceneJob(
        name=name, settings=checked, chunk=chunk, **{"model": bundled_person(), **given}
    )


def _convert(value: Any, hint: Any, where: str, base: Path) -> Any:
    """Return a YAML value converted to the type of a settings field.

    Args:
        value: the value as read.
        hint: the field's type hint, with its cyclopts parameters.
        where: file, scene and field, for messages.
        base: folder of relative paths.

    Raises SettingsError: the value cannot be converted.
    """
    reader = None
    while get_origin(hint) is Annotated:
        hint, *more = get_args(hint)
        found = [one.converter for one in more if isinstance(one, Parameter)]
        reader = next((one for one in found if isinstance(one, FromText)), reader)
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and reader is not None:
        # Parse the text as the option does; a list of numbers is joined to such a text.
        text = ",".join(map(str, value)) if isinstance(value, list) else value
        if not isinstance(text, str):
            raise SettingsError(f"{where}: must be a text, not {value!r:.60}")
        try:
            parsed = reader.parse(text)
        except SettingsError as error:
            raise SettingsError(f"{where}: {error}") from None
        if isinstance(parsed, tuple) and isinstance(parsed[0], Path):
            return (base / parsed[0], *parsed[1:])
        return parsed
    if origin in (Union, UnionType):
        if value is True and bool in arguments:
            return value
        return _convert(value, next(one for one in arguments if one is not type(None)), where, base)
    if origin is tuple:
        texts = value if isinstance(value, list) else [value]
        return tuple(_convert(one, arguments[0], where, base) for one in texts)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        if not isinstance(value, dict):
            raise SettingsError(f"{where}: expected NAME: VALUE lines")
        return {
            str(name): _convert(one, arguments[1], f"{where}: {name}", base)
            for name, one in value.items()
        }
    kinds: dict[Any, tuple[Any, str]] = {
        bool: (bool, "true or false"),
        int: (int, "a whole number"),
        float: ((int, float), "a number"),
    }
    kind, expected = kinds.get(hint, (str, "a text (put numbers in quotes)"))
    if not isinstance(value, kind) or (isinstance(value, bool) and hint is not bool):
        raise SettingsError(f"{where}: must be {expected}, not {value!r:.60}")
    if hint is Path:
        return base / value
    return float(value) if hint is float else value
