"""The commands of the papers' experiments: which experiment runs, and what is printed."""

import sys
from types import SimpleNamespace

import pytest

import drake_pose.papers
from tests.cli import run_json, run_to_end

RESULT = SimpleNamespace(
    name="hand", figures={"f": 1}, warning=lambda: "beware", as_json=lambda: {"f": 1},
    table=lambda: "table", tables=lambda: ["table"], costs=lambda: "costs",
)  # fmt: skip
REAL = {"beam": {"f": 1, "warnings": []}, "paper": {"warnings": ["blurred"]}}
ANSWERS = {
    "run_real_experiment": REAL, "experiment_tree": "tree", "experiment_search": "S",
    "beam_experiment_search": "B", "grid_figures": {"f": 1}, "continuous_figures": {"f": 1},
    "run_walk_through": ({"f": 1}, "p"), "save_hypotheses": None,
    "PAPER": {"images": 219.0}, "METHODS": {"beam": "Beam", "paper": "Paper"}, "PICTURES": "drawn",
}  # fmt: skip


class Module:
    """A module of experiments, which records their calls without the count."""

    def __init__(self, calls):
        self.calls = calls

    def __getattr__(self, name):
        def call(*given, **more):
            given = [one for one in given if not callable(one) and one is not RESULT]
            self.calls.append(" ".join(map(str, [name, *given, *more.values()])))
            if name in ("experiment_settings", "MultiStartSearch"):
                return self.calls[-1]
            answer = ANSWERS.get(name, "table" if name.endswith("table") else RESULT)
            return dict(answer) if isinstance(answer, dict) else answer

        return ANSWERS[name] if name.isupper() else call


@pytest.fixture
def calls(monkeypatch):
    made = []
    for name in ("kameda", "shimada", "shimada_sequences", "date", "pictures", "tables"):
        monkeypatch.setitem(sys.modules, f"drake_pose.papers.{name}", Module(made))
        monkeypatch.setattr(drake_pose.papers, name, Module(made), raising=False)
    monkeypatch.setattr("drake_pose.search.MultiStartSearch", Module(made).MultiStartSearch)
    return made


EXPECTED = {
    "kameda --images 5 --seed 3": "S 5 3",
    "kameda --images 300 --method beam": "S 219 0, B 300 0",
    "kameda --angles continuous --views 2 --images 4": "MultiStartSearch tree True 4 0 2",
    "kameda --angles continuous": "MultiStartSearch tree True 219 0 1",
    "kameda --experiment B": "B 219 None",
    "shimada": "50 0 experiment_settings joint 20 lines",
    "shimada --pictures --truncation none --iterations 2": "10 0 experiment_settings none 2 drawn",
    "shimada --hypotheses --runs 3 --seed 4": "3 4 experiment_settings sequential 1",
    "shimada --sequence a": "a experiment_settings joint 20",
    "date": "9 240 0 silhouette",
    "date --cameras 5 --frames 40 --method paper": "5 40 0 paper",
    "date --walk --seed 2": "9 2",
}


@pytest.mark.parametrize("words", EXPECTED)
def test_options_choose_the_experiment(calls, tmp_path, words):
    command = ["reproduce", *words.split()]
    figures = run_json(*command)
    runs = [one.split(" ", 1)[1] for one in calls if one.startswith("run_")]
    assert ", ".join(runs) == EXPECTED[words]
    assert figures.get("f", 1) == 1
    assert ("paper_method" in figures) == ("beam" in words or "--experiment" in words)
    assert not [one for one in calls if one.startswith("save")]
    shown = run_to_end(*command)
    assert shown.stdout.split()[0] == "table"
    assert ("Paper: blurred" in shown.stderr) == ("--experiment" in words)
    assert ("beware" in shown.stderr) == ("--sequence" in words)
    done = run_to_end(*command, "--out", tmp_path / "out")
    *drawn, page = (one for one in calls if one.startswith("save"))
    assert page.startswith(f"save_page {tmp_path / 'out'}")
    assert len(drawn) == (0 if "continuous" in words or "--experiment" in words else 1)
    assert ("nothing to draw" in done.stderr) == ("hypotheses" in words)


def test_options_that_exclude_each_other(calls):
    for words in (
        "kameda --experiment B --seed 0", "kameda --experiment C --method beam",
        "kameda --experiment B --angles grid", "kameda --experiment B --views 1",
        "kameda --views 2", "kameda --angles continuous --method beam",
        "shimada --pictures --hypotheses", "shimada --sequence a --hypotheses",
        "shimada --sequence a --runs 2", "date --cameras 2",
    ):  # fmt: skip
        run_to_end("reproduce", *words.split(), status=2)
    assert calls == []
