"""Who may import whom, checked on the syntax tree of every file."""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = "geoorbit_ros"
ROOT = Path(__file__).parents[2] / PACKAGE

# The allowed edges are those of the diagram in the docs, and no other.
DIAGRAM = Path(__file__).parents[2] / "docs" / "architecture.md"
EDGE = re.compile(r"^  (\w+) --> (.+)$", re.MULTILINE)


def drawn_edges(text: str) -> set[tuple[str, str]]:
    """Edges `name --> name & name` of the diagram."""
    return {(a, b) for a, targets in EDGE.findall(text) for b in targets.split(" & ")}


ALLOWED = drawn_edges(DIAGRAM.read_text(encoding="utf-8"))
SUBPACKAGES = {name for edge in ALLOWED for name in edge}

# Who may import what from outside. Names are patterns of the imported top-level module.
RESERVED = {
    r"rclpy|rosidl_\w+|ament_\w+|\w+_msgs|\w+_srvs|\w+_interfaces": {
        "nodes",
        "conversions",
        "parameters",
        "storage",
    },
    r"torch": {"learning"},
    r"libsumo|sumolib|traci|sumo": {"mapcheck", "roadnet", "scenes", "twin"},
    r"typer|rich|click": {"cli"},
}
CORE_MAY_IMPORT = {"numpy", "scipy"}


@dataclass(frozen=True)
class Import:
    path: Path
    line: int
    subpackage: str  # the importing file's place below the package
    module: str  # dotted name of what it imports

    def breach(self, rule: str) -> str:
        return f"{self.path}:{self.line}: {self.subpackage} imports {self.module}: {rule}"


def imported_modules(node: ast.AST, package: list[str]) -> list[str]:
    """Dotted names that one statement imports; relative ones resolved against `package`."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = package[: len(package) - node.level + 1] if node.level else []
        start = ".".join([*base, node.module] if node.module else base)
        # `from geoorbit_ros import nodes` imports a subpackage by name.
        return [f"{start}.{alias.name}" for alias in node.names]
    if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
        called = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        called = node.func.id if isinstance(node.func, ast.Name) else called
        if called in {"import_module", "__import__"}:
            return [str(node.args[0].value)]
    return []


def imports(root: Path) -> Iterator[Import]:
    """All imports in a package, those inside functions and type-checking blocks included."""
    for path in sorted(root.rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        package = [PACKAGE, *parts[:-1]]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
            for module in imported_modules(node, package):
                yield Import(path, getattr(node, "lineno", 0), parts[0], module)


def breach(found: Import) -> str | None:
    """Says which rule an import breaks, if any."""
    top, _, rest = found.module.partition(".")
    if top == PACKAGE:
        target = rest.partition(".")[0]
        if target in SUBPACKAGES - {found.subpackage} and (found.subpackage, target) not in ALLOWED:
            return found.breach(
                f"docs/architecture.md draws no edge from {found.subpackage} to {target}"
            )
        return None
    for pattern, allowed in RESERVED.items():
        if re.fullmatch(pattern, top) and found.subpackage not in allowed:
            return found.breach(f"only {', '.join(sorted(allowed))} may")
    if found.subpackage == "core" and top not in CORE_MAY_IMPORT | sys.stdlib_module_names:
        return found.breach(f"core needs only {', '.join(sorted(CORE_MAY_IMPORT))}")
    return None


def used_edges(found: list[Import]) -> set[tuple[str, str]]:
    """Edges between subpackages that some import needs."""
    targets = ((item.subpackage, item.module.partition(".")) for item in found)
    pairs = {(a, rest.partition(".")[0]) for a, (top, _, rest) in targets if top == PACKAGE}
    return {(a, b) for a, b in pairs if a != b and b in SUBPACKAGES}


def cycle(edges: set[tuple[str, str]]) -> list[str]:
    """Names on or between circles of a graph: what is left when its ends are taken away."""
    while True:
        sources, targets = {a for a, _ in edges}, {b for _, b in edges}
        left = {(a, b) for a, b in edges if a in targets and b in sources}
        if left == edges:
            return sorted({name for edge in edges for name in edge})
        edges = left


def module_edges(root: Path) -> set[tuple[str, str]]:
    """Imports between the files of the package, each by its dotted name."""
    files = {".".join(p.relative_to(root.parent).with_suffix("").parts) for p in root.rglob("*.py")}
    edges = set()
    for item in imports(root):
        source = ".".join(item.path.relative_to(root.parent).with_suffix("").parts)
        for target in (item.module, item.module.rpartition(".")[0]):
            if target in files and target != source:
                edges.add((source, target))
    return edges


def test_imports_follow_the_diagram() -> None:
    breaches = [text for item in imports(ROOT) if (text := breach(item))]
    assert not breaches, "\n" + "\n".join(breaches)


def test_every_edge_of_the_diagram_is_needed() -> None:
    assert sorted(ALLOWED - used_edges(list(imports(ROOT)))) == []


def test_neither_subpackages_nor_files_import_in_a_circle() -> None:
    assert cycle(ALLOWED) == []
    assert cycle(module_edges(ROOT)) == []


def test_every_subpackage_is_in_the_diagram() -> None:
    folders = {path.name for path in ROOT.iterdir() if (path / "__init__.py").is_file()}
    files = {path.stem for path in ROOT.glob("*.py")} - {"__init__"}
    assert folders | files == SUBPACKAGES
    table = re.findall(r"^\| `(\w+)` \|", DIAGRAM.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(table) == sorted(SUBPACKAGES)


def test_a_circle_is_found() -> None:
    assert cycle({("a", "b"), ("b", "c"), ("c", "b"), ("c", "d")}) == ["b", "c"]
    assert cycle({("a", "b"), ("b", "c")}) == []


@pytest.mark.parametrize(
    ("file", "statement"),
    [
        ("core/a.py", "import cv2"),
        ("core/a.py", "from geoorbit_ros.lanes import estimator"),
        ("core/a.py", "from ..lanes import estimator"),
        ("lanes/a.py", "from sensor_msgs.msg import PointCloud2"),
        ("lanes/a.py", "def f():\n    import rclpy"),
        ("lanes/a.py", "import libsumo"),
        ("metrics/a.py", "from geoorbit_ros import storage"),
        ("calibration/a.py", "from importlib import import_module\nimport_module('rclpy')"),
        ("storage/a.py", "import geoorbit_ros.nodes.homography"),
        ("nodes/a.py", "from geoorbit_ros.cli import main"),
        ("cli/a.py", "import torch"),
        ("report/a.py", "from rich import print"),
    ],
)
def test_the_rules_catch_a_wrong_import(tmp_path: Path, file: str, statement: str) -> None:
    path = tmp_path / file
    path.parent.mkdir()
    path.write_text(f"import numpy as np\n{statement}\n")
    breaches = [text for item in imports(tmp_path) if (text := breach(item))]
    assert len(breaches) == 1, statement
    assert f"{path}:{1 + statement.count(chr(10)) + 1}:" in breaches[0]


@pytest.mark.parametrize(
    ("file", "statement"),
    [
        ("core/a.py", "from scipy.spatial import cKDTree\nimport math"),
        ("lanes/a.py", "from geoorbit_ros.core.lanes import Lane\nfrom ..calibration import datum"),
        ("nodes/a.py", "import rclpy\nfrom geoorbit_ros.lanes import mapper"),
        ("storage/a.py", "from rclpy.serialization import serialize_message"),
        ("scenes/a.py", "import libsumo"),
    ],
)
def test_the_rules_allow_a_right_import(tmp_path: Path, file: str, statement: str) -> None:
    path = tmp_path / file
    path.parent.mkdir()
    path.write_text(statement)
    assert [text for item in imports(tmp_path) if (text := breach(item))] == []


ARRAY_METHODS = {
    *("all", "any", "argmax", "argmin", "astype", "clip", "cumsum", "dot", "max", "mean", "min"),
    *("prod", "ptp", "reshape", "round", "sort", "std", "sum", "transpose", "var"),
}


def array_arithmetic(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Line and reason of every place where a file computes with arrays, as far as syntax shows it.

    Types (`NDArray`, `np.float64`, `np.dtype`) may be named. What a parameter's annotation calls an
    array may be handed on, indexed and counted.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and root_of(node.func) in {"np", "numpy", "scipy", "cv2"}:
            yield node.lineno, f"calls {ast.unparse(node.func)}"
        if isinstance(node, ast.BinOp | ast.AugAssign) and isinstance(node.op, ast.MatMult):
            yield node.lineno, "multiplies matrices"
        if isinstance(node, ast.FunctionDef):
            arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            arrays = {
                a.arg for a in arguments if a.annotation and "NDArray" in ast.unparse(a.annotation)
            }
            for part in ast.walk(node):
                for operand in operands(part):
                    if root_of(operand) in arrays:
                        yield operand.lineno, f"computes {ast.unparse(part)}"


def root_of(node: ast.expr) -> str:
    """`a` of `a`, `a.b`, `a[0].b`; else nothing."""
    while isinstance(node, ast.Attribute | ast.Subscript):
        node = node.value
    return node.id if isinstance(node, ast.Name) else ""


def operands(node: ast.AST) -> list[ast.expr]:
    """What an arithmetic expression, a comparison or an array's method works on."""
    if isinstance(node, ast.BinOp):
        return [node.left, node.right]
    if isinstance(node, ast.AugAssign):
        return [node.target, node.value]
    if isinstance(node, ast.UnaryOp) and not isinstance(node.op, ast.Not):
        return [node.operand]
    if isinstance(node, ast.Compare) and not isinstance(node.ops[0], ast.Is | ast.IsNot | ast.In):
        return [node.left, *node.comparators]
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
        return [node.func.value] if node.func.attr in ARRAY_METHODS else []
    return []


def test_nodes_do_not_compute_with_arrays() -> None:
    found = [
        f"{path}:{line}: {reason}"
        for path in sorted((ROOT / "nodes").rglob("*.py"))
        for line, reason in array_arithmetic(ast.parse(path.read_text(encoding="utf-8")))
    ]
    assert not found, "\n" + "\n".join(found)


@pytest.mark.parametrize(
    "statement",
    [
        "x = np.zeros(3)",
        "x = np.linalg.norm(v)",
        "image = cv2.resize(image, (2, 2))",
        "x = a @ b",
        "def f(rows: NDArray[np.void]) -> None:\n    x = rows['x'] + 1",
        "def f(rows: NDArray[np.void]) -> bool:\n    return rows['x'].max() > 3",
        "def f(a: NDArray[np.float64] | None) -> None:\n    a *= 2",
        "def f(a: NDArray[np.float64]) -> None:\n    return -a",
    ],
)
def test_the_rule_for_nodes_catches_arithmetic(statement: str) -> None:
    assert list(array_arithmetic(ast.parse(statement)))


@pytest.mark.parametrize(
    "statement",
    [
        "x: np.dtype[np.void] = TRACK_DTYPE",
        "def f(rows: NDArray[np.void]) -> int:\n    return len(rows) + 1",
        "def f(a: NDArray[np.float64] | None) -> None:\n    if a is not None:\n        g(a[0])",
        "x = a + b * 2",
    ],
)
def test_the_rule_for_nodes_allows_handing_arrays_on(statement: str) -> None:
    assert list(array_arithmetic(ast.parse(statement))) == []


MAX_FUNCTION_LINES = 60
"""A function reads on one screen. Options of a command and its help count, too."""


def test_functions_read_on_one_screen() -> None:
    long = []
    for path in sorted(ROOT.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = (node.end_lineno or 0) - node.lineno + 1
                if lines >= MAX_FUNCTION_LINES:
                    long.append(f"{path}:{node.lineno}: {node.name} has {lines} lines")
    assert long == []
