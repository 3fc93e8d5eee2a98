"""The shape of the source tree: one namespace package in five roots, layers that import one way."""

from __future__ import annotations

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from .data import ROOT

ROOTS = ("kit", "identification", "fmu_src", "design", "deploy")
FILES = sorted(path for root in ROOTS for path in (ROOT / root).rglob("*.py"))
RUNTIMES = [path for path in FILES if path.name.endswith("_runtime.py")]
PACKAGES = [path for path in FILES if path.name == "__init__.py"]
# Lowest first; those of one line must not import each other.
LAYERS = (
    ("core",), ("signals",), ("loop", "plots"), ("plant", "identification"), ("estimation",), ("design",), ("fmu",),
    ("cosim",), ("verification",), ("testing",), ("drives",), ("report",), ("cli",),
)  # fmt: skip
RANK = {name: rank for rank, names in enumerate(LAYERS) for name in names}


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


def test_there_are_five_roots_and_none_hides_the_others() -> None:
    for root in ROOTS:
        assert (ROOT / root / "softneck").is_dir(), root
        # It would make `softneck` a regular package and hide the other roots.
        assert not (ROOT / root / "softneck" / "__init__.py").exists(), root
    spec = importlib.util.find_spec("softneck")
    assert spec is not None
    assert spec.origin is None


def test_no_file_is_longer_than_400_lines() -> None:
    assert [name_of(path) for path in FILES if len(path.read_text(encoding="utf-8").splitlines()) > 400] == []


def test_an_init_only_re_exports() -> None:
    problems = []
    for path in PACKAGES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
            export = isinstance(node, ast.ImportFrom) and all(alias.asname == alias.name for alias in node.names)
            if not docstring and not export:
                problems.append(f"{name_of(path)}: {ast.unparse(node)}")
    assert problems == []


def test_a_runtime_imports_numpy_math_and_other_runtimes_only() -> None:
    problems = []
    for path in RUNTIMES:
        for module in imports_of(path):
            other_runtime = module.startswith("softneck.") and module.endswith("_runtime")
            if not other_runtime and module not in ("numpy", "math", "__future__"):
                problems.append(f"{name_of(path)}: {module}")
    assert problems == []


def test_imports_point_down_the_layers() -> None:
    """Told from the source text alone, so that an import inside a function counts as well."""
    problems = []
    for path in FILES:
        package = path.parts[path.parts.index("softneck") + 1]
        for module in imports_of(path):
            other = module.split(".")[1] if module.startswith("softneck.") else package
            if other != package and RANK[other] >= RANK[package]:
                problems.append(f"{name_of(path)}: {module}")
    assert problems == []


def test_the_import_contract_holds() -> None:
    tool = Path(sys.executable).with_name("lint-imports")
    if not tool.exists():
        pytest.skip("import-linter is not installed (dependency group `lint`)")
    done = subprocess.run([tool, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize(
    ("package", "heavy"),
    [
        ("softneck.core", ("numba", "matplotlib", "control", "casadi", "pandas", "fmpy")),
        ("softneck.signals", ("numba", "matplotlib", "control", "casadi", "fmpy")),
        ("softneck.cli", ("numba", "matplotlib", "control", "casadi", "pandas", "fmpy")),
    ],
)
def test_what_is_heavy_is_imported_where_it_is_used(package: str, heavy: tuple[str, ...]) -> None:
    code = f"import sys, {package}; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
