"""Benchmark of several processes: a batch on workers, and images sent by LCM (`make bench`).

Milliseconds are CPU time, so a busy machine affects only the frames per second.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from drake import lcmt_image_array
from pydrake.common.value import AbstractValue
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import (
    ImageLabel16I,
    ImageRgba8U,
    ImageToLcmImageArrayT,
    LcmImageArrayToImages,
    PixelType,
)

from drake_pose.body import bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.batch import run_batch
from drake_pose.jobs.batch_tasks import SceneJob
from drake_pose.jobs.cluster import open_cluster
from drake_pose.papers.kameda import experiment_camera
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.tables import print_table
from tests.written_files import write_mask

if TYPE_CHECKING:
    from distributed import Client


def write_stills(folder: Path, count: int = 8, chunk: int = 2) -> SceneJob:
    """Write a scene of Kameda's woman with random arm poses, and return the job for it."""
    model_path = bundled_model("woman")
    model = load_model(model_path, check=False)
    camera = experiment_camera()
    renderer = LabelRenderer(model, camera)
    (folder / "masks" / camera.name).mkdir(parents=True)
    save_cameras(folder / "cameras.yaml", [camera])
    generator = np.random.default_rng(0)
    moves = np.array(["arm" in name for name in model.position_names])
    rest = np.where(np.array(model.position_kinds) == "angle", model.default_positions, 0.0)
    for k in range(count):
        drawn = 0.4 * generator.uniform(model.lower, model.upper)
        q = np.where(moves, np.clip(drawn, model.lower, model.upper), rest)
        write_mask(folder / "masks" / camera.name / f"{k:04d}.png", renderer.mask(q))
    hold = {
        name: float(np.degrees(value))
        for name, value, free in zip(model.position_names, rest, moves, strict=True)
        if not free
    }
    settings = EstimateSettings(hold=hold, method="beam")
    return SceneJob("stills", folder, model_path, settings, replay=False, chunk=chunk)


def measure_batch(job: SceneJob, out: Path, client: Client | None) -> float:
    """Return frames per second of a batch, without the time to compile and to start workers."""
    settings = replace(job.settings, frames=("0000",))
    warm_up = [replace(job, name=f"warm_up_{k}", settings=settings) for k in range(2)]
    run_batch(warm_up, out / "warm_up", client)
    begin = time.perf_counter()
    result = run_batch([job], out / "out", client)
    return result.scenes[job.name].frame_count / (time.perf_counter() - begin)


def measure_lcm(
    image: ImageLabel16I | ImageRgba8U, kind: PixelType, count: int = 60
) -> tuple[float, float]:
    """Return the CPU time to send and to receive an image [ms], by multicast on this machine."""
    url = "udpm://239.255.76.67:7691?ttl=0&recv_buf_size=4000000"
    sends, receives = DiagramBuilder(), DiagramBuilder()
    source = sends.AddSystem(ConstantValueSource(AbstractValue.Make(image)))
    packer = sends.AddSystem(ImageToLcmImageArrayT(do_compress=True))
    sends.Connect(source.get_output_port(), packer.DeclareImageInputPort[kind]("image"))
    publisher = sends.AddSystem(
        LcmPublisherSystem.Make("IMAGE", lcmt_image_array, DrakeLcm(url), 0.1, True)
    )
    sends.Connect(packer.get_output_port(), publisher.get_input_port())
    lcm = receives.AddSystem(LcmInterfaceSystem(DrakeLcm(url)))
    subscriber = receives.AddSystem(
        LcmSubscriberSystem.Make("IMAGE", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    images = receives.AddSystem(LcmImageArrayToImages())
    receives.Connect(subscriber.get_output_port(), images.get_input_port())
    name = "label_image" if kind == PixelType.kLabel16I else "color_image"
    receives.ExportOutput(images.GetOutputPort(name), name)
    ends = [Simulator(builder.Build()) for builder in (sends, receives)]
    seconds = np.zeros((count, 2))
    for k in range(count):
        for end, simulator in enumerate(ends):
            begin = time.process_time()
            simulator.AdvanceTo(0.1 * (k + 1))
            if end:
                context = simulator.get_context()
                simulator.get_system().get_output_port().Eval(context)
            seconds[k, end] = time.process_time() - begin
            # Let the network thread work.
            time.sleep(0.02)
    context = ends[1].get_context()
    received = ends[1].get_system().get_output_port().Eval(context)
    assert np.array_equal(received.data, image.data), "pictures were lost"
    sent, got = 1e3 * np.median(seconds, axis=0)
    return float(sent), float(got)


def main() -> None:
    """Print the speed-up by workers and the cost of LCM."""
    with tempfile.TemporaryDirectory() as name, open_cluster(1) as one, open_cluster(2) as two:
        folder, who = Path(name), {"this process": None, "1 worker": one, "2 workers": two}
        job = write_stills(folder / "stills")
        rates = [measure_batch(job, folder / f"batch_{k}", who[k]) for k in who]
    rows = [
        (k, f"{rate:.2f}", f"{rate / rates[0]:.2f}") for k, rate in zip(who, rates, strict=True)
    ]
    print_table("Batch: 8 stills in chunks of 2", ("who", "frames a second", "ratio"), rows)
    y, x = np.mgrid[:480, :640]
    label, colour = ImageLabel16I(640, 480), ImageRgba8U(640, 480)
    label.mutable_data[:, :, 0] = np.where(np.hypot(x - 320, 2.0 * (y - 240)) < 150, 1, 32766)
    noise = np.random.default_rng(0).integers(0, 8, (480, 640))
    colour.mutable_data[:] = ((x + y) // 5 + noise)[:, :, None]
    rows = []
    for image, kind in ((label, PixelType.kLabel16I), (colour, PixelType.kRgba8U)):
        sent, got = measure_lcm(image, kind)
        rows.append((kind.name, f"{sent:.1f} ms", f"{got:.1f} ms"))
    print_table(
        "640 x 480 pixels, compressed, by LCM: processor time",
        ("image", "to send", "to receive"),
        rows,
    )


if __name__ == "__main__":
    main()
