"""Count the tree; `python -m tests.sums` lowers the rows of sums.csv that became smaller.

No sum may grow: `test_structure.py` compares each with its row in `sums.csv`. Who raises a row
gives the reason in the commit's message.
"""

import ast
import csv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).resolve().parent
TABLE = TESTS / "sums.csv"

# Numbers of counts, units and shapes, which nobody had to choose.
PLAIN = {0, 1, 2, 3, 4, 0.5, 6, 8, 10, 12, 60, 90, 100, 180, 255, 360, 1000, 1024}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def is_number(node: ast.AST | None) -> bool:
    if not isinstance(node, ast.Constant):
        return False
    return isinstance(node.value, int | float) and not isinstance(node.value, bool)


def defaults(function: Function) -> list[ast.AST | None]:
    return [*function.args.defaults, *function.args.kw_defaults]


def lines_of_code(text: str, tree: ast.Module) -> int:
    """Lines without imports, docstrings, comments and blank lines."""
    others = set[int]()
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node, ast.Import | ast.ImportFrom) or (
            is_text and isinstance(node.value.value, str)
        ):
            others.update(range(node.lineno, node.end_lineno + 1))
    return sum(
        bool(line.strip()) and not line.strip().startswith("#") and number not in others
        for number, line in enumerate(text.splitlines(), 1)
    )


def chosen_numbers(tree: ast.Module) -> int:
    """Fields of settings classes, and numeric defaults of arguments."""
    count = 0
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef) and node.name.endswith("Settings"):
            count += sum(isinstance(one, ast.AnnAssign) for one in node.body)
        elif isinstance(node, Function):
            count += sum(map(is_number, defaults(node)))
    return count


def numbers_in_functions(tree: ast.Module) -> int:
    """Numbers within functions that are neither defaults nor plain."""
    functions = [node for node in ast.walk(tree) if isinstance(node, Function)]
    named = {id(one) for function in functions for one in defaults(function)}
    numbers = {
        id(node): node.value
        for function in functions
        for statement in function.body
        for node in ast.walk(statement)
        if is_number(node) and id(node) not in named
    }
    return sum(abs(value) not in PLAIN for value in numbers.values())


def names_used(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr


def count(root: Path) -> dict[str, int]:
    """Count the files of `root`/drake_pose, and the lines of `root`/tests, by the name of a row."""
    texts = [path.read_text() for path in sorted((root / "drake_pose").rglob("*.py"))]
    trees = [ast.parse(text) for text in texts]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    used = Counter(name for tree in trees for name in names_used(tree))
    private = [
        node
        for node in nodes
        if isinstance(node, Function) and node.name[0] == "_" and node.name[:2] != "__"
    ]
    tests = (path.read_text() for path in (root / "tests").rglob("*.py"))
    return {
        "lines": sum(text.count("\n") for text in texts),
        "lines_of_code": sum(map(lines_of_code, texts, trees)),
        "files": len(texts),
        "classes": sum(isinstance(node, ast.ClassDef) for node in nodes),
        "chosen_numbers": sum(map(chosen_numbers, trees)),
        "numbers_in_functions": sum(map(numbers_in_functions, trees)),
        "functions_with_one_caller": sum(used[node.name] <= 1 for node in private),
        "lines_of_tests": sum(text.count("\n") for text in tests),
    }


def read_table() -> dict[str, int]:
    with TABLE.open(newline="") as file:
        return {row["sum"]: int(row["most"]) for row in csv.DictReader(file)}


def write_table(sums: dict[str, int]) -> None:
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([("sum", "most"), *sums.items()])


if __name__ == "__main__":
    now = count(TESTS.parent)
    most = read_table() if TABLE.is_file() else now
    for name, number in now.items():
        print(f"{name}: {number}, at most {most.get(name, number)}")
    write_table({name: min(number, most.get(name, number)) for name, number in now.items()})
