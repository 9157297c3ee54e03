"""Files are opened and written by `rig.base.files`, JSON from outside is read by `rig.base.checks`, and figures are
drawn by `replays.report.canvas`: the syntax trees show no other calls.
"""

from __future__ import annotations

import ast

import pytest

from tests.house.test_sizes import paths, tree_of

_DRAFT = "a file that is named by the writer's own draft"
_LOCK = "a lock, a folder, a pipe or a terminal, not a file of data"
_INTERNAL = "text that this program wrote, or holds already"
EXCEPTIONS = {
    "rig/base/files.py": "the functions themselves",
    "rig/base/checks.py:read_json": "the function itself",
    "rig/cli/main.py:_open_closed_streams": "the null device in place of closed streams",
    "rig/cli/commands/completion.py:_install": "the start file of the user's shell, which may be a link",
    "rig/cli/commands/completion.py:_remove": "the same",
    "rig/cli/commands/keys.py:_values": _INTERNAL,
    "rig/cli/commands/view.py:_saved": _DRAFT,
    "rig/physics/engines/tape/taylor.py": "run by a developer, who generates a file of the source",
    "rig/run/offline.py:__init__": _DRAFT,
    "rig/run/offline.py:array": _DRAFT,
    "rig/run/scenes.py:scene_document": _INTERNAL,
    "rig/serve/transport/exposure/certificates.py": "new folders of unguessable names, readable by their owner only",
    "rig/serve/transport/exposure/secret.py": "created exclusively, and private to its owner from the start",
    "rig/serve/transport/names.py": _LOCK,
    "drivers/link/serial.py:open_serial": _LOCK,
    "recorder/contents/consistency.py:_load_json": "values that are only compared; text that is not JSON has none",
    "recorder/viewer/canvas.py:piped": _LOCK,
    "recorder/files/unfinished_file.py": "keeps its file if it is interrupted; creates it exclusively",
    "replays/campaigns/evidence.py": "moves files within its own folder, without links",
    "replays/campaigns/equipment/record.py": "the descriptor by which a recording is judged",
    "replays/campaigns/equipment/process.py": "the output of a device, without links",
    "replays/recordings/formats/mapping.py:document": _INTERNAL,
    "replays/recordings/formats/exporting/selection.py:sidecar": "documents checked when the recording was opened",
    "replays/recordings/formats/exporting/export.py": _DRAFT,
    "replays/recordings/formats/readers/delimited.py:__init__": _DRAFT,
    "replays/recordings/formats/readers/mdf.py:close": _DRAFT,
    "replays/recordings/formats/readers/uff.py:__init__": _DRAFT,
    "replays/recordings/identification/document.py:write_set": "in a temporary folder",
    "replays/report/canvas.py": "the functions themselves",
}
"""Functions, or modules with all of their functions, that do it themselves, with the reason."""
_ATTRIBUTES = frozenset({"write_text", "write_bytes", "savefig", "rename", "renames", "mkstemp", "NamedTemporaryFile"})
_OF_MODULES = {"os": {"open", "replace", "rename"}, "json": {"load", "loads"}, "np": {"load", "loadtxt", "genfromtxt"},
               "shutil": {"copy", "copyfile", "move"}, "io": {"open"}}  # fmt: skip


def _is_direct(call: ast.Call) -> bool:
    """Return whether a call opens, writes or renames a file, reads JSON, or saves a figure."""
    to = call.func
    if isinstance(to, ast.Name):
        return to.id == "open"
    if not isinstance(to, ast.Attribute):
        return False
    if isinstance(to.value, ast.Name) and to.attr in _OF_MODULES.get(to.value.id, ()):
        return True
    mode = next((each.value for each in call.args[:1] if isinstance(each, ast.Constant)), None)
    opens = to.attr == "open" and ((isinstance(mode, str) and len(mode) <= 3) or any(
        each.arg in ("encoding", "newline") for each in call.keywords))  # fmt: skip
    return opens or to.attr in _ATTRIBUTES or (to.attr == "replace" and len(call.args) == 1 and not call.keywords)


def find_direct_calls(tree: ast.AST) -> list[tuple[str, int]]:
    """Return function and line of all such calls; of a nested function, the outermost name inside a class or module."""
    found = []

    def visit(node: ast.AST, name: str) -> None:
        for child in ast.iter_child_nodes(node):
            inner = name
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef) and not name:
                inner = child.name
            if isinstance(child, ast.Call) and _is_direct(child):
                found.append((name, child.lineno))
            visit(child, inner)

    visit(tree, "")
    return found


def test_files_are_opened_and_written_in_one_module() -> None:
    used, others = set(), []
    for path in paths():
        for name, line in find_direct_calls(tree_of(path)):
            key = next((key for key in (path, f"{path}:{name}") if key in EXCEPTIONS), None)
            if key is None:
                others.append(f"{path}:{line} {name}")
            used.add(key)
    assert not others
    assert set(EXCEPTIONS) - used == set(), "exceptions that nothing needs"


@pytest.mark.parametrize(
    "text",
    ["open('a')", "path.open('wb')", "path.open(encoding='utf-8')", "os.replace(a, b)", "draft.replace(path)",
     "json.loads(text)", "figure.savefig(path)", "path.write_text('')", "np.load(path)"],
)  # fmt: skip
def test_a_direct_call_is_found(text: str) -> None:
    assert find_direct_calls(ast.parse(f"def save():\n    {text}")) == [("save", 2)]


def test_other_calls_are_not_found() -> None:
    assert not find_direct_calls(ast.parse("text.replace('a', 'b')\nRecording.open(path)\nopen_file(path)"))
