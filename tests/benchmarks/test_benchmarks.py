"""What benchmarks render, damage and measure."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.benchmarks import figures, registration
from tests.benchmarks.tables import print_table


def test_pose_errors_are_recovered():
    true, turn = np.eye(4), Rotation.from_rotvec([0.01, -0.02, 0.03])
    true[:3, :3] = Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()
    found = true.copy()
    found[:3, :3] = turn.as_matrix().T @ true[:3, :3]
    found[:3, 3] -= [0.1, 0.2, 0.3]
    expected = [0.01, -0.02, 0.03, 0.1, 0.2, 0.3]
    np.testing.assert_allclose(registration.pose_error(found, true), expected, atol=1e-12)


def test_printed_tables_become_markdown(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    long = "long enough for two lines"
    for title in ("first", long):
        print_table(title, ("name", "value"), [("a", "1"), ("b [m]", "2.5 %")])
    rows = "| name | value |\n| --- | --- |\n| a | 1 |\n| b [m] | 2.5 % |"
    printed = capsys.readouterr().out
    assert long not in printed
    found = figures.to_markdown(f"of\nsomething\nelse\n{printed}")
    assert found.startswith("**first**")
    assert found.endswith(f"**{long}**\n\n{rows}")
    assert found.count(rows) == 2


def test_only_the_section_that_was_measured_changes():
    page = "".join(f"# {n}\n{a}\nold\n{b}\n" for n in "xy" for a, b in [figures.markers(n)])
    found = figures.replaced(page, "y", "new")
    assert found.startswith(page.split("# y")[0])
    assert "old" not in found.split("# y")[1]
    assert figures.replaced(found, "y", "new") == found
    with pytest.raises(ValueError, match="section 'z'"):
        figures.replaced(page, "z", "new")


def test_no_table_of_figures_is_typed_by_hand():
    texts = [page.read_text(encoding="utf-8") for page in figures.PAGES]
    for name in figures.SECTIONS:
        (k,) = (k for k, text in enumerate(texts) if figures.markers(name)[0] in text)
        texts[k] = figures.replaced(texts[k], name, "")
    assert not any("\n|" in text for text in texts)
