"""The commands `drake-pose reproduce kameda`, `shimada` and `date`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from drake_pose.commands.common import (
    Json,
    Pictures,
    Seed,
    UsageError,
    count_progress,
    output_console,
    print_json,
    warn,
    within,
)

if TYPE_CHECKING:
    from rich.table import Table

    from drake_pose.papers.tables import Count


def kameda(
    *,
    experiment: Literal["A", "B", "C"] = "A",
    images: Annotated[int, within(1)] = 219,
    seed: Annotated[int | None, within(0)] = None,
    method: Literal["paper", "beam"] | None = None,
    angles: Literal["grid", "continuous"] | None = None,
    views: Annotated[int | None, within(1)] = None,
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Kameda, Minoh and Ikeda: poses of a woman (A), of a man in real pictures (B), of a hand (C).

    The pose is searched from one silhouette and the position of the head (A), an ankle (B) or the
    wrist (C). The table shows the published results beside ours.

        drake-pose reproduce kameda --images 20

    Args:
        experiment: A: rendered silhouettes of random poses; B: six pictures of a man; C: two
            pictures of a hand.
        images: Maximum number of silhouettes.
        seed: Seed of the random poses. Default: 0.
        method: paper: the published search alone; beam: compare it with beam search. Default:
            paper.
        angles: grid: true angles and samples are multiples of 20 degrees, as in the paper;
            continuous: true angles are arbitrary, and poses are refined between the samples.
            Default: grid.
        views: With --angles continuous: number of cameras. Default: 1.
    """
    is_continuous = angles == "continuous"
    if experiment != "A" and (method or angles or views or seed is not None):
        raise UsageError("--method, --angles, --views and --seed need --experiment A")
    if is_continuous and method:
        raise UsageError("--method needs --angles grid")
    if views and not is_continuous:
        raise UsageError("--views needs --angles continuous")
    warnings: list[str] = []
    with _experiment(out) as count:
        from drake_pose.papers import kameda as poses
        from drake_pose.papers.pictures import save_poses
        from drake_pose.search import MultiStartSearch

        if experiment != "A":
            real = poses.run_real_experiment(experiment, images, out, count)
            figures, table = {**real["beam"], "paper_method": real["paper"]}, poses.real_table(real)
            for method, name in poses.METHODS.items():
                warnings += [f"{name}: {text}" for text in real[method]["warnings"]]
        elif is_continuous:
            search = MultiStartSearch(poses.experiment_tree(), exact_masks=True)
            result = poses.run_experiment(search, images, seed or 0, count, views or 1)
            figures, table = poses.continuous_figures(result), poses.continuous_table(result)
        else:
            # For the comparison the published search runs on as many images as in the paper.
            is_beam = method == "beam"
            few = min(images, int(poses.PAPER["images"])) if is_beam else images
            runs = [poses.run_experiment(poses.experiment_search(), few, seed or 0, count)]
            if is_beam:
                beam = poses.beam_experiment_search()
                runs.append(poses.run_experiment(beam, images, seed or 0, count))
            figures, table = poses.grid_figures(runs[-1]), poses.grid_table(runs)
            if is_beam:
                figures["paper_method"] = poses.grid_figures(runs[0])
            if out is not None:
                save_poses(runs[-1], out)
    _show(figures, [table], json, warnings, out)


def shimada(
    *,
    runs: Annotated[int | None, within(1)] = None,
    seed: Seed = 0,
    truncation: Literal["sequential", "joint", "none"] | None = None,
    iterations: Annotated[int | None, within(1)] = None,
    hypotheses: bool = False,
    pictures: bool = False,
    sequence: tuple[Path, ...] = (),
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Shimada, Shirai, Kuno and Miura: joint angles and lengths of a synthetic hand, one camera.

    A two-finger hand moves, turns and flexes for 55 frames, measured with noise. A Kalman filter
    starts from wrong angles and lengths and corrects both; its belief is truncated by the limits
    and couplings of the paper's table 1. The published experiment measures numbers (section 6);
    with --pictures the measurements are silhouettes from Drake's renderer (figure 17).

        drake-pose reproduce shimada --runs 20 --out results/shimada
        drake-pose reproduce shimada --pictures --out results/figure_17
        drake-pose reproduce shimada --sequence SCENE --out results/figure_17_hand

    Args:
        runs: Number of sequences for each of r_13 = 35 and 40. Default: 50, with --pictures 10.
        truncation: Truncation of the belief by the inequalities; sequential is the published one.
            Default: joint, with --hypotheses sequential.
        iterations: Maximum number of linearisations in an update; the published filter has 1.
            Default: 20, with --hypotheses 1.
        hypotheses: Run the experiment of figure 9 instead: fingers bend through the image plane.
            Shows which hypotheses are created, and what rejects the wrong ones.
        pictures: Measure silhouettes drawn by Drake's renderer instead of noisy numbers.
        sequence: Use recorded silhouettes instead, of a right hand cut off at the wrist, in one
            view of unknown scale (a scene with sequence: true); repeat for several.
    """
    if pictures and hypotheses:
        raise UsageError("--pictures excludes --hypotheses")
    if sequence and (hypotheses or runs):
        raise UsageError("--sequence excludes --hypotheses and --runs")
    warnings = []
    with _experiment(out) as count:
        from drake_pose.papers import shimada as hands
        from drake_pose.papers import shimada_sequences as sequences
        from drake_pose.papers.pictures import save_hands, save_hypotheses, save_recorded_hand

        if sequence:
            settings = sequences.experiment_settings(truncation or "joint", iterations or 20)
            followed = [sequences.run_sequence(folder, settings, count) for folder in sequence]
            figures: dict[str, Any] = {one.name: one.figures for one in followed}
            table = sequences.recorded_table(followed)
            warnings = [one.warning() for one in followed]
            if out is not None:
                for one in followed:
                    save_recorded_hand(one, out)
        elif hypotheses:
            settings = sequences.experiment_settings(truncation or "sequential", iterations or 1)
            found = hands.run_hypotheses_experiment(runs or 50, seed, settings, count)
            figures, table = found.as_json(), found.table()
            if out is not None and not save_hypotheses(found, out):
                warnings = ["no wrong hypothesis was rejected by an inequality: nothing to draw"]
        else:
            settings = sequences.experiment_settings(truncation or "joint", iterations or 20)
            observed = hands.PICTURES if pictures else "lines"
            number = runs or (10 if pictures else 50)
            result = hands.run_experiment(number, seed, settings, observed, count)
            figures, table = result.as_json(), hands.result_table(result)
            if out is not None:
                save_hands(result, out)
    _show(figures, [table], json, warnings, out)


def date(
    *,
    cameras: Annotated[int, within(3)] = 9,
    frames: Annotated[int, within(40)] = 240,
    seed: Seed = 0,
    method: Literal["silhouette", "paper"] = "silhouette",
    walk: bool = False,
    out: Pictures = None,
    json: Json = False,
) -> None:
    """Date, Yoshimatsu, Arita and Taniguchi: a moving person before many calibrated cameras.

    A simulated person walks, reaches, leans, crouches, turns and crosses the arms. The table
    compares the published inverse kinematics, the published search for elbows and knees, and one
    fit to all silhouettes at once. Times are for one core, without rendering.

        drake-pose reproduce date --cameras 5 --frames 120 --out results/date

    Args:
        cameras: Number of cameras, including the one before the face; the paper has 9.
        frames: Number of frames; fewer than 120 do not show all motions.
        method: paper: the published method alone, with its rules as printed (rectangles on one
            circle, waist weights 0.55, 0.225 and 0.225, feet nearest to their last positions);
            silhouette: compare it with a fit to all silhouettes.
        walk: Run the experiment of section 6.2 and figure 8 instead: the gestures of table 1 walk
            an avatar through a place. Captured by the published method.
    """
    with _experiment(out) as count:
        from drake_pose.papers import date as people
        from drake_pose.papers.pictures import save_captures, save_walk

        if walk:
            figures, pictures = people.run_walk_through(cameras, seed, count)
            if out is not None:
                save_walk(pictures, out)
            _show(figures, [people.walk_table(figures)], json, out=out)
            return
        result = people.run_experiment(cameras, frames, seed, method, count)
        if out is not None:
            save_captures(result, out)
    _show(result.as_json(), [*result.tables(), result.costs()], json, out=out)


@contextmanager
def _experiment(out: Path | None) -> Iterator[Count]:
    """Lock the folder for results, unless it is None; yields a function that starts a progress bar.

    That function gets a label and the number of all items, removes the bar before, and returns a
    function to be called with the number of finished items.
    """
    from drake_pose.files.folder import claimed

    with ExitStack() as bars, nullcontext() if out is None else claimed(out):

        def count(what: str, total: int) -> Callable[[int], None]:
            bars.close()
            return bars.enter_context(count_progress(what, total))

        yield count


def _show(
    figures: Mapping[str, Any],
    shown: Sequence[Table | str],
    json: bool,
    warnings: Sequence[str] = (),
    out: Path | None = None,
) -> None:
    """Print warnings to stderr, and results to stdout; write them to a page.

    Args:
        figures: all results, printed if ``json`` is True.
        shown: tables of the main results, printed otherwise.
        json: whether JSON is printed.
        warnings: messages for the user.
        out: folder for the page report.html; None: none is written.
    """
    warn(*warnings)
    if out is not None:
        from drake_pose.papers.tables import save_page

        save_page(out, shown, warnings)
    if json:
        print_json(figures)
    else:
        output_console().print(*shown)
