"""All benchmarks: `python -m examples.benchmarks`."""

from . import calls, ensemble, speed, tolerance, work_precision


def main() -> None:
    speed.main()
    calls.main()
    ensemble.main()
    tolerance.main()
    work_precision.main("errors", "seconds")


if __name__ == "__main__":
    main()
