"""Models of other people's robots, against pinocchio (URDF) and MuJoCo (MJCF)."""

import pytest

from tests.robots.comparing import Row, cases, check_verdict, model_files, rows

PACKAGES = ("example-robot-data", "dm-control")
TABLE = rows(*PACKAGES)


@pytest.mark.parametrize("row", cases(TABLE))
def test_model_is_read_as_other_libraries_read_it_or_refused_with_the_reason(row: Row) -> None:
    check_verdict(row)


@pytest.mark.parametrize("package", PACKAGES)
def test_table_names_every_model_file(package: str) -> None:
    assert model_files(package) == sorted(row.file for row in rows(package))


def test_nine_of_ten_models_that_hold_geometry_are_fit() -> None:
    seen = [row for row in TABLE if row.geometry == "yes"]
    assert sum(row.verdict == "fit" for row in seen) >= 0.9 * len(seen)
