"""What the README says works."""

import re
from pathlib import Path


README = (Path(__file__).parent.parent / "README.md").read_text()


def test_readme_example_runs(capsys):
    (code,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    exec(code, {})
    assert "Array" in capsys.readouterr().out


def test_readme_lists_every_solver():
    import diffrax_symplectic as ds

    for name, value in vars(ds).items():
        if isinstance(value, type) and issubclass(
            value, ds.AbstractSymplecticRungeKutta
        ):
            assert name.startswith("Abstract") or f"| `{name}(" in README
