"""Messages name arguments that there are."""

import ast
import inspect
import re
from pathlib import Path

import diffrax

import diffrax_symplectic as ds


PACKAGE = Path(ds.__file__).parent
FILES = sorted(PACKAGE.rglob("*.py"))
# Users do not construct these.
RESULTS = (ds.Comparison, ds.Ensemble, ds.Expectation, ds.Suggestion, ds.Suggestions)
# What messages quote besides: the first argument of the user's `flow`, fields of an
# `Expectation`, an argument that JAX names, the function of Diffrax, libraries, packages.
OTHERS = set(
    "time error std_error compiler_options diffeqsolve llvm libllvm diffrax_symplectic "
    # Of damaged files: no user sees their names.
    "begin end num_good num_failed failed_on paths_per_sample rounding_floor".split()
)
# Functions of the package that take the name of one of the user's arguments, as their first
# argument or as `name`.
CHECKS = set(
    "call_user_function check_real check_takes checked_energy checked_not_negative "
    "whole_number".split()
)
# In backticks: an argument with its value, a function of the user's, and a name alone.
WITH_VALUE = re.compile(r"(?<![\w.])([a-z]\w*)=(?!=)")
OF_THE_USER = re.compile(r"(?<![\w.])([a-zH]\w*)\([\w, ]*\bargs\)")
ALONE = re.compile(r"[a-z]\w+")


def parameters(*functions) -> set[str]:
    return {name for fn in functions for name in inspect.signature(fn).parameters}


def public_functions() -> list:
    """All public functions, classes and methods but the classes of results, which users do
    not construct: the fields of these are no arguments."""
    public = [value for name, value in vars(ds).items() if not name.startswith("_")]
    functions = [value for value in public if callable(value)]
    methods = [
        getattr(kind, name)
        for kind in filter(inspect.isclass, functions)
        for name in vars(kind)
        if not name.startswith("_") and inspect.isroutine(getattr(kind, name))
    ]
    return [fn for fn in (*functions, *methods) if fn not in RESULTS]


def text_of(node: ast.AST) -> str:
    """A string of the code, with nothing in the place of what is computed."""
    parts = node.values if isinstance(node, ast.JoinedStr) else [node]
    return "".join(
        part.value
        for part in parts
        if isinstance(part, ast.Constant) and isinstance(part.value, str)
    )


def messages(tree: ast.AST) -> list[str]:
    """All strings of a module but its docstrings."""
    docstrings = [node.value for node in ast.walk(tree) if isinstance(node, ast.Expr)]
    strings = [
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant | ast.JoinedStr) and node not in docstrings
    ]
    return [text for node in strings if "`" in (text := text_of(node))]


def quoted_arguments(file: Path) -> set[str]:
    """What the messages of a module call an argument."""
    tree = ast.parse(file.read_text())
    quoted = re.findall("`([^`]+)`", "\n".join(messages(tree)))
    found = {name for code in quoted for name in WITH_VALUE.findall(code)}
    found |= {name for code in quoted for name in OF_THE_USER.findall(code)}
    found |= {code for code in quoted if ALONE.fullmatch(code)}
    for call in ast.walk(tree):
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") in CHECKS:
            found.add(text_of(call.args[0]))
            found |= {text_of(x.value) for x in call.keywords if x.arg == "name"}
    # The text of anything but a string is empty.
    return found - {""}


def known_names() -> set[str]:
    functions = public_functions()
    names = {fn.__name__ for fn in functions}
    # Users call these, too.
    return names | OTHERS | parameters(*functions, diffrax.diffeqsolve, diffrax.SaveAt)


def test_messages_quote_only_arguments_and_functions_that_there_are():
    known = known_names()
    for file in FILES:
        unknown = quoted_arguments(file) - known
        assert not unknown, (file.name, unknown)


def listed_arguments(fn) -> set[str]:
    """The names in the list of arguments of a docstring."""
    found = re.search(
        r"\*\*Arguments:\*\*\n\n(.*?)(\n\n\*\*|\Z)", inspect.getdoc(fn) or "", re.S
    )
    items = re.findall(r"^- ((?:`\w+`(?:, )?)+)", found[1], re.M) if found else []
    return {name for item in items for name in re.findall(r"\w+", item)}


def test_docstrings_list_all_arguments_and_no_others():
    with_lists = 0
    for fn in public_functions():
        listed = listed_arguments(fn)
        if inspect.isclass(fn):
            listed |= listed_arguments(fn.__init__)
        if listed:
            assert listed == parameters(fn) - {"self"}, fn
            with_lists += 1
    assert with_lists > 30
