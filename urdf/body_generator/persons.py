"""The bundled man and woman: published measures and masses, and chosen looks."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Person:
    """A bundled body before it is scaled.

    Attributes:
        measures: body measures under their names in the survey [m].
        mass: of the whole body at these measures [kg].
        mass_fractions: mass of each kind of segment, as a fraction of the whole mass.
        build: the other fields of ``Build``.
    """

    measures: dict[str, float]
    mass: float
    mass_fractions: dict[str, float]
    build: dict[str, Any]


# ANSUR II, 2012 [m]: male means (n = 4082), female means (n = 1986). Gordon et al. 2014,
# Natick/TR-15/007, public data.
_MEASURES = {
    "stature": (1.7562, 1.6285),
    "acromialheight": (1.4407, 1.3351),
    "acromionradialelength": (0.3352, 0.3112),
    "anklecircumference": (0.2293, 0.2157),
    "axillaheight": (1.3291, 1.2390),
    "balloffootlength": (0.2009, 0.1821),
    "biacromialbreadth": (0.4157, 0.3653),
    "bicepscircumferenceflexed": (0.3581, 0.3056),
    "bicristalbreadth": (0.2754, 0.2733),
    "bideltoidbreadth": (0.5104, 0.4503),
    "bizygomaticbreadth": (0.1426, 0.1338),
    "buttockdepth": (0.2458, 0.2329),
    "buttockheight": (0.8879, 0.8337),
    "calfcircumference": (0.3923, 0.3733),
    "cervicaleheight": (1.5173, 1.3957),
    "chestbreadth": (0.2894, 0.2693),
    "chestdepth": (0.2538, 0.2474),
    "chestheight": (1.2911, 1.1716),
    "crotchheight": (0.8459, 0.7823),
    "earlength": (0.0642, 0.0594),
    "footbreadthhorizontal": (0.1019, 0.0927),
    "footlength": (0.2712, 0.2463),
    "forearmcircumferenceflexed": (0.3101, 0.2641),
    "handbreadth": (0.0883, 0.0782),
    "handlength": (0.1933, 0.1811),
    "headbreadth": (0.1543, 0.1478),
    "headlength": (0.1995, 0.1898),
    "heelbreadth": (0.0725, 0.0672),
    "hipbreadth": (0.3457, 0.3538),
    "lateralfemoralepicondyleheight": (0.4917, 0.4659),
    "lateralmalleolusheight": (0.0729, 0.0627),
    "lowerthighcircumference": (0.4093, 0.4007),
    "mentonsellionlength": (0.1226, 0.1131),
    "neckcircumference": (0.3976, 0.3298),
    "neckcircumferencebase": (0.4346, 0.3712),
    "palmlength": (0.1165, 0.1087),
    "radialestylionlength": (0.2679, 0.2413),
    "suprasternaleheight": (1.4386, 1.3297),
    "tenthribheight": (1.1207, 1.0563),
    "thighcircumference": (0.6251, 0.6161),
    "tragiontopofhead": (0.1311, 0.1265),
    "trochanterionheight": (0.9009, 0.8454),
    "waistbreadth": (0.3264, 0.2999),
    "waistdepth": (0.2378, 0.2130),
    "waistheightomphalion": (1.0565, 0.9801),
    "wristcircumference": (0.1759, 0.1548),
}

# Whole mass: the same survey's mean. Mass fractions: de Leva 1996; the middle part of the trunk is
# divided equally between chest and waist.
MAN = Person(
    measures={name: male for name, (male, _) in _MEASURES.items()},
    mass=85.52,
    mass_fractions={
        "head": 0.0694,
        "chest": 0.1596 + 0.5 * 0.1633,
        "waist": 0.5 * 0.1633 + 0.1117,
        "upper_arm": 0.0271,
        "forearm": 0.0162,
        "hand": 0.0061,
        "thigh": 0.1416,
        "shin": 0.0433,
        "foot": 0.0137,
    },
    build={
        "name": "man",
        "bust": False,
        "jaw": 0.92,
        "chin": 1.2,
        "brow": 0.003,
        "natural_waist": 0.95,
        "ponytail": False,
        "muscle": 1.5,
        "colours": {
            "skin": (0.82, 0.62, 0.50),
            "hair": (0.16, 0.11, 0.08),
            "eye": (0.14, 0.10, 0.08),
            "lips": (0.66, 0.40, 0.36),
            "suit": (0.24, 0.29, 0.36),
            "shorts": (0.20, 0.22, 0.27),
        },
    },
)
WOMAN = Person(
    measures={name: female for name, (_, female) in _MEASURES.items()},
    mass=67.76,
    mass_fractions={
        "head": 0.0668,
        "chest": 0.1545 + 0.5 * 0.1465,
        "waist": 0.5 * 0.1465 + 0.1247,
        "upper_arm": 0.0255,
        "forearm": 0.0138,
        "hand": 0.0056,
        "thigh": 0.1478,
        "shin": 0.0481,
        "foot": 0.0129,
    },
    build={
        "name": "woman",
        "bust": True,
        "jaw": 0.80,
        "chin": 1.0,
        "brow": 0.0,
        "natural_waist": 0.86,
        "ponytail": True,
        "muscle": 1.0,
        "colours": {
            "skin": (0.87, 0.67, 0.56),
            "hair": (0.26, 0.15, 0.09),
            "eye": (0.16, 0.10, 0.08),
            "lips": (0.70, 0.32, 0.32),
            "suit": (0.12, 0.45, 0.50),
            "shorts": (0.17, 0.19, 0.25),
        },
    },
)
