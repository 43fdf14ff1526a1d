"""All benchmarks: `python -m examples.benchmarks`."""

from . import (
    calls,
    ensemble,
    growth,
    many_paths,
    members,
    speed,
    step_sizes,
    tolerance,
    total_error,
    work_precision,
)


def main() -> None:
    speed.main()
    calls.main()
    ensemble.main()
    growth.main()
    many_paths.main("measure")
    step_sizes.main("measure")
    tolerance.main()
    members.main()
    work_precision.main("errors", "seconds")
    total_error.main("errors")
    total_error.main("seconds")
    total_error.main()


if __name__ == "__main__":
    main()
