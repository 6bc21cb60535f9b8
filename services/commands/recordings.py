"""`deltalight recordings`: contents of a recording, recovery, and conversion from and to dataset folders."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from deltalight.protocol.counts import counted
from deltalight.protocol.errors import DeltalightError
from deltalight.services.exports import ExportFormat

if TYPE_CHECKING:
    from rich.progress import Progress
    from rich.table import Table

    from deltalight.services.recording_copies import Copied, Track

recordings = typer.Typer(no_args_is_help=True, help="Inspect, repair and convert recordings.")

FILE = Annotated[Path, typer.Argument(help="Recording: .mcap, or .mcap.active if it was not finished.")]
AS_JSON = Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")]


@recordings.command()
def info(
    file: FILE, *, as_json: Annotated[bool, typer.Option("--json", help="Print the facts as JSON.")] = False
) -> None:
    """Show what a recording contains: frames, rates, sizes, cameras, and what is missing."""
    from deltalight.services.recording_info import describe_recording

    with _progress("reading", show_count=False) as progress:
        task = progress.add_task("reading", total=1.0)
        found = describe_recording(file, lambda fraction: progress.update(task, completed=fraction))
    if as_json:
        typer.echo(json.dumps(found))
    else:
        from rich.console import Console

        console = Console(soft_wrap=True)
        for table in (_summary_table(found), _stream_table(found)):
            console.print(table)
        for note in found["notes"]:
            typer.echo(note, err=True)


@recordings.command()
def recover(
    file: FILE,
    *,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="Repaired recording; default: NAME.mcap for NAME.mcap.active, else NAME-recovered.mcap.",
        ),
    ] = None,
    as_json: AS_JSON = False,
) -> None:
    """Repair a recording that was cut off or damaged; writes a new .mcap and leaves the old file as it is."""
    from deltalight.services.recording_copies import recover_recording, recovered_name

    copied = recover_recording(file, out or recovered_name(file), _track("recovering"))
    if copied is None:
        typer.echo(json.dumps({"out": None}) if as_json else f"{file} is whole; there is nothing to recover.")
    else:
        _print_copied(copied, as_json=as_json)


@recordings.command(name="import")
def import_(
    folder: Annotated[
        Path, typer.Argument(help="Dataset folder with rgb.txt, or a ROS bag: a .bag file or ROS 2's folder.")
    ],
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Recording to write, NAME.mcap; it must not exist.")
    ],
    scene: Annotated[
        Path | None, typer.Option(help="Scene document to attach; default: FOLDER/scene.json if it exists.")
    ] = None,
    as_json: AS_JSON = False,
) -> None:
    """Convert a dataset folder or a ROS bag to a recording."""
    from deltalight.services.exports.ros_bags import import_bag, is_bag
    from deltalight.services.recording_copies import import_folder

    if is_bag(folder):
        if scene is not None:
            raise DeltalightError("--scene is attached to dataset folders; leave it out for a ROS bag.")
        _print_copied(import_bag(folder, out, _track("importing")), as_json=as_json)
        return
    _print_copied(import_folder(folder, out, scene, _track("importing")), as_json=as_json)


@recordings.command()
def export(
    file: FILE,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder or file to write; it must not exist.")],
    format: Annotated[  # the option's name
        ExportFormat, typer.Option(help="What to write; see docs/recording.md.")
    ] = ExportFormat.DATASET,
    scene: Annotated[
        Path | None, typer.Option(help="Scene document for --format glb; default: the attached one.")
    ] = None,
    as_json: AS_JSON = False,
) -> None:
    """Convert a recording to a dataset folder, or to the format of another program."""
    from deltalight.services.exports.recording import export_as

    _print_copied(export_as(format, file, out, scene, _track("exporting")), as_json=as_json)


def _progress(words: str, *, show_count: bool = True) -> "Progress":
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn(words), BarColumn(), *([MofNCompleteColumn()] if show_count else [])]
    console = Console(stderr=True)
    is_hidden = not console.is_terminal
    return Progress(*columns, TimeRemainingColumn(), console=console, transient=True, disable=is_hidden)


def _track(words: str) -> "Track":
    def track(numbers: range) -> Iterable[int]:
        with _progress(words) as progress:
            yield from progress.track(numbers)

    return track


def _print_copied(copied: "Copied", *, as_json: bool) -> None:
    if as_json:
        figures = {
            "out": str(copied.out),
            "frames": copied.frames,
            "lost": copied.lost,
            "notes": copied.notes,
        }
        typer.echo(json.dumps(figures))
        return
    for note in copied.notes:
        typer.echo(note, err=True)
    typer.echo(f"{counted(copied.frames, 'frame')}, {copied.lost} lost, written to {copied.out}")


def _summary_table(found: dict[str, Any]) -> "Table":
    from rich.table import Table

    table = Table("Recording", found["file"], title_justify="left")
    for name, value in _rows(found):
        table.add_row(name, value)
    return table


def _rows(found: dict[str, Any]) -> list[tuple[str, str]]:
    seconds = found["duration_s"]
    return [
        ("finished", _finished(found)),
        ("duration", f"{seconds:.2f} s"),
        ("frames", f"{found['frames']}" + _per_second(found["frames_per_s"], "a second")),
        ("size", f"{found['bytes'] / 1e6:.2f} MB" + _per_second(found["mb_per_s"], "MB/s")),
        ("lost", _lost(found)),
        ("colour", _color(found["color"])),
        ("depth", _depth(found["depth"])),
        ("fish-eye", _fisheye(found["fisheye"])),
        ("given poses", str(found["given_poses"])),
        ("relit pictures", str(found["composites"] or "none")),
        ("board", _board(found["board"])),
        ("transforms", ", ".join(found["extrinsics"]) or "none"),
        ("scene", "none" if found["scene"] is None else found["scene"] or "attached"),
    ]


def _finished(found: dict[str, Any]) -> str:
    damage = f", {counted(found['damaged_parts'], 'damaged part')}" if found["damaged_parts"] else ""
    return ("yes" if found["is_finished"] else "no, `recordings recover` finishes it") + damage


def _per_second(rate: float | None, unit: str) -> str:
    return "" if rate is None else f", {rate:.2f} {unit}"


def _lost(found: dict[str, Any]) -> str:
    gaps, longest_s = found["gaps"], found["longest_gap_s"]
    told = f", {counted(gaps, 'gap')}, the longest {longest_s:.3f} s" if gaps else ""
    return f"{counted(found['frames_skipped'], 'frame number')} skipped{told}"


def _color(color: dict[str, Any]) -> str:
    exposure = color["exposure_s"]
    shown = "exposure not told" if exposure is None else f"exposure {_span_ms(exposure)}"
    response = "its own response" if color["has_response"] else "sRGB"
    return f"{_camera(color['camera'])}, {shown}, {response}"


def _span_ms(span: list[float]) -> str:
    low, high = (f"{1000 * seconds:.3g}" for seconds in span)
    return f"{low} ms" if low == high else f"{low} to {high} ms"


def _camera(camera: dict[str, Any]) -> str:
    matrix = camera["matrix"]
    focal = f"f {matrix[0]:.1f} x {matrix[4]:.1f} px"
    return f"{camera['width']}x{camera['height']}, {camera['distortion_model']}, {focal}"


def _depth(depth: dict[str, Any] | None) -> str:
    if depth is None:
        return "none"
    scale = "32-bit floats" if depth["scale_m"] is None else f"{1000 * depth['scale_m']:g} mm a step"
    return f"{_camera(depth['camera'])}, {scale}, in {counted(depth['frames'], 'frame')}"


def _fisheye(fisheye: dict[str, Any] | None) -> str:
    if fisheye is None:
        return "none"
    lens, exposures = fisheye["lens"], len(fisheye["exposures_s"])
    size = f"{lens['width']}x{lens['height']}" if "width" in lens else "size not told"
    bracket = f"{exposures} exposures" if exposures > 1 else "one exposure"
    return f"{size}, {lens.get('distortion_model')}, {counted(fisheye['pictures'], 'moment')} of {bracket}"


def _board(board: dict[str, Any] | None) -> str:
    return "none" if board is None else f"{board['type']}, {board['dictionary']}"


def _stream_table(found: dict[str, Any]) -> "Table":
    from rich.table import Table

    table = Table("Stream", "Messages", "MB before compression", "KB a message", title_justify="left")
    for column in table.columns[1:]:
        column.justify = "right"
    for topic, figures in found["streams"].items():
        count, size = figures["messages"], figures["bytes"]
        table.add_row(topic, str(count), f"{size / 1e6:.2f}", f"{size / 1e3 / count:.1f}")
    return table
