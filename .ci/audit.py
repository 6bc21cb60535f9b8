"""Compares the packages of the lock files with a database of known weaknesses in the format of OSV.

    ./run audit all.zip

The database is given, and nothing is asked over a network: a record (.json), a folder of them, or a .zip such as
those that https://osv.dev offers for PyPI and npm. Format: OSV schema 1.7, https://ossf.github.io/osv-schema.
"""

import json
import re
import runpy
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from packaging.version import InvalidVersion, Version

ECOSYSTEMS = {"pypi": "PyPI", "npm": "npm"}
FOUND, UNREADABLE = 1, 2
LONGEST_SUMMARY = 120

Record = dict[str, Any]


def main() -> None:
    """Prints what is known of the packages; exit code 1: something is, 2: the database cannot be read."""
    listed = runpy.run_path(str(Path(__file__).with_name("sbom.py")))["bill"]()["components"]
    components = [each for each in listed if _kind(each) in ECOSYSTEMS]
    try:
        records = list(read_records(Path(sys.argv[1])))
    except (OSError, ValueError, zipfile.BadZipFile) as fault:
        print(f"deltalight: {sys.argv[1]} is no database in the format of OSV ({fault}).", file=sys.stderr)
        sys.exit(UNREADABLE)
    lines = sorted(weaknesses(components, records))
    print(
        "\n".join(
            [*lines, f"{len(lines)} weaknesses of {len(components)} packages, by {len(records)} records"]
        )
    )
    sys.exit(FOUND if lines else 0)


def read_records(path: Path) -> Iterator[Record]:
    """Yields the records of a file, a folder or an archive, those aside that were withdrawn.

    Raises:
        OSError, ValueError, zipfile.BadZipFile: it cannot be read, or there is no record in it.
    """
    count = 0
    for text in _texts(path):
        record = json.loads(text)
        if not isinstance(record, dict) or "id" not in record:
            raise ValueError("a file without an id")
        count += 1
        if "withdrawn" not in record:
            yield record
    if count == 0:
        raise ValueError("it holds no .json")


def _texts(path: Path) -> Iterator[bytes]:
    if path.is_dir():
        yield from (each.read_bytes() for each in sorted(path.rglob("*.json")))
    elif path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            yield from (archive.read(name) for name in archive.namelist() if name.endswith(".json"))
    else:
        yield path.read_bytes()


def weaknesses(components: list[Record], records: list[Record]) -> Iterator[str]:
    """Yields a line for each package and each record that names its version."""
    by_package: dict[tuple[str, str], list[tuple[Record, Record]]] = {}
    for record in records:
        for affected in record.get("affected", []):
            package = affected.get("package", {})
            key = _key(package.get("ecosystem", ""), package.get("name", ""))
            by_package.setdefault(key, []).append((record, affected))
    for component in components:
        path = component["purl"].partition("/")[2]
        name = path.rpartition("@")[0].replace("%40", "@")
        told = set()
        for record, affected in by_package.get(_key(ECOSYSTEMS[_kind(component)], name), []):
            if record["id"] not in told and is_affected(component["version"], affected):
                told.add(record["id"])
                summary = str(record.get("summary", ""))[:LONGEST_SUMMARY]
                use = "runs" if component["scope"] == "required" else "builds and tests"
                yield f"{name} {component['version']} ({use}): {record['id']} {summary}".rstrip()


def is_affected(version: str, affected: Record) -> bool:
    """Whether a version is listed, or lies in a range; one that cannot be compared is."""
    if version in affected.get("versions", []):
        return True
    ranges = [each for each in affected.get("ranges", []) if each.get("type") in ("ECOSYSTEM", "SEMVER")]
    try:
        return any(_is_in(Version(version), each.get("events", [])) for each in ranges)
    except InvalidVersion:
        return True


def _is_in(version: Version, events: list[Record]) -> bool:
    """Whether a version is in a range of OSV: the last event at or before it tells, `last_affected` is inside."""
    is_inside = False
    for event in sorted((each for each in events if "limit" not in each), key=_place):
        kind, at = next(iter(event.items()))
        if kind == "introduced" and (at == "0" or Version(at) <= version):
            is_inside = True
        elif (kind == "fixed" and Version(at) <= version) or (
            kind == "last_affected" and Version(at) < version
        ):
            is_inside = False
    return is_inside


def _place(event: Record) -> tuple[Version, bool]:
    kind, at = next(iter(event.items()))
    return Version(at), kind == "last_affected"


def _kind(component: Record) -> str:
    """Returns where a package is from; images and Debian's have no version that a record could name."""
    return str(component["purl"].removeprefix("pkg:").partition("/")[0])


def _key(ecosystem: str, name: str) -> tuple[str, str]:
    """Returns how a package is looked up: by its name as PyPI compares names (PEP 503), else as it is."""
    return ecosystem, re.sub(r"[-_.]+", "-", name).lower() if ecosystem == "PyPI" else name


if __name__ == "__main__":
    main()
