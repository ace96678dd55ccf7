import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import hsi_sc_nerf
from hsi_sc_nerf.errors import InputError
from hsi_sc_nerf.processing.session_checks import MAY_BE_RED, require_checks

FOLDERS = ("calibration", "inspection", "poses", "processing")
MAKERS = ("Finding", "judged", "_same")


def says_red(node: ast.AST) -> bool:
    return any(isinstance(part, ast.Constant) and part.value == "red" for part in ast.walk(node))


def red_in(function: ast.FunctionDef) -> Iterator[str]:
    """Names of the checks that the function may find red: it says so in the call, or in the level that it gives."""
    levels = {
        name.id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign | ast.AnnAssign) and says_red(node)
        for name in ast.walk(node)
        if isinstance(name, ast.Name)
    }
    for call in ast.walk(function):
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in MAKERS:
            names = [one.value for one in call.args[:2] if isinstance(one, ast.Constant)]
            given = {one.id for one in call.args if isinstance(one, ast.Name)}
            if names and (call.func.id == "judged" or any(map(says_red, call.args)) or given & levels):
                yield names[0]


def test_names_to_accept_are_those_of_the_checks_that_may_be_red():
    package = Path(hsi_sc_nerf.__file__).parent
    found = {
        name
        for folder in FOLDERS
        for path in (package / folder).glob("*.py")
        for function in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(function, ast.FunctionDef)
        for name in red_in(function)
    }
    assert found == set(MAY_BE_RED)
    assert len(MAY_BE_RED) == len(found)


def test_another_name_is_refused():
    require_checks(("dates", "masks-hull"))
    with pytest.raises(InputError, match=r"^--accept masks-hul: [^\n]*masks-hull[^\n]*\.$"):
        require_checks(("dates", "masks-hul"))
