"""The shape of the source tree: one package of subpackages that import one way, and its public names."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

from softneck.core import resolve

from .data import ROOT

PACKAGE = ROOT / "softneck"
FILES = sorted(PACKAGE.rglob("*.py"))
RUNTIMES = [path for path in FILES if path.name.endswith("_runtime.py")]
SUBPACKAGES = [path for path in FILES if path.name == "__init__.py"]


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imports_of(path: Path) -> list[str]:
    """All imported modules, also those inside functions; relative ones as they are written."""
    found: list[str] = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append("." * node.level + (node.module or ""))
    return found


def test_every_folder_of_the_package_is_a_subpackage_that_says_what_it_is_for() -> None:
    assert {path.parent for path in FILES} == {subpackage.parent for subpackage in SUBPACKAGES}
    for subpackage in SUBPACKAGES:
        lines = (ast.get_docstring(ast.parse(subpackage.read_text(encoding="utf-8"))) or "").splitlines()
        # A line on what is inside, one that is empty, two on what may enter.
        assert len(lines) == 4, name_of(subpackage)


def test_the_names_of_the_design_card_lead_to_their_subpackages() -> None:
    for name, target in {"identification": "identification", "design": "design", "fmu_src": "fmu"}.items():
        link = ROOT / name
        if not link.exists():  # unpacked from an archive: nothing of ours uses them
            continue
        assert link.is_symlink()
        assert link.readlink() == Path("softneck") / target


def test_a_subpackage_re_exports_lazily_and_does_nothing_else() -> None:
    lazily = "import lazy_loader\n__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)"
    allowed = {ast.unparse(node) for node in ast.parse(lazily).body}
    for subpackage in SUBPACKAGES:
        code = {ast.unparse(node) for node in ast.parse(subpackage.read_text(encoding="utf-8")).body[1:]}
        if subpackage.parent == PACKAGE:
            code = {line for line in code if not line.startswith("__version__ = ")}
        assert code in (set(), allowed), name_of(subpackage)


def public_names(shared: bool = False) -> list[str]:
    """Return every name that a subpackage re-exports, with its subpackage; `shared` adds those for softneck alone."""
    found = []
    for stub in sorted(PACKAGE.rglob("__init__.pyi")):
        subpackage = ".".join(stub.parent.relative_to(ROOT).parts)
        text = stub.read_text(encoding="utf-8")
        for node in ast.parse(text if shared else text.partition("# isort: split")[0]).body:
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                found += [f"{subpackage}:{alias.name}" for alias in node.names]
    return found


def test_public_names_are_there() -> None:
    for name in public_names(shared=True):
        assert resolve(name) is not None, name


def test_no_subpackage_imports_a_private_module_of_another() -> None:
    """Names that several subpackages use are in the stub of theirs; the text of runtimes goes into bundles as it is."""
    problems = []
    for path in sorted(set(FILES) - set(RUNTIMES)):
        here = path.relative_to(PACKAGE).parts[0]
        for module in imports_of(path):
            parts = module.split(".")
            private = module.startswith("softneck.") and any(part.startswith("_") for part in parts[1:])
            runtime = parts[-1].endswith("_runtime") or module == "softneck.runtime._layout"
            if private and not runtime and parts[1] != here:
                problems.append(f"{name_of(path)}: {module}")
    assert problems == []


def test_nothing_is_overwritten_unless_somebody_asks() -> None:
    usual = {(name_of(path), word) for path in FILES
             for word in re.findall(r"\bforce: bool = (\w+)", path.read_text(encoding="utf-8"))}  # fmt: skip
    assert len(usual) > 10
    assert {word for _, word in usual} == {"False"}


def test_a_runtime_imports_numpy_math_and_other_runtimes_only() -> None:
    problems = []
    for path in RUNTIMES:
        for module in imports_of(path):
            other_runtime = module.startswith("softneck.") and module.endswith("_runtime")
            if not other_runtime and module not in ("numpy", "math", "__future__", "softneck.runtime._layout"):
                problems.append(f"{name_of(path)}: {module}")
    assert problems == []


def test_the_import_contract_holds() -> None:
    tool = Path(sys.executable).with_name("lint-imports")
    if not tool.exists():
        pytest.skip("import-linter is not installed (dependency group `lint`)")
    done = subprocess.run([tool, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


HEAVY = {
    "scipy", "pandas", "pyarrow", "numba", "matplotlib", "bokeh", "control", "casadi", "fmpy", "pythonfmu", "filterpy",
    "h5py", "python_calamine", "mcap_ros2", "can", "canopen", "mcap", "serial", "loky",
}  # fmt: skip


@pytest.mark.parametrize(
    ("package", "may_load"),
    [
        ("softneck", set()),
        ("softneck.cli, softneck.cli._main", set()),
        ("softneck.core", set()),
        ("softneck.signals; softneck.signals.read_recording; softneck.signals.signal", set()),
        ("softneck.identification; softneck.identification.Rls", set()),
        ("softneck.loop; softneck.loop.run_loop", set()),
    ],
)
def test_what_is_heavy_is_imported_where_it_is_used(package: str, may_load: set[str]) -> None:
    code = f"import sys; import {package}; print(*sorted(set({sorted(HEAVY)!r}) & sys.modules.keys()))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) <= may_load
