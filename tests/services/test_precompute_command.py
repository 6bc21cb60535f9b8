"""`deltalight precompute`: computed once, kept, gone on with after a kill, broken off without a trace."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import trimesh
from PIL import Image

from tests.render_server.brdf_samples import brdf_file, grey_brdf
from tests.services.conftest import ROOT, RunCli

PATIENCE_S = 60.0


def scene_with(folder: Path, **changes: object) -> Path:
    trimesh.creation.box((0.2, 0.2, 0.2)).export(folder / "box.ply")
    path = folder / "scene.json"
    objects = [{"id": "box", "asset": "box.ply"}]
    path.write_text(
        json.dumps({"objects": objects, "shading": {"name": "precomputed", "rays": 64}, **changes})
    )
    return path


@pytest.fixture
def kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache/precomputed-transfer"


def test_computes_once_with_a_bar(
    cli: RunCli, tmp_path: Path, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    scene = scene_with(tmp_path)
    done = cli("precompute", str(scene))
    assert done.returncode == 0, done.stderr
    assert "object `box`: light transfer of" in done.stdout
    assert "light transfer of `box`" in done.stderr
    (file,) = kept.glob("*.npz")
    before = file.read_bytes()
    again = cli("precompute", str(scene))
    assert again.stdout == done.stdout
    assert "light transfer of `box`" not in again.stderr
    assert file.read_bytes() == before


def test_fields_of_a_scene_with_aroof(cli: RunCli, tmp_path: Path, kept: Path) -> None:
    method = {"name": "aroof", "shells": 2, "resolution": 12, "rays": 64}
    done = cli("precompute", str(scene_with(tmp_path, method=method, shading={})))
    assert done.stdout == "object `box`: occlusion field of 2 shells\n"
    assert not kept.exists()
    assert len(list(kept.with_name("occlusion-fields").glob("*.npz"))) == 1


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.slow(seconds=8)
def test_a_killed_process_leaves_what_is_done_and_the_next_goes_on(
    cli: RunCli, tmp_path: Path, kept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    trimesh.creation.icosphere(3).export(tmp_path / "ball.ply")
    objects = [{"id": "box", "asset": "box.ply"}, {"id": "ball", "asset": "ball.ply"}]
    method = {"name": "aroof", "shells": 3, "resolution": 16, "rays": 64}
    scene = str(scene_with(tmp_path, objects=objects, method=method))
    fields = kept.with_name("occlusion-fields")
    command = [sys.executable, "-m", "deltalight.services.cli", "precompute", scene]
    with subprocess.Popen(
        command, cwd=ROOT, text=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as process:
        assert process.stdout is not None
        box = [process.stdout.readline() for _ in range(2)]
        assert "light transfer of" in process.stdout.readline()  # of the ball, whose field comes next
        deadline_s = time.monotonic() + PATIENCE_S
        while not list(fields.glob("*-occlusion-0.npz")):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        process.kill()
        assert process.stdout.read() == ""
    assert process.returncode == -signal.SIGKILL
    done = {path.name: path.stat().st_ino for path in (*kept.glob("*.npz"), *fields.glob("*.npz"))}
    assert len(done) >= 4  # two transfers, the box's field, a shell of the ball's

    again = cli("precompute", scene)
    assert again.returncode == 0, again.stderr
    assert again.stdout.splitlines(keepends=True)[:2] == box
    assert "parts of its occlusion field are from a run that was cut off" in again.stderr
    assert "of `box`" not in again.stderr
    assert "light transfer of" not in again.stderr
    whole = {path.name: path.stat().st_ino for path in (*kept.glob("*.npz"), *fields.glob("*.npz"))}
    assert len(whole) == 4
    assert {name: inode for name, inode in done.items() if "-" not in name}.items() <= whole.items()

    monkeypatch.setenv("DELTALIGHT_CACHE", str(tmp_path / "undisturbed"))
    assert cli("precompute", scene).stdout == again.stdout
    assert contents(tmp_path / "undisturbed") == contents(kept.parent)


def test_what_cannot_be_precomputed_is_said_in_one_sentence(cli: RunCli, tmp_path: Path, kept: Path) -> None:
    nothing = cli("precompute", str(scene_with(tmp_path, shading={})))
    moving = cli("precompute", str(scene_with(tmp_path, objects=[{"asset": "box.ply", "rigid": False}])))
    for done, sentence in (
        (nothing, "asks for nothing precomputed"),
        (moving, "holds for rigid objects only"),
    ):
        assert done.returncode == 2
        assert sentence in done.stderr
        assert len(done.stderr.splitlines()) == 1
    assert not kept.exists()


def test_pictures_under_lights_of_several_angles_become_a_material(cli: RunCli, tmp_path: Path) -> None:
    folder, out = tmp_path / "studs", tmp_path / "studs.dlmat"
    folder.mkdir()
    for name, code in (("low", 60), ("high", 160)):
        Image.new("RGB", (12, 8), (code, code, code)).save(folder / f"{name}.png")
    info = {"type": "abtf", "pictures": ["low.png", "high.png"], "angles_deg": [70, 0]}
    (folder / "info.json").write_text(json.dumps(info))
    done = cli("precompute", str(folder), "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "studs.dlmat: a stack of 16 of 12x8 texels, reflects 0.277 0.277 0.277 of" in done.stdout
    before = out.read_bytes()
    (folder / "low.png").unlink()
    refused = cli("precompute", str(folder), "--out", str(out))
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
    assert "low.png cannot be read as a picture" in refused.stderr
    assert out.read_bytes() == before


def test_a_ptm_file_becomes_a_material(cli: RunCli, tmp_path: Path) -> None:
    source, out = tmp_path / "coin.PTM", tmp_path / "coin.dlmat"
    grey = bytes([0, 0, 0, 0, 0, 128])  # 128 / 255 in all light
    scale, bias = "1 1 1 1 1 1", "0 0 0 0 0 0"
    white = bytes([255, 255, 255])
    source.write_bytes(f"PTM_1.2\nPTM_FORMAT_LRGB\n4 3\n{scale}\n{bias}\n".encode() + 12 * grey + 12 * white)
    done = cli("precompute", str(source), "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "coin.dlmat: polynomials of 4x3 texels, reflects 0.432 0.432 0.432 of" in done.stdout
    source.write_bytes(source.read_bytes()[:-2])
    refused = cli("precompute", str(source), "--out", str(out))
    assert (refused.returncode, len(refused.stderr.splitlines())) == (2, 1)
    assert "it is damaged, so copy it again" in refused.stderr


def test_a_measured_brdf_becomes_a_material(cli: RunCli, tmp_path: Path) -> None:
    source, out = brdf_file(tmp_path, grey_brdf(0.4, (0.2, 0.1, 0.5))), tmp_path / "paint.dlmat"
    done = cli("precompute", str(source), "--out", str(out))
    assert done.returncode == 0, done.stderr
    assert "fitted to half of them, it misses the others by" in done.stdout
    assert out.read_bytes().startswith(b"deltalight material 1 ")
    before = out.read_bytes()
    source.write_text("1 2 3")
    for arguments, sentence in (
        (("--out", str(out)), "paint.brdf is not a complete .brdf file"),
        ((), "say where it goes: --out paint.dlmat"),
        (("--out", "paint.json"), "say where it goes: --out paint.dlmat"),
    ):
        refused = cli("precompute", str(source), *arguments)
        assert refused.returncode == 2
        assert sentence in refused.stderr
        assert len(refused.stderr.splitlines()) == 1
    assert out.read_bytes() == before
    refused = cli("precompute", str(tmp_path), "--out", str(out))
    assert "info.json cannot be read" in refused.stderr
    refused = cli("precompute", str(scene_with(tmp_path)), "--out", str(out))
    assert "is treated as a scene document, and --out is for a measured BRDF" in refused.stderr
