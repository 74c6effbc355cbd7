import json
from pathlib import Path

import numpy as np
import pytest

from drake_pose.errors import OutputError
from drake_pose.results.folder import PoseRow, ResultFolder, read_summary

NAMES = ("a", "b")


def row(frame: str, *q: float, base: np.ndarray | None = None, error: float = 0.25) -> PoseRow:
    return PoseRow(frame, np.array(q), base, error, 1.5)


def lost(frame: str) -> PoseRow:
    return row(frame, np.nan, np.nan, error=np.nan)


def test_a_row_is_on_the_disk_when_add_returns(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=False)
    folder.open()
    folder.add(row("0001", 0.5, -1.25))
    folder.add(lost("0002"))
    text = (tmp_path / "out" / "poses.csv").read_text()
    assert text == "frame,a,b,error,seconds\n0001,0.5,-1.25,0.25,1.5000\n0002,,,,1.5000\n"


def test_base_columns(tmp_path: Path) -> None:
    base = np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0])
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=True)
    folder.open()
    folder.add(row("1", 0.5, 0.5, base=base))
    folder.add(lost("2"))
    folder.close()
    again = ResultFolder(tmp_path / "out", NAMES, with_base=True, resume=True)
    assert again.rows[0].base is not None
    assert again.rows[0].base.tolist() == base.tolist()
    assert again.rows[1].base is None
    assert not again.rows[1].found


def test_resuming_drops_a_row_that_was_cut_off(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=False)
    folder.open()
    folder.add(row("0001", 0.5, -1.25))
    folder.close()
    with (tmp_path / "out" / "poses.csv").open("a") as file:
        file.write("0002,0.5,")
    again = ResultFolder(tmp_path / "out", NAMES, with_base=False, resume=True)
    again.open()
    again.add(row("0002", 1.0, 2.0))
    again.close()
    lines = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["frame", "0001", "0002"]
    assert lines[2] == "0002,1,2,0.25,1.5000"


def test_rows_can_be_put_in_order(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=False)
    folder.open()
    folder.add(row("3", 0.0, 0.0))
    folder.add(row("1", 1.0, 1.0))
    folder.sort(["1", "2", "3"])
    lines = (tmp_path / "out" / "poses.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines] == ["frame", "1", "3"]


def test_a_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"not empty.*--resume"):
        ResultFolder(tmp_path, NAMES, with_base=False)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_file_in_the_folders_place_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    for place in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(OutputError, match="out: is a file"):
            ResultFolder(place, NAMES, with_base=False)


def test_a_name_that_no_folder_can_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="aaa: cannot be written: File name too long"):
        ResultFolder(tmp_path / ("a" * 300), NAMES, with_base=False)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,a,c,error,seconds\n", "another model"),
        ("frame,a,b,error,seconds\n1,2\n", "damaged"),
        ("frame,a,b,error,seconds\n1,x,2,3,4\n", "damaged"),
    ],
)
def test_what_cannot_be_resumed_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(OutputError, match=message):
        ResultFolder(tmp_path, NAMES, with_base=False, resume=True)


def test_files_appear_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=False)
    folder.write("overlay/cam/1.png", b"first")

    def full_disk(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full_disk)
    with pytest.raises(OutputError, match=r"1\.png.*No space left"):
        folder.write("overlay/cam/1.png", b"second")
    assert (tmp_path / "out" / "overlay" / "cam" / "1.png").read_bytes() == b"first"


def test_summary_has_no_nan(tmp_path: Path) -> None:
    folder = ResultFolder(tmp_path / "out", NAMES, with_base=False)
    folder.write_summary({"a": float("nan"), "b": [np.float64(1.5), np.inf], "c": np.arange(2)})
    text = (tmp_path / "out" / "summary.json").read_text()
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": [0, 1]}
    assert read_summary(tmp_path / "out") == json.loads(text)


@pytest.mark.parametrize("text", [None, "{", "[]"])
def test_a_damaged_summary_is_named(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "summary.json").write_text(text)
    with pytest.raises(OutputError, match=r"summary\.json"):
        read_summary(tmp_path)
