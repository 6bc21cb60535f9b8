"""The notebooks run in a kernel of their own, with small pictures; without OpenGL one sentence says so."""

import os
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow(seconds=15)
nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")
nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = ROOT / "docs" / "notebooks"
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(ROOT),
    "MPLBACKEND": "agg",
    "PIP_NO_INDEX": "1",
    "PIP_NO_BUILD_ISOLATION": "false",  # which is how pip spells that it builds without downloads
}
METHOD = {"volume_size": 32, "rsm_size": 128, "triangle_budget": 5000}
SMALL = f'replaced(method={METHOD}, output={{"width": 160, "height": 120'
CHECKS = {
    "relight": """
    np.testing.assert_allclose(compose(picture.ratio), picture.linear, atol=1e-5)
    shadow = (picture.ratio.max(axis=2) < 0.7) & (picture.coverage == 0)
    assert shadow.mean() > 0.002
    assert (softer > picture.linear)[shadow].all()
    """,
    "compare_methods": """
    assert (pictures["none"].ratio[pictures["none"].coverage == 0] == 1).all()
    darkest = {name: picture.ratio[row].min() for name, picture in pictures.items()}
    assert all(darkest[name] < 0.6 for name in ("paper", "exact", "dlpv")), darkest
    """,
    "own_method": """
    import numpy as np
    from ball_occlusion import covered
    below, up = np.zeros((1, 1, 3)), np.array([[[0.0, 0.0, 1.0]]])
    assert abs(covered(below, up, np.array([0, 0, 1.4]), 1.0)[0, 0] - 1 / 1.4**2) < 1e-12
    assert covered(below, -up, np.array([0, 0, 1.4]), 1.0)[0, 0] == 0
    changed = abs(pictures["ball"].ratio - 1).max(axis=2) > 0.01
    assert changed.mean() > 0.02
    assert not changed[:20].any(), "far from the object nothing changes"
    """,
}


def run(name: str, folder: Path, **environment: str) -> None:
    notebook = nbformat.read(NOTEBOOKS / f"{name}.ipynb", 4)
    for cell in notebook.cells:
        cell.source = cell.source.replace('replaced(output={"width": 320, "height": 240', SMALL)
    notebook.cells.append(nbformat.v4.new_code_cell("if True:" + CHECKS[name]))
    client = nbclient.NotebookClient(notebook, timeout=250, resources={"metadata": {"path": str(folder)}})
    client.execute(env=ENVIRONMENT | environment)


@pytest.mark.parametrize("name", CHECKS)
def test_it_runs_and_is_kept_without_outputs(name: str, tmp_path: Path) -> None:
    file = NOTEBOOKS / f"{name}.ipynb"
    assert file.stat().st_size < 50_000
    assert not any(cell.get("outputs") for cell in nbformat.read(file, 4).cells)
    nbformat.validate(nbformat.read(file, 4))
    run(name, tmp_path)
    assert list(tmp_path.glob("*.png"))


def test_without_opengl_one_sentence_says_so(tmp_path: Path) -> None:
    with pytest.raises(nbclient.exceptions.CellExecutionError) as error:
        run("relight", tmp_path, __EGL_VENDOR_LIBRARY_FILENAMES=str(tmp_path / "none.json"))
    assert "No OpenGL context (" in error.value.traceback
    assert "Traceback" not in error.value.traceback


def test_every_notebook_is_run() -> None:
    assert {path.stem for path in NOTEBOOKS.glob("*.ipynb")} == set(CHECKS)
