"""Soft mattes: hair that depth does not show, before an object, against mattes that are known."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from deltalight.protocol.scene import SceneDocument
from tests.render_server.hair import PATTERNS, HairyThing, hairy_thing
from tests.render_server.scenes import ObjectsRenderer, Stage, unlit
from tests.render_server.test_antialiasing import ABOVE, GLOW
from tests.render_server.test_edge_unmixing import glowing

pytestmark = pytest.mark.usefixtures("clean_gl")
REACH_PX = 8


@pytest.fixture
def stage(tmp_path: Path) -> Stage:
    return Stage(tmp_path)


def matted(document: SceneDocument, reach_px: int = REACH_PX) -> SceneDocument:
    return document.replaced(output=document.output.model_copy(update={"matting_px": reach_px}))


def guided(thing: HairyThing, radius: int = 8, epsilon: float = 1e-4) -> np.ndarray:
    """The hard matte after OpenCV's guided filter (He et al. 2013)."""
    hard = 255 * thing.by_depth.astype(np.uint8)
    return np.asarray(cv2.ximgproc.guidedFilter(thing.color, hard, radius, epsilon * 255**2) / 255.0)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_try(objects: ObjectsRenderer, stage: Stage, pattern: str) -> None:
    thing = hairy_thing(pattern)
    band = thing.band(REACH_PX)
    truth = thing.alpha[..., None] * thing.front + (1 - thing.alpha[..., None]) * GLOW
    from deltalight.protocol.frames import decode_lut
    lin = decode_lut(None)[thing.color, 0]
    enc = lambda x: np.where(x < .0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - .055)
    def say(name, alpha, picture):
        e = (alpha - thing.alpha)[band]
        p = (enc(np.clip(picture, 0, 1)) - enc(truth))[band]
        print(f"{pattern:7s}{name:10s} SAD {np.abs(e).sum():6.1f} rms {np.sqrt((e**2).mean()):.3f} PSNR {-10*np.log10((p**2).mean()):.2f}")
    print()
    hard = thing.by_depth.astype(float)
    say("hard", hard, np.where(hard[..., None] > 0, lin, GLOW))
    g = guided(thing); say("guided", g, g[..., None] * lin + (1 - g[..., None]) * GLOW)
    g = guided(thing, 16); say("guided16", g, g[..., None] * lin + (1 - g[..., None]) * GLOW)
    pics = [lin, truth]
    for px in (0, 4, 8, 12):
        result = objects.draw(matted(unlit(glowing(stage)), px), thing.view(pose=ABOVE))
        c = objects.newest_coverage(); print(px, [x for x in objects.renderer.graph.report() if x.name=='object surface'][0]) if 0 else None
        say(f"{px}px", 1 - c, result.linear); pics.append(result.linear)
    row = np.hstack([enc(np.clip(p, 0, 1)) for p in pics[:4] + pics[4:5]])[20:90]
    cv2.imwrite(f"/tmp/matte/gpu_{pattern}.png", cv2.resize((255 * row).astype(np.uint8)[..., ::-1], None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST))
    a = np.hstack([thing.alpha, hard, guided(thing), 1 - objects.coverage(matted(unlit(glowing(stage)), 0), thing.view(pose=ABOVE)), 1 - objects.coverage(matted(unlit(glowing(stage)), 8), thing.view(pose=ABOVE))])[20:90]
    cv2.imwrite(f"/tmp/matte/alpha_{pattern}.png", cv2.resize((255 * a).astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST))
