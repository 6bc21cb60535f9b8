"""What shaders execute is counted exactly where a closed form tells it."""

from collections.abc import Callable, Iterator
from pathlib import Path

import moderngl
import numpy as np
import pytest

from deltalight.benchmarks.speed.arithmetic import ArithmeticCounter, counted_arithmetic
from deltalight.benchmarks.speed.flop_weights import NOTHING, Cost
from deltalight.benchmarks.speed.measure import opened
from deltalight.benchmarks.speed.peaks import FLOPS_OF_ROUND
from deltalight.benchmarks.speed.peaks import SHADERS as PEAK_SHADERS
from deltalight.benchmarks.speed.spirv import Instruction, counting, decoded, encoded
from deltalight.render_server.gpu.context import GpuContext
from deltalight.render_server.gpu.kernel import Binding, Kernel
from deltalight.render_server.gpu.textures import release_all
from tests.benchmarks.small_demo import needs_tools

HEAD = """layout(local_size_x = 32) in;
layout(std430) buffer Out { float values[]; };
uniform mat3 turn;
uniform mat2x3 wide;
uniform vec4 v;
uniform float x;
uniform int rounds;
"""
THREADS = 96
ROUNDS = 7


@pytest.fixture(scope="module")
def counting_gpu() -> Iterator[tuple[GpuContext, ArithmeticCounter]]:
    """A context whose programs count."""
    with counted_arithmetic() as counter, opened(None) as gpu:
        yield gpu, counter


@pytest.fixture(autouse=True)
def current(request: pytest.FixtureRequest) -> None:
    if (
        "counting_gpu" in request.fixturenames
    ):  # other tests make contexts of their own, which are current then
        request.getfixturevalue("counting_gpu")[0].ctx.__enter__()


def executed(
    counting_gpu: tuple[GpuContext, ArithmeticCounter], folder: Path, body: str, threads: int = THREADS
) -> Cost:
    """What a kernel of this body executes."""
    gpu, counter = counting_gpu
    (folder / "counted.comp.glsl").write_text(HEAD + body)
    kernel, out = Kernel(gpu, folder / "counted"), gpu.ctx.buffer(bytes(4 * threads))
    counter.reset()
    given: dict[str, Binding] = {
        "turn": np.eye(3),
        "wide": tuple(map(float, range(6))),
        "v": (1.0, 2.0, 3.0, 4.0),
        "x": 0.5,
        "rounds": ROUNDS,
    }
    kernel.run((threads,), given, Out=out)
    found = counter.total()
    release_all(kernel, out)
    return found


LAST = "values[gl_GlobalInvocationID.x] = {};"
EXPRESSIONS = {  # and what a component of each takes
    "x * 3.0 + 1.0": Cost(2),
    "x / 3.0 - x": Cost(1, 1),
    "dot(v, v)": Cost(7),
    "dot(v.xy, v.zw)": Cost(3),
    "(v.xyz * x).x": Cost(3),
    "(turn * v.xyz).y": Cost(15),
    "(v.xyz * turn).y": Cost(15),
    "(wide * v.xy).z": Cost(9),
    "(v.xyz * wide).y": Cost(10),
    "(turn * turn)[1].x": Cost(45),
    "(transpose(turn) * x)[1].x": Cost(9),
    "outerProduct(v.xyz, v.xy)[1].x": Cost(6),
    "determinant(turn)": Cost(14),
    "length(v.xyz)": Cost(5, 1),
    "distance(v, v.wzyx)": Cost(11, 1),
    "normalize(v.xyz).x": Cost(8, 1),
    "cross(v.xyz, v.yzx).x": Cost(9),
    "reflect(v.xyz, v.yzx).x": Cost(12),
    "mix(v, v.wzyx, x).x": Cost(12),
    "fma(x, x, x)": Cost(2),
    "pow(x, 3.5) + exp2(x)": Cost(1, 2),
    "sqrt(v).x": Cost(0, 4),
    "max(x, abs(v.x))": NOTHING,
    "float(int(x) * 3)": NOTHING,
    "-x": NOTHING,
}


@needs_tools
@pytest.mark.slow
@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_an_expression_costs_what_it_is_defined_by(
    expression: str, counting_gpu: tuple[GpuContext, ArithmeticCounter], tmp_path: Path
) -> None:
    body = f"void main() {{ {LAST.format(expression)} }}"
    once = EXPRESSIONS[expression]
    assert executed(counting_gpu, tmp_path, body) == Cost(THREADS * once.flops, THREADS * once.special)


CONTROL: dict[str, Callable[[int], int]] = {  # bodies, and the cost of invocation `i`
    "for (int k = 0; k < rounds; ++k) sum = sum * x + 1.0;": lambda _: 2 * ROUNDS,
    "for (int k = 0; k < rounds; ++k) { if (k == 3) continue; sum += x; }": lambda _: ROUNDS - 1,
    "for (int k = 0; k < i % 5; ++k) sum += x;": lambda i: i % 5,
    "int k = 0; do sum += x; while (++k < i % 5);": lambda i: max(1, i % 5),
    "while (sum < 3.5) sum += x;": lambda _: 7,
    "if (i % 3 == 0) sum += x; else if (i % 3 == 1) sum = x * x + x; ": lambda i: (1, 2, 0)[i % 3],
    "if (i % 2 == 0) return; sum += x;": lambda i: i % 2,
    "switch (i % 4) { case 0: sum += x; case 1: sum += x; break; case 2: return; default: sum *= x; }": (
        lambda i: (2, 1, 0, 1)[i % 4]
    ),
    "sum += twice(x) + (i < 40 ? twice(sum) : 0.0);": lambda i: 2 + 2 + (2 if i < 40 else 0),
    "for (int k = 0; k < 3; ++k) { barrier(); sum += shared_sum; }": lambda _: 3,
}


@needs_tools
@pytest.mark.slow
@pytest.mark.parametrize("code", CONTROL)
def test_only_what_is_executed_counts(
    code: str, counting_gpu: tuple[GpuContext, ArithmeticCounter], tmp_path: Path
) -> None:
    functions = "shared float shared_sum;\nfloat twice(float a) { return a * 2.0 + a; }\n"
    main = f"void main() {{ int i = int(gl_GlobalInvocationID.x); float sum = 0.0; {code} values[i] = sum; }}"
    expected = sum(CONTROL[code](i) for i in range(THREADS))
    assert executed(counting_gpu, tmp_path, functions + main) == Cost(expected)


@needs_tools
@pytest.mark.slow
def test_the_peak_s_kernel_counts_what_the_peak_is_computed_from(
    counting_gpu: tuple[GpuContext, ArithmeticCounter],
) -> None:
    gpu, counter = counting_gpu
    rounds, threads = 64, 512
    kernel, result = (
        Kernel(gpu, PEAK_SHADERS / "multiply_add", ROUNDS=rounds),
        gpu.ctx.buffer(reserve=4 * threads),
    )
    counter.reset()
    kernel.run((threads,), Result=result, factor=0.5)
    around = 3 * 4 + 3 * 4 + 7  # the other chains' starts, their sum, the dot product
    assert counter.total() == Cost(threads * (rounds * FLOPS_OF_ROUND + around))
    release_all(kernel, result)


@needs_tools
@pytest.mark.slow
def test_sums_beyond_32_bits_are_exact(
    counting_gpu: tuple[GpuContext, ArithmeticCounter], tmp_path: Path
) -> None:
    """2^26 products of 4x4 matrices; Mesa's software renderer ends loops after 65535 rounds."""
    rounds, threads = 1 << 15, 1 << 11
    body = f"""void main() {{
        mat4 m = mat4(x);
        for (int k = 0; k < {rounds}; ++k) m = m * m;
        {LAST.format("m[0].x")}
    }}"""
    assert executed(counting_gpu, tmp_path, body, threads) == Cost(threads * rounds * 112)


VERTEX = """#version 430
out float shade;
void main() {
    vec2 c = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0;
    shade = 0.5;
    gl_Position = vec4(c - 1.0, 0.0, 1.0);
}
"""
FRAGMENT = "#version 430\nin float shade; out vec4 color;\nvoid main() {"


@needs_tools
@pytest.mark.slow
@pytest.mark.parametrize(
    ("fragment", "each"),
    [("color = vec4(shade * 3.0);", 1), ("if (shade * 3.0 > 1.0) discard; color = vec4(shade * shade);", 1)],
)
def test_vertices_and_fragments_count_as_they_are_drawn(
    fragment: str, each: int, counting_gpu: tuple[GpuContext, ArithmeticCounter]
) -> None:
    """Also those that are discarded; not those that only help their neighbours, nor what depth hides before."""
    gpu, counter = counting_gpu
    size = 21, 13  # odd: quads of fragments reach beyond the picture
    targets = gpu.ctx.texture(size, 4), gpu.ctx.depth_texture(size)
    target = gpu.ctx.framebuffer([targets[0]], targets[1])
    program = gpu.ctx.program(vertex_shader=VERTEX, fragment_shader=f"{FRAGMENT} {fragment} }}")
    triangle = gpu.ctx.vertex_array(program, [])
    target.use()
    gpu.ctx.enable_only(moderngl.DEPTH_TEST)
    target.clear(depth=1.0)
    counter.reset()
    triangle.render(moderngl.TRIANGLES, vertices=3)
    assert counter.total() == Cost(3 * (2 + 2) + each * size[0] * size[1])
    if "discard" not in fragment:
        counter.reset()
        triangle.render(moderngl.TRIANGLES, vertices=3)  # no fragment is nearer than what is there
        assert counter.total() == Cost(3 * (2 + 2))
    release_all(triangle, program, target, *targets)


NOTHING_BUT_MAIN = [  # `void main() {}` as types and a function of one block
    Instruction(19, (1,)),
    Instruction(33, (2, 1)),
    Instruction(54, (1, 3, 0, 2)),
    Instruction(248, (4,)),
    Instruction(253, ()),
    Instruction(56, ()),
]


def test_a_module_without_arithmetic_keeps_its_instructions() -> None:
    module = encoded((0x07230203, 0x10000, 0, 5, 0), NOTHING_BUT_MAIN)
    header, instructions = decoded(counting(module))
    assert [each for each in instructions if each in NOTHING_BUT_MAIN] == NOTHING_BUT_MAIN
    assert (
        len(instructions) - len(NOTHING_BUT_MAIN) == 6
    )  # counters, their names, their type, a pointer to it
    assert header[3] == 5 + 4
    for wrong in (b"", module[1:] + b"\0", module[:-12]):
        with pytest.raises(ValueError, match="SPIR-V"):
            decoded(wrong)
