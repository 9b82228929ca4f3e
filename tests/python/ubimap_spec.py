"""What protocol/SPEC.md itself says, ready to use: its code, its layouts of messages and its priors.

The code of the document is executed as it stands there, so that a mistake in the document is a
mistake here, and the vectors find it. `UBIMAP_SPEC` names another file to read.
"""

import os
import re
import zlib
from pathlib import Path

PATH = Path(os.environ.get("UBIMAP_SPEC") or Path(__file__).resolve().parents[2] / "protocol" / "SPEC.md")
TEXT = PATH.read_text(encoding="utf-8")


def blocks(tag):
    """The blocks of code with this tag, each with the number of lines before it."""
    for block in re.finditer(rf"^```{tag}\n(.*?)^```$", TEXT, re.M | re.S):
        yield TEXT.count("\n", 0, block.start(1)), block[1]


def code():
    """The names that the code of the document defines."""
    names = {"crc32": zlib.crc32}
    for line, block in blocks("python"):
        # The empty lines make a traceback point at the line of the document.
        exec(compile("\n" * line + block, str(PATH), "exec"), names)
    return names


def layouts():
    """Two dictionaries: the types by name, and the layouts of the messages by (direction, kind)."""
    types, messages, direction = {}, {}, None
    for line in "".join(block for _, block in blocks("fields")).splitlines():
        if line.startswith("to "):
            direction = line
        elif message := re.fullmatch(r"(\d+) (\w+):(.*)", line):
            messages[direction, int(message[1])] = message[2], message[3].strip()
        elif line:
            name, layout = line.split("=")
            types[name.strip()] = layout.strip()
    return types, messages


CODE = code()
TYPES, MESSAGES = layouts()
PRIORS = [int(prior) for _, block in blocks("priors") for prior in block.split()]
