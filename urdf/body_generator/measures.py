"""Body measures and the joint positions that follow from them, in metres."""

from dataclasses import dataclass, fields, replace

import numpy as np


@dataclass(frozen=True)
class Measures:
    """Mean body measures [m], under their names in the ANSUR II survey (Gordon et al. 2014)."""

    stature: float
    acromialheight: float
    acromionradialelength: float
    anklecircumference: float
    axillaheight: float
    balloffootlength: float
    biacromialbreadth: float
    bicepscircumferenceflexed: float
    bicristalbreadth: float
    bideltoidbreadth: float
    bizygomaticbreadth: float
    buttockdepth: float
    buttockheight: float
    calfcircumference: float
    cervicaleheight: float
    chestbreadth: float
    chestdepth: float
    chestheight: float
    crotchheight: float
    earlength: float
    footbreadthhorizontal: float
    footlength: float
    forearmcircumferenceflexed: float
    handbreadth: float
    handlength: float
    headbreadth: float
    headlength: float
    heelbreadth: float
    hipbreadth: float
    lateralfemoralepicondyleheight: float
    lateralmalleolusheight: float
    lowerthighcircumference: float
    mentonsellionlength: float
    neckcircumference: float
    neckcircumferencebase: float
    palmlength: float
    radialestylionlength: float
    suprasternaleheight: float
    tenthribheight: float
    thighcircumference: float
    tragiontopofhead: float
    trochanterionheight: float
    waistbreadth: float
    waistdepth: float
    waistheightomphalion: float
    wristcircumference: float

    def scaled_to(self, stature: float) -> "Measures":
        """Return all measures in proportion to another stature [m]."""
        factor = stature / self.stature
        return replace(self, **{f.name: getattr(self, f.name) * factor for f in fields(self)})


@dataclass(frozen=True)
class Build:
    """Looks and mass of a bundled body, besides its measures.

    Attributes:
        name: of the model, the URDF file and the .mtl file.
        bust: whether there are breasts.
        jaw: breadth of the lower jaw, as a fraction of the bizygomatic breadth.
        chin: breadth of the chin, as a multiple of the woman's.
        brow: prominence of the brow ridge [m].
        natural_waist: breadth and depth of the narrowest waist, as fractions of those at the navel.
        ponytail: long hair, tied behind the head; otherwise short hair.
        muscle: size of the muscles' bulges, as a multiple of the woman's.
        mass: of the whole body [kg].
        mass_fractions: mass of each kind of segment, as a fraction of the whole mass.
        colours: material name to red, green, blue in 0..1.
    """

    name: str
    bust: bool
    jaw: float
    chin: float
    brow: float
    natural_waist: float
    ponytail: bool
    muscle: float
    mass: float
    mass_fractions: dict[str, float]
    colours: dict[str, tuple[float, float, float]]


def joint_positions(m: Measures) -> dict[str, np.ndarray]:
    """Return where each segment joins its parent in the standing body (3,) [m].

    x is to the body's left, y up from the floor, z forward. Only the left side is returned; the
    right side is its mirror image. The README of each model states which numbers are measured and
    which are derived.
    """
    scale = m.stature / 1.6285
    neck = m.stature - m.tragiontopofhead - 0.015 * scale
    shoulder = np.array([0.46 * m.biacromialbreadth, 0.0, -0.022 * scale])
    shoulder[1] = m.acromialheight - 0.104 * m.acromionradialelength
    elbow = shoulder + np.array([0.034 * scale, 0.0, -0.004 * scale])
    elbow[1] = m.acromialheight - m.acromionradialelength
    wrist = elbow + np.array([0.016 * scale, -m.radialestylionlength, 0.022 * scale])
    hip = np.array([0.32 * m.bicristalbreadth, m.trochanterionheight, -0.004 * scale])
    knee = np.array([0.92 * hip[0], m.lateralfemoralepicondyleheight, 0.004 * scale])
    ankle = np.array([0.84 * hip[0], m.lateralmalleolusheight, -0.022 * scale])
    return {
        "head": np.array([0.0, neck, -0.004 * scale]),
        "chest": np.array([0.0, 0.5 * (m.cervicaleheight + m.suprasternaleheight), -0.024 * scale]),
        "waist": np.array([0.0, 0.5 * (m.tenthribheight + m.waistheightomphalion), -0.008 * scale]),
        "upper_arm": shoulder,
        "forearm": elbow,
        "hand": wrist,
        "thigh": hip,
        "shin": knee,
        "foot": ankle,
    }
