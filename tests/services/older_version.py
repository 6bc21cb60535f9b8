"""Processes of the version before: they send and read the oldest schema version that is still read."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from deltalight.protocol.messages import OLDEST_SCHEMA_VERSION, SCHEMA_VERSION
from tests.services.conftest import ROOT

# The command of the version before: it sends and reads the oldest schema version alone, as all that it starts.
OLDER = f"""
import sys
from importlib.util import find_spec, module_from_spec
from pathlib import Path
name = "deltalight.protocol.messages"
spec = find_spec(name)
source = Path(spec.origin).read_text()
now = "SCHEMA_VERSION: Final = {SCHEMA_VERSION}\\n"
assert now in source
sys.modules[name] = module_from_spec(spec)
exec(compile(source.replace(now, "SCHEMA_VERSION: Final = {OLDEST_SCHEMA_VERSION}\\n", 1), spec.origin, "exec"),
     sys.modules[name].__dict__)
from deltalight.services.child import ChildSpec
ChildSpec.deltalight = classmethod(lambda cls, name, *words: cls(name, ("-c", sys.orig_argv[2], *words)))
from deltalight.services.cli import main
main()
"""


@contextmanager
def running(*arguments: object, is_older: bool = False) -> Iterator[None]:
    """Runs a command of this version or the one before as a process."""
    program = ["-c", OLDER] if is_older else ["-m", "deltalight.services.cli"]
    process = subprocess.Popen([sys.executable, *program, *map(str, arguments)], cwd=ROOT)
    try:
        yield
    finally:
        process.kill()
        process.wait()
