"""The package deltalight: a wheel holds all of it alone and works anywhere; its dependencies are pinned."""

import fcntl
import json
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from contextlib import closing
from pathlib import Path

import pytest

from deltalight.services.storage import asset_sandbox
from deltalight.services.storage.asset_sandbox import ONE_THREAD, WORKER, probe
from deltalight.services.storage.worker_forks import WorkerForks
from tests.services.storage_samples import TETRAHEDRON

ROOT = Path(__file__).resolve().parents[1]
ROOMS = ("protocol", "sensor_node", "render_server", "services", "benchmarks")
DASHBOARD = ROOT / "services" / "dashboard"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PINNED = re.compile(r"^([\w-]+)==", re.MULTILINE)
PLACES = "import sys, deltalight, deltalight.protocol as room; print(*deltalight.__path__, room.__file__, sep='\\n')"


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """A folder whose modules have the names of ours."""
    folder = tmp_path / "foreign"
    folder.mkdir()
    for name in ("deltalight", *ROOMS):
        (folder / f"{name}.py").write_text("raise SystemExit('imported from the folder of the call')")
    return folder


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    options = ("--no-deps", "--no-build-isolation", "--no-index", "--wheel-dir", folder)
    with (ROOT / "hatch_build.py").open() as lock:
        fcntl.flock(
            lock, fcntl.LOCK_EX
        )  # builds in the checkout itself, where another worker may do the same
        _run(sys.executable, "-m", "pip", "wheel", *options, ROOT)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Programs of a virtual environment with the wheel and the packages of this one, without the checkout."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder)
    python = folder / "bin" / "python"
    packages = sysconfig.get_path("purelib", vars={"base": str(folder)})
    Path(packages, "shared.pth").write_text(
        sysconfig.get_path("purelib")
    )  # whose own .pth files count for nothing
    _run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--no-index", wheel)
    return python.parent


def _run(*command: str | Path, cwd: Path = ROOT) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    words = [str(word) for word in command]
    done = subprocess.run(words, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_importing_the_package_imports_nothing_else() -> None:
    code = "import sys; before = {*sys.modules}; import deltalight; print(*{*sys.modules} - before)"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "deltalight" in done.stdout.split()
    assert not [name for name in done.stdout.split() if name.startswith(("deltalight.", "numpy"))]


@pytest.mark.slow
def test_a_wheel_holds_all_files_below_one_name(wheel: Path) -> None:
    listed = ("git", "ls-files", "--cached", "--others", "--exclude-standard", "--", "deltalight", *ROOMS)
    files = {Path(name) for name in _run(*listed).splitlines()}
    kept = {name for name in files if not (ROOT / name).is_relative_to(DASHBOARD)}
    built = (path for path in (DASHBOARD / "dist").rglob("*") if path.is_file() and path.name != ".built")
    kept |= {path.relative_to(ROOT) for path in built}
    names = set(zipfile.ZipFile(wheel).namelist())
    info = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    assert names - info == {str(Path("deltalight", *_inside(name))) for name in kept}
    assert {"deltalight/py.typed", "deltalight/services/dashboard/dist/index.html"} <= names


def _inside(name: Path) -> tuple[str, ...]:
    return name.parts[1:] if name.parts[0] == "deltalight" else name.parts


@pytest.mark.slow
def test_an_installed_wheel_works_in_any_folder(installed: Path, foreign: Path) -> None:
    package, room = map(Path, _run(installed / "python", "-P", "-c", PLACES, cwd=foreign).splitlines())
    assert package.is_relative_to(installed.parent)
    assert room.is_relative_to(package)
    program = installed / "deltalight"
    assert _run(program, "--version", cwd=foreign).split()[0] == "deltalight"
    checks = {
        check["name"]: check["state"] for check in json.loads(_run(program, "doctor", "--json", cwd=foreign))
    }
    assert checks["OpenGL device 0"] == "ok"
    options = ("--headless", "--frames", "1", "--method", "paper", "--out", "out", "--json")
    done = json.loads(_run(program, "demo", *options, cwd=foreign))
    assert set(done["restarts"].values()) == {0}
    assert (foreign / "out" / "000000.jpg").is_file()


@pytest.mark.parametrize("is_forked", [asset_sandbox.CAN_FORK, False])
def test_the_process_that_checks_assets_imports_nothing_from_the_folder(
    foreign: Path, monkeypatch: pytest.MonkeyPatch, *, is_forked: bool
) -> None:
    path = foreign / "tetrahedron.obj"
    path.write_bytes(TETRAHEDRON)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.chdir(foreign)
    monkeypatch.setattr(asset_sandbox, "CAN_FORK", is_forked)
    with closing(WorkerForks(WORKER, ONE_THREAD)) as forks:  # which imports all here
        monkeypatch.setattr(asset_sandbox, "_forks", forks)
        assert probe(path, "mesh", path.name)["triangles"] == 4


def _names(requirements: list[str]) -> set[str]:
    return {re.split(r"[^\w-]", requirement)[0].lower() for requirement in requirements}


def test_every_dependency_is_pinned_also_those_of_other_machines() -> None:
    pinned = {*PINNED.findall((ROOT / "requirements.lock").read_text())}
    assert _names([*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["client"]]) <= pinned
    node = (ROOT / "deploy" / "node.in").read_text().splitlines()[1:]
    assert _names(node) <= _names([*PROJECT["dependencies"], *PROJECT["optional-dependencies"]["oak"]])
    assert _names(node) <= {*PINNED.findall((ROOT / "deploy" / "node.lock").read_text())}
    fleet = (ROOT / "deploy" / "fleet.in").read_text().splitlines()[2:]
    extras = (PROJECT["optional-dependencies"][name] for name in ("cluster", "postgres", "s3"))
    assert _names(fleet) == _names([each for extra in extras for each in extra])
    assert _names(fleet) <= {*PINNED.findall((ROOT / "deploy" / "fleet.lock").read_text())}
