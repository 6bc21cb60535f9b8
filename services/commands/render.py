"""`deltalight render`: a recording to composites on disk."""

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.counts import counted
from deltalight.services.commands.options import Device, Quality, View

if TYPE_CHECKING:
    from deltalight.services.offline import RenderSummary


class LayerFormat(StrEnum):
    """File format of the layers."""

    EXR = "exr"


def render(
    source: Annotated[Path, typer.Argument(help="Dataset folder or .mcap recording.")],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Folder for the pictures, created if missing; or a video, NAME.mp4."
        ),
    ],
    scene: Annotated[
        Path | None, typer.Option(help="Scene document; default: the one in the recording.")
    ] = None,
    frames: Annotated[
        str | None,
        typer.Option(metavar="A:B", help="Frame numbers from A up to but not including B; default: all."),
    ] = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Size of the pictures, such as 640x480; default: as the scene says."
        ),
    ] = None,
    device: Device = None,
    view: Annotated[View | None, typer.Option(help="View to render; default: as the scene says.")] = None,
    method: Annotated[
        str | None,
        typer.Option(help="Relighting method, as for `demo`, or a plugin's; default: as the scene says."),
    ] = None,
    quality: Annotated[
        Quality, typer.Option(help="What may be given up for speed while something moves.")
    ] = Quality.BEST,
    exr: Annotated[bool, typer.Option("--exr", help="Also write linear OpenEXR files.")] = False,
    layers: Annotated[
        LayerFormat | None,
        typer.Option(help="Also write light and objects as layers, for a compositing program."),
    ] = None,
    allow_software: Annotated[
        bool, typer.Option("--allow-software", help="Do not warn about a missing GPU.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Render a recording to pictures, OUT/000000.png and so on, with facts in OUT/frames.jsonl; or to a video."""
    from deltalight.protocol.method_names import with_method
    from deltalight.protocol.source import open_source
    from deltalight.services.commands.options import parse_frames, parse_size
    from deltalight.services.host import choose_scene
    from deltalight.services.offline import RenderJob, run_job, with_output

    size_px = None if size is None else parse_size(size)
    recording = open_source(source)
    document = with_output(choose_scene(recording, scene), size_px, view and view.value)
    document = document if method is None else with_method(document, method)
    document = document.replaced(
        method=document.method.replaced(quality=quality.value),
        output=document.output.replaced(frame_budget_ms=None),
    )
    job = RenderJob(
        recording,
        document,
        parse_frames(frames, len(recording)),
        out,
        device,
        with_exr=exr,
        with_layers=layers is not None,
    )
    for note in recording.notes:
        typer.echo(note, err=True)
    bar = _Bar(len(job.frames), warn=not allow_software)
    with bar.progress:
        summary = run_job(job, bar)
    _print_summary(summary, as_json=as_json)


class _Bar:
    """Shows a job on stderr: a bar, warnings above it."""

    def __init__(self, total: int, *, warn: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        console = Console(stderr=True, soft_wrap=True)
        hidden = not console.is_terminal  # it would leave an empty line in a file
        self.progress = Progress(*columns, console=console, transient=True, disable=hidden)
        self._task = self.progress.add_task("rendering", total=total)
        self._warn = warn

    def renderer(self, name: str, *, is_software: bool) -> None:
        if is_software and self._warn:
            self.notice(f"warning: no GPU found, rendering slowly in software with {name}")

    def notice(self, sentence: str) -> None:
        self.progress.console.print(sentence, markup=False, highlight=False)

    def frame_done(self) -> None:
        self.progress.advance(self._task)


def _print_summary(summary: "RenderSummary", *, as_json: bool) -> None:
    figures = summary.as_dict()
    if as_json:
        typer.echo(json.dumps(figures))
        return
    typer.echo(
        f"{counted(figures['frames'], 'frame')}, {figures['no_pose']} without a pose, {figures['mean_ms']:.1f} ms"
        f" per frame, {figures['renderer']}, written to {figures['out']}"
    )
