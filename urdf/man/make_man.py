"""Writes man.urdf and its meshes; see --help."""

import sys
from pathlib import Path

# ANSUR II, 2012, male means (n = 4082) [m]: Gordon et al. 2014, Natick/TR-15/007, public data.
MEASURES = {
    "stature": 1.7562,
    "acromialheight": 1.4407,
    "acromionradialelength": 0.3352,
    "anklecircumference": 0.2293,
    "axillaheight": 1.3291,
    "balloffootlength": 0.2009,
    "biacromialbreadth": 0.4157,
    "bicepscircumferenceflexed": 0.3581,
    "bicristalbreadth": 0.2754,
    "bideltoidbreadth": 0.5104,
    "bizygomaticbreadth": 0.1426,
    "buttockdepth": 0.2458,
    "buttockheight": 0.8879,
    "calfcircumference": 0.3923,
    "cervicaleheight": 1.5173,
    "chestbreadth": 0.2894,
    "chestdepth": 0.2538,
    "chestheight": 1.2911,
    "crotchheight": 0.8459,
    "earlength": 0.0642,
    "footbreadthhorizontal": 0.1019,
    "footlength": 0.2712,
    "forearmcircumferenceflexed": 0.3101,
    "handbreadth": 0.0883,
    "handlength": 0.1933,
    "headbreadth": 0.1543,
    "headlength": 0.1995,
    "heelbreadth": 0.0725,
    "hipbreadth": 0.3457,
    "lateralfemoralepicondyleheight": 0.4917,
    "lateralmalleolusheight": 0.0729,
    "lowerthighcircumference": 0.4093,
    "mentonsellionlength": 0.1226,
    "neckcircumference": 0.3976,
    "neckcircumferencebase": 0.4346,
    "palmlength": 0.1165,
    "radialestylionlength": 0.2679,
    "suprasternaleheight": 1.4386,
    "tenthribheight": 1.1207,
    "thighcircumference": 0.6251,
    "tragiontopofhead": 0.1311,
    "trochanterionheight": 0.9009,
    "waistbreadth": 0.3264,
    "waistdepth": 0.2378,
    "waistheightomphalion": 1.0565,
    "wristcircumference": 0.1759,
}
# Whole mass: the same survey's mean.  Shares: de Leva 1996; the trunk's middle part is
# halved between chest and waist.
MASS = 85.52
MASS_SHARES = {
    "head": 0.0694,
    "chest": 0.1596 + 0.5 * 0.1633,
    "waist": 0.5 * 0.1633 + 0.1117,
    "upper_arm": 0.0271,
    "forearm": 0.0162,
    "hand": 0.0061,
    "thigh": 0.1416,
    "shin": 0.0433,
    "foot": 0.0137,
}
COLOURS = {
    "skin": (0.82, 0.62, 0.50),
    "hair": (0.16, 0.11, 0.08),
    "eye": (0.14, 0.10, 0.08),
    "lips": (0.66, 0.40, 0.36),
    "suit": (0.24, 0.29, 0.36),
    "shorts": (0.20, 0.22, 0.27),
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
        name="man",
        bust=False,
        jaw=0.92,
        chin=1.2,
        brow=0.003,
        natural_waist=0.95,
        ponytail=False,
        muscle=1.5,
        mass_shares=MASS_SHARES,
        colours=COLOURS,
    )


if __name__ == "__main__":
    main()
