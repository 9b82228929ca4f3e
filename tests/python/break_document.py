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
#: Breaks that change nothing: what is given instead is overwritten, masked or never used.
EQUAL = [
    "0 Ack: next u32 < 2048, later u32",
    "return k >= 1024 or 1 <= k <= 33 and later >> k - 1 & 1 == 1",
    "def bit(self, model, bit=1):",
    "def plain(self, n, value=1):",
    "def golomb(self, k, value=1):",
    "def signed(self, k, value=1):",
    "if n + k > 33:",
    "if n - k > 32:",
    "value = self.plain(n + k, value + (1 << k) - (2 << n + k)) + (1 << n + k) - (1 << k)",
    "value = self.plain(n + k, value + (1 << k) + (1 << n + k)) + (1 << n + k) - (1 << k)",
    "self.range, self.code = 0xFFFFFFFF, 1",
    "self.cache, self.pending, self.out = 1, 1, []",
    "for _ in range(6):",
    'base = version - 1 - c.golomb(0, told["version"] - 1 - (told["base"] or 1)) if has_base else None',
    "if isinstance(self.coder, Decoder) and self.coder.at <= len(self.coder.data):",
    "now, changed = list(was), [False] * 1025",
    "south_changed = y > 0 and any(changed[32 * y - 32 : 33 * y])",
    "south_changed = y >= 0 and any(changed[32 * y - 32 : 32 * y])",
    "w_changed, s_changed = x > 0 and changed[at - 1], y >= 0 and changed[at - 32]",
    "self.generations, self.replies, self.began = [], 0, 1",
    "return there - (total // 2 if total > 0 else -(-total // 2))",
    "return there - (total // 2 if total >= 1 else -(-total // 2))",
]
#: Breaks that only a coincidence of one in 2^24 or so would show, or a poll that comes late.
RARE = [
    "s = min(interval, 3000001)",
    "return max(60_000, 500001 if self.srtt is None else self.srtt // 4)",
    "while self.range <= 1 << 24:",
    "if self.low < 4278190081 or self.low >= 1 << 32:",
    "if self.low <= 0xFF000000 or self.low >= 1 << 32:",
    "if self.low < 0xFF000000 or self.low > 1 << 32:",
    "self.low = (self.low + self.range - 2) >> 24 << 24",
]


def places():
    """Each way to break the document: the line, and the whole broken text."""
    lines = spec.TEXT.split("\n")
    for tag in ("python", "fields", "priors"):
        for first, block in spec.blocks(tag):
            for number in range(first, first + block.count("\n")):
                line = lines[number].split("  #")[0]
                # A number above all others, and what a decoder ignores.
                if "2**62" in line or "tile or dict(" in line:
                    continue
                for pattern, change in BREAKS:
                    for found in re.finditer(pattern, line):
                        broken = line[: found.start()] + change(found) + line[found.end() :]
                        if broken.strip() in EQUAL + RARE:
                            continue
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
