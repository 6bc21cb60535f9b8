"""Results of a run that was cut off: each is kept as soon as it is known, and taken where all inputs are the same."""

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from io import BytesIO
from pathlib import Path

import numpy as np

from deltalight import protocol, render_server, sensor_node
from deltalight.benchmarks.quality.figures import Figures
from deltalight.benchmarks.quality.metrics import Picture
from deltalight.benchmarks.variants import Variant
from deltalight.protocol.cached_files import read_cached, write_cached
from deltalight.protocol.methods import PLUGINS

_PARTS = (
    Path(__file__).parents[1],
    *(Path(part.__path__[0]) for part in (protocol, sensor_node, render_server)),
)
_CODE = (".py", ".glsl")


@dataclass(frozen=True, eq=False)
class VariantResult:
    """A variant on one scene: figures (figures.py), the picture that the report shows, and `Rendered`'s account."""

    figures: Figures
    shown: Picture
    is_repeatable: bool | None = None
    history_codes: int | None = None
    note: str = ""


class KeptResults:
    """Results in a folder, found by a hash of what determines them: truth, variant, renderer, and all code."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.taken = 0

    @classmethod
    def beside(cls, report: Path) -> "KeptResults":
        """Returns those of the report that is to be written as folder `report`."""
        absolute = report.absolute()
        return cls(absolute.with_name(f".{absolute.name}.partial"))

    def result(
        self,
        measure: Callable[[], VariantResult],
        renderer: str,
        truth: str,
        variant: Variant,
        volume_size: int | None,
    ) -> VariantResult:
        """Returns a result: the kept one of the same inputs, else a new one, which is kept.

        Raises:
            DeltalightError: the disk refuses.
        """
        inputs = [
            renderer,
            truth,
            variant.name,
            variant.kind,
            dict(variant.settings),
            volume_size,
            self._code,
        ]
        path = self._folder / f"{hashlib.sha256(json.dumps(inputs).encode()).hexdigest()[:24]}.npz"
        content = None if variant.kind in PLUGINS.values else read_cached(path)  # their code is elsewhere
        if content is not None:
            self.taken += 1
            return _unpacked(content)
        measured = measure()
        write_cached(path, _packed(measured))
        return measured

    def remove(self) -> None:
        """Removes all: the report is complete."""
        shutil.rmtree(self._folder, ignore_errors=True)

    @cached_property
    def _code(self) -> str:
        hasher = hashlib.sha256()
        for path in sorted(path for part in _PARTS for path in part.rglob("*") if path.suffix in _CODE):
            hasher.update(f"{path}\0".encode() + path.read_bytes())
        return hasher.hexdigest()


def _packed(result: VariantResult) -> bytes:
    about = {name: value for name, value in vars(result).items() if name != "shown"}
    stream = BytesIO()
    np.savez(stream, about=np.frombuffer(json.dumps(about).encode(), np.uint8), shown=result.shown)
    return stream.getvalue()


def _unpacked(content: bytes) -> VariantResult:
    with np.load(BytesIO(content), allow_pickle=False) as arrays:
        return VariantResult(shown=arrays["shown"], **json.loads(arrays["about"].tobytes()))
