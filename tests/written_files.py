"""Compare files written by scripts as text and numbers; write masks."""

import re
from pathlib import Path

from drake_pose.arrays import Mask
from drake_pose.silhouette.pictures.masks import encode_mask

NUMBER = re.compile(r"[-+]?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?")
LAST_PLACES = 2.1


def assert_same_files(written: Path, committed: Path) -> None:
    """Assert that every written file is committed, with the same words and matching numbers.

    Integers (indices) must be equal; other numbers may differ by LAST_PLACES units of the last
    decimal place in the committed file.
    """
    names = sorted(path.relative_to(written) for path in written.rglob("*") if path.is_file())
    assert names
    for name in names:
        text, expected = ((folder / name).read_text("utf-8") for folder in (written, committed))
        assert NUMBER.sub("#", text) == NUMBER.sub("#", expected), name
        pairs = zip(NUMBER.findall(text), NUMBER.findall(expected), strict=True)
        differing = [
            (found, wanted)
            for found, wanted in pairs
            if found != wanted and abs(float(found) - float(wanted)) > _tolerance(wanted)
        ]
        assert not differing, f"{name}: {differing[:5]} (found, committed) and so on"


def _tolerance(number: str) -> float:
    """Return LAST_PLACES units of the last decimal place of a number's text; 0 for an integer."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return LAST_PLACES * 10.0 ** (int(exponent or 0) - decimals) if "." in mantissa else 0.0


def write_mask(path: Path, mask: Mask) -> None:
    path.write_bytes(encode_mask(mask))
