"""The process behind safety.py: reads a model, and prints why it cannot be used ("": it can)."""

import json
import os
import sys
from contextlib import suppress
from pathlib import Path

from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body.formats.parsing import captured_warnings
from drake_pose.body.formats.safety import MEMORY_LIMIT_BYTES
from drake_pose.body.model import read_model
from drake_pose.errors import DrakePoseError


def main() -> None:
    """Read the model of the arguments: its file, packages and limits."""
    path, packages, limits = sys.argv[1:]
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    reason = ""
    try:
        model = read_model(Path(path), json.loads(packages), json.loads(limits))
        scene_graph = SceneGraph()
        model.add_to(MultibodyPlant(time_step=0.0), scene_graph)
        with captured_warnings():
            scene_graph.AddRenderer("check", MakeRenderEngineVtk(RenderEngineVtkParams()))
    except DrakePoseError as error:
        reason = str(error)
    except RuntimeError as error:
        reason = f"{path}: {error}"
    except MemoryError:
        limit = f"{MEMORY_LIMIT_BYTES // 2**30} GiB"
        reason = f"{path}: reading it needs more than {limit} of memory; make its meshes smaller"
    print("\n" + json.dumps(reason), flush=True)
    os._exit(0)  # What a broken file left behind may crash on the way out.


if __name__ == "__main__":
    main()
