"""All benchmarks: `python -m examples.benchmarks`."""

from . import ensemble, growth, members, speed, tolerance, work_precision


def main() -> None:
    speed.main()
    ensemble.main()
    growth.main()
    tolerance.main()
    members.main()
    work_precision.main()


if __name__ == "__main__":
    main()
