"""Shape of the head with face, ears, hair and neck, in its link frame [m]."""

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

FACE_ANGLES = (0, 6, 13, 21, 31, 44, 62, 88, 128, 180)
HAIR_RINGS = (0.18, 0.26, 0.35, 0.44, 0.52, 0.59, 0.66, 0.72, 0.78, 0.84, 0.90, 0.95)
HAIR_ANGLES = (0, 24, 46, 66, 88, 112, 144, 180)

# Eyes and brows: share of the way from chin to sellion, distance from the middle, radii and depth
# of the centre under the skin [m for the mean woman], material.
FACE_DETAILS = (
    (0.985, 0.0315, (0.0135, 0.0062, 0.0060), 0.0030, "eye"),
    (1.105, 0.0330, (0.0175, 0.0030, 0.0060), 0.0042, "hair"),
)


def _sections(m: Measures, build: Build) -> list[Section]:
    """Return neck, face and skull from the base of the neck to the crown, above the floor."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    half, cheek = 0.5 * m.headbreadth, 0.5 * m.bizygomaticbreadth
    jaw = build.jaw * cheek
    front, back = 0.535 * m.headlength, -0.465 * m.headlength
    base = joint_positions(m)["chest"]
    neck, low_neck = m.neckcircumference / 6.283, m.neckcircumferencebase / 6.283

    def section(share: float, side: float, fore: float, aft: float, power: float = 2.1) -> Section:
        """Return a section at a share of the face-to-crown height."""
        return Section(chin + share * height, side, side, fore, -aft, front_power=power)

    head_z = 0.004 * s
    skull = [
        section(0.004, 0.80 * jaw, 0.80 * front, -0.058 * s, build.chin),
        section(0.06, 0.92 * jaw, 0.92 * front, -0.062 * s, build.chin + 0.10),
        section(0.18, 1.02 * jaw, 0.955 * front, -0.068 * s, build.chin + 0.30),
        section(0.32, 0.5 * (jaw + cheek), 0.955 * front, 0.86 * back, 2.05),
        section(0.44, 0.99 * cheek, 0.95 * front, 0.93 * back, 2.2),
        section(0.53, 1.00 * cheek, 0.94 * front, 0.98 * back, 2.2),
        section(0.61, 0.97 * half, 0.99 * front, back, 2.25),
        section(0.70, half, 0.985 * front, 0.99 * back, 2.25),
        section(0.80, 0.95 * half, 0.93 * front, 0.93 * back, 2.2),
        section(0.87, 0.85 * half, 0.82 * front, 0.83 * back, 2.1),
        section(0.92, 0.72 * half, 0.69 * front, 0.71 * back, 2.0),
        section(0.96, 0.53 * half, 0.50 * front, 0.52 * back, 2.0),
        section(0.985, 0.33 * half, 0.31 * front, 0.33 * back, 2.0),
    ]
    skull = [
        Section(c.y, c.left, c.right, c.front, c.back, 0.0, head_z, c.front_power, c.back_power)
        for c in skull
    ]
    neck_sections = [
        Section(base[1], low_neck, low_neck, 0.95 * low_neck, 1.0 * low_neck, z=base[2]),
        Section(base[1] + 0.022 * s, neck, neck, 0.97 * neck, 1.02 * neck, z=base[2] + 0.006 * s),
        Section(chin - 0.010 * s, neck, neck, 1.04 * neck, 1.0 * neck, z=-0.010 * s),
    ]
    return neck_sections + skull


def _face_height(m: Measures) -> float:
    """Return the height from the chin to the crown [m]: the sellion lies at the eyes' height."""
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
        """Add a swelling at x and -x [m], share of the height from chin to sellion."""
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
    swell(0.0, 0.28, (0.020, 0.012), 0.003)
    swell(0.0, 0.17, (0.022, 0.006), -0.004)
    swell(0.0, 0.04, (0.016, 0.011), 0.006)
    bumps.append(
        EllipsoidBump(
            (0.0, chin + 0.66 * face, front - 0.006 * s),
            (0.0135 * s, 0.011 * s, 0.0225 * s),
            0.006 * s,
        )
    )
    bumps.append(
        EllipsoidBump(
            (0.0, chin + 0.80 * face, front - 0.008 * s),
            (0.0085 * s, 0.027 * s, 0.0165 * s),
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


def head(m: Measures, build: Build) -> list[Shell]:
    """Return the head with its neck; the hair is a shell that leaves the face free."""
    s = m.stature / 1.6285
    sections, bumps = _sections(m, build), _features(m, build)
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    face = m.mentonsellionlength
    shares = (0.05, 0.11, 0.155, 0.20, 0.26, 0.30, 0.34, 0.38, 0.43, 0.475, 0.515, 0.55, 0.60)
    more = (0.67, 0.76, 0.85, 0.93)
    rings = [sections[1].y, sections[2].y, chin + 0.004 * height]
    rings += [chin + share * height for share in shares + more]
    loft = Loft(
        sections,
        rings=rings,
        low_cap=0.9 * m.neckcircumferencebase / 6.283,
        high_cap=0.015 * height,
        angles=mirrored_angles(FACE_ANGLES),
        bumps=bumps,
        cap_rings=2,
    )
    shells = [loft.shell("skin")]
    for side in (1.0, -1.0):
        ear = ellipsoid(
            (0.0, 0.0, 0.0), (0.007 * s, 0.48 * m.earlength, 0.016 * s), "skin", around=6, rings=3
        )
        turn = np.array([[0.92, 0.0, 0.39], [0.0, 1.0, 0.0], [-0.39, 0.0, 0.92]])
        ear = ear.transformed(turn)
        ear = ear.moved((0.5 * m.headbreadth - 0.005 * s, 0.0, -0.004 * s))
        ear = ear.moved((0.0, m.stature - m.tragiontopofhead + 0.004 * s, 0.0))
        shells.append(ear if side > 0.0 else ear.mirrored())
        for share, x, radii, sink, material in FACE_DETAILS:
            y = chin + share * face
            size = np.asarray(radii) * s
            z = _surface_z(loft, x * s, y) - sink * s
            shells.append(ellipsoid((side * x * s, y, z), size, material, around=6, rings=2))
    lip_y = chin + 0.285 * face
    lip_z = _surface_z(loft, 0.0, lip_y)
    shells.append(
        ellipsoid(
            (0.0, lip_y, lip_z - 0.0060 * s),
            (0.0235 * s, 0.0080 * s, 0.0085 * s),
            "lips",
            around=8,
            rings=2,
        )
    )
    shells += _hair(m, build, sections)
    origin = joint_positions(m)["head"]
    return [shell.moved(-origin) for shell in shells]


def _hair(m: Measures, build: Build, sections: list[Section]) -> list[Shell]:
    """Return the hair: the skull swollen where hair grows, sunk under the skin elsewhere."""
    s = m.stature / 1.6285
    chin = m.stature - _face_height(m)
    height = m.stature - chin
    thick = (0.011 if build.ponytail else 0.009) * s
    skull = [c for c in sections if c.y > chin + 0.15 * height]

    def grow(axis: np.ndarray, direction: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return the radius of the hair: out over the scalp, in under the face and nape."""
        share = (axis[:, 1] - chin) / height
        forward = np.degrees(np.arccos(np.clip(direction[:, 2], -1.0, 1.0)))
        # Hairline: over the forehead, down in front of the ears, round them, to the nape.
        line = np.interp(
            forward,
            [0.0, 30.0, 50.0, 68.0, 84.0, 100.0, 125.0, 180.0],
            [0.80, 0.775, 0.72, 0.60, 0.50, 0.38, 0.20, 0.14],
        )
        over = np.clip((share - line) / 0.11 + 0.5, 0.0, 1.0)
        over = over * over * (3.0 - 2.0 * over)
        return radius - 0.012 * s + over * (thick + 0.012 * s)

    cap = Loft(
        skull,
        rings=[chin + f * height for f in HAIR_RINGS],
        low_cap=0.002 * s,
        high_cap=0.015 * height + 0.9 * thick,
        angles=mirrored_angles(HAIR_ANGLES),
        cap_rings=1,
        rule=grow,
    )
    shells = [cap.shell("hair")]
    if build.ponytail:
        shells.append(_ponytail(m, chin, height, s))
    return shells


def _ponytail(m: Measures, chin: float, height: float, s: float) -> Shell:
    """Return the tail of hair, tied behind the crown and hanging to the shoulders."""
    tie = chin + 0.66 * height
    rear = -0.465 * m.headlength
    sections = [
        Section(tie - 0.205 * s, 0.008 * s, 0.008 * s, 0.007 * s, 0.007 * s, z=rear - 0.022 * s),
        Section(tie - 0.155 * s, 0.021 * s, 0.021 * s, 0.016 * s, 0.015 * s, z=rear - 0.028 * s),
        Section(tie - 0.085 * s, 0.027 * s, 0.027 * s, 0.020 * s, 0.018 * s, z=rear - 0.034 * s),
        Section(tie - 0.025 * s, 0.025 * s, 0.025 * s, 0.022 * s, 0.020 * s, z=rear - 0.030 * s),
        Section(tie + 0.012 * s, 0.018 * s, 0.018 * s, 0.024 * s, 0.018 * s, z=rear - 0.018 * s),
    ]
    loft = Loft(sections, rings=7, low_cap=0.010 * s, high_cap=0.014 * s, angles=7, cap_rings=1)
    return loft.shell("hair")
