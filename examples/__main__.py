"""All examples: `python -m examples`."""

import time

from . import kubo, linear_oscillator, rigid_body, synchrotron


def main() -> None:
    start = time.perf_counter()
    linear_oscillator.main()
    kubo.main()
    synchrotron.main()
    rigid_body.main()
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")


if __name__ == "__main__":
    main()
