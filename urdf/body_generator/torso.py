"""Shapes of the chest and of the waist (belly, hips and buttocks), each in its link frame [m]."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from .measures import Build, Measures, joint_positions
from .shapes import (
    Bump,
    EllipsoidBump,
    Loft,
    Section,
    Shell,
    SwellingBump,
    ellipsoid,
    mirrored_angles,
)

TORSO_ANGLES = (0, 13, 26, 40, 55, 72, 90, 108, 125, 140, 154, 167, 180)


def _pair(bump: Bump) -> list[Bump]:
    """Return a bump and its mirror image."""
    x, y, z = bump.centre
    if isinstance(bump, EllipsoidBump):
        return [bump, EllipsoidBump((-x, y, z), bump.radii, bump.blend)]
    return [bump, SwellingBump((-x, y, z), bump.widths, bump.amount)]


def _section(y: float, half: float, front: float, back: float, power: float = 2.2) -> Section:
    """Return a symmetric section of half breadth `half` from z = back to z = front [m]."""
    z = 0.5 * (front + back)
    depth = front - z
    return Section(y, half, half, depth, depth, z=z, front_power=power, back_power=power)


def _in_link(loft_sections: Iterable[Section], origin_y: float) -> list[Section]:
    """Return sections with heights above the joint, given heights above the floor."""
    return [replace(section, y=section.y - origin_y) for section in loft_sections]


def _waist_sections(m: Measures, build: Build) -> list[Section]:
    """Return the torso from the navel to its narrowest place at the tenth rib, above the floor.

    Chest and waist share these sections, so that they join flush.
    """
    navel_half, navel_depth = 0.5 * m.waistbreadth, m.waistdepth
    joint = joint_positions(m)["waist"][1]
    low, high = m.waistheightomphalion, m.tenthribheight
    narrow = build.natural_waist
    sections = []
    for y, share in ((low, 1.0), (joint, 0.38 + 0.62 * narrow), (high, narrow)):
        depth = share * navel_depth
        lean = -0.006 * (y - low) / (high - low)
        sections.append(
            _section(y, share * navel_half, 0.50 * depth + lean, -0.50 * depth + lean, 2.55)
        )
    return sections


def _chest_front(m: Measures, build: Build) -> tuple[float, float]:
    """Return how far the ribs, without breasts, reach forward, and how far back [m]."""
    s = m.stature / 1.6285
    back = -0.118 * s
    return m.chestdepth + back - (0.052 * s if build.bust else 0.010 * s), back


def _chest_sections(m: Measures, build: Build) -> list[Section]:
    """Return ribs and shoulders from the hem to the collar, at heights above the floor."""
    s = m.stature / 1.6285
    origin = joint_positions(m)["chest"]
    _, seam, narrow = _waist_sections(m, build)
    hem = 0.002 * s  # the shirt hangs over the shorts
    ribs, shoulder = 0.5 * m.chestbreadth, 0.5 * m.biacromialbreadth
    front, back = _chest_front(m, build)
    neck, neck_z = m.neckcircumferencebase / 6.283, origin[2]
    top = m.acromialheight
    return [
        replace(seam, left=seam.left + hem, right=seam.right + hem, front=seam.front + hem),
        narrow,
        _section(
            0.45 * narrow.y + 0.55 * m.chestheight,
            0.5 * narrow.left + 0.49 * ribs,
            0.5 * (narrow.z + narrow.front + front) + 0.004 * s,
            0.5 * (narrow.z - narrow.back + back) - 0.003 * s,
        ),
        _section(m.chestheight, ribs, front, back, 2.7),
        _section(
            m.axillaheight - 0.012 * s,
            0.91 * ribs + 0.10 * shoulder,
            front - 0.006 * s,
            back - 0.002 * s,
            2.5,
        ),
        _section(
            m.axillaheight + 0.035 * s, 0.45 * ribs + 0.52 * shoulder, 0.056 * s, -0.116 * s, 2.4
        ),
        _section(top - 0.021 * s, 0.985 * shoulder, 0.040 * s, -0.098 * s, 2.3),
        _section(top - 0.004 * s, 0.92 * shoulder, 0.037 * s, -0.090 * s, 2.1),
        _section(top + 0.008 * s, 0.74 * shoulder, neck_z + 1.00 * neck, neck_z - 1.12 * neck, 2.0),
        _section(top + 0.017 * s, 0.53 * shoulder, neck_z + 0.97 * neck, neck_z - 1.12 * neck, 2.0),
        _section(origin[1], 1.12 * neck, neck_z + 0.92 * neck, neck_z - 1.10 * neck, 2.0),
    ]


def _chest_bumps(m: Measures, build: Build, y0: float) -> list[Bump]:
    """Return breasts or chest muscles, shoulder blades and the groove of the spine.

    Args:
        m: the measures.
        build: the build.
        y0: height of the link's origin [m].
    """
    s = m.stature / 1.6285
    front, back = _chest_front(m, build)
    bumps: list[Bump] = []
    if build.bust:
        bust = m.chestheight - y0
        reach = m.chestdepth + back
        bumps += _pair(
            EllipsoidBump(
                (0.073 * s, bust + 0.004 * s, reach - 0.058 * s),
                (0.058 * s, 0.068 * s, 0.058 * s),
                0.036 * s,
            )
        )
    else:
        bumps += _pair(
            EllipsoidBump(
                (0.066 * s, m.chestheight + 0.026 * s - y0, front - 0.042 * s),
                (0.064 * s, 0.062 * s, 0.043 * s),
                0.04 * s,
            )
        )
    blade_y = 0.5 * (m.axillaheight + m.chestheight) - y0
    bumps += _pair(
        SwellingBump(
            (0.08 * s, blade_y + 0.02 * s, -0.12 * s), (0.03 * s, 0.05 * s, 0.03 * s), 0.006 * s
        )
    )
    bumps.append(
        SwellingBump(
            (0.0, blade_y - 0.01 * s, -0.12 * s), (0.014 * s, 0.06 * s, 0.03 * s), -0.008 * s
        )
    )
    return bumps


def chest(m: Measures, build: Build) -> list[Shell]:
    """Return the chest: ribs, breasts, shoulder blades, shoulders sloping to the neck."""
    s = m.stature / 1.6285
    origin = joint_positions(m)["chest"]
    sections = _in_link(_chest_sections(m, build), origin[1])
    knots = [section.y for section in sections]
    loft = Loft(
        sections,
        rings=[*np.linspace(knots[0], knots[5], 16), *knots[6:]],
        low_cap=0.62 * _waist_sections(m, build)[1].left,
        high_cap=0.014 * s,
        angles=mirrored_angles(TORSO_ANGLES),
        bumps=_chest_bumps(m, build, origin[1]),
        cap_rings=4,
    )
    # The shoulders' balls keep the arms attached in every pose.
    ball = ellipsoid((0.0, -0.004 * s, 0.0), (0.034 * s, 0.026 * s, 0.034 * s), "suit", 8, 3)
    ball = ball.moved(joint_positions(m)["upper_arm"] - origin)
    return [loft.shell("suit").moved((0.0, 0.0, -origin[2])), ball, ball.mirrored()]


def waist(m: Measures, build: Build) -> list[Shell]:
    """Return belly, hips and buttocks, from the narrow waist down to the crotch."""
    s = m.stature / 1.6285
    joints = joint_positions(m)
    origin = joints["waist"]
    y0 = origin[1]
    belly, seam, _ = _waist_sections(m, build)
    navel, seat, crotch = m.waistheightomphalion, m.buttockheight, m.crotchheight
    hips = 0.5 * m.hipbreadth
    front_navel, back_navel = belly.z + belly.front, belly.z - belly.back
    front_hip, back_hip = 0.43 * m.buttockdepth, -0.50 * m.buttockdepth
    middle = 0.5 * (navel + seat)
    sections = [
        _section(crotch, 0.80 * hips, 0.70 * front_hip, 0.72 * back_hip),
        _section(0.5 * (crotch + seat), 0.95 * hips, 0.90 * front_hip, 0.94 * back_hip, 2.35),
        _section(seat, hips, front_hip, back_hip, 2.5),
        _section(seat + 0.35 * (navel - seat), 0.98 * hips, 1.04 * front_hip, back_hip, 2.7),
        _section(
            middle + 0.15 * (navel - seat),
            0.5 * (belly.left + hips),
            0.5 * (front_navel + 1.05 * front_hip),
            0.55 * back_navel + 0.45 * back_hip,
            2.7,
        ),
        belly,
        seam,
    ]
    hip_x = joints["thigh"][0]
    bumps: list[Bump] = []
    bumps += _pair(
        EllipsoidBump(
            (0.80 * hip_x, seat + 0.014 * s - y0, -0.57 * m.buttockdepth + 0.058 * s),
            (0.074 * s, 0.080 * s, 0.058 * s),
            0.030 * s,
        )
    )
    bumps.append(
        SwellingBump(
            (0.0, seat - 0.012 * s - y0, -0.13 * s), (0.011 * s, 0.05 * s, 0.05 * s), -0.016 * s
        )
    )
    loft = Loft(
        _in_link(sections, y0),
        rings=18,
        low_cap=0.028 * s,
        high_cap=0.42 * seam.left,
        angles=mirrored_angles(TORSO_ANGLES),
        bumps=bumps,
        cap_rings=4,
    )
    return [loft.shell("shorts").moved((0.0, 0.0, -origin[2]))]
