"""A SPIR-V module that counts its own arithmetic: each block of a function adds what it costs to two variables."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from deltalight.benchmarks.speed.flop_weights import FUNCTIONS, INSTRUCTIONS, NOTHING, SCALAR, Cost, Shape

COUNTERS: Final = ("counted_flops", "counted_special")
"""The variables, of type uint, private to an invocation."""

MAGIC, HEADER_WORDS = 0x07230203, 5
NAME, EXTENDED = 5, 12
TYPES: Final = range(19, 40)
TYPE_INT, TYPE_FLOAT, TYPE_VECTOR, TYPE_MATRIX, TYPE_POINTER = 21, 22, 23, 24, 32
CONSTANT, FUNCTION, VARIABLE, LOAD, STORE, INTEGER_ADD = 43, 54, 59, 61, 62, 128
DECORATIONS: Final = range(71, 76)
MERGES, ENDS = (246, 247), range(249, 256)
PRIVATE = 6
UNDEFINED, FIRST_VALUE = 1, 41
WITHOUT_RESULT: Final = frozenset(
    {*MERGES, *ENDS, 56, STORE, 63, 64, *DECORATIONS, 99, 224, 225, 228, 248, 317}
)
"""Opcodes from FIRST_VALUE on that give no value: ends of blocks and functions, stores, decorations, barriers."""


@dataclass(frozen=True)
class Instruction:
    """An opcode and the words after it."""

    opcode: int
    words: tuple[int, ...]

    @property
    def encoded(self) -> tuple[int, ...]:
        """All words of it."""
        return (len(self.words) + 1) << 16 | self.opcode, *self.words


def decoded(module: bytes) -> tuple[tuple[int, ...], list[Instruction]]:
    """Returns the header and the instructions of a module.

    Raises:
        ValueError: it is not a SPIR-V module in little-endian byte order, or is cut off.
    """
    if len(module) < 4 * HEADER_WORDS or len(module) % 4 or int(np.frombuffer(module[:4], "<u4")[0]) != MAGIC:
        raise ValueError("This is not a SPIR-V module.")
    words: list[int] = np.frombuffer(module, "<u4").tolist()
    found, at = [], HEADER_WORDS
    while at < len(words):
        size = words[at] >> 16
        if not 0 < size <= len(words) - at:
            raise ValueError("This SPIR-V module ends within an instruction.")
        found.append(Instruction(words[at] & 0xFFFF, tuple(words[at + 1 : at + size])))
        at += size
    return tuple(words[:HEADER_WORDS]), found


def encoded(header: Sequence[int], instructions: Iterable[Instruction]) -> bytes:
    """Returns the module of a header and instructions."""
    words = [*header, *(word for each in instructions for word in each.encoded)]
    return np.array(words, "<u4").tobytes()


@dataclass
class _Meaning:
    """What ids stand for: shapes of floating-point types, types of values."""

    shapes: dict[int, Shape] = field(default_factory=dict)
    types: dict[int, int] = field(default_factory=dict)

    def cost_of(self, instruction: Instruction) -> Cost:
        """Returns what an instruction costs, having learnt what it defines."""
        self._learn(instruction)
        words = instruction.words
        is_function = instruction.opcode == EXTENDED
        weigh = FUNCTIONS.get(words[3]) if is_function else INSTRUCTIONS.get(instruction.opcode)
        if weigh is None:
            return NOTHING
        return weigh(self.shapes[words[0]], self._shape_of(words[4 if is_function else 2]))

    def _learn(self, instruction: Instruction) -> None:
        words = instruction.words
        if instruction.opcode == TYPE_FLOAT:
            self.shapes[words[0]] = SCALAR
        elif instruction.opcode in (TYPE_VECTOR, TYPE_MATRIX) and words[1] in self.shapes:
            column = self.shapes[words[1]]
            is_vector = instruction.opcode == TYPE_VECTOR
            self.shapes[words[0]] = Shape(1, words[2]) if is_vector else Shape(words[2], column.rows)
        elif _gives_value(instruction.opcode):
            self.types[words[1]] = words[0]

    def _shape_of(self, value: int) -> Shape:
        return self.shapes.get(self.types[value], SCALAR)


class _Counters:
    """The ids that a module needs to count, of which `declared` are new."""

    def __init__(self, header: Sequence[int], instructions: Sequence[Instruction]) -> None:
        self.bound = header[3]
        self.declared: list[Instruction] = []
        known = {
            (each.opcode, each.words[1:]): each.words[0] for each in instructions if each.opcode in TYPES
        }
        self._uint = known.get((TYPE_INT, (32, 0))) or self._declare(TYPE_INT, 32, 0)
        wanted = PRIVATE, self._uint
        self._pointer = known.get((TYPE_POINTER, wanted)) or self._declare(TYPE_POINTER, *wanted)
        self._constants: dict[int, int] = {}
        self._variables = [self._declare_typed(VARIABLE, self._pointer, PRIVATE) for _ in COUNTERS]
        self.names = [
            Instruction(NAME, (variable, *_literal(name)))
            for variable, name in zip(self._variables, COUNTERS, strict=True)
        ]

    def adding(self, cost: Cost) -> Iterator[Instruction]:
        """Yields what adds a cost to the variables."""
        for variable, amount in zip(self._variables, (cost.flops, cost.special), strict=True):
            if amount:
                before, after = self._new(), self._new()
                yield Instruction(LOAD, (self._uint, before, variable))
                yield Instruction(INTEGER_ADD, (self._uint, after, before, self._constant(amount)))
                yield Instruction(STORE, (variable, after))

    def _constant(self, value: int) -> int:
        if value not in self._constants:
            self._constants[value] = self._declare_typed(CONSTANT, self._uint, value)
        return self._constants[value]

    def _new(self) -> int:
        self.bound += 1
        return self.bound - 1

    def _declare(self, opcode: int, *words: int) -> int:
        self.declared.append(Instruction(opcode, (self._new(), *words)))
        return self.bound - 1

    def _declare_typed(self, opcode: int, kind: int, *words: int) -> int:
        self.declared.append(Instruction(opcode, (kind, self._new(), *words)))
        return self.bound - 1


def _gives_value(opcode: int) -> bool:
    return opcode in (UNDEFINED, EXTENDED) or (opcode >= FIRST_VALUE and opcode not in WITHOUT_RESULT)


def _literal(text: str) -> list[int]:
    """Returns the words of a string: it ends with a zero."""
    data = text.encode() + b"\0"
    words: list[int] = np.frombuffer(data.ljust(-(-len(data) // 4) * 4, b"\0"), "<u4").tolist()
    return words


def counting(module: bytes) -> bytes:
    """Returns the module that also adds, block by block, what it executes to the variables COUNTERS.

    Raises:
        ValueError: `module` is not a SPIR-V module.
    """
    header, instructions = decoded(module)
    counters, meaning = _Counters(header, instructions), _Meaning()
    body: list[Instruction] = []
    cost, tail = NOTHING, 0  # of the block so far; where its merge and end begin
    for each in instructions:
        if each.opcode in MERGES:
            tail = len(body)
        elif each.opcode in ENDS:
            place = tail or len(body)
            body[place:place] = counters.adding(cost)
            cost, tail = NOTHING, 0
        body.append(each)
        cost += meaning.cost_of(each)
    first = next(at for at, each in enumerate(body) if each.opcode == FUNCTION)
    body[first:first] = counters.declared
    named = next(at for at, each in enumerate(body) if each.opcode in DECORATIONS or each.opcode in TYPES)
    body[named:named] = counters.names
    return encoded((*header[:3], counters.bound, *header[4:]), body)
