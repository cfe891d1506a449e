"""Notices for the user when frames stop and when they arrive again, for all systems."""

SILENCE_US = 500_000  # without frames, after which a server is contacted again


class Silence:
    """Is notified of every frame and polled often; writes its lines to `notices`. Sans I/O."""

    def __init__(self, notices: list[str]) -> None:
        self._notices = notices
        self._received_us: int | None = None  # when the last frame arrived
        self._lasts = False

    def on_frame(self, now_us: int) -> None:
        """Note the arrival of a frame."""
        if self._lasts and self._received_us is not None:
            gap_s = (now_us - self._received_us) * 1e-6
            self._notices.append(f"motion capture: frames arrive again after {gap_s:.1f} s")
        self._lasts = False
        self._received_us = now_us

    def lasts(self, now_us: int) -> bool:
        """Return whether frames have arrived before, but not lately."""
        silent = self._received_us is not None and now_us - self._received_us > SILENCE_US
        if silent and not self._lasts:
            self._notices.append("motion capture: no frames; calling the server again")
        self._lasts = silent
        return silent
