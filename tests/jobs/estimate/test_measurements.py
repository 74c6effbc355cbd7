from pathlib import Path

import pytest

from drake_pose.errors import SceneError, UnknownNameError
from drake_pose.input_files import read_csv
from drake_pose.jobs.estimate.measurements import read_joint_centres, read_measured_positions

CENTRES = "frame,joint,x,y,z\n0,ankle,1,2,3\n0,knee,4,5,6\n7,ankle,-1,-2,-3\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def test_joint_centres_compare_frames_as_numbers(tmp_path: Path) -> None:
    path = written(tmp_path / "centres.csv", CENTRES)
    positions = read_joint_centres(path, "ankle", ["0000", "0007"])
    assert positions["0000"].tolist() == [1, 2, 3]
    assert positions["0007"].tolist() == [-1, -2, -3]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("a,b\n", "first line"),
        ("frame,joint,x,y,z\n0,ankle,1,2\n", "line 2 has 4 columns"),
        ("frame,joint,x,y,z\n0,ankle,1,2,here\n", "line 2"),
        ("frame,joint,x,y,z\n0,ankle,1,2,nan\n", "not finite"),
        ("frame,joint,x,y,z\n1,ankle,1,2,3\n", "'ankle'.*'0000'"),
        ("frame,joint,x,y,z\n0.5,ankle,1,2,3\n", "'ankle'.*'0000'"),
        ("frame,joint,x,y,z\n0,ankle,1,2,3\n00,ankle,1,2,3\n", "line 3: frame '00' .* twice"),
    ],
)
def test_damaged_joint_centres(tmp_path: Path, text: str, message: str) -> None:
    path = written(tmp_path / "centres.csv", text)
    with pytest.raises(SceneError, match=rf"centres\.csv.*{message}"):
        read_joint_centres(path, "ankle", ["0000"])


def test_missing_joint_centres_are_named(tmp_path: Path) -> None:
    path = written(tmp_path / "centres.csv", CENTRES)
    with pytest.raises(SceneError, match=r"centres\.csv.*'ankle'.*'still'"):
        read_joint_centres(path, "ankle", ["0000", "still"])
    with pytest.raises(UnknownNameError, match="ankle, knee"):
        read_joint_centres(path, "elbow", ["0000"])
    with pytest.raises(SceneError, match=r"nowhere\.csv"):
        read_joint_centres(tmp_path / "nowhere.csv", "ankle", ["0000"])


def test_measured_positions_are_read_by_frame(tmp_path: Path) -> None:
    path = written(tmp_path / "angles.csv", "frame,b,a\n3,0.5,-1\n")
    truth = read_measured_positions(path, ["a", "b", "c"])
    assert truth.names == ("b", "a")
    values = truth.of("0003")
    assert values is not None
    assert values.tolist() == [0.5, -1.0]
    assert truth.of("0004") is None
    assert truth.of("still") is None
    # Too long for a number: compared as a name.
    assert (
        read_measured_positions(written(path, f"frame,b\n{'9' * 5000},0\n"), ["b"]).of("9") is None
    )
    path = written(tmp_path / "angles.csv", "frame,b,d\n3,0.5,-1\n")
    with pytest.raises(UnknownNameError, match=r"angles.csv.*'d'.*a, b, c"):
        read_measured_positions(path, ["a", "b", "c"])


@pytest.mark.parametrize(("sign", "name"), [(";", "semicolons"), ("\t", "tabs")])
def test_tables_with_other_separators_are_refused_by_name(
    tmp_path: Path, sign: str, name: str
) -> None:
    file = tmp_path / "joint_angles.csv"
    file.write_text(f"frame{sign}A1\n0000{sign}0,5\n")
    with pytest.raises(SceneError, match=f"{name}; save the table with commas"):
        read_csv(file, SceneError)
