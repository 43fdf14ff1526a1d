"""All benchmarks: `python -m examples.benchmarks`."""

from . import growth, speed, work_precision


def main() -> None:
    speed.main()
    growth.main()
    work_precision.main()


if __name__ == "__main__":
    main()
