"""Programs of kernels: compiled when they first run, with the switches that are on, shared, and freed."""

from dataclasses import replace

import moderngl
import pytest

from deltalight.render_server.gpu import context as context_module
from deltalight.render_server.gpu.context import GpuContext, count_gl_objects
from deltalight.render_server.gpu.kernel import BindingError, Kernel, ShaderError
from tests.render_server.tiny_kernel import MakeKernel, floats

pytestmark = pytest.mark.usefixtures("clean_gl")


def test_labels_tell_variants_apart(gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer) -> None:
    compiled: dict[str, str] = {}
    gpu.compile_watchers.append(lambda label, sources: compiled.update({label: sources["comp"]}))
    make("", "values[0] = SIZE;", REAL=1, SIZE=0.5).run((1,), Out=out)
    gpu.compile_watchers.clear()
    assert list(compiled) == ["tiny REAL SIZE=0.5"]
    assert "#define REAL 1\n#define SIZE 0.5\n" in compiled["tiny REAL SIZE=0.5"]


def test_kernels_of_one_source_share_a_program_and_each_runs_with_its_own_values(
    make: MakeKernel, out: moderngl.Buffer
) -> None:
    before = count_gl_objects()["Program"]
    first, second = (make("uniform float a;", "values[0] = a;") for _ in range(2))
    other = make("uniform float a;", "values[0] = a;", TWICE=1)
    for kernel, value in ((first, 3), (second, 4), (first, 3), (other, 2)):
        kernel.run((1,), Out=out, a=value)
        assert floats(out, 1) == [value]
    assert count_gl_objects()["Program"] - before == 2
    first.release()
    second.run((1,), Out=out, a=5)
    other.run((1,), a=6, Out=out)
    assert floats(out, 1) == [6]


def test_programs_that_nobody_uses_are_freed_beyond_some(
    make: MakeKernel, out: moderngl.Buffer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(context_module, "SPARE_PROGRAMS", 0)
    kept = make("", "values[0] = 1.0;", KEPT=1)
    kept.run((1,), Out=out)
    before = count_gl_objects()["Program"]
    for number in range(3):
        spare = make("", "values[0] = 1.0;", NUMBER=number)
        spare.run((1,), Out=out)
        spare.release()
    assert count_gl_objects()["Program"] <= before
    assert kept.resources()["storage blocks"] == ["Out"]


def test_switches_choose_a_variant_that_is_compiled_when_first_run(
    gpu: GpuContext, make: MakeKernel, out: moderngl.Buffer
) -> None:
    """What hangs on a switch is declared and bound only where it is on."""
    compiled: list[str] = []
    watch = lambda label, _: compiled.append(label)  # noqa: E731
    gpu.compile_watchers.append(watch)
    kernel = make(
        "#ifndef BRIGHT\n#pragma switch BRIGHT\n#else\nuniform float gain;\n#endif\n",
        "values[0] = 1.0;\n#ifdef BRIGHT\nvalues[0] *= gain;\n#endif\n",
    )
    assert compiled == []
    for on, expected in ((False, 1.0), (True, 3.0), (False, 1.0), (True, 3.0)):
        kernel.run((1,), {"BRIGHT": on, "gain": 3.0}, Out=out)
        assert floats(out, 1) == [expected]
    gpu.compile_watchers.remove(watch)
    assert compiled == ["tiny", "tiny BRIGHT"]
    with pytest.raises(BindingError, match="Kernel tiny needs `BRIGHT`"):
        kernel.run((1,), Out=out)


def test_a_variant_that_never_runs_is_never_compiled(make: MakeKernel, out: moderngl.Buffer) -> None:
    before = count_gl_objects()["Program"]
    kernel = make("#pragma switch bool bright\n", "values[0] = bright ? 3.0 : 1.0;", "local_size_x = 4")
    assert (kernel.label, kernel.local_size) == ("tiny", (4, 1, 1))
    with pytest.raises(BindingError, match="Kernel tiny needs `bright`"):
        kernel.run((1,), Out=out)
    assert count_gl_objects()["Program"] == before
    kernel.run((1,), Out=out, bright=True)
    assert floats(out, 1) == [3]
    assert count_gl_objects()["Program"] == before + 1


def test_checks_of_shaders_compile_what_never_runs(gpu: GpuContext) -> None:
    compiled: list[str] = []
    watchers = [lambda label, _: compiled.append(label)]
    for compiles_unrun, expected in ((False, []), (True, ["direct_light"])):
        checked = replace(gpu, compile_watchers=watchers, compiles_unrun=compiles_unrun)
        Kernel(checked, "direct_light").release()
        assert compiled == expected


def test_a_shader_that_the_driver_refuses_is_named_with_its_switches(
    make: MakeKernel, out: moderngl.Buffer
) -> None:
    kernel = make("#pragma switch BRIGHT\n", "values[0] = 1.0;\n#ifdef BRIGHT\nbrighten();\n#endif\n", SIZE=2)
    kernel.run((1,), Out=out, BRIGHT=False)
    with pytest.raises(ShaderError, match=r"Kernel tiny SIZE=2 BRIGHT does not compile: [\s\S]*brighten"):
        kernel.run((1,), Out=out, BRIGHT=True)
    kernel.run((1,), Out=out, BRIGHT=False)
    assert floats(out, 1) == [1]
