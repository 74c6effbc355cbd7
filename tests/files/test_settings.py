import math
from pathlib import Path

import pytest

from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.files import settings
from drake_pose.files.settings import (
    EstimateSettings,
    LiveSettings,
    MaskSettings,
    RegistrationSettings,
)
from drake_pose.silhouette.pictures.scenes import select_frames
from tests.cli import run_command

FRAMES = ("0001", "0002", "0010", "still")


def test_option_texts_are_parsed():
    for parse, given, expected in (
        (settings.parse_assignments, ["a=1", "b=c=-2.5"], {"a": 1.0, "b=c": -2.5}),
        (settings.parse_packages, ["b=.", "c=/"], {"b": Path.cwd(), "c": Path("/")}),
        (settings.parse_root_position, "1,-2,0.5", (1.0, -2.0, 0.5)),
        (settings.parse_root_position, "a/centres.csv:toe", (Path("a/centres.csv"), "toe")),
        (settings.parse_root_position, "unknown", "unknown"),
        (settings.parse_root_rotation, "fixed", "fixed"),
        (settings.parse_root_rotation, "free", "free"),
        (settings.parse_root_rotation, "y=-18:18, x=-1:1", {"y": (-18.0, 18.0), "x": (-1.0, 1.0)}),
    ):
        parsed = parse(given)
        assert parsed == expected
        assert [*parsed] == [*expected]


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
    ("frames", "text", "expected"),
    [
        (FRAMES, "2", ("0002",)), (FRAMES, "0010 1", ("0001", "0010")), (FRAMES, "", FRAMES),
        (FRAMES, "1:10", FRAMES[:3]), (FRAMES, "0002:still", FRAMES[1:]),
        *((FRAMES, one, ", ".join(FRAMES)) for one in ("3", "0003", "moving", "1:7", "\u00b2")),
        (("1", "01"), "001", "1, 01"), (FRAMES, "10:1", "'10:1'"),
    ],
)  # fmt: skip
def test_frames_are_selected_by_name_number_and_range(frames, text, expected):
    if isinstance(expected, tuple):
        assert select_frames(frames, text.split(), "scene") == expected
        return
    with pytest.raises((UnknownNameError, SettingsError), match=expected):
        select_frames(frames, [text], "scene")


def test_settings_that_exclude_each_other_are_refused():
    for make, message in (
        (lambda: settings.parse_assignments(["a=1", "a=2"]), "'a' is given twice"),
        (lambda: settings.parse_packages(["a=.", "a=/"]), "'a' is given twice"),
        (lambda: EstimateSettings(method="person", root="a"), "search poses; leave root out"),
        (lambda: EstimateSettings(method="guess"), "'guess'; there is: auto, beam, paper, person"),
        (lambda: RegistrationSettings(exports=("ros", "a")), "there is no export 'a'; there is: r"),
        (lambda: EstimateSettings(workers=0), "workers"),
        (lambda: EstimateSettings(cameras=3), "cameras must be names like"),
        (lambda: EstimateSettings(frames=["a", 3]), "frames must be names like"),
        (lambda: MaskSettings(classes=("a",), background="median"), "needs a COCO file"),
        (lambda: LiveSettings(seconds=0.0), "positive"),
        (lambda: LiveSettings(faces=Path("a")), "need each other"),
    ):
        with pytest.raises(SettingsError, match=message):
            make()


def test_single_names_and_lists_become_tuples_and_json_is_plain():
    more = {"start": Path("s.csv"), "root_rotation": {"y": (-10.0, 20.0)}}
    more |= {"packages": {"b": Path("/x")}}
    one = EstimateSettings(cameras="left", frames=["1", "2"], workers=3, **more)
    assert (one.cameras, one.frames) == (("left",), ("1", "2"))
    told = one.as_json()
    assert "workers" not in told
    assert told["root_rotation"] == [["y", -10.0, 20.0]]
    assert (told["packages"], told["start"], told["frames"]) == ({"b": "/x"}, "s.csv", ["1", "2"])
    assert EstimateSettings(root_rotation="free").as_json()["root_rotation"] == "free"
    # Options that are not at their defaults, of the search alone or of all.
    assert {*settings.changed(one)} == {"cameras", "frames", "workers", *more}
    assert {*one.search_settings} == {*more} - {"packages"}
    assert MaskSettings(classes="a").classes == ("a",)
    assert MaskSettings(background=Path("b")).as_json() == {"background": "b"}


def test_only_numbers_out_of_bounds_are_refused():
    for bounds, value, wanted in (
        ((1.0, 4.0), 0.9, "1 to 4"), ((1.0, 4.0), 4.1, "1 to 4"), ((1.0,), 0.5, "1 or more"),
        ((1.0,), math.inf, "1 or more"), ((1.0, 4.0), math.nan, "1 to 4"),
    ):  # fmt: skip
        for accepted in (None, 1.0, 2.5, 4.0):
            settings.within(1.0, 4.0).validator[0](None, accepted)
        with pytest.raises(ValueError, match=f"It must be {wanted}"):
            settings.within(*bounds).validator[0](None, value)
