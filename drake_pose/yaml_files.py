"""Read small YAML files written by users or other programs."""

from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydrake.common.yaml import yaml_load_typed

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular

_Schema = TypeVar("_Schema")


class _UniqueKeyLoader(yaml.SafeLoader):
    """Safe loader that refuses NUL characters and duplicate keys (PyYAML keeps the last one)."""

    def construct_scalar(self, node: yaml.ScalarNode) -> Any:
        value = super().construct_scalar(node)
        if "\0" in str(value):
            raise yaml.constructor.ConstructorError(
                None, None, "a text contains NUL", node.start_mark
            )
        return value

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        mapping = super().construct_mapping(node, deep=deep)
        if len(mapping) != len(node.value):
            raise yaml.constructor.ConstructorError(
                None, None, "a key is given twice (or merged with <<)", node.start_mark
            )
        return mapping


class _TaggedLoader(_UniqueKeyLoader):
    """Loader that stores the tag of a mapping under ``_tag``, as pydrake.common.yaml does."""


def _construct_tagged(loader: _TaggedLoader, suffix: str, node: yaml.Node) -> Any:
    """Return a node with a tag ``!suffix``, the key ``_tag`` of a mapping; others lose it."""
    if isinstance(node, yaml.MappingNode):
        return {"_tag": f"!{suffix}", **loader.construct_mapping(node, deep=True)}
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    return loader.construct_scalar(node)


_TaggedLoader.add_multi_constructor("!", _construct_tagged)


def read_yaml(
    path: Path, error_type: type[DrakePoseError], *, tags: bool = False, largest: int = 1 << 20
) -> Any:
    """Return the content of a YAML file as plain values.

    The file's size is limited. Aliases stay references, so a small file cannot exhaust the memory
    unless the caller walks through every copy.

    Args:
        error_type: class of the exceptions.
        tags: store local tags of mappings, as Drake's files have them, under the key ``_tag``;
            else such a file is refused.
        largest: maximum size of the file [byte].

    Raises error_type: the file is unreadable, too large or invalid. The message names the file.
    """
    try:
        data = read_regular(path, largest + 1)
    except OSError as error:
        raise error_type(f"{path}: cannot read it: {error.strerror}") from error
    if len(data) > largest:
        raise error_type(f"{path}: larger than the maximum of {largest} bytes")
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
    """Return an entry of a YAML file as an instance of a dataclass, by ``yaml_load_typed``.

    Args:
        entry: plain values as from ``read_yaml``, with the dataclass's fields as keys.
        schema: the dataclass.
        where: start of the error message.
        error_type: class of the exception.

    Raises error_type: a field is unknown or has the wrong type.
    """
    try:
        return yaml_load_typed(schema=schema, data=yaml.safe_dump(entry))
    # Drake's reader raises any of these for values of the wrong type.
    except (RuntimeError, ValueError, TypeError, AttributeError, AssertionError) as error:
        names = ", ".join(one.name for one in fields(schema))  # type: ignore[arg-type]
        raise error_type(f"{where}: expected a mapping of {names}: {error}") from error
