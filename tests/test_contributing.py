"""The examples of docs/contributing.md, applied to a copy of the project: they fit, work, and touch few files."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "contributing.md").read_text(encoding="utf-8")
PLUGINS = (ROOT / "docs" / "plugins.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^## (.*?)\n(.*?)(?=^## |\Z)", PAGE, re.DOTALL | re.MULTILINE))
NEW_FILE = re.compile(r"```(?:python|glsl)\n(?:#|//) (\S+)\n(.*?)```", re.DOTALL)
CHANGE = re.compile(r"```diff\n--- (\S+)\n(.*?)```", re.DOTALL)
LISTED = re.compile(r"^\| `([^`]+)` \|", re.MULTILINE)
MOST_FILES = {"A pass": 3, "A type of light": 6, "A method": 3, "A camera driver": 2}
GENERATED = "services/dashboard/src/api/schema.ts"


def files_of(title: str) -> dict[str, str]:
    """The new files of a section with their text."""
    found = dict(NEW_FILE.findall(SECTIONS[title]))
    if title == "A camera driver":
        (module,) = re.findall(r"```python\n# bars_camera\.py\n(.*?)```", PLUGINS, re.DOTALL)
        found["sensor_node/cameras/bars.py"] = module
    return found


def changed(text: str, change: str) -> str:
    """Applies the hunks of a diff, each at the one place where its old lines are."""
    for hunk in change.split("@@\n")[1:]:
        lines = hunk.splitlines(keepends=True)
        old, new = ("".join(line[1:] or line for line in lines if line[0] != sign) for sign in "+-")
        assert text.count(old) == 1, f"there are {text.count(old)} places for:\n{hunk}"
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project with all examples in it."""
    folder = tmp_path_factory.mktemp("copy")
    for part in ("deltalight", "protocol", "render_server", "sensor_node", "services/dashboard/src/forms"):
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    for title, section in SECTIONS.items():
        for path, text in files_of(title).items():
            assert not (folder / path).exists()
            (folder / path).write_text(text)
        for path, change in CHANGE.findall(section):
            (folder / path).write_text(changed((folder / path).read_text(), change))
    return folder


@pytest.mark.parametrize("title", MOST_FILES)
def test_every_file_is_listed_and_there_are_few(title: str) -> None:
    touched = {*files_of(title), *(path for path, _ in CHANGE.findall(SECTIONS[title]))}
    listed = set(LISTED.findall(SECTIONS[title]))
    assert listed - {GENERATED} == touched
    assert 0 < len(listed) <= MOST_FILES[title]


SCRIPT = """
import sys
from pathlib import Path

import numpy as np
import trimesh
from deltalight import protocol
from deltalight.protocol.camera_model import CameraModel
from deltalight.protocol.frames import BoardPose, ViewFrame
from deltalight.protocol.scene import parse_scene
from deltalight.render_server.gpu.context import create_context
from deltalight.render_server.renderer import SceneRenderer
from deltalight.sensor_node.cameras.open import open_camera
from deltalight.sensor_node.cameras.settings import CameraSettings

folder = Path(sys.argv[1])
assert Path(protocol.__file__).is_relative_to(folder)
with open_camera("bars:4", CameraSettings(width=64, height=48, fps=500)) as camera:
    assert camera.read().color[0, :5, 0].tolist() == [100] * 4 + [200]

for name, extents, height in (("floor", (4, 4, 0.02), -0.01), ("cube", (0.2, 0.2, 0.2), 0.1)):
    mesh = trimesh.creation.box(extents)
    mesh.apply_translation((0, 0, height))
    mesh.export(folder / f"{name}.ply")
pose = np.diag([1.0, -1.0, -1.0, 1.0])  # from above, the picture's right is +x
pose[2, 3] = 1.5
camera = CameraModel(64, 48, np.array([[50.0, 0, 31.5], [0, 50.0, 23.5], [0, 0, 1]]))
frame = ViewFrame(0, 0, np.full((48, 64, 3), 150, np.uint8), camera, pose=BoardPose(pose))
gpu, green = create_context(), {}
for kind in ("sphere", "downlight"):
    lamp = {"type": kind, "position_m": [-0.9, 0, 1], "intensity": 2, "radius_m": 0}
    renderer = SceneRenderer(gpu, parse_scene({
        "real": {"geometry": {"model": str(folder / "floor.ply")}},
        "objects": [{"asset": str(folder / "cube.ply"), "material": {"base_color": [0.5] * 3, "specular": 0}}],
        "lights": {"manual": [lamp, {"type": "ambient", "radiance": 0.2}], "surroundings": "none"},
        "method": {"name": "draft"},
    }))
    green[kind] = renderer.render(frame, with_linear=True).linear[..., 1]
    assert "vignette" in renderer.graph
    assert renderer.graph["light set"].lights[0].describe()["type"] == kind
    renderer.release()
top = np.s_[22:26, 30:34]  # of the cube, seen from the lamp about 48 degrees from its axis
assert 0.5 < green["downlight"][top].mean() / green["sphere"][top].mean() < 0.9
shadow = np.s_[22:26, 36:39]
assert (green["sphere"][shadow] < green["sphere"][22:26, 5:10].mean()).all()
assert (green["downlight"][shadow] < green["downlight"][22:26, 5:10].mean()).all()
"""


@pytest.mark.slow
def test_the_examples_work(copy: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(copy)],
        cwd=copy,
        env={**os.environ, "PYTHONPATH": str(copy)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_the_examples_fit(copy: Path) -> None:
    for title in SECTIONS:
        for path in files_of(title):
            assert (copy / path).is_file()
            if path.endswith(".py"):
                compile((copy / path).read_text(), path, "exec")


def test_floors_installs_what_its_tests_import() -> None:
    tools = re.search(r"TEST_TOOLS=\((.*?)\)", (ROOT / ".ci" / "floors").read_text())
    assert tools is not None
    collected = [path for path in (ROOT / "tests" / "services").glob("*.py") if "dashboard" not in path.name]
    for module in ("playwright", "psutil", "hypothesis", "pypdfium2"):
        if any(
            re.search(rf"^(import|from) {module}\b", path.read_text(), re.MULTILINE) for path in collected
        ):
            assert module in tools[1].split(), module


def test_docstrings_say_what_functions_do() -> None:
    """Those of commands and routes are shown to users, as instructions."""
    instruction = re.compile(r'^ *"""(Return|Yield|Write|Read|Send|Check) ', re.MULTILINE)
    shown = ("benchmarks/cli.py", "services/api/routes/", "services/commands/")
    folders = ("benchmarks", "deltalight", "protocol", "render_server", "sensor_node", "services")
    modules = [path.relative_to(ROOT) for folder in folders for path in (ROOT / folder).rglob("*.py")]
    wrong = [
        str(module)
        for module in modules
        if "node_modules" not in module.parts
        and not str(module).startswith(shown)
        and instruction.search((ROOT / module).read_text("utf-8"))
    ]
    assert len(modules) > 600
    assert not wrong
