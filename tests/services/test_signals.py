"""A signal that comes while Python cannot raise is not lost."""

import subprocess
import sys
from pathlib import Path

import pytest

from deltalight.services.cli import run

ROOT = Path(__file__).parents[2]
PROGRAM = """
import os, signal, time
from deltalight.services.signals import raise_signals

class Freed:
    def __del__(self):
        os.kill(os.getpid(), signal.{name})
        time.sleep(0.1)

raise_signals()
try:
    Freed()  # what is raised while an object is freed goes nowhere
    time.sleep(60)
except BaseException as ending:
    print(type(ending).__name__)
"""


@pytest.mark.parametrize(("name", "ending"), [("SIGTERM", "Terminated"), ("SIGINT", "Interrupted")])
def test_a_signal_while_an_object_is_freed_ends_the_program_all_the_same(name: str, ending: str) -> None:
    program = [sys.executable, "-c", PROGRAM.format(name=name)]
    ended = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout.strip(), ended.stderr, ended.returncode) == (ending, "", 0)


FINISHING = """
import os, signal, time
from deltalight.services.signals import Terminated, raise_signals

raise_signals()
try:
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(60)
except Terminated:
    for _ in range(20):  # a supervisor of many threads was killed
        os.kill(os.getpid(), signal.SIGTERM)
    print("finished")
"""


def test_further_signals_do_not_break_off_what_the_first_one_ends() -> None:
    program = [sys.executable, "-c", FINISHING]
    ended = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout.strip(), ended.stderr, ended.returncode) == ("finished", "", 0)


IN_A_STRING = """
import os, signal, sys, time
from deltalight.services.signals import raise_signals

raise_signals()
try:
    exec("os.kill(os.getpid(), signal.SIGINT); time.sleep(60)")
except KeyboardInterrupt:
    print("finished")
    sys.exit(130)
"""


def test_ctrl_c_in_code_from_a_string_ends_with_the_programs_own_exit_code(tmp_path: Path) -> None:
    (tmp_path / "program.py").write_text(IN_A_STRING)
    program = [sys.executable, "-m", "program"]
    ended = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout.strip(), ended.stderr, ended.returncode) == ("finished", "", 130)


FREEING = """
import os, signal, threading, time
import zmq
from deltalight.services.signals import raise_signals

raise_signals()
frames = [zmq.Frame(b"") for _ in range(300_000)]
freeing = threading.Event()

def interrupt():
    freeing.wait()
    os.kill(os.getpid(), signal.SIGINT)

threading.Thread(target=interrupt).start()
try:
    freeing.set()
    frames.clear()  # each frame looks for signals as it is freed, in compiled code that prints what it cannot raise
    time.sleep(60)
except KeyboardInterrupt:
    print("ended")
"""


def test_a_signal_that_compiled_code_catches_leaves_no_traceback() -> None:
    program = [sys.executable, "-c", FREEING]
    ended = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout.strip(), ended.stderr, ended.returncode) == ("ended", "", 0)


def test_commands_keep_what_handles_such_a_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "excepthook", sys.__excepthook__)
    assert run(["--version"]) == 0
    assert sys.excepthook is sys.__excepthook__


IMPORTING = """
import os, runpy, signal, sys, time

class Interrupts:
    def find_spec(self, name, *_):
        if name == "deltalight.services.commands.render":
            os.kill(os.getpid(), signal.{name})
            time.sleep(60)

sys.meta_path.insert(0, Interrupts())
runpy.run_module("deltalight.services", run_name="__main__")
"""


@pytest.mark.parametrize(("name", "code"), [("SIGTERM", 143), ("SIGINT", 130)])
def test_a_signal_during_the_imports_ends_the_command_without_a_traceback(name: str, code: int) -> None:
    program = [sys.executable, "-c", IMPORTING.format(name=name)]
    ended = subprocess.run(program, cwd=ROOT, capture_output=True, text=True, timeout=120, check=False)
    assert (ended.stdout, ended.stderr, ended.returncode) == ("", "", code)
