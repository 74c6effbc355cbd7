"""Shape of the head with face, ears, hair and neck, in its link frame [m]."""

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

FACE_ANGLES = (0, 6, 13, 21, 31, 46, 70, 105, 180)
# Heights of the rings of the face and of the hair, as fractions of the way from chin to crown.
FACE_RINGS = (0.052, 0.095, 0.145, 0.185, 0.22, 0.27, 0.31, 0.35, 0.385, 0.43, 0.475)
SKULL_RINGS = (0.515, 0.555, 0.61, 0.70, 0.82)
HAIR_ANGLES = (0, 15, 32, 50, 72, 100, 138, 180)
HAIR_RINGS = (0.22, 0.32, 0.42, 0.51, 0.60, 0.69, 0.79, 0.885)
# Hairline: angles from straight ahead [deg], and its height there as a fraction of chin to crown:
# over the forehead, down in front of the ears, around them, to the nape.
HAIRLINE = (
    (0.0, 25.0, 48.0, 66.0, 84.0, 100.0, 125.0, 180.0),
    (0.800, 0.785, 0.725, 0.62, 0.49, 0.36, 0.20, 0.14),
)
# Eyes and brows: fraction of the way from chin to sellion, distance from the middle, radii, and
# depth of the centre under the skin [m for the mean woman], material.
FACE_DETAILS = (
    (0.985, 0.0310, (0.0155, 0.0068, 0.0065), 0.0028, "eye"),
    (1.150, 0.0325, (0.0195, 0.0028, 0.0060), 0.0040, "hair"),
)


def _sections(m: Measures, build: Build) -> list[Section]:
    """Return face and skull from the chin to the crown, at heights above the floor."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    half, cheek = 0.5 * m.headbreadth, 0.5 * m.bizygomaticbreadth
    jaw = build.jaw * cheek
    front, back = 0.535 * m.headlength, -0.465 * m.headlength
    head_z = 0.004 * s

    def section(
        share: float, side: float, fore: float, aft: float, power: float, middle: float = 0.0
    ) -> Section:
        """Return a section at a fraction of chin to crown, its axis at z = middle."""
        return Section(
            chin + share * height,
            side,
            side,
            fore - middle,
            middle - aft,
            z=head_z + middle,
            front_power=power,
        )

    square = build.chin
    return [
        section(0.026, 0.58 * square * jaw, 0.875 * front, 0.16 * front, 2.0, 0.056 * s),
        section(0.07, 0.72 * square * jaw, 0.945 * front, -0.15 * front, 2.0, 0.048 * s),
        section(0.13, (0.40 + 0.48 * square) * jaw, 0.935 * front, -0.5 * front, 2.0, 0.034 * s),
        section(0.20, jaw, 0.955 * front, 0.74 * back, 2.0, 0.018 * s),
        section(0.32, 0.5 * (jaw + cheek) + 0.002 * s, 0.95 * front, 0.86 * back, 2.05, 0.006 * s),
        section(0.44, 0.99 * cheek, 0.945 * front, 0.93 * back, 2.15),
        section(0.53, 1.00 * cheek, 0.94 * front, 0.98 * back, 2.2),
        section(0.61, 0.97 * half, 0.985 * front, back, 2.25),
        section(0.70, half, 0.98 * front, 0.99 * back, 2.25),
        section(0.80, 0.94 * half, 0.92 * front, 0.93 * back, 2.2),
        section(0.87, 0.825 * half, 0.80 * front, 0.815 * back, 2.1),
        section(0.92, 0.68 * half, 0.66 * front, 0.675 * back, 2.0),
        section(0.96, 0.49 * half, 0.47 * front, 0.49 * back, 2.0),
    ]


def _neck(m: Measures) -> Shell:
    """Return the neck, from inside the chest to inside the skull, leaning forward."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    base = joint_positions(m)["chest"]
    neck, low = m.neckcircumference / 6.283, m.neckcircumferencebase / 6.283
    side = 0.92 * neck  # the neck is deeper than broad
    sections = [
        Section(base[1] - 0.004 * s, 0.92 * low, 0.92 * low, 0.84 * low, low, z=base[2]),
        Section(base[1] + 0.020 * s, side, side, 0.98 * neck, 1.10 * neck, z=base[2] + 0.003 * s),
        Section(chin - 0.004 * s, 0.97 * side, 0.97 * side, neck, 1.04 * neck, z=-0.012 * s),
        Section(chin + 0.034 * s, 0.95 * side, 0.95 * side, 0.9 * neck, 0.98 * neck, z=-0.010 * s),
    ]
    throat = SwellingBump(
        (0.0, base[1] + 0.034 * s, 0.04 * s), (0.016 * s, 0.012 * s, 0.02 * s), 0.0015 * s
    )
    loft = Loft(
        sections,
        rings=4,
        low_cap=0.85 * low,
        high_cap=0.02 * s,
        angles=10,
        bumps=[throat],
        cap_rings=2,
    )
    return loft.shell("skin")


def _face_height(m: Measures) -> float:
    """Return the height from chin to crown [m]; the sellion is at the height of the eyes."""
    return m.mentonsellionlength + 0.815 * m.tragiontopofhead


def _features(m: Measures, build: Build) -> list[Bump]:
    """Return the bumps of the face: eye sockets, brows, cheeks, nose, lips and chin."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    face = m.mentonsellionlength
    front = 0.535 * m.headlength + 0.004 * s
    bumps: list[Bump] = []

    def swell(
        x: float, share: float, widths: tuple[float, float], amount: float, depth: float = 0.03
    ) -> None:
        """Add a swelling at x and -x [m], at a fraction of the height from chin to sellion."""
        for side in (x, -x) if x else (0.0,):
            bumps.append(
                SwellingBump(
                    (side, chin + share * face, front - 0.006 * s),
                    (widths[0] * s, widths[1] * s, depth * s),
                    amount * s,
                )
            )

    swell(0.034 * s, 0.985, (0.014, 0.010), -0.008)
    swell(0.032 * s, 1.16, (0.020, 0.008), build.brow / s)
    swell(0.040 * s, 0.72, (0.016, 0.014), 0.004)
    swell(0.0, 0.30, (0.020, 0.012), 0.003)
    swell(0.0, 0.19, (0.022, 0.006), -0.003)
    swell(0.0, 0.06, (0.015, 0.010), 0.004)
    bumps.append(
        EllipsoidBump(
            (0.0, chin + 0.66 * face, front - 0.006 * s),
            (0.0125 * s, 0.0105 * s, 0.0205 * s),
            0.006 * s,
        )
    )
    bumps.append(
        EllipsoidBump(
            (0.0, chin + 0.80 * face, front - 0.008 * s),
            (0.0080 * s, 0.027 * s, 0.0150 * s),
            0.008 * s,
        )
    )
    return bumps


def _surface_z(loft: Loft, x: float, y: float) -> float:
    """Return how far forward the loft's surface reaches at x, y [m]."""
    vertices = loft.shell("skin").vertices
    near = vertices[vertices[:, 2] > 0.0]
    distance = np.linalg.norm(near[:, :2] - np.array([x, y]), axis=1)
    best = np.argsort(distance, kind="stable")[:4]
    weight = 1.0 / (distance[best] + 1e-6)
    return float(np.sum(near[best, 2] * weight) / np.sum(weight))


def _detail(size: np.ndarray, material: str, around: int = 6) -> Shell:
    """Return a small spindle lying along x, pointed at its ends: an eye, a brow, the lips."""
    standing = ellipsoid((0.0, 0.0, 0.0), (size[1], size[0], size[2]), material, around, rings=3)
    return standing.transformed(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))


def head(m: Measures, build: Build) -> list[Shell]:
    """Return the head with its neck; the hair is a shell that does not cover the face."""
    s = m.stature / 1.6285
    sections = _sections(m, build)
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    face = m.mentonsellionlength
    loft = Loft(
        sections,
        rings=[chin + share * height for share in FACE_RINGS + SKULL_RINGS],
        low_cap=0.024 * height,
        high_cap=0.035 * height,
        angles=mirrored_angles(FACE_ANGLES),
        bumps=_features(m, build),
        cap_rings=1,
    )
    shells = [loft.shell("skin"), _neck(m)]
    for share, x, radii, sink, material in FACE_DETAILS:
        y = chin + share * face
        z = _surface_z(loft, x * s, y) - sink * s
        detail = _detail(np.asarray(radii) * s, material, 6 if material == "eye" else 4)
        detail = detail.moved((x * s, y, z))
        shells += [detail, detail.mirrored()]
    ear = ellipsoid((0.0, 0.0, 0.0), (0.007 * s, 0.48 * m.earlength, 0.016 * s), "skin", 6, 2)
    turn, lean = np.radians(22.0), np.radians(8.0)
    outwards = np.array(
        [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    )
    backwards = np.array(
        [[1, 0, 0], [0, np.cos(lean), np.sin(lean)], [0, -np.sin(lean), np.cos(lean)]]
    )
    ear = ear.transformed(backwards @ outwards).moved(
        (0.5 * m.headbreadth - 0.006 * s, m.stature - m.tragiontopofhead + 0.004 * s, -0.004 * s)
    )
    shells += [ear, ear.mirrored()]
    lip_y = chin + 0.30 * face
    lips = _detail(np.array([0.0240, 0.0088, 0.0090]) * s, "lips")
    shells.append(lips.moved((0.0, lip_y, _surface_z(loft, 0.0, lip_y) - 0.0048 * s)))
    shells += _hair(m, build, sections)
    origin = joint_positions(m)["head"]
    return [shell.moved(-origin) for shell in shells]


def _hair(m: Measures, build: Build, sections: list[Section]) -> list[Shell]:
    """Return the hair: the skull, swollen where hair grows, and sunk under the skin elsewhere."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    thick = (0.011 if build.ponytail else 0.009) * s
    # The skull is stretched above its widest part, so that the hair is equally thick on top.
    widest = chin + 0.68 * height
    stretch = 1.0 + thick / (m.stature - widest)

    def lifted(y: float) -> float:
        """Return the height of the hair over a height of the skull [m]."""
        return widest + max(y - widest, 0.0) * stretch + min(y - widest, 0.0)

    def grow(axis: np.ndarray, direction: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return the radius of the hair: out over the scalp, in under the face and nape."""
        share = (axis[:, 1] - chin) / height
        forward = np.degrees(np.arccos(np.clip(direction[:, 2], -1.0, 1.0)))
        over = (share - np.interp(forward, *HAIRLINE)) / 0.11
        fade = np.clip((m.stature + thick - axis[:, 1]) / (0.25 * height), 0.3, 1.0)
        return np.maximum(radius + np.clip(over, -1.3, 1.0) * thick * fade, 0.003 * s)

    skull = [replace(c, y=lifted(c.y)) for c in sections if c.y > chin + 0.15 * height]
    cap = Loft(
        skull,
        rings=[lifted(chin + share * height) for share in HAIR_RINGS],
        low_cap=0.002 * s,
        high_cap=0.044 * height,
        angles=mirrored_angles(HAIR_ANGLES),
        cap_rings=2,
        rule=grow,
    )
    shells = [cap.shell("hair")]
    if build.ponytail:
        shells.append(_ponytail(m, chin, height, s))
    return shells


def _ponytail(m: Measures, chin: float, height: float, s: float) -> Shell:
    """Return the tail of hair, tied behind the crown and hanging to the nape."""
    tie = chin + 0.70 * height
    rear = -0.465 * m.headlength
    profile = (
        (-0.200, 0.008, 0.007, -0.012),
        (-0.155, 0.020, 0.015, -0.020),
        (-0.090, 0.027, 0.020, -0.032),
        (-0.030, 0.025, 0.021, -0.034),
        (0.000, 0.019, 0.018, -0.022),
        (0.016, 0.013, 0.014, -0.008),
    )
    sections = [
        Section(tie + y * s, side * s, side * s, deep * s, deep * s, z=rear + z * s)
        for y, side, deep, z in profile
    ]
    loft = Loft(sections, rings=6, low_cap=0.010 * s, high_cap=0.010 * s, angles=6, cap_rings=1)
    return loft.shell("hair")
