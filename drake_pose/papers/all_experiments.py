"""All experiments of the three papers, one after another, and one page about them."""

from __future__ import annotations

import base64
import html
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType
from rich.text import Text

from drake_pose.errors import OutputError
from drake_pose.filtering.kalman.truncated_filter import FilterSettings
from drake_pose.papers import paper_figures
from drake_pose.papers.date.experiment import run_experiment as run_date
from drake_pose.papers.date.pictures import save_pictures as save_date
from drake_pose.papers.kameda.continuous import (
    continuous_search,
    continuous_table,
    run_continuous_experiment,
)
from drake_pose.papers.kameda.experiment import (
    beam_experiment_search,
    experiment_search,
)
from drake_pose.papers.kameda.experiment import run_experiment as run_kameda
from drake_pose.papers.kameda.pictures import save_pictures as save_kameda
from drake_pose.papers.kameda.real_pictures import (
    METHODS,
    picture_names,
    real_table,
    run_real_experiment,
)
from drake_pose.papers.kameda.table import experiment_table
from drake_pose.papers.paper_figures import Beside
from drake_pose.papers.shimada.experiment import run_experiment as run_shimada
from drake_pose.papers.shimada.hypotheses import run_hypotheses_experiment
from drake_pose.papers.shimada.pictures import save_hypotheses
from drake_pose.papers.shimada.pictures import save_pictures as save_shimada
from drake_pose.papers.shimada.static_view import run_static_experiment
from drake_pose.results.folder import without_nan
from drake_pose.search.scoring import PoseSearch
from drake_pose.version import VERSION

REPORT, FIGURES, TABLES, BESIDE = "report.html", "figures.json", "tables.txt", "paper.json"
_SETTINGS = "settings.json"
_OUTSIDE_WEIGHT = 10.0
_COLUMNS = 110
# The paper's filter and ours, by the names of their figures.
_FILTERS = (("paper", "sequential", 1), ("ours", "joint", FilterSettings().iterations))

Advance = Callable[[int], None]
Count = Callable[[str, int], "Advance"]


@dataclass(frozen=True)
class Outcome:
    """What an experiment came to.

    Args:
        figures: as its command prints them with --json.
        shown: its tables.
        beside: the paper's figures beside ours; empty where the paper has no such experiment.
    """

    figures: Mapping[str, Any]
    shown: Sequence[RenderableType]
    beside: Sequence[Beside] = ()


@dataclass(frozen=True)
class Experiment:
    """One of all.

    Args:
        name: of its folder.
        title: what the page calls it.
        command: what runs it alone.
        run: makes it, given whether it is short, its folder for pictures, and what counts.
    """

    name: str
    title: str
    command: str
    run: Callable[[bool, Path, Count], Outcome]


def _kameda(short: bool, folder: Path, count: Count) -> Outcome:
    images = 3 if short else 219
    searches: dict[str, PoseSearch] = {
        "paper": experiment_search(),
        "outside_weight": experiment_search(outside_weight=_OUTSIDE_WEIGHT),
        "beam": beam_experiment_search(),
    }
    results = {
        name: run_kameda(search, images, 0, count(f"Kameda A, {name}", images))
        for name, search in searches.items()
    }
    for name, result in results.items():
        save_kameda(result, folder / name)
    figures = {name: result.as_json() for name, result in results.items()}
    shown: list[RenderableType] = [experiment_table([[result] for result in results.values()])]
    return Outcome(figures, shown, paper_figures.kameda_a(figures))


def _kameda_continuous(short: bool, folder: Path, count: Count) -> Outcome:
    images = 1 if short else 30
    result = run_continuous_experiment(
        continuous_search(), images, 77, progress=count("Kameda A, continuous", images)
    )
    return Outcome(result.as_json(), [continuous_table({"one view": result})])


def _kameda_pictures(experiment: str, short: bool, folder: Path, count: Count) -> Outcome:
    frames = picture_names(experiment)[: 1 if short else None]
    results = [
        run_real_experiment(
            experiment,
            method,
            frames,
            folder / method,
            count(f"Kameda {experiment}, {name}", len(frames)),
        )
        for method, name in METHODS.items()
    ]
    figures: dict[str, Any] = {result.method: result.as_json() for result in results}
    warnings = [
        Text(f"Warning: {METHODS[result.method]}: {text}")
        for result in results
        for text in result.warnings
    ]
    shown: list[RenderableType] = [real_table(results), *warnings]
    return Outcome(figures, shown, paper_figures.kameda_pictures(figures))


def _shimada(short: bool, folder: Path, count: Count) -> Outcome:
    runs = 1 if short else 50
    figures, shown = {}, []
    for name, truncation, iterations in _FILTERS:
        advance = count(f"Shimada, {name}", 2 * runs)
        result = run_shimada(runs, 0, truncation, "lines", advance, iterations)
        save_shimada(result, folder / name)
        figures[name] = result.as_json()
        shown.append(result.table())
    return Outcome(figures, shown, paper_figures.shimada(figures))


def _shimada_hypotheses(short: bool, folder: Path, count: Count) -> Outcome:
    runs = 2 if short else 50
    figures, shown = {}, []
    for name, truncation, iterations in _FILTERS:
        advance = count(f"Shimada's figure 9, {name}", runs)
        result = run_hypotheses_experiment(runs, 0, truncation, "lines", advance, iterations)
        save_hypotheses(result, folder / name)
        figures[name] = result.as_json()
        shown.append(result.table())
    return Outcome(figures, shown, paper_figures.shimada_hypotheses(figures))


def _shimada_static(short: bool, folder: Path, count: Count) -> Outcome:
    runs, frames = (1, 20) if short else (4, 1000)
    figures: dict[str, Any] = {}
    shown: list[RenderableType] = []
    for name, truncation, iterations in _FILTERS:
        result = run_static_experiment(
            runs,
            truncation=truncation,
            marks=(frames // 2, frames),
            progress=count(f"Shimada, one view, {name}", runs),
            iterations=iterations,
        )
        figures[name] = result.as_json()
        shown += [Text(f"{name}:"), result.table()]
    return Outcome(figures, shown, paper_figures.shimada_static(figures))


def _date(short: bool, folder: Path, count: Count) -> Outcome:
    cameras, frames, size = (4, 40, (320, 240)) if short else (9, 240, (640, 480))
    result = run_date(cameras, frames, 0, "silhouette", count("Date", frames), size)
    save_date(result, folder)
    shown: list[RenderableType] = [result.table(), result.found_table(), result.costs()]
    return Outcome(result.as_json(), shown, paper_figures.date(result.as_json()))


EXPERIMENTS = (
    Experiment(
        "kameda",
        "Kameda, Minoh, Ikeda: pose from one silhouette, experiment A",
        "drake-pose reproduce kameda --method beam --outside-weight 10",
        _kameda,
    ),
    Experiment(
        "kameda_b",
        "Kameda, Minoh, Ikeda, experiment B: a person in real pictures",
        "drake-pose reproduce kameda --experiment B",
        partial(_kameda_pictures, "B"),
    ),
    Experiment(
        "kameda_c",
        "Kameda, Minoh, Ikeda, experiment C: a hand in real pictures",
        "drake-pose reproduce kameda --experiment C",
        partial(_kameda_pictures, "C"),
    ),
    Experiment(
        "kameda_continuous",
        "The same with angles between the samples (not in the paper)",
        "drake-pose reproduce kameda --angles continuous --images 30 --seed 77",
        _kameda_continuous,
    ),
    Experiment(
        "shimada",
        "Shimada, Shirai, Kuno, Miura: angles and lengths of a hand; the paper's filter, then ours",
        "drake-pose reproduce shimada --iterations 1 --truncation sequential",
        _shimada,
    ),
    Experiment(
        "shimada_hypotheses",
        "Several hypotheses, and which inequality rejects the wrong ones: its figure 9",
        "drake-pose reproduce shimada --hypotheses",
        _shimada_hypotheses,
    ),
    Experiment(
        "shimada_static",
        "One unchanging view, the limitation that its authors state",
        "drake-pose reproduce shimada --runs 4 --static 1000",
        _shimada_static,
    ),
    Experiment(
        "date",
        "Date, Yoshimatsu, Arita, Taniguchi: a person before many cameras",
        "drake-pose reproduce date",
        _date,
    ),
)


def reproduce_all(out: Path, short: bool, count: Count, say: Callable[[str], None]) -> Path:
    """Runs all experiments that are not finished yet, and writes the page after each.

    An experiment's folder gets its name when it is finished, so that nothing half done looks whole.

    Args:
        out: the folder.
        short: a few images, runs and frames of each, to see that all of it works.
        count: called with what is counted and up to where; its value with how many are done.
        say: called with what happens.

    Returns:
        The page.

    Raises:
        OutputError: the folder cannot be written, or holds a run with other settings.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        _check_settings(out / _SETTINGS, {"short": short, "version": VERSION})
        for number, experiment in enumerate(EXPERIMENTS, start=1):
            folder = out / experiment.name
            if folder.is_dir():
                say(f"{number} of {len(EXPERIMENTS)}, {experiment.name}: is there")
                continue
            say(f"{number} of {len(EXPERIMENTS)}, {experiment.name}")
            part = out / f"{experiment.name}.part"
            shutil.rmtree(part, ignore_errors=True)
            part.mkdir()
            begin = time.process_time()
            outcome = experiment.run(short, part, count)
            _write_outcome(part, outcome, time.process_time() - begin)
            os.replace(part, folder)
            _write(out / REPORT, _page(out, short))
        return _write(out / REPORT, _page(out, short))
    except OSError as error:
        raise OutputError(f"{out}: cannot write the experiments: {error.strerror}") from error


def _check_settings(path: Path, settings: Mapping[str, Any]) -> None:
    """Refuses to go on with experiments that were made otherwise."""
    text = json.dumps(settings, indent=2)
    if path.is_file() and path.read_text() != text:
        raise OutputError(
            f"{path.parent}: holds experiments made with other settings ({path.name}); name "
            "another folder with --out"
        )
    _write(path, text)


def _write_outcome(folder: Path, outcome: Outcome, cpu_seconds: float) -> None:
    beside = {
        "figures": [one._asdict() for one in outcome.beside],
        "cpu_seconds": round(cpu_seconds, 1),
    }
    (folder / BESIDE).write_text(json.dumps(beside, indent=2))
    (folder / FIGURES).write_text(
        json.dumps(without_nan(outcome.figures), indent=2, allow_nan=False)
    )
    console = Console(file=io.StringIO(), record=True, width=_COLUMNS)
    for one in outcome.shown:
        console.print(one)
    (folder / TABLES).write_text(console.export_text())


def _write(path: Path, text: str) -> Path:
    """Writes a file beside its place and moves it there."""
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(text)
    os.replace(beside, path)
    return path


def _page(out: Path, short: bool) -> str:
    """The page about the experiments that are finished."""
    finished = [one for one in EXPERIMENTS if (out / one.name).is_dir()]
    left = [one.name for one in EXPERIMENTS if one not in finished]
    notes = ""
    if short:
        notes += "<p><strong>Short: too few images and runs for any conclusion.</strong></p>"
    if left:
        notes += f"<p><strong>Not finished: {html.escape(', '.join(left))}.</strong></p>"
    notes += _overview(out, finished)
    sections = "".join(_section(out / one.name, one) for one in finished)
    return (
        "<!DOCTYPE html><html lang='en'><head><meta charset='utf-8'>"
        "<title>The papers' experiments</title><style>body{font-family:sans-serif;margin:2em}"
        "pre{line-height:1.15}td,th{padding:.1em .8em;text-align:left}"
        "img{max-width:48em;margin:.5em;vertical-align:top}</style></head>"
        f"<body><h1>The papers' experiments</h1>{notes}{sections}</body></html>\n"
    )


def _overview(out: Path, finished: Sequence[Experiment]) -> str:
    """The papers' figures beside ours, of all experiments, and what they cost."""
    rows, seconds = "", 0.0
    for one in finished:
        beside = json.loads((out / one.name / BESIDE).read_text())
        seconds += beside["cpu_seconds"]
        if beside["figures"]:
            rows += f"<tr><th colspan='4'>{html.escape(one.title)}</th></tr>"
        for row in beside["figures"]:
            rows += (
                "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row.values()) + "</tr>"
            )
    return (
        f"<p>Processor time: {seconds / 60:.1f} minutes.</p><table><tr><th>figure</th>"
        "<th>the paper</th><th>its method here</th><th>ours</th></tr>"
        f"{rows}</table>"
    )


def _section(folder: Path, experiment: Experiment) -> str:
    pictures = "".join(
        f"<figure><img alt='{html.escape(path.stem)}' src='data:image/png;base64,"
        f"{base64.b64encode(path.read_bytes()).decode()}'>"
        f"<figcaption>{html.escape(str(path.relative_to(folder)))}</figcaption></figure>"
        for path in sorted(folder.rglob("*.png"))
    )
    tables = html.escape((folder / TABLES).read_text())
    return (
        f"<h2>{html.escape(experiment.title)}</h2><p><code>{html.escape(experiment.command)}"
        f"</code></p><pre>{tables}</pre>{pictures}"
    )
