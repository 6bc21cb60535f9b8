"""What lies beside the project's tests: every shader variant, the protected pictures and their goldens."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import UInt8

from deltalight.benchmarks.gpu_check.record import Skipped

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

ROOT = Path(__file__).resolve().parents[2]
TESTS = ROOT / "tests" / "render_server"
Picture = UInt8[np.ndarray, "h w 3"]


@dataclass(frozen=True, eq=False)
class ComparedPicture:
    """A protected picture and its golden, None where that is missing; `psnr_db` is then nan."""

    name: str
    picture: Picture
    golden: Picture | None
    psnr_db: float
    least_db: float

    @property
    def is_alike(self) -> bool:
        """Whether the picture is close enough to its golden."""
        return self.psnr_db >= self.least_db

    @property
    def complaint(self) -> str:
        """What is wrong with a picture that is not alike."""
        if self.golden is None:
            return "its golden is missing"
        return f"{self.psnr_db:.1f} dB, at least {self.least_db:.0f} are asked for"


def shader_parts() -> "dict[str, Callable[[GpuContext, Path], None]]":
    """Returns what compiles every variant of every shader, by name.

    Raises:
        Skipped: the tests are not here.
    """
    parts: dict[str, Callable[[GpuContext, Path], None]] = _module("shader_variants").PARTS
    return parts


def protected_cases() -> list[Any]:
    """Returns the protected scenes; their names are their strings.

    Raises:
        Skipped: the tests are not here.
    """
    return list(_module("protected_scenes").cases())


def compare_picture(gpu: "GpuContext", case: Any, folder: Path) -> ComparedPicture:  # noqa: ANN401 (see _module)
    """Renders a protected scene, with its assets in `folder`, and compares its picture with the golden."""
    scenes = _module("protected_scenes")
    pictures, _ = scenes.pictures_of(gpu, case, folder)
    picture = pictures[scenes.SHOWN]
    try:
        golden = scenes.golden_of(case)
    except FileNotFoundError:
        return ComparedPicture(str(case), picture, None, float("nan"), scenes.LEAST_PSNR_DB)
    psnr_db = _module("scenes").psnr_db(picture, golden)
    return ComparedPicture(str(case), picture, golden, psnr_db, scenes.LEAST_PSNR_DB)


def _module(name: str) -> Any:  # noqa: ANN401 (a module of the tests, which a wheel lacks)
    require_tests()
    return importlib.import_module(f"tests.render_server.{name}")


def require_tests() -> None:
    """Checks that the project's tests are here.

    Raises:
        Skipped: this is an installed package, which has none.
    """
    if not (TESTS / "protected_scenes.py").is_file():
        raise Skipped("the project's tests are not here; run it in a checkout of the repository")
