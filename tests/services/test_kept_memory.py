"""What is freed is kept: arrays of the next frame bring few page faults."""

import platform
import subprocess
import sys

import pytest

SCRIPT = """
import resource, sys
import numpy as np
from deltalight.services.kept_memory import keep_freed_memory

if sys.argv[1] == "kept":
    keep_freed_memory()

def frame():
    arrays = [np.ones(1 << 20) for _ in range(8)]  # 64 MB

frame()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
frame()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(how: str) -> int:
    command = [sys.executable, "-c", SCRIPT, how]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other C libraries keep what they like")
def test_arrays_of_a_second_frame_bring_few_page_faults() -> None:
    assert faults("kept") < faults("as usual") / 10
