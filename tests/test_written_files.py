"""Comparison of written files with committed ones."""

from contextlib import nullcontext

import pytest

from tests.written_files import assert_same_files

TEXT = "v 0.12345 -1.5e-3 2\nf 1//1 2//2 3//3\n"


@pytest.mark.parametrize(
    ("old", "new", "same"),
    [
        ("0.12345 -1.5e-3", "0.12346 -1.6e-3", True),
        ("0.12345", "0.12348", False),
        ("-1.5e-3", "-1.8e-3", False),
        ("f 1//1", "f 2//2", False),
        ("v 0", "vn 0", False),
        ("2\nf", "2 0.0\nf", False),
    ],
)
def test_only_last_digits_may_differ(tmp_path, old, new, same):
    folders = tmp_path / "written", tmp_path / "committed"
    for folder, text in zip(folders, (TEXT.replace(old, new), TEXT), strict=True):
        (folder / "meshes").mkdir(parents=True)
        (folder / "meshes" / "a.obj").write_text(text)
    with nullcontext() if same else pytest.raises(AssertionError):
        assert_same_files(*folders)
