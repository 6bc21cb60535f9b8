"""Kernels that write whole pictures: each invocation writes its own pixel of every output, and of nothing else.

For a vector of four numbers, Mesa's llvmpipe takes 16 ns of a core to store it to an image, one by one, and 2 to
write it to a framebuffer. So in software such a kernel is drawn: its source becomes that of a fragment shader.
"""

import re
from collections.abc import Mapping
from functools import lru_cache, partial
from pathlib import Path
from typing import Final

import moderngl

from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import (
    Binding,
    BindingError,
    Bindings,
    Kernel,
    Program,
    Shader,
    label_of,
    merged,
)
from deltalight.render_server.gpu.shader_source import SHADERS, declarations, shader_source
from deltalight.render_server.gpu.texel_images import until_bracket, with_images
from deltalight.render_server.gpu.textures import image_format, release_target

Box = tuple[int, int, int, int]  # x, y, width, height in pixels
TARGETS_KEPT = 2  # framebuffers of a kernel: what is filled in turns has two
VERTEX_SHADER = """#version 430
void main() { gl_Position = vec4(4.0 * vec2(gl_VertexID & 1, gl_VertexID >> 1) - 1.0, 0.0, 1.0); }
"""
_PRAGMA = re.compile(r"#pragma outputs (.+)")
_LOCAL_SIZE = re.compile(r"layout\(local_size[^)]*\) in;")
_OUTPUT = r"layout\(\w+\) writeonly uniform ([iu]?)image2D {};"
_BUILT_IN: Final = {  # of a compute shader, in a fragment shader; nobody reads those after the first there
    "gl_GlobalInvocationID": "uvec3(uvec2(gl_FragCoord.xy) - uvec2(first_fragment), 0u)",
    "gl_WorkGroupID": "uvec3(0u)",
    "gl_NumWorkGroups": "uvec3(1u)",
    "gl_LocalInvocationID": "uvec3(0u)",
    "gl_LocalInvocationIndex": "0u",
}


@lru_cache(maxsize=128)
def outputs_of(source: str) -> Mapping[str, str]:
    """Returns the outputs that a shader's `#pragma outputs NAME ...` names and its defines leave: name and format."""
    formats = declarations(source).formats
    names = [name for names in _PRAGMA.findall(source) for name in names.split()]
    return {name: min(formats[name]) for name in names if name in formats}


@lru_cache(maxsize=128)
def as_fragment_shader(source: str) -> str:
    """Returns the source of a fragment shader that does at each pixel what the compute shader does there."""
    for place, name in enumerate(outputs_of(source)):
        declared = rf"layout(location = {place}) out \1vec4 {name};"
        source = re.sub(_OUTPUT.format(name), declared, source)
        head = f"imageStore({name}, "
        while (at := source.find(head)) >= 0:
            arguments, rest = until_bracket(source, at + len(head), "(", ")")
            source = f"{source[:at]}{name} = {arguments.partition(', ')[2]}{rest}"
    for word, meaning in _BUILT_IN.items():
        source = source.replace(word, meaning)
    return _LOCAL_SIZE.sub("uniform ivec2 first_fragment;", source)


class _Drawn(Program):
    """The program of a kernel that is drawn, and the triangle that covers the picture."""

    def __init__(self, gpu: GpuContext, label: str, fragment: str, outputs: Mapping[str, str]) -> None:
        self.outputs = outputs
        program = gpu.ctx.program(vertex_shader=VERTEX_SHADER, fragment_shader=fragment)
        super().__init__(gpu, label, program, declarations(fragment))
        self.triangle = gpu.ctx.vertex_array(program, [])

    def release(self) -> None:
        """Frees the GL objects."""
        self.triangle.release()
        super().release()


class _DrawnKernel(Shader):
    """The programs of a kernel that is drawn, and the framebuffers of its outputs."""

    def __init__(self, gpu: GpuContext, name: str | Path, defines: Mapping[str, float | str]) -> None:
        self._targets: dict[tuple[moderngl.Texture, ...], moderngl.Framebuffer] = {}
        super().__init__(gpu, name, defines)

    def _source(self, defines: Mapping[str, float | str]) -> str:
        return shader_source(SHADERS / f"{self._name}.comp.glsl", defines)

    def _text(self, defines: Mapping[str, float | str]) -> str:
        fragment = as_fragment_shader(self._source({**self._gpu.defines, **defines}))
        return with_images(fragment, self._gpu.most_images)

    def _compiled(self, defines: Mapping[str, float | str]) -> Program:
        label, fragment = label_of(self._name, defines), self._text(defines)
        self._tell_compiled(label, {"comp": self._source(defines)})
        outputs = outputs_of(self._source({**self._gpu.defines, **defines}))
        return self._shared("drawn", fragment, link=partial(_Drawn, self._gpu, label, fragment, outputs))

    def draw(self, rectangle: Box, /, *shared: Bindings, **own: Binding) -> None:
        """Draws a rectangle of the outputs."""
        known = merged({**own, "first_fragment": rectangle[:2]}, shared)
        program = self._chosen(known)
        assert isinstance(program, _Drawn)
        outputs = {name: self._output(name, wanted, known) for name, wanted in program.outputs.items()}
        program.bind({name: value for name, value in own.items() if name not in outputs}, known)
        target = self._target_of(tuple(outputs.values()))
        target.use()
        target.viewport = rectangle
        self._gpu.ctx.enable_only(moderngl.NOTHING)
        program.triangle.render(moderngl.TRIANGLES, vertices=3)
        self._gpu.ctx.memory_barrier()
        if self._gpu.watchers:
            program.report(rectangle[2:], lambda: {**program.written(known), **outputs})

    def _output(self, name: str, wanted: str, known: Bindings) -> moderngl.Texture:
        texture = known.get(name)
        if not isinstance(texture, moderngl.Texture) or image_format(texture) != wanted:
            found = image_format(texture) if isinstance(texture, moderngl.Texture) else type(texture).__name__
            raise BindingError(
                f"Kernel {self.label}: `{name}` is declared {wanted}, but the texture is {found}."
            )
        return texture

    def _target_of(self, outputs: tuple[moderngl.Texture, ...]) -> moderngl.Framebuffer:
        """Returns the framebuffer of these textures, mostly one of the last runs'."""
        if outputs not in self._targets:
            if len(self._targets) == TARGETS_KEPT:
                self._release_targets()
            self._targets[outputs] = self._gpu.ctx.framebuffer(outputs)
        return self._targets[outputs]

    def _release_targets(self) -> None:
        for target in self._targets.values():
            release_target(target)
        self._targets.clear()

    def release(self) -> None:
        """Leaves the programs to other kernels of the same source, and frees the framebuffers."""
        self._release_targets()
        super().release()


class PictureKernel:
    """A kernel of which each invocation writes its own pixel of the images that `#pragma outputs` names.

    Every invocation must write all of them, at that pixel: in software, what it does not write is undefined.
    """

    def __init__(self, gpu: GpuContext, name: str | Path, **defines: float | str) -> None:
        self._kernel = _DrawnKernel(gpu, name, defines) if gpu.is_software else Kernel(gpu, name, **defines)

    def run(self, rectangle: Box, /, *shared: Bindings, **own: Binding) -> None:
        """Runs an invocation for each pixel of a rectangle of the outputs; the first one for that at its corner.

        Raises:
            BindingError: as `Kernel.run`.
        """
        if isinstance(self._kernel, Kernel):
            self._kernel.run(rectangle[2:], *shared, **own)
        else:
            self._kernel.draw(rectangle, *shared, **own)

    def release(self) -> None:
        """Leaves the programs to other kernels of the same source."""
        self._kernel.release()
