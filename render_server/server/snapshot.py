"""Snapshots: one frame rendered into files in several views and by several methods, with linear radiance."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float32, UInt8
from pydantic import Field, model_validator

from deltalight.protocol.documents import StrictModel
from deltalight.protocol.errors import DeltalightError
from deltalight.protocol.files import replacing, write_png
from deltalight.protocol.frames import ViewFrame, linear_color
from deltalight.protocol.message_fields import Name
from deltalight.protocol.radiance_files import write_exr
from deltalight.protocol.scene import SceneDocument, parse_scene
from deltalight.render_server.camera_frames import CameraFrame

CAMERA_VIEW = "camera"
EXR_NAME = "composite.exr"
MAX_PICTURES = 32


class SnapshotPicture(StrictModel):
    """One picture, NAME.png: a view of the scene document, or `camera`; `method` = a document to use instead."""

    name: Name
    view: str = "composite"
    method: dict[str, Any] | None = None


class SnapshotRequest(StrictModel):
    """What to write into an existing folder; `exr` adds composite.exr (linear, the scene's own method).

    `camera`: whose frame; None = the first one's.
    """

    folder: Path
    camera: str | None = None
    pictures: tuple[SnapshotPicture, ...] = Field(default=(), max_length=MAX_PICTURES, fail_fast=True)
    exr: bool = False

    @model_validator(mode="after")
    def _names_differ(self) -> "SnapshotRequest":
        names = [picture.name for picture in self.pictures]
        if len(set(names)) < len(names):
            raise ValueError("two pictures have the same name, but every name must be unique")
        return self


class RenderedPicture(Protocol):
    """The part of a composite that a snapshot uses; `linear` is None if nothing was rendered."""

    @property
    def color(self) -> UInt8[np.ndarray, "h w 3"]:
        """The picture in the camera's code."""

    @property
    def linear(self) -> Float32[np.ndarray, "h w 3"] | None:
        """The same before the camera's response."""


class StartedPicture(Protocol):
    """A frame in flight on the GPU."""

    @property
    def finish(self) -> Callable[[], RenderedPicture]:
        """Returns the composite."""


class SnapshotRenderer(Protocol):
    """The part of `renderer.SceneRenderer` that a snapshot uses."""

    def set_scene(self, scene: SceneDocument) -> None:
        """Switches to another scene."""

    def sized(self, frame: ViewFrame) -> ViewFrame:
        """Returns the frame at the composite's size."""

    def submit_cameras(
        self, taken: Sequence[CameraFrame], *, with_linear: bool = False, full_size: bool = False
    ) -> Sequence[StartedPicture]:
        """Starts the composites that are to be shown, at full size if `full_size`."""


@dataclass
class Snapshot:
    """Names of the files that were written, and by picture name the reasons for those that were not."""

    files: list[str] = field(default_factory=list)
    errors: dict[str, str] = field(default_factory=dict)

    @contextmanager
    def writing(self, name: str, file: str) -> Iterator[None]:
        """Records `file` as written, or the error that prevented it."""
        try:
            yield
        except DeltalightError as fault:
            self.errors[name] = str(fault)
        else:
            self.files.append(file)


def take_snapshot(
    renderer: SnapshotRenderer, scene: SceneDocument, taken: Sequence[CameraFrame], order: SnapshotRequest
) -> Snapshot:
    """Writes the ordered pictures of one frame; afterwards the renderer shows `scene` and that frame again.

    `taken`: the room's frames, of which that one is to be shown. None may be in flight. Rendering the same frames
    again adds nothing to averages over frames.

    Raises:
        DeltalightError: the folder does not exist.
    """
    folder = order.folder
    if not folder.is_dir():
        raise DeltalightError(
            f"There is no folder {folder}; name one that exists on the render server's host."
        )
    snapshot = Snapshot()
    try:
        for picture in order.pictures:
            file = f"{picture.name}.png"
            with snapshot.writing(picture.name, file):
                write_png(folder / file, _picture(renderer, scene, taken, picture))
        if order.exr:
            with snapshot.writing(EXR_NAME, EXR_NAME), replacing(folder / EXR_NAME) as temporary:
                write_exr(temporary, _linear(renderer, scene, taken))
    finally:
        renderer.set_scene(scene)
        with suppress(DeltalightError):  # it was reported when the frame arrived
            _composite(renderer, taken)
    return snapshot


def _picture(
    renderer: SnapshotRenderer, scene: SceneDocument, taken: Sequence[CameraFrame], picture: SnapshotPicture
) -> UInt8[np.ndarray, "h w 3"]:
    if picture.view == CAMERA_VIEW:
        return renderer.sized(_shown(taken)).color
    renderer.set_scene(_variant(scene, picture.view, picture.method))
    return _composite(renderer, taken, full_size=True).color


def _linear(
    renderer: SnapshotRenderer, scene: SceneDocument, taken: Sequence[CameraFrame]
) -> Float32[np.ndarray, "h w 3"]:
    renderer.set_scene(_variant(scene, "composite", None))
    composite = _composite(renderer, taken, with_linear=True)
    return linear_color(_shown(taken), composite.color) if composite.linear is None else composite.linear


def _composite(
    renderer: SnapshotRenderer,
    taken: Sequence[CameraFrame],
    *,
    with_linear: bool = False,
    full_size: bool = False,
) -> RenderedPicture:
    (started,) = renderer.submit_cameras(taken, with_linear=with_linear, full_size=full_size)
    return started.finish()


def _shown(taken: Sequence[CameraFrame]) -> ViewFrame:
    return next(each.frame for each in taken if each.is_shown)


def _variant(scene: SceneDocument, view: str, method: dict[str, Any] | None) -> SceneDocument:
    """Returns the scene in another view, by another method.

    Keeps the triangle budget of the real scene's mesh: another one would restart the mesh, and lose earlier frames.
    """
    document = scene.model_dump(mode="json")
    document["output"]["view"] = view
    if method is not None:
        document["method"] = method
    variant = parse_scene(document, "the picture")
    if "triangle_budget" not in type(variant.method).model_fields:
        return variant
    budget = getattr(scene.method, "triangle_budget", None)
    return variant.replaced(method=variant.method.replaced(triangle_budget=budget))
