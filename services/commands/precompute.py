"""`deltalight precompute`: what is computed before a scene is shown, of its objects or of a measured material."""

from pathlib import Path
from typing import Annotated

import typer

from deltalight.protocol.errors import DeltalightError


def precompute(
    source: Annotated[
        Path,
        typer.Argument(
            help="Scene document, with its assets where it refers to them; a measured BRDF (.brdf); a polynomial "
            "texture map (.ptm); or the folder of one or of an ABTF (info.json)."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="File that a material becomes, NAME.dlmat.", show_default=False),
    ] = None,
) -> None:
    """Compute the light transfer and the occlusion fields of a scene's objects, so that no picture waits for them.

    What is in the cache already is not computed again. A run that was ended, by Ctrl-C too, leaves the objects that
    are done, and of an occlusion field its shells: the next goes on there.

    A measured BRDF, a polynomial texture map or an ABTF becomes a file for `material: {precomputed: FILE}` of scene
    documents.
    """
    from deltalight.render_server.scene.brdf_measurements import BRDF_SUFFIX
    from deltalight.render_server.scene.textures_by_light import is_texture_by_light

    if is_texture_by_light(source) or source.suffix.lower() == BRDF_SUFFIX:
        _precompute_material(source, out)
    elif out is not None:
        raise DeltalightError(
            f"{source} is treated as a scene document, and --out is for a measured BRDF ({BRDF_SUFFIX}) or a"
            " texture by the light; leave it out."
        )
    else:
        _precompute_scene(source)


def _precompute_scene(path: Path) -> None:
    from deltalight.protocol.scene import load_scene
    from deltalight.render_server.precomputation.precomputed import precompute_scene

    def notify(sentence: str) -> None:
        typer.echo(sentence, err=True)

    for line in precompute_scene(load_scene(path), notify):
        typer.echo(line)


def _precompute_material(source: Path, out: Path | None) -> None:
    from deltalight.render_server.scene.material_file import MATERIAL_SUFFIX
    from deltalight.render_server.scene.textures_by_light import is_texture_by_light

    if out is None or out.suffix != MATERIAL_SUFFIX:
        raise DeltalightError(
            f"{source} is a measured material; say where it goes: --out {source.stem}{MATERIAL_SUFFIX}."
        )
    if is_texture_by_light(source):
        _convert_textures(source, out)
    else:
        _fit_brdf(source, out)


def _convert_textures(source: Path, out: Path) -> None:
    from deltalight.render_server.scene.material_file import write_material
    from deltalight.render_server.scene.texture_stack import TextureStack
    from deltalight.render_server.scene.textures_by_light import read_texture_by_light

    texture = read_texture_by_light(source)
    write_material(out, texture)
    height, width = texture.albedo.shape[:2]
    albedo = " ".join(f"{each:.3f}" for each in texture.albedo.mean(axis=(0, 1), dtype=float))
    kind = f"a stack of {len(texture.planes)}" if isinstance(texture, TextureStack) else "polynomials"
    typer.echo(f"{out}: {kind} of {width}x{height} texels, reflects {albedo} of light from everywhere")


def _fit_brdf(source: Path, out: Path) -> None:
    from deltalight.render_server.scene.brdf_fit import MIRROR_RANGE_DEG, fit_brdf, held_out_error
    from deltalight.render_server.scene.brdf_measurements import read_brdf
    from deltalight.render_server.scene.material_file import write_material

    samples = read_brdf(source)
    fitted = fit_brdf(samples)
    write_material(out, fitted)
    error = held_out_error(samples)
    widths = ", ".join(f"{sigma:.3f}" for sigma in fitted.sigmas)
    albedo = " ".join(f"{each:.3f}" for each in fitted.hemispherical_albedo)
    typer.echo(f"{out}: lobes of {widths} rad, reflects {albedo} of light from everywhere")
    typer.echo(
        f"{len(samples)} samples; fitted to half of them, it misses the others by {error.whole:.0%} r.m.s., and by "
        f"{error.off_mirror:.0%} without those whose half-vector is within {MIRROR_RANGE_DEG:g} degrees of the normal"
    )
