from pathlib import Path

import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.files.settings import (
    parse_assignments,
    parse_boxes,
    parse_packages,
    parse_root_position,
    parse_root_rotation,
    percent,
)
from drake_pose.silhouette.pictures.scenes import select_frames
from tests.cli import run_command

FRAMES = ("0001", "0002", "0010", "still")


def test_fractions_are_stated_in_percent():
    assert (percent(0.12345), percent(1.0), percent(None)) == ("12.35 %", "100.00 %", "-")


def test_option_texts_are_parsed():
    assert parse_assignments(["a=1", "b=c=-2.5"]) == {"a": 1.0, "b=c": -2.5}
    assert parse_packages(["b=.", "c=/"]) == {"b": Path.cwd(), "c": Path("/")}
    assert parse_root_position("1,-2,0.5") == (1.0, -2.0, 0.5)
    assert parse_root_position("a/centres.csv:toe") == (Path("a/centres.csv"), "toe")
    assert parse_root_position("unknown") == "unknown"
    assert parse_root_rotation("fixed") == "fixed"
    assert parse_root_rotation("free") == "free"
    limits = parse_root_rotation("y=-180:180, x=-10:10")
    assert list(limits.items()) == [("y", (-180.0, 180.0)), ("x", (-10.0, 10.0))]
    assert parse_boxes(["1,2,9:4,-5,6"]) == (((1.0, -5.0, 6.0), (4.0, 2.0, 9.0)),)


BAD = {
    "--hold": ["a", "=1", "a=", "a=x", "a=nan", "a=inf"],
    "--root-position": ["1,2", "1,2,x", "centres.csv", ":joint", "centres.csv:"],
    "--root-rotation": ["", "w=0:1", "x=1", "x=0:1,x=0:1", "x=2:1", "x=a:b", "x=0:nan"],
    "--package": ["a", "=b", "a=nowhere"],
}


@pytest.mark.parametrize(("option", "text"), [(one, text) for one in BAD for text in BAD[one]])
def test_a_bad_option_text_names_the_option_in_one_line(option, text):
    done = run_command(["estimate", "a", "-m", "b", "-o", "c", option, text])
    assert done.exit_code == 2
    assert done.stderr.startswith(f"drake-pose: error: {option}: ")
    assert done.output.count("\n") == 1


@pytest.mark.parametrize(
    ("wanted", "selected"),
    [
        ([], FRAMES),
        (["2"], ("0002",)),
        (["0010", "1"], ("0001", "0010")),
        (["1:10"], ("0001", "0002", "0010")),
        (["0002:still"], ("0002", "0010", "still")),
    ],
)
def test_frames_are_selected_by_name_number_and_range(wanted, selected):
    assert select_frames(FRAMES, wanted, "scene") == selected


@pytest.mark.parametrize(
    ("frames", "text", "words"),
    [
        *((FRAMES, one, ", ".join(FRAMES)) for one in ("3", "0003", "moving", "1:7", "\u00b2")),
        (("1", "01"), "001", "1, 01"),
        (FRAMES, "10:1", "'10:1'"),
    ],
)
def test_unknown_or_ambiguous_frames_are_refused_with_a_list(frames, text, words):
    with pytest.raises((UnknownNameError, SettingsError), match=words):
        select_frames(frames, [text], "scene")


@pytest.mark.parametrize(
    ("parse", "texts"), [(parse_assignments, ["a=1", "a=2"]), (parse_packages, ["a=.", "a=/"])]
)
def test_a_name_given_twice_is_refused(parse, texts):
    with pytest.raises(SettingsError, match="'a' is given twice"):
        parse(texts)
