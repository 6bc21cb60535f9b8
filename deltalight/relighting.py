"""Relighting of frames in this process: no servers, no sockets."""

from collections.abc import Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
from jaxtyping import Float32, UInt8

from deltalight.checked_input import require_device, require_document, require_frames, require_method_name
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.frames import ViewFrame, linear_color
from deltalight.protocol.method_names import with_method
from deltalight.protocol.quality import Quality, require_quality
from deltalight.protocol.scene import SceneDocument
from deltalight.render_server.gpu.context import create_context
from deltalight.render_server.renderer import CompositeFrame, PictureLayers, SceneRenderer
from deltalight.scene import Scene

HALF_PRECISION = 2.0**-10  # of a value: what the renderer's 16-bit pictures round away
DARKEST = 1e-4  # radiance of the camera's picture, camera units, below which a ratio to it says nothing


@dataclass(frozen=True, eq=False, repr=False)
class RelitPicture:
    """A relit frame, in numpy arrays of one size. Camera units: 1.0 = sensor white at the reference exposure.

    With the camera's own linear picture b, `linear` = (1 - coverage) ratio b + additive, at every pixel.

    Attributes:
        color: as the camera would encode it, (h, w, 3) uint8; untouched pixels equal the camera's bit for bit.
        linear: the same before the camera's response, (h, w, 3) float32, camera units.
        delta: what the objects change, `linear` - b, (h, w, 3) float32, camera units.
        ratio: factor on the light of the real scene, (h, w, 3) float32; 1 where nothing changes, 0 in full shadow.
        additive: light added on top: objects times coverage, new light where b is black, (h, w, 3) float32.
        coverage: fraction of the pixel that objects cover, (h, w) float32, 0..1.
        depth: of the nearest surface, real or virtual, along the optical axis, (h, w) float32, m; 0 = unknown.
        composite: the renderer's other results: frame_id, timestamp_ns, pass times, lights, status.
    """

    color: UInt8[np.ndarray, "h w 3"]
    linear: Float32[np.ndarray, "h w 3"]
    delta: Float32[np.ndarray, "h w 3"]
    ratio: Float32[np.ndarray, "h w 3"]
    additive: Float32[np.ndarray, "h w 3"]
    coverage: Float32[np.ndarray, "h w"]
    depth: Float32[np.ndarray, "h w"]
    composite: CompositeFrame

    def __repr__(self) -> str:
        height, width = self.color.shape[:2]
        return f"<RelitPicture of frame {self.composite.frame_id}, {width}x{height}, {self.composite.status}>"

    @classmethod
    def of(cls, frame: ViewFrame, composite: CompositeFrame, layers: PictureLayers) -> Self:
        """Splits a composite with its linear picture into light that changes and light that is added."""
        camera = linear_color(frame, frame.color)
        linear = camera if composite.linear is None else composite.linear
        linear = np.where(np.abs(linear - camera) <= HALF_PRECISION * camera, camera, linear)
        cover = layers.coverage[..., None]
        objects = cover * layers.radiance
        real = np.divide(linear - objects, 1 - cover, out=camera.copy(), where=cover < 1)
        ratio = np.divide(real, camera, out=np.ones_like(camera), where=(camera > DARKEST) & (cover < 1))
        ratio = np.maximum(ratio, 0)
        additive = linear - (1 - cover) * ratio * camera
        delta = linear - camera
        return cls(
            composite.color, linear, delta, ratio, additive, layers.coverage, layers.depth_m, composite
        )


class Renderer:
    """Relights frames: `with dl.Renderer(method="dvct") as r: picture = r.render(frame, scene)`.

    It keeps what it learnt from earlier frames (the fused room, estimates of light), so pass the frames of one
    take in order; call `forget` before starting another. Use it from one thread only.

    Args:
        method: `exact`, `paper`, `dlpv`, `dlpv-paper`, `aroof`, `differential`, `none` or a plugin's; None: as the
            scene says.
        quality: `live`, `balanced` or `best`; None: as the scene says.
        device: EGL device, as `deltalight doctor` lists them; None: the driver's first.

    Raises:
        DeltalightError: there is no OpenGL 4.3 driver, no such device, method or quality.
    """

    def __init__(
        self,
        method: str | None = None,
        quality: Quality | None = "best",
        *,
        device: int | None = None,
    ) -> None:
        self._method = None if method is None else require_method_name(method)
        self._quality = None if quality is None else require_quality(quality)
        self._is_closed = False
        self._gpu = create_context(None if device is None else require_device(device))
        self._renderer: SceneRenderer | None = None

    @property
    def device_name(self) -> str:
        """Name of the GPU, or of the software renderer."""
        return self._gpu.renderer_name

    @property
    def is_software(self) -> bool:
        """Whether it renders without a GPU, which is slow."""
        return self._gpu.is_software

    @property
    def notices(self) -> list[str]:
        """Sentences that a user should read, each once."""
        return [] if self._renderer is None else list(self._renderer.notices)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def render(self, frame: ViewFrame, scene: Scene | SceneDocument) -> RelitPicture:
        """Relights one frame of a take.

        Without a pose (the board is out of view) or a visible object, the picture is the camera's.

        Raises:
            DeltalightError: an asset cannot be read, the scene needs more memory than it allows, the renderer is
                closed, or frame or scene are something else: arrays that do not fit the camera, an impossible pose.
        """
        return self.render_views([frame], scene)[0]

    def render_views(self, frames: Iterable[ViewFrame], scene: Scene | SceneDocument) -> list[RelitPicture]:
        """Relights one frame of each of several cameras in one room, all of one moment; returns their pictures.

        The cameras' poses must be of the same board. They share one real scene and its light: what one camera sees
        lights the pictures of the others, and a further picture costs only the work that depends on its pixels.
        Pass the cameras in the same order each time. Lights are estimated from the first one.

        Raises:
            DeltalightError: as `render`, or there are no frames.
        """
        if self._is_closed:
            raise DeltalightError("The renderer is closed; make another one.")
        frames, document = require_frames(frames), self._adjusted(require_document(scene))
        with self._gpu.ctx:  # another renderer's may be current
            renderer = self._prepared(document)
            composites = renderer.render_views(frames, with_linear=True)
            pairs = zip(frames, composites, strict=True)
            return [
                RelitPicture.of(renderer.sized(frame), composite, renderer.layers(camera))
                for camera, (frame, composite) in enumerate(pairs)
            ]

    def _adjusted(self, document: SceneDocument) -> SceneDocument:
        """Returns the scene with the method and quality that were asked for; offline, no budget applies."""
        document = document if self._method is None else with_method(document, self._method)
        if self._quality is not None:
            document = document.replaced(method=document.method.replaced(quality=self._quality))
        return document.replaced(output=document.output.replaced(frame_budget_ms=None))

    def _prepared(self, document: SceneDocument) -> SceneRenderer:
        if self._renderer is None:
            self._renderer = SceneRenderer(self._gpu, document, with_linear=True)
        elif document != self._renderer.scene:
            self._renderer.set_scene(document)
        return self._renderer

    def forget(self) -> None:
        """Forgets everything seen in earlier frames, because the next ones come from another take."""
        if self._renderer is not None:
            with self._gpu.ctx:
                self._renderer.forget_frames()

    def close(self) -> None:
        """Frees everything on the GPU; idempotent."""
        if self._is_closed:
            return
        self._is_closed = True
        if self._renderer is not None:
            with self._gpu.ctx:
                self._renderer.release()
        self._gpu.release()
