"""Writes woman.urdf and its meshes; see --help."""

import sys
from pathlib import Path

# ANSUR II, 2012, female means (n = 1986) [m]: Gordon et al. 2014, Natick/TR-15/007, public data.
MEASURES = {
    "stature": 1.6285,
    "acromialheight": 1.3351,
    "acromionradialelength": 0.3112,
    "anklecircumference": 0.2157,
    "axillaheight": 1.2390,
    "balloffootlength": 0.1821,
    "biacromialbreadth": 0.3653,
    "bicepscircumferenceflexed": 0.3056,
    "bicristalbreadth": 0.2733,
    "bideltoidbreadth": 0.4503,
    "bizygomaticbreadth": 0.1338,
    "buttockdepth": 0.2329,
    "buttockheight": 0.8337,
    "calfcircumference": 0.3733,
    "cervicaleheight": 1.3957,
    "chestbreadth": 0.2693,
    "chestdepth": 0.2474,
    "chestheight": 1.1716,
    "crotchheight": 0.7823,
    "earlength": 0.0594,
    "footbreadthhorizontal": 0.0927,
    "footlength": 0.2463,
    "forearmcircumferenceflexed": 0.2641,
    "handbreadth": 0.0782,
    "handlength": 0.1811,
    "headbreadth": 0.1478,
    "headlength": 0.1898,
    "heelbreadth": 0.0672,
    "hipbreadth": 0.3538,
    "lateralfemoralepicondyleheight": 0.4659,
    "lateralmalleolusheight": 0.0627,
    "lowerthighcircumference": 0.4007,
    "mentonsellionlength": 0.1131,
    "neckcircumference": 0.3298,
    "neckcircumferencebase": 0.3712,
    "palmlength": 0.1087,
    "radialestylionlength": 0.2413,
    "suprasternaleheight": 1.3297,
    "tenthribheight": 1.0563,
    "thighcircumference": 0.6161,
    "tragiontopofhead": 0.1265,
    "trochanterionheight": 0.8454,
    "waistbreadth": 0.2999,
    "waistdepth": 0.2130,
    "waistheightomphalion": 0.9801,
    "wristcircumference": 0.1548,
}
# Whole mass: the same survey's mean.  Shares: de Leva 1996; the trunk's middle part is
# halved between chest and waist.
MASS = 67.76
MASS_SHARES = {
    "head": 0.0668,
    "chest": 0.1545 + 0.5 * 0.1465,
    "waist": 0.5 * 0.1465 + 0.1247,
    "upper_arm": 0.0255,
    "forearm": 0.0138,
    "hand": 0.0056,
    "thigh": 0.1478,
    "shin": 0.0481,
    "foot": 0.0129,
}
COLOURS = {
    "skin": (0.87, 0.67, 0.56),
    "hair": (0.26, 0.15, 0.09),
    "eye": (0.16, 0.10, 0.08),
    "lips": (0.70, 0.32, 0.32),
    "suit": (0.12, 0.45, 0.50),
    "shorts": (0.17, 0.19, 0.25),
}


def main() -> None:
    """Read the command line and write the model."""
    here = Path(__file__).resolve().parent
    sys.path.insert(0, str(here.parent))
    from body_generator.script import run

    run(
        here,
        MEASURES,
        MASS,
        skin=True,
        name="woman",
        bust=True,
        jaw=0.80,
        chin=1.0,
        brow=0.0,
        natural_waist=0.86,
        ponytail=True,
        muscle=1.0,
        mass_shares=MASS_SHARES,
        colours=COLOURS,
    )


if __name__ == "__main__":
    main()
