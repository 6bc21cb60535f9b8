"""`bench quality` as a process, killed between two results: the next run takes what is there."""

import importlib.util
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

if importlib.util.find_spec("mitsuba") is None:
    pytest.skip("Mitsuba is not installed (dev extra)", allow_module_level=True)

pytestmark = pytest.mark.slow(seconds=15)
ROOT = Path(__file__).parents[2]
SCENE = "natural_light"
SIZE = ("--size", "72x54", "--spp", "8", "--volume", "32")
PATIENCE_S = 120.0


def test_a_killed_run_goes_on_with_its_truth_and_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    out, kept = tmp_path / "quality", tmp_path / ".quality.partial"
    chosen = ("--scenes", SCENE, "--methods", "camera,none", *SIZE, "--out", str(out))
    command = [sys.executable, "-m", "deltalight.services.cli", "bench", "quality", *chosen]
    with subprocess.Popen(command, cwd=ROOT, stderr=subprocess.DEVNULL) as process:
        deadline_s = time.monotonic() + PATIENCE_S
        while not list(kept.glob("*.npz")):
            assert process.poll() is None
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        process.kill()
    assert process.returncode == -signal.SIGKILL
    assert not out.exists()
    (result,) = kept.glob("*.npz")
    (truth,) = (tmp_path / "cache" / "ground-truth").glob(f"{SCENE}-*")
    pictures = {path: path.stat().st_ino for path in truth.rglob("*.npy")}
    with np.load(result) as arrays:
        camera = json.loads(arrays["about"].tobytes())["figures"]

    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=PATIENCE_S)
    assert again.returncode == 0, again.stderr
    assert "1 results are from the run that was cut off." in again.stderr
    variants = json.loads((out / "quality.json").read_text())["scenes"][SCENE]["variants"]
    assert variants["camera"]["figures"] == {
        name: value if math.isfinite(value) else None for name, value in camera.items()
    }
    assert "none" in variants
    assert {path: path.stat().st_ino for path in truth.rglob("*.npy")} == pictures
    assert not kept.exists()
