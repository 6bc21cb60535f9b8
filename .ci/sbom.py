"""Prints a software bill of materials (CycloneDX 1.5, JSON) from the lock files, with the licence of each package.

What the images of deploy/Dockerfile hold beside them is in it too: the images that they begin with, and Debian's
packages, without a version where the file pins none: each build takes the newest of its Debian release.

Licences of Python packages are read from what is installed here: run it in the environment of requirements-dev.lock,
as `./run sbom` does. The same files give the same text.
"""

import json
import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import Any
from urllib.parse import quote

ROOT = Path(__file__).parents[1]
RUNTIME, DEVELOPMENT = "requirements.lock", "requirements-dev.lock"
IMAGES = ("deploy/node.lock", "deploy/fleet.lock")  # of single roles
NODE_JS = "services/dashboard/nodejs.lock"  # builds the dashboard
DOCKERFILE = "deploy/Dockerfile"
DASHBOARD = "services/dashboard/package-lock.json"
PINNED = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)")
HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})")
APPROVED = "License :: OSI Approved :: "
LONGEST_NAME = 100  # some packages put the whole text into that field
UNKNOWN = "unknown"
FROM = re.compile(r"^FROM (\S+):(\S+) AS (\w+)$", re.MULTILINE)  # others begin with one of these
APT = re.compile(r"apt-get install ([^&]+)")
DEBIAN = "bookworm"
DEBIAN_LICENCES = {  # the main one of each; /usr/share/doc/NAME/copyright has all
    "libegl1": "MIT",
    "libgl1": "MIT",
    "libegl-mesa0": "MIT",
    "libgl1-mesa-dri": "MIT",
    "libusb-1.0-0": "LGPL-2.1-or-later",
}
UNSTATED = {"openexr": "BSD-3-Clause"}  # their files say it, their metadata does not

Component = dict[str, Any]


def bill() -> dict[str, Any]:
    """Returns the bill: what runs is `required`, what only builds and tests is `excluded` (of a release)."""
    listed = [
        *(each for lock in (DEVELOPMENT, NODE_JS) for each in python_components(lock, "excluded")),
        *(each for lock in (RUNTIME, *IMAGES) for each in python_components(lock, "required")),
        *dashboard_components(),
        *image_components(),
    ]
    components = {each["purl"]: each for each in listed}  # the later one counts
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": {"component": own_component()},
        "components": [components[purl] for purl in sorted(components)],
    }


def own_component() -> Component:
    """Returns what the bill is of."""
    text = (ROOT / "deltalight/__init__.py").read_text()
    found = re.search(r'^__version__ = "(.+)"$', text, re.MULTILINE)
    assert found is not None
    licence = [{"license": {"id": "Apache-2.0"}}]
    return {"type": "application", "name": "deltalight", "version": found[1], "licenses": licence}


def python_components(lock: str, scope: str) -> Iterator[Component]:
    """Yields the packages of a lock file."""
    for entry in re.split(r"\n(?=\S)", (ROOT / lock).read_text()):
        pinned = PINNED.match(entry)
        if pinned is None:
            continue
        name, version = pinned.groups()
        yield {
            "type": "library",
            "name": name,
            "version": version,
            "purl": f"pkg:pypi/{name.lower()}@{version}",
            "scope": scope,
            "licenses": python_licences(name),
            "hashes": [{"alg": "SHA-256", "content": each} for each in sorted(HASH.findall(entry))],
        }


def python_licences(name: str) -> list[Component]:
    """Returns the licence that an installed package states: as an expression, a classifier or a name."""
    try:
        stated = metadata(name)
    except PackageNotFoundError:
        return [{"license": {"name": UNKNOWN}}]
    if expression := stated.get("License-Expression"):
        return [{"expression": expression}]
    classifiers = [each for each in stated.get_all("Classifier") or [] if each.startswith(APPROVED)]
    if classifiers:
        return [{"license": {"name": each.removeprefix(APPROVED)}} for each in classifiers]
    if name.lower() in UNSTATED:
        return [{"expression": UNSTATED[name.lower()]}]
    named = (stated.get("License") or "").strip().partition("\n")[0][:LONGEST_NAME]
    return [{"license": {"name": named or UNKNOWN}}]


def dashboard_components() -> Iterator[Component]:
    """Yields the packages of the dashboard; `dev` ones build it and are not in it."""
    packages = json.loads((ROOT / DASHBOARD).read_text())["packages"]
    for path, package in packages.items():
        name = path.rpartition("node_modules/")[2]
        if not name:
            continue
        yield {
            "type": "library",
            "name": name,
            "version": package["version"],
            "purl": f"pkg:npm/{quote(name, safe='/')}@{package['version']}",
            "scope": "excluded" if package.get("dev") else "required",
            "licenses": [
                {"expression": package["license"]} if "license" in package else {"license": {"name": UNKNOWN}}
            ],
        }


def image_components() -> Iterator[Component]:
    """Yields what the Dockerfile takes from elsewhere: the images that it begins with, and Debian's packages."""
    text = (ROOT / DOCKERFILE).read_text()
    for name, tag, stage in FROM.findall(text):
        yield {
            "type": "container",
            "name": name,
            "version": tag,
            "purl": f"pkg:docker/{name}@{tag}",
            "scope": "excluded" if stage == "dashboard" else "required",  # that stage is in no image
            "licenses": [{"license": {"name": UNKNOWN}}],  # each part has its own
        }
    words = {word for found in APT.findall(text) for word in found.replace("\\", " ").split()}
    for word in sorted(word for word in words if not word.startswith("-")):
        name, _, version = word.partition("=")
        yield {
            "type": "library",
            "name": name,
            **({"version": version} if version else {}),
            "purl": f"pkg:deb/debian/{name}{f'@{version}' if version else ''}?distro={DEBIAN}",
            "scope": "required",
            "licenses": [{"license": {"name": DEBIAN_LICENCES.get(name, UNKNOWN)}}],
        }


if __name__ == "__main__":
    print(json.dumps(bill(), indent=1))
