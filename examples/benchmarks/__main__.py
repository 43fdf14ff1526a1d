"""All benchmarks of `docs/benchmarks`: `python -m examples.benchmarks`."""

from . import calls, scan, speed, work_precision


def main() -> None:
    work_precision.main("errors", "seconds")
    speed.main()
    scan.main()
    calls.main()


if __name__ == "__main__":
    main()
