"""The house rules that a machine can check, by walking the syntax tree of every file.

Each rule is a function of a parsed file that yields what is wrong; each is shown here to fail on a small bad example,
so that no rule is empty.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("kernels", "warp_deferred", "scenes", "bench")
FILES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
GROUPS = ("Frame", "Scene", "In", "Params", "Out")

#: Longer than the rule allows, and why. Keys: "file" or "file:function".
EXCEPTIONS = {
    "warp_deferred/cli.py:render": "one parameter with its help text per flag",
}


@dataclass(frozen=True)
class File:
    """A parsed source file: its path below the root, its text and tree."""

    path: str
    text: str
    tree: ast.Module

    @property
    def folder(self) -> str:
        return self.path.split("/")[0]


def parse(text: str, path: str) -> File:
    return File(path, text, ast.parse(text))


def dotted(node: ast.AST) -> str:
    """Name of an expression such as wp.config.quiet; the part of a call or subscript that is called or indexed."""
    if isinstance(node, ast.Name):
        return node.id
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    if isinstance(node, ast.Call):
        return dotted(node.func)
    if isinstance(node, ast.Subscript):
        return dotted(node.value)
    return ""


def functions(tree: ast.AST) -> Iterator[tuple[ast.FunctionDef, tuple[ast.AST, ...]]]:
    """Every function with what encloses it, outermost first."""

    def walk(node: ast.AST, above: tuple[ast.AST, ...]) -> Iterator[tuple[ast.FunctionDef, tuple[ast.AST, ...]]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef):
                yield child, above
            scope = isinstance(child, (ast.FunctionDef, ast.ClassDef))
            yield from walk(child, (*above, child) if scope else above)

    yield from walk(tree, ())


def is_kernel(function: ast.FunctionDef) -> bool:
    return any(dotted(d) in ("wp.kernel", "warp.kernel") for d in function.decorator_list)


def kernels(file: File) -> Iterator[tuple[ast.FunctionDef, tuple[ast.AST, ...]]]:
    return ((f, above) for f, above in functions(file.tree) if is_kernel(f))


def parameters(function: ast.FunctionDef) -> list[ast.arg]:
    return [*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs]


def groups(file: File, kernel: ast.FunctionDef) -> list[tuple[str, str | None]]:
    """Parameter names with the group comment above them, None before the first."""
    lines, group, found = file.text.splitlines(), None, []
    arguments = {a.lineno: a.arg for a in reversed(parameters(kernel))}
    for number in range(kernel.lineno, kernel.body[0].lineno):
        comment = re.fullmatch(r"\s*#\s*(\w+)\s*", lines[number - 1])
        if comment and comment[1] in GROUPS:
            group = comment[1]
        if number in arguments:
            found += [(a.arg, group) for a in parameters(kernel) if a.lineno == number]
    return found


def file_length(file: File) -> Iterator[str]:
    count = len(file.text.splitlines())
    if count > 400 and file.path not in EXCEPTIONS:
        yield f"{count} lines, more than 400"


def function_length(file: File) -> Iterator[str]:
    for function, _ in functions(file.tree):
        # What is defined inside counts for itself: a factory is not as long as its kernel.
        inner = sum(
            f.end_lineno - f.lineno + 1 + len(f.decorator_list)
            for f, above in functions(function)
            if not any(isinstance(scope, ast.FunctionDef) for scope in above)
        )
        count, limit = function.end_lineno - function.lineno + 1 - inner, 80 if is_kernel(function) else 60
        if count > limit and f"{file.path}:{function.name}" not in EXCEPTIONS:
            yield f"{function.name}: {count} lines, more than {limit}"


def kernel_names(file: File) -> Iterator[str]:
    for kernel, _ in kernels(file):
        if not kernel.name.endswith("_kernel"):
            yield f"{kernel.name}: a kernel's name ends in _kernel"


def kernel_parameters(file: File) -> Iterator[str]:
    for kernel, _ in kernels(file):
        if len(parameters(kernel)) > 12:
            yield f"{kernel.name}: {len(parameters(kernel))} parameters, more than 12; make a struct"
        if kernel.args.defaults or any(kernel.args.kw_defaults):
            yield f"{kernel.name}: a kernel parameter has no default"
        for parameter in parameters(kernel):
            note = parameter.annotation
            if note is None:
                yield f"{kernel.name}.{parameter.arg}: no annotation"
            elif isinstance(note, ast.Call) and dotted(note).startswith("wp.array"):
                yield f"{kernel.name}.{parameter.arg}: write wp.array[T]"
            elif "array1d" in dotted(note):
                yield f"{kernel.name}.{parameter.arg}: write wp.array[T], not wp.array1d"


def kernel_groups(file: File) -> Iterator[str]:
    for kernel, _ in kernels(file):
        found = groups(file, kernel)
        order = [GROUPS.index(group) for _, group in found if group]
        if order != sorted(order):
            yield f"{kernel.name}: groups stand in the order {', '.join(GROUPS)}"
        for name, group in found:
            if group is None:
                yield f"{kernel.name}.{name}: no group comment above ({', '.join('# ' + g for g in GROUPS)})"
            elif (group == "Out") != name.startswith("out_"):
                yield f"{kernel.name}.{name}: outputs, and only they, are named out_... and stand under # Out"


def kernel_writes(file: File) -> Iterator[str]:
    for kernel, _ in kernels(file):
        inputs = {name for name, group in groups(file, kernel) if group != "Out"}
        for node in ast.walk(kernel):
            targets: list[ast.AST] = []
            if isinstance(node, ast.Assign):
                targets = [t for t in node.targets if isinstance(t, ast.Subscript)]
            elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
                targets = [node.target]
            elif isinstance(node, ast.Call) and dotted(node).startswith("wp.atomic_") and node.args:
                targets = [node.args[0]]
            for target in targets:
                root = dotted(target).split(".")[0]
                if root in inputs:
                    yield f"{kernel.name}: line {node.lineno} writes {root}, which is not under # Out"


def module_options(file: File) -> Iterator[str]:
    if not any(True for _ in kernels(file)):
        return
    for node in file.tree.body:
        if isinstance(node, ast.Expr) and dotted(node.value) == "wp.set_module_options":
            try:
                options = ast.literal_eval(node.value.args[0])
            except (ValueError, IndexError):
                options = {}
            if options.get("enable_backward") is False:
                return
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            break
    yield 'no wp.set_module_options({"enable_backward": False, ...}) above the first function'


def nested_kernels(file: File) -> Iterator[str]:
    for kernel, above in kernels(file):
        if not above:
            continue
        options = {k.arg: k.value for d in kernel.decorator_list if isinstance(d, ast.Call) for k in d.keywords}
        module = options.get("module")
        if not (isinstance(module, ast.Constant) and module.value == "unique"):
            yield f'{kernel.name}: a kernel in a factory has module="unique"'
        factory = above[0]
        cached = isinstance(factory, ast.FunctionDef) and any(
            dotted(d) in ("functools.cache", "functools.lru_cache") for d in factory.decorator_list
        )
        if not cached or not factory.name.startswith("make_"):
            yield f"{kernel.name}: stands in a function make_... under functools.cache"
        if not any(isinstance(n, (ast.Assign, ast.AnnAssign)) and "VARIANTS" in assigned(n) for n in file.tree.body):
            yield f"{kernel.name}: no list VARIANTS in the file, so CI compiles none of it"


def assigned(node: ast.stmt) -> list[str]:
    """Dotted names a statement assigns to."""
    if isinstance(node, ast.Assign):
        return [dotted(t) for target in node.targets for t in (getattr(target, "elts", None) or [target])]
    if isinstance(node, (ast.AugAssign, ast.AnnAssign)):
        return [dotted(node.target)]
    return []


def no_global_config(file: File) -> Iterator[str]:
    if file.folder == "bench" or re.fullmatch(r"warp_deferred/cli(_\w+)?\.py", file.path):
        return
    for node in ast.walk(file.tree):
        for name in assigned(node) if isinstance(node, ast.stmt) else []:
            if re.match(r"(wp|warp)\.config\.", name):
                yield f"line {node.lineno}: {name} is the application's to set, not the library's"


ALLOCATORS = {"array", "zeros", "zeros_like", "empty", "empty_like", "full", "full_like", "ones", "ones_like", "clone"}
ALLOCATORS |= {"from_numpy", "synchronize", "synchronize_device", "synchronize_stream"}


def lean_run(file: File) -> Iterator[str]:
    for function, above in functions(file.tree):
        owner = next((a.name for a in reversed(above) if isinstance(a, ast.ClassDef)), "")
        if function.name != "run" or not owner.endswith("Pass"):
            continue
        for node in ast.walk(function):
            if not isinstance(node, ast.Call):
                continue
            name = dotted(node)
            if name.split(".")[-1] in ("numpy", "list", "tolist") and "." in name:
                yield f"{owner}.run: line {node.lineno} reads back from the device"
            if re.match(r"(wp|warp)\.", name) and name.split(".")[-1] in ALLOCATORS:
                yield f"{owner}.run: line {node.lineno} calls {name}; a frame allocates nothing and waits for nothing"


def launches_name_their_device(file: File) -> Iterator[str]:
    for node in ast.walk(file.tree):
        if isinstance(node, ast.Call) and dotted(node) in ("wp.launch", "wp.launch_tiled"):
            given = {k.arg for k in node.keywords}
            if not {"device", "block_dim"} <= given and None not in given:
                yield f"line {node.lineno}: {dotted(node)} without device= and block_dim="


def no_assert(file: File) -> Iterator[str]:
    for node in ast.walk(file.tree):
        if isinstance(node, ast.Assert):
            yield f"line {node.lineno}: assert vanishes under -O; raise one of our errors"


def no_leftovers(file: File) -> Iterator[str]:
    for number, line in enumerate(file.text.splitlines(), 1):
        if re.search(r"\b(TODO|FIXME|XXX)\b", line):
            yield f"line {number}: an unfinished note"
        if re.search(r"(?<![\w.])/(work|home|root|Users|tmp)/", line):
            yield f"line {number}: a path of one machine"


def docstrings(file: File) -> Iterator[str]:
    if ast.get_docstring(file.tree) is None:
        yield "no docstring that says what the file is for"


OPTIONS = 'wp.set_module_options({"enable_backward": False})\n'
#: Rule -> path and text of a file that breaks it and nothing else of that rule.
BAD: dict[Callable[[File], Iterator[str]], list[tuple[str, str]]] = {
    file_length: [("kernels/a.py", "x = 1\n" * 401)],
    function_length: [
        ("kernels/a.py", "def f():\n" + "    x = 1\n" * 60),
        ("kernels/a.py", "@wp.kernel\ndef f():\n" + "    x = 1\n" * 80),
    ],
    kernel_names: [("kernels/a.py", "@wp.kernel\ndef shade():\n    pass")],
    kernel_parameters: [
        ("kernels/a.py", f"@wp.kernel\ndef f({', '.join(f'p{i}: wp.int32' for i in range(13))}):\n    pass"),
        ("kernels/a.py", "@wp.kernel\ndef f(a: wp.int32 = 1):\n    pass"),
        ("kernels/a.py", "@wp.kernel\ndef f(a):\n    pass"),
        ("kernels/a.py", "@wp.kernel\ndef f(a: wp.array(dtype=float)):\n    pass"),
        ("kernels/a.py", "@wp.kernel(module='unique')\ndef f(a: wp.array1d[float]):\n    pass"),
    ],
    kernel_groups: [
        ("kernels/a.py", "@wp.kernel\ndef f(\n    a: wp.int32,\n):\n    pass"),
        (
            "kernels/a.py",
            "@wp.kernel\ndef f(\n    # Params\n    a: wp.int32,\n    # In\n    b: wp.int32,\n):\n    pass",
        ),
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # Out\n    a: wp.array[wp.int32],\n):\n    pass"),
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # In\n    out_a: wp.array[wp.int32],\n):\n    pass"),
    ],
    kernel_writes: [
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # In\n    a: wp.array[wp.int32],\n):\n    a[0] = 1"),
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # In\n    a: wp.array[wp.int32],\n):\n    a[0] += 1"),
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # In\n    a: S,\n):\n    a.count[0] = 1"),
        ("kernels/a.py", "@wp.kernel\ndef f(\n    # In\n    a: wp.array[wp.int32],\n):\n    wp.atomic_add(a, 0, 1)"),
    ],
    module_options: [
        ("kernels/a.py", "@wp.kernel\ndef f():\n    pass"),
        ("kernels/a.py", 'wp.set_module_options({"fast_math": True})\n@wp.kernel\ndef f():\n    pass'),
        ("kernels/a.py", f"@wp.kernel\ndef f():\n    pass\n{OPTIONS}"),
    ],
    nested_kernels: [
        ("kernels/a.py", "VARIANTS = []\n@functools.cache\ndef make_k():\n    @wp.kernel\n    def k():\n        pass"),
        ("kernels/a.py", "VARIANTS = []\ndef make_k():\n    @wp.kernel(module='unique')\n    def k():\n        pass"),
        (
            "kernels/a.py",
            "VARIANTS = []\n@functools.cache\ndef k():\n    @wp.kernel(module='unique')\n    def k():\n        pass",
        ),
        (
            "kernels/a.py",
            "@functools.cache\ndef make_k():\n    @wp.kernel(module='unique')\n    def k():\n        pass",
        ),
    ],
    no_global_config: [
        ("warp_deferred/a.py", "wp.config.mode = 'debug'"),
        ("kernels/a.py", "def f():\n    x, wp.config.quiet = 1, True"),
    ],
    lean_run: [
        ("warp_deferred/passes/a.py", "class APass:\n    def run(self, f):\n        f.a.numpy()"),
        ("warp_deferred/passes/a.py", "class APass(Pass):\n    def run(self, f):\n        b = wp.zeros(3)"),
        ("warp_deferred/passes/a.py", "class APass(Pass):\n    def run(self, f):\n        wp.synchronize()"),
    ],
    launches_name_their_device: [
        ("warp_deferred/a.py", "wp.launch(k, dim=1, inputs=[])"),
        ("warp_deferred/a.py", "wp.launch_tiled(k, dim=1, inputs=[], device=d)"),
    ],
    no_assert: [("warp_deferred/a.py", "def f(x):\n    assert x > 0")],
    no_leftovers: [("kernels/a.py", "# TO" + "DO: later"), ("scenes/a.py", "PATH = '/home" + "/me/x'")],
    docstrings: [("scenes/a.py", "x = 1")],
}
RULES = list(BAD)

GOOD = f'''"""A file that keeps every rule."""
{OPTIONS}
BLOCK_DIM = 64
VARIANTS = [(True,)]


@functools.cache
def make_fill_kernel(flag):
    @wp.kernel(module="unique")
    def fill_kernel(
        # Frame
        views: wp.array[View],
        # In
        a: wp.array2d[wp.float32],
        # Params
        limit: wp.float32,
        # Out
        out_a: wp.array2d[wp.float32],
        out_count: wp.array[wp.int32],
    ):
        out_a[0, 0] = wp.min(a[0, 0], limit)
        wp.atomic_add(out_count, 0, 1)

    return fill_kernel


class FillPass:
    def run(self, frame):
        wp.launch(self.kernel, dim=1, inputs=self.inputs, outputs=self.outputs, device=self.device, block_dim=BLOCK_DIM)
'''


@pytest.mark.parametrize(
    ("rule", "path", "text"),
    [(rule, *case) for rule, cases in BAD.items() for case in cases],
    ids=lambda v: getattr(v, "__name__", ""),
)
def test_every_rule_fails_on_a_bad_example(rule, path, text):
    assert len(list(rule(parse(text, path)))) == 1


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_a_good_example_passes_every_rule(rule):
    assert list(rule(parse(GOOD, "kernels/good.py"))) == []


def test_the_command_line_may_set_warp_up():
    text = "wp.config.log_level = 40"
    assert not list(no_global_config(parse(text, "warp_deferred/cli_arguments.py")))
    assert list(no_global_config(parse(text, "warp_deferred/client.py")))


def test_exceptions_are_needed():
    """A name in the list that no longer breaks a rule, or is gone, must leave the list."""
    for key in EXCEPTIONS:
        path, _, name = key.partition(":")
        file = parse((ROOT / path).read_text(), path)
        if name:
            spans = [f.end_lineno - f.lineno + 1 for f, _ in functions(file.tree) if f.name == name]
            assert spans and max(spans) > 60, key
        else:
            assert len(file.text.splitlines()) > 400, key


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_files_keep_the_rules(path):
    file = parse(path.read_text(encoding="utf-8"), path.relative_to(ROOT).as_posix())
    found = [f"{file.path}: {text} ({rule.__name__})" for rule in RULES for text in rule(file)]
    assert not found, "\n".join(found)
