"""README, CONTRIBUTING and the pages under tutorials: links, examples, commands, formats."""

import ast
import json
import os
import pkgutil
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

import drake_pose
from drake_pose.body import load_landmarks
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.sources import load_sources
from drake_pose.commands.main import app
from drake_pose.filtering.inequalities import load_couplings
from drake_pose.jobs.batch_tasks import read_job
from tests.cli import run_command

ROOT = Path(__file__).resolve().parents[2]
TUTORIALS = ROOT / "tutorials"
FOLDERS = (ROOT, ROOT / "docs", TUTORIALS, ROOT / "urdf")
PAGES = sorted(
    {page for folder in FOLDERS for page in folder.glob("*.md")} | {*ROOT.glob("urdf/*/*.md")}
)
TEXTS = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
# Those that show how the program is used.
SHOWN = {name: text for name, text in TEXTS.items() if not name.startswith("urdf/")}
NOTEBOOKS = sorted(TUTORIALS.glob("*.ipynb"))
ENVIRONMENT = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}

each_page = pytest.mark.parametrize("page", TEXTS)


def blocks(text: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)


def shell_lines(text: str) -> Iterator[list[str]]:
    for block in blocks(text, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            if words := shlex.split(line, comments=True):
                yield words


PYTHON = [(name, code) for name, text in SHOWN.items() for code in blocks(text, "python")]
COMMANDS = [
    words[1:] for text in SHOWN.values() for words in shell_lines(text) if words[0] == "drake-pose"
]
PASTED = [words for words in COMMANDS if any(word.startswith("tutorials/data") for word in words)]


@each_page
def test_python_names_in_the_text_exist(page: str) -> None:
    for name in set(re.findall(r"drake_pose(?:\.[a-z]\w*)+(?:\.[A-Z]\w*)?", TEXTS[page])):
        assert pkgutil.resolve_name(name) is not None


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(PYTHON)), ids=[name for name, _ in PYTHON])
def test_python_examples_run(
    index: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    name, code = PYTHON[index]
    exec(compile(code, f"{name}, an example", "exec"), {})
    printed = capsys.readouterr().out
    assert printed
    assert "nan" not in printed


@pytest.mark.slow
def test_a_camera_reaches_another_process_by_lcm() -> None:
    """The two programs of a page, on a port of this test's own."""
    camera, matcher = (
        code.replace(":7667", f":{20000 + os.getpid() % 10000}")
        for code in blocks(TEXTS["tutorials/cluster.md"], "py")
    )
    with subprocess.Popen([sys.executable, "-c", camera], cwd=ROOT) as process:
        try:
            found = subprocess.check_output([sys.executable, "-c", matcher], cwd=ROOT, text=True)
        finally:
            process.kill()
    assert 0.0 < float(found.split()[-1]) < 0.15


@pytest.mark.slow
@pytest.mark.parametrize("words", PASTED, ids=" ".join)
def test_commands_on_data_of_the_repository_run_as_pasted(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("tutorials", "urdf"):
        (tmp_path / name).symlink_to(ROOT / name)
    monkeypatch.chdir(tmp_path)
    result = run_command(words, env=ENVIRONMENT)
    assert result.exit_code == 0, result.output
    out = tmp_path / words[words.index("--out") + 1] if "--out" in words else tmp_path
    assert all((out / name).is_file() for name in re.findall(r"^(\S+\.\w+)  ", result.output, re.M))


def test_the_readme_fits_on_a_screen() -> None:
    readme = TEXTS["README.md"]
    assert [name for name, _ in PYTHON].count("README.md") == 1
    assert [words[:2] for words in shell_lines(readme)] == [["make", "demo"]]
    assert len(re.findall(r"!\[|<img", readme)) == 1
    assert len(readme.splitlines()) <= 60
    assert len(readme.encode()) <= 3500


def python_sources() -> Iterator[tuple[str, str]]:
    """The name and the Python code of every example and notebook."""
    for name, text in SHOWN.items():
        for language in ("python", "py"):
            yield from ((name, code) for code in blocks(text, language))
    for path in NOTEBOOKS:
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        yield from (
            (path.name, "".join(cell["source"])) for cell in cells if cell["cell_type"] == "code"
        )


def test_pages_and_notebooks_import_from_drake_pose_itself() -> None:
    used = set()
    for page, code in python_sources():
        for node in ast.walk(ast.parse(code)):
            if isinstance(node, ast.Import):
                assert not any(one.name.startswith("drake_pose.") for one in node.names), page
            elif isinstance(node, ast.ImportFrom) and f"{node.module}.".startswith("drake_pose."):
                assert node.module == "drake_pose", f"{page}: from {node.module} import ..."
                used |= {one.name for one in node.names}
    assert used <= {*drake_pose.__all__}
    # What pages describe and no example imports.
    text = "\n".join(SHOWN.values())
    unused = {*drake_pose.__all__} - used
    assert all(re.search(rf"`{name}\b", text) for name in unused), unused


def test_the_public_names_are_few_and_nothing_else_is_listed() -> None:
    assert len(drake_pose.__all__) <= 46
    assert dir(drake_pose) == sorted([*drake_pose.__all__, "__version__"])


def test_every_command_has_an_example() -> None:
    listed = {name for name in app if not name.startswith("-")}
    shown = {words[1] for words in shell_lines(TEXTS["tutorials/commands.md"])}
    assert shown == listed


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_command_line_examples_use_options_that_exist(words: list[str]) -> None:
    command = words[:2] if words[0] == "reproduce" else words[:1]
    shown = run_command([*command, "--help"], env=ENVIRONMENT)
    assert shown.exit_code == 0
    known = set(re.findall(r"--[a-z][a-z-]*", shown.output))
    used = {word for word in words if word.startswith("--")}
    assert used <= known


def test_options_named_in_the_text_exist() -> None:
    commands = [[command] for command in ("estimate", "register", "masks", "capture", "batch")]
    commands += [["reproduce", paper] for paper in ("kameda", "shimada", "date")]
    shown = [run_command([*one, "--help"], env=ENVIRONMENT) for one in commands]
    known = {word for one in shown for word in re.findall(r"--[a-z][a-z-]*", one.output)}
    named = {word for text in SHOWN.values() for word in re.findall(r"`(--[a-z][a-z-]*)", text)}
    assert {"--json", "--resume", "--package"} <= named
    assert named - known - {"--help"} == set()


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    text = "\n".join(SHOWN.values())
    named = set(re.findall(r"`make ([a-z-]+)`", text))
    named |= set(re.findall(r"^make ([a-z-]+)", text, flags=re.MULTILINE))
    assert {"demo", "test", "test-slow", "docs", "bench"} <= named
    for target in named:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def anchors(page: Path) -> set[str]:
    """A page's headings as GitHub makes anchors of them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.*)$", text, flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", one.lower()).replace(" ", "-") for one in headings}


@pytest.mark.parametrize("page", [*TEXTS, *(f"tutorials/{one.name}" for one in NOTEBOOKS)])
def test_links_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    targets = re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text)
    for target in targets:
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        place = (ROOT / page).parent / file if file else ROOT / page
        assert place.exists(), target
        if anchor:
            assert anchor in anchors(place), target


def test_the_overview_names_every_page() -> None:
    listed = re.findall(r"^\| \[\w+\]\((\w+\.md)\)", TEXTS["tutorials/README.md"], re.MULTILINE)
    assert sorted(listed) == sorted(
        page.name for page in TUTORIALS.glob("*.md") if page.name != "README.md"
    )


def test_the_folders_are_those_of_the_library() -> None:
    listed = re.findall(r"^\| `drake_pose/(\w+)` \|", TEXTS["CONTRIBUTING.md"], re.MULTILINE)
    folders = {path.parent.name for path in (ROOT / "drake_pose").glob("*/__init__.py")}
    assert set(listed) == folders
    assert len(listed) == len(folders)


def test_the_ways_of_a_picture_lead_through_functions_that_exist() -> None:
    rows = re.findall(
        r"^\| [^|]* \| (`\w+/.*?) \| (`.*?) \| .* \|$", TEXTS["CONTRIBUTING.md"], re.M
    )
    for files, functions in rows:
        text = "".join((ROOT / "drake_pose" / one).read_text() for one in files.split("`")[1::2])
        for name in re.findall(r"`[\w.]*?(\w+)`", functions):
            assert re.search(rf"(def|class) {name}\b", text), f"{name} is not in {files}"
    assert len(rows) > 30


def test_every_package_has_an_api_page() -> None:
    pages = {page.stem for page in (ROOT / "docs").glob("*.rst")}
    folders = {path.parent.name for path in (ROOT / "drake_pose").glob("*/__init__.py")}
    assert pages == {"index", "errors", *folders} - {"commands"}


@each_page
def test_no_absolute_path(page: str) -> None:
    assert not re.search(r"(?<![\w.)/:])/(home|root|tmp|usr|work|Users|opt|var)/", TEXTS[page])


def yaml_example(page: str, word: str) -> str:
    (found,) = [block for block in blocks(TEXTS[page], "yaml") if word in block]
    return found


def test_the_examples_of_files_can_be_read(tmp_path: Path) -> None:
    formats, models = "tutorials/file_formats.md", "tutorials/models.md"

    def write(name: str, page: str, word: str) -> Path:
        path = tmp_path / name
        path.write_text(yaml_example(page, word), encoding="utf-8")
        return path

    (left,) = load_cameras(write("cameras.yaml", formats, "X_WC")).values()
    cameras = {name: left for name in ("front", "side", "top")}
    sources = load_sources(write("sources.yaml", formats, "location"), cameras)
    assert [one.kind for one in sources.values()] == ["device", "video", "folder"]
    jobs = read_job(write("jobs.yaml", formats, "scenes:"))
    assert [job.name for job in jobs] == ["monday", "tuesday", "walker", "robot"]
    assert "left_elbow" in load_landmarks(write("landmarks.yaml", models, "landmarks:"))
    columns = ("flexion_11", "flexion_12", "flexion_13")
    rows = load_couplings(write("hand.couplings.yaml", models, "differences"), columns)
    assert len(rows) == 3
    for page in (formats, models):
        for block in blocks(TEXTS[page], "yaml"):
            assert yaml.safe_load(block)
