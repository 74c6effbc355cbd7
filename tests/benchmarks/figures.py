"""Write the measured tables of tutorials/figures.md and tutorials/speed.md (``make figures``).

Run as ``python -m tests.benchmarks.figures DATA [NAME ...]``; DATA is the folder of recorded
scenes, NAME a section of ``SECTIONS`` (default: all, about an hour on two cores). Each section runs
its commands, turns the tables that they print into Markdown, and replaces what stands between its
two markers in its page. A command that fails leaves its section as it was.
"""

import argparse
import os
import re
import resource
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path

PAGES = tuple(
    Path(__file__).parents[2] / "tutorials" / f"{name}.md" for name in ("figures", "speed")
)

SECTIONS: dict[str, tuple[str, ...]] = {
    "kameda": ("drake-pose reproduce kameda --method beam --seed 2026",),
    "kameda-continuous": (
        "drake-pose reproduce kameda --angles continuous --images 24 --seed 77",
        "drake-pose reproduce kameda --angles continuous --images 24 --seed 555",
        "drake-pose reproduce kameda --angles continuous --images 12 --seed 77 --views 2",
    ),
    "kameda-pictures": (
        "drake-pose reproduce kameda --experiment B",
        "drake-pose reproduce kameda --experiment C",
    ),
    "shimada": (
        "drake-pose reproduce shimada --runs 50",
        "drake-pose reproduce shimada --runs 50 --iterations 1 --truncation sequential",
        "drake-pose reproduce shimada --pictures",
        "drake-pose reproduce shimada --hypotheses",
    ),
    "date": ("drake-pose reproduce date", "drake-pose reproduce date --walk"),
    "estimates": ("python -m tests.benchmarks.estimates DATA",),
    "hands": ("python -m tests.benchmarks.estimates DATA --hands",),
    "intervals": ("python -m tests.benchmarks.coverage DATA",),
    "registration": ("python -m tests.benchmarks.registration DATA --cases 5",),
    "episodes": tuple(
        f"python -m tests.benchmarks.episodes DATA --rooms {more}" for more in ("3", "1 --spoilt")
    ),
    "filters": ("python -m tests.benchmarks.filters",),
    "speed": ("python -m tests.benchmarks.speed", "python -m tests.benchmarks.silhouette_camera"),
    "memory": ("python -m tests.benchmarks.memory",),
    "cluster": ("python -m tests.benchmarks.cluster",),
}
"""Commands by section of the pages. ``DATA`` stands for the folder of recorded scenes."""


def markers(name: str) -> tuple[str, str]:
    """Return the lines between which a section's tables stand in the page."""
    return f"<!-- {name}: written by make figures -->", f"<!-- end of {name} -->"


def to_markdown(printed: str) -> str:
    """Convert the tables that rich printed to Markdown.

    A title, which rich centres above its table, becomes a bold line. Text outside tables is left
    out. Cells that rich broke over several lines are joined.
    """
    found, rows, before = list[str](), list[list[str]](), list[str]()
    for text in map(str.strip, printed.splitlines()):
        mark = text[:1]
        if mark == "┏":
            # Rich breaks a long title in two lines; more lines are something else.
            title = " ".join(before if len(before) < 3 else before[-1:])
            rows, before = [], []
        elif mark and mark in "┃│":
            cells = [cell.strip() for cell in re.split("[┃│]", text)[1:-1]]
            # A head, or a cell of the first column, continues in the next line.
            if rows and (mark == "┃" or (not cells[0] and len(rows) > 1)):
                rows[-1] = [f"{a} {b}".strip() for a, b in zip(rows[-1], cells, strict=True)]
            else:
                rows.append(cells)
        elif mark == "└" and rows:
            head, *body = (f"| {' | '.join(row)} |" for row in rows)
            rule = "|" + " --- |" * len(rows[0])
            found.append("\n".join([*([f"**{title}**\n"] if title else []), head, rule, *body]))
        elif not mark or mark not in "┡├":
            before.append(text)
    return "\n\n".join(found)


def run(command: str, data: Path) -> tuple[str, float]:
    """Run a command of a section: what it printed, and its CPU time [s].

    Raises:
        subprocess.CalledProcessError: if the command failed.
    """
    words = shlex.split(command)
    program = {"drake-pose": ["-m", "drake_pose.commands.main"], "python": []}[words[0]]
    given = [str(data) if word == "DATA" else word for word in words[1:]]
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *program, *given], check=True, capture_output=True, text=True,
        env=os.environ | {"COLUMNS": "400", "NO_COLOR": "1"},
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return done.stdout, seconds


def machine() -> str:
    """Return the processor's name and the number of cores that this process may use."""
    info = Path("/proc/cpuinfo")
    names = re.findall(r"model name\s*: (.*)", info.read_text()) if info.is_file() else []
    count = len(os.sched_getaffinity(0))
    return f"{names[0].strip() if names else 'processor'}, {count} cores"


def blocks(name: str, data: Path) -> Iterator[str]:
    """Run a section's commands: of each its command line, its tables and its cost."""
    for command in SECTIONS[name]:
        printed, seconds = run(command, data)
        shown = command.replace("DATA", "../shared/data")
        if not (tables := to_markdown(printed)):
            raise ValueError(f"{command}: printed no table")
        today = date.today().isoformat()
        yield f"`{shown}`\n\n{tables}\n\n{seconds:.0f} s of CPU time; {machine()}; {today}."


def replaced(page: str, name: str, text: str) -> str:
    """Return the page with a section's tables replaced.

    Raises:
        ValueError: if the page lacks the section's markers.
    """
    begin, end = markers(name)
    if page.count(begin) != 1 or page.count(end) != 1:
        raise ValueError(f"the page lacks the markers of section '{name}'")
    head, tail = page.split(begin)[0], page.split(end)[1]
    return f"{head}{begin}\n\n{text}\n\n{end}{tail}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the sections that are asked for, each as soon as it is measured."""
    parser = argparse.ArgumentParser(description="Write the tables of figures.md and speed.md.")
    parser.add_argument("data", type=Path, help="folder of recorded scenes")
    parser.add_argument("names", nargs="*", help="sections; default: all")
    given = parser.parse_args(arguments)
    if unknown := [name for name in given.names if name not in SECTIONS]:
        parser.error(f"no section '{unknown[0]}'; there are {', '.join(SECTIONS)}")
    for name in given.names or SECTIONS:
        print(name, flush=True)
        try:
            text = "\n\n".join(blocks(name, given.data))
        except (subprocess.CalledProcessError, ValueError) as error:
            print(f"{name}: left as it was: {error}", file=sys.stderr)
            continue
        page = next(page for page in PAGES if markers(name)[0] in page.read_text())
        page.write_text(replaced(page.read_text(), name, text))


if __name__ == "__main__":
    main()
