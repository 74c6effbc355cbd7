"""Joint limits, couplings of joints, and the ranges that are searched and reported."""

import math
import re

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.body.parsed_model import covers_full_turn, mimic_warnings, nearest_turn, one_turn
from drake_pose.body.plant_source import Coupling
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.errors import ModelError, UnknownNameError
from tests.body.models import JOINTS_SDF, joint, link, urdf, write

FULL = 2.0 * math.pi


def one_joint(tmp_path, limits, kind="revolute", given=None, mount="fixed"):
    """Two links with a joint between them; limits are URDF attributes."""
    text = urdf(
        link("a"),
        link("b"),
        joint("mount", mount, "world", "a"),
        joint("j", kind, "a", "b", limits=limits),
    )
    return load_model(write(tmp_path, text), limits=given, check=False)


WIDE = 'lower="-1e16" upper="1e16"'


def test_limits_that_are_searched_ignored_or_refused(tmp_path):
    """Angles more than four turns apart turn freely; slides need limits once they are searched."""
    turn, slide, half = "revolute", "prismatic", (-math.pi, math.pi)
    for kind, limits, given, found, word in (
        ("continuous", None, None, half, None),
        (turn, None, None, half, None),
        (turn, WIDE, None, half, "1e+16 rad.*turn freely"),
        (turn, 'lower="-12.6" upper="12.6"', None, half, "12.6 rad.*turn freely"),
        (turn, 'lower="-12.56" upper="12.56"', None, (-12.56, 12.56), None),
        ("continuous", None, (-500.0, 500.0), half, "500"),
        (turn, WIDE, (-0.5, 0.25), (-0.5, 0.25), None),
        (turn, 'lower="1" upper="1"', None, (1.0, 1.0), None),
        (slide, WIDE, None, (-np.inf, np.inf), "1e[+]16 m"),
        (slide, None, None, (-np.inf, np.inf), None),
        (slide, 'upper="1"', None, (-np.inf, np.inf), None),
        (slide, 'lower="0" upper="1000"', None, (0.0, 1000.0), None),
        (slide, 'lower="0" upper="1001"', None, (-np.inf, np.inf), "ignored"),
    ):
        model = one_joint(tmp_path, limits, kind, given and {"j": given})
        np.testing.assert_allclose([model.lower[0], model.upper[0]], found)
        is_free = found == half or np.isinf(found[0])
        assert model.is_unlimited_angle[0] == (is_free and kind != slide)
        told = [one for one in model.warnings if "joint 'j'" in one]
        assert len(told) == (word is not None)
        assert word is None or re.search(word.replace("e+", "e[+]"), told[0])
        if found == half:
            grid = model.pose_tree().grid(1, math.radians(20.0))
            assert (len(grid), np.abs(grid).max() <= math.pi + 1e-9) == (18, True)
    for kind, limits, given, word in (
        (slide, WIDE, None, "joint 'j' has no limits, or limits too wide"),
        (slide, 'lower="0" upper="5000"', None, r"'j' .*limits={'j': \(low, high\)}"),
        (turn, 'lower="-1"', None, r"joint 'j' has no limits: .*upper inf \[rad\]"),
        (turn, None, {"j": (2.0, 1.0)}, "joint 'j': lower limit 2 is above upper"),
        (turn, None, {"j": (np.nan, 1.0)}, "joint 'j': .*NaN"),
    ):
        with pytest.raises(ModelError, match=word):
            one_joint(tmp_path, limits, kind, given, mount="revolute").pose_tree()
    with pytest.raises(UnknownNameError, match="'nose'"):
        one_joint(tmp_path, None, given={"nose": (0.0, 1.0)})


def test_searched_turn_is_inside_limits_about_the_default(tmp_path):
    """A joint without a default position has 0, moved inside its limits."""
    for limits, turn in (
        ((-3.1, 3.1), (-3.1, 3.1)),
        ((-math.pi, math.pi), (-math.pi, math.pi)),
        ((-math.pi, 3 * math.pi), (-math.pi, math.pi)),
        ((-1.0, 9.0), (-1.0, FULL - 1.0)),
        ((-9.0, 0.5), (0.5 - FULL, 0.5)),
        ((2.0, 2.0 + 1.5 * FULL), (2.0, 2.0 + FULL)),
    ):
        model = one_joint(tmp_path, f'lower="{limits[0]!r}" upper="{limits[1]!r}"')
        tree = model.pose_tree()
        np.testing.assert_allclose(np.ravel(tree.value_limits(1)), limits)
        np.testing.assert_allclose(np.ravel(tree.value_bounds(1)), turn, atol=1e-9)
        around = limits[1] - limits[0] > FULL - 1e-9
        assert tree.covers_full_turn(1).all() == around
        assert not model.pose_tree(held={"j": turn[1]}).covers_full_turn(1).any()
        kinematics = TreeKinematics(tree)
        reach = (-np.inf, np.inf) if around else limits
        assert (kinematics.lower[0], kinematics.upper[0]) == reach
        grid = tree.grid(1, math.radians(20.0))[:, 0]
        assert turn[0] - 1e-9 <= grid.min() <= grid.max() <= turn[1] + 1e-9
        directions = np.unique(np.round(np.degrees(grid) % 360.0, 6) % 360.0)
        assert len(directions) == len(grid) == (18 if around else 17)


def test_screw_is_not_periodic(tmp_path):
    three_turns = JOINTS_SDF.replace(">-3</lower><upper>3<", ">-9</lower><upper>9<")
    model = load_model(write(tmp_path, three_turns, "m.sdf"), check=False)
    named = [model.periodic[model.position_index(name)] for name in ("screw", "turn")]
    assert named == [False, True]
    tree = model.pose_tree()
    node = next(i for i, one in enumerate(tree.nodes) if "screw" in one.value_names)
    column = tree.nodes[node].value_names.index("screw")
    assert not tree.covers_full_turn(node)[column]
    np.testing.assert_allclose(np.unique(tree.grid(node, 1.0)[:, column]), np.arange(-9.0, 10.0))
    bare = JOINTS_SDF.replace(
        "<limit><lower>-3</lower><upper>3</upper><effort>0</effort></limit>", ""
    )
    model = load_model(write(tmp_path, bare, "m.sdf"), check=False)
    assert any("'screw' is a screw without limits" in warning for warning in model.warnings)


def test_turns_that_are_within_limits_are_the_nearest_ones(tmp_path):
    kinematics = TreeKinematics(one_joint(tmp_path, f'lower="{-FULL}" upper="{FULL}"').pose_tree())
    for value in np.random.default_rng(3).uniform(-30.0, 30.0, 40):
        found = kinematics.within_limits(np.array([value]))[0]
        assert abs(found) <= FULL + 1e-9
        assert math.remainder(found - value, FULL) == pytest.approx(0.0, abs=1e-9)
        assert found == value or abs(value) > FULL


def test_turns_by_brute_force():
    rng = np.random.default_rng(0)
    for low, width, near in rng.uniform((-9.0, 0.0, -15.0), (9.0, 20.0, 15.0), (200, 3)):
        found = one_turn(low, low + width, near)
        starts = np.linspace(low, max(low + width - FULL, low), 2001)
        middles = starts + 0.5 * min(FULL, width)
        assert found[1] - found[0] == pytest.approx(min(FULL, width))
        best = starts[np.argmin(np.abs(middles - near))]
        assert found[0] == pytest.approx(best, abs=0.01)
        turned = float(nearest_turn(np.array(low), np.array(near), True))
        assert abs(turned - near) <= math.pi + 1e-9
        assert math.remainder(turned - low, FULL) == pytest.approx(0.0, abs=1e-9)
    periodic = np.array([True, False])
    np.testing.assert_allclose(nearest_turn(np.full(2, 7.0), np.zeros(2), periodic), [7 - FULL, 7])
    ends = np.array([FULL, FULL - 1e-10, FULL - 1e-8, FULL])
    known = np.array([True, True, True, False])
    assert covers_full_turn(np.zeros(4), ends, known).tolist() == [True, True, False, False]


def coupled(tmp_path, limits, relations):
    """A hand whose first joint leads the others, with limits and (multiplier, offset) of each."""
    names = [f"j{k}" for k in range(len(limits))]
    mimic = '<mimic joint="j0" multiplier="{}" offset="{}"/>'
    parts = [link("world", ""), link("palm"), joint("mount", "fixed", "world", "palm", limits=None)]
    for name, ends, more in zip(names, limits, [None, *relations], strict=True):
        given = None if ends is None else f'lower="{ends[0]}" upper="{ends[1]}"'
        extra = mimic.format(*more) if more else ""
        kind = "continuous" if ends is None else "revolute"
        parts += [link(name), joint(name, kind, "palm", name, limits=given, more=extra)]
    return load_model(write(tmp_path, urdf(*parts)), check=False)


@pytest.mark.parametrize("seed", range(8))
def test_couplings_intersect_limits(tmp_path, seed):
    """By brute force: the leader keeps the values at which all are within their limits."""
    rng = np.random.default_rng(seed)
    limits = [(-1.5, 2.0), *rng.uniform((-2.0, 0.3), (-0.3, 2.0), (3, 2))]
    limits[seed % 4] = None if seed % 2 else limits[seed % 4]
    relations = np.column_stack([rng.choice([-2.0, -1.0, 0.5, 1.0], 3), rng.uniform(-0.1, 0.1, 3)])
    model = coupled(tmp_path, limits, relations.tolist())
    values = np.linspace(-4.0, 4.0, 80_001)
    inside = np.ones(len(values), dtype=bool)
    for ends, (factor, offset) in zip(limits, [(1.0, 0.0), *relations], strict=True):
        followed = factor * values + offset
        inside &= True if ends is None else (followed >= ends[0]) & (followed <= ends[1])
    low, high = values[inside][[0, -1]]
    np.testing.assert_allclose([model.lower[0], model.upper[0]], [low, high], atol=2e-4)
    for k, (factor, offset) in enumerate(relations, 1):
        ends = np.sort(factor * np.array([low, high]) + offset)
        np.testing.assert_allclose([model.lower[k], model.upper[k]], ends, atol=5e-4)
        assert model.default_positions[k] == pytest.approx(
            factor * model.default_positions[0] + offset
        )
    assert not model.is_unlimited_angle.any()
    assert model.periodic[0] == all(float(factor).is_integer() for factor, _ in relations)


@pytest.mark.parametrize("seed", range(4))
def test_chains_of_couplings_are_all_followed(tmp_path, seed):
    """In whatever order they stand: each position keeps its relation to the one that it follows."""
    rng = np.random.default_rng(seed)
    relations = {k: (int(rng.integers(k)), *rng.uniform(0.5, 2.0, 2)) for k in range(1, 6)}
    parts = [link("world", ""), *(link(f"l{k}") for k in range(6))]
    for k in rng.permutation(6):
        j, factor, offset = relations.get(k, (0, 0.0, 0.0))
        more = f'<mimic joint="j{j}" multiplier="{-factor}" offset="{offset}"/>' if k else ""
        ends = 'lower="-99" upper="99"'
        parts.append(joint(f"j{k}", "prismatic", "world", f"l{k}", limits=ends, more=more))
    model = load_model(write(tmp_path, urdf(*parts)), check=False)
    q = rng.uniform(-1.0, 1.0, 6)
    leader = model.position_index("j0")
    for follower, own, multiplier, offset in model.couplings:
        assert own == leader
        q[follower] = multiplier * q[own] + offset
    for k, (j, factor, offset) in relations.items():
        followed = -factor * q[model.position_index(f"j{j}")] + offset
        assert q[model.position_index(f"j{k}")] == pytest.approx(followed)


def test_couplings_of_turning_joints_and_of_limits_that_exclude_each_other(tmp_path):
    free = coupled(tmp_path, [None, None], [(2.0, 0.3)])
    assert free.is_unlimited_angle.all()
    np.testing.assert_allclose(free.upper, [math.pi, FULL + 0.3])
    # A follower whose limits leave one value has lost them, unless its leader is fixed itself.
    model = coupled(tmp_path, [(0.0, 1.0), (-1.0, 0.0)], [(1.0, 0.0)])
    np.testing.assert_allclose(model.upper, 1.0)
    assert re.search("'j1' follows joint 'j0'.*only 0: the follower's limits", model.warnings[0])
    assert not coupled(tmp_path, [(0.5, 0.5), (-1.0, 1.0)], [(1.0, 0.0)]).warnings
    with pytest.raises(ModelError, match=r"'j1' follows joint 'j0'.*leave no value"):
        coupled(tmp_path, [(0.0, 1.0), (-1.0, -0.1)], [(1.0, 0.0)])
    mimics = [f'<mimic joint="j{1 - k}"/>' for k in range(2)]
    ring = [
        joint(f"j{k}", "revolute", ("world", "a")[k], "ab"[k], more=mimics[k]) for k in range(2)
    ]
    loop = urdf(link("world", ""), link("a"), link("b"), *ring)
    with pytest.raises(ModelError, match="coupled in two ways"):
        load_model(write(tmp_path, loop), check=False)


def test_positions_that_do_not_follow_are_named():
    follower, spans = Coupling(1, 0, 2.0, 0.1), np.array([2.0, 0.5])
    for off, told in ((0.0, False), (0.049, False), (-0.051, True), (np.nan, False)):
        q = np.array([[0.2, 0.5], [0.3, 0.7 + off]])
        for rows in (q, q[1]):
            assert bool(mimic_warnings("ab", [follower], rows, spans)) == told
    for end, count in ((0.19, 0), (0.3, 1)):
        found = mimic_warnings("ab", [follower], np.array([0.0, end]), np.full(2, 9.0))
        assert ["'b' is written to follow joint 'a'" in one for one in found] == [True] * count
