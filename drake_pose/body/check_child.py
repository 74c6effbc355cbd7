"""The process behind safety.py: reads a model, and prints why it cannot be used ("": it can)."""

import json
import os
import sys

from drake_pose.body.formats.safety import why_unusable
from drake_pose.body.model import read_model

if __name__ == "__main__":
    print("\n" + json.dumps(why_unusable(read_model, *sys.argv[1:])), flush=True)
    os._exit(0)  # What a broken file left behind may crash on the way out.
