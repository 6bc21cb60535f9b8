"""The bill of materials holds what the lock files pin, each with a licence that may go with Apache-2.0."""

import json
import re
import runpy
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
    for name in ("requirements.lock", "requirements-dev.lock"):
        pinned = re.findall(r"^([\w.-]+)==([^\s;]+)", (ROOT / name).read_text(), re.MULTILINE)
        assert {f"pkg:pypi/{each.lower()}@{version}" for each, version in pinned} <= set(purls)
    packages = json.loads((ROOT / "services/dashboard/package-lock.json").read_text())["packages"]
    assert sum(purl.startswith("pkg:npm/") for purl in purls) == len(
        {(path.rpartition("node_modules/")[2], each["version"]) for path, each in packages.items() if path}
    )
    assert (bill["bomFormat"], bill["specVersion"]) == ("CycloneDX", "1.5")


def test_what_runs_has_hashes_and_a_licence_that_goes_with_ours(bill: dict[str, Any]) -> None:
    running = [each for each in bill["components"] if each["scope"] == "required"]
    assert len(running) > 60
    for each in running:
        assert WANTED.search(licences(each)), each["name"]
        if each["purl"].startswith("pkg:pypi/"):
            assert all(re.fullmatch("[0-9a-f]{64}", known["content"]) for known in each["hashes"])
            assert each["hashes"]
