"""Kernels: programs whose resources and uniforms are bound by their GLSL names.

Linking assigns units and binding points, so shaders state none, and every run passes all that the kernel
needs.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence, Set
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from difflib import get_close_matches
from functools import partial
from itertools import compress
from pathlib import Path
from typing import Any, cast

import moderngl
import numpy as np

from deltalight.render_server.gpu.buffer_images import BUFFER_IMAGES, BufferImage
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.program_slots import IMAGES, SAMPLERS, BindingCalls, Slot, Value, values_of
from deltalight.render_server.gpu.shader_source import SHADERS, Declarations, declarations, shader_source
from deltalight.render_server.gpu.texel_images import with_images
from deltalight.render_server.gpu.textures import image_format, release_all, texels_of
from deltalight.render_server.gpu.uniform_block import UniformBlock

GL_INT = 0x1404

Texture = moderngl.Texture | moderngl.Texture3D | moderngl.TextureArray
PLAIN = (float, int, bool, tuple, list)  # values of uniforms that moderngl takes as they are
CONSTANT = frozenset({float, int, bool, tuple})  # those of them that nobody changes in place
Binding = Texture | moderngl.Buffer | UniformBlock[Any] | Value | None
Bindings = Mapping[str, Binding]
"""GLSL names and what is bound to them; None stands for nothing: a texture without texels, an empty buffer."""


class BindingError(RuntimeError):
    """A name is undeclared or missing, or its value is of the wrong kind."""


class ShaderError(RuntimeError):
    """The driver refuses a shader."""


@dataclass(frozen=True)
class Dispatch:
    """One run of a kernel: workgroups (x, y, z) or triangles drawn, and what it wrote, by name.

    `size` is empty where the GPU counted the workgroups itself.
    """

    kernel: str
    size: tuple[int, ...]
    written: Mapping[str, object]


class Program:
    """A linked program and its resources by name."""

    def __init__(
        self,
        gpu: GpuContext,
        label: str,
        program: moderngl.Program | moderngl.ComputeShader,
        declared: Declarations,
    ) -> None:
        self._gpu, self.label, self.program, self._declared = gpu, label, program, declared
        self.compute = cast("moderngl.ComputeShader", program)  # if it is one that is dispatched
        self.users: set[int] = set()  # ids of the kernels that have not been released
        self._samplers: list[Slot] = []
        self._images: list[Slot] = []
        self._arrays: list[Slot] = []  # storage buffers that a shader takes as images
        self._storage: list[Slot] = []
        self._blocks: list[Slot] = []
        self._uniforms: list[Slot] = []
        for name in program:
            self._adopt(name, program[name])
        self._assign()
        self._shown = {
            slot.name: BufferImage(gpu.texture_calls, slot.place, *declared.formats[slot.name])
            for slot in self._arrays
        }
        binders: Sequence[tuple[list[Slot], Callable[[Slot, Any], Callable[[], None]]]] = (
            (self._samplers, self._sampler_call),
            (self._images, self._image_call),
            (self._arrays, self._array_call),
            (self._storage, self._storage_call),
            (self._blocks, self._block_call),
        )
        bound = [(slot, binder) for slots, binder in binders for slot in slots]
        self._resources = values_of([slot.name for slot, _ in bound])
        self._calls = BindingCalls([partial(binder, slot) for slot, binder in bound])
        self._values = values_of([slot.name for slot in self._uniforms])
        self._held: tuple[Any, ...] | None = None  # values of uniforms, if nobody can change them in place

    def _adopt(self, name: str, member: object) -> None:
        slot = Slot(name, member, getattr(member, "gl_type", 0))
        if isinstance(member, moderngl.StorageBlock):
            self._storage.append(slot)
        elif isinstance(member, moderngl.UniformBlock):
            self._blocks.append(slot)
        elif isinstance(member, moderngl.Uniform):
            textures = (SAMPLERS, self._samplers), (IMAGES, self._images), (BUFFER_IMAGES, self._arrays)
            slots = next((slots for kinds, slots in textures if slot.kind in kinds), self._uniforms)
            slots.append(slot)
            if slots is not self._uniforms:
                slot.member.gl_type = GL_INT  # as units are; moderngl 5.13 leaves that of an image3D unset

    def _assign(self) -> None:
        """Assigns units and binding points, each kind from 0 on."""
        for slots in (self._samplers, [*self._images, *self._arrays]):
            for slot in slots:
                slot.place = slots.index(slot)
                slot.member.value = slot.place
        for slots in (self._storage, self._blocks):
            for slot in slots:
                slot.place = slots.index(slot)
                slot.member.binding = slot.place

    def bind(self, own: Bindings, known: Bindings) -> None:
        """Binds everything that the program reads and writes, of what is `known`; `own` names must be declared.

        Raises:
            BindingError: a name or value does not fit.
        """
        if not own.keys() <= self._declared.names:
            name = next(name for name in own if name not in self._declared.names)
            raise BindingError(f"Kernel {self.label} declares no `{name}`{self._nearest(name)}.")
        try:
            resources, values = self._resources(known), self._values(known)
        except KeyError:
            slots = self._samplers, self._images, self._storage, self._blocks, self._arrays, self._uniforms
            require_given({slot.name for each in slots for slot in each}, known, self.label)
            raise
        for call in self._calls.of(resources):
            call()
        # Compared all at once: of most programs none is another, and to look at each would take longest of all here.
        is_constant = CONSTANT.issuperset(map(type, values))
        if not is_constant or values != self._held:
            self._held = None  # until all of them are written
            for slot, value in zip(self._uniforms, values, strict=True):
                if type(value) not in CONSTANT or slot.last != value:
                    self._write(slot, value)
            self._held = values if is_constant else None

    def _nearest(self, name: str) -> str:
        close = get_close_matches(name, self._declared.names, 1)
        return f"; the nearest name is `{close[0]}`" if close else ""

    def _wrong(self, slot: Slot, value: object, wanted: str) -> BindingError:
        return BindingError(f"Kernel {self.label}: `{slot.name}` is {wanted}, not a {type(value).__name__}.")

    def _require_held(self, slot: Slot, value: Any) -> None:  # noqa: ANN401 (textures and buffers)
        if isinstance(value.mglo, moderngl.InvalidObject):
            raise BindingError(f"Kernel {self.label}: `{slot.name}` was released; bind what replaces it.")

    def _sampler_call(self, slot: Slot, value: Binding) -> Callable[[], None]:
        kind, texels = SAMPLERS[slot.kind]
        texture: Any = self._gpu.empty_texture(kind, f"{texels}1", 4) if value is None else value
        self._check_sampled(slot, texture)
        return partial(texture.mglo.use, slot.place)

    def _check_sampled(self, slot: Slot, texture: object) -> None:
        kind, texels = SAMPLERS[slot.kind]
        if not isinstance(texture, Texture) or not isinstance(texture, kind):
            raise self._wrong(slot, texture, f"a {kind.__name__} that is sampled")
        self._require_held(slot, texture)
        # n: integers that are read as fractions of their greatest
        if texture.dtype[0].replace("n", "f") != texels:
            raise BindingError(
                f"Kernel {self.label}: `{slot.name}` samples texels of type {texels}, not {texture.dtype}."
            )

    def _image_call(self, slot: Slot, value: Binding) -> Callable[[], None]:
        texture: Any = value
        if value is None and slot.name not in self._declared.written:
            (texels,) = self._declared.formats[slot.name]
            texture = self._gpu.empty_texture(IMAGES[slot.kind], *texels_of(texels))
        else:
            self._check_image(slot, value)
        return partial(texture.mglo.bind, slot.place, True, True, 0, 0)  # read, write, level, its own format

    def _check_image(self, slot: Slot, texture: object) -> None:
        kind = IMAGES[slot.kind]
        if not isinstance(texture, Texture) or not isinstance(texture, kind):
            raise self._wrong(slot, texture, f"a {kind.__name__} that is written or read texel by texel")
        self._require_held(slot, texture)
        wanted = self._declared.formats[slot.name]
        found = image_format(texture)
        if wanted and found not in wanted:
            raise BindingError(
                f"Kernel {self.label}: `{slot.name}` is declared {' or '.join(sorted(wanted))}, "
                f"but the texture is {found}."
            )

    def _array_call(self, slot: Slot, value: Binding) -> Callable[[], None]:
        return partial(self._shown[slot.name].bind, self._buffer(slot, value))

    def _storage_call(self, slot: Slot, value: Binding) -> Callable[[], None]:
        mglo: Any = self._buffer(slot, value).mglo
        return partial(mglo.bind_to_storage_buffer, slot.place, 0, -1)  # all of it

    def _buffer(self, slot: Slot, value: Binding) -> moderngl.Buffer:
        is_written = slot.name in self._declared.written
        nothing = self._gpu.discarded_buffer if is_written else self._gpu.empty_buffer
        buffer = nothing if value is None else value
        if not isinstance(buffer, moderngl.Buffer):
            raise self._wrong(slot, value, "a storage buffer")
        self._require_held(slot, buffer)
        return buffer

    def _block_call(self, slot: Slot, value: Binding) -> Callable[[], None]:
        if not isinstance(value, UniformBlock):
            raise self._wrong(slot, value, "a uniform block")
        self._require_held(slot, value)
        if not value.fits(slot.member.size):
            raise BindingError(
                f"Kernel {self.label}: block `{slot.name}` takes {slot.member.size} bytes, "
                f"{type(value.value).__name__} packs {value.size}."
            )
        return value.binds(slot.place)

    def _write(self, slot: Slot, value: Binding) -> None:
        """Writes a uniform if its value changed; 4x4 arrays are row-major here."""
        data: bytes | Value
        if isinstance(value, np.ndarray):
            ordered = value.T if value.ndim == 2 and slot.member.matrix else value
            data = np.ascontiguousarray(ordered, dtype="f4").tobytes()
        elif isinstance(value, PLAIN):
            data = value
        elif isinstance(value, np.generic):
            data = value.item()
        else:
            raise self._wrong(slot, value, "a uniform")
        if slot.last == data:
            return
        try:
            if isinstance(data, bytes):
                slot.member.write(data)
            else:
                slot.member.value = data
        except Exception as error:  # struct and moderngl raise several kinds
            raise BindingError(
                f"Kernel {self.label}: `{slot.name}` cannot take {value!r} ({error})."
            ) from error
        slot.last = data

    @property
    def local_size(self) -> tuple[int, int, int]:
        """Invocations of a workgroup."""
        return self._declared.local_size

    def resources(self) -> dict[str, list[str]]:
        """Names of the active samplers, images, storage blocks and uniform blocks."""
        return {
            "samplers": [slot.name for slot in self._samplers],
            "images": [slot.name for slot in self._images],
            "storage blocks": [slot.name for slot in (*self._arrays, *self._storage)],
            "uniform blocks": [slot.name for slot in self._blocks],
        }

    def release(self) -> None:
        """Frees the GL objects."""
        release_all(self.program, *self._shown.values())

    def written(self, known: Bindings) -> dict[str, object]:
        """Images and buffers that it may write, of what its names were bound to."""
        slots = (*self._images, *self._arrays, *self._storage)
        bound = {slot.name: known[slot.name] for slot in slots if slot.name in self._declared.written}
        return {name: item for name, item in bound.items() if item is not None}

    def report(self, size: tuple[int, ...], written: Callable[[], Mapping[str, object]]) -> None:
        """Tells the watchers that the program ran, and what `written` says it wrote."""
        for watch in self._gpu.watchers:
            watch(Dispatch(self.label, size, written()))


class Shader(ABC):
    """The programs of one shader: with each set of its switches (`#pragma switch NAME`) that bindings turn on.

    Each is compiled when first run: what a scene lacks costs nothing.
    """

    def __init__(self, gpu: GpuContext, name: str | Path, defines: Mapping[str, float | str]) -> None:
        self._gpu, self._name, self._defines = gpu, name, defines
        self.label = label_of(name, defines)
        declared = declarations(self._text(defines))
        self.local_size, self._switches = declared.local_size, declared.switches
        self._switch_values = values_of(declared.switches)
        self._programs: dict[tuple[str, ...], Program] = {}  # by the switches that are on
        if gpu.compiles_unrun:
            self._with(())

    @abstractmethod
    def _text(self, defines: Mapping[str, float | str]) -> str:
        """Returns what the driver gets with these defines."""

    @abstractmethod
    def _compiled(self, defines: Mapping[str, float | str]) -> Program:
        """Returns the linked program of these defines."""

    def _shared(self, *source: str, link: Callable[[], Program]) -> Program:
        program = self._gpu.programs.take(self, source, link)
        assert isinstance(program, Program)
        return program

    def _tell_compiled(self, label: str, stages: Mapping[str, str]) -> None:
        """Tells the watchers, who look at what any GPU compiles."""
        if self._gpu.compile_watchers:
            self._gpu.compiled(label, stages)

    def _bound(self, own: Bindings, shared: Sequence[Bindings]) -> tuple[Program, Bindings]:
        """Returns the program that the bindings choose, with everything bound, and what each name is bound to."""
        known = merged(own, shared)
        program = self._chosen(known)
        program.bind(own, known)
        return program, known

    def _chosen(self, known: Bindings) -> Program:
        on = self._switched_on(known) if self._switches else ()
        return self._programs.get(on) or self._first_chosen(on, known)

    def _first_chosen(self, on: tuple[str, ...], _known: Bindings) -> Program:
        """Returns the program with these switches on, which these bindings are the first to choose."""
        return self._with(on)

    def _switched_on(self, known: Bindings) -> tuple[str, ...]:
        try:
            return tuple(compress(self._switches, self._switch_values(known)))
        except KeyError:
            require_given(frozenset(self._switches), known, self.label)
            raise

    def _with(self, on: tuple[str, ...]) -> Program:
        """Returns the program with these switches on; compiles it if it never ran.

        Raises:
            ShaderError: the driver refuses it.
        """
        if on not in self._programs:
            defines = {**self._defines, **dict.fromkeys(on, 1)}
            try:
                self._programs[on] = self._compiled(defines)
            except moderngl.Error as fault:
                label = label_of(self._name, defines)
                raise ShaderError(f"Kernel {label} does not compile: {fault}") from fault
        return self._programs[on]

    def resources(self) -> dict[str, list[str]]:
        """Returns the names of the bindings of the program without switches, by kind."""
        return self._with(()).resources()

    def release(self) -> None:
        """Leaves the programs to other kernels of the same source."""
        for each in self._programs.values():
            self._gpu.programs.give_back(self, each)


class Kernel(Shader):
    """A compute shader with its defines: `name`.comp.glsl of the shaders' folder, or of another one if it is a path.

    The one place where work is dispatched, so that the memory barrier is never forgotten: a missing barrier does not
    show on a software renderer.

    Where a binding `NAME_later` is true, later frames turn the switch NAME on: the program with it is compiled ahead
    (gpu/precompile_queue.py).
    """

    def __init__(self, gpu: GpuContext, name: str | Path, **defines: float | str) -> None:
        super().__init__(gpu, name, defines)
        self._later: Bindings = {}  # switches to be turned on, until the program with them is compiled

    def _text(self, defines: Mapping[str, float | str]) -> str:
        source = shader_source(SHADERS / f"{self._name}.comp.glsl", {**self._gpu.defines, **defines})
        return with_images(source, self._gpu.most_images) if self._gpu.is_software else source

    def _compiled(self, defines: Mapping[str, float | str]) -> Program:
        source, label = self._text(defines), label_of(self._name, defines)
        self._tell_compiled(label, {"comp": shader_source(SHADERS / f"{self._name}.comp.glsl", defines)})

        def link() -> Program:
            return Program(self._gpu, label, self._gpu.ctx.compute_shader(source), declarations(source))

        return self._shared(source, link=link)

    def _first_chosen(self, on: tuple[str, ...], known: Bindings) -> Program:
        off = set(self._switches).difference(on)
        self._later = {name: True for name in off if known.get(f"{name}_later")}
        self._gpu.precompile_queue.forget(self)
        return self._with(on)

    def compile_later(self, *shared: Bindings, **own: Binding) -> None:
        """Has the program that these bindings choose compiled ahead, unless it is compiled already."""
        known = merged(own, shared)
        if self._switched_on(known) not in self._programs:
            self._gpu.precompile_queue.add(self, known)

    def compile_ahead(self, known: Bindings) -> None:
        """Compiles the program for a run that binds the like of `known`, and turns on what is to be on later.

        It runs without workgroups, because some drivers compile for what is bound, and no sooner than that. What
        fails here is told when it fails again in a run.
        """
        known, self._later = {**known, **self._later}, {}
        with suppress(ShaderError, BindingError):
            program = self._chosen(known)
            program.bind({}, known)
            program.compute.run_indirect(self._gpu.empty_buffer)

    def release(self) -> None:
        """Leaves the programs to other kernels of the same source."""
        self._gpu.precompile_queue.forget(self)
        super().release()

    def run(self, threads: Sequence[int], *shared: Bindings, **own: Binding) -> None:
        """Runs at least `threads` (x[, y[, z]]) invocations; later work sees their writes.

        Names in `own` must be declared by the shader; from `shared` it takes what it needs. `own` takes
        precedence, then `shared` in order.

        Raises:
            BindingError: a name is undeclared or missing, or its value is of the wrong kind or format.
        """
        program, known = self._bound(own, shared)
        (x, y, z, *_), (width, height, depth) = (*threads, 1, 1), self.local_size
        groups = -(-x // width) or 1, -(-y // height) or 1, -(-z // depth) or 1
        self._gpu.settle_draws()
        program.compute.run(*groups)
        self._end(program, known, groups)

    def run_counted(self, groups: moderngl.Buffer, *shared: Bindings, **own: Binding) -> None:
        """Runs as many workgroups (x, y, z; three uint32) as `groups` holds on the GPU, perhaps none; else as `run`.

        Nothing is read back, so the CPU does not wait until the GPU has counted.
        """
        program, known = self._bound(own, shared)
        self._gpu.settle_draws()
        program.compute.run_indirect(groups)
        self._end(program, known, ())

    def _end(self, program: Program, known: Bindings, groups: tuple[int, ...]) -> None:
        """Ends a run of so many workgroups, () where only the GPU knows: later work sees its writes."""
        self._gpu.ctx.memory_barrier()
        if self._later:
            self._gpu.precompile_queue.add(self, known)
        if self._gpu.watchers:
            program.report(groups, partial(program.written, known))


def require_given(names: Set[str], known: Bindings, label: str) -> None:
    """Checks that the names that kernel `label` needs are bound.

    Raises:
        BindingError: one is missing.
    """
    if not names <= known.keys():
        missing = min(names - known.keys())
        raise BindingError(f"Kernel {label} needs `{missing}`, which it was not given.")


def merged(own: Bindings, shared: Sequence[Bindings]) -> dict[str, Binding]:
    """Returns what each name is bound to: `own` takes precedence, then `shared` in order."""
    known: dict[str, Binding] = {}
    for source in reversed(shared):
        known.update(source)
    known.update(own)
    return known


def label_of(name: str | Path, defines: Mapping[str, float | str]) -> str:
    """Returns the shader's name and defines, e.g. `trace_cones REAL`."""
    stem = name.name if isinstance(name, Path) else name
    return " ".join([stem, *(key if value == 1 else f"{key}={value}" for key, value in defines.items())])


def common_kernel(gpu: GpuContext, name: str) -> Kernel:
    """The kernel that all share, compiled on first use; it ends with the context."""
    kernel = gpu.common.get(name) or gpu.common.setdefault(name, Kernel(gpu, name))
    assert isinstance(kernel, Kernel)
    return kernel


@contextmanager
def watched(gpu: GpuContext, watch: Callable[[Dispatch], None]) -> Iterator[None]:
    """Calls `watch` for every run of a kernel of this context."""
    gpu.watchers.append(watch)
    try:
        yield
    finally:
        gpu.watchers.remove(watch)
