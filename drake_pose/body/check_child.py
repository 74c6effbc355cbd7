"""The child process of safety.py: read one model as load_model would, and say how it went.

Run as ``python -m drake_pose.body.check_child FILE PACKAGES LIMITS``; the last line of its output
is JSON.
"""

import json
import sys
from contextlib import suppress
from pathlib import Path

from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body.files.parsing import captured_warnings
from drake_pose.body.files.safety import MEMORY_LIMIT_BYTES
from drake_pose.body.model import read_model
from drake_pose.errors import DrakePoseError


def limit_memory() -> None:
    """Let this process fail, rather than the machine, when a model takes too much memory."""
    with suppress(ImportError, ValueError, OSError):
        import resource  # Absent on Windows.

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT_BYTES, MEMORY_LIMIT_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main() -> None:
    """Read the model, give it to a renderer, and print the verdict."""
    limit_memory()
    path = Path(sys.argv[1])
    try:
        model = read_model(path, json.loads(sys.argv[2]), json.loads(sys.argv[3]))
        plant = MultibodyPlant(time_step=0.0)
        scene_graph = SceneGraph()
        model.add_to(plant, scene_graph)
        with captured_warnings():
            scene_graph.AddRenderer("check", MakeRenderEngineVtk(RenderEngineVtkParams()))
        answer = {"usable": True, "reason": ""}
    except DrakePoseError as error:
        answer = {"usable": False, "reason": str(error)}
    except RuntimeError as error:
        answer = {"usable": False, "reason": f"{path}: {error}"}
    except MemoryError:
        limit = f"{MEMORY_LIMIT_BYTES // 2**30} GiB"
        reason = f"{path}: reading it needs more than {limit} of memory; make its meshes smaller"
        answer = {"usable": False, "reason": reason}
    print("\n" + json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
