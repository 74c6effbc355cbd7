"""Results do not depend on locale, time zone, threads, hash seeds or paths."""

import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.jobs.scenes import read_rows

NUMBERS = {
    "poses.csv": ("lift", "luff", "error"), "joints.csv": ("low", "high"),
    "modes.csv": ("value", "low", "high"),
}  # fmt: skip


def test_result_is_independent_of_locale_time_zone_and_threads(tiny_scene, tmp_path, out):
    far = tmp_path / "Größe 模型 mit Leerzeichen"
    shutil.copytree(tiny_scene.folder, far / "scene")
    model = Path(shutil.copyfile(tiny_scene.model, far / "Kran ü.urdf"))
    nowhere = tmp_path / "home"
    nowhere.write_text("a file, so that nothing can be written beneath it")
    threads = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    plain = {"PYTHONHASHSEED": "1", "LC_ALL": "C", "TZ": "UTC", **dict.fromkeys(threads, "1")}
    # A locale with a decimal comma, if there is one.
    other = {"PYTHONHASHSEED": "77", "LC_ALL": "de_DE.UTF-8", "TZ": "Asia/Kolkata"}
    other |= {"HOME": str(nowhere / "of" / "nobody"), **dict.fromkeys(threads, "2")}
    outs = out, far / "out ä"
    for scene, to, settings in (
        (tiny_scene, outs[0], plain),
        (replace(tiny_scene, folder=far / "scene", model=model), outs[1], other),
    ):
        words = [*scene.estimate(to), "--no-overlay", "--no-replay"]
        subprocess.run(
            [sys.executable, "-m", "drake_pose.commands.main", *words],
            env={**os.environ, **settings}, check=True, capture_output=True,
        )  # fmt: skip
    # With an empty cache of kernels, one joint differs by 0.04 degrees in one of about ten runs;
    # the cause is unknown. Rounding that depends on the alignment of arrays would explain it.
    for file, numbers in NUMBERS.items():
        tolerance = 2e-3 if file == "poses.csv" else 0.2
        rows = [read_rows(to / file) for to in outs]
        told = [[[float(row.pop(name)) for name in numbers] for row in own] for own in rows]
        assert told[0]
        np.testing.assert_allclose(*told, rtol=0.0, atol=tolerance)
        for row in (*rows[0], *rows[1]):
            row.pop("seconds", None)
        assert rows[0] == rows[1]
