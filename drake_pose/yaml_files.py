"""Reading small YAML files that others wrote."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from drake_pose.errors import DrakePoseError
from drake_pose.regular_files import read_regular

_LARGEST_FILE = 1 << 20


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


def read_yaml(path: Path, error_type: type[DrakePoseError], *, tags: bool = False) -> Any:
    """Returns a YAML file's content, plain values only.

    The file's size is limited. An alias stays a reference, so a small file cannot fill the memory
    unless its reader walks through every copy.

    Args:
        path: the file.
        error_type: raised, with the file's name, when it cannot be read or is no small YAML file.
        tags: keep local tags of mappings, as Drake's files have them, under the key ``_tag``.
    """
    try:
        data = read_regular(path, _LARGEST_FILE + 1)
    except OSError as error:
        raise error_type(f"{path}: cannot read it: {error.strerror}") from error
    if len(data) > _LARGEST_FILE:
        raise error_type(f"{path}: larger than {_LARGEST_FILE} bytes, which is not expected here")
    try:
        # The loader derives from yaml.SafeLoader.
        return yaml.load(data, Loader=_TaggedLoader if tags else _UniqueKeyLoader)
    except (yaml.YAMLError, ValueError, TypeError) as error:
        raise error_type(f"{path}: not a YAML file: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise error_type(f"{path}: nested too deeply") from None
