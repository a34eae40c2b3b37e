"""The docstrings are the reference: all is said there, and they render as pages."""

import inspect
import re

import pdoc
import pycostate
import pytest


def public():
    """(name, object) of what users see."""
    for name in pycostate.__all__:
        thing = getattr(pycostate, name)
        if inspect.ismodule(thing):
            continue
        yield name, thing
        if inspect.isclass(thing) and not issubclass(thing, BaseException):
            for own, member in vars(thing).items():
                if own == "__call__" or not own.startswith("_"):
                    yield f"{name}.{own}", getattr(member, "__func__", member)


@pytest.mark.parametrize(("name", "thing"), [pytest.param(*both, id=both[0]) for both in public()])
def test_each_is_described(name, thing):
    text = inspect.getdoc(thing)
    assert text, name
    if isinstance(thing, property) or inspect.isclass(thing) and issubclass(thing, BaseException):
        return
    for parameter in inspect.signature(thing).parameters.values():
        word = re.escape(parameter.name)
        # What is said once for all is named by what is given: states by name, options of `using`.
        known = parameter.name in ("self", "cls", "more", "states", "numerics", "states_and_numerics", "options")
        assert known or re.search(rf"(?<!\w){word}(?!\w)", text), f"{name}: {parameter.name}"


def test_they_render(tmp_path):
    pdoc.render.configure(docformat="numpy")
    pdoc.pdoc("pycostate", output_directory=tmp_path)
    page = (tmp_path / "pycostate.html").read_text(encoding="utf-8")
    for name, _ in public():
        anchor = name.replace(".__call__", "")
        assert f'id="{anchor}"' in page, name
    # Sections are lists, not text.
    assert "<h6 id=\"parameters\">Parameters</h6>" in page
    assert "<strong>points</strong> (array_like, Dataset or DataFrame)" in page
    rest = re.sub(r"<pre.*?</pre>", "", page, flags=re.DOTALL)
    assert "----------" not in rest and ":meth:" not in rest
