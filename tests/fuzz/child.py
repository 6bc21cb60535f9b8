"""The process that libFuzzer runs in: the decoders are instrumented as they are imported."""

import hashlib
import sys
import time
import traceback
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["deltalight"]):
    from tests.fuzz.targets import attempt

SLOW_S = 1.0  # of processor time


def main() -> None:
    """Fuzz `sys.argv[1]`; faults that Python can catch are kept, once each by their place, and fuzzing goes on."""
    target, seen, slowest_s = sys.argv.pop(1), set[str](), 0.0
    kept = Path(next(word for word in sys.argv if word.startswith("-artifact_prefix=")).partition("=")[2])

    def test_one(data: bytes) -> None:
        nonlocal slowest_s
        began_s = time.process_time()
        try:
            attempt(target, data)
        except Exception as fault:
            _keep(kept, _place(fault), data, fault, seen)
        took_s = time.process_time() - began_s
        if took_s > slowest_s:
            slowest_s = took_s
            print(
                f"stat::slowest_input_ms: {1e3 * took_s:.0f}", file=sys.stderr, flush=True
            )  # as libFuzzer does
        if took_s > SLOW_S:
            _keep(kept, "slow", data, None, seen)

    atheris.Setup(sys.argv, test_one)
    atheris.Fuzz()


def _place(fault: Exception) -> str:
    frames = [frame for frame in traceback.extract_tb(fault.__traceback__) if "/tests/" not in frame.filename]
    last = frames[-1] if frames else None
    return (
        f"{type(fault).__name__}-{Path(last.filename).stem}-{last.lineno}" if last else type(fault).__name__
    )


def _keep(folder: Path, place: str, data: bytes, fault: Exception | None, seen: set[str]) -> None:
    if place in seen:
        return
    seen.add(place)
    (folder / f"{place}-{hashlib.sha256(data).hexdigest()[:8]}").write_bytes(data)
    if fault is not None:
        print("".join(traceback.format_exception(fault)), file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
