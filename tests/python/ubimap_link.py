"""What an end of a link does in time: knocking, acknowledging and sending again (SPEC.md 3 and 4).

No clock and no port in here: `now` is an argument, in microseconds, and `due` says when to come
back (None: not at all).
"""

from ubimap_wire import RoundTrip, Window, acknowledges

ACK_DELAY = 5_000
ACK_REPEATS = [40_000, 70_000]
FRAMES_AFTER_LOSS = 32


def earliest(*moments):
    return min((moment for moment in moments if moment is not None), default=None)


class Knocking:
    """4.2: when a robot says hello."""

    def __init__(self, boot_nonce):
        self.nonce, self.hellos, self.due = boot_nonce, 0, 0

    def poll(self, now):
        """Whether to say hello now."""
        if now < self.due:
            return False
        self.due = now + (200_000 << min(self.hellos, 4))
        self.hellos += 1
        return True

    def restart(self, now):
        """The session was lost."""
        self.nonce = (self.nonce + 0x9E3779B9) % 2**32
        self.hellos, self.due = 0, now

    def refused(self, is_number_in_use, now):
        self.due = now + (3_000_000 if is_number_in_use else 10_000_000)


class Receiver:
    """3.1: which reliable frames have arrived, and when to say so."""

    def __init__(self):
        self.window, self.due, self.repeats, self.lossy = Window(), None, 0, 0

    def arrive(self, sequence, now):
        is_ahead = sequence != self.window.next
        outcome = self.window.arrive(sequence)
        if outcome == "refused":
            return outcome
        if is_ahead:
            self.lossy = FRAMES_AFTER_LOSS
        self.lossy = max(self.lossy - 1, 0)
        self.repeats = len(ACK_REPEATS) if self.lossy else 0
        self.due = earliest(self.due, now + ACK_DELAY)
        return outcome

    def ack(self):
        """The fields of the Ack."""
        return {"next": self.window.next, "later": self.window.later}

    def acknowledged(self, now):
        """An Ack has left."""
        waits = ACK_REPEATS[len(ACK_REPEATS) - self.repeats :]
        self.due = now + waits[0] if waits else None
        self.repeats = max(self.repeats - 1, 0)


class Sender:
    """3.2: the reliable frames in flight. Each has a token, which comes back when it has arrived."""

    def __init__(self, most=8):
        self.most, self.sequence, self.in_flight = most, 0, {}
        self.round_trip, self.newest = RoundTrip(), None

    def has_room(self):
        oldest = next(iter(self.in_flight), self.sequence)
        return len(self.in_flight) < self.most and (self.sequence - oldest) % 2048 <= 32

    def keep(self, payload, token, now):
        """Keeps a frame that leaves now. Returns its sequence number."""
        sequence = self.sequence
        self.in_flight[sequence] = {"payload": payload, "token": token, "sent": now, "times": 1}
        self.sequence = (sequence + 1) % 2048
        return sequence

    def acknowledge(self, ack, now):
        """The tokens of the frames that have arrived."""
        tokens = []
        for sequence, frame in list(self.in_flight.items()):
            if acknowledges(ack["next"], ack["later"], sequence):
                del self.in_flight[sequence]
                tokens.append(frame["token"])
                if frame["times"] == 1:
                    self.round_trip.sample(now - frame["sent"])
                self.newest = max(self.newest or 0, frame["sent"])
        return tokens

    def deadline(self, frame):
        overtaken = frame["sent"] + self.round_trip.reordering()
        if self.newest is not None and self.newest >= overtaken:
            return overtaken
        return frame["sent"] + self.round_trip.timeout(frame["times"])

    @property
    def due(self):
        return earliest(*(self.deadline(frame) for frame in self.in_flight.values()))

    def again(self, now):
        """Sequence number and payload of a frame to send again, or None."""
        sequence = min(self.in_flight, key=lambda it: self.deadline(self.in_flight[it]), default=None)
        if sequence is None or self.deadline(self.in_flight[sequence]) > now:
            return None
        frame = self.in_flight[sequence]
        frame["sent"], frame["times"] = now, frame["times"] + 1
        return sequence, frame["payload"]
