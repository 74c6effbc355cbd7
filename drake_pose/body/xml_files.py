"""XML files as the robots' own programs read them: more leniently than a strict reader."""

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from xml.parsers import expat

from drake_pose.errors import ModelError

_BYTE_ORDER_MARK = b"\xef\xbb\xbf"
_COMMENT = re.compile(rb"<!--.*?-->", re.DOTALL)
_DECLARED_ENCODING = re.compile(rb"<\?xml[^>]*?\bencoding\s*=\s*[\"']([\w.:-]+)")


def read_xml(path: Path) -> ElementTree.Element:
    """The outermost element of an XML file; comments are left out.

    As tinyxml, with which ROS, Drake and MuJoCo read: what stands before ``<?xml`` may be blank, a
    comment may hold ``--``, a prefix is part of the name whether it is declared or not, and text in
    UTF-8 that is none is taken for Latin-1. Nothing outside the file is read.

    Raises:
        ModelError: unreadable, or not well-formed; the message names the file and the line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    return parse_xml(data, str(path))


def parse_xml(data: bytes, where: str) -> ElementTree.Element:
    """As read_xml, for a file's content; ``where`` is its name in messages."""
    data = data.removeprefix(_BYTE_ORDER_MARK)
    blank_lines = data[: len(data) - len(data.lstrip())].count(b"\n")
    data = _COMMENT.sub(lambda comment: b"\n" * comment[0].count(b"\n"), data.lstrip())
    builder = ElementTree.TreeBuilder()
    try:
        # Without a separator, a prefix stays a part of the name.
        parser = expat.ParserCreate(_encoding(data))
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        # Zero: an error, where expat itself would pass over the entity without a word.
        parser.ExternalEntityRefHandler = lambda *_: 0
        parser.Parse(data, True)
    except expat.ExpatError as error:
        place = f"line {error.lineno + blank_lines}, column {error.offset}"
        raise ModelError(
            f"{where} is not well-formed XML: {expat.ErrorString(error.code)}: {place}"
        ) from error
    except (LookupError, ValueError) as error:
        raise ModelError(f"{where}: its text cannot be decoded: {error}") from error
    return builder.close()


def xml_text(root: ElementTree.Element) -> str:
    """The text of an element that parse_xml made."""
    return ElementTree.tostring(root, encoding="unicode")


def _encoding(data: bytes) -> str | None:
    """The encoding of a file's content; None: as it declares, or as its first bytes say."""
    declared = _DECLARED_ENCODING.match(data)
    if declared is not None and declared[1].lower() not in (b"utf-8", b"utf8"):
        return None
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return None
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "iso-8859-1"
    return "utf-8"
