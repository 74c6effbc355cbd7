"""The commands that the page of a replay holds for Meshcat."""

import base64
import re
from contextlib import suppress

import msgpack
import numpy as np


def played(page):
    """Return the Meshcat commands of a replay by (type, path)."""
    told = {}
    for text in re.findall(r"base64,([\w+/=]+)", page):
        with suppress(ValueError):
            command = msgpack.unpackb(base64.b64decode(text), strict_map_key=False)
            if isinstance(command, dict) and "type" in command:
                told[command["type"], command.get("path")] = command
    return told


def object_of(command):
    """Return the points (n, 3) of a command's object, their indices if any, and its material."""
    (geometry,), (material,) = (command["object"][key] for key in ("geometries", "materials"))
    data = geometry["data"]["attributes"]["position"]["array"].data
    return np.frombuffer(data, np.float32).reshape(-1, 3).astype(float), material


def tracks_of(told):
    """Return the positions by time of each animated path, and the steps per second."""
    clips = {one["path"]: one["clip"] for one in told["set_animation", None]["animations"]}
    positions = {
        path: {key["time"]: key["value"] for key in track["keys"]}
        for path, clip in clips.items()
        for track in clip["tracks"]
        if track["name"] == ".position"
    }
    (rate,) = {clip["fps"] for clip in clips.values()}
    return positions, rate
