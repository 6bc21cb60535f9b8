"""Checks of arrays that come from outside the project: from plugins, and from programs that use the package."""

import numpy as np


def misfit(array: object, kind: type[np.generic], shape: tuple[int, ...]) -> str | None:
    """Returns what is wrong with an array, `must be ..., and is ...`; None if it has that kind and shape."""
    if isinstance(array, np.ndarray) and array.shape == shape and np.issubdtype(array.dtype, kind):
        return None
    wanted = {np.floating: "float32", np.bool_: "bool"}.get(kind, kind.__name__)
    found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else kind_of(array)
    return f"must be an array of {wanted} {shape}, and is {found}"


def kind_of(value: object) -> str:
    """Returns what a value is, for sentences: its type's name in backticks, or `None`."""
    return "None" if value is None else f"`{type(value).__name__}`"
