import json
from pathlib import Path

import numpy as np
import pytest

from drake_pose.errors import OutputError
from drake_pose.files.folder import read_summary, require_empty, write_file, write_summary
from drake_pose.files.records import PoseRow, PoseTable

NAMES = ("a", "b")


def row(frame: str, *q: float, base: np.ndarray | None = None, error: float = 0.25) -> PoseRow:
    return PoseRow(frame, np.array(q), base, error, 1.5)


LOST = row("0002", np.nan, np.nan, error=np.nan)


def test_rows_are_on_the_disk_when_append_returns_and_read_back(tmp_path: Path) -> None:
    base = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0])
    for with_base, cells in ((False, ""), (True, ",1,2,3,1,0,0,0")):
        table = PoseTable(tmp_path, NAMES, with_base)
        table.write([])
        table.append(row("0001", 0.5, -1.25, base=base))
        table.append(LOST)
        header, *lines = (tmp_path / "poses.csv").read_text().splitlines()
        assert header.split(",") == table.header
        assert lines == [
            f"0001,0.5,-1.25{cells},0.25,1.5000",
            f"0002,{',' * (2 + 7 * with_base)},1.5000",
        ]
        first, second = table.read()
        assert (first.base is not None and first.base.tolist() == base.tolist()) is with_base
        assert second.base is None
        assert (first.found, second.found) == (True, False)


def test_reading_drops_a_row_that_was_cut_off(tmp_path: Path) -> None:
    table = PoseTable(tmp_path, NAMES, False)
    assert table.read() == []
    table.write([row("0001", 0.5, -1.25)])
    with (tmp_path / "poses.csv").open("a") as file:
        file.write("0002,0.5,")
    assert [one.frame for one in table.read()] == ["0001"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,a,c,error,seconds\n", "another model"),
        ("frame,a,b,error,seconds\n1,2\n", "line 2 has 2 columns"),
        ("frame,a,b,error,seconds\n1,x,2,3,4\n", "line 2 is damaged"),
    ],
)
def test_what_cannot_be_resumed_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(OutputError, match=message):
        PoseTable(tmp_path, NAMES, False).read()


def test_a_folder_that_holds_something_or_cannot_be_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    for place, message in (
        (tmp_path, "not empty.*--resume"),
        (tmp_path / "out", "out: is a file"),
        (tmp_path / "out" / "deeper", "out: is a file"),
        (tmp_path / ("a" * 300), "aaa: cannot be written: File name too long"),
    ):
        with pytest.raises(OutputError, match=message):
            require_empty(place)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_files_appear_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_file(tmp_path / "out", "overlay/cam/1.png", b"first")

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OutputError, match=r"1\.png.*No space left"):
        write_file(tmp_path / "out", "overlay/cam/1.png", b"second")
    assert (tmp_path / "out" / "overlay" / "cam" / "1.png").read_bytes() == b"first"


def test_summary_has_no_nan(tmp_path: Path) -> None:
    write_summary(tmp_path, {"a": float("nan"), "b": [np.float64(1.5), np.inf], "c": np.arange(2)})
    text = (tmp_path / "summary.json").read_text()
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": [0, 1]}
    assert read_summary(tmp_path) == json.loads(text)


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_a_damaged_summary_is_named(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "summary.json").write_text(text)
    with pytest.raises(OutputError, match=r"summary\.json"):
        read_summary(tmp_path)
