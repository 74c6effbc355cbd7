"""Third-party robot models, against pinocchio (URDF) and MuJoCo (MJCF)."""

import pytest

from tests.robots.comparing import Row, cases, check_verdict, model_files, rows

PACKAGES = ("example-robot-data", "dm-control")
TABLE = rows(*PACKAGES)


@pytest.mark.parametrize("row", cases(TABLE))
def test_model_matches_reference_or_is_refused_with_reason(row: Row) -> None:
    check_verdict(row)


@pytest.mark.parametrize("package", PACKAGES)
def test_table_lists_every_model_file(package: str) -> None:
    assert model_files(package) == sorted(row.file for row in rows(package))


def test_nine_of_ten_models_with_geometry_are_fit() -> None:
    with_geometry = [row for row in TABLE if row.geometry == "yes"]
    assert sum(row.verdict == "fit" for row in with_geometry) >= 0.9 * len(with_geometry)
