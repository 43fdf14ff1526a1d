"""What a call is doing, for those who wait."""

import sys
import threading
import time
from typing import Any

import diffrax
import numpy as np


NO_METER = diffrax.NoProgressMeter()
# A call without a progress meter says after this many seconds what it is doing.
_SECONDS_OF_SILENCE = 5.0


class Progress:
    """What a call is doing and how far it is, as a context manager. With a progress meter
    of Diffrax the meter shows it. Without one, a call that takes long prints one line to
    `sys.stderr`.

    - `advice`: the arguments of `caller` for a quick first look.
    """

    def __init__(self, caller: str, meter: diffrax.AbstractProgressMeter, advice: str):
        self._caller = caller
        self._meter = meter
        self._meter_state = meter.init()
        self._advice = advice
        self._stage = "tracing"
        self._share = 0.0
        self._begin = time.monotonic()
        # The main thread may be compiling, which it does not interrupt for a look at the
        # clock.
        self._timer = threading.Timer(_SECONDS_OF_SILENCE, self._tell)
        self._timer.daemon = True

    def stage(self, name: str) -> None:
        """Says what comes next, such as `sampling`."""
        self._stage = name

    def step(self, share: float) -> None:
        """Says which share of the samples is done, from 0 to 1."""
        self._share = share
        self._meter_state = self._meter.step(self._meter_state, np.asarray(share))

    def _tell(self) -> None:
        seconds = time.monotonic() - self._begin
        print(
            f"`{self._caller}` after {seconds:.0f} s: {self._stage}, {self._share:.0%} of "
            f"the samples done. For a quick first look pass {self._advice}; "
            "`progress_meter=diffrax.TextProgressMeter()` shows how far it is.",
            file=sys.stderr,
            flush=True,
        )

    def __enter__(self) -> "Progress":
        if isinstance(self._meter, diffrax.NoProgressMeter):
            self._timer.start()
        return self

    def __exit__(self, *error: Any) -> None:
        self._timer.cancel()
        self._meter.close(self._meter_state)
