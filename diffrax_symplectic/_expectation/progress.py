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
    """Tells the user what a call is doing and how far it is, as a context manager. A
    progress meter of Diffrax shows the share of samples that are done. Without a meter, a
    call that takes long prints one line to `sys.stderr`.

    - `caller`: the name of the function that the user called.
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
        # A thread of its own looks at the clock, since the main thread may be compiling.
        self._timer = threading.Timer(_SECONDS_OF_SILENCE, self._tell)
        self._timer.daemon = True

    def stage(self, name: str) -> None:
        """Takes note of what the call does next, such as `sampling`."""
        self._stage = name

    def step(self, share: float) -> None:
        """Takes note of the share of the samples that are done, from 0 to 1."""
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
