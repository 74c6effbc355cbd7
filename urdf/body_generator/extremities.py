"""Shapes of the left hand and the left foot, each in its link frame [m]."""

import numpy as np
from numpy.typing import ArrayLike

from .measures import Build, Measures
from .shapes import EllipsoidBump, Loft, Section, Shell, SwellingBump

# Lengths and breadths of index, middle, ring and little finger, over the middle finger's length and
# the mean breadth: chosen by the look of a hand.
FINGER_LENGTHS = (0.91, 1.0, 0.93, 0.74)
FINGER_BREADTHS = (1.0, 1.02, 0.96, 0.86)
# Shift of each relaxed fingertip towards the palm, as a fraction of the finger's length.
FINGER_CURLS = (0.14, 0.18, 0.22, 0.26)


def _digit(
    base: ArrayLike,
    direction: ArrayLike,
    length: float,
    radius: float,
    curl: float,
    bend: ArrayLike,
) -> Shell:
    """Return a finger or thumb.

    Args:
        base: (3,) middle of the root [m].
        direction: (3,) from root to tip.
        length: from root to tip [m].
        radius: at the root [m]; 0.78 of it at the tip.
        curl: shift of the tip along `bend` [m].
        bend: (3,) direction of the curl.
    """
    shares = np.array([0.0, 0.3, 0.5, 0.75, 1.0])
    sizes = np.array([1.0, 0.97, 0.98, 0.88, 0.78]) * radius
    along = length - sizes[-1]
    sections = [
        Section(-along * t, r, r, 0.94 * r, 0.90 * r, z=curl * t**2)
        for t, r in zip(shares, sizes, strict=True)
    ]
    loft = Loft(sections, rings=6, low_cap=sizes[-1], high_cap=radius, angles=8, cap_rings=2)
    down = np.asarray(direction, dtype=float)
    y = -down / np.linalg.norm(down)
    z = np.asarray(bend, dtype=float)
    z = z - y * (z @ y)
    z /= np.linalg.norm(z)
    frame = np.stack([np.cross(y, z), y, z], axis=1)
    return loft.shell("skin").transformed(frame).moved(base)


def hand(m: Measures, build: Build) -> list[Shell]:
    """Return the hanging left hand: palm inward, thumb forward, fingers slightly bent."""
    half = 0.5 * m.handbreadth
    palm = m.palmlength
    s = m.handlength / 0.1811
    thick = 0.0135 * s
    wrist = 0.975 * m.wristcircumference / (2.0 * np.pi)
    sections = [
        Section(0.010 * s, 0.80 * wrist, 0.80 * wrist, 1.14 * wrist, 1.12 * wrist),
        Section(-0.008 * s, 0.80 * wrist, 0.80 * wrist, 1.14 * wrist, 1.12 * wrist),
        Section(-0.30 * palm, 1.05 * thick, 1.25 * thick, 0.86 * half, 0.88 * half),
        Section(-0.60 * palm, 0.95 * thick, 1.05 * thick, 0.97 * half, 0.95 * half),
        Section(-0.80 * palm, 0.84 * thick, 0.86 * thick, 1.00 * half, 0.98 * half),
        Section(-0.93 * palm, 0.66 * thick, 0.72 * thick, 0.95 * half, 0.92 * half),
    ]
    thenar = EllipsoidBump(
        (-0.009 * s, -0.36 * palm, 0.55 * half), (0.014 * s, 0.034 * s, 0.020 * s), 0.012 * s
    )
    hypothenar = SwellingBump(
        (-0.015 * s, -0.45 * palm, -0.6 * half), (0.012 * s, 0.025 * s, 0.012 * s), 0.004 * s
    )
    palm_shell = Loft(
        sections,
        rings=11,
        low_cap=0.012 * s,
        high_cap=0.018 * s,
        angles=16,
        bumps=[thenar, hypothenar],
        cap_rings=2,
    ).shell("skin")
    shells = [palm_shell]
    breadth, middle = 0.5 * half, m.handlength - palm
    for index in range(4):
        z = half - breadth * (index + 0.5)
        overlap = 0.016 * s + (0.010 * s if index == 3 else 0.0)
        length = FINGER_LENGTHS[index] * middle
        base = (-0.001 * s, -palm + overlap, z)
        splay = np.array([0.0, -1.0, 0.035 * (1.5 - index)])
        shells.append(
            _digit(
                base,
                splay,
                length + overlap - (0.004 * s if index in (0, 2) else 0.0),
                0.5 * breadth * 1.04 * FINGER_BREADTHS[index],
                FINGER_CURLS[index] * length,
                (-1.0, 0.0, 0.0),
            )
        )
    shells.append(
        _digit(
            (-0.010 * s, -0.34 * palm, 0.62 * half),
            (-0.22, -0.80, 0.50),
            0.074 * s,
            0.0125 * s,
            0.008 * s,
            (0.0, -1.0, -0.6),
        )
    )
    return shells


def foot(m: Measures, build: Build) -> list[Shell]:
    """Return the left foot: flat sole, arch inward, heel behind the ankle, five toes."""
    length, ankle = m.footlength, m.lateralmalleolusheight
    half, heel = 0.5 * m.footbreadthhorizontal, 0.5 * m.heelbreadth
    s = length / 0.2463
    back = -0.22 * length
    ball = back + m.balloffootlength
    shin = m.anklecircumference / (2.0 * np.pi)

    def across(z: float, top: float, inner: float, outer: float, sole: float = 0.0) -> Section:
        """Return a section at z with its top above the sole, half breadths and sole height."""
        middle = sole + 0.38 * (top - sole)
        return Section(
            z,
            outer,
            inner,
            top - middle,
            middle - sole,
            z=middle - ankle,
            front_power=2.1,
            back_power=3.2,
        )

    sections = [
        across(back + 0.010 * s, 0.062 * s, 0.70 * heel, 0.70 * heel, 0.006 * s),
        across(back + 0.030 * s, 0.078 * s, 0.98 * heel, 0.98 * heel),
        across(-0.004 * s, ankle + 0.026 * s, 1.06 * shin, 1.06 * shin),
        across(0.026 * s, ankle + 0.016 * s, 1.00 * shin, 1.08 * shin),
        across(0.055 * s, ankle - 0.004 * s, 0.92 * shin, 1.12 * shin),
        across(0.5 * (0.055 * s + ball), 0.046 * s, 0.86 * half, 0.92 * half),
        across(ball - 0.012 * s, 0.034 * s, 0.98 * half, 0.96 * half),
        across(ball + 0.012 * s, 0.024 * s, 0.96 * half, 0.88 * half, 0.001 * s),
    ]
    # A loft runs along y: its x, y, z become x, z, y of the foot.
    arch = SwellingBump(
        (-0.03 * s, 0.045 * s, -ankle), (0.018 * s, 0.030 * s, 0.016 * s), -0.012 * s
    )
    to_foot = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    body = Loft(
        sections,
        rings=15,
        low_cap=0.010 * s,
        high_cap=0.010 * s,
        angles=18,
        bumps=[arch],
        cap_rings=2,
    )
    shells = [body.shell("skin").transformed(to_foot)]
    return shells + _toes(m, back, half, ball, s)


def _toes(m: Measures, back: float, half: float, ball: float, s: float) -> list[Shell]:
    """Return the five toes, from the big toe (inside) outwards."""
    shells = []
    tips = np.array([1.0, 0.985, 0.955, 0.92, 0.88]) * m.footlength + back
    centres = np.array([-0.68, -0.20, 0.16, 0.47, 0.74]) * half
    radii = np.array([0.0125, 0.0085, 0.0080, 0.0075, 0.0075]) * s
    roots = ball - np.array([0.004, 0.002, 0.004, 0.010, 0.018]) * s
    for tip, centre, radius, root in zip(tips, centres, radii, roots, strict=True):
        start = np.array([centre, -m.lateralmalleolusheight + 1.25 * radius, root])
        direction = np.array([0.04 * np.sign(centre), -0.20 * radius / 0.03, tip - root])
        direction[0] *= tip - root
        direction[1] = -0.25 * radius
        shells.append(_digit(start, direction, tip - root, radius, 0.0, (0.0, 1.0, 0.0)))
    return shells
