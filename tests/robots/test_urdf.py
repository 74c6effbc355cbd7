"""URDF and SDFormat models of other people's robots, against pinocchio."""

import pytest

from .comparing import Row, cases, check_verdict, model_files, rows

TABLE = rows("example-robot-data")


@pytest.mark.parametrize("row", cases(TABLE))
def test_model_is_read_as_pinocchio_reads_it_or_refused_with_the_reason(row: Row) -> None:
    check_verdict(row)


def test_table_names_every_model_file() -> None:
    assert model_files("example-robot-data") == sorted(row.file for row in TABLE)


def test_nine_of_ten_models_that_hold_geometry_are_fit() -> None:
    seen = [row for row in rows("example-robot-data", "dm-control") if row.geometry == "yes"]
    assert sum(row.verdict == "fit" for row in seen) >= 0.9 * len(seen)
