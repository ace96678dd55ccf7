"""A clock that tests move by hand, so that timed runs do not depend on the machine."""

from hsi_sc_nerf.models.schedule import TrainingClock


class Time:
    """Its time in seconds."""

    now = 100.0

    def __call__(self):
        return self.now


def time_by_hand(monkeypatch) -> Time:
    """The wall and processor time of every training clock that is made from now on."""
    time = Time()
    monkeypatch.setattr(TrainingClock.__init__, "__defaults__", (lambda: None, 0.0, time, time))
    return time
