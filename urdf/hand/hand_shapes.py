"""Measures and shapes of the left hand and forearm, each part in its link's frame [m].

Axes when all angles are 0: y along the forearm to the fingertips, z out of the palm, x from the
thumb to the little finger. The right hand is the mirror image.
"""

from dataclasses import dataclass

import numpy as np
from body_generator.shapes import EllipsoidBump, Loft, Section, Shell, SwellingBump

MATERIAL = "skin"


@dataclass(frozen=True)
class HandMeasures:
    """Outer measures [m], under their names in the ANSUR II survey (Gordon et al. 2014)."""

    handlength: float
    handbreadth: float
    wristcircumference: float
    forearmcircumferenceflexed: float
    bicepscircumferenceflexed: float
    radialestylionlength: float

    def scaled_to(self, handlength: float) -> "HandMeasures":
        """Return all measures in proportion to another hand length [m]."""
        factor = handlength / self.handlength
        return HandMeasures(**{name: value * factor for name, value in vars(self).items()})


@dataclass(frozen=True)
class Finger:
    """One of the four fingers.

    Attributes:
        bones: lengths of the proximal, middle and distal phalanx, and of the soft tissue beyond
            the last [mm] (Buryanov and Kotiuk 2010); only their ratios count.
        knuckle: centre of the MCP joint: distance from the third metacarpal's axis, over the
            hand's breadth; distance from the wrist, over the hand's length.
        thickness: of the three phalanges, over the hand's breadth.
        webs: reach of the web beyond the finger's axis, towards the thumb and towards the little
            finger, over the hand's breadth; 0: no web on this side.
        web_length: distance of the web's end from the knuckle, over the hand's length.
    """

    bones: tuple[float, float, float, float]
    knuckle: tuple[float, float]
    thickness: tuple[float, float, float]
    webs: tuple[float, float]
    web_length: float


FINGERS = {
    "index": Finger(
        (39.78, 22.38, 15.82, 3.84), (-0.251, 0.447), (0.229, 0.198, 0.176), (0.0, 0.210), 0.128
    ),
    "middle": Finger(
        (44.63, 26.33, 17.40, 3.95), (0.0, 0.446), (0.216, 0.197, 0.180), (0.195, 0.165), 0.130
    ),
    "ring": Finger(
        (41.37, 25.65, 17.30, 3.95), (0.206, 0.409), (0.203, 0.182, 0.168), (0.165, 0.195), 0.140
    ),
    "little": Finger(
        (32.74, 18.11, 15.96, 3.73), (0.402, 0.368), (0.183, 0.165, 0.149), (0.205, 0.0), 0.135
    ),
}
THUMB_BONES = (31.57, 21.67, 5.67)  # proximal, distal, soft tissue [mm], as above
THUMB_BASE = (-0.196, 0.073, 0.040)  # CMC joint: breadth, length, breadth (towards the palm)
THUMB_METACARPAL = 0.251  # over the hand's length
THUMB_THICKNESS = (0.330, 0.262, 0.245)  # metacarpal, proximal, distal phalanx
# Radii of the heads of metacarpal, proximal and middle phalanx [mm]: the distance of a joint's
# centre from the end of the bone before it.
HEADS = (7.0, 4.0, 3.0)
THUMB_HEADS = (6.0, 5.0)


def finger_lengths(name: str, m: HandMeasures) -> tuple[float, float, float]:
    """Return the distances between joint centres, and from the last joint to the fingertip [m].

    The middle finger ends at the hand's length; the others have the bones' ratios to it.
    """
    middle = FINGERS["middle"]
    reach = m.handlength * (1.0 - middle.knuckle[1])
    scale = reach / (sum(middle.bones) + HEADS[0])
    first, second, third, tip = FINGERS[name].bones
    return (
        scale * (first + HEADS[0] - HEADS[1]),
        scale * (second + HEADS[1] - HEADS[2]),
        scale * (third + tip + HEADS[2]),
    )


def thumb_lengths(m: HandMeasures) -> tuple[float, float, float]:
    """Return the distances CMC to MCP, MCP to IP, and IP to the thumb's tip [m]."""
    middle = FINGERS["middle"]
    scale = m.handlength * (1.0 - middle.knuckle[1]) / (sum(middle.bones) + HEADS[0])
    first, last, tip = THUMB_BONES
    return (
        THUMB_METACARPAL * m.handlength,
        scale * (first + THUMB_HEADS[0] - THUMB_HEADS[1]),
        scale * (last + tip + THUMB_HEADS[1]),
    )


def knuckle(name: str, m: HandMeasures) -> np.ndarray:
    """Return the MCP joint's centre in the palm's frame (3,) [m]."""
    across, along = FINGERS[name].knuckle
    return np.array([across * m.handbreadth, along * m.handlength, 0.0])


def thumb_base(m: HandMeasures) -> np.ndarray:
    """Return the thumb's CMC joint in the palm's frame (3,) [m]."""
    across, along, out = THUMB_BASE
    return np.array([across * m.handbreadth, along * m.handlength, out * m.handbreadth])


def _round(y: float, radius: float, thumbwards: float = 0.0, outwards: float = 0.0) -> Section:
    """Return a finger's section: slightly broader than deep, with a fuller pulp than back.

    Args:
        y: along the finger [m].
        radius: mean radius [m].
        thumbwards, outwards: least half breadths towards the thumb and away from it [m].
    """
    side = 1.05 * radius
    return Section(
        y, max(side, outwards), max(side, thumbwards), 1.0 * radius, 0.92 * radius, z=0.0
    )


def _capsule(sections: list[Section], rings: int, caps: tuple[float, float]) -> Shell:
    """Return a closed finger segment with round ends."""
    loft = Loft(sections, rings, low_cap=caps[0], high_cap=caps[1], angles=14, cap_rings=3)
    return loft.shell(MATERIAL)


def proximal(name: str, m: HandMeasures) -> Shell:
    """Return a finger's proximal phalanx with half of each web beside it."""
    finger, length = FINGERS[name], finger_lengths(name, m)[0]
    half = [0.5 * share * m.handbreadth for share in finger.thickness]
    base, end = 1.04 * half[0], 0.51 * (half[0] + half[1])
    web = finger.web_length * m.handlength
    thumbwards, outwards = (share * m.handbreadth for share in finger.webs)
    sections = [_round(0.0, base)]
    for share, reach in ((0.30, 0.85), (0.80, 1.0), (0.97, 0.90)):
        y = share * web
        radius = float(np.interp(y, [0.0, 0.6 * length, length], [base, 0.97 * half[0], end]))
        sections.append(_round(y, radius, reach * thumbwards, reach * outwards))
    sections += [_round(web + 0.11 * length, 0.98 * half[0]), _round(length, end)]
    return _capsule(sections, 10, (base, end))


def middle(name: str, m: HandMeasures) -> Shell:
    """Return a finger's middle phalanx."""
    length = finger_lengths(name, m)[1]
    half = [0.5 * share * m.handbreadth for share in FINGERS[name].thickness]
    start, end = 0.51 * (half[0] + half[1]), 0.50 * (half[1] + half[2])
    sections = [_round(0.0, start), _round(0.5 * length, 0.98 * half[1]), _round(length, end)]
    return _capsule(sections, 8, (start, end))


def distal(name: str, m: HandMeasures) -> Shell:
    """Return a finger's last phalanx."""
    half = [0.5 * share * m.handbreadth for share in FINGERS[name].thickness]
    return _tip(finger_lengths(name, m)[2], 0.50 * (half[1] + half[2]), half[2])


def _tip(length: float, start: float, radius: float) -> Shell:
    """Return a last phalanx of radius `start` at its joint and `radius` at the nail's root [m]."""
    cap = 0.78 * radius
    sections = [
        _round(0.0, start),
        _round(0.45 * length, 1.0 * radius),
        _round(length - cap, 0.86 * radius),
    ]
    return _capsule(sections, 7, (start, cap))


def thumb_metacarpal(m: HandMeasures) -> Shell:
    """Return the thumb's metacarpal in its muscles, with the web towards the index finger."""
    length = thumb_lengths(m)[0]
    half, next_half = (0.5 * share * m.handbreadth for share in THUMB_THICKNESS[:2])
    end = 1.02 * next_half

    def section(share: float, radius: float, web: float) -> Section:
        """Return a section at a fraction of the length, reaching `web` [m] towards the index."""
        return Section(
            share * length, 0.95 * radius, 0.95 * radius, max(radius, web), radius, front_power=2.0
        )

    sections = [
        section(0.0, 0.95 * half, 0.0),
        section(0.30, 1.04 * half, 0.32 * m.handbreadth),
        section(0.58, 0.98 * half, 0.33 * m.handbreadth),
        section(0.82, 0.5 * (half + end), 0.29 * m.handbreadth),
        section(1.0, end, 0.18 * m.handbreadth),
    ]
    return _capsule(sections, 10, (0.95 * half, end))


def thumb_proximal(m: HandMeasures) -> Shell:
    """Return the thumb's proximal phalanx."""
    length = thumb_lengths(m)[1]
    half, next_half = (0.5 * share * m.handbreadth for share in THUMB_THICKNESS[1:])
    start, end = 1.02 * half, 0.52 * (half + next_half)
    sections = [_round(0.0, start), _round(0.5 * length, 0.92 * half), _round(length, end)]
    return _capsule(sections, 8, (start, end))


def thumb_distal(m: HandMeasures) -> Shell:
    """Return the thumb's last phalanx."""
    half, last = (0.5 * share * m.handbreadth for share in THUMB_THICKNESS[1:])
    return _tip(thumb_lengths(m)[2], 0.52 * (half + last), last)


def palm(m: HandMeasures) -> Shell:
    """Return the palm: a rounded slab from the wrist to the knuckles, thick under the thumb."""
    length, breadth = m.handlength, m.handbreadth
    wrist = m.wristcircumference / (2.0 * np.pi)

    def section(y: float, thumbwards: float, outwards: float, front: float, back: float) -> Section:
        """Return a section; y over the hand's length, the rest over its breadth."""
        return Section(
            y * length,
            outwards * breadth,
            thumbwards * breadth,
            front * breadth,
            back * breadth,
            front_power=2.4,
            back_power=2.5,
        )

    sections = [
        Section(0.0, 1.10 * wrist, 1.10 * wrist, 0.80 * wrist, 0.80 * wrist),
        section(0.080, 0.38, 0.38, 0.25, 0.22),
        section(0.180, 0.48, 0.45, 0.22, 0.18),
        section(0.270, 0.54, 0.50, 0.19, 0.16),
        section(0.350, 0.51, 0.52, 0.17, 0.15),
        section(0.410, 0.44, 0.49, 0.155, 0.14),
        section(0.468, 0.40, 0.36, 0.14, 0.125),
    ]
    thenar = EllipsoidBump(
        (-0.21 * breadth, 0.20 * length, 0.10 * breadth),
        (0.20 * breadth, 0.17 * length, 0.19 * breadth),
        0.12 * breadth,
    )
    hypothenar = SwellingBump(
        (0.36 * breadth, 0.17 * length, 0.12 * breadth),
        (0.12 * breadth, 0.11 * length, 0.12 * breadth),
        0.04 * breadth,
    )
    loft = Loft(
        sections,
        rings=14,
        low_cap=0.80 * wrist,
        high_cap=0.13 * breadth,
        angles=18,
        bumps=[thenar, hypothenar],
        cap_rings=3,
    )
    return loft.shell(MATERIAL)


def forearm(m: HandMeasures) -> Shell:
    """Return the forearm from the wrist (the origin) down to the elbow."""
    wrist, full = m.wristcircumference, 0.97 * m.forearmcircumferenceflexed
    elbow = 0.95 * 0.84 * m.bicepscircumferenceflexed
    length = m.radialestylionlength

    def section(
        share: float, girth: float, shape: tuple[float, float, float, float], x: float = 0.0
    ) -> Section:
        """Return a section at a fraction of the way from elbow to wrist.

        Args:
            share: 0 at the elbow, 1 at the wrist.
            girth: circumference [m].
            shape: radii outwards (little finger), thumbwards, towards the palm, back; only their
                ratios count.
            x: shift of the axis [m].
        """
        section = Section((share - 1.0) * length, *shape, x)
        return section.scaled_to_girth(girth)

    sections = [
        section(0.0, 0.99 * elbow, (1.04, 1.04, 0.96, 0.96)),
        section(0.12, full, (1.02, 1.08, 1.00, 0.92)),
        section(0.28, full, (1.02, 1.10, 1.02, 0.90)),
        section(0.55, 0.82 * full, (1.02, 1.10, 0.96, 0.92)),
        section(0.80, 0.5 * (0.72 * full + wrist), (1.08, 1.10, 0.88, 0.86)),
        section(0.93, wrist, (1.11, 1.12, 0.81, 0.80)),
        section(1.0, 1.02 * wrist, (1.12, 1.12, 0.80, 0.80)),
    ]
    loft = Loft(
        sections,
        rings=14,
        low_cap=0.9 * elbow / (2.0 * np.pi),
        high_cap=0.80 * wrist / (2.0 * np.pi),
        angles=18,
        cap_rings=3,
    )
    return loft.shell(MATERIAL)
