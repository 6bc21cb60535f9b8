"""Both tiers of the tests, what keeps workers apart that run at the same time, and what all rooms share: one GL
context, real captures.
"""

import gc
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import structlog

from deltalight.services import ports
from tests.lanes import SLOW_MARKERS, dealt, is_slow
from tests.patience import LostTime, grant

if TYPE_CHECKING:
    from deltalight.render_server.gpu.context import GpuContext

# A shell starts what it puts into the background with SIGINT ignored, and children inherit that: no test of Ctrl-C
# could pass.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine may take longer over an example than Hypothesis likes.
with suppress(ImportError):
    from hypothesis import HealthCheck, settings

    settings.register_profile("patient", deadline=None, suppress_health_check=[HealthCheck.too_slow])
    settings.load_profile("patient")

# Thousands of tests and modules come to stay: to look through them again and again takes a third of the collection.
gc.disable()

THREAD_COUNTS = ("LP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
# OpenBLAS chooses its kernels by the processor's maker too, and they differ in the last bits of what they compute:
# protected pictures were made with these. It does so once, when NumPy is loaded (pyproject.toml, `addopts`).
PROCESSOR = Path("/proc/cpuinfo")
if "numpy" not in sys.modules and PROCESSOR.exists() and "avx512f" in PROCESSOR.read_text():
    os.environ["OPENBLAS_CORETYPE"] = "SkylakeX"
WORKER = os.environ.get("PYTEST_XDIST_WORKER")  # gw0, gw1, ...; None where tests are not spread
WORKERS = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))

if WORKER is not None:
    number = int(WORKER.removeprefix("gw")) % WORKERS  # who replaces another has the next number
    ports.PRIVATE_PORTS = ports.PRIVATE_PORTS[number::WORKERS]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Gives each worker that starts now one thread to render and to compute with: together they fill the cores."""
    for name in THREAD_COUNTS:
        os.environ.setdefault(name, "1")


killed: set[str] = set()


@pytest.hookimpl(optionalhook=True)
def pytest_handlecrashitem(crashitem: str, report: pytest.TestReport, sched: Any) -> None:  # noqa: ANN401 (no stubs)
    """Runs a test again whose worker was killed: one machine's fault is no fault of the test, twice the same is."""
    if crashitem not in killed:
        killed.add(crashitem)
        report.outcome = "rerun"  # type: ignore[assignment]  # no outcome that pytest counts
        sched.mark_test_pending(crashitem)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Names the tests whose worker was killed, whatever came of them."""
    for test in sorted(killed):
        terminalreporter.write_line(f"a worker was killed in {test}, which ran again")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="run the tests marked `slow` or `data` too")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leaves slow tests out of the quick tier; in the full one they come first, so that none is waited for alone."""
    grant(items)
    if config.getoption("all") or _are_slow_ones_named(config):
        items[:] = dealt(items, WORKERS)
    elif slow := [item for item in items if is_slow(item)]:
        config.hook.pytest_deselected(items=slow)
        items[:] = [item for item in items if not is_slow(item)]


lost_time = LostTime()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    lost_time.refuse(item)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    lost_time.note(report)


def pytest_collection_finish() -> None:
    gc.enable()
    gc.freeze()


def _are_slow_ones_named(config: pytest.Config) -> bool:
    """Whether the command line says `-m slow`, `file.py` or `file.py::test`."""
    is_file_named = any(".py" in argument for argument in config.args)
    return is_file_named or any(name in config.option.markexpr for name in SLOW_MARKERS)


@pytest.fixture(scope="session", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What is kept between runs is not the user's: tests neither meet it nor leave anything there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("DELTALIGHT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(autouse=True)
def fresh_logs() -> Iterator[None]:
    """A command that runs in this process sends log lines to a stderr that pytest closes after the test."""
    yield
    structlog.reset_defaults()


@pytest.fixture(scope="session")
def shared_context() -> Iterator["GpuContext"]:
    """The context that keeps linked programs from module to module; its new memory holds NaN."""
    from deltalight.render_server.gpu.context import create_context
    from tests.unwritten_memory import FilledContext

    context = create_context()
    poisoned: Any = FilledContext(context.ctx)
    yield replace(context, ctx=poisoned)
    context.release()


@pytest.fixture(scope="module")
def gpu(shared_context: "GpuContext") -> "GpuContext":
    gc.collect()  # frees contexts that other modules left now, and not in the middle of a test: that is a GL error
    shared_context.ctx.__enter__()  # type: ignore[no-untyped-call]  # other modules' contexts may be current
    return shared_context


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real captures beside the project; tests that need it are skipped where it is absent."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("the shared real captures are not beside this checkout")
    return folder
