"""What the papers say of their experiments, beside what comes out here.

Where a paper shows a picture and prints no number, its column says so in words.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from drake_pose.papers.kameda.experiment import PAPER as KAMEDA_A

Figures = Mapping[str, Any]


class Beside(NamedTuple):
    """One figure of a paper.

    Attributes:
        what: it is.
        paper: what the paper says.
        its_method: what the paper's own method reaches here.
        ours: what this project's own method reaches.
    """

    what: str
    paper: str
    its_method: str
    ours: str


_NONE = "-"


def kameda_a(figures: Figures) -> Sequence[Beside]:
    """Experiment A, of ``{"paper": ..., "beam": ...}``."""
    paper, beam = figures["paper"], figures["beam"]
    counted = {"exact": "silhouettes matched exactly", "pose_equal": "every joint angle right"}
    rows = [
        Beside(
            "mean E_total of poses found",
            *(f"{one['mean_e_total']:.2%}" for one in (KAMEDA_A, paper, beam)),
        )
    ]
    rows += [
        Beside(label, *(f"{one[key]} of {one['images']}" for one in (KAMEDA_A, paper, beam)))
        for key, label in counted.items()
    ]
    improved = [f"{one['improved']} of {one['images']}" for one in (KAMEDA_A, paper)]
    rows.append(Beside("improved by re-estimation", improved[0], improved[1], _NONE))
    runs = [f"{one['mean_runs']:.1f}" for one in (KAMEDA_A, paper)]
    rows.append(Beside("runs of step 3, mean", runs[0], runs[1], _NONE))
    seconds = (f"{one['median_seconds']:.2f}" for one in (paper, beam))
    return [*rows, Beside("processor seconds an image, median", _NONE, *seconds)]


def kameda_pictures(figures: Figures) -> Sequence[Beside]:
    """Experiments B and C, of ``{"paper": ..., "beam": ...}``."""
    paper, beam = figures["paper"], figures["beam"]
    said = f"{paper['paper_mean_e_total']:.1%} ({paper['paper_images']} pictures)"
    found = (f"{one['mean_e_total']:.1%} ({one['images']})" for one in (paper, beam))
    seconds = (f"{one['seconds_an_image']:.1f}" for one in (paper, beam))
    return [
        Beside("mean E_total", said, *found),
        Beside("processor seconds an image", _NONE, *seconds),
    ]


def shimada(figures: Figures) -> Sequence[Beside]:
    """The synthetic sequences, of ``{"paper": ..., "ours": ...}``."""
    both = (figures["paper"], figures["ours"])
    rows = []
    for key, true, figure in (("r13_35", 35, 15), ("r13_40", 40, 16)):
        cases = [one[key] for one in both]
        rows.append(
            Beside(
                f"r_13 after 55 frames where it is {true} [pixel]",
                f"right (figure {figure})",
                *(f"{c['r_13_mean']:.1f} (RMS error {c['r_13_rmse']:.1f})" for c in cases),
            )
        )
    inside = (f"{one['r13_35']['inside_2sigma']:.0%}" for one in both)
    angles = (f"{one['r13_35']['angle_rmse_at_end']:.1f}" for one in both)
    lost = (f"{one['r13_35']['lost'] + one['r13_40']['lost']} of {2 * one['runs']}" for one in both)
    return [
        *rows,
        Beside("truths within two deviations", "in its figures 12 to 16", *inside),
        Beside("joint angles at the end, RMS error [deg]", "right (figure 14)", *angles),
        Beside("sequences lost", "none of two", *lost),
    ]


def shimada_hypotheses(figures: Figures) -> Sequence[Beside]:
    """Figure 9, of ``{"paper": ..., "ours": ...}``."""
    paper, ours = figures["paper"], figures["ours"]
    lived = f"{paper['frames_lived_median'] or 0:g} (median)"
    later = (str(one["rejected_later_than_made"]) for one in (paper, ours))
    coupled = str(paper["of_these_by_coupled_joints"])
    return [
        Beside("hypotheses rejected later than made", "one is shown", *later),
        Beside("of these wrong", "that one", str(paper["of_these_wrong"]), _NONE),
        Beside("frames from its birth to its end", "2 (18 to 20)", lived, _NONE),
        Beside("as two joints do not bend alike", "that one", coupled, _NONE),
    ]


def shimada_static(figures: Figures) -> Sequence[Beside]:
    """One unchanging view, of ``{"paper": ..., "ours": ...}``."""
    marks = [mark for mark in figures["ours"]["static_frames"] if mark.isdigit()]
    rows = []
    for mark in marks:
        at = [figures[way]["static_frames"][mark] for way in ("paper", "ours")]
        nees = (f"{one['nees_per_dof']:.2f}" for one in at)
        what = f"lengths' NEES a degree of freedom after {mark} frames (1: honest)"
        rows.append(Beside(what, "may grow (section 7)", *nees))
    return rows


def date(figures: Figures) -> Sequence[Beside]:
    """The captured person."""
    rows = []
    for joint in ("elbow", "knee"):
        found = f"{figures[f'{joint}_ik_mm']:.0f} to {figures[f'{joint}_mm']:.0f}"
        all_at_once = f"{figures[f'{joint}s']['silhouette_mm']:.1f} (all motions)"
        what = f"{joint}s, upright: by inverse kinematics alone, then with the search [mm]"
        rows.append(Beside(what, "wrong, then right (figure 7)", found, all_at_once))
    whole = f"{figures['ms_per_frame']['all']:.0f} ms, one core"
    back = (
        "not"
        if figures["frames_to_recover_registered"] is None
        else str(figures["frames_to_recover_registered"])
    )
    return [
        *rows,
        Beside("a frame", "real time, a cluster (15 ms for the face)", _NONE, whole),
        Beside("frames until right when the registered pose is shown", "that frame", _NONE, back),
    ]
