"""The `deltalight` command: registers the commands and reports faults by sentences and exit codes.

Exit codes: 0 done, 1 a fault of the program (or `doctor` found one), 2 wrong use or bad input, 75 the GPU was reset,
130 Ctrl-C, 141 nobody reads the output any more (`| head`), 143 SIGTERM.
"""

import errno
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from typer.core import TyperGroup
from typer.main import get_command

from deltalight import __version__
from deltalight.benchmarks.cli import bench, gpu_check
from deltalight.protocol.errors import DeltalightError, unreachable
from deltalight.services.commands.api import api
from deltalight.services.commands.backup import backup, restore
from deltalight.services.commands.board import board
from deltalight.services.commands.calibrate import calibrate
from deltalight.services.commands.config import config
from deltalight.services.commands.demo import demo
from deltalight.services.commands.doctor import doctor
from deltalight.services.commands.examples import examples_of
from deltalight.services.commands.foxglove import foxglove
from deltalight.services.commands.graph import graph
from deltalight.services.commands.keys import keys
from deltalight.services.commands.node import node
from deltalight.services.commands.ping import ping
from deltalight.services.commands.precompute import precompute
from deltalight.services.commands.record import record
from deltalight.services.commands.recordings import recordings
from deltalight.services.commands.render import render
from deltalight.services.commands.replay import replay
from deltalight.services.commands.rooms import rooms
from deltalight.services.commands.schema import schema
from deltalight.services.commands.server import server
from deltalight.services.commands.stream import stream
from deltalight.services.commands.up import up
from deltalight.services.commands.virtual_camera import virtual_camera
from deltalight.services.open_files import allow_many_connections, open_standard_streams
from deltalight.services.parent_death_signal import end_with_supervisor
from deltalight.services.process import InForkedChild
from deltalight.services.signals import Terminated, raise_signals
from deltalight.services.warm_spare import wait_if_spare

DEBUG_FLAG = "--debug"
LIVE_COMMANDS = frozenset(
    {"node", "server", "api", "demo", "up"}
)  # they do the same for each frame, or fork who does
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
REFUSED_PATH = frozenset({errno.EACCES, errno.ENAMETOOLONG, errno.ELOOP})
FULL_DISK = frozenset({errno.ENOSPC, errno.EDQUOT})
UNREAD_OUTPUT = 128 + signal.SIGPIPE  # as of programs that the signal ends, which Python ignores
PYDANTIC_PREFIX = "Value error, "  # by which pydantic, which typer checks options with, begins such sentences


class _Commands(TyperGroup):
    """Shows wrong values of options without words of pydantic's."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401 - click's context, of typer's own click in newer versions
        """Runs the command that was named."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as fault:
            fault.message = fault.message.removeprefix(PYDANTIC_PREFIX)
            raise


app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Mixed-reality relighting: virtual objects in a camera picture, with light acting both ways.",
)
for command in (
    render,
    demo,
    precompute,
    node,
    server,
    up,
    record,
    replay,
    backup,
    restore,
    foxglove,
    config,
    doctor,
    graph,
    schema,
    board,
    ping,
    virtual_camera,
    stream,
):
    app.command(epilog=examples_of(command.__name__))(command)
app.add_typer(api, name="api")
app.add_typer(recordings, name="recordings")
app.add_typer(rooms, name="rooms")
app.add_typer(calibrate, name="calibrate")
app.add_typer(keys, name="keys")
app.add_typer(bench, name="bench")
app.command()(gpu_check)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"deltalight {__version__}")
        raise typer.Exit


@app.callback()
def _global_options(
    debug: Annotated[  # read by run(), so that it may appear anywhere
        bool, typer.Option(DEBUG_FLAG, help="Show the full traceback of an error instead of one sentence.")
    ] = False,
    log_level: Annotated[
        str, typer.Option(help="Lowest level of messages to log: debug, info, warning or error.")
    ] = "info",
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    del debug, version
    from deltalight.services.logs import configure_logging  # as long as `--help` itself

    configure_logging(log_level)


def main() -> None:
    """Runs the command line of this process and exit with its code."""
    code = None
    while code is None:
        with suppress(InForkedChild):  # this process is the child, with a command line of its own
            code = _run_as_process()
    sys.exit(_with_output_flushed(code))


def _with_output_flushed(code: int) -> int:
    """Writes what standard output still holds, which Python would do with a traceback, and returns the exit code."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD_OUTPUT
    return code


def _run_as_process() -> int:
    raise_signals()
    open_standard_streams()
    end_with_supervisor()
    allow_many_connections()
    limit_blas_threads(sys.argv[1:])
    wait_if_spare(run)
    return run(sys.argv[1:])


def limit_blas_threads(words: Sequence[str]) -> None:
    """Gives live commands one thread of OpenBLAS each, unless the environment says how many.

    A frame's matrices are small: more threads wait for each other, spinning, longer than they compute, and take the
    cores from the other processes. It works until numpy is imported.
    """
    if LIVE_COMMANDS.intersection(words):
        os.environ.setdefault(BLAS_THREADS, "1")


def run(arguments: list[str]) -> int:
    """Runs one command line in this process and returns its exit code.

    Faults become sentences on stderr; with `--debug`, anywhere on the line, they are raised.
    """
    words = [argument for argument in arguments if argument != DEBUG_FLAG]
    try:
        command = get_command(app)  # calling `app` would replace sys.excepthook
        _refuse_empty_paths(command)
        command(words, prog_name="deltalight")
    except SystemExit as stop:
        # Typer turns a broken pipe into code 1.
        return UNREAD_OUTPUT if isinstance(stop.__context__, BrokenPipeError) else int(stop.code or 0)
    except Terminated:
        return 128 + signal.SIGTERM
    except KeyboardInterrupt:
        return 128 + signal.SIGINT
    except Exception as fault:
        if DEBUG_FLAG in arguments:
            raise
        return _report(fault)
    return 0


def _refuse_empty_paths(command: Any) -> None:  # noqa: ANN401 - a command of click's, as above
    """Lets no option or argument take "" for a path: it would be the current folder (`--out "$UNSET"`)."""
    hints = get_type_hints(command.callback) if command.callback else {}
    for parameter in command.params:
        hint = hints.get(parameter.name)
        if Path in (hint, *get_args(hint)):
            parameter.process_value = partial(_path, parameter, parameter.process_value)
    for below in getattr(command, "commands", {}).values():
        _refuse_empty_paths(below)


def _path(parameter: Any, process: Callable[[Any, Any], Any], context: Any, value: object) -> Any:  # noqa: ANN401
    if value == "":
        raise typer.BadParameter("the path is empty; write one ('.' is this folder).", context, parameter)
    return process(context, value)


def _report(fault: Exception) -> int:
    if isinstance(fault, OSError) and fault.errno in FULL_DISK:  # that of standard output, say
        fault = DeltalightError(
            f"the output cannot be written ({fault.strerror}); free some space, and run it again."
        )
    if isinstance(fault, OSError) and fault.errno in REFUSED_PATH and fault.filename is not None:
        fault = unreachable(Path(os.fsdecode(fault.filename)), fault.strerror)
    if isinstance(fault, DeltalightError):
        print(f"deltalight: {' '.join(str(fault).split())}", file=sys.stderr)
        return fault.exit_code
    kind = type(fault).__name__
    print(
        f"deltalight: internal error, {kind}: {fault}; run it again with --debug and report the traceback.",
        file=sys.stderr,
    )
    return 1


if __name__ == "__main__":
    main()
