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

DEGREE = np.pi / 180.0


def test_rows_of_the_hand_are_its_limits_and_those_of_table_1():
    """Of Shimada et al.: 3 differences of flexions, 7 of lengths. The palm has no limits."""
    hand = load_model(bundled_model("two_finger_hand"))
    rows, limits = model_inequalities(hand), from_model(hand)
    assert rows.rows[: len(limits)] == limits.rows
    assert len(limits) == 2 * (len(hand.position_names) - 7)
    bounds = {}
    for phi, b in zip(rows.phi[len(limits) :], rows.b[len(limits) :], strict=True):
        first, second = np.flatnonzero(phi)
        assert phi[second] == -phi[first]
        pair = rows.columns[first], rows.columns[second]
        bounds.setdefault(pair, {})["lower" if phi[first] < 0.0 else "upper"] = b / phi[first]
    assert len(bounds) == 10
    for first, second, lower, upper in (
        ("flexion_12", "flexion_13", -10 * DEGREE, 10 * DEGREE),
        ("flexion_22", "flexion_23", -10 * DEGREE, 10 * DEGREE),
        ("flexion_11", "flexion_21", -35 * DEGREE, 35 * DEGREE),
        ("length_21", "length_22", 0.0, 0.030),
        ("length_12", "length_13", -0.010, 0.010),
        ("length_13", "length_23", -0.005, 0.005),
    ):
        assert bounds[first, second] == pytest.approx({"lower": lower, "upper": upper})


@pytest.mark.parametrize(
    ("kind", "limits", "rows"),
    [
        ("revolute", (-1, 2), ("turn >= -1", "turn <= 2")),
        ("revolute", (-np.pi, np.pi + 3e-9), ("turn >= -3.14159", "turn <= 3.14159")),
        ("revolute", (-np.pi, np.pi), ()),
        ("revolute", (-1e16, 1e16), ()),
        ("continuous", None, ()),
        ("prismatic", (0, 2 * np.pi), ("turn >= 0", "turn <= 6.28319")),
    ],
)
def test_joints_that_turn_freely_have_no_rows(tmp_path, kind, limits, rows):
    limits = limits and f'lower="{limits[0]!r}" upper="{limits[1]!r}"'
    turn = joint("turn", kind, "base", "arm", limits=limits)
    model = load_model(write(tmp_path, urdf(link("base"), link("arm"), turn)), check=False)
    assert from_model(model).rows == rows
    if not rows:
        with pytest.warns(UserWarning, match="no joint has a limit"):
            model_inequalities(model)


def test_an_inner_point_is_far_from_all_rows_or_the_conflict_is_named():
    rows = from_bounds(["a", "b"], [0, -np.inf], [1, -5])
    np.testing.assert_allclose(inner_point(rows)[0], 0.5)
    triangle = make_inequalities(["a", "b"], "xyz", [[-1, 0], [0, -9], [3, 4]], [0, 0, 1.2])
    # The incircle of a triangle with sides 0.3, 0.4 and 0.5.
    np.testing.assert_allclose(inner_point(triangle), [0.1, 0.1])
    np.testing.assert_array_equal(inner_point(from_bounds(["a"], [-np.inf], [np.inf])), [0.0])
    with pytest.raises(SettingsError, match="leave no interior: b"):
        inner_point(from_bounds(["a", "b"], [0, 1], [1, 1]))
    parts = [
        from_bounds(["a", "b", "c"], [0, 0, 0], [1, 1, 1]),
        two_sided(["a", "b"], "a + b", [1, 1], 2.5, np.inf),
        two_sided(["b", "c"], "b - c", [1, -1], -0.5, 0.5),
    ]
    with pytest.raises(SettingsError, match="exclude each other") as caught:
        inner_point(stack(parts))
    names = ("a <= 1", "b <= 1", "a + b >= 2.5", "b - c", ">= 0")
    assert [name in str(caught.value) for name in names] == [True] * 3 + [False] * 2


def test_rows_for_other_columns():
    rows = from_bounds(["a", "b"], [0, 1], [2, 3])
    larger = rows.for_columns(["rate", "b", "a"])
    np.testing.assert_allclose(larger.margins([99, 1.5, 0.5]), rows.margins([0.5, 1.5]))
    assert rows.restricted_to(["b", "c"]).rows == ("b >= 1", "b <= 3")
    both = stack([rows, from_bounds(["c"], [-1], [np.inf])])
    assert (both.columns, both.rows[4:]) == (("a", "b", "c"), ("c >= -1",))
    assert len(stack([], ["a"])) == 0
    with pytest.raises(ValueError, match="read-only"):
        rows.phi[0, 0] = 1.0


def test_couplings_and_priors_are_read_with_units_for_known_columns(tmp_path):
    (tmp_path / "c.yaml").write_text(
        "rows: [{name: r, terms: {a: 2, b: 1}, lower: -90, unit: deg}]\n"
        "differences: [{first: b, second: a, within: 10, unit: mm},"
        " {first: a, second: b, upper: 1}]\n"
        "usual: [{name: r, terms: {b: 2, a: -1}, mean: 90, deviation: 45, unit: deg},"
        " {name: other, terms: {c: 1}, mean: 1, deviation: 1}]"
    )
    rows = load_couplings(tmp_path / "c.yaml", ["a", "b"])
    found = dict(zip(rows.rows, np.c_[rows.phi, rows.b].tolist(), strict=True))
    assert found == {
        "r >= -1.5708": pytest.approx([-2, -1, np.pi / 2]),
        "b - a >= -0.01": pytest.approx([1, -1, 0.01]),
        "b - a <= 0.01": pytest.approx([-1, 1, 0.01]),
        "a - b <= 1": [1, -1, 1],
    }
    usual = load_joint_prior(tmp_path / "c.yaml", ["a", "b"])
    np.testing.assert_allclose(usual.phi, [[-1, 2]])
    np.testing.assert_allclose([*usual.mean, *usual.deviation], [np.pi / 2, np.pi / 4])


KEYS = "a mapping of differences, rows, usual"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("differences: [{first: a, second: x, within: 1}]", "no joint 'x'"),
        ("differences: [{first: a, second: a, within: 1}]", "two different"),
        ("differences: [{first: a, second: b}]", "nothing is bounded"),
        ("differences: [{first: a, second: b, within: 1, lower: 0}]", "either within"),
        ("differences: [{first: a, second: b, within: 1, upper: 0}]", "either within"),
        ("differences: [{first: a, second: b, lower: 1, upper: 0}]", "a - b.*exceed"),
        ("differences: [{first: a, second: b, within: 1, unit: ft}]", "'ft'.*deg"),
        ("differences: [{first: a, other: b, within: 1}]", KEYS),
        ("rows: [{name: r, terms: {a: .nan}, upper: 1}]", "'r'.*finite"),
        ("rows: [{name: r, terms: {a: 1}, lower: .nan, upper: 1}]", "exceed"),
        ("- [", "not a YAML file"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1, deviation: 0}]", "positive"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1, deviation: .inf}]", "positive"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: .nan, deviation: 2}]", "mean"),
        ("usual: [{name: knuckle, terms: {a: 1}, mean: 1, deviation: 2, unit: ft}]", "'ft'"),
        ("usual: [{name: knuckle, terms: {a: 0}, mean: 1, deviation: 2}]", "terms"),
    ],
)
def test_invalid_couplings_files_are_refused_by_name(tmp_path, text, words):
    (tmp_path / "bad.couplings.yaml").write_text(text)
    load = load_joint_prior if text.startswith("usual") else load_couplings
    with pytest.raises((ModelError, UnknownNameError), match=rf"(?s)bad\.couplings\.yaml.*{words}"):
        load(tmp_path / "bad.couplings.yaml", ["a", "b"])


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: make_inequalities(["a"], ["r"], [[1.0]], [np.inf]), "'r'.*finite"),
        (lambda: make_inequalities(["a"], ["r"], [[np.nan]], [1.0]), "'r'.*finite"),
        (lambda: make_inequalities(["a"], ["r"], [[0.0]], [1.0]), "'r'.*zero"),
        (lambda: make_inequalities(["a"], ["r"], [[1.0]], [1.0, 2.0]), "as many"),
        (lambda: make_inequalities(["a"], ["r", "s"], [[1.0]], [1.0]), "as many"),
        (lambda: from_bounds(["a"], [2], [1]), "exceed"),
        (lambda: from_bounds(["a"], [np.nan], [1]), "exceed"),
        (lambda: from_bounds(["a"], [0], [1], ["b"]), "'a'"),
    ],
)
def test_invalid_arrays_are_refused_by_name(make, word):
    with pytest.raises((SettingsError, UnknownNameError), match=word):
        make()
