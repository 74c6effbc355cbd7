"""MJCF models of other people's robots, against MuJoCo."""

import pytest

from .comparing import Row, cases, check_verdict, model_files, rows

TABLE = rows("dm-control")


@pytest.mark.parametrize("row", cases(TABLE))
def test_model_is_read_as_mujoco_reads_it_or_refused_with_the_reason(row: Row) -> None:
    check_verdict(row)


def test_table_names_every_model_file() -> None:
    assert model_files("dm-control") == sorted(row.file for row in TABLE)
