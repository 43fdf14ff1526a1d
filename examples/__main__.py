"""All examples: `python -m examples`."""

import time

from . import kubo, rigid_body


def main() -> None:
    start = time.perf_counter()
    kubo.main()
    rigid_body.main()
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")


if __name__ == "__main__":
    main()
