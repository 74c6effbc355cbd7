"""All experiments of the three papers in turn, and one page of their results."""

import base64
import io
import json
import os
import shutil
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console, RenderableType

from drake_pose.errors import OutputError
from drake_pose.files.folder import without_nan
from drake_pose.files.report_page import page_template
from drake_pose.papers import date, kameda, kameda_pictures, shimada, shimada_pictures
from drake_pose.papers.tables import Count, Figures
from drake_pose.person.date.walking import COMMANDS, REGISTERED
from drake_pose.search import MultiStartSearch, PoseSearch
from drake_pose.version import VERSION

Outcome = tuple[Figures, Sequence[RenderableType], Sequence[tuple[Any, ...]]]
"""An experiment's figures, its tables, and rows that compare the paper's figures with ours.

A row: label, format, then the entries of the paper, of its method here, and of ours. An entry is a
text, or figures by the names of the format.
"""


class Experiment(NamedTuple):
    """An experiment of a paper.

    Attributes:
        name: of its folder.
        title: its heading on the page.
        command: the command line that runs it alone.
        run: runs it: `run(short, folder, count)` with few images and runs if `short`, writes its
            pictures to the folder, and reports progress to the count.
    """

    name: str
    title: str
    command: str
    run: Callable[[bool, Path, Count], Outcome]


def _kameda(short: bool, folder: Path, count: Count) -> Outcome:
    """Run Kameda's experiment A by both searches, 3 poses if `short` or 219; pictures: `folder`."""
    searches: dict[str, PoseSearch] = {
        "paper": kameda.experiment_search(),
        "beam": kameda.beam_experiment_search(),
    }
    images = 3 if short else 219
    results = {
        name: kameda.run_experiment(search, images, 0, count) for name, search in searches.items()
    }
    for name, result in results.items():
        kameda_pictures.save_pictures(result, folder / name)
    figures = {name: kameda.grid_figures(result) for name, result in results.items()}
    printed, (paper, beam) = kameda.PAPER, figures.values()
    rows = (
        ("mean E_total of poses found", "{mean_e_total:.2%}", printed, paper, beam),
        ("silhouettes matched exactly", "{exact} of {images}", printed, paper, beam),
        ("every joint angle right", "{pose_equal} of {images}", printed, paper, beam),
        ("improved by re-estimation", "{improved} of {images}", printed, paper, "-"),
        ("runs of step 3, mean", "{mean_runs:.1f}", printed, paper, "-"),
        ("processor seconds an image, median", "{median_seconds:.2f}", "-", paper, beam),
    )
    return figures, [kameda.grid_table([[one] for one in results.values()])], rows


def _kameda_continuous(short: bool, _folder: Path, count: Count) -> Outcome:
    """Run Kameda's experiment A with continuous angles, one pose if `short`, otherwise 30."""
    search = MultiStartSearch(kameda.experiment_tree(), exact_masks=True)
    result = kameda.run_experiment(search, 1 if short else 30, 77, count)
    return kameda.continuous_figures(result), [kameda.continuous_table(result)], ()


def _kameda_pictures(experiment: str, short: bool, folder: Path, count: Count) -> Outcome:
    """Run Kameda's experiment "B" or "C", one picture if `short`; pictures go to `folder`."""
    figures = kameda.run_real_experiment(experiment, 1 if short else None, folder, count)
    paper, beam = figures["paper"], figures["beam"]
    said = "{paper_mean_e_total:.1%} ({paper_images} pictures)".format(**paper)
    rows = (
        ("mean E_total", "{mean_e_total:.1%} ({images})", said, paper, beam),
        ("processor seconds an image", "{seconds_an_image:.1f}", "-", paper, beam),
    )
    warnings = [f"Warning: {text}" for one in figures.values() for text in one["warnings"]]
    return figures, [kameda.real_table(figures), *warnings], rows


def _filters() -> tuple[tuple[str, str, int], ...]:
    """Return name, truncation and most linearisations of the paper's filter and of ours."""
    own = shimada.experiment_settings("joint").iterations
    return ("paper", "sequential", 1), ("ours", "joint", own)


def _shimada(observed: str, runs: int, short: bool, folder: Path, count: Count) -> Outcome:
    """Run Shimada's experiment with the paper's filter and with ours.

    Pictures are written to `folder`, progress is reported to `count`.

    Args:
        observed: what is measured, as of `shimada.run_experiment`.
        runs: number of runs of each case; one if `short`.
    """
    figures: dict[str, dict[str, Any]] = {}
    shown = []
    for name, truncation, iterations in _filters():
        result = shimada.run_experiment(
            1 if short else runs, 0, truncation, observed, count, iterations
        )
        shimada_pictures.save_pictures(result, folder / name)
        figures[name] = result.as_json()
        shown.append(shimada.result_table(result))
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
        ("true values within two deviations", *inside, *first),
        (angles, "{angle_rmse_at_end:.1f}", "right (figure 14)", *first),
        ("sequences lost", "", "none of two", *lost),
        ("milliseconds a frame, median, without drawing", "{ms_per_update:.1f}", "-", *first),
    )
    return figures, shown, rows


def _shimada_hypotheses(short: bool, folder: Path, count: Count) -> Outcome:
    """Run Shimada's hypotheses by both filters, 2 runs if `short`, or 50; pictures: `folder`."""
    figures, shown = {}, []
    for name, truncation, iterations in _filters():
        runs = 2 if short else 50
        result = shimada.run_hypotheses_experiment(runs, 0, truncation, "lines", count, iterations)
        shimada_pictures.save_hypotheses(result, folder / name)
        figures[name] = result.as_json()
        shown.append(result.table())
    paper, ours = figures["paper"], figures["ours"]
    later, lived = "{rejected_later_than_made}", f"{paper['frames_lived_median'] or 0:g} (median)"
    coupled = "{of_these_by_coupled_joints}"
    rows = (
        ("hypotheses rejected later than made", later, "one is shown", paper, ours),
        ("of these wrong", "{of_these_wrong}", "that one", paper, "-"),
        ("frames from creation to rejection", "", "2 (18 to 20)", lived, "-"),
        ("rejected by a coupling of two joints", coupled, "that one", paper, "-"),
    )
    return figures, shown, rows


def _date(short: bool, folder: Path, count: Count) -> Outcome:
    """Run Date's experiment, a small one if `short`; pictures go to `folder`."""
    cameras, frames, size = (4, 40, (320, 240)) if short else (9, 240, (640, 480))
    result = date.run_experiment(cameras, frames, 0, "silhouette", count, size)
    date.save_pictures(result, folder)
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
        ("frames until the shown registered pose is right", "", "that frame", *map(str, backs)),
    ]
    return figures, [*result.tables(), result.costs()], rows


def _date_walk(short: bool, folder: Path, count: Count) -> Outcome:
    """Run Date's walk through a virtual place, a small one if `short`; pictures go to `folder`."""
    cameras, size = (4, (320, 240)) if short else (9, (640, 480))
    figures, pictures = date.run_walk_through(cameras, 0, count, size)
    date.save_walk(pictures, folder)
    followed = "{captured_s:.1f} s ({wrongly_s:.1f} s wrong)"
    rows: list[tuple[Any, ...]] = []
    for name in COMMANDS:
        one = figures["commands"][name]
        true = f"{name} (true: {one['true_s']:.1f} s)"
        rows.append((true, followed, "works (figure 8)", one, "-"))
    end = "{place_error_m:.2f} m, {heading_error_deg:.0f} degrees"
    rows.append(("error at the walk's end", end, "-", figures, "-"))
    return figures, [date.walk_table(figures)], rows


EXPERIMENTS = (
    Experiment(
        "kameda",
        "Kameda, Minoh, Ikeda: pose from one silhouette, experiment A",
        "drake-pose reproduce kameda --method beam",
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
        partial(_shimada, shimada.PICTURES, 10),
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
    """Run all experiments that are not finished, and write the page after each; return its path.

    An experiment's folder gets its final name only when the experiment is finished.

    Args:
        out: folder of the results.
        short: whether to run few images, runs and frames, as a test.
        count: reports the progress of each experiment.
        say: called with messages.

    Raises OutputError: the folder cannot be written, or holds a run with other settings.
    """
    settings, made = out / "settings.json", json.dumps({"short": short, "version": VERSION})
    try:
        out.mkdir(parents=True, exist_ok=True)
        if settings.is_file() and settings.read_text() != made:
            raise OutputError(
                f"{out}: holds experiments made with other settings ({settings.name}); name "
                "another folder with --out"
            )
        _write(settings, made)
        for number, experiment in enumerate(EXPERIMENTS, start=1):
            folder, part = out / experiment.name, out / f"{experiment.name}.part"
            which = f"{number} of {len(EXPERIMENTS)}, {experiment.name}"
            say(f"{which}: finished already" if folder.is_dir() else which)
            if not folder.is_dir():
                shutil.rmtree(part, ignore_errors=True)
                part.mkdir()
                begin = time.process_time()
                outcome = experiment.run(short, part, count)
                _write_outcome(part, outcome, time.process_time() - begin)
                os.replace(part, folder)
            _write(out / "report.html", _page(out, short))
    except OSError as error:
        raise OutputError(f"{out}: cannot write the experiments: {error.strerror}") from error
    return out / "report.html"


def _write_outcome(folder: Path, outcome: Outcome, cpu_seconds: float) -> None:
    """Write figures.json, tables.txt, and paper.json: compared figures and processor time [s]."""
    figures, shown, rows = outcome
    beside = [
        {"what": what}
        | {
            name: one if isinstance(one, str) else form.format(**one)
            for name, one in zip(("paper", "its_method", "ours"), columns, strict=True)
        }
        for what, form, *columns in rows
    ]
    for name, content in (
        ("paper.json", {"figures": beside, "cpu_seconds": round(cpu_seconds, 1)}),
        ("figures.json", without_nan(figures)),
    ):
        (folder / name).write_text(json.dumps(content, indent=2, allow_nan=False))
    console = Console(file=io.StringIO(), record=True, width=110)
    for one in shown:
        console.print(one, markup=False)
    (folder / "tables.txt").write_text(console.export_text())


def _write(path: Path, text: str) -> None:
    """Write a text file under another name and move it to its place."""
    beside = path.with_name(f"{path.name}.part")
    beside.write_text(text)
    os.replace(beside, path)


def _page(out: Path, short: bool) -> str:
    """Return the HTML page of a folder's finished experiments; it says if they are `short`."""
    finished = []
    for one in EXPERIMENTS:
        folder = out / one.name
        if folder.is_dir():
            pictures = {
                str(path.relative_to(folder)): base64.b64encode(path.read_bytes()).decode()
                for path in sorted(folder.rglob("*.png"))
            }
            beside = json.loads((folder / "paper.json").read_text())
            tables = (folder / "tables.txt").read_text()
            finished.append({**one._asdict(), **beside, "tables": tables, "pictures": pictures})
    return page_template("drake_pose.papers").render(
        short=short,
        missing=[one.name for one in EXPERIMENTS if not (out / one.name).is_dir()],
        minutes=sum(one["cpu_seconds"] for one in finished) / 60,
        finished=finished,
    )
