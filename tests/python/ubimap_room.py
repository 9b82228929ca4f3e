"""What a real robot has sensors, wheels and a map for: a little room, drawn by hand."""

import math

SECOND = 1_000_000


class Room:
    """Where the robot is by its odometry, where it goes, and what it would have drawn."""

    def __init__(self):
        self.x, self.y, self.heading, self.waypoints, self.is_stopped = 0.0, 0.0, 0.0, [], False

    def odometry(self):
        heading = round(self.heading / math.tau * 65_536) % 65_536
        return {"x": round(self.x), "y": round(self.y), "heading": heading}

    def cells(self, x, y, now):
        """The cells of a tile: a room of 2.4 by 1.6 m, and a box that is there every other 10 s."""
        has_box = now // (10 * SECOND) % 2 == 1
        cells = []
        for at in range(1024):
            column, row = 32 * x + at % 32, 32 * y + at // 32
            code = 1 if -24 <= column < 24 and -16 <= row < 16 else 0
            if code and (column in (-24, 23) or row in (-16, 15)):
                code = 2
            if has_box and 10 <= column < 14 and 4 <= row < 7:
                code = 3
            cells.append(code)
        return cells

    def drive(self, seconds):
        """Drives towards the first waypoint, in the frame of odometry. Returns whether the path has
        just ended."""
        if not self.waypoints or self.is_stopped:
            return False
        x, y = self.waypoints[0]
        away = math.hypot(x - self.x, y - self.y)
        step = min(300 * seconds, away)
        if away > 0:
            self.heading = math.atan2(y - self.y, x - self.x)
            self.x += step * math.cos(self.heading)
            self.y += step * math.sin(self.heading)
        if away - step < 1:
            self.waypoints.pop(0)
        return not self.waypoints
