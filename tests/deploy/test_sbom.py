"""The bill of materials holds what the lock files pin, each with a licence that may go with Apache-2.0."""

import json
import re
import runpy
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import pytest

from tests.services.conftest import ROOT

# Of what runs. LGPL: zeroconf is a library of its own beside this one, which anybody may replace.
WANTED = re.compile(
    r"MIT|BSD|Apache|ISC|PSF|Python|MPL|Mozilla|LGPL|0BSD|Zlib|CC0|OFL|HPND|Scopatz|BlueOak|Unlicense",
    re.IGNORECASE,
)


@pytest.fixture(scope="module")
def bill() -> dict[str, Any]:
    made = runpy.run_path(str(ROOT / ".ci" / "sbom.py"))["bill"]()
    assert isinstance(made, dict)
    return made


def licences(component: dict[str, Any]) -> str:
    found = component["licenses"]
    return " AND ".join(each.get("expression") or each["license"].get("name", "") for each in found)


def test_everything_that_is_locked_is_in_it_once(bill: dict[str, Any]) -> None:
    purls = [each["purl"] for each in bill["components"]]
    assert len(set(purls)) == len(purls)
    locks = ("requirements.lock", "requirements-dev.lock", "deploy/node.lock", "deploy/fleet.lock")
    for name in (*locks, "services/dashboard/nodejs.lock"):
        pinned = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / name).read_text(), re.MULTILINE)
        assert {f"pkg:pypi/{each.lower()}@{version}" for each, version in pinned} <= set(purls)
    packages = json.loads((ROOT / "services/dashboard/package-lock.json").read_text())["packages"]
    assert sum(purl.startswith("pkg:npm/") for purl in purls) == len(
        {(path.rpartition("node_modules/")[2], each["version"]) for path, each in packages.items() if path}
    )
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")


def test_what_the_images_hold_beside_the_locks_is_in_it(bill: dict[str, Any]) -> None:
    scopes = {each["purl"]: each["scope"] for each in bill["components"]}
    text = (ROOT / "deploy" / "Dockerfile").read_text()
    for image in set(re.findall(r"^FROM (\S+:\S+)", text, re.MULTILINE)):
        assert f"pkg:docker/{image.replace(':', '@')}" in scopes
    lines = [line for line in text.splitlines() if "apt-get install" in line]
    packages = {word for line in lines for word in line.split() if re.fullmatch(r"lib[a-z0-9.-]+", word)}
    assert len(packages) > 4
    found = {purl: scope for purl, scope in scopes.items() if purl.startswith("pkg:deb/debian/")}
    assert found == {f"pkg:deb/debian/{name}?distro=bookworm": "required" for name in packages}
    ray = next(purl for purl in scopes if purl.startswith("pkg:pypi/ray@"))
    assert scopes[ray] == "required", "the fleet's image runs it"


def test_what_runs_has_hashes_and_a_licence_that_goes_with_ours(bill: dict[str, Any]) -> None:
    running = [each for each in bill["components"] if each["scope"] == "required"]
    assert len(running) > 60
    for each in running:
        if each["type"] == "container":
            continue  # of many parts
        assert WANTED.search(licences(each)), each["name"]
        if each["purl"].startswith("pkg:pypi/"):
            assert all(re.fullmatch("[0-9a-f]{64}", known["content"]) for known in each["hashes"])
            assert each["hashes"]


def audited(database: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, ROOT / ".ci" / "audit.py", database], capture_output=True, text=True, check=False
    )


def record(name: str, *events: dict[str, str], ecosystem: str = "PyPI", **more: Any) -> dict[str, Any]:  # noqa: ANN401
    ranges = [{"type": "ECOSYSTEM", "events": list(events)}]
    affected = [{"package": {"ecosystem": ecosystem, "name": name}, "ranges": ranges}]
    return {"id": f"TEST-{name}", "summary": "made for this test", "affected": affected, **more}


def test_known_weaknesses_of_locked_versions_are_found_in_a_database(tmp_path: Path) -> None:
    """By a range that is open or ends behind the version, or a list; not if fixed before, withdrawn, or another's."""
    listed = record("Pillow")
    pillow = next(
        line for line in (ROOT / "requirements.lock").read_text().splitlines() if "pillow==" in line
    )
    listed["affected"][0]["versions"] = [pillow.partition("==")[2].split()[0]]
    records = [
        listed,
        record("NumPy", {"introduced": "0"}),
        record("three", {"introduced": "0.1.0"}, {"last_affected": "99.0.0"}, ecosystem="npm"),
        record("zeroconf", {"introduced": "0"}, {"fixed": "0.1"}),
        record("fastapi", {"introduced": "0"}, withdrawn="2026-01-01T00:00:00Z"),
        record("scipy", {"introduced": "999"}),
        record("typer", {"introduced": "0"}, ecosystem="npm"),
    ]
    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        for each in records:
            archive.writestr(f"{each['id']}.json", json.dumps(each))
    done = audited(tmp_path / "all.zip")
    assert done.returncode == 1, done.stderr
    *found, total = done.stdout.splitlines()
    assert [line.split()[0] for line in found] == ["numpy", "pillow", "three"]
    assert all("(runs): TEST-" in line for line in found)
    assert total.startswith("3 weaknesses")
    (tmp_path / "one.json").write_text(json.dumps(records[3]))
    assert audited(tmp_path / "one.json").returncode == 0


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"PK\3\4"])
def test_what_is_no_database_is_one_sentence(tmp_path: Path, content: bytes) -> None:
    for name in ("a.json", "a.zip"):
        (tmp_path / name).write_bytes(content)
        done = audited(tmp_path / name)
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.count("\n") == 1
        assert "no database in the format of OSV" in done.stderr
