"""Mutation tests of the judging code: `python -m tests.mutants [--part PART] [-n N] [--seed S] [--folder FOLDER]
[--only NUMBER] [--list]`.

Changes one place of a part in a copy of this tree, and runs the tests of that module until one fails, for at most 20 s
of processor time of each process. The parts are `judging` (scorecard, faults, validation, table of units) and
`campaigns` (campaigns, protection monitor). Tests that execute the place come first,
the cheapest test file first; this is measured once and kept in the folder, and a test that fails without a mutant ends
the program with status 2. A mutant that no test kills shows a gap in the tests. Hand-picked mutants come first; the
others are drawn by a seed from all places where a comparison can be inverted, a constant changed, an operand of `and`
or `or` removed, an absolute value removed, a sign inverted or a branch swapped. Results are stored in a journal, from
which an interrupted run continues. Status 1 if fewer than 9 of 10 are killed.

The copy stays in its folder, so that kernels, which are not mutated, compile there once.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import json
import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.covering_tests import ORDER, RECORD, TRACED, Record, order_tests

ROOT = Path(__file__).parent.parent
CPU_S = 20
"""Processor time of the tests of a mutant [s]."""
BASELINE_CPU_S = 900
"""Processor time of a test file without a mutant, traced and with compilation [s]."""
MIN_KILLED = 0.9
_FAULTS = (
    "channel_faults",
    "block_faults",
    "fault_sizes",
    "fault_equations",
    "generated_faults",
    "declared_faults",
    "score_faults",
)
TESTS = {
    "replays/score/": ("score*", "time_order", "outcome"),
    "rig/run/fault_injection.py": _FAULTS, "rig/channels/faults/": _FAULTS,
    "replays/recordings/validation/": (
        "faults", "validation", "verdict", "outcome", "declared_faults", "blind_faults", "events",
    ),
    "rig/base/units.": ("units", "time_columns", "import"),
    "replays/campaigns/plugin.py": ("campaign_*", "system/test_campaigns.py"), "replays/campaigns/": ("campaign_*",),
    "drivers/protection/": ("protection", "protection_acceptance"),
}  # fmt: skip
"""Test files of each folder or module: patterns of their names in tests/unit, or paths in tests."""
_INVERSE_OPERATORS = {
    ast.Lt: ">=", ast.LtE: ">", ast.Gt: "<=", ast.GtE: "<", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in",
    ast.NotIn: "in", ast.Is: "is not", ast.IsNot: "is",
}  # fmt: skip
_DISPLAY_FUNCTIONS = ("__repr__", "__str__", "picture", "verdict_line", "describe", "draw", "_mark")
"""Functions whose places are skipped: their results are only displayed."""
_KILLING_FUNCTIONS = ("find_children", "_kill_marked")
"""Functions whose places are skipped: a mutant could kill processes of others."""
_PICKED_MUTANTS = (
    ("replays/score/card/scorecard.py", "=PASS in verdicts and not self.evidence_gaps", "=not self.evidence_gaps"),
    ("replays/score/card/scorecard.py", "=PASS in verdicts and not self.evidence_gaps", "=PASS in verdicts"),
    ("replays/score/card/scorecard.py", "limit.low <= low and high <= limit.high", "limit.low <= value <= limit.high"),
    ("replays/score/card/scorecard.py", "high < limit.low or low > limit.high", "low < limit.low or high > limit.high"),
    ("replays/estimate/intervals.py", "student_quantile(0.975, dof)", "student_quantile(0.95, dof)"),
    ("replays/estimate/intervals.py", "chi2_quantile(0.025, dof)", "chi2_quantile(0.05, dof)"),
    ("replays/estimate/spectra.py", "np.hanning(rows + 1)[:-1]", "np.hanning(rows)"),
    ("replays/score/alignment/stamps.py", "jitter_s / math.sqrt(low)", "jitter_s / math.sqrt(high)"),
    (
        "replays/score/waveform.py",
        "student(self.dof) * self.spread", "0.84 * student(self.dof) * self.spread",
    ),
    ("replays/score/card/limits.py", "if any(map(math.isnan, ends)):", "if False:"),
    ("replays/score/card/limits.py", "channel.lsb_v / math.sqrt(12.0))\n", "channel.lsb_v)\n"),
    ("rig/base/units.toml", "thou = { size = 2.54e-05 }", "thou = { size = 0.0254 }"),
    ("rig/base/units.toml", "mil = { size = 2.54e-05 }", "mil = { size = 2.54e-08 }"),
)  # fmt: skip
_PICKED_CAMPAIGN_MUTANTS = (
    (
        "replays/campaigns/files/expectation.py",
        "if place != wanted and not (isinstance(place, list) and wanted in place):", "if place != wanted:",
    ),
    ("replays/campaigns/files/expectation.py", "if each >= from_s), math.nan)", "), math.nan)"),
    ("replays/campaigns/files/expectation.py", "(np.abs(values) > level) & (times", "(values > level) & (times"),
    ("replays/campaigns/files/case_results.py", '(event["tick"] - origin, event)', '(event["tick"], event)'),
    ("replays/campaigns/measurement.py", "not numbers[0] <= numbers[1]", "numbers[0] > numbers[1]"),
    ("replays/campaigns/files/run.py", "if (left_s or device.has_ended_early) and not", "if left_s and not"),
    ("replays/campaigns/files/run.py", "and not (device.may_end or device.is_ended_by_test)", ""),
    ("replays/campaigns/equipment/record.py", " or digest.hexdigest() != summary.sha256", ""),
    ("drivers/protection/monitor.py", "accumulate(on) | (alarm in self.active)", "accumulate(on)"),
    ("drivers/protection/monitor.py", "high * (1.0 - settings.hysteresis)", "high * (1.0 + settings.hysteresis)"),
    (
        "drivers/protection/monitor.py",
        'if self.settings.not_ok == "against":\n            return np.logical_and(*votes)',
        'if self.settings.not_ok == "against":\n            return np.logical_or(*votes)',
    ),
    ("drivers/protection/monitor.py", " & ~np.logical_and(*out)", ""),
)  # fmt: skip


@dataclass(frozen=True)
class Part:
    """A part of the product.

    Attributes:
        count: Number of its mutants by default.
        modules: Folders and files of which mutants are drawn, equally many of each.
        picked: Mutants chosen by hand: file, text that occurs in it once, and its replacement.
    """

    count: int
    modules: tuple[str, ...]
    picked: tuple[tuple[str, str, str], ...]


PARTS = {
    "judging": Part(
        60,
        (
            "replays/score", "rig/run/fault_injection.py", "rig/channels/faults", "replays/recordings/validation",
            "rig/base/units.py",
        ),
        _PICKED_MUTANTS,
    ),
    "campaigns": Part(
        40,
        (
            "replays/campaigns", "replays/campaigns/files", "replays/campaigns/equipment",
            "replays/campaigns/reporting", "drivers/protection",
        ),
        _PICKED_CAMPAIGN_MUTANTS,
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change.

    Attributes:
        file: Path in the tree.
        start, end: Place in its text [characters].
        new: Replacement.
        kind: Kind of the change.
    """

    file: str
    start: int
    end: int
    new: str
    kind: str

    def applied(self, text: str) -> str:
        """Return the file's text with the change."""
        return text[: self.start] + self.new + text[self.end :]

    def describe(self, text: str) -> str:
        """Return file, line and change."""
        line = text.count("\n", 0, self.start) + 1
        return f"{self.file}:{line} {self.kind}: {' '.join(text[self.start : self.end].split())} -> {self.new}"


class _Places(ast.NodeVisitor):
    """Collects the mutants of a file."""

    def __init__(self, file: str, text: str) -> None:
        self.file, self.text, self.found = file, text, list[Mutant]()
        self._starts = [0]
        for line in text.splitlines(keepends=True):
            self._starts.append(self._starts[-1] + len(line.encode()))
        self._bytes = text.encode()

    def _at(self, line: int, column: int) -> int:
        return len(self._bytes[: self._starts[line - 1] + column].decode())

    def _span(self, node: ast.expr) -> tuple[int, int]:
        return self._at(node.lineno, node.col_offset), self._at(node.end_lineno or 0, node.end_col_offset or 0)

    def _source(self, node: ast.expr) -> str:
        start, end = self._span(node)
        return self.text[start:end]

    def _add(self, node: ast.expr, new: str, kind: str) -> None:
        self.found.append(Mutant(self.file, *self._span(node), new, kind))

    def _between(self, left: ast.expr, right: ast.expr, new: str, kind: str) -> None:
        """Replace an operator, which is between two operands, with the brackets around them."""
        start, end = self._span(left)[1], self._span(right)[0]
        between = self.text[start:end]
        if "#" not in between and "\n" not in between:
            closed = between[: len(between) - len(between.lstrip(") "))]
            opened = between[len(between.rstrip("( ")) :]
            self.found.append(Mutant(self.file, start, end, f"{closed.rstrip()} {new} {opened.lstrip()}", kind))

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        if node.name not in (*_DISPLAY_FUNCTIONS, *_KILLING_FUNCTIONS):
            for each in (*node.args.defaults, *[d for d in node.args.kw_defaults if d], *node.body):
                self.visit(each)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        for each in node.body:  # without its decorators and bases
            self.visit(each)

    def visit_keyword(self, node: ast.keyword) -> None:
        if node.arg != "strict":
            self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Skip texts."""

    def visit_Raise(self, node: ast.Raise) -> None:
        """Skip messages."""

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1:
            self._between(node.left, node.comparators[0], _INVERSE_OPERATORS[type(node.ops[0])], "comparison inverted")
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._add(node, self._source(node.values[0]), f"operands of {type(node.op).__name__.lower()} removed")
        self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> None:
        if (isinstance(node.func, ast.Name) and node.func.id == "abs") or (
            isinstance(node.func, ast.Attribute) and node.func.attr == "abs"
        ):
            self._add(node, f"({self._source(node.args[0])})", "absolute value removed")
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        new = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}.get(type(node.op))
        if new and not any(
            isinstance(s, ast.Constant | ast.JoinedStr) and not isinstance(getattr(s, "value", 0.0), int | float)
            for s in (node.left, node.right)
        ):
            self._between(node.left, node.right, new, "sign inverted" if new in "+-" else "factor inverted")
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        if isinstance(node.value, bool):
            self._add(node, str(not node.value), "constant changed")
        elif isinstance(node.value, int):
            self._add(node, str(node.value + 1), "off by one")
        elif isinstance(node.value, float):
            self._add(node, repr(0.5 * node.value if node.value else 1.0), "constant changed")

    def visit_If(self, node: ast.If) -> None:
        self._add(node.test, f"not ({self._source(node.test)})", "branch swapped")
        self.generic_visit(node)

    def visit_IfExp(self, node: ast.IfExp) -> None:
        self._add(node.test, f"(not ({self._source(node.test)}))", "branch swapped")
        self.generic_visit(node)


def find_mutants(file: str) -> list[Mutant]:
    """Return all mutants of a file; some may not be valid Python."""
    text = (ROOT / file).read_text(encoding="utf-8")
    visitor = _Places(file, text)
    visitor.visit(ast.parse(text))
    return visitor.found


def _parses(text: str) -> bool:
    try:
        ast.parse(text)
    except SyntaxError:
        return False
    return True


def replace_once(text: str, old: str, new: str, name: str) -> str:
    """Return a source with a text replaced.

    Raises:
        ValueError: The text does not occur exactly once; the message has the name of the defect.
    """
    if text.count(old) != 1:
        raise ValueError(f"{name}: the replaced text must occur once; received {text.count(old)} times: {old}")
    return text.replace(old, new)


def choose_mutants(part: Part, count: int, seed: int) -> list[Mutant]:
    """Return `count` mutants: the picked ones, then equally many of each module, drawn at random."""
    found = []
    for file, old, new in part.picked:
        text = (ROOT / file).read_text(encoding="utf-8")
        try:
            replace_once(text, old, new, file)
        except ValueError as error:
            print(error)
            sys.exit(2)
        found.append(Mutant(file, text.index(old), text.index(old) + len(old), new, "picked"))
    draw, stacks = random.Random(seed), []
    for module in part.modules:
        kinds: dict[str, list[Mutant]] = {}
        for each in (mutant for file in list_files(module) for mutant in find_mutants(file)):
            kinds.setdefault(each.kind, []).append(each)
        for each in kinds.values():
            draw.shuffle(each)
        stacks.append(_alternate([kinds[kind] for kind in sorted(kinds)]))
    for each in _alternate(stacks):
        if len(found) < count and _parses(each.applied((ROOT / each.file).read_text(encoding="utf-8"))):
            found.append(each)
    return found[:count]


def _alternate(stacks: list[list[Mutant]]) -> list[Mutant]:
    """Return one of each in turn until all are used."""
    longest = max(map(len, stacks), default=0)
    return [stack[n] for n in range(longest) for stack in stacks if n < len(stack)]


def find_tests(file: str) -> list[str]:
    """Return the test files of a module."""
    names = next(names for prefix, names in TESTS.items() if file.startswith(prefix))
    patterns = [name if "/" in name else f"unit/test_{name}.py" for name in names]
    found = {path for pattern in patterns for path in (ROOT / "tests").glob(pattern)}
    return sorted(str(path.relative_to(ROOT)) for path in found)


def list_files(module: str) -> list[str]:
    """Return the file of a module, or the files of a folder without its subfolders and without tests."""
    found = (ROOT / module).glob("*.py") if not module.endswith(".py") else [ROOT / module]
    return sorted(str(path.relative_to(ROOT)) for path in found if not path.name.startswith("test_"))


def measure_tests(
    tree: Path, files: list[str], tests: list[str], stored: dict[str, dict[str, Any]], journal: Path
) -> Record | None:
    """Return the lines that tests execute, from the journal or measured; None if a test fails."""
    record, helpers = Record(), list_helpers()
    texts = {path: (ROOT / path).read_text(encoding="utf-8") for path in (*files, *helpers, *tests)}
    for test in tests:
        key = _key(*files, *(texts[path] for path in (*helpers, test)))
        # The lines that a test executes stay the same until one of its files changes.
        if key not in stored or any(
            _key(texts.get(path, "")) != digest for path, digest in stored[key]["files"].items()
        ):
            written = tree.parent / "record.json"
            traced = {RECORD: str(written), TRACED: json.dumps(files)}
            result, used_s = run(tree, [test], BASELINE_CPU_S, traced)
            print(f"without a mutant: {result} {used_s:5} s  {test}", flush=True)
            if result != "lived":
                return None
            found: Record = json.loads(written.read_text(encoding="utf-8"))
            executed = sorted({path for ran in found.values() for path in ran["lines"]})
            _keep(journal, stored, {"key": key, "files": {p: _key(texts[p]) for p in executed}, "record": found})
        record.update(stored[key]["record"])
    return record


def list_helpers() -> list[str]:
    """Return the files that tests import, but not these programs."""
    paths = [path for folder in ("tests", "tests/unit") for path in sorted((ROOT / folder).glob("*.py"))]
    own = ("mutants.py", "covering_tests.py")
    return [str(path.relative_to(ROOT)) for path in paths if not path.name.startswith("test_") and path.name not in own]


def _key(*texts: str) -> str:
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


def _keep(journal: Path, stored: dict[str, dict[str, Any]], line: dict[str, Any]) -> None:
    stored[line["key"]] = line
    with journal.open("a", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def copy_tree(folder: Path) -> Path:
    """Update the copy of the tree; unchanged files are not written."""
    tree = folder / "tree"
    words = ("git", "ls-files", "--cached", "--others", "--exclude-standard", "-z")
    names = subprocess.run(words, cwd=ROOT, check=True, capture_output=True).stdout.decode().split("\0")
    for name in filter(None, names):
        source, target = ROOT / name, tree / name
        if not source.is_file() or (target.is_file() and target.read_bytes() == source.read_bytes()):
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)
    return tree


def run(tree: Path, tests: list[str], limit_s: int, more: dict[str, str]) -> tuple[str, float]:
    """Run tests until one fails.

    Args:
        tree: Folder of the copy.
        tests: Test files.
        limit_s: Processor time after which the tests are stopped [s].
        more: Environment variables of the plugin `tests.covering_tests`.

    Returns:
        "killed", "lived" or "out of time"; the processor time [s].
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    words = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly"]
    # In a folder of its own: pytest removes old folders of other runs, and fails if one of these is removed meanwhile.
    words += ["--basetemp", str(tree.parent / "temporary"), "-p", "tests.covering_tests", *tests]
    ended = subprocess.run(
        words, cwd=tree, capture_output=True, check=False,
        env={**os.environ, "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1", **more},
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s)),
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    # A test module that cannot be imported also counts as a kill; a signal is that of the limit.
    return {0: "lived", 1: "killed", 2: "killed"}.get(ended.returncode, "out of time"), round(used_s, 1)


def _lines(journal: Path) -> Iterator[dict[str, Any]]:
    if journal.exists():
        yield from map(json.loads, journal.read_text(encoding="utf-8").splitlines())


def main(words: list[str] | None = None) -> int:
    """Run mutants; return 1 if too many survive."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--part", choices=PARTS, default="judging")
    parser.add_argument("-n", type=int, help="number of mutants, the hand-picked ones first (default: 60 or 40)")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "rig-mutants")
    parser.add_argument("--only", type=int, help="run one mutant, by its number, whatever the journal has of it")
    parser.add_argument("--list", action="store_true", help="print the mutants and run nothing")
    options = parser.parse_args(words)
    part = PARTS[options.part]
    mutants = choose_mutants(part, options.n or part.count, options.seed)
    texts = {each.file: (ROOT / each.file).read_text(encoding="utf-8") for each in mutants}
    if options.list:
        print("\n".join(f"{n:3} {each.describe(texts[each.file])}" for n, each in enumerate(mutants)))
        return 0
    tree = copy_tree(options.folder)
    journal = options.folder / "journal.jsonl"
    stored = {line["key"]: line for line in _lines(journal)}
    all_tests = sorted({test for mutant in mutants for test in find_tests(mutant.file)})
    files = [file for module in part.modules for file in list_files(module)]
    record = measure_tests(tree, files, all_tests, stored, journal)
    if record is None:
        return 2
    sources = {file: (ROOT / file).read_text(encoding="utf-8") for file in files}
    helpers = [(ROOT / path).read_text(encoding="utf-8") for path in list_helpers()]
    results, order = [], options.folder / "order.json"
    for number, mutant in enumerate(mutants):
        if options.only not in (None, number):
            continue
        tests, text = find_tests(mutant.file), texts[mutant.file]
        description = mutant.describe(text)
        own = {test: ran for test, ran in record.items() if test.partition("::")[0] in tests}
        first, last = (text.count("\n", 0, place) + 1 for place in (mutant.start, mutant.end))
        ids = json.dumps(order_tests(own, sources, mutant.file, first, last))
        key = _key(description, text, ids, *helpers, *((ROOT / test).read_text(encoding="utf-8") for test in tests))
        if key not in stored or options.only is not None:
            order.write_text(ids, encoding="utf-8")
            target = tree / mutant.file
            try:
                target.write_text(mutant.applied(text), encoding="utf-8")
                result, used_s = run(tree, tests, CPU_S, {ORDER: str(order)})
            finally:
                target.write_text(text, encoding="utf-8")
            _keep(journal, stored, {"key": key, "mutant": description, "result": result, "cpu_s": used_s})
        results.append(str(stored[key]["result"]))
        print(f"{number:3} {results[-1]:12} {stored[key]['cpu_s']:5} s  {description}", flush=True)
    killed = results.count("killed")
    print(
        f"{killed} of {len(results)} killed; {results.count('out of time')} out of time, {results.count('lived')} lived"
    )
    return 0 if killed >= MIN_KILLED * len(results) else 1


if __name__ == "__main__":
    sys.exit(main())
