"""Ports of a robot on a PC, and the loop that drives it (SPEC.md 1.4)."""

import argparse
import os
import select
import socket
import sys
import time

from ubimap_frames import SealedFrames, count_boot, read_key


def clock():
    """The robot's clock, in microseconds."""
    return time.monotonic_ns() // 1_000


class Stream:
    """A serial line, a pseudo-terminal, or standard input and output."""

    def __init__(self, source, sink):
        self.source, self.sink = source, sink

    @classmethod
    def serial(cls, path, baud):
        import termios
        import tty

        line = os.open(path, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(line)
        settings = termios.tcgetattr(line)
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            sys.exit(f"{path}: no serial port has {baud} bit/s; try 115200")
        settings[4] = settings[5] = speed
        termios.tcsetattr(line, termios.TCSANOW, settings)
        return cls(line, line)

    def read(self, wait):
        """Bytes that have come within these seconds; None if the other end is gone."""
        if not select.select([self.source], [], [], wait)[0]:
            return b""
        try:
            return os.read(self.source, 4_096) or None
        except OSError:
            return None

    def write(self, frame):
        while frame:
            frame = frame[os.write(self.sink, frame) :]


class Datagrams:
    """UDP: a frame in each datagram."""

    def __init__(self, host, port):
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect((host, port))

    def read(self, wait):
        if not select.select([self.socket], [], [], wait)[0]:
            return b""
        try:
            return self.socket.recv(65_535)
        except ConnectionRefusedError:
            return b""

    def write(self, frame):
        try:
            self.socket.send(frame)
        except ConnectionRefusedError:
            pass  # Nobody listens yet.


def options(arguments, about):
    """The port, the robot's number and its frames, as the command line says."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawTextHelpFormatter)
    where = parser.add_mutually_exclusive_group(required=True)
    where.add_argument("--serial", metavar="PATH", help="a serial port or pseudo-terminal")
    where.add_argument("--udp", metavar="HOST:PORT")
    where.add_argument("--tcp", metavar="HOST:PORT")
    where.add_argument("--stdio", action="store_true", help="standard input and output")
    parser.add_argument("--baud", type=int, default=115_200)
    parser.add_argument("--robot", type=int, default=1, metavar="N", help="the robot's number")
    parser.add_argument("--key", metavar="FILE", help="seal the link with this key")
    parser.add_argument("--boot-file", metavar="FILE", help="where boots are counted; goes with --key")
    told = parser.parse_args(arguments)
    if bool(told.key) != bool(told.boot_file):
        parser.error("--key and --boot-file go together")
    frames = None
    if told.key:
        try:
            frames = SealedFrames(told.robot, read_key(told.key), count_boot(told.boot_file))
        except (OSError, ValueError) as error:
            sys.exit(str(error))
    try:
        return port_of(parser, told), told.robot, frames
    except OSError as error:
        sys.exit(f"{told.serial or told.tcp}: {error.strerror}")


def port_of(parser, told):
    if told.serial:
        return Stream.serial(told.serial, told.baud)
    if told.stdio:
        return Stream(sys.stdin.fileno(), sys.stdout.fileno())
    host, _, port = (told.udp or told.tcp).rpartition(":")
    if not port.isdigit():
        parser.error(f"{told.udp or told.tcp}: write HOST:PORT")
    if told.udp:
        return Datagrams(host, int(port))
    line = socket.create_connection((host, int(port)))
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    line = line.detach()
    return Stream(line, line)


def run(robot, port):
    """Drives a robot until its port is gone."""
    while True:
        while (frame := robot.poll(clock())) is not None:
            port.write(frame)
        data = port.read(max(robot.due - clock(), 0) / 1e6)
        if data is None:
            return
        robot.receive(data, clock())
