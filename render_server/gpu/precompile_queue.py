"""Programs that the next motion will run: compiled while nothing moves, so that no gesture waits for a compiler.

Drivers of GPUs take half a second for some programs, and a first drag or a first move of the camera needs several:
those that reuse the light of the frame before.
"""

from collections.abc import Mapping
from typing import Any, Protocol


class PrecompilableKernel(Protocol):
    """A kernel with a program to compile ahead (`kernel.Kernel`)."""

    def compile_ahead(self, known: Mapping[str, Any]) -> None:
        """Compiles the program that the like of these bindings will run."""


class PrecompileQueue:
    """Programs to compile ahead: at most one of each kernel, with bindings to compile it for."""

    def __init__(self) -> None:
        self._waiting: dict[PrecompilableKernel, Mapping[str, Any]] = {}

    def add(self, kernel: PrecompilableKernel, known: Mapping[str, Any]) -> None:
        """Adds a kernel's program; newer bindings replace those before, which may have been released since."""
        self._waiting[kernel] = known

    def forget(self, kernel: PrecompilableKernel) -> None:
        """Leaves out the program of a kernel."""
        self._waiting.pop(kernel, None)

    def compile_next(self) -> None:
        """Compiles the program that was added first, if there is one."""
        if self._waiting:
            kernel = next(iter(self._waiting))
            kernel.compile_ahead(self._waiting.pop(kernel))
