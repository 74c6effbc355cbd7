"""Files that scripts write, compared as text and numbers: the last digit depends on the machine."""

import re
from pathlib import Path

NUMBER = re.compile(r"[-+]?(?:\d+\.\d*|\.\d+|\d+)(?:[eE][-+]?\d+)?")
LAST_PLACES = 2.1


def assert_same_files(written: Path, committed: Path) -> None:
    """Every written file is committed too, with the same words, and numbers that agree.

    Whole numbers (indices) must be equal; others may differ by LAST_PLACES units of the last
    decimal place that is committed.
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
    """LAST_PLACES units of the last decimal place of a number as written; 0 for a whole one."""
    mantissa, _, exponent = number.lower().partition("e")
    decimals = len(mantissa.partition(".")[2])
    return LAST_PLACES * 10.0 ** (int(exponent or 0) - decimals) if "." in mantissa else 0.0
