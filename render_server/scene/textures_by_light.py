"""Textures whose texels go by the light's direction, whichever kind a folder or file holds."""

from pathlib import Path

from deltalight.render_server.scene.polynomial_texture import PolynomialTexture, read_polynomial_texture
from deltalight.render_server.scene.ptm_file import PTM_SUFFIX, read_ptm
from deltalight.render_server.scene.texture_folder import read_info
from deltalight.render_server.scene.texture_stack import STACK_TYPE, TextureStack, read_texture_stack

TextureByLight = PolynomialTexture | TextureStack


def is_texture_by_light(path: Path) -> bool:
    """Whether a path names what `read_texture_by_light` reads."""
    return path.is_dir() or path.suffix.lower() == PTM_SUFFIX


def read_texture_by_light(path: Path) -> TextureByLight:
    """Reads a polynomial texture map, of a `.ptm` file or a folder, or an ABTF, by what the folder says it is.

    Raises:
        DeltalightError: a file is missing or damaged, or it is another kind of map.
    """
    if not path.is_dir():
        return read_ptm(path)
    info = read_info(path, "a PTM or an ABTF")
    return read_texture_stack(path) if info.get("type") == STACK_TYPE else read_polynomial_texture(path)
