"""Textures whose texels go by the light's direction, whichever kind a folder holds."""

from pathlib import Path

from deltalight.render_server.scene.polynomial_texture import PolynomialTexture, read_polynomial_texture
from deltalight.render_server.scene.texture_folder import read_info
from deltalight.render_server.scene.texture_stack import STACK_TYPE, TextureStack, read_texture_stack

TextureByLight = PolynomialTexture | TextureStack


def read_texture_by_light(folder: Path) -> TextureByLight:
    """Reads a polynomial texture map or an ABTF, by what its description says it is.

    Raises:
        DeltalightError: a file is missing or damaged, or it is another kind of map.
    """
    info = read_info(folder, "a PTM or an ABTF")
    return read_texture_stack(folder) if info.get("type") == STACK_TYPE else read_polynomial_texture(folder)
