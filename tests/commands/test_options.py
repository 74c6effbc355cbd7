from pathlib import Path

import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.results.options import (
    parse_assignments,
    parse_root_position,
    parse_root_rotation,
    select_frames,
)

FRAMES = ("0001", "0002", "0010", "still")


def test_assignments_keep_equals_signs_in_names() -> None:
    assert parse_assignments(["a=1", "b=c=-2.5"], "--hold") == {"a": 1.0, "b=c": -2.5}


@pytest.mark.parametrize("text", ["a", "=1", "a=", "a=x", "a=nan", "a=inf"])
def test_bad_assignments_name_the_option(text: str) -> None:
    with pytest.raises(SettingsError, match="--hold"):
        parse_assignments([text], "--hold")


def test_a_name_given_twice_is_refused() -> None:
    with pytest.raises(SettingsError, match="'a' is given twice"):
        parse_assignments(["a=1", "a=2"], "--hold")


def test_root_position() -> None:
    assert parse_root_position("1,-2,0.5") == (1.0, -2.0, 0.5)
    assert parse_root_position("dir/centres.csv:left_ankle") == (
        Path("dir/centres.csv"),
        "left_ankle",
    )
    assert parse_root_position("unknown") == "unknown"


@pytest.mark.parametrize("text", ["1,2", "1,2,x", "centres.csv", ":joint", "centres.csv:"])
def test_bad_root_position(text: str) -> None:
    with pytest.raises(SettingsError, match="--root-position"):
        parse_root_position(text)


def test_root_rotation_keeps_the_order_of_the_axes() -> None:
    assert parse_root_rotation("fixed") == "fixed"
    assert parse_root_rotation("free") == "free"
    limits = parse_root_rotation("y=-180:180, x=-10:10")
    assert list(limits.items()) == [("y", (-180.0, 180.0)), ("x", (-10.0, 10.0))]


@pytest.mark.parametrize("text", ["", "w=0:1", "x=1", "x=0:1,x=0:1", "x=2:1", "x=a:b", "x=0:nan"])
def test_bad_root_rotation(text: str) -> None:
    with pytest.raises(SettingsError, match="--root-rotation"):
        parse_root_rotation(text)


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
def test_frames(wanted: list[str], selected: tuple[str, ...]) -> None:
    assert select_frames(FRAMES, wanted, "scene") == selected


@pytest.mark.parametrize("text", ["3", "0003", "moving", "1:7", "\N{SUPERSCRIPT TWO}"])
def test_unknown_frames_list_those_that_exist(text: str) -> None:
    with pytest.raises(UnknownNameError, match="0001, 0002, 0010, still"):
        select_frames(FRAMES, [text], "scene")


def test_two_frames_of_one_number_are_not_guessed_at() -> None:
    with pytest.raises(UnknownNameError):
        select_frames(("1", "01"), ["001"], "scene")


def test_a_range_that_ends_before_it_begins() -> None:
    with pytest.raises(SettingsError, match="'10:1'"):
        select_frames(FRAMES, ["10:1"], "scene")
