"""C++ that kernels call: read from a file beside its Python module, with some of its words replaced.

Loops that a compiler should turn into vector code need to be told that arrays do not overlap, which Warp's own
language can't say. Such loops are C++, in files of their own that any editor colours.
"""

import functools
import re
from pathlib import Path

from warpflag_kernels.base.precision import Precision


@functools.cache
def without_comments(path: Path) -> str:
    """The text of a file without comments: they would enter the hash that decides whether a kernel is compiled anew."""
    lines = (re.sub(r"\s*//.*", "", line) for line in path.read_text(encoding="utf-8").splitlines())
    return "\n".join(line for line in lines if line.strip()) + "\n"


def native(module_file: str, name: str, p: Precision, **words: object) -> str:
    """The text of `name`.cpp in the folder of a module, ready for `wp.func_native`.

    Args:
        module_file: `__file__` of the module.
        name: of the file, without its ending.
        p: precision; REAL in the file becomes its C++ type.
        words: by word of the file, what replaces it; only whole words are replaced.

    Raises:
        ValueError: the file does not have one of the words.
    """
    text = without_comments(Path(module_file).with_name(f"{name}.cpp"))
    for word, meaning in words.items():
        text, found = re.subn(rf"\b{word}\b", lambda _match, meaning=meaning: str(meaning), text)
        if not found:
            raise ValueError(f"{name}.cpp does not have the word {word}")
    # An alias, since Warp defines float(x) and double(x) as macros of its own.
    return f"using Real = {p.c_name};\n" + re.sub(r"\bREAL\b", "Real", text)
