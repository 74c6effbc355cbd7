"""All experiments of the three papers, one after another, and one page about them."""

from __future__ import annotations

import base64
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

from rich.console import Console, RenderableType

from drake_pose.errors import OutputError
from drake_pose.files.folder import without_nan
from drake_pose.files.report_page import page_template
from drake_pose.filtering.truncated_filter import FilterSettings
from drake_pose.papers.date import run_experiment as run_date
from drake_pose.papers.date_walk import run_walk_through
from drake_pose.papers.date_walk import save_pictures as save_date
from drake_pose.papers.kameda import (
    Renderer,
    beam_experiment_search,
    continuous_search,
    experiment_search,
)
from drake_pose.papers.kameda import run_experiment as run_kameda
from drake_pose.papers.kameda_figures import (
    PAPER,
    continuous_figures,
    continuous_table,
    grid_figures,
    grid_table,
)
from drake_pose.papers.kameda_pictures import save_pictures as save_kameda
from drake_pose.papers.kameda_real_pictures import real_table, run_real_experiment
from drake_pose.papers.shimada import PICTURES, result_table
from drake_pose.papers.shimada import run_experiment as run_shimada
from drake_pose.papers.shimada_hypotheses import run_hypotheses_experiment
from drake_pose.papers.shimada_pictures import save_hypotheses
from drake_pose.papers.shimada_pictures import save_pictures as save_shimada
from drake_pose.papers.tables import Count, Figures
from drake_pose.person.date.walking import COMMANDS, REGISTERED
from drake_pose.search import PoseSearch
from drake_pose.version import VERSION

REPORT, FIGURES, TABLES, BESIDE = "report.html", "figures.json", "tables.txt", "paper.json"
_SETTINGS = "settings.json"
_OUTSIDE_WEIGHT = 10.0
_COLUMNS = 110
# The paper's filter and ours, by the names of their figures.
_FILTERS = (("paper", "sequential", 1), ("ours", "joint", FilterSettings().iterations))
_NONE = "-"


class Outcome(NamedTuple):
    """What an experiment came to: figures by method, its tables, and the paper's beside ours.

    A row of `beside`: what it is, a form, then the paper, its method and ours: words, or figures
    that are put into the form.
    """

    figures: Figures
    shown: Sequence[RenderableType]
    beside: Sequence[tuple[Any, ...]] = ()


class Experiment(NamedTuple):
    """An experiment: folder, title, command for it alone, and `run(short, pictures, count)`."""

    name: str
    title: str
    command: str
    run: Callable[[bool, Path, Count], Outcome]


def _kameda(short: bool, folder: Path, count: Count) -> Outcome:
    searches: dict[str, tuple[PoseSearch, Renderer]] = {
        "paper": (experiment_search(), "drake"),
        "outside_weight": (experiment_search(outside_weight=_OUTSIDE_WEIGHT), "drake"),
        "beam": (beam_experiment_search(), "drake"),
        "beam_own_drawing": (beam_experiment_search(renderer="own"), "own"),
    }
    results = {
        name: run_kameda(search, 3 if short else 219, 0, count, renderer=renderer)
        for name, (search, renderer) in searches.items()
    }
    for name, result in results.items():
        save_kameda(result, folder / name)
    figures = {name: grid_figures(result) for name, result in results.items()}
    paper, beam = figures["paper"], figures["beam"]
    rows = (
        ("mean E_total of poses found", "{mean_e_total:.2%}", PAPER, paper, beam),
        ("silhouettes matched exactly", "{exact} of {images}", PAPER, paper, beam),
        ("every joint angle right", "{pose_equal} of {images}", PAPER, paper, beam),
        ("improved by re-estimation", "{improved} of {images}", PAPER, paper, _NONE),
        ("runs of step 3, mean", "{mean_runs:.1f}", PAPER, paper, _NONE),
        ("processor seconds an image, median", "{median_seconds:.2f}", _NONE, paper, beam),
    )
    return Outcome(figures, [grid_table([[one] for one in results.values()])], rows)


def _kameda_continuous(short: bool, _folder: Path, count: Count) -> Outcome:
    results = {
        f"drawn by {renderer}": run_kameda(
            continuous_search(), 1 if short else 30, 77, count, renderer=renderer
        )
        for renderer in get_args(Renderer)
    }
    drake, own = results.values()
    figures = {**continuous_figures(drake), "own_drawing": continuous_figures(own)}
    return Outcome(figures, [continuous_table(results)])


def _kameda_pictures(experiment: str, short: bool, folder: Path, count: Count) -> Outcome:
    figures = run_real_experiment(experiment, 1 if short else None, folder, count)
    paper, beam = figures["paper"], figures["beam"]
    said = "{paper_mean_e_total:.1%} ({paper_images} pictures)".format(**paper)
    rows = (
        ("mean E_total", "{mean_e_total:.1%} ({images})", said, paper, beam),
        ("processor seconds an image", "{seconds_an_image:.1f}", _NONE, paper, beam),
    )
    warnings = [f"Warning: {text}" for one in figures.values() for text in one["warnings"]]
    return Outcome(figures, [real_table(figures), *warnings], rows)


def _shimada(observed: str, runs: int, short: bool, folder: Path, count: Count) -> Outcome:
    figures: dict[str, dict[str, Any]] = {}
    shown = []
    for name, truncation, iterations in _FILTERS:
        result = run_shimada(1 if short else runs, 0, truncation, observed, count, iterations)
        save_shimada(result, folder / name)
        figures[name] = result.as_json()
        shown.append(result_table(result))
    both = (figures["paper"], figures["ours"])
    first, second = ([one[case] for one in both] for case in ("r13_35", "r13_40"))
    r_13, form = "r_13 after 55 frames where it is", "{r_13_mean:.1f} (RMS error {r_13_rmse:.1f})"
    angles = "joint angles at the end, RMS error [deg]"
    lost = [
        f"{one['lost'] + other['lost']} of {2 * both[0]['runs']}"
        for one, other in zip(first, second, strict=True)
    ]
    inside = ("{inside_2sigma:.0%}", "in its figures 12 to 16")
    rows = (
        (f"{r_13} 35 [pixel]", form, "right (figure 15)", *first),
        (f"{r_13} 40 [pixel]", form, "right (figure 16)", *second),
        ("truths within two deviations", *inside, *first),
        (angles, "{angle_rmse_at_end:.1f}", "right (figure 14)", *first),
        ("sequences lost", "", "none of two", *lost),
        ("milliseconds a frame, median, without drawing", "{ms_per_update:.1f}", _NONE, *first),
    )
    return Outcome(figures, shown, rows)


def _shimada_hypotheses(short: bool, folder: Path, count: Count) -> Outcome:
    figures, shown = {}, []
    for name, truncation, iterations in _FILTERS:
        runs = 2 if short else 50
        result = run_hypotheses_experiment(runs, 0, truncation, "lines", count, iterations)
        save_hypotheses(result, folder / name)
        figures[name] = result.as_json()
        shown.append(result.table())
    paper, ours = figures["paper"], figures["ours"]
    later, lived = "{rejected_later_than_made}", f"{paper['frames_lived_median'] or 0:g} (median)"
    coupled = "{of_these_by_coupled_joints}"
    rows = (
        ("hypotheses rejected later than made", later, "one is shown", paper, ours),
        ("of these wrong", "{of_these_wrong}", "that one", paper, _NONE),
        ("frames from its birth to its end", "", "2 (18 to 20)", lived, _NONE),
        ("as two joints do not bend alike", coupled, "that one", paper, _NONE),
    )
    return Outcome(figures, shown, rows)


def _date(short: bool, folder: Path, count: Count) -> Outcome:
    cameras, frames, size = (4, 40, (320, 240)) if short else (9, 240, (640, 480))
    result = run_date(cameras, frames, 0, "silhouette", count, size)
    save_date(result, folder)
    figures: dict[str, Any] = result.as_json()
    rows: list[tuple[Any, ...]] = []
    for joint in ("elbow", "knee"):
        what = f"{joint}s, upright: by inverse kinematics alone, then with the search [mm]"
        found = f"{figures[f'{joint}_ik_mm']:.0f} to {figures[f'{joint}_mm']:.0f}"
        all_at_once = f"{figures[f'{joint}s']['silhouette_mm']:.1f}"
        rows.append((what, "", "wrong, then right (figure 7)", found, all_at_once))
    both = ("paper", "silhouette")
    whole = [f"{result.milliseconds(way)['all']:.0f} ms, one core" for way in both]
    backs = [result.recoveries(way).get(REGISTERED) or "not" for way in both]
    rows += [
        ("a frame", "", "real time, a cluster (15 ms for the face)", *whole),
        ("frames until the registered pose, shown, is right", "", "that frame", *map(str, backs)),
    ]
    return Outcome(figures, [*result.tables(), result.costs()], rows)


def _date_walk(short: bool, folder: Path, count: Count) -> Outcome:
    cameras, size = (4, (320, 240)) if short else (9, (640, 480))
    walk = run_walk_through(cameras, 0, count, size)
    walk.save(folder)
    followed = "{captured_s:.1f} s ({wrongly_s:.1f} s wrongly)"
    rows: list[tuple[Any, ...]] = []
    for name in COMMANDS:
        one = walk.figures["commands"][name]
        true = f"{name} (true: {one['true_s']:.1f} s)"
        rows.append((true, followed, "works (figure 8)", one, _NONE))
    end = "{place_error_m:.2f} m, {heading_error_deg:.0f} degrees"
    rows.append(("off at the walk's end", end, _NONE, walk.figures, _NONE))
    return Outcome(walk.figures, [walk.table()], rows)


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
        partial(_shimada, "lines", 50),
    ),
    Experiment(
        "shimada_pictures",
        "The same from silhouettes by Drake's renderer: its figures 17 and 18",
        "drake-pose reproduce shimada --pictures --iterations 1 --truncation sequential",
        partial(_shimada, PICTURES, 10),
    ),
    Experiment(
        "shimada_hypotheses",
        "Several hypotheses, and which inequality rejects the wrong ones: its figure 9",
        "drake-pose reproduce shimada --hypotheses",
        _shimada_hypotheses,
    ),
    Experiment(
        "date",
        "Date, Yoshimatsu, Arita, Taniguchi: a person before many cameras",
        "drake-pose reproduce date",
        _date,
    ),
    Experiment(
        "date_walk",
        "Its application: walking on the spot through a place, figure 8",
        "drake-pose reproduce date --walk --method paper",
        _date_walk,
    ),
)


def reproduce_all(out: Path, short: bool, count: Count, say: Callable[[str], None]) -> Path:
    """Runs all experiments that are not finished yet, writes the page after each, and returns it.

    An experiment's folder gets its name when it is finished, so that nothing half done looks whole.

    Args:
        short: a few images, runs and frames of each, to see that all of it works.
        count: counts images, sequences and frames.
        say: called with what happens.

    Raises:
        OutputError: the folder cannot be written, or holds a run with other settings.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        settings, made = out / _SETTINGS, json.dumps({"short": short, "version": VERSION}, indent=2)
        if settings.is_file() and settings.read_text() != made:
            raise OutputError(
                f"{out}: holds experiments made with other settings ({_SETTINGS}); name another "
                "folder with --out"
            )
        _write(settings, made)
        for number, experiment in enumerate(EXPERIMENTS, start=1):
            folder, part = out / experiment.name, out / f"{experiment.name}.part"
            which = f"{number} of {len(EXPERIMENTS)}, {experiment.name}"
            say(f"{which}: is there" if folder.is_dir() else which)
            if not folder.is_dir():
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir()
                begin = time.process_time()
                outcome = experiment.run(short, part, count)
                _write_outcome(part, outcome, time.process_time() - begin)
                os.replace(part, folder)
            _write(out / REPORT, _page(out, short))
    except OSError as error:
        raise OutputError(f"{out}: cannot write the experiments: {error.strerror}") from error
    return out / REPORT


def _write_outcome(folder: Path, outcome: Outcome, cpu_seconds: float) -> None:
    beside = [
        {"what": what}
        | {
            name: one if isinstance(one, str) else form.format(**one)
            for name, one in zip(("paper", "its_method", "ours"), columns, strict=True)
        }
        for what, form, *columns in outcome.beside
    ]
    for name, content in (
        (BESIDE, {"figures": beside, "cpu_seconds": round(cpu_seconds, 1)}),
        (FIGURES, without_nan(outcome.figures)),
    ):
        (folder / name).write_text(json.dumps(content, indent=2, allow_nan=False))
    console = Console(file=io.StringIO(), record=True, width=_COLUMNS)
    for one in outcome.shown:
        console.print(one, markup=False)
    (folder / TABLES).write_text(console.export_text())


def _write(path: Path, text: str) -> None:
    """Writes a file beside its place and moves it there."""
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(text)
    os.replace(beside, path)


def _page(out: Path, short: bool) -> str:
    """The page about the experiments that are finished: the papers' figures beside ours first."""
    finished = []
    for one in EXPERIMENTS:
        folder = out / one.name
        if folder.is_dir():
            pictures = {
                str(path.relative_to(folder)): base64.b64encode(path.read_bytes()).decode()
                for path in sorted(folder.rglob("*.png"))
            }
            beside = json.loads((folder / BESIDE).read_text())
            tables = (folder / TABLES).read_text()
            finished.append({**one._asdict(), **beside, "tables": tables, "pictures": pictures})
    return page_template("drake_pose.papers").render(
        short=short,
        missing=[one.name for one in EXPERIMENTS if not (out / one.name).is_dir()],
        minutes=sum(one["cpu_seconds"] for one in finished) / 60,
        finished=finished,
    )
