"""A population of DAQs under test: `python -m tests.score_population foreign|perfect|defects [-n N] [--seed S]`.

Judges records that differ from the session (`foreign`), DAQs without a defect (`perfect`) and DAQs with one defect
(`defects`) by the function of `rig score`, and with `--command EVERY` some of them by the command itself. Each case is
a line of a journal, from which an interrupted population continues; `--only NUMBER` judges one case and prints its
line. Status 1 if the goal is missed:

- foreign: none of 200 passes
- perfect: none of 200 fails, and at most 5 % are inconclusive
- defects: none of 300 passes, the right quantity fails in 95 %, and no other fails in 95 %
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from replays.score.card.scorecard import FAIL, Scorecard
from replays.score.judgement import judge
from rig.base.errors import InputError
from tests.score_cases import Case, make_foreign_case, make_perfect_case
from tests.score_defects import make_defect_case
from tests.score_sessions import Sessions

SIZES = {"foreign": 200, "perfect": 200, "defects": 300}
MAX_INCONCLUSIVE, MIN_RIGHT, MIN_NO_OTHER = 0.05, 0.95, 0.95
_STATUS = {0: "pass", 1: "fail", 2: "refused", 3: "inconclusive"}


class Population:
    """One of the three populations.

    Attributes:
        name: A key of `SIZES`.
        seed: Of its cases.
    """

    def __init__(self, name: str, seed: int, folder: Path) -> None:
        """Keep sessions and files in a folder."""
        self.name, self.seed, self._folder = name, seed, folder
        self._sessions, self._bases = Sessions(folder / "sessions"), dict[str, Scorecard]()

    def case(self, number: int) -> Case:
        """Return a case by its number; its file is kept until the next case."""
        stem = self._folder / f"case-{self.name}-{self.seed}"
        for file in self._folder.glob(f"{stem.name}.*"):
            file.unlink()
        if self.name == "defects":
            return make_defect_case(number, self.seed, self._sessions, stem, self._base)
        make = make_foreign_case if self.name == "foreign" else make_perfect_case
        return make(number, self.seed, self._sessions, stem)

    def _base(self, case: Case) -> Scorecard:
        if case.label not in self._bases:
            self._bases[case.label] = judge(case.file, [case.sent.path], path=case.path)
        return self._bases[case.label]

    def judged(self, number: int, *, command: bool = False) -> dict[str, Any]:
        """Return the line of the journal of a case."""
        case, begun = self.case(number), time.process_time()
        line: dict[str, Any] = {"population": self.name, "seed": self.seed, "number": number, "label": case.label}
        try:
            line |= _by_command(case, self._folder) if command else _by_function(case)
        except InputError as error:
            line |= {"outcome": "refused", "reason": str(error), "red": []}
        except Exception as error:
            line |= {"outcome": "crashed", "reason": f"{type(error).__name__}: {error}", "red": []}
        red = {quantity for quantity, _ in line["red"]}
        line |= {
            "right": bool(red & case.right), "other": sorted(red - case.right - case.allowed),
            "by": "command" if command else "function", "cpu_s": round(time.process_time() - begun, 2),
        }  # fmt: skip
        return line


def _by_function(case: Case) -> dict[str, Any]:
    card = judge(case.file, [case.sent.path], path=case.path, **case.judged)
    red = [(row.quantity, row.channel) for row in card.rows if row.verdict == FAIL]
    reason = "; ".join(card.evidence_gaps or card.remarks)[:300]
    return {"outcome": str(card.outcome), "path": card.path, "red": red, "reason": reason, "line": card.verdict_line}


def _by_command(case: Case, folder: Path) -> dict[str, Any]:
    from rig.cli.main import main

    card_path = folder / "card.json"
    card_path.unlink(missing_ok=True)
    words = ["score", str(case.file), "--against", str(case.sent.path), "--json", str(card_path), "--force"]
    words += ["--path", case.path] if case.path else []
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main(words)
        except SystemExit as ended:
            status = ended.code
    document = json.loads(card_path.read_text(encoding="utf-8")) if card_path.exists() else {"rows": []}
    outcome = _STATUS.get(int(status or 0), f"status {status}")
    red = [(row["quantity"], row["channel"] or "") for row in document["rows"] if row["verdict"] == FAIL]
    reason = "; ".join(document.get("doubts") or document.get("remarks") or []) or err.getvalue().strip()[-300:]
    return {
        "outcome": outcome, "path": document.get("path"), "red": red, "line": document.get("verdict", ""),
        "reason": reason[:300],
    }  # fmt: skip


def binomial_interval(count: int, of: int) -> tuple[float, float]:
    """Return the 95 % interval of a part, by Clopper and Pearson."""
    from scipy.stats import beta

    low = 0.0 if not count else float(beta.ppf(0.025, count, of - count + 1))
    return low, 1.0 if count == of else float(beta.ppf(0.975, count + 1, of - count))


def _part(name: str, count: int, of: int) -> str:
    low, high = binomial_interval(count, of)
    return f"{name}: {count} of {of} = {count / max(1, of):.1%} ({low:.1%} to {high:.1%})"


def summarise(name: str, lines: list[dict[str, Any]]) -> tuple[list[str], bool]:
    """Return the figures of a population in lines, and whether its goal is met."""
    count, outcomes = len(lines), Counter(line["outcome"] for line in lines)
    parts = [
        _part(outcome, outcomes[outcome], count) for outcome in sorted({*outcomes, "pass", "fail", "inconclusive"})
    ]
    wrong = outcomes["crashed"]
    if name == "perfect":
        good = not outcomes["fail"] and not outcomes["refused"] and outcomes["inconclusive"] <= MAX_INCONCLUSIVE * count
    elif name == "foreign":
        good = not outcomes["pass"]
    else:
        right, none = sum(line["right"] for line in lines), sum(not line["other"] for line in lines)
        parts += [_part("the right quantity is red", right, count), _part("no other is red", none, count)]
        good = not outcomes["pass"] and right >= MIN_RIGHT * count and none >= MIN_NO_OTHER * count
    used_s, by_command = sum(line["cpu_s"] for line in lines), sum(line["by"] == "command" for line in lines)
    parts.append(f"{used_s:.0f} s of processor time, {by_command} by the command")
    return parts, good and not wrong


def main(words: list[str] | None = None) -> int:
    """Judge a population; return 1 if its goal is missed."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.score_population", description=(__doc__ or "").split("\n")[0]
    )
    parser.add_argument("population", choices=list(SIZES))
    parser.add_argument("-n", type=int, help="cases; as many as the goal is about unless given")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--journal", type=Path, help="lines of JSON; NAME-SEED.jsonl in the folder unless given")
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()) / "rig-score-population")
    parser.add_argument("--command", type=int, default=0, metavar="EVERY", help="judge every so many by `rig score`")
    parser.add_argument("--only", type=int, help="judge one case and print its scorecard")
    options = parser.parse_args(words)
    size = SIZES[options.population] if options.n is None else options.n
    command: Callable[[int], bool] = lambda n: bool(options.command) and n % options.command == options.command - 1  # noqa: E731
    population = Population(options.population, options.seed, options.folder)
    if options.only is not None:
        line = population.judged(options.only, command=command(options.only))
        print(json.dumps(line, indent=1))
        return 0
    journal = options.journal or options.folder / f"{options.population}-{options.seed}.jsonl"
    lines = [json.loads(each) for each in journal.read_text(encoding="utf-8").splitlines()] if journal.exists() else []
    lines = [each for each in lines if (each["population"], each["seed"]) == (options.population, options.seed)]
    done = {each["number"] for each in lines}
    with journal.open("a", encoding="utf-8") as file:
        for number in range(size):
            if number not in done:
                lines.append(population.judged(number, command=command(number)))
                file.write(json.dumps(lines[-1]) + "\n")
                file.flush()
    lines = [each for each in lines if each["number"] < size]
    for line in lines:
        bad = {"foreign": line["outcome"] == "pass", "perfect": line["outcome"] != "pass"}.get(
            options.population, line["outcome"] == "pass" or not line["right"] or bool(line["other"])
        )
        if bad or line["outcome"] == "crashed":
            print(
                f"{line['number']:4} {line['outcome']:12} {line['label']}: red {line['red'][:4]} {line['reason'][:160]}"
            )
    summary, good = summarise(options.population, lines)
    print("\n".join([*summary, "the goal is met" if good else "THE GOAL IS MISSED"]))
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
