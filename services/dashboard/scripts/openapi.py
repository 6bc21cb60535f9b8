"""Writes the OpenAPI document of the REST API to a file: `python scripts/openapi.py FILE`."""

import json
import sys
import tempfile
from pathlib import Path

from deltalight.services.api.app import create_app
from deltalight.services.api.settings import ApiSettings
from deltalight.services.storage.store import Store


def write_openapi(target: Path) -> None:
    """Writes the document; the application is created over an empty store and never started."""
    with tempfile.TemporaryDirectory() as folder, Store(Path(folder)) as store:
        document = create_app(ApiSettings(), store).openapi()
    target.write_text(json.dumps(document, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    write_openapi(Path(sys.argv[1]))
