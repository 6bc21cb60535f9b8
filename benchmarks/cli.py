"""`deltalight bench` and `gpu-check`: measurements of this machine. The only module here that `services` imports."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from deltalight.protocol.errors import DeltalightError
from deltalight.services.commands.options import Device, writable

if TYPE_CHECKING:
    from deltalight.benchmarks.speed.measure import SpeedJob

# The methods that `bench quality` compares by default.
DEFAULT_METHODS = "camera,none,paper,exact,path"

# Those of `bench speed`, `bench counts` and `bench kernels`.
TIMED_METHODS = "raster,none,exact,paper,dlpv"
# Those of `bench views`; beams that smooth objects cast are traced for each camera.
VIEWS_METHODS = "exact,exact:caustics=false,paper,dlpv"
DEFAULT_MOTIONS = "camera,object,arm,lamps,still"

Size = Annotated[str | None, typer.Option(metavar="WxH", help="Size of the pictures; default: the demo's.")]
ReportFile = Annotated[
    Path | None, typer.Option("--out", "-o", callback=writable, help="File for the report as JSON.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the report as JSON.")]

METHODS_HELP = (
    "dvct (the scene's own), raster (objects without shadows: a floor), none (objects without relighting), exact, "
    "paper, dlpv, dlpv-paper, aroof, differential, a plugin's; or exact:KEY=VALUE[,KEY=VALUE], likewise for the "
    "others except none."
)
MOTIONS_HELP = "What moves: camera, object, arm, lamps, still; separated by commas."

bench = typer.Typer(
    no_args_is_help=True, help="Measure speed on this machine, and agreement with ground truth."
)


@bench.command()
def speed(
    *,
    size: Size = None,
    methods: Annotated[str, typer.Option(help=METHODS_HELP)] = TIMED_METHODS,
    motions: Annotated[str, typer.Option(help=MOTIONS_HELP)] = DEFAULT_MOTIONS,
    frames: Annotated[int, typer.Option(min=1, max=10_000, help="Frames per measurement.")] = 30,
    budget_ms: Annotated[
        float, typer.Option(min=0.1, help="Frames that take longer are counted as late, ms.")
    ] = 100.0,
    device: Device = None,
    end_to_end: Annotated[
        bool,
        typer.Option("--end-to-end/--no-end-to-end", help="Measure node, server and viewer processes too."),
    ] = True,
    compare: Annotated[
        tuple[Path, Path] | None,
        typer.Option(metavar="A B", help="Compare two reports instead of measuring: B against A."),
    ] = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time each stage of a frame while camera, object, real scene or light moves, and the delay to the viewer."""
    if compare is not None:
        from deltalight.benchmarks.speed.command import run_comparison

        run_comparison(*compare, as_json=as_json)
        return
    job = _speed_job(methods, motions, frames, size, device)
    from deltalight.benchmarks.speed.command import run_speed

    run_speed(job, budget_ms, end_to_end=end_to_end, out=out, as_json=as_json)


@bench.command()
def counts(
    *,
    size: Size = None,
    methods: Annotated[str, typer.Option(help=METHODS_HELP)] = TIMED_METHODS,
    motions: Annotated[str, typer.Option(help=MOTIONS_HELP)] = DEFAULT_MOTIONS,
    frames: Annotated[
        int, typer.Option(min=1, max=1000, help="Frames to count, and as many again to time without the GPU.")
    ] = 8,
    device: Device = None,
    gpu_paths: Annotated[
        bool, typer.Option("--gpu-paths", help="Render as on a GPU, also where there is none (slow).")
    ] = False,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Count what a frame asks of the GPU, and time what Python takes for it while the GPU is left out."""
    job = _speed_job(methods, motions, frames, size, device)
    from deltalight.benchmarks.speed.command import run_counts

    run_counts(job, gpu_paths=gpu_paths, out=out, as_json=as_json)


@bench.command()
def kernels(
    *,
    size: Size = None,
    methods: Annotated[str, typer.Option(help=METHODS_HELP)] = TIMED_METHODS,
    motions: Annotated[str, typer.Option(help=MOTIONS_HELP)] = "camera",
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames to time of each motion.")] = 8,
    device: Device = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time each kernel and draw of a frame alone: which of a stage's kernels takes long."""
    job = _speed_job(methods, motions, frames, size, device)
    from deltalight.benchmarks.speed.command import run_kernels

    run_kernels(job, out=out, as_json=as_json)


@bench.command()
def roofline(
    *,
    report: Annotated[Path, typer.Argument(help="Report of `bench speed --out`; its times are kept.")],
    methods: Annotated[
        str | None, typer.Option(help="Which of the report's methods, as for `bench speed`; default: all.")
    ] = None,
    motions: Annotated[
        str | None, typer.Option(help="Which of the report's motions, separated by commas; default: all.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames to count of each motion.")] = 3,
    device: Device = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Count the arithmetic of a speed report's stages, and show how far they are from the machine's limits."""
    from deltalight.benchmarks.variants import RENDERED, parse_variants

    named = None if methods is None else [variant.name for variant in parse_variants(methods, RENDERED)]
    from deltalight.benchmarks.speed.command import run_roofline
    from deltalight.benchmarks.speed.motions import parse_motions
    from deltalight.benchmarks.speed.report import read_report
    from deltalight.benchmarks.speed.roofline import RooflineJob

    moved = None if motions is None else parse_motions(motions)
    run_roofline(RooflineJob(read_report(report), named, moved, frames, device), out=out, as_json=as_json)


@bench.command()
def views(
    *,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of each camera's pictures.")] = "320x240",
    methods: Annotated[str, typer.Option(help=METHODS_HELP)] = VIEWS_METHODS,
    geometry: Annotated[
        Literal["depth", "fused"], typer.Option(help="What the real scene is made of.")
    ] = "depth",
    moments: Annotated[int, typer.Option(min=1, max=1000, help="Moments of each measurement.")] = 8,
    device: Device = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time pictures of one, two and three cameras in one room, by processor time and in turn."""
    from deltalight.benchmarks.variants import RENDERED, parse_variants
    from deltalight.services.commands.options import parse_size

    variants, size_px = parse_variants(methods, RENDERED), parse_size(size)
    from deltalight.benchmarks.views import ViewsJob, run_views

    run_views(ViewsJob(variants, moments, size_px, geometry, device), out=out, as_json=as_json)


@bench.command()
def node(
    *,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the camera's pictures.")] = "320x240",
    rounds: Annotated[int, typer.Option(min=1, max=1000, help="How often each frame is measured.")] = 4,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time what a frame costs a sensor node, by part, while the camera rests and while it moves."""
    from deltalight.services.commands.options import parse_size

    size_px = parse_size(size)
    from deltalight.benchmarks.node_costs import run_node_costs

    run_node_costs(size_px, rounds, out=out, as_json=as_json)


@bench.command()
def sweep(
    *,
    full: Annotated[
        bool,
        typer.Option("--full", help="All sizes, up to 512 voxels along each edge: for a GPU."),
    ] = False,
    size: Size = None,
    frames: Annotated[int, typer.Option(min=1, max=1000, help="Frames per size.")] = 8,
    device: Device = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time stages as shadow maps, volumes and steps grow, beside the times published in the dissertation."""
    from deltalight.services.commands.options import parse_size

    size_px = None if size is None else parse_size(size)
    from deltalight.benchmarks.speed.command import run_sweeps

    run_sweeps(frames, size_px, device, full=full, out=out, as_json=as_json)


@bench.command()
def quality(
    *,
    scenes: Annotated[
        str | None, typer.Option(help="Benchmark scenes, separated by commas; default: all.")
    ] = None,
    methods: Annotated[
        str,
        typer.Option(
            help="camera, dvct (the scene's own), none, paper, exact, fisheye (exact with the lights of the fish-eye "
            "picture), dlpv, dlpv-paper, aroof, differential, raster, path, path+oidn (denoised), a plugin's; or "
            "exact:KEY=VALUE[,KEY=VALUE], likewise for the others that render."
        ),
    ] = DEFAULT_METHODS,
    ablation: Annotated[
        bool, typer.Option("--ablation", help="Compare the paper's operator with ours, one switch per row.")
    ] = False,
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the pictures.")] = "320x240",
    volume: Annotated[
        int | None,
        typer.Option(min=32, max=512, help="Voxels along each edge; default: what this machine can do."),
    ] = None,
    spp: Annotated[
        int, typer.Option(min=1, help="Light paths per pixel of the truth; a multiple of 8.")
    ] = 512,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")] = Path("quality"),
    device: Device = None,
    as_json: AsJson = False,
) -> None:
    """Compare relit pictures with path-traced truth: figures, and a page with pictures of the errors."""
    from deltalight.services.commands.options import parse_size

    size_px = parse_size(size)
    try:
        from deltalight.benchmarks.quality.command import run_quality
    except ModuleNotFoundError as missing:
        raise DeltalightError(
            f"`bench quality` needs the package {missing.name}; install the project with its dev extra."
        ) from missing
    chosen = None if scenes is None else scenes.split(",")
    compared = None if ablation else methods
    run_quality(chosen, compared, size_px, spp, volume_size=volume, device=device, out=out, as_json=as_json)


@bench.command()
def real(
    *,
    data: Annotated[Path, typer.Option(help="Folder of real pairs: carton_table and robot_bins.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")] = Path("real"),
    device: Device = None,
    as_json: AsJson = False,
) -> None:
    """Compare relit tables with photographs with and without things: lights are fitted in one, tested in others."""
    try:
        from deltalight.benchmarks.real.command import run_real
    except ModuleNotFoundError as missing:
        raise DeltalightError(
            f"`bench real` needs the package {missing.name}; install the project with its dev extra."
        ) from missing
    run_real(data, out, device=device, as_json=as_json)


@bench.command()
def plot(
    *,
    speed: Annotated[
        list[Path],
        typer.Option(
            help="Report of `bench speed`; may be given more than once: the first report that has a method counts."
        ),
    ],
    quality: Annotated[
        list[Path],
        typer.Option(
            help="quality.json in a report folder of `bench quality`; may be given more than once, likewise, for the "
            "same scenes."
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", callback=writable, metavar="FILE.svg", help="File for the picture.")
    ],
    motion: Annotated[str, typer.Option(help="What moves while frames are timed.")] = "camera",
) -> None:
    """Plot speed against quality, a point for each method that both reports have."""
    from deltalight.benchmarks.plot import draw_plot, read_plot
    from deltalight.protocol.files import write_bytes

    found = read_plot(speed, quality, motion)
    write_bytes(out, draw_plot(found).encode())
    if found.left_out:
        typer.echo(f"Left out, in one kind of report only: {', '.join(found.left_out)}.", err=True)
    typer.echo(f"The picture is in {out}.", err=True)


@bench.command()
def rest(
    *,
    seconds: Annotated[
        float, typer.Option(min=0.2, max=3600, help="Duration of each measurement, s.")
    ] = 20.0,
    size: Size = None,
    device: Device = None,
    out: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Time the REST API with and without rendering, what 20 live viewers cost, and the dashboard's size."""
    from deltalight.protocol.files import write_bytes
    from deltalight.services.commands.options import parse_size

    size_px = None if size is None else parse_size(size)
    from deltalight.benchmarks.rest import (  # needs the api extra, unlike a wrong option
        measure_rest,
        print_report,
    )

    report = measure_rest(seconds, size=size_px, device=device)
    if out is not None:
        write_bytes(out, json.dumps(report, indent=2).encode())
    if as_json:
        typer.echo(json.dumps(report, indent=2))
    else:
        print_report(report)


@bench.command()
def soak(
    *,
    minutes: Annotated[
        float,
        typer.Option(min=0, max=7 * 24 * 60, help="Duration in minutes; each fault happens at least once."),
    ] = 2.0,
    profile: Annotated[
        str,
        typer.Option(
            help="station: four nodes, 320x240, 15 pictures a second; desk: one node, 10 a second; synthetic: "
            "the same of the synthetic camera; small: one node, 5 a second, short faults."
        ),
    ] = "station",
    faults: Annotated[
        str,
        typer.Option(
            help="all, none, or of these, separated by commas: kill-node, kill-server, kill-web, kill-recorder, "
            "stop-node, stop-server, stop-web, viewers, churn, nonsense, link-arm, link-foxglove, link-lossy, "
            "link-reorder, cut."
        ),
    ] = "all",
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of the order of the faults and of all that is random in them.")
    ] = 0,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")] = Path("soak"),
) -> None:
    """Run a station of real processes under faults, and report delay, rate, memory and open files."""
    from deltalight.benchmarks.soak.command import SoakJob, print_report, run_soak
    from deltalight.benchmarks.soak.faults import parse_faults
    from deltalight.benchmarks.soak.profiles import choose_profile

    choose_profile(profile)
    job = SoakJob(profile, parse_faults(faults), 60 * minutes, seed)
    print_report(run_soak(job, out, lambda text: typer.echo(f"soak: {text}", err=True)), out)


@bench.command()
def rooms(
    *,
    times: Annotated[int, typer.Option(min=1, max=100, help="How often each act is measured.")] = 5,
    placer: Annotated[
        Literal["local", "ray", "both"],
        typer.Option(help="What places the rooms; ray: on hosts of a cluster on this machine."),
    ] = "both",
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the report.")] = Path("rooms"),
) -> None:
    """Kill, move and drain a room of real processes, and report for how long its viewers see nothing."""
    try:
        from deltalight.benchmarks.rooms.command import print_report, run_rooms
    except ModuleNotFoundError as missing:
        raise DeltalightError(
            f"`bench rooms` needs the package {missing.name}; install the project with its dev extra."
        ) from missing
    placers = ("local", "ray") if placer == "both" else (placer,)
    print_report(run_rooms(placers, times, out, lambda text: typer.echo(f"rooms: {text}", err=True)), out)


def _speed_job(methods: str, motions: str, frames: int, size: str | None, device: int | None) -> "SpeedJob":
    from deltalight.benchmarks.variants import RENDERED, parse_variants
    from deltalight.services.commands.options import parse_size

    variants, size_px = parse_variants(methods, RENDERED), None if size is None else parse_size(size)
    from deltalight.benchmarks.speed.measure import SpeedJob  # needs OpenGL's packages, unlike a wrong option
    from deltalight.benchmarks.speed.motions import parse_motions

    return SpeedJob(variants, parse_motions(motions), frames, size_px, device)


def gpu_check(
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the report and pictures that differ.")
    ] = Path("gpu-check"),
    steps: Annotated[
        str | None,
        typer.Option(
            help="Steps, separated by commas: doctor, shaders, pictures, speed, memory, leaks, quality, tests, "
            "slow-tests; default: all."
        ),
    ] = None,
) -> None:
    """Check this machine's GPU and driver, eight minutes at most; exit code 1 if a step failed or ran out of time."""
    from deltalight.benchmarks.gpu_check.packages import missing_packages
    from deltalight.benchmarks.gpu_check.plan import choose_steps

    chosen, missing = choose_steps(steps), missing_packages()
    from deltalight.benchmarks.gpu_check.check import check_gpu  # needs some of those packages
    from deltalight.services.files import make_output_folder

    def say(text: str) -> None:
        typer.echo(f"gpu-check: {text}", err=True)

    if missing:
        say(f"these packages are not installed: {', '.join(missing)}")
    report = check_gpu(make_output_folder(out), chosen, missing, say)
    typer.echo(f"gpu-check: {report.sentence}")
    raise typer.Exit(1 if report.bad_steps else 0)
