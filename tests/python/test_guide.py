"""The guide's chapter on Python works as it is written."""

import re

import conftest


def test_the_first_example_runs(capsys):
    text = (conftest.ROOT / "docs/python.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    names = {}
    exec(compile(program, "docs/python.md", "exec"), names)
    printed = capsys.readouterr().out
    assert "Riccati" in printed
    # V by the map is V by solving, and u* = -p_v.
    one = names["ds"].sel(x=0.5)
    assert abs(names["v"]([0.5, 0.0]) - one.V.item()) < 1e-4
    assert abs(one.u.item() + one.p.sel(state="v").item()) < 1e-9


def test_what_the_chapter_names_is_there():
    import pycostate

    text = (conftest.ROOT / "docs/python.md").read_text(encoding="utf-8")
    for name in set(re.findall(r"`p\.(\w+)\(", text)):
        assert hasattr(pycostate.Problem, name), name
    for name in set(re.findall(r"`v\.(\w+)\(", text)):
        assert hasattr(pycostate.Value, name), name
    for name in set(re.findall(r"`law\.(\w+)\(", text)):
        assert hasattr(pycostate.Law, name), name
    for name in set(re.findall(r"`pycostate\.(\w+)\(", text)):
        assert hasattr(pycostate, name), name
    for name in set(re.findall(r"`(\w+(?:Error|Warning|Interrupted))`", text)) - {"ValueError"}:
        assert hasattr(pycostate, name), name
