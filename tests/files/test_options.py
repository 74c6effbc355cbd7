import math
from pathlib import Path

import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.files.settings import (
    EstimateSettings,
    MaskSettings,
    changed,
    parse_assignments,
    parse_packages,
    parse_root_position,
    parse_root_rotation,
    plain,
    within,
)
from drake_pose.silhouette.pictures.scenes import select_frames
from tests.cli import run_command

FRAMES = ("0001", "0002", "0010", "still")


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


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"method": "person", "root": "a"}, "does not search poses; leave root out"),
        ({"method": "guess"}, "there is no method 'guess'; there is: auto, beam, paper, person"),
        ({"workers": 0}, "workers"),
        ({"cameras": 3}, "cameras must be names like"),
        ({"cameras": {"a": 1}}, "cameras must be names like"),
        ({"frames": ["a", 3]}, "frames must be names like"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(given, message):
    with pytest.raises(SettingsError, match=message):
        EstimateSettings(**given)


def test_single_names_and_lists_become_tuples_and_json_is_plain():
    one = EstimateSettings(
        cameras="left", frames=["1", "2"], packages={"b": Path("/x")}, workers=3,
        start=Path("s.csv"),
        root_rotation={"y": (-10.0, 20.0)},
    )  # fmt: skip
    assert (one.cameras, one.frames) == (("left",), ("1", "2"))
    told = one.as_json()
    assert "workers" not in told
    assert told["root_rotation"] == [["y", -10.0, 20.0]]
    assert (told["packages"], told["start"], told["frames"]) == ({"b": "/x"}, "s.csv", ["1", "2"])
    assert EstimateSettings(root_rotation="free").as_json()["root_rotation"] == "free"
    assert plain((Path("a"), [Path("b")], 3)) == ["a", ["b"], 3]
    # Options that are not at their defaults, of the search alone or of all.
    assert {*changed(one)} == {
        "cameras", "frames", "packages", "workers", "start", "root_rotation"
    }  # fmt: skip
    assert {*one.search_settings} == {"start", "root_rotation"}
    assert changed(EstimateSettings()) == ()


def test_classes_need_annotations():
    with pytest.raises(SettingsError, match="needs a COCO file"):
        MaskSettings(classes=("a",), background="median")
    assert MaskSettings(classes="a").classes == ("a",)
    assert MaskSettings(background=Path("b")).as_json() == {"background": "b"}


@pytest.mark.parametrize(
    ("bounds", "value", "wanted"),
    [
        ((1.0, 4.0), 0.9, "1 to 4"), ((1.0, 4.0), 4.1, "1 to 4"), ((1.0,), 0.5, "1 or more"),
        ((1.0,), math.inf, "1 or more"), ((1.0, 4.0), math.nan, "1 to 4"),
    ],
)  # fmt: skip
def test_only_numbers_out_of_bounds_are_refused(bounds, value, wanted):
    for accepted in (None, 1.0, 2.5, 4.0):
        within(1.0, 4.0).validator[0](None, accepted)
    with pytest.raises(ValueError, match=f"It must be {wanted}"):
        within(*bounds).validator[0](None, value)
