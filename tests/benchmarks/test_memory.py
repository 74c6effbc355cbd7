"""Peak memory of processes whose memory is known."""

import os

import psutil
import pytest

from drake_pose.commands.main import app
from tests.benchmarks.memory import benchmark_commands, measure_memory

_ONE, _OTHER = 200, 500
MIB = 2**20


@pytest.mark.slow
def test_memory_is_that_of_the_process():
    # Filled, because pages that nobody wrote take none.
    def took(size):
        floor = psutil.Process(os.getpid()).memory_info().rss // MIB
        program = ("-c", f"import sys; b = b'x' * ({floor + size} * {MIB}); sys.exit(3)")
        return measure_memory(["word"], program), floor

    for size in (_ONE, _OTHER):
        found, floor = took(size)
        assert found.mebibytes == pytest.approx(floor + size, abs=40)
        assert (found.exit_code, found.words) == (3, ("word",))


def test_every_command_of_the_benchmark_is_one(tmp_path):
    for words in benchmark_commands(tmp_path):
        # Parses without running it; an option that is none raises.
        app.parse_args(list(words), exit_on_error=False, print_error=False)
