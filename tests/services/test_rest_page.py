"""The commands of docs/rest-api.md, as a reader types them."""

import re
import shutil
import subprocess
from pathlib import Path
from textwrap import dedent

import pytest

from tests.services.api_samples import running_api
from tests.services.storage_samples import glb

PAGE = Path(__file__).resolve().parents[2] / "docs" / "rest-api.md"
CURL = 'set -e\ncurl() { command curl --silent --show-error --fail-with-body "$@"; }\n'


def commands() -> str:
    """The block of the section `Try it`."""
    found = re.search(r"## Try it\n\n((?: {4}.*\n|\n)+)", PAGE.read_text(encoding="utf-8"))
    assert found is not None
    return dedent(found[1])


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("curl") is None, reason="curl is not installed")
def test_what_the_page_tells_to_try_works(tmp_path: Path) -> None:
    (tmp_path / "chair.glb").write_bytes(glb({"asset": {"version": "2.0"}}))
    with running_api(tmp_path / "data") as api:
        address = str(api.client.base_url).rstrip("/")

        def run(text: str) -> None:
            script = CURL + re.sub(r"^API=.*", "", text, flags=re.MULTILINE)
            done = subprocess.run(
                ["bash", "-c", script],
                cwd=tmp_path,
                env={"PATH": "/usr/bin:/bin", "API": address},
                capture_output=True,
                text=True,
                timeout=60,
                check=False,
            )
            assert done.returncode == 0, done.stdout[-500:] + done.stderr

        making, changing = re.split(
            r"(?=^curl -X POST \$API/scenes/ID/activate)", commands(), flags=re.MULTILINE
        )
        run(making)
        (scene,) = api.client.get("/scenes").json()
        run(changing.replace("/scenes/ID", f"/scenes/{scene['id']}"))
        changed = api.client.get(f"/scenes/{scene['id']}").json()["document"]
        assert changed["objects"][0]["pose"]["translation_m"] == [0.34, 0, 0]
        assert [light["type"] for light in changed["lights"]["manual"]] == ["ambient", "sphere"]
        assert changed["lights"]["manual"][1]["intensity"] == 3
        assert len(api.client.get("/scenes").json()) == 2, "the export was imported"
