"""`deltalight bench` and `gpu-check`: measurements of this machine. The only module here that `services` imports."""

import json
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import DeltalightError
from services.commands.options import parse_method

# The methods that `bench quality` compares by default.
DEFAULT_METHODS = "camera,none,paper,exact,path"

bench = typer.Typer(
    no_args_is_help=True, help="Measure speed on this machine, and agreement with ground truth."
)


@bench.command()
def speed(
    *,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures; default the demo's.")
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Methods, separated by commas, as for `demo --method`.")
    ] = "exact,paper,dlpv",
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="Frames of each measurement.")] = 30,
    device: Annotated[
        int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")
    ] = None,
    end_to_end: Annotated[
        bool,
        typer.Option("--end-to-end/--no-end-to-end", help="Measure node, server and viewer processes too."),
    ] = True,
    out: Annotated[Path | None, typer.Option(help="File for the report as JSON.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Time every pass of a frame on the demo's recording, and the frame rate from camera to viewer."""
    from protocol.files import write_bytes
    from services.commands.options import parse_size

    chosen, size_px = _methods(methods), None if size is None else parse_size(size)
    from benchmarks.speed import measure_speed, print_report  # needs OpenGL's packages, unlike a wrong option

    report = measure_speed(chosen, frames, size=size_px, device=device, end_to_end=end_to_end)
    if out is not None:
        write_bytes(out, json.dumps(report, indent=2).encode())
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        print_report(report)


@bench.command()
def quality(
    *,
    scenes: Annotated[
        str | None, typer.Option(help="Benchmark scenes, separated by commas; default all.")
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            help="camera, none, paper, exact, fisheye (exact with the lights of the fish-eye picture), dlpv, "
            "dlpv-paper, path; or exact:KEY=VALUE[,KEY=VALUE], likewise for paper, dlpv, dlpv-paper."
        ),
    ] = DEFAULT_METHODS,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Compare the paper's operator with ours, one switch a row.")
    ] = False,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the pictures.")] = "320x240",
    volume: Annotated[
        int | None, typer.Option(min=32, max=512, help="Voxels an edge; default as the machine can.")
    ] = None,
    spp: Annotated[int, typer.Option(min=1, help="Light paths a pixel of the truth; a multiple of 8.")] = 512,
    out: Annotated[Path, typer.Option(help="Folder for the report.")] = Path("quality"),
    device: Annotated[
        int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Compare relit pictures with path-traced truth: figures, and a page with pictures of the errors."""
    from services.commands.options import parse_size

    size_px = parse_size(size)
    try:
        from benchmarks.quality.command import run_quality
    except ModuleNotFoundError as missing:
        raise DeltalightError(
            f"`bench quality` needs the package {missing.name}; install the project with its dev extra."
        ) from missing
    chosen = None if scenes is None else scenes.split(",")
    compared = None if ablation else methods
    run_quality(chosen, compared, size_px, spp, volume_size=volume, device=device, out=out, as_json=as_json)


@bench.command()
def rest(
    *,
    seconds: Annotated[float, typer.Option(min=0.2, max=3600, help="Length of each measurement.")] = 20.0,
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures; default the demo's.")
    ] = None,
    device: Annotated[
        int | None, typer.Option(min=0, help="EGL device; `deltalight doctor` lists them.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File for the report as JSON.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
) -> None:
    """Time the REST API with and without rendering, what 20 live viewers cost, and the dashboard's size."""
    from protocol.files import write_bytes
    from services.commands.options import parse_size

    size_px = None if size is None else parse_size(size)
    from benchmarks.rest import measure_rest, print_report  # needs the api extra, unlike a wrong option

    report = measure_rest(seconds, size=size_px, device=device)
    if out is not None:
        write_bytes(out, json.dumps(report, indent=2).encode())
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        print_report(report)


def gpu_check(
    *,
    out: Annotated[Path, typer.Option(help="Folder for the report and pictures that differ.")] = Path(
        "gpu-check"
    ),
    steps: Annotated[
        str | None,
        typer.Option(
            help="Steps, separated by commas: doctor, shaders, pictures, speed, memory, leaks, quality, tests, "
            "slow-tests; default all."
        ),
    ] = None,
) -> None:
    """Check this machine's GPU and driver, eight minutes at most; exit code 1 if a step failed or ran out of time."""
    from benchmarks.gpu_check.packages import missing_packages
    from benchmarks.gpu_check.plan import choose_steps

    chosen, missing = choose_steps(steps), missing_packages()
    from benchmarks.gpu_check.check import check_gpu  # needs some of those packages
    from services.files import make_output_folder

    def say(text: str) -> None:
        typer.echo(f"gpu-check: {text}", err=True)

    if missing:
        say(f"these packages are not installed: {', '.join(missing)}")
    report = check_gpu(make_output_folder(out), chosen, missing, say)
    typer.echo(f"gpu-check: {report.sentence}")
    raise typer.Exit(1 if report.bad_steps else 0)


def _methods(text: str) -> list[str]:
    return [parse_method(name.strip()).value for name in text.split(",")]
