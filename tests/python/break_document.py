"""Breaks the code, the layouts and the priors of SPEC.md one place at a time, and checks the vectors
each time: they must fail. Prints the breaks that nothing notices, and how many were noticed.

    python3 tests/python/break_document.py [EVERY]

tries every EVERY-th break (default: all, which takes some minutes).
"""

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

import ubimap_spec as spec

CHECK = Path(__file__).with_name("check_vectors.py")
#: A pattern, and what takes its place.
BREAKS = [
    (r"(?<![\w.])(?:0x[0-9A-F]+|\d[\d_]*)(?!\w)", lambda found: str(int(found[0], 0) + 1)),
    (r" \+ ", lambda _: " - "),
    (r" - ", lambda _: " + "),
    (r" (?:<=|<) ", lambda found: " < " if found[0] == " <= " else " <= "),
    (r" (?:>=|>) ", lambda found: " > " if found[0] == " >= " else " >= "),
    (r" == ", lambda _: " != "),
    (r" and ", lambda _: " or "),
    (r"\b([ui])(16|32|64)\b", lambda found: found[1] + {"16": "32", "32": "64", "64": "32"}[found[2]]),
    (r"\b(w|s|se|e)\b(?= >= 2)", lambda found: {"w": "s", "s": "se", "se": "e", "e": "se"}[found[1]]),
]
#: Changes that change nothing: a bound that is never reached, or a value that is overwritten.
HARMLESS = ["2**62", "def golomb(self, k, value=0)", "def bit(self, model, bit=0)", "version=1, base=None"]


def places():
    """Each way to break the document: the line, and the whole broken text."""
    lines = spec.TEXT.split("\n")
    for tag in ("python", "fields", "priors"):
        for first, block in spec.blocks(tag):
            for number in range(first, first + block.count("\n")):
                line = lines[number].split("  #")[0]
                if any(harmless in line for harmless in HARMLESS):
                    continue
                for pattern, change in BREAKS:
                    for found in re.finditer(pattern, line):
                        broken = line[: found.start()] + change(found) + line[found.end() :]
                        yield number + 1, broken, "\n".join(lines[:number] + [broken] + lines[number + 1 :])


def is_noticed(text):
    with tempfile.NamedTemporaryFile("w", suffix=".md", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        command = [sys.executable, "-B", str(CHECK), "--brief"]
        try:
            run = subprocess.run(
                command, env={**os.environ, "UBIMAP_SPEC": file.name}, capture_output=True, timeout=20
            )
        except subprocess.TimeoutExpired:
            return True
        return run.returncode != 0


def main():
    every = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    noticed = missed = 0
    for number, broken, text in list(places())[::every]:
        if is_noticed(text):
            noticed += 1
        else:
            missed += 1
            print(f"nothing notices line {number}: {broken.strip()}", flush=True)
    print(f"{noticed} breaks noticed, {missed} missed")
    return missed != 0


if __name__ == "__main__":
    sys.exit(main())
