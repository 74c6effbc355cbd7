"""Comparison of written files with committed ones."""

import pytest

from tests.written_files import assert_same_files


@pytest.fixture
def folders(tmp_path):
    for name in ("written", "committed"):
        (tmp_path / name / "meshes").mkdir(parents=True)
        (tmp_path / name / "meshes" / "a.obj").write_text("v 0.12345 -1.5e-3 2\nf 1//1 2//2 3//3\n")
    return tmp_path / "written", tmp_path / "committed"


def test_last_digits_may_differ(folders):
    (folders[0] / "meshes" / "a.obj").write_text("v 0.12346 -1.6e-3 2\nf 1//1 2//2 3//3\n")
    assert_same_files(*folders)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("0.12345", "0.12348"),
        ("-1.5e-3", "-1.8e-3"),
        ("f 1//1", "f 2//2"),
        ("v 0", "vn 0"),
        ("2\nf", "2 0.0\nf"),
    ],
)
def test_other_differences_are_found(folders, old, new):
    path = folders[0] / "meshes" / "a.obj"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(AssertionError):
        assert_same_files(*folders)
