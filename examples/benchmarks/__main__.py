"""All benchmarks: `python -m examples.benchmarks`."""

from . import (
    calls,
    ensemble,
    speed,
    tolerance,
    total_error,
    work_precision,
)


def main() -> None:
    speed.main()
    calls.main()
    ensemble.main()
    tolerance.main()
    work_precision.main("errors", "seconds")
    total_error.main("errors")
    total_error.main("seconds")
    total_error.main()


if __name__ == "__main__":
    main()
