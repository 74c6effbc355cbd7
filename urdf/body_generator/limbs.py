"""Shapes of the limbs of the left side, each in its link frame [m]."""

import numpy as np

from .measures import Build, Measures, joint_positions
from .shapes import EllipsoidBump, Loft, Section, Shell, SwellingBump

SLEEVE = 0.30  # end of the shirt's sleeve, as a fraction of the upper arm
HEM = 0.55  # end of the shorts, as a fraction of the thigh


def _limb_section(
    end: np.ndarray,
    share: float,
    girth: float,
    shape: tuple[float, float, float, float],
    shift: tuple[float, float] = (0.0, 0.0),
) -> Section:
    """Return a section of a limb from the origin to end (3,).

    Args:
        end: position of the next joint [m].
        share: place on the limb, 0 at the origin, 1 at the end.
        girth: circumference [m].
        shape: radii outward, inward, forward and backward; only their ratios count.
        shift: of the section's axis, outward and forward [m].
    """
    centre = end * share
    section = Section(centre[1], *shape, centre[0] + shift[0], centre[2] + shift[1])
    return section.scaled_to_girth(girth)


def _rings(end: np.ndarray, count: int, share: float) -> list[float]:
    """Return `count` heights evenly spaced over a limb, and the one at the fraction `share` [m]."""
    even = np.linspace(0.0, 1.0, count)
    even = even[np.abs(even - share) > 0.02]
    return [float(end[1] * t) for t in (*even, share)]


def upper_arm(m: Measures, build: Build) -> list[Shell]:
    """Return the left upper arm: deltoid outside, biceps in front, triceps behind."""
    joints = joint_positions(m)
    end = joints["forearm"] - joints["upper_arm"]
    s = m.stature / 1.6285
    girth = 0.95 * m.bicepscircumferenceflexed
    elbow = 0.84 * girth
    out = 0.5 * m.bideltoidbreadth - joints["upper_arm"][0]
    sections = [
        _limb_section(end, 0.0, 0.94 * girth, (0.94, 0.94, 1.0, 1.02), (-0.004 * s, 0.0)),
        _limb_section(end, 0.16, 1.07 * girth, (1.00, 0.86, 1.05, 1.08), (0.002 * s, 0.0)),
        _limb_section(end, 0.36, 1.02 * girth, (0.92, 0.88, 1.08, 1.14), (0.0, -0.001 * s)),
        _limb_section(end, 0.55, 1.0 * girth, (0.88, 0.90, 1.18, 1.06), (0.0, 0.003 * s)),
        _limb_section(end, 0.78, 0.90 * girth, (0.98, 0.96, 1.08, 0.98), (0.0, 0.002 * s)),
        _limb_section(end, 0.92, 0.86 * girth, (1.08, 1.08, 0.95, 0.95)),
        _limb_section(end, 1.0, elbow, (1.06, 1.06, 0.96, 0.96)),
    ]
    deltoid = EllipsoidBump(
        (0.32 * out, 0.20 * end[1], -0.001 * s), (0.68 * out, 0.085 * s, 0.044 * s), 0.03 * s
    )
    biceps = SwellingBump(
        (0.5 * end[0], 0.58 * end[1], 0.05 * s),
        (0.025 * s, 0.05 * s, 0.03 * s),
        0.004 * s * build.muscle,
    )
    triceps = SwellingBump(
        (0.4 * end[0], 0.42 * end[1], -0.05 * s),
        (0.03 * s, 0.05 * s, 0.03 * s),
        0.004 * s * build.muscle,
    )
    radius = elbow / (2.0 * np.pi)
    loft = Loft(
        sections,
        rings=_rings(end, 14, SLEEVE),
        low_cap=radius,
        high_cap=0.54 * girth / (2.0 * np.pi),
        angles=18,
        bumps=[deltoid, biceps, triceps],
        cap_rings=5,
    )
    return [loft.shell("skin").painted_above(SLEEVE * end[1], "suit")]


def forearm(m: Measures, build: Build) -> list[Shell]:
    """Return the left forearm: full below the elbow, flat at the wrist, thumb edge forward."""
    joints = joint_positions(m)
    end = joints["hand"] - joints["forearm"]
    s = m.stature / 1.6285
    elbow = 0.95 * 0.84 * m.bicepscircumferenceflexed
    full = 0.97 * m.forearmcircumferenceflexed
    sections = [
        _limb_section(end, 0.0, 0.99 * elbow, (1.08, 1.06, 0.95, 0.97)),
        _limb_section(end, 0.12, full, (1.10, 1.00, 1.02, 0.92), (0.0, 0.001 * s)),
        _limb_section(end, 0.28, full, (1.06, 1.02, 1.10, 0.90), (0.0, 0.001 * s)),
        _limb_section(end, 0.55, 0.82 * full, (0.96, 0.98, 1.12, 0.94), (0.001 * s, 0.0)),
        _limb_section(
            end, 0.80, 0.5 * (0.72 * full + m.wristcircumference), (0.84, 0.88, 1.12, 1.04)
        ),
        _limb_section(end, 0.93, m.wristcircumference, (0.80, 0.80, 1.12, 1.10)),
        _limb_section(end, 1.0, 1.02 * m.wristcircumference, (0.80, 0.80, 1.12, 1.12)),
    ]
    outer = SwellingBump(
        (0.045 * s, 0.17 * end[1], 0.02 * s),
        (0.022 * s, 0.045 * s, 0.026 * s),
        0.004 * s * build.muscle,
    )
    point = SwellingBump((0.0, -0.004 * s, -0.04 * s), (0.014 * s, 0.016 * s, 0.02 * s), 0.004 * s)
    loft = Loft(
        sections,
        rings=15,
        low_cap=0.020 * s,
        high_cap=0.95 * elbow / (2.0 * np.pi),
        angles=18,
        bumps=[outer, point],
        cap_rings=4,
    )
    return [loft.shell("skin")]


def thigh(m: Measures, build: Build) -> list[Shell]:
    """Return the left thigh: quadriceps forward, adductors inward, hamstrings behind."""
    joints = joint_positions(m)
    end = joints["shin"] - joints["thigh"]
    s = m.stature / 1.6285
    top, low = m.thighcircumference, m.lowerthighcircumference
    knee = 0.93 * low
    sections = [
        _limb_section(end, 0.0, 0.93 * top, (0.94, 0.88, 0.98, 1.12), (-0.002 * s, 0.002 * s)),
        _limb_section(end, 0.16, top, (0.96, 0.94, 1.02, 1.16), (0.0, -0.004 * s)),
        _limb_section(end, 0.34, 0.95 * top, (0.95, 0.91, 1.10, 1.08), (0.0, 0.002 * s)),
        _limb_section(end, 0.55, 0.83 * top, (0.97, 0.90, 1.16, 0.98), (0.0, 0.006 * s)),
        _limb_section(end, 0.75, 0.5 * (0.74 * top + 1.06 * low), (0.98, 0.96, 1.06, 0.98)),
        _limb_section(end, 0.88, low, (1.00, 0.98, 1.02, 0.98)),
        _limb_section(end, 1.0, knee, (0.98, 0.98, 1.0, 0.96)),
    ]
    inner_knee = SwellingBump(
        (end[0] - 0.05 * s, 0.88 * end[1], 0.02 * s), (0.03 * s, 0.035 * s, 0.03 * s), 0.005 * s
    )
    loft = Loft(
        sections,
        rings=_rings(end, 17, HEM),
        low_cap=0.95 * knee / (2.0 * np.pi),
        high_cap=0.90 * top / (2.0 * np.pi),
        angles=20,
        bumps=[inner_knee],
        cap_rings=5,
    )
    return [loft.shell("skin").painted_above(HEM * end[1], "shorts")]


def shin(m: Measures, build: Build) -> list[Shell]:
    """Return the left shin: kneecap and sharp edge in front, calf behind, malleoli below."""
    joints = joint_positions(m)
    end = joints["foot"] - joints["shin"]
    s = m.stature / 1.6285
    knee, calf, ankle = 0.91 * m.lowerthighcircumference, m.calfcircumference, m.anklecircumference
    sections = [
        _limb_section(end, 0.0, knee, (1.00, 1.00, 0.98, 0.98)),
        _limb_section(end, 0.10, 0.95 * calf, (0.98, 0.98, 0.98, 1.02), (0.0, -0.002 * s)),
        _limb_section(end, 0.20, 0.985 * calf, (0.96, 1.02, 0.84, 1.20), (-0.001 * s, -0.004 * s)),
        _limb_section(end, 0.31, calf, (0.94, 1.04, 0.78, 1.26), (-0.001 * s, -0.005 * s)),
        _limb_section(end, 0.44, 0.93 * calf, (0.94, 1.00, 0.80, 1.22), (0.0, -0.005 * s)),
        _limb_section(end, 0.62, 0.76 * calf, (0.94, 0.96, 0.90, 1.10), (0.0, -0.003 * s)),
        _limb_section(end, 0.80, 1.02 * ankle, (0.92, 0.92, 0.98, 1.08), (0.0, -0.002 * s)),
        _limb_section(end, 0.90, ankle, (0.92, 0.92, 0.98, 1.12), (0.0, -0.002 * s)),
        _limb_section(end, 1.0, 0.97 * ankle, (0.96, 0.96, 1.00, 1.06)),
    ]
    ankle_x, ankle_y = float(end[0]), float(end[1])
    bumps = [
        SwellingBump((0.0, -0.002 * s, 0.058 * s), (0.022 * s, 0.022 * s, 0.03 * s), 0.007 * s),
        SwellingBump(
            (-0.035 * s, 0.27 * ankle_y, -0.05 * s),
            (0.022 * s, 0.05 * s, 0.03 * s),
            0.006 * s * build.muscle,
        ),
        SwellingBump(
            (0.03 * s, 0.22 * ankle_y, -0.05 * s),
            (0.022 * s, 0.045 * s, 0.03 * s),
            0.004 * s * build.muscle,
        ),
        SwellingBump(
            (ankle_x + 0.034 * s, ankle_y, -0.026 * s), (0.014 * s, 0.013 * s, 0.013 * s), 0.006 * s
        ),
        SwellingBump(
            (ankle_x - 0.034 * s, ankle_y + 0.008 * s, -0.016 * s),
            (0.014 * s, 0.013 * s, 0.013 * s),
            0.006 * s,
        ),
    ]
    loft = Loft(
        sections,
        rings=20,
        low_cap=0.9 * ankle / (2.0 * np.pi),
        high_cap=0.97 * knee / (2.0 * np.pi),
        angles=20,
        bumps=bumps,
        cap_rings=4,
    )
    return [loft.shell("skin")]
