#!/usr/bin/env python3
"""Sends the frames of a camera to `ubimap serve`; `sim-host/src/camera/stream.rs` describes the bytes.

Import `Sender` and call `send` with what your camera's SDK gives, or run it to send a recorded folder's
depth images and pictures again and again: send_camera.py SOCKET|HOST:PORT FOLDER [HZ]. It needs numpy and,
for folders, Pillow.
"""
import socket
import struct
import sys
import time
import zlib

import numpy as np


class Sender:
    def __init__(self, address):
        self.address, self.socket = address, None

    def send(self, depth_mm=None, picture=None, captured=None):
        """depth_mm: rows of uint16, 0 for none; picture: rows of uint8 (grey) or of three (RGB); captured:
        seconds of time.time(). Returns whether the frame was sent; drop it if not."""
        sent = int(time.time() * 1e6)
        captured = sent if captured is None else int(captured * 1e6)
        depth, picture_bytes, channels, sizes = b"", b"", 0, [(0, 0), (0, 0)]
        if depth_mm is not None:
            depth_mm = np.asarray(depth_mm, "<u2")
            packed = depth_mm.copy()
            packed[:, 1:] -= depth_mm[:, :-1]  # modulo 65536
            depth, sizes[0] = zlib.compress(packed.tobytes(), 1), depth_mm.shape[1::-1]
        if picture is not None:
            picture = np.asarray(picture, "u1")
            picture_bytes, sizes[1] = picture.tobytes(), picture.shape[1::-1]
            channels = 3 if picture.ndim == 3 else 1
        header = struct.pack("<4sBBBBQQ", b"UBIF", 1, 2 if depth else 0, 1 if channels else 0, channels, captured, sent)
        header += struct.pack("<HHIHHI", *sizes[0], len(depth), *sizes[1], len(picture_bytes))
        try:
            if self.socket is None:
                host, _, port = self.address.rpartition(":")
                unix = not port.isdigit()
                self.socket = socket.socket(socket.AF_UNIX if unix else socket.AF_INET)
                self.socket.settimeout(2)
                self.socket.connect(self.address if unix else (host, int(port)))
            self.socket.sendall(header + depth + picture_bytes)
            return True
        except OSError:
            self.socket = None  # the server is away: connect again with the next frame
            return False


if __name__ == "__main__":
    from pathlib import Path

    from PIL import Image

    sender, folder = Sender(sys.argv[1]), Path(sys.argv[2])
    interval = 1 / float(sys.argv[3] if len(sys.argv) > 3 else 15)
    files = [sorted((folder / name).glob("*.p*")) for name in ("depth", "color")]
    for number in range(10**9):
        images = [np.array(Image.open(found[number % len(found)])) if found else None for found in files]
        sender.send(*images)
        time.sleep(interval)
