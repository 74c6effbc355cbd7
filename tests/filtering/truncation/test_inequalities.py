import subprocess
import sys

import numpy as np
import pytest

from drake_pose.body import bundled_model, load_model
from drake_pose.errors import ModelError, SettingsError, UnknownNameError
from drake_pose.filtering.inequalities import (
    from_bounds,
    from_model,
    inner_point,
    load_couplings,
    load_joint_prior,
    make_inequalities,
    model_inequalities,
    stack,
    two_sided,
)
from tests.body.models import joint, link, urdf, write
from tests.written_files import assert_same_files

HAND = bundled_model("two_finger_hand")
KEYS = "a mapping of differences, rows, usual"


@pytest.fixture(scope="module")
def hand():
    return load_model(HAND)


def test_each_joint_limit_of_the_hand_gives_two_named_rows(hand):
    rows = from_model(hand)
    # The palm floats and has no limits.
    assert hand.position_names[:7] == tuple(f"palm_{c}" for c in ("qw", "qx", "qy", "qz", *"xyz"))
    assert len(rows) == 2 * (len(hand.position_names) - 7)
    inside = np.r_[np.zeros(7), 0.5 * (hand.lower[7:] + hand.upper[7:])]
    assert (rows.margins(inside) > 0).all()
    for index, name in list(enumerate(hand.position_names))[7:]:
        beyond = inside.copy()
        beyond[index] = hand.upper[index] + 0.01
        margins = rows.margins(beyond)
        (k,) = np.flatnonzero(margins < 0)
        assert rows.rows[k].startswith(f"{name} <=")
        assert margins[k] == pytest.approx(-0.01)


def test_couplings_equal_table_1(hand):
    """Both bounds of each difference in table 1 of Shimada et al., and no others."""
    rows = model_inequalities(hand)
    # 10 two-sided couplings: 3 of flexions (2 pairs, one across), 2 + 2 + 3 of lengths.
    assert len(rows) == 2 * (len(hand.position_names) - 7) + 20
    bounds = {}
    for phi, b in zip(rows.phi, rows.b, strict=True):
        first, *second = np.flatnonzero(phi)
        if second:
            assert phi[second] == [-phi[first]]
            pair = rows.columns[first], rows.columns[second[0]]
            bounds.setdefault(pair, {})["lower" if phi[first] < 0.0 else "upper"] = b / phi[first]
    assert len(bounds) == 10
    degree = np.pi / 180
    for first, second, lower, upper in (
        ("flexion_12", "flexion_13", -10 * degree, 10 * degree),
        ("flexion_22", "flexion_23", -10 * degree, 10 * degree),
        ("flexion_11", "flexion_21", -35 * degree, 35 * degree),
        ("length_21", "length_22", 0.0, 0.030),
        ("length_12", "length_13", -0.010, 0.010),
        ("length_13", "length_23", -0.005, 0.005),
    ):
        assert bounds[first, second] == pytest.approx({"lower": lower, "upper": upper})


def test_free_joints_have_no_rows_and_models_without_rows_warn(tmp_path):
    parts = [link(name) for name in ("base", "free", "limited")]
    turns = joint("turns", "continuous", "base", "free", limits=None)
    bends = joint("bends", "revolute", "base", "limited", limits='lower="-1" upper="2"')
    file = write(tmp_path, urdf(*parts, turns, bends))
    assert from_model(load_model(file)).rows == ("bends >= -1", "bends <= 2")
    bends = joint("bends", "continuous", "base", "limited", limits=None)
    file = write(tmp_path, urdf(*parts, turns, bends))
    with pytest.warns(UserWarning, match="no joint has a limit"):
        assert len(model_inequalities(load_model(file))) == 0


def test_only_the_conflicting_rows_are_named():
    rows = stack(
        [
            from_bounds(["a", "b", "c"], [0, 0, 0], [1, 1, 1]),
            two_sided(["a", "b"], "a + b", [1, 1], 2.5, np.inf),
            two_sided(["b", "c"], "b - c", [1, -1], -0.5, 0.5),
        ]
    )
    with pytest.raises(SettingsError, match="exclude each other") as caught:
        inner_point(rows)
    names = ("a <= 1", "b <= 1", "a + b >= 2.5", "b - c", ">= 0")
    assert [name in str(caught.value) for name in names] == [True] * 3 + [False] * 2


def test_inner_point_is_strictly_inside_or_refused():
    with pytest.raises(SettingsError, match="leave no interior"):
        inner_point(from_bounds(["a", "b"], [0, 1], [1, 1]))
    rows = from_bounds(["a", "b"], [0, -np.inf], [1, -5])
    assert (rows.margins(inner_point(rows)) > 0).all()
    np.testing.assert_array_equal(inner_point(from_bounds(["a"], [-np.inf], [np.inf])), [0.0])


def test_rows_for_other_columns():
    rows = from_bounds(["a", "b"], [0, 1], [2, 3])
    larger = rows.for_columns(["rate", "b", "a"])
    np.testing.assert_allclose(larger.margins([99, 1.5, 0.5]), rows.margins([0.5, 1.5]))
    assert rows.restricted_to(["b", "c"]).rows == ("b >= 1", "b <= 3")
    with pytest.raises(UnknownNameError, match="'a'"):
        rows.for_columns(["b"])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("differences: [{first: a, second: x, within: 1}]", "no joint 'x'"),
        ("differences: [{first: a, second: a, within: 1}]", "two different"),
        ("differences: [{first: a, second: b}]", "nothing is bounded"),
        ("differences: [{first: a, second: b, within: 1, lower: 0}]", "either within"),
        ("differences: [{first: a, second: b, lower: 1, upper: 0}]", "a - b.*exceed"),
        ("differences: [{first: a, second: b, within: 1, unit: ft}]", "'ft'.*deg"),
        ("differences: [{first: a, other: b, within: 1}]", KEYS),
        ("rows: [{name: r, terms: {a: .nan}, upper: 1}]", "'r'.*finite"),
        ("rows: 3", KEYS),
        ("- [", "not a YAML file"),
        ("3", KEYS),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1}]", "deviation"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1, deviation: -2}]", "positive"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: .nan, deviation: 2}]", "mean"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1, deviation: 2, unit: ft}]", "'ft'"),
        ("usual: [{name: knuckle, terms: {a: 0}, mean: 1, deviation: 2}]", "terms"),
        ("usual: [{name: knuckle, terms: {}, mean: 1, deviation: 2}]", "terms"),
        ("usual: [{name: knuckle, terms: {a: 1}, about: 1, deviation: 2}]", KEYS),
    ],
)
def test_invalid_couplings_files_are_refused_by_name(tmp_path, text, words):
    file = tmp_path / "bad.couplings.yaml"
    file.write_text(text)
    load = load_joint_prior if text.startswith("usual") else load_couplings
    with pytest.raises((ModelError, UnknownNameError), match=f"(?s){words}") as caught:
        load(file, ["a", "b"])
    assert "bad.couplings.yaml" in str(caught.value)


def test_units_of_couplings(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text("rows: [{name: r, terms: {a: 2, b: 1}, lower: -90, unit: deg}]")
    rows = load_couplings(file, ["a", "b"])
    np.testing.assert_allclose(rows.phi, [[-2, -1]])
    np.testing.assert_allclose(rows.b, [np.pi / 2])


def test_joint_prior_is_read_with_units_and_for_known_columns(tmp_path):
    file = tmp_path / "c.yaml"
    file.write_text(
        "usual: [{name: r, terms: {b: 2, a: -1}, mean: 90, deviation: 45, unit: deg},"
        " {name: other, terms: {c: 1}, mean: 1, deviation: 1}]"
    )
    usual = load_joint_prior(file, ["a", "b"])
    np.testing.assert_allclose(usual.phi, [[-1, 2]])
    np.testing.assert_allclose(usual.mean, [np.pi / 2])
    np.testing.assert_allclose(usual.deviation, [np.pi / 4])
    assert len(load_couplings(file, ["a", "b"])) == 0


def test_invalid_arrays_are_refused():
    for phi, b, word in (
        (1.0, [np.inf], r"'r'.*finite"), (0.0, [1.0], r"'r'.*zero"), (0.0, [1.0, 2.0], "as many"),
    ):  # fmt: skip
        with pytest.raises(SettingsError, match=word):
            make_inequalities(["a"], ["r"], [[phi]], b)
    with pytest.raises(SettingsError, match="exceed"):
        from_bounds(["a"], [2], [1])


def test_the_hands_files_equal_its_scripts_output(tmp_path):
    script = HAND.parent / "make_two_finger_hand.py"
    subprocess.run([sys.executable, str(script), "--out", str(tmp_path)], check=True)
    assert {path.name for path in tmp_path.iterdir()} == {
        "two_finger_hand.urdf",
        "two_finger_hand.couplings.yaml",
    }
    assert_same_files(tmp_path, HAND.parent)
