"""Insertion, outpainting and other tasks are settings of a scene: the code must not name any of these tasks."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
TASKS = re.compile(r"outpaint|insertion|sparse.views", re.IGNORECASE)


def code_words(path: Path) -> set[str]:
    """Return the words in the names and strings of a file's code, without docstrings."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {id(n.value) for n in ast.walk(tree) if isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant)}
    strings = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)
               and id(n) not in docstrings}  # fmt: skip
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)}
    names |= {n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)}
    return strings | names | {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}


def test_no_code_knows_the_task():
    files = [p for folder in ("reffusion", "stages", "runner", "report") for p in (ROOT / folder).rglob("*.py")]
    knowing = {
        str(p.relative_to(ROOT)): found for p in files if (found := [w for w in code_words(p) if TASKS.search(w)])
    }
    assert len(files) > 100 and not knowing
    assert not TASKS.search((ROOT / "pipeline.yaml").read_text())
