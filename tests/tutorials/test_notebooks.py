import re
from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat import NotebookNode

TUTORIALS = Path(__file__).resolve().parents[2] / "tutorials"
NOTEBOOKS = sorted(TUTORIALS.glob("*.ipynb"))

each_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)


def read(path: Path) -> NotebookNode:
    return nbformat.read(path, as_version=nbformat.NO_CONVERT)


def code_cells(notebook: NotebookNode) -> list[NotebookNode]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_notebooks_are_numbered_and_the_overview_names_each() -> None:
    numbers = [int(path.stem[:2]) for path in NOTEBOOKS]
    assert numbers == list(range(1, len(NOTEBOOKS) + 1))
    overview = (TUTORIALS / "README.md").read_text(encoding="utf-8")
    names = re.findall(r"\(([^)]*\.ipynb)\)", overview)
    assert names == [path.name for path in NOTEBOOKS] != []


@each_notebook
def test_format(path: Path) -> None:
    notebook = read(path)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.cells[0].cell_type == "markdown"
    assert notebook.cells[0].source.startswith("# ")
    # Identifiers that a person chose stay the same when a notebook is saved again.
    assert all(re.fullmatch(r"[a-z]+(-[a-z0-9]+)*", cell.id) for cell in notebook.cells)
    for cell in code_cells(notebook):
        assert (cell.outputs, cell.execution_count) == ([], None), f"clear cell '{cell.id}'"


@each_notebook
def test_source_is_fit_to_be_shared(path: Path) -> None:
    notebook = read(path)
    text = "\n".join(cell.source for cell in notebook.cells)
    assert "pydrake.all" not in text
    assert not re.search(r"(?<![\w.)/:])/(home|root|tmp|usr|work|Users|opt|var)/", text)
    first_code = code_cells(notebook)[0].source
    assert first_code.index('os.environ["LP_NUM_THREADS"] = "0"') < first_code.index("drake_pose")
    # By default Drake's Meshcat listens on all network interfaces.
    assert text.count("Meshcat(") == text.count('Meshcat(MeshcatParams(host="localhost"))')


@pytest.mark.slow
@each_notebook
def test_runs_without_an_error(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    # The figures are made, but not shown.
    monkeypatch.delenv("MPLBACKEND", raising=False)
    client = NotebookClient(
        read(path),
        timeout=240,
        kernel_name="python3",
        resources={"metadata": {"path": str(path.parent)}},
    )
    client.execute()
