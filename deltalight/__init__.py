"""Mixed-reality relighting; the parts are subpackages, such as `deltalight.protocol` and `deltalight.services`.

A wheel holds them inside this folder. In a checkout they are the folders beside it. Importing this package imports
nothing else: public names that need other modules belong into a module-level `__getattr__` (PEP 562) here.
"""

from pathlib import Path

__version__ = "0.1.0"

_PACKAGE = Path(__file__).parent

if not (_PACKAGE / "protocol").is_dir():  # a checkout
    __path__.append(str(_PACKAGE.parent))
