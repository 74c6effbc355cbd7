"""Reading small YAML files that others wrote."""

from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydrake.common.yaml import yaml_load_typed

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular

_Schema = TypeVar("_Schema")


class _UniqueKeyLoader(yaml.SafeLoader):
    """A safe loader that refuses NUL, and a key given twice (PyYAML silently keeps the last)."""

    def construct_scalar(self, node: yaml.ScalarNode) -> Any:
        value = super().construct_scalar(node)
        if "\0" in str(value):
            raise yaml.constructor.ConstructorError(None, None, "a text has a NUL", node.start_mark)
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep=deep)
        if len(mapping) != len(node.value):
            raise yaml.constructor.ConstructorError(
                None, None, "a key is given twice (or merged with <<)", node.start_mark
            )
        return mapping


class _TaggedLoader(_UniqueKeyLoader):
    """Keeps the tag of a mapping in it as ``_tag``, as pydrake.common.yaml does."""


def _construct_tagged(loader: _TaggedLoader, suffix: str, node: yaml.Node) -> Any:
    """The value of a node that has a tag of its own, such as Drake's ``!Rpy``."""
    if isinstance(node, yaml.MappingNode):
        return {"_tag": f"!{suffix}", **loader.construct_mapping(node, deep=True)}
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_TaggedLoader.add_multi_constructor("!", _construct_tagged)


def read_yaml(
    path: Path, error_type: type[DrakePoseError], *, tags: bool = False, largest: int = 1 << 20
) -> Any:
    """Returns a YAML file's content, plain values only.

    The file's size is limited. An alias stays a reference, so a small file cannot fill the memory
    unless its reader walks through every copy.

    Args:
        path: the file.
        error_type: raised, with the file's name, when it cannot be read or is no small YAML file.
        tags: keep local tags of mappings, as Drake's files have them, under the key ``_tag``.
        largest: size of a file that is read [byte].
    """
    try:
        data = read_regular(path, largest + 1)
    except OSError as error:
        raise error_type(f"{path}: cannot read it: {error.strerror}") from error
    if len(data) > largest:
        raise error_type(f"{path}: larger than {largest} bytes, which is not expected here")
    try:
        # The loader derives from yaml.SafeLoader.
        return yaml.load(data, Loader=_TaggedLoader if tags else _UniqueKeyLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise error_type(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise error_type(f"{path}: nested too deeply") from None


def typed_entry(
    entry: Any, schema: type[_Schema], where: str, error_type: type[DrakePoseError]
) -> _Schema:
    """An entry of a YAML file as an instance of a dataclass, by Drake's ``yaml_load_typed``.

    Raises error_type, which begins with ``where``: a field is unknown or has another type.
    """
    try:
        return yaml_load_typed(schema=schema, data=yaml.safe_dump(entry))
    # What Drake's reader raises for values of other types.
    except (RuntimeError, ValueError, TypeError, AttributeError, AssertionError) as error:
        names = ", ".join(one.name for one in fields(schema))  # type: ignore[arg-type]
        raise error_type(f"{where}: expected a mapping of {names}: {error}") from error
