import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from drake_pose.apps.main import app

ROOT = Path(__file__).resolve().parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", README, flags=re.MULTILINE | re.DOTALL)


def shell_lines() -> list[list[str]]:
    joined = [block.replace("\\\n", " ") for block in blocks("sh")]
    lines = [line for block in joined for line in block.splitlines()]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


DRAKE_POSE_LINES = [words[1:] for words in shell_lines() if words[0] == "drake-pose"]


@pytest.mark.slow
@pytest.mark.parametrize("index", range(len(blocks("python"))))
def test_python_examples_run(
    index: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)
    exec(compile(blocks("python")[index], f"README.md, example {index + 1}", "exec"), {})
    printed = capsys.readouterr().out
    assert printed
    assert "nan" not in printed


def test_there_are_examples() -> None:
    assert len(blocks("python")) == 2
    commands = {
        "batch", "calibrate", "capture", "check", "empty-room", "estimate", "reproduce",
        "undistort", "walk",
    }  # fmt: skip
    assert {words[0] for words in DRAKE_POSE_LINES} == commands


@pytest.mark.parametrize("words", DRAKE_POSE_LINES, ids=" ".join)
def test_command_line_examples_use_options_that_exist(words: list[str]) -> None:
    command = words[:2] if words[0] == "reproduce" else words[:1]
    environment = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    shown = CliRunner().invoke(app, [*command, "--help"], env=environment)
    assert shown.exit_code == 0
    known = set(re.findall(r"--[a-z][a-z-]*", shown.output))
    used = {word for word in words if word.startswith("--")}
    assert used <= known


@pytest.mark.parametrize("option", ["--help", "--json", "--resume"])
def test_options_named_in_the_text_exist(option: str) -> None:
    assert f"`{option}`" in README
    environment = {"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    assert option in CliRunner().invoke(app, ["estimate", "--help"], env=environment).output


def test_make_targets_exist() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    named = set(
        re.findall(r"\bmake ([a-z]+)$|`make ([a-z]+)`|^make ([a-z]+)", README, re.MULTILINE)
    )
    targets = {name for names in named for name in names if name}
    assert {"demo", "test", "bench"} <= targets
    for target in targets:
        assert re.search(rf"^{target}:", makefile, flags=re.MULTILINE), target


def test_files_that_are_linked_or_shown_exist() -> None:
    targets = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r'src="([^"]+)"', README)
    files = [target for target in targets if not target.startswith(("https://", "#"))]
    assert len(files) > 5
    assert [file for file in files if not (ROOT / file).is_file()] == []


def test_the_rooms_are_those_of_the_library() -> None:
    listed = set(re.findall(r"^\| `drake_pose/(\w+)` \|", README, flags=re.MULTILINE))
    assert listed == {path.parent.name for path in (ROOT / "drake_pose").glob("*/__init__.py")}


def test_pictures_are_small() -> None:
    pictures = list((ROOT / "tutorials" / "pictures").glob("*.png"))
    assert {picture.name for picture in pictures} == {"demo.png", "woman.png"}
    assert sum(picture.stat().st_size for picture in pictures) < 200_000


def test_no_absolute_path() -> None:
    assert not re.search(r"(?<![\w.)/:])/(home|root|tmp|usr|work|Users|opt|var)/", README)
