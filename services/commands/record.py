"""`deltalight record`: the raw streams of a node to an .mcap recording."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from deltalight.protocol.counts import counted
from deltalight.services.commands.options import ConfigFile, NodeName, NodeStreams, node_endpoints
from deltalight.services.commands.room_options import Room, Rooms, following_room

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from deltalight.protocol.keys import Keys
    from deltalight.protocol.scene import SceneDocument
    from deltalight.services.recorder import Recorder, RecordStatus

SHOW_PERIOD_S, LINE_PERIOD_S = 0.25, 1.0

Show = Callable[["RecordStatus"], None]


def record(
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Recording to write, NAME.mcap; it must not exist.")
    ],
    subscribe: NodeStreams = None,
    node: NodeName = None,
    name: Annotated[
        str | None, typer.Option(help="Name of the node, if several publish there or the room has several.")
    ] = None,
    scene: Annotated[Path | None, typer.Option(help="Scene document to attach.")] = None,
    control: Annotated[
        str | None, typer.Option(help="Control endpoint of the render server whose scene is attached.")
    ] = None,
    extrinsics: Annotated[
        Path | None, typer.Option(help="calibration/extrinsics.yaml: transforms between the sensors.")
    ] = None,
    composites: Annotated[
        str | None,
        typer.Option(
            help="Endpoint of the render server whose relit pictures are kept too, beside the frames."
        ),
    ] = None,
    rooms: Rooms = None,
    room: Room = None,
    duration: Annotated[float | None, typer.Option(min=0.1, help="Stop after this many seconds.")] = None,
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    config_file: ConfigFile = None,
    progress: Annotated[
        bool, typer.Option("--progress", help="Print the progress as a line of JSON once a second.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON.")] = False,
) -> None:
    """Record every raw frame of a node, or of that of --room, until Ctrl-C, or for --duration or --frames."""
    from rich.console import Console

    from deltalight.protocol.calibration import load_extrinsics_yaml
    from deltalight.protocol.keys import KeySettings
    from deltalight.services.recorder import Recorder, RecordJob
    from deltalight.services.rooms.follower import streams_of_room
    from deltalight.services.settings import load_configuration

    settings = load_configuration(config_file).section("keys", KeySettings)
    if rooms is None or room is None or subscribe or node is not None:
        places = node_endpoints(subscribe, node, settings)
    else:
        places = [streams_of_room(rooms, room, name, settings.load([rooms]))]
    keys = settings.load([*places, *(each for each in (control, composites, rooms) if each is not None)])
    job = RecordJob(
        out,
        tuple(places),
        node=name,
        scene=_scene(scene, control, keys),
        extrinsics=None if extrinsics is None else load_extrinsics_yaml(extrinsics),
        duration_s=duration,
        frames=frames,
        keys=keys,
        composites=composites,
    )
    console = Console(stderr=True, soft_wrap=True)
    recorder = Recorder(job, lambda sentence: console.print(sentence, markup=False, highlight=False))
    shown = _progress_lines() if progress else _progress_on(console)
    with following_room(rooms, room, keys, recorder.follow):
        _run(recorder, shown, lambda status: _print_summary(status, as_json=as_json))


def _scene(path: Path | None, control: str | None, keys: "Keys | None") -> "SceneDocument | None":
    from deltalight.protocol.errors import DeltalightError
    from deltalight.protocol.scene import load_scene
    from deltalight.services.recorder import scene_of_server

    if path is not None and control is not None:
        raise DeltalightError("--scene and --control both name a scene to attach; give one of them.")
    if path is not None:
        return load_scene(path)
    return None if control is None else scene_of_server(control, keys)


@contextmanager
def _progress_on(console: "Console") -> "Iterator[Show]":
    from rich.live import Live

    with Live(console=console, transient=True, auto_refresh=False) as live:
        yield lambda status: live.update(_line(status), refresh=True)


@contextmanager
def _progress_lines() -> "Iterator[Show]":
    printed_s = -LINE_PERIOD_S

    def show(status: "RecordStatus") -> None:
        nonlocal printed_s
        if time.monotonic() - printed_s >= LINE_PERIOD_S:
            printed_s = time.monotonic()
            print(json.dumps(status.as_dict()), flush=True)

    yield show


def _run(recorder: "Recorder", progress: "AbstractContextManager[Show]", summarize: "Show") -> None:
    """Records in a thread, which no signal interrupts in the middle of a frame, and shows progress."""
    from concurrent.futures import ThreadPoolExecutor, wait
    from threading import Event

    from deltalight.services.signals import Terminated

    stop, ended_by = Event(), None
    with ThreadPoolExecutor(1) as thread:
        running = thread.submit(recorder.run, stop)
        try:
            with progress as show:
                while not wait([running], SHOW_PERIOD_S).done:
                    show(recorder.status)
        except (KeyboardInterrupt, Terminated) as signal:
            ended_by = signal
        finally:
            stop.set()
        status = running.result()
    summarize(status)
    if ended_by is not None and (isinstance(ended_by, Terminated) or not status.frames):
        raise ended_by  # Ctrl-C ends a recording normally; without a frame there is none


def _line(status: "RecordStatus") -> "Text":
    from rich.text import Text

    words = (
        f"{status.out.name}: {counted(status.frames, 'frame')}, {status.seconds:.0f} s,"
        f" {status.size_bytes / 1e6:.1f} MB, {status.bytes_per_s / 1e6:.1f} MB/s,"
        f" lost {_losses(status)}, {status.free_bytes / 1e9:.1f} GB free"
    )
    return Text(words if status.frames else "waiting for the first frame", no_wrap=True, overflow="ellipsis")


def _losses(status: "RecordStatus") -> str:
    parts = [f"{count} {stream}" for stream, count in status.missing.items() if count]
    if status.node_drops:
        parts.append(f"{status.node_drops} dropped by the node itself")
    parts += [f"{count} {cause} dropped here" for cause, count in status.dropped.items() if count]
    if status.unkept:
        parts.append(f"{counted(status.unkept, 'frame')} that the disk refused")
    return ", ".join(parts) or "nothing"


def _print_summary(status: "RecordStatus", *, as_json: bool) -> None:
    figures = status.as_dict()
    if as_json:
        typer.echo(json.dumps(figures))
    elif not status.frames:
        typer.echo("Nothing was recorded and no file was written.", err=True)
    else:
        relit = f", {counted(status.composites, 'relit picture')}" if status.composites else ""
        typer.echo(
            f"{counted(status.frames, 'frame')}{relit} in {status.seconds:.1f} s ({figures['frames_per_s']:.1f} a"
            f" second), {status.size_bytes / 1e6:.1f} MB ({figures['mb_per_s']:.1f} MB/s), lost {_losses(status)},"
            f" {100 * figures['cpu_share']:.0f} % of a core, written to {status.out}"
        )
